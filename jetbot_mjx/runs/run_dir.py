"""Create, lock and read run folders, which hold everything that is needed after training.

A run folder holds config.yaml (resolved), versions.json, task/ (the source of a task that is not of
this package), metrics.jsonl, tensorboard/, checkpoints/<env_steps>/, evaluations/<env_steps>/,
videos/, policy/ and nan_dumps/. If several seeds are trained at once, it holds one folder seed-<n>/
for each of them, with all of that inside.
"""

import contextlib
import datetime
import errno
import itertools
import json
import os
import platform
import shutil
import stat
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import IO, Any

from jetbot_mjx.config import (
    FOLDER,
    Config,
    ConfigError,
    MjcfRobotConfig,
    model_files,
    parse_config,
    parse_yaml,
    register,
)
from jetbot_mjx.envs import LIBRARIES, installed_version
from jetbot_mjx.errors import UserError, check_answer, clipped, os_errors, shown
from jetbot_mjx.runs.durable import exchange, make_folders, move, sync_tree

try:
    import fcntl
except ModuleNotFoundError:  # on Windows
    fcntl = None

JsonObject = dict[str, Any]
"""A JSON object, whose values are checked where they are read."""

CONFIG = "config.yaml"
"""Name of the file in a run folder that holds the resolved configuration."""

_VERSIONS = "versions.json"

_LOCK = ".lock"
"""Name of the file that a training locks, with the number of its process."""

_LOCK_TRIES, _LOCK_PAUSE = 4, 0.025
"""How often a locked file is tried again, and after which time [s]: `is_occupied` holds it for an
instant."""

_MOST_BYTES = 100_000_000
"""Largest size of a file that is read from a run, but for a checkpoint's arrays."""

_LAST_SECTION = list(Config.model_fields)[-1]


class DamagedRunError(UserError):
    """Raised when a file of a run folder is damaged, and commands cannot tell what the run is."""

    def __init__(self, run_dir: Path, reason: str) -> None:
        """Compose the message.

        Args:
          run_dir: the run folder.
          reason: what is wrong with which of its files.
        """
        super().__init__(
            f"the run {run_dir} is damaged: {reason}: restore the file, or train into a new folder"
        )
        self.run_dir, self.reason = run_dir, reason


def default_run_dir(config_path: Path, root: Path = Path("runs")) -> Path:
    """Return `runs/<config>-<date>-<time>`, in local time, which may exist."""
    now = datetime.datetime.now().astimezone()
    return root / f"{config_path.stem}-{now:%Y%m%d-%H%M%S}"


@contextlib.contextmanager
def claim_run_dir(
    given: str | Path | None,
    config_path: Path,
    root: Path = Path("runs"),
    *,
    creates: bool = True,
) -> Iterator[Path]:
    """Yield the run folder that is given, or create the default one.

    A number is appended to the default one's name if another training, here or elsewhere, has taken
    it in this second. If nothing is written into it, it is removed again.

    Args:
      given: the folder; None: the default one.
      config_path: the configuration whose name the default one has.
      root: the folder of runs.
      creates: whether to create it, as the first of several processes does.

    Raises:
      UserError: the folder cannot be created.
    """
    if given is not None:
        yield Path(given)
        return
    first = default_run_dir(config_path, root)
    if not creates:
        yield first
        return
    for count in itertools.count(1):
        run_dir = first.with_name(f"{first.name}-{count}") if count > 1 else first
        with writing_to(run_dir):
            make_folders(root)
            with contextlib.suppress(FileExistsError):
                run_dir.mkdir()
                break
    try:
        yield run_dir
    finally:
        for folder in (run_dir, root):
            with contextlib.suppress(OSError):
                folder.rmdir()


def seed_dirs(run_dir: Path, config: Config) -> list[Path]:
    """Return the run folder of each seed, which is `run_dir` itself if there is only one seed."""
    if config.seeds == 1:
        return [run_dir]
    return [run_dir / f"seed-{one.seed}" for one in config.of_each_seed()]


