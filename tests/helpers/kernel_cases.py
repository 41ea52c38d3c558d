"""Functions of one robot that the kernel compiler is tried with, on every back end."""

import jax
import jax.numpy as jnp
import numpy as np

VECTOR = jax.ShapeDtypeStruct((4,), jnp.float32)

ARITHMETIC = {
    "arithmetic": lambda x: (x + 2) * x - x / (x - 3),
    "roots and floors": lambda x: jnp.sqrt(jnp.abs(x)) + jnp.floor(-x),
    "extremes": lambda x: jnp.maximum(x, x[::-1]) - jnp.minimum(x, 0.25),
    "extremes of a constant": lambda x: jnp.maximum(0.5, x) - jnp.minimum(x, -0.5),
    "extremes of whole numbers": lambda x: (
        jnp.maximum((x * 9).astype(int), jnp.abs((x[::-1] * 9).astype(int)))
        - jnp.minimum((x * 7).astype(int), 2)
    ).astype(jnp.float32),
    "angles": lambda x: jnp.sin(x * 20) + jnp.cos(x),
    "comparisons": lambda x: (
        (x < 0)
        + 2.0 * (x <= x[0])
        + 4.0 * (x > 1)
        + 8.0 * (x >= x[1])
        + 16.0 * (x == x[2])
        + 32.0 * (x != x[3])
    ),
    "logic": lambda x: jnp.where(((x > 0) | (x[0] > 0)) & ~((x > 1) ^ (x[1] > 1)), x, -x),
    "truths chosen": lambda x: jnp.where(jnp.where(x > 0, x[0] > 0, x[1] > 0), 1.0, x),
    "whole numbers": lambda x: ((x * 3).astype(jnp.int32) * jnp.argmin(x) - 2).astype(jnp.float32),
    "whole numbers compared": lambda x: jnp.where(
        ((x * 3).astype(int) < 1) == (-(x * 3).astype(int) != (x[::-1] * 3).astype(int)), x, 0.0
    ),
    "numbers too large": lambda x: (x * 1e20).astype(int).astype(jnp.float32),
    "what is finite": lambda x: jnp.where(jnp.isfinite(1 / jnp.floor(x)), x, 0.0),
    "truth of a number": lambda x: jnp.where(x.astype(bool) == (x > 0).astype(bool), x, 5.0),
    "one of three by a whole number": lambda x: jax.lax.select_n(
        jnp.clip((x * 2).astype(jnp.int32) + 1, 0, 2), x, 2 * x, x - 1
    ),
    "one of two by a whole number": lambda x: jax.lax.select_n((x > 0).astype(jnp.int32), x, x + 9),
    "places that are promised": lambda x: x.at[jnp.array([3, 0, 1, 1])].get(
        mode="promise_in_bounds"
    ),
}


def _root(x):
    """Newton's method until it has converged, for each robot another number of trips."""
    wanted = jnp.abs(x[0]) * 100 + 1.0

    def going(state):
        y, count = state
        return (jnp.abs(y * y - wanted) > 1e-3 * wanted) & (count < 60)

    def trip(state):
        y, count = state
        return 0.5 * (y + wanted / y), count + 1

    y, count = jax.lax.while_loop(going, trip, (wanted, 0))
    return jnp.array([y, count, x[1], wanted])


def _nested(x):
    """A loop in a loop, the inner one as long as the outer one's number says."""

    def outer(state):
        total, n = state
        inner = jax.lax.while_loop(
            lambda s: s[1] < n, lambda s: (s[0] + jnp.cos(s[0]) * x, s[1] + 1), (total, 0)
        )
        return inner[0] * 0.5, n - 1

    return jax.lax.while_loop(
        lambda s: s[1] > 0, outer, (x, jnp.floor(jnp.abs(x[0]) * 3).astype(int))
    )[0]


def _heavy(x):
    """Some sixty operations on each number."""
    for _ in range(4):
        x = jnp.sin(x) + x[::-1] * 0.5
    return x


def _scan_of_cond(x):
    """As MJX's line search: a fixed number of trips that do nothing once a condition fails."""

    def trip(state, _):
        y, going = state
        y, going = jax.lax.cond(going, lambda y: (_heavy(y), y[0] < 1.0), lambda y: (y, False), y)
        return (y, going), None

    return jax.lax.scan(trip, (x, x[1] < 1.0), length=6)[0][0]


def _derived(x):
    """What a trip needs is prepared at the end of the one before, as MJX's solver does."""

    def prepared(y):
        return y, _heavy(y) * 0.25

    def trip(state):
        y, ahead, count = state
        return *prepared(y * 0.5 + ahead), count + 1

    def going(state):
        y, _, count = state
        return (jnp.abs(y).max() > 0.3) & (count < 9)

    return jax.lax.while_loop(going, trip, (*prepared(x), 0))[0]


LOOPS = {
    "a loop until it converges": _root,
    "a loop in a loop": _nested,
    "a loop of conditions": _scan_of_cond,
    "what is prepared for the next trip": _derived,
    "a loop that is never begun": lambda x: jax.lax.while_loop(
        lambda y: (y > 1e6).any(), lambda y: y - 1.0, x
    ),
    "a carry that stays": lambda x: (
        jax.lax.while_loop(
            lambda s: s[0] < x[1], lambda s: (s[0] + 1.0, s[1], s[2]), (x[0], jnp.float32(3), x[2])
        )[1]
        * x
    ),
    "a branch": lambda x: jax.lax.cond(x[0] > 0, _heavy, lambda x: x, x),
    "two heavy sides": lambda x: jax.lax.cond(x[0] > 0, _heavy, lambda x: _heavy(-x), x),
    "one of four": lambda x: jax.lax.switch(
        (x[0] * 2).astype(int), [_heavy, lambda x: -x, lambda x: _heavy(2 * x), lambda x: x], x
    ),
    "a branch in a loop": lambda x: jax.lax.fori_loop(
        0, 12, lambda i, y: jax.lax.cond(y[0] > 0.2, _heavy, lambda y: y + 0.1, y), x
    ),
    "several loops at once": lambda x: jax.vmap(
        lambda a: jax.lax.while_loop(lambda y: y < 2.0, lambda y: y * 1.5 + 0.25, jnp.abs(a))
    )(x),
    "an index that counts": lambda x: jax.lax.fori_loop(
        0, 4, lambda i, y: y.at[i].add(x[3 - i]), x
    ),
}

FUNCTIONS = {**ARITHMETIC, **LOOPS}


def robots(count):
    """As many robots' arguments, none at a place where rounding decides."""
    x = np.float32(np.random.default_rng(5).normal(size=(count, 4)))
    x[3 % count, 2] = 0
    return x
