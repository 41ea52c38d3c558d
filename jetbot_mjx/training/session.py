"""Compose a training from its configuration and run it into its run folder.

This module is the composition root: `train` builds the environment, PPO with its networks, and the
run folders once, `open_recorder` the evaluator, the video, the terminal and the logs. All other
modules receive what they need as required arguments.
"""

import contextlib
import functools
import importlib.util
import pickle
import shlex
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jetbot_mjx.agents.networks import PolicyParams
from jetbot_mjx.agents.ppo import PPO, TrainState
from jetbot_mjx.compiler.program_cache import ProgramCache
from jetbot_mjx.compiler.xla_options import compiler_options
from jetbot_mjx.config import Config, ConfigError
from jetbot_mjx.envs.checks.runner import require_trainable
from jetbot_mjx.envs.domain_randomization import maybe_randomize
from jetbot_mjx.envs.jetbot_env import JetBotEnv, make_env
from jetbot_mjx.envs.program_key import TRUSTED
from jetbot_mjx.errors import UserError, ran_out
from jetbot_mjx.evaluation.evaluator import Evaluator, Summary, summarize, training_keys
from jetbot_mjx.fallbacks import Fallback, collect
from jetbot_mjx.runs.checkpoint import about_policy, load_checkpoint
from jetbot_mjx.runs.checkpoint_store import checkpoint_steps, digest
from jetbot_mjx.runs.metrics import METRICS, CompileClock, History, read_history, restart_clock
from jetbot_mjx.runs.resume import Resumption, resume
from jetbot_mjx.runs.run_dir import (
    changed_versions,
    occupied,
    seed_dirs,
    stored_config,
    versions,
    write_run,
)
from jetbot_mjx.runs.task_code import (
    TaskCode,
    collect_task_code,
    read_task_code,
    stored_task_class,
    write_task_code,
)
from jetbot_mjx.runs.train_log import log_message
from jetbot_mjx.runs.wandb_sink import check_tracking
from jetbot_mjx.training import distributed, ppo_trainer
from jetbot_mjx.training.callbacks import TrainerCallback
from jetbot_mjx.training.console import SilentTerminal
from jetbot_mjx.training.memory import advice, device_memory, sizes
from jetbot_mjx.training.preemption import DeferredSignals, Preemption, StopRequest
from jetbot_mjx.training.run_recorder import (
    RunRecorder,
    SeedRecorder,
    Standing,
    open_sinks,
)
from jetbot_mjx.training.terminal import open_terminal
from jetbot_mjx.training.warm_start import WarmStart, make_warm_start

_COMPLETE, _BEGINS, _RESUMES = range(3)
"""What the run folder holds: a complete run, none, or one that can be resumed."""


class Result(NamedTuple):
    """A `Result` holds the result of a training; of several processes only the first has it all."""

    run_dir: Path
    run_dirs: list[Path]
    """The folder of each seed, which is the run folder if there is only one seed."""
    standings: list[Standing]
    """How far each seed has come; empty in all processes but the first."""
    fingerprints: list[str]
    """SHA-256 of each seed's last parameters, which are the same for the same seed; empty in all
    processes but the first."""
    finished: bool
    """Whether the training came to its end; otherwise the same command resumes it."""
    wall_seconds: float
    """Time spent on the training, in all processes [s]."""

    def __repr__(self) -> str:
        """Return the folder and the best success rate of each seed in one line."""
        rates = [f"{one.best.success_rate:.1%}" if one.best else "-" for one in self.standings]
        return (
            f"Result(run_dir={str(self.run_dir)!r}, success={' '.join(rates) or '-'},"
            f" finished={self.finished})"
        )

    @property
    def history(self) -> list[History]:
        """Return the metrics of the first seed, one entry for each line of its `metrics.jsonl`."""
        return read_history(self.run_dirs[0] / METRICS)

    @property
    def best(self) -> Summary:
        """Return the metrics of the first seed's best checkpoint."""
        assert self.standings[0].best is not None
        return self.standings[0].best

    @property
    def best_steps(self) -> int:
        """Return the environment steps of the first seed's best checkpoint."""
        return self.standings[0].best_steps


