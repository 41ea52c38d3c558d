"""Make a kernel of a traced function, with another kernel inside it or none.

A kernel takes and returns numbers as they are, and a bool as 0.0 or 1.0. Constants of
the traced function may be arguments of its kernel: their places say which.
"""

import math
from collections.abc import Callable, Sequence
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Literal, Var, jaxpr_as_fun
from jaxtyping import Array, PyTree

from onekernel.errors import UnsupportedError
from onekernel.kernel import Kernel, called_by
from onekernel.lower import (
    DTYPES,
    LateProgram,
    ScalarProgram,
    scalarize_part,
    word_shape,
)

MAX_PASSED_BYTES = 64 * 1024
"""Most memory for the arguments and results of one instance: LLVM takes 10 s for a kernel that
reads and writes 10,000 numbers, and 46 s for 40,000. On a CPU, those of all lanes are on the stack
of a thread, together up to 1 MiB."""


def kernel_of(traced: ClosedJaxpr, places: Sequence[int]) -> Kernel:
    """Lower a traced function to a kernel.

    Args:
      traced: the function.
      places: the places of those of its constants that are arguments of the kernel, before others.

    Raises:
      UnsupportedError: an operation cannot be lowered, or there are several kernels in it.
    """
    arguments, results = arguments_of(traced, places), traced.jaxpr.outvars
    calls = [x for x in traced.jaxpr.eqns if called_by(x) is not None]
    # Without a kernel inside, the whole function becomes one that runs once.
    if not calls:
        return whole_kernel_of(traced, places)
    _check_passed(arguments, results)
    # Otherwise cut the function at the call. The one step must be plain: not a map, not itself made
    # of three parts, and called for one instance.
    step = called_by(calls[0])
    if len(calls) > 1 or step is None or step.table is not None or step.before or step.after:
        raise UnsupportedError("more than one kernel")
    if [tuple(x.aval.shape) for x in calls[0].invars] != step.argument_shapes:
        raise UnsupportedError("a kernel for several instances")
    if step.unsupported:
        raise step.unsupported
    # The part in front computes the arguments of the call; the part behind computes the results
    # from the arguments of the function and the results of the call. `scalarize_part` lowers only
    # what its results need, so the cut needs no list of equations.
    before = _lower_part(traced, arguments, calls[0].invars)
    after = _lower_part(traced, [*arguments, *calls[0].outvars], results)
    return Kernel(
        step.program,
        carried=step.carried,
        steps=step.steps,
        fallback=as_passed(_as_function(traced, places), traced, places),
        impl=step.impl,
        explain=step.explain,
        on_fallback=step.on_fallback,
        before=before,
        after=after,
        argument_dtypes=_passed_dtypes(arguments),
        result_dtypes=_passed_dtypes(results),
    )


def whole_kernel_of(traced: ClosedJaxpr, places: Sequence[int], *, is_late: bool = False) -> Kernel:
    """Return a traced function without a kernel inside as a kernel that runs once.

    Args:
      traced: the function.
      places: as for `kernel_of`.
      is_late: whether it is lowered when it is compiled.

    Raises:
      UnsupportedError: an operation cannot be lowered.
    """
    arguments, results = arguments_of(traced, places), traced.jaxpr.outvars

    def lower() -> ScalarProgram:
        _check_passed(arguments, results)
        return _lower_part(traced, arguments, results)

    shapes = [
        [word_shape(x.shape, x.dtype) for x in passed_avals(atoms)]
        for atoms in (arguments, results)
    ]
    return Kernel(
        LateProgram(lower, *shapes) if is_late else lower(),
        carried=0,
        steps=1,
        fallback=as_passed(_as_function(traced, places), traced, places),
        argument_dtypes=_passed_dtypes(arguments),
        result_dtypes=_passed_dtypes(results),
    )


def _lower_part(
    traced: ClosedJaxpr, arguments: Sequence[Var], results: Sequence[Var | Literal]
) -> ScalarProgram:
    """Lower a part of a traced function, whose arguments and results are those of a kernel."""
    # Functions around a step test whether its state is finite, so here NaN must stay NaN.
    return scalarize_part(traced, arguments, results, words=True, finite=False)


