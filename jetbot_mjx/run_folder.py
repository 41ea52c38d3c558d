"""A run is one folder, and everything after training needs only that folder.

config.yaml (resolved), versions.json, metrics.jsonl, tensorboard/, checkpoints/<env_steps>/,
evaluations/<env_steps>/, videos/.
"""

import datetime
import importlib.metadata
import json
import platform
import subprocess
from pathlib import Path
from typing import Any

import jax

from jetbot_mjx.config import Config
from jetbot_mjx.errors import UserError

_PACKAGES = (
    "jetbot_mjx",
    "jax",
    "jaxlib",
    "mujoco",
    "mujoco-mjx",
    "brax",
    "flax",
    "optax",
    "orbax-checkpoint",
    "numpy",
)


def default_run_dir(config_path: Path, root: Path = Path("runs")) -> Path:
    """`runs/<config>-<date>-<time>`, in local time."""
    now = datetime.datetime.now().astimezone()
    return root / f"{config_path.stem}-{now:%Y%m%d-%H%M%S}"


def check_free(run_dir: Path) -> None:
    """Refuses a run folder that something already lies in.

    Raises:
      UserError: it exists and is not an empty folder.
    """
    try:
        in_use = run_dir.exists() and (not run_dir.is_dir() or any(run_dir.iterdir()))
    except OSError as error:
        raise UserError(f"--run-dir {run_dir} cannot be used: {error.strerror}") from None
    if in_use:
        raise UserError(f"--run-dir {run_dir} is already in use: name a new folder")


def create_run_folder(run_dir: Path, config: Config) -> None:
    """Makes the folder and writes what is known before training.

    Args:
      run_dir: a folder that does not exist yet, or is empty.
      config: the resolved configuration.

    Raises:
      UserError: the folder is in use or cannot be written.
    """
    check_free(run_dir)
    try:
        run_dir.mkdir(parents=True, exist_ok=True)
        (run_dir / "config.yaml").write_text(config.to_yaml(), encoding="utf-8")
        write_json(run_dir / "versions.json", versions())
    except OSError as error:
        raise UserError(f"--run-dir {run_dir} cannot be written: {error.strerror}") from None


def make_folder(path: Path) -> None:
    """Makes a folder for results inside a run folder, unless it is there.

    Raises:
      UserError: it cannot be made.
    """
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"{path} cannot be written: {error.strerror}") from None


def versions() -> dict[str, Any]:
    """Packages, Python, machine, devices and state of the source, as JSON."""
    devices = jax.devices()
    return {
        "python": platform.python_version(),
        "platform": f"{platform.system()} {platform.machine()}",
        "packages": {name: _version(name) for name in _PACKAGES},
        "device": devices[0].device_kind,
        "device_platform": devices[0].platform,
        "device_count": len(devices),
        "git": _git_state(),
    }


def write_json(path: Path, values: Any) -> None:
    """Writes JSON for people: indented, with a final newline."""
    path.write_text(json.dumps(values, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def _git_state() -> dict[str, Any] | None:
    """Commit of the package's source and whether it was changed; None outside a checkout."""
    folder = Path(__file__).parent

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(folder), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    try:
        if git("ls-files", Path(__file__).name) == "":
            return None
        return {"commit": git("rev-parse", "HEAD"), "changed": git("status", "--short") != ""}
    except (OSError, subprocess.CalledProcessError):
        return None