class Training(NamedTuple):
    """A `Training` holds the objects that a training is composed of, each built once."""

    config: Config
    run_dir: Path
    run_dirs: list[Path]
    """The folder of each seed."""
    env: JetBotEnv
    """The environment, unwrapped."""
    ppo: PPO
    """PPO over all devices; its networks are also those of the evaluations and videos."""
    programs: ProgramCache
    warm_start: WarmStart | None
    """The parameters to begin with; None: those of the seed, or the run is resumed."""
    versions: Mapping[str, Any]
    """The versions that the folders of all seeds store."""
    fallbacks: Sequence[Fallback]
    """What runs slower than it could: those that are known yet, to which others are added."""
    task_code: TaskCode | None = None
    """The source of the task that the run stores; None: it has none, or it is stored already."""
    verbose: bool = True
    """Whether to show the progress."""


def run(config: Config, run_dir: Path, *, verbose: bool = False) -> Result:
    """Train a policy in a program that imports the package, which keeps its process to itself.

    The programs are compiled, or found in JAX's own cache; `train` takes a cache that is loaded
    without tracing. SIGINT and SIGTERM stop the training as `DeferredSignals` describes.

    Args:
      config: the configuration of the run.
      run_dir: the run folder: a new one, or that of a run with this configuration.
      verbose: whether to show the progress.

    Returns:
      The result.

    Raises:
      UserError: as for `train`.
    """
    restart_clock()
    programs = ProgramCache(compiler_options(config))
    stop = DeferredSignals(config.preemption_notice)
    return train(config, run_dir, programs, stop, verbose=verbose)


def train(
    config: Config,
    run_dir: Path,
    programs: ProgramCache,
    stop: StopRequest | None = None,
    *,
    verbose: bool = True,
) -> Result:
    """Train a policy with a given cache of compiled programs.

    Args:
      config: the configuration of the run.
      run_dir: the run folder: a new one, or that of a run with this configuration.
      programs: the cache of compiled programs of this configuration. Programs that are loaded from
        disk do not contain what was replaced or patched in this package.
      stop: a context manager that hears of requests to stop; None: a command's `Preemption`.
      verbose: whether to show the progress.

    Returns:
      The result.

    Raises:
      UserError: the folder holds something else, belongs to another training or cannot be
        written; the task cannot be built; the environments cannot be divided among the devices,
        the CPU is divided otherwise, or the devices have too little memory.
    """
    if programs.loads:
        # Import what writes checkpoints meanwhile; if not, there is time while programs compile.
        from jetbot_mjx.runs import checkpoint_manager  # noqa: F401
    # Refuse what cannot be trained before anything is built.
    if jax.process_count() > 1:
        distributed.check(config)
    if jax.default_backend() == "cpu":
        config.check_cpu_devices(jax.local_device_count())
    config.check_devices(jax.device_count())
    check_tracking(config)
    stop = stop or Preemption(config.preemption_notice)
    with collect() as fallbacks:
        result = _compose(config, run_dir, programs, fallbacks, stop, verbose=verbose)
    if distributed.is_primary():
        for fallback in fallbacks:
            log_message(run_dir, f"slow: {fallback}")
    return result


def _compose(
    config: Config,
    run_dir: Path,
    programs: ProgramCache,
    fallbacks: Sequence[Fallback],
    stop: StopRequest,
    *,
    verbose: bool,
) -> Result:
    """Build every object of a training once, and train."""
    run_dirs = seed_dirs(run_dir, config)
    env, task_code = _make_env(config, run_dirs)
    ppo = ppo_trainer.build_ppo(config, env)
    warm_start = _warm_start(config, env, run_dirs)
    objects = env, ppo, programs, warm_start, versions(), fallbacks
    training = Training(config, run_dir, run_dirs, *objects, task_code, verbose)
    try:
        return _train_with_brax(training) if config.trainer == "brax" else _train(training, stop)
    except jax.errors.JaxRuntimeError as error:
        if not ran_out(error):
            raise
        smaller = advice(config, sizes(ppo, env), jax.device_count(), device_memory())
    raise UserError(smaller)


def _has_checkpoints(run_dirs: Sequence[Path]) -> bool:
    """Return whether there is a run to continue; a folder that cannot be read is refused later."""
    try:
        return any(map(checkpoint_steps, run_dirs))
    except OSError:
        return False


