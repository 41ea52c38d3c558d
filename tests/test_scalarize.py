"""Functions taken apart into numbers do what JAX does with them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jetbot_mjx import mjx
from jetbot_mjx.config import parse_config
from jetbot_mjx.env import make_env
from jetbot_mjx.scalarize import scalarize
from jetbot_mjx.scalars import UnsupportedError
from jetbot_mjx.state import PhysicsState

MATRIX = jax.ShapeDtypeStruct((3, 4), jnp.float32)
INDICES = jnp.array([[2, 1], [0, 3], [2, 9]])


def newton(x):
    def closer(carry):
        root, i = carry
        return 0.5 * (root + jnp.abs(x) / root), i + 1

    def goes_on(carry):
        root, i = carry
        return (i < 5) & (jnp.abs(root * root - jnp.abs(x)).sum() > 1e-3)

    return jax.lax.while_loop(goes_on, closer, (jnp.ones_like(x), 0))[0]


def branch(x):
    return jax.lax.cond(x[0, 0] > 0, lambda x: x * 2, lambda x: x - 1, x)


def running(x):
    def body(carry, row):
        return carry + row, carry * row

    return jax.lax.scan(body, jnp.zeros(4), x), jax.lax.scan(body, jnp.ones(4), x, reverse=True)


FUNCTIONS = {
    "products": lambda x: (x @ x.T, jnp.einsum("ij,ij->i", x, x), jnp.linalg.norm(x, axis=1)),
    "batched product": lambda x: jnp.einsum("bi,bj->bij", x, x) @ jnp.ones((3, 4, 2)),
    "reductions": lambda x: (x.sum(0), x.max(), x.min(1), (x > 0).all(0), (x > 2).any()),
    "running sums": lambda x: (jnp.cumsum(x, 1), jnp.cumsum(x, 0, dtype=jnp.float32)),
    "running sums backwards": lambda x: jax.lax.cumsum(x, 1, reverse=True),
    "places": lambda x: (jnp.argmin(x, 1), jnp.argmax(x[:, 0])),
    "gather": lambda x: x[INDICES[:, 0], :2],
    "gather beyond the end": lambda x: x.at[INDICES[:, 0], INDICES[:, 1]].get(mode="clip"),
    "gather that fills": lambda x: x.at[:, INDICES[:, 1]].get(mode="fill", fill_value=7),
    "batched gather": lambda x: jax.vmap(lambda row, i: row[i])(x, jnp.array([3, 0, 1])),
    "scatter": lambda x: x.at[INDICES[:2, 0], INDICES[:2, 1]].set(0.5),
    "scatter that drops": lambda x: x.at[INDICES[:, 0], INDICES[:, 1]].add(x[:, 0], mode="drop"),
    "scatter that multiplies": lambda x: x.at[jnp.array([0, 2]), 1:3].multiply(3.0),
    "moves": lambda x: (
        x.T[::-1, 1:],
        jnp.pad(x, ((1, 0), (0, 2))),
        jnp.tile(x, (2, 1)),
        x.ravel(),
    ),
    "joins": lambda x: (jnp.concatenate([x, x], 1), jnp.stack([x, x], 1), jnp.split(x, 2, 1)),
    "sorted constants": lambda x: x[:, jnp.argsort(jnp.array([3, 1, 2, 0]))],
    "selection": lambda x: (jnp.where(x > 0, x, -x), jnp.clip(x, -0.5, 0.5), jnp.sign(x)),
    "a place that depends": lambda x: jax.lax.dynamic_slice(
        x, (jnp.argmax(x[:, 0]), jnp.int32(1)), (1, 2)
    ),
    "powers": lambda x: (
        x**3,
        x**-2,
        jax.lax.integer_pow(x, 0),
        jnp.square(x),
        jax.lax.rsqrt(x * x),
        x**2.0,
    ),
    "angles": lambda x: (jnp.sin(9 * x), jnp.cos(9 * x), jnp.arctan2(x, x[::-1]), jnp.floor(x)),
    "whole numbers": lambda x: ((x > 0).astype(jnp.int32) * 3 + 1, (x * 3).astype(jnp.int32)),
    "a loop that ends early": newton,
    "a branch": branch,
    "loops over rows": running,
    "constants": lambda x: x + jnp.arange(4) * jax.lax.iota(jnp.float32, 3)[:, None],
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_program_does_what_the_function_does(name):
    function = FUNCTIONS[name]
    x = np.float32(np.random.default_rng(3).normal(size=(20, *MATRIX.shape)))
    program = scalarize(function, MATRIX)
    ours = program.evaluate([x])
    theirs = jax.tree.leaves(jax.vmap(function)(x))
    for one, other in zip(ours, theirs, strict=True):
        assert one.shape == other.shape
        np.testing.assert_allclose(one, other, rtol=2e-5, atol=2e-6)


def test_a_product_of_two_dtypes_is_one_of_the_results():
    # As in the frame of a contact that has friction.
    program = scalarize(lambda x: jnp.dot(x, jnp.where(x[0] > 0, 1, 0)), MATRIX)
    x = np.float32(np.random.default_rng(3).normal(size=MATRIX.shape))
    np.testing.assert_allclose(program.evaluate([x])[0], x @ (x[0] > 0), rtol=1e-6)
    for value in program.block.values():
        if value.op == "mul":
            assert {x.dtype for x in value.operands} == {value.dtype}


def _row_after_row(x):
    """An index that counts, in a loop of which only the numbers tell how long it is."""
    return jax.lax.while_loop(
        lambda s: s[1].sum() < 9,
        lambda s: (s[0] + 1, s[1] + jnp.take(x, s[0] % len(x), axis=0)),
        (0, x[0]),
    )[1]


@pytest.mark.parametrize(
    ("function", "reason"),
    [
        (lambda x: x[x[0].astype(int)], "depends on the state"),
        (lambda x: jnp.sort(x), "depends on the state"),
        (_row_after_row, "64 times"),
        (lambda x: jax.random.uniform(jax.random.PRNGKey(0), (4,)) * x, "random"),
        (jax.lax.erf, "erf"),
    ],
)
def test_what_cannot_be_written_so_is_named(function, reason):
    with pytest.raises(UnsupportedError, match=reason):
        scalarize(function, MATRIX)


@pytest.fixture(scope="module")
def env():
    # Of the presets the one with more of everything: a motor's limit.
    return make_env(parse_config({"robot": {"preset": "real"}}))


def test_the_arithmetic_of_mjx_is_mjxs_own(env):
    def step(physics, ctrl):
        return env.physics.substep(physics, (ctrl, []))

    first = env.reset(jax.random.PRNGKey(0)).pipeline_state
    program = scalarize(step, first, jnp.zeros(2))
    rng = np.random.default_rng(0)
    robots = 32
    states = jax.tree.map(lambda x: jnp.repeat(x[None], robots, 0), first)
    step = jax.jit(jax.vmap(step))
    for number in range(40):
        if number % 8 == 0:
            ctrl = jnp.asarray(rng.uniform(-12, 31, (robots, 2)), jnp.float32)
        leaves = [np.asarray(leaf) for leaf in jax.tree.leaves((states, ctrl))]
        states = step(states, ctrl)
        ours = PhysicsState(*program.evaluate(leaves))
        # A wheel of 3e-4 kg m² under 0.05 N m s/rad: an acceleration's last digit is some 1e-4.
        np.testing.assert_allclose(ours.qpos, states.qpos, atol=2e-6)
        np.testing.assert_allclose(ours.qvel, states.qvel, atol=2e-5)
        np.testing.assert_allclose(ours.time, states.time, atol=0)
    # They have driven off, each its own way.
    assert np.ptp(np.asarray(states.qpos[:, 0])) > 0.05


def test_of_the_arithmetic_of_mjx_most_is_multiplication_by_zero(env):
    data = mjx.make_data(env.mj_model)
    size = sum(leaf.size for leaf in jax.tree.leaves(data))
    step = scalarize(
        lambda physics: env.physics.substep(physics, (jnp.zeros(2), [])),
        env.reset(jax.random.PRNGKey(0)).pipeline_state,
    )
    # The traced step has some 15,000 operations on arrays of up to 64 numbers.
    assert size < step.size < 15_000
