"""Simulate a single robot and its task with C MuJoCo, which for one robot is faster than MJX.

The model is the one that MJX gets. Everything but physics (goals, positions of solid bodies,
observation, images, reward, termination) is the code of `JetBotEnv`, compiled by JAX for the CPU.
"""

import copy
import functools
import math
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float, PyTree, UInt8, UInt32

from jetbot_mjx.config import Config, RobotConfig
from jetbot_mjx.devices import default_device_cpu
from jetbot_mjx.envs.camera.wrapper import NUMBERS, PIXELS, see
from jetbot_mjx.envs.jetbot_env import JetBotEnv, make_jetbot_env
from jetbot_mjx.envs.state import Obs, PhysicsState, State, robot_state
from jetbot_mjx.envs.task import AdvancesGoal, Goal, TaskClass, layout_size

# MuJoCo prints each of these warnings once per episode and appends it to a file in the working
# directory. They are suppressed, since `Step.finite` reports the same.
_NONFINITE_WARNINGS = [
    int(getattr(mujoco.mjtWarning, f"mjWARN_BAD{name}"))
    for name in ("QPOS", "QVEL", "QACC", "CTRL")
]


Observation = Float[np.ndarray, " obs"] | dict[str, np.ndarray]
"""Numbers; of a robot that sees, a dictionary as of `CameraWrapper`."""


class Step(NamedTuple):
    """A `Step` holds the result of one step."""

    obs: Observation
    """Observation after the step."""
    reward: float
    """Reward of the step."""
    terminated: bool
    """Whether the task ended the episode."""
    success: bool
    """Whether the robot has solved the task."""
    finite: bool
    """Whether state, observation and reward are finite; if not, the step was discarded."""


class MujocoJetBot:
    """A `MujocoJetBot` simulates one robot and its goal."""

    def __init__(self, config: Config, task_class: TaskClass | None = None) -> None:
        """Build the model, and compile the programs of the task.

        Args:
          config: the configuration; `randomization` is ignored.
          task_class: the class of the task; None: the one that `task.name` imports.

        Raises:
          UserError: the task or its scene cannot be built.
        """
        programs = _programs(config.model_dump_json(), task_class)
        self.env, self.model, self._reset, self._task_step = programs
        self.data = mujoco.MjData(self.model)
        self.goal: Goal = None
        """Goal of this episode, as it stands now."""
        self._task, self._robot = config.task, config.robot
        self._n_substeps = config.physics.n_substeps
        self._goal_advances = isinstance(self.env.task, AdvancesGoal)
        # Views of MuJoCo's arrays.
        self._qpos, self._qvel, self._ctrl = self.data.qpos, self.data.qvel, self.data.ctrl
        self._mocap_pos: Float[np.ndarray, "nmocap 3"] = self.data.mocap_pos.copy()
        self._before = np.concatenate((self._qpos, self._qvel), dtype=np.float32)
        self._numbers = np.zeros(layout_size(self.env.task.layout), np.float32)
        self._images: UInt8[np.ndarray, "h w c"] | None = None

    def reset(self, key: UInt32[np.ndarray, "2"]) -> tuple[Observation, UInt32[np.ndarray, "2"]]:
        """Begin the episode that `JetBotEnv.reset` draws from a key.

        Args:
          key: the random key of this episode.

        Returns:
          The first observation, and the key of the next episode.
        """
        pose, self.goal, mocap_pos, numbers, self._images, next_key = self._reset(key)
        self._before, self._numbers = np.array(pose), np.array(numbers)
        if mocap_pos is not None:
            self._mocap_pos = np.asarray(mocap_pos)
        self._restore(time=0.0)
        return self._observation(), np.asarray(next_key)

    def _observation(self) -> Observation:
        """Return the caller's copy of the observation."""
        if self._images is None:
            return self._numbers.copy()
        numbers = {NUMBERS: self._numbers.copy()} if self._numbers.size else {}
        return {PIXELS: np.array(self._images), **numbers}

    def step(self, action: Float[np.ndarray, " action"]) -> Step:
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
        result, images, goal, mocap_pos = self._task_step(given, self.goal, self._images)
        result = np.array(result)
        reward, terminated, success, finite = result[-4:].tolist()
        if not finite:
            return self._discarded(time)
        self._before, self._numbers = given[len(self._before) : -len(action)], result[:-4]
        self._images = images
        # Update the goal.
        if self._goal_advances:
            self.goal = goal
            if mocap_pos is not None:
                self._mocap_pos = np.asarray(mocap_pos)
                self.data.mocap_pos[:] = self._mocap_pos
        return Step(self._observation(), reward, terminated > 0, success > 0, True)

    def wheel_targets(self, action: Float[np.ndarray, " action"]) -> Sequence[float]:
        """Return the controls of an action, before motor limits.

        Those of a JetBot are computed in Python, since a call of JAX takes as long as physics.

        Args:
          action: the action; values outside [-1, 1] are clipped.
        """
        if not isinstance(self._robot, RobotConfig):
            return np.asarray(self._controls(np.asarray(action, np.float32))).tolist()
        # These comparisons keep NaN, as `jnp.clip` does.
        drive, turn = (-1.0 if x < -1.0 else 1.0 if x > 1.0 else x for x in action.tolist())
        speed = 0.5 * (drive + 1.0) * self._task.max_speed
        half = 0.5 * turn * self._task.max_yaw_rate * self._robot.controller_wheel_separation
        radius = self._robot.controller_wheel_radius
        return (speed - half) / radius, (speed + half) / radius

    @functools.cached_property
    def _controls(self) -> jax.stages.Compiled:
        """Return the program from an action to the controls of a robot's own model."""
        drive = self.env.drive
        with default_device_cpu():
            program = jax.jit(lambda action: drive.controls(drive.command(action)))
            return program.lower(np.zeros(self.env.action_size, np.float32)).compile()

    def _discarded(self, time: float) -> Step:
        """Restore the state before a non-finite step, and return its result."""
        self._restore(time)
        return Step(self._observation(), 0.0, False, False, False)

    def _restore(self, time: float) -> None:
        """Set robot and solid bodies to their last finite state."""
        mujoco.mj_resetData(self.model, self.data)
        self._qpos[:], self._qvel[:] = np.split(self._before, [self.model.nq])
        self.data.mocap_pos[:] = self._mocap_pos
        self.data.time = time
        self.data.warning.number[_NONFINITE_WARNINGS] = 1


