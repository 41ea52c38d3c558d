"""One robot in C MuJoCo and its task, one step at a time: MJX takes several times as long for one.

The model is the one that MJX is given. All that is not physics, the draw of the goal, where solid
bodies stand, observation, reward, the end and the next goal, is the environment's own code,
compiled by JAX for the CPU.
"""

import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float, UInt32

from jetbot_mjx.compiler.xla_options import default_device_cpu
from jetbot_mjx.config import Config
from jetbot_mjx.envs.jetbot_env import JetBotEnv, make_env
from jetbot_mjx.envs.robot_model import (
    CONTROLLER_WHEEL_RADIUS,
    CONTROLLER_WHEEL_SEPARATION,
    ROBOTS,
    make_mj_model,
)
from jetbot_mjx.envs.state import PhysicsState, robot_state
from jetbot_mjx.envs.task import AdvancesGoal, Goal, RobotState

# MuJoCo prints the first of each of these in an episode, and appends it to a file in the folder
# that the program runs in. `Step.finite` tells them instead.
_NONFINITE = [
    int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{name}"))
    for name in ("QPOS", "QVEL", "QACC", "CTRL")
]


class Step(NamedTuple):
    """The result of one step."""

    obs: Float[np.ndarray, " obs"]
    reward: float
    terminated: bool
    success: bool
    finite: bool
    """Whether state, observation and reward are finite; where not, no step was taken."""


class _Programs(NamedTuple):
    """The programs and models that robots of one configuration share."""

    env: JetBotEnv
    model: mujoco.MjModel
    begin: Any
    """From a key to the first pose, goal, solid bodies' places and observation, and a key."""
    judge: Any
    """From poses, action and goal to the step's numbers; goal and places, if they can change."""


class MujocoJetBot:
    """A robot and its goal."""

    def __init__(self, config: Config) -> None:
        """Build the model, and compiles what is not physics.

        Args:
          config: robot, task and physics; of `randomization` nothing is drawn.

        Raises:
          UserError: the task cannot be built.
        """
        self.env, self.model, self._begin, self._judge = _programs(config.model_dump_json())
        self.data = mujoco.MjData(self.model)
        self.goal: Goal = None
        """Goal of this episode, as it stands."""
        self._task = config.task
        self._n_substeps = config.physics.n_substeps
        self._goal_advances = isinstance(self.env.task, AdvancesGoal)
        # Views, which stay true while MuJoCo steps.
        self._qpos, self._qvel, self._ctrl = self.data.qpos, self.data.qvel, self.data.ctrl
        self._mocap_pos: Float[np.ndarray, "nmocap 3"] = self.data.mocap_pos.copy()
        self._before = self._pose()
        self._obs = np.zeros(self.env.observation_size, np.float32)

    def reset(
        self, key: UInt32[np.ndarray, "2"]
    ) -> tuple[Float[np.ndarray, " obs"], UInt32[np.ndarray, "2"]]:
        """Begin the episode that `JetBotEnv.reset` draws from a key.

        Args:
          key: of this episode.

        Returns:
          The first observation, and the key of the next episode.
        """
        pose, self.goal, mocap_pos, obs, next_key = self._begin(key)
        self._before, self._obs = np.array(pose), np.array(obs)
        if mocap_pos is not None:
            self._mocap_pos = np.asarray(mocap_pos)
        self._place(time=0.0)
        return self._obs.copy(), np.asarray(next_key)

    def step(self, action: Float[np.ndarray, "2"]) -> Step:
        """Hold an action for one environment step.

        Args:
          action: in [-1, 1]²; values outside are clipped.

        Returns:
          What came of it.
        """
        time = self.data.time
        ctrl = self.wheel_targets(action)
        if not all(map(math.isfinite, ctrl)):
            # MuJoCo would stop the motors instead.
            return self._discarded(time)
        self._ctrl[:] = ctrl
        mujoco.mj_step(self.model, self.data, self._n_substeps)
        # One array in and one out: every array more costs a third as much as physics.
        given = np.concatenate((self._before, self._qpos, self._qvel, action), dtype=np.float32)
        judged, goal, mocap_pos = self._judge(given, self.goal)
        judged = np.array(judged)
        reward, terminated, success, finite = judged[-4:].tolist()
        if not finite:
            return self._discarded(time)
        self._before, self._obs = given[len(self._before) : -len(action)], judged[:-4]
        if self._goal_advances:
            self.goal = goal
            if mocap_pos is not None:
                self._mocap_pos = np.asarray(mocap_pos)
                self.data.mocap_pos[:] = self._mocap_pos
        return Step(self._obs.copy(), reward, terminated > 0, success > 0, True)

    def wheel_targets(self, action: Float[np.ndarray, "2"]) -> tuple[float, float]:
        """Wheel speeds (left, right) [rad/s] that an action commands, before motor limits.

        `JetBotEnv.wheel_targets` in plain numbers, for a call of JAX would take as long as physics.
        """
        # Comparisons let through what is not a number, as `jnp.clip` does.
        drive, turn = (-1.0 if x < -1.0 else 1.0 if x > 1.0 else x for x in action.tolist())
        speed = 0.5 * (drive + 1.0) * self._task.max_speed
        half = 0.5 * turn * self._task.max_yaw_rate * CONTROLLER_WHEEL_SEPARATION
        return (speed - half) / CONTROLLER_WHEEL_RADIUS, (speed + half) / CONTROLLER_WHEEL_RADIUS

    def _discarded(self, time: float) -> Step:
        """Return the step that is not taken, because it would not be finite."""
        self._place(time)
        return Step(self._obs.copy(), 0.0, False, False, False)

    def _place(self, time: float) -> None:
        """Put robot and solid bodies where they were last known to be."""
        mujoco.mj_resetData(self.model, self.data)
        self._qpos[:], self._qvel[:] = np.split(self._before, [self.model.nq])
        self.data.mocap_pos[:] = self._mocap_pos
        self.data.time = time
        self.data.warning.number[_NONFINITE] = 1

    def _pose(self) -> Float[np.ndarray, " nq+nv"]:
        return np.concatenate((self._qpos, self._qvel), dtype=np.float32)


