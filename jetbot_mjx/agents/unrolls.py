"""Collect unrolls: step the environments with a policy's actions, and keep what the loss reads."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, PRNGKeyArray, PyTree

from jetbot_mjx.agents.brax_parts import Transition
from jetbot_mjx.agents.learner import PackedEnv, UnrollFn
from jetbot_mjx.agents.random_keys import Keys
from jetbot_mjx.agents.train_state import NanDump
from jetbot_mjx.packed import Packed, pack

_EXTRA_FIELDS = ("truncation", "episode_metrics", "episode_done")
"""Fields of the state's `info` that are collected."""

Act = Callable[[PyTree, Array], tuple[Array, PyTree]]
"""From the observations of all environments, and the keys or the noise of their actions, to the
actions and what Brax keeps of them."""


def kept_of(state: PyTree) -> dict[str, PyTree]:
    """Return what a collection keeps of the state after a step."""
    info = {name: state.info[name] for name in _EXTRA_FIELDS}
    return {"obs": state.obs, "reward": state.reward, "done": state.done, "info": info}


def transition(obs: PyTree, action: Array, extras: PyTree, kept: dict[str, PyTree]) -> Transition:
    """Return the data of one step, or of several.

    Args:
      obs: the observation before the step.
      action: the action.
      extras: what Brax keeps of the action.
      kept: what `kept_of` returns of the state after the step.
    """
    # The loss needs the next observation only at the end of an unroll, where it is in the state:
    # the others, possibly images, are not even stored.
    nothing: PyTree = None
    all_extras: PyTree = {"policy_extras": extras, "state_extras": kept["info"]}
    return Transition(
        observation=obs,
        action=action,
        reward=kept["reward"],
        discount=1 - kept["done"],
        next_observation=nothing,
        extras=all_extras,
    )


def step_by_step(env: PackedEnv, act: Act, draw: Callable[[PRNGKeyArray], Array]) -> UnrollFn:
    """Return the function of an unroll in which policy and environments take turns.

    Args:
      env: the environment from `wrap_for_training`.
      act: the policy.
      draw: draws from a key what `act` takes in each step.
    """

    def step(start: Packed, drawn: Array) -> tuple[Packed, Packed]:
        # Act, step, and keep what the loss reads as one array.
        obs = start.unpack().obs
        action, extras = act(obs, drawn)
        after = env.step_packed(start, action)
        data = transition(obs, action, extras, kept_of(after.unpack()))
        return after, pack(data, batch_axes=1)

    def unroll(start: Packed, key: PRNGKeyArray) -> tuple[Packed, Transition]:
        after, packed = jax.lax.scan(step, start, draw(key))
        return after, packed.unpack()

    return unroll


def action_keys(key: PRNGKeyArray, time: int) -> Keys:
    """Return Brax's keys of the actions of an unroll, each of which follows from the one before."""

    def split(key: Array, _: None) -> tuple[Array, Array]:
        own, following = jax.random.split(key)
        return following, own

    return jax.lax.scan(split, key, length=time)[1]


def joined(data: Transition) -> Transition:
    """Reshape data from (unrolls, time, environments) to (unrolls x environments, time)."""
    data = jax.tree.map(lambda x: jnp.swapaxes(x, 1, 2), data)
    return jax.tree.map(lambda x: x.reshape((-1, *x.shape[2:])), data)


def find_nan_dump(start: Packed, data: Transition) -> NanDump:
    """Return what reproduces the first non-finite state of an unroll.

    Args:
      start: the states at its start.
      data: its data, of shape (time, environment, ...).
    """
    # The environment has replaced a non-finite state, ended the episode and counted it.
    statistics: PyTree = data.extras["state_extras"]["episode_metrics"]
    ended = data.extras["state_extras"]["episode_done"]
    nonfinite = ended * statistics.get("nonfinite_envs", jnp.zeros(())) > 0
    # The flat index is ordered by time and then by environment.
    first = jnp.argmax(nonfinite)
    step, env_index = jnp.divmod(first, nonfinite.shape[1])
    return NanDump(
        found=nonfinite.any(),
        env_state=jax.tree.map(lambda x: x[env_index], start),
        actions=data.action[:, env_index],
        step=step,
    )