def _check_passed(arguments: Sequence[Var], results: Sequence[Var | Literal]) -> None:
    """Raise an error if a kernel cannot have these arguments and results."""
    # A kernel without arguments has no instances.
    if not arguments:
        raise UnsupportedError("a function of nothing")
    for dtype in dtypes_of([*arguments, *results]):
        if dtype not in DTYPES:
            raise UnsupportedError(f"arguments or results of {dtype}")
    avals = passed_avals([*arguments, *results])
    count = sum(x.dtype.itemsize * math.prod(x.shape) for x in avals)
    if count > MAX_PASSED_BYTES:
        raise UnsupportedError(
            f"arguments and results of {count:,} bytes for each instance, more than"
            f" {MAX_PASSED_BYTES:,}"
        )


def arguments_of(traced: ClosedJaxpr, places: Sequence[int]) -> list[Var]:
    """Return the variables of a jaxpr that are arguments of its kernel."""
    return [*(traced.jaxpr.constvars[i] for i in places), *traced.jaxpr.invars]


def dtypes_of(atoms: Sequence[Var | Literal]) -> list[np.dtype]:
    """Return the dtypes of a function's arguments or results."""
    return [np.dtype(cast(ShapedArray, atom.aval).dtype) for atom in atoms]


def kernels_in(traced: ClosedJaxpr) -> list[Kernel]:
    """Return the kernels that a traced function calls."""
    return [kernel for kernel in map(called_by, traced.jaxpr.eqns) if kernel is not None]


def as_passed(
    function: Callable[..., PyTree], traced: ClosedJaxpr, places: Sequence[int] = ()
) -> Callable[..., list[Array]]:
    """Return a function as one from what is passed to its kernel to what that returns.

    Args:
      function: a function of all arguments of the kernel.
      traced: that function, or one with the same arguments and results, as it was traced.
      places: as for `kernel_of`.
    """
    dtypes, result_dtypes = dtypes_of(arguments_of(traced, places)), dtypes_of(traced.jaxpr.outvars)

    def run(*passed: Array) -> list[Array]:
        # A result that is a literal of the jaxpr is a number of Python here.
        results = jax.tree.leaves(function(*received(passed, dtypes)))
        pairs = zip(results, result_dtypes, strict=True)
        return [to_pass(jnp.asarray(x, dtype)) for x, dtype in pairs]

    return run


def _as_function(traced: ClosedJaxpr, places: Sequence[int]) -> Callable[..., list[Array]]:
    """Return a traced function as one of all arguments of its kernel, which XLA computes."""

    def run(*arguments: Array) -> list[Array]:
        constants = list(traced.consts)
        # The first arguments are constants; `zip` stops after these.
        for place, argument in zip(places, arguments, strict=False):
            constants[place] = argument
        closed = ClosedJaxpr(traced.jaxpr, constants)
        return jaxpr_as_fun(closed)(*arguments[len(places) :])

    return run


def _passed_dtypes(atoms: Sequence[Var | Literal]) -> list[np.dtype]:
    return [np.dtype(np.float32) if dtype.kind == "b" else dtype for dtype in dtypes_of(atoms)]


def passed_avals(atoms: Sequence[Var | Literal]) -> list[ShapedArray]:
    """Return the shapes and dtypes that a kernel takes or returns them with."""
    pairs = zip(atoms, _passed_dtypes(atoms), strict=True)
    return [cast(ShapedArray, x.aval).update(dtype=t, weak_type=False) for x, t in pairs]


def to_pass(x: Array) -> Array:
    """Return an array as a kernel takes it."""
    return x.astype(jnp.float32) if x.dtype.kind == "b" else x


def received(passed: Sequence[Array], dtypes: Sequence[np.dtype]) -> list[Array]:
    """Return arrays of these dtypes for those that a kernel returned."""
    pairs = zip(passed, dtypes, strict=True)
    return [x != 0 if dtype.kind == "b" else x for x, dtype in pairs]
