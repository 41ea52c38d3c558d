"""Store the source of a task of one's own in the run folder, and import it from there.

A policy is worth little without the task that it was trained in. When a training begins, the file
of the task's module and those of the modules that it imports from the same folder are copied to
`task/` in the run folder, each with its SHA-256. Later commands import the stored files if the
module cannot be found, or if its files differ from the stored ones. Tasks of this package and of
installed packages are not stored, because their versions are.
"""

import ast
import builtins
import contextlib
import hashlib
import importlib
import importlib.abc
import importlib.util
import json
import sys
import threading
from collections.abc import Iterator
from importlib.machinery import ModuleSpec
from pathlib import Path, PurePosixPath
from types import ModuleType
from typing import Any, NamedTuple

from jetbot_mjx.config import shipped_folder
from jetbot_mjx.errors import UserError
from jetbot_mjx.imports import find_task_here, import_root, source_file
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
      to an installed package, or all files together are larger than `MAX_BYTES`.
    """
    module = name.partition(":")[0]
    find_task_here(module)
    root = import_root(module)
    if root is None or _is_installed(root, module):
        return None
    files: dict[str, bytes] = {}
    names, seen = [module], set()
    while names:
        one = names.pop()
        if one in seen or import_root(one) != root or _is_installed(root, one):
            continue
        seen.add(one)
        if "." in one:
            names.append(one.rpartition(".")[0])
        file = source_file(root, one)
        if file is not None:
            content = file.read_bytes()
            files[file.relative_to(root).as_posix()] = content
            names += _imported_names(content, one, is_package=file.name == "__init__.py")
    if source_file(root, module) is None:
        return None
    if sum(map(len, files.values())) > MAX_BYTES:
        _say(
            f"the source of {name} is larger than {MAX_BYTES:,} bytes and is not stored in the run"
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
            (folder / path).parent.mkdir(parents=True, exist_ok=True)
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


def stored_task_class(run_dir: Path, name: str, *, silent: bool = False) -> type[Any] | None:
    """Import the class of a task from the source that its run stored.

    A line on stderr says so, once for each source, unless `silent`. The modules are not left in
    `sys.modules`, so that runs with different sources of one name can be used in one process.

    Args:
      run_dir: the run folder.
      name: the task as `package.module:Class`.
      silent: whether to print nothing.

    Returns:
      The class. None if the module is to be imported by its name: the run stored no source of it,
      or the module's own files are those that were stored.

    Raises:
      UserError: the stored source is damaged, or cannot be imported.
    """
    module, _, class_name = name.partition(":")
    code = read_task_code(run_dir)
    # Never replace this package, whose compiled programs are cached by its own source.
    if code is None or code.module != module or module.partition(".")[0] == _PACKAGE:
        return None
    # Prefer the module itself if nothing changed, so that its classes are the user's own.
    find_task_here(module)
    root = import_root(module)
    on_disk = root is not None and source_file(root, module) is not None
    if root is not None and on_disk and all(_holds(root / path, text) for path, text in code.files):
        return None
    # Import the stored files.
    folder = shortened(run_dir / FOLDER)
    main = source_file(run_dir / FOLDER, module)
    if main is None:
        raise UserError(f"{folder} holds no source of {module}: delete it to run {module} itself")
    if silent:
        pass
    elif on_disk:
        reason = f"{module} on disk differs from the code this run was trained with: using the"
        _say(f"{reason} stored code {shortened(main)}", code)
    else:
        _say(f"running the task's code stored in {shortened(main)}", code)
    try:
        importer = _importers.setdefault(code, _StoredModules(run_dir / FOLDER, code))
        found = importer.load(module)
    except ModuleNotFoundError as error:
        raise UserError(
            f"{shortened(main)} cannot be imported: no module named {error.name!r}: install it"
        ) from None
    if not hasattr(found, class_name):
        raise UserError(f"task.name = {name!r}: {shortened(main)} has no {class_name!r}")
    return getattr(found, class_name)


def _is_installed(root: Path, module: str) -> bool:
    top = module.partition(".")[0]
    if top == _PACKAGE or top in sys.stdlib_module_names:
        return True
    # The examples are installed with this package, but imported only where they are asked for.
    is_example = root == shipped_folder("examples").resolve()
    return bool({"site-packages", "dist-packages"} & {*root.parts}) and not is_example


def _imported_names(source: bytes, module: str, *, is_package: bool) -> list[str]:
    """Return the full names of all that a source file may import, wherever it does."""
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError):
        return []
    package = module if is_package else module.rpartition(".")[0]
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                with contextlib.suppress(ImportError):
                    base = importlib.util.resolve_name("." * node.level + base, package)
            found += [base, *(f"{base}.{alias.name}" for alias in node.names)] if base else []
    return found


def _holds(path: Path, content: bytes) -> bool:
    try:
        return path.read_bytes() == content
    except OSError:
        return False


_said: set[Any] = set()


def _say(line: str, about: Any = None) -> None:
    """Print a line on stderr, once for each subject."""
    if (about or line) not in _said:
        _said.add(about or line)
        print(line, file=sys.stderr, flush=True)


class _StoredModules(importlib.abc.MetaPathFinder):
    """A `_StoredModules` imports stored source files under their own names.

    Its modules are in `sys.modules` only while one of them is imported, or imports something.
    """

    def __init__(self, folder: Path, code: TaskCode) -> None:
        self._folder = folder
        self._sources: dict[str, tuple[str, bytes]] = {}
        for path, content in code.files:
            parts = PurePosixPath(path).with_suffix("").parts
            parts = parts[:-1] if parts[-1] == "__init__" else parts
            self._sources[".".join(parts)] = path, content
        self._names = {
            ".".join(name.split(".")[:length])
            for name in self._sources
            for length in range(1, name.count(".") + 2)
        }
        self._modules: dict[str, ModuleType] = {}
        self._lock = threading.RLock()

    def load(self, name: str) -> ModuleType:
        """Import a stored module."""
        with self._active():
            return importlib.import_module(name)

    def import_(self, *arguments: Any, **keywords: Any) -> Any:
        """Stand in for `__import__` in the stored modules, so that late imports find them too."""
        with self._active():
            return builtins.__import__(*arguments, **keywords)

    def find_spec(self, fullname: str, path: Any = None, target: Any = None) -> ModuleSpec | None:
        """Return the spec of a stored module or of a folder of such modules."""
        if fullname not in self._names:
            return None
        folder = str(self._folder.joinpath(*fullname.split(".")))
        if fullname not in self._sources:
            spec = ModuleSpec(fullname, None, is_package=True)
            spec.submodule_search_locations = [folder]
            return spec
        file, content = self._sources[fullname]
        path = str(self._folder / file)
        return importlib.util.spec_from_file_location(
            fullname,
            path,
            loader=_StoredLoader(path, content, self.import_),
            submodule_search_locations=[folder] if file.endswith("__init__.py") else None,
        )

    @contextlib.contextmanager
    def _active(self) -> Iterator[None]:
        """Replace other modules of the stored names by the stored ones, and restore them."""
        with self._lock:
            if self in sys.meta_path:
                # A module that is being imported imports another one.
                yield
                return
            others = {name: sys.modules.pop(name, None) for name in self._names}
            sys.modules.update(self._modules)
            sys.meta_path.insert(0, self)
            try:
                yield
            finally:
                sys.meta_path.remove(self)
                for name, other in others.items():
                    if name in sys.modules:
                        self._modules[name] = sys.modules.pop(name)
                    if other is not None:
                        sys.modules[name] = other


class _StoredLoader(importlib.abc.SourceLoader):
    """A `_StoredLoader` runs source that was read and checked before, and writes no bytecode."""

    def __init__(self, path: str, content: bytes, import_: Any) -> None:
        self._path, self._content, self._import = path, content, import_

    def get_filename(self, fullname: str) -> str:
        return self._path

    def get_data(self, path: str) -> bytes:
        if path != self._path:
            raise FileNotFoundError(path)
        return self._content

    def exec_module(self, module: ModuleType) -> None:
        module.__dict__["__builtins__"] = {**vars(builtins), "__import__": self._import}
        super().exec_module(module)


_importers: dict[TaskCode, _StoredModules] = {}
"""The importer of each source; runs that stored the same source share it."""
