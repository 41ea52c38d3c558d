"""Define the action of one sample and PPO's loss, with its derivatives, for the kernels on CPUs.

These are JAX functions of scalars and short vectors, which `lower_jaxpr` lowers. The loss is that
of `brax.training.agents.ppo.losses`, the distributions those of `brax.training.distribution`.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jetbot_mjx.compiler.update.shapes import LossTerms

_MIN_STD = 0.001
_HALF_LOG_TWO_PI = 0.5 * math.log(2 * math.pi)


def activation(name: str, z: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return an activation and its derivative.

    Args:
      name: its name in `ppo.network.activation`.
      z: the weighted sum of a unit.
    """
    if name == "tanh":
        value = jnp.tanh(z)
        return value, 1.0 - value * value
    if name == "relu":
        return jnp.maximum(z, 0.0), jnp.where(z > 0.0, 1.0, 0.0)
    if name == "elu":
        grown = jnp.expm1(jnp.minimum(z, 0.0))
        return jnp.where(z > 0.0, z, grown), jnp.where(z > 0.0, 1.0, grown + 1.0)
    gate = _sigmoid(z)
    value = z * gate
    return value, gate + value * (1.0 - gate)


class ActionSample(NamedTuple):
    """An `ActionSample` holds what an action of the collection depends on."""

    outputs: Float[Array, " outputs"]
    """Outputs of the policy network."""
    deviations: Float[Array, " actions"]
    """The standard deviations that are parameters; without meaning for `tanh_normal`."""
    noise: Float[Array, " actions"]
    """Standard normal noise."""


def action_sample(sample: ActionSample, *, tanh: bool) -> tuple[Array, Array, Array, Array]:
    """Draw an action.

    Args:
      sample: the sample.
      tanh: whether the distribution is `tanh_normal`.

    Returns:
      The action, the action before its tanh, the logarithm of its probability, and the parameters
      of the distribution.
    """
    outputs, deviations, noise = sample
    mean, scale = _distribution(outputs, deviations, tanh)
    raw = noise * scale + mean
    log_prob = _density(raw, mean, scale, tanh).log_probs.sum()
    if tanh:
        return jnp.tanh(raw), raw, log_prob, outputs
    return raw, raw, log_prob, jnp.concatenate([mean, scale])


class PolicySample(NamedTuple):
    """A `PolicySample` holds what the policy's loss of a sample depends on."""

    outputs: Float[Array, " outputs"]
    """Outputs of the policy network."""
    deviations: Float[Array, " actions"]
    """The standard deviations that are parameters; without meaning for `tanh_normal`."""
    action: Float[Array, " actions"]
    """The action before its tanh."""
    log_prob: Float[Array, ""]
    """Logarithm of its probability in the collection."""
    old: Float[Array, " 2*actions"]
    """Parameters of the distribution in the collection."""
    noise: Float[Array, " actions"]
    """Standard normal noise, which estimates the entropy."""
    advantage: Float[Array, ""]
    """The advantage, normalised if configured."""
    weight: Float[Array, ""]
    """1, or 0 if there is no such sample."""


