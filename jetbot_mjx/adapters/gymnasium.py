"""One robot as a `gymnasium.Env`, registered as `JetBot-v0`."""

from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from jetbot_mjx.adapters.arguments import (
    Arguments,
    Source,
    an_extra,
    as_actions,
    key_from_seed,
    resolve,
    seeds_of,
)
from jetbot_mjx.adapters.renderer import RENDER_MODES
from jetbot_mjx.compiler.program_cache import use_compilation_cache
from jetbot_mjx.config import Config
from jetbot_mjx.envs.mujoco_env import MujocoJetBot
from jetbot_mjx.errors import UserError

with an_extra("gymnasium"):
    import gymnasium
    from gymnasium import spaces

ENV_ID = "JetBot-v0"


class JetBotGymEnv(gymnasium.Env):
    """One robot, with the tutorial's constructor; physics is C MuJoCo's (`mujoco_jetbot`).

    Action, observation, reward and the end are those of `jetbot_mjx.JetBotEnv`. `terminated` is
    the task's end, `truncated` the time limit, which the environment keeps itself; `info` has
    `is_success`. A world that blows up is truncated without a reward, and `info` then has
    `nonfinite_world`. Without a seed `reset` goes on with the random stream that the first one
    began.
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 60}  # noqa: RUF012

    def __init__(
        self,
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
        """Build the model, and compiles what is not physics.

        Args:
          skip_frame: `physics_dt` in one environment step.
          physics_dt: [s] default: `physics.ctrl_dt`, 1/60; made in equal physics steps, none of
            them longer than `physics.sim_dt`.
          rendering_dt: [s] of simulated time between two pictures in a window; default: one for
            every step.
          max_episode_length: environment steps after which an episode is truncated; default:
            `task.episode_length`, 256.
          seed: of the first episode, where `reset` is given none; None: something else every time.
          headless: False: `render_mode` is `human`, where none is given.
          render_mode: `human`: in a window, in real time; `rgb_array`: as `render` is called.
          config: a YAML file, nested settings or a `Config` for all else; default: the tutorial's.

        Raises:
          UserError: an argument or setting is wrong, robots are to be drawn for every episode, or
            there is no display for a window.
        """
        given = Arguments(
            skip_frame, physics_dt, rendering_dt, max_episode_length, headless, render_mode
        )
        settings = resolve(given, config)
        self.config: Config = settings.config
        """What the environment was built from."""
        if drawn := ", ".join(self.config.randomization.drawn):
            raise UserError(
                f"randomization.{drawn}: the single robot is the preset's; take JetBotVectorEnv, of"
                " one robot if need be"
            )
        # Who comes from elsewhere has no reason to know that JAX would compile at every start.
        use_compilation_cache()
        self.robot = MujocoJetBot(settings.config)
        self.render_mode = settings.render_mode
        self._view = settings.view(self.robot.env)
        self.metadata = {**type(self).metadata, **settings.metadata}
        self.observation_space = spaces.Box(-np.inf, np.inf, (self.robot.env.observation_size,))
        self.action_space = spaces.Box(-1.0, 1.0, (self.robot.env.action_size,))
        (self._first_seed,) = seeds_of(seed, 1)
        self._next_key = None
        self._steps = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Float[np.ndarray, " obs"], dict[str, Any]]:
        """Begin an episode: the robot at rest at the origin, a new goal.

        Args:
          seed: begins a new random stream.
          options: none are known.

        Returns:
          The first observation, and nothing else to tell.
        """
        super().reset(seed=seed)
        key = self._next_key
        if seed is not None or key is None:
            key = key_from_seed(self._first_seed if seed is None else seed)
        obs, self._next_key = self.robot.reset(key)
        self._steps = 0
        self._show()
        return obs, {}

    def step(
        self, action: Float[np.ndarray, "2"]
    ) -> tuple[Float[np.ndarray, " obs"], float, bool, bool, dict[str, Any]]:
        """Hold an action for one environment step.

        Args:
          action: in [-1, 1]²; values outside are clipped.

        Returns:
          Observation, reward, terminated, truncated and `is_success`.

        Raises:
          ResetNeeded: there was no `reset` yet.
        """
        if self._next_key is None:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        obs, reward, terminated, success, finite = self.robot.step(as_actions(action, (2,)))
        self._steps += 1
        out_of_time = self._steps >= self.config.task.episode_length
        truncated = not terminated and (out_of_time or not finite)
        info = {"is_success": success}
        if not finite:
            info["nonfinite_world"] = True
        self._show()
        return obs, reward, terminated, truncated, info

    def render(self) -> UInt8[np.ndarray, "height width 3"] | None:
        """Return an image from the following camera; None unless asked for `rgb_array`.

        Raises:
          ResetNeeded: there was no `reset` yet.
          UserError: this machine has no OpenGL that works without a screen.
        """
        if self.render_mode != "rgb_array":
            return None
        if self._next_key is None:
            raise gymnasium.error.ResetNeeded("call reset() before render()")
        assert self._view is not None
        return self._view.frame(self.robot.data.qpos, self.robot.goal)

    def close(self) -> None:
        """Close what was opened to show the robot."""
        if self._view is not None:
            self._view.close()

    def _show(self) -> None:
        if self.render_mode == "human":
            assert self._view is not None
            now = self._steps * self.config.physics.ctrl_dt
            self._view.show(self.robot.data.qpos, self.robot.goal, now)


def _register() -> None:
    gymnasium.register(
        ENV_ID,
        entry_point=f"{__name__}:{JetBotGymEnv.__name__}",
        vector_entry_point="jetbot_mjx.adapters.vector:JetBotVectorEnv",
    )


_register()
