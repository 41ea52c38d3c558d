"""Build Brax's policy and value networks, name their parameters, and run inference.

A training whose programs are found compiled needs no networks, only their parameters. Flax and
Brax's networks take a quarter of a second to import, and are imported where networks are built.
"""

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float, PyTree, UInt32

from jetbot_mjx.agents.brax_parts import (
    Normalizer,
    identity_observation_preprocessor,
    running_statistics,
    specs,
)
from jetbot_mjx.agents.cnn_sizes import check_size, is_image
from jetbot_mjx.config import NetworkConfig, PPOConfig
from jetbot_mjx.devices import default_device_cpu
from jetbot_mjx.errors import InvalidError

_ACTIVATIONS: dict[str, Callable[[jax.Array], jax.Array]] = {
    "tanh": jax.nn.tanh,
    "relu": jax.nn.relu,
    "elu": jax.nn.elu,
    "swish": jax.nn.swish,
}


Observation = Float[Array | np.ndarray, "*batch obs"] | Mapping[str, Array | np.ndarray]
"""One observation or any batch of them: a vector of numbers, or a dictionary with images."""


class Networks:
    """A `Networks` has the attributes of Brax's `PPONetworks`, or of `VisionNetworks`.

    The networks are built when one of them is asked for.
    """

    def __init__(self, build: Callable[[], Any]) -> None:
        """Keep the function that builds the networks."""
        self._built = functools.cache(build)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):
            # `copy` and `pickle` ask for such names before the object has attributes.
            raise AttributeError(name)
        return getattr(self._built(), name)


class NetworkParams(struct.PyTreeNode):
    """A `NetworkParams` holds the weights of both networks, as Brax's `PPONetworkParams` does."""

    policy: PyTree
    value: PyTree


class PolicyParams(NamedTuple):
    """A `PolicyParams` holds Brax's positional triple of parameters by name."""

    normalizer: Normalizer
    """Running mean and standard deviation of the observation."""
    policy: PyTree
    """Weights of the policy network."""
    value: PyTree
    """Weights of the value network."""


@runtime_checkable
class Policy(Protocol):
    """A `Policy` maps observations to actions."""

    def __call__(
        self, obs: Observation, key: UInt32[Array, "2"] | None = None
    ) -> Float[Array, "*batch action"]:
        """Return actions: the mode of the distribution without a key, a sample with one."""
        ...


def network_factory(config: NetworkConfig) -> Callable[..., Any]:
    """Return Brax's `network_factory` argument for a network configuration.

    Args:
      config: the layer sizes, the activation and the action distribution.

    Returns:
      A function of (observation_size, action_size, preprocess_observations_fn=...) and of further
      arguments of `brax.training.agents.ppo.networks.make_ppo_networks`, which returns a
      `PPONetworks`.
    """
    from brax.training.agents.ppo import networks as ppo_networks

    kind = config.distribution_type
    make = functools.partial(
        ppo_networks.make_ppo_networks,
        policy_hidden_layer_sizes=config.policy_hidden_layer_sizes,
        value_hidden_layer_sizes=config.value_hidden_layer_sizes,
        activation=_ACTIVATIONS[config.activation],
        distribution_type="tanh_normal" if kind == "categorical" else kind,
    )
    if kind == "categorical":
        return functools.partial(_choosing, config, make)
    if config.initial_action is None:
        return make
    action = config.initial_action

    def make_biased(observation_size: Any, action_size: int, **arguments: Any) -> Any:
        _check_action(action, action_size)
        networks: Any = make(observation_size, action_size, **arguments)
        # A mean of the normal distribution is bounded by its tanh, or by nothing.
        is_bounded = config.distribution_type == "tanh_normal"
        mean = np.arctanh(action) if is_bounded else np.asarray(action)
        policy = networks.policy_network
        return networks.replace(
            policy_network=dataclasses.replace(
                policy, init=lambda key: _with_mean(policy.init(key), mean)
            )
        )

    return make_biased


def _choosing(
    config: NetworkConfig,
    make: Callable[..., Any],
    observation_size: Any,
    action_size: int,
    **arguments: Any,
) -> Any:
    """Return Brax's networks with a policy whose outputs are those of choices."""
    from brax.training.networks import make_policy_network

    from jetbot_mjx.agents.categorical import CategoricalDistribution

    distribution = CategoricalDistribution(action_size)
    policy = make_policy_network(
        distribution.param_size,
        observation_size,
        hidden_layer_sizes=config.policy_hidden_layer_sizes,
        activation=_ACTIVATIONS[config.activation],
        **arguments,
    )
    networks: Any = make(observation_size, action_size, **arguments)
    return networks.replace(policy_network=policy, parametric_action_distribution=distribution)


