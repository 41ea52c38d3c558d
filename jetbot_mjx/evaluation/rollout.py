"""Whole episodes under a controller: one compiled program, shared by all who judge or draw.

A controller sees the whole state, so that a scripted one can be judged beside a policy:
`controller(params, state, key) -> action`. Here the batch axis is made, by `jax.vmap`.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from brax.envs import Wrapper
from jaxtyping import Array, Bool, Float, Int, UInt32

from jetbot_mjx.envs import kinematics
from jetbot_mjx.envs.jetbot_env import JetBotEnv
from jetbot_mjx.envs.robot_model import QPOS_QUAT, QPOS_XYZ
from jetbot_mjx.envs.state import State
from jetbot_mjx.envs.task import Goal
from jetbot_mjx.envs.wrappers import EpisodeWrapper

# Apart from what the first reset, the robot and later episodes draw from the same key.
_ACTION_DRAWS = 0x61637473

Controller = Callable[[Any, State, UInt32[Array, "2"]], Float[Array, "2"]]


class Episodes(NamedTuple):
    """One finished episode of each of n environments."""

    success: Float[Array, " n"]
    """1 where the task's success was reached."""
    steps: Float[Array, " n"]
    """Environment steps until the end."""
    episode_return: Float[Array, " n"]
    """Sum of rewards."""
    terminated: Float[Array, " n"]
    """1 where the task ended the episode, in success or failure."""
    nonfinite: Float[Array, " n"]
    """1 where the episode was cut off because its world was no longer finite."""
    path_length: Float[Array, " n"]
    """Way travelled by the axle midpoint [m], on the floor."""
    start_w: Float[Array, "n 2"]
    """Where the robot started [m]."""
    start_yaw: Float[Array, " n"]
    """Where it headed then [rad], counter-clockwise from the world's x axis."""
    end_w: Float[Array, "n 2"]
    """Where it ended [m]."""
    goal_w: Float[Array, "n 3"]
    """Where it had to go [m], world frame."""
    goal: Goal
    """The whole of what the task drew."""
    qpos: Float[Array, "n time nq"] | None
    """Trajectory, first state included; after the end it stands still. None: not recorded."""


Rollout = Callable[[int | Int[Array, ""], Any, UInt32[Array, "n 2"]], Episodes]
"""Of (index of the controller, its parameters, reset keys)."""


class _Tally(NamedTuple):
    alive: Float[Array, ""]
    success: Float[Array, ""]
    steps: Float[Array, ""]
    episode_return: Float[Array, ""]
    terminated: Float[Array, ""]
    nonfinite: Float[Array, ""]
    path_length: Float[Array, ""]


class _Carry(NamedTuple):
    time: Int[Array, ""]
    state: State
    tally: _Tally
    qpos: Float[Array, "n time nq"] | None


def rollout_fn(
    env: JetBotEnv | Wrapper,
    controllers: Sequence[Controller],
    episode_length: int,
    *,
    record: bool = False,
) -> Rollout:
    """Makes episodes under any one of several controllers into one program.

    Args:
      env: one environment, or one in a wrapper that leaves its state a `State`.
      controllers: what can drive.
      episode_length: environment steps after which an episode is truncated.
      record: whether to keep the trajectories.

    Returns:
      A function of (index of the controller, its parameters, one reset key for each
      environment), to be compiled by `jax.jit`. The reset key also seeds the controller's own
      randomness.
    """
    episode_env = EpisodeWrapper(env, episode_length)

    def one_step(state: State, tally: _Tally, action: Float[Array, "2"]) -> tuple[State, _Tally]:
        nstate = episode_env.step(state, action)
        moved = jnp.linalg.norm(
            nstate.pipeline_state.qpos[QPOS_XYZ][:2] - state.pipeline_state.qpos[QPOS_XYZ][:2]
        )
        now = _Tally(
            alive=-nstate.done,
            success=nstate.metrics["success"],
            steps=jnp.ones(()),
            episode_return=nstate.reward,
            terminated=nstate.info["terminated"],
            nonfinite=nstate.metrics["nonfinite_worlds"],
            path_length=moved,
        )
        added = jax.tree.map(lambda total, x: total + tally.alive * x, tally, now)
        # A finished robot stands where it finished.
        nstate = jax.tree.map(lambda a, b: jnp.where(tally.alive > 0, a, b), nstate, state)
        return nstate, added

    # `fold_in(key, 1)` alone is `split(key)[1]`, from which the goal is drawn.
    fold_in = jax.vmap(jax.random.fold_in, in_axes=(0, None))

    def run(index: int | Int[Array, ""], params: Any, keys: UInt32[Array, "n 2"]) -> Episodes:
        first = jax.vmap(episode_env.reset)(keys)
        zero = jnp.zeros(keys.shape[0])
        tally = _Tally(jnp.ones_like(zero), *[zero] * 6)

        def act(state: State, key: UInt32[Array, "2"]) -> Float[Array, "2"]:
            branches = [lambda s, k, c=c: c(params, s, k) for c in controllers]
            return jax.lax.switch(index, branches, state, key)

        def goes_on(carry: _Carry) -> Bool[Array, ""]:
            # Most policies are done long before the time is out.
            return (carry.time < episode_length) & (carry.tally.alive > 0).any()

        def body(carry: _Carry) -> _Carry:
            step_keys = fold_in(fold_in(keys, _ACTION_DRAWS), carry.time)
            actions = jax.vmap(act)(carry.state, step_keys)
            state, tally = jax.vmap(one_step)(carry.state, carry.tally, actions)
            qpos = carry.qpos
            if qpos is not None:
                qpos = qpos.at[:, carry.time + 1].set(state.pipeline_state.qpos)
            return _Carry(carry.time + 1, state, tally, qpos)

        start = first.pipeline_state.qpos
        trail = jnp.repeat(start[:, None], episode_length + 1, axis=1) if record else None
        time, last, tally, qpos = jax.lax.while_loop(
            goes_on, body, _Carry(jnp.zeros((), jnp.int32), first, tally, trail)
        )
        if qpos is not None:
            ended = jnp.arange(episode_length + 1) > time
            qpos = jnp.where(ended[:, None], last.pipeline_state.qpos[:, None], qpos)
        return Episodes(
            success=tally.success,
            steps=tally.steps,
            episode_return=tally.episode_return,
            terminated=tally.terminated,
            nonfinite=tally.nonfinite,
            path_length=tally.path_length,
            start_w=start[:, QPOS_XYZ][:, :2],
            start_yaw=jax.vmap(kinematics.yaw)(start[:, QPOS_QUAT]),
            end_w=last.pipeline_state.qpos[:, QPOS_XYZ][:, :2],
            goal_w=jax.vmap(env.task.goal_position)(first.goal),
            goal=first.goal,
            qpos=qpos,
        )

    return run
