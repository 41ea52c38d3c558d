"""One robot as a `gymnasium.Env`, registered as `JetBot-v0`."""

import numpy as np
from jaxtyping import Float, UInt8

from jetbot_mjx.adapters.arguments import ResetKeys, Source, as_actions
from jetbot_mjx.adapters.base import AdapterBase
from jetbot_mjx.adapters.batched_env import unwrap_single
from jetbot_mjx.adapters.renderer import RENDER_MODES, Pose
from jetbot_mjx.envs import MujocoJetBot, Observation
from jetbot_mjx.errors import UserError, requires_extra

with requires_extra("gymnasium", "the adapter"):
    import gymnasium


class JetBotGymEnv(AdapterBase, gymnasium.Env):
    """One robot, with the tutorial's constructor; physics runs in C MuJoCo (`MujocoJetBot`).

    Action, observation, reward and termination are those of `jetbot_mjx.JetBotEnv`, images too:
    `observation_space` of the module `base` describes the spaces. `terminated` is the task's end,
    `truncated` the time limit, which the environment counts itself; `info` has `is_success`. A step
    to a non-finite state is truncated with reward 0, and `info` then has `nonfinite_world`. Without
    a seed `reset` continues the random stream that the first one began.
    """

    metadata: dict[str, object] = {"render_modes": list(RENDER_MODES), "render_fps": 60}  # noqa: RUF012

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
        """Build the MuJoCo model, and compile the task's functions.

        Args:
          skip_frame: Number of `physics_dt` in one environment step.
          physics_dt: Simulated time [s], divided into equal physics steps no longer than
            `physics.sim_dt`; default: `physics.ctrl_dt`, 1/60.
          rendering_dt: Simulated time between two frames in a window [s]; default: one frame for
            every step.
          max_episode_length: Environment steps after which an episode is truncated; default:
            `task.episode_length`, 256.
          seed: Seed of the first episode, where `reset` is given none; None draws another seed
            every time.
          headless: False makes `human` the render mode, where none is given.
          render_mode: `human` renders in a window, in real time; `rgb_array` when `render` is
            called.
          config: A YAML file, nested settings or a `Config` with all other settings; default: the
            tutorial's.

        Raises:
          UserError: An argument or setting is wrong, the configuration randomizes the robot, or
            there is no display for a window.
        """
        given = skip_frame, physics_dt, rendering_dt, max_episode_length, headless, render_mode
        self._configure(config, given)
        if drawn := ", ".join(self.config.randomization.drawn):
            raise UserError(
                f"randomization.{drawn}: this environment has the preset's robot only: use"
                " JetBotVectorEnv, with num_envs=1 for one robot"
            )
        self.robot = MujocoJetBot(self.config)
        self.observation_space, self.action_space = self._prepare(self.robot.env)
        self._reset_keys = ResetKeys(seed, 1)
        self._next_key = None
        self._steps = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, object] | None = None
    ) -> tuple[Observation, dict[str, object]]:
        """Begin an episode: the robot at rest at the origin, a new goal.

        Args:
          seed: Seed of a new random stream; None continues the one that there is.
          options: Not used.

        Returns:
          The first observation, and an empty `info`.
        """
        super().reset(seed=seed)
        (key,) = self._reset_keys(seed, self._next_key)
        obs, next_key = self.robot.reset(key)
        self._next_key = next_key[None]
        self._is_begun, self._steps = True, 0
        self._show()
        return unwrap_single(obs), {}

    def step(
        self, action: Float[np.ndarray, "2"]
    ) -> tuple[Observation, float, bool, bool, dict[str, object]]:
        """Apply an action for one environment step.

        Args:
          action: Action in [-1, 1]²; values outside are clipped.

        Returns:
          Observation, reward, terminated, truncated and `info` with `is_success`.

        Raises:
          ResetNeeded: There was no `reset` yet.
        """
        self._require_reset("step")
        obs, reward, terminated, success, finite = self.robot.step(
            as_actions(action, (self.robot.env.action_size,))
        )
        self._steps += 1
        out_of_time = self._steps >= self.config.task.episode_length
        truncated = not terminated and (out_of_time or not finite)
        info: dict[str, object] = {"is_success": success}
        if not finite:
            info["nonfinite_world"] = True
        self._show()
        return unwrap_single(obs), reward, terminated, truncated, info

    def render(self) -> UInt8[np.ndarray, "height width 3"] | None:
        """Return an image of the robot and its goal; None unless the mode is `rgb_array`.

        Raises:
          ResetNeeded: There was no `reset` yet.
          UserError: This machine has no OpenGL that works without a screen.
        """
        return self._frames()[0] if self.render_mode == "rgb_array" else None

    def _poses(self) -> list[Pose]:
        now = self._steps * self.config.physics.ctrl_dt
        return [Pose(self.robot.data.qpos, self.robot.goal, now)]
