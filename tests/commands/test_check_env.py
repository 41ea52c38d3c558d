"""The command `check_env`: its output, its exit codes and its answers to mistakes."""

import re

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


OWN = "helpers.broken_environments"


def test_a_sound_environment_is_clean_and_its_costs_are_told(capsys):
    assert check_env.main([f"{OWN}:Sound", "--set", "task.episode_length=8"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line[:16] for line in lines[:4]] == [
        "ok     interface",
        "ok     purity   ",
        "ok     batch    ",
        "ok     drive    ",
    ]
    assert lines[4:9] == [
        f"{OWN}:Sound: no errors",
        "sizes      2 observations, 1 action",
        "metrics    speed",
        "state      3 numbers that a later step reads",
        "step is one kernel",
    ]
    assert re.fullmatch(r"rate       \S+ environment steps/s of 1,024 instances on .*", lines[-1])


def test_an_environment_that_is_no_kernel_is_told_why(capsys):
    assert check_env.main([f"{OWN}:Sorts"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[8].startswith("step is no kernel: one kernel cannot do ")
    assert "of 16 instances" in lines[-1]


def test_a_finding_about_an_environment_gives_exit_code_1(capsys):
    assert check_env.main([f"{OWN}:HasNoReset"]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("wrong  interface  ")
    assert lines[1].endswith("HasNoReset is no environment: it lacks reset")
    assert lines[2:] == [
        "not checked until that is corrected: purity, batch, drive",
        f"{OWN}:HasNoReset: 1 error",
    ]


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["cartpole"], "cartpole:Cartpole"),
        (["{examples}/cartpole.yaml"], "cartpole:Cartpole"),
        (["--config", "cartpole"], "cartpole:Cartpole"),
        (["--config", "cartpole", f"{OWN}:Sound"], f"{OWN}:Sound"),
        (["gates"], "gates_task:GatesTask"),
    ],
)
def test_what_is_checked_has_a_name_or_a_file(root, monkeypatch, arguments, code):
    asked = []
    for name in ("check_task", "check_environment"):
        monkeypatch.setattr(envs, name, lambda x: asked.append(x) or [("purity", ["wrong"])])
    words = [word.replace("{examples}", str(root / "examples")) for word in arguments]
    assert check_env.main(words) == 1
    assert asked[0].code == code


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
    assert "give a configuration, or a class as file.py:Class" in capsys.readouterr().err


@pytest.mark.slow
def test_a_robots_own_model_decides_what_touches_the_floor(root, capsys):
    assert check_env.main(["--config", str(root / "examples" / "turtlebot.yaml")]) == 0
    assert "is in no contact pair" not in capsys.readouterr().out
