"""What one kernel may not assume: that numbers are finite, or that bits are those of numbers."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import gliding
from helpers.small_kernels import launches, made
from jetbot_mjx.config import parse_config
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.task import GoalTask
from jetbot_mjx.envs.wrappers import EpisodeWrapper, NewEpisodeWrapper, wrap_for_training
from onekernel import fuse

EVERY_KIND = np.float32([1.0, -2.5, 0.0, 3e7, -1e9, 1e14, np.nan, np.inf, -np.inf])

OF_ANY_NUMBER = {
    "nothing of it": lambda x: x * 0.0,
    "without itself": lambda x: x - x,
    "a share of nothing": lambda x: 0.0 / x,
    "at most NaN": lambda x: jnp.minimum(x, jnp.nan),
    "at least NaN": lambda x: jnp.maximum(jnp.nan, x),
    "clipped by NaN": lambda x: jnp.clip(x, 0.0, jnp.nan),
    "its sine": jnp.sin,
    "its cosine": jnp.cos,
    "the largest of it and others": lambda x: jnp.argmax(jnp.stack([x * 0 + 2, x, x + 1])),
    "the smallest of it and others": lambda x: jnp.argmin(jnp.stack([x * 0 - 2, -x, x])),
    "summed with zeros": lambda x: jnp.zeros((1, 2)) @ jnp.stack([x, x]),
}


@pytest.mark.parametrize("name", OF_ANY_NUMBER)
def test_what_is_not_finite_stays_so(name):
    function = jax.vmap(fuse(OF_ANY_NUMBER[name]))
    assert launches(function, EVERY_KIND) == 1
    expected = jax.vmap(OF_ANY_NUMBER[name])(EVERY_KIND)
    np.testing.assert_allclose(jax.jit(function)(EVERY_KIND), expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("reduce", [jnp.bitwise_or, jnp.bitwise_and, jnp.bitwise_xor])
@pytest.mark.parametrize("dtype", [np.int32, np.uint32])
def test_the_bits_of_whole_numbers_are_combined(reduce, dtype):
    numbers = np.random.default_rng(0).integers(0, 2**31, (17, 5)).astype(dtype)
    ours = jax.jit(jax.vmap(fuse(lambda x: reduce.reduce(x), on_unsupported="xla")))(numbers)
    np.testing.assert_array_equal(ours, jax.vmap(lambda x: reduce.reduce(x))(numbers))


def typed(words):
    return jax.random.wrap_key_data(words)


def place(words):
    """Where to look for one of three keys; often there is none."""
    return (words[0] % 7).astype(jnp.int32) - 1


WITH_KEYS = {
    "poisson": lambda key: jax.random.poisson(key, 3.0, (2,)),
    "binomial": lambda key: jax.random.binomial(key, 5, 0.4),
    "one of two keys": lambda key: jax.random.bits(
        jnp.where(key[0] % 2 == 0, typed(key), jax.random.split(typed(key))[1])
    ),
    "a key of a branch": lambda key: jax.random.bits(
        jax.lax.cond(key[0] % 2 == 0, lambda k: k, lambda k: jax.random.split(k)[0], typed(key))
    ),
    "a key of a loop": lambda key: jax.random.bits(
        jax.lax.fori_loop(0, 200, lambda i, k: jax.random.fold_in(k, i), typed(key))
    ),
    "a key at a place": lambda key: jax.random.bits(jax.random.split(typed(key), 3)[place(key)]),
    "a key at no place": lambda key: jax.random.key_data(
        jax.random.split(typed(key), 3).at[place(key)].get(mode="fill")
    ),
    "keys with another one at a place": lambda key: jax.random.key_data(
        jax.random.split(typed(key), 3).at[place(key)].set(typed(key))
    ),
    "a copy of a key": lambda key: jax.random.bits(jax.random.clone(typed(key))),
    "a key as a result": lambda key: jax.random.split(typed(key)),
}


@pytest.mark.parametrize("name", WITH_KEYS)
def test_what_chooses_between_keys_stays_as_it_is(name):
    keys = np.random.default_rng(1).integers(0, 2**32, (9, 2), np.uint32)
    # These two are of the gamma function, which has no kernel.
    on_unsupported = "xla" if name in ("poisson", "binomial") else "raise"
    ours = jax.jit(jax.vmap(fuse(WITH_KEYS[name], on_unsupported=on_unsupported)))(keys)
    theirs = jax.jit(jax.vmap(WITH_KEYS[name]))(keys)
    if name == "a key as a result":
        ours, theirs = jax.random.key_data(ours), jax.random.key_data(theirs)
    np.testing.assert_array_equal(ours, theirs)


def test_a_key_as_an_argument_stays_as_it_is():
    keys = jax.random.split(jax.random.key(3), 9)
    ours = jax.jit(jax.vmap(fuse(jax.random.bits)))(keys)
    np.testing.assert_array_equal(ours, jax.vmap(jax.random.bits)(keys))


class WeighsWithZero(GoalTask):
    """A reward whose last term is zero times the logarithm of what may be negative."""

    def reward(self, before, after, goal, action):
        reward, terms = super().reward(before, after, goal, action)
        return reward + 0.0 * jnp.log(action[0]), terms


def test_a_nan_reward_ends_the_episode():
    config = parse_config({"task": {"observation": "egocentric"}})
    env = make_env(config, own_class=WeighsWithZero)
    batch = wrap_for_training(env, 40)
    plain = NewEpisodeWrapper(EpisodeWrapper(env, 40))
    state = jax.jit(batch.reset)(jax.random.split(jax.random.PRNGKey(0), 8))
    action = jnp.stack([jnp.linspace(-1.0, 1.0, 8), jnp.zeros(8)], axis=1)
    with gliding.everywhere():
        ours = jax.jit(batch.step)(state, action)
        theirs = jax.jit(jax.vmap(plain.step))(state, action)
    np.testing.assert_array_equal(ours.metrics["nonfinite_envs"], action[:, 0] < 0)
    np.testing.assert_array_equal(ours.done, theirs.done)
    np.testing.assert_array_equal(ours.key, theirs.key)


def test_integers_keep_their_bits_where_these_are_a_nan():
    """As floats, some are NaNs of the kind that a conversion would change."""
    numbers = np.int32([-5_000_000, 0x7F800001, 0x7FBFFFFF, -1])
    ours = jax.jit(jax.vmap(fuse(lambda x: (x, jnp.asarray(numbers)))))(np.ones(5))
    np.testing.assert_array_equal(ours[1], np.tile(numbers, (5, 1)))


def test_a_zero_keeps_its_sign_in_a_choice():
    one = fuse(lambda x: jnp.where(x > 0, -0.0, 0.0))
    np.testing.assert_array_equal(np.signbit(jax.vmap(one)(np.float32([1, -1]))), [True, False])


def test_nothing_divided_by_a_whole_number_is_what_jax_makes_of_it():
    one = fuse(lambda n: jax.lax.div(jnp.int32(0), n))
    np.testing.assert_array_equal(jax.vmap(one)(np.int32([0, 3])), [-1, 0])


def test_other_settings_and_weak_types_are_lowered_again():
    key = jax.random.PRNGKey(1)
    draw = fuse(lambda key: jax.random.bits(key, (2,)), on_unsupported="xla")
    draw(key)
    with jax.threefry_partitionable(False):
        np.testing.assert_array_equal(draw(key), jax.random.bits(key, (2,)))
    product = fuse(lambda a, b: a * b)
    assert product(jnp.uint32(5), 3).dtype == jnp.uint32
    assert product(jnp.uint32(5), jnp.int32(3)).dtype == jnp.int32


def test_a_function_of_nothing_stays_as_it_is():
    np.testing.assert_array_equal(fuse(lambda: jnp.ones(3), on_unsupported="xla")(), np.ones(3))


def test_a_kernel_for_several_robots_stays_as_it_is():
    step = made()

    def each(x):
        return jax.vmap(lambda row: step({"x": row, "n": row[0]}, jnp.float32(2))["x"])(x)

    robots = np.random.default_rng(0).normal(size=(4, 2, 3)).astype(np.float32)
    ours = jax.jit(jax.vmap(fuse(each, on_unsupported="xla")))(robots)
    np.testing.assert_allclose(ours, robots * 4, rtol=1e-6)


@pytest.mark.parametrize("power", [0.5, -0.5, 1.5])
def test_powers_of_infinities_are_those_of_jax(power):
    x = jnp.array([-jnp.inf, -2.0, 0.0, 3.0, jnp.inf, jnp.nan])
    ours = jax.jit(jax.vmap(fuse(lambda x: x**power)))(x)
    np.testing.assert_allclose(ours, jax.jit(lambda x: x**power)(x), rtol=1e-6)
