"""Begin a training with the networks and the normaliser of another run.

The first layer of a network multiplies each number of the observation with one row of weights. The
observation's layout names those numbers, so that the rows can be matched between two tasks:

  field in both layouts    its rows, mean and deviation are taken over
  field of the new one     its rows begin at zero, so that the policy acts as it did; its mean and
                           deviation are measured while that policy drives in the new task
  field of the old one     its rows are dropped, and it is named

All later layers are taken over but for the policy's last one. A trained policy commands full speed
almost everywhere, and there its noise changes nothing that it could learn from. Therefore the last
layer's means are scaled by `MEAN_SCALE`, which changes how hard the policy steers and not where to,
and the part that gives the width of its noise is that of a new policy. The
optimizer starts from its initial state.
"""

from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from jetbot_mjx.agents import PolicyParams, TrainState, UInt64, last_layer, make_policy
from jetbot_mjx.config import Config
from jetbot_mjx.envs import AdaptedEnv, JetBotEnv, LayoutData, State, layout_data
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs.checkpoint import Checkpoint
from jetbot_mjx.runs.setup import Setup

MEAN_SCALE = 0.25
"""Factor on the means of the actions, before they are limited to -1 .. 1."""

_Driving = tuple[State, Array]
"""The states of the environments, and the key of the next actions."""

_MEASURED_ENVS = 256
"""Environments in which the statistics of new fields are measured, for one episode each."""


class WarmStart(NamedTuple):
    """A `WarmStart` holds the parameters to begin with, and what became of each field."""

    params: PolicyParams
    """The parameters, on the host."""
    source: Path
    """The checkpoint that they are from."""
    env_steps: int
    """Environment steps that the checkpoint was trained for."""
    new: list[str]
    """Names of the fields that only the new layout has."""
    dropped: list[str]
    action_size: int
    """Number of the policy's outputs that are means, or of choices."""

    def apply(self, state: TrainState) -> TrainState:
        """Return a training state before the first step with these parameters."""
        fresh = jax.device_get(state.params.policy)
        policy = _with_new_noise(self.params.policy, fresh, self.action_size)
        networks = state.params.replace(policy=policy, value=self.params.value)
        return state.replace(params=networks, normalizer=self.params.normalizer)

    def describe(self) -> str:
        """Return one line that says what was taken over."""
        parts = [
            f"begins with the policy of {self.source} after {self.env_steps:,} steps",
            f"to explore again, its last layer is scaled by {MEAN_SCALE} and its noise is new:"
            " expect less of it at first",
        ]
        if self.new:
            parts.append(f"new in its observation: {', '.join(self.new)}")
        if self.dropped:
            parts.append(f"dropped: {', '.join(self.dropped)}")
        return "; ".join(parts)


def make_warm_start(source: Checkpoint, setup: Setup) -> WarmStart:
    """Fit another run's policy to a new task.

    Args:
      source: a checkpoint of the other run.
      setup: the new run.

    Returns:
      The parameters to begin with. Before `apply`, they make the same actions as the other run's
      policy wherever both tasks observe the same.

    Raises:
      UserError: the networks differ in more than the observation, or no field is in both layouts.
    """
    if source.config.task.sees:
        raise UserError(
            f"init_from {source.path}: its policy sees images (task.observation ="
            f" {source.config.task.observation!r}), and only numbers can be matched"
        )
    config = setup.config
    _check_networks(source, config, setup.env)
    old, new = source.about["layout"], layout_data(setup.env.layout)
    rows = match_rows(old, new)
    names = [[field["name"] for field in layout] for layout in (old, new)]
    if (rows < 0).all():
        theirs, ours = (", ".join(f"{x['name']}[{x['size']}]" for x in one) for one in (old, new))
        raise UserError(
            f"init_from {source.path}: no field of its observation ({theirs}) is one of"
            f" {config.code} ({ours})"
        )
    # Take over the networks and the statistics, row by row.
    params = PolicyParams(
        _match_statistics(source.params.normalizer, rows),
        _match_first_layer(source.params.policy, rows),
        _match_first_layer(source.params.value, rows),
    )
    # Measure the statistics of new fields while this policy drives.
    if (rows < 0).any():
        params = params._replace(normalizer=_measure(params, setup, rows))
    ends = np.cumsum([field["size"] for field in new])
    taken = [name for name, end in zip(names[1], ends, strict=True) if rows[end - 1] >= 0]
    return WarmStart(
        params=jax.device_get(params),
        source=source.path,
        env_steps=source.env_steps,
        new=[name for name in names[1] if name not in taken],
        dropped=sorted(set(names[0]) - set(taken)),
        action_size=setup.env.action_size,
    )


def match_rows(old: LayoutData, new: LayoutData) -> Int[np.ndarray, " new"]:
    """Return for each number of the new observation its index in the old one, or -1.

    A field is the same if its name, size, unit and frame are.
    """

    def numbers(layout: LayoutData) -> list[tuple[object, ...]]:
        """Return a key for each number of a layout: its field, and its place in the field."""
        names = ("name", "size", "unit", "frame")
        fields = [(tuple(field[name] for name in names), field["size"]) for field in layout]
        return [(*key, place) for key, size in fields for place in range(size)]

    index = {key: row for row, key in enumerate(numbers(old))}
    return np.array([index.get(key, -1) for key in numbers(new)], np.int64)


