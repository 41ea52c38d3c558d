"""Model the actuators: delay, supply voltage, dead-band, motor lag, unequal motors and wheels.

The model is a pure function of one robot. It runs before physics, on wheel speeds (left, right)
[rad/s]; its result is the control of MuJoCo's velocity actuators.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float

from jetbot_mjx.config import RobotParams


class ActuatorState(NamedTuple):
    """An `ActuatorState` holds what the actuator model carries from step to step."""

    commands: Float[Array, "delay command"] | None
    """The last commands [rad/s], the newest first; None: the model has no delay."""
    targets: Float[Array, "2"] | None
    """Output of the motor lag in the last step [rad/s]; None: the model has no lag."""


def initial_actuator_state(
    robot_params: RobotParams, longest_delay: int, size: int = 2
) -> ActuatorState:
    """Return the actuator state before the first command: the motors stand still.

    Args:
      robot_params: the parameters of the robot.
      longest_delay: the longest `action_delay` that the compiled program supports [control steps].
      size: the length of a command; the motors of two sides have two numbers.
    """
    return ActuatorState(
        jnp.zeros((longest_delay, size)) if longest_delay else None,
        jnp.zeros(2) if robot_params.differs("motor_lag") else None,
    )


def step_actuators(
    actuators: ActuatorState,
    command: Float[Array, " command"],
    robot_params: RobotParams,
    *,
    full_speed: float,
    ctrl_dt: float,
) -> tuple[ActuatorState, Float[Array, " command"]]:
    """Return the wheel speed targets of this step for one command.

        u = voltage · command of `action_delay` steps ago
        w = sign(u) max(|u| - band · full, 0) / (1 - band)
        target' = d target + (1 - d) w          d = exp(-ctrl_dt / motor_lag)
        wheel speed = gain · radius · target'

    Dead-band: the speed of a motor is linear in the voltage above the share that friction takes,
    and reaches full speed at full voltage. The no-load speeds of a TT motor, 90 rpm at 3 V and
    200 rpm at 6 V, lie on such a line, which meets zero at 0.55 V.

    Wheel radius and separation enter as wheel speeds, which is exact while the wheels roll: a wheel
    of radius f r at speed ω moves like one of radius r at f ω. Wheels that are f b apart turn the
    robot like wheels that are b apart with the same mean speed and a difference of speeds divided
    by f.

    Args:
      actuators: the state before the step.
      command: wheel speeds (left, right) [rad/s], within the limits of the motors; of a robot
        without two sides, a command of which only the delay changes.
      robot_params: the parameters of the robot.
      full_speed: the speed of a motor at full voltage [rad/s].
      ctrl_dt: the duration of a control step [s].

    Returns:
      The state after the step, and the wheel speed targets (left, right) of this step [rad/s].
    """
    commands, targets = actuators
    # Delay: read the command of `action_delay` steps ago.
    if commands is not None:
        history = jnp.concatenate([command[None], commands])
        command = history[jnp.round(robot_params.action_delay).astype(jnp.int32)]
        commands = history[:-1]
    # Voltage and dead-band.
    if robot_params.differs("supply_voltage"):
        command = command * robot_params.supply_voltage
    if robot_params.differs("dead_band"):
        band = jnp.asarray(robot_params.dead_band)
        excess = jnp.maximum(jnp.abs(command) - band * full_speed, 0.0)
        command = jnp.sign(command) * excess / (1.0 - band)
    # Motor lag: with a time constant of 0, exp(-∞) is exactly 0, and the command stays as it is.
    if targets is not None:
        decay = jnp.exp(-ctrl_dt / jnp.asarray(robot_params.motor_lag))
        targets = decay * targets + (1.0 - decay) * command
        command = targets
    return ActuatorState(commands, targets), _at_preset_wheels(command, robot_params)


def _at_preset_wheels(
    target: Float[Array, " command"], robot_params: RobotParams
) -> Float[Array, " command"]:
    """Return the speeds at which the preset's wheels move like this robot's wheels at `target`."""
    sides = jnp.array([0.5, -0.5])
    if robot_params.differs("motor_gain", "wheel_radius"):
        target = target * (robot_params.motor_gain * robot_params.wheel_radius)
    for name in ("motor_gain_mismatch", "wheel_radius_mismatch"):
        if robot_params.differs(name):
            target = target * (1.0 + sides * getattr(robot_params, name))
    if robot_params.differs("wheel_separation"):
        # Written as a difference, so that a factor of 1 leaves the speeds bit-identical.
        change = 0.5 * (1.0 / jnp.asarray(robot_params.wheel_separation) - 1.0)
        target = target + change * (target - target[::-1])
    return target
