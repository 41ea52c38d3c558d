"""Compute generalised advantage estimation (GAE) without a loop, as a replacement for Brax's.

Motivation: Brax runs backwards through an unroll with `jax.lax.scan` in every minibatch. On a GPU
each iteration launches several very small kernels, a third of all launches of a minibatch.
Unrolled, the same operations in the same order are one or two kernels.

Equation, backwards in time, with dₜ = 1 if the task terminated the episode at step t and cₜ = 1 if
the time limit truncated it:

    δₜ = (1 - cₜ) (rₜ + γ (1 - dₜ) Vₜ₊₁ - Vₜ)
    Aₜ = δₜ + γ λ (1 - dₜ) (1 - cₜ) Aₜ₊₁

A termination stops bootstrapping from Vₜ₊₁, but a truncation does not end the task: Vₜ₊₁ already
belongs to the next episode, so the truncated step has no advantage at all. The value targets are
Aₜ + Vₜ.

Source: J. Schulman et al., High-Dimensional Continuous Control Using Generalized Advantage
Estimation, arXiv:1506.02438.
"""

import contextlib
import threading
from collections.abc import Iterator
from unittest import mock

import jax
import jax.numpy as jnp
from brax.training.agents.ppo import losses
from jaxtyping import Array, Float

_MAX_UNROLL_LENGTH = 64
"""Longest unroll that is computed without a loop; the program grows with its length."""

_brax = losses.compute_gae
_lock = threading.Lock()


@contextlib.contextmanager
def unrolled() -> Iterator[None]:
    """Use this module's `compute_gae` instead of Brax's in all code that is traced inside."""
    # One thread at a time: otherwise a second one would restore the first one's replacement.
    with _lock, mock.patch.object(losses, "compute_gae", compute_gae):
        yield


def compute_gae(
    truncation: Float[Array, "time batch"],
    termination: Float[Array, "time batch"],
    rewards: Float[Array, "time batch"],
    values: Float[Array, "time batch"],
    bootstrap_value: Float[Array, " batch"],
    lambda_: float = 1.0,
    discount: float = 0.99,
) -> tuple[Float[Array, "time batch"], Float[Array, "time batch"]]:
    """Compute the value targets and the advantages by the equation that the module states.

    Args:
      truncation: cₜ, 1 at steps where the time limit truncated an episode.
      termination: dₜ, 1 at steps where the task terminated an episode.
      rewards: rₜ, scaled as in the loss.
      values: Vₜ, the value estimate before each step.
      bootstrap_value: the value estimate after the last step.
      lambda_: λ, from 0 (one-step estimates) to 1 (discounted returns).
      discount: γ, the discount per environment step.

    Returns:
      The targets Vₜ' = Aₜ + Vₜ, and the advantages that Brax's loss uses,
      (1 - cₜ) (rₜ + γ (1 - dₜ) Vₜ₊₁' - Vₜ). No gradient passes through either.
    """
    if len(rewards) > _MAX_UNROLL_LENGTH:
        return _brax(truncation, termination, rewards, values, bootstrap_value, lambda_, discount)
    # Compute δₜ and the factor of Aₜ₊₁ for all steps at once, in the order of Brax's operations.
    not_truncated = 1 - truncation
    discounts = discount * (1 - termination)
    next_values = jnp.concatenate([values[1:], bootstrap_value[None]])
    deltas = (rewards + discounts * next_values - values) * not_truncated
    factors = discounts * not_truncated * lambda_
    # Accumulate Aₜ backwards in time, which gives the targets and from them the advantages.
    gae = [deltas[-1]]
    for delta, factor in zip(deltas[-2::-1], factors[-2::-1], strict=True):
        gae.append(delta + factor * gae[-1])
    targets = jnp.stack(gae[::-1]) + values
    next_targets = jnp.concatenate([targets[1:], bootstrap_value[None]])
    advantages = (rewards + discounts * next_targets - values) * not_truncated
    return jax.lax.stop_gradient(targets), jax.lax.stop_gradient(advantages)
