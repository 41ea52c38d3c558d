"""Print the progress of a training: plain lines, for people, pipes and logs."""

import math
import sys
import time
from collections.abc import Sequence
from typing import Protocol, TextIO

from jetbot_mjx.runs.metrics import MetricValues, mean_of

COMPILING = "compiling"
TRAINING = "training"
EVALUATING = "evaluating"
SAVING = "saving"
FILMING = "filming"
PHASES = (COMPILING, TRAINING, EVALUATING, SAVING, FILMING)
"""What a training can be at."""

_SECONDS_BETWEEN_LINES = 10.0


class Terminal(Protocol):
    """The interface of what shows the progress of a training."""

    def begin(self) -> None:
        """Show that compiling has begun."""
        ...

    def phase(self, name: str) -> None:
        """Hear which of `PHASES` begins."""
        ...

    def write(self, env_steps: int, metrics: Sequence[MetricValues]) -> None:
        """Take the metrics of every seed at the end of an interval."""
        ...

    def tell(self, env_steps: int, metrics: MetricValues, env_steps_per_second: float) -> None:
        """Take what is known between two reports: the mean of all seeds."""
        ...

    def say(self, text: str) -> None:
        """Print a line of its own."""
        ...

    def close(self) -> None:
        """Leave the terminal as it was, with the last metrics on it."""
        ...


class Lines:
    """A line for every interval, with what is left to wait."""

    def __init__(self, total_steps: int, stream: TextIO | None = None) -> None:
        """Prepare the lines.

        Args:
          total_steps: environment steps of the whole training.
          stream: where to print; standard output by default.
        """
        self._total = total_steps
        self._stream = stream or sys.stdout
        self._last_line = -math.inf

    def begin(self) -> None:
        """Say that compiling has begun: nothing else comes for a while."""
        self.say("compiling ...")

    def phase(self, name: str) -> None:
        """Let it pass: the lines tell."""

    def write(self, env_steps: int, metrics: Sequence[MetricValues]) -> None:
        """Print one line, of several seeds the mean."""
        mean = mean_of(metrics)
        wall = mean.get("time/wall_seconds") or 0.0
        parts = [f"{env_steps:>12,} steps"]
        parts.append(_shown(mean, "eval/success_rate", "success {:6.1%}"))
        parts.append(_shown(mean, "eval/time_to_goal_median", "to goal {:4.2f} s"))
        parts.append(_shown(mean, "time/env_steps_per_second", "{:>10,.0f} steps/s"))
        parts.append(f"{wall:6.1f} s")
        compiled = mean.get("time/compile_seconds") or 0.0
        if rate := mean.get("time/env_steps_per_second"):
            parts.append(self._eta(env_steps, rate))
        if compiled > 0.5:
            parts.append(f"(compiling {compiled:.1f} s)")
        self._print(parts)

    def tell(self, env_steps: int, metrics: MetricValues, env_steps_per_second: float) -> None:
        """Print a line between two reports, unless the last one is still new."""
        if time.monotonic() - self._last_line < _SECONDS_BETWEEN_LINES:
            return
        self._print(
            [
                f"{env_steps:>12,} steps",
                _shown(metrics, "rollout/success_rate", "exploring {:6.1%}"),
                f"{env_steps_per_second:>10,.0f} steps/s",
                self._eta(env_steps, env_steps_per_second),
            ]
        )

    def _eta(self, env_steps: int, env_steps_per_second: float) -> str:
        """Training time that is left at this pace."""
        left = max(0, self._total - env_steps) / env_steps_per_second
        return f"ETA {left:5.0f} s"

    def say(self, text: str) -> None:
        """Print a line of its own."""
        self._print([text])

    def _print(self, parts: Sequence[str]) -> None:
        print("  ".join(part for part in parts if part), file=self._stream, flush=True)
        self._last_line = time.monotonic()

    def close(self) -> None:
        """Nothing is left."""


def _shown(metrics: MetricValues, name: str, form: str) -> str:
    value = metrics.get(name)
    return form.format(value) if value is not None else ""
