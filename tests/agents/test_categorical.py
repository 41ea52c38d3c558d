"""The distribution of a choice, against NumPy's numbers and the frequency of its draws."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jetbot_mjx.agents.categorical import CategoricalDistribution

CHOICES = 4
DISTRIBUTION = CategoricalDistribution(CHOICES)


@pytest.fixture
def logits():
    return 2 * np.random.default_rng(0).standard_normal((5, CHOICES)).astype(np.float32)


def probabilities(logits):
    powers = np.exp(logits.astype(np.float64))
    return powers / powers.sum(-1, keepdims=True)


def test_a_network_has_one_output_for_each_choice():
    assert DISTRIBUTION.param_size == CHOICES


@pytest.mark.parametrize("choice", range(CHOICES))
def test_the_probability_of_a_choice(logits, choice):
    action = np.tile(np.eye(CHOICES, dtype=np.float32)[choice], (5, 1))
    ours = DISTRIBUTION.log_prob(jnp.asarray(logits), jnp.asarray(action))
    np.testing.assert_allclose(ours, np.log(probabilities(logits)[:, choice]), rtol=1e-5)


def test_the_entropy(logits):
    p = probabilities(logits)
    ours = DISTRIBUTION.entropy(jnp.asarray(logits), jax.random.PRNGKey(0))
    np.testing.assert_allclose(ours, -(p * np.log(p)).sum(-1), rtol=1e-5)
    even = DISTRIBUTION.entropy(jnp.zeros(CHOICES), jax.random.PRNGKey(0))
    assert even == pytest.approx(np.log(CHOICES), rel=1e-6)


def test_the_divergence_is_of_the_old_distribution_from_the_new_one(logits):
    old, new = probabilities(logits[:1])[0], probabilities(logits[1:2])[0]
    ours = DISTRIBUTION.create_dist(jnp.asarray(logits[1])).kl_divergence(
        DISTRIBUTION.create_dist(jnp.asarray(logits[0]))
    )
    assert float(ours) == pytest.approx((old * np.log(old / new)).sum(), rel=1e-5)


def test_draws_have_the_frequencies_of_their_probabilities(logits):
    count = 20_000
    keys = jax.random.split(jax.random.PRNGKey(1), count)
    draws = np.asarray(jax.vmap(lambda key: DISTRIBUTION.sample(jnp.asarray(logits), key))(keys))
    assert {*np.unique(draws)} == {0.0, 1.0}
    np.testing.assert_array_equal(draws.sum(-1), 1.0)
    p = probabilities(logits)
    assert np.all(np.abs(draws.mean(0) - p) < 4.5 * np.sqrt(p * (1 - p) / count) + 1e-6)


def test_the_mode_is_the_most_probable_choice(logits):
    mode = DISTRIBUTION.mode(jnp.asarray(logits))
    np.testing.assert_array_equal(mode, np.eye(CHOICES)[logits.argmax(-1)])


def test_the_scale_is_the_deviation_of_each_number(logits):
    p = probabilities(logits)
    ours = DISTRIBUTION.create_dist(jnp.asarray(logits)).scale
    np.testing.assert_allclose(ours, np.sqrt(p * (1 - p)), rtol=1e-4, atol=1e-6)
