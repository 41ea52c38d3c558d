"""Programs run in NumPy, without a compiler."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from onekernel import UnsupportedError
from onekernel.build import evaluate, scalarize

VECTOR = jax.ShapeDtypeStruct((3,), jnp.float32)
X = np.random.default_rng(0).normal(size=(3, 20)).astype(np.float32)


def test_a_program_is_evaluated_for_all_instances_at_once():
    def function(x):
        return jnp.where(x > 0, jnp.exp(x), x * x.sum()), jnp.tanh(x[0])

    found = evaluate(scalarize(function, VECTOR), list(X))
    expected = jax.vmap(function)(X.T)
    np.testing.assert_allclose(np.stack(found[:3], 1), expected[0], rtol=2e-6, atol=1e-6)
    np.testing.assert_allclose(found[3], expected[1], rtol=2e-6, atol=1e-6)


def test_numbers_are_found_by_their_places():
    table = np.float32(np.random.default_rng(1).normal(size=300))

    def function(x):
        place = (jnp.abs(x) * 100).astype(int)
        return jnp.array(table)[place] + (jnp.array(table) * x[0])[place[::-1]]

    found = evaluate(scalarize(function, VECTOR), list(X))
    np.testing.assert_allclose(np.stack(found, 1), jax.vmap(function)(X.T), rtol=2e-6, atol=1e-6)


def test_a_program_with_a_loop_is_refused():
    def function(x):
        return jax.lax.while_loop(lambda y: y.sum() < 9, lambda y: y * 2 + 1, x)

    with pytest.raises(UnsupportedError):
        evaluate(scalarize(function, VECTOR), list(X))
