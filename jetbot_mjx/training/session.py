"""A training from its configuration to its run folder, and what there is to say of it."""

import contextlib
from pathlib import Path
from typing import NamedTuple

import jax

from jetbot_mjx.compiler.program_cache import ProgramCache
from jetbot_mjx.config import Config
from jetbot_mjx.envs.jetbot_env import JetBotEnv, make_env
from jetbot_mjx.envs.program_key import open_program_cache
from jetbot_mjx.errors import UserError, ran_out
from jetbot_mjx.evaluation.evaluator import Summary
from jetbot_mjx.runs.checkpoint_store import checkpoint_steps
from jetbot_mjx.runs.metrics import CompileClock
from jetbot_mjx.runs.resume import Resumption, resume
from jetbot_mjx.runs.run_dir import (
    changed_versions,
    occupied,
    seed_dirs,
    stored_config,
    write_run,
)
from jetbot_mjx.runs.wandb_sink import check_tracking
from jetbot_mjx.training import distributed, ppo_trainer
from jetbot_mjx.training.callbacks import TrainerCallback
from jetbot_mjx.training.memory import advice, device_memory
from jetbot_mjx.training.preemption import Preemption
from jetbot_mjx.training.run_recorder import RunRecorder, Standing

_COMPLETE, _BEGINS, _RESUMES = range(3)
"""How a training finds its folder."""


class Result(NamedTuple):
    """The result of a training; of several processes only the first has all of it."""

    run_dir: Path
    run_dirs: list[Path]
    """The folder of each seed; of a single one, the run folder."""
    standings: list[Standing]
    """How far each seed has come; empty in all processes but the first."""
    fingerprints: list[str]
    """SHA-256 of each seed's last parameters; the same seed gives the same. Empty likewise."""
    finished: bool
    """Whether it came to its end; otherwise the same command goes on."""
    wall_seconds: float
    """In all processes together."""

    @property
    def best(self) -> Summary:
        """Return metrics of the best checkpoint, of the first seed."""
        assert self.standings[0].best is not None
        return self.standings[0].best

    @property
    def best_steps(self) -> int:
        """Environment steps of the best checkpoint, of the first seed."""
        return self.standings[0].best_steps


def run(config: Config, run_dir: Path, programs: ProgramCache | None = None) -> Result:
    """Train a policy, from the beginning or from where the folder's run was stopped.

    Args:
      config: the run.
      run_dir: the run folder: a new one, or that of a run with this configuration.
      programs: of that configuration; None: they are compiled, or found in JAX's own cache. Those
        that are kept know nothing of what was replaced or patched in this package.

    Returns:
      Where it lies and how good it became.

    Raises:
      UserError: the folder holds something else, belongs to another training or cannot be
        written; the task cannot be built; the devices cannot share the environments, or their
        memory does not suffice.
    """
    if jax.process_count() > 1:
        distributed.check(config)
    config.check_devices(jax.device_count())
    check_tracking(config)
    env = make_env(config)
    programs = programs or open_program_cache(config, keep=False)
    try:
        if config.trainer == "brax":
            return _run_brax(config, env, run_dir, programs)
        return _run_resumable(config, env, run_dir, programs)
    except jax.errors.JaxRuntimeError as error:
        if not ran_out(error):
            raise
        told = advice(config, env, jax.device_count(), device_memory())
    raise UserError(told)


def _check_folder(config: Config, run_dir: Path) -> None:
    stored = stored_config(run_dir)
    if stored is not None:
        if "brax" in (stored.trainer, config.trainer):
            raise UserError(
                f"--run-dir {run_dir} is in use by a run of trainer = {stored.trainer!r}, which"
                " cannot be continued: name a new folder"
            )
        # What ended before its first checkpoint, such as for lack of memory, may begin as another.
        if stored.seeds != config.seeds or any(map(checkpoint_steps, seed_dirs(run_dir, stored))):
            stored.check_resume(config)


def _run_brax(config: Config, env: JetBotEnv, run_dir: Path, programs: ProgramCache) -> Result:
    # Brax's own trainer takes half a second to import.
    from jetbot_mjx.training import brax_trainer

    _check_folder(config, run_dir)
    with occupied(run_dir), CompileClock() as clock:
        write_run(run_dir, config)
        with RunRecorder(config, env, [run_dir], clock, programs=programs) as recorder:
            recorder.begin(_headline(config, run_dir))
            brax_trainer.train(config, env, recorder)
    return _result(run_dir, [run_dir], recorder, finished=True)


