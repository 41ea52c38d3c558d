"""The trial of a robot in C MuJoCo tells how it follows its commands."""

import pytest

from helpers.own_robots import load_robot
from jetbot_mjx.config import parse_config
from jetbot_mjx.envs import make_env
from jetbot_mjx.envs.robot_trial import drive_trial


def trial_of(config):
    env = make_env(config)
    return drive_trial(config, env.physics.mj_model, env.drive)


def test_a_rover_that_skids_turns_less_than_its_wheels():
    trial = trial_of(load_robot("rover", "robot.wheel_separation=0.2"))
    assert trial.speed == pytest.approx(1.0, abs=0.03)
    assert trial.turn < 0.6


@pytest.mark.parametrize("name", ["turtlebot", "car"])
def test_one_that_rolls_turns_as_it_is_told(name):
    trial = trial_of(load_robot(name))
    assert trial.speed == pytest.approx(1.0, abs=0.03)
    assert trial.turn == pytest.approx(1.0, abs=0.03)


def test_a_jetbot_is_as_slow_as_its_motors():
    trial = trial_of(parse_config({"robot": {"preset": "real"}}))
    assert trial.speed == pytest.approx(0.4, abs=0.02)