@functools.lru_cache(maxsize=8)
def _programs(
    settings: str, task_class: TaskClass | None
) -> tuple[JetBotEnv, mujoco.MjModel, jax.stages.Compiled, jax.stages.Compiled]:
    """Build what robots of one configuration share: environment, model and two programs.

    Args:
      settings: the configuration as JSON, since a `Config` is not hashable.
      task_class: as for `MujocoJetBot`.

    Returns:
      Environment and model; the program of a reset, from a key to (first pose, goal, positions of
      solid bodies, numbers of the observation, its images, next key); and that of the task's part
      of a step, from (poses and action, goal, images before) to (numbers and scalars, images, goal,
      positions of solid bodies). What a task or robot lacks or cannot change is None.
    """
    config = Config.model_validate_json(settings)
    env = make_jetbot_env(config, task_class=task_class)
    # Leave non-finite states to `MujocoJetBot`, which counts them.
    model = copy.copy(env.physics.mj_model)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    nq, size = model.nq, model.nq + model.nv

    def see_from(state: State, before: Array | None) -> Array | None:
        """Return the images of a state; `before`: those of the step before, if there is one."""
        if env.camera is None:
            return None
        return see(env.camera, env.task, state, before, begins=before is None).obs[PIXELS]

    def reset(key: UInt32[Array, "2"]) -> tuple[PyTree, ...]:
        state = env.blind().reset(key)
        pose = jnp.concatenate([state.pipeline_state.qpos, state.pipeline_state.qvel])
        mocap_pos, numbers = env.mocap_positions(state.goal), _vector(state.obs)
        return pose, state.goal, mocap_pos, numbers, see_from(state, None), state.key

    def physics_of(pose: Float[Array, " n"]) -> PhysicsState:
        return PhysicsState(pose[:nq], pose[nq:], jnp.zeros(model.nv), jnp.zeros(()))

    def task_step(
        given: Float[Array, " n"], goal: Goal, images: Array | None
    ) -> tuple[Array, Array | None, Goal, Array | None]:
        before, after, action = jnp.split(given, [size, 2 * size])
        physics = physics_of(after)
        task = env.task_step(robot_state(physics_of(before)), robot_state(physics), goal, action)
        numbers = _vector(task.obs)
        finite = jnp.isfinite(jnp.concatenate([after, numbers, task.reward[None]])).all()
        scalars = jnp.stack([task.reward, task.terminated, task.success, finite])
        result = jnp.concatenate([numbers, scalars])
        state = State(physics, {}, task.reward, task.terminated, {}, {}, task.goal, jnp.zeros(2))
        images = see_from(state, images)
        if not isinstance(env.task, AdvancesGoal):
            return result, images, None, None
        return result, images, task.goal, env.mocap_positions(task.goal)

    # Compile for the CPU: on a GPU, every call would wait for the device.
    with default_device_cpu():
        key, given = np.zeros(2, np.uint32), np.zeros(2 * size + env.action_size, np.float32)
        reset_program = jax.jit(reset).lower(key).compile()
        _, goal, _, _, images, _ = reset_program(key)
        task_program = jax.jit(task_step).lower(given, goal, images).compile()
    return env, model, reset_program, task_program


def _vector(obs: Obs) -> Float[Array, " obs"]:
    """Return the numbers of an observation without images, which may be an empty dictionary."""
    return jnp.zeros(0) if isinstance(obs, dict) else obs
