"""The batched MJX environment with NumPy arrays in and out, for trainers written in Python."""

import operator
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, PyTree, UInt8

from jetbot_mjx.adapters.arguments import ResetKeys, Seed, as_actions
from jetbot_mjx.adapters.renderer import Pose
from jetbot_mjx.config import Config
from jetbot_mjx.devices import compiler_options
from jetbot_mjx.envs import State, make_jetbot_env, wrap_for_training
from jetbot_mjx.errors import check_count

Observations = Float[np.ndarray, "n obs"] | UInt8[np.ndarray, "n h w c"] | dict[str, np.ndarray]
"""Numbers, images, or both by name."""
Rewards = Float[np.ndarray, " n"]
Flags = Bool[np.ndarray, " n"]

_Part = TypeVar("_Part")

_MOST_ENVS = 2**24


class Steps(NamedTuple):
    """One step of every environment. Where an episode ended, `obs` is the next one's first."""

    obs: Observations
    reward: Rewards
    terminated: Flags
    truncated: Flags
    success: Flags
    nonfinite: Flags
    """Where the state was not finite, and the episode was truncated for it."""
    final_obs: Observations
    """The observation after the step, before any reset; without a reset it equals `obs`."""

    def final_obs_of(self, index: np.intp) -> PyTree:
        """Return the observation of one robot after the step, before any reset."""
        return jax.tree.map(operator.itemgetter(index), self.final_obs)

    @property
    def done(self) -> Flags:
        """Return where an episode ended."""
        return self.terminated | self.truncated


def unwrap_single(parts: _Part | dict[str, _Part]) -> _Part | dict[str, _Part]:
    """Return the only part of an observation, or the observation if it is none of several parts."""
    if isinstance(parts, dict) and len(parts) == 1:
        return next(iter(parts.values()))
    return parts


class BatchedEnv:
    """Robots in one compiled program, which resets those whose episode ends."""

    def __init__(self, config: Config, num_envs: int, seed: Seed) -> None:
        """Build the environment; the first reset and the first step compile.

        Args:
          config: The configuration of robot, task and physics.
          num_envs: Number of robots.
          seed: Seed of the first episodes, where `reset` is given none.

        Raises:
          UserError: The task cannot be built, `num_envs` is not a number of robots, or there are
            not as many seeds as robots.
        """
        check_count("num_envs", num_envs, _MOST_ENVS)
        self.num_envs = int(num_envs)
        self._reset_keys = ResetKeys(seed, self.num_envs)
        self.env = make_jetbot_env(config)
        length = config.task.episode_length
        wrapped = wrap_for_training(self.env, length, final_images=True)
        options = compiler_options(config.deterministic)

        def step(state: State, actions: jax.Array) -> tuple[State, tuple[PyTree, ...]]:
            state = wrapped.step(state, actions)
            info, metrics = state.info, state.metrics
            flags = (info["terminated"], info["truncation"], metrics["success"])
            flags = jnp.stack([*flags, metrics["nonfinite_envs"]]) > 0
            obs, final_obs = unwrap_single(state.obs), unwrap_single(info["final_obs"])
            return state, (obs, state.reward, flags, final_obs)

        self._reset = jax.jit(wrapped.reset, compiler_options=options)
        self._step = jax.jit(step, compiler_options=options)
        self._state: State | None = None
        self._results: tuple[PyTree, ...] | None = None

    def reset(self, seed: Seed = None) -> Observations:
        """Begin an episode in every environment.

        Args:
          seed: Seed of new random streams, by the rule of `ResetKeys`; None continues those that
            the environments have.

        Returns:
          The first observations.

        Raises:
          UserError: There are not as many seeds as environments.
        """
        current = None if self._state is None else np.asarray(self._state.key)
        keys = self._reset_keys(seed, current)
        self._results = None
        state = self._state = self._reset(keys)
        return jax.tree.map(np.array, jax.device_get(unwrap_single(state.obs)))

    def start(self, actions: np.ndarray) -> None:
        """Start a step on the device, without waiting for it.

        Args:
          actions: Actions of shape (n, action_size), in [-1, 1].

        Raises:
          UserError: The actions have another shape.
        """
        actions = as_actions(actions, (self.num_envs, self.env.action_size))
        self._state, self._results = self._step(self._state, actions)

    def finish(self) -> Steps:
        """Wait for the step that `start` began, and return its results as the caller's arrays."""
        assert self._results is not None, "start() comes before finish()"
        results = jax.tree.map(np.array, jax.device_get(self._results))
        obs, reward, flags, final_obs = results
        self._results = None
        terminated, truncated, success, nonfinite = flags
        return Steps(obs, reward, terminated, truncated, success, nonfinite, final_obs)

    def poses(self) -> list[Pose]:
        """Return the pose of every robot."""
        assert self._state is not None, "reset() comes before poses()"
        physics, goals = jax.device_get((self._state.pipeline_state, self._state.goal))
        goal_of = [jax.tree.map(lambda x, i=i: x[i], goals) for i in range(self.num_envs)]
        return list(map(Pose, physics.qpos, goal_of, physics.time.tolist()))
