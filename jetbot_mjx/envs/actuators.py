"""An actuator model: delay, voltage, dead-band, lag, unequal motors and wheels.

A pure pipeline of one robot, outside physics, on wheel speeds (left, right) [rad/s].
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jetbot_mjx.envs.robot_params import RobotParams


class ActuatorState(NamedTuple):
    """The memory of the actuator model."""

    commands: Float[Array, "delay 2"] | None
    """The last commands, the newest first; None: there is no delay."""
    targets: Float[Array, "2"] | None
    """What the motors were asked for in the last step; None: there is no lag."""


def motors_at_rest(robot_params: RobotParams, longest_delay: int) -> ActuatorState:
    """Return the state of actuators that no command has reached yet.

    Args:
      robot_params: the robot's.
      longest_delay: of any robot that the program serves [control steps].

    Returns:
      What they remember.
    """
    return ActuatorState(
        jnp.zeros((longest_delay, 2)) if longest_delay else None,
        jnp.zeros(2) if robot_params.differs("motor_lag") else None,
    )


def drive_motors(
    motors: ActuatorState,
    command: Float[Array, "2"],
    robot_params: RobotParams,
    *,
    full_speed: float,
    ctrl_dt: float,
) -> tuple[ActuatorState, Float[Array, "2"]]:
    """Pass one command on to the wheels.

        u = voltage · command of `action_delay` steps ago
        w = sign(u) max(|u| - band · full, 0) / (1 - band)
        target' = d target + (1 - d) w          d = exp(-ctrl_dt / motor_lag)
        wheel speed = gain · radius · target'

    A motor turns at what its voltage exceeds the share that friction takes, and at full voltage
    at full speed. No-load speeds of a TT motor, 90 rpm at 3 V and 200 rpm at 6 V, lie on such a
    line; it meets zero at 0.55 V.

    Wheels of another radius or separation are entered as wheel speeds: as long as they roll, a
    wheel of radius f r at ω moves as one of radius r at f ω, and wheels f b apart turn the robot as
    wheels b apart whose difference of speeds is divided by f, the mean being the same.

    Args:
      motors: before.
      command: within the motors' limits.
      robot_params: the robot's.
      full_speed: what a motor makes of full voltage [rad/s].
      ctrl_dt: duration of one control step [s].

    Returns:
      The motors after it, and the wheel speeds to aim at during this step.
    """
    commands, targets = motors
    if commands is not None:
        line = jnp.concatenate([command[None], commands])
        command = line[jnp.round(robot_params.action_delay).astype(jnp.int32)]
        commands = line[:-1]
    if robot_params.differs("supply_voltage"):
        command = command * robot_params.supply_voltage
    if robot_params.differs("dead_band"):
        band = jnp.asarray(robot_params.dead_band)
        excess = jnp.maximum(jnp.abs(command) - band * full_speed, 0.0)
        command = jnp.sign(command) * excess / (1.0 - band)
    if targets is not None:
        # Without a lag exp(-∞) is exactly zero, and the command passes bit for bit.
        decay = jnp.exp(-ctrl_dt / jnp.asarray(robot_params.motor_lag))
        targets = decay * targets + (1.0 - decay) * command
        command = targets
    return ActuatorState(commands, targets), _at_the_wheels(command, robot_params)


def _at_the_wheels(target: Float[Array, "2"], robot_params: RobotParams) -> Float[Array, "2"]:
    """Return the speeds at which the preset's wheels do what these wheels do at `target`."""
    sides = jnp.array([0.5, -0.5])
    if robot_params.differs("motor_gain", "wheel_radius"):
        target = target * (robot_params.motor_gain * robot_params.wheel_radius)
    for name in ("motor_gain_mismatch", "wheel_radius_mismatch"):
        if robot_params.differs(name):
            target = target * (1.0 + sides * getattr(robot_params, name))
    if robot_params.differs("wheel_separation"):
        # As a difference, so that no rounding is left where there is none.
        change = 0.5 * (1.0 / jnp.asarray(robot_params.wheel_separation) - 1.0)
        target = target + change * (target - target[::-1])
    return target
