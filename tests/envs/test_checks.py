"""Every error that a task can have is found and reported in one line."""

import jax.numpy as jnp
import pytest

from helpers import gliding
from jetbot_mjx.config import load_config, parse_config
from jetbot_mjx.envs.checks.runner import check_task
from jetbot_mjx.errors import UserError


def config_of(name, **task):
    return parse_config({"task": {"name": name, **task}})


def first_findings(config):
    """The first check that finds something, and what it finds."""
    with gliding.everywhere():
        for check, findings in check_task(config):
            if findings:
                return check, findings
    return None, []


@pytest.mark.parametrize(
    ("name", "check", "told"),
    [
        ("TwoOfAName", "layout", "'position' 2 times: give each"),
        ("NoUnit", "layout", "'goal_position' has no unit: say it"),
        (
            "NoScale",
            "layout",
            "'battery' has the unit 'V', for which no smallest deviation is known",
        ),
        ("NegativeScale", "layout", "'goal_position' has min_std = -0.1: it should be a positive"),
        ("CannotBeBuilt", "layout", "IndexError: tuple index out of range (broken_tasks.py:"),
        ("DecidesInPython", "purity", "success raises TracerBoolConversionError: Python cannot"),
        ("Raises", "purity", "observe raises KeyError: 'lidar' (broken_tasks.py:"),
        ("DrawsFromPython", "purity", "sample is another program each time"),
        ("KeepsWhatItSaw", "purity", "changes self.seen: methods must be pure"),
        ("LongerThanItsLayout", "types", "observe has the shape [17]: it should be [16]"),
        ("WeaklyTyped", "types", "reward has a weak type, of Python's own number: write"),
        ("NumberForTruth", "types", "terminated is float32: it should be bool"),
        ("NoTerms", "types", "reward returns something other than (reward, {name: term})"),
        ("ChangesTheTree", "types", "advance makes float32[3] of sample int32[3]"),
        ("SameEveryTime", "draws", "sample draws the same for every key"),
        ("AsksTheHost", "batches", "reward under jax.vmap differs from one robot at a time"),
        ("DividesByZero", "finite", "a robot standing exactly on the goal: guard"),
        ("OverflowsFarAway", "finite", "a robot far away, tumbling and fast"),
        ("HidesAPenalty", "reward", "name every part of the reward among the terms"),
        ("SucceedsOnAndOn", "endings", "success without terminated (a robot"),
        ("EndsWhereItBegins", "endings", "of 256 episodes have ended where the robot starts"),
        ("InheritsMoveGoal", "goal", "move_goal returns another tree than sample"),
        ("ForgetsWhereItMoved", "goal", "goal_position is not where move_goal has put"),
        (
            "MarksNobody",
            "scene",
            "'flag', which is not a mocap body: add_body(name='flag', mocap=True)",
        ),
        ("PutsItOnTheRobot", "scene", "'pillar' touches something in 256 of 256 episodes"),
        (
            "LeavesItSolid",
            "scene",
            "geom 'wall' can collide and is in no contact pair: give it contype=0",
        ),
        ("StandsOnTheRobot", "scene", "'ball' touches something"),
        ("NamesATermAnewEachTime", "drive", "the state's metrics['reward/progress_"),
    ],
)
def test_every_fault_is_found_by_its_check(name, check, told):
    found, messages = first_findings(config_of(f"helpers.broken_tasks:{name}"))
    assert found == check
    assert any(told in message for message in messages)
    assert not any("\n" in message for message in messages)


def test_a_non_finite_state_is_found_during_a_drive(monkeypatch):
    def blow_up(self, state, ctrl, mocap_pos=None):
        return state.replace(qvel=state.qvel * jnp.nan)

    monkeypatch.setattr(gliding.GlidingPhysics, "step", blow_up)
    check, messages = first_findings(config_of("helpers.broken_tasks:Sound"))
    assert check == "drive"
    assert "1024 of 1024 steps are not finite" in messages[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    "config",
    [
        pytest.param(lambda root: config_of("jetbot_mjx:GoalTask"), id="world"),
        pytest.param(
            lambda root: config_of("jetbot_mjx:GoalTask", observation="egocentric"),
            id="egocentric",
        ),
        *[
            pytest.param(
                lambda root, n=n: load_config(root / "examples" / f"{n}.yaml"),
                id=n,
                marks=[] if n == "gates" else pytest.mark.slow,
            )
            for n in ("obstacle", "pillars", "gates")
        ],
    ],
)
def test_nothing_is_wrong_with_what_is_shipped(root, monkeypatch, config):
    monkeypatch.syspath_prepend(str(root / "examples"))
    assert first_findings(config(root)) == (None, [])


def test_a_check_that_the_rest_rests_on_ends_the_list():
    names = [name for name, _ in check_task(config_of("helpers.broken_tasks:Raises"))]
    assert names == ["layout", "purity"]


def test_a_task_that_is_not_there_is_the_users_mistake():
    with pytest.raises(UserError, match=r"helpers\.broken_tasks has no 'Nobody'"):
        list(check_task(config_of("helpers.broken_tasks:Nobody")))
