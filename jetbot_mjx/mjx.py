"""MJX, imported without what it does not need here.

It prints two lines when its optional Warp part is absent. And it loads trimesh, the better part of
a second, for meshes that no robot here has: that is put off until one does. It would put models on
the first device of all, and of several processes only one has that: here it is the process's own.
"""

import contextlib
import importlib
import io
import types
from typing import Any

import jax
import mujoco

from jetbot_mjx.imports import standing_in


class _Trimesh(types.ModuleType):
    """What MJX sees of trimesh: a name for its annotations, the library for its meshes."""

    def __getattr__(self, name: str) -> Any:
        return getattr(importlib.import_module("trimesh"), name)

    @staticmethod
    def Trimesh(*arguments: Any, **options: Any) -> Any:
        return importlib.import_module("trimesh").Trimesh(*arguments, **options)


with standing_in("trimesh", _Trimesh("trimesh")), contextlib.redirect_stdout(io.StringIO()):
    from mujoco import mjx
    from mujoco.mjx import Data, Model, step

__all__ = ["Data", "Model", "make_data", "put_model", "step"]


def put_model(model: mujoco.MjModel) -> Model:
    """MuJoCo's model as arrays on a device."""
    return mjx.put_model(model, device=jax.local_devices()[0])


def make_data(model: mujoco.MjModel) -> Data:
    """The model's state before the first step, on a device."""
    return mjx.make_data(model, device=jax.local_devices()[0])
