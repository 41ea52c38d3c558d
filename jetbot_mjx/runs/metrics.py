"""Where the figures of a training go: a file and TensorBoard, one `Sink` each.

Names, the same everywhere; a line of metrics.jsonl also holds env_steps and timestamp, and
TensorBoard the names of Stable-Baselines3 (`aliases.py`):
  eval/episodes             of the deterministic policy, on fixed goals; likewise successes
  eval/success_rate         of those; with success_low, success_high
  eval/time_to_goal_median  [s] of the successes; likewise time_to_goal_p95
  eval/path_efficiency      straight line over way travelled, mean over the successes
  eval/episode_return       mean sum of rewards [m]: about the distance covered
  eval/final_distance_median    [m] to the goal at the end, on the floor
  eval/nonfinite_worlds     episodes cut off because their world was no longer finite
  loss/total, policy, value, entropy    means over the interval, as Brax computes them
  policy/entropy            of the actions, after squashing where they are squashed [nat]
  policy/kl                 between the policy before and after an update, mean
  policy/std                of the action distribution, before squashing
  policy/learning_rate      Adam's step size
  rollout/episodes          that ended while collecting, driven by the exploring policy
  rollout/success_rate      of those; likewise rollout/episode_return, rollout/episode_length
  train/nonfinite_worlds    while collecting: each was reset, and its first one kept for replay
  train/nonfinite_updates   gradients that were not finite, and not applied
  time/env_steps_per_second environment steps over training seconds, compilation apart
  time/training_seconds     spent on training since the last report
  time/evaluation_seconds   spent on this evaluation, its compilation included
  time/recording_seconds    spent on logging, saving and filming after the last evaluation
  time/compile_seconds      spent tracing and compiling in this interval, evaluation included
  time/wall_seconds         since training began, in all processes that worked on the run
"""

import contextlib
import json
import math
import os
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol, Self

import jax

from jetbot_mjx.imports import standing_in
from jetbot_mjx.runs.run_dir import write_text
from jetbot_mjx.runs.sb3_tags import Alias, with_aliases

# It would load PyTorch where there is one, seconds, for pictures of networks.
with standing_in("torch", None):
    from tensorboardX.event_file_writer import EventsWriter
    from tensorboardX.proto import event_pb2, summary_pb2

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


def mean_of(figures: Sequence[Figures]) -> Figures:
    """Of several seeds, figure by figure; a seed that has none is left out."""
    means: dict[str, float | None] = {}
    for name in figures[0]:
        values = [value for one in figures if (value := one.get(name)) is not None]
        means[name] = sum(values) / len(values) if values else None
    return means


class History(NamedTuple):
    """One line of `metrics.jsonl`."""

    env_steps: int
    timestamp: float
    """When it was written [s since 1970]."""
    figures: Figures


def read_history(path: Path, last: int) -> list[History]:
    """Reads the lines of an earlier training.

    Args:
      path: of `metrics.jsonl`; it need not be there.
      last: environment steps after which nothing is wanted.

    Returns:
      What was written up to then; a line cut short is left out.
    """
    if not path.is_file():
        return []
    found = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        with contextlib.suppress(ValueError, LookupError, TypeError, AttributeError):
            values = json.loads(line)
            env_steps, timestamp = values.pop("env_steps"), values.pop("timestamp")
            if env_steps <= last:
                found.append(History(env_steps, timestamp, values))
    return found


class JsonlSink:
    """One JSON object a line, readable while training runs."""

    def __init__(self, path: Path, history: Sequence[History] = ()) -> None:
        """Opens the file.

        Args:
          path: of the file.
          history: what it begins with; anything else in it goes.
        """
        text = "".join(_line(*entry) for entry in history)
        if not path.is_file() or path.read_text(encoding="utf-8", errors="replace") != text:
            write_text(path, text)
        self._file = path.open("a", encoding="utf-8")

    def write(self, env_steps: int, figures: Figures) -> None:
        """Appends a line and sees it onto the disk, so that no checkpoint is ahead of it."""
        self._file.write(_line(env_steps, time.time(), figures))
        self._file.flush()
        os.fsync(self._file.fileno())

    def close(self) -> None:
        """Closes the file."""
        self._file.close()


