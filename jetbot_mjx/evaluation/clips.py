"""Choose the episodes of which a report shows clips; `viewers` renders them."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from jetbot_mjx.envs import JetBotEnv
from jetbot_mjx.evaluation.rollout import Episodes

_SUCCESSES, _FAILURES = 3, 5


class Clip(NamedTuple):
    """A `Clip` holds a video of one episode of a report."""

    goal: int
    """Index of the goal in the fixed set, from 0."""
    reached: bool
    speed: int
    """Pace, as a multiple of real time."""
    mp4: bytes


ClipMaker = Callable[[JetBotEnv, Episodes, Sequence[int]], Sequence[Clip]]
"""A function that renders some episodes of a batch, which are on the host and hold `qpos`.

It raises a `UserError` if this machine cannot render.
"""


def clip_goals(episodes: Episodes) -> list[int]:
    """Return the goals to show: the first three that were reached, and the first five missed."""
    won = np.asarray(episodes.success) > 0
    return [*np.flatnonzero(won)[:_SUCCESSES].tolist(), *np.flatnonzero(~won)[:_FAILURES].tolist()]
