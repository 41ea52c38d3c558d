"""Checkpoints on disk, by Orbax, each one explaining itself.

`checkpoints/<env_steps>/` holds the parameters and, as JSON, all that is needed to use them:
resolved configuration, observation layout, versions, and the figures they were judged by.
Orbax writes in the background and renames at the end: a folder is whole or absent.
"""

import json
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self

import flax.serialization
import jax
import numpy as np
import orbax.checkpoint as ocp
import tensorstore as ts
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import networks as ppo_networks

from jetbot_mjx.config import Config, ConfigError, parse_config
from jetbot_mjx.env import JetBotEnv, make_env
from jetbot_mjx.errors import UserError
from jetbot_mjx.policy import Policy, PolicyParams, make_networks, make_policy

Which = Literal["best", "last"] | int
"""A checkpoint of a run: the best, the last, or the one at that many environment steps."""

_FOLDER = "checkpoints"
_PARAMS, _ABOUT = "policy", "about"
_STEP_DIGITS = 12
_FORMAT = "jetbot_mjx.policy/1"
_KEYS = ("config", "layout", "observation_size", "action_size", "env_steps", "figures")

# Orbax tells of every step of its work at INFO, and of what it would prefer at WARNING.
logging.getLogger("absl").setLevel(logging.ERROR)


class CheckpointError(UserError):
    """A checkpoint that is not there, or that cannot be used."""


class Checkpoint(NamedTuple):
    """A policy read back, with what explains it."""

    path: Path
    run_dir: Path
    """Where reports and videos of this policy go."""
    env_steps: int
    config: Config
    params: PolicyParams
    networks: ppo_networks.PPONetworks
    about: Mapping[str, Any]

    def make_env(self) -> JetBotEnv:
        """Builds the environment that the policy was trained in.

        Raises:
          UserError: the task cannot be built.
          CheckpointError: its observation is not the one that the policy knows.
        """
        env = make_env(self.config)
        layout = [field._asdict() for field in env.task.layout]
        if layout != self.about["layout"]:
            raise CheckpointError(
                f"checkpoint {self.path} was trained on another observation than"
                f" {self.config.task.name} gives: {_names(self.about['layout'])} then,"
                f" {_names(layout)} here"
            )
        return env


def _names(layout: Sequence[Mapping[str, Any]]) -> str:
    return " ".join(f"{field['name']}[{field['size']}]" for field in layout)


class CheckpointWriter:
    """Writes the policies of one run; a context manager that waits for the last write."""

    def __init__(self, run_dir: Path, about: Mapping[str, Any]) -> None:
        """Opens a run's checkpoint folder.

        Args:
          run_dir: the run folder, which exists.
          about: what is the same for all checkpoints of the run, as JSON.
        """
        self._about = {"format": _FORMAT, **about}
        self._manager = _manager(run_dir / _FOLDER, create=True)

    def save(self, env_steps: int, params: PolicyParams, figures: Mapping[str, Any]) -> None:
        """Begins to write one checkpoint.

        Args:
          env_steps: environment steps so far; names the folder.
          params: the policy.
          figures: what it was judged by, as JSON; `success_rate` decides which is best, and
            of equals the later one.
        """
        about = {**self._about, "env_steps": env_steps, "figures": dict(figures)}
        self._manager.save(
            env_steps,
            args=ocp.args.Composite(
                **{
                    _PARAMS: ocp.args.StandardSave(_to_tree(params)),
                    _ABOUT: ocp.args.JsonSave(about),
                }
            ),
            metrics={"success_rate": figures["success_rate"]},
        )

    def __enter__(self) -> Self:
        """Enters."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Waits until all is on disk."""
        self._manager.close()


def load_checkpoint(path: str | Path, which: Which = "best") -> Checkpoint:
    """Reads a policy and what explains it.

    Args:
      path: a run folder, or one checkpoint folder of it.
      which: the checkpoint of a run folder; one checkpoint folder stands for itself.

    Returns:
      The checkpoint.

    Raises:
      CheckpointError: there is none, it is not one of ours, or it cannot be read whole.
    """
    folder = find_checkpoint(path, which)
    about = _read_about(folder)
    try:
        config = parse_config(about["config"], source=f"{folder}: stored config")
        networks = make_networks(
            config.ppo.network,
            about["observation_size"],
            about["action_size"],
            normalize=config.ppo.normalize_observations,
        )
        template = _template(networks, about["observation_size"])
    except (KeyError, TypeError, ConfigError) as error:
        raise CheckpointError(f"checkpoint {folder} does not explain itself: {error}") from None
    try:
        _read_all(folder / _PARAMS)
        with ocp.StandardCheckpointer() as reader:
            stored = reader.metadata(folder / _PARAMS).item_metadata.tree
            _check_shapes(_to_tree(template), stored)
            tree = reader.restore(folder / _PARAMS, _to_tree(template))
    # Orbax and TensorStore report a damaged folder by many kinds of exception.
    except Exception as error:
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise CheckpointError(f"checkpoint {folder} cannot be read: {reason[:200]}") from error
    return Checkpoint(
        path=folder,
        run_dir=folder.parent.parent,
        env_steps=about["env_steps"],
        config=config,
        params=_from_tree(template, tree),
        networks=networks,
        about=about,
    )


def load_policy(run_or_checkpoint: str | Path, which: Which = "best") -> Policy:
    """Reads a policy, ready to act.

    Args:
      run_or_checkpoint: a run folder, or one checkpoint folder of it.
      which: the checkpoint of a run folder.

    Returns:
      `policy(obs, key=None) -> action`: deterministic without a key.

    Raises:
      CheckpointError: as for `load_checkpoint`.
    """
    checkpoint = load_checkpoint(run_or_checkpoint, which)
    return make_policy(checkpoint.networks, checkpoint.params)


