"""Show the progress of a training in place, on a terminal that a user watches, with rich.

A thread draws twice a second, and only this thread writes to the terminal. The training updates
plain data and queues lines, so that a terminal that stops reading (Ctrl-S, a lost connection) never
blocks it. The cursor stays visible and rests on an empty line below the dashboard, so the terminal
is in order however the process ends, even by SIGKILL.
"""

import contextlib
import io
import os
import statistics
import sys
import textwrap
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, TextIO

import jax
from rich.columns import Columns
from rich.console import Console, ConsoleOptions, Group, RenderResult
from rich.live import Live
from rich.measure import Measurement
from rich.panel import Panel
from rich.progress import Progress
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from jetbot_mjx.errors import printable_lines
from jetbot_mjx.runs import History, MetricValues, mean_of
from jetbot_mjx.terminal import in_foreground, process_seconds
from jetbot_mjx.training.console import Phase, Terminal

_BLOCKS = "▁▂▃▄▅▆▇█"
_MAX_ROWS = 8
_MAX_WIDTH = 100
_MIN_CURVE, _MIN_BAR = 8, 8
_DROPPED = ("length", "return", "p95", "", "best", "exploring", "to goal")
"""Columns of the table of seeds that a narrow terminal leaves out, the first of them first; the
curve has no name."""
_UPDATE = {
    "loss": ("loss/total", "{:.3g}"),
    "KL": ("policy/kl", "{:.2g}"),
    "std": ("policy/std", "{:.2f}"),
    "learning rate": ("policy/learning_rate", "{:.1e}"),
}
"""Metrics of the line on the last update, by their label."""
_SECONDS_BETWEEN_DRAWINGS = 0.5
_PATIENCE_SECONDS = 1.0
"""Longest time that a caller waits for the terminal, at a flush and at the end [s]."""
_SPEED_SECONDS = 3600.0
"""Time over which the speed for the remaining time is averaged [s]."""


def sparkline(rates: Sequence[float], width: int) -> str:
    """Return a curve of rates from 0 to 1 as blocks, sampled evenly to at most `width` of them."""
    if len(rates) > width:
        scale = (len(rates) - 1) / max(1, width - 1)
        rates = [rates[round(place * scale)] for place in range(width)]
    return "".join(_BLOCKS[min(int(rate * len(_BLOCKS)), len(_BLOCKS) - 1)] for rate in rates)


def scaled(values: Sequence[float]) -> list[float]:
    """Return a curve of values, such as returns, as rates from 0 at the lowest to 1."""
    low, high = min(values, default=0.0), max(values, default=0.0)
    return [(value - low) / (high - low) if high > low else 0.0 for value in values]