@functools.lru_cache(maxsize=8)
def _programs(settings: str) -> _Programs:
    """Environment, model and programs of a configuration, given as JSON: it has no hash."""
    config = Config.model_validate_json(settings)
    env = make_env(config)
    model = make_mj_model(
        ROBOTS[config.robot.preset],
        config.physics,
        build_scene=env.task.build_scene,
        visual=False,
    )
    # A state that is not finite is ours to tell; MuJoCo would put the robot back without a word.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    nq, size = model.nq, model.nq + model.nv

    def begin(key: UInt32[Array, "2"]) -> tuple[Any, ...]:
        state = env.reset(key)
        pose = jnp.concatenate([state.pipeline_state.qpos, state.pipeline_state.qvel])
        return pose, state.goal, env.mocap_positions(state.goal), state.obs, state.key

    def robot_of(pose: Float[Array, " n"]) -> RobotState:
        nothing = jnp.zeros(())
        return robot_state(PhysicsState(pose[:nq], pose[nq:], jnp.zeros(model.nv), nothing))

    def judge(given: Float[Array, " n"], goal: Goal) -> tuple[Array, Goal, Array | None]:
        before, after, action = jnp.split(given, [size, 2 * size])
        task = env.task_step(robot_of(before), robot_of(after), goal, action)
        finite = jnp.isfinite(jnp.concatenate([after, task.obs, task.reward[None]])).all()
        numbers = jnp.stack([task.reward, task.terminated, task.success, finite])
        judged = jnp.concatenate([task.obs, numbers])
        if not isinstance(env.task, AdvancesGoal):
            return judged, None, None
        return judged, task.goal, env.mocap_positions(task.goal)

    # On a GPU every call would wait for the device.
    with default_device_cpu():
        key, given = np.zeros(2, np.uint32), np.zeros(2 * size + env.action_size, np.float32)
        begin_program = jax.jit(begin).lower(key).compile()
        judge_program = jax.jit(judge).lower(given, begin_program(key)[1]).compile()
    return _Programs(env, model, begin_program, judge_program)
