"""Imports that leave out, or put off, what another library would load and nobody here needs.

MuJoCo loads GLFW before anyone asks for a window; MJX trimesh and SciPy's geometry for meshes that
no robot here has, and it prints two lines when its optional Warp part is absent; Brax JAXopt for an
engine that is not used here; tensorboardX a service that nobody logs to. On a slow machine that is
the better part of two seconds, before anything has begun. And a training needs no OpenGL, so that
MuJoCo has to do without what `MUJOCO_GL` asks for in vain.
"""

import contextlib
import importlib
import importlib.abc
import importlib.machinery
import io
import sys
import types
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

_Around = Callable[[], contextlib.AbstractContextManager[None]]


def load_lazily(
    package: str, homes: Mapping[str, str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return a package's `__getattr__` and `__dir__`, which import public names at their first use.

    Args:
      package: its full name.
      homes: the module of the package that each public name lives in.
    """

    def find(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(importlib.import_module(f"{package}.{homes[name]}"), name)

    return find, lambda: sorted(homes)


class PutOff(types.ModuleType):
    """Stands for a module that is imported when something in it is first asked for."""

    def __getattr__(self, name: str) -> Any:
        if sys.modules.get(self.__name__) is self:
            del sys.modules[self.__name__]
        return getattr(importlib.import_module(self.__name__), name)


class _Trimesh(PutOff):
    """MJX's annotations name a class of it as soon as they are read."""

    @staticmethod
    def Trimesh(*arguments: Any, **options: Any) -> Any:
        return importlib.import_module("trimesh").Trimesh(*arguments, **options)


class _Comet(types.ModuleType):
    """What tensorboardX's own writer, which nobody here uses, would log to."""

    CometLogger = None

    def __init__(self) -> None:
        super().__init__("tensorboardX.comet_utils")


@contextlib.contextmanager
def standing_in(name: str, module: types.ModuleType | None) -> Iterator[None]:
    """Lets what is imported inside find something else under a module's name.

    Args:
      name: of a module; where it is already loaded, nothing is changed.
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
        # One that was put off may have been needed inside.
        if sys.modules.get(name) is module:
            del sys.modules[name]


class _Finder(importlib.abc.MetaPathFinder):
    """Finds modules where they are, and has something done around their execution."""

    def __init__(self, around: Mapping[str, _Around]) -> None:
        self._around = around

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: types.ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if fullname not in self._around:
            return None
        spec = importlib.machinery.PathFinder.find_spec(fullname, path, target)
        if spec is not None and spec.loader is not None:
            spec.loader = _Loader(spec.loader, self._around[fullname])
        return spec


class _Loader(importlib.abc.Loader):
    """Another loader, and something done around it."""

    def __init__(self, loader: importlib.abc.Loader, around: _Around) -> None:
        self._loader = loader
        self._do_around = around

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> types.ModuleType | None:
        return self._loader.create_module(spec)

    def exec_module(self, module: types.ModuleType) -> None:
        with self._do_around():
            self._loader.exec_module(module)

    def __getattr__(self, name: str) -> Any:
        # Whatever else one may ask a loader, such as the source of its module.
        return getattr(self._loader, name)


@contextlib.contextmanager
def _mjx() -> Iterator[None]:
    with (
        standing_in("trimesh", _Trimesh("trimesh")),
        standing_in("scipy.spatial", PutOff("scipy.spatial")),
        contextlib.redirect_stdout(io.StringIO()),
    ):
        yield


@contextlib.contextmanager
def _opengl() -> Iterator[None]:
    # MuJoCo then has no OpenGL, as with `MUJOCO_GL=disabled`; who needs pictures is told why by
    # `offscreen.find_backend`. PyOpenGL fails by an AttributeError where the library is missing.
    with contextlib.suppress(ImportError, AttributeError, OSError, RuntimeError):
        yield


_AROUND: Mapping[str, _Around] = {
    "brax.generalized.constraint": lambda: standing_in("jaxopt", PutOff("jaxopt")),
    "mujoco.glfw": lambda: standing_in("glfw", PutOff("glfw")),
    "mujoco.mjx": _mjx,
    "mujoco.rendering.classic.gl_context": _opengl,
    "tensorboardX.writer": lambda: standing_in("tensorboardX.comet_utils", _Comet()),
}
"""By the module that imports them."""


def lighten() -> None:
    """Makes these libraries light to import, from now on and whoever imports them."""
    sys.meta_path.insert(0, _Finder(_AROUND))