class Dashboard(Terminal):
    """A `Dashboard` shows scores, speed and phases in place; messages scroll above it."""

    def __init__(
        self,
        title: str,
        total_steps: int,
        seeds: Sequence[str],
        histories: Sequence[Sequence[History]],
        console: Console,
    ) -> None:
        """Read the history; nothing is drawn yet.

        Args:
          title: name of the run.
          total_steps: environment steps of the whole training.
          seeds: name of each seed.
          histories: the metrics that each seed has logged before.
          console: the terminal to draw on.
        """
        super().__init__(total_steps)
        self._title, self._seeds, self._console = title, seeds, console
        self._scores: list[list[float]] = [[] for _ in seeds]
        self._scored_by: Literal["success", "return"] = "success"
        self._is_own = False
        self._metrics: Sequence[MetricValues] = [{} for _ in seeds]
        self._mean: MetricValues = {}
        self._nonfinite = 0.0
        self._speed: float | None = None
        self._phase: Phase | None = None
        self._spent: dict[Phase, float] = {}
        self._phase_began = time.monotonic()
        # Show the history before the speed for the remaining time is measured.
        steps = 0
        for entries in zip(*histories, strict=False):
            steps = entries[0].env_steps
            self._add([entry.metrics for entry in entries])
        self._progress = Progress(
            console=console, speed_estimate_period=_SPEED_SECONDS, get_time=time.monotonic
        )
        self._task = self._progress.add_task("", total=total_steps, completed=steps)
        # Protects the data above and the lines, and is never held while the terminal is written.
        self._lock = threading.Lock()
        self._lines: list[str] = []
        self._wake, self._idle = threading.Event(), threading.Event()
        self._drawing = self._closing = False
        self._thread = threading.Thread(target=self._draw_until_closed, daemon=True)
        self._replaced: dict[str, tuple[TextIO, _LineQueue]] = {}

    def begin(self) -> None:
        """Begin to draw, and to print above the dashboard what others print on this terminal."""
        self.phase("compiling")
        self._drawing = True
        for name in ("stdout", "stderr"):
            stream = getattr(sys, name)
            # Standard error may go to a file.
            if stream.isatty():
                self._replaced[name] = stream, _LineQueue(self, stream)
                setattr(sys, name, self._replaced[name][1])
        self._thread.start()

    def phase(self, name: Phase | None) -> None:
        """Show that a phase begins; None: the training has ended."""
        now = time.monotonic()
        with self._lock:
            if self._phase is not None:
                self._spent[self._phase] = self._seconds_in(self._phase)
            # The start of the process belongs to the first phase, which is that of compiling.
            self._phase_began = now if self._spent else now - process_seconds()
            self._phase = name
            if name is not None:
                self._spent.setdefault(name, 0.0)

    def write(self, env_steps: int, metrics: Sequence[MetricValues]) -> None:
        """Show the metrics of every seed at the end of an interval."""
        with self._lock:
            self._add(metrics)
            self._advance(env_steps, metrics[0].get("time/env_steps_per_second"))

    def update(self, env_steps: int, metrics: MetricValues, env_steps_per_second: float) -> None:
        """Show progress within an interval; the metrics are means over all seeds."""
        with self._lock:
            self._mean = {**self._mean, **metrics}
            self._advance(env_steps, env_steps_per_second)

    def say(self, text: str) -> None:
        """Print a message above the dashboard, or as it is before the dashboard is drawn.

        What is printed before, such as the headline, breaks between words. Messages above the
        dashboard may be commands to copy, and the terminal itself breaks them.
        """
        text = printable_lines(text)
        with self._lock:
            if self._drawing:
                self._lines.append(text)
                self._idle.clear()
                self._wake.set()
                return
        # A terminal that is gone is no reason to fail.
        with contextlib.suppress(OSError):
            fill = textwrap.TextWrapper(
                self._console.width, break_long_words=False, break_on_hyphens=False
            ).fill
            print(*map(fill, text.split("\n")), sep="\n", file=self._console.file, flush=True)

    def wait(self) -> None:
        """Wait until all messages are printed, but not for long."""
        if self._drawing and threading.current_thread() is not self._thread:
            self._idle.wait(_PATIENCE_SECONDS)

    def close(self) -> None:
        """Draw for the last time."""
        self.phase(None)
        if self._thread.ident is None:
            return
        for _, queue in self._replaced.values():
            queue.end_line()
        self._closing = True
        self._wake.set()
        self._thread.join(_PATIENCE_SECONDS)
        self._restore_streams()

    def _restore_streams(self) -> None:
        for name, (stream, queue) in self._replaced.items():
            if getattr(sys, name) is queue:
                setattr(sys, name, stream)

    def _draw_until_closed(self) -> None:
        """Draw until the training ends or the terminal is gone; then messages are printed again."""
        live = Live(
            get_renderable=self._render_locked,
            console=self._console,
            auto_refresh=False,
            redirect_stdout=False,
            redirect_stderr=False,
        )
        try:
            with contextlib.suppress(OSError):
                live.start()
                self._console.show_cursor(True)
                while not self._closing:
                    if in_foreground(self._console.file):
                        self._draw(live)
                    self._wake.wait(_SECONDS_BETWEEN_DRAWINGS)
                    self._wake.clear()
                self._draw(live)
                live.stop()
        finally:
            with self._lock:
                self._drawing = False
            self._idle.set()
            self._restore_streams()

    def _draw(self, live: Live) -> None:
        with self._lock:
            lines, self._lines = self._lines, []
        # Printing draws the dashboard below the lines.
        if lines:
            self._console.print(Text("\n".join(lines)), soft_wrap=True)
        else:
            live.refresh()
        with self._lock:
            if not self._lines:
                self._idle.set()

    def _render_locked(self) -> Group:
        with self._lock:
            return self.render()

    def _add(self, metrics: Sequence[MetricValues]) -> None:
        self._metrics, self._mean = metrics, mean_of(metrics)
        # Only an environment of one's own has an interval of the return.
        self._is_own = "eval/return_low" in self._mean
        told = not self._is_own or self._mean.get("eval/success_rate") is not None
        self._scored_by = "success" if told else "return"
        key = "eval/success_rate" if told else "eval/episode_return"
        for scores, one in zip(self._scores, metrics, strict=True):
            if (score := one.get(key)) is not None:
                scores.append(score)
            for name in ("train/nonfinite_envs", "train/nonfinite_updates"):
                self._nonfinite += one.get(name) or 0.0

    def _advance(self, env_steps: int, speed: float | None) -> None:
        self._progress.update(self._task, completed=env_steps)
        self._speed = speed

    def _seconds_in(self, phase: Phase) -> float:
        running = time.monotonic() - self._phase_began if phase == self._phase else 0.0
        return self._spent.get(phase, 0.0) + running

    def render(self) -> Group:
        """Lay out the dashboard; the empty line at its end is for the cursor."""
        rows = Table.grid(padding=(0, 2, 0, 0), expand=True, pad_edge=False)
        rows.add_column(style="dim", no_wrap=True)
        rows.add_column(ratio=1)
        rows.add_row("steps", self._steps())
        rows.add_row("speed", self._pace())
        rows.add_row("time", self._phases())
        rows.add_row("update", self._update())
        if self._nonfinite:
            count = f"{self._nonfinite:,.0f} states or gradients"
            rows.add_row("non-finite", Text(count, "bold red"))
        if memory := _memory_in_use():
            rows.add_row("memory", memory)
        panel = Panel(
            Group(self._table(), "", rows),
            title=Text(self._title, "bold"),
            title_align="left",
            subtitle=_clock(process_seconds()),
            subtitle_align="right",
            width=_MAX_WIDTH,
        )
        return Group(panel, "")

    def _steps(self) -> "_FirstThatFits":
        total = self._total
        done = min(self._progress.tasks[0].completed, total)
        text = Text(f"{done / total:.0%}  {done:,.0f} of {total:,}")
        beside = Table.grid(padding=(0, 2, 0, 0), expand=True, pad_edge=False)
        beside.add_column(ratio=1)
        beside.add_column(no_wrap=True)
        beside.add_row(_Bar(total, done), text)
        return _FirstThatFits(beside, text)

    def _pace(self) -> str:
        if not self._speed:
            return "-"
        text = f"{self._speed:,.0f} environment steps/s"
        left = self._progress.tasks[0].time_remaining
        return f"{text}, {_clock(left)} left" if left else text

    def _phases(self) -> Columns:
        texts = [
            Text(
                f"{name} {_clock(self._seconds_in(name))}",
                "bold cyan" if name == self._phase else "",
            )
            for name in self._spent
        ]
        return Columns(texts, padding=(0, 3))

    def _update(self) -> Columns | str:
        texts = [
            f"{label} {form.format(value)}"
            for label, (name, form) in _UPDATE.items()
            if (value := self._mean.get(name)) is not None
        ]
        return Columns(texts, padding=(0, 3)) if texts else "-"

    def _table(self) -> "_FirstThatFits":
        cells = [
            {"seed": name} | self._cells(scores, metrics) for name, scores, metrics in self._rows()
        ]
        names = [name for name in cells[0] if name != "seed" or len(self._seeds) > 1]
        tables = []
        for count in range(len(_DROPPED) + 1):
            table = Table(box=None, expand=True, pad_edge=False, header_style="dim")
            shown = [name for name in names if name not in _DROPPED[:count]]
            for name in shown:
                ratio = 1 if name == "" else None
                justify = "left" if name in ("seed", "") else "right"
                table.add_column(name, justify=justify, no_wrap=True, ratio=ratio)
            for row in cells:
                table.add_row(*(row[name] for name in shown))
            tables.append(table)
        return _FirstThatFits(*tables)

    def _cells(
        self, scores: Sequence[float], metrics: MetricValues
    ) -> "dict[str, str | Text | _Curve]":
        """Return what a row of the table shows, by the name of the column."""
        what, key = "success", "success_rate"
        form, curve = "{:.1%}", scores
        if self._scored_by == "return":
            what, key = "return", "episode_return"
            form, curve = "{:.2f}", scaled(scores)
        cells = {
            what: Text(_formatted(metrics.get(f"eval/{key}"), form), "bold green"),
            "": _Curve(curve),
            "best": _formatted(max(scores, default=None), form),
            "exploring": _formatted(metrics.get(f"rollout/{key}"), form),
        }
        if what == "success":
            cells["return"] = _formatted(metrics.get("eval/episode_return"), "{:.2f}")
        if self._is_own:
            return cells | {"length": _formatted(metrics.get("eval/episode_length"), "{:.1f}")}
        return cells | {
            "to goal": _formatted(metrics.get("eval/time_to_goal_median"), "{:.2f} s"),
            "p95": _formatted(metrics.get("eval/time_to_goal_p95"), "{:.2f} s"),
        }

    def _rows(self) -> list[tuple[str, Sequence[float], MetricValues]]:
        """Return name, scores and metrics of each seed, or of many seeds their range."""
        if len(self._seeds) == 1:
            return [("", self._scores[0], self._mean)]
        if len(self._seeds) <= _MAX_ROWS:
            return list(zip(self._seeds, self._scores, self._metrics, strict=True))
        rows = []
        for name, of in (("mean", statistics.fmean), ("lowest", min), ("highest", max)):
            values = {
                key: [value for one in self._metrics if (value := one.get(key)) is not None]
                for key in self._metrics[0]
            }
            metrics = {key: of(found) for key, found in values.items() if found}
            rows.append((name, [of(one) for one in zip(*self._scores, strict=False)], metrics))
        return rows


