"""Small factors and triangular systems in scalar arithmetic, in kernels and where XLA compiles."""

import functools
import itertools

import jax
import jax.numpy as jnp
import jax.scipy.linalg
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from helpers.further import slow_unless
from helpers.run_program import evaluate
from onekernel import UnsupportedError, fuse
from onekernel.build import scalarize, unroll_linear_algebra

CALLS = "potrf", "trsm", "cusolver", "cublas", "stablehlo.cholesky", "stablehlo.triangular_solve"


def in_a_kernel(function, *arguments):
    """The results of the lowered function, for each row of the arguments."""
    one = [jax.ShapeDtypeStruct(x.shape[1:], x.dtype) for x in arguments]
    program = scalarize(function, *one)
    return evaluate(program, [np.asarray(x) for x in arguments])[0]


def by_xla(function, *arguments):
    lowered = jax.jit(jax.vmap(unroll_linear_algebra(function))).lower(*arguments)
    text = lowered.as_text()
    assert not any(call in text for call in CALLS)
    return lowered.compile()(*arguments)


WAYS = [in_a_kernel, by_xla]


def matrices(count, size, seed=0):
    """Symmetric, positive definite, with eigenvalues from 1e-3 to 10."""
    rng = np.random.default_rng(seed)
    turns = np.linalg.qr(rng.normal(size=(count, size, size)))[0]
    values = 10 ** rng.uniform(-3, 1, (count, size))
    return np.asarray(np.einsum("bij,bj,bkj->bik", turns, values, turns), np.float32)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("lower", [False, True])
@pytest.mark.parametrize("size", [1, 2, 5, 8])
def test_factors_are_the_librarys(way, size, lower):
    def factor(a):
        # The library leaves in the other triangle what was there.
        return (jnp.tril if lower else jnp.triu)(jax.scipy.linalg.cho_factor(a, lower=lower)[0])

    a = matrices(8, size)
    np.testing.assert_allclose(way(factor, a), jax.vmap(factor)(a), rtol=1e-3, atol=5e-5)


@pytest.mark.parametrize(
    ("size", "columns", "way"),
    slow_unless(
        lambda size, _, way: size < 16 or way is in_a_kernel,
        [
            (size, columns, way)
            for size in (1, 2, 3, 7, 8, 16)
            for columns in ([(), (3,)] if size == 8 else [()])
            for way in WAYS
        ],
    ),
)
def test_solutions_are_as_good_as_the_librarys(way, size, columns):
    def solve(a, b):
        return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(a), b)

    a = matrices(128, size, seed=size)
    x = np.random.default_rng(1).normal(size=(128, size, *columns))
    b = np.asarray(np.einsum("bij,bj...->bi...", np.asarray(a, np.float64), x), np.float32)

    def error(solutions):
        return np.median(np.abs(solutions - x).reshape(128, -1).max(axis=1))

    assert error(way(solve, a, b)) < 1.5 * error(jax.vmap(solve)(a, b)) + 1e-7


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize(
    "options",
    # To conjugate does nothing to real numbers: of eight quick ones each other option is in four.
    [
        pytest.param(x, marks=() if x[3] == x[0] and x[4] == x[1] else pytest.mark.slow)
        for x in itertools.product([False, True], repeat=5)
    ],
)
def test_triangular_systems_may_be_of_any_kind(way, options):
    names = "left_side", "lower", "transpose_a", "conjugate_a", "unit_diagonal"
    given = dict(zip(names, options, strict=True))
    rng = np.random.default_rng(3)
    # The other triangle must not be read.
    a = rng.normal(size=(4, 5, 5)).astype(np.float32) + 3 * np.eye(5, dtype=np.float32)
    b = rng.normal(size=(4, *((5, 2) if given["left_side"] else (2, 5)))).astype(np.float32)

    def solve(a, b):
        return jax.lax.linalg.triangular_solve(a, b, **given)

    np.testing.assert_allclose(way(solve, a, b), jax.vmap(solve)(a, b), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("way", WAYS)
def test_they_are_found_in_loops_branches_calls_and_batches(way):
    def function(a, b):
        def solve(b):
            return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(a), b)

        looped, _ = jax.lax.while_loop(
            lambda carry: carry[1] < 3 + (b[0] > 0),
            lambda carry: (solve(carry[0]), carry[1] + 1),
            (b, 0),
        )
        scanned, rows = jax.lax.scan(lambda x, _: (solve(x), solve(x)), b, length=2)
        chosen = jax.lax.cond(b[0] > 0, jax.jit(solve), lambda b: solve(2 * b), b)
        batched = jnp.linalg.cholesky(jnp.stack([a, a + jnp.eye(4)]))
        return jnp.concatenate([looped, scanned, chosen, rows.ravel(), batched.ravel()])

    a = matrices(6, 4) + np.eye(4, dtype=np.float32)
    b = np.random.default_rng(0).normal(size=(6, 4)).astype(np.float32)
    np.testing.assert_allclose(way(function, a, b), jax.vmap(function)(a, b), rtol=1e-3, atol=1e-4)


