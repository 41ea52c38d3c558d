"""Random JAX functions of a vector whose derivatives finite differences find, in any float dtype.

A function is a list of moves, each from two vectors to one, which is kept small. Some hold lists of
their own: loops, branches, maps, and what has a derivative of its own.
"""

import functools
import random

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.special import erf, logsumexp

SIZE = 4


def _place(x):
    """An index that is computed, and that round-off of 0 or 1 does not change."""
    return (jnp.abs(lax.stop_gradient(x)) * 7.3 + 0.1).astype(jnp.int32) % SIZE


def _matrix(x, y):
    return jnp.outer(x, y) / SIZE + 3 * jnp.eye(SIZE, dtype=x.dtype)


@jax.custom_jvp
def _own_jvp(x):
    return jnp.sin(x) * x


_own_jvp.defjvp(lambda x, t: (_own_jvp(x[0]), (jnp.cos(x[0]) * x[0] + jnp.sin(x[0])) * t[0]))


@jax.custom_vjp
def _own_vjp(x):
    return jnp.tanh(x)


_own_vjp.defvjp(lambda x: (jnp.tanh(x),) * 2, lambda y, g: (g * (1 - y * y),))

MOVES = {
    "sin": lambda x, y: jnp.sin(2 * x) + y,
    "cos": lambda x, y: jnp.cos(x * y),
    "exp": lambda x, y: jnp.exp(-x * x) * y,
    "softplus": lambda x, y: jax.nn.softplus(3 * x) - y,
    "sigmoid": lambda x, y: jax.nn.sigmoid(x - y),
    "log": lambda x, y: jnp.log1p(x * x) + y,
    "root": lambda x, y: jnp.sqrt(1 + x * x) * y,
    "quotient": lambda x, y: x / (1 + y * y),
    "power": lambda x, y: (1 + x * x) ** y,
    "cube": lambda x, y: x**3 - (5 + y) ** -2,
    "angle": lambda x, y: jnp.arctan2(x, 2 + y * y),
    "erf": lambda x, y: erf(x) + y,
    "logaddexp": jnp.logaddexp,
    "larger": jnp.maximum,
    "relu": lambda x, y: jax.nn.relu(x) * y,
    "where": lambda x, y: jnp.where(x > y, x * y, jnp.abs(y)),
    "clip": lambda x, y: jnp.clip(x * 2, -1, y),
    "dot": lambda x, y: jnp.sin(jnp.outer(x, y)) @ (x + 1),
    "einsum": lambda x, y: jnp.einsum("i,j,ij->j", x, y, jnp.outer(y, jnp.cos(x))),
    "cumsum": lambda x, y: jnp.cumsum(x) * y,
    "cumsum from the end": lambda x, y: lax.cumsum(x * y, reverse=True),
    "cumprod": lambda x, y: jnp.cumprod(1 + 0.5 * x) + y,
    "cummax": lambda x, y: lax.cummax(x) * y,
    "cumlogsumexp": lambda x, y: lax.cumlogsumexp(x) - y,
    "sort": lambda x, y: jnp.sort(x) * y,
    "reverse": lambda x, y: x[::-1] * jnp.roll(y, 1),
    "take": lambda x, y: x[_place(y[0])] * y,
    "gather": lambda x, y: x[(_place(y[1]) + jnp.arange(SIZE)) % SIZE] + x * y,
    "scatter": lambda x, y: x.at[_place(y[0])].add(y[1] * x[2]),
    "set": lambda x, y: (x * y).at[_place(x[0])].set(jnp.sin(y[3])),
    "multiply at": lambda x, y: x.at[_place(y[0])].multiply(y[1]),
    "slice": lambda x, y: x.at[:2].set(lax.dynamic_slice(y, (_place(x[0]),), (2,))),
    "update": lambda x, y: lax.dynamic_update_slice(x, y[:2] * x[2:], (_place(y[0]),)),
    "pad": lambda x, y: jnp.pad(x * y, (1, 2))[2 : 2 + SIZE],
    "concatenate": lambda x, y: jnp.concatenate([x[1:] * 2, y[:1]]),
    "sum": lambda x, y: jnp.sum(x * y) * y,
    "product": lambda x, y: jnp.prod(1 + x) * y,
    "largest": lambda x, y: jnp.max(x) - jnp.min(x * y) + y,
    "softmax": lambda x, y: jax.nn.softmax(2 * x) * y,
    "logsumexp": lambda x, y: logsumexp(x) * y,
    "norm": lambda x, y: jnp.linalg.norm(x + 3) * y,
    "variance": lambda x, y: jnp.var(x) + jnp.mean(y) * x,
    "solve": lambda x, y: jnp.linalg.solve(_matrix(x, y), x + 1),
    "cholesky": lambda x, y: jnp.linalg.cholesky(_matrix(x, x)) @ y,
    "inverse": lambda x, y: jnp.linalg.inv(_matrix(y, x)) @ x,
    "determinant": lambda x, y: jnp.linalg.slogdet(_matrix(x, y))[1] * y,
    "own jvp": lambda x, y: _own_jvp(x) + y,
    "own vjp": lambda x, y: _own_vjp(x * y),
    # The same numbers in any dtype, which are exact.
    "random": lambda x, y: x + y * jax.random.uniform(jax.random.key(3), (SIZE,), jnp.float32, -1),
    "convolution": lambda x, y: jnp.convolve(x, y[:3], mode="same"),
}