class _LineQueue(io.TextIOBase):
    """A `_LineQueue` replaces a stream of the terminal; whole lines go above the dashboard."""

    def __init__(self, dashboard: Dashboard, stream: TextIO) -> None:
        self._dashboard, self._stream = dashboard, stream
        self._lock = threading.Lock()
        self._unfinished = ""

    def write(self, text: str) -> int:
        with self._lock:
            *lines, self._unfinished = (self._unfinished + text).split("\n")
        if lines:
            self._dashboard.say("\n".join(lines))
        return len(text)

    def flush(self) -> None:
        self._dashboard.wait()

    def end_line(self) -> None:
        """Print the text that no end of a line has followed."""
        if self._unfinished:
            self.write("\n")

    def isatty(self) -> bool:
        return self._stream.isatty()

    def fileno(self) -> int:
        return self._stream.fileno()

    def __getattr__(self, name: str) -> object:
        return getattr(self._stream, name)


class _FirstThatFits:
    """A `_FirstThatFits` renders the first of several renderables that is narrow enough."""

    def __init__(self, *choices: Table | Text) -> None:
        self._choices = choices

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        unlimited = options.update(max_width=1_000)
        for choice in self._choices:
            if Measurement.get(console, unlimited, choice).maximum <= options.max_width:
                break
        yield choice


