"""Compose a training from its configuration and run it into its run folder.

This module is the composition root: `run` builds environment, networks, programs and PPO once, and
`open_recorder` builds the evaluator, the video, the terminal and the logs. All other modules
receive what they need as required arguments.
"""

import contextlib
import dataclasses
import functools
import importlib.util
import shlex
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, UInt32

from jetbot_mjx import envs, runs
from jetbot_mjx.agents import PPO, PolicyParams, TrainState
from jetbot_mjx.config import Config, ConfigError
from jetbot_mjx.envs import AdaptedEnv
from jetbot_mjx.errors import UserError, lost_device, ran_out
from jetbot_mjx.evaluation import (
    Evaluator,
    ReturnEvaluator,
    ReturnSummary,
    Summary,
    summarize,
    summarize_returns,
    training_keys,
)
from jetbot_mjx.fallbacks import Fallback, collect
from jetbot_mjx.interrupts import tell
from jetbot_mjx.runs import CompileClock, Resumption, Setup, TaskCode, WarmStart, checkpoint_steps
from jetbot_mjx.training import distributed, ppo_trainer
from jetbot_mjx.training.callbacks import TrainerCallback
from jetbot_mjx.training.console import SilentTerminal
from jetbot_mjx.training.memory import MemoryModel, device_memory, sizes
from jetbot_mjx.training.preemption import DeferredSignals, StopRequest
from jetbot_mjx.training.run_recorder import RunRecorder, SeedRecorder, Standing, open_sinks
from jetbot_mjx.training.terminal import open_terminal
from onekernel import ProgramCache


class Result(NamedTuple):
    """A `Result` holds the result of a training; of several processes only the first has it all."""

    run_dir: Path
    run_dirs: Sequence[Path]
    """The folder of each seed, which is the run folder if there is only one seed."""
    standings: list[Standing]
    """The progress of each seed; empty in all processes but the first."""
    fingerprints: list[str]
    """SHA-256 of each seed's last parameters, which are the same for the same seed; empty in all
    processes but the first."""
    finished: bool
    """Whether the training came to its end; otherwise the same command resumes it."""
    wall_seconds: float
    """Time spent on the training, in all processes [s]."""
    next_commands: Sequence[str] = ("evaluate", "render", "play")
    """Commands for its policies, the first of which takes several seeds."""

    def __repr__(self) -> str:
        """Return the folder and the best evaluation of each seed in one line."""
        scores = [told_score(one.best) if one.best else "-" for one in self.standings]
        return (
            f"Result(run_dir={str(self.run_dir)!r}, best={', '.join(scores) or '-'},"
            f" finished={self.finished})"
        )

    @property
    def history(self) -> list[runs.History]:
        """Return the metrics of the first seed, one entry for each line of its `metrics.jsonl`."""
        return runs.read_history(self.run_dirs[0] / runs.METRICS)

    @property
    def best(self) -> Summary | ReturnSummary:
        """Return the metrics of the first seed's best checkpoint."""
        assert self.standings[0].best is not None
        return self.standings[0].best

    @property
    def best_steps(self) -> int:
        """Return the environment steps of the first seed's best checkpoint."""
        return self.standings[0].best_steps


@dataclasses.dataclass(frozen=True, kw_only=True)
class Training:
    """A `Training` holds the objects that a training is composed of, each built once."""

    setup: Setup
    """Configuration, environment, networks and programs, also those of evaluations and videos."""
    run_dir: Path
    run_dirs: Sequence[Path]
    """The folder of each seed."""
    ppo: PPO
    """PPO over all devices."""
    warm_start: WarmStart | None = None
    """The parameters to begin with; None: those of the seed, or the run is resumed."""
    fallbacks: Sequence[Fallback] = ()
    """Parts that run slower than they could; others are added while programs are traced."""
    task_code: TaskCode | None = None
    """The source of the task that the run stores; None: it has none, or it is stored already."""
    hints: Sequence[str] = ()
    """Settings without which a robot of a user's own may not learn."""
    verbose: bool = True
    """Whether to show the progress."""

    @property
    def config(self) -> Config:
        """Return the configuration of the run."""
        return self.setup.config

    @functools.cached_property
    def versions(self) -> runs.JsonObject:
        """Return the versions that the folders of all seeds store."""
        return runs.versions()


