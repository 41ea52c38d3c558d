"""Look up the best-known time to each of the report's goals, and a bound below it.

The files in the package hold the results of `benchmarks/learning/best_known.py`, which searches
commands for each goal with the true model and executes them open-loop, so that their time is an
upper bound of the shortest time, and of `benchmarks/learning/lower_bound.py`, which computes from
the limits of the robot's motion a time in which no controller reaches the goal. Each result states
the settings for which it is valid; there are no times for any other task, robot or time step.
"""

import json
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float

from jetbot_mjx.config import Config
from jetbot_mjx.evaluation.goal_set import GOAL_SET_VERSION
from jetbot_mjx.evaluation.rollout import Episodes
from jetbot_mjx.runs import JsonObject

_ASSETS = Path(__file__).parents[1] / "assets"
FILE, BOUND_FILE = _ASSETS / "best_known.json", _ASSETS / "lower_bound.json"

Kind = Literal["search", "bound"]

FORMAT = "jetbot_mjx-best-known/1"
"""Format of the first of these files."""

SETTINGS = (
    "task.name",
    "task.max_speed",
    "task.max_yaw_rate",
    "task.goal_distance_min",
    "task.goal_distance_span",
    "task.success_radius",
    "physics.ctrl_dt",
    "physics.sim_dt",
)
"""Settings that the goals and the times to them depend on, besides the robot."""

_GOAL_TOLERANCE = 1.5e-3  # [m] The file holds whole millimetres.


def settings_of(config: Config) -> JsonObject:
    """Return the robot and the settings of a configuration that the times depend on, by key."""
    flat = config.flat()
    return {"robot.preset": config.robot.label, **{name: flat[name] for name in SETTINGS}}


def find(kind: Kind, config: Config, episodes: Episodes) -> Float[np.ndarray, " n"] | str:
    """Find numbers of steps to the goals on which a policy was evaluated.

    Args:
      kind: what they were computed by: a search, or as a bound of them.
      config: the configuration of the policy's run.
      episodes: the policy's episodes on the first goals of the report, with arrays on the host.

    Returns:
      The number of environment steps to each goal, or in one line why there are none.
    """
    # Choose the search whose settings differ least from this configuration's.
    file = FILE if kind == "search" else BOUND_FILE
    searches = [
        one
        for one in json.loads(file.read_text(encoding="utf-8"))["searches"]
        if one["goal_set_version"] == GOAL_SET_VERSION
    ]
    if not searches:
        return f"no {kind} was made for these goals"
    ours = settings_of(config)

    def differing(search: JsonObject) -> list[str]:
        return [name for name, value in ours.items() if search["settings"][name] != value]

    search = min(searches, key=lambda one: len(differing(one)))
    if names := differing(search):
        stated = ", ".join(f"{name} = {search['settings'][name]}" for name in names)
        own = ", ".join(str(ours[name]) for name in names)
        return f"the {kind} was made for {stated}, and this run has {own}"
    # Check that the search covers exactly these goals.
    count = episodes.steps.size
    goals, steps = np.asarray(search["goals"], float) / 1e3, np.asarray(search["steps"], float)
    if len(steps) < count:
        return f"the {kind} covers {len(steps):,} of these {count:,} goals"
    if np.abs(goals[:count] - episodes.goal_w[:, :2]).max() > _GOAL_TOLERANCE:
        return f"the {kind} was made for goals at other positions"
    return steps[:count]