def _check_action(action: Sequence[float] | None, action_size: int) -> None:
    if action is not None and len(action) != action_size:
        raise InvalidError(
            f"ppo.network.initial_action = {list(action)} is wrong: an action has {action_size}"
            " numbers"
        )


def _with_mean(params: PyTree, mean: np.ndarray) -> PyTree:
    """Return a policy network's parameters with a bias of its last layer's first outputs.

    Args:
      params: Brax's parameters, whose last layer has biases of zero.
      mean: the biases of the first outputs, the mean of the action's distribution.
    """
    # Only the biases of the last layer change.
    layers = params["params"]
    last = last_layer(layers)
    bias = layers[last]["bias"].at[: len(mean)].set(mean)
    return {"params": {**layers, last: {**layers[last], "bias": bias}}}


def last_layer(layers: Mapping[str, PyTree]) -> str:
    """Return the name of a policy network's last layer, whose first outputs are the means.

    Args:
      layers: Brax's parameters of the network, by layer.
    """
    # With `normal`, Brax has the hidden layers in a module of their own, in front of `Dense_0`.
    return "Dense_0" if "Dense_0" in layers else f"hidden_{len(layers) - 1}"


def make_networks(
    config: PPOConfig, observation_size: int | Mapping[str, Sequence[int]], action_size: int
) -> Networks:
    """Build the policy and value networks: Brax's, behind an encoder if there are images.

    Args:
      config: the settings of PPO, of which `network` and `normalize_observations` are used: with
        the latter, the networks normalise numbers by running statistics.
      observation_size: the length of the observation, or the shapes of its parts.
      action_size: the length of the action.

    Returns:
      The networks.

    Raises:
      InvalidError: `initial_action` is not an action, or the images are too small for the
        convolutions.
    """
    network, shapes = config.network, {}
    _check_action(network.initial_action, action_size)
    if not isinstance(observation_size, int):
        shapes = {name: tuple(shape) for name, shape in observation_size.items()}
        check_size(network.cnn, shapes)
    preprocess = (
        running_statistics.normalize
        if config.normalize_observations
        else identity_observation_preprocessor
    )

    def build() -> Any:
        # Brax's networks hold an observation of zeros, which need not be on the GPU.
        with jax.ensure_compile_time_eval(), default_device_cpu():
            make = network_factory(network)
            if isinstance(observation_size, int):
                return make(observation_size, action_size, preprocess_observations_fn=preprocess)
            from jetbot_mjx.agents.vision import make_vision_networks

            return make_vision_networks(
                network, shapes, action_size, make_heads=make, normalize=preprocess
            )

    return Networks(build)


def init_normalizer(observation_size: int | Mapping[str, Sequence[int]]) -> Normalizer:
    """Return the statistics of an observation before the first is known; images have none.

    Args:
      observation_size: the length of the observation, or the shapes of its parts.
    """
    # Mean 0 and standard deviation 1 of each number, without images.
    dtype = jnp.dtype("float32")
    if isinstance(observation_size, int):
        return running_statistics.init_state(specs.Array((observation_size,), dtype))
    return running_statistics.init_state(
        {
            name: specs.Array(tuple(shape), dtype)
            for name, shape in observation_size.items()
            if not is_image(name)
        }
    )


def update_normalizer(
    normalizer: Normalizer, obs: Observation, axis_name: str | None = None
) -> Normalizer:
    """Return the statistics with a batch of observations taken in; those of images are not kept.

    Args:
      normalizer: the statistics before.
      obs: the observations, with any batch axes.
      axis_name: the mesh axis over which the observations are sharded; None: none.
    """
    # Images have no statistics, and perhaps there is nothing else.
    if isinstance(obs, Mapping):
        obs = {name: value for name, value in obs.items() if not is_image(name)}
    if not jax.tree.leaves(obs):
        return normalizer
    return running_statistics.update(normalizer, obs, pmap_axis_name=axis_name)


def make_policy(networks: Networks, params: PolicyParams) -> Policy:
    """Bind networks and parameters into a policy.

    Args:
      networks: the networks from `make_networks`.
      params: the parameters of the networks and of the normaliser.

    Returns:
      The policy, which takes one observation or any batch of observations.
    """
    from brax.training.agents.ppo import networks as ppo_networks

    # Brax takes whatever has the attributes of its `PPONetworks`.
    any_networks: Any = networks
    inference = ppo_networks.make_inference_fn(any_networks)
    greedy, exploring = inference(params, deterministic=True), inference(params)

    def policy(
        obs: Observation, key: UInt32[Array, "2"] | None = None
    ) -> Float[Array, "*batch action"]:
        if key is None:
            # Brax requires a key, although the mode does not use it.
            return greedy(jax.tree.map(jnp.asarray, obs), jax.random.PRNGKey(0))[0]
        return exploring(jax.tree.map(jnp.asarray, obs), key)[0]

    return policy