def run(
    config: Config,
    run_dir: Path,
    programs: ProgramCache | None = None,
    stop: StopRequest | None = None,
    *,
    verbose: bool = False,
) -> Result:
    """Train a policy, from the beginning or from where the run in the folder was stopped.

    Args:
      config: the configuration of the run.
      run_dir: the run folder: a new one, or that of a run with this configuration.
      programs: the cache of compiled programs of this configuration. Programs that are loaded from
        disk do not contain what was replaced or patched in this package. None: all programs are
        traced, and compiled or found in JAX's own cache.
      stop: a context manager that receives requests to stop; None: `DeferredSignals`, which leaves
        the process to the program that imports the package.
      verbose: whether to show the progress.

    Returns:
      The result.

    Raises:
      UserError: the folder holds something else, belongs to another training or cannot be
        written; the task cannot be built; the environments cannot be divided among the devices,
        the CPU is divided otherwise, or the devices have too little memory.
    """
    keep = programs is not None
    if programs is None:
        programs = envs.open_program_cache(config, keep=False)
    if programs.loads:
        # Import what writes checkpoints meanwhile; if not, there is time while programs compile.
        from jetbot_mjx.runs import open_manager  # noqa: F401
    # Refuse what cannot be trained before anything is built.
    if jax.process_count() > 1:
        distributed.check_processes(config)
    if jax.default_backend() == "cpu":
        config.check_cpu_devices(jax.local_device_count())
    config.check_devices(jax.device_count())
    runs.check_tracking(config)
    # Build every object once, and train.
    with collect() as fallbacks:
        training = _compose(config, run_dir, programs, fallbacks, keep=keep, verbose=verbose)
        try:
            if config.trainer == "brax":
                result = _train_with_brax(training)
            else:
                result = _train(training, stop or DeferredSignals(config.preemption_notice))
        except jax.errors.JaxRuntimeError as error:
            if not (line := _explain(error, training)):
                raise
            raise UserError(line) from None
    if distributed.is_primary():
        for fallback in fallbacks:
            runs.log_message(run_dir, f"slow: {fallback}")
    return result


def _explain(error: Exception, training: Training) -> str:
    """Return one line about a device that failed or is too small; nothing about other errors."""
    if ran_out(error):
        each = sizes(training.ppo, training.setup.env)
        model = MemoryModel(training.config, each, jax.device_count())
        return model.advice(device_memory())
    if not (reason := lost_device(error)):
        return ""
    run_dir, folders = training.run_dir, training.run_dirs
    saved = min((checkpoint_steps(one) or [-1])[-1] for one in folders)
    if saved < 0:
        return f"the device failed, and nothing was saved yet: {reason}"
    return (
        f"the device failed: {reason}: the training is saved after {saved:,} steps:"
        f" `jetbot-mjx train --resume {shlex.quote(str(run_dir))}` continues it from there"
    )


