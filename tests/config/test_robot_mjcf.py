"""The section `robot` of a model of one's own."""

import pytest

from helpers.own_robots import copy_robot, load_robot
from jetbot_mjx.config import ConfigError, MjcfRobotConfig, load_config, parse_config

ROVER = {"wheels": {"left": ["fl", "rl"], "right": ["fr", "rr"]}}


def test_it_is_found_beside_the_configuration_and_known_by_its_hash(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "in").mkdir()
    robot = load_config(copy_robot(tmp_path / "in", "rover")).robot
    assert isinstance(robot, MjcfRobotConfig)
    assert (robot.file, robot.label, robot.drive) == ("rover.xml", "rover", "differential")
    assert robot == load_robot("rover").robot
    changed = load_config(copy_robot(tmp_path / "in", "rover", [("0.085", "0.086")])).robot
    assert changed.sha256 != robot.sha256


def test_settings_of_it_can_be_changed_and_it_can_be_replaced():
    config = load_robot("rover", "robot.wheel_separation=0.3")
    assert config.robot.wheel_separation == 0.3
    assert load_config(config, ["robot.wheel_separation=0.4"]).robot.wheel_separation == 0.4
    assert parse_config(config.model_dump(mode="json")) == config


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"wheels": {"left": [], "right": ["fr"]}}, "name the actuators in robot.wheels.left and"),
        ({"wheels": None}, "a differential drive has wheels on both sides"),
        (
            {"drive": "tank"},
            "robot.drive: 'tank' is no drive: it should be differential, ackermann, or",
        ),
        ({"wheel_radius": 50}, "robot.wheel_radius = 50 is wrong"),
        (
            {"chassis_mass": 2.0},
            "robot.chassis_mass = 2.0 is unknown: a robot with a model of its own has file, base",
        ),
        ({"wheels": {"left": ["fl"]}}, "a differential drive has wheels on both sides"),
        ({"wheels": {**ROVER["wheels"], "middle": ["x"]}}, "and none in the middle"),
        (
            {"steering": ROVER["wheels"]},
            "robot: steering is that of a car: set robot.drive: ackermann, or leave",
        ),
        (
            {"drive": "ackermann", "steering": {}},
            "a car has actuators in robot.wheels and in robot.steering",
        ),
        ({"file": "none.xml"}, "robot.file none.xml does not exist"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(changed, said):
    values = load_robot("rover").model_dump(mode="json")["robot"]
    if "file" in changed:
        values["sha256"] = ""
    with pytest.raises(ConfigError) as error:
        parse_config({"robot": values | changed})
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_what_a_car_does_not_have_is_not_drawn():
    load_robot("rover", "randomization.motor_lag=[0, 0.1]")
    load_robot("car", "randomization.friction=[0.5, 1]")
    with pytest.raises(ConfigError, match=r"randomization.motor_lag is of motors on two sides"):
        load_robot("car", "randomization.motor_lag=[0, 0.1]")


def test_a_stored_configuration_finds_its_model_in_the_run_or_refuses_it(tmp_path):
    config = load_config(copy_robot(tmp_path, "turtlebot"))
    run = tmp_path / "run"
    (run / "robot").mkdir(parents=True)
    (run / "config.yaml").write_text(config.to_yaml())
    (tmp_path / "turtlebot.xml").rename(run / "robot" / "turtlebot.xml")
    assert load_config(run / "config.yaml").robot == config.robot
    (run / "robot" / "turtlebot.xml").write_text("<mujoco/>")
    with pytest.raises(ConfigError, match="is not the hash of the model that was found"):
        load_config(run / "config.yaml")


def test_another_model_than_the_stored_one_has_a_hash_of_its_own(tmp_path):
    config = load_config(copy_robot(tmp_path, "turtlebot"))
    other = tmp_path / "other.xml"
    other.write_bytes((tmp_path / "turtlebot.xml").read_bytes())
    changed = load_config(config, {"robot.file": str(other)})
    assert changed.robot.file == "other.xml"
    assert changed.robot.sha256 != config.robot.sha256
