"""Find the module of a task or an environment of one's own.

It is looked for beside the configuration file that names it, then in the current folder, and then
as Python finds any other.
"""

import ast
import contextlib
import importlib
import importlib.util
import os
import sys
from pathlib import Path
from typing import NamedTuple

from jetbot_mjx.config.files import shipped_folder
from jetbot_mjx.errors import InvalidError, shown

_PACKAGE = __name__.partition(".")[0]

TASK_FOLDERS: dict[str, Path] = {}
"""Folders of configuration files beside which a task's module was found, by the module's top-level
name. They are also in `sys.path`."""


def class_name(value: str) -> str:
    """Return the name of a class as `module:Class`, of one in a file `folder/file.py:Class` too.

    Raises:
      ValueError: it is neither.
    """
    module, separator, name = value.partition(":")
    if separator and module.endswith(".py"):
        module = ".".join(Path(module.removesuffix(".py")).parts)
        for part in module.split("."):
            if not part.isidentifier():
                raise ValueError(
                    f"{shown(value)} is wrong: Python cannot import {shown(part)}: rename the file"
                    " or folder, with letters, digits and underscores only"
                )
    if separator and all(part.isidentifier() for part in (*module.split("."), *name.split("."))):
        return f"{module}:{name}"
    # Python itself separates a class from its module by a dot.
    likely = ":".join(value.rpartition(".")[::2])
    is_likely = not separator and likely[0] not in ".:" and not value.endswith(".py")
    hint = f", perhaps {likely}" if is_likely else ""
    raise ValueError(
        f"{shown(value)} is wrong: write file.py:Class, with a file beside the configuration, or"
        f" package.module:Class{hint}"
    )


def find_task_beside(config: Path, module: str) -> None:
    """Let a task's module be imported from the folder of a configuration file, if it is there.

    Args:
      config: path of the configuration file.
      module: full name of the module.

    Raises:
      InvalidError: another module of this name was found before. Python can import only one of
        them.
    """
    folder, top = config.absolute().parent.resolve(), module.partition(".")[0]
    file = source_file(folder, module)
    if file is None or top == _PACKAGE:
        return
    earlier = TASK_FOLDERS.get(top) or (import_root(top) if top in sys.modules else folder)
    other = earlier and source_file(earlier, module)
    # An installed copy of the same module may have been imported.
    if other is None or other.read_bytes() != file.read_bytes():
        raise InvalidError(
            f"{file} cannot be imported: this process uses another module {module} already"
            f"{f', {other}' if other else ''}: rename one of them"
        )
    if earlier is not None and earlier.resolve() == folder:
        TASK_FOLDERS[top] = folder
        _import_first_from(folder)


def find_task_here(module: str) -> None:
    """Let a task's module be imported from the current folder, unless it was found before."""
    if is_task_here(module):
        _import_first_from(Path.cwd().resolve())


def is_task_here(module: str) -> bool:
    """Return whether a task's module is in the current folder, and was not found before."""
    top = module.partition(".")[0]
    if top in TASK_FOLDERS or top in sys.modules:
        return False
    return source_file(Path.cwd().resolve(), module) is not None


def _import_first_from(folder: Path) -> None:
    if str(folder) in sys.path:
        sys.path.remove(str(folder))
    sys.path.insert(0, str(folder))
    importlib.invalidate_caches()


def source_file(folder: Path, module: str) -> Path | None:
    """Return the source file of a module below a folder that imports begin in, or None."""
    if not all(part.isidentifier() for part in module.split(".")):
        return None
    path = folder.joinpath(*module.split("."))
    candidates = path / "__init__.py", path.with_name(f"{path.name}.py")
    return next((file for file in candidates if os.path.isfile(file)), None)


def import_root(module: str) -> Path | None:
    """Return the folder that the import of a module begins in; None if Python does not find it."""
    top = module.partition(".")[0]
    try:
        spec = importlib.util.find_spec(top)
    except (ImportError, ValueError):  # a module without a spec, such as `__main__`
        return None
    if spec is None:
        return None
    if spec.submodule_search_locations:
        return Path(next(iter(spec.submodule_search_locations))).absolute().parent
    return Path(spec.origin).absolute().parent if spec.has_location and spec.origin else None


class Sources(NamedTuple):
    """A `Sources` holds the source files of a module and of all that it imports beside it."""

    files: dict[str, bytes]
    """Content of each file, by its path relative to the folder that imports begin in."""
    late: list[str]
    """Which of them imports another one inside a function, and where."""


def read_sources(module: str) -> Sources | None:
    """Read the files of a module, and of all that it imports from the same folder.

    Args:
      module: full name of the module, which can be imported.

    Returns:
      The files; None if it has none, or belongs to this or to an installed package.
    """
    root = import_root(module)
    if root is None or _is_installed(root, module) or source_file(root, module) is None:
        return None
    found = Sources({}, [])
    names, seen = [module], set()
    # Follow the imports, the parent packages included.
    while names:
        one = names.pop()
        if one in seen or import_root(one) != root or _is_installed(root, one):
            continue
        seen.add(one)
        parent = one.rpartition(".")[0]
        names += [parent] if parent else []
        file = source_file(root, one)
        if file is None:
            continue
        path, content = file.relative_to(root).as_posix(), file.read_bytes()
        found.files[path] = content
        for other, line, is_late in _imports(content, one if file.stem == "__init__" else parent):
            names.append(other)
            if is_late and source_file(root, other) and import_root(other) == root:
                found.late.append(f"{path}, line {line}: imports {other} inside a function")
    return found


def _is_installed(root: Path, module: str) -> bool:
    top = module.partition(".")[0]
    if top == _PACKAGE or top in sys.stdlib_module_names:
        return True
    # The examples are installed with this package, but imported only where they are asked for.
    is_example = root == shipped_folder("examples").resolve()
    return bool({"site-packages", "dist-packages"} & {*root.parts}) and not is_example


def _imports(source: bytes, package: str) -> list[tuple[str, int, bool]]:
    """Find all that a source file may import, wherever it does.

    Args:
      source: the content of the file.
      package: the package that relative imports start from.

    Returns:
      Full name of each import, its line, and whether it is made inside a function.
    """
    try:
        tree = ast.parse(source)
    except (SyntaxError, ValueError):
        return []
    functions = ast.FunctionDef | ast.AsyncFunctionDef
    late = {x for node in ast.walk(tree) if isinstance(node, functions) for x in ast.walk(node)}
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                with contextlib.suppress(ImportError):
                    base = importlib.util.resolve_name("." * node.level + base, package)
            names = [base, *(f"{base}.{alias.name}" for alias in node.names)] if base else []
        else:
            continue
        found += [(name, node.lineno, node in late) for name in names]
    return found
