"""The batched MJX environment with NumPy on either side, as Python's trainers want it."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, PyTree

from jetbot_mjx.adapters.arguments import Seed, as_actions, key_from_seed, seeds_of
from jetbot_mjx.compiler.program_cache import use_compilation_cache
from jetbot_mjx.compiler.xla_options import compiler_options
from jetbot_mjx.config import Config
from jetbot_mjx.envs.jetbot_env import make_env
from jetbot_mjx.envs.state import State
from jetbot_mjx.envs.wrappers import wrap_for_training


class Steps(NamedTuple):
    """One step of every environment. Where an episode ended, `obs` is the next one's first."""

    obs: Float[np.ndarray, "n obs"]
    reward: Float[np.ndarray, " n"]
    terminated: Bool[np.ndarray, " n"]
    truncated: Bool[np.ndarray, " n"]
    success: Bool[np.ndarray, " n"]
    nonfinite: Bool[np.ndarray, " n"]
    """Where a world blew up, and was truncated."""
    final_obs: Float[np.ndarray, "n obs"]
    """What the step led to; where no episode ended, the same as `obs`."""

    @property
    def done(self) -> Bool[np.ndarray, " n"]:
        """Return where an episode ended."""
        return self.terminated | self.truncated


class Pose(NamedTuple):
    """The state of one robot that is shown."""

    qpos: Float[np.ndarray, " nq"]
    goal: PyTree
    time: Float[np.ndarray, ""]
    """Since its episode began [s]."""


class BatchedEnv:
    """Robots in one compiled program, which resets those whose episode ends."""

    def __init__(self, config: Config, num_envs: int, seed: Seed) -> None:
        """Build the environment; the first reset and the first step compile.

        Args:
          config: robot, task and physics.
          num_envs: robots.
          seed: of the first episodes, where `reset` is given none.

        Raises:
          UserError: the task cannot be built, or there are not as many seeds as robots.
        """
        self._first_seeds = seeds_of(seed, num_envs)
        # Who comes from elsewhere has no reason to know that JAX would compile at every start.
        use_compilation_cache()
        self.num_envs = num_envs
        self.env = make_env(config)
        wrapped: Any = wrap_for_training(self.env, config.task.episode_length)
        options = compiler_options(config)

        def step(state: State, actions: jax.Array) -> tuple[State, tuple[jax.Array, ...]]:
            state = wrapped.step(state, actions)
            info, metrics = state.info, state.metrics
            flags = (info["terminated"], info["truncation"], metrics["success"])
            flags = jnp.stack([*flags, metrics["nonfinite_envs"]]) > 0
            return state, (state.obs, state.reward, flags, info["final_obs"])

        self._reset = jax.jit(wrapped.reset, compiler_options=options)
        self._step = jax.jit(step, compiler_options=options)
        self._state: State | None = None
        self._results: tuple[jax.Array, ...] | None = None

    def reset(self, seed: Seed = None) -> Float[np.ndarray, "n obs"]:
        """Begin an episode in every environment.

        Args:
          seed: of the random streams that episodes come from, by Gymnasium's rule (`seeds_of`);
            None goes on with the streams that there are.

        Returns:
          The first observations.

        Raises:
          UserError: there are not as many seeds as environments.
        """
        seeds = seeds_of(seed, self.num_envs)
        if self._state is None:
            begun = zip(seeds, self._first_seeds, strict=True)
            keys = [key_from_seed(first if one is None else one) for one, first in begun]
        else:
            going_on = zip(seeds, np.asarray(self._state.key), strict=True)
            keys = [key if one is None else key_from_seed(one) for one, key in going_on]
        self._results = None
        state = self._state = self._reset(np.stack(keys))
        return np.array(state.obs)

    @property
    def is_begun(self) -> bool:
        """Return whether there was a `reset`."""
        return self._state is not None

    def start(self, actions: np.ndarray) -> None:
        """Let the device begin a step, and does not wait for it.

        Args:
          actions: of shape (n, 2), in [-1, 1].

        Raises:
          UserError: they have another shape.
        """
        actions = as_actions(actions, (self.num_envs, 2))
        self._state, self._results = self._step(self._state, actions)

    def finish(self) -> Steps:
        """Wait for the step that `start` began.

        Returns:
          What came of it, in arrays of the caller's own.
        """
        assert self._results is not None, "start() comes before finish()"
        obs, reward, flags, final_obs = (np.array(x) for x in jax.device_get(self._results))
        self._results = None
        terminated, truncated, success, nonfinite = flags
        return Steps(obs, reward, terminated, truncated, success, nonfinite, final_obs)

    def poses(self) -> list[Pose]:
        """Return where every robot is, its goal, and since when it drives there."""
        assert self._state is not None, "reset() comes before all else"
        physics, goals = jax.device_get((self._state.pipeline_state, self._state.goal))
        return [
            Pose(physics.qpos[index], jax.tree.map(lambda x: x[index], goals), physics.time[index])  # noqa: B023
            for index in range(self.num_envs)
        ]
