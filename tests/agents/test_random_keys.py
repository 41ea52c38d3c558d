"""Random numbers drawn by kernels: they are JAX's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jetbot_mjx.agents.random_keys import kernel_key, raw_key
from onekernel.build import cpu

pytestmark = [
    pytest.mark.cpu,
    pytest.mark.skipif(cpu.obstacle() is not None, reason="there is no such back end"),
]


def draws(key):
    keys = jax.random.split(key, 5)
    return [
        raw_key(keys),
        raw_key(jax.random.split(key, 40)),
        jax.random.bits(key, (7, 3)),
        jax.random.bits(key, (5,), np.uint8),
        jax.random.uniform(key),
        jax.random.uniform(keys[1], (0,)),
        jax.vmap(lambda key: jax.random.normal(key, (3,)))(keys),
        raw_key(jax.lax.scan(lambda key, _: (jax.random.fold_in(key, 3), key), key, length=4)[1]),
        raw_key(jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(40))),
        jax.random.permutation(keys[2], 64),
        jax.random.randint(keys[3], (11,), 0, 9),
    ]


def by_kernels(key):
    return draws(kernel_key(key))


@pytest.mark.parametrize("seed", [0, 1, 2**31 - 1])
def test_they_are_those_of_jax(seed):
    key = jax.random.PRNGKey(seed)
    for one, other in zip(jax.jit(by_kernels)(key), draws(key), strict=True):
        np.testing.assert_array_equal(one, other)


def test_they_are_drawn_by_kernels():
    key = jax.random.PRNGKey(0)
    lowered = jax.jit(lambda key: jax.random.normal(kernel_key(key), (3,))).lower(key)
    assert len(cpu.kernels_in(lowered.as_text())) == 1


def test_a_batch_of_keys_is_one_launch():
    keys = jax.random.split(jax.random.PRNGKey(0), 6)
    draw = jax.vmap(lambda key: jax.random.uniform(kernel_key(key), (50,)))
    expected = jax.vmap(lambda key: jax.random.uniform(key, (50,)))(keys)
    np.testing.assert_array_equal(jax.jit(draw)(keys), expected)


def test_without_a_back_end_jax_draws(monkeypatch):
    monkeypatch.setattr(cpu, "obstacle", lambda: "there is none")
    key = jax.random.PRNGKey(0)
    assert kernel_key(key) is key


def test_other_bits_of_threefry_are_jax_s():
    key = jax.random.PRNGKey(0)
    jax.config.update("jax_threefry_partitionable", False)
    try:
        assert kernel_key(key) is key
    finally:
        jax.config.update("jax_threefry_partitionable", True)
