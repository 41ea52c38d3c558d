"""Compare a kernel with XLA on random numbers before its first use.

Two correct programs of one function differ by round-off, and a function may enlarge that: a test
such as x > 0.3 goes one way here and the other way there, and a solver stops an iteration earlier.
So the measure of what is allowed comes from the function itself: XLA computes it also with other
round-off in each of its operations (`onekernel.round_off`), and a result may differ from XLA's by a
few times what those evaluations differ by. A whole number or truth value that is the same in all of
them must be the same.
"""

from collections.abc import Callable, Sequence

import jax
import numpy as np
from jaxtyping import Array

from onekernel.errors import KernelError
from onekernel.kernel import Kernel
from onekernel.round_off import noisy

_INSTANCES = 65
_EVALUATIONS = 16
"""Number of evaluations with other round-off."""

_ROUNDING = {np.dtype(np.float32): 1e-5, np.dtype(np.float64): 2e-14}
"""Difference that is always allowed, as a part of the largest magnitude of a result's scalar."""

_JUMP = 1e-3
"""Difference of an evaluation, likewise, above which round-off has decided something there."""

_REACH = 8.0
"""Multiple of such a difference by which all numbers of its instance may differ there."""

_AMPLIFICATION = 4.0
"""Multiple of the largest difference of those evaluations that is allowed beside that."""


def check(kernel: Kernel, arguments: Sequence[np.dtype], results: Sequence[np.dtype]) -> None:
    """Compare a kernel with its fallback on random arguments, on JAX's default device.

    Floats are normal, with each instance on a scale of its own; whole numbers with a sign are small
    (they may be indices), and those without are random bits (they may be the words of a key).

    Args:
      kernel: the kernel, which steps.
      arguments: the dtypes of its arguments; a truth value is passed as a float32.
      results: likewise.

    Raises:
      KernelError: a result differs from XLA's by more than round-off. Its kind is "check".
    """
    random = np.random.default_rng(0)
    shapes = kernel.argument_shapes
    drawn = [_draw(random, dtype, shape) for dtype, shape in zip(arguments, shapes, strict=True)]
    # The caller may be tracing another function, and forbid that arrays are copied to a device.
    with jax.ensure_compile_time_eval(), jax.transfer_guard("allow"):
        by_xla = jax.jit(jax.vmap(lambda *passed: kernel.fallback(*passed)))
        ours = _run(jax.jit(jax.vmap(lambda *passed: kernel.as_function()(passed))), drawn, results)
        theirs = _run(by_xla, drawn, results)
        seeds = random.integers(0, 2**32, (_EVALUATIONS, _INSTANCES), np.uint32)
        with_noise = jax.jit(jax.vmap(noisy(kernel.fallback)))
        shaken = [_run(with_noise, [seed, *drawn], results) for seed in seeds]
    for place, (one, other) in enumerate(zip(ours, theirs, strict=True)):
        others = [x[place] for x in shaken]
        wrong = differ(one, other, [*others, _decided(other, others)], _AMPLIFICATION, _size(other))
        if wrong.any():
            # Name the first number that differs.
            at = tuple(np.argwhere(wrong)[0].tolist())
            where = f" at {[*at[1:]]}" if at[1:] else ""
            count = wrong.reshape(_INSTANCES, -1).any(axis=1).sum()
            message = (
                f"result {place} of a kernel is not XLA's: {one[at]:.9g} instead of"
                f" {other[at]:.9g}{where} in {count} of {_INSTANCES} random instances"
            )
            raise KernelError(message, "check")


def _draw(random: np.random.Generator, dtype: np.dtype, shape: tuple[int, ...]) -> np.ndarray:
    full = (_INSTANCES, *shape)
    if dtype.kind == "f":
        scale = np.exp(random.normal(size=(_INSTANCES, *[1] * len(shape))))
        return (random.normal(size=full) * scale).astype(dtype)
    if dtype.kind == "b":
        return random.random(full) < 0.5
    if dtype.kind == "u":
        return random.integers(0, np.iinfo(dtype).max, full, dtype, endpoint=True)
    return random.integers(0, 8, full, dtype)


def _run(
    function: Callable[..., list[Array]],
    arguments: Sequence[np.ndarray],
    dtypes: Sequence[np.dtype],
) -> list[np.ndarray]:
    """Run a function whose truth values are passed as 0.0 and 1.0."""
    passed = [x.astype(np.float32) if x.dtype.kind == "b" else x for x in arguments]
    found = zip(map(np.asarray, function(*passed)), dtypes, strict=True)
    return [x != 0 if dtype.kind == "b" else x for x, dtype in found]


def differ(
    one: np.ndarray,
    other: np.ndarray,
    shaken: Sequence[np.ndarray],
    amplification: float,
    size: np.ndarray,
) -> np.ndarray:
    """Return which numbers differ by more than round-off.

    Args:
      one: a result of several instances, (instances, ...).
      other: what it should be.
      shaken: the same as `other`, each computed with other round-off.
      amplification: multiple of the largest difference between those and `other` that is allowed.
      size: how large the numbers are in the instances together, (...): a number that is a thousand
        times smaller may differ as one of a thousandth of that.

    Returns:
      Truth values of the shape of `one`.
    """
    if one.dtype.kind != "f":
        # What round-off changes may go either way.
        steady = np.all([x == other for x in shaken], axis=0)
        return steady & (one != other)
    with np.errstate(invalid="ignore", over="ignore"):
        spread = np.max([np.abs(x.astype(np.float64) - other) for x in shaken], axis=0)
        scale = np.maximum(np.abs(other), np.maximum(1e-3 * size, 1e-30))
        allowed = _ROUNDING[one.dtype] * scale + amplification * spread
        close = np.abs(one.astype(np.float64) - other) <= allowed
    same = (one == other) | (np.isnan(one) & np.isnan(other))
    # A result that is finite in some evaluations only is as unsteady as one that varies.
    steady = np.all([np.isfinite(x) == np.isfinite(other) for x in shaken], axis=0)
    return steady & ~close & ~same


def _decided(result: np.ndarray, shaken: Sequence[np.ndarray]) -> np.ndarray:
    """Return a result that differs in all numbers of an instance in which round-off decides.

    Where a comparison or an index goes one way or the other, what it changes is no measure of what
    another such decision changes: all numbers of such an instance move farther than the farthest.

    Args:
      result: a result of several instances, (instances, ...).
      shaken: the same, each computed with other round-off.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        plain = result.astype(np.float64)
        moves = np.max([np.abs(np.where(x == result, 0, x - plain)) for x in shaken], axis=0)
        # A number that is finite in some evaluations only moves without end.
        steady = np.all([np.isnan(x) == np.isnan(plain) for x in shaken], axis=0)
        moves = np.where(np.isnan(moves), np.where(steady, 0, np.inf), moves)
        limit = _JUMP * np.maximum(np.abs(plain), _size(plain)) if result.dtype.kind == "f" else 0
        axes = tuple(range(1, result.ndim))
        jumps = (moves > limit).any(axis=axes, keepdims=True)
        farthest = moves.max(axis=axes, keepdims=True, initial=0)
        return np.where(jumps, plain + _REACH * farthest, plain)


def _size(result: np.ndarray) -> np.ndarray:
    """Return how large each number of a result is in the median of the instances."""
    return np.median(np.abs(np.where(np.isfinite(result), result, 0)), axis=0)
