"""The simulated JetBot against formulas."""

import math

import numpy as np
import pytest

from jetbot_mjx.deployment.simulated_jetbot import (
    ROLLING_RADIUS,
    MotorModel,
    Pose,
    SimulatedJetBot,
    replayed,
)

IDEAL = MotorModel(dead_band=(0.0, 0.0), lag=0.0, delay=0.0)


def driven(model, left, right, seconds=2.0):
    robot = SimulatedJetBot(model)
    robot.set_motors(left, right)
    robot.sleep(seconds)
    return robot


@pytest.mark.parametrize("value", [0.2, 1.0])
def test_a_wheel_rolls_on_its_rolling_radius(value):
    robot = driven(IDEAL, value, value)
    assert robot.speed() == pytest.approx(value * 12.56 * ROLLING_RADIUS, rel=1e-3)
    assert robot.pose().yaw == pytest.approx(0.0, abs=1e-6)


def test_below_its_dead_band_a_motor_stands_and_beyond_it_turns():
    assert driven(MotorModel(), 0.119, 0.119).speed() < 1e-4
    right = driven(MotorModel(dead_band=(0.12, 0.3)), 0.25, 0.25)
    assert right.pose().yaw < -0.3  # the left one alone
    full = driven(MotorModel(), 7.0, 7.0)  # clipped
    assert full.speed() == pytest.approx(12.56 * ROLLING_RADIUS, rel=1e-2)


def test_a_command_arrives_after_its_delay_and_is_followed_with_the_lag():
    late = driven(IDEAL._replace(delay=0.5), 0.5, 0.5, seconds=0.49)
    assert late.speed() < 1e-4
    late.sleep(0.4)
    assert late.speed() > 0.15
    lagging = driven(IDEAL._replace(lag=0.5), 0.5, 0.5, seconds=0.5)
    share = lagging.speed() / (0.5 * 12.56 * ROLLING_RADIUS)
    assert share == pytest.approx(1 - math.exp(-1), abs=0.03)


def test_the_clock_moves_the_robot_and_nothing_else_does():
    robot = driven(IDEAL, 0.5, 0.5, seconds=0.0)
    assert (robot.now(), robot.pose()) == (0.0, Pose(0.0, 0.0, 0.0))
    for _ in range(60):
        robot.sleep(1 / 60)
    assert robot.now() == pytest.approx(1.0)
    robot.place(Pose(1.0, 2.0, -3.0))
    assert robot.pose() == pytest.approx((1.0, 2.0, -3.0))
    assert robot.now() == pytest.approx(1.0)
    robot.sleep(0.5)
    assert robot.pose() == pytest.approx((1.0, 2.0, -3.0), abs=1e-4)


def test_a_replay_is_the_drive():
    robot = SimulatedJetBot()
    robot.place(Pose(0.3, 0.1, 2.0))
    values = np.random.default_rng(0).uniform(0.2, 0.9, (40, 2))
    times, path = [], []
    for left, right in values:
        times.append(robot.now() + 7.0)
        path.append(robot.pose())
        robot.set_motors(left, right)
        robot.sleep(1 / 30)
    again = replayed(robot.motor_model, Pose(0.3, 0.1, 2.0), times, values)
    np.testing.assert_allclose(again[:, :2], np.array(path)[:, :2], atol=1e-6)
