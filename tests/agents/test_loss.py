"""The loss of a minibatch against Brax's, values and gradients; of images in `test_vision`."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import losses
from brax.training.types import Transition

from jetbot_mjx.agents.gae import compute_gae
from jetbot_mjx.agents.loss import ppo_loss
from jetbot_mjx.agents.networks import make_networks
from jetbot_mjx.agents.train_state import LOSSES
from jetbot_mjx.config import parse_config

UNROLLS, TIME, OBS, ACTIONS = 8, 6, 5, 2


def minibatch(distribution):
    rng = np.random.default_rng(0)
    shape = UNROLLS, TIME

    def draw(*size):
        return jnp.asarray(rng.normal(size=size), jnp.float32)

    def some():
        return jnp.asarray(rng.uniform(size=shape) < 0.2, jnp.float32)

    means, deviations = draw(*shape, ACTIONS), jnp.abs(draw(*shape, ACTIONS)) + 0.1
    return Transition(
        observation=draw(*shape, OBS),
        action=draw(*shape, ACTIONS),
        reward=draw(*shape),
        discount=1 - some(),
        next_observation=draw(UNROLLS, 1, OBS),
        extras={
            "policy_extras": {
                "log_prob": draw(*shape) - 2,
                "raw_action": draw(*shape, ACTIONS),
                "distribution_params": (means, deviations)
                if distribution == "normal"
                else jnp.concatenate([means, deviations], axis=-1),
            },
            "state_extras": {"truncation": some()},
        },
    )


def both(settings):
    """Loss, metrics and gradient of ours and of Brax's loss."""
    config = parse_config({"ppo": {"reward_scaling": 3.0, **settings}}).ppo
    networks = make_networks(config, OBS, ACTIONS)
    params = losses.PPONetworkParams(
        policy=networks.policy_network.init(jax.random.PRNGKey(1)),
        value=networks.value_network.init(jax.random.PRNGKey(2)),
    )
    normalizer = running_statistics.init_state(specs.Array((OBS,), jnp.dtype("float32")))
    batch, key = minibatch(config.network.distribution_type), jax.random.PRNGKey(3)

    def ours(params):
        return ppo_loss(params, normalizer, batch, key, networks=networks, config=config)

    def brax(params):
        loss, metrics = losses.compute_ppo_loss(
            params,
            normalizer,
            batch,
            key,
            ppo_network=networks,
            entropy_cost=config.entropy_cost,
            discounting=config.discounting,
            reward_scaling=config.reward_scaling,
            gae_lambda=config.gae_lambda,
            clipping_epsilon=config.clipping_epsilon,
            normalize_advantage=config.normalize_advantage,
            vf_coefficient=config.vf_loss_coefficient,
        )
        # What is not asked for would change how XLA fuses the rest.
        return loss, {name: metrics[name] for name in LOSSES if name in metrics}

    return [jax.jit(jax.value_and_grad(loss, has_aux=True))(params) for loss in (ours, brax)]


SETTINGS = [
    {"entropy_cost": 0.01},
    {"normalize_advantage": False, "clipping_epsilon": 0.1},
    {"network": {"distribution_type": "normal"}, "vf_loss_coefficient": 0.3},
]


@pytest.mark.parametrize("settings", SETTINGS)
def test_the_loss_is_braxs(settings):
    ((loss, metrics), gradient), ((wanted, their_metrics), their_gradient) = both(settings)
    assert float(loss) == pytest.approx(float(wanted), rel=1e-5)
    assert metrics.keys() == their_metrics.keys()
    for name, value in metrics.items():
        assert float(value) == pytest.approx(float(their_metrics[name]), rel=1e-5, abs=1e-6), name
    jax.tree.map(
        lambda one, other: np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-6),
        gradient,
        their_gradient,
    )


@pytest.mark.parametrize("settings", SETTINGS)
def test_but_for_the_advantages_its_operations_are_braxs(settings, monkeypatch):
    monkeypatch.setattr(losses, "compute_gae", compute_gae)
    ((loss, metrics), gradient), ((wanted, their_metrics), their_gradient) = both(settings)
    assert loss == wanted
    assert metrics == their_metrics
    jax.tree.map(np.testing.assert_array_equal, gradient, their_gradient)
