"""The command `check_env`: its output, its exit codes and its answers to mistakes."""

import pytest

from helpers import gliding
from jetbot_mjx import check_env, envs
from jetbot_mjx.errors import UserError


def test_a_sound_task_is_clean(capsys):
    with gliding.everywhere():
        assert check_env.main(["helpers.broken_tasks:Sound"]) == 0
    printed = capsys.readouterr().out
    assert printed.count("ok ") == 11
    assert printed.splitlines()[-1] == "helpers.broken_tasks:Sound: no errors"


def test_a_finding_is_one_line_and_gives_exit_code_1(capsys):
    assert check_env.main(["helpers.broken_tasks:Raises"]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].startswith("wrong  purity")
    assert lines[2].startswith("       - observe raises KeyError: 'lidar' (broken_tasks.py:")
    assert lines[3].startswith("not checked until that is corrected: types, draws")
    assert lines[4] == "helpers.broken_tasks:Raises: 1 error"


def test_a_built_in_task_goes_by_its_class(capsys, monkeypatch):
    asked = []
    monkeypatch.setattr(envs, "check_task", lambda config: asked.append(config.task) or iter(()))
    check_env.main(["GoalTask", "--set", "task.observation=egocentric"])
    assert (asked[0].name, asked[0].observation) == ("jetbot_mjx:GoalTask", "egocentric")


def test_a_configuration_names_its_task(root, monkeypatch):
    asked = []
    monkeypatch.setattr(envs, "check_task", lambda config: asked.append(config.task) or iter(()))
    check_env.main(["--config", str(root / "examples" / "gates.yaml")])
    assert (asked[0].name, asked[0].episode_length) == ("gates_task:GatesTask", 360)


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["nowhere.at_all:Task"], "there is no nowhere/at_all.py beside"),
        (["helpers.broken_tasks:Nobody"], "helpers.broken_tasks has no 'Nobody'"),
        (["Nobody"], "jetbot_mjx has no 'Nobody'"),
        (["GoalTask", "--set", "task.optoins.a=1"], "optoins"),
        (["helpers.broken_tasks:Drawn"], "is not a task: it lacks sample"),
    ],
)
def test_a_users_mistake_is_one_line(arguments, told):
    with pytest.raises(UserError, match=told):
        check_env.main(arguments)


def test_a_command_that_names_nothing_is_refused(capsys):
    with pytest.raises(SystemExit) as left:
        check_env.main([])
    assert left.value.code == 2
    assert "give a task as package.module:Class" in capsys.readouterr().err


def test_a_robots_own_model_decides_what_touches_the_floor(root, capsys):
    assert check_env.main(["--config", str(root / "examples" / "turtlebot.yaml")]) == 0
    assert "is in no contact pair" not in capsys.readouterr().out
