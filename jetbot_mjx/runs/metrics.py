"""Log the metrics of a training to a file and to TensorBoard, with one `Sink` for each.

Metrics have the same names in all sinks. A line of metrics.jsonl also holds env_steps and
timestamp, and TensorBoard also shows the tags of Stable-Baselines3 (`sb3_tags.py`):
  eval/episodes             episodes of the deterministic policy on fixed goals; likewise successes
  eval/success_rate         success rate; interval: success_low, success_high
  eval/time_to_goal_median  [s] median time of the successes; 95th percentile: time_to_goal_p95
  eval/path_efficiency      straight line over distance travelled, mean over the successes
  eval/episode_return       [m] mean sum of rewards, about the distance covered; of an
                            `environment` in its own unit, with return_low, return_high,
                            return_min, episode_length
  eval/metrics/<name>       sum over an episode of a metric of an `environment`, mean over all
  eval/final_distance_median  [m] distance to the goal at the end, on the floor
  eval/nonfinite_envs       episodes that were cut off because of a non-finite state
  loss/total, policy, value, entropy  means over the applied updates, as Brax computes them
  policy/entropy            [nat] entropy of the actions, after squashing
  policy/kl                 mean KL divergence between the policies before and after an update
  policy/std                standard deviation of the action distribution, before squashing
  policy/learning_rate      Adam's step size
  rollout/episodes          episodes of the exploring policy that ended during collection
  rollout/success_rate      their success rate; likewise episode_return, episode_length
  train/nonfinite_envs      non-finite states during collection; the first one is saved for replay
  train/nonfinite_updates   updates that were skipped because their gradient was not finite
  time/env_steps_per_second environment steps per second of training, without compilation
  time/training_seconds     time spent on training since the last report
  time/evaluation_seconds   time spent on this evaluation, with its compilation
  time/recording_seconds    time spent on logging, saving and rendering after the last evaluation
  time/compile_seconds      time spent on tracing and compiling in this interval
  time/wall_seconds         time of all processes that worked on the run, from their start
"""

import contextlib
import json
import math
import os
import struct
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple, Protocol

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from tensorboardX import summary as tensorboard_summary
from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto import event_pb2, summary_pb2

from jetbot_mjx.config import Config
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs.run_dir import read_bytes, write_text
from jetbot_mjx.runs.sb3_tags import aliases, with_aliases

if TYPE_CHECKING:
    from google.protobuf.message import Message

METRICS = "metrics.jsonl"
"""Name of the file of metrics in a run folder."""

EVALUATION_VIDEO = "evaluation.mp4"
"""Name of an evaluation's video, in `videos/<env_steps>/` of the run folder."""

VIDEO_TAG = "eval/video"
"""Name of the videos in TensorBoard and Weights & Biases."""

_LATEST = 253_402_300_799
"""Last second of the year 9999, after which no time can be shown [s since 1970]."""

MetricValues = Mapping[str, float | None]

_Number = Annotated[int | float, Field(ge=-sys.float_info.max, le=sys.float_info.max)]
"""A number that a float can hold; a whole one stays whole."""


class Sink(Protocol):
    """A `Sink` receives metrics and writes them somewhere."""

    def write(self, env_steps: int, metrics: MetricValues) -> None:
        """Write the metrics at one environment step; a metric without a value is None."""

    def write_video(self, env_steps: int, mp4: Path) -> None:
        """Write the video of an evaluation, beside which there is a GIF of the same name."""

    def close(self) -> None:
        """Write what is still buffered, and close."""


def mean_of(metrics: Sequence[MetricValues]) -> MetricValues:
    """Compute the mean of each metric over several seeds, leaving out seeds without a value."""
    means: dict[str, float | None] = {}
    for name in metrics[0]:
        values = [value for one in metrics if (value := one.get(name)) is not None]
        means[name] = sum(values) / len(values) if values else None
    return means


class _Line(BaseModel):
    """A line of `metrics.jsonl` that a training can have written; other keys are metrics."""

    model_config = ConfigDict(strict=True, extra="allow")
    __pydantic_extra__: dict[str, _Number | None]

    env_steps: Annotated[int, Field(ge=0, le=2**53)]
    timestamp: Annotated[_Number, Field(ge=0, le=_LATEST)]


class History(NamedTuple):
    """A `History` holds one line of `metrics.jsonl`."""

    env_steps: int
    timestamp: float
    """Time at which the line was written [s since 1970]."""
    metrics: MetricValues


def read_history(path: Path, last: float = math.inf) -> list[History]:
    """Read the metrics that an earlier training wrote.

    Args:
      path: path of `metrics.jsonl`; the file may be missing.
      last: the largest environment step to read.

    Returns:
      The lines up to that step, without those that are incomplete.

    Raises:
      UserError: the file cannot be read.
    """
    try:
        text = read_bytes(path).decode(errors="replace")
    except FileNotFoundError:
        return []
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from None
    entries = map(_parse_line, text.splitlines())
    return [entry for entry in entries if entry is not None and entry.env_steps <= last]


