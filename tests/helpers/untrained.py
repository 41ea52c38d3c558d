"""Run folders whose policies nobody trained."""

import jax
import jax.numpy as jnp
import numpy as np

from jetbot_mjx.agents.networks import PolicyParams, init_normalizer, make_networks
from jetbot_mjx.config import Config
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.runs.checkpoint import about_policy
from jetbot_mjx.runs.checkpoint_store import CheckpointStore
from jetbot_mjx.runs.trust import record_code


def write_untrained_run(folder, config: Config, steps=(0,), scores=None):
    """Write a run folder with a checkpoint for each number of steps; returns the environment.

    `scores` are the checkpoints' success rates by steps; those that are not given are 0.5.
    """
    env = make_env(config)
    size, actions = env.observation_size, env.action_size
    networks = make_networks(config.ppo, size, actions)
    folder.mkdir()
    record_code(folder, config, None)
    with CheckpointStore(folder, keep=len(steps)) as checkpoints:
        for env_steps in steps:
            key, score = jax.random.PRNGKey(env_steps), (scores or {}).get(env_steps, 0.5)
            policy, value = networks.policy_network.init(key), networks.value_network.init(key)
            params = PolicyParams(init_normalizer(size), policy, value)
            trees = {
                "policy": jax.tree.map(
                    lambda x: np.asarray(x, np.asarray(jnp.asarray(x)).dtype), params
                )
            }
            about = about_policy(config, env) | {"metrics": {"success_rate": score}}
            checkpoints.save(env_steps, trees, about, score)
    return env
