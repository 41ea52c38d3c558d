"""Provide the tutorial's task on one robot in C MuJoCo and NumPy, without this package's code.

Stable-Baselines3 is measured on it. Observation, reward, goals, time limit and controller are
those of `jetbot_mjx.envs.task.GoalTask` with `observation: world`; a test compares the two.
"""

import math
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from jetbot_mjx.config import Config, RobotConfig
from jetbot_mjx.envs.robot_model import (
    QPOS_QUAT,
    QPOS_XYZ,
    QVEL_ANGULAR_B,
    QVEL_LINEAR_W,
    make_mj_model,
)
from jetbot_mjx.envs.task import GOAL_HEIGHT


def make_physics_model(config: Config) -> mujoco.MjModel:
    """Return the C model from which MJX's is made: same robot, time step and solver settings."""
    return make_mj_model(config.robot, config.physics, visual=False)


def wheel_targets(config: Config, actions: Float[np.ndarray, "*n 2"]) -> Float[np.ndarray, "*n 2"]:
    """Return the wheel speeds (left, right) [rad/s] that actions in [-1, 1]² command."""
    drive, turn = np.moveaxis(np.clip(actions, -1.0, 1.0), -1, 0)
    speed = 0.5 * (drive + 1.0) * config.task.max_speed
    robot = config.robot
    assert isinstance(robot, RobotConfig)
    difference = 0.5 * turn * config.task.max_yaw_rate * robot.controller_wheel_separation
    wheels = np.stack([speed - difference, speed + difference], axis=-1)
    return wheels / robot.controller_wheel_radius


class OneRobot:
    """An environment of one robot with the interface of Gymnasium."""

    def __init__(self, config: Config) -> None:
        """Build the model.

        Args:
          config: The robot, task and physics.
        """
        self.config = config
        self.model = make_physics_model(config)
        self.data = mujoco.MjData(self.model)
        self.goal = np.zeros(3)
        self._steps = 0
        self._distance = 0.0

    def reset(self, rng: np.random.Generator) -> Float[np.ndarray, "16"]:
        """Start an episode with the robot at rest at the origin and a new goal.

        Args:
          rng: The generator that draws the goal.

        Returns:
          The first observation.
        """
        mujoco.mj_resetData(self.model, self.data)
        task = self.config.task
        angle = 2.0 * math.pi * rng.random()
        distance = task.goal_distance_span * math.sqrt(rng.random()) + task.goal_distance_min
        self.goal[:] = distance * math.sin(angle), distance * math.cos(angle), GOAL_HEIGHT
        self._steps = 0
        self._distance = self._goal_distance()
        return self._observe()

    def step(
        self, action: Float[np.ndarray, "2"]
    ) -> tuple[Float[np.ndarray, "16"], float, bool, bool, dict[str, Any]]:
        """Hold an action for one environment step.

        Args:
          action: Forward speed and yaw rate, each in [-1, 1].

        Returns:
          Observation, reward (progress [m]), terminated, truncated and an empty info.
        """
        self.data.ctrl[:] = wheel_targets(self.config, action)
        mujoco.mj_step(self.model, self.data, self.config.physics.n_substeps)
        self._steps += 1
        before, self._distance = self._distance, self._goal_distance()
        terminated = self._distance < self.config.task.success_radius
        truncated = not terminated and self._steps >= self.config.task.episode_length
        return self._observe(), before - self._distance, terminated, truncated, {}

    def _goal_distance(self) -> float:
        return float(np.linalg.norm(self.goal - self.data.qpos[QPOS_XYZ]))

    def _observe(self) -> Float[np.ndarray, "16"]:
        quat = self.data.qpos[QPOS_QUAT]
        angular_velocity_w = np.empty(3)
        mujoco.mju_rotVecQuat(angular_velocity_w, self.data.qvel[QVEL_ANGULAR_B], quat)
        parts = (
            self.data.qpos[QPOS_XYZ],
            quat,
            self.data.qvel[QVEL_LINEAR_W],
            angular_velocity_w,
            self.goal,
        )
        return np.concatenate(parts).astype(np.float32)
