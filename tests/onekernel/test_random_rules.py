"""Random numbers on scalars are JAX's: bit for bit, in NumPy and in a compiled kernel."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import special

from helpers.run_program import evaluate
from helpers.small_kernels import launches
from onekernel import fuse
from onekernel.errors import UnsupportedError
from onekernel.lower.jaxpr import scalarize

KEY = jax.ShapeDtypeStruct((2,), jnp.uint32)


def many_keys():
    seeds = [jax.random.PRNGKey(seed) for seed in (0, 1, 2**31 - 1)]
    ends = [[0, 2**32 - 1], [2**32 - 1, 0], [2**32 - 1, 2**32 - 1], [2**31, 2**31]]
    random = np.random.default_rng(0).integers(0, 2**32, (200, 2), np.uint32)
    return np.concatenate([np.uint32(seeds), np.uint32(ends), random])


KEYS = many_keys()


def a_loop_of_keys(key):
    def trip(key, _):
        return jax.random.fold_in(key, 3), jax.random.bits(key)

    return jax.lax.scan(trip, key, length=4)


def a_loop_that_depends(key):
    def going(state):
        key, count = state
        return (jax.random.bits(key) > 2**30) & (count < 20)

    def trip(state):
        key, count = state
        return jax.random.split(key)[1], count + 1

    return jax.lax.while_loop(going, trip, (key, 0))


EXACT = {
    "a word": jax.random.bits,
    "words": lambda key: jax.random.bits(key, (5,)),
    "a matrix of words": lambda key: jax.random.bits(key, (2, 3)),
    "two keys": jax.random.split,
    "a matrix of keys": lambda key: jax.random.split(key, (2, 3)),
    "a key of a number": lambda key: [jax.random.fold_in(key, x) for x in (0, 7, 2**32 - 1)],
    "a key of a drawn number": lambda key: jax.random.fold_in(key, jax.random.bits(key)),
    "a key of a number below zero": lambda key: jax.random.fold_in(key, key.view(jnp.int32)[1]),
    "keys of numbers": lambda key: jax.vmap(lambda i: jax.random.fold_in(key, i))(jnp.arange(4)),
    "draws of many keys": lambda key: jax.vmap(lambda key: jax.random.bits(key, (2,)))(
        jax.random.split(key, 3)
    ),
    "a key of type": lambda key: jax.random.key_data(
        jax.random.split(jax.random.wrap_key_data(key), 3)
    ),
    "whole numbers": lambda key: jax.random.randint(key, (5,), -7, 9),
    "all whole numbers": lambda key: jax.random.randint(key, (3,), -(2**31), 2**31 - 1),
    "whole numbers from zero": lambda key: jax.random.randint(key, (4,), 0, 5, jnp.uint32),
    "truths": lambda key: jax.random.bernoulli(key, 0.3, (5,)),
    "choices": lambda key: jax.random.choice(key, 8, (3,)),
    "numbers from 0 to 1": lambda key: jax.random.uniform(key, (4,)),
    "a loop of keys": a_loop_of_keys,
    "a loop that depends": a_loop_that_depends,
}


@pytest.mark.parametrize("name", EXACT)
def test_they_are_those_of_jax_to_the_bit(name):
    draw = EXACT[name]
    theirs = [np.asarray(x) for x in jax.tree.leaves(jax.jit(jax.vmap(draw))(KEYS))]
    for ours in both(draw):
        for one, other in zip(ours, theirs, strict=True):
            assert one.dtype == other.dtype
            np.testing.assert_array_equal(one, other)


def both(draw):
    """What a function of a key draws in NumPy and as a kernel."""
    compiled = jax.vmap(fuse(draw))
    assert launches(compiled, KEYS) == 1
    return evaluate(scalarize(draw, KEY), [KEYS]), jax.tree.leaves(jax.jit(compiled)(KEYS))


def test_none_are_drawn_where_none_are_wanted():
    def draw(key):
        return jax.random.bits(key, (0, 3)), jax.random.split(key, 0), jax.random.uniform(key)

    compiled = jax.vmap(fuse(draw))
    assert launches(compiled, KEYS) == 1
    bits, keys, number = compiled(KEYS)
    assert (bits.shape, bits.dtype) == ((len(KEYS), 0, 3), np.uint32)
    assert (keys.shape, keys.dtype) == ((len(KEYS), 0, 2), np.uint32)
    np.testing.assert_array_equal(number, jax.vmap(jax.random.uniform)(KEYS))


@pytest.mark.cpu
def test_of_an_interval_they_are_those_of_jax_up_to_a_unit_of_its_ends():
    def draw(key):
        return jax.random.uniform(key, (20,), minval=-2.0, maxval=0.7)

    theirs = jax.vmap(draw)(KEYS)
    for (ours,) in both(draw):
        np.testing.assert_allclose(ours, theirs, rtol=0, atol=np.spacing(np.float32(2)))
        assert ours.min() >= -2
        assert ours.max() <= np.float32(0.7)


NORMAL_FROM = np.nextafter(np.float32(-1), np.float32(0))
FLOATS = {
    "normal": (jax.random.normal, NORMAL_FROM, lambda u: np.sqrt(2.0) * special.erfinv(u), 8),
    "exponential": (jax.random.exponential, 0.0, lambda u: -np.log1p(-u), 3),
}


@pytest.mark.cpu
@pytest.mark.parametrize("name", FLOATS)
def test_what_is_made_of_uniform_numbers_is_that_of_float64(name):
    draws, low, exact, units = FLOATS[name]
    uniform = jax.vmap(lambda key: jax.random.uniform(key, (20,), minval=low, maxval=1.0))(KEYS)
    expected = exact(np.float64(uniform))
    theirs = jax.vmap(lambda key: draws(key, (20,)))(KEYS)
    for (ours,) in both(lambda key: draws(key, (20,))):
        off = np.abs(ours - expected) / np.spacing(np.abs(np.float32(expected)))
        assert off.max() < units
        # XLA's own are off by more, near the ends.
        np.testing.assert_allclose(ours, theirs, rtol=2e-5)


OTHERS = {
    "bytes": lambda key: jax.random.bits(key, (5,), np.uint8),
    "half words": lambda key: jax.random.bits(key, (5,), np.uint16),
    "half floats": lambda key: jax.random.uniform(key, (3,), jnp.float16),
}


def check_as_it_is(draw, keys):
    run = jax.vmap(fuse(draw, on_unsupported="xla"))
    assert launches(run, keys) == 0
    theirs = jax.vmap(draw)(keys)
    for one, other in zip(jax.tree.leaves(run(keys)), jax.tree.leaves(theirs), strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("name", OTHERS)
def test_others_are_refused_and_drawn_by_jax(name):
    with pytest.raises(UnsupportedError):
        scalarize(OTHERS[name], KEY)
    check_as_it_is(OTHERS[name], KEYS[:5])


@pytest.mark.parametrize("name", ["words", "two keys", "a key of a number"])
@pytest.mark.parametrize("impl", ["rbg", "unsafe_rbg"])
def test_keys_of_other_generators_are_refused_and_used_by_jax(name, impl):
    def draw(key):
        # A function of its own: JAX would reuse its trace of a function with another generator.
        return EXACT[name](key)

    with jax.default_prng_impl(impl):
        keys = jnp.stack([jax.random.PRNGKey(seed) for seed in range(3)])
        with pytest.raises(UnsupportedError, match="other than those of Threefry"):
            scalarize(draw, keys[0])
        check_as_it_is(draw, keys)


@pytest.mark.parametrize("name", ["words", "two keys", "whole numbers"])
def test_the_older_order_of_bits_is_refused_and_drawn_by_jax(name):
    newer = jax.vmap(EXACT[name])(KEYS)
    with jax.threefry_partitionable(False):
        assert not np.array_equal(jax.vmap(EXACT[name])(KEYS), newer)
        with pytest.raises(UnsupportedError, match="without jax_threefry_partitionable"):
            scalarize(EXACT[name], KEY)
        check_as_it_is(EXACT[name], KEYS[:5])


SEEDS = np.int32([0, 1, -1, 7, 2**31 - 1, -(2**31)])


def test_a_key_begins_with_a_seed():
    def keys(seed):
        constant = jax.random.PRNGKey(0), jax.random.PRNGKey(-5), jax.random.key_data(seedless())
        many = jax.vmap(jax.random.PRNGKey)(seed + jnp.arange(3))
        return jax.random.PRNGKey(seed), jax.random.PRNGKey(seed.astype(jnp.uint32)), many, constant

    def seedless():
        return jax.random.key(3)

    ours = jax.vmap(fuse(keys, on_unsupported="raise"))(SEEDS)
    jax.tree.map(np.testing.assert_array_equal, ours, jax.vmap(keys)(SEEDS))


def test_a_constant_seed_may_have_64_bits():
    def keys(x):
        return x, jax.random.PRNGKey(2**40 + 5), jax.random.PRNGKey(-7)

    with jax.enable_x64(True):
        ours = jax.vmap(fuse(keys, on_unsupported="raise"))(SEEDS)
        jax.tree.map(np.testing.assert_array_equal, ours, jax.vmap(keys)(SEEDS))


def test_a_seed_of_another_generator_is_named():
    function = fuse(
        lambda seed: jax.random.key_data(jax.random.key(seed, impl="rbg")), on_unsupported="raise"
    )
    with pytest.raises(UnsupportedError, match=r"numbers other than those of Threefry \(.*rules"):
        function(3)
