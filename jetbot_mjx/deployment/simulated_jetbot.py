"""Simulate a JetBot for a driver: motor values in, a pose out, in simulation time.

A `SimulatedJetBot` has the two methods of NVIDIA's `jetbot.Robot` that a driver calls, and a clock
on which a driver waits; waiting advances the simulation. Physics is the preset `real` in C MuJoCo.
The motor model turns a motor value m into a wheel speed ω by a delay, a dead-band, the full speed
and a lag:

    s(t) = m(t - delay)          target = sign(s) full (|s| - dead) / (1 - dead), 0 below `dead`
    ω' = d ω + (1 - d) target    d = exp(-dt / lag)
"""

import collections
import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from jaxtyping import Float

from jetbot_mjx.config import PhysicsConfig, RobotConfig
from jetbot_mjx.envs import QPOS_QUAT, QPOS_XYZ, make_mj_model

ROLLING_RADIUS = 0.0321
"""Distance over the floor per radian of a wheel [m]: under load it sinks 0.4 mm into the floor."""


class MotorModel(NamedTuple):
    """The actuator model between a motor value and a wheel. Pairs are (left, right)."""

    dead_band: tuple[float, float] = (0.12, 0.12)
    """Motor value up to which a wheel does not turn. PICOBOT: 0.11; others up to 0.25."""
    full_speed: tuple[float, float] = (12.56, 12.56)
    """Wheel speed at a motor value of 1 [rad/s]; the default is the preset's."""
    lag: float = 0.1
    """Time constant [s]. PICOBOT: 0.085."""
    delay: float = 0.05
    """Delay from setting a motor value to its effect on the motor [s]."""
    lost: float = 0.0
    """Share of the motor values that the bus loses, so that the ones before stay."""


class Pose(NamedTuple):
    """Position and heading of the axle midpoint, in the world frame."""

    x: float
    """[m]"""
    y: float
    """[m]"""
    yaw: float
    """Counter-clockwise from the world's x axis, in (-π, π] [rad]."""


class SimulatedJetBot:
    """A simulated JetBot with its motors and its clock."""

    def __init__(self, motors: MotorModel | None = None) -> None:
        """Build the robot, at rest at the origin.

        Args:
          motors: The motor model; None: the defaults of `MotorModel`.
        """
        self.motor_model = MotorModel() if motors is None else motors
        # The motor model limits the wheel speed instead of the preset.
        robot = RobotConfig(preset="real", max_wheel_speed=None)
        self._model = make_mj_model(robot, PhysicsConfig(), visual=False)
        self._data = mujoco.MjData(self._model)
        self._time = 0.0
        self._rng = np.random.default_rng(0)
        self.watchers: list[Callable[[], None]] = []
        """Functions that are called after every physics step, such as a camera's."""
        self.place(Pose(0.0, 0.0, 0.0))

    def place(self, pose: Pose) -> None:
        """Place the robot at rest and drop all pending motor values; the clock is not reset."""
        mujoco.mj_resetData(self._model, self._data)
        qpos = self._data.qpos
        qpos[QPOS_XYZ][:2] = pose.x, pose.y
        turned = np.array([math.cos(pose.yaw / 2), 0.0, 0.0, math.sin(pose.yaw / 2)])
        mujoco.mju_mulQuat(qpos[QPOS_QUAT], turned, self._model.qpos0[QPOS_QUAT])
        self._active = np.zeros(2)
        self._wheels = np.zeros(2)
        self._pending: collections.deque[tuple[float, np.ndarray]] = collections.deque()
        self.motors = (0.0, 0.0)
        """The last motor values (left, right) that arrived."""

    def set_motors(self, left_speed: float, right_speed: float) -> None:
        """Set both motor values, as `jetbot.Robot` does.

        Args:
          left_speed: Motor value of the left motor in [-1, 1]; values outside are clipped.
          right_speed: Motor value of the right motor.
        """
        if self.motor_model.lost > 0 and self._rng.random() < self.motor_model.lost:
            return
        self.motors = (float(left_speed), float(right_speed))
        values = np.clip(self.motors, -1.0, 1.0)
        self._pending.append((self._time + self.motor_model.delay, values))

    def stop(self) -> None:
        """Set both motor values to zero."""
        self.set_motors(0.0, 0.0)

    def now(self) -> float:
        """Return the simulation time [s] since the robot was built."""
        return self._time

    def sleep(self, seconds: float) -> None:
        """Advance the simulation in whole physics steps.

        Args:
          seconds: Simulated time [s]; the remainder of a step is added to the next call.
        """
        dt = self._model.opt.timestep
        end = self._time + seconds
        # The tolerance is half a step, because times are sums of rounded numbers.
        while self._time < end - 0.5 * dt:
            self._tick(dt)

    def pose(self) -> Pose:
        """Return the robot's pose."""
        x, y, _ = self._data.qpos[QPOS_XYZ]
        w, i, j, k = self._data.qpos[QPOS_QUAT]
        yaw = math.atan2(2.0 * (w * k + i * j), 1.0 - 2.0 * (j * j + k * k))
        return Pose(float(x), float(y), yaw)

    def attitude(self) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "4"]]:
        """Return the position [m] of the axle midpoint, and the attitude (w, x, y, z)."""
        qpos = self._data.qpos
        return qpos[QPOS_XYZ].copy(), qpos[QPOS_QUAT].copy()

    def speed(self) -> float:
        """Return the speed of the axle midpoint over the floor [m/s]."""
        return float(np.hypot(*self._data.qvel[:2]))

    def _tick(self, dt: float) -> None:
        while self._pending and self._pending[0][0] <= self._time + 1e-9:
            self._active = self._pending.popleft()[1]
        model = self.motor_model
        target = np.array([*map(_wheel_speed, self._active, model.dead_band, model.full_speed)])
        decay = math.exp(-dt / model.lag) if model.lag > 0 else 0.0
        self._wheels = decay * self._wheels + (1.0 - decay) * target
        self._data.ctrl[:] = self._wheels
        mujoco.mj_step(self._model, self._data)
        self._time += dt
        for watch in self.watchers:
            watch()


def _wheel_speed(value: float, dead_band: float, full_speed: float) -> float:
    beyond = max(abs(value) - dead_band, 0.0)
    return math.copysign(full_speed * beyond / (1.0 - dead_band), value)


def replayed(
    motors: MotorModel, start: Pose, times: Sequence[float], values: Float[np.ndarray, "n 2"]
) -> Float[np.ndarray, "n 3"]:
    """Drive a simulated JetBot by logged motor values, and return its path.

    Args:
      motors: The motor model.
      start: The pose at the start, where the robot is at rest.
      times: Times at which each value was set [s], ascending.
      values: Motor values (left, right).

    Returns:
      (x, y, yaw) [m, m, rad] at each of the times, before its value is set; yaw without jumps.
    """
    robot = SimulatedJetBot(motors)
    robot.place(start)
    poses = []
    for time, (left, right) in zip(times, values, strict=True):
        robot.sleep(time - times[0] - robot.now())
        poses.append(robot.pose())
        robot.set_motors(left, right)
    path = np.array(poses)
    path[:, 2] = np.unwrap(path[:, 2])
    return path
