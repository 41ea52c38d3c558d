"""A run is one folder, and everything after training needs only that folder.

config.yaml (resolved), versions.json, metrics.jsonl, tensorboard/, checkpoints/<env_steps>/,
evaluations/<env_steps>/, videos/, policy/, faults/; of several seeds trained at once, seed-<n>/
with all of that in each.
"""

import contextlib
import datetime
import fcntl
import importlib.metadata
import json
import os
import platform
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax

from jetbot_mjx.config import Config, load_config
from jetbot_mjx.errors import UserError

_PACKAGES = (
    "jetbot_mjx",
    "jax",
    "jaxlib",
    "llvmlite",
    "mujoco",
    "mujoco-mjx",
    "brax",
    "flax",
    "optax",
    "orbax-checkpoint",
    "numpy",
)


CONFIG = "config.yaml"
"""The resolved configuration, in a run folder."""

_VERSIONS = "versions.json"


def default_run_dir(config_path: Path, root: Path = Path("runs")) -> Path:
    """`runs/<config>-<date>-<time>`, in local time."""
    now = datetime.datetime.now().astimezone()
    return root / f"{config_path.stem}-{now:%Y%m%d-%H%M%S}"


def seed_dirs(run_dir: Path, config: Config) -> list[Path]:
    """Where the run of each seed lies: in the folder itself where there is one seed."""
    if config.seeds == 1:
        return [run_dir]
    return [run_dir / f"seed-{one.seed}" for one in config.of_each_seed()]


def seed_folders(run_dir: Path) -> list[Path]:
    """The folders of the seeds that were trained at once; none where it was one seed.

    Raises:
      UserError: the folder cannot be read.
    """
    try:
        found = [path for path in run_dir.glob("seed-*") if (path / CONFIG).is_file()]
    except OSError as error:
        raise UserError(f"{run_dir} cannot be read: {error.strerror}") from None
    return sorted(found, key=lambda path: (len(path.name), path.name))


def stored_config(run_dir: Path) -> Config | None:
    """The configuration of the run that lies in a folder.

    Args:
      run_dir: a run folder, or one that is to become one.

    Returns:
      Its resolved configuration; None where there is no folder yet, or nothing in it.

    Raises:
      UserError: something else lies there, or it cannot be read.
    """
    try:
        if run_dir.is_dir() and (run_dir / CONFIG).is_file():
            return load_config(run_dir / CONFIG)
        if run_dir.is_dir() and all(path.name.startswith(".") for path in run_dir.iterdir()):
            return None
        in_use = run_dir.exists()
    except OSError as error:
        raise UserError(f"--run-dir {run_dir} cannot be used: {error.strerror}") from None
    if in_use:
        raise UserError(
            f"--run-dir {run_dir} is in use, and holds no run (no {CONFIG}): name a new folder"
        )
    return None


@contextlib.contextmanager
def occupied(run_dir: Path) -> Iterator[None]:
    """Makes a run folder unless it is there, and keeps every other training out of it.

    The lock belongs to the process: however that ends, the folder is free again.

    Raises:
      UserError: the folder cannot be written, or another training holds it.
    """
    path = run_dir / ".lock"
    try:
        run_dir.mkdir(parents=True, exist_ok=True)
        file = path.open("a+")
    except OSError as error:
        raise UserError(f"--run-dir {run_dir} cannot be written: {error.strerror}") from None
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            raise UserError(
                f"--run-dir {run_dir} is held by another training (process"
                f" {file.read().strip() or 'unknown'}): wait for it, or name another folder"
            ) from None
        except OSError:
            # A file system without locks: nothing can be promised, and nothing is refused.
            pass
        file.truncate(0)
        print(os.getpid(), file=file, flush=True)
        yield


def write_run(run_dir: Path, config: Config) -> None:
    """Writes what is known before training: the configuration and the versions.

    Args:
      run_dir: the run folder, which exists.
      config: the resolved configuration.

    Raises:
      UserError: the folder cannot be written.
    """
    with writing_to(run_dir):
        write_text(run_dir / CONFIG, config.to_yaml())
        write_json(run_dir / _VERSIONS, versions())


def changed_versions(run_dir: Path) -> list[str]:
    """What is not as it was when the run was last trained, such as `jax 0.10.2, now 0.11.2`."""
    try:
        then = json.loads((run_dir / _VERSIONS).read_text(encoding="utf-8"))
        packages = dict(then["packages"])
    except (OSError, ValueError, LookupError, TypeError):
        return []
    now = versions()
    found = [
        f"{name} {packages.get(name)}, now {version}"
        for name, version in now["packages"].items()
        if packages.get(name) != version
    ]
    for key in ("device", "device_count"):
        if then.get(key) != now[key]:
            found.append(f"{key} {then.get(key)}, now {now[key]}")
    return found


@contextlib.contextmanager
def writing_to(path: Path) -> Iterator[None]:
    """Turns what the file system refuses into one line.

    Raises:
      UserError: in place of an `OSError`.
    """
    try:
        yield
    except OSError as error:
        raise UserError(f"{path} cannot be written: {error.strerror or error}") from None


def make_folder(path: Path) -> None:
    """Makes a folder for results inside a run folder, unless it is there.

    Raises:
      UserError: it cannot be made.
    """
    with writing_to(path):
        path.mkdir(parents=True, exist_ok=True)


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
    write_text(path, json.dumps(values, indent=2, allow_nan=False) + "\n")


def write_text(path: Path, text: str) -> None:
    """Writes a file of text that is whole or as it was, whenever the process ends."""
    write_bytes(path, text.encode())


def write_bytes(path: Path, content: bytes) -> None:
    """Writes a file that is whole or as it was, whenever the process ends."""
    unfinished = path.with_name(f".{path.name}.unfinished")
    unfinished.write_bytes(content)
    unfinished.replace(path)


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
