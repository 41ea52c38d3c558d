"""Any number of robots as a `VecEnv` of Stable-Baselines3, over the batched MJX environment."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, UInt8

from jetbot_mjx.adapters.arguments import Arguments, Source, an_extra, check_num_envs, resolve
from jetbot_mjx.adapters.batched_env import BatchedEnv
from jetbot_mjx.config import Config
from jetbot_mjx.errors import UserError

with an_extra("sb3"):
    import gymnasium
    from gymnasium import spaces
    from stable_baselines3.common.vec_env import VecEnv  # pyright: ignore[reportMissingImports]

Indices = None | int | Iterable[int]


class JetBotVecEnv(VecEnv):
    """Robots in one compiled program, for `PPO("MlpPolicy", JetBotVecEnv(64))` and its like.

    Where an episode ends, its `info` has `terminal_observation`, `is_success` and
    `TimeLimit.truncated`, by which Stable-Baselines3 bootstraps, and the observation is already
    the next episode's. Without a seed `reset` goes on with the random streams of the
    environments.
    """

    def __init__(
        self,
        num_envs: int = 1,
        skip_frame: int = 1,
        physics_dt: float | None = None,
        rendering_dt: float | None = None,
        max_episode_length: int | None = None,
        seed: int | None = 0,
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
          seed: of the first episodes, where nobody calls `seed`; it counts on from environment to
            environment.
          headless: likewise; a window shows the first robot.
          render_mode: `human`, or `rgb_array`: one picture of all robots, side by side.
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
        self.render_mode = settings.render_mode
        self.batch = BatchedEnv(settings.config, check_num_envs(num_envs), seed)
        self._view = settings.view(self.batch.env)
        self._attributes: dict[str, list[Any]] = {}
        env = self.batch.env
        super().__init__(
            self.batch.num_envs,
            spaces.Box(-np.inf, np.inf, (env.observation_size,)),
            spaces.Box(-1.0, 1.0, (env.action_size,)),
        )
        self.metadata: dict[str, Any] = {**self.metadata, **settings.metadata}

    def reset(self) -> Float[np.ndarray, "n obs"]:
        """Begin an episode in every environment, with the seeds that `seed` was called with.

        Returns:
          The first observations.
        """
        obs = self.batch.reset(self._seeds)
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = [{} for _ in range(self.num_envs)]
        self._show()
        return obs

    def step_async(self, actions: Float[np.ndarray, "n 2"]) -> None:
        """Let the device begin a step, and does not wait for it.

        Args:
          actions: in [-1, 1]²; values outside are clipped.

        Raises:
          ResetNeeded: there was no `reset` yet.
        """
        self._require_reset("step")
        self.batch.start(actions)

    def step_wait(
        self,
    ) -> tuple[
        Float[np.ndarray, "n obs"],
        Float[np.ndarray, " n"],
        Bool[np.ndarray, " n"],
        list[dict[str, Any]],
    ]:
        """Wait for the step that `step_async` began.

        Returns:
          Observations, rewards, where an episode ended, and what there is to tell of each.
        """
        steps = self.batch.finish()
        done = steps.done
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for index in np.flatnonzero(done):
            infos[index] = {
                "terminal_observation": steps.final_obs[index],
                "TimeLimit.truncated": bool(steps.truncated[index]),
                "is_success": bool(steps.success[index]),
            }
        for index in np.flatnonzero(steps.nonfinite):
            infos[index]["nonfinite_world"] = True
        self._show()
        return steps.obs, steps.reward, done, infos

    def close(self) -> None:
        """Close what was opened to show the robots."""
        if self._view is not None:
            self._view.close()

    def get_images(self) -> Sequence[UInt8[np.ndarray, "height width 3"]]:
        """Return a picture of every robot.

        Raises:
          ResetNeeded: there was no `reset` yet.
          UserError: this machine has no OpenGL that works without a screen.
        """
        self._require_reset("render")
        assert self._view is not None, "asked for pictures without a render_mode"
        return [self._view.frame(pose.qpos, pose.goal) for pose in self.batch.poses()]

    def render(self, mode: str | None = None) -> UInt8[np.ndarray, "height width 3"] | None:
        """Return all robots in one image; None where a window shows the first, in every step."""
        return None if self.render_mode == "human" else super().render(mode)

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """Return an attribute of the environments: set by `set_attr`, or what they share.

        Args:
          attr_name: its name, such as `config` or `dt`.
          indices: of which environments; None: all.

        Returns:
          Its value in each of them.

        Raises:
          AttributeError: there is no such attribute.
        """
        chosen = self._get_indices(indices)
        if attr_name in self._attributes:
            return [self._attributes[attr_name][index] for index in chosen]
        value = self._shared(attr_name)
        return [value for _ in chosen]

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Keep a value for `get_attr`. The program is compiled: nothing in it changes.

        Args:
          attr_name: its name.
          value: for each of the environments.
          indices: of which environments; None: all, and others have None.

        Raises:
          UserError: it is something that the environments are made of.
        """
        if self.has_attr(attr_name) and attr_name not in self._attributes:
            raise UserError(
                f"{attr_name} cannot be set: the environments are one compiled program;"
                " build others with config="
            )
        kept = self._attributes.setdefault(attr_name, [None] * self.num_envs)
        for index in self._get_indices(indices):
            kept[index] = value

    def env_method(
        self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method that the environments share, such as `wheel_targets`.

        Args:
          method_name: of `JetBotEnv` or of this class.
          method_args: handed on.
          indices: for which environments; None: all.
          method_kwargs: handed on.

        Returns:
          What it returned, once for each of them.

        Raises:
          AttributeError: there is no such method.
        """
        method = self._shared(method_name)
        return [method(*method_args, **method_kwargs) for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type, indices: Indices = None) -> list[bool]:
        """No environment is wrapped; `VecMonitor` goes around all of them."""
        del wrapper_class
        return [False for _ in self._get_indices(indices)]

    def _require_reset(self, method: str) -> None:
        if not self.batch.is_begun:
            raise gymnasium.error.ResetNeeded(f"call reset() before {method}()")

    def _shared(self, name: str) -> Any:
        if name in ("render_mode", "config"):
            return getattr(self, name)
        return getattr(self.batch.env, name)

    def _show(self) -> None:
        if self.render_mode == "human":
            assert self._view is not None
            pose = self.batch.poses()[0]
            self._view.show(pose.qpos, pose.goal, float(pose.time))
