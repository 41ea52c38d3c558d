"""The hint at the end of a training."""

import importlib.util
import shlex
from pathlib import Path

import pytest

from helpers import point_mass
from jetbot_mjx import training
from jetbot_mjx.evaluation.evaluator import Summary
from jetbot_mjx.training import session


@pytest.mark.parametrize("installed", [True, False])
def test_the_end_names_the_next_commands_and_tensorboard_where_it_is_installed(
    installed, monkeypatch
):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object() if installed else None)
    mine = Path("runs/mine")
    best = Summary(4, 4, 1.0, 0.5, 1.0, 1.5, 2.0, 0.9, 0.8, 0.1, 0)
    standing = session.Standing(env_steps=8, best_steps=8, best=best)
    result = session.Result(mine, [mine], [standing], ["abc"], finished=True, wall_seconds=1.0)
    lines = session.summary(result).splitlines()
    assert lines[2:5] == [
        "next: jetbot-mjx evaluate runs/mine",
        "      jetbot-mjx render runs/mine",
        "      jetbot-mjx play runs/mine",
    ]
    assert lines[5:] == (["      tensorboard --logdir runs"] if installed else [])


def test_the_next_commands_can_be_copied_where_the_folder_has_blanks():
    mine = Path("my runs/mine")
    standing = session.Standing(best=Summary(4, 4, 1.0, 0.5, 1.0, 1.5, 2.0, 0.9, 0.8, 0.1, 0))
    result = session.Result(mine, [mine], [standing], ["abc"], finished=True, wall_seconds=1.0)
    commands = session.summary(result).partition("next:")[2].splitlines()
    assert [shlex.split(line)[-1] for line in commands[:3]] == ["my runs/mine"] * 3


@pytest.mark.parametrize(
    ("name", "commands"),
    [("PointMass", ["evaluate", "export"]), ("Shown", ["evaluate", "export", "render"])],
)
def test_an_environment_gets_the_commands_that_work_for_it(name, commands, tmp_path):
    result = training.run(point_mass.config(name), tmp_path / "mine")
    lines = session.summary(result).partition("next:")[2].splitlines()
    assert [line.split()[1] for line in lines if "jetbot-mjx" in line] == commands
