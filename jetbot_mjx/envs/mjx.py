"""MJX, with models that stay on the host until they are needed.

MJX would put them on the first device of all, which of several processes only one has, and compile
a small program there for many an array; a model's numbers are constants of programs.
"""

from typing import Any

import jax
import mujoco
import numpy as np
from mujoco import mjx
from mujoco.mjx import Data, Model, step

from jetbot_mjx.compiler.xla_options import default_device_cpu

__all__ = ["Data", "Model", "make_data", "put_model", "step"]


def put_model(model: mujoco.MjModel) -> Model:
    """Return MuJoCo's model as arrays."""
    # Whoever asks may be in the middle of tracing something.
    with jax.ensure_compile_time_eval(), default_device_cpu() as device:
        return _anywhere(mjx.put_model(model, device=device))


def make_data(model: mujoco.MjModel) -> Data:
    """Return the model's state before the first step, as arrays."""
    with jax.ensure_compile_time_eval(), default_device_cpu() as device:
        return _anywhere(mjx.make_data(model, device=device))


def _anywhere(tree: Any) -> Any:
    """Return the same arrays, free to go wherever they are needed."""
    # `jnp.asarray` would compile a program for every shape among them.
    return jax.device_put(jax.tree.map(np.asarray, tree))
