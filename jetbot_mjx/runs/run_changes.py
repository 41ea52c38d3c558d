"""List runs, say what changed from one to another, open the report of one, and delete one."""

import json
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Literal, NamedTuple

from jetbot_mjx.errors import NotFoundError, UserError, os_errors, printable
from jetbot_mjx.runs.run_dir import CONFIG, occupied, read_config, seed_folders
from jetbot_mjx.runs.run_finder import (
    PRETRAINED,
    ROOT,
    RunInfo,
    Unusable,
    format_score,
    read_info,
    runs_table,
    scan_runs,
)
from jetbot_mjx.terminal import text_table

_ORDERS: dict[str, Callable[[RunInfo], str | float]] = {
    "age": lambda run: -run.changed,
    "name": lambda run: run.name,
    "steps": lambda run: -run.env_steps,
    "success": lambda run: -(run.success_rate or 0.0),
}


def list_runs(
    folder: Path | None = None,
    *,
    text: str = "",
    sort: Literal["age", "name", "steps", "success"] = "age",
    as_json: bool = False,
) -> str:
    """Return a list of runs.

    Args:
      folder: the folder of the runs; None: `ROOT`, and those that come with the package as well.
      text: list only runs whose name or task contains it, in capitals or not.
      sort: the order: the latest, the longest or the most successful first, or by name.
      as_json: whether to return JSON, with the runs of `folder` alone.
    """

    def chosen(folder: Path) -> tuple[list[RunInfo], list[Unusable]]:
        found, damaged = scan_runs(folder)
        found = [run for run in found if text.lower() in f"{run.name} {run.task}".lower()]
        return sorted(found, key=_ORDERS[sort]), [] if text else damaged

    found, damaged = chosen(folder or ROOT)
    if as_json:
        return json.dumps([run.to_json() for run in found], indent=2)
    shipped = ([], []) if folder else chosen(PRETRAINED)
    if text and not (found or shipped[0]):
        return f"no run has {printable(text)!r} in its name or task"
    tables = []
    if found or not text:
        tables.append(runs_table(found, damaged))
    if shipped[0]:
        tables.append(
            f"with the package, for every command that takes a run:\n{runs_table(*shipped)}"
        )
    return "\n\n".join(tables)


class RunChanges(NamedTuple):
    """A `RunChanges` holds what two runs differ in."""

    before: str
    """Name of the one run; `after` is that of the other."""
    after: str
    results: Mapping[str, tuple[str, str]]
    """Steps and best evaluation of both, as text."""
    settings: Mapping[str, tuple[str, str]]
    """The settings that differ, by their full key, as text."""


def compare_two(before: Path, after: Path) -> RunChanges:
    """Return the results of two runs, and the settings in which they differ.

    Args:
      before: the folder of one run.
      after: the folder of the other.

    Raises:
      DamagedRunError: the configuration or the metrics of one cannot be read.
    """
    one, other = read_info(before), read_info(after)
    results = {
        "steps": (f"{one.env_steps:,}", f"{other.env_steps:,}"),
        "best evaluation": (format_score(one), format_score(other)),
    }
    old, new = (read_config(run.path).flat() for run in (one, other))
    keys = [key for key in {**old, **new} if old.get(key) != new.get(key)]
    settings = {key: (str(old.get(key, "-")), str(new.get(key, "-"))) for key in keys}
    return RunChanges(one.name, other.name, results, settings)


def changes_table(changes: RunChanges) -> str:
    """Return what two runs differ in as text, a line each."""
    rows = [("", changes.before, changes.after)]
    rows += [(key, *both) for key, both in {**changes.results, **changes.settings}.items()]
    table = text_table(rows)
    return table if changes.settings else f"{table}\nall settings are equal"


def changes_since_the_run_before(run_dir: Path) -> RunChanges | None:
    """Return what a run of the user changed from the one before it in the same folder, if any."""
    if not (run_dir / CONFIG).is_file() or run_dir.parent == PRETRAINED:
        return None
    changed = read_info(run_dir).changed
    earlier = [run for run in scan_runs(run_dir.parent)[0] if run.changed < changed]
    return compare_two(earlier[0].path, run_dir) if earlier else None


def newest_report(run: Path) -> Path:
    """Return the page of the newest report of a run, which of several seeds is a comparison.

    Raises:
      NotFoundError: there is none.
    """
    name = "comparison" if seed_folders(run) else "report"
    pages = run.glob(f"evaluations/*/{name}.html")
    newest = max(pages, key=lambda page: page.stat().st_mtime, default=None)
    if newest is None:
        raise NotFoundError(f"{run} has no report: write one with `jetbot-mjx evaluate {run}`")
    return newest


def find_deletable(path: Path) -> RunInfo:
    """Return the run of the user in a folder.

    Raises:
      UserError: there is no run in it, or one that comes with the package; or it is a link.
    """
    if path.resolve().parent == PRETRAINED.resolve():
        raise UserError(f"--delete {path.name}: it comes with the package and stays")
    if not (path / CONFIG).is_file():
        raise NotFoundError(f"--delete {path}: there is no run in this folder")
    if path.is_symlink():
        raise UserError(f"--delete {path}: it is a link: name the folder, {path.resolve()}")
    return read_info(path)


def delete_run(run: RunInfo) -> None:
    """Delete the folder of a run.

    Raises:
      UserError: a training writes it, or it cannot be deleted.
    """
    with occupied(run.path), os_errors(f"{run.path} cannot be deleted"):
        shutil.rmtree(run.path)
