"""Build Brax's policy and value networks, name their parameters, and run inference."""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
from brax.training.acme import running_statistics
from brax.training.agents.ppo import networks as ppo_networks
from brax.training.types import identity_observation_preprocessor
from jaxtyping import Array, Float, UInt32

from jetbot_mjx.compiler.xla_options import default_device_cpu
from jetbot_mjx.config import NetworkConfig

_ACTIVATIONS: dict[str, Callable[[jax.Array], jax.Array]] = {
    "tanh": nn.tanh,
    "relu": nn.relu,
    "elu": nn.elu,
    "swish": nn.swish,
}


class PolicyParams(NamedTuple):
    """A `PolicyParams` holds Brax's positional triple of parameters by name."""

    normalizer: Any
    """Running mean and standard deviation of the observation."""
    policy: Any
    """Weights of the policy network."""
    value: Any
    """Weights of the value network."""


@runtime_checkable
class Policy(Protocol):
    """A `Policy` maps observations to actions."""

    def __call__(
        self, obs: Float[Array | np.ndarray, "*batch obs"], key: UInt32[Array, "2"] | None = None
    ) -> Float[Array, "*batch action"]:
        """Return actions: the mode of the distribution without a key, a sample with one."""
        ...


def network_factory(config: NetworkConfig) -> Callable[..., ppo_networks.PPONetworks]:
    """Return Brax's `network_factory` argument for a network configuration.

    Args:
      config: the layer sizes, the activation and the action distribution.

    Returns:
      A function of (observation_size, action_size, preprocess_observations_fn=...).
    """

    def factory(
        observation_size: Any,
        action_size: int,
        preprocess_observations_fn: Any = identity_observation_preprocessor,
    ) -> ppo_networks.PPONetworks:
        return ppo_networks.make_ppo_networks(
            observation_size,
            action_size,
            preprocess_observations_fn=preprocess_observations_fn,
            policy_hidden_layer_sizes=config.policy_hidden_layer_sizes,
            value_hidden_layer_sizes=config.value_hidden_layer_sizes,
            activation=_ACTIVATIONS[config.activation],
            distribution_type=config.distribution_type,
        )

    return factory


def make_networks(
    config: NetworkConfig, observation_size: int, action_size: int, *, normalize: bool
) -> ppo_networks.PPONetworks:
    """Build Brax's policy and value networks.

    Args:
      config: the layer sizes, the activation and the action distribution.
      observation_size: the length of the observation.
      action_size: the length of the action.
      normalize: whether the networks normalise observations by running statistics.

    Returns:
      Brax's networks.
    """
    preprocess = running_statistics.normalize if normalize else identity_observation_preprocessor
    # Brax's networks hold an observation of zeros, which need not be on the GPU.
    with jax.ensure_compile_time_eval(), default_device_cpu():
        return network_factory(config)(
            observation_size, action_size, preprocess_observations_fn=preprocess
        )


def make_policy(networks: ppo_networks.PPONetworks, params: PolicyParams) -> Policy:
    """Bind networks and parameters into a policy.

    Args:
      networks: the networks from `make_networks`.
      params: the parameters of the networks and of the normaliser.

    Returns:
      The policy, which takes one observation or any batch of observations.
    """
    inference = ppo_networks.make_inference_fn(networks)
    greedy, exploring = inference(params, deterministic=True), inference(params)

    def policy(
        obs: Float[Array | np.ndarray, "*batch obs"], key: UInt32[Array, "2"] | None = None
    ) -> Float[Array, "*batch action"]:
        if key is None:
            # Brax requires a key, although the mode does not use it.
            return greedy(jnp.asarray(obs), jax.random.PRNGKey(0))[0]
        return exploring(jnp.asarray(obs), key)[0]

    return policy
