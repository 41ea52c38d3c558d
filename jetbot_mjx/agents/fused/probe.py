"""Check the kernels of PPO on this machine before a training relies on them.

The check is a few actions, a small gradient and a step of Adam, compared with those of `reference`.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from jetbot_mjx.agents.fused import adam, launch, reference
from jetbot_mjx.agents.fused.adam import AdamRule
from jetbot_mjx.agents.fused.arrays import ADAM, Actions
from jetbot_mjx.agents.fused.shapes import LossTerms, UpdateShape

_SHAPE = UpdateShape(4, 16, 1, 1, "tanh_normal", "tanh", normalizes=False)
_TERMS = LossTerms(0.2, 0.01, 1.0, 0.9, 0.9, 1.0)
_UNROLLS, _TIME = 8, 4
_RULE = AdamRule(_SHAPE, _UNROLLS * _TIME, "NONE", steps=1)
_MOST_NORM, _RATE = 0.3, 0.01
_MOST_ERROR = 0.01
"""Largest difference of the gradients, relative to their norm, and of actions and logarithms of
probabilities; GPUs have products of float16."""


@functools.cache
def runs_correctly() -> bool:
    """Return whether the kernels draw actions, compute a gradient and make a step correctly."""
    # Without a back end there is nothing to check.
    backend = launch.backend()
    if backend.obstacle():
        return False
    data = params, rows, _, noise = _data()
    # What the kernels should compute.
    gradient = reference.gradient(_SHAPE, _TERMS, *data)
    observations = rows[:, 0, : _SHAPE.observations]
    actions = reference.actions(_SHAPE, params, observations, noise[0])
    # What they compute, as a new function each time, for which JAX has traced nothing yet.
    arrays = [np.asarray(x, np.float32) for x in data]
    with jax.default_device(jax.local_devices(backend=backend.PLATFORM)[0]):
        try:
            result, drawn, stepped = jax.jit(functools.partial(_run))(*jax.device_put(arrays))
        except jax.errors.JaxRuntimeError:
            return False
        ours = np.asarray(result, np.float64)
        updated = reference.adam_step(_RULE, _adam_arrays(params, ours))
        pairs = [*zip(drawn, actions, strict=True), *zip(stepped, updated, strict=True)]
        errors = [np.abs(np.asarray(one) - other).max() for one, other in pairs]
    # Beside the gradient, the vector has the sums of the metrics, which are no derivatives.
    ours[_RULE.places] = 0.0
    errors.append(np.linalg.norm(ours - gradient) / np.linalg.norm(gradient))
    # A comparison with NaN is false, so that NaN fails the check.
    return all(bool(error <= _MOST_ERROR) for error in errors)


def _data() -> tuple[np.ndarray, ...]:
    """Draw parameters, unrolls in which no episode ends, what follows them, and noise."""
    rng, columns = np.random.default_rng(0), _SHAPE.columns
    params = 0.3 * rng.standard_normal(_SHAPE.size)
    rows = rng.standard_normal((_UNROLLS, _TIME, columns["size"]))
    rows[..., columns["discount"] :] = 1.0, 0.0
    last = rng.standard_normal((_UNROLLS, _SHAPE.observations))
    noise = rng.standard_normal((2, _TIME, _UNROLLS, _SHAPE.actions))
    # The policy that collects is the one that learns, so nothing is clipped.
    observations = rows[..., : _SHAPE.observations]
    drawn = reference.actions(_SHAPE, params, observations, noise[1].swapaxes(0, 1))
    collected = [x.reshape(_UNROLLS, _TIME, -1) for x in drawn[1:]]
    rows[..., columns["raw_action"] : columns["reward"]] = np.concatenate(collected, -1)
    return params, rows, last, noise[0]


def _adam_arrays(params: Array | np.ndarray, gradient: Array | np.ndarray) -> dict[str, PyTree]:
    """Return what a step of Adam takes; any vectors serve as the means."""
    progress = np.zeros((2, adam.SIZES["progress"]), np.float32)
    progress[0, :3] = _RATE, 1, 1
    terms = np.zeros(adam.SIZES["adam_terms"], np.float32)
    terms[0] = _MOST_NORM
    arrays = gradient, params, params, abs(params), progress, np.zeros((), np.int32), terms
    return dict(zip(ADAM.arguments, arrays, strict=True))


def _run(
    params: Array, rows: Array, last: Array, noise: Array
) -> tuple[Array, Actions, tuple[Array, ...]]:
    """Return a gradient, the actions of the first steps, and a step of Adam, by the kernels."""
    # The observations stay as they are.
    statistics = jnp.zeros(_SHAPE.observations), jnp.ones(_SHAPE.observations)
    network, index = (_SHAPE, params, *statistics), jnp.zeros((), jnp.int32)
    order = jnp.arange(_UNROLLS, dtype=jnp.int32)
    given = rows, last, order[None], noise[None], index
    gradient = launch.gradient(*network, *given, jnp.asarray(_TERMS))
    actions = launch.actions(*network, rows[:, 0, : _SHAPE.observations], noise[0])
    arrays = map(jnp.asarray, _adam_arrays(params, gradient).values())
    return gradient, actions, launch.adam(_RULE, *arrays)
