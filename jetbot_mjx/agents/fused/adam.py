"""Define a step of Adam along a gradient, with all that a training counts, as JAX functions.

Equation, with the gradient g clipped to a global norm, as `optax.adam` has it:

    m' = β₁ m + (1 - β₁) g,    v' = β₂ v + (1 - β₂) g²
    p' = p - η (m' / (1 - β₁ⁿ)) / (√(v' / (1 - β₂ⁿ)) + 10⁻⁸)

for the n-th step, of size η. The moments, m (`mu`) and v (`nu`), are moving averages of the
gradients and of their squares, and 1 / (1 - βⁿ) corrects the bias of their beginning at zero. A
step whose gradient is not finite is left out. The powers of β are carried from step to step.

`cpu_adam` and `gpu_adam` lower `factors` and `element` for a kernel.
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jetbot_mjx.agents.fused.sample_loss import vector_of
from jetbot_mjx.agents.fused.shapes import POLICY_METRICS, VALUE_METRICS, UpdateShape
from onekernel.build import ScalarProgram, scalarize

BETA_1, BETA_2 = 0.9, 0.999
_EPSILON = 1e-8

METRICS = (*POLICY_METRICS, *VALUE_METRICS)

Scalar = Array | float


class AdamRule(NamedTuple):
    """An `AdamRule` says what the vectors hold, and how the step size changes."""

    shape: UpdateShape
    samples: int
    """Number of samples of a minibatch."""
    schedule: str
    """One of `ppo.learning_rate_schedule`."""
    steps: int
    """Steps of Adam, which are minibatches, in a training step."""

    @property
    def metric_places(self) -> list[int]:
        """Return where the gradient's vector has the sums of `METRICS`."""
        ends = [(self.shape.policy_size, POLICY_METRICS), (self.shape.size, VALUE_METRICS)]
        return [end - len(names) + i for end, names in ends for i in range(len(names))]


class AdamTerms(NamedTuple):
    """An `AdamTerms` holds what does not change during a training step.

    The kernels read them from an array, because replicas may have different ones.
    """

    max_grad_norm: Scalar
    learning_rate: Scalar
    """Size of the first step of all, for the schedule `LINEAR`."""
    fraction_done: Scalar
    """Fraction of the training's steps that were made before this training step."""
    fraction_per_step: Scalar
    """Fraction of the training's steps that one step is."""
    desired_kl: Scalar
    min_rate: Scalar
    max_rate: Scalar


class Progress(NamedTuple):
    """A `Progress` holds what a step of Adam carries on beside the vectors."""

    rate: Scalar
    """Step size."""
    power_1: Scalar
    """Power of β₁ whose exponent is the number of steps."""
    power_2: Scalar
    sums: Sequence[Scalar]
    """Sums of each of the `METRICS` over the samples of all steps of this training step so far, but
    for those that were left out."""
    rates: Scalar
    """Sum of the sizes of these steps."""
    applied: Scalar
    """Number of these steps."""


class Factors(NamedTuple):
    """A `Factors` holds what all elements of the vectors have in common."""

    is_applied: Array
    """1, or 0 if the gradient is not finite."""
    clipping: Array
    """What the gradient is multiplied by."""
    rate: Array
    correction_1: Array
    """1 / (1 - β₁ⁿ)."""
    correction_2: Array


SIZES = {"adam_terms": len(AdamTerms._fields), "progress": len(Progress._fields) - 1 + len(METRICS)}
"""Lengths of the arrays of `AdamTerms` and `Progress`."""


@functools.cache
def programs(rule: AdamRule) -> tuple[ScalarProgram, ScalarProgram]:
    """Lower `factors` and `element` to programs on scalars.

    Args:
      rule: what the vectors hold.
    """
    scalar, metrics = vector_of(), vector_of(len(METRICS))
    arrays = vector_of(SIZES["progress"]), vector_of(SIZES["adam_terms"])
    common = Factors(*[scalar] * len(Factors._fields))
    # Their numbers may not be finite, so that x - x, for one, is not simplified to 0.
    of_all = functools.partial(factors, rule=rule)
    return (
        scalarize(of_all, scalar, metrics, *arrays, finite=False),
        scalarize(element, *[scalar] * 4, common, finite=False),
    )