def _make_env(config: Config, run_dirs: Sequence[Path]) -> tuple[JetBotEnv, TaskCode | None]:
    """Build the environment, and return it with the source of its task if that is to be stored.

    A run that has checkpoints continues with the task that it was begun with. Of several processes,
    all train the task of the first one, which sends its source to those that lack it.
    """
    name, primary = config.task.name, distributed.is_primary()
    resumes = primary and _has_checkpoints(run_dirs)

    def source() -> bytes:
        code = read_task_code(run_dirs[0]) if resumes else collect_task_code(name)
        return pickle.dumps(code) if code else b""

    sent = distributed.broadcast_bytes(source) if jax.process_count() > 1 else b""
    task_class = stored_task_class(run_dirs[0], name) if resumes else None
    if sent and not primary:
        with tempfile.TemporaryDirectory() as folder:
            write_task_code(Path(folder), pickle.loads(sent))
            task_class = stored_task_class(Path(folder), name, silent=True)
    env = make_env(config, task_class=task_class)
    if name not in TRUSTED:
        require_trainable(env.task, config)
    return env, None if task_class else collect_task_code(name)


def _store_run(training: Training) -> None:
    """Write what is known before training: configuration, versions and the source of the task."""
    folders = {training.run_dir: training.config}
    if training.config.seeds > 1:
        folders |= dict(zip(training.run_dirs, training.config.of_each_seed(), strict=True))
    for folder, config in folders.items():
        write_run(folder, config, training.versions)
        if training.task_code:
            write_task_code(folder, training.task_code)


def _warm_start(config: Config, env: JetBotEnv, run_dirs: Sequence[Path]) -> WarmStart | None:
    """Load the parameters to begin with, unless the run has checkpoints of its own."""
    if config.init_from is None or _has_checkpoints(run_dirs):
        return None
    return make_warm_start(load_checkpoint(config.init_from), config, env)


def _train_with_brax(training: Training) -> Result:
    # Brax's own trainer takes half a second to import.
    from jetbot_mjx.training import brax_trainer

    config, run_dir = training.config, training.run_dir
    _check_folder(config, run_dir)
    with occupied(run_dir), CompileClock() as clock:
        _store_run(training)
        with open_recorder(training, clock, None) as recorder:
            recorder.begin(_headline(config, run_dir))
            brax_trainer.train(config, training.env, recorder)
    return _result(training, recorder, finished=True)


def _train(training: Training, stop: StopRequest) -> Result:
    config = training.config
    opened: list[tuple[RunRecorder, list[TrainState]]] = []
    with contextlib.ExitStack() as stack:
        clock = stack.enter_context(CompileClock())
        # Several processes end together, after the first checkpoint.
        if jax.process_count() == 1:
            stop.begin_compiling(
                functools.partial(stop_message, training.run_dir, training.run_dirs)
            )
        stack.enter_context(stop)
        seeds = [one.seed for one in config.of_each_seed()]
        trainer = ppo_trainer.CompiledTrainer(training.ppo, seeds, training.programs)

        def begin() -> int:
            resumption, messages = _open_folders(stack, training, trainer.template())
            recorder = stack.enter_context(open_recorder(training, clock, resumption))
            opened.append((recorder, resumption.states if resumption else []))
            if recorder.complete:
                # Of the messages, the last one would say that the training resumes.
                for line in (*messages[:-1], _complete_message(config, recorder.standings)):
                    recorder.say(line)
                return _COMPLETE
            if training.warm_start:
                messages.append(training.warm_start.describe())
            recorder.begin("\n".join([*messages, _headline(config, training.run_dir)]))
            return _RESUMES if resumption else _BEGINS

        # The first process opens the folders, and sends the others the state to resume from.
        found = distributed.run_on_primary(begin)
        recorder, stored = opened[0] if opened else (None, [])
        states = None
        if found == _RESUMES:
            states = distributed.broadcast_from_primary(stored, trainer.template(), len(seeds))
        elif found == _BEGINS and training.warm_start:
            states = [training.warm_start.apply(one) for one in trainer.get(trainer.init())]
        if found != _COMPLETE:
            callback = recorder or TrainerCallback()
            ppo_trainer.train(
                trainer,
                callback,
                stop,
                config.checkpoint_interval,
                states,
                resumes=found == _RESUMES,
            )
    # Tell the other processes whether the training came to its end.
    complete = distributed.run_on_primary(lambda: recorder is not None and recorder.complete)
    return _result(training, recorder, finished=bool(complete))


