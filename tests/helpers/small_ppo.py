"""PPO as small as can be: its settings, its parameters and batches made up for it."""

import json

import jax
import jax.numpy as jnp
import numpy as np
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import losses
from brax.training.types import Transition

from jetbot_mjx.agents.optimizer import make_optimizer
from jetbot_mjx.config import parse_config

SIZE = 4096  # environment steps in one training step of configs/smoke.yaml


def with_ppo(config, **changes):
    top = {name: changes.pop(name) for name in list(changes) if name in type(config).model_fields}
    values = config.model_dump(mode="json") | top
    values["ppo"] |= changes
    return parse_config(values)


def furthest(one, other):
    """The largest difference between two trees."""
    differences = jax.tree.map(lambda a, b: np.max(np.abs(np.asarray(a) - b)), one, other)
    return max(jax.tree.leaves(differences))


TINY = {
    "num_envs": 8,
    "unroll_length": 4,
    "batch_size": 8,
    "num_minibatches": 4,
    "num_updates_per_batch": 1,
    "network": {"policy_hidden_layer_sizes": [8], "value_hidden_layer_sizes": [8]},
}

OBS, ACTIONS = 7, 2


def beginning(ppo):
    def begin(key):
        policy_key, value_key = jax.random.split(key)
        params = losses.PPONetworkParams(
            policy=ppo.networks.policy_network.init(policy_key),
            value=ppo.networks.value_network.init(value_key),
        )
        normalizer = running_statistics.init_state(specs.Array((OBS,), jnp.dtype("float32")))
        return params, make_optimizer(ppo.config).init(params), normalizer

    return jax.jit(begin)(jax.random.PRNGKey(0))


def made_up(ppo, spoiled=()):
    """Data of one collection; the rewards of the spoiled unrolls are not numbers."""
    unrolls = ppo.config.batch_size * ppo.config.num_minibatches
    shape = (unrolls, ppo.config.unroll_length)
    rng = np.random.default_rng(0)

    def draw(*size):
        return jnp.asarray(rng.normal(size=size), jnp.float32)

    reward = draw(*shape)
    return Transition(
        observation=draw(*shape, OBS),
        action=jnp.tanh(draw(*shape, ACTIONS)),
        reward=reward.at[jnp.array(spoiled, int)].set(jnp.nan) if spoiled else reward,
        discount=jnp.ones(shape),
        next_observation=draw(unrolls, 1, OBS),
        extras={
            "policy_extras": {
                "log_prob": draw(*shape),
                "raw_action": draw(*shape, ACTIONS),
                "distribution_params": draw(*shape, 2 * ACTIONS),
            },
            "state_extras": {"truncation": jnp.zeros(shape)},
        },
    )


def lines(run_dir):
    return [json.loads(line) for line in (run_dir / "metrics.jsonl").read_text().splitlines()]