def policy_sample(
    sample: PolicySample, terms: LossTerms, *, samples: int, tanh: bool
) -> tuple[Array, ...]:
    """Return the derivatives of the policy's loss by one sample, and the sample's metrics.

    Args:
      sample: the sample.
      terms: the coefficients of the loss.
      samples: the number of samples of the minibatch.
      tanh: whether the distribution is `tanh_normal`.

    Returns:
      The derivatives by the outputs, by the deviations (none for `tanh_normal`), and the metrics of
      `POLICY_METRICS`.
    """
    outputs, deviations, action, log_prob, old, noise, advantage, weight = sample
    mean, scale = _distribution(outputs, deviations, tanh)
    old_mean, old_scale = _distribution(old, old[len(action) :], tanh)
    # The clipped surrogate objective.
    inverse, log_scale, distance, log_probs = _density(action, mean, scale, tanh)
    ratio = jnp.exp(log_probs.sum() - log_prob)
    bounds = 1.0 - terms.clipping_epsilon, 1.0 + terms.clipping_epsilon
    clipped, surrogate = jnp.clip(ratio, *bounds) * advantage, ratio * advantage
    by_log = jnp.where(surrogate <= clipped, surrogate, 0.0) * (-weight / samples)
    by_mean = by_log * distance * inverse
    by_scale = by_log * (distance * distance - 1.0) * inverse
    # The entropy, of a sample of the current policy.
    cost = weight * terms.entropy_cost * (-1.0 / samples)
    entropy = log_scale + (0.5 + _HALF_LOG_TWO_PI)
    by_scale += inverse * cost
    if tanh:
        drawn = noise * scale + mean
        entropy += _log_slope(drawn)
        slope = (4.0 * _sigmoid(-2.0 * drawn) - 2.0) * cost
        by_mean, by_scale = by_mean + slope, by_scale + slope * noise
    # The divergence of the current distribution from that of the collection.
    square = old_scale * old_scale + (old_mean - mean) * (old_mean - mean)
    divergence = jnp.log(scale / old_scale + 1e-5) + 0.5 * square * inverse * inverse - 0.5
    metrics = (
        -jnp.minimum(surrogate, clipped) * weight,
        entropy.sum() * weight,
        divergence.sum() * weight,
        scale.sum() * weight,
    )
    if tanh:
        slopes = _sigmoid(outputs[len(action) :])
        return jnp.concatenate([by_mean, by_scale * slopes]), *metrics
    return by_mean, by_scale, *metrics


class _Density(NamedTuple):
    """A `_Density` holds the logarithms of the probabilities of an action, and their parts."""

    inverse: Array
    log_scale: Array
    distance: Array
    log_probs: Array


def _density(action: Array, mean: Array, scale: Array, tanh: bool) -> _Density:
    """Return the logarithms of the probabilities of an action before its tanh."""
    inverse, log_scale = 1.0 / scale, jnp.log(scale)
    distance = (action - mean) * inverse
    log_probs = -0.5 * distance * distance - log_scale - _HALF_LOG_TWO_PI
    if tanh:
        log_probs -= _log_slope(action)
    return _Density(inverse, log_scale, distance, log_probs)


def _distribution(outputs: Array, deviations: Array, tanh: bool) -> tuple[Array, Array]:
    """Return mean and standard deviation of the action before its tanh."""
    actions = len(deviations)
    return outputs[:actions], _softplus(outputs[actions:]) + _MIN_STD if tanh else deviations


class ValueStep(NamedTuple):
    """A `ValueStep` holds what the value loss of a step depends on, besides what follows it."""

    value: Float[Array, ""]
    reward: Float[Array, ""]
    discount: Float[Array, ""]
    truncation: Float[Array, ""]
    next_value: Float[Array, ""]
    next_target: Float[Array, ""]
    next_estimate: Float[Array, ""]
    """The generalised advantage estimate of the next step."""


def value_step(step: ValueStep, terms: LossTerms, samples: int) -> tuple[Array, ...]:
    """Return the estimates of a step by the equation of `jetbot_mjx.agents.gae`, and its loss.

    Args:
      step: the step.
      terms: the coefficients of the loss.
      samples: the number of samples of the minibatch.

    Returns:
      The advantage, the derivative of the loss by the value, the squared error, and for the step
      before this one the value, the target and the estimate.
    """
    kept = 1.0 - step.truncation
    termination = (1.0 - step.discount) * kept
    future = terms.discounting * (1.0 - termination)
    reward = step.reward * terms.reward_scaling
    delta = (reward + future * step.next_value - step.value) * kept
    estimate = delta + future * kept * terms.gae_lambda * step.next_estimate
    target = estimate + step.value
    advantage = (reward + future * step.next_target - step.value) * kept
    error = step.value - target
    slope = error * terms.vf_loss_coefficient * (1.0 / samples)
    return advantage, slope, error * error, step.value, target, estimate


def _sigmoid(x: Array) -> Array:
    return 1.0 / (1.0 + jnp.exp(-x))


def _softplus(x: Array) -> Array:
    return jnp.maximum(x, 0.0) + jnp.log1p(jnp.exp(-jnp.abs(x)))


def _log_slope(x: Array) -> Array:
    """Return the logarithm of the derivative of tanh."""
    return 2.0 * (math.log(2.0) - x - _softplus(-2.0 * x))


def vector_of(*sizes: int) -> Any:
    """Return the shape of an argument of a function of one sample."""
    return jax.ShapeDtypeStruct(sizes, jnp.float32)
