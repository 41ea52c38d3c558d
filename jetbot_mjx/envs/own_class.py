"""Import the class of a task or an environment of one's own."""

import difflib
import importlib
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

from jetbot_mjx.config import find_task_here, read_sources
from jetbot_mjx.envs.checks.errors import describe_error
from jetbot_mjx.errors import InvalidError, MissingPackageError, UserError


def import_class(key: str, name: str) -> Any:
    """Import what a name `package.module:Class` refers to, which may not be a class.

    Args:
      key: the setting that names it.
      name: the name.

    Raises:
      UserError: it cannot be imported.
    """
    module_name, _, class_name = name.partition(":")
    find_task_here(module_name)
    try:
        module = _import_as_it_is(module_name)
    except ModuleNotFoundError as error:
        if f"{module_name}.".startswith(f"{error.name}."):
            here = sorted(path.stem for path in Path().glob("*.py"))
            close = difflib.get_close_matches(module_name, here, n=1)
            hint = f": did you mean {close[0]}:{class_name}?" if close else ""
            raise MissingPackageError(
                f"{key} = {name!r}: there is no {module_name.replace('.', os.sep)}.py beside"
                f" the YAML file or in the current folder, and no such package{hint}"
            ) from None
        raise MissingPackageError(
            f"{key} = {name!r}: {module_name} imports {error.name!r}, which is not installed:"
            " install it"
        ) from None
    except SyntaxError as error:
        raise InvalidError(
            f"{key} = {name!r}: {error.filename}, line {error.lineno}, is not valid Python:"
            f" {error.msg}"
        ) from None
    except UserError:
        raise
    except Exception as error:
        described = describe_error(error, f"the import of {module_name}", ())
        raise InvalidError(f"{key} = {name!r}: {described}") from error
    found, owner = module, module_name
    for part in class_name.split("."):
        if not hasattr(found, part):
            close = difflib.get_close_matches(part, dir(found), n=1)
            hint = f": did you mean {close[0]!r}?" if close else ""
            raise InvalidError(f"{key} = {name!r}: {owner} has no {part!r}{hint}")
        found, owner = getattr(found, part), part
    return found


_imported: dict[str, Mapping[str, bytes]] = {}
"""The files that each module was imported from, with those of its imports, by its name."""


def _import_as_it_is(name: str) -> ModuleType:
    """Import a module of one's own; again, if a file was edited since, as in a notebook."""
    sources = read_sources(name)
    files = {} if sources is None else sources.files
    earlier = _imported.get(name, files)
    if earlier != files:
        for path in {*earlier, *files}:
            module = path.removesuffix(".py").replace("/", ".").removesuffix(".__init__")
            sys.modules.pop(module, None)
        importlib.invalidate_caches()
    module = importlib.import_module(name)
    _imported[name] = files
    return module
