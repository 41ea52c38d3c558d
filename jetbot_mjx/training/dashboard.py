"""Show the progress of a training in place, on a terminal that a user watches, with rich.

A thread of rich's `Live` draws twice a second. The cursor stays visible and rests on an empty line
below the dashboard, so the terminal is in order however the process ends, even by SIGKILL.
"""

import contextlib
import os
import statistics
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import IO

from rich.console import Console, Group
from rich.live import Live
from rich.panel import Panel
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from jetbot_mjx.runs.metrics import History, MetricValues
from jetbot_mjx.training.console import COMPILING, Terminal

_BLOCKS = "▁▂▃▄▅▆▇█"
_MAX_ROWS = 8
_MAX_WIDTH = 100
_DRAWINGS_PER_SECOND = 2
_SPEED_SECONDS = 3600.0
"""Time over which the speed for the remaining time is averaged [s]."""


def open_terminal(
    run_dirs: Sequence[Path], total_steps: int, histories: Sequence[Sequence[History]]
) -> Terminal:
    """Return a dashboard if standard output is a terminal in the foreground, else plain lines.

    As rich does, `TERM=dumb` and `TTY_INTERACTIVE=0` select plain lines, `NO_COLOR` no colours.

    Args:
      run_dirs: the folder of each seed.
      total_steps: environment steps of the whole training.
      histories: the metrics that each seed has logged before.

    Returns:
      The terminal.
    """
    console = Console(highlight=False)
    watched = sys.stdout.isatty() and console.is_interactive and _in_foreground(sys.stdout)
    if not watched or not console.encoding.startswith("utf"):
        return Terminal(total_steps)
    seeds = [folder.name.removeprefix("seed-") for folder in run_dirs]
    title = (run_dirs[0] if len(run_dirs) == 1 else run_dirs[0].parent).name
    return Dashboard(title, total_steps, seeds, histories, console)


def sparkline(rates: Sequence[float], width: int) -> str:
    """Return a curve of rates from 0 to 1 as blocks, sampled evenly to at most `width` of them."""
    if len(rates) > width:
        scale = (len(rates) - 1) / max(1, width - 1)
        rates = [rates[round(place * scale)] for place in range(width)]
    return "".join(_BLOCKS[min(int(rate * len(_BLOCKS)), len(_BLOCKS) - 1)] for rate in rates)


