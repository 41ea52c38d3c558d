"""Any number of robots as a `gymnasium.vector.VectorEnv`, over the batched MJX environment."""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from jetbot_mjx.adapters.arguments import (
    Arguments,
    Seed,
    Source,
    an_extra,
    check_num_envs,
    resolve,
)
from jetbot_mjx.adapters.batched_env import BatchedEnv
from jetbot_mjx.adapters.renderer import RENDER_MODES
from jetbot_mjx.config import Config

with an_extra("gymnasium"):
    import gymnasium
    from gymnasium import spaces
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space


class JetBotVectorEnv(VectorEnv):
    """Robots in one compiled program; where an episode ends, the next begins in the same step.

    With `AutoresetMode.SAME_STEP`, `infos` has `final_obs` and `final_info` of the episodes that
    ended, and `obs` is already the next episode's. Every environment draws goal after goal from a
    random stream of its own, and the same ones as `JetBotGymEnv` draws from the same seed.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": list(RENDER_MODES),
        "render_fps": 60,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    def __init__(
        self,
        num_envs: int = 1,
        skip_frame: int = 1,
        physics_dt: float | None = None,
        rendering_dt: float | None = None,
        max_episode_length: int | None = None,
        seed: Seed = 0,
        headless: bool = True,
        *,
        render_mode: str | None = None,
        config: Source = None,
    ) -> None:
        """Build the environment; the first reset and the first step compile.

        Args:
          num_envs: robots.
          skip_frame: as `JetBotGymEnv` has it, like all that follow.
          physics_dt: likewise.
          rendering_dt: likewise.
          max_episode_length: likewise.
          seed: of the first episodes; one number counts on from environment to environment.
          headless: likewise; a window shows the first robot.
          render_mode: `human`, or `rgb_array`: a picture of every robot.
          config: likewise.

        Raises:
          UserError: an argument or setting is wrong, or there is no display for a window.
        """
        given = Arguments(
            skip_frame, physics_dt, rendering_dt, max_episode_length, headless, render_mode
        )
        settings = resolve(given, config)
        self.config: Config = settings.config
        """What the environments were built from."""
        self.num_envs = check_num_envs(num_envs)
        self.batch = BatchedEnv(settings.config, self.num_envs, seed)
        self.render_mode = settings.render_mode
        self._view = settings.view(self.batch.env)
        self.metadata = {**type(self).metadata, **settings.metadata}
        env = self.batch.env
        self.single_observation_space = spaces.Box(-np.inf, np.inf, (env.observation_size,))
        self.single_action_space = spaces.Box(-1.0, 1.0, (env.action_size,))
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(
        self, *, seed: Seed = None, options: dict[str, Any] | None = None
    ) -> tuple[Float[np.ndarray, "n obs"], dict[str, Any]]:
        """Begin an episode in every environment.

        Args:
          seed: begins new random streams; one number counts on from environment to environment.
          options: none are known.

        Returns:
          The first observations, and nothing else to tell.

        Raises:
          UserError: there are not as many seeds as environments.
        """
        obs = self.batch.reset(seed)
        self._show()
        return obs, {}

    def step(
        self, actions: Float[np.ndarray, "n 2"]
    ) -> tuple[
        Float[np.ndarray, "n obs"],
        Float[np.ndarray, " n"],
        Bool[np.ndarray, " n"],
        Bool[np.ndarray, " n"],
        dict[str, Any],
    ]:
        """Step every environment.

        Args:
          actions: in [-1, 1]²; values outside are clipped.

        Returns:
          Observations, rewards, terminated, truncated, and what there is to tell.

        Raises:
          ResetNeeded: there was no `reset` yet.
        """
        if not self.batch.is_begun:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        self.batch.start(actions)
        steps = self.batch.finish()
        done = steps.done
        # Laid out as Gymnasium's own SyncVectorEnv has it.
        infos: dict[str, Any] = {}
        if done.any():
            final_obs = np.full(self.num_envs, None, object)
            for index in np.flatnonzero(done):
                final_obs[index] = steps.final_obs[index]
            final_info = {"is_success": steps.success & done, "_is_success": done.copy()}
            if steps.nonfinite.any():
                final_info |= {"nonfinite_world": steps.nonfinite}
                final_info |= {"_nonfinite_world": steps.nonfinite.copy()}
            infos |= {"final_obs": final_obs, "_final_obs": done.copy()}
            infos |= {"final_info": final_info, "_final_info": done.copy()}
        if not done.all():
            infos |= {"is_success": steps.success & ~done, "_is_success": ~done}
        self._show()
        rewards = steps.reward.astype(np.float64)
        return steps.obs, rewards, steps.terminated, steps.truncated, infos

    def render(self) -> tuple[UInt8[np.ndarray, "height width 3"], ...] | None:
        """Return a picture of every robot; None unless asked for `rgb_array`.

        Raises:
          ResetNeeded: there was no `reset` yet.
          UserError: this machine has no OpenGL that works without a screen.
        """
        if self.render_mode != "rgb_array":
            return None
        if not self.batch.is_begun:
            raise gymnasium.error.ResetNeeded("call reset() before render()")
        assert self._view is not None
        return tuple(self._view.frame(pose.qpos, pose.goal) for pose in self.batch.poses())

    def close_extras(self, **kwargs: Any) -> None:
        """Close what was opened to show the robots."""
        del kwargs
        if self._view is not None:
            self._view.close()

    def _show(self) -> None:
        if self.render_mode == "human":
            assert self._view is not None
            pose = self.batch.poses()[0]
            self._view.show(pose.qpos, pose.goal, float(pose.time))
