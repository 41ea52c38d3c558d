"""What an action means for wheels: sides of a drive, and the curves of a car."""

import math

import jax.numpy as jnp
import numpy as np
import pytest

from jetbot_mjx.config import parse_config
from jetbot_mjx.envs.drive import (
    AckermannDrive,
    DifferentialDrive,
    Wheel,
    jetbot_drive,
    largest_curvature,
)

FRONT = (Wheel(0, 0.2, 0.06, 1.0), Wheel(1, 0.2, -0.06, 1.0))
REAR = (Wheel(2, 0.0, 0.07, 1.0, 0.03), Wheel(3, 0.0, -0.07, 1.0, 0.03))
CAR = AckermannDrive(0.8, 4.0, 0.03, 0.0, REAR, FRONT)


def test_a_jetbot_has_the_tutorials_controller():
    drive = jetbot_drive(parse_config({}))
    left, right = np.asarray(drive.command(jnp.array([1.0, 1.0])))
    assert (left, right) == (
        pytest.approx((1.0 - math.pi * 0.05625) / 0.0325),
        pytest.approx((1.0 + math.pi * 0.05625) / 0.0325),
    )
    command = jnp.array([3.0, 5.0])
    np.testing.assert_array_equal(drive.controls(command), command)


def test_every_actuator_gets_the_speed_of_its_side():
    wheels = (
        Wheel(0, 0.1, 0.1, 1.0, 0.05),
        Wheel(1, 0.1, -0.1, -2.0, 0.05),
        Wheel(2, 0.0, 0.1, 3.0),
    )
    drive = DifferentialDrive(1.0, 1.0, 0.05, 0.2, wheels)
    np.testing.assert_array_equal(drive.controls(jnp.array([4.0, 5.0])), [4.0, -10.0, 12.0])


@pytest.mark.parametrize("action", [(1.0, 1.0), (0.2, -0.7), (-1.0, 0.5), (3.0, -9.0)])
def test_all_wheels_of_a_car_are_perpendicular_to_the_line_to_the_centre(action):
    command = CAR.command(jnp.array(action))
    controls = np.asarray(CAR.controls(command))
    curvature = np.clip(action[1], -1, 1) * 4.0
    centre = np.array([0.0, 1.0 / curvature])
    for wheel in FRONT:
        angle = controls[wheel.actuator]
        ahead = np.array([math.cos(angle), math.sin(angle)])
        assert ahead @ (centre - [wheel.x, wheel.y]) == pytest.approx(0.0, abs=1e-6)
    # A wheel rolls as far as it is from the centre.
    speed = 0.5 * (np.clip(action[0], -1, 1) + 1.0) * 0.8
    for wheel in REAR:
        expected = speed * abs(1.0 / curvature - wheel.y) * abs(curvature) / 0.03
        assert controls[wheel.actuator] == pytest.approx(expected, rel=1e-5, abs=1e-6)


def test_a_car_that_drives_ahead_does_not_steer():
    controls = np.asarray(CAR.controls(CAR.command(jnp.array([1.0, 0.0]))))
    np.testing.assert_allclose(controls, [0.0, 0.0, 0.8 / 0.03, 0.8 / 0.03], rtol=1e-6)


def test_the_largest_curvature_puts_the_inner_wheel_at_its_limit():
    curvature = largest_curvature(FRONT, 0.0, np.array([0.6, 0.6]))
    drive = CAR._replace(max_curvature=curvature)
    for turn, inner in ((1.0, 0), (-1.0, 1)):
        controls = np.abs(drive.controls(drive.command(jnp.array([1.0, turn]))))
        assert controls[inner] == pytest.approx(0.6, rel=1e-5)
        assert controls[1 - inner] < 0.6
