"""Random bits by one kernel: they are JAX's, and JAX is as before afterwards."""

import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jetbot_mjx.compiler import llvm_backend, random_bits
from jetbot_mjx.compiler.program_cache import ProgramCache

pytestmark = [
    pytest.mark.cpu,
    pytest.mark.skipif(llvm_backend.obstacle() is not None, reason="there is no such back end"),
]


def draws(key):
    keys = jax.random.split(key, 5)
    return [
        jax.random.bits(key, (7, 3)),
        jax.random.bits(key, (5,), np.uint8),
        jax.random.uniform(key),
        jax.random.uniform(keys[1], (0,)),
        jax.vmap(lambda key: jax.random.normal(key, (3,)))(keys),
        jax.lax.scan(lambda key, _: (jax.random.fold_in(key, 3), key), key, length=4)[1],
        jax.random.permutation(keys[2], 64),
        jax.random.randint(keys[3], (11,), 0, 9),
    ]


def lowered(key):
    return jax.jit(lambda key: draws(key)).trace(key).lower()


def kernels(program):
    return len(llvm_backend.kernels_in(program.as_text()))


@pytest.mark.parametrize("seed", [0, 1, 2**31 - 1])
def test_they_are_those_of_jax(seed):
    key = jax.random.PRNGKey(seed)
    with random_bits.by_one_kernel():
        ours = lowered(key)
    assert kernels(ours) > 1
    for one, other in zip(ours.compile()(key), draws(key), strict=True):
        np.testing.assert_array_equal(one, other)


def test_outside_nothing_has_changed():
    key = jax.random.PRNGKey(0)
    with pytest.raises(RuntimeError), random_bits.by_one_kernel():
        raise RuntimeError
    assert kernels(lowered(key)) == 0


def test_two_caches_that_lower_at_once_leave_jax_as_it_was():
    key = jax.random.PRNGKey(0)
    begun, inside, over = threading.Event(), threading.Event(), threading.Event()

    def first():
        begun.set()
        inside.wait(0.3)
        return jax.jit(jax.random.uniform).trace(key)

    def second():
        inside.set()
        over.wait(2.0)
        return jax.jit(jax.random.normal).trace(key)

    def compile_second():
        begun.wait()
        ProgramCache({}).compile("second", second)

    thread = threading.Thread(target=compile_second)
    thread.start()
    ProgramCache({}).compile("first", first)
    over.set()
    thread.join()
    assert kernels(lowered(key)) == 0


def test_where_there_is_no_back_end_jax_draws(monkeypatch):
    monkeypatch.setattr(llvm_backend, "obstacle", lambda: "there is none")
    key = jax.random.PRNGKey(0)
    with random_bits.by_one_kernel():
        assert kernels(lowered(key)) == 0


def test_a_training_s_programs_draw_by_it():
    key = jnp.zeros(2, jnp.uint32)
    program = ProgramCache({}).compile("draw", lambda: jax.jit(jax.random.uniform).trace(key))
    assert len(llvm_backend.kernels_in(program.as_text())) == 1