def _line(env_steps: int, timestamp: float, figures: Figures) -> str:
    """What is not finite is written as null, since JSON has no NaN."""
    values = {
        name: value if value is not None and math.isfinite(value) else None
        for name, value in figures.items()
    }
    return json.dumps({"env_steps": env_steps, "timestamp": timestamp, **values}) + "\n"


# Protocol buffers make their classes while they are imported, unseen by pyright.
_SUMMARY: Any = vars(summary_pb2)["Summary"]
_EVENT: Any = vars(event_pb2)["Event"]


class TensorBoardSink:
    """TensorBoard event files, written without TensorFlow."""

    def __init__(
        self,
        folder: Path,
        history: Sequence[History] = (),
        names: Mapping[str, Alias] | None = None,
    ) -> None:
        """Opens an event file.

        Args:
          folder: for `tensorboard --logdir`; events of an earlier training go.
          history: is written first, in their place.
          names: from `aliases.aliases`: what is written under further names.
        """
        self._names = names or {}
        folder.mkdir(exist_ok=True)
        for events in folder.glob("events.out.tfevents.*"):
            events.unlink()
        # Its SummaryWriter writes from a thread, whose errors nobody hears.
        self._writer = EventsWriter(str(folder / "events"))
        for entry in history:
            self._add(*entry)
        self._writer.flush()

    def write(self, env_steps: int, figures: Figures) -> None:
        """Adds one scalar for each figure there is."""
        self._add(env_steps, time.time(), figures)
        self._writer.flush()

    def _add(self, env_steps: int, timestamp: float, figures: Figures) -> None:
        values = [
            _SUMMARY.Value(tag=name, simple_value=value)
            for name, value in with_aliases(env_steps, figures, self._names).items()
        ]
        event = _EVENT(wall_time=timestamp, step=env_steps, summary=_SUMMARY(value=values))
        self._writer.write_event(event)

    def close(self) -> None:
        """Closes the event file."""
        self._writer.close()


class CompileClock:
    """What JAX spends on tracing, lowering and compiling, by its own account.

    A context manager that stops listening. Threads may compile side by side: a second counts once.
    """

    _EVENTS = (
        "/jax/core/compile/jaxpr_trace_duration",
        "/jax/core/compile/jaxpr_to_mlir_module_duration",
        "/jax/core/compile/backend_compile_duration",
    )
    _CACHE_HIT = "/jax/compilation_cache/cache_hits"
    _SAVED = "/jax/compilation_cache/compile_time_saved_sec"

    def __init__(self) -> None:
        """Starts to listen."""
        self._lock = threading.Lock()
        self._spans: list[tuple[float, float]] = []
        self._counted_until = -math.inf
        self.programs = 0
        """Compiled, or found in the persistent cache."""
        self.cached = 0
        """Found in the persistent cache."""
        self.saved_seconds = 0.0
        """What compiling those would have taken."""
        jax.monitoring.register_event_duration_secs_listener(self._listen)
        jax.monitoring.register_event_listener(self._count)

    def _listen(self, event: str, duration_secs: float, **kwargs: str | int) -> None:
        del kwargs
        end = time.perf_counter()
        with self._lock:
            if event in self._EVENTS:
                self._spans.append((end - duration_secs, end))
                self.programs += event == self._EVENTS[-1]
            elif event == self._SAVED:
                self.saved_seconds += duration_secs

    def _count(self, event: str, **kwargs: str | int) -> None:
        del kwargs
        with self._lock:
            self.cached += event == self._CACHE_HIT

    def lap(self) -> float:
        """Seconds since the last call."""
        with self._lock:
            spans, self._spans = sorted(self._spans), []
        # What was still compiling at the last call counts from there on.
        seconds, until = 0.0, self._counted_until
        for start, end in spans:
            seconds += max(0.0, end - max(start, until))
            until = max(until, end)
        self._counted_until = until
        return seconds

    def __enter__(self) -> Self:
        """Enters."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Stops listening."""
        jax.monitoring.unregister_event_duration_listener(self._listen)
        jax.monitoring.unregister_event_listener(self._count)


_IMPORTED = time.perf_counter()


def process_seconds() -> float:
    """Since this process began [s]; where the system does not tell, since this module's import."""
    try:
        after_name = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
        began = int(after_name[19]) / os.sysconf("SC_CLK_TCK")
        return time.clock_gettime(time.CLOCK_BOOTTIME) - began
    except (OSError, AttributeError, ValueError, IndexError):
        return time.perf_counter() - _IMPORTED
