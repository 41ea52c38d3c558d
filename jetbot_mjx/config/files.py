"""Find configuration files: those that come with the package, and those in run folders."""

import difflib
import os
from collections.abc import Sequence
from pathlib import Path

from jetbot_mjx.config.errors import ConfigNotFoundError


def shipped_folder(name: str) -> Path:
    """Return a folder of the repository that a wheel holds inside the package.

    Args:
      name: `configs`, `docs`, `examples`, or a folder in them.
    """
    package = Path(__file__).parents[1]
    return next(
        (folder / name for folder in (package, package.parent) if (folder / name).is_dir()),
        package / name,
    )


_CONFIGS = ("configs", "examples")


def run_around(path: Path) -> Path | None:
    """Return the run folder that a path is, or is inside of at `checkpoints/`; None if neither."""
    inside = [path, path.parent, path.parent.parent, path.parent.parent.parent]
    for place, folder in enumerate(inside):
        if os.path.isfile(folder / "config.yaml"):
            return folder if place == 0 or inside[place - 1].name == "checkpoints" else None
    return None


def shipped_configs(folders: Sequence[str] = _CONFIGS) -> dict[str, Path]:
    """Return the configurations that come with the package, by name; the examples come last.

    Args:
      folders: the folders that hold them, or others in the repository with YAML files.
    """
    files = [file for one in folders for file in sorted(shipped_folder(one).glob("*.yaml"))]
    return {file.stem: file for file in files}


def find_config(name: str | Path, folders: Sequence[str] = _CONFIGS, what: str = "config") -> Path:
    """Return the path of a configuration file.

    Args:
      name: the path of a file, or the name of a configuration that comes with the package, such
        as `jetbot_egocentric`.
      folders: where that comes from, as for `shipped_configs`.
      what: the argument that names the file, for error messages.

    Returns:
      The path, which need not exist if it names a folder.

    Raises:
      ConfigNotFoundError: a plain name is neither a file nor one that comes with the package.
    """
    path = Path(name)
    # A reader of the documentation may name `configs/gpu.yaml` in another folder.
    if os.path.lexists(path) or path.parent.as_posix() not in (".", *folders):
        return path
    shipped = shipped_configs(folders)
    if (found := shipped.get(path.name.removesuffix(".yaml"))) is not None:
        return found
    if (meant := path.with_name(f"{path.name}.yaml")).is_file():
        raise ConfigNotFoundError(f"{what} {name} does not exist: did you mean {meant}?")
    close = difflib.get_close_matches(path.stem, shipped, n=1)
    hint = f"did you mean {close[0]}?" if close else f"give a file, or one of {', '.join(shipped)}"
    raise ConfigNotFoundError(f"{what} {name} does not exist: {hint}")
