"""Any number of robots as a `VecEnv` of Stable-Baselines3, over the batched MJX environment."""

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float, UInt8

from jetbot_mjx.adapters.base import BatchAdapter, ObservationSpace, spaces
from jetbot_mjx.adapters.batched_env import Flags, Observations, Rewards
from jetbot_mjx.envs import JetBotEnv
from jetbot_mjx.errors import UserError, requires_extra

with requires_extra("sb3", "the adapter"):
    from stable_baselines3.common.vec_env import VecEnv  # pyright: ignore[reportMissingImports]

Indices = None | int | Iterable[int]


class JetBotVecEnv(BatchAdapter, VecEnv):
    """Robots in one compiled program, for example in `PPO("MlpPolicy", JetBotVecEnv(64))`.

    Where an episode ends, its `info` has `terminal_observation`, `is_success` and
    `TimeLimit.truncated`, by which Stable-Baselines3 bootstraps, and the observation is already
    the next episode's. Without a seed `reset` continues the random streams of the environments.
    """

    def _set_spaces(self, observation: ObservationSpace, action: spaces.Box) -> None:
        self._attributes: dict[str, list[object]] = {}
        metadata = self.metadata
        VecEnv.__init__(self, self.batch.num_envs, observation, action)
        # `VecEnv` leaves nothing but the render mode in it.
        self.metadata = metadata

    def reset(self) -> Observations:
        """Begin an episode in every environment, with the seeds that `seed` was called with.

        Returns:
          The first observations.
        """
        obs = self.batch.reset(self._seeds)
        self._is_begun = True
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = [{} for _ in range(self.num_envs)]
        self._show()
        return obs

    def step_async(self, actions: Float[np.ndarray, "n 2"]) -> None:
        """Start a step on the device, without waiting for it.

        Args:
          actions: Actions in [-1, 1]²; values outside are clipped.

        Raises:
          ResetNeeded: There was no `reset` yet.
        """
        self._require_reset("step")
        self.batch.start(actions)

    def step_wait(self) -> tuple[Observations, Rewards, Flags, list[dict[str, object]]]:
        """Wait for the step that `step_async` began.

        Returns:
          Observations, rewards, dones, and an `info` for each environment.
        """
        steps = self.batch.finish()
        done = steps.done
        infos: list[dict[str, object]] = [{} for _ in range(self.num_envs)]
        for index in np.flatnonzero(done):
            infos[index] = {
                "terminal_observation": steps.final_obs_of(index),
                "TimeLimit.truncated": bool(steps.truncated[index]),
                "is_success": bool(steps.success[index]),
            }
        for index in np.flatnonzero(steps.nonfinite):
            infos[index]["nonfinite_world"] = True
        self._show()
        return steps.obs, steps.reward, done, infos

    def get_images(self) -> Sequence[UInt8[np.ndarray, "height width 3"]]:
        """Return an image of every robot.

        Raises:
          ResetNeeded: There was no `reset` yet.
          UserError: This machine has no OpenGL that works without a screen.
        """
        return self._frames()

    def render(self, mode: str | None = None) -> UInt8[np.ndarray, "height width 3"] | None:
        """Return all robots in one image; None in mode `human`, whose window every step updates."""
        return None if self.render_mode == "human" else super().render(mode)

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[object]:
        """Return an attribute that `set_attr` set, or that the environments share.

        Args:
          attr_name: Name of the attribute, such as `config` or `dt`.
          indices: Indices of the environments to ask; None: all.

        Returns:
          The value in each of these environments.

        Raises:
          AttributeError: There is no such attribute.
        """
        chosen = self._get_indices(indices)
        if attr_name in self._attributes:
            return [self._attributes[attr_name][index] for index in chosen]
        value = getattr(self._owner_of(attr_name), attr_name)
        return [value for _ in chosen]

    def set_attr(self, attr_name: str, value: object, indices: Indices = None) -> None:
        """Store a value for `get_attr`. The compiled program does not see it.

        Args:
          attr_name: Name of the attribute.
          value: The value, the same for each of these environments.
          indices: Indices of the environments to set; None: all. Unset ones have None.

        Raises:
          UserError: The environments have an attribute of this name themselves.
        """
        if self.has_attr(attr_name) and attr_name not in self._attributes:
            raise UserError(
                f"{attr_name} cannot be set: the environments are one compiled program;"
                " build others with config="
            )
        values = self._attributes.setdefault(attr_name, [None] * self.num_envs)
        for index in self._get_indices(indices):
            values[index] = value

    def env_method(
        self,
        method_name: str,
        *method_args: object,
        indices: Indices = None,
        **method_kwargs: object,
    ) -> list[object]:
        """Call a method that the environments share, such as `wheel_targets`.

        Args:
          method_name: Name of a method of `JetBotEnv`.
          method_args: Positional arguments of the call.
          indices: Indices of the environments; None: all.
          method_kwargs: Keyword arguments of the call.

        Returns:
          The result of the call, once for each of these environments.

        Raises:
          AttributeError: There is no such method.
        """
        method = getattr(self._owner_of(method_name), method_name)
        return [method(*method_args, **method_kwargs) for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type, indices: Indices = None) -> list[bool]:
        """Return False for every environment: wrappers such as `VecMonitor` hold the batch."""
        return [False for _ in self._get_indices(indices)]

    def _owner_of(self, name: str) -> "JetBotVecEnv | JetBotEnv":
        """Return what has an attribute that the environments share."""
        return self if name in ("render_mode", "config") else self.batch.env

    def close(self) -> None:
        """Close the renderer; the base class of Stable-Baselines3 has nothing to close."""
        self._close_renderer()