def seed_folders(run_dir: Path) -> list[Path]:
    """Return the folders of the seeds that were trained at once; an empty list for a single seed.

    Raises:
      UserError: the folder cannot be read.
    """
    with os_errors(f"{run_dir} cannot be read"):
        found = [path for path in run_dir.glob("seed-*") if (path / CONFIG).is_file()]
    return sorted(found, key=lambda path: (len(path.name), path.name))


def read_config(run_dir: Path) -> Config:
    """Return the configuration that a run folder holds.

    Args:
      run_dir: the run folder.

    Raises:
      DamagedRunError: the file is missing, cannot be read or is not one that a training wrote
        completely.
      UnreadableError: the drive does not answer.
    """
    try:
        text = read_text(run_dir / CONFIG)
        if not text.strip():
            raise ConfigError(f"{CONFIG} is empty")
        # A training writes all settings. If the end is missing, its settings would become defaults.
        if not text.endswith("\n"):
            raise ConfigError(f"{CONFIG} was cut off: its last line is not complete")
        values = parse_yaml(text, CONFIG)
        if _LAST_SECTION not in values:
            raise ConfigError(f"{CONFIG} was cut off: it has no section {_LAST_SECTION}")
        return parse_stored(values, run_dir, CONFIG)
    # One of them is a `FileNotFoundError` too.
    except ConfigError as error:
        raise DamagedRunError(run_dir, str(error)) from None
    except FileNotFoundError:
        raise DamagedRunError(run_dir, f"{CONFIG} is missing") from None
    except UnicodeDecodeError:
        raise DamagedRunError(run_dir, f"{CONFIG} is not UTF-8 text") from None
    except OSError as error:
        raise DamagedRunError(run_dir, f"{CONFIG} cannot be read: {error.strerror}") from None


def parse_stored(values: Mapping[str, object], run_dir: Path, source: str) -> Config:
    """Check the settings that a run stored, and read the model of its robot, if that is a file.

    Args:
      values: the settings.
      run_dir: the run folder.
      source: description of their origin for error messages.

    Raises:
      ConfigError: the settings are damaged, or name a robot outside of the run.
      DamagedRunError: the model's files are not those that the training stored.
    """
    robot = values.get("robot")
    name = robot.get("file") if isinstance(robot, Mapping) else None
    if isinstance(name, str) and name != Path(name).name:
        raise ConfigError(f"{source}: robot.file = {shown(name)}: a run stores no path, but a name")
    config = parse_config(values, source)
    if isinstance(config.robot, MjcfRobotConfig):
        _read_model(run_dir, config.robot)
    return config


def stored_config(run_dir: Path) -> Config | None:
    """Return the configuration of the run in a folder.

    Args:
      run_dir: a run folder, or a folder that will become one.

    Returns:
      The resolved configuration; None if the folder does not exist yet or is empty.

    Raises:
      DamagedRunError: as for `read_config`.
      UserError: the path holds something else, or cannot be read.
    """
    with os_errors(f"--run-dir {run_dir} cannot be used"):
        if not run_dir.exists():
            return None
        if run_dir.is_dir():
            names = os.listdir(run_dir)
            if CONFIG in names:
                return read_config(run_dir)
            if all(name.startswith(".") for name in names):
                return None
    raise UserError(f"--run-dir {run_dir} exists and holds no run (no {CONFIG}): name a new folder")


def is_occupied(run_dir: Path) -> bool:
    """Return whether a living process trains in a run folder, as far as this system can tell.

    Nothing is written. Of a folder that cannot be read, or where there are no locks, nothing is
    known: False.
    """
    if fcntl is None:
        return False
    try:
        with open(run_dir / _LOCK, "rb", opener=open_at_once) as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except OSError:
        return False
    return False


def _lock(file: IO[str]) -> None:
    """Lock a file for this process alone, and wait a moment for one who only asks about it.

    Raises:
      BlockingIOError: another process holds it.
      OSError: the file system has no locks.
    """
    assert fcntl is not None
    for tries_left in reversed(range(_LOCK_TRIES)):
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError:
            if not tries_left:
                raise
            time.sleep(_LOCK_PAUSE)