def _parse_line(line: str) -> History | None:
    """Return what a line holds; None if it is incomplete or no training can have written it."""
    try:
        found = _Line.model_validate_json(line)
    except ValidationError:
        return None
    return History(found.env_steps, found.timestamp, found.model_extra or {})


class JsonlSink:
    """A sink that writes one JSON object per line, readable while training runs."""

    def __init__(self, path: Path, history: Sequence[History] = ()) -> None:
        """Open the file.

        Args:
          path: path of the file.
          history: lines that the file begins with; all other content is removed.
        """
        text = "".join(_line(*entry) for entry in history)
        if not path.is_file() or path.read_text(encoding="utf-8", errors="replace") != text:
            write_text(path, text)
        self._file = path.open("a", encoding="utf-8")

    def write(self, env_steps: int, metrics: MetricValues) -> None:
        """Append a line and sync it to disk, so that no checkpoint is newer than the metrics."""
        self._file.write(_line(env_steps, time.time(), metrics))
        self._file.flush()
        os.fsync(self._file.fileno())

    def write_video(self, env_steps: int, mp4: Path) -> None:
        """Leave the video out: it is a file of its own."""

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _line(env_steps: int, timestamp: float, metrics: MetricValues) -> str:
    """Return one line of JSON, with null for values that are not finite, as JSON has no NaN."""
    values = {
        name: value if value is not None and math.isfinite(value) else None
        for name, value in metrics.items()
    }
    return json.dumps({"env_steps": env_steps, "timestamp": timestamp, **values}) + "\n"


# Protocol buffers create their classes at import time, so pyright does not know them.
_SUMMARY = vars(summary_pb2)["Summary"]
_EVENT = vars(event_pb2)["Event"]

_GIF_SIZE_AT = 6
"""Byte of a GIF at which its width and height begin, two bytes each."""


_LAYOUT = {
    "success": {
        "success rate, 95 % interval": [
            "Margin",
            ["eval/success_rate", "eval/success_low", "eval/success_high"],
        ],
        "success rate, and that of the exploring policy": [
            "Multiline",
            ["eval/success_rate", "rollout/success_rate"],
        ],
        "time to goal [s]": ["Multiline", ["eval/time_to_goal_median", "eval/time_to_goal_p95"]],
    }
}
"""Charts of TensorBoard's tab of custom scalars, so that success comes first."""

_RETURN_LAYOUT = {
    "return": {
        "mean return, 95 % interval": [
            "Margin",
            ["eval/episode_return", "eval/return_low", "eval/return_high"],
        ],
        "mean return, and that of the exploring policy": [
            "Multiline",
            ["eval/episode_return", "rollout/episode_return"],
        ],
        "episode length [steps]": ["Multiline", ["eval/episode_length", "rollout/episode_length"]],
    },
    "success": {
        name: chart for name, chart in _LAYOUT["success"].items() if name.startswith("success")
    },
}
"""Those of a run with an `environment`, which may tell no success."""


