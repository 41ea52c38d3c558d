"""Turn actions into commands of a drive, and commands into the controls of its actuators.

A command is two numbers: the wheel speeds of both sides, or of a car a wheel speed and a curvature.
Positions are in the frame of the robot's body: x is forward, y is left. SI units.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jetbot_mjx.config import Config, RobotConfig
from jetbot_mjx.envs import kinematics


class Wheel(NamedTuple):
    """A `Wheel` holds what a drive needs to know of a wheel with an actuator."""

    actuator: int
    """Index of the actuator."""
    x: float
    """Position ahead of the body's origin [m]."""
    y: float
    """Position to the left of it [m]."""
    gain: float
    """Control per speed of the wheel [s/rad] or per angle of its steering [1/rad], signed."""
    radius: float = 0.0
    """Radius of a driven wheel [m]."""


class DifferentialDrive(NamedTuple):
    """A drive with one wheel or more on either side, which roll forward alone."""

    max_speed: float
    """Speed that an action of 1 commands [m/s]."""
    max_yaw_rate: float
    """Yaw rate that an action of 1 commands [rad/s]."""
    wheel_radius: float
    """Radius that the controller assumes [m]."""
    wheel_separation: float
    """Distance of the wheels that it assumes [m]."""
    wheels: tuple[Wheel, ...] = ()
    """Wheels of the actuators, in their order; empty: one left and one right, as a JetBot has."""

    action_size = 2

    def command(self, action: Float[Array, "2"]) -> Float[Array, "2"]:
        """Return the wheel speeds (left, right) [rad/s] that an action commands."""
        limits = {"max_speed": self.max_speed, "max_yaw_rate": self.max_yaw_rate}
        return kinematics.wheel_speeds(
            kinematics.twist_from_action(action, **limits),
            wheel_radius=self.wheel_radius,
            wheel_separation=self.wheel_separation,
        )

    def controls(self, command: Float[Array, "2"]) -> Float[Array, " nu"]:
        """Return the controls for wheel speeds (left, right) [rad/s]."""
        if not self.wheels:
            return command
        left, right = command
        return jnp.stack([one.gain * (left if one.y > 0 else right) for one in self.wheels])


class AckermannDrive(NamedTuple):
    """The drive of a car: each wheel is perpendicular to the line to the centre of the curve."""

    max_speed: float
    """Speed of the middle of the rear axle that an action of 1 commands [m/s]."""
    max_curvature: float
    """Curvature of its path that an action of 1 commands [1/m]."""
    wheel_radius: float
    """Radius of the driven wheels [m]."""
    rear: float
    """Position of the rear axle ahead of the body's origin [m]."""
    driven: tuple[Wheel, ...]
    steered: tuple[Wheel, ...]

    action_size = 2

    def command(self, action: Float[Array, "2"]) -> Float[Array, "2"]:
        """Return the wheel speed [rad/s] and the curvature [1/m] that an action commands."""
        drive, turn = jnp.clip(action, -1.0, 1.0)
        speed = 0.5 * (drive + 1.0) * self.max_speed / self.wheel_radius
        return jnp.stack([speed, turn * self.max_curvature])

    def controls(self, command: Float[Array, "2"]) -> Float[Array, " nu"]:
        """Return the controls for a wheel speed and a curvature κ.

        A wheel x ahead of the rear axle and y to its left turns by atan(x κ / (1 - y κ)), and rolls
        √((1 - y κ)² + (x κ)²) times as fast as one in the middle of the rear axle.
        """
        speed, curvature = command
        values = {}
        for one in self.steered:
            ahead, beside = (one.x - self.rear) * curvature, 1.0 - one.y * curvature
            values[one.actuator] = one.gain * jnp.arctan(ahead / beside)
        for one in self.driven:
            ahead, beside = (one.x - self.rear) * curvature, 1.0 - one.y * curvature
            values[one.actuator] = one.gain * speed * jnp.hypot(beside, ahead)
        return jnp.stack([values[index] for index in sorted(values)])


class OwnDrive(NamedTuple):
    """A drive that is a function of the user's own, from an action to controls."""

    function: Callable[[Float[Array, " action"]], Float[ArrayLike, " nu"]]
    action_size: int

    def command(self, action: Float[Array, " action"]) -> Float[Array, " action"]:
        """Return the action, clipped."""
        return jnp.clip(action, -1.0, 1.0)

    def controls(self, command: Float[Array, " action"]) -> Float[Array, " nu"]:
        """Return the controls of an action."""
        return jnp.asarray(self.function(command), jnp.float32)


Drive = DifferentialDrive | AckermannDrive | OwnDrive


def jetbot_drive(config: Config) -> DifferentialDrive:
    """Return the drive of a JetBot: the tutorial's differential controller.

    Args:
      config: the configuration, whose robot is given by its measures.
    """
    robot, task = config.robot, config.task
    assert isinstance(robot, RobotConfig)
    return DifferentialDrive(
        max_speed=task.max_speed,
        max_yaw_rate=task.max_yaw_rate,
        wheel_radius=robot.controller_wheel_radius,
        wheel_separation=robot.controller_wheel_separation,
    )


def largest_curvature(
    steered: Sequence[Wheel], rear: float, angles: Float[np.ndarray, " n"]
) -> float:
    """Return the largest curvature of a car [1/m], at which its first wheel is at its limit.

    Args:
      steered: the wheels that turn to the side.
      rear: position of the rear axle ahead of the body's origin [m].
      angles: largest angle of each [rad].
    """
    tangents = np.tan(angles)
    ahead = np.abs([one.x - rear for one in steered])
    beside = np.abs([one.y for one in steered])
    return float(np.min(tangents / (ahead + beside * tangents)))
