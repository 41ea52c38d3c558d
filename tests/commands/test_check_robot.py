"""`check_robot` tells what a robot is, how it follows its commands, and what is wrong with it."""

import re

import pytest

from helpers.own_robots import EXAMPLES, OWN_ROBOTS, copy_robot, load_robot
from jetbot_mjx import check_robot
from jetbot_mjx.config import parse_config
from jetbot_mjx.envs import make_env, training_hints
from jetbot_mjx.errors import UserError


@pytest.fixture
def checked(monkeypatch, capsys):
    """What it prints for a file; what a step costs is printed by `onekernel.explain`."""
    monkeypatch.setattr(check_robot, "_tell_cost", lambda env: None)

    def check(*arguments):
        assert check_robot.main([*map(str, arguments)]) == 0
        return capsys.readouterr().out

    return check


def test_a_configuration_is_checked_with_its_settings(checked):
    printed = checked(EXAMPLES / "rover.yaml", "--set", "robot.wheel_separation=0.2")
    assert "rover: 3.2 kg" in printed
    assert "0.79 m/s of task.max_speed = 0.8" in printed
    assert "wheels of 50 mm, 200 mm apart for the controller" in printed
    assert "hint       the robot turns with" in printed
    turn = int(re.search(r"turn +(\d+)%", printed)[1])
    assert 30 < turn < 45
    assert re.search(r"robot.wheel_separation = 0.4\d would make that (99|10[01])%", printed)


def test_a_robot_that_is_faster_than_it_is_told_gets_a_radius_and_then_a_separation(
    checked, tmp_path
):
    file = tmp_path / "mine.yaml"
    file.write_text("robot: {preset: real, wheel_radius: 0.04}\ntask: {max_speed: 0.3}\n")
    printed = checked(file)
    assert "robot drives with 121% of the speed that is commanded" in printed
    assert "the robot turns with" not in printed
    radius = float(
        re.search(r"controller_wheel_radius = ([\d.]+) would make that 100%", printed)[1]
    )
    assert radius == pytest.approx(1.21 * 0.0325, rel=0.01)
    printed = checked(file, "--set", f"robot.controller_wheel_radius={radius}")
    assert "0.3 m/s of task.max_speed = 0.3" in printed
    assert "robot drives with" not in printed
    # Weak motors are slow whatever the controller takes their wheels for.
    weak = ("--set", "robot.max_wheel_speed=5", "--set", "robot.controller_wheel_radius=0.04")
    assert "robot.controller_wheel_radius" not in checked(file, *weak)


def test_a_wheel_that_does_not_touch_the_floor_is_why_a_robot_leans(tmp_path, capsys):
    nose = '<geom name="nose" class="touches" type="sphere" pos="0.05 0 0.02" size="0.01"/>'
    small = [('type="sphere" size="0.033"', 'type="sphere" size="0.001"')]
    small.append(('<geom name="scanner"', f'{nose}<geom name="scanner"'))
    with pytest.raises(UserError, match="wheel 'left_wheel' does not touch the floor: make it"):
        check_robot.main([str(copy_robot(tmp_path, "turtlebot", small))])


def test_what_keeps_a_robot_from_the_farthest_goal_is_told(checked):
    printed = checked("turtlebot")
    assert "goals      reached within 98.5 mm on the floor" in printed
    assert "hint" not in printed
    # 1.1 m at 0.49 m/s, and half a turn at 2.5 rad/s.
    printed = checked("turtlebot", "--set", "task.episode_length=192")
    assert "rear takes 3.5 s, and an episode ends after 3.2 s: task.episode_length = 384" in printed
    # A horizon of 100 steps of 1/60 s is a sixth of half a turn at 0.3 rad/s.
    slow = ("--set", "task.max_yaw_rate=0.3", "--set", "task.episode_length=1024")
    printed = checked("turtlebot", *slow, "--set", "ppo.discounting=0.99")
    assert "half a turn takes 10 s, beyond the horizon of ppo.discounting = 0.99: 0.996" in printed
    assert "hint" not in checked("turtlebot", *slow, "--set", "ppo.discounting=0.9945")
    assert "hint" not in checked("car")
    printed = checked("car", "--set", "ppo.discounting=0.7", "--set", "task.episode_length=64")
    assert "rear takes 2.4 s, and an episode ends after 2.1 s" in printed
    assert "half a turn takes 0.99 s, beyond the horizon of ppo.discounting = 0.7: 0.92" in printed


