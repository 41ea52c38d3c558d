"""Evaluate, log and save a training at every report, seed by seed."""

import contextlib
import dataclasses
import shlex
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from pydantic import Field, TypeAdapter, ValidationError

from jetbot_mjx import runs
from jetbot_mjx.agents import NanDump, PolicyParams
from jetbot_mjx.config import Config
from jetbot_mjx.envs import find_backend
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation import ReturnSummary, Summary
from jetbot_mjx.interrupts import tell
from jetbot_mjx.runs import CheckpointStore, JsonObject, MetricValues
from jetbot_mjx.terminal import process_seconds
from jetbot_mjx.training.callbacks import Progress, TrainerCallback
from jetbot_mjx.training.console import Phase, Terminal

if TYPE_CHECKING:
    from jetbot_mjx.viewers import EnvironmentVideo, EvaluationVideo


@dataclasses.dataclass
class Standing:
    """A `Standing` holds the progress of one seed; its checkpoints store it."""

    env_steps: Annotated[int, Field(ge=0)] = 0
    best_steps: Annotated[int, Field(ge=0)] = 0
    best: Summary | ReturnSummary | None = None
    """The best evaluation; of equal ones the latest."""
    last: Summary | ReturnSummary | None = None
    """The last evaluation."""
    wall_seconds: float = 0.0
    """Time spent on the training so far, in all processes [s]."""

    def to_json(self) -> JsonObject:
        """Return JSON values."""
        summaries = {"best": self.best, "last": self.last}
        return {**vars(self), **{key: one and one._asdict() for key, one in summaries.items()}}

    @classmethod
    def from_json(cls, values: object, run_dir: Path) -> "Standing":
        """Return the object whose JSON values a checkpoint of a run stores.

        Raises:
          UserError: no training has written these values.
        """
        try:
            return TypeAdapter(cls).validate_python(values)
        except ValidationError as error:
            key = ".".join(map(str, ("progress", *error.errors()[0]["loc"])))
            raise UserError(
                f"{run_dir}: the last checkpoint has unusable metadata: {key} is wrong: move it to"
                " another folder, and the training continues from the one before"
            ) from None


def _reaches(value: float | None, target: float | None) -> bool:
    return value is not None and target is not None and value >= target


def open_sinks(
    config: Config,
    run_dir: Path,
    history: Sequence[runs.History],
    say: Callable[[str], None],
    seeds: int,
) -> list[runs.Sink]:
    """Open the logs of one seed.

    Args:
      config: the configuration of this seed.
      run_dir: the run folder of this seed.
      history: the metrics that were logged before; the logs begin with them.
      say: a function that prints one line for the user.
      seeds: number of seeds of the training.

    Returns:
      The logs, which receive the metrics in this order.

    Raises:
      UserError: the folder cannot be written.
    """
    with runs.writing_to(run_dir):
        sinks: list[runs.Sink] = [runs.JsonlSink(run_dir / runs.METRICS, history)]
        if config.tensorboard:
            folder = run_dir / "tensorboard"
            sinks.append(runs.TensorBoardSink(folder, history, config))
        if config.wandb is not None:
            sinks.append(runs.WandbSink(config, run_dir, history, say, seeds))
    return sinks


