"""The action around which an untrained policy acts."""

import copy

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jetbot_mjx.agents.networks import (
    PolicyParams,
    init_normalizer,
    make_networks,
    make_policy,
    network_factory,
)
from jetbot_mjx.config import ConfigError, parse_config
from jetbot_mjx.envs.camera.wrapper import PIXELS
from jetbot_mjx.errors import InvalidError

ACTION = [-0.3, 0.6]


def config(**network):
    sizes = {"policy_hidden_layer_sizes": [8] * 11, "value_hidden_layer_sizes": [8], "cnn": "tiny"}
    return parse_config({"ppo": {"network": {**sizes, **network}}}).ppo


@pytest.mark.parametrize("observation", [5, {PIXELS: (16, 16, 3)}], ids=["numbers", "image"])
@pytest.mark.parametrize("distribution", ["tanh_normal", "normal"])
def test_an_untrained_policy_acts_around_the_initial_action(distribution, observation):
    network = {"distribution_type": distribution}
    actions = []
    for changes in (network, {**network, "initial_action": ACTION}):
        networks = make_networks(config(**changes), observation, 2)
        weights = networks.policy_network.init(jax.random.PRNGKey(0))
        params = PolicyParams(init_normalizer(observation), weights, None)
        # Biases are zero, so that an observation of zeros leaves only those of the last layer.
        zeros = np.zeros(5) if observation == 5 else {PIXELS: np.zeros((16, 16, 3), np.uint8)}
        actions.append(make_policy(networks, params)(zeros))
    np.testing.assert_allclose(actions, [[0.0, 0.0], ACTION], atol=1e-6)


def test_all_other_weights_are_those_without_it():
    key = jax.random.PRNGKey(0)
    plain = make_networks(config(), 5, 2).policy_network.init(key)
    other = make_networks(config(initial_action=ACTION), 5, 2).policy_network.init(key)
    same = jax.tree.map(lambda x, y: bool(jnp.array_equal(x, y)), plain, other)
    assert jax.tree.leaves(same).count(False) == 1
    assert not same["params"]["hidden_11"]["bias"]


@pytest.mark.parametrize("by_factory", [False, True])
def test_it_needs_a_number_for_each_action(by_factory):
    ppo = config(initial_action=[0.5])
    with pytest.raises(InvalidError) as caught:
        network_factory(ppo.network)(5, 2) if by_factory else make_networks(ppo, 5, 2)
    assert str(caught.value) == (
        "ppo.network.initial_action = [0.5] is wrong: an action has 2 numbers"
    )


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy])
def test_networks_can_be_copied(copied):
    networks = make_networks(config(), 5, 2)
    key = jax.random.PRNGKey(0)
    both = [one.value_network.init(key) for one in (networks, copied(networks))]
    assert jax.tree.all(jax.tree.map(lambda x, y: bool(jnp.array_equal(x, y)), *both))


@pytest.mark.parametrize("action", [[0.0, 1.0], [-1, 0], [], [float("nan"), 0.0]])
def test_it_lies_inside_of_the_bounds(action):
    with pytest.raises(ConfigError, match=r"ppo\.network\.initial_action"):
        config(initial_action=action)
