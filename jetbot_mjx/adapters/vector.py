"""Any number of robots as a `gymnasium.vector.VectorEnv`, over the batched MJX environment."""

import numpy as np
from jaxtyping import Float, UInt8

from jetbot_mjx.adapters.arguments import Seed
from jetbot_mjx.adapters.base import BatchAdapter, ObservationSpace
from jetbot_mjx.adapters.batched_env import Flags, Observations, Rewards
from jetbot_mjx.adapters.renderer import RENDER_MODES
from jetbot_mjx.errors import requires_extra

with requires_extra("gymnasium", "the adapter"):
    from gymnasium import spaces
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space


class JetBotVectorEnv(BatchAdapter, VectorEnv):
    """Robots in one compiled program; where an episode ends, the next begins in the same step.

    With `AutoresetMode.SAME_STEP`, `infos` has `final_obs` and `final_info` of the episodes that
    ended, and `obs` is already the next episode's. Every environment draws its goals from a random
    stream of its own, and the same goals as `JetBotGymEnv` draws from the same seed.
    """

    metadata: dict[str, object] = {  # noqa: RUF012
        "render_modes": list(RENDER_MODES),
        "render_fps": 60,
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    def _set_spaces(self, observation: ObservationSpace, action: spaces.Box) -> None:
        self.num_envs = self.batch.num_envs
        self.single_observation_space, self.single_action_space = observation, action
        self.observation_space = batch_space(observation, self.num_envs)
        self.action_space = batch_space(action, self.num_envs)

    def reset(
        self, *, seed: Seed = None, options: dict[str, object] | None = None
    ) -> tuple[Observations, dict[str, object]]:
        """Begin an episode in every environment.

        Args:
          seed: Seed of new random streams; one number counts on from environment to environment.
          options: Not used.

        Returns:
          The first observations, and empty `infos`.

        Raises:
          UserError: There are not as many seeds as environments.
        """
        obs = self.batch.reset(seed)
        self._is_begun = True
        self._show()
        return obs, {}

    def step(
        self, actions: Float[np.ndarray, "n 2"]
    ) -> tuple[Observations, Rewards, Flags, Flags, dict[str, object]]:
        """Step every environment.

        Args:
          actions: Actions in [-1, 1]²; values outside are clipped.

        Returns:
          Observations, rewards, terminated, truncated and `infos`.

        Raises:
          ResetNeeded: There was no `reset` yet.
        """
        self._require_reset("step")
        self.batch.start(actions)
        steps = self.batch.finish()
        done = steps.done
        # The layout is that of Gymnasium's own SyncVectorEnv.
        infos: dict[str, object] = {}
        if done.any():
            final_obs = np.full(self.num_envs, None, object)
            for index in np.flatnonzero(done):
                final_obs[index] = steps.final_obs_of(index)
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
        """Return an image of every robot; None unless the render mode is `rgb_array`.

        Raises:
          ResetNeeded: There was no `reset` yet.
          UserError: This machine has no OpenGL that works without a screen.
        """
        return tuple(self._frames()) if self.render_mode == "rgb_array" else None
