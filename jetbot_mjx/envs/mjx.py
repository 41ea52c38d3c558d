"""Wrap MJX so that models stay on the host until a program needs them.

MJX puts models on the first of all devices, which only one of several processes has, and compiles
small programs there for many arrays. Here a model's arrays are constants of programs instead.
"""

from typing import TypeVar

import jax
import mujoco
import numpy as np

from jetbot_mjx import mjx_import  # noqa: F401
from jetbot_mjx.devices import default_device_cpu

# isort: split
from mujoco import mjx
from mujoco.mjx import ConeType as ConeType
from mujoco.mjx import Data, Model
from mujoco.mjx import GeomType as GeomType
from mujoco.mjx import step as step
from mujoco.mjx._src import collision_driver as collision_driver
from mujoco.mjx._src import solver as solver

_Tree = TypeVar("_Tree", Model, Data)


def put_model(model: mujoco.MjModel) -> Model:
    """Return the MJX model of a C model, as uncommitted arrays."""
    # The caller may be tracing a program.
    with jax.ensure_compile_time_eval(), default_device_cpu() as device:
        return _uncommitted(mjx.put_model(model, device=device))


def make_data(model: mujoco.MjModel) -> Data:
    """Return MJX's simulation data before the first step, as uncommitted arrays."""
    with jax.ensure_compile_time_eval(), default_device_cpu() as device:
        return _uncommitted(mjx.make_data(model, device=device))


def body_poses(model: Model, data: Data) -> Data:
    """Return the data with positions and attitudes of all bodies, from `qpos` and `mocap_pos`."""
    return mjx.kinematics(model, data)


def _uncommitted(tree: _Tree) -> _Tree:
    """Return arrays that JAX may move to any device."""
    # `jnp.asarray` would compile a program for every shape.
    return jax.device_put(jax.tree.map(np.asarray, tree))