class TensorBoardSink:
    """A sink that writes TensorBoard event files without TensorFlow.

    With a configuration, the file also holds its YAML as text, its settings as hyperparameters
    beside the last success rate or return, and charts with that first. Videos are GIFs among the
    images.
    """

    def __init__(
        self,
        folder: Path,
        history: Sequence[History] = (),
        config: Config | None = None,
    ) -> None:
        """Open an event file.

        Args:
          folder: folder for `tensorboard --logdir`; event files of an earlier training are removed.
          history: metrics that are written first, in place of the removed ones.
          config: the configuration of the run, or None to write metrics only, without other tags.
        """
        self._names = aliases(config.ppo) if config else {}
        folder.mkdir(exist_ok=True)
        for events in folder.glob("events.out.tfevents.*"):
            events.unlink()
        # tensorboardX's SummaryWriter writes from a thread, whose errors would not be reported.
        self._writer = EventsWriter(str(folder / "events"))
        self._at_end: Message | None = None
        if config is not None:
            self._describe(config)
        for entry in history:
            self._add(*entry)
        written = {entry.env_steps: entry.timestamp for entry in history}
        for env_steps, timestamp in written.items():
            mp4 = folder.parent / "videos" / f"{env_steps:012d}" / EVALUATION_VIDEO
            if mp4.with_suffix(".gif").is_file():
                self._add_video(env_steps, timestamp, mp4)
        self._writer.flush()

    def write(self, env_steps: int, metrics: MetricValues) -> None:
        """Write one scalar for each metric that has a value."""
        self._add(env_steps, time.time(), metrics)
        self._writer.flush()

    def write_video(self, env_steps: int, mp4: Path) -> None:
        """Write the GIF beside the video, which TensorBoard plays."""
        self._add_video(env_steps, time.time(), mp4)
        self._writer.flush()

    def _describe(self, config: Config) -> None:
        """Write the charts, the configuration and the hyperparameters."""
        # The plugin knows no lists and no None.
        settings = {
            key: value if isinstance(value, (bool, int, float)) else str(value)
            for key, value in config.flat().items()
        }
        # The table of hyperparameters shows the last value of this metric.
        own = config.environment is not None
        metric = "eval/episode_return" if own else "eval/success_rate"
        *begin, self._at_end = tensorboard_summary.hparams(settings, {metric: 0.0})
        # Markdown shows lines that are indented as they are.
        indented = "".join(f"    {line}\n" for line in config.to_yaml().splitlines())
        begin += [
            tensorboard_summary.custom_scalars(_RETURN_LAYOUT if own else _LAYOUT),
            tensorboard_summary.text("config", indented),
        ]
        for summary in begin:
            self._writer.write_event(_EVENT(wall_time=time.time(), summary=summary))

    def _add(self, env_steps: int, timestamp: float, metrics: MetricValues) -> None:
        values = [
            _SUMMARY.Value(tag=name, simple_value=value)
            for name, value in with_aliases(env_steps, metrics, self._names).items()
        ]
        event = _EVENT(wall_time=timestamp, step=env_steps, summary=_SUMMARY(value=values))
        self._writer.write_event(event)

    def _add_video(self, env_steps: int, timestamp: float, mp4: Path) -> None:
        gif = read_bytes(mp4.with_suffix(".gif"))
        if len(gif) < _GIF_SIZE_AT + 4:
            return  # It was cut off since it was written.
        width, height = struct.unpack_from("<HH", gif, _GIF_SIZE_AT)
        shown = _SUMMARY.Image(width=width, height=height, colorspace=3, encoded_image_string=gif)
        summary = _SUMMARY(value=[_SUMMARY.Value(tag=VIDEO_TAG, image=shown)])
        self._writer.write_event(_EVENT(wall_time=timestamp, step=env_steps, summary=summary))

    def close(self) -> None:
        """Close the event file."""
        if self._at_end is not None:
            self._writer.write_event(_EVENT(wall_time=time.time(), summary=self._at_end))
        self._writer.close()


class CompileClock(contextlib.AbstractContextManager["CompileClock"]):
    """A `CompileClock` measures the time that JAX reports for tracing, lowering and compiling.

    It is a context manager that unregisters its listeners at the end. Where threads compile in
    parallel, each second counts once.
    """

    _EVENTS = (
        "/jax/core/compile/jaxpr_trace_duration",
        "/jax/core/compile/jaxpr_to_mlir_module_duration",
        "/jax/core/compile/backend_compile_duration",
    )
    _CACHE_HIT = "/jax/compilation_cache/cache_hits"
    _SAVED = "/jax/compilation_cache/compile_time_saved_sec"

    def __init__(self) -> None:
        """Register the listeners."""
        self._lock = threading.Lock()
        self._spans: list[tuple[float, float]] = []
        self._counted_until = -math.inf
        self.programs = 0
        """Number of programs that were compiled or found in the persistent cache."""
        self.cached = 0
        """Number of programs that were found in the persistent cache."""
        self.saved_seconds = 0.0
        """Time that compiling the programs found in the cache would have taken [s]."""
        # The commands that list and find runs read metrics without JAX.
        import jax

        jax.monitoring.register_event_duration_secs_listener(self._listen)
        jax.monitoring.register_event_listener(self._count)

    def _listen(self, event: str, duration_secs: float, **kwargs: str | int) -> None:
        end = time.perf_counter()
        with self._lock:
            if event in self._EVENTS:
                self._spans.append((end - duration_secs, end))
                self.programs += event == self._EVENTS[-1]
            elif event == self._SAVED:
                self.saved_seconds += duration_secs

    def _count(self, event: str, **kwargs: str | int) -> None:
        with self._lock:
            self.cached += event == self._CACHE_HIT

    def lap(self) -> float:
        """Return the time spent on compilation since the last call [s]."""
        with self._lock:
            spans, self._spans = sorted(self._spans), []
        # Count a compilation that was running at the last call from that call on.
        seconds, until = 0.0, self._counted_until
        for start, end in spans:
            seconds += max(0.0, end - max(start, until))
            until = max(until, end)
        self._counted_until = until
        return seconds

    def __exit__(self, *exception: object) -> None:
        """Unregister the listeners."""
        import jax

        jax.monitoring.unregister_event_duration_listener(self._listen)
        jax.monitoring.unregister_event_listener(self._count)
