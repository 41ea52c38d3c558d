"""Simulate a single robot and its task with C MuJoCo, which for one robot is faster than MJX.

The model is the one that MJX gets. Everything but physics (goals, positions of solid bodies,
observation, reward, termination) is the code of `JetBotEnv`, compiled by JAX for the CPU.
"""

import copy
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
from jetbot_mjx.envs.robot_model import CONTROLLER_WHEEL_RADIUS, CONTROLLER_WHEEL_SEPARATION
from jetbot_mjx.envs.state import PhysicsState, robot_state
from jetbot_mjx.envs.task import AdvancesGoal, Goal, RobotState, layout_size
from jetbot_mjx.errors import UserError

# MuJoCo prints each of these warnings once per episode and appends it to a file in the working
# directory. They are suppressed, since `Step.finite` reports the same.
_NONFINITE_WARNINGS = [
    int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{name}"))
    for name in ("QPOS", "QVEL", "QACC", "CTRL")
]


class Step(NamedTuple):
    """A `Step` holds the result of one step."""

    obs: Float[np.ndarray, " obs"]
    """Observation after the step."""
    reward: float
    """Reward of the step."""
    terminated: bool
    """Whether the task ended the episode."""
    success: bool
    """Whether the robot has solved the task."""
    finite: bool
    """Whether state, observation and reward are finite; if not, the step was discarded."""


class _Programs(NamedTuple):
    """A `_Programs` holds the model and programs that robots of one configuration share."""

    env: JetBotEnv
    model: mujoco.MjModel
    reset: Any
    """From a key to (first pose, goal, positions of solid bodies, observation, next key)."""
    task_step: Any
    """From (poses and action, goal) to (observation and scalars of the step, goal, positions of
    solid bodies); the last two are None if goals cannot change."""


class MujocoJetBot:
    """A `MujocoJetBot` simulates one robot and its goal."""

    def __init__(self, config: Config, task_class: type[Any] | None = None) -> None:
        """Build the model, and compile the programs of the task.

        Args:
          config: the configuration; `randomization` is ignored.
          task_class: the class of the task; None: the one that `task.name` imports.

        Raises:
          UserError: the task or its scene cannot be built, or the policy sees images.
        """
        if config.task.sees:
            raise UserError(
                f"task.observation = {config.task.observation!r}: one robot in C MuJoCo observes"
                " numbers only, world or egocentric; a batch of robots sees (JetBotVectorEnv,"
                " JetBotVecEnv)"
            )
        programs = _programs(config.model_dump_json(), task_class)
        self.env, self.model, self._reset, self._task_step = programs
        self.data = mujoco.MjData(self.model)
        self.goal: Goal = None
        """Goal of this episode, as it stands now."""
        self._task = config.task
        self._n_substeps = config.physics.n_substeps
        self._goal_advances = isinstance(self.env.task, AdvancesGoal)
        # Views of MuJoCo's arrays.
        self._qpos, self._qvel, self._ctrl = self.data.qpos, self.data.qvel, self.data.ctrl
        self._mocap_pos: Float[np.ndarray, "nmocap 3"] = self.data.mocap_pos.copy()
        self._before = np.concatenate((self._qpos, self._qvel), dtype=np.float32)
        self._obs = np.zeros(layout_size(self.env.task.layout), np.float32)

    def reset(
        self, key: UInt32[np.ndarray, "2"]
    ) -> tuple[Float[np.ndarray, " obs"], UInt32[np.ndarray, "2"]]:
        """Begin the episode that `JetBotEnv.reset` draws from a key.

        Args:
          key: the random key of this episode.

        Returns:
          The first observation, and the key of the next episode.
        """
        pose, self.goal, mocap_pos, obs, next_key = self._reset(key)
        self._before, self._obs = np.array(pose), np.array(obs)
        if mocap_pos is not None:
            self._mocap_pos = np.asarray(mocap_pos)
        self._restore(time=0.0)
        return self._obs.copy(), np.asarray(next_key)

    def step(self, action: Float[np.ndarray, "2"]) -> Step:
        """Make one environment step.

        Args:
          action: the action; values outside [-1, 1] are clipped.
        """
        # Step the physics.
        time = self.data.time
        ctrl = self.wheel_targets(action)
        if not all(map(math.isfinite, ctrl)):
            # MuJoCo would replace these controls by zeros.
            return self._discarded(time)
        self._ctrl[:] = ctrl
        mujoco.mj_step(self.model, self.data, self._n_substeps)
        # Apply the task. Each array passed to or from JAX costs a third of the time of physics,
        # so that all numbers are concatenated.
        given = np.concatenate((self._before, self._qpos, self._qvel, action), dtype=np.float32)
        result, goal, mocap_pos = self._task_step(given, self.goal)
        result = np.array(result)
        reward, terminated, success, finite = result[-4:].tolist()
        if not finite:
            return self._discarded(time)
        self._before, self._obs = given[len(self._before) : -len(action)], result[:-4]
        # Update the goal.
        if self._goal_advances:
            self.goal = goal
            if mocap_pos is not None:
                self._mocap_pos = np.asarray(mocap_pos)
                self.data.mocap_pos[:] = self._mocap_pos
        return Step(self._obs.copy(), reward, terminated > 0, success > 0, True)

    def wheel_targets(self, action: Float[np.ndarray, "2"]) -> tuple[float, float]:
        """Return the wheel speeds (left, right) [rad/s] of an action, before motor limits.

        This is `JetBotEnv.wheel_targets` in Python, since a call of JAX takes as long as physics.

        Args:
          action: the action; values outside [-1, 1] are clipped.
        """
        # These comparisons keep NaN, as `jnp.clip` does.
        drive, turn = (-1.0 if x < -1.0 else 1.0 if x > 1.0 else x for x in action.tolist())
        speed = 0.5 * (drive + 1.0) * self._task.max_speed
        half = 0.5 * turn * self._task.max_yaw_rate * CONTROLLER_WHEEL_SEPARATION
        return (speed - half) / CONTROLLER_WHEEL_RADIUS, (speed + half) / CONTROLLER_WHEEL_RADIUS

    def _discarded(self, time: float) -> Step:
        """Restore the state before a non-finite step, and return its result."""
        self._restore(time)
        return Step(self._obs.copy(), 0.0, False, False, False)

    def _restore(self, time: float) -> None:
        """Set robot and solid bodies to their last finite state."""
        mujoco.mj_resetData(self.model, self.data)
        self._qpos[:], self._qvel[:] = np.split(self._before, [self.model.nq])
        self.data.mocap_pos[:] = self._mocap_pos
        self.data.time = time
        self.data.warning.number[_NONFINITE_WARNINGS] = 1