def factors(
    square: Float[Array, ""],
    metrics: Float[Array, " metrics"],
    progress: Float[Array, " progress"],
    terms: Float[Array, " terms"],
    rule: AdamRule,
) -> tuple[Factors, Float[Array, " progress"]]:
    """Return what all elements have in common, and the next progress.

    Args:
      square: the sum of the squares of the gradient.
      metrics: the sums of the metrics of the minibatch.
      progress: an array of `Progress`.
      terms: an array of `AdamTerms`.
      rule: what the vectors hold.
    """
    settings = AdamTerms(*(terms[i] for i in range(SIZES["adam_terms"])))
    rate, power_1, power_2, *rest = (progress[i] for i in range(SIZES["progress"]))
    old = Progress(rate, power_1, power_2, rest[: len(METRICS)], *rest[len(METRICS) :])
    # Clip the gradient to its norm, and leave the step out if that is not finite.
    norm = jnp.sqrt(square)
    is_applied = jnp.isfinite(norm)
    clipping = jnp.where(norm < settings.max_grad_norm, 1.0, settings.max_grad_norm / norm)
    # The step size by its schedule.
    if rule.schedule == "LINEAR":
        fraction = settings.fraction_done + old.applied * settings.fraction_per_step
        rate = settings.learning_rate * (1.0 - jnp.minimum(fraction, 1.0))
    elif rule.schedule == "ADAPTIVE_KL":
        divergence = metrics[METRICS.index("kl")] * (1.0 / rule.samples)
        slower = jnp.maximum(settings.min_rate, rate / 1.5)
        rate = jnp.where(divergence > 2.0 * settings.desired_kl, slower, rate)
        faster = jnp.minimum(settings.max_rate, rate * 1.5)
        is_small = (divergence < 0.5 * settings.desired_kl) & (divergence > 0.0)
        rate = jnp.where(is_small, faster, rate)
    # The bias corrections.
    power_1, power_2 = power_1 * BETA_1, power_2 * BETA_2
    is_one = jnp.where(is_applied, 1.0, 0.0)
    corrections = 1.0 / (1.0 - power_1), 1.0 / (1.0 - power_2)
    common = Factors(is_one, clipping, rate, *corrections)
    # Count the step, unless it is left out: then its metrics may not be finite either.
    sums = [total + metrics[i] for i, total in enumerate(old.sums)]
    new = Progress(rate, power_1, power_2, sums, old.rates + rate, old.applied + 1.0)
    pairs = zip(jax.tree.leaves(new), progress, strict=True)
    return common, jnp.stack([jnp.where(is_applied, *pair) for pair in pairs])


def element(
    param: Array, mu: Array, nu: Array, gradient: Array, common: Factors
) -> tuple[Array, ...]:
    """Return the next parameter and moments of one element, or of many.

    Args:
      param: the parameter.
      mu: the first moment.
      nu: the second moment.
      gradient: the gradient.
      common: what the elements have in common.
    """
    # The equation of the module, with the clipped gradient as g.
    clipped = gradient * common.clipping
    new_mu = BETA_1 * mu + (1.0 - BETA_1) * clipped
    new_nu = BETA_2 * nu + (1.0 - BETA_2) * (clipped * clipped)
    change = common.rate * (new_mu * common.correction_1)
    change = change / (jnp.sqrt(new_nu * common.correction_2) + _EPSILON)
    # Or what it was, if the step is left out.
    pairs = (param - change, param), (new_mu, mu), (new_nu, nu)
    return tuple(jnp.where(common.is_applied > 0.0, *pair) for pair in pairs)
