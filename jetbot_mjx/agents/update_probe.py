"""Check the kernels of PPO on this machine before a training relies on them.

The check is a few actions, a small gradient and a step of Adam, compared with NumPy and central
differences of the loss, since XLA would take longer to compile them than a training takes to begin.
"""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jetbot_mjx.compiler.update import adam, launch
from jetbot_mjx.compiler.update.adam import AdamRule
from jetbot_mjx.compiler.update.shapes import LossTerms, UpdateShape

_SHAPE = UpdateShape(4, 16, 1, 1, "tanh_normal", "tanh", normalizes=False)
_TERMS = LossTerms(0.2, 0.01, 1.0, 0.9, 0.9, 1.0)
_UNROLLS, _TIME = 8, 4
_RULE = AdamRule(_SHAPE, _UNROLLS * _TIME, "NONE", steps=1)
_MOST_NORM, _RATE = 0.3, 0.01
_MOST_ERROR = 0.01
"""Largest difference of the gradients, relative to their norm, and of actions and logarithms of
probabilities; GPUs have products of float16."""
_STEP = 1e-4


@functools.cache
def runs_correctly() -> bool:
    """Return whether the kernels draw actions, compute a gradient and make a step correctly."""
    backend = launch.backend()
    if backend.obstacle():
        return False
    rng = np.random.default_rng(0)
    params = 0.3 * rng.standard_normal(_SHAPE.size)
    rows = rng.standard_normal((_UNROLLS, _TIME, _SHAPE.columns["size"]))
    rows[..., _SHAPE.columns["discount"] :] = 1.0, 0.0
    last = rng.standard_normal((_UNROLLS, _SHAPE.observations))
    noise = rng.standard_normal((_TIME, _UNROLLS, _SHAPE.actions))
    mean, scale, _ = _outputs(params, rows)
    rows[..., _SHAPE.columns["log_prob"]] = _log_prob(mean, scale, rows)
    estimates = _estimates(params, rows, last)
    expected = np.zeros(_SHAPE.size)
    for i in range(_SHAPE.size):
        shift = _STEP * (np.arange(_SHAPE.size) == i)
        higher, lower = (_loss(x, rows, noise, estimates) for x in (params + shift, params - shift))
        expected[i] = (higher - lower) / (2 * _STEP)
    # The actions of the first step of each unroll.
    raw = mean[:, 0] + scale[:, 0] * noise[0]
    drawn = rows[:, 0].copy()
    drawn[:, _SHAPE.columns["raw_action"] :][:, : _SHAPE.actions] = raw
    log_prob = _log_prob(mean[:, 0], scale[:, 0], drawn)

    def run(params: Array, rows: Array, last: Array, order: Array, noise: Array) -> Any:
        statistics = jnp.zeros(_SHAPE.observations), jnp.ones(_SHAPE.observations)
        network = _SHAPE, params, *statistics
        given = rows, last, order[None], noise[None], jnp.zeros((), jnp.int32)
        gradient = launch.gradient(*network, *given, jnp.asarray(_TERMS))
        observations = rows[:, 0, : _SHAPE.observations]
        # Any vector serves as the means.
        state = gradient, params, params, jnp.abs(params), jnp.asarray(progress), given[-1]
        stepped = launch.adam(_RULE, *state, jnp.asarray(adam_terms))
        return gradient, launch.actions(*network, observations, noise[0]), stepped

    progress = np.zeros((2, adam.SIZES["progress"]), np.float32)
    progress[0, :3] = _RATE, 1, 1
    adam_terms = np.zeros(adam.SIZES["adam_terms"], np.float32)
    adam_terms[0] = _MOST_NORM
    order = np.arange(_UNROLLS, dtype=np.int32)
    arrays = [np.asarray(x, np.float32) for x in (params, rows, last)]
    arguments = *arrays, order, np.asarray(noise, np.float32)
    with jax.default_device(jax.local_devices(backend=backend.PLATFORM)[0]):
        try:
            result, actions, stepped = jax.jit(run)(*jax.device_put(arguments))
        except jax.errors.JaxRuntimeError:
            return False
        # Beside the gradient, the vector has the sums of the metrics, on which nothing depends.
        ours = np.where(expected == 0, 0, np.asarray(result, np.float64))
        outputs = _network(params, _SHAPE.outputs[0], rows[:, 0, : _SHAPE.observations])
        drawn_right = np.tanh(raw), raw, log_prob, outputs
        errors = [
            np.abs(np.asarray(one) - other).max()
            for one, other in zip(actions, drawn_right, strict=True)
        ]
        errors += [
            np.abs(np.asarray(one) - other).max()
            for one, other in zip(stepped, _step(params, ours, np.asarray(stepped[3])), strict=True)
        ]
    errors.append(np.linalg.norm(ours - expected) / np.linalg.norm(expected))
    # What is no number is not smaller.
    return all(bool(error <= _MOST_ERROR) for error in errors)


