"""Load a policy from a run, together with everything that is needed to use it."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt32
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from jetbot_mjx import agents
from jetbot_mjx.agents import Networks, Policy, PolicyParams
from jetbot_mjx.config import Config, plain
from jetbot_mjx.devices import require_float32
from jetbot_mjx.envs import AdaptedEnv, JetBotEnv, LayoutData, layout_data
from jetbot_mjx.errors import InvalidError, UserError, os_errors, shown
from jetbot_mjx.runs import checkpoint_store
from jetbot_mjx.runs.checkpoint_store import FOLDER, CheckpointError, CheckpointNotFoundError
from jetbot_mjx.runs.run_dir import JsonObject, parse_stored, shortened
from jetbot_mjx.runs.run_finder import PRETRAINED as PRETRAINED
from jetbot_mjx.runs.run_finder import ROOT, explain_missing, find_run, scan_runs, suggest_run
from jetbot_mjx.runs.setup import Setup
from jetbot_mjx.runs.trust import trusted_class

Which = Literal["best", "last"] | int
"""Selects a checkpoint of a run: the best, the last, or one by its environment steps."""

POLICY = "policy"
"""The tree that holds a policy's parameters."""

FORMAT = "jetbot_mjx/3"
"""Format of a checkpoint's content; checkpoints of other formats cannot be read."""

_Size = Annotated[int, Field(ge=1, lt=2**24)]


class _LayoutField(BaseModel):
    """One field of the observation, as `layout_data` returns it."""

    model_config = ConfigDict(strict=True)

    name: str
    size: _Size
    unit: str
    frame: str


class _About(BaseModel):
    """The metadata that a policy needs; there may be more."""

    model_config = ConfigDict(strict=True)

    config: JsonObject
    layout: list[_LayoutField]
    observation_size: _Size | dict[str, list[_Size]]
    action_size: _Size
    env_steps: Annotated[int, Field(ge=0)]
    metrics: dict[str, float | None]


class Checkpoint(NamedTuple):
    """A `Checkpoint` holds a loaded policy and the metadata that describes it."""

    path: Path
    run_dir: Path
    """The run folder, to which reports and videos of this policy are written."""
    env_steps: int
    config: Config
    params: PolicyParams
    networks: Networks
    about: JsonObject

    def __repr__(self) -> str:
        """Return the folder and the configuration's repr, without the arrays."""
        return f"Checkpoint(path={str(self.path)!r}, config={self.config!r})"

    @property
    def results_dir(self) -> Path:
        """Return the folder for results: of a run of the package, one in the current folder."""
        if self.run_dir.parent == PRETRAINED:
            return ROOT / "pretrained" / self.run_dir.name
        return self.run_dir

    def make_env(self) -> JetBotEnv | AdaptedEnv:
        """Build the environment that the policy was trained in, for the available devices."""
        return self.make_setup().env

    def make_setup(self) -> Setup:
        """Build the environment that the policy was trained in, for the available devices.

        The code of a task or an environment of one's own is what the run stored, if that cannot be
        imported by name or has changed.

        Raises:
          UserError: it cannot be built, its stored code is damaged, or it names code that may not
            run, as for `require_trust`.
          CheckpointError: its observation differs from the one that the policy was trained on.
        """
        own_class = trusted_class(self.run_dir, self.config)
        config = self.config.for_any_device()
        setup = Setup(config, own_class=own_class, networks=self.networks)
        layout = layout_data(setup.env.layout)
        if layout != self.about["layout"]:
            raise CheckpointError(
                f"checkpoint {self.path} was trained on another observation than"
                f" {self.config.code} gives: {_names(self.about['layout'])} then,"
                f" {_names(layout)} here"
            )
        return setup


def _names(layout: LayoutData) -> str:
    return " ".join(f"{field['name']}[{field['size']}]" for field in layout)


def about_policy(config: Config, env: JetBotEnv | AdaptedEnv) -> JsonObject:
    """Return the metadata that every checkpoint of a run carries, as JSON values."""
    return {
        "format": FORMAT,
        "config": config.model_dump(mode="json"),
        "layout": layout_data(env.layout),
        "observation_size": env.observation_size,
        "action_size": env.action_size,
        "ctrl_dt": env.dt,
    }


