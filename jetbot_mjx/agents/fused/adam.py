"""Define a step of Adam along a gradient, with all that a training counts, as JAX functions.

Equation, with the gradient g clipped to a global norm, as `optax.adam` has it:

    m' = β₁ m + (1 - β₁) g,    v' = β₂ v + (1 - β₂) g²
    p' = p - η (m' / (1 - β₁ⁿ)) / (√(v' / (1 - β₂ⁿ)) + 10⁻⁸)

for the n-th step, of size η. A step whose gradient is not finite is left out. The powers of β are
carried from step to step.

`cpu_adam` and `gpu_adam` lower `factors` and `element` for a kernel.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jetbot_mjx.agents.fused.sample_loss import vector_of
from jetbot_mjx.agents.fused.shapes import POLICY_METRICS, VALUE_METRICS, UpdateShape
from onekernel.build import ScalarProgram, scalarize_part

BETA_1, BETA_2 = 0.9, 0.999
_EPSILON = 1e-8

METRICS = (*POLICY_METRICS, *VALUE_METRICS)


class AdamRule(NamedTuple):
    """An `AdamRule` says what the vectors hold, and how the step size changes."""

    shape: UpdateShape
    samples: int
    """Number of samples of a minibatch."""
    schedule: str
    """One of `ppo.learning_rate_schedule`."""
    steps: int
    """Number of steps of a training step."""

    @property
    def sizes(self) -> dict[str, int]:
        """Return the number of elements of each of the `ARRAYS` for one policy."""
        sizes = dict.fromkeys(ARRAYS, self.shape.size) | SIZES
        return {**sizes, "progress": (self.steps + 1) * SIZES["progress"], "index": 1}

    @property
    def places(self) -> list[int]:
        """Return where the gradient's vector has the sums of `METRICS`."""
        ends = [(self.shape.policy_size, POLICY_METRICS), (self.shape.size, VALUE_METRICS)]
        return [end - len(names) + i for end, names in ends for i in range(len(names))]


class AdamTerms(NamedTuple):
    """An `AdamTerms` holds what does not change during a training step.

    The kernels read them from an array, because they may differ between policies.
    """

    max_grad_norm: Any
    learning_rate: Any
    """Size of the first step of all, for the schedule `LINEAR`."""
    begun: Any
    """Part of all steps that were done before this training step."""
    share: Any
    """Part of all steps that one step is."""
    desired_kl: Any
    min_rate: Any
    max_rate: Any


class Progress(NamedTuple):
    """A `Progress` holds what a step of Adam carries on beside the vectors."""

    rate: Any
    """Step size."""
    power_1: Any
    """Power of β₁ whose exponent is the number of steps."""
    power_2: Any
    sums: Any
    """Sums of `METRICS` over the steps, whose samples they sum themselves."""
    rates: Any
    """Sum of the step sizes."""
    applied: Any
    """Number of steps of this training step."""


class Factors(NamedTuple):
    """A `Factors` holds what all elements of the vectors have in common."""

    is_applied: Any
    """1, or 0 if the gradient is not finite."""
    clipping: Any
    """What the gradient is multiplied by."""
    rate: Any
    inverse_1: Any
    """1 / (1 - β₁ⁿ)."""
    inverse_2: Any


SIZES = {"adam_terms": len(AdamTerms._fields), "progress": len(Progress._fields) - 1 + len(METRICS)}
"""Lengths of the arrays of `AdamTerms` and `Progress`."""

ARRAYS = ("gradient", "params", "mu", "nu", "progress", "index", "adam_terms")
"""The arrays that the kernels take, as `launch.adam` does."""

UPDATED = ("params", "mu", "nu", "progress")
"""Those which they change in place, and return."""

ALIASES = {ARRAYS.index(name): i for i, name in enumerate(UPDATED)}
"""The arguments whose memory the results take."""


