"""Say what changed from one run to another, and delete a run."""

import shutil
from pathlib import Path

from jetbot_mjx.config import Setting
from jetbot_mjx.errors import os_errors
from jetbot_mjx.runs.run_dir import occupied, read_config
from jetbot_mjx.runs.run_finder import RunInfo, format_score, read_info
from jetbot_mjx.terminal import text_table


def changed_settings(before: Path, after: Path) -> dict[str, tuple[Setting, Setting]]:
    """Return the settings in which two runs differ, by their full key; None where one has none.

    Args:
      before: the folder of one run.
      after: the folder of the other.

    Raises:
      DamagedRunError: the configuration of one cannot be read.
    """
    old, new = (read_config(folder).flat() for folder in (before, after))
    return {
        key: (old.get(key), new.get(key))
        for key in {**old, **new}
        if old.get(key) != new.get(key)
    }


def compare_two(before: Path, after: Path) -> str:
    """Return a table of the results of two runs, and of the settings in which they differ.

    Args:
      before: the folder of the run in the first column.
      after: the folder of the run in the second column.

    Raises:
      DamagedRunError: the configuration or the metrics of one cannot be read.
    """
    one, other = read_info(before), read_info(after)
    rows = [
        ("", one.name, other.name),
        ("steps", f"{one.env_steps:,}", f"{other.env_steps:,}"),
        ("best evaluation", format_score(one), format_score(other)),
    ]
    changed = changed_settings(before, after)
    rows += [(key, str(old), str(new)) for key, (old, new) in changed.items()]
    table = text_table(rows)
    return table if changed else f"{table}\nall settings are equal"


def delete_run(run: RunInfo) -> None:
    """Delete the folder of a run.

    Raises:
      UserError: a training writes it, or it cannot be deleted.
    """
    with occupied(run.path), os_errors(f"{run.path} cannot be deleted"):
        shutil.rmtree(run.path)