class Dashboard(Terminal):
    """A `Dashboard` shows success, speed and phases in place; messages scroll above it."""

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
        self._rates: list[list[float]] = [[] for _ in seeds]
        self._metrics: list[dict[str, float | None]] = [{} for _ in seeds]
        self._nonfinite = 0.0
        self._speed = "-"
        self._phase: str | None = None
        self._spent: dict[str, float] = {}
        self._began = self._phase_began = time.monotonic()
        # Show the history before the progress bar begins to measure the speed.
        steps = 0
        for entries in zip(*histories, strict=False):
            steps = entries[0].env_steps
            self._add([entry.metrics for entry in entries])
        self._progress = Progress(
            BarColumn(None),
            TextColumn("{task.percentage:.0f}%  {task.completed:,} of {task.total:,} steps"),
            TimeRemainingColumn(compact=True),
            TextColumn("left"),
            console=console,
            expand=True,
            speed_estimate_period=_SPEED_SECONDS,
            get_time=time.monotonic,
        )
        self._task = self._progress.add_task("", total=total_steps, completed=steps)
        self._live = _Live(
            get_renderable=self.render,
            console=console,
            refresh_per_second=_DRAWINGS_PER_SECOND,
            # Standard error may go to a file.
            redirect_stderr=sys.stderr.isatty(),
        )

    def begin(self) -> None:
        """Begin to draw."""
        self.phase(COMPILING)
        with contextlib.suppress(OSError):
            self._live.start()
            self._console.show_cursor(True)

    def phase(self, name: str | None) -> None:
        """Show that a phase begins; None: the training has ended."""
        now = time.monotonic()
        if self._phase is not None:
            self._spent[self._phase] = self._seconds_in(self._phase)
        self._phase, self._phase_began = name, now
        if name is not None:
            self._spent.setdefault(name, 0.0)

    def write(self, env_steps: int, metrics: Sequence[MetricValues]) -> None:
        """Show the metrics of every seed at the end of an interval."""
        self._add(metrics)
        speed = metrics[0].get("time/env_steps_per_second")
        self._advance(env_steps, speed)

    def update(self, env_steps: int, metrics: MetricValues, env_steps_per_second: float) -> None:
        """Show progress within an interval; the metrics are means, so only one seed shows them."""
        if len(self._seeds) == 1:
            self._metrics = [{**self._metrics[0], **metrics}]
        self._advance(env_steps, env_steps_per_second)

    def say(self, text: str) -> None:
        """Print a message above the dashboard; do not fail if the terminal is gone."""
        with contextlib.suppress(OSError):
            self._console.print(Text.from_ansi(text), soft_wrap=True)

    def close(self) -> None:
        """Draw for the last time."""
        self.phase(None)
        with contextlib.suppress(OSError):
            # Rich holds back a line without an end, and would lose it.
            sys.stdout.write("")
            sys.stdout.flush()
            self._live.stop()

    def _add(self, metrics: Sequence[MetricValues]) -> None:
        self._metrics = [dict(one) for one in metrics]
        for rates, one in zip(self._rates, metrics, strict=True):
            if (rate := one.get("eval/success_rate")) is not None:
                rates.append(rate)
            for name in ("train/nonfinite_envs", "train/nonfinite_updates"):
                self._nonfinite += one.get(name) or 0.0

    def _advance(self, env_steps: int, speed: float | None) -> None:
        self._progress.update(self._task, completed=env_steps)
        self._speed = f"{speed:,.0f} environment steps/s" if speed else "-"

    def _seconds_in(self, phase: str) -> float:
        running = time.monotonic() - self._phase_began if phase == self._phase else 0.0
        return self._spent.get(phase, 0.0) + running

    def render(self) -> Group:
        """Lay out the dashboard; the empty line at its end is for the cursor."""
        phases = Text()
        for name in self._spent:
            style = "bold cyan" if name == self._phase else ""
            phases.append(f"{name} {_clock(self._seconds_in(name))}", style).append("   ")
        rows = [self._table(), "", self._progress, self._speed, phases]
        if self._nonfinite:
            rows.append(Text(f"{self._nonfinite:,.0f} non-finite states or gradients", "bold red"))
        elapsed = _clock(time.monotonic() - self._began)
        title = Text(self._title, "bold")
        panel = Panel(
            Group(*rows), title=title, title_align="left", subtitle=elapsed, width=_MAX_WIDTH
        )
        return Group(panel, "")

    def _table(self) -> Table:
        table = Table(box=None, expand=True, pad_edge=False, header_style="dim")
        table.add_column("seed", no_wrap=True)
        table.add_column("", ratio=1, no_wrap=True)
        for name in ("success", "best", "exploring", "return", "to goal"):
            table.add_column(name, justify="right", no_wrap=True)
        width = min(self._console.width, _MAX_WIDTH) - 60
        for name, rates, metrics in self._rows():
            table.add_row(
                name,
                Text(sparkline(rates, max(8, width)), "green"),
                Text(_formatted(metrics.get("eval/success_rate"), "{:.1%}"), "bold green"),
                _formatted(max(rates, default=None), "{:.1%}"),
                _formatted(metrics.get("rollout/success_rate"), "{:.1%}"),
                _formatted(metrics.get("eval/episode_return"), "{:.2f}"),
                _formatted(metrics.get("eval/time_to_goal_median"), "{:.2f} s"),
            )
        return table

    def _rows(self) -> list[tuple[str, Sequence[float], MetricValues]]:
        """Return name, success rates and metrics of each seed, or of many seeds their range."""
        if len(self._seeds) <= _MAX_ROWS:
            return list(zip(self._seeds, self._rates, self._metrics, strict=True))
        rows = []
        for name, of in (("mean", statistics.fmean), ("lowest", min), ("highest", max)):
            values = {
                key: [value for one in self._metrics if (value := one.get(key)) is not None]
                for key in self._metrics[0]
            }
            metrics = {key: of(found) for key, found in values.items() if found}
            rows.append((name, [of(rates) for rates in zip(*self._rates, strict=False)], metrics))
        return rows


class _Live(Live):
    """A live display that pauses in the background and ignores a terminal that is gone."""

    def refresh(self) -> None:
        if _in_foreground(self.console.file):
            with contextlib.suppress(OSError):
                super().refresh()


def _in_foreground(stream: IO[str]) -> bool:
    """Return whether the terminal belongs to this process group, or to no shell at all."""
    try:
        return os.tcgetpgrp(stream.fileno()) == os.getpgrp()
    except (OSError, ValueError):
        return True


def _clock(seconds: float) -> str:
    minutes, seconds = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"


def _formatted(value: float | None, form: str) -> str:
    return "-" if value is None else form.format(value)
