"""Import other libraries lazily, without the modules that this package does not need.

MuJoCo loads GLFW before a window is requested. MJX loads trimesh and SciPy's geometry for meshes,
which no robot here has, and prints two lines if its optional Warp part is absent. Brax loads JAXopt
for an engine that is not used here, and tensorboardX loads a logging service that is not used. JAX
loads Pallas, and a library for locks that watches every later import, and reads the metadata of all
packages. Flax loads its networks and Orbax its second interface, although a training that finds its
programs compiled needs neither. On a slow machine these imports take more than two seconds at every
start of a command. A training also needs no OpenGL, so that a command must be able to import MuJoCo
even if the backend that `MUJOCO_GL` names is unavailable. The versions of all libraries are told
here, too.

The module of a task of one's own is found beside the configuration file that names it, then in the
current folder, and then as Python finds any other.
"""

import ast
import contextlib
import functools
import glob
import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import io
import os
import sys
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from jetbot_mjx.errors import InvalidError

_Around = Callable[[], contextlib.AbstractContextManager[None]]


LIBRARIES = ("brax", "flax", "jax", "jaxlib", "llvmlite", "mujoco", "mujoco-mjx", "numpy", "optax")
"""Libraries of whose releases the results of a training depend."""


@functools.cache
def installed_version(library: str) -> str | None:
    """Return the version of a library, or None if it is not installed."""
    # Commands that store no versions start without it.
    import importlib.metadata

    try:
        return importlib.metadata.version(library)
    except importlib.metadata.PackageNotFoundError:
        return None


TASK_FOLDERS: dict[str, Path] = {}
"""Folders of configuration files beside which a task's module was found, by the module's top-level
name. They are also in `sys.path`."""


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
    if file is None or top == __name__.partition(".")[0]:
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
    top, folder = module.partition(".")[0], Path.cwd().resolve()
    if top not in TASK_FOLDERS and top not in sys.modules and source_file(folder, module):
        _import_first_from(folder)


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