def load_checkpoint(path: str | Path, which: Which = "best") -> Checkpoint:
    """Read a policy and its metadata.

    Args:
      path: a run folder, or one checkpoint folder of it.
      which: which checkpoint of a run folder to read; ignored if `path` is a checkpoint folder.

    Returns:
      The checkpoint.

    Raises:
      CheckpointError: there is no checkpoint, it was not written by jetbot_mjx, or it changed
        after it was written.
      UserError: JAX is set to 64 bits.
    """
    require_float32()
    folder = find_checkpoint(path, which)
    about = explanation(folder)
    size = about["observation_size"]
    try:
        config = parse_stored(about["config"], folder.parent.parent, "stored config")
        networks = agents.make_networks(config.ppo, size, about["action_size"])
        template = jax.eval_shape(
            lambda key: PolicyParams(
                agents.init_normalizer(size),
                networks.policy_network.init(key),
                networks.value_network.init(key),
            ),
            jax.random.PRNGKey(0),
        )
    except UserError as error:
        raise CheckpointError(f"checkpoint {folder} has unusable metadata: {error}") from None
    # JAX and Flax raise many kinds of exception for sizes of which no network can be built.
    except Exception:
        raise CheckpointError(
            f"checkpoint {folder} has unusable metadata: observation_size = {shown(size)} and"
            f" action_size = {about['action_size']} do not fit its configuration"
        ) from None
    return Checkpoint(
        path=folder,
        run_dir=folder.parent.parent,
        env_steps=about["env_steps"],
        config=config,
        params=checkpoint_store.read_tree(folder, POLICY, template),
        networks=networks,
        about=about,
    )


def explanation(folder: Path) -> JsonObject:
    """Read the metadata of a checkpoint that this project wrote.

    Args:
      folder: the checkpoint folder.

    Returns:
      The JSON object, which holds every key of `about_policy` and more.

    Raises:
      CheckpointError: it was not written by jetbot_mjx, is incomplete, or has another format.
    """
    about = checkpoint_store.read_about(folder, ("format", *_About.model_fields))
    if about["format"] != FORMAT:
        raise CheckpointError(
            f"checkpoint {folder} has the format {shown(about['format'])}, and only {FORMAT!r} can"
            " be read"
        )
    try:
        _About.model_validate(about)
    except ValidationError as error:
        key = str(error.errors()[0]["loc"][0])
        raise CheckpointError(
            f"checkpoint {folder} has unusable metadata: {key} = {shown(about[key])} is wrong"
        ) from None
    return about


def load_policy(run_or_checkpoint: str | Path, which: Which = "best") -> Policy:
    """Read a policy and return it as a function of the observation.

    Args:
      run_or_checkpoint: a run folder, or one checkpoint folder of it.
      which: the checkpoint of a run folder.

    Returns:
      `policy(obs, key=None) -> action`, which is deterministic without a key. It raises an
      `InvalidError` if the observation has another length than that of the training.

    Raises:
      CheckpointError: as for `load_checkpoint`.
    """
    return _CheckedPolicy(load_checkpoint(run_or_checkpoint, which))


class _CheckedPolicy:
    """A `_CheckedPolicy` is a policy that refuses observations of another size."""

    def __init__(self, checkpoint: Checkpoint) -> None:
        self._checkpoint = checkpoint
        self._policy = agents.make_policy(checkpoint.networks, checkpoint.params)

    def __call__(
        self, obs: agents.Observation, key: UInt32[Array, "2"] | None = None
    ) -> Float[Array, "*batch action"]:
        size, layout = (self._checkpoint.about[name] for name in ("observation_size", "layout"))
        if isinstance(size, int):
            _check_numbers(obs, size, layout)
            # A list of numbers is an observation, too.
            obs = np.asarray(obs, np.float32) if isinstance(obs, list | tuple) else obs
        else:
            _check_parts(obs, size)
        return self._policy(obs, key)

    def __repr__(self) -> str:
        one = self._checkpoint
        return (
            f"Policy(run={str(shortened(one.run_dir))!r}, env_steps={one.env_steps},"
            f" observation_size={one.about['observation_size']},"
            f" action_size={one.about['action_size']})"
        )