@functools.cache
def programs(rule: AdamRule) -> tuple[ScalarProgram, ScalarProgram]:
    """Lower `factors` and `element` to programs on scalars.

    Args:
      rule: what the vectors hold.
    """
    scalar, metrics = vector_of(), vector_of(len(METRICS))
    arrays = vector_of(SIZES["progress"]), vector_of(SIZES["adam_terms"])
    common = _lowered(functools.partial(factors, rule=rule), scalar, metrics, *arrays)
    return common, _lowered(element, *[scalar] * (4 + len(Factors._fields)))


def _lowered(function: Callable[..., Any], *arguments: jax.ShapeDtypeStruct) -> ScalarProgram:
    """Lower a function whose numbers may not be finite."""
    closed = jax.make_jaxpr(function)(*arguments)
    return scalarize_part(closed, closed.jaxpr.invars, closed.jaxpr.outvars, finite=False)


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
    given = AdamTerms(*(terms[i] for i in range(SIZES["adam_terms"])))
    rate, power_1, power_2, *rest = (progress[i] for i in range(SIZES["progress"]))
    old = Progress(rate, power_1, power_2, rest[: len(METRICS)], *rest[len(METRICS) :])
    norm = jnp.sqrt(square)
    is_applied = jnp.isfinite(norm)
    clipping = jnp.where(norm < given.max_grad_norm, 1.0, given.max_grad_norm / norm)
    if rule.schedule == "LINEAR":
        done = given.begun + old.applied * given.share
        rate = given.learning_rate * (1.0 - jnp.minimum(done, 1.0))
    elif rule.schedule == "ADAPTIVE_KL":
        divergence = metrics[METRICS.index("kl")] * (1.0 / rule.samples)
        slower = jnp.maximum(given.min_rate, rate / 1.5)
        rate = jnp.where(divergence > 2.0 * given.desired_kl, slower, rate)
        faster = jnp.minimum(given.max_rate, rate * 1.5)
        is_small = (divergence < 0.5 * given.desired_kl) & (divergence > 0.0)
        rate = jnp.where(is_small, faster, rate)
    power_1, power_2 = power_1 * BETA_1, power_2 * BETA_2
    common = Factors(
        jnp.where(is_applied, 1.0, 0.0),
        clipping,
        rate,
        1.0 / (1.0 - power_1),
        1.0 / (1.0 - power_2),
    )
    new = Progress(
        rate,
        power_1,
        power_2,
        [total + metrics[i] for i, total in enumerate(old.sums)],
        old.rates + rate,
        old.applied + 1.0,
    )
    # Metrics of a step that is left out may not be finite.
    kept = [jnp.where(is_applied, *x) for x in zip(jax.tree.leaves(new), progress, strict=True)]
    return common, jnp.stack(kept)


def element(
    param: Array,
    mu: Array,
    nu: Array,
    gradient: Array,
    is_applied: Array,
    clipping: Array,
    rate: Array,
    inverse_1: Array,
    inverse_2: Array,
) -> tuple[Array, Array, Array]:
    """Return the next parameter and means of one element, or of many.

    Args:
      param: the parameter.
      mu: mean of its gradients.
      nu: mean of their squares.
      gradient: the gradient.
      is_applied: the first of the `Factors`, which the others are, too.
      clipping: what the gradient is multiplied by.
      rate: the step size.
      inverse_1: 1 / (1 - β₁ⁿ).
      inverse_2: 1 / (1 - β₂ⁿ).
    """
    clipped = gradient * clipping
    new_mu = BETA_1 * mu + (1.0 - BETA_1) * clipped
    new_nu = BETA_2 * nu + (1.0 - BETA_2) * (clipped * clipped)
    change = rate * (new_mu * inverse_1) / (jnp.sqrt(new_nu * inverse_2) + _EPSILON)
    new, old = (param - change, new_mu, new_nu), (param, mu, nu)
    first, second, third = (jnp.where(is_applied > 0.0, *x) for x in zip(new, old, strict=True))
    return first, second, third
