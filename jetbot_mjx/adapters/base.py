"""The construction and the rendering that all adapters share."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import UInt8

from jetbot_mjx.adapters.arguments import Seed, Source, TutorialArguments, resolve
from jetbot_mjx.adapters.batched_env import BatchedEnv
from jetbot_mjx.adapters.renderer import RENDER_MODES, FrameRenderer, Pose, is_available
from jetbot_mjx.agents import is_image
from jetbot_mjx.config import Config
from jetbot_mjx.devices import use_compilation_cache
from jetbot_mjx.envs import JetBotEnv
from jetbot_mjx.errors import requires_extra

with requires_extra("gymnasium", "the adapter"):
    import gymnasium
    from gymnasium import spaces


ObservationSpace = spaces.Box | spaces.Dict


def observation_space(size: int | Mapping[str, tuple[int, ...]]) -> ObservationSpace:
    """Return the space of an observation: a `Box`, or a `Dict` if numbers stand beside an image.

    Images are uint8 of shape (height, width, channels), 0 to 255, as Stable-Baselines3 expects
    them.

    Args:
      size: the length of the vector, or the shapes of the parts.
    """
    if isinstance(size, int):
        return spaces.Box(-np.inf, np.inf, (size,))
    parts = {
        name: spaces.Box(0, 255, shape, np.uint8)
        if is_image(name)
        else spaces.Box(-np.inf, np.inf, shape)
        for name, shape in size.items()
    }
    return next(iter(parts.values())) if len(parts) == 1 else spaces.Dict({**parts})


class AdapterBase:
    """The base of the adapters.

    A constructor calls `_configure`, builds its simulation from `config`, and calls `_prepare`.
    """

    metadata: dict[str, object]
    config: Config
    """The configuration that the environment is built from."""
    render_mode: str | None
    _renderer: FrameRenderer | None
    _is_begun = False
    """Whether there was a `reset`; the subclass sets it."""

    def _configure(self, config: Source, given: TutorialArguments) -> None:
        """Set `config` and `render_mode`.

        Args:
          config: The constructor's `config`.
          given: The constructor's arguments from the tutorial.

        Raises:
          UserError: An argument or setting is wrong.
        """
        self.config, self.render_mode, self._rendering_dt = resolve(config, given)
        # A script that imports an adapter has no other reason to set up JAX's cache.
        use_compilation_cache()

    def _prepare(self, env: JetBotEnv) -> tuple[ObservationSpace, spaces.Box]:
        """Build the renderer, and set `metadata`.

        Args:
          env: The environment of the simulation.

        Returns:
          The observation and action space of one robot.

        Raises:
          UserError: There is no display for a window.
        """
        mode = self.render_mode
        self._renderer = FrameRenderer(env, mode, self._rendering_dt) if mode else None
        self.metadata = {
            **getattr(type(self), "metadata", {}),
            "render_modes": [one for one in RENDER_MODES if one == mode or is_available(one)],
            "render_fps": max(1, round(1 / self.config.physics.ctrl_dt)),
        }
        return observation_space(env.observation_size), spaces.Box(-1.0, 1.0, (env.action_size,))

    def _poses(self) -> list[Pose]:
        """Return the pose of every robot."""
        raise NotImplementedError

    def _require_reset(self, method: str) -> None:
        if not self._is_begun:
            raise gymnasium.error.ResetNeeded(f"call reset() before {method}()")

    def _frames(self) -> list[UInt8[np.ndarray, "height width 3"]]:
        """Return an image of every robot.

        Raises:
          ResetNeeded: There was no `reset` yet.
          UserError: This machine has no OpenGL that works without a screen.
        """
        self._require_reset("render")
        assert self._renderer is not None, "images need a render_mode"
        return [self._renderer.frame(pose) for pose in self._poses()]

    def _show(self) -> None:
        """Show the first robot where the render mode is `human`."""
        if self.render_mode == "human":
            assert self._renderer is not None
            self._renderer.show(self._poses()[0])

    def _close_renderer(self) -> None:
        if self._renderer is not None:
            self._renderer.close()

    def close(self) -> None:
        """Close the renderer, and what Gymnasium's own class has open."""
        self._close_renderer()
        super().close()  # pyright: ignore[reportAttributeAccessIssue]


class BatchAdapter(AdapterBase):
    """The base of the adapters of several robots, which run in one compiled program."""

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
          num_envs: Number of robots.
          skip_frame: See `JetBotGymEnv`, as for all arguments that are not explained here.
          physics_dt: See `JetBotGymEnv`.
          rendering_dt: See `JetBotGymEnv`.
          max_episode_length: See `JetBotGymEnv`.
          seed: Seed of the first episodes; one number counts on from environment to environment.
          headless: See `JetBotGymEnv`; a window shows the first robot.
          render_mode: `human`, or `rgb_array` for images of every robot.
          config: See `JetBotGymEnv`.

        Raises:
          UserError: An argument or setting is wrong, or there is no display for a window.
        """
        given = skip_frame, physics_dt, rendering_dt, max_episode_length, headless, render_mode
        self._configure(config, given)
        self.batch = BatchedEnv(self.config, num_envs, seed)
        self._set_spaces(*self._prepare(self.batch.env))

    def _set_spaces(self, observation: ObservationSpace, action: spaces.Box) -> None:
        """Set the attributes of the environment's class from the spaces of one robot."""
        raise NotImplementedError

    def _poses(self) -> list[Pose]:
        return self.batch.poses()
