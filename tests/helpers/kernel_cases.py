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


def _ends(*columns):
    """Four numbers of what a scan returns."""
    return jnp.stack([columns[i % len(columns)][place] for i, place in enumerate((0, 57, -2, -1))])


def _sums(x, reverse=False):
    """What a step is given, and a number that depends on all before, in every step."""
    given = x[0] * jnp.arange(100) + x[1]
    last, sums = jax.lax.scan(lambda c, a: (c * 0.9 + a, c - a), x[2], given, reverse=reverse)
    return _ends(sums) * 0.01 + last


def _trajectory(x):
    """Euler's method for an oscillator, whose states are returned by step."""

    def step(y, _):
        y = y + 0.05 * jnp.array([y[1], -y[0] - 0.1 * y[1]])
        return y, y

    states = jax.lax.scan(step, x[:2], length=200)[1]
    return _ends(states[:, 0], states[:, 1]) + states.sum() * 0.01


def _several_sequences(x):
    """Floats, both kinds of whole numbers, truths and keys, given and returned."""
    n, whole = 70, jax.lax.bitcast_convert_type(x[0], jnp.uint32)
    counts = (x[1] * 8).astype(jnp.int32) - jnp.arange(n) * 3
    given = x[2] * jnp.arange(n), counts, whole + jnp.arange(n, dtype=jnp.uint32), counts % 2 == 0
    keys = jax.vmap(lambda i: jax.random.wrap_key_data(jnp.stack([whole, i])))(
        jnp.arange(n, dtype=jnp.uint32)
    )

    def step(carry, row):
        (number, count, word, truth), key = row
        drawn = jax.random.bits(key)
        carry = carry + jnp.where(truth, number, count.astype(jnp.float32))
        return carry, (
            carry,
            count * 2,
            word ^ drawn,
            truth != (carry > 0),
            jax.random.split(key)[0],
        )

    total, (floats, counts, words, truths, made) = jax.lax.scan(step, x[3], (given, keys))
    bits = (words ^ jax.random.key_data(made)[:, 1]) >> 24
    return _ends(floats, counts, bits, truths.astype(jnp.float32)) * 0.01 + total


def _scan_in_scan(x):
    """An inner scan returns its steps anew in every step of the outer one."""

    def outer(y, a):
        end, inner = jax.lax.scan(lambda c, b: (c * 0.5 + b * a, c + b), y, jnp.arange(80) * x[0])
        return end * 0.5, inner[::-1][a % 7] + inner[40]

    end, returned = jax.lax.scan(outer, x[1], jnp.arange(66))
    return _ends(returned) * 1e-3 + end * 1e-3


def _scan_in_loop(x):
    """Each robot makes as many rounds as it needs, of a scan and what follows from its steps."""

    def trip(state):
        y, count = state
        steps = jax.lax.scan(lambda c, a: (c + a * 1e-3, c * a), y, jnp.arange(65) * x[1])[1]
        return 0.5 * y + 1e-4 * steps[64] + 1e-4 * jnp.flip(steps)[60], count + 1

    y, count = jax.lax.while_loop(
        lambda s: (jnp.abs(s[0]) > 0.05) & (s[1] < 9), trip, (x[0] * 4, 0)
    )
    return jnp.stack([y, count, x[1], y * x[2]])


def _derivative(x):
    def loss(x):
        def step(c, a):
            c = jnp.sin(c * x[0] * 0.5) + a
            return c, c

        return (jax.lax.scan(step, x[3], x[1] * jnp.arange(90))[1] ** 2).mean() * 1e-3

    return jax.grad(loss)(x)


_TABLE = np.float32(np.random.default_rng(9).normal(size=300))

SCANS = {
    "given and returned by step": _sums,
    "from the last step to the first": lambda x: _sums(x, reverse=True),
    "states by step": _trajectory,
    "several sequences": _several_sequences,
    "a scan in a scan": _scan_in_scan,
    "a scan in a loop": _scan_in_loop,
    "a scan on one side": lambda x: jax.lax.cond(x[0] > 0, _sums, lambda x: x, x),
    "a derivative": _derivative,
    "a place in a table": lambda x: jnp.array(_TABLE)[(jnp.abs(x) * 100).astype(int)],
    "a place among numbers": lambda x: (x[0] * jnp.array(_TABLE))[(jnp.abs(x) * 100).astype(int)],
    "a window": lambda x: jax.lax.dynamic_slice(
        x[0] * jnp.array(_TABLE), [(x[1] * 200).astype(int)], [4]
    ),
}
"""Functions with arrays in memory."""

FUNCTIONS = {**ARITHMETIC, **LOOPS}


def robots(count):
    """As many robots' arguments, none at a place where rounding decides."""
    x = np.float32(np.random.default_rng(5).normal(size=(count, 4)))
    x[3 % count, 2] = 0
    return x
