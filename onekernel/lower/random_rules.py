"""Lower JAX's random numbers to operations on scalars, with the same bits.

A key is one element of an array, as it is in JAX, and holds two scalars of 32 bits.

Source: J. K. Salmon et al., Parallel Random Numbers: As Easy as 1, 2, 3, SC 2011,
doi:10.1145/2063384.2063405 (Threefry-2x32 with 20 rounds, which JAX uses).
"""

import dataclasses
import functools
import math
from collections.abc import Iterable

import jax
import numpy as np
from jax.extend.core import JaxprEqn

from onekernel.errors import UnsupportedError
from onekernel.lower.indexing import Rule, ScalarArray, scalar_array, shape_of
from onekernel.lower.scalar_ir import ExprGraph, Scalar

_ROTATIONS = ((13, 15, 26, 6), (17, 29, 16, 24))
_PARITY = np.uint32(0x1BD11BDA)
_WORD = np.dtype(np.uint32)


@dataclasses.dataclass(eq=False, frozen=True)
class Key:
    """A `Key` holds the two words of a random key."""

    first: Scalar
    second: Scalar


def words_of(x: Scalar | Key) -> tuple[Scalar, ...]:
    """Return the words of a key, or a scalar as the only one."""
    return (x.first, x.second) if isinstance(x, Key) else (x,)


def like(x: Scalar | Key, words: Iterable[Scalar]) -> Scalar | Key:
    """Return a key if `x` is a key, else a scalar, from the next of some words."""
    words = iter(words)
    return Key(next(words), next(words)) if isinstance(x, Key) else next(words)


def select(
    graph: ExprGraph, condition: Scalar, if_false: Scalar | Key, if_true: Scalar | Key
) -> Scalar | Key:
    """Select between two scalars, or the words of two random keys."""
    pairs = zip(words_of(if_false), words_of(if_true), strict=True)
    return like(if_true, (graph.select(condition, *pair) for pair in pairs))


def threefry(graph: ExprGraph, key: Key, first: Scalar, second: Scalar) -> Key:
    """Return the hash of a count of 64 bits, in two words, under a key; all scalars are uint32."""
    add = functools.partial(graph.apply, "add")
    xor = functools.partial(graph.apply, "xor")
    # Threefry-2x32 (figure 2 of the source): the third key is the parity of the other two.
    keys = key.first, key.second, xor(xor(key.first, key.second), _PARITY)
    first, second = add(first, keys[0]), add(second, keys[1])
    # Five groups of four rounds; after each group, two of the three keys and the group's number are
    # added.
    for group in range(5):
        for rotation in _ROTATIONS[group % 2]:
            first = add(first, second)
            second = xor(first, graph.apply("rotate_left", second, np.uint32(rotation)))
        first = add(first, keys[(group + 1) % 3])
        second = add(add(second, keys[(group + 2) % 3]), np.uint32(group + 1))
    return Key(first, second)


def _threefry2x32(
    graph: ExprGraph,
    equation: JaxprEqn,
    key: ScalarArray,
    other: ScalarArray,
    first: ScalarArray,
    second: ScalarArray,
) -> list[ScalarArray]:
    arrays = np.broadcast_arrays(key, other, first, second)
    rows = zip(*(array.ravel() for array in arrays), strict=True)
    hashes = [threefry(graph, Key(*row[:2]), *row[2:]) for row in rows]
    shape = arrays[0].shape
    return [
        scalar_array((x.first for x in hashes), shape),
        scalar_array((x.second for x in hashes), shape),
    ]


def _seed(graph: ExprGraph, equation: JaxprEqn, seeds: ScalarArray) -> ScalarArray:
    if equation.params["impl"].name != "threefry2x32":
        raise UnsupportedError("random numbers other than those of Threefry")

    # A key is a seed of 64 bits. Those of 32 are padded with zeros.
    def first(seed: Scalar) -> Scalar:
        if seed.dtype.itemsize < 8:
            return np.uint32(0)
        high = graph.apply("shift_right_logical", seed, seed.dtype.type(32))
        return graph.convert(high, _WORD)

    keys = (Key(first(x), graph.convert(x, _WORD)) for x in seeds.ravel())
    return scalar_array(keys, seeds.shape)


def _wrap(graph: ExprGraph, equation: JaxprEqn, words: ScalarArray) -> ScalarArray:
    pairs = words.reshape(-1, words.shape[-1])
    # Keys of other generators have more words.
    if words.shape[-1] != 2:
        raise UnsupportedError("random numbers other than those of Threefry")
    return scalar_array((Key(*pair) for pair in pairs), words.shape[:-1])


def _unwrap(graph: ExprGraph, equation: JaxprEqn, keys: ScalarArray) -> ScalarArray:
    words = [word for key in keys.ravel() for word in words_of(key)]
    return scalar_array(words, (*keys.shape, 2))


def _hashes(graph: ExprGraph, key: Key, shape: tuple[int, ...]) -> list[Key]:
    """Return the hashes of the places of an array under a key."""
    if not jax.config.values.get("jax_threefry_partitionable", False):
        raise UnsupportedError("random numbers without jax_threefry_partitionable")
    # With `jax_threefry_partitionable`, each number is the hash of its place in the array, a count
    # of 64 bits; so it does not depend on how many are drawn.
    counts = range(math.prod(shape))
    return [threefry(graph, key, np.uint32(0), np.uint32(count)) for count in counts]


def _split(graph: ExprGraph, equation: JaxprEqn, keys: ScalarArray) -> ScalarArray:
    shape = equation.params["shape"]
    split = [child for key in keys.ravel() for child in _hashes(graph, key, shape)]
    return scalar_array(split, shape_of(equation.outvars[0]))


def _bits(graph: ExprGraph, equation: JaxprEqn, keys: ScalarArray) -> ScalarArray:
    width = equation.params["bit_width"]
    if width not in (32, 64):
        raise UnsupportedError(f"random bits other than words of 32 or 64: {width}")
    shape = equation.params["shape"]
    hashes = [one for key in keys.ravel() for one in _hashes(graph, key, shape)]
    # A hash has two words; random bits of 32 are both of them combined, and 64 are one behind the
    # other.
    if width == 64:
        bits = (graph.joined(one.second, one.first) for one in hashes)
    else:
        bits = (graph.apply("xor", one.first, one.second) for one in hashes)
    return scalar_array(bits, shape_of(equation.outvars[0]))


def _fold_in(
    graph: ExprGraph, equation: JaxprEqn, keys: ScalarArray, data: ScalarArray
) -> ScalarArray:
    pairs = zip(*(x.ravel() for x in np.broadcast_arrays(keys, data)), strict=True)
    folded = (
        threefry(graph, key, np.uint32(0), graph.convert(number, _WORD)) for key, number in pairs
    )
    return scalar_array(folded, shape_of(equation.outvars[0]))


RANDOM_RULES: dict[str, Rule] = {
    "random_bits": _bits,
    "random_clone": lambda graph, equation, key: key,
    "random_fold_in": _fold_in,
    "random_seed": _seed,
    "random_split": _split,
    "random_unwrap": _unwrap,
    "random_wrap": _wrap,
    "threefry2x32": _threefry2x32,
}
"""Lowering rules of random numbers, by the name of the JAX primitive.

A rule is a function of the graph, the equation and its operands."""
