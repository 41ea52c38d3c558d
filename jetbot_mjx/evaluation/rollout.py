"""Run whole episodes under a controller in one compiled program, for evaluation and rendering.

A controller is a function `controller(params, state, key) -> action`. It sees the whole state, so
that a scripted controller can be evaluated like a policy. This module adds the batch axis by
`jax.vmap`.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree, UInt32

from jetbot_mjx import envs
from jetbot_mjx.agents import kernel_key, raw_key
from jetbot_mjx.envs import QPOS_XYZ, AdaptedEnv, JetBotEnv, State
from jetbot_mjx.mjx_import import Wrapper
from jetbot_mjx.packed import Packed, pack

# Separates the actions' random numbers from those that the first reset, the robot and later
# episodes draw from the same key.
_ACTION_DRAWS = 0x61637473

_PATH = "path_length"
"""Key of the distance travelled in the state's `info` [m]."""

_OTHER_SUMS = frozenset({"success", "sum_reward", "length", "nonfinite_envs"})
"""Names in `episode_metrics` that mean the same for every environment."""

Controller = Callable[[PyTree, State, UInt32[Array, "2"]], Float[Array, " action"]]


class Episodes(NamedTuple):
    """An `Episodes` tuple holds one finished episode of each of n environments."""

    success: Float[Array, " n"]
    """1 if the episode ended in the task's success."""
    steps: Float[Array, " n"]
    """Environment steps until the end."""
    episode_return: Float[Array, " n"]
    """Sum of rewards."""
    terminated: Float[Array, " n"]
    """1 if the task ended the episode, in success or failure."""
    nonfinite: Float[Array, " n"]
    """1 if the episode was cut off because of a non-finite state."""
    path_length: Float[Array, " n"]
    """Distance travelled by the axle midpoint [m], on the floor."""
    start_w: Float[Array, "n 2"]
    """Start position of the robot [m], world frame."""
    start_yaw: Float[Array, " n"]
    """Heading at the start [rad], counter-clockwise from the world's x axis."""
    end_w: Float[Array, "n 2"]
    """Final position of the robot [m], world frame."""
    goal_w: Float[Array, "n 3"]
    """Position of the goal [m], world frame."""
    goal: envs.Goal
    """The complete goal that the task sampled."""
    qpos: Float[Array, "n time nq"] | None
    """Trajectory with the first state, constant after the end of the episode. None: not recorded.
    """


class ReturnEpisodes(NamedTuple):
    """A `ReturnEpisodes` tuple holds one finished episode of each of n environments of one's own.

    The fields are those of `Episodes`; `success` is 0 where the environment tells none.
    """

    success: Float[Array, " n"]
    steps: Float[Array, " n"]
    episode_return: Float[Array, " n"]
    terminated: Float[Array, " n"]
    nonfinite: Float[Array, " n"]
    qpos: Float[Array, "n time nq"] | None
    metrics: Mapping[str, Float[Array, " n"]]
    """Sum of each of the environment's own metrics over the episode."""


Rollout = Callable[[int | Int[Array, ""], PyTree, UInt32[Array, "n 2"]], Episodes]
"""A function of (index of the controller, its parameters, reset keys)."""

ReturnRollout = Callable[[int | Int[Array, ""], PyTree, UInt32[Array, "n 2"]], ReturnEpisodes]


class _Carry(NamedTuple):
    """A `_Carry` holds what the loop over the environment steps carries."""

    time: Int[Array, ""]
    states: Packed
    qpos: Float[Array, "n time nq"] | None


class _OneEpisodeWrapper(Wrapper):
    """A wrapper that keeps the final state of the first episode."""

    env: envs.EpisodeWrapper

    def step(self, state: State, action: Float[Array, " action"]) -> State:
        """Make one step, unless the episode has ended."""
        nstate: PyTree = self.env.step(state, action)
        return jax.tree.map(lambda a, b: jnp.where(state.done > 0, a, b), state, nstate)


class _WayWrapper(Wrapper):
    """A wrapper that measures the way of a robot."""

    env: envs.EpisodeWrapper

    def reset(self, rng: UInt32[Array, "2"]) -> State:
        """Begin the episode."""
        state = self.env.reset(rng)
        return state.replace(info={**state.info, _PATH: jnp.zeros(())})

    def step(self, state: State, action: Float[Array, " action"]) -> State:
        """Make one step."""
        nstate: PyTree = self.env.step(state, action)
        moved = jnp.linalg.norm(
            nstate.pipeline_state.qpos[QPOS_XYZ][:2] - state.pipeline_state.qpos[QPOS_XYZ][:2]
        )
        return nstate.replace(info={**nstate.info, _PATH: state.info[_PATH] + moved})


def rollout_fn(
    env: JetBotEnv | Wrapper,
    controllers: Sequence[Controller],
    episode_length: int,
    *,
    record: bool = False,
) -> Rollout:
    """Return a function that runs episodes of a robot under any one of several controllers.

    Args:
      env: one environment, or one in a wrapper whose state is still a `State`.
      controllers: the controllers to choose from.
      episode_length: environment steps after which an episode is truncated.
      record: whether to record the trajectories.

    Returns:
      A function of (index of the controller, its parameters, one reset key for each
      environment), to be compiled by `jax.jit`. The reset key also seeds the controller's own
      randomness.
    """
    blind = env.blind() if isinstance(env, JetBotEnv) else env
    measured = _WayWrapper(envs.EpisodeWrapper(blind, episode_length))
    one = envs.with_camera(envs.KernelWrapper(_OneEpisodeWrapper(measured)), env.camera)
    run = _loop_fn(one, controllers, episode_length, _qpos if record else None)
    return lambda index, params, keys: _to_episodes(env, *run(index, params, keys))


