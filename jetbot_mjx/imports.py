"""Imports that leave out what another library would load and nobody here needs."""

import contextlib
import sys
import types
from collections.abc import Iterator


@contextlib.contextmanager
def standing_in(name: str, module: types.ModuleType | None) -> Iterator[None]:
    """Lets what is imported inside find something else under a module's name.

    Args:
      name: of a top-level module; where it is already loaded, nothing is changed.
      module: what is found; None: there is no such module.
    """
    if name in sys.modules:
        yield
        return
    # Not `mock.patch.dict`, which would take back all other modules that were loaded, too.
    sys.modules[name] = module  # pyright: ignore[reportArgumentType]
    try:
        yield
    finally:
        del sys.modules[name]