@dataclasses.dataclass(eq=False)
class RunRecorder(TrainerCallback, contextlib.AbstractContextManager["RunRecorder"]):
    """A `RunRecorder` records the training of one run; it is a context manager.

    Args:
      config: the configuration of the run, which says when it is complete.
      seeds: the recorder of each seed.
      evaluate: a function that evaluates a policy on the fixed goals of training.
      video: renders a policy after an evaluation; None: no videos.
      terminal: shows the progress.
      say: tells the user a message, on the terminal and in the log of the run.
      clock: measures the time that is spent on compilation.
    """

    config: Config
    seeds: Sequence["SeedRecorder"]
    evaluate: Callable[[PolicyParams], Summary | ReturnSummary]
    video: "EvaluationVideo | EnvironmentVideo | None"
    terminal: Terminal
    say: Callable[[str], None]
    clock: runs.CompileClock

    def __post_init__(self) -> None:
        """Begin to measure."""
        self._earlier_seconds = self.seeds[0].standing.wall_seconds
        self._compiled = False
        self._compile_seconds = 0.0
        self._unlogged_compile_seconds = 0.0
        self._recording_seconds = 0.0
        self._awaiting_first_step = False
        self._unread = False

    @property
    def standings(self) -> list[Standing]:
        """Return the progress of each seed."""
        return [seed.standing for seed in self.seeds]

    @property
    def complete(self) -> bool:
        """Return whether every seed has made all its steps, or is as good as was asked for."""
        ppo, config = self.config.ppo, self.config
        return all(
            one.env_steps >= ppo.all_steps
            or (
                one.last is not None
                and (
                    _reaches(one.last.success_rate, config.stop_at_success)
                    or _reaches(one.last.episode_return, config.stop_at_return)
                )
            )
            for one in self.standings
        )

    @property
    def wall_seconds(self) -> float:
        """Return the time of all processes that worked on the run, from their start [s]."""
        return self._earlier_seconds + process_seconds()

    def begin(self, headline: str) -> None:
        """Print the headline, and show that compilation has begun."""
        self.say(headline)
        self.terminal.begin()

    def on_interval(self, progress: Sequence[Progress]) -> bool:
        """Evaluate, log and save every seed; return whether to go on."""
        # Evaluate the policy of every seed.
        self._set_phase("evaluating")
        # What Brax's trainer compiles while it trains is part of the time that it reports.
        compiling = self._lap()
        began = time.perf_counter()
        summaries = [self.evaluate(one.params) for one in progress]
        evaluating = time.perf_counter() - began
        # Log the metrics, and save a checkpoint.
        self._set_phase("saving")
        self._lap()
        compiled, self._unlogged_compile_seconds = self._unlogged_compile_seconds, 0.0
        logged = []
        for seed, one, summary in zip(self.seeds, progress, summaries, strict=True):
            steps = one.env_steps - seed.standing.env_steps
            training = one.seconds - (compiling if one.state is None else 0.0)
            metrics = {
                **{f"eval/{name}": value for name, value in _by_name(summary).items()},
                **one.metrics,
                "time/env_steps_per_second": steps / training if steps and training > 0 else None,
                "time/training_seconds": training,
                "time/evaluation_seconds": evaluating,
                "time/recording_seconds": self._recording_seconds,
                "time/compile_seconds": compiled,
                "time/wall_seconds": self.wall_seconds,
            }
            seed.report(one, summary, metrics, self.wall_seconds)
            logged.append(metrics)
        # Show the metrics, and render the videos.
        self._report_first_step()
        self.terminal.write(progress[0].env_steps, logged)
        self._report_unread()
        self._render_videos(progress)
        self._recording_seconds = time.perf_counter() - began - evaluating
        if progress[0].env_steps > 0:
            self._compiled = True
        self._set_phase("training")
        return not self.complete

    def on_preempt(self, progress: Sequence[Progress]) -> None:
        """Save every seed without an evaluation."""
        self.terminal.phase("saving")
        for seed, one in zip(self.seeds, progress, strict=True):
            seed.save(one, {}, self.wall_seconds)

    def on_progress(self, env_steps: int, metrics: Mapping[str, float], seconds: float) -> None:
        """Show the progress on the terminal."""
        self._report_first_step()
        steps = env_steps - self.seeds[0].standing.env_steps
        self.terminal.update(env_steps, metrics, steps / max(seconds, 1e-9))
        self._report_unread()

    def on_nan_dump(self, seed_index: int, env_steps: int, nan_dump: NanDump) -> None:
        """Save the dump for replay, and print the command that replays it."""
        seed = self.seeds[seed_index]
        with runs.writing_to(seed.run_dir):
            path = runs.save_nan_dump(seed.run_dir, seed.config, env_steps, nan_dump)
        if path is not None:
            self.say(
                f"a state became non-finite before step {env_steps:,}, and its environment was"
                f" reset: jetbot-mjx replay {shlex.quote(str(path))}"
            )

    def on_compiled(self) -> None:
        """Show that training begins; the first step reports the time until then."""
        self._compiled = True
        self._set_phase("training")
        self._awaiting_first_step = True

    def _render_videos(self, progress: Sequence[Progress]) -> None:
        """Render a video of every seed, last: an error leaves the log and checkpoints complete."""
        only_last = self.config.evaluation.video == "last"
        if self.video is None or (only_last and not self.complete):
            return
        self._set_phase("rendering")
        try:
            find_backend()
        except UserError as error:
            self.say(f"evaluation.video: no videos are rendered: {error}")
            self.video = None
            return
        for seed, one in zip(self.seeds, progress, strict=True):
            seed.render(self.video, one)
        # Leave the video's compilation out of the trainer's time.
        self._lap()

    def _set_phase(self, phase: Phase) -> None:
        """Show the phase; before the first training step most of the time is compilation."""
        self.terminal.phase(phase if self._compiled else "compiling")

    def _report_first_step(self) -> None:
        """Print after the first training step how long the start took."""
        if not self._awaiting_first_step:
            return
        self._awaiting_first_step = False
        self._lap()
        cache = ""
        if self.clock.programs:
            cache = f" ({self.clock.cached} of {self.clock.programs} programs from the cache"
            # Loading a small program may take longer than compiling it took.
            saved = round(self.clock.saved_seconds, 1)
            cache += f", which saved {saved:.1f} s)" if saved > 0 else ")"
        self.say(
            f"first training step done {process_seconds():.1f} s after the start;"
            f" {self._compile_seconds:.1f} s of it compiling{cache}"
        )

    def _report_unread(self) -> None:
        """Tell once that the output can no longer be written, and that the training goes on."""
        if self._unread or not self.terminal.lost:
            return
        self._unread = True
        text = (
            "standard output cannot be written: the training goes on, and its messages are in"
            f" {runs.TRAIN_LOG} in the run folder"
        )
        self.say(text)
        tell(text)

    def _lap(self) -> float:
        seconds = self.clock.lap()
        self._compile_seconds += seconds
        self._unlogged_compile_seconds += seconds
        return seconds

    def __exit__(self, *exception: object) -> None:
        """Wait until all files are written."""
        self.terminal.phase("saving")
        with contextlib.ExitStack() as stack:
            stack.callback(self.terminal.close)
            for seed in self.seeds:
                stack.callback(seed.close)