def return_rollout_fn(
    env: AdaptedEnv,
    controllers: Sequence[Controller],
    episode_length: int,
    *,
    record: bool = False,
) -> ReturnRollout:
    """Return the same for an environment of one's own, of which only returns are known.

    Args:
      env: the environment, which has an `mj_model` if `record` is true.
      controllers: as for `rollout_fn`, like the other arguments.
      episode_length: environment steps after which an episode is truncated.
      record: whether to record the trajectories.
    """
    one = envs.KernelWrapper(_OneEpisodeWrapper(envs.EpisodeWrapper(env, episode_length)))
    run = _loop_fn(one, controllers, episode_length, jax.vmap(env.qpos) if record else None)
    names = sorted({*env.metrics} - _OTHER_SUMS)

    def rollout(
        index: int | Int[Array, ""], params: PyTree, keys: UInt32[Array, "n 2"]
    ) -> ReturnEpisodes:
        _, last, qpos = run(index, params, keys)
        totals, sums = _totals(last), last.info["episode_metrics"]
        return ReturnEpisodes(**totals, qpos=qpos, metrics={name: sums[name] for name in names})

    return rollout


def _qpos(states: State) -> Float[Array, "n nq"]:
    return states.pipeline_state.qpos


def _totals(last: State) -> dict[str, Float[Array, " n"]]:
    """Return what all episodes have, by name, from the final states of all environments."""
    # All episodes have ended: the sums are those of whole episodes.
    sums = last.info["episode_metrics"]
    return {
        "success": sums.get("success", jnp.zeros_like(last.done)),
        "steps": last.info["steps"],
        "episode_return": sums["sum_reward"],
        "terminated": last.info["terminated"],
        "nonfinite": sums["nonfinite_envs"],
    }


def _loop_fn(
    one: Wrapper,
    controllers: Sequence[Controller],
    episode_length: int,
    qpos_of: Callable[[State], Float[Array, "n nq"]] | None,
) -> Callable[..., tuple[State, State, Float[Array, "n time nq"] | None]]:
    """Return a function that steps environments until the first episode of each has ended.

    Args:
      one: one environment, with a kernel.
      controllers: the controllers to choose from.
      episode_length: environment steps after which an episode is truncated.
      qpos_of: returns what to record of the states; None: nothing is recorded.

    Returns:
      A function, as of `rollout_fn`, that returns first states, last states and the record.
    """
    batch = envs.BatchWrapper(one)
    # Fold in twice: `fold_in(key, 1)` alone equals `split(key)[1]`, from which the goal is drawn.
    fold_in = jax.vmap(
        lambda key, data: raw_key(jax.random.fold_in(kernel_key(key), data)), (0, None)
    )

    def run(
        index: int | Int[Array, ""], params: PyTree, keys: UInt32[Array, "n 2"]
    ) -> tuple[State, State, Float[Array, "n time nq"] | None]:
        first = batch.reset(keys)

        def act(state: State, key: UInt32[Array, "2"]) -> Float[Array, " action"]:
            branches = [lambda s, k, c=c: c(params, s, k) for c in controllers]
            return jax.lax.switch(index, branches, state, key)

        def goes_on(carry: _Carry) -> Bool[Array, ""]:
            # Stop early, because most policies reach all goals long before the time limit.
            done = carry.states.unpack().done
            return (carry.time < episode_length) & (done == 0).any()

        def body(carry: _Carry) -> _Carry:
            step_keys = fold_in(fold_in(keys, _ACTION_DRAWS), carry.time)
            actions = jax.vmap(act)(carry.states.unpack(), step_keys)
            states, qpos = batch.step_packed(carry.states, actions), carry.qpos
            if qpos is not None and qpos_of is not None:
                qpos = qpos.at[:, carry.time + 1].set(qpos_of(states.unpack()))
            return _Carry(carry.time + 1, states, qpos)

        # Step all environments until the episode of each has ended.
        trail = None
        if qpos_of is not None:
            trail = jnp.repeat(qpos_of(first)[:, None], episode_length + 1, axis=1)
        begun = _Carry(jnp.zeros((), jnp.int32), pack(first, batch_axes=1), trail)
        end = jax.lax.while_loop(goes_on, body, begun)
        last, qpos = end.states.unpack(), end.qpos
        if qpos is not None and qpos_of is not None:
            # Repeat the final state in the rows that were not reached.
            ended = jnp.arange(qpos.shape[1]) > end.time
            qpos = jnp.where(ended[:, None], qpos_of(last)[:, None], qpos)
        return first, last, qpos

    return run


def _to_episodes(
    env: JetBotEnv | Wrapper, first: State, last: State, qpos: Float[Array, "n time nq"] | None
) -> Episodes:
    """Return the episodes between the reset states and the last ones."""
    start = first.pipeline_state.qpos
    return Episodes(
        **_totals(last),
        path_length=last.info[_PATH],
        start_w=start[:, QPOS_XYZ][:, :2],
        start_yaw=jax.vmap(envs.yaw)(start[:, envs.QPOS_QUAT]),
        end_w=last.pipeline_state.qpos[:, QPOS_XYZ][:, :2],
        goal_w=jax.vmap(env.task.goal_position)(first.goal),
        goal=first.goal,
        qpos=qpos,
    )
