"""PPO of a size that kernels take, and minibatches made up for it."""

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs import Wrapper
from brax.training.acme import running_statistics
from brax.training.types import Transition

from jetbot_mjx.agents.networks import NetworkParams, make_networks
from jetbot_mjx.agents.ppo import PPO
from jetbot_mjx.config import parse_config

OBSERVATIONS, ACTIONS = 5, 2


def config(**ppo):
    network = ppo.pop("network", {})
    hidden = ppo.pop("hidden", [32, 32])
    sizes = {"policy_hidden_layer_sizes": hidden, "value_hidden_layer_sizes": hidden}
    values = {"num_envs": 64, "batch_size": 16, "num_minibatches": 4, "unroll_length": 4}
    return parse_config({"ppo": {**values, **ppo, "network": {**sizes, **network}}})


class Sizes(Wrapper):
    """An environment that has sizes and nothing else."""

    observation_size, action_size = OBSERVATIONS, ACTIONS
    observation_min_std = np.zeros(OBSERVATIONS)


def make_ppo(settings):
    return PPO(settings.ppo, Sizes(None), make_networks(settings.ppo, OBSERVATIONS, ACTIONS))


def minibatch(rng, settings, networks):
    """Random unrolls with ratios far from the ends of the clip range, parameters and statistics."""
    ppo = settings.ppo
    steps = ppo.batch_size, ppo.unroll_length

    def normal(*shape):
        return jnp.asarray(rng.normal(size=shape), jnp.float32)

    keys = jax.random.split(jax.random.PRNGKey(1))
    params = NetworkParams(
        policy=jax.jit(networks.policy_network.init)(keys[0]),
        value=jax.jit(networks.value_network.init)(keys[1]),
    )
    statistics = running_statistics.init_state(jax.ShapeDtypeStruct((OBSERVATIONS,), jnp.float32))
    statistics = statistics.replace(mean=normal(OBSERVATIONS), std=jnp.full(OBSERVATIONS, 1.5))
    observation, raw_action = normal(*steps, OBSERVATIONS), normal(*steps, ACTIONS)
    with jax.default_matmul_precision("highest"):
        parameters = networks.policy_network.apply(statistics, params.policy, observation)
    distribution = networks.parametric_action_distribution
    log_prob = distribution.log_prob(parameters, raw_action)
    batch = Transition(
        observation=observation,
        action=jnp.tanh(raw_action),
        reward=normal(*steps),
        discount=jnp.asarray(rng.choice([0.0, 1.0], p=[0.1, 0.9], size=steps), jnp.float32),
        next_observation=normal(steps[0], 1, OBSERVATIONS),
        extras={
            "policy_extras": {
                "raw_action": raw_action,
                "log_prob": log_prob + jnp.asarray(rng.choice([-0.7, 0.0, 0.7], size=steps)),
                "distribution_params": parameters,
            },
            "state_extras": {
                "truncation": jnp.asarray(rng.choice([0.0, 1.0], p=[0.9, 0.1], size=steps))
            },
        },
    )
    return params, statistics, jax.tree.map(lambda x: x.astype(jnp.float32), batch)