def open_recorder(
    training: Training, clock: CompileClock, resumption: Resumption | None
) -> RunRecorder:
    """Build the recorder of a training, with the evaluator, video, terminal and logs that it uses.

    Args:
      training: the objects of the training; its folders exist.
      clock: measures the time that is spent on compilation.
      resumption: the state to resume from; None: the training starts from the beginning.

    Returns:
      The recorder, which is a context manager.

    Raises:
      UserError: a folder cannot be written.
    """
    config, run_dirs, env = training.config, training.run_dirs, training.env
    # Prepare the evaluation.
    evaluate = _evaluation(training)
    networks, programs = training.ppo.networks, training.programs
    video = None
    if config.evaluation.video:
        # Only here, because it imports libraries for images that no other training needs.
        from jetbot_mjx.viewers.video import EvaluationVideo

        video = EvaluationVideo(env, networks, programs)
    # Open the terminal and the logs where the stored run ends.
    resumed = resumption or Resumption(0, [], [{} for _ in run_dirs], [])
    histories = [
        read_history(folder / METRICS, resumed.env_steps) if resumption else []
        for folder in run_dirs
    ]
    total_steps = config.ppo.training_steps * config.ppo.steps_per_training_step
    terminal = SilentTerminal(total_steps)
    if training.verbose:
        terminal = open_terminal(run_dirs, total_steps, histories)

    def say(text: str) -> None:
        log_message(training.run_dir, text)
        terminal.say(text)

    seeds = []
    for index, seed_config in enumerate(config.of_each_seed()):
        folder, history = run_dirs[index], histories[index]
        sinks = open_sinks(seed_config, folder, history, say, len(run_dirs))
        about = {
            **about_policy(seed_config, env),
            "versions": training.versions,
            "fallbacks": training.fallbacks,
        }
        standing = Standing.from_json(resumed.progress[index])
        fingerprint = digest(resumed.states[index].policy_params) if resumption else ""
        seeds.append(SeedRecorder(seed_config, folder, sinks, about, standing, fingerprint))
    return RunRecorder(config, seeds, evaluate, video, terminal, say, clock)


def _evaluation(training: Training) -> Callable[[PolicyParams], Summary]:
    """Return a function that evaluates a policy on the fixed goals of training.

    The robots vary as in training.
    """
    env, programs = training.env, training.programs
    evaluator = Evaluator(maybe_randomize(env), training.ppo.networks, programs)
    episodes = training.config.evaluation.episodes

    @functools.cache
    def keys() -> Any:
        # Compile one program; operation by operation they would be half a dozen.
        jitted = jax.jit(training_keys, static_argnums=0)
        return programs.compile(f"{episodes} keys", lambda: jitted.trace(episodes))()

    def evaluate(params: PolicyParams) -> Summary:
        # Draw the keys while XLA compiles the episodes.
        evaluator.prepare(params, episodes)
        return summarize(evaluator.run(params, keys()), env.dt)

    return evaluate


def _check_folder(config: Config, run_dir: Path) -> bool:
    """Return whether the folder holds a run, which this training may continue.

    Raises:
      UserError: it holds another run or something else, or cannot be read.
    """
    stored = stored_config(run_dir)
    if stored is not None:
        if "brax" in (stored.trainer, config.trainer):
            raise UserError(
                f"--run-dir {run_dir} is in use by a run of trainer = {stored.trainer!r}, which"
                " cannot be continued: name a new folder"
            )
        # A run that ended before its first checkpoint, for example because memory was too small,
        # may start again with another configuration.
        if stored.seeds != config.seeds or any(map(checkpoint_steps, seed_dirs(run_dir, stored))):
            try:
                stored.check_resume(config)
            except ConfigError as error:
                raise ConfigError(
                    f"{run_dir} holds another run: choose a new --run-dir, or --resume it: {error}"
                ) from None
    return stored is not None


def _open_folders(
    stack: contextlib.ExitStack, training: Training, template: TrainState
) -> tuple[Resumption | None, list[str]]:
    """Create the run folders, and lock them until the stack ends.

    Args:
      stack: the context that holds the locks.
      training: the objects of the training.
      template: shapes and dtypes of one seed's state.

    Returns:
      The state to resume from, None if there is none, and the messages to print about it.
    """
    config, run_dir, run_dirs = training.config, training.run_dir, training.run_dirs
    holds_run = _check_folder(config, run_dir)
    configs = config.of_each_seed()
    for folder in dict.fromkeys([run_dir, *run_dirs]):
        stack.enter_context(occupied(folder))
    resumption = resume(run_dirs, configs, template)
    messages = []
    if resumption:
        messages += [f"skipped: {reason}" for reason in resumption.skipped]
        # Compare the versions before those of this process replace the stored ones.
        if changes := changed_versions(run_dir):
            messages.append(f"versions changed, so the results may differ: {'; '.join(changes)}")
        messages.append(f"resuming after {resumption.env_steps:,} steps")
    elif holds_run:
        messages.append("the run has no checkpoint: starting from zero")
    _store_run(training)
    return resumption, messages


