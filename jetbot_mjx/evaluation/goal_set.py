"""Define the size of the report's fixed goal set, and read and write indices into it.

The commands parse their arguments with this module, so it imports no large library.
"""

import numbers
import re
from collections.abc import Iterable, Sequence
from itertools import groupby

from jetbot_mjx.errors import InvalidError

GOAL_SET_VERSION = 1
"""Version number that increases whenever the goals or the rules of the report change."""

REPORT_GOALS = 1024
"""Default number of fixed goals in a report."""

MOST_GOALS = 1_048_576
"""Largest number of goals that the user can ask for."""


def check_goals(goals: Sequence[int]) -> list[int]:
    """Return indices as a list, unless one is outside of the fixed goal set or occurs twice.

    Args:
      goals: The indices; an array holds some, too.

    Raises:
      InvalidError: an index is invalid or occurs twice, or there is none.
    """
    if not isinstance(goals, Iterable):
        raise InvalidError(f"goals = {goals!r} is wrong: give indices, as in [3, 17]")
    goals = list(goals)
    if not goals:
        raise InvalidError("goals = [] is empty: give at least one index")
    for place, goal in enumerate(goals):
        if not isinstance(goal, numbers.Integral):
            raise InvalidError(f"goals: {goal!r} is wrong: give indices, as in [3, 17]")
        if not 0 <= goal < REPORT_GOALS:
            raise InvalidError(
                f"goal {goal} is not one of the {REPORT_GOALS:,} fixed goals: they are 0 to"
                f" {REPORT_GOALS - 1}"
            )
        if goal in goals[:place]:
            raise InvalidError(f"goal {goal} is given twice: give it once")
    return [int(goal) for goal in goals]


def format_goals(goals: Sequence[int]) -> str:
    """Format indices as `3,17`, or `0-7` for consecutive ones."""
    runs = [
        [goal for _, goal in run] for _, run in groupby(enumerate(goals), lambda p: p[1] - p[0])
    ]
    return ",".join(f"{run[0]}-{run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs)


def parse_goals(text: str) -> list[int]:
    """Return the goals that a text lists as indices and ranges, such as `3,17` or `0-7`.

    Args:
      text: Indices and ranges, separated by commas.

    Returns:
      The indices, in the order of the text.

    Raises:
      InvalidError: the text is not such a list, or `check_goals` rejects an index.
    """
    goals: list[int] = []
    for part in text.split(","):
        found = re.fullmatch(r"(\d{1,9})(?:-(\d{1,9}))?", part.strip(), re.ASCII)
        if found is None:
            raise InvalidError(
                f"{part!r} is not a goal: write indices and ranges, as in 3,17 or 0-7"
            )
        first, last = int(found[1]), int(found[2] or found[1])
        if last < first:
            raise InvalidError(f"{part} is a reversed range: write {last}-{first}")
        # Limit the length: an index beyond the last goal is rejected below anyway.
        goals += range(first, min(last, first + REPORT_GOALS) + 1)
    check_goals(goals)
    return goals
