"""The actuator model between command and wheel: each stage against its formula."""

import jax.numpy as jnp
import numpy as np
import pytest

from helpers import motion
from jetbot_mjx.config import RobotParams
from jetbot_mjx.envs.actuators import initial_actuator_state, step_actuators
from jetbot_mjx.envs.domain_randomization import LARGEST_TRACED

LONGEST = LARGEST_TRACED["action_delay"]

FULL = 12.0
RAMP = np.arange(1.0, 25.0).reshape(12, 2)


def drive(robot_params, commands, longest_delay=LONGEST):
    motors, speeds = initial_actuator_state(robot_params, longest_delay), []
    for command in np.asarray(commands, np.float32):
        motors, speed = step_actuators(
            motors, jnp.asarray(command), robot_params, full_speed=FULL, ctrl_dt=1 / 60
        )
        speeds.append(speed)
    return np.asarray(speeds)


@pytest.mark.parametrize("delay", [0, 1, 3, LONGEST])
def test_until_the_first_command_arrives_the_motors_are_asked_to_stand(delay):
    speeds = drive(RobotParams(action_delay=delay), RAMP)
    np.testing.assert_array_equal(speeds[:delay], 0.0)
    np.testing.assert_array_equal(speeds[delay:], RAMP[: 12 - delay])


def test_a_delay_is_rounded_to_whole_steps():
    np.testing.assert_array_equal(
        drive(RobotParams(action_delay=1.6), RAMP), drive(RobotParams(action_delay=2.0), RAMP)
    )


def test_a_lag_is_of_first_order():
    speeds = drive(RobotParams(motor_lag=0.1), [(10.0, -5.0)] * 12)
    expected = 1.0 - np.exp(-np.arange(1, 13) / 60 / 0.1)
    np.testing.assert_allclose(speeds, expected[:, None] * (10.0, -5.0), rtol=1e-5)


def test_below_the_dead_band_a_wheel_stands_and_at_full_command_it_is_as_fast_as_without():
    commands = [(2.9, -2.9), (3.0 + 4.5, -(3.0 + 4.5)), (FULL, -FULL)]
    speeds = drive(RobotParams(dead_band=0.25), commands)
    expected = np.array([0.0, 0.5 * FULL, FULL])
    np.testing.assert_allclose(speeds, expected[:, None] * (1.0, -1.0), rtol=1e-6)


def test_a_low_voltage_slows_the_motors_and_widens_their_dead_band():
    slow, gain = RobotParams(supply_voltage=0.5), RobotParams(motor_gain=0.5)
    np.testing.assert_allclose(drive(slow, RAMP), 0.5 * RAMP)
    np.testing.assert_allclose(drive(gain, RAMP), 0.5 * RAMP)
    at_low_voltage, at_low_gain = (
        drive(one._replace(dead_band=0.25), [(5.0, 8.0)])[0] for one in (slow, gain)
    )
    np.testing.assert_allclose(at_low_voltage, (0.0, (4.0 - 3.0) / 0.75), rtol=1e-6)
    np.testing.assert_allclose(at_low_gain, (0.5 * 2.0 / 0.75, 0.5 * 5.0 / 0.75), rtol=1e-6)


def test_unequal_motors_and_wheels_part_symmetrically():
    for name in ("motor_gain_mismatch", "wheel_radius_mismatch"):
        left, right = drive(RobotParams(**{name: 0.1}), [(10.0, 10.0)])[0]
        assert (left, right) == pytest.approx((10.5, 9.5))


@pytest.mark.parametrize(("left", "right"), [(3.0, 7.0), (-4.0, 4.0), (5.0, 5.0)])
def test_wheels_of_another_size_and_distance_move_the_robot_as_kinematics_says(left, right):
    robot_params = RobotParams(wheel_radius=1.04, wheel_separation=0.95)
    entered = drive(robot_params, [(left, right)])[0]
    as_entered = motion.body_twist(
        jnp.asarray(entered), wheel_radius=0.0325, wheel_separation=0.114
    )
    true = motion.body_twist(
        jnp.array([left, right]),
        wheel_radius=1.04 * 0.0325,
        wheel_separation=0.95 * 0.114,
    )
    np.testing.assert_allclose(as_entered, true, rtol=1e-5, atol=1e-7)


def test_nominal_actuators_return_their_commands_unchanged():
    np.testing.assert_array_equal(drive(RobotParams(), RAMP, longest_delay=0), RAMP)
    traced = RobotParams(*(jnp.float32(value) for value in RobotParams()))
    np.testing.assert_array_equal(drive(traced, RAMP), RAMP)
    assert initial_actuator_state(RobotParams(), 0) == (None, None)
