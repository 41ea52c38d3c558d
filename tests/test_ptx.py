"""The kernels' text, run by a machine for it in NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import ptx_machine
import pytest

from jetbot_mjx import ptx
from jetbot_mjx.config import parse_config
from jetbot_mjx.env import make_env
from jetbot_mjx.scalarize import scalarize
from jetbot_mjx.scalars import UnsupportedError

VECTOR = jax.ShapeDtypeStruct((4,), jnp.float32)

FUNCTIONS = {
    "arithmetic": lambda x: (x + 2) * x - x / (x - 3),
    "roots and floors": lambda x: jnp.sqrt(jnp.abs(x)) + jnp.floor(-x),
    "extremes": lambda x: jnp.maximum(x, x[::-1]) - jnp.minimum(x, 0.25),
    "angles": lambda x: jnp.sin(x * 20) + jnp.cos(x),
    "comparisons": lambda x: (
        (x < 0)
        + 2.0 * (x <= x[0])
        + 4.0 * (x > 1)
        + 8.0 * (x >= x[1])
        + 16.0 * (x == x[2])
        + 32.0 * (x != x[3])
    ),
    "logic": lambda x: jnp.where(((x > 0) | (x[0] > 0)) & ~((x > 1) ^ (x[1] > 1)), x, -x),
    "truths chosen": lambda x: jnp.where(jnp.where(x > 0, x[0] > 0, x[1] > 0), 1.0, x),
    "whole numbers": lambda x: ((x * 3).astype(jnp.int32) * jnp.argmin(x) - 2).astype(jnp.float32),
    "what is finite": lambda x: jnp.where(jnp.isfinite(1 / jnp.floor(x)), x, 0.0),
    "truth of a number": lambda x: jnp.where(x.astype(bool) == (x > 0).astype(bool), x, 5.0),
}


def run(program, arguments, steps=1, carried=1):
    robots = len(arguments[0])
    kernel = ptx.make_kernel(program, carried=carried, steps=steps, name="it")
    outputs = [np.full_like(x, np.nan) for x in arguments[:carried]]
    ptx_machine.run(ptx.source(kernel, robots), -(-robots // ptx.THREADS), arguments, outputs)
    return outputs


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_kernel_does_what_the_function_does(name):
    x = np.float32(np.random.default_rng(5).normal(size=(21, 4)))
    x[3, 2] = 0
    (ours,) = run(scalarize(FUNCTIONS[name], VECTOR), [x])
    np.testing.assert_allclose(ours, jax.vmap(FUNCTIONS[name])(x), rtol=2e-5, atol=2e-6)


def test_what_is_not_a_number_stays_so_in_an_extreme():
    x = np.float32([[np.nan, 1, 2, 3]])
    (ours,) = run(scalarize(lambda x: jnp.maximum(x, x[::-1]) + jnp.minimum(x, 1.5), VECTOR), [x])
    np.testing.assert_array_equal(np.isnan(ours), [[True, False, False, True]])


def test_results_become_arguments_and_what_is_held_stays():
    def step(x, held):
        return jnp.roll(x, 1) + held

    x = np.float32(np.random.default_rng(0).normal(size=(5, 4)))
    held = np.float32([[0.5], [1], [2], [3], [4]])
    program = scalarize(step, VECTOR, jax.ShapeDtypeStruct((1,), jnp.float32))
    (ours,) = run(program, [x, held], steps=6)
    np.testing.assert_allclose(ours, np.roll(x, 6, 1) + 6 * held, rtol=1e-5)


def test_all_results_are_read_before_any_argument_is_written():
    x = np.arange(8, dtype=np.float32).reshape(2, 4)
    (ours,) = run(scalarize(lambda x: jnp.roll(x, 1), VECTOR), [x], steps=3)
    np.testing.assert_array_equal(ours, np.roll(x, 3, 1))


@pytest.mark.parametrize("robots", [1, ptx.THREADS - 1, ptx.THREADS, 2 * ptx.THREADS + 5])
def test_robots_that_do_not_fill_their_last_block_are_all_there(robots):
    x = np.arange(4 * robots, dtype=np.float32).reshape(robots, 4)
    (ours,) = run(scalarize(lambda x: x + 1, VECTOR), [x])
    np.testing.assert_array_equal(ours, x + 1)


def test_what_ptx_does_not_do_here_is_named():
    program = scalarize(lambda x: jnp.tanh(x), VECTOR)
    with pytest.raises(UnsupportedError, match="tanh"):
        run(program, [np.zeros((1, 4), np.float32)])
    program = scalarize(lambda i: i + 1, jax.ShapeDtypeStruct((1,), jnp.int32))
    with pytest.raises(UnsupportedError, match="not float32"):
        run(program, [np.zeros((1, 1), np.int32)])


@pytest.mark.parametrize("preset", ["isaac", "real"])
def test_the_kernel_of_physics_is_its_program(preset):
    env = make_env(parse_config({"robot": {"preset": preset}}))
    physics = env.reset(jax.random.PRNGKey(0)).pipeline_state
    program = scalarize(env.physics.substep, physics, (jnp.zeros(2), []))
    rng = np.random.default_rng(0)
    robots = 20
    ours = theirs = [np.repeat(np.asarray(x)[None], robots, 0) for x in jax.tree.leaves(physics)]
    for _ in range(4):
        ctrl = np.float32(rng.uniform(-12, 31, (robots, 2)))
        ours = run(program, [*ours, ctrl], steps=8, carried=4)
        for _ in range(8):
            theirs = program.evaluate([*theirs, ctrl])
    for one, other in zip(ours, theirs, strict=True):
        np.testing.assert_array_equal(one, other)
    assert np.ptp(ours[0][:, 0]) > 0.02
