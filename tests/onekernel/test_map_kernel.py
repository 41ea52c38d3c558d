"""Kernels with a table: a function of every item of a robot, whose results are bytes."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.map_kernels import make, reference, robots
from onekernel import KernelError, cpu, gpu

pytest.importorskip("llvmlite")


available = pytest.mark.skipif(
    all(backend.obstacle() for backend in (cpu, gpu)),
    reason="there is no kernel here",
)


@available
@pytest.mark.parametrize(("items", "count"), [(64, 1), (67, 9), (1024, 33), (16, 200)])
def test_every_byte_is_the_functions(items, count):
    table, one = make(items)
    run = jax.vmap(lambda *shared: one.as_map()(shared))
    text = jax.jit(run).lower(*robots(count)).as_text()
    assert text.count("custom_call @onekernel_") + text.count(gpu._TARGET) == 1
    ours = jax.jit(run)(*robots(count))
    theirs = jax.jit(jax.vmap(lambda *x: reference(*x, table)))(*robots(count))
    assert ours.dtype == jnp.uint8
    assert ours.shape == theirs.shape == (count, 3 * items)
    # A sum that is rounded once instead of twice may fall on the other side of a whole number.
    different = np.asarray(ours).astype(int) - np.asarray(theirs)
    assert np.abs(different).max() <= 1
    assert (different != 0).mean() < 1e-3
    assert len(np.unique(ours)) > 20


@available
def test_one_robot_and_batches_of_batches_are_the_same():
    _, one = make(64)
    run = lambda *shared: one.as_map()(shared)  # noqa: E731
    of_robot, number = robots(6)
    flat = jax.vmap(run)(of_robot, number)
    nested = jax.vmap(jax.vmap(run))(of_robot.reshape(2, 3, 2), number.reshape(2, 3))
    np.testing.assert_array_equal(nested.reshape(6, -1), flat)
    np.testing.assert_array_equal(run(of_robot[4], number[4]), flat[4])


@available
def test_it_cannot_be_differentiated():
    _, one = make(64)
    with pytest.raises(KernelError, match="cannot be differentiated"):
        jax.jvp(lambda x: one.as_map()((x, jnp.float32(1))), (jnp.ones(2),), (jnp.ones(2),))


def test_a_platform_without_a_kernel_runs_the_function_itself():
    _, one = make(64)
    run = jax.jit(jax.vmap(lambda *shared: one.as_map()(shared)))
    with pytest.warns(UserWarning, match="slower: there are no kernels for this platform"):
        text = run.trace(*robots(3)).lower(lowering_platforms=("tpu",)).as_text()
    assert "custom_call @onekernel_" not in text
    np.testing.assert_array_equal(one.fallback(*(x[0] for x in robots(3)))[0].shape, (192,))


@pytest.mark.parametrize("architecture", [70, 80, 90])
def test_a_gpus_text_stores_bytes_and_loads_what_robots_share_before_the_loop(architecture):
    _, one = make(64)
    text = gpu.compiled(one, architecture)
    before, *blocks = re.split(r"\$L__BB0_\d+:", text)
    loop = "".join(blocks)
    assert f".target sm_{architecture}" in text
    # Three bytes of an item, three numbers of its column, three of the robot.
    assert text.count("st.global.b8") + text.count("st.global.u8") == 3
    assert before.count("ld.global") == 3
    assert loop.count("ld.global") == 3
    # The root of what the robot alone determines is taken once.
    assert before.count("sqrt.approx") == 1
    assert not any(f"{op}.local" in text for op in ("ld", "st"))
