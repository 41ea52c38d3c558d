"""Save the complete state of a training in checkpoints and restore the newest usable one.

A checkpoint of the resumable trainer holds two trees: the policy, and `training`, the rest of
`ppo.TrainState`. A checkpoint is skipped if a name, a shape, a dtype or a bit changed after it was
written, or if it was written under another configuration.
"""

import json
import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import PyTree

from jetbot_mjx.agents import TALLIED, PolicyParams, TrainState
from jetbot_mjx.config import Config, ConfigError, parse_config
from jetbot_mjx.errors import clipped
from jetbot_mjx.runs import checkpoint_store
from jetbot_mjx.runs.checkpoint import POLICY, explanation
from jetbot_mjx.runs.checkpoint_store import CheckpointError, checkpoint_path
from jetbot_mjx.runs.run_dir import CONFIG, JsonObject, seed_dirs

TRAINING = "training"
"""Name of the tree that holds the part of the state that acting does not need."""

_REST = ("optimizer_state", "env_state", "key", "env_steps")


class Resumption(NamedTuple):
    """A `Resumption` holds the restored state of every seed of a run."""

    env_steps: int
    states: list[TrainState]
    progress: list[JsonObject]
    """The progress that the recorder of each seed stored in its checkpoint."""
    skipped: list[str]
    """Error messages of the newer checkpoints that were skipped."""


def to_trees(state: TrainState) -> dict[str, PyTree]:
    """Return a training state as the trees of a checkpoint, with its sums by name."""
    rest = {name: getattr(state, name) for name in _REST}
    return {POLICY: state.policy_params, TRAINING: {**rest, "tally": state.sums}}


def check_resumed(run_dir: Path, stored: Config, config: Config) -> None:
    """Raise an error if a run that has trained is to be continued with settings that are fixed.

    A run that ended before its first checkpoint may start again with others.

    Args:
      run_dir: the run folder.
      stored: its configuration.
      config: the configuration to continue it with.

    Raises:
      ConfigError: a setting changed that must not. The message names it, and the command of another
        run that begins with the policy.
    """
    if stored.seeds == config.seeds and not trained_steps(run_dir, stored):
        return
    changes = stored.fixed_changes(config)
    # The command names another policy to begin with.
    settings = [
        f"--set={key}={json.dumps(now)}"
        for key, (_, now) in stored.changes(config).items()
        if key != "init_from"
    ]
    command = ["jetbot-mjx", "train", str(run_dir / CONFIG), "--init-from", str(run_dir), *settings]
    try:
        stored.check_resume(config)
    except ConfigError as error:
        raise ConfigError(
            f"{error}: leave {clipped(', '.join(changes))} out, or begin another run with this"
            f" one's policy: `{shlex.join([*command, '--run-dir', 'NEW'])}`"
        ) from None


def require_same_run(run_dir: Path, stored: Config, config: Config) -> list[int]:
    """Raise an error if a folder holds a run that a configuration cannot continue.

    A run that ended before its first checkpoint, for example because memory was too small, may
    start again with another configuration.

    Args:
      run_dir: the run folder.
      stored: its configuration.
      config: the configuration of the training.

    Returns:
      As `trained_steps`.

    Raises:
      ConfigError: a setting changed that must not.
    """
    trained = trained_steps(run_dir, stored)
    if stored.seeds != config.seeds or trained:
        try:
            stored.check_resume(config)
        except ConfigError as error:
            raise ConfigError(
                f"{run_dir} holds another run: choose a new --run-dir, or begin with its policy,"
                f" --init-from {run_dir}: {error}"
            ) from None
    return trained


def trained_steps(run_dir: Path, stored: Config) -> list[int]:
    """Return the last environment step of every seed of a run that has a checkpoint.

    Args:
      run_dir: the run folder.
      stored: its configuration.
    """
    found = [checkpoint_store.checkpoint_steps(each) for each in seed_dirs(run_dir, stored)]
    return [steps[-1] for steps in found if steps]


def resume(
    run_dirs: Sequence[Path], configs: Sequence[Config], template: TrainState
) -> Resumption | None:
    """Read the newest checkpoint that is usable in the folder of every seed.

    Newer checkpoints are then moved to `set_aside/` in the run folder; nothing is deleted.

    Args:
      run_dirs: the run folder of each seed.
      configs: the configuration of each seed.
      template: the shapes and dtypes of a training state.

    Returns:
      The restored state of each seed; None if there is no checkpoint at all.

    Raises:
      CheckpointError: there are checkpoints, but none of them can be used. No file is changed.
      UnreadableError: the drive does not answer. No file is changed.
    """
    # Try the steps from the newest to the oldest, until all seeds can be read at one of them.
    known = sorted(
        {step for run_dir in run_dirs for step in checkpoint_store.checkpoint_steps(run_dir)}
    )
    skipped: list[str] = []
    for step in reversed(known):
        try:
            found = [
                _read(checkpoint_path(run_dir, step), config, template)
                for run_dir, config in zip(run_dirs, configs, strict=True)
            ]
        except CheckpointError as error:
            skipped.append(str(error))
            continue
        # Move newer checkpoints away, so that the resumed training can write its own.
        for run_dir in run_dirs:
            for newer in checkpoint_store.checkpoint_steps(run_dir):
                if newer > step:
                    checkpoint_store.set_aside(checkpoint_path(run_dir, newer))
        states, progress = zip(*found, strict=True)
        return Resumption(step, list(states), list(progress), skipped)
    if not known:
        return None
    raise CheckpointError(
        f"no checkpoint in {run_dirs[0] / checkpoint_store.FOLDER} can be used. The newest:"
        f" {skipped[0]}. Train into a new folder"
    )


def _read(path: Path, config: Config, template: TrainState) -> tuple[TrainState, JsonObject]:
    """Return the training state and the recorder's progress that a checkpoint holds."""
    about = explanation(path)
    try:
        parse_config(about["config"], source="stored config").check_resume(config)
    except ConfigError as error:
        raise CheckpointError(f"checkpoint {path} belongs to another run: {error}") from None
    shapes = jax.eval_shape(to_trees, template)
    policy: PolicyParams = checkpoint_store.read_tree(path, POLICY, shapes[POLICY])
    rest = checkpoint_store.read_tree(path, TRAINING, shapes[TRAINING])
    rest["tally"] = np.stack([rest["tally"][name] for name in TALLIED])
    state = TrainState(
        params=template.params.replace(policy=policy.policy, value=policy.value),
        normalizer=policy.normalizer,
        **rest,
    )
    return state, about.get("progress", {})