def _compose(
    config: Config,
    run_dir: Path,
    programs: ProgramCache,
    fallbacks: Sequence[Fallback],
    *,
    keep: bool,
    verbose: bool,
) -> Training:
    """Build every object of a training once."""
    run_dirs = runs.seed_dirs(run_dir, config)
    own_class, task_code = _find_code(config, run_dirs)
    setup = Setup(config, programs, own_class=own_class)
    if isinstance(setup.env, AdaptedEnv):
        _check_targets(config, setup.env)
    elif not envs.is_built_in(config.task.name):
        envs.require_trainable(setup.env.task, config)
    if keep and not envs.is_built_in(config.code):
        # Only now it is known what the programs depend on.
        setup.programs = envs.open_program_cache(config, own=envs.own_fingerprint(setup.env))
    if isinstance(setup.env, AdaptedEnv) and not setup.programs.has("advance"):
        # What was trained before has passed it.
        envs.require_sound(setup.env)
    hints = [] if isinstance(setup.env, AdaptedEnv) else envs.training_hints(setup.env)
    ppo = ppo_trainer.build_ppo(setup)
    # Another run's policy is loaded only for a run without checkpoints of its own.
    warm_start = None
    if config.init_from is not None and not _has_checkpoints(run_dirs):
        warm_start = runs.make_warm_start(runs.load_checkpoint(config.init_from), setup)
    return Training(
        setup=setup,
        run_dir=run_dir,
        run_dirs=run_dirs,
        ppo=ppo,
        warm_start=warm_start,
        fallbacks=fallbacks,
        task_code=task_code,
        hints=hints,
        verbose=verbose,
    )


def _has_checkpoints(run_dirs: Sequence[Path]) -> bool:
    """Return whether there is a run to continue; a folder that cannot be read is refused later."""
    try:
        return any(map(checkpoint_steps, run_dirs))
    except OSError:
        return False


def _check_targets(config: Config, env: AdaptedEnv) -> None:
    """Raise an error if a training cannot end, or show itself, as it is told to."""
    if config.stop_at_success is not None and not env.has_success:
        raise UserError(
            f"stop_at_success = {config.stop_at_success}: environment = {config.environment!r} has"
            " no metric 'success': use stop_at_return, or leave it out"
        )
    if config.evaluation.video and env.mj_model is None:
        raise UserError(
            f"evaluation.video = {config.evaluation.video!r}: environment = {config.environment!r}"
            " has no `mj_model`, or its state no `qpos`: leave it out"
        )


def _find_code(config: Config, run_dirs: Sequence[Path]) -> tuple[type | None, TaskCode | None]:
    """Return the class of the task or the environment if the run stores it, or its source to store.

    A run that has checkpoints continues with the code that it was begun with. Of several processes,
    all train with that of the first one, which sends its source to those that lack it.
    """
    primary = distributed.is_primary()
    resumes = primary and _has_checkpoints(run_dirs)

    def source() -> TaskCode | None:
        if resumes:
            return runs.require_trust(run_dirs[0], config)
        return runs.collect_task_code(config.code)

    sent = distributed.broadcast_from_primary(source) if jax.process_count() > 1 else None
    own_class = runs.trusted_class(run_dirs[0], config) if resumes else None
    if sent and not primary:
        with tempfile.TemporaryDirectory() as folder:
            runs.write_task_code(Path(folder), sent)
            own_class = runs.stored_class(Path(folder), config.code, sent, silent=True)
    return own_class, None if own_class else runs.collect_task_code(config.code)


def _store_run(training: Training) -> None:
    """Write what is known before training: configuration, versions and the source of the task."""
    runs.record_code(training.run_dir, training.config, training.task_code)
    folders = {training.run_dir: training.config}
    if training.config.seeds > 1:
        folders |= dict(zip(training.run_dirs, training.config.of_each_seed(), strict=True))
    for folder, config in folders.items():
        runs.write_run(folder, config, training.versions)
        if training.task_code:
            runs.write_task_code(folder, training.task_code)


def _train_with_brax(training: Training) -> Result:
    """Train with Brax's own trainer, which cannot resume."""
    # It takes half a second to import.
    from jetbot_mjx.training import brax_trainer

    _check_folder(training)
    runs.check_links(training.run_dir)
    with runs.occupied(training.run_dir), CompileClock() as clock:
        _store_run(training)
        with open_recorder(training, clock, None) as recorder:
            recorder.begin(_headline(training))
            brax_trainer.train(training.setup, recorder)
    return _result(training, recorder, finished=True)


