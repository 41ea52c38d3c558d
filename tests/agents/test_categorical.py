"""The distribution of an action that is a choice, beside SciPy's and NumPy's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special, stats

from jetbot_mjx.agents.categorical import CategoricalDistribution, Choice

LOGITS = np.random.default_rng(0).normal(scale=2.0, size=(5, 4)).astype(np.float32)
PROBS = special.softmax(LOGITS.astype(float), axis=-1)


@pytest.fixture(scope="module")
def head():
    return CategoricalDistribution(4)


def test_log_prob_is_that_of_the_choice(head):
    for choice in range(4):
        action = jax.nn.one_hot(jnp.full(5, choice), 4)
        got = head.log_prob(jnp.asarray(LOGITS), action)
        np.testing.assert_allclose(got, np.log(PROBS[:, choice]), rtol=1e-5)


def test_entropy_is_scipy_s(head):
    got = head.entropy(jnp.asarray(LOGITS), jax.random.PRNGKey(0))
    np.testing.assert_allclose(got, stats.entropy(PROBS, axis=-1), rtol=1e-5)


def test_divergence_is_scipy_s(head):
    new, old = map(head.create_dist, (jnp.asarray(LOGITS[:4]), jnp.asarray(LOGITS[1:])))
    expected = stats.entropy(PROBS[1:], PROBS[:4], axis=-1)
    np.testing.assert_allclose(new.kl_divergence(old), expected, rtol=1e-4)
    np.testing.assert_allclose(new.kl_divergence(new), 0, atol=1e-7)


def test_scale_is_the_deviation_of_each_number(head):
    got = head.create_dist(jnp.asarray(LOGITS)).scale
    np.testing.assert_allclose(got, stats.bernoulli(PROBS).std(), rtol=1e-5)


def test_samples_are_one_hot_as_often_as_they_are_probable(head):
    count = 4096
    keys = jax.random.split(jax.random.PRNGKey(1), count)
    drawn = np.asarray(jax.vmap(lambda key: head.sample(jnp.asarray(LOGITS), key))(keys))
    assert set(np.unique(drawn)) == {0.0, 1.0}
    assert (drawn.sum(axis=-1) == 1).all()
    for row, probs in zip(drawn.sum(axis=0), PROBS, strict=True):
        assert stats.chisquare(row, count * probs).pvalue > 1e-3


def test_an_action_goes_through_brax_s_functions_unchanged(head):
    drawn = head.sample_no_postprocessing(jnp.asarray(LOGITS), jax.random.PRNGKey(1))
    np.testing.assert_array_equal(head.postprocess(drawn), drawn)
    np.testing.assert_array_equal(head.inverse_postprocess(drawn), drawn)
    assert head.param_size == 4


def test_the_mode_is_the_most_probable(head):
    np.testing.assert_array_equal(
        head.mode(jnp.asarray(LOGITS)), np.eye(4, dtype=np.float32)[PROBS.argmax(axis=-1)]
    )


def test_a_choice_that_is_certain_has_finite_numbers():
    certain = Choice(jax.nn.log_softmax(jnp.array([1e4, 0.0, -1e4])))
    assert float(certain.entropy().sum()) == 0
    assert float(certain.log_prob(jnp.array([1.0, 0.0, 0.0])).sum()) == 0
    np.testing.assert_array_equal(certain.mode(), [1, 0, 0])
