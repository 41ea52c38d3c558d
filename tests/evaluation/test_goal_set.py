"""Indices into the report's fixed goals, as they are written and read."""

import pytest

from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation.goal_set import REPORT_GOALS, check_goals, format_goals, parse_goals


@pytest.mark.parametrize(
    ("text", "goals"),
    [("3", [3]), ("3,17", [3, 17]), ("0-3", [0, 1, 2, 3]), ("9, 2-4,7", [9, 2, 3, 4, 7])],
)
def test_goals_are_read_and_written(text, goals):
    assert parse_goals(text) == goals
    assert parse_goals(format_goals(goals)) == goals


def test_consecutive_goals_are_written_as_a_range():
    assert format_goals([0, 1, 2, 5, 7, 8]) == "0-2,5,7-8"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "'' is not a goal: write indices and ranges"),
        ("1-", "'1-' is not a goal"),
        ("-1", "'-1' is not a goal"),
        ("²", "'²' is not a goal"),
        ("7-3", "7-3 is a reversed range: write 3-7"),
        (f"{REPORT_GOALS}", "goal 1024 is not one of the 1,024 fixed goals: they are 0 to 1023"),
        ("0-999999999", "goal 1024 is not one of"),
        ("3,2-4", "goal 3 is given twice"),
    ],
)
def test_an_invalid_list_of_goals_is_refused(text, said):
    with pytest.raises(UserError) as caught:
        parse_goals(text)
    assert said in str(caught.value)


def test_no_goals_and_fractions_are_refused():
    with pytest.raises(UserError, match="is empty: give at least one"):
        check_goals([])
    with pytest.raises(ValueError, match=r"goals: 1\.5 is wrong"):
        check_goals([1.5])
