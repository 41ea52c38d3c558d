"""Derivatives of random functions, against differences in float64 and against JAX's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import smooth_functions
from helpers.further import slow_unless
from helpers.smooth_functions import BLOCKS, MOVES, SmoothFunction
from onekernel import cpu, fuse
from onekernel.lower import control_flow

pytestmark = pytest.mark.skipif(cpu.obstacle() is not None, reason="there are no kernels here")

BATCH = 25  # functions in one test
BATCHES = 40
BATCHES_IN_FLOAT64 = 10
QUICK = (0, 2, 3)
INSTANCES = 2
STEP = 2e-3
"""Of the first differences."""

STEADY = 1e-7
"""Differences of two steps that are farther apart, as a part of the derivative, measure nothing."""

PRECISE = 1e-6
"""What derivatives in float64 may differ by from differences, as a part of them."""

CLOSE = {np.float32: 1e-4, np.float64: 1e-10}
"""What those of kernels may differ by from JAX's."""

SOONEST = {}
"""Options with which XLA compiles soonest."""
if jax.default_backend() == "cpu":
    SOONEST = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}

WEIGHTS = np.array([1.0, -0.7, 0.4, 1.3])


def derivative(function, direction, has_reverse_mode):
    """The derivative of a weighted sum of results along a direction, by the mode that there is."""

    def total(x):
        return (function(x) * jnp.asarray(WEIGHTS, x.dtype)).sum()

    def along(x):
        towards = jnp.asarray(direction, x.dtype)
        return (
            jax.grad(total)(x) @ towards
            if has_reverse_mode
            else jax.jvp(total, (x,), (towards,))[1]
        )

    return along


def one_by_one(function, points, dtype):
    """What JAX computes at each point, an operation after the other: no function is compiled."""
    with jax.enable_x64(dtype == np.float64), jax.disable_jit():
        return np.stack([np.asarray(function(jnp.asarray(x, dtype))) for x in points])


def differences(function, x, direction):
    """The derivative along a direction by differences in float64; None where they disagree."""

    def quotient(step):
        ends = one_by_one(function, [x + step * direction, x - step * direction], np.float64)
        return (ends[0] - ends[1]) @ WEIGHTS / (2 * step)

    first, second, third = (quotient(STEP / 2**k) for k in range(3))
    # Richardson's extrapolation, whose error is of the fourth order.
    coarse, fine = (4 * second - first) / 3, (4 * third - second) / 3
    return fine if abs(coarse - fine) <= STEADY * abs(fine) else None


def compare(function, has_reverse_mode, seed, dtype):
    """Check a function's derivative in a dtype; return whether differences could measure it."""
    points = smooth_functions.inputs(seed, INSTANCES)
    direction = np.random.default_rng(seed).normal(size=points.shape[1])
    along = derivative(function, direction, has_reverse_mode)
    precise = one_by_one(along, points, np.float64)
    theirs = one_by_one(along, points, dtype)
    one = fuse(function, on_unsupported="raise")
    run = jax.jit(jax.vmap(derivative(one, direction, has_reverse_mode)))
    with jax.enable_x64(dtype == np.float64):
        ours = np.asarray(run(dtype(points)))
    assert ours.dtype == dtype
    # A function may enlarge round-off: by how much, the error of float32 tells.
    rough = theirs if dtype == np.float32 else one_by_one(along, points, np.float32)
    enlarged = np.abs(rough - precise).max() * np.finfo(dtype).eps / np.finfo(np.float32).eps
    allowed = CLOSE[dtype] * np.abs(precise).max() + 4 * enlarged
    if np.abs(ours - theirs).max() > allowed:
        # Where large terms cancel, what XLA makes of the same operations in its order is round-off.
        with jax.enable_x64(dtype == np.float64):
            compiled = jax.jit(jax.vmap(along), compiler_options=SOONEST)(dtype(points))
        allowed += 4 * np.abs(np.asarray(compiled) - precise).max()
    assert np.abs(ours - theirs).max() <= allowed, f"{ours}, not {theirs}, precisely {precise}"
    found = differences(function, points[0], direction)
    if found is not None:
        ours = ours if dtype == np.float64 else precise
        assert abs(found - ours[0]) <= PRECISE * abs(found), f"{ours[0]}, not {found}"
    return found is not None


def check(seed, monkeypatch, dtype=np.float32):
    """Check the function of a seed, of which every fourth has no reverse mode."""
    has_reverse_mode = seed % 4 > 0
    function = SmoothFunction(seed, has_reverse_mode)
    with monkeypatch.context() as patch:
        if seed % 2:
            # Loops and branches where there would be none: all are small here.
            patch.setattr(control_flow, "MIN_BRANCH_OPERATIONS", 2)
            patch.setattr(control_flow, "MAX_UNROLLED_OPERATIONS", 8)
        try:
            return compare(function, has_reverse_mode, seed, dtype)
        except Exception as error:
            lines = "\n".join(function.text)
            raise AssertionError(f"seed {seed}: {error}\n{lines}") from error


KINDS = {
    "moves": lambda x, y: sum(f(x, y) for f in MOVES.values()),
    "blocks": lambda x, y: sum(
        f(MOVES["where"], MOVES["gather"], count, x, y) for f in BLOCKS.values() for count in (1, 2)
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", [pytest.param("moves", marks=pytest.mark.slow), "blocks"])
def test_all_kinds_of_operations_have_jaxs_gradient(name, monkeypatch):
    if name == "blocks":
        monkeypatch.setattr(control_flow, "MIN_BRANCH_OPERATIONS", 2)
        monkeypatch.setattr(control_flow, "MAX_UNROLLED_OPERATIONS", 8)

    def gradients(function):
        total = lambda x, y: (function(x, y) * np.float32(WEIGHTS)).sum()  # noqa: E731
        return jax.jit(jax.vmap(jax.grad(total, argnums=(0, 1))), compiler_options=SOONEST)

    points = np.float32(smooth_functions.inputs(3, 10)).reshape(2, 5, -1)
    ours = gradients(fuse(KINDS[name], on_unsupported="raise"))(*points)
    for one, other in zip(ours, gradients(KINDS[name])(*points), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-4, atol=1e-4 * np.abs(other).max())


@pytest.mark.parametrize("seed", slow_unless(QUICK.__contains__, range(BATCH)))
def test_derivatives_in_float64_are_what_differences_make_of_them(seed, monkeypatch):
    check(seed, monkeypatch, np.float64)


@pytest.mark.slow
@pytest.mark.parametrize("batch", range(BATCHES_IN_FLOAT64))
def test_more_derivatives_in_float64_are_what_differences_make_of_them(batch, monkeypatch):
    seeds = range(BATCH * (batch + 1), BATCH * (batch + 2))
    assert sum(check(seed, monkeypatch, np.float64) for seed in seeds) > 0.6 * BATCH


@pytest.mark.slow
@pytest.mark.parametrize("batch", range(BATCHES))
def test_a_thousand_derivatives_are_what_differences_and_jax_make_of_them(batch, monkeypatch):
    seeds = range(BATCH * batch, BATCH * (batch + 1))
    assert sum(check(seed, monkeypatch) for seed in seeds) > 0.6 * BATCH
