"""What a training says at its end."""

import importlib.util
import shlex
from pathlib import Path

import pytest

from jetbot_mjx.config import parse_config
from jetbot_mjx.evaluation.evaluator import Summary
from jetbot_mjx.training.result import Result, summary, target_message
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


def result_of(rates, **fields):
    """A finished training whose seeds have these success rates."""
    best = Summary(4, 4, 1.0, 0.5, 1.0, 1.5, 2.0, 0.9, 0.8, 0.1, 0)
    standings = [Standing(best=best._replace(success_rate=rate)) for rate in rates]
    folders = [Path(f"runs/mine/seed-{index}") for index in range(len(rates))]
    shas = ["abc"] * len(rates)
    return Result(folders[0].parent, folders, standings, shas, True, 1.0, **fields)


@pytest.mark.parametrize(
    ("rates", "said"),
    [
        ([1.0, 1.0], "2 seeds: 100.00% success in the mean"),
        ([0.9, 1.0], "2 seeds: 95.00% success in the mean"),
        ([1.0] * 5, "5 seeds: 100.00% success in the mean"),
        (
            [0.9, 0.9, 1.0],
            "3 seeds: 93.33% success in the mean (95 % interval 90.00% .. 100.00%, too narrow for"
            " so few seeds)",
        ),
        (
            [0.9] * 4 + [1.0],
            "5 seeds: 92.00% success in the mean (95 % interval 90.00% .. 96.00%)",
        ),
    ],
)
def test_an_interval_over_seeds_is_told_where_it_says_something(rates, said):
    assert summary(result_of(rates)).splitlines()[len(rates)] == said


@pytest.mark.parametrize(
    ("settings", "steps", "said"),
    [
        ({"stop_at_success": 0.99}, 8192, "stop_at_success = 0.99 reached at 8,192 steps"),
        ({"stop_at_return": -5}, 8192, "stop_at_return = -5 reached at 8,192 steps"),
        ({"stop_at_success": 0.99}, 10**9, ""),
    ],
)
def test_the_end_says_which_target_was_reached_before_the_last_step(settings, steps, said):
    config = parse_config({**settings, "environment": "a:B"} if "return" in said else settings)
    line = target_message(config, [Standing(env_steps=steps)])
    assert line == said
    lines = summary(result_of([1.0], ended_early=line)).splitlines()
    assert (lines[1] == said) == bool(said)
    assert lines[1 + bool(said)] == "total 1.0 s"
