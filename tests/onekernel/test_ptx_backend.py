"""Kernels in PTX: what can be told of them without a GPU, and what they compute on one."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.kernel_cases import FUNCTIONS, SCANS, VECTOR, robots
from helpers.small_physics import small_physics
from jetbot_mjx.config import parse_config
from jetbot_mjx.envs.build import make_env
from onekernel import fuse, gpu
from onekernel.kernel import Kernel
from onekernel.lower.jaxpr import scalarize

pytest.importorskip("llvmlite")
on_a_gpu = pytest.mark.skipif(gpu.obstacle() is not None, reason="there is no NVIDIA GPU")


def kernel(function, *shapes, carried=1, steps=1):
    program = scalarize(function, *(shapes or (VECTOR,)))
    return Kernel(program, carried=carried, steps=steps, fallback=function, impl="ptx")


@pytest.mark.parametrize("architecture", [70, 80, 90])
@pytest.mark.parametrize("name", FUNCTIONS)
def test_it_is_compiled_for_every_architecture(name, architecture):
    text = gpu.compiled(kernel(FUNCTIONS[name]), architecture)
    assert f".target sm_{architecture}" in text
    assert text.count(gpu.INSTANCES) == 1
    assert f".maxntid {gpu.MAX_THREADS}" in text
    # A thread may have as many registers as one block leaves it.
    assert ".minnctapersm 1\n" in text
    # All threads of a block begin a step together.
    assert len(re.findall(r"bar(rier)?\.(cta\.)?sync", text)) == 1
    # Values in between stay in registers.
    assert text.count("st.global") == 4
    assert text.count("ld.global") <= 4
    assert not re.search(r"\b(ld|st)\.local", text)
    assert "call" not in text


def elementary(x):
    """Functions of float64, with the angles of any size."""
    return (
        jnp.sin(x * 1e7) + jnp.exp(-x * x) * jnp.log1p(jnp.abs(x)),
        jnp.arctan2(x, x[::-1]) + jnp.abs(x) ** x + jax.lax.erf_inv(x / 9),
        jnp.maximum(x, x[::-1]) + jnp.round(x) + jnp.sqrt(jnp.abs(x)) + jnp.fmod(x, 0.3),
    )


def whole(x):
    """Whole numbers of 64 bits, with and without a sign, and their conversions."""
    n = (x * 2.0**40).astype(jnp.int64)
    word = jax.lax.bitcast_convert_type(x, jnp.uint64)
    divided = n // (n[::-1] | 1), word % (word[::-1] | jnp.uint64(1))
    return n * 3, word >> 7, *divided, word.astype(x.dtype), word.astype(jnp.float32), n << n


def rows(x):
    """A scan whose rows are in memory, and a number of them at a computed place."""
    end, found = jax.lax.scan(lambda c, i: (c * 0.5 + i, (c, i > 40)), x, jnp.arange(80.0))
    return end, found[0][jnp.abs(x[0]).astype(int) % 80], found[1].sum()


WIDE = {
    "elementary": elementary,
    "whole": whole,
    "rows": rows,
    "gradient": jax.grad(lambda x: (jnp.tanh(x) * x[::-1]).sum()),
    "random": lambda x: jax.random.normal(jax.random.key(x[0].astype(int)), (2,)) * x[0],
}
"""Functions of a vector of float64."""


@pytest.fixture
def wide():
    with jax.enable_x64(True):
        yield


@pytest.mark.parametrize("architecture", [70, 80, 90])
@pytest.mark.parametrize("name", WIDE)
def test_numbers_of_64_bits_are_compiled_for_every_architecture(name, architecture, wide):
    fused = fuse(WIDE[name], on_unsupported="raise")
    one = fused.lowered(jax.ShapeDtypeStruct((4,), jnp.float64)).one
    assert isinstance(one, Kernel)
    text = gpu.compiled(one, architecture)
    assert f".target sm_{architecture}" in text
    assert re.search(r"\.(f64|s64|u64)", text)
    # Only angles that are far from 0 need a function, which a module has once.
    assert len(re.findall(r"^\.func .*angle_rest", text, re.MULTILINE)) == (name == "elementary")
    # A number of 64 bits is read and written as two words.
    assert text.count("st.global") == sum(one.result_words)
    assert text.count("ld.global.b32") >= 2


@on_a_gpu
@pytest.mark.parametrize("name", WIDE)
def test_numbers_of_64_bits_are_those_of_jax(name, wide):
    x = np.random.default_rng(0).normal(size=(300, 4))
    ours = jax.jit(jax.vmap(fuse(WIDE[name], on_unsupported="raise")))(x)
    theirs = jax.jit(jax.vmap(WIDE[name]))(x)
    for one, other in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        assert one.dtype == other.dtype
        np.testing.assert_allclose(one, other, rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize("name", SCANS)
def test_arrays_are_in_the_threads_own_memory(name):
    text = gpu.compiled(kernel(SCANS[name]), 90)
    tables = len(re.findall(r"^\.global .*\btable_\w+\[1200\]", text, re.MULTILINE))
    assert tables == (name == "a place in a table")
    # What follows from constants alone, or is read from them, takes no memory of a thread.
    assert bool(re.search(r"\bst\.local", text)) == (not tables)
    assert text.count("st.global") == 4


def test_rows_are_not_in_shared_memory_where_threads_lack_registers(monkeypatch):
    def halved(x):
        return jax.lax.while_loop(lambda x: x[0] > 1, lambda x: x * 0.5, x)

    long = kernel(halved, jax.ShapeDtypeStruct((40,), jnp.float32))
    assert "ld.shared" in gpu.compiled(long, 90)
    # The loop carries 40 numbers.
    monkeypatch.setattr(gpu, "_REGISTERS", 39)
    assert "ld.shared" not in gpu.compiled(long, 90)


@pytest.mark.parametrize(
    ("robots", "threads"),
    [(1, 32), (4096, 32), (4097, 64), (16384, 128), (65536, 256), (10**7, 256)],
)
def test_blocks_grow_with_the_number_of_robots(robots, threads):
    assert gpu.threads_in_block(robots) == threads


@pytest.mark.skipif(gpu.obstacle() is None, reason="there is an NVIDIA GPU")
def test_without_a_gpu_there_is_none():
    assert small_physics()[0].impl != "ptx"


@on_a_gpu
@pytest.mark.parametrize("name", {**FUNCTIONS, **SCANS})
def test_it_does_what_the_function_does(name):
    x = robots(300)
    function = {**FUNCTIONS, **SCANS}[name]
    step = kernel(lambda x, held: function(x), VECTOR, ()).as_step()
    ours = jax.jit(jax.vmap(lambda x: step(x, ())))(x)
    with jax.default_matmul_precision("highest"):
        theirs = jax.jit(jax.vmap(function))(x)
    np.testing.assert_allclose(ours, theirs, rtol=2e-5, atol=2e-6)


@on_a_gpu
@pytest.mark.parametrize("preset", ["isaac", "real"])
def test_it_drives_as_xla_does(preset):
    count = 256
    rng = np.random.default_rng(0)
    targets = rng.uniform(-12, 31, (16, count, 2)).astype(np.float32)
    ends = []
    for impl in ("ptx", "xla"):
        env = make_env(parse_config({"robot": {"preset": preset}, "physics": {"impl": impl}}))
        keys = jax.random.split(jax.random.PRNGKey(0), count)
        states = jax.jit(jax.vmap(env.reset))(keys).pipeline_state
        step = jax.jit(jax.vmap(env.physics.step))
        for ctrl in np.repeat(targets, 16, 0):
            states = step(states, ctrl)
        ends.append(np.asarray(states.qpos))
    np.testing.assert_allclose(*ends, atol=1e-3)


@on_a_gpu
def test_a_robots_bits_do_not_depend_on_those_beside_it():
    env = make_env(parse_config({"physics": {"impl": "ptx"}}))
    keys = jax.random.split(jax.random.PRNGKey(0), 1000)
    states = jax.jit(jax.vmap(env.reset))(keys).pipeline_state
    ctrl = np.random.default_rng(0).choice([-12.0, 31.0], (1000, 2)).astype(np.float32)
    step = jax.jit(
        lambda s, c: jax.lax.fori_loop(0, 20, lambda _, s: jax.vmap(env.physics.step)(s, c), s)
    )
    together = step(states, ctrl)
    for few in (1, 31, 33):
        alone = step(jax.tree.map(lambda x, few=few: x[:few], states), ctrl[:few])
        np.testing.assert_array_equal(alone.qpos, together.qpos[:few])


@on_a_gpu
def test_a_program_for_the_cpu_steps_by_its_own_kernel_beside_it():
    env = make_env(parse_config({}))
    state = env.reset(jax.random.PRNGKey(0)).pipeline_state
    here = env.physics.step(state, jnp.ones(2))
    on_cpu = jax.device_put((state, jnp.ones(2)), jax.devices("cpu")[0])
    there = jax.jit(env.physics.step)(*on_cpu)
    assert there.qpos.devices() == {jax.devices("cpu")[0]}
    np.testing.assert_allclose(here.qpos, there.qpos, atol=1e-5)
