"""Show the progress of a command: a bar on a terminal, and plain lines elsewhere.

What takes long reports its stages with `stage`, wherever it is in the package. Only a command
switches the display on, with `show_progress`; in a program that imports the package nothing is
shown. All times count from the start of the process.
"""

import contextlib
import contextvars
import os
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from typing import IO, TYPE_CHECKING, TextIO

if TYPE_CHECKING:
    from rich.console import Console

_SECONDS_BETWEEN_LINES = 10.0
_SECONDS_BEFORE_LINE = 2.0
"""Time after which a stage is worth a line [s]."""

Advance = Callable[[int], None]
"""Reports that so many further units of a stage are done."""


_Display = Callable[[str, int | None], contextlib.AbstractContextManager[Advance]]
_DISPLAY: contextvars.ContextVar[_Display | None] = contextvars.ContextVar("display", default=None)


@contextlib.contextmanager
def stage(name: str, total: int | None = None) -> Iterator[Advance]:
    """Report a stage that takes the time of the context; stages may be nested.

    Args:
      name: What is done, such as `compiling`, or what is counted, such as `frames`.
      total: The number of units of the stage, or None if they cannot be counted.

    Yields:
      A function that takes the number of units that have been completed since its last call.
    """
    display = _DISPLAY.get()
    if display is None:
        yield lambda count: None
        return
    with display(name, total) as advance:
        yield advance


@contextlib.contextmanager
def show_progress(stream: TextIO) -> Iterator[None]:
    """Show the stages inside the context.

    Args:
      stream: Where to show them: with a bar if it is a terminal in the foreground.
    """
    # Rich is not needed in a program that imports the package.
    from rich.console import Console

    console = Console(file=stream, highlight=False)
    with _bars(console) if is_watched(console) else contextlib.nullcontext(_lines(stream)) as shown:
        token = _DISPLAY.set(shown)
        try:
            yield
        finally:
            _DISPLAY.reset(token)


def is_watched(console: "Console") -> bool:
    """Return whether a console is a terminal in the foreground that can be drawn on.

    As rich does, `TERM=dumb` and `TTY_INTERACTIVE=0` select plain lines.
    """
    drawable = console.file.isatty() and console.is_interactive
    return drawable and console.encoding.startswith("utf") and in_foreground(console.file)


def in_foreground(stream: IO[str]) -> bool:
    """Return whether the terminal belongs to this process group, or to no shell at all."""
    if not hasattr(os, "tcgetpgrp"):  # on Windows
        return True
    try:
        return os.tcgetpgrp(stream.fileno()) == os.getpgrp()
    except (OSError, ValueError):
        return True


@contextlib.contextmanager
def _bars(console: "Console") -> Iterator[_Display]:
    """Show one bar for each stage that is under way; rich's own thread draws them."""
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        ProgressColumn,
        Task,
        TextColumn,
        TimeRemainingColumn,
    )
    from rich.text import Text

    from jetbot_mjx.terminal.clock import process_seconds

    class Count(MofNCompleteColumn):
        def render(self, task: Task) -> Text:
            return Text("") if task.total is None else super().render(task)

    class Clock(ProgressColumn):
        def render(self, task: Task) -> Text:
            return Text(f"{process_seconds():.0f} s", "dim")

    progress = Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        Count(separator=" of "),
        TimeRemainingColumn(compact=True),
        Clock(),
        console=console,
        transient=True,
        refresh_per_second=4,
        speed_estimate_period=3600.0,
        # Results may go to a file.
        redirect_stdout=sys.stdout.isatty(),
        redirect_stderr=sys.stderr.isatty(),
    )

    @contextlib.contextmanager
    def show(name: str, total: int | None) -> Iterator[Advance]:
        task = progress.add_task(name, total=total)
        try:
            yield lambda count: progress.advance(task, count)
        finally:
            progress.remove_task(task)

    with progress:
        yield show


def _lines(stream: TextIO) -> _Display:
    """Return a display that prints a line for every stage that takes long, and then now and then.

    A thread prints the lines of a stage in which nothing is counted for long, such as compiling.
    """
    from jetbot_mjx.terminal.clock import process_seconds

    lock = threading.Lock()
    under_way: list[threading.Event] = []

    def say(text: str) -> None:
        # A reader that has gone does not end the command.
        with lock, contextlib.suppress(OSError, ValueError):
            print(f"{process_seconds():7.1f} s  {text}", file=stream, flush=True)

    @contextlib.contextmanager
    def show(name: str, total: int | None) -> Iterator[Advance]:
        done, began = 0, time.monotonic()
        reports: list[tuple[int, float]] = []  # the first and the last: what was done, and when
        last_line = began
        finished = threading.Event()

        def remind() -> None:
            if finished.wait(_SECONDS_BEFORE_LINE):
                return
            say(name if total is None else f"{name}: {total:,}")
            while not finished.wait(_SECONDS_BETWEEN_LINES):
                # Of stages inside each other, the inner one tells what takes long.
                if under_way[-1:] == [finished]:
                    say_how_far()

        def advance(count: int) -> None:
            nonlocal done
            done += count
            reports.append((done, time.monotonic()))
            del reports[1:-1]
            if total and done < total:
                say_how_far()

        def say_how_far() -> None:
            nonlocal last_line
            now = time.monotonic()
            if now - last_line < _SECONDS_BETWEEN_LINES:
                return
            last_line = now
            counted = "" if total is None else f" {done:,} of {total:,},"
            if total and reports and done > reports[0][0]:
                say(f"{name}:{counted} about {_seconds_left(reports, now, total):.0f} s left")
            else:
                say(f"{name}:{counted} {now - began:.0f} s so far")

        under_way.append(finished)
        threading.Thread(target=remind, daemon=True).start()
        try:
            yield advance
        finally:
            finished.set()
            under_way.remove(finished)

    return show


def _seconds_left(reports: Sequence[tuple[int, float]], now: float, total: int) -> float:
    """Return how long a stage will still take, at the speed between its first and last report.

    What came before the first has compiled, too, and says nothing about the rest.

    Args:
      reports: how many units the first and the last report told, and when [s].
      now: the time [s].
      total: all units.
    """
    first, last = reports[0], reports[-1]
    each = (last[1] - first[1]) / (last[0] - first[0])
    # The next unit is on its way, and takes at least as long as it has taken.
    under_way = now - last[1]
    return max(each - under_way, 0) + each * (total - last[0] - 1)
