"""Evaluate, log and save a training at every report, seed by seed."""

import contextlib
import dataclasses
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

import jax

from jetbot_mjx.agents.networks import PolicyParams, make_networks
from jetbot_mjx.agents.ppo import NanDump
from jetbot_mjx.compiler.program_cache import ProgramCache
from jetbot_mjx.config import Config
from jetbot_mjx.envs.domain_randomization import maybe_randomize
from jetbot_mjx.envs.jetbot_env import JetBotEnv
from jetbot_mjx.envs.program_key import open_program_cache
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation.evaluator import Evaluator, Summary, summarize, training_keys
from jetbot_mjx.runs.checkpoint import POLICY, about_policy
from jetbot_mjx.runs.checkpoint_store import CheckpointStore, checkpoint_path, digest
from jetbot_mjx.runs.metrics import (
    CompileClock,
    History,
    JsonlSink,
    MetricValues,
    Sink,
    Sinks,
    TensorBoardSink,
    process_seconds,
    read_history,
)
from jetbot_mjx.runs.nan_dump import save_nan_dump
from jetbot_mjx.runs.resume import Resumption, to_trees
from jetbot_mjx.runs.run_dir import make_folder, versions, writing_to
from jetbot_mjx.runs.sb3_tags import aliases
from jetbot_mjx.runs.wandb_sink import WandbSink
from jetbot_mjx.training.callbacks import Progress, TrainerCallback
from jetbot_mjx.training.console import COMPILING, EVALUATING, FILMING, SAVING, TRAINING
from jetbot_mjx.training.dashboard import open_terminal
from jetbot_mjx.viewers.offscreen import find_backend
from jetbot_mjx.viewers.video import EvaluationVideo

_METRICS = "metrics.jsonl"


@dataclasses.dataclass
class Standing:
    """The progress of one seed, which is stored in its checkpoints."""

    env_steps: int = 0
    best_steps: int = 0
    best: Summary | None = None
    """The best evaluation, of equals the later."""
    last: Summary | None = None
    """The last one."""
    wall_seconds: float = 0.0
    """Spent on training in all processes so far."""

    def to_json(self) -> dict[str, Any]:
        """Return it as it is stored."""
        return {
            **vars(self),
            "best": self.best._asdict() if self.best else None,
            "last": self.last._asdict() if self.last else None,
        }

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> "Standing":
        """Read it as it was stored."""
        summaries = {
            name: Summary(**values[name]) if values.get(name) else None for name in ("best", "last")
        }
        return cls(**{**values, **summaries})


