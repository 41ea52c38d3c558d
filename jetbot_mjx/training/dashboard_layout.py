"""Lay out the dashboard of a training with rich."""

import os
import statistics
import time
from collections.abc import Sequence
from pathlib import Path

import jax
from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.measure import Measurement
from rich.panel import Panel
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from jetbot_mjx.runs.metrics import History, MetricValues, mean_of
from jetbot_mjx.training.console import PHASES

_BLOCKS = "▁▂▃▄▅▆▇█"
_MOST_ROWS = 8
_WIDEST = 100
_NONE = "-"


def sparkline(rates: Sequence[float], width: int) -> str:
    """Return a curve of rates from 0 to 1 as a line of blocks, at most so many."""
    if len(rates) > width:
        last = len(rates) - 1
        rates = [rates[round(place * last / max(1, width - 1))] for place in range(width)]
    return "".join(_BLOCKS[min(int(rate * len(_BLOCKS)), len(_BLOCKS) - 1)] for rate in rates)


class DashboardLayout:
    """The content of the dashboard and its layout; for one thread at a time."""

    def __init__(
        self,
        title: str,
        total_steps: int,
        seeds: Sequence[str],
        histories: Sequence[Sequence[History]],
    ) -> None:
        """Return an empty board, or one with what was logged before.

        Args:
          title: of the run.
          total_steps: environment steps of the whole training.
          seeds: the name of each.
          histories: what each has logged before.
        """
        self._title = title
        self._total = total_steps
        self._seeds = seeds
        self._rates: list[list[float]] = [[] for _ in seeds]
        self._reported: Sequence[MetricValues] = [{} for _ in seeds]
        self._mean: dict[str, float | None] = {}
        self._nonfinite = 0.0
        self._env_steps = 0
        self._speed: float | None = None
        self._first: tuple[float, int] | None = None
        self._end: float | None = None
        for entries in zip(*histories, strict=False):
            self.write(entries[0].env_steps, [entry.metrics for entry in entries])
        self._speed = self._first = self._end = None
        self._began = self._since = time.monotonic()
        self._phase: str | None = None
        self._spent: dict[str, float] = dict.fromkeys(PHASES, 0.0)

    def phase(self, name: str | None) -> None:
        """Begin a phase; None: all are over."""
        now = time.monotonic()
        if self._phase is not None:
            self._spent[self._phase] += now - self._since
        self._phase, self._since = name, now

    def write(self, env_steps: int, metrics: Sequence[MetricValues]) -> None:
        """Take a report."""
        self._reported = metrics
        for rates, one in zip(self._rates, metrics, strict=True):
            if (rate := one.get("eval/success_rate")) is not None:
                rates.append(rate)
            for name in ("train/nonfinite_envs", "train/nonfinite_updates"):
                self._nonfinite += one.get(name) or 0.0
        mean = mean_of(metrics)
        self._learn(env_steps, mean, mean.get("time/env_steps_per_second"))

    def tell(self, env_steps: int, metrics: MetricValues, env_steps_per_second: float) -> None:
        """Take what is known between two reports."""
        self._learn(env_steps, metrics, env_steps_per_second)

    def _learn(self, env_steps: int, mean: MetricValues, speed: float | None) -> None:
        self._env_steps, self._speed = env_steps, speed
        self._mean |= mean
        if env_steps == 0:
            return
        now = time.monotonic()
        if self._first is None:
            # What compiled before is no part of the pace; judging and saving are.
            self._first = (now, env_steps)
        elif env_steps > self._first[1]:
            began, first = self._first
            left = max(0, self._total - env_steps)
            self._end = now + left * (now - began) / (env_steps - first)

    def render(self, memory: str) -> RenderableType:
        """Lay it out.

        Args:
          memory: from `memory_in_use`.

        Returns:
          What rich can draw; it ends with an empty line, where the cursor rests.
        """
        rows = Table.grid(padding=(0, 2, 0, 0), expand=True)
        rows.add_column(style="dim", no_wrap=True)
        rows.add_column(ratio=1)
        rows.add_row("steps", self._progress())
        rows.add_row("speed", self._pace())
        rows.add_row("time", self._phases())
        rows.add_row("update", self._update())
        if self._nonfinite:
            count = f"{self._nonfinite:,.0f} worlds or gradients so far"
            rows.add_row("not finite", Text(count, "bold red"))
        if memory:
            rows.add_row("memory", memory)
        panel = Panel(
            Group(self._successes(), "", rows),
            title=Text(self._title, "bold"),
            title_align="left",
            subtitle=_clock(time.monotonic() - self._began),
            subtitle_align="right",
            border_style="dim",
            width=_WIDEST,
        )
        return Group(panel, "")

    def _successes(self) -> Table:
        table = Table(
            box=None, expand=True, padding=(0, 2, 0, 0), pad_edge=False, header_style="dim"
        )
        several = len(self._seeds) > 1
        if several:
            table.add_column("seed", no_wrap=True)
        table.add_column("success", justify="right", no_wrap=True)
        table.add_column("", ratio=1, no_wrap=True)
        for name in ("best", "exploring", "to goal", "p95"):
            table.add_column(name, justify="right", no_wrap=True)
        for name, rates, metrics in self._rows():
            table.add_row(
                *([name] if several else []),
                Text(_percent(metrics.get("eval/success_rate")), "bold green"),
                _Curve(rates),
                _percent(max(rates, default=None)),
                _percent(metrics.get("rollout/success_rate")),
                _seconds(metrics.get("eval/time_to_goal_median")),
                _seconds(metrics.get("eval/time_to_goal_p95")),
            )
        return table

    def _rows(self) -> list[tuple[str, Sequence[float], MetricValues]]:
        """Name, success rates and metrics: of each seed, or of many the mean and the range."""
        if len(self._seeds) == 1:
            return [("", self._rates[0], self._mean)]
        if len(self._seeds) <= _MOST_ROWS:
            return list(zip(self._seeds, self._rates, self._reported, strict=True))
        rates = list(zip(*self._rates, strict=False))
        rows = []
        for name, of in (("mean", statistics.fmean), ("lowest", min), ("highest", max)):
            known = {
                key: [value for one in self._reported if (value := one.get(key)) is not None]
                for key in self._reported[0]
            }
            metrics = {key: of(values) if values else None for key, values in known.items()}
            rows.append((name, [of(one) for one in rates], metrics))
        return rows

    def _progress(self) -> Table:
        share = min(1.0, self._env_steps / self._total)
        row = Table.grid(padding=(0, 2, 0, 0), expand=True)
        row.add_column(ratio=1)
        row.add_column(no_wrap=True)
        text = f"{share:.0%}  {self._env_steps:,} of {self._total:,}"
        bar = ProgressBar(total=1.0, completed=share, complete_style="cyan", finished_style="green")
        row.add_row(bar, text)
        return row

    def _pace(self) -> str:
        if self._speed is None:
            return _NONE
        text = f"{self._speed:,.0f} environment steps/s"
        if self._phase is not None and self._end is not None:
            text += f", {_clock(max(0.0, self._end - time.monotonic()))} left"
        return text

    def _phases(self) -> Text:
        text = Text()
        for name, spent in self._spent.items():
            here = name == self._phase
            if here or spent:
                spent += time.monotonic() - self._since if here else 0.0
                text.append("   " if text else "")
                text.append(f"{name} {_clock(spent)}", "bold cyan" if here else "")
        return text

    def _update(self) -> str:
        shown = (
            ("loss", "loss/total", "{:.3g}"),
            ("KL", "policy/kl", "{:.2g}"),
            ("std", "policy/std", "{:.2f}"),
            ("learning rate", "policy/learning_rate", "{:.1e}"),
        )
        known = [
            f"{label} {form.format(value)}"
            for label, name, form in shown
            if (value := self._mean.get(name)) is not None
        ]
        return "   ".join(known) or _NONE


class _Curve:
    """A sparkline as wide as its cell."""

    def __init__(self, rates: Sequence[float]) -> None:
        self._rates = rates

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        yield Text(sparkline(self._rates, options.max_width), "green")

    def __rich_measure__(self, console: Console, options: ConsoleOptions) -> Measurement:
        return Measurement(1, options.max_width)


def memory_in_use() -> str:
    """Return the memory in use, of the first device or of this process; empty: unknown."""
    stats = jax.local_devices()[0].memory_stats()
    if stats:
        used, limit = (stats.get(key, 0) / 2**30 for key in ("bytes_in_use", "bytes_limit"))
        return f"{used:.2f} of {limit:.1f} GiB on the device"
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except (OSError, ValueError, IndexError):
        return ""
    return f"{pages * os.sysconf('SC_PAGE_SIZE') / 2**30:.2f} GiB"


def _clock(seconds: float) -> str:
    minutes, seconds = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{seconds:02}" if hours else f"{minutes}:{seconds:02}"


def _percent(rate: float | None) -> str:
    return _NONE if rate is None else f"{rate:.1%}"


def _seconds(seconds: float | None) -> str:
    return _NONE if seconds is None else f"{seconds:.2f} s"
