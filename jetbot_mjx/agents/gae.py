"""Generalised advantage estimation without a loop, in the place of Brax's.

Brax runs back through an unroll by `jax.lax.scan`, in every minibatch: on a GPU each of its steps
is a handful of launches of next to nothing, a third of all that a minibatch launches. Written out,
the same operations in the same order are one or two kernels.

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
"""Unrolls beyond which Brax's loop is the better choice: the program grows with their length."""

_brax = losses.compute_gae
_lock = threading.Lock()


@contextlib.contextmanager
def unrolled() -> Iterator[None]:
    """Lets what is traced inside estimate advantages by this module instead of Brax."""
    # One thread at a time: of two that replace and restore, the second would keep the first's.
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
    """Targets of the value function, and advantages.

        δₜ = rₜ + γ (1 - dₜ) Vₜ₊₁ - Vₜ,  Aₜ = δₜ + γ λ (1 - dₜ) Aₜ₊₁

    and both are 0 where an episode was cut off.

    Args:
      truncation: 1 where an episode was cut off.
      termination: dₜ, 1 where the task ended one.
      rewards: rₜ.
      values: Vₜ.
      bootstrap_value: V after the last step.
      lambda_: λ.
      discount: γ.

    Returns:
      The targets, and the advantages over the values of those targets; no gradient passes.
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
