"""The evaluation of a function with other round-off: which numbers it changes, and by how much."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from onekernel import round_off
from onekernel.lower import control_flow
from onekernel.lower.jaxpr import primitives

X = np.float32(2.1)
COUNT = np.arange(6, dtype=np.int32)


def evaluate(function, seed, *arguments):
    """Return the leaves of a function's results, with the round-off of a seed."""
    flat = round_off.noisy(lambda *x: jax.tree.leaves(function(*x)))
    return [np.asarray(x) for x in jax.jit(flat)(jnp.uint32(seed), *arguments)]


@jax.custom_vjp
def with_gradient(x):
    return x * 1.5


with_gradient.defvjp(lambda x: (x * 1.5, None), lambda _, g: (g * 1.5,))


@jax.custom_jvp
def with_derivative(x):
    return x / 7


with_derivative.defjvp(lambda x, t: (x[0] / 7, t[0] / 7))

MATRIX = np.float32([[4, 1, 0], [1, 5, 2], [0, 2, 6]])

CALLS = {
    "a call": jax.jit(lambda n: n / 7.0),
    "a custom derivative": with_derivative,
    "a custom gradient": with_gradient,
    "a computation again": jax.grad(jax.checkpoint(lambda n: jnp.sin(jnp.sin(n)).sum())),
    "a scan": lambda n: jax.lax.scan(lambda c, x: (c + x / 7, c / 3), 0.1, n),
    "a scan backwards": lambda n: jax.lax.scan(lambda c, x: (c + x / 7, c / 3), 0.1, n, 6, True),
    "a while": lambda n: jax.lax.while_loop(
        lambda state: state[0] < n[2],
        lambda state: (state[0] + 1, state[1] / 3 + n[4]),
        (0.0, n),
    ),
    "whiles in a batch": jax.vmap(
        lambda n: jax.lax.while_loop(
            lambda state: state[0] < n, lambda state: (state[0] + 1, state[1] / 3 + n), (0.0, 1.0)
        )
    ),
    "a branch": lambda n: jax.lax.cond(n[1] > 0, lambda x: x / 7, lambda x: x / 3, n),
    "a switch": lambda n: jax.lax.switch(n[1].astype(int), [jnp.sin, jnp.cos, lambda x: x / 3], n),
    "a sum": lambda n: (n * np.float32([0.1, 0.2, 0.3, 0.4, 0.5, -0.6])).sum(),
    "a solver": lambda n: jnp.linalg.solve(MATRIX, n[:3]),
    "symmetric equations": lambda n: jax.scipy.linalg.solve(MATRIX, n[:3], assume_a="pos"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CALLS)
def test_arithmetic_is_rounded_otherwise_wherever_it_is(name):
    # The arguments are whole, and so exact: all noise comes from inside.
    whole = COUNT.astype(np.float32)
    plain = jax.tree.leaves(CALLS[name](whole))
    first, again, other = (evaluate(CALLS[name], seed, whole) for seed in (1, 1, 2))
    for a, b, c, d in zip(plain, first, again, other, strict=True):
        np.testing.assert_array_equal(b, c)
        np.testing.assert_allclose(a, b, rtol=3e-5, atol=1e-6)
        np.testing.assert_allclose(a, d, rtol=3e-5, atol=1e-6)
    assert any((x != y).any() for x, y in zip(first, other, strict=True))


EXACT = {
    "a permutation": lambda n: jax.random.permutation(jax.random.key(n[0]), 6),
    "random bits": lambda n: jax.random.bits(jax.random.key(n[0]), (4,)),
    "a counter": lambda n: jax.lax.fori_loop(0, 9, lambda i, c: c + 2.0, n.astype(float)),
    "half a count": lambda n: jnp.floor(n.astype(float) * 3.0 / 2.0),
    "a sum of squares": lambda n: n.astype(float) @ n.astype(float),
    "a bit pattern": lambda n: jax.lax.bitcast_convert_type(n + (127 << 23), jnp.float32),
    "a choice": lambda n: jnp.where(n > 2, 0.1, -0.7)[::-1],
    "largest numbers": lambda n: jnp.sort(jnp.maximum(jnp.where(n > 2, 0.3, 0.2), 0.1)),
}


@pytest.mark.parametrize("name", EXACT)
def test_what_is_exact_stays(name):
    plain = jax.tree.leaves(EXACT[name](COUNT))
    for seed in (1, 2, 3):
        for x, y in zip(plain, evaluate(EXACT[name], seed, COUNT), strict=True):
            np.testing.assert_array_equal(x, y)


def test_each_number_has_noise_of_its_own():
    (found,) = evaluate(lambda x: x * 1, 5, np.full(1000, 0.7, np.float32))
    change = found.astype(float) / np.float32(0.7) - 1
    assert len(np.unique(found)) > 5
    # An argument is changed, and the product again.
    most = round_off._NOISE * np.finfo(np.float32).eps
    assert 1 < np.abs(change).max() / most < 2.5
    assert abs(change.mean()) < 0.1 * most


def test_numbers_of_64_bits_have_noise_in_their_own_last_bits():
    with jax.enable_x64(True):
        (found,) = evaluate(lambda x: x * 1, 5, np.full(1000, 0.7))
    assert found.dtype == np.float64
    change = found / 0.7 - 1
    assert 1 < np.abs(change).max() / (round_off._NOISE * np.finfo(float).eps) < 2.5
    assert len(np.unique(found)) > 5


def test_a_loop_that_waits_until_nothing_changes_ends():
    def function(x):
        def step(pair):
            return 0.5 * (pair[0] + x / pair[0]), pair[0]

        return jax.lax.while_loop(lambda pair: pair[0] != pair[1], step, (x, x + 1))

    for seed in range(1, 9):
        root, before = evaluate(function, seed, X)
        assert root == before
        np.testing.assert_allclose(root, np.sqrt(X), rtol=1e-6)


def test_infinity_and_nan_stay():
    (found,) = evaluate(lambda x: x * 2, 5, np.float32([np.inf, -np.inf, np.nan, 0]))
    np.testing.assert_array_equal(found, np.float32([np.inf, -np.inf, np.nan, 0]))


def test_all_names_are_those_of_primitives_that_a_kernel_may_have():
    known = {name for names in primitives().values() for name in names}
    # `jit`, `remat2` and `closed_call` have another name in other versions of JAX.
    aliases = {"pjit", "checkpoint", "closed_call", "eval_jaxpr"}
    assert known | aliases >= round_off._EXACT | round_off._SUMS | control_flow.CALLS
    calls = {name[1:] for name in vars(round_off._Evaluation) if not name.startswith("__")}
    assert {"scan", "while", "cond"} <= calls & known
