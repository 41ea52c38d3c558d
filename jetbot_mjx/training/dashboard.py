"""A terminal that people watch shows how a training goes, in place: rich's live display.

One thread of its own draws. Training only leaves metrics and lines for it and never waits, not
even for a terminal that no longer reads. The display hides no cursor and ends with an empty
line: however the process ends, by SIGKILL too, the terminal is in order and the last metrics
stay on it.
"""

import contextlib
import os
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TextIO

from rich.console import Console, RenderableType
from rich.live import Live
from rich.text import Text

from jetbot_mjx.runs.metrics import History, MetricValues
from jetbot_mjx.training.console import COMPILING, Lines, Terminal
from jetbot_mjx.training.dashboard_layout import DashboardLayout, memory_in_use

_SECONDS_BETWEEN_DRAWINGS = 0.5
_PATIENCE = 1.0
"""How long anybody waits for the terminal [s]."""


def open_terminal(
    run_dirs: Sequence[Path], total_steps: int, histories: Sequence[Sequence[History]]
) -> Terminal:
    """Return the dashboard where standard output is a terminal that people watch, otherwise lines.

    Rich's conventions hold: `TERM=dumb` and `TTY_INTERACTIVE=0` mean lines, `NO_COLOR` no colours.

    Args:
      run_dirs: the folder of each seed.
      total_steps: environment steps of the whole training.
      histories: what each seed has logged before.

    Returns:
      Whoever tells people about this training.
    """
    stream = sys.stdout
    console = Console(file=stream, highlight=False)
    watched = stream.isatty() and console.is_interactive and _in_foreground(stream)
    if not watched or not console.encoding.startswith("utf"):
        return Lines(total_steps, stream)
    seeds = [folder.name.removeprefix("seed-") for folder in run_dirs]
    folder = run_dirs[0] if len(run_dirs) == 1 else run_dirs[0].parent
    return Dashboard(DashboardLayout(folder.name, total_steps, seeds, histories), console)


class Dashboard:
    """A board on the terminal, drawn by a thread of its own.

    What is printed while it is there, by whomever, scrolls above it.
    """

    def __init__(self, board: DashboardLayout, console: Console) -> None:
        """Prepare it.

        Args:
          board: what to show.
          console: of a terminal.
        """
        self._board = board
        self._console = console
        self._lock = threading.Lock()
        self._lines: list[str] = []
        self._wake, self._drawn = threading.Event(), threading.Event()
        self._drawing = self._closing = False
        self._thread = threading.Thread(target=self._draw_until_closed, daemon=True)
        self._replaced: dict[str, tuple[TextIO, _Lines]] = {}

    def begin(self) -> None:
        """Take its place on the terminal."""
        self.phase(COMPILING)
        self._drawing = True
        self._redirect()
        self._thread.start()

    def phase(self, name: str) -> None:
        """Show which phase it is, and how long it has lasted."""
        with self._lock:
            self._board.phase(name)

    def write(self, env_steps: int, metrics: Sequence[MetricValues]) -> None:
        """Show a report."""
        with self._lock:
            self._board.write(env_steps, metrics)

    def tell(self, env_steps: int, metrics: MetricValues, env_steps_per_second: float) -> None:
        """Show what is known between two reports."""
        with self._lock:
            self._board.tell(env_steps, metrics, env_steps_per_second)

    def say(self, text: str) -> None:
        """Let lines scroll above the board."""
        with self._lock:
            if self._drawing:
                self._lines.append(text)
                self._drawn.clear()
                self._wake.set()
                return
        print(text, file=self._console.file, flush=True)

    def wait(self) -> None:
        """Wait until all that was said is drawn, or until the terminal has had its time."""
        if threading.current_thread() is not self._thread:
            self._drawn.wait(_PATIENCE)

    def close(self) -> None:
        """Draw it for the last time."""
        if self._thread.ident is None:
            return
        for _, lines in self._replaced.values():
            lines.end()
        with self._lock:
            self._board.phase(None)
            self._closing = True
        self._wake.set()
        self._thread.join(_PATIENCE)
        self._restore()

    def _redirect(self) -> None:
        for name in ("stdout", "stderr"):
            stream = getattr(sys, name)
            # What goes into a file goes there still.
            if stream.isatty():
                self._replaced[name] = (stream, _Lines(self, stream))
                setattr(sys, name, self._replaced[name][1])

    def _restore(self) -> None:
        for name, (stream, ours) in self._replaced.items():
            if getattr(sys, name) is ours:
                setattr(sys, name, stream)

    def _draw_until_closed(self) -> None:
        live = Live(
            get_renderable=self._render,
            console=self._console,
            auto_refresh=False,
            redirect_stdout=False,
            redirect_stderr=False,
        )
        try:
            # A terminal that has gone away is no reason to stop training.
            with contextlib.suppress(OSError):
                live.start()
                self._console.show_cursor(True)
                while not self._closing:
                    if _in_foreground(self._console.file):
                        self._draw(live)
                    self._wake.wait(_SECONDS_BETWEEN_DRAWINGS)
                    self._wake.clear()
                self._draw(live)
                live.stop()
        finally:
            with self._lock:
                self._drawing = False
            self._drawn.set()
            self._restore()

    def _draw(self, live: Live) -> None:
        with self._lock:
            lines, self._lines = self._lines, []
        if lines:
            self._console.print(Text.from_ansi("\n".join(lines)), soft_wrap=True)
        else:
            live.refresh()
        with self._lock:
            if not self._lines:
                self._drawn.set()

    def _render(self) -> RenderableType:
        # A device may take its time to answer.
        memory = memory_in_use()
        with self._lock:
            return self._board.render(memory)


class _Lines:
    """Stands in for a stream: whole lines go above the board."""

    def __init__(self, dashboard: Dashboard, stream: TextIO) -> None:
        self._dashboard = dashboard
        self._stream = stream
        self._lock = threading.Lock()
        self._begun = ""

    def write(self, text: str) -> int:
        with self._lock:
            *lines, self._begun = (self._begun + text).split("\n")
        if lines:
            self._dashboard.say("\n".join(lines))
        return len(text)

    def flush(self) -> None:
        self._dashboard.wait()

    def end(self) -> None:
        """Take what was begun for a line."""
        if self._begun:
            self.write("\n")

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


def _in_foreground(stream: Any) -> bool:
    """Return whether a shell has given its terminal to this process, or there is no shell."""
    try:
        return os.tcgetpgrp(stream.fileno()) == os.getpgrp()
    except (OSError, ValueError):
        return True