@functools.lru_cache(maxsize=8)
def _programs(settings: str, task_class: type[Any] | None) -> _Programs:
    """Build the environment, model and programs of a configuration.

    Args:
      settings: the configuration as JSON, since a `Config` is not hashable.
      task_class: as for `MujocoJetBot`.
    """
    config = Config.model_validate_json(settings)
    env = make_env(config, task_class)
    # Leave non-finite states to `MujocoJetBot`, which counts them.
    model = copy.copy(env.physics.mj_model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    nq, size = model.nq, model.nq + model.nv

    def reset(key: UInt32[Array, "2"]) -> tuple[Any, ...]:
        state = env.reset(key)
        pose = jnp.concatenate([state.pipeline_state.qpos, state.pipeline_state.qvel])
        return pose, state.goal, env.mocap_positions(state.goal), state.obs, state.key

    def robot_of(pose: Float[Array, " n"]) -> RobotState:
        time = jnp.zeros(())
        return robot_state(PhysicsState(pose[:nq], pose[nq:], jnp.zeros(model.nv), time))

    def task_step(given: Float[Array, " n"], goal: Goal) -> tuple[Array, Goal, Array | None]:
        before, after, action = jnp.split(given, [size, 2 * size])
        task = env.task_step(robot_of(before), robot_of(after), goal, action)
        finite = jnp.isfinite(jnp.concatenate([after, task.obs, task.reward[None]])).all()
        scalars = jnp.stack([task.reward, task.terminated, task.success, finite])
        result = jnp.concatenate([task.obs, scalars])
        if not isinstance(env.task, AdvancesGoal):
            return result, None, None
        return result, task.goal, env.mocap_positions(task.goal)

    # Compile for the CPU: on a GPU, every call would wait for the device.
    with default_device_cpu():
        key, given = np.zeros(2, np.uint32), np.zeros(2 * size + env.action_size, np.float32)
        reset_program = jax.jit(reset).lower(key).compile()
        task_program = jax.jit(task_step).lower(given, reset_program(key)[1]).compile()
    return _Programs(env, model, reset_program, task_program)
