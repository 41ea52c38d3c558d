"""Parameters and moments as vectors: each is in them once, on devices and on the host."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jetbot_mjx.agents.fused.layout import VectorLayout
from jetbot_mjx.agents.fused.learner import shape_of
from jetbot_mjx.agents.learner import TREES
from jetbot_mjx.agents.networks import NetworkParams, make_networks
from jetbot_mjx.agents.optimizer import make_optimizer
from jetbot_mjx.config import parse_config

OBSERVATIONS, ACTIONS = 5, 2


def made(distribution):
    """The networks as the kernels know them, and their parameters with the optimizer's state."""
    hidden = {f"{name}_hidden_layer_sizes": [16, 16] for name in ("policy", "value")}
    network = {"distribution_type": distribution, **hidden}
    config = parse_config({"ppo": {"network": network}}).ppo
    networks = make_networks(config, OBSERVATIONS, ACTIONS)
    keys = jax.random.split(jax.random.PRNGKey(0))
    params = NetworkParams(
        policy=networks.policy_network.init(keys[0]), value=networks.value_network.init(keys[1])
    )
    optimizer_state = make_optimizer(config).init(params)
    return shape_of(config, OBSERVATIONS, ACTIONS), (params, optimizer_state)


def assert_equal(one, other):
    assert jax.tree.structure(one) == jax.tree.structure(other)
    jax.tree.map(np.testing.assert_array_equal, one, other)


@pytest.mark.parametrize("distribution", ["tanh_normal", "normal"])
def test_vectors_become_the_same_parameters(distribution):
    shape, tree = made(distribution)
    layout = VectorLayout(shape)
    packed = layout.pack(tree)
    assert packed[0].shape == (shape.size,)
    # All numbers are there once, and nothing else.
    total = sum(float(jnp.abs(x).sum()) for x in jax.tree.leaves(tree[0]))
    np.testing.assert_allclose(jnp.abs(packed[0]).sum(), total, rtol=1e-5)
    assert_equal(layout.unpack(packed), tree)


def test_arrays_of_the_host_stay_there():
    shape, tree = made("tanh_normal")
    layout, on_host = VectorLayout(shape), jax.device_get(tree)
    packed = layout.pack(on_host)
    assert isinstance(packed[0], np.ndarray)
    assert_equal(packed, jax.device_get(layout.pack(tree)))
    assert_equal(layout.unpack(packed), on_host)


def test_the_room_for_metrics_is_behind_the_parameters_of_each_network():
    shape, tree = made("normal")
    filled = jax.tree.map(jnp.ones_like, tree[0])
    vector = np.asarray(VectorLayout(shape).pack(filled))
    expected = np.zeros(shape.size)
    for start, end in shape.ranges:
        expected[start:end] = 1
    np.testing.assert_array_equal(vector, expected)


def test_trees_stay_trees():
    _, tree = made("normal")
    assert TREES.pack(tree) is tree
    assert TREES.unpack(tree) is tree
