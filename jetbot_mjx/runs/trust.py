"""Decide whether the code that a run names may run: every command asks here before it imports any.

A run folder can come from anyone, and its configuration may name code: the task or environment
whose source it stores, any callable of an installed package, and the drive of a robot. Such code
runs only if a training of this user on this machine has run it, or if the user asks for it by
`trusting`.

A training records what it runs as a hash, the name of an empty file in the user's state folder. The
hash covers the name and the options of the class, the content of its stored files, and the files of
a robot with a drive of its own. Code that a run does not store is named by the folder that it is
imported from instead.

Code of the package itself and of its examples needs no record. The content of a run is data: no
reader of it unpickles, and no link in a run may lead a writer out of the folder.
"""

import contextlib
import contextvars
import hashlib
import importlib.util
import json
import os
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from jetbot_mjx.config import (
    FOLDER,
    Config,
    MjcfRobotConfig,
    TaskConfig,
    import_root,
    is_task_here,
    shipped_folder,
    source_file,
)
from jetbot_mjx.errors import UserError, shown
from jetbot_mjx.runs import task_code
from jetbot_mjx.runs.run_dir import CONFIG, shortened, write_bytes
from jetbot_mjx.runs.task_code import TaskCode, read_task_code, stored_class

_HOW = "add --trust (in Python: trust=True)"

_WRITTEN = (
    *(".lock", "config.yaml", "versions.json", "metrics.jsonl", "train.log", "wandb.json"),
    *("checkpoints", "set_aside", "task", "robot", "nan_dumps", "tensorboard", "wandb"),
    *("evaluations", "videos", "policy", "page.html"),
)
"""Names of all that commands write in a run folder."""

_ONLY_READ_INSIDE = ("checkpoints", "set_aside")

_PACKAGE = Path(__file__).parents[1]

_trusts = contextvars.ContextVar("trusts", default=False)


@contextlib.contextmanager
def trusting(asked: bool) -> Iterator[None]:
    """Run the code of every run inside the context, if asked to, whoever wrote it.

    Args:
      asked: whether the user has asked for it, by `--trust`.
    """
    token = _trusts.set(asked or _trusts.get())
    try:
        yield
    finally:
        _trusts.reset(token)


def trusted_class(run_dir: Path, config: Config) -> type | None:
    """Import the class of a run's task or environment, if its code may run.

    Args:
      run_dir: the run folder.
      config: its configuration.

    Returns:
      The class, as for `stored_class`.

    Raises:
      UserError: as for `require_trust`; or the stored source is damaged, or cannot be imported.
    """
    code = require_trust(run_dir, config)
    return None if code is None else stored_class(run_dir, config.code, code)


def require_trust(run_dir: Path, config: Config) -> TaskCode | None:
    """Raise an error if the code that a run names may not run.

    Args:
      run_dir: the run folder.
      config: its configuration.

    Returns:
      The source of its task or environment; None if it stored none.

    Raises:
      UserError: no training of this user has run the code, or a link leaves the folder; or the
        stored source is damaged.
    """
    check_links(run_dir)
    own_class, own_drive = _names_code(config)
    code = _stored(run_dir, config) if own_class else None
    if _trusts.get() or (own_class and not own_drive and _is_example(config, code)):
        return code
    found = []
    if own_class and (code or _can_be_found(config)):
        found.append(_describe_class(run_dir, config, code))
    if own_drive:
        found.append(_describe_drive(run_dir, config))
    if found and not _is_recorded(_digest(config, code)):
        what, where = (" and ".join(parts) for parts in zip(*found, strict=True))
        raise UserError(
            f"{what} would run, which no training of yours on this machine has run: read {where},"
            f" then {_HOW}"
        )
    return code


def record_code(run_dir: Path, config: Config, code: TaskCode | None) -> None:
    """Record that a training of this user runs the code that a configuration names.

    Where that cannot be recorded, a line on stderr says so.

    Args:
      run_dir: the run folder.
      config: the configuration of the training.
      code: the source that the run stores; None: it stores none, or has stored it before.
    """
    if not any(_names_code(config)):
        return
    folder = _state_folder()
    try:
        if folder is None:
            raise OSError(None, "there is no home folder")
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if not _is_mine(folder):
            raise OSError(None, f"others may write to {folder}")
        path = folder / _digest(config, code or _stored(run_dir, config))
        if not path.exists():
            write_bytes(path, b"")
    except OSError as error:
        print(
            f"not recorded that this code is yours: {error.strerror}: for other commands on this"
            f" run, {_HOW}",
            file=sys.stderr,
            flush=True,
        )


