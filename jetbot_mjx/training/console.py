"""Print the progress of a training as plain lines, for pipes, logs and simple terminals."""

import math
import sys
import time
from collections.abc import Sequence
from typing import Literal, TextIO

from jetbot_mjx.errors import printable_lines, write_error
from jetbot_mjx.runs import MetricValues, mean_of
from jetbot_mjx.terminal import process_seconds

Phase = Literal["compiling", "training", "evaluating", "saving", "rendering"]

_SECONDS_BETWEEN_LINES = 10.0


class Terminal:
    """A `Terminal` shows the progress of a training; this one prints plain lines."""

    def __init__(self, total_steps: int, stream: TextIO | None = None) -> None:
        """Prepare to print.

        Args:
          total_steps: environment steps of the whole training.
          stream: where to print; standard output by default.
        """
        self._total = total_steps
        self._stream = stream or sys.stdout
        self._last_line = -math.inf
        self._lost = False

    @property
    def lost(self) -> bool:
        """Return whether something could not be printed: its reader has gone, or a disk is full."""
        return self._lost or write_error(self._stream) is not None

    def begin(self) -> None:
        """Show that compilation has begun, after which nothing else happens for a while."""
        self.say("compiling ...")

    def phase(self, name: Phase) -> None:
        """Show that a phase begins; plain lines do not show it."""

    def write(self, env_steps: int, metrics: Sequence[MetricValues]) -> None:
        """Show the end of an interval.

        Args:
          env_steps: environment steps so far.
          metrics: the metrics of every seed; a line shows their mean.
        """
        mean = mean_of(metrics)
        speed, compiled = mean.get("time/env_steps_per_second"), mean.get("time/compile_seconds")
        self._print(
            f"{env_steps:>12,} steps",
            _formatted(mean, "eval/success_rate", "success {:6.1%}"),
            # Of a robot with goals, the return says little.
            _formatted(mean, "eval/episode_return", "return {:9.2f}")
            if "eval/return_low" in mean
            else "",
            _formatted(mean, "eval/time_to_goal_median", "to goal {:4.2f} s"),
            _formatted(mean, "time/env_steps_per_second", "{:>10,.0f} steps/s"),
            f"{process_seconds():6.1f} s",
            self._eta(env_steps, speed) if speed else "",
            f"(compiling {compiled:.1f} s)" if compiled and compiled > 0.5 else "",
        )

    def update(self, env_steps: int, metrics: MetricValues, env_steps_per_second: float) -> None:
        """Show progress within an interval, unless the last line is still new.

        Args:
          env_steps: environment steps so far.
          metrics: means over all seeds.
          env_steps_per_second: speed of the training.
        """
        if time.monotonic() - self._last_line >= _SECONDS_BETWEEN_LINES:
            self._print(
                f"{env_steps:>12,} steps",
                _formatted(metrics, "rollout/success_rate", "exploring {:6.1%}")
                or _formatted(metrics, "rollout/episode_return", "exploring {:9.2f}"),
                f"{env_steps_per_second:>10,.0f} steps/s",
                self._eta(env_steps, env_steps_per_second),
            )

    def say(self, text: str) -> None:
        """Print a message, which may name files."""
        self._print(printable_lines(text))

    def close(self) -> None:
        """Leave the terminal in order, with the last metrics on it."""

    def _eta(self, env_steps: int, env_steps_per_second: float) -> str:
        return f"ETA {max(0, self._total - env_steps) / env_steps_per_second:5.0f} s"

    def _print(self, *parts: str) -> None:
        try:
            print("  ".join(part for part in parts if part), file=self._stream, flush=True)
        except (OSError, ValueError):
            # In a program that imports the package: the training outlives its terminal there too.
            self._lost = True
        self._last_line = time.monotonic()


class SilentTerminal(Terminal):
    """A `SilentTerminal` shows nothing, for a program that has not asked for the progress."""

    def _print(self, *parts: str) -> None:
        """Do nothing."""


def _formatted(metrics: MetricValues, name: str, form: str) -> str:
    value = metrics.get(name)
    return form.format(value) if value is not None else ""
