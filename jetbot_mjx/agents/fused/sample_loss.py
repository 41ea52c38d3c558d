"""Define the action of one sample and PPO's loss as JAX functions, which the kernels lower.

A sample is one step of one environment. Its outputs of the policy network, and the standard
deviations if they are parameters, are the normal distribution N(μ, σ) of the action before its
tanh. The loss of a minibatch, which `jetbot_mjx.agents.ppo` states, is the mean of these terms of
its samples:

    L_policy  = -min(ρ Â, clip(ρ, 1 - ε, 1 + ε) Â)
    L_value   = ½ c_v (V' - V)²
    L_entropy = -c_e H

JAX differentiates them, and `onekernel` lowers the loss with its derivatives, for CPUs and for
GPUs. The functions know nothing of batches, networks and memory.

Source: J. Schulman et al., Proximal Policy Optimization Algorithms, arXiv:1707.06347; formulas as
in `brax.training.agents.ppo.losses` and `brax.training.distribution`.
"""

import functools
import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jetbot_mjx.agents.fused.shapes import LossTerms, UpdateShape
from jetbot_mjx.agents.gae import gae_step, td_error
from onekernel.build import ScalarProgram, scalarize

_MIN_STD = 0.001
_HALF_LOG_TWO_PI = 0.5 * math.log(2 * math.pi)