def _run_resumable(config: Config, env: JetBotEnv, run_dir: Path, programs: ProgramCache) -> Result:
    opened: list[tuple[RunRecorder, Resumption | None]] = []
    with contextlib.ExitStack() as stack:
        clock = stack.enter_context(CompileClock())
        preemption = stack.enter_context(Preemption(config.preemption_notice))
        program = ppo_trainer.CompiledTrainer(config, env, programs)

        def begin() -> int:
            resumption, welcome = _open_folders(stack, config, run_dir, program)
            run_dirs = seed_dirs(run_dir, config)
            recorder = RunRecorder(config, env, run_dirs, clock, resumption, programs)
            opened.append((stack.enter_context(recorder), resumption))
            if recorder.complete:
                recorder.say(*welcome)
                return _COMPLETE
            recorder.begin("\n".join([*welcome, _headline(config, run_dir)]))
            return _RESUMES if resumption else _BEGINS

        outset = distributed.run_on_primary(begin)
        recorder, resumption = opened[0] if opened else (TrainerCallback(), None)
        states = None
        if outset == _RESUMES:
            stored = resumption.states if resumption else []
            states = distributed.broadcast_from_primary(stored, program.template(), config.seeds)
        if outset != _COMPLETE:
            ppo_trainer.train(config, program, recorder, preemption, states)
    first = recorder if isinstance(recorder, RunRecorder) else None
    finished = bool(distributed.run_on_primary(lambda: first is not None and first.complete))
    return _result(run_dir, seed_dirs(run_dir, config), first, finished=finished)


def _open_folders(
    stack: contextlib.ExitStack, config: Config, run_dir: Path, program: ppo_trainer.CompiledTrainer
) -> tuple[Resumption | None, list[str]]:
    """Make the folders, and holds them until the stack ends.

    Returns:
      Where the seeds stand, and what there is to say of it.
    """
    _check_folder(config, run_dir)
    run_dirs, configs = seed_dirs(run_dir, config), config.of_each_seed()
    for folder in dict.fromkeys([run_dir, *run_dirs]):
        stack.enter_context(occupied(folder))
    resumption = resume(run_dirs, configs, program.template())
    # Before this run's versions take the place of the stored ones.
    welcome = [_welcome_back(run_dir, resumption)] if resumption else []
    write_run(run_dir, config)
    if config.seeds > 1:
        for seed_dir, seed_config in zip(run_dirs, configs, strict=True):
            write_run(seed_dir, seed_config)
    return resumption, welcome


def _result(
    run_dir: Path, run_dirs: list[Path], recorder: RunRecorder | None, *, finished: bool
) -> Result:
    return Result(
        run_dir=run_dir,
        run_dirs=run_dirs,
        standings=recorder.standings if recorder else [],
        fingerprints=recorder.fingerprints if recorder else [],
        finished=finished,
        wall_seconds=recorder.wall_seconds if recorder else 0.0,
    )


def _welcome_back(run_dir: Path, resumption: Resumption) -> str:
    lines = [f"skipped: {reason}" for reason in resumption.skipped]
    if changes := changed_versions(run_dir):
        lines.append(f"not as it was, so the bits may differ: {'; '.join(changes)}")
    lines.append(f"going on after {resumption.env_steps:,} steps")
    return "\n".join(lines)


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
        from jetbot_mjx.evaluation.bootstrap import bootstrap, mean

        rates = [standing.best.success_rate for standing in result.standings if standing.best]
        over_seeds = bootstrap(mean, rates)
        lines.append(
            f"{len(lines)} seeds: {over_seeds.value:.2%} success in the mean"
            f" (95 % interval {over_seeds.low:.2%} .. {over_seeds.high:.2%})"
        )
    lines += [
        f"{result.wall_seconds:.1f} s in all",
        f"next: python -m jetbot_mjx.evaluate {result.run_dir}",
        f"      python -m jetbot_mjx.render {result.run_dirs[0]}",
        f"      tensorboard --logdir {result.run_dir}",
    ]
    return "\n".join(lines)
