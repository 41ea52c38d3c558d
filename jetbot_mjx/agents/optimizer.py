"""Make Adam with a schedule of its step size, and read and write the state in which optax keeps it.

The state is a chain's: that of clipping, if there is any, followed by that of `inject_hyperparams`
around Adam. Every learner leaves it in this form, so that each can continue another's training.
"""

from typing import Any, NamedTuple

import jax
import optax
from jaxtyping import Array, Float, Int, PyTree

from jetbot_mjx.agents.brax_parts import optimizer as brax_optimizer
from jetbot_mjx.config import PPOConfig


def make_optimizer(config: PPOConfig) -> optax.GradientTransformation:
    """Return Adam, preceded by clipping of the global gradient norm if configured.

    Args:
      config: the hyperparameters, of which the step size, its schedule and the norm are used.

    Returns:
      A chain whose last state holds the step size in `hyperparams["learning_rate"]`.
    """
    # The step size: constant, or falling to zero; ADAPTIVE_KL changes it in the state.
    rate: Any = config.learning_rate
    if config.learning_rate_schedule == "LINEAR":
        rate = optax.linear_schedule(config.learning_rate, 0.0, config.gradient_steps)
    # Adam, whose other constants are not part of the state.
    fixed = ("b1", "b2", "eps", "eps_root")
    adam = optax.inject_hyperparams(optax.adam, static_args=fixed)(learning_rate=rate)
    if config.max_grad_norm is None:
        return optax.chain(adam)
    return optax.chain(optax.clip_by_global_norm(config.max_grad_norm), adam)


def adapt_step_size(state: PyTree, kl: Float[Array, ""], config: PPOConfig) -> PyTree:
    """Return the optimizer's state with the step size that ADAPTIVE_KL gives it.

    Args:
      state: the state before a minibatch.
      kl: the KL divergence of the minibatch, the mean over all devices.
      config: the hyperparameters, of which the divergence aimed at and the bounds are used.
    """
    state, _ = brax_optimizer.adaptive_kl_learning_rate(
        # Pass a copy, because the function modifies its argument.
        jax.tree.map(lambda x: x, state),
        kl,
        config.desired_kl,
        min_learning_rate=config.learning_rate_schedule_min_lr,
        max_learning_rate=config.learning_rate_schedule_max_lr,
    )
    return state


class AdamState(NamedTuple):
    """An `AdamState` holds what the state of an optimizer from `make_optimizer` says of Adam."""

    rate: Float[Array, ""]
    """The step size."""
    count: Int[Array, ""]
    """The number of steps so far."""
    mu: PyTree
    """First moment: the moving average of the gradients."""
    nu: PyTree
    """Second moment: the moving average of their squares."""


def read_adam(state: PyTree) -> AdamState:
    """Return what the optimizer's state says of Adam."""
    adam, *_ = state[-1].inner_state
    return AdamState(state[-1].hyperparams["learning_rate"], adam.count, adam.mu, adam.nu)


def write_adam(
    state: PyTree, rate: Float[Array, ""], applied: Float[Array, ""], mu: PyTree, nu: PyTree
) -> PyTree:
    """Return the optimizer's state after some steps of Adam.

    Args:
      state: the state before them.
      rate: the step size of the last one.
      applied: their number.
      mu: the first moment after them.
      nu: the second moment after them.
    """
    *before, injected = state
    adam, *rest = injected.inner_state

    # Optax counts the steps three times: for Adam, for the injection and for the schedule.
    def later(count: Array) -> Array:
        return count + applied.astype(count.dtype)

    after = injected._replace(
        count=later(injected.count),
        hyperparams={"learning_rate": rate},
        hyperparams_states=jax.tree.map(later, injected.hyperparams_states),
        inner_state=(adam._replace(count=later(adam.count), mu=mu, nu=nu), *rest),
    )
    return (*before, after)