def _result(training: Training, recorder: RunRecorder | None, *, finished: bool) -> Result:
    return Result(
        run_dir=training.run_dir,
        run_dirs=training.run_dirs,
        standings=recorder.standings if recorder else [],
        fingerprints=recorder.fingerprints if recorder else [],
        finished=finished,
        wall_seconds=recorder.wall_seconds if recorder else 0.0,
    )


def _complete_message(config: Config, standings: Sequence[Standing]) -> str:
    """Return the line about a run that has nothing left to train, and how to train it further."""
    steps = min(standing.env_steps for standing in standings)
    planned = config.ppo.training_steps * config.ppo.steps_per_training_step
    setting = "ppo.num_timesteps" if steps >= planned else "stop_at_success"
    return f"complete after {steps:,} steps; raise {setting} to train further"


def _headline(config: Config, run_dir: Path) -> str:
    device = jax.devices()[0]
    hosts = f" of {jax.process_count()} processes" if jax.process_count() > 1 else ""
    seeds = f", {config.seeds} seeds at once" if config.seeds > 1 else ""
    return (
        f"training {config.task.name} ({config.robot.preset} robot,"
        f" {config.task.observation} observation) with the {config.trainer} trainer:"
        f" {config.ppo.num_timesteps:,} steps in {config.ppo.num_envs:,} environments{seeds} on"
        f" {jax.device_count()} x {device.device_kind}{hosts}\nrun folder: {run_dir}"
    )


def stop_message(run_dir: Path, run_dirs: Sequence[Path]) -> str:
    """Return the line about a training that was stopped, and write it to the log of the run.

    Args:
      run_dir: the run folder.
      run_dirs: the folder of each seed.
    """
    text = "stopped before the first checkpoint: the same command starts from the beginning"
    if all(map(checkpoint_steps, run_dirs)):
        text = f"stopped; to resume: jetbot-mjx train --resume {shlex.quote(str(run_dir))}"
    log_message(run_dir, text)
    return text


def closing_message(result: Result) -> str:
    """Return the text that a training prints at last, and write it to the log of the run."""
    if not result.finished:
        return stop_message(result.run_dir, result.run_dirs)
    text = summary(result)
    log_message(result.run_dir, text)
    return text


def summary(result: Result) -> str:
    """Return the text that is printed at the end of a training."""
    lines = []
    for standing, folder, fingerprint in zip(
        result.standings, result.run_dirs, result.fingerprints, strict=True
    ):
        assert standing.best is not None
        seed = f"{folder.name}, " if folder != result.run_dir else ""
        lines.append(
            f"{seed}best policy: {standing.best.success_rate:.1%} success at"
            f" {standing.best_steps:,} steps; last parameters: sha256 {fingerprint}"
        )
    if len(lines) > 1:
        # Its statistics take half a second to import.
        from jetbot_mjx.evaluation.bootstrap import bootstrap

        rates = [standing.best.success_rate for standing in result.standings if standing.best]
        over_seeds = bootstrap(np.mean, rates)
        lines.append(
            f"{len(lines)} seeds: {over_seeds.value:.2%} success in the mean"
            f" (95 % interval {over_seeds.low:.2%} .. {over_seeds.high:.2%})"
        )
    first = shlex.quote(str(result.run_dirs[0]))
    lines += [
        f"total {result.wall_seconds:.1f} s",
        f"next: jetbot-mjx evaluate {shlex.quote(str(result.run_dir))}",
        f"      jetbot-mjx render {first}",
        f"      jetbot-mjx play {first}",
    ]
    if importlib.util.find_spec("tensorboard") is not None:
        # TensorBoard names runs by their folder below this one.
        lines.append(f"      tensorboard --logdir {shlex.quote(str(result.run_dir.parent))}")
    return "\n".join(lines)