def load_lazily(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return a package's `__getattr__` and `__dir__`, which import public names at their first use.

    The public names are those that the package's file imports for type checkers alone, in its block
    `if TYPE_CHECKING`.

    Args:
      package: its full name.
    """

    @functools.cache
    def homes() -> dict[str, str]:
        tree = ast.parse(Path(str(sys.modules[package].__file__)).read_text(encoding="utf-8"))
        (block,) = (node for node in tree.body if isinstance(node, ast.If))
        imports = (node for node in block.body if isinstance(node, ast.ImportFrom))
        return {alias.name: str(node.module) for node in imports for alias in node.names}

    def find(name: str) -> Any:
        if name not in homes():
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        with without_warp_lines():
            module = importlib.import_module(homes()[name])
        return getattr(module, name)

    return find, lambda: sorted(homes())


class LazyModule(types.ModuleType):
    """A `LazyModule` is a lazy module, which is imported at the first access to an attribute."""

    def __getattr__(self, name: str) -> Any:
        if sys.modules.get(self.__name__) is self:
            del sys.modules[self.__name__]
        return getattr(importlib.import_module(self.__name__), name)


class _Trimesh(LazyModule):
    """A lazy trimesh with its class `Trimesh`, which MJX's annotations use at import time."""

    @staticmethod
    def Trimesh(*arguments: Any, **options: Any) -> Any:
        return importlib.import_module("trimesh").Trimesh(*arguments, **options)


@contextlib.contextmanager
def standing_in(name: str, module: types.ModuleType | None) -> Iterator[None]:
    """Replace a module for the imports inside the context.

    Args:
      name: name of the module; if it is already loaded, nothing is changed.
      module: the replacement; None: the import fails as if the module did not exist.
    """
    if name in sys.modules:
        yield
        return
    # Do not use `mock.patch.dict`, which would also remove all other modules that were loaded.
    sys.modules[name] = module  # pyright: ignore[reportArgumentType]
    try:
        yield
    finally:
        # A lazy module may have been replaced by the real one inside the context.
        if sys.modules.get(name) is module:
            del sys.modules[name]


class _Finder(importlib.abc.MetaPathFinder):
    """An import finder that runs the context managers of `_AROUND` around modules' execution."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: types.ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if fullname not in _AROUND:
            return None
        spec = importlib.machinery.PathFinder.find_spec(fullname, path, target)
        if spec is not None and spec.loader is not None:
            around, execute = _AROUND[fullname], spec.loader.exec_module

            def exec_module(module: types.ModuleType) -> None:
                with around():
                    execute(module)

            spec.loader.exec_module = exec_module
        return spec


@contextlib.contextmanager
def _mjx() -> Iterator[None]:
    with (
        standing_in("trimesh", _Trimesh("trimesh")),
        standing_in("scipy.spatial", LazyModule("scipy.spatial")),
        without_warp_lines(),
    ):
        yield


def _lru_cache() -> contextlib.AbstractContextManager[None]:
    # JAX does without the library where it is not installed.
    if importlib.util.find_spec("filelock") is None:
        return contextlib.nullcontext()
    return standing_in("filelock", LazyModule("filelock"))


@contextlib.contextmanager
def _without_rocm() -> Iterator[None]:
    """Keep JAX from reading the metadata of all installed packages, if none is for AMD's GPUs."""
    metadata: Any = importlib.import_module("importlib.metadata")
    distributions = metadata.distributions
    if not any(glob.glob("jax[-_]rocm*", root_dir=folder) for folder in sys.path):
        metadata.distributions = lambda: ()
    try:
        yield
    finally:
        metadata.distributions = distributions


@contextlib.contextmanager
def without_warp_lines() -> Iterator[None]:
    """Print what is printed inside the context, except for MJX's lines about its part Warp."""
    printed = io.StringIO()
    try:
        with contextlib.redirect_stdout(printed):
            yield
    finally:
        lines = printed.getvalue().splitlines(keepends=True)
        sys.stdout.writelines(line for line in lines if not line.startswith("Failed to import "))


_COMET = types.ModuleType("tensorboardX.comet_utils")
_COMET.CometLogger = None  # pyright: ignore[reportAttributeAccessIssue]
_ORBAX_V1 = "orbax.checkpoint.experimental.v1"
_AROUND: Mapping[str, _Around] = {
    "brax.generalized.constraint": lambda: standing_in("jaxopt", LazyModule("jaxopt")),
    "brax.io.image": lambda: standing_in("PIL.Image", LazyModule("PIL.Image")),
    "flax": lambda: standing_in("flax.linen", LazyModule("flax.linen")),
    "jax._src.numpy.array_constructors": _without_rocm,
    "jax._src.lru_cache": _lru_cache,
    "jax.extend": lambda: standing_in("jax.extend.pallas", LazyModule("jax.extend.pallas")),
    "mujoco.glfw": lambda: standing_in("glfw", LazyModule("glfw")),
    "mujoco.mjx": _mjx,
    # MuJoCo then has no OpenGL, as with `MUJOCO_GL=disabled`, and `opengl.find_backend` reports
    # the reason if images are needed. PyOpenGL raises an AttributeError if the library is missing.
    "mujoco.rendering.classic.gl_context": lambda: contextlib.suppress(
        ImportError, AttributeError, OSError, RuntimeError
    ),
    "orbax.checkpoint": lambda: standing_in(_ORBAX_V1, LazyModule(_ORBAX_V1)),
    # Stand in for a logging service of tensorboardX's own writer, which is not used.
    "tensorboardX.writer": lambda: standing_in("tensorboardX.comet_utils", _COMET),
}
"""Context managers by the name of the module that they surround."""


def install_lazy_imports() -> None:
    """Install the lazy imports for the whole process, from now on.

    Only a command does this. A program that imports the package as a library loads the other
    libraries in its own way.
    """
    if not any(isinstance(finder, _Finder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Finder())