class RunRecorder(TrainerCallback):
    """Records the training of one run, of one seed or several; a context manager."""

    def __init__(
        self,
        config: Config,
        env: JetBotEnv,
        run_dirs: Sequence[Path],
        clock: CompileClock,
        resumption: Resumption | None = None,
        programs: ProgramCache | None = None,
    ) -> None:
        """Open the logs and the checkpoint folders.

        Args:
          config: the run.
          env: to judge policies in, unwrapped.
          run_dirs: the folder of each seed.
          clock: of the compiler.
          resumption: where the seeds stand; None: at the beginning.
          programs: of that configuration; None: they are not kept.

        Raises:
          UserError: a folder cannot be written.
        """
        networks = make_networks(
            config.ppo.network,
            env.observation_size,
            env.action_size,
            normalize=config.ppo.normalize_observations,
        )
        self._config = config
        programs = programs or open_program_cache(config, keep=False)
        self._evaluator = Evaluator(maybe_randomize(env), networks, programs=programs)
        # As one program: operation by operation it would be half a dozen.
        keys = jax.jit(training_keys, static_argnums=0)
        episodes = config.evaluation.episodes
        self._keys = programs.compile(f"{episodes} keys", lambda: keys.trace(episodes))()
        self._film = EvaluationVideo(env, networks) if config.evaluation.video else None
        self._clock = clock
        resumed = resumption or Resumption(0, [], [{} for _ in run_dirs], [])
        histories = [
            read_history(run_dir / _METRICS, resumed.env_steps) if resumption else []
            for run_dir in run_dirs
        ]
        ppo = config.ppo
        self._total = ppo.training_steps * ppo.steps_per_training_step
        self._terminal = open_terminal(run_dirs, self._total, histories)
        self._compiled = False
        self._seeds = [
            _SeedRecorder(
                seed_config,
                env,
                run_dir,
                Standing.from_json(standing),
                history,
                self._terminal.say,
                len(run_dirs),
            )
            for seed_config, run_dir, standing, history in zip(
                config.of_each_seed(), run_dirs, resumed.progress, histories, strict=True
            )
        ]
        self._earlier = self._seeds[0].standing.wall_seconds
        self._began = time.perf_counter()
        self._compile_seconds = 0.0
        self._unlogged_compile_seconds = 0.0
        self._recording_seconds = 0.0
        self._awaiting_first_step = False
        self.fingerprints = [digest(state.policy_params) for state in resumed.states]
        """SHA-256 of each seed's last parameters."""

    @property
    def standings(self) -> list[Standing]:
        """Return the progress of each seed."""
        return [seed.standing for seed in self._seeds]

    @property
    def complete(self) -> bool:
        """Return whether every seed has made all its steps, or reached `stop_at_success`."""
        target = self._config.stop_at_success
        return all(
            one.env_steps >= self._total
            or (target is not None and one.last is not None and one.last.success_rate >= target)
            for one in self.standings
        )

    @property
    def wall_seconds(self) -> float:
        """Since the training began, in all processes [s]."""
        return self._earlier + time.perf_counter() - self._began

    def say(self, *lines: str) -> None:
        """Pass lines to the terminal."""
        for line in lines:
            self._terminal.say(line)

    def begin(self, headline: str) -> None:
        """Say what is trained, and that compiling has begun."""
        self._terminal.say(headline)
        self._terminal.begin()

    def on_interval(self, progress: Sequence[Progress]) -> bool:
        """Evaluate, logs and saves every seed; tells whether it is worth going on."""
        self._at(EVALUATING)
        # What a trainer compiles while it trains belongs to the time it reports.
        compiling = self._lap()
        began = time.perf_counter()
        summaries = [self.judge(one.params) for one in progress]
        judging = time.perf_counter() - began
        self._at(SAVING)
        self._lap()
        compiled, self._unlogged_compile_seconds = self._unlogged_compile_seconds, 0.0
        lines = []
        for seed, one, summary in zip(self._seeds, progress, summaries, strict=True):
            steps = one.env_steps - seed.standing.env_steps
            training = one.seconds - (compiling if one.state is None else 0.0)
            metrics = {
                **{f"eval/{name}": value for name, value in summary._asdict().items()},
                **one.metrics,
                "time/env_steps_per_second": steps / training if steps and training > 0 else None,
                "time/training_seconds": training,
                "time/evaluation_seconds": judging,
                "time/recording_seconds": self._recording_seconds,
                "time/compile_seconds": compiled,
                "time/wall_seconds": self.wall_seconds,
            }
            seed.report(one, summary, metrics, self.wall_seconds)
            lines.append(metrics)
        self._tell_first_step()
        self._terminal.write(progress[0].env_steps, lines)
        self.fingerprints = [digest(one.params) for one in progress]
        self._film_seeds(progress)
        self._recording_seconds = time.perf_counter() - began - judging
        if progress[0].env_steps > 0:
            self._compiled = True
        self._at(TRAINING)
        return not self.complete

    def judge(self, params: PolicyParams) -> Summary:
        """Evaluate a policy on the fixed goals of training, with robots as it is trained on."""
        episodes = self._evaluator.run(params, self._keys)
        return summarize(episodes, self._config.physics.ctrl_dt)

    def on_preempt(self, progress: Sequence[Progress]) -> None:
        """Save every seed as it is."""
        self._terminal.phase(SAVING)
        for seed, one in zip(self._seeds, progress, strict=True):
            seed.save(one, {}, self.wall_seconds)

    def on_progress(self, env_steps: int, metrics: Mapping[str, float], seconds: float) -> None:
        """Show on the terminal that something happens."""
        self._tell_first_step()
        steps = env_steps - self._seeds[0].standing.env_steps
        self._terminal.tell(env_steps, metrics, steps / max(seconds, 1e-9))

    def on_nan_dump(self, seed_index: int, env_steps: int, nan_dump: NanDump) -> None:
        """Keep it for replay, and says where."""
        path = self._seeds[seed_index].on_nan_dump(env_steps, nan_dump)
        if path is not None:
            self._terminal.say(
                f"a world stopped being finite before step {env_steps:,} and was reset:"
                f" python -m jetbot_mjx.replay {path}"
            )

    def on_compiled(self) -> None:
        """Wait for the first step to tell what came before it."""
        self._compiled = True
        self._at(TRAINING)
        self._awaiting_first_step = True

    def _film_seeds(self, progress: Sequence[Progress]) -> None:
        """Render a video last: whatever happens to it, the log and the checkpoints are begun."""
        if self._film is None:
            return
        self._at(FILMING)
        try:
            find_backend()
        except UserError as error:
            self._terminal.say(f"evaluation.video: nothing is filmed: {error}")
            self._film = None
            return
        for seed, one in zip(self._seeds, progress, strict=True):
            seed.film(self._film, one)
        # No trainer compiled this.
        self._lap()

    def _at(self, phase: str) -> None:
        """Tell the terminal; what is done before the first training step is mostly compiling."""
        self._terminal.phase(phase if self._compiled else COMPILING)

    def _tell_first_step(self) -> None:
        if not self._awaiting_first_step:
            return
        self._awaiting_first_step = False
        self._lap()
        cache = f"{self._clock.cached} of {self._clock.programs} programs from the cache"
        if self._clock.cached:
            cache += f", which saved {self._clock.saved_seconds:.1f} s"
        self._terminal.say(
            f"first training step done {process_seconds():.1f} s after the start;"
            f" {self._compile_seconds:.1f} s of it compiling ({cache})"
        )

    def _lap(self) -> float:
        seconds = self._clock.lap()
        self._compile_seconds += seconds
        self._unlogged_compile_seconds += seconds
        return seconds

    def __enter__(self) -> Self:
        """Enter."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Wait until all is on disk."""
        self._terminal.phase(SAVING)
        with contextlib.ExitStack() as stack:
            stack.callback(self._terminal.close)
            for seed in self._seeds:
                stack.callback(seed.close)