def _scan(first, second, count, x, y):
    def step(carry, row):
        after = first(carry, row)
        return after, second(row, carry).sum()

    rows = jnp.outer(jnp.arange(1, count + 2, dtype=x.dtype), y)
    after, sums = lax.scan(step, x, rows, reverse=count == 2)
    return after + sums.sum()


def _loop(first, second, count, x, y):
    def step(i, pair):
        one, other = pair
        return first(one, other) + i * 0.01, second(other, one)

    return lax.fori_loop(0, count + 1, step, (x, y))[0]


def _while(first, second, count, x, y):
    def step(pair):
        return first(pair[0], y), pair[1] + 1

    return lax.while_loop(lambda pair: pair[1] < 1 + _place(x[0]), step, (x, 0))[0]


BLOCKS = {
    "scan": _scan,
    "loop": _loop,
    "cond": lambda f, g, n, x, y: lax.cond(x[0] > y[1], f, g, x, y),
    "switch": lambda f, g, n, x, y: lax.switch(_place(x[0]), [f, g, jnp.multiply, g], y, x),
    "checkpoint": lambda f, g, n, x, y: g(jax.checkpoint(f)(x, y), y),
    "checkpointed scan": lambda f, g, n, x, y: _scan(jax.checkpoint(f), g, n, x, y),
    "map": lambda f, g, n, x, y: jax.vmap(f)(jnp.outer(x, y), jnp.outer(y, x)).sum(0) + g(x, y),
    "gradient": lambda f, g, n, x, y: jax.grad(lambda z: f(z, y).sum())(x) + g(x, y),
    "jit": lambda f, g, n, x, y: jax.jit(f)(x, y) * g(x, y),
}


class SmoothFunction:
    """A function of a vector that returns one, the same for the same seed."""

    def __init__(self, seed, has_reverse_mode=True):
        """Draw it; without reverse mode it has a `while_loop`."""
        self._random = random.Random(seed)
        self._names = [x for x in MOVES if has_reverse_mode or x != "own vjp"]
        self.text: list[str] = []
        self._run = self._block(0)
        self._last = None if has_reverse_mode else self._draw_block("while", _while, 1)

    def __call__(self, x):
        """Compute the function of a float vector, (SIZE,)."""
        x = jnp.asarray(x)
        found = self._run(x, jnp.cos(x))
        return found if self._last is None else self._last(found, x)

    def _block(self, depth):
        moves = [self._move(depth) for _ in range(self._random.randint(1, 2) + 2 * (depth == 0))]

        def run(x, y):
            for move, is_swapped in moves:
                found = move(y, x) if is_swapped else move(x, y)
                # Keep it small, and of its dtype: some constants have another.
                x, y = 2 * jnp.tanh(found.astype(x.dtype) / 2), x
            return x

        return run

    def _move(self, depth):
        is_swapped = self._random.random() < 0.3
        if depth < 2 and self._random.random() < (0.5, 0.15)[depth]:
            name = self._random.choice(list(BLOCKS))
            return self._draw_block(name, BLOCKS[name], depth + 1), is_swapped
        name = self._random.choice(self._names)
        self.text.append("  " * depth + name)
        return MOVES[name], is_swapped

    def _draw_block(self, name, function, depth):
        self.text.append("  " * (depth - 1) + name)
        count = self._random.randint(1, 3)
        return functools.partial(function, self._block(depth), self._block(depth), count)


def inputs(seed, count):
    """Vectors in float64, (count, SIZE)."""
    return np.random.default_rng(seed).uniform(-1.5, 1.5, (count, SIZE))
