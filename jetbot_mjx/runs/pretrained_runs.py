"""Copy the trained runs that come with the package."""

import shutil
from pathlib import Path

from jetbot_mjx.errors import UserError
from jetbot_mjx.runs.checkpoint import PRETRAINED
from jetbot_mjx.runs.run_dir import atomic_folder


def copy_pretrained(folder: Path) -> tuple[Path, ...]:
    """Copy the runs that come with the package, without overwriting anything.

    Args:
      folder: The folder in which each run gets a folder of its own.

    Returns:
      The run folders, named after their configurations. Each is complete or absent.

    Raises:
      UserError: one of them exists already, or cannot be written.
    """
    runs = {path: folder / path.name for path in sorted(PRETRAINED.iterdir())}
    for target in runs.values():
        if target.exists():
            raise UserError(f"{target} is there already: give --out another folder")
    for source, target in runs.items():
        with atomic_folder(target) as unfinished:
            shutil.copytree(source, unfinished, dirs_exist_ok=True)
    return tuple(runs.values())
