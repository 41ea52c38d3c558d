"""Import other libraries lazily, without the modules that no command needs.

MuJoCo loads GLFW before a window is requested. MJX loads trimesh and SciPy's geometry for meshes,
which no robot here has. Brax loads JAXopt for an engine that is not used here, and tensorboardX
loads PyTorch and a logging service, neither of which is used. JAX loads Pallas. Flax loads its
networks, although a training that finds its programs compiled needs none. On a slow machine
these imports take more than two seconds at every start of a command. A training also needs no
OpenGL, so that a command must be able to import MuJoCo even if the backend that `MUJOCO_GL` names
is unavailable.
"""

import contextlib
import importlib
import importlib.abc
import importlib.machinery
import sys
import types
from collections.abc import Callable, Iterator, Mapping, Sequence

from jetbot_mjx.startup.switch import is_plain

_Around = Callable[[], contextlib.AbstractContextManager[None]]


class LazyModule(types.ModuleType):
    """A stand-in for a module, which imports the module at the first access to an attribute."""

    def __getattr__(self, name: str) -> object:
        if sys.modules.get(self.__name__) is self:
            del sys.modules[self.__name__]
        return getattr(importlib.import_module(self.__name__), name)


class _Trimesh(LazyModule):
    """A lazy trimesh with its class `Trimesh`, which MJX's annotations use at import time."""

    @staticmethod
    def Trimesh(*arguments: object, **options: object) -> object:
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
    ):
        yield


_COMET = types.ModuleType("tensorboardX.comet_utils")
_COMET.CometLogger = None  # pyright: ignore[reportAttributeAccessIssue]
_AROUND: Mapping[str, _Around] = {
    "brax.generalized.constraint": lambda: standing_in("jaxopt", LazyModule("jaxopt")),
    "brax.io.image": lambda: standing_in("PIL.Image", LazyModule("PIL.Image")),
    "flax": lambda: standing_in("flax.linen", LazyModule("flax.linen")),
    "jax.extend": lambda: standing_in("jax.extend.pallas", LazyModule("jax.extend.pallas")),
    "mujoco.glfw": lambda: standing_in("glfw", LazyModule("glfw")),
    "mujoco.mjx": _mjx,
    # MuJoCo then has no OpenGL, as with `MUJOCO_GL=disabled`, and `opengl.find_backend` reports
    # the reason if images are needed. PyOpenGL raises an AttributeError if the library is missing.
    "mujoco.rendering.classic.gl_context": lambda: contextlib.suppress(
        ImportError, AttributeError, OSError, RuntimeError
    ),
    # Where PyTorch is installed, tensorboardX would load it to draw network graphs.
    "tensorboardX": lambda: standing_in("torch", None),
    # Stand in for a logging service of tensorboardX's own writer, which is not used.
    "tensorboardX.writer": lambda: standing_in("tensorboardX.comet_utils", _COMET),
}
"""Context managers by the name of the module that they surround."""


def install_lazy_imports() -> None:
    """Install the lazy imports for the whole process, from now on."""
    if not is_plain() and not any(isinstance(finder, _Finder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Finder())