def check_links(run_dir: Path) -> None:
    """Raise an error if a symbolic link leads out of a run folder where commands write.

    They would follow it. What is inside of a checkpoint is not looked at, because it is only read.

    Args:
      run_dir: the run folder, which need not exist.

    Raises:
      UserError: there is such a link, and the user has not asked to trust the folder.
    """
    if _trusts.get() or run_dir.is_relative_to(_PACKAGE):
        return
    # A comparison of seeds is written to the folder that holds them.
    top = run_dir.parent if run_dir.name.startswith("seed-") else run_dir
    folders = dict.fromkeys((top, run_dir, *run_dir.glob("seed-*")))
    inside = top.resolve()
    for path in (one for folder in folders for one in _written(folder)):
        if path.is_symlink() and not _target(path).is_relative_to(inside):
            raise UserError(
                f"{shortened(path)} is a link that leads out of the run folder, to {_target(path)}:"
                f" put the files themselves there, or {_HOW}"
            )


def _written(folder: Path) -> Iterator[Path]:
    """Yield a run folder and all in it that commands write to or through."""
    yield folder
    for path in (folder / name for name in _WRITTEN):
        yield path
        for parent, folders, files in os.walk(path):
            yield from (Path(parent, name) for name in (*folders, *files))
            if path.name in _ONLY_READ_INSIDE:
                break


def _target(link: Path) -> Path:
    try:
        return link.resolve()
    except (OSError, RuntimeError):  # A loop leads nowhere.
        return link.parent.resolve()


def _names_code(config: Config) -> tuple[bool, bool]:
    """Return whether a configuration names a class, and a drive, that are not this package's."""
    robot = config.robot
    own_class = config.environment is not None or config.task.name != TaskConfig().name
    return own_class, isinstance(robot, MjcfRobotConfig) and robot.has_own_drive


def _stored(run_dir: Path, config: Config) -> TaskCode | None:
    """Return the source that a run stores of the module that its configuration names."""
    code = read_task_code(run_dir)
    return code if code and code.module == config.code.partition(":")[0] else None


def _digest(config: Config, code: TaskCode | None) -> str:
    """Return a hash of all that decides what code of a run does when it is imported and called."""
    robot: Any = config.robot
    own_class, own_drive = _names_code(config)
    parts = {
        "class": config.code,
        "options": [config.environment_options, config.task.options],
        "files": code and [(path, hashlib.sha256(x).hexdigest()) for path, x in code.files],
        "imported_from": str(_root(config)) if own_class and code is None else None,
        "drive": [robot.drive, robot.sha256] if own_drive else None,
    }
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def _root(config: Config) -> Path | None:
    """Return the folder that the module of task or environment would be imported from, if any."""
    module = config.code.partition(":")[0]
    return Path.cwd().resolve() if is_task_here(module) else import_root(module)


def _can_be_found(config: Config) -> bool:
    """Return whether Python finds the module of task or environment; if not, nothing can run."""
    try:
        top = config.code.partition(":")[0].partition(".")[0]
        return _root(config) is not None or importlib.util.find_spec(top) is not None
    except (ImportError, ValueError):
        return True


def _is_example(config: Config, code: TaskCode | None) -> bool:
    """Return whether the code is a class of an example that comes with the package."""
    module, _, name = config.code.partition(":")
    files = dict(code.files) if code else {}
    text = files.get(f"{module}.py", b"").decode(errors="replace")
    # What an example itself imports could be named too.
    if not name.isidentifier() or not re.search(rf"^class {name}\b", text, re.MULTILINE):
        return False
    folder = shipped_folder("examples")
    return all(task_code.holds(folder / path, content) for path, content in files.items())


def _describe_class(run_dir: Path, config: Config, code: TaskCode | None) -> tuple[str, str]:
    """Return what class would run, and where to read its code."""
    key = "task.name" if config.environment is None else "environment"
    what = f"{key} = {shown(config.code)}"
    if config.environment_options:
        what += f" with {shown(config.environment_options)}"
    if code:
        return what, str(shortened(run_dir / task_code.FOLDER))
    root = _root(config)
    file = source_file(root, config.code.partition(":")[0]) if root else None
    return what, str(shortened(file)) if file else str(shortened(run_dir / CONFIG))


def _describe_drive(run_dir: Path, config: Config) -> tuple[str, str]:
    """Return what drive would run, and where to read its code."""
    assert isinstance(config.robot, MjcfRobotConfig)
    drive = config.robot.drive
    file = run_dir / FOLDER / drive.partition(":")[0]
    return f"robot.drive = {shown(drive)}", str(shortened(file))


def _state_folder() -> Path | None:
    """Return the folder of the records; None: this user has no home."""
    base = Path(os.environ.get("XDG_STATE_HOME", ""))
    try:
        base = base if base.is_absolute() else Path.home() / ".local" / "state"
    except RuntimeError:
        return None
    return base / "jetbot_mjx" / "own_code" if base.is_absolute() else None


def _is_recorded(digest: str) -> bool:
    folder = _state_folder()
    try:
        return folder is not None and _is_mine(folder) and (folder / digest).is_file()
    except OSError:
        return False


def _is_mine(folder: Path) -> bool:
    """Return whether nobody but this user and root can write to a folder."""
    status = folder.stat()
    # Windows has no owners and modes that could be checked.
    if not hasattr(os, "geteuid"):
        return True
    return status.st_uid in (os.geteuid(), 0) and not status.st_mode & 0o022