@contextlib.contextmanager
def occupied(run_dir: Path) -> Iterator[None]:
    """Create a run folder if needed, and lock it against every other training.

    The lock belongs to the process, so it is released however the process ends. Where the system
    has no such locks, a line on stderr says so.

    Raises:
      UserError: the folder cannot be written, or another training has locked it.
    """
    path = run_dir / _LOCK
    try:
        make_folders(run_dir)
        file = path.open("a+")
    except OSError as error:
        reason = error.strerror or f"{path.name} is not a regular file"
        raise UserError(f"--run-dir {run_dir} cannot be written: {reason}") from None
    try:
        try:
            if fcntl is None:
                line = "this system has no locks: start no second training in this run folder"
                print(line, file=sys.stderr, flush=True)
            else:
                _lock(file)
        except BlockingIOError:
            file.seek(0)
            raise UserError(
                f"--run-dir {run_dir} is locked by another training (process"
                f" {file.read(20).strip() or 'unknown'}): wait for it, or name another folder"
            ) from None
        except OSError:
            # The file system has no locks: train without one.
            pass
        with writing_to(path):
            file.truncate(0)
            print(os.getpid(), file=file, flush=True)
        yield
    finally:
        # All of it is written, and a drive that does not answer may refuse this too.
        with contextlib.suppress(OSError):
            file.close()


def write_run(run_dir: Path, config: Config, made_with: JsonObject) -> None:
    """Write the configuration and the versions, which are known before training.

    Args:
      run_dir: the run folder, which must exist.
      config: the resolved configuration.
      made_with: the versions, from `versions`.

    Raises:
      UserError: the folder cannot be written.
    """
    with writing_to(run_dir):
        # A folder counts as a run by its configuration: first what that needs.
        write_model(run_dir, config)
        write_text(run_dir / CONFIG, config.to_yaml())
        write_json(run_dir / _VERSIONS, made_with)


def write_model(folder: Path, config: Config) -> None:
    """Write the files of the robot's model, if it is one, to where a configuration finds them.

    Args:
      folder: the folder of the configuration.
      config: the configuration.
    """
    if not isinstance(config.robot, MjcfRobotConfig):
        return
    for name, content in (model_files(config.robot.sha256) or {}).items():
        file = folder / FOLDER / name
        make_folders(file.parent)
        write_bytes(file, content)


def _read_model(run_dir: Path, robot: MjcfRobotConfig) -> None:
    """Read the files of a robot's model, unless this process has them.

    Raises:
      DamagedRunError: they are not those that the training stored.
    """
    path = run_dir / FOLDER / robot.file
    code = robot.drive.partition(":")[0] if robot.has_own_drive else None
    if model_files(robot.sha256) is None and register(path, code) != robot.sha256:
        raise DamagedRunError(
            run_dir, f"{FOLDER}/ does not hold the files of the robot's model that it began with"
        )


def changed_versions(run_dir: Path) -> list[str]:
    """Return the versions that changed since the last training, as `jax 0.10.2, now 0.11.2`."""
    try:
        then = json.loads(read_text(run_dir / _VERSIONS))
        packages = dict(then["packages"])
    except (OSError, ValueError, LookupError, TypeError, RecursionError):
        return []
    now = versions()
    found = [
        f"{name} {clipped(str(packages.get(name)), 40)}, now {version}"
        for name, version in now["packages"].items()
        if packages.get(name) != version
    ]
    for key in ("device", "device_count"):
        if then.get(key) != now[key]:
            found.append(f"{key} {clipped(str(then.get(key)), 80)}, now {now[key]}")
    return found


def writing_to(path: Path) -> contextlib.AbstractContextManager[None]:
    """Convert an `OSError` inside the context to a one-line `UserError`."""
    return os_errors(f"{path} cannot be written")


def check_writable(path: Path) -> None:
    """Raise an error, before long work, if a folder for its results could not be created.

    A folder is created for a moment, because only a try tells what a drive permits.

    Raises:
      UserError: the path or a part of it is not a folder, or may not be written.
    """
    with writing_to(path):
        existing = next(one for one in (path.absolute(), *path.absolute().parents) if one.exists())
        if not existing.is_dir():
            raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR))
        with tempfile.TemporaryDirectory(dir=existing, prefix="."):
            pass


