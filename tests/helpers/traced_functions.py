"""Functions whose hash a test computes in two processes."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from onekernel import fuse
from onekernel.fingerprint import fingerprint
from onekernel.mujoco import fuse_mjx

PENDULUM = """
<mujoco><option timestep="0.01"/><worldbody><body><joint type="hinge" axis="0 1 0"/>
<geom type="capsule" fromto="0 0 0 0 0 -{length}" size="0.05"/></body></worldbody></mujoco>
"""


def hashed(function, *arguments):
    return fingerprint(jax.make_jaxpr(function)(*(arguments or (jnp.arange(3.0),))))


def program(x):
    """A function with an inner one, a loop, constants and a kernel."""
    table = jnp.asarray(np.linspace(0.0, 1.0, 40, dtype=np.float32))
    inner = jax.jit(lambda x: x + table[:3].sum())
    looped = jax.lax.fori_loop(0, 3, lambda i, x: inner(x) * 2.0, x)
    return fuse(lambda x: jnp.sin(x) + table[7], on_unsupported="raise")(looped)


def step_of(length):
    step = fuse_mjx(mujoco.MjModel.from_xml_string(PENDULUM.format(length=length)))
    return lambda state: step(state, jnp.zeros(0))


def state_of(length):
    return fuse_mjx(mujoco.MjModel.from_xml_string(PENDULUM.format(length=length))).init()