def _check_networks(source: Checkpoint, config: Config, env: JetBotEnv | AdaptedEnv) -> None:
    ours, theirs = config.ppo.network.model_dump(), source.config.ppo.network.model_dump()
    for name, value in ours.items():
        if theirs[name] != value:
            raise UserError(
                f"init_from {source.path}: its network has {name} = {_text(theirs[name])}, and"
                f" ppo.network.{name} = {_text(value)}: give --set ppo.network.{name}="
                f"{_text(theirs[name])}"
            )
    if source.about["action_size"] != env.action_size:
        raise UserError(
            f"init_from {source.path}: its policy has {source.about['action_size']} actions, and"
            f" {config.code} has {env.action_size}"
        )
    normalize = config.ppo.normalize_observations
    if source.config.ppo.normalize_observations != normalize:
        raise UserError(
            f"init_from {source.path}: it was trained with ppo.normalize_observations ="
            f" {_text(not normalize)}: set the same here"
        )


def _text(value: object) -> str:
    if isinstance(value, bool | None):
        return {True: "true", False: "false", None: "null"}[value]
    return f"[{','.join(map(str, value))}]" if isinstance(value, tuple | list) else str(value)


def _match_first_layer(params: PyTree, rows: Int[np.ndarray, " new"]) -> PyTree:
    """Return a network whose first layer has a row for each number of the new observation."""

    def match(path: jax.tree_util.KeyPath, x: np.ndarray) -> np.ndarray:
        if [entry.key for entry in path[-2:]] != ["hidden_0", "kernel"]:
            return x
        return np.where((rows >= 0)[:, None], np.asarray(x)[rows], np.float32(0.0))

    return jax.tree_util.tree_map_with_path(match, params)


def _with_new_noise(trained: PyTree, fresh: PyTree, means: int) -> PyTree:
    """Return a policy with smaller means and the noise of a fresh one.

    The last layer's outputs are the means of the actions, followed by the parameters of their
    deviations, which `distribution_type: normal` has in a module of their own instead. Those of
    choices have no deviations.
    """
    layers, new = dict(trained["params"]), fresh["params"]
    name = last_layer(layers)
    if "std_param" in layers:
        layers["std_param"] = new["std_param"]

    def mix(x: Float[np.ndarray, "*in out"], new: Float[np.ndarray, "*in out"]) -> np.ndarray:
        return np.concatenate([MEAN_SCALE * x[..., :means], new[..., means:]], axis=-1)

    layers[name] = jax.tree.map(mix, layers[name], new[name])
    return {**trained, "params": layers}


def _match_statistics(normalizer: PyTree, rows: Int[np.ndarray, " new"]) -> PyTree:
    """Return the running statistics of the new observation; new fields: mean 0, deviation 1."""
    known = rows >= 0
    count = float(normalizer.count.to_numpy() if hasattr(normalizer.count, "to_numpy") else 0)
    mean, std = np.asarray(normalizer.mean), np.asarray(normalizer.std)
    variance = np.asarray(normalizer.summed_variance)
    return normalizer.replace(
        mean=np.where(known, mean[rows], np.float32(0.0)),
        std=np.where(known, std[rows], np.float32(1.0)),
        summed_variance=np.where(known, variance[rows], np.float32(count)),
    )


def _measure(params: PolicyParams, setup: Setup, rows: Int[np.ndarray, " new"]) -> PyTree:
    """Return statistics whose new fields have the mean and deviation that a policy meets.

    Running statistics have one count for all fields. It becomes that of the measurement, so that
    training changes all of them from there on, and the sums of squares are scaled with it.
    """
    config, batched = setup.config, setup.training_env
    policy = make_policy(setup.networks, params)

    def step(carry: _Driving, _: None) -> tuple[_Driving, PyTree]:
        state, key = carry
        key, action_key = jax.random.split(key)
        return (batched.step(state, policy(state.obs, action_key)), key), state.obs

    @jax.jit
    def drive(key: Array) -> tuple[Float[Array, " obs"], Float[Array, " obs"]]:
        keys = jax.random.split(key, _MEASURED_ENVS)
        start = batched.reset(keys), key
        _, seen = jax.lax.scan(step, start, length=config.task.episode_length)
        return seen.mean(axis=(0, 1)), seen.std(axis=(0, 1))

    measured_mean, measured_std = jax.device_get(drive(jax.random.PRNGKey(config.seed)))
    old: PyTree = params.normalizer
    known, count = rows >= 0, _MEASURED_ENVS * config.task.episode_length
    physical = config.ppo.normalizer == "physical"
    floor: PyTree = setup.env.observation_min_std if physical else 1e-6
    std = np.where(known, old.std, np.maximum(measured_std, floor)).astype(np.float32)
    return old.replace(
        # Pyright does not follow flax's dataclasses.
        count=UInt64(hi=np.uint32(0), lo=np.uint32(count)),  # pyright: ignore[reportCallIssue]
        mean=np.where(known, old.mean, measured_mean).astype(np.float32),
        std=std,
        summed_variance=(np.square(std) * count).astype(np.float32),
    )