@contextlib.contextmanager
def atomic_folder(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder, and put it in the place of `folder` when the disk holds it.

    Raises:
      UserError: the folder cannot be written.
    """
    unfinished = folder.with_name(f".{folder.name}.unfinished")
    earlier = folder.with_name(f".{folder.name}.earlier")
    with writing_to(folder):
        remove(unfinished)
        remove(earlier)
        make_folders(folder.parent)
        unfinished.mkdir()
        try:
            yield unfinished
            sync_tree(unfinished)
            if not folder.exists():
                move(unfinished, folder)
            elif not exchange(unfinished, folder):
                folder.rename(earlier)
                move(unfinished, folder)
        finally:
            remove(unfinished)
            remove(earlier)


def remove(path: Path) -> None:
    """Remove a file or folder that an earlier process left, if it exists and can be removed."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
        return
    # `rmtree` would wait for the writer of a named pipe.
    with contextlib.suppress(OSError):
        path.unlink()


def make_folder(path: Path) -> None:
    """Create a folder for results inside a run folder if it does not exist.

    Raises:
      UserError: the folder cannot be created.
    """
    with writing_to(path):
        make_folders(path)


def shortened(path: Path) -> Path:
    """Return the path relative to the current folder if it is inside of it."""
    here = Path.cwd()
    return path.relative_to(here) if path.is_relative_to(here) else path


def versions() -> JsonObject:
    """Return the versions of packages and Python, the machine, the devices and the git state."""
    # The commands that list and find runs start without it.
    import jax

    devices = jax.devices()
    packages = ("jetbot_mjx", *LIBRARIES)
    return {
        "python": platform.python_version(),
        "platform": f"{platform.system()} {platform.machine()}",
        "packages": {name: installed_version(name) for name in packages},
        "device": devices[0].device_kind,
        "device_platform": devices[0].platform,
        "device_count": len(devices),
        "git": _git_state(),
    }


def read_bytes(path: Path) -> bytes:
    """Read a file of a run, and never wait for one that only another process could fill.

    Raises:
      OSError: it cannot be read, is not a regular file, or is larger than any that a run has.
      UnreadableError: the drive does not answer.
    """
    try:
        with open(path, "rb", opener=open_at_once) as file:
            if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
                raise OSError(errno.EINVAL, "it is not a regular file")
            content = file.read(_MOST_BYTES + 1)
    except OSError as error:
        check_answer(error.errno, path)
        raise
    if len(content) > _MOST_BYTES:
        raise OSError(errno.EFBIG, f"it is larger than {_MOST_BYTES // 1_000_000} MB")
    return content


def read_text(path: Path) -> str:
    """Read a text file of a run, as `read_bytes` does.

    Raises:
      OSError: as for `read_bytes`.
      UnreadableError: as for `read_bytes`.
      UnicodeDecodeError: it is not UTF-8.
    """
    return read_bytes(path).decode()


def open_at_once(path: str, flags: int) -> int:
    """Open a file as `open` does, but a named pipe without waiting for its other end."""
    return os.open(path, flags | getattr(os, "O_NONBLOCK", 0), 0o666)


def write_json(path: Path, values: object) -> None:
    """Write readable JSON, indented and with a final newline."""
    write_text(path, json.dumps(values, indent=2, allow_nan=False) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically, as `write_bytes` does."""
    write_bytes(path, text.encode())


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file atomically: it is complete or unchanged whenever process or power end.

    After the call the disk holds it. Others may write the same file at the same time: the last one
    to complete it stays.
    """
    writer = f"{os.getpid()}-{threading.get_ident()}"
    unfinished = path.with_name(f".{path.name}.{writer}.unfinished")
    # A named pipe in its place would wait for a reader.
    unfinished.unlink(missing_ok=True)
    try:
        with unfinished.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        move(unfinished, path)
    finally:
        unfinished.unlink(missing_ok=True)


def _git_state() -> JsonObject | None:
    """Return the commit of the package's source and whether it was changed.

    Return None outside of a git checkout.
    """
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
