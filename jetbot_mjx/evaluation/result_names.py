"""Choose where results are written, so that a quick look does not replace a fuller result."""

import json
from pathlib import Path

from jetbot_mjx.evaluation.goal_set import GOAL_SET_VERSION, REPORT_GOALS
from jetbot_mjx.runs import read_text

PARTS = ("robustness", "randomized", "mujoco", "rendered")
"""Parts of a report that are written on request or if the run has ranges; keys of its JSON file,
but `rendered`, which is a key below `mujoco`."""


def name_with_count(name: str, count: int, default: int, unit: str = "") -> str:
    """Return the name of a result, with the count after it unless that is the default.

    Args:
      name: the name, such as `episodes`.
      count: the number of episodes that the result is about.
      default: the number of episodes without an option.
      unit: what follows the count.
    """
    return name if count == default else f"{name}-{count}{unit}"


def run_name(checkpoint: Path) -> str:
    """Return the readable name of a run; for a seed, with the folder that holds all seeds.

    Args:
      checkpoint: the folder of a checkpoint of the run.
    """
    run_dir = checkpoint.parents[1]
    alone = not run_dir.name.startswith("seed-")
    return run_dir.name if alone else f"{run_dir.parent.name}/{run_dir.name}"


def report_folder(evaluations: Path, name: str, goals: int, parts: frozenset[str]) -> Path:
    """Choose the folder of a new report, in which no fuller report lies.

    The folder is `<name>`; with fewer goals than the default `<name>-<goals>-goals`. If the report
    in it has more goals, or parts that the new one lacks, the names of the new report's parts
    follow, or `nominal` if it has none.

    Args:
      evaluations: the folder of all reports of the run.
      name: the name of the checkpoint.
      goals: the number of goals of the new report.
      parts: those of `PARTS` that the new report has.

    Returns:
      The folder, which may not exist yet.
    """
    own_name = name_with_count(name, goals, REPORT_GOALS, "-goals")
    folder = evaluations / (name if goals >= REPORT_GOALS else own_name)
    found = _goals_and_parts(folder)
    if found is None or (found[0] <= goals and found[1] <= parts):
        return folder
    return evaluations / f"{own_name}-{'-'.join(sorted(parts)) or 'nominal'}"


def find_report(evaluations: Path, name: str, goals: int, parts: frozenset[str]) -> Path | None:
    """Return the folder of a report that is at least as full as a new one; None without one.

    Args:
      evaluations: as for `report_folder`, like all other arguments.
      name: the name of the checkpoint.
      goals: the number of goals of the new report.
      parts: those of `PARTS` that the new report has.
    """
    own_name = name_with_count(name, goals, REPORT_GOALS, "-goals")
    own_folder = report_folder(evaluations, name, goals, parts)
    for folder in (evaluations / name, evaluations / own_name, own_folder):
        found = _goals_and_parts(folder)
        if found is not None and found[0] >= goals and found[1] >= parts:
            return folder
    return None


def fuller_report(folder: Path, name: str) -> Path | None:
    """Return the folder that a report of the checkpoint `name` was written beside, if it exists."""
    other = folder.with_name(name)
    return other if folder != other and _goals_and_parts(other) is not None else None


def _goals_and_parts(folder: Path) -> tuple[int, frozenset[str]] | None:
    """Return the number of goals and the parts of the report in a folder; None without one."""
    try:
        values = json.loads(read_text(folder / "report.json"))
        if values["goal_set_version"] != GOAL_SET_VERSION:
            return None
        found = {**values, "rendered": (values.get("mujoco") or {}).get("rendered")}
        parts = frozenset(part for part in PARTS if found.get(part) is not None)
        return int(values["policy"]["episodes"]), parts
    except (
        *(OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError),
        ArithmeticError,
    ):
        # Whatever cannot be read is not worth keeping.
        return None
