"""Choose where results are written, so that a quick look does not replace a fuller result."""

import itertools
import json
import os
import re
from collections.abc import Mapping
from pathlib import Path

from jetbot_mjx.evaluation.goal_set import GOAL_SET_VERSION, REPORT_GOALS
from jetbot_mjx.runs import Checkpoint, read_text

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


def comparison_folder(
    evaluations: Path, name: str, runs: Mapping[str, Mapping[str, Checkpoint]]
) -> Path:
    """Choose the folder of a new comparison, in which none of other runs lies.

    The folder is `<name>`, or the first of `<name>-2`, `<name>-3` and so on that is free or holds
    a comparison of the same runs, which the new one replaces.

    Args:
      evaluations: the folder of all reports of the first run.
      name: the name of the comparison.
      runs: the policy of each seed by name, of each run by name.

    Returns:
      The folder, which may not exist yet.
    """
    for number in itertools.count(1):
        folder = evaluations / (name if number == 1 else f"{name}-{number}")
        wanted = [
            [run, *(path_from(folder, one.run_dir) for one in seeds.values())]
            for run, seeds in runs.items()
        ]
        if _compared_runs(folder) in (None, wanted):
            break
    return folder


def path_from(folder: Path, path: Path) -> str:
    """Return the path that leads from a folder to another one, on every system with slashes."""
    return Path(os.path.relpath(path, folder)).as_posix()


def kept_line(folder: Path) -> str:
    """Return what follows the page of a comparison that was written beside one of other runs.

    Args:
      folder: the folder of the new comparison.
    """
    numbered = re.fullmatch(r"(comparison(?:-\d+-[a-z]+)?)-\d+", folder.name)
    if not numbered or (kept := _compared_runs(other := folder.with_name(numbered[1]))) is None:
        return ""
    return f" (the one of {', '.join(name for name, *_ in kept)} in {other} stays as it is)"


def _compared_runs(folder: Path) -> list[list[str]] | None:
    """Return the runs of the comparison in a folder; None without one."""
    try:
        values = json.loads(read_text(folder / "comparison.json"))
        return [[run["name"], *(seed["run"] for seed in run["seeds"])] for run in values["runs"]]
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        # Whatever cannot be read is not worth keeping.
        return None


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