def _train(training: Training, stop: StopRequest) -> Result:
    """Train with the resumable trainer, in all processes."""
    config = training.config
    recorder: RunRecorder | None = None

    def say_stopped() -> None:
        text = stop_message(training)
        runs.log_message(training.run_dir, text)
        tell(text)

    with contextlib.ExitStack() as stack:
        clock = stack.enter_context(CompileClock())
        # Several processes end together, after the first checkpoint.
        if jax.process_count() == 1:
            stop.compiling = say_stopped
        stack.enter_context(stop)
        seeds = [one.seed for one in config.of_each_seed()]
        trainer = ppo_trainer.CompiledTrainer(training.ppo, seeds, training.setup.programs)

        template = trainer.template()

        def begin() -> tuple[bool, list[list[np.ndarray]]]:
            """Return whether the run is complete, and the arrays of the states to resume from."""
            nonlocal recorder
            resumption, messages = _open_folders(stack, training, template)
            recorder = stack.enter_context(open_recorder(training, clock, resumption))
            if recorder.complete:
                # Leave out the last message, which would say that the training resumes.
                for line in (*messages[:-1], _complete_message(config, recorder.standings)):
                    recorder.say(line)
                return True, []
            if training.warm_start:
                messages.append(training.warm_start.describe())
            recorder.begin("\n".join([*messages, _headline(training)]))
            return False, [jax.tree.leaves(one) for one in resumption.states] if resumption else []

        # The first process opens the folders, and sends the others the state to resume from.
        complete, stored = distributed.broadcast_from_primary(begin)
        states = [jax.tree.unflatten(jax.tree.structure(template), leaves) for leaves in stored]
        if not complete:
            if training.warm_start and not stored:
                states = [training.warm_start.apply(one) for one in trainer.get(trainer.init())]
            callback, interval = recorder or TrainerCallback(), config.checkpoint_interval
            resumes = bool(stored)
            ppo_trainer.train(trainer, callback, stop, interval, states or None, resumes=resumes)
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
    config, run_dirs = training.config, training.run_dirs
    # Prepare the evaluation and its video.
    evaluate = _evaluation(training.setup)
    video = None
    if config.evaluation.video:
        # Only here, because it imports libraries for images that no other training needs.
        from jetbot_mjx.viewers import EnvironmentVideo, EvaluationVideo

        is_own = isinstance(training.setup.env, AdaptedEnv)
        video = (EnvironmentVideo if is_own else EvaluationVideo)(training.setup)
    # Open the terminal and the logs where the stored run ends.
    resumed = resumption or Resumption(0, [], [{} for _ in run_dirs], [])
    histories = [
        runs.read_history(folder / runs.METRICS, resumed.env_steps) if resumption else []
        for folder in run_dirs
    ]
    total_steps = config.ppo.training_steps * config.ppo.steps_per_training_step
    terminal = SilentTerminal(total_steps)
    if training.verbose:
        terminal = open_terminal(run_dirs, total_steps, histories)

    def say(text: str) -> None:
        runs.log_message(training.run_dir, text)
        terminal.say(text)

    # Build the recorder of each seed.
    seeds = []
    for index, seed_config in enumerate(config.of_each_seed()):
        folder, history = run_dirs[index], histories[index]
        standing = Standing.from_json(resumed.progress[index], folder)
        sinks = open_sinks(seed_config, folder, history, say, len(run_dirs))
        about = {
            **runs.about_policy(seed_config, training.setup.env),
            "versions": training.versions,
            "fallbacks": training.fallbacks,
        }
        fingerprint = runs.digest(resumed.states[index].policy_params) if resumption else ""
        seeds.append(SeedRecorder(seed_config, folder, sinks, about, standing, fingerprint))
    return RunRecorder(config, seeds, evaluate, video, terminal, say, clock)


