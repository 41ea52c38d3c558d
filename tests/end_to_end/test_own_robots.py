"""A robot of one's own, of either kind, through all commands, without the files it came from."""

import json
import subprocess
import sys
import time

import jax
import numpy as np
import pytest

from helpers.further import slow_fixture
from helpers.own_robots import OWN_ROBOTS, copy_robot, load_robot
from helpers.tiny import TINY
from jetbot_mjx import evaluate, export, render
from jetbot_mjx.config import MjcfRobotConfig, load_config, robot_files
from jetbot_mjx.config.robot_mjcf import OF_CARS
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs import checkpoint_steps, load_checkpoint, stored_config
from jetbot_mjx.training import session

SETTINGS = (*TINY, "ppo.learning_rate_schedule=NONE")
"""A training that may go on for longer than it was to, and be the same until then."""

MEASURES = """
robot:
  preset: real
  wheel_radius: 0.04
  wheel_separation: 0.15
  controller_wheel_radius: 0.04
  controller_wheel_separation: 0.15
  chassis_mass: 0.9
task: {observation: egocentric, max_speed: 0.3}
"""


def assert_same_policy(*runs):
    ours, theirs = (jax.tree.leaves(load_checkpoint(run, "last").params) for run in runs)
    for one, other in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(one, other)


# A car has all that a JetBot has not; the others are shown to end the same way by the slow tests.
QUICK, SLOW = ("car",), ("measures", "own drive")
every_kind = pytest.mark.parametrize(
    "trained",
    [*QUICK, *(pytest.param(kind, marks=pytest.mark.slow) for kind in SLOW)],
    indirect=True,
)


@slow_fixture(scope="module")
def trained(request, tmp_path_factory):
    """A run, and the folder that its files came from, which are gone."""
    folder = tmp_path_factory.mktemp("own")
    config = folder / "mine.yaml"
    config.write_text(MEASURES)
    if request.param == "car":
        config = copy_robot(folder, "car")
    if request.param == "own drive":
        (folder / "wheels.py").write_text("def controls(action): return 10.0 * action")
        own = {"drive": "wheels.py:controls", "action_size": 4, "wheels": None}
        config = copy_robot(folder, "rover", settings=own)
    session.run(load_config(config, SETTINGS), folder / "run")
    for file in folder.glob("*.*"):
        file.unlink()
    with pytest.MonkeyPatch.context() as patch:
        # As in another process.
        patch.setattr(robot_files, "_MODELS", {})
        yield folder / "run"


@pytest.mark.slow
@every_kind
def test_the_run_holds_what_the_robot_is(trained):
    config = stored_config(trained)
    assert load_checkpoint(trained).config.robot == config.robot
    if isinstance(config.robot, MjcfRobotConfig):
        assert (trained / "robot" / config.robot.file).is_file()
    else:
        assert (config.robot.wheel_radius, config.robot.friction) == (0.04, 1.0)


@pytest.mark.slow
@every_kind
@pytest.mark.usefixtures("blank_figures", "small_videos")
def test_it_is_evaluated_in_both_simulators_rendered_and_exported(trained, tmp_path):
    evaluate(trained, episodes=4, simulator="mujoco", output=tmp_path / "report")
    assert "in C MuJoCo" in (tmp_path / "report" / "report.md").read_text()
    assert render(trained, episodes=1).files["gif"].is_file()
    assert (
        export.main(
            [
                str(trained),
                "--format",
                "all",
                "--output",
                str(tmp_path / "policy"),
            ]
        )
        == 0
    )
    spec = json.loads((tmp_path / "policy" / "policy.json").read_text())
    config = stored_config(trained)
    assert spec["robot"] == config.robot.model_dump(mode="json")
    if isinstance(config.robot, MjcfRobotConfig) and config.robot.has_own_drive:
        assert [one["name"] for one in spec["action"]] == [f"action_{i}" for i in range(4)]
    elif isinstance(config.robot, MjcfRobotConfig):
        assert spec["wheel_speeds"]["order"] == ["wheel_speed", "curvature"]
        assert spec["frames"]["body"].startswith("that of the base in its model")
        names = [one["name"] for one in spec["actuators"]]
        assert names == ["steer_left", "steer_right", "drive_left", "drive_right"]
    else:
        assert "actuators" not in spec
        assert "axle midpoint" in spec["frames"]["body"]


@pytest.mark.slow
@every_kind
def test_a_training_that_is_continued_ends_with_the_same_bits(trained, tmp_path):
    config = stored_config(trained)
    half = load_config(config, ["ppo.num_timesteps=1024"])
    session.run(half, tmp_path / "run")
    session.run(config, tmp_path / "run")
    assert_same_policy(tmp_path / "run", trained)


@every_kind
def test_a_model_that_was_changed_in_the_run_is_refused(trained):
    config = stored_config(trained)
    if not isinstance(config.robot, MjcfRobotConfig):
        pytest.skip("a robot by its measures has no file")
    file = trained / "robot" / config.robot.file
    text = file.read_text()
    file.write_text(text.replace("0.1", "0.2"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(robot_files, "_MODELS", {})
        with pytest.raises(UserError, match="does not hold the files of the robot's model"):
            stored_config(trained)
    file.write_text(text)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["measures", *OWN_ROBOTS])
def test_a_training_that_is_killed_ends_with_the_same_bits(kind, tmp_path):
    config = tmp_path / "mine.yaml"
    config.write_text(MEASURES)
    if kind != "measures":
        config = copy_robot(tmp_path, kind)
    settings = [word for one in (*SETTINGS, "ppo.num_timesteps=65536") for word in ("--set", one)]

    def start(name):
        program = [sys.executable, "-m", "jetbot_mjx.train", str(config), *settings]
        return subprocess.Popen([*program, "--run-dir", str(tmp_path / name)])

    assert start("whole").wait() == 0
    process = start("killed")
    while len(checkpoint_steps(tmp_path / "killed")) < 3:
        assert process.poll() is None
        time.sleep(0.05)
    process.kill()
    process.wait()
    assert checkpoint_steps(tmp_path / "killed")[-1] < 65536
    assert start("killed").wait() == 0
    assert_same_policy(tmp_path / "killed", tmp_path / "whole")


@pytest.mark.slow
def test_a_car_is_evaluated_where_it_differs(tmp_path):
    session.run(load_robot("car", *TINY), tmp_path / "run")
    report = evaluate(tmp_path / "run", episodes=2, robustness=True)
    names = [result.sweep.name for result in report.robustness]
    assert names == list(OF_CARS)
