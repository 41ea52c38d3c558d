"""Compute generalised advantage estimation (GAE) without a loop, as a replacement for Brax's.

Motivation: Brax runs backwards through an unroll with `jax.lax.scan` in every minibatch. On a GPU
each iteration launches several very small kernels, a third of all launches of a minibatch.
Unrolled, the same operations in the same order are one or two kernels.

Equation, backwards in time:

    δₜ = rₜ + γ (1 - dₜ) Vₜ₊₁ - Vₜ,  Aₜ = δₜ + γ λ (1 - dₜ) Aₜ₊₁

where δₜ and Aₜ are 0 at a truncated step. The value targets are Aₜ + Vₜ.

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

_LONGEST = 64
"""Longest unroll to write out; beyond it Brax's loop is better, for the program grows."""

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
    """Compute the targets of the value function, and the advantages.

        δₜ = rₜ + γ (1 - dₜ) Vₜ₊₁ - Vₜ,  Aₜ = δₜ + γ λ (1 - dₜ) Aₜ₊₁

    where δₜ and Aₜ are 0 at a truncated step.

    Args:
      truncation: 1 where an episode was truncated.
      termination: dₜ, 1 where the task terminated an episode.
      rewards: rₜ.
      values: Vₜ.
      bootstrap_value: V after the last step.
      lambda_: λ.
      discount: γ.

    Returns:
      The targets Aₜ + Vₜ, and one-step advantages that use the next target in place of Vₜ₊₁; no
      gradient passes through either.
    """
    if len(rewards) > _LONGEST:
        return _brax(truncation, termination, rewards, values, bootstrap_value, lambda_, discount)
    kept = 1 - truncation
    goes_on = discount * (1 - termination)
    next_values = jnp.concatenate([values[1:], bootstrap_value[None]])
    deltas = (rewards + goes_on * next_values - values) * kept
    factors = goes_on * kept * lambda_
    over_value = [deltas[-1]]
    for delta, factor in zip(deltas[-2::-1], factors[-2::-1], strict=True):
        over_value.append(delta + factor * over_value[-1])
    targets = jnp.stack(over_value[::-1]) + values
    next_targets = jnp.concatenate([targets[1:], bootstrap_value[None]])
    advantages = (rewards + goes_on * next_targets - values) * kept
    return jax.lax.stop_gradient(targets), jax.lax.stop_gradient(advantages)
