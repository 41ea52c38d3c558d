"""Kernels with a table: a function of every item of a robot, whose results are bytes."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jetbot_mjx.compiler import kernel, llvm_backend, ptx_backend
from jetbot_mjx.compiler.lower_jaxpr import scalarize
from jetbot_mjx.errors import UserError

pytest.importorskip("llvmlite")

COLUMNS = 3
ARGUMENTS = [jax.ShapeDtypeStruct(shape, jnp.float32) for shape in ((2,), (), (COLUMNS,))]


def channels(of_robot, number, column):
    """Three values from 0 to 255: one of the robot alone, one of both, one with a branch."""
    own = jnp.sqrt(jnp.abs(of_robot[0])) * 20
    both = jnp.abs(of_robot[1] * column[0] / (column[1] + 1))

    def work(x):
        for _ in range(12):
            x = jnp.abs(jnp.sqrt(x * x + 1.0) * number - 3.0)
        return x

    far = jax.lax.cond(column[2] > 0.5, work, lambda x: x, column[0] * 40)
    return [jnp.clip(x, 0.0, 255.0) for x in (own, both, far)]


def reference(of_robot, number, table):
    values = jax.vmap(channels, in_axes=(None, None, 1))(of_robot, number, jnp.asarray(table))
    return jnp.stack(values, axis=-1).astype(jnp.uint8).reshape(-1)


def make(items, impl="auto"):
    table = np.random.default_rng(items).random((COLUMNS, items), np.float32)
    program = scalarize(channels, *ARGUMENTS)
    return table, kernel.Kernel(
        program,
        carried=0,
        steps=1,
        fallback=lambda *leaves: [reference(*leaves, table)],
        impl=impl,
        table=table,
    )


def robots(count):
    rng = np.random.default_rng(count)
    return rng.normal(0, 5, (count, 2)).astype(np.float32), rng.random(count, np.float32)


available = pytest.mark.skipif(
    all(backend.obstacle() for backend in (llvm_backend, ptx_backend)),
    reason="there is no kernel here",
)


@available
@pytest.mark.parametrize(("items", "count"), [(64, 1), (67, 9), (1024, 33), (16, 200)])
def test_every_byte_is_the_functions(items, count):
    table, one = make(items)
    run = jax.vmap(lambda *shared: kernel.as_map(one)(shared))
    text = jax.jit(run).lower(*robots(count)).as_text()
    assert text.count("custom_call @jetbot_mjx_") + text.count(ptx_backend._TARGET) == 1
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
    run = lambda *shared: kernel.as_map(one)(shared)  # noqa: E731
    of_robot, number = robots(6)
    flat = jax.vmap(run)(of_robot, number)
    nested = jax.vmap(jax.vmap(run))(of_robot.reshape(2, 3, 2), number.reshape(2, 3))
    np.testing.assert_array_equal(nested.reshape(6, -1), flat)
    np.testing.assert_array_equal(run(of_robot[4], number[4]), flat[4])


@available
def test_it_cannot_be_differentiated():
    _, one = make(64)
    with pytest.raises(UserError, match="cannot be differentiated"):
        jax.jvp(lambda x: kernel.as_map(one)((x, jnp.float32(1))), (jnp.ones(2),), (jnp.ones(2),))


def test_a_platform_without_a_kernel_runs_the_function_itself():
    _, one = make(64)
    run = jax.jit(jax.vmap(lambda *shared: kernel.as_map(one)(shared)))
    text = run.trace(*robots(3)).lower(lowering_platforms=("tpu",)).as_text()
    assert "custom_call @jetbot_mjx_" not in text
    np.testing.assert_array_equal(one.fallback(*(x[0] for x in robots(3)))[0].shape, (192,))


@pytest.mark.parametrize("architecture", [70, 80, 90])
def test_a_gpus_text_stores_bytes_and_loads_what_robots_share_before_the_loop(architecture):
    _, one = make(64)
    text = ptx_backend.compiled(one, architecture)
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
