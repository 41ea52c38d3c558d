"""Run a training, composed from its configuration, into its run folder.

`compose` builds environment, networks, programs and PPO once, and `open_recorder` builds the
evaluator, the video, the terminal and the logs. All other modules receive what they need as
required arguments.
"""

import contextlib
import functools
import shlex
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
from jaxtyping import Array, UInt32

from jetbot_mjx import envs, runs
from jetbot_mjx.agents import PolicyParams, TrainState
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
from jetbot_mjx.fallbacks import collect
from jetbot_mjx.interrupts import tell
from jetbot_mjx.runs import CompileClock, Resumption, Setup, checkpoint_steps
from jetbot_mjx.training import distributed, ppo_trainer
from jetbot_mjx.training.callbacks import TrainerCallback
from jetbot_mjx.training.composition import Training, compose
from jetbot_mjx.training.console import SilentTerminal
from jetbot_mjx.training.memory import MemoryModel, device_memory, sizes
from jetbot_mjx.training.preemption import DeferredSignals, StopRequest
from jetbot_mjx.training.result import Result, complete_message, stop_message, target_message
from jetbot_mjx.training.run_recorder import RunRecorder, SeedRecorder, Standing, open_sinks
from jetbot_mjx.training.terminal import open_terminal
from onekernel import ProgramCache


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
    # Refuse what cannot be trained before anything is built.
    if jax.process_count() > 1:
        distributed.check_processes(config)
    if jax.default_backend() == "cpu":
        config.check_cpu_devices(jax.local_device_count())
    config.check_devices(jax.device_count())
    runs.check_tracking(config)
    # Build every object once, and train.
    with collect() as fallbacks:
        training = compose(config, run_dir, programs, fallbacks, keep=keep, verbose=verbose)
        try:
            if config.trainer == "brax":
                result = _train_with_brax(training)
            else:
                result = _train(training, stop or DeferredSignals(config.preemption_notice))
        # Between several processes JAX raises the second kind as well.
        except (jax.errors.JaxRuntimeError, ValueError) as error:
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
        text = stop_message(training.run_dir, training.run_dirs)
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
                for line in (*messages[:-1], complete_message(config, recorder.standings)):
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
    total_steps = config.ppo.all_steps
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
    trained = runs.require_same_run(run_dir, stored, config)
    done = max(trained, default=0)
    planned = config.ppo.all_steps
    if planned < done and config.ppo.num_timesteps != stored.ppo.num_timesteps:
        raise ConfigError(
            f"ppo.num_timesteps = {config.ppo.num_timesteps} is fewer than the {done:,} steps that"
            f" {run_dir} has trained: choose more, or leave it out"
        )
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
    if recorder.complete:
        done = done._replace(ended_early=target_message(training.config, recorder.standings))
    env = training.setup.env
    if not isinstance(env, AdaptedEnv):
        return done
    return done._replace(next_commands=["evaluate", "export"] + ["render"] * bool(env.mj_model))


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
    wanted, steps = config.ppo.num_timesteps, config.ppo.all_steps
    rounded = f" ({wanted:,} rounded up to whole training steps)" if steps != wanted else ""
    return (
        f"training {what} with the {config.trainer} trainer:"
        f" {steps:,} steps{rounded} in {config.ppo.num_envs:,} environments{seeds} on"
        f" {jax.device_count()} x {device.device_kind}{hosts}\nrun folder: {training.run_dir}"
        f"{hints}"
    )
