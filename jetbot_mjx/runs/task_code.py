"""Store the source of one's own task or environment in the run folder, and import it from there.

A policy is worth little without what it was trained in. When a training begins, the file of the
module of task or environment and those of the modules that it imports from the same folder are
copied to `task/` in the run folder, each with its SHA-256. Later commands import the stored files
if the module cannot be found, or if its files differ from the stored ones. Tasks of this package
and of installed packages are not stored, because their versions are.

The stored files are imported from memory, as they were checked: no other file in the run folder,
and no bytecode, is ever imported. Afterwards their modules leave `sys.modules`, so that runs with
different sources of one name can be used in one process. So the modules must import each other when
they are imported, not later in a function.
"""

import contextlib
import hashlib
import importlib
import importlib.abc
import importlib.util
import json
import os
import sys
import threading
from collections.abc import Iterable, Iterator
from importlib.machinery import ModuleSpec
from pathlib import Path, PurePosixPath
from types import ModuleType
from typing import NamedTuple

from jetbot_mjx.config import (
    find_task_here,
    import_root,
    is_task_here,
    read_sources,
    source_file,
)
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs.durable import make_folders
from jetbot_mjx.runs.run_dir import (
    read_bytes,
    read_text,
    shortened,
    write_bytes,
    write_json,
    writing_to,
)

FOLDER = "task"
"""Name of the folder in a run folder that holds the source of the task."""

HASHES = "sources.json"
"""Name of the file in that folder that holds the module's name and the SHA-256 of each file."""

MAX_BYTES = 1_000_000
"""Largest size of all source files together; larger ones are not stored."""

_PACKAGE = __name__.partition(".")[0]


class TaskCode(NamedTuple):
    """A `TaskCode` holds the source files of a task."""

    module: str
    """Name of the task's module."""
    files: tuple[tuple[str, bytes], ...]
    """Path and content of each file; paths are relative to the folder that imports begin in."""


def collect_task_code(name: str) -> TaskCode | None:
    """Read the source files that a task consists of.

    Args:
      name: the task as `package.module:Class`, which can be imported.

    Returns:
      The file of the module and those of the modules that it imports from the same folder, directly
      or not. None if there is nothing to store: the module has no source file, belongs to this or
      to an installed package, all files together are larger than `MAX_BYTES`, or one of them
      imports another inside a function.
    """
    module = name.partition(":")[0]
    find_task_here(module)
    sources = read_sources(module)
    # Store all of them, or nothing.
    if sources is None:
        return None
    files, late = sources
    if sum(map(len, files.values())) > MAX_BYTES:
        _say(
            f"the source of {name} is larger than {MAX_BYTES:,} bytes and is not stored in the run"
        )
        return None
    if late:
        _say(
            f"{late[0]}, so that the source of {name} is not stored in the run: move the import to"
            " the top of the file"
        )
        return None
    return TaskCode(module, tuple(sorted(files.items())))


def write_task_code(run_dir: Path, code: TaskCode) -> None:
    """Write the source of a task to `task/` in the run folder.

    Args:
      run_dir: the run folder, which must exist.
      code: the source.

    Raises:
      UserError: the folder cannot be written.
    """
    folder = run_dir / FOLDER
    with writing_to(folder):
        for path, content in code.files:
            make_folders((folder / path).parent)
            write_bytes(folder / path, content)
        hashes = {path: hashlib.sha256(content).hexdigest() for path, content in code.files}
        # Write this file last: without it, the others count as not stored.
        write_json(folder / HASHES, {"module": code.module, "sha256": hashes})


def read_task_code(run_dir: Path) -> TaskCode | None:
    """Read the source that `write_task_code` stored, and check it.

    Args:
      run_dir: the run folder.

    Returns:
      The source; None if the run stored none.

    Raises:
      UserError: a file is missing or differs from its SHA-256.
    """
    path = run_dir / FOLDER / HASHES
    remedy = f"restore it, or delete {run_dir / FOLDER} to run the module that can be imported"
    try:
        stored = json.loads(read_text(path))
        module, hashes = str(stored["module"]), dict(stored["sha256"])
        files = []
        for name, expected in hashes.items():
            path = run_dir / FOLDER / name
            parts = PurePosixPath(name)
            if parts.is_absolute() or ".." in parts.parts:
                raise ValueError
            content = read_bytes(path)
            if hashlib.sha256(content).hexdigest() != expected:
                raise UserError(f"{path} is not the file that the training stored: {remedy}")
            files.append((name, content))
    except (FileNotFoundError, NotADirectoryError):
        if path.name == HASHES:
            return None
        raise UserError(f"{path} is missing: {remedy}") from None
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from None
    except (ValueError, LookupError, TypeError, RecursionError):
        raise UserError(f"{path} is damaged: {remedy}") from None
    return TaskCode(module, tuple(sorted(files)))


