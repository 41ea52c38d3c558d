"""What a training says at its end."""

import importlib.util
import shlex
from pathlib import Path

import pytest

from jetbot_mjx.evaluation.evaluator import Summary
from jetbot_mjx.training.result import Result, summary
from jetbot_mjx.training.run_recorder import Standing


@pytest.mark.parametrize("installed", [True, False])
def test_the_end_names_the_next_commands_and_tensorboard_where_it_is_installed(
    installed, monkeypatch
):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: object() if installed else None)
    mine = Path("runs/mine")
    best = Summary(4, 4, 1.0, 0.5, 1.0, 1.5, 2.0, 0.9, 0.8, 0.1, 0)
    standing = Standing(env_steps=8, best_steps=8, best=best)
    result = Result(mine, [mine], [standing], ["abc"], finished=True, wall_seconds=1.0)
    lines = summary(result).splitlines()
    assert lines[2:5] == [
        "next: jetbot-mjx evaluate runs/mine",
        "      jetbot-mjx render runs/mine",
        "      jetbot-mjx play runs/mine",
    ]
    assert lines[5:] == (["      tensorboard --logdir runs"] if installed else [])


def test_the_next_commands_can_be_copied_where_the_folder_has_blanks():
    mine = Path("my runs/mine")
    standing = Standing(best=Summary(4, 4, 1.0, 0.5, 1.0, 1.5, 2.0, 0.9, 0.8, 0.1, 0))
    result = Result(mine, [mine], [standing], ["abc"], finished=True, wall_seconds=1.0)
    commands = summary(result).partition("next:")[2].splitlines()
    assert [shlex.split(line)[-1] for line in commands[:3]] == ["my runs/mine"] * 3