def _evaluation(setup: Setup) -> Callable[[PolicyParams], Summary | ReturnSummary]:
    """Return a function that evaluates a policy on the fixed goals or starts of training.

    The robots vary as in training.
    """
    programs, episodes = setup.programs, setup.config.evaluation.episodes
    evaluator, summary_of = _evaluator(setup)

    @functools.cache
    def keys() -> UInt32[Array, "n 2"]:
        # Compile one program; operation by operation they would be half a dozen.
        jitted = jax.jit(training_keys, static_argnums=0)
        return programs.compile(f"{episodes} keys", lambda: jitted.trace(episodes))()

    def evaluate(params: PolicyParams) -> Summary | ReturnSummary:
        # Draw the keys while XLA compiles the episodes.
        evaluator.prepare(params, episodes)
        return summary_of(evaluator.run(params, keys()))

    return evaluate


def _evaluator(
    setup: Setup,
) -> tuple[Evaluator | ReturnEvaluator, Callable[..., Summary | ReturnSummary]]:
    """Return what runs the episodes of a setup, and what summarises them."""
    env = setup.env
    if isinstance(env, AdaptedEnv):
        evaluator = ReturnEvaluator(env, setup.networks, setup.programs)
        return evaluator, functools.partial(summarize_returns, has_success=env.has_success)
    evaluator = Evaluator(envs.maybe_randomize(env), setup.networks, setup.programs)
    return evaluator, functools.partial(summarize, ctrl_dt=env.dt)


def _check_folder(training: Training) -> bool:
    """Return whether the folder holds a run, which this training may continue.

    Raises:
      UserError: it holds another run or something else, or cannot be read.
    """
    config, run_dir = training.config, training.run_dir
    stored = runs.stored_config(run_dir)
    if stored is None:
        return False
    if "brax" in (stored.trainer, config.trainer):
        raise UserError(
            f"--run-dir {run_dir} is in use by a run of trainer = {stored.trainer!r}, which cannot"
            " be continued: name a new folder"
        )
    # A run that ended before its first checkpoint, for example because memory was too small, may
    # start again with another configuration.
    if stored.seeds != config.seeds or any(map(checkpoint_steps, runs.seed_dirs(run_dir, stored))):
        try:
            stored.check_resume(config)
        except ConfigError as error:
            raise ConfigError(
                f"{run_dir} holds another run: choose a new --run-dir, or --resume it: {error}"
            ) from None
    return True


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
    run_dir, run_dirs = training.run_dir, training.run_dirs
    holds_run = _check_folder(training)
    runs.check_links(run_dir)
    for folder in dict.fromkeys([run_dir, *run_dirs]):
        stack.enter_context(runs.occupied(folder))
    resumption = runs.resume(run_dirs, training.config.of_each_seed(), template)
    messages = []
    if resumption:
        messages += [f"skipped: {reason}" for reason in resumption.skipped]
        # Compare the versions before those of this process replace the stored ones.
        if changes := runs.changed_versions(run_dir):
            messages.append(f"versions changed, so the results may differ: {'; '.join(changes)}")
        messages.append(f"resuming after {resumption.env_steps:,} steps")
    elif holds_run:
        messages.append("the run has no checkpoint: starting from zero")
    _store_run(training)
    return resumption, messages


def _result(training: Training, recorder: RunRecorder | None, *, finished: bool) -> Result:
    folders = training.run_dir, training.run_dirs
    if recorder is None:
        return Result(*folders, [], [], finished, 0.0)
    fingerprints = [seed.fingerprint for seed in recorder.seeds]
    done = Result(*folders, recorder.standings, fingerprints, finished, recorder.wall_seconds)
    env = training.setup.env
    if not isinstance(env, AdaptedEnv):
        return done
    return done._replace(next_commands=["evaluate", "export"] + ["render"] * bool(env.mj_model))