def test_what_is_unrolled_can_be_differentiated():
    def energy(a, b):
        return b @ jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(a), b)

    a, b = matrices(1, 4)[0] + np.eye(4, dtype=np.float32), jnp.arange(4.0)
    for derivative in (jax.grad, jax.jacfwd):
        expected = derivative(energy, argnums=1)(a, b)
        outside = derivative(unroll_linear_algebra(energy), argnums=1)(a, b)
        np.testing.assert_allclose(outside, expected, rtol=1e-4)
        inside = unroll_linear_algebra(derivative(energy, argnums=1))(a, b)
        np.testing.assert_allclose(inside, expected, rtol=1e-4)


def test_what_is_unrolled_takes_and_returns_trees_and_runs_where_nothing_is_compiled():
    def function(given, scale):
        return {"factor": jnp.linalg.cholesky(given["a"]) * scale, "none": None}

    a = jnp.asarray(matrices(1, 3)[0])
    with jax.disable_jit():
        ours = unroll_linear_algebra(function)({"a": a}, 2.0)
    np.testing.assert_allclose(ours["factor"], 2 * jnp.linalg.cholesky(a), rtol=1e-3, atol=1e-5)
    assert ours["none"] is None


@pytest.mark.parametrize("way", WAYS)
def test_what_is_not_positive_definite_gives_nan(way):
    a = np.diag([1.0, -1.0, 1.0]).astype(np.float32)[None]
    assert np.isnan(way(jnp.linalg.cholesky, a)).any()


@pytest.mark.parametrize("way", [fuse, unroll_linear_algebra])
def test_a_matrix_without_rows_has_a_factor_and_solutions_without_rows(way):
    def solve(a, b):
        return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(a), b)

    a, b = np.zeros((2, 0, 0), np.float32), np.zeros((2, 0, 3), np.float32)
    assert jax.jit(jax.vmap(way(jnp.linalg.cholesky)))(a).shape == a.shape
    assert jax.jit(jax.vmap(way(solve)))(a, b).shape == b.shape


def test_large_matrices_stay_with_the_library_and_no_kernel_takes_them():
    a = matrices(1, 17)[0]
    np.testing.assert_array_equal(
        unroll_linear_algebra(jnp.linalg.cholesky)(a), jnp.linalg.cholesky(a)
    )
    with pytest.raises(UnsupportedError, match="cholesky of 17 rows, more than 16"):
        scalarize(jnp.linalg.cholesky, a)
    with pytest.raises(UnsupportedError, match="triangular_solve of 17 rows, more than 16"):
        scalarize(lambda a, b: jax.scipy.linalg.solve_triangular(a, b), a, a[0])


def chain(links):
    """A chain of bodies on hinges, with limits that it hits."""
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.integrator = 0.01, mujoco.mjtIntegrator.mjINT_EULER
    spec.option.iterations, spec.option.ls_iterations = 4, 6
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    body = spec.worldbody
    for _ in range(links):
        body = body.add_body(pos=(0.1, 0, 0))
        body.add_joint(
            type=mujoco.mjtJoint.mjJNT_HINGE, axis=(0, 1, 0), limited=True, range=(-0.2, 0.2),
            damping=[0.01, 0, 0],
        )  # fmt: skip
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=(0, 0, 0, 0.1, 0, 0), size=(0.02, 0, 0),
            contype=0, conaffinity=0,
        )  # fmt: skip
    return spec.compile()


@functools.cache
def driven_chain(links):
    """A step of a chain, positions and velocities for it, and what the library makes of them."""
    model = chain(links)
    there, data = mjx.put_model(model), mjx.make_data(model)

    def step(qpos, qvel):
        after = mjx.step(there, data.replace(qpos=qpos, qvel=qvel))
        return jnp.concatenate([after.qpos, after.qvel])

    rng = np.random.default_rng(0)
    qpos = rng.uniform(-0.3, 0.3, (8, links)).astype(np.float32)
    qvel = rng.normal(size=(8, links)).astype(np.float32)
    with jax.default_matmul_precision("highest"):
        return step, (qpos, qvel), jax.jit(jax.vmap(step))(qpos, qvel)


@pytest.mark.slow
@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("links", [pytest.param(1, marks=pytest.mark.slow), 3])
def test_a_chain_of_hinges_moves_as_with_the_library(way, links):
    step, given, theirs = driven_chain(links)
    with jax.default_matmul_precision("highest"):
        ours = way(step, *given)
    np.testing.assert_allclose(ours, theirs, rtol=1e-3, atol=1e-4)
