"""Compute generalised advantage estimation (GAE) without a loop.

Motivation: Brax runs backwards through an unroll with `jax.lax.scan` in every minibatch. On a GPU
each iteration launches several very small kernels, a third of all launches of a minibatch.
Unrolled, the same operations in the same order are one or two kernels.

Equation, backwards in time, with dₜ = 1 if the task terminated the episode at step t and cₜ = 1 if
the time limit truncated it:

    δₜ  = (1 - cₜ) (rₜ + γ (1 - dₜ) Vₜ₊₁ - Vₜ)
    Aₜ  = δₜ + γ λ (1 - dₜ) (1 - cₜ) Aₜ₊₁
    V'ₜ = Vₜ + Aₜ
    Âₜ  = (1 - cₜ) (rₜ + γ (1 - dₜ) V'ₜ₊₁ - Vₜ) = δₜ + γ (1 - dₜ) (1 - cₜ) Aₜ₊₁

A termination stops bootstrapping from Vₜ₊₁, but a truncation does not end the task: Vₜ₊₁ already
belongs to the next episode, so the truncated step has no advantage at all. V'ₜ is the value target.
The advantage of Brax's loss is Âₜ: it is Aₜ without the first of its factors λ.

`td_error` and `gae_step` are these equations; `fused.sample_loss` lowers them for the kernels.

Source: J. Schulman et al., High-Dimensional Continuous Control Using Generalized Advantage
Estimation, arXiv:1506.02438.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_MAX_UNROLL_LENGTH = 64
"""Longest unroll that is computed without a loop; the program grows with its length."""


def td_error(
    reward: Array, discount: Array, value: Array, next_value: Array, not_truncated: Array
) -> Array:
    """Return δₜ, the error of the value estimate of one step, or of many; or Âₜ.

    Args:
      reward: rₜ, scaled as in the loss.
      discount: γ (1 - dₜ).
      value: Vₜ.
      next_value: Vₜ₊₁ for δₜ, V'ₜ₊₁ for Âₜ.
      not_truncated: 1 - cₜ.
    """
    return (reward + discount * next_value - value) * not_truncated


def gae_step(delta: Array, factor: Array, next_gae: Array) -> Array:
    """Return Aₜ from Aₜ₊₁.

    Args:
      delta: δₜ.
      factor: γ λ (1 - dₜ) (1 - cₜ).
      next_gae: Aₜ₊₁.
    """
    return delta + factor * next_gae


def compute_gae(
    truncation: Float[Array, "time batch"],
    termination: Float[Array, "time batch"],
    rewards: Float[Array, "time batch"],
    values: Float[Array, "time batch"],
    bootstrap_value: Float[Array, " batch"],
    lambda_: float = 1.0,
    discount: float = 0.99,
) -> tuple[Float[Array, "time batch"], Float[Array, "time batch"]]:
    """Compute the value targets and the advantages by the equations that the module states.

    Args:
      truncation: cₜ, 1 at steps where the time limit truncated an episode.
      termination: dₜ, 1 at steps where the task terminated an episode.
      rewards: rₜ, scaled as in the loss.
      values: Vₜ, the value estimate before each step.
      bootstrap_value: the value estimate after the last step.
      lambda_: λ, from 0 (one-step estimates) to 1 (discounted returns).
      discount: γ, the discount per environment step.

    Returns:
      The value targets V'ₜ and the advantages Âₜ. No gradient passes through either.
    """
    if len(rewards) > _MAX_UNROLL_LENGTH:
        # Late: Brax imports MJX, and few trainings need this.
        from brax.training.agents.ppo import losses

        return losses.compute_gae(
            truncation, termination, rewards, values, bootstrap_value, lambda_, discount
        )
    # Compute δₜ and the factor of Aₜ₊₁ for all steps at once, in the order of Brax's operations.
    not_truncated = 1 - truncation
    discounts = discount * (1 - termination)
    next_values = jnp.concatenate([values[1:], bootstrap_value[None]])
    deltas = td_error(rewards, discounts, values, next_values, not_truncated)
    factors = discounts * not_truncated * lambda_
    # Accumulate Aₜ backwards in time, which gives the targets V'ₜ and from them Âₜ.
    gae = [deltas[-1]]
    for delta, factor in zip(deltas[-2::-1], factors[-2::-1], strict=True):
        gae.append(gae_step(delta, factor, gae[-1]))
    targets = jnp.stack(gae[::-1]) + values
    next_targets = jnp.concatenate([targets[1:], bootstrap_value[None]])
    advantages = td_error(rewards, discounts, values, next_targets, not_truncated)
    return jax.lax.stop_gradient(targets), jax.lax.stop_gradient(advantages)