@pytest.mark.parametrize("name", OWN_ROBOTS)
def test_before_a_training_the_examples_are_told_nothing(name):
    assert training_hints(make_env(load_robot(name))) == []


def test_before_a_training_a_rover_that_skids_is_told_that_it_does():
    turn, goals = training_hints(make_env(load_robot("rover", "robot.wheel_separation=0.2")))
    assert turn.startswith("the robot turns with ")
    assert re.search(r"robot.wheel_separation = 0.4\d would make that (99|10[01])%", turn)
    assert "half a turn takes" in goals


def test_a_proposed_separation_of_wheels_does_what_is_said(checked):
    # A rover that skids does not turn in proportion to it.
    printed = checked("rover", "--set", "robot.wheel_separation=0.2")
    (better,) = re.findall(
        r"robot.wheel_separation = (\S+) would make that (?:9[5-9]|10[0-5])%", printed
    )
    assert "commanded:" not in checked("rover", "--set", f"robot.wheel_separation={better}")


def test_no_larger_separation_is_proposed_than_a_configuration_may_have(checked, tmp_path):
    config = copy_robot(
        tmp_path, "turtlebot", [("<freejoint/>", '<joint type="free" damping="5"/>')]
    )
    printed = checked(config)
    assert re.search(r"robot.wheel_separation = 2 would make that \d\d%", printed)


def test_needless_contacts_are_told(checked, tmp_path):
    said = "each step looks for contacts of "
    touches = [
        ('contype="1" conaffinity="0" type="sphere"', 'contype="1" conaffinity="1" type="sphere"')
    ]
    touches += [('<geom name="head"', '<geom name="head" contype="1"')]
    printed = checked(copy_robot(tmp_path, "rover", touches))
    assert said + "6 pairs of the robot's own parts and of head with the floor" in printed
    tyres = [
        (f'"front_{side}_tyre"', f'"front_{side}_tyre" {own}')
        for side, own in (("left", 'contype="3"'), ("right", 'conaffinity="2"'))
    ]
    printed = checked(copy_robot(tmp_path, "rover", tyres))
    assert said + "1 pair of the robot's own parts, which costs" in printed


def test_a_jetbot_that_cannot_drive_is_refused_before_it_is_trained():
    env = make_env(parse_config({"robot": {"preset": "real", "motor_torque": 1e-4}}))
    with pytest.raises(UserError, match="the motors are too weak or too slow"):
        training_hints(env)
    # A shipped robot is what it is, however fast it is told to drive.
    shipped = parse_config({"robot": {"preset": "real"}, "task": {"max_speed": 3.0}})
    assert training_hints(make_env(shipped)) == []


def test_of_a_model_alone_the_parts_are_guessed_and_printed(checked):
    printed = checked(EXAMPLES / "car.xml")
    assert '"drive": "ackermann", "steering": {"left": ["steer_left"]' in printed
    assert "turn       circles of 0.2" in printed


def test_a_configuration_of_the_package_is_checked_by_its_name(checked):
    assert "turtlebot: 1.8 kg" in checked("turtlebot")


def test_other_endings_of_a_model_are_known_and_other_files_refused(checked, tmp_path):
    model = (EXAMPLES / "turtlebot.xml").read_bytes()
    (tmp_path / "mine.mjcf").write_bytes(model)
    assert '"file": "mine.mjcf"' in checked(tmp_path / "mine.mjcf")
    for name in ("mine.mjb", "mine.urdf"):
        (tmp_path / name).write_bytes(b"<robot/>")
        with pytest.raises(UserError, match=r"NAME.xml|this is URDF"):
            checked(tmp_path / name)


def test_measures_are_checked(checked, root):
    printed = checked(root / "jetbot_mjx" / "assets" / "robots" / "real.yaml")
    assert "real: 0.694 kg" in printed


@pytest.mark.slow
def test_what_a_step_costs_is_told(capsys):
    assert check_robot.main([str(EXAMPLES / "turtlebot.yaml")]) == 0
    printed = capsys.readouterr().out
    assert "step_of_this_robot is one kernel" in printed
    assert "environment steps/s of 1,024 robots on this" in printed


