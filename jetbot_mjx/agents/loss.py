"""Compute PPO's loss of a minibatch, whose equation `jetbot_mjx.agents.ppo` states.

`XlaLearner` differentiates it. `FusedLearner` does not call it: `fused.sample_loss` states the same
loss of one sample for the kernels. Whoever changes one changes both.

Formulas and the order of operations are those of Brax; only the advantages are computed by `gae`,
without a loop.

Source: google/brax v0.14.2, brax/training/agents/ppo/losses.py.
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from jetbot_mjx.agents.brax_parts import Normalizer, Transition
from jetbot_mjx.agents.gae import compute_gae
from jetbot_mjx.agents.networks import NetworkParams, Networks
from jetbot_mjx.config import PPOConfig


def ppo_loss(
    params: NetworkParams,
    normalizer: Normalizer,
    batch: Transition,
    key: PRNGKeyArray,
    *,
    networks: Networks,
    config: PPOConfig,
) -> tuple[Float[Array, ""], dict[str, Float[Array, ""]]]:
    """Compute the loss L = L_policy + L_value + L_entropy.

    Args:
      params: the parameters of the networks.
      normalizer: the statistics of the observations.
      batch: the minibatch, of shape (unrolls, time, ...).
      key: the key of the noise that estimates the entropy.
      networks: the policy and value networks, with one array or dictionary as their observation.
      config: the hyperparameters, of which the coefficients of the loss are used.

    Returns:
      The loss, and its terms and the metrics of the policy under Brax's names.
    """
    # Put the time first.
    batch = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), batch)
    last = jax.tree.map(lambda x: x[-1], batch.next_observation)
    distribution = networks.parametric_action_distribution
    value_network = networks.value_network
    outputs = networks.policy_network.apply(normalizer, params.policy, batch.observation)
    values = value_network.apply(normalizer, params.value, batch.observation)
    bootstrap_value = value_network.apply(normalizer, params.value, last)
    collected, state_extras = batch.extras["policy_extras"], batch.extras["state_extras"]
    log_probs = distribution.log_prob(outputs, collected["raw_action"])
    # Advantages and value targets.
    truncation = state_extras["truncation"]
    targets, advantages = compute_gae(
        truncation=truncation,
        termination=(1 - batch.discount) * (1 - truncation),
        rewards=batch.reward * config.reward_scaling,
        values=values,
        bootstrap_value=bootstrap_value,
        lambda_=config.gae_lambda,
        discount=config.discounting,
    )
    if config.normalize_advantage:
        advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    # The three terms: the clipped surrogate objective,
    ratio = jnp.exp(log_probs - collected["log_prob"])
    policy_loss = -jnp.mean(_surrogate(ratio, advantages, config.clipping_epsilon))
    # the value loss and the entropy bonus.
    error = targets - values
    value_loss = jnp.mean(error * error) * 0.5 * config.vf_loss_coefficient
    entropy_loss = config.entropy_cost * -jnp.mean(distribution.entropy(outputs, key))
    loss = policy_loss + value_loss + entropy_loss
    return loss, {
        "total_loss": loss,
        "policy_loss": policy_loss,
        "v_loss": value_loss,
        "entropy_loss": entropy_loss,
        **_policy_metrics(distribution, outputs, collected["distribution_params"]),
    }


def _surrogate(ratio: Array, advantages: Array, epsilon: float | Array) -> Array:
    """Return the smaller of the surrogate objective and of the one with a clipped ratio."""
    surrogate, clipped = ratio * advantages, jnp.clip(ratio, 1 - epsilon, 1 + epsilon) * advantages
    return jnp.minimum(surrogate, clipped)


def _policy_metrics(distribution: Any, outputs: PyTree, collected: PyTree) -> dict[str, Array]:
    """Return the divergence of the policy from that of the collection, and its deviation.

    Args:
      distribution: the family of the policy's distributions.
      outputs: the parameters of the policy's distributions.
      collected: those of the collection.
    """
    policy, old_policy = distribution.create_dist(outputs), distribution.create_dist(collected)
    return {
        "kl_mean": jnp.mean(policy.kl_divergence(old_policy)),
        "policy_dist_mean_std": jnp.mean(policy.scale),
    }