def activation(name: str, z: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return an activation and its derivative, for CPUs.

    A GPU has instructions of its own for them: see `gpu_network`.

    Args:
      name: its name in `ppo.network.activation`.
      z: the weighted sum of a unit.
    """
    return jax.value_and_grad(getattr(jax.nn, name))(z)


# The distribution of an action.


class ActionDistribution(NamedTuple):
    """An `ActionDistribution` is the normal distribution of an action, before its tanh if any."""

    mean: Float[Array, " actions"]
    std: Float[Array, " actions"]
    """Standard deviations."""
    tanh: bool
    """Whether the action is the tanh of the normal number, as for `tanh_normal`."""

    @classmethod
    def of(cls, outputs: Array, deviations: Array, tanh: bool) -> "ActionDistribution":
        """Return the distribution that outputs of the policy network stand for.

        Args:
          outputs: the outputs: means and, for `tanh_normal`, what the deviations follow from.
          deviations: the standard deviations otherwise.
          tanh: whether the distribution is `tanh_normal`.
        """
        actions = len(deviations)
        std = _softplus(outputs[actions:]) + _MIN_STD if tanh else deviations
        return cls(outputs[:actions], std, tanh)

    def draw(self, noise: Array) -> Array:
        """Return the number before the tanh, by standard normal noise."""
        return noise * self.std + self.mean

    def log_prob(self, raw: Array) -> Float[Array, ""]:
        """Return the logarithm of the probability of an action, given before its tanh."""
        distance = (raw - self.mean) * (1.0 / self.std)
        logs = -0.5 * jnp.square(distance) - jnp.log(self.std) - _HALF_LOG_TWO_PI
        # A tanh makes the density larger by 1 / slope.
        return (logs - _log_tanh_slope(raw)).sum() if self.tanh else logs.sum()

    def entropy(self, noise: Array) -> Float[Array, ""]:
        """Return the entropy; that of the tanh is estimated from one number drawn by noise."""
        entropy = jnp.log(self.std) + (0.5 + _HALF_LOG_TWO_PI)
        return (entropy + _log_tanh_slope(self.draw(noise))).sum() if self.tanh else entropy.sum()

    def divergence(self, old: "ActionDistribution") -> Float[Array, ""]:
        """Return the KL divergence from another distribution, which a tanh does not change."""
        inverse, difference = 1.0 / self.std, old.mean - self.mean
        square = old.std * old.std + difference * difference
        log = jnp.log(self.std / old.std + 1e-5)
        return (log + 0.5 * square * inverse * inverse - 0.5).sum()


@jax.custom_jvp
def _softplus(x: Array) -> Array:
    """Return log(1 + eˣ) without overflow."""
    return jnp.maximum(x, 0.0) + jnp.log1p(jnp.exp(-jnp.abs(x)))


@_softplus.defjvp
def _softplus_jvp(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    # The derivative is the logistic function. JAX's own softplus computes it by a second exp.
    (x,), (tangent,) = primals, tangents
    exp = jnp.exp(-jnp.abs(x))
    return _softplus(x), jnp.where(x >= 0.0, 1.0, exp) / (1.0 + exp) * tangent


def _log_tanh_slope(x: Array) -> Array:
    """Return the logarithm of the derivative of tanh, log(1 - tanh² x), without cancellation."""
    return 2.0 * (math.log(2.0) - x - _softplus(-2.0 * x))


# Drawing an action.


def draw_action(
    outputs: Array, deviations: Array, noise: Array, *, tanh: bool
) -> tuple[Array, Array, Array, Array]:
    """Draw an action.

    Args:
      outputs: the outputs of the policy network.
      deviations: the standard deviations that are parameters; without meaning for `tanh_normal`.
      noise: standard normal noise.
      tanh: whether the distribution is `tanh_normal`.

    Returns:
      The action, the action before its tanh, the logarithm of its probability, and the parameters
      of the distribution.
    """
    policy = ActionDistribution.of(outputs, deviations, tanh)
    raw = policy.draw(noise)
    # Not from the noise, which would be shorter: the loss knows the rounded action only, and its
    # logarithm is to be the same as long as the policy is.
    log_prob = policy.log_prob(raw)
    if tanh:
        return jnp.tanh(raw), raw, log_prob, outputs
    return raw, raw, log_prob, jnp.concatenate([policy.mean, policy.std])


# The loss of the policy network.


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
    old_parameters: Float[Array, " 2*actions"]
    """Parameters of the distribution in the collection."""
    noise: Float[Array, " actions"]
    """Standard normal noise, which estimates the entropy."""
    advantage: Float[Array, ""]
    """The advantage, normalised if configured."""
    weight: Float[Array, ""]
    """1, or 0 if there is no such sample."""


def policy_and_entropy_loss(
    outputs: Array, deviations: Array, sample: PolicySample, terms: LossTerms, *, tanh: bool
) -> tuple[Float[Array, ""], tuple[Float[Array, ""], ...]]:
    """Compute L_policy + L_entropy of one sample.

    Args:
      outputs: those of the sample, with respect to which the loss is differentiated.
      deviations: likewise.
      sample: the sample.
      terms: the coefficients of the loss.
      tanh: whether the distribution is `tanh_normal`.

    Returns:
      L_policy + L_entropy, and the metrics of `POLICY_METRICS`.
    """
    policy = ActionDistribution.of(outputs, deviations, tanh)
    parameters = sample.old_parameters
    old = ActionDistribution.of(parameters, parameters[len(deviations) :], tanh)
    # The clipped surrogate objective, -L_policy. Where the clipped one is smaller, the ratio ρ is
    # outside of the range, and the objective does not depend on the policy.
    ratio = jnp.exp(policy.log_prob(sample.action) - sample.log_prob)
    low, high = 1.0 - terms.clipping_epsilon, 1.0 + terms.clipping_epsilon
    surrogate = ratio * sample.advantage
    clipped = jax.lax.stop_gradient(jnp.clip(ratio, low, high) * sample.advantage)
    objective = jnp.where(surrogate <= clipped, surrogate, clipped)
    # The entropy bonus, -L_entropy.
    entropy = policy.entropy(sample.noise)
    loss = -objective - terms.entropy_cost * entropy
    # The metrics: beside both, how far the policy is from that of the collection, and how wide.
    return loss, (-objective, entropy, policy.divergence(old), policy.std.sum())


def policy_gradient(
    sample: PolicySample, terms: LossTerms, *, samples: int, tanh: bool
) -> tuple[Array, ...]:
    """Return a sample's part of the gradient of L_policy + L_entropy, and the sample's metrics.

    Args:
      sample: the sample.
      terms: the coefficients of the loss.
      samples: the number of samples of the minibatch, of whose losses the mean is taken.
      tanh: whether the distribution is `tanh_normal`.

    Returns:
      The derivatives with respect to the outputs and to the deviations (none for `tanh_normal`),
      and the metrics of `POLICY_METRICS`.
    """

    def scaled_loss(outputs: Array, deviations: Array) -> tuple[Array, tuple[Array, ...]]:
        loss, metrics = policy_and_entropy_loss(outputs, deviations, sample, terms, tanh=tanh)
        return loss * (sample.weight / samples), metrics

    gradient = jax.grad(scaled_loss, argnums=(0, 1), has_aux=True)
    (d_outputs, d_deviations), metrics = gradient(sample.outputs, sample.deviations)
    metrics = tuple(x * sample.weight for x in metrics)
    return (d_outputs, *metrics) if tanh else (d_outputs, d_deviations, *metrics)


# The loss of the value network.


class ValueStep(NamedTuple):
    """A `ValueStep` holds what the error of a step's value depends on."""

    value: Float[Array, ""]
    reward: Float[Array, ""]
    discount: Float[Array, ""]
    truncation: Float[Array, ""]
    next_value: Float[Array, ""]
    """The value after the step, or its target."""


def value_error(step: ValueStep, terms: LossTerms) -> tuple[Array, Array]:
    """Return δₜ of the equations that `jetbot_mjx.agents.gae` states, and the factor of Aₜ₊₁.

    Args:
      step: the step; with the next target V'ₜ₊₁ as its `next_value`, δₜ becomes the advantage Âₜ.
      terms: the coefficients of the loss.
    """
    not_truncated = 1.0 - step.truncation
    termination = (1.0 - step.discount) * not_truncated
    discount = terms.discounting * (1.0 - termination)
    reward = step.reward * terms.reward_scaling
    delta = td_error(reward, discount, step.value, step.next_value, not_truncated)
    return delta, discount * not_truncated * terms.gae_lambda


def value_gradient(
    value: Array, target: Array, coefficient: Array, samples: int
) -> tuple[Array, ...]:
    """Return the derivative of L_value with respect to one value, and the squared error.

    Args:
      value: V.
      target: V', on which no gradient depends.
      coefficient: c_v.
      samples: the number of samples of the minibatch, of whose losses the mean is taken.
    """

    def scaled_loss(value: Array) -> tuple[Array, Array]:
        square = jnp.square(target - value)
        return 0.5 * square * coefficient * (1.0 / samples), square

    return jax.grad(scaled_loss, has_aux=True)(value)


def value_step(
    step: ValueStep, next_target: Array, next_gae: Array, terms: LossTerms, *, samples: int
) -> tuple[Array, ...]:
    """Return the estimates of a step and its loss, for a run backwards through an unroll.

    Args:
      step: the step.
      next_target: the value target V'ₜ₊₁ of the next step.
      next_gae: the generalised advantage estimate Aₜ₊₁ of the next step.
      terms: the coefficients of the loss.
      samples: the number of samples of the minibatch.

    Returns:
      The advantage Âₜ, the derivative of L_value with respect to the value, the squared error, and
      for the step before this one Vₜ, V'ₜ and Aₜ.
    """
    delta, factor = value_error(step, terms)
    gae = gae_step(delta, factor, next_gae)
    target = gae + step.value
    advantage, _ = value_error(step._replace(next_value=next_target), terms)
    error, square = value_gradient(step.value, target, terms.vf_loss_coefficient, samples)
    return advantage, error, square, step.value, target, gae


# The programs of the kernels, functions of the scalars of their arguments in order. Those of GPUs
# have approximate instructions for exp, log and 1/x.


def vector_of(*sizes: int) -> Any:
    """Return a shape that stands for an array among the arguments of a function of one sample."""
    return jax.ShapeDtypeStruct(sizes, jnp.float32)


_TERMS = LossTerms(*[vector_of()] * len(LossTerms._fields))
_STEP = ValueStep(*[vector_of()] * len(ValueStep._fields))


@functools.cache
def action_program(shape: UpdateShape, *, for_gpu: bool = False) -> ScalarProgram:
    """Lower `draw_action`."""
    draw = functools.partial(draw_action, tanh=shape.distribution == "tanh_normal")
    sizes = shape.outputs[0], shape.actions, shape.actions
    return scalarize(draw, *map(vector_of, sizes), approximate=for_gpu)


@functools.cache
def policy_program(shape: UpdateShape, samples: int, *, for_gpu: bool = False) -> ScalarProgram:
    """Lower `policy_gradient`."""
    each, number = vector_of(shape.actions), vector_of()
    outputs, old = vector_of(shape.outputs[0]), vector_of(2 * shape.actions)
    sample = PolicySample(outputs, each, each, number, old, each, number, number)
    tanh = shape.distribution == "tanh_normal"
    loss = functools.partial(policy_gradient, samples=samples, tanh=tanh)
    return scalarize(loss, sample, _TERMS, approximate=for_gpu)


def value_step_program(samples: int) -> ScalarProgram:
    """Lower `value_step`."""
    step = functools.partial(value_step, samples=samples)
    return scalarize(step, _STEP, vector_of(), vector_of(), _TERMS)


def value_error_program() -> ScalarProgram:
    """Lower `value_error` for GPUs."""
    return scalarize(value_error, _STEP, _TERMS, approximate=True)


def gae_program() -> ScalarProgram:
    """Lower `gae_step` for GPUs."""
    return scalarize(gae_step, *[vector_of()] * 3, approximate=True)


def value_program(samples: int) -> ScalarProgram:
    """Lower `value_gradient` for GPUs."""
    loss = functools.partial(value_gradient, samples=samples)
    return scalarize(loss, *[vector_of()] * 3, approximate=True)
