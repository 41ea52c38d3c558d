"""Random keys as words: what passes to a kernel and from it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from onekernel.keys import with_key, without_key, words_of


@pytest.mark.parametrize("kind", ["threefry2x32", "rbg"])
def test_keys_of_every_kind_are_words_and_become_the_same_keys(kind):
    keys = jax.random.split(jax.random.key(3, impl=kind), 2)
    words = without_key(keys)
    assert words.dtype == np.uint32
    assert (words.shape, words.dtype) == (words_of(jax.typeof(keys)).shape, np.uint32)
    assert (with_key(jax.typeof(keys), words) == keys).all()
    assert with_key(jax.typeof(keys), words).dtype == keys.dtype


def test_what_is_no_key_stays():
    x = jnp.ones(3)
    assert without_key(x) is x
    assert with_key(jax.typeof(x), x) is x
    assert words_of(jax.typeof(x)) == jax.typeof(x)