def test_what_is_wrong_is_told(checked, tmp_path):
    config = copy_robot(tmp_path, "turtlebot", [("<freejoint/>", "")])
    with pytest.raises(UserError, match="no body of the world has a free joint"):
        checked(config)
    (tmp_path / "ball.xml").write_text("<mujoco><worldbody/></mujoco>")
    with pytest.raises(UserError, match="no actuators turn wheels on both sides"):
        checked(tmp_path / "ball.xml")


def test_a_motor_faster_than_a_time_step_is_told_with_the_armature_that_it_needs(checked, tmp_path):
    def told(armature):
        change = [('armature="6e-4"', f'armature="{armature}"')]
        return checked(copy_robot(tmp_path, "turtlebot", change))

    printed = told(0)
    assert "the motor of left and others chatters where the wheel slips" in printed
    constant, step, missing = re.search(
        r"speed within (\S+) ms, and physics.sim_dt is (\S+) ms. An armature of (\S+) kg", printed
    ).groups()
    assert 2 * float(constant) < float(step)
    assert "chatters" not in told(missing)
    # Twice the time constant is the limit: there, each step reverses the error.
    assert "chatters" in told(float(missing) / 2 - 0.06 * float(missing))
    assert "chatters" not in told(float(missing) / 2)


def test_a_mesh_that_may_touch_the_floor_is_told(checked, tmp_path):
    corners = "0 0 0 0.1 0 0 0 0.1 0 0 0 0.1"
    asset = ("<worldbody>", f'<asset><mesh name="m" vertex="{corners}"/></asset><worldbody>')
    head = '<geom name="nose" type="mesh" mesh="m" mass="0.01"{}/><geom name="head"'
    for extra, expected in ((' contype="1"', True), (' contype="0"', False)):
        folder = tmp_path / str(expected)
        folder.mkdir()
        changes = [asset, ('<geom name="head"', head.format(extra))]
        printed = checked(copy_robot(folder, "rover", changes))
        assert ("where nose touches the floor, MJX has other points" in printed) == expected


WEAK = ('kv="0.08"', 'kv="0.02"')


def test_of_a_robot_that_drags_nothing_else_is_told(checked, tmp_path):
    smooth = 'size="0.01" friction="0.001" priority="1" condim="1"'
    rough = smooth.replace("0.001", "0.9").replace('condim="1"', 'condim="3"')
    printed = checked(copy_robot(tmp_path, "turtlebot", [(smooth, rough), WEAK]))
    assert re.search(r"drives with \d\d% of the speed that is commanded: .* ball \(0.9\)", printed)
    assert "robot.wheel_separation" not in printed
    assert "episode_length" not in printed


def test_an_elliptic_cone_is_told_to_be_a_pyramidal_one(checked, tmp_path):
    for cone in ("elliptic", "pyramidal"):
        (folder := tmp_path / cone).mkdir()
        change = [("<worldbody>", f'<option cone="{cone}"/><worldbody>')]
        printed = checked(copy_robot(folder, "turtlebot", change))
        assert ("not the elliptic one" in printed) == (cone == "elliptic")


def test_a_robot_that_does_not_drive_straight_is_told(checked, tmp_path):
    hint = re.compile(r"told to drive straight ahead, the robot turns by (-?\d+)° each second")
    joint = '<joint name="rear_left"'
    for extra in ("", ' frictionloss="1.1"'):
        (folder := tmp_path / f"{len(extra)}").mkdir()
        printed = checked(copy_robot(folder, "rover", [(joint, joint + extra)]))
        found = hint.search(printed)
        assert bool(found) == bool(extra)
    # To the left, whose wheel drags.
    assert int(found[1]) > 2
    assert "robot.wheel_separation" not in printed


def test_actuators_without_names_are_named(tmp_path, capsys):
    text = (EXAMPLES / "turtlebot.xml").read_text("utf-8")
    for names in ((' name="left"', ' name="right"'), (' name="left"',)):
        changed = text
        for name in names:
            changed = changed.replace(f"<velocity{name}", "<velocity")
        (tmp_path / "robot.xml").write_text(changed, "utf-8")
        with pytest.raises(UserError, match="an actuator of a wheel has no name: give each one"):
            check_robot.main([str(tmp_path / "robot.xml")])


def test_a_robot_that_falls_through_the_floor_is_told_so(checked, tmp_path):
    through = [('class="touches" type="sphere"', 'type="sphere" contype="0"')]
    config = copy_robot(tmp_path, "turtlebot", through, {"wheel_radius": 0.033})
    with pytest.raises(UserError, match="it falls through the floor: no wheel collides"):
        checked(config)
