"""Compose a training from its configuration: environment, networks, programs and PPO.

This module is the composition root: each object is built once, and what needs one receives it as a
required argument.
"""

import dataclasses
import functools
import tempfile
from collections.abc import Sequence
from pathlib import Path

import jax

from jetbot_mjx import envs, runs
from jetbot_mjx.agents import PPO
from jetbot_mjx.config import Config
from jetbot_mjx.envs import AdaptedEnv
from jetbot_mjx.errors import UserError
from jetbot_mjx.fallbacks import Fallback
from jetbot_mjx.runs import Setup, TaskCode, WarmStart, checkpoint_steps
from jetbot_mjx.training import distributed, ppo_trainer
from onekernel import ProgramCache


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


def compose(
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
    own_class, task_code = find_code(config, run_dirs)
    setup = Setup(config, programs, own_class=own_class)
    if isinstance(setup.env, AdaptedEnv):
        _check_targets(config, setup.env)
    elif not envs.is_built_in(config.task.name):
        envs.require_trainable(setup.env.task, config)
    if keep and not envs.is_built_in(config.code):
        # Only now it is known what the programs depend on.
        setup.programs = envs.open_program_cache(config, own=setup.env)
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


def find_code(config: Config, run_dirs: Sequence[Path]) -> tuple[type | None, TaskCode | None]:
    """Return the class of the task or the environment if the run stores it, or its source to store.

    A run that has checkpoints continues with the code that it was begun with. Of several processes,
    all train with that of the first one, which sends its source to those that lack it.
    """
    primary = distributed.is_primary()
    resumes = primary and _has_checkpoints(run_dirs)

    def source() -> TaskCode | None:
        if resumes:
            return _require_trust(run_dirs[0], config)
        return runs.collect_task_code(config.code)

    sent = distributed.broadcast_from_primary(source) if jax.process_count() > 1 else None
    own_class = None
    if resumes:
        _require_trust(run_dirs[0], config)
        own_class = runs.trusted_class(run_dirs[0], config)
    if sent and not primary:
        with tempfile.TemporaryDirectory() as folder:
            runs.write_task_code(Path(folder), sent)
            own_class = runs.stored_class(Path(folder), config.code, sent, silent=True)
    return own_class, None if own_class else runs.collect_task_code(config.code)


def _require_trust(run_dir: Path, config: Config) -> TaskCode | None:
    """Return what `runs.require_trust` does; where settings changed that must not, say that."""
    try:
        return runs.require_trust(run_dir, config)
    except UserError:
        # The options of a class are part of what is trusted: others would be untrusted code.
        stored = runs.stored_config(run_dir)
        if stored is not None and stored.seeds == config.seeds:
            runs.require_same_run(run_dir, stored, config)
        raise


def _has_checkpoints(run_dirs: Sequence[Path]) -> bool:
    """Return whether there is a run to continue."""
    return any(map(checkpoint_steps, run_dirs))
