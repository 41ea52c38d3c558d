"""Check the kernels of PPO on this machine before a training relies on them.

The check is a few actions, a small gradient and a step of Adam, compared with those of the CPU's
kernels. These are written of the same functions of one sample, but everything around these is
different, and so is the compiler's target. XLA would take longer to compile the functions than a
training takes to begin.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jetbot_mjx.agents.fused import launch
from jetbot_mjx.agents.fused.adam import SIZES, AdamRule
from jetbot_mjx.agents.fused.arrays import Actions
from jetbot_mjx.agents.fused.shapes import LossTerms, UpdateShape
from jetbot_mjx.devices import host_cpu

_SHAPE = UpdateShape(4, 16, 2, 1, "tanh_normal", "tanh")
_TERMS = LossTerms(0.2, 0.01, 1.0, 0.9, 0.9, 1.0)
_UNROLLS, _TIME = 8, 4
_RULE = AdamRule(_SHAPE, _UNROLLS * _TIME, "NONE", steps=1)
_MOST_NORM, _RATE = 0.3, 0.01
_MOST_ERROR = 0.01
"""Largest difference of the gradients, relative to their norm, and of actions and logarithms of
probabilities; GPUs have products of float16."""


@functools.cache
def runs_correctly() -> bool:
    """Return whether the kernels draw actions, compute a gradient and make a step correctly.

    Their back end must be usable.
    """
    # What they compute and what the CPU's do, as a new function each time, for which JAX has traced
    # nothing yet. Where `JAX_PLATFORMS` leaves out the CPU, all that is checked is that they run.
    results = []
    for device in (jax.local_devices(backend=launch.backend().PLATFORM)[0], host_cpu()):
        with jax.default_device(device):
            try:
                results.append(jax.jit(functools.partial(_run))(*jax.device_put(_data())))
            except jax.errors.JaxRuntimeError:
                return False
    (ours, *others), (theirs, *wanted) = jax.tree.map(np.array, results)
    pairs = zip(jax.tree.leaves(others), jax.tree.leaves(wanted), strict=True)
    errors = [np.abs(one - other).max() for one, other in pairs]
    # Beside the gradient, the vector has the sums of the metrics, which are no derivatives.
    ours[_RULE.metric_places] = theirs[_RULE.metric_places] = 0.0
    errors.append(np.linalg.norm(ours - theirs) / np.linalg.norm(theirs))
    # A comparison with NaN is false, so that NaN fails the check.
    return all(bool(error <= _MOST_ERROR) for error in errors)


def _data() -> list[np.ndarray]:
    """Draw parameters, unrolls in which no episode ends, what follows them, and noise."""
    rng, columns = np.random.default_rng(0), _SHAPE.columns
    params = 0.3 * rng.standard_normal(_SHAPE.size)
    rows = rng.standard_normal((_UNROLLS, _TIME, columns["size"]))
    rows[..., columns["discount"] :] = 1.0, 0.0
    last = rng.standard_normal((_UNROLLS, _SHAPE.observations))
    noise = rng.standard_normal((2, _TIME, _UNROLLS, _SHAPE.actions))
    return [x.astype(np.float32) for x in (params, rows, last, noise)]


def _run(
    params: Array, rows: Array, last: Array, noise: Array
) -> tuple[Array, Actions, tuple[Array, ...]]:
    """Return a gradient, the actions of all steps, and a step of Adam, by the kernels."""
    # The observations stay as they are.
    columns, size, index = _SHAPE.columns, _SHAPE.observations, jnp.zeros((), jnp.int32)
    network = _SHAPE, params, jnp.zeros(size), jnp.ones(size)
    # The policy that collects is the one that learns, so nothing is clipped.
    actions = launch.actions(*network, rows[..., :size].reshape(-1, size), noise[1].reshape(-1, 1))
    _, *collected = (x.reshape(_UNROLLS, _TIME, -1) for x in actions)
    start, stop = columns["raw_action"], columns["reward"]
    rows = rows.at[..., start:stop].set(jnp.concatenate(collected, -1))
    order = jnp.arange(_UNROLLS, dtype=jnp.int32)
    data = rows, last, order[None], noise[:1], index
    gradient = launch.gradient(*network, *data, jnp.asarray(_TERMS))
    # Any vectors serve as gradient and moments of Adam.
    progress = np.zeros((2, SIZES["progress"]), np.float32)
    progress[0, :3] = _RATE, 1, 1
    adam_terms = np.zeros(SIZES["adam_terms"], np.float32)
    adam_terms[0] = _MOST_NORM
    arguments = params, params, params, abs(params), progress, index, adam_terms
    return gradient, actions, launch.adam(_RULE, *map(jnp.asarray, arguments))