def _check_numbers(obs: agents.Observation, size: int, layout: LayoutData) -> None:
    """Raise an error if an observation is no vector of a length, or a batch of such."""
    if isinstance(obs, Mapping):
        raise InvalidError(f"observation: expected {size} numbers; got {_parts(obs)}")
    shape = np.shape(obs)
    if shape[-1:] != (size,):
        given = shape[-1] if shape else "one number without an axis"
        raise InvalidError(f"observation: expected {size} numbers, {_names(layout)}; got {given}")


def _check_parts(obs: agents.Observation, shapes: Mapping[str, Sequence[int]]) -> None:
    """Raise an error if an observation lacks parts of the given shapes, or a batch of such."""
    wanted = "{" + ", ".join(f"{name}: {list(shape)}" for name, shape in shapes.items()) + "}"
    if not isinstance(obs, Mapping):
        raise InvalidError(f"observation: expected {wanted}; got shape {list(np.shape(obs))}")
    fits = set(obs) == set(shapes) and all(
        np.shape(obs[name])[-len(shape) :] == tuple(shape) for name, shape in shapes.items()
    )
    if not fits:
        raise InvalidError(f"observation: expected {wanted}; got {_parts(obs)}")
    images = [name for name in shapes if len(shapes[name]) == 3]
    dtypes = {name: jnp.asarray(obs[name]).dtype for name in images}
    if wrong := [name for name, dtype in dtypes.items() if dtype != np.uint8]:
        raise InvalidError(
            f"observation: {wrong[0]} has the dtype {dtypes[wrong[0]]}: it should be uint8,"
            " 0 to 255"
        )


def _parts(obs: Mapping[str, Array | np.ndarray]) -> str:
    return "{" + ", ".join(f"{name}: {list(np.shape(x))}" for name, x in obs.items()) + "}"


def find_checkpoint(path: str | Path, which: Which = "best") -> Path:
    """Find a checkpoint folder.

    Args:
      path: a run folder, one checkpoint folder of it, or a run's name as for `find_run`.
      which: the checkpoint of a run folder.

    Returns:
      The checkpoint folder.

    Raises:
      CheckpointError: there is no such checkpoint.
    """
    path = find_run(path).absolute()
    with os_errors(f"no checkpoint at {path}", CheckpointError):
        return _find(path, which)


def _find(path: Path, which: Which) -> Path:
    def missing(reason: str) -> CheckpointNotFoundError:
        return CheckpointNotFoundError(f"no checkpoint at {path}: {reason}")

    if reason := explain_missing(path):
        raise missing(reason)
    # A run folder may contain `policy/` too, which `export` writes.
    if (path / POLICY).is_dir() and not (path / FOLDER).is_dir():
        return path
    if seeds := sorted(path.glob("seed-*")):
        raise missing(f"it holds several seeds; name one, such as {seeds[0]}")
    if not (path / FOLDER).is_dir() and (runs := scan_runs(path)[0]):
        names = ", ".join(run.path.name for run in runs[:8]) + (", ..." if runs[8:] else "")
        raise missing(f"it holds {len(runs)} runs; name one of {names}")
    if not (path / FOLDER).is_dir():
        raise missing(f"it holds neither {FOLDER}/ nor {POLICY}/; {suggest_run(path)}")
    steps = checkpoint_store.checkpoint_steps(path)
    if not steps:
        raise CheckpointNotFoundError(f"no checkpoint in {path / FOLDER}: the run saved none")
    if which == "last":
        step = steps[-1]
    elif which == "best":
        # Prefer the later of equally good ones, because it was trained for longer.
        step = max(steps, key=lambda step: (checkpoint_store.stored_score(path, step), step))
    elif not isinstance(which := plain(which), int):
        raise InvalidError(f"which = {which!r} is neither best, last nor a number of steps")
    elif which in steps:
        step = which
    else:
        known = ", ".join(str(step) for step in steps)
        raise CheckpointNotFoundError(
            f"no checkpoint at {which} steps in {path}: there are {known}"
        )
    return checkpoint_store.checkpoint_path(path, step)