class _SeedRecorder:
    """The logs and checkpoints of one seed."""

    def __init__(
        self,
        config: Config,
        env: JetBotEnv,
        run_dir: Path,
        standing: Standing,
        history: Sequence[History],
        say: Callable[[str], None],
        seeds: int,
    ) -> None:
        self.standing = standing
        self._config = config
        self._run_dir = run_dir
        self._about = {**about_policy(config, env), "versions": versions()}
        with writing_to(run_dir):
            sinks: list[Sink] = [JsonlSink(run_dir / _METRICS, history)]
            if config.tensorboard:
                names = aliases(config.ppo)
                sinks.append(TensorBoardSink(run_dir / "tensorboard", history, names))
            if config.wandb is not None:
                sinks.append(WandbSink(config, run_dir, history, say, seeds))
        self._sinks = Sinks(sinks)
        self._store = CheckpointStore(run_dir, config.checkpoints_to_keep)

    def report(
        self, progress: Progress, summary: Summary, metrics: MetricValues, wall_seconds: float
    ) -> None:
        """Log, then saves: a checkpoint is never ahead of the log."""
        standing = self.standing
        standing.env_steps, standing.last = progress.env_steps, summary
        if standing.best is None or summary.success_rate >= standing.best.success_rate:
            standing.best_steps, standing.best = progress.env_steps, summary
        with writing_to(self._run_dir):
            self._sinks.write(progress.env_steps, metrics)
        self.save(progress, summary._asdict(), wall_seconds)

    def save(self, progress: Progress, judged: Mapping[str, Any], wall_seconds: float) -> None:
        """Begin to write a checkpoint."""
        self.standing.wall_seconds = wall_seconds
        trees = to_trees(progress.state) if progress.state else {POLICY: progress.params}
        about = {**self._about, "metrics": dict(judged), "progress": self.standing.to_json()}
        self._store.save(progress.env_steps, trees, about, judged.get("success_rate"))

    def film(self, film: EvaluationVideo, progress: Progress) -> None:
        name = checkpoint_path(self._run_dir, progress.env_steps).name
        path = self._run_dir / "videos" / name / "evaluation.mp4"
        make_folder(path.parent)
        with writing_to(path):
            film.write(path, progress.params, progress.env_steps)

    def on_nan_dump(self, env_steps: int, nan_dump: NanDump) -> Path | None:
        with writing_to(self._run_dir):
            return save_nan_dump(self._run_dir, self._config, env_steps, nan_dump)

    def close(self) -> None:
        with contextlib.ExitStack() as stack:
            stack.enter_context(writing_to(self._run_dir))
            stack.callback(self._sinks.close)
            stack.enter_context(self._store)