class _Curve:
    """A `_Curve` renders a `sparkline` that is as wide as its cell."""

    def __init__(self, rates: Sequence[float]) -> None:
        self._rates = rates

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield Text(sparkline(self._rates, options.max_width), "green")

    def __rich_measure__(self, console: Console, options: ConsoleOptions) -> Measurement:
        return Measurement(_MIN_CURVE, _MIN_CURVE)


class _Bar(ProgressBar):
    """A `_Bar` is a progress bar that is as wide as its cell."""

    def __rich_measure__(self, console: Console, options: ConsoleOptions) -> Measurement:
        return Measurement(_MIN_BAR, _MIN_BAR)


def _memory_in_use() -> str:
    """Return the memory in use, of the first device or of this process; empty if unknown."""
    if stats := jax.local_devices()[0].memory_stats():
        limit = stats.get("bytes_limit")
        of = f" of {limit / 2**30:.1f}" if limit else ""
        return f"{stats['bytes_in_use'] / 2**30:.2f}{of} GiB"
    statm = Path("/proc/self/statm")
    if not statm.is_file():  # on macOS and Windows
        return ""
    pages = int(statm.read_text().split()[1])
    return f"{pages * os.sysconf('SC_PAGE_SIZE') / 2**30:.2f} GiB"


def _clock(seconds: float) -> str:
    minutes, seconds = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"


def _formatted(value: float | None, form: str) -> str:
    return "-" if value is None else form.format(value)