# Orbax reads in threads of its own. Where one fails, the others go on and print tracebacks that
# nobody can catch: whatever could fail is tried here first.


def _read_all(folder: Path) -> None:
    """Reads every stored chunk once, and raises where one is missing or damaged."""
    store = ts.KvStore.open({"driver": "ocdbt", "base": f"file://{folder}/"}).result()
    for key in store.list().result():
        store.read(key).result()


def _check_shapes(wanted: Any, stored: Any) -> None:
    """Raises where the stored parameters are not those of the networks."""
    wanted, stored = (
        {
            jax.tree_util.keystr(path, simple=True, separator="."): tuple(np.shape(leaf))
            for path, leaf in jax.tree_util.tree_leaves_with_path(tree)
        }
        for tree in (wanted, stored)
    )
    for name in sorted(wanted.keys() | stored.keys()):
        if wanted.get(name) != stored.get(name):
            raise ValueError(
                f"{name} has shape {stored.get(name)}, and the networks want {wanted.get(name)}"
            )


def find_checkpoint(path: str | Path, which: Which = "best") -> Path:
    """Finds a checkpoint folder.

    Args:
      path: a run folder, or one checkpoint folder of it.
      which: the checkpoint of a run folder.

    Returns:
      The checkpoint folder.

    Raises:
      CheckpointError: there is none.
    """
    path = Path(path).absolute()
    try:
        return _find(path, which)
    except OSError as error:
        raise CheckpointError(f"no checkpoint at {path}: {error.strerror}") from None


def _find(path: Path, which: Which) -> Path:
    if not path.is_dir():
        raise CheckpointError(
            f"no checkpoint at {path}: no such folder; give a run folder or a checkpoint in it"
        )
    if (path / _PARAMS).is_dir():
        return path
    if not (path / _FOLDER).is_dir():
        raise CheckpointError(
            f"no checkpoint at {path}: it holds neither {_FOLDER}/ nor {_PARAMS}/;"
            " give a run folder or a checkpoint in it"
        )
    steps = checkpoint_steps(path)
    if not steps:
        raise CheckpointError(f"no checkpoint in {path / _FOLDER}: the run saved none")
    if which == "last":
        step = steps[-1]
    elif which == "best":
        # Of equals, the later: it has learnt for longer.
        step = max(steps, key=lambda step: (_success_rate(path / _FOLDER / _name(step)), step))
    elif which in steps:
        step = which
    else:
        known = ", ".join(str(step) for step in steps)
        raise CheckpointError(f"no checkpoint at {which} steps in {path}: there are {known}")
    return path / _FOLDER / _name(step)


def checkpoint_steps(run_dir: Path) -> list[int]:
    """Environment steps of a run's checkpoints, ascending; unfinished ones are left out."""
    folders = (run_dir / _FOLDER).iterdir()
    return sorted(
        int(folder.name)
        for folder in folders
        if folder.name.isdecimal() and (folder / _PARAMS).is_dir()
    )


def _name(step: int) -> str:
    return f"{step:0{_STEP_DIGITS}d}"


def _success_rate(folder: Path) -> float:
    return float(_read_about(folder).get("figures", {}).get("success_rate", -1.0))


def _read_about(folder: Path) -> dict[str, Any]:
    path = folder / _ABOUT / "metadata"
    try:
        about = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        raise CheckpointError(
            f"checkpoint {folder} is not one of jetbot_mjx: {path.relative_to(folder)} is missing"
            " or damaged"
        ) from None
    if not isinstance(about, dict) or about.get("format") != _FORMAT:
        raise CheckpointError(f"checkpoint {folder} is not in the format {_FORMAT}")
    missing = [name for name in _KEYS if name not in about]
    if missing:
        raise CheckpointError(f"checkpoint {folder} does not explain itself: no {missing[0]}")
    return about


def _manager(folder: Path, *, create: bool) -> ocp.CheckpointManager:
    names = ocp.path.step.standard_name_format(step_format_fixed_length=_STEP_DIGITS)
    options = ocp.CheckpointManagerOptions(
        create=create,
        step_name_format=names,
        best_fn=lambda metrics: metrics["success_rate"],
        best_mode="max",
        cleanup_tmp_directories=True,
    )
    return ocp.CheckpointManager(folder.absolute(), options=options)


def _template(networks: ppo_networks.PPONetworks, observation_size: int) -> PolicyParams:
    """Shapes and dtypes of a policy's parameters; no numbers that could pass for a policy."""

    def init() -> PolicyParams:
        key = jax.random.PRNGKey(0)
        return PolicyParams(
            normalizer=running_statistics.init_state(
                specs.Array((observation_size,), np.dtype("float32"))
            ),
            policy=networks.policy_network.init(key),
            value=networks.value_network.init(key),
        )

    return jax.eval_shape(init)


def _to_tree(params: PolicyParams) -> dict[str, Any]:
    """Plain nested dictionaries: what is on disk depends on no Python class."""
    return {name: flax.serialization.to_state_dict(part) for name, part in params._asdict().items()}


def _from_tree(template: PolicyParams, tree: Mapping[str, Any]) -> PolicyParams:
    return PolicyParams(
        **{
            name: flax.serialization.from_state_dict(part, tree[name])
            for name, part in template._asdict().items()
        }
    )