def _step(params: np.ndarray, gradient: np.ndarray, progress: np.ndarray) -> list[np.ndarray]:
    """Return what `launch.adam` does; of the progress, what does not depend on the metrics."""
    clipped = gradient * min(1.0, _MOST_NORM / np.linalg.norm(gradient))
    is_parameter = np.ones(_SHAPE.size, bool)
    is_parameter[_RULE.places] = False
    one, two = adam.BETA_1, adam.BETA_2
    mu = np.where(is_parameter, one * params + (1 - one) * clipped, params)
    nu = np.abs(params)
    nu = np.where(is_parameter, two * nu + (1 - two) * clipped**2, nu)
    change = _RATE * mu / (1 - one) / (np.sqrt(nu / (1 - two)) + 1e-8)
    after = progress.copy()
    after[0, :3], after[1, :3], after[1, -2:] = (_RATE, 1, 1), (_RATE, one, two), (_RATE, 1)
    return [np.where(is_parameter, params - change, params), mu, nu, after]


def _network(params: np.ndarray, outputs: int, x: np.ndarray) -> np.ndarray:
    """Return the outputs of the network whose parameters come first."""
    inputs, width, start = _SHAPE.observations, _SHAPE.width, 0
    for size in (width, outputs):
        weights = params[start : start + inputs * size].reshape(inputs, size)
        start += inputs * size
        x = x @ weights + params[start : start + size]
        start, inputs = start + size, size
        x = np.tanh(x) if size == width else x
    return x


def _outputs(params: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mean and standard deviation of the actions, and the values."""
    observation = rows[..., : _SHAPE.observations]
    mean, raw = np.split(_network(params, _SHAPE.outputs[0], observation), 2, axis=-1)
    values = _network(params[_SHAPE.policy_size :], 1, observation)[..., 0]
    return mean, np.logaddexp(raw, 0) + 0.001, values


def _log_slope(x: np.ndarray) -> np.ndarray:
    return 2 * (np.log(2) - x - np.logaddexp(-2 * x, 0))


def _log_prob(mean: np.ndarray, scale: np.ndarray, rows: np.ndarray) -> np.ndarray:
    start = _SHAPE.columns["raw_action"]
    action = rows[..., start : start + _SHAPE.actions]
    normal = -0.5 * ((action - mean) / scale) ** 2 - np.log(scale) - 0.5 * np.log(2 * np.pi)
    return (normal - _log_slope(action)).sum(-1)


def _estimates(
    params: np.ndarray, rows: np.ndarray, last: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return advantages and value targets of unrolls in which no episode ends."""
    following = _network(params[_SHAPE.policy_size :], 1, last)[..., 0]
    values, reward = _outputs(params, rows)[2], rows[..., _SHAPE.columns["reward"]]
    ahead = np.concatenate([values[:, 1:], following[:, None]], axis=1)
    deltas, total = reward + _TERMS.discounting * ahead - values, 0.0
    targets = values.copy()
    for t in reversed(range(_TIME)):
        total = deltas[:, t] + _TERMS.discounting * _TERMS.gae_lambda * total
        targets[:, t] += total
    ahead = np.concatenate([targets[:, 1:], following[:, None]], axis=1)
    return reward + _TERMS.discounting * ahead - values, targets


def _loss(
    params: np.ndarray,
    rows: np.ndarray,
    noise: np.ndarray,
    estimates: tuple[np.ndarray, np.ndarray],
) -> float:
    """Return PPO's loss near the policy of the collection, where nothing is clipped."""
    mean, scale, values = _outputs(params, rows)
    advantages, targets = estimates
    log_ratio = _log_prob(mean, scale, rows) - rows[..., _SHAPE.columns["log_prob"]]
    sample = noise.swapaxes(0, 1) * scale + mean
    entropy = (0.5 + 0.5 * np.log(2 * np.pi) + np.log(scale) + _log_slope(sample)).sum(-1)
    terms = -np.exp(log_ratio) * advantages - _TERMS.entropy_cost * entropy
    return float(np.mean(terms + 0.5 * _TERMS.vf_loss_coefficient * (targets - values) ** 2))
