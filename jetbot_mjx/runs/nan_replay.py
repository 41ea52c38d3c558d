"""Replay the steps of an environment whose state became non-finite during a training."""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jetbot_mjx.envs.domain_randomization import maybe_randomize
from jetbot_mjx.envs.jetbot_env import JetBotEnv
from jetbot_mjx.envs.kinematics import yaw
from jetbot_mjx.envs.state import State, robot_state
from jetbot_mjx.envs.wrappers import wrap_for_training
from jetbot_mjx.runs.checkpoint_store import flatten
from jetbot_mjx.runs.nan_dump import StoredNanDump

HEADER = (
    f"{'step':>4}  {'action':>15}  {'x [m]':>8} {'y [m]':>8} {'z [m]':>8}  {'yaw':>8}"
    f"  {'max |qvel|':>10}  not finite"
)
"""Names of the columns of `format_step`."""


class ReplayStep(NamedTuple):
    """A `ReplayStep` holds one step of the replay."""

    action: np.ndarray
    state: State
    """State after the step and before any reset."""
    nonfinite: list[str]
    """Names of the arrays that are not finite."""


def replay_nan_dump(stored: StoredNanDump, env: JetBotEnv) -> Iterator[ReplayStep]:
    """Replay the recorded actions from the state in which the unroll began.

    Args:
      stored: The stored state and actions.
      env: The environment that the NaN dump was recorded in.

    Yields:
      Every step up to the one with the non-finite state.
    """
    wrapped = wrap_for_training(env, stored.config.task.episode_length)
    step, raw_step = jax.jit(wrapped.step), jax.jit(jax.vmap(maybe_randomize(env).step))
    state: Any = jax.tree.map(lambda x: jnp.asarray(x)[None], stored.nan_dump.env_state)
    for action in stored.nan_dump.actions[: int(stored.nan_dump.step) + 1]:
        after = jax.device_get(jax.tree.map(lambda x: x[0], raw_step(state, action[None])))
        seen = {"pipeline_state": after.pipeline_state, "obs": after.obs, "reward": after.reward}
        nonfinite = [name for name, leaf in flatten(seen).items() if not np.all(np.isfinite(leaf))]
        yield ReplayStep(action, after, nonfinite)
        state = step(state, action[None])


def format_step(index: int, step: ReplayStep) -> str:
    """Return one step as a line of the table."""
    robot = robot_state(jax.tree.map(jnp.asarray, step.state.pipeline_state))
    x, y, z = np.asarray(robot.position_w)
    fastest = np.abs(step.state.pipeline_state.qvel).max()
    return (
        f"{index:4d}  {step.action[0]:+7.3f} {step.action[1]:+7.3f}  {x:+8.3f} {y:+8.3f}"
        f" {z:+8.4f}  {math.degrees(float(yaw(robot.quat))):+7.1f}°  {fastest:10.3g}"
        f"  {', '.join(step.nonfinite)}"
    )
