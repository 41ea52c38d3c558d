"""Where the figures of a training go: a file, TensorBoard, the terminal. One `Sink` each.

Names, the same everywhere:
  eval/success_rate         deterministic policy, fixed goals; with success_low, success_high
  eval/time_to_goal_median  [s] of the successes; likewise time_to_goal_p95
  eval/path_efficiency      straight line over way travelled, mean over the successes
  eval/episode_return       mean sum of rewards [m]: about the distance covered
  eval/nonfinite_worlds     episodes cut off because their world was no longer finite
  loss/total, policy, value, entropy    means over the interval, as Brax computes them
  policy/entropy            of the action distribution, before squashing [nat]
  policy/kl                 between the policy before and after an update, mean
  policy/std                of the action distribution, before squashing
  policy/learning_rate      Adam's step size
  time/env_steps_per_second environment steps over training seconds, compilation apart
  time/compile_seconds      spent tracing and compiling in this interval, evaluation included
  time/wall_seconds         since the process began to train
"""

import json
import math
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Protocol, Self, TextIO

import jax
import tensorboardX

Figures = Mapping[str, float | None]


class Sink(Protocol):
    """Something that takes figures."""

    def write(self, env_steps: int, figures: Figures) -> None:
        """Takes the figures at one moment; None stands for one that does not exist then."""
        ...

    def close(self) -> None:
        """Writes out what is left."""
        ...


class Sinks:
    """Several sinks as one; a context manager that closes them all."""

    def __init__(self, sinks: Sequence[Sink]) -> None:
        """Joins sinks.

        Args:
          sinks: each gets every figure, in this order.
        """
        self._sinks = sinks

    def write(self, env_steps: int, figures: Figures) -> None:
        """Passes the figures on."""
        for sink in self._sinks:
            sink.write(env_steps, figures)

    def close(self) -> None:
        """Closes each."""
        for sink in self._sinks:
            sink.close()

    def __enter__(self) -> Self:
        """Enters."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Closes each."""
        self.close()


class JsonlSink:
    """One JSON object a line, readable while training runs."""

    def __init__(self, path: Path) -> None:
        """Opens the file for appending.

        Args:
          path: of the file.
        """
        self._file = path.open("a", encoding="utf-8")

    def write(self, env_steps: int, figures: Figures) -> None:
        """Appends a line; what is not finite is written as null, since JSON has no NaN."""
        values = {
            name: value if value is not None and math.isfinite(value) else None
            for name, value in figures.items()
        }
        self._file.write(json.dumps({"env_steps": env_steps, **values}) + "\n")
        self._file.flush()

    def close(self) -> None:
        """Closes the file."""
        self._file.close()


class TensorBoardSink:
    """TensorBoard event files, written without TensorFlow."""

    def __init__(self, folder: Path) -> None:
        """Opens an event file.

        Args:
          folder: for `tensorboard --logdir`.
        """
        # A queue lies before the file, and `flush` does not wait for it: let its own thread write.
        self._writer = tensorboardX.SummaryWriter(str(folder), flush_secs=1)

    def write(self, env_steps: int, figures: Figures) -> None:
        """Adds one scalar for each figure there is."""
        for name, value in figures.items():
            if value is not None:
                self._writer.add_scalar(name, value, env_steps)

    def close(self) -> None:
        """Closes the event file."""
        self._writer.close()


class ProgressSink:
    """A line on the terminal for every interval, with what is left to wait."""

    def __init__(self, total_steps: int, stream: TextIO | None = None) -> None:
        """Prepares the lines.

        Args:
          total_steps: environment steps of the whole training.
          stream: where to print; standard output by default.
        """
        self._total = total_steps
        self._stream = stream or sys.stdout
        self._previous: tuple[int, float] | None = None

    def write(self, env_steps: int, figures: Figures) -> None:
        """Prints one line."""
        wall = figures.get("time/wall_seconds") or 0.0
        parts = [f"{env_steps:>12,} steps"]
        parts.append(_shown(figures, "eval/success_rate", "success {:6.1%}"))
        parts.append(_shown(figures, "eval/time_to_goal_median", "to goal {:4.2f} s"))
        parts.append(_shown(figures, "time/env_steps_per_second", "{:>10,.0f} steps/s"))
        parts.append(f"{wall:6.1f} s")
        compiled = figures.get("time/compile_seconds") or 0.0
        parts.append(self._eta(env_steps, wall - compiled))
        if compiled > 0.5:
            parts.append(f"(compiling {compiled:.1f} s)")
        print("  ".join(part for part in parts if part), file=self._stream, flush=True)
        self._previous = env_steps, wall

    def _eta(self, env_steps: int, wall: float) -> str:
        """Time left at the pace since the last line, compilation apart."""
        if self._previous is None or env_steps <= self._previous[0]:
            return ""
        steps, before = self._previous
        left = max(0, self._total - env_steps) * (wall - before) / (env_steps - steps)
        return f"ETA {left:5.0f} s"

    def close(self) -> None:
        """Nothing is left."""


def _shown(figures: Figures, name: str, form: str) -> str:
    value = figures.get(name)
    return form.format(value) if value is not None else ""


class CompileClock:
    """Seconds that JAX has spent tracing, lowering and compiling, by its own account.

    A context manager that stops listening.
    """

    _EVENTS = (
        "/jax/core/compile/jaxpr_trace_duration",
        "/jax/core/compile/jaxpr_to_mlir_module_duration",
        "/jax/core/compile/backend_compile_duration",
    )

    def __init__(self) -> None:
        """Starts to listen."""
        self._spans: list[tuple[float, float]] = []
        jax.monitoring.register_event_duration_secs_listener(self._listen)

    def _listen(self, event: str, duration_secs: float, **kwargs: str | int) -> None:
        del kwargs
        if event not in self._EVENTS:
            return
        end = time.perf_counter()
        start = end - duration_secs
        # Tracing nests: a span that covers earlier ones stands for them all.
        while self._spans and self._spans[-1][0] >= start:
            self._spans.pop()
        self._spans.append((start, end))

    def lap(self) -> float:
        """Seconds since the last call."""
        spans, self._spans = self._spans, []
        return sum(end - start for start, end in spans)

    def __enter__(self) -> Self:
        """Enters."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Stops listening."""
        jax.monitoring.unregister_event_duration_listener(self._listen)
