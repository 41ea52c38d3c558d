"""Look up the best-known time to each of the report's goals, as a reference for a policy's time.

The file in the package holds the results of `benchmarks/learning/best_known.py`. It searches
commands for each goal with the true model and executes them open-loop, so their time is an upper
bound of the shortest time. Each search states the settings for which it is valid; there are no
times for any other task, robot or time step.
"""

import json
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jetbot_mjx.config import Config
from jetbot_mjx.evaluation.goal_set import GOAL_SET_VERSION
from jetbot_mjx.evaluation.rollout import Episodes
from jetbot_mjx.runs import JsonObject

FILE = Path(__file__).parents[1] / "assets" / "best_known.json"

FORMAT = "jetbot_mjx-best-known/1"
"""Format of that file."""

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


def find(config: Config, episodes: Episodes) -> Float[np.ndarray, " n"] | str:
    """Find the best-known times to the goals on which a policy was evaluated.

    Args:
      config: the configuration of the policy's run.
      episodes: the policy's episodes on the first goals of the report, with arrays on the host.

    Returns:
      The number of environment steps to each goal, or in one line why there are no times.
    """
    return look_up(FILE, "search", config, episodes)


def look_up(
    file: Path, kind: str, config: Config, episodes: Episodes
) -> Float[np.ndarray, " n"] | str:
    """Find numbers of steps to the goals on which a policy was evaluated.

    Args:
      file: the file with the numbers for some settings.
      kind: what they were computed by.
      config: the configuration of the policy's run.
      episodes: the policy's episodes on the first goals of the report, with arrays on the host.

    Returns:
      The number of environment steps to each goal, or in one line why there are none.
    """
    # Choose the search whose settings differ least from this configuration's.
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