def _complete_message(config: Config, standings: Sequence[Standing]) -> str:
    """Return the line about a run that has nothing left to train, and how to train it further."""
    steps = min(standing.env_steps for standing in standings)
    planned = config.ppo.training_steps * config.ppo.steps_per_training_step
    setting = "ppo.num_timesteps"
    if steps < planned:
        setting = "stop_at_success" if config.stop_at_return is None else "stop_at_return"
    return f"complete after {steps:,} steps; raise {setting} to train further"


def _headline(training: Training) -> str:
    config, device = training.config, jax.devices()[0]
    hosts = f" of {jax.process_count()} processes" if jax.process_count() > 1 else ""
    seeds = f", {config.seeds} seeds at once" if config.seeds > 1 else ""
    env = training.setup.env
    if isinstance(env, AdaptedEnv):
        actions = "choices" if env.is_discrete else "actions"
        what = f"{config.code} ({env.observation_size} observations, {env.action_size} {actions})"
    else:
        robot, *measures = config.robot.label.partition(" with ")
        what = (
            f"{config.task.name} ({robot} robot{''.join(measures)},"
            f" {config.task.observation} observation)"
        )
    hints = "".join(f"\nhint: {one}" for one in training.hints)
    return (
        f"training {what} with the {config.trainer} trainer:"
        f" {config.ppo.num_timesteps:,} steps in {config.ppo.num_envs:,} environments{seeds} on"
        f" {jax.device_count()} x {device.device_kind}{hosts}\nrun folder: {training.run_dir}"
        f"{hints}"
    )


def told_score(best: Summary | ReturnSummary) -> str:
    """Return in words the number by which the best checkpoint was found."""
    if best.success_rate is None:
        return f"return {best.episode_return:.1f}"
    return f"{best.success_rate:.1%} success"


def stop_message(run: Training | Result) -> str:
    """Return the line about a training that was stopped."""
    if not all(map(checkpoint_steps, run.run_dirs)):
        return "stopped before the first checkpoint: the same command starts from the beginning"
    return f"stopped; to resume: jetbot-mjx train --resume {shlex.quote(str(run.run_dir))}"


def closing_message(result: Result) -> str:
    """Return the text that a training prints at last."""
    return summary(result) if result.finished else stop_message(result)


def summary(result: Result) -> str:
    """Return the text that is printed at the end of a training."""
    lines = []
    for standing, folder, fingerprint in zip(
        result.standings, result.run_dirs, result.fingerprints, strict=True
    ):
        assert standing.best is not None
        seed = f"{folder.name}, " if folder != result.run_dir else ""
        lines.append(
            f"{seed}best policy: {told_score(standing.best)} at"
            f" {standing.best_steps:,} steps; last parameters: sha256 {fingerprint}"
        )
    if len(lines) > 1:
        # Its statistics take half a second to import.
        from jetbot_mjx.evaluation import bootstrap

        best = [standing.best for standing in result.standings if standing.best]
        form = "{:.2%}" if best[0].success_rate is not None else "{:.1f}"
        over_seeds = bootstrap(np.mean, [one.score for one in best])
        value, low, high = map(form.format, (over_seeds.value, over_seeds.low, over_seeds.high))
        what = "success" if best[0].success_rate is not None else "return"
        lines.append(
            f"{len(lines)} seeds: {value} {what} in the mean (95 % interval {low} .. {high})"
        )
    first = shlex.quote(str(result.run_dirs[0]))
    lines += [
        f"total {result.wall_seconds:.1f} s",
        f"next: jetbot-mjx {result.next_commands[0]} {shlex.quote(str(result.run_dir))}",
        *(f"      jetbot-mjx {command} {first}" for command in result.next_commands[1:]),
    ]
    if importlib.util.find_spec("tensorboard") is not None:
        # TensorBoard names runs by their folder below this one.
        lines.append(f"      tensorboard --logdir {shlex.quote(str(result.run_dir.parent))}")
    return "\n".join(lines)
