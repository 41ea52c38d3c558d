"""The unrolled factor against the library's, alone and inside MJX."""

import threading

import jax
import jax.numpy as jnp
import jax.scipy.linalg
import numpy as np
import pytest

from jetbot_mjx.config import parse_config
from jetbot_mjx.envs import cholesky
from jetbot_mjx.envs.jetbot_env import make_env

library = jax.scipy.linalg.cho_factor, jax.scipy.linalg.cho_solve


def matrices(count, size, seed=0):
    """Symmetric, positive definite, with eigenvalues from 1e-3 to 10."""
    rng = np.random.default_rng(seed)
    turns = np.linalg.qr(rng.normal(size=(count, size, size)))[0]
    values = 10 ** rng.uniform(-3, 1, (count, size))
    return jnp.asarray(np.einsum("bij,bj,bkj->bik", turns, values, turns), jnp.float32)


@pytest.mark.parametrize("size", [1, 2, 8, 16])
def test_the_factor_is_the_librarys(size):
    a = matrices(4, size)
    ours, lower = jax.vmap(cholesky.cho_factor)(a)
    theirs = jnp.triu(jax.vmap(lambda one: library[0](one)[0])(a))
    assert not np.any(lower)
    np.testing.assert_allclose(ours, theirs, rtol=2e-4, atol=2e-5)


@pytest.mark.parametrize("columns", [(), (3,)])
def test_solutions_are_as_good_as_the_librarys(columns):
    a = matrices(256, 8)
    x = np.random.default_rng(1).normal(size=(256, 8, *columns))
    b = jnp.asarray(np.einsum("bij,bj...->bi...", np.asarray(a, np.float64), x), jnp.float32)

    def error(factor, solve):
        missed = np.abs(jax.vmap(lambda a, b: solve(factor(a), b))(a, b) - x)
        return np.median(missed.reshape(256, -1).max(axis=1))

    assert error(cholesky.cho_factor, cholesky.cho_solve) < 1.5 * error(*library)


def test_either_solves_from_the_others_factor():
    a, b = matrices(1, 8)[0], jnp.arange(8.0)
    expected = np.linalg.solve(np.asarray(a, np.float64), b)
    for solve, factor in ((library[1], cholesky.cho_factor), (cholesky.cho_solve, library[0])):
        np.testing.assert_allclose(solve(factor(a), b), expected, rtol=1e-2, atol=1e-2)


def test_what_is_not_positive_definite_gives_nan():
    a = jnp.diag(jnp.array([1.0, -1.0, 1.0]))
    assert np.isnan(cholesky.cho_factor(a)[0]).any()


def test_what_is_large_lower_or_batched_is_the_librarys_part():
    large = matrices(1, 17)[0]
    np.testing.assert_array_equal(cholesky.cho_factor(large)[0], library[0](large)[0])
    batch = matrices(2, 4)
    np.testing.assert_array_equal(cholesky.cho_factor(batch)[0], library[0](batch)[0])
    one = batch[0]
    factor = cholesky.cho_factor(one, lower=True)
    np.testing.assert_array_equal(factor[0], library[0](one, lower=True)[0])
    b = jnp.ones(4)
    np.testing.assert_array_equal(cholesky.cho_solve(factor, b), library[1](factor, b))


def test_outside_it_all_is_as_before():
    with cholesky.unrolled():
        assert jax.scipy.linalg.cho_factor is cholesky.cho_factor
        with cholesky.unrolled():
            pass
        assert jax.scipy.linalg.cho_solve is cholesky.cho_solve
    assert (jax.scipy.linalg.cho_factor, jax.scipy.linalg.cho_solve) == library


def test_threads_take_turns():
    entered, leave, seen = threading.Event(), threading.Event(), []

    def other():
        with cholesky.unrolled():
            seen.append(leave.is_set())

    thread = threading.Thread(target=other)
    with cholesky.unrolled():
        thread.start()
        entered.wait(0.1)
        leave.set()
    thread.join()
    assert seen == [True]
    assert (jax.scipy.linalg.cho_factor, jax.scipy.linalg.cho_solve) == library


@pytest.mark.parametrize(("choice", "calls"), [("unrolled", False), ("library", True)])
def test_the_choice_decides_whether_physics_calls_a_library(choice, calls):
    env = make_env(parse_config({"physics": {"cholesky": choice, "impl": "xla"}}))
    state = env.reset(jax.random.PRNGKey(0)).pipeline_state
    text = jax.jit(env.step_physics).lower(state, jnp.zeros(2)).as_text()
    assert ("potrf" in text or "cholesky" in text) == calls