def stored_class(run_dir: Path, name: str, code: TaskCode, *, silent: bool = False) -> type | None:
    """Import the class of a task or an environment from the source that its run stored.

    A line on stderr says so, once for each source, unless `silent`.

    Args:
      run_dir: the run folder.
      name: the class as `package.module:Class`.
      code: the source.
      silent: whether to print nothing.

    Returns:
      The class. None if the module is to be imported by its name: the source is that of another
      one, or the files of the module that Python finds are those that were stored.

    Raises:
      UserError: the stored source cannot be imported.
    """
    module, _, class_name = name.partition(":")
    # Never replace this package, whose compiled programs are cached by its own source.
    if code.module != module or module.partition(".")[0] == _PACKAGE:
        return None
    # Prefer the module itself if nothing changed, so that its classes are the user's own. But in
    # the current folder, which may be anyone's, there could be other files that it would import.
    is_here = is_task_here(module)
    place = Path.cwd() if is_here else import_root(module)
    on_disk = place is not None and source_file(place, module) is not None
    changed = [path for path, text in code.files if place and not holds(place / path, text)]
    is_same = on_disk and not changed
    if is_same and not is_here:
        return None
    # Import the stored files.
    folder = shortened(run_dir / FOLDER)
    main = source_file(run_dir / FOLDER, module)
    if main is None:
        raise UserError(f"{folder} holds no source of {module}: delete it to run {module} itself")
    if silent or is_same:
        pass
    elif on_disk:
        reason = f"{changed[0]} on disk differs from the code this run was trained with: using the"
        _say(f"{reason} stored code {shortened(main)}", code)
    else:
        _say(f"running the code stored in {shortened(main)}", code)
    try:
        found = _import_stored((run_dir / FOLDER).absolute(), code)
    except ModuleNotFoundError as error:
        raise UserError(
            f"{shortened(main)} cannot be imported: no module named {error.name!r}: install it"
        ) from None
    if not hasattr(found, class_name):
        raise UserError(f"{shortened(main)} has no {class_name!r}, which {name!r} names")
    return getattr(found, class_name)


def holds(path: Path, content: bytes) -> bool:
    """Return whether a file exists and has this content."""
    try:
        return path.read_bytes() == content
    except OSError:
        return False


_said: set[str | TaskCode] = set()


def _say(line: str, about: TaskCode | None = None) -> None:
    """Print a line on stderr, once for each subject."""
    if (about or line) not in _said:
        _said.add(about or line)
        print(line, file=sys.stderr, flush=True)


_modules: dict[TaskCode, ModuleType] = {}
"""The imported module of each source; runs that stored the same source share it."""

_lock = threading.Lock()


def _import_stored(folder: Path, code: TaskCode) -> ModuleType:
    """Import the module of a task from the folder that its source is stored in."""
    with _lock:
        if code not in _modules:
            names = {path.partition("/")[0].removesuffix(".py") for path, _ in code.files}
            with _importing_from(folder, code, names):
                _modules[code] = importlib.import_module(code.module)
        return _modules[code]


class _Importer(importlib.abc.MetaPathFinder, importlib.abc.SourceLoader):
    """An `_Importer` imports modules from the files of a source in memory."""

    def __init__(self, folder: Path, code: TaskCode) -> None:
        self._folder = folder
        self._files = {str(folder / path): content for path, content in code.files}

    def find_spec(self, fullname: str, *_: object) -> ModuleSpec | None:
        folder = str(self._folder.joinpath(*fullname.split(".")))
        spec = None
        if self._file(fullname) is not None:
            spec = importlib.util.spec_from_loader(fullname, self)
        elif any(file.startswith(f"{folder}{os.sep}") for file in self._files):
            spec = ModuleSpec(fullname, None, is_package=True)
        if spec is not None and spec.submodule_search_locations is not None:
            # Nothing else is found in the folder of a package.
            spec.submodule_search_locations = []
        return spec

    def get_filename(self, fullname: str) -> str:
        file = self._file(fullname)
        assert file is not None
        return file

    def get_data(self, path: str) -> bytes:
        if path not in self._files:
            raise FileNotFoundError(path)
        return self._files[path]

    def _file(self, fullname: str) -> str | None:
        path = self._folder.joinpath(*fullname.split("."))
        candidates = str(path / "__init__.py"), f"{path}.py"
        return next((file for file in candidates if file in self._files), None)


@contextlib.contextmanager
def _importing_from(folder: Path, code: TaskCode, names: Iterable[str]) -> Iterator[None]:
    """Import modules of a source from memory.

    Other modules of these top-level names return to `sys.modules` afterwards.
    """
    others, importer = _pop_modules(names), _Importer(folder, code)
    sys.meta_path.insert(0, importer)
    try:
        yield
    finally:
        sys.meta_path.remove(importer)
        _pop_modules(names)
        sys.modules.update(others)


def _pop_modules(names: Iterable[str]) -> dict[str, ModuleType]:
    """Remove modules and the modules in them from `sys.modules`, and return them by name."""
    found = [name for name in sys.modules if name.partition(".")[0] in names]
    return {name: sys.modules.pop(name) for name in found}