@dataclasses.dataclass(eq=False)
class SeedRecorder:
    """A `SeedRecorder` writes the logs and checkpoints of one seed.

    Args:
      config: the configuration of this seed.
      run_dir: the run folder of this seed.
      sinks: the logs of this seed.
      about: the metadata that every checkpoint carries, as JSON values.
      standing: the progress of this seed.
      fingerprint: the SHA-256 of its parameters; empty if there are none yet.
    """

    config: Config
    run_dir: Path
    sinks: Sequence[runs.Sink]
    about: JsonObject
    standing: Standing
    fingerprint: str

    def __post_init__(self) -> None:
        """Open the folder of checkpoints."""
        self._store = CheckpointStore(self.run_dir, self.config.checkpoints_to_keep)

    def report(
        self,
        progress: Progress,
        summary: Summary | ReturnSummary,
        metrics: MetricValues,
        wall_seconds: float,
    ) -> None:
        """Log the metrics, then save: a checkpoint is never newer than the log.

        Args:
          progress: the progress of this seed.
          summary: the evaluation of its policy.
          metrics: the values to log.
          wall_seconds: time of all processes that worked on the run [s].
        """
        standing = self.standing
        standing.env_steps, standing.last = progress.env_steps, summary
        if standing.best is None or summary.score >= standing.best.score:
            standing.best_steps, standing.best = progress.env_steps, summary
        with runs.writing_to(self.run_dir):
            for sink in self.sinks:
                sink.write(progress.env_steps, metrics)
        self.save(progress, _by_name(summary), wall_seconds, summary.score)
        self.fingerprint = runs.digest(progress.params)

    def save(
        self,
        progress: Progress,
        evaluation: MetricValues,
        wall_seconds: float,
        score: float | None = None,
    ) -> None:
        """Begin to write a checkpoint.

        Args:
          progress: the progress of this seed.
          evaluation: the metrics of the policy; empty if it was not evaluated.
          wall_seconds: time of all processes that worked on the run [s].
          score: the number by which the best checkpoint is found; None if it was not evaluated.
        """
        self.standing.wall_seconds = wall_seconds
        trees = runs.to_trees(progress.state) if progress.state else {runs.POLICY: progress.params}
        about = {
            **self.about,
            "metrics": dict(evaluation),
            "progress": self.standing.to_json(),
        }
        # Other programs may read the policy, array by array, but not the rest.
        joined = trees.keys() - {runs.POLICY}
        self._store.save(progress.env_steps, trees, about, score, joined)

    def render(self, video: "EvaluationVideo | EnvironmentVideo", progress: Progress) -> None:
        """Render a video of the policy into the run folder, and log it."""
        name = runs.checkpoint_path(self.run_dir, progress.env_steps).name
        path = self.run_dir / "videos" / name / runs.EVALUATION_VIDEO
        runs.make_folder(path.parent)
        with runs.writing_to(path):
            video.write(path, progress.params, progress.env_steps)
            for sink in self.sinks:
                sink.write_video(progress.env_steps, path)

    def close(self) -> None:
        """Wait until the logs and checkpoints are written."""
        with contextlib.ExitStack() as stack:
            stack.enter_context(runs.writing_to(self.run_dir))
            for sink in self.sinks:
                stack.callback(sink.close)
            stack.enter_context(self._store)


def _by_name(summary: Summary | ReturnSummary) -> dict[str, float | None]:
    """Return the metrics of an evaluation by name, those of the environment below `metrics/`."""
    values = summary._asdict()
    own = values.pop("metrics", {})
    return {**values, **{f"metrics/{name}": value for name, value in own.items()}}
