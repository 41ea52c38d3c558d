"""Differentiate a kernel: its derivative is kernels again.

Motivation: without one, `jax.grad(loss of a fused function)` gives up the kernel, and XLA computes
both the function and its gradient.

Protocol:

1. Where JAX differentiates a kernel, `jax.linearize` divides its function of one instance in two:
   forward, from the arguments to the results and to what their derivative needs of them, the
   residuals; and a function that is linear in the tangents, from residuals and tangents to the
   tangents of the results. Each becomes a kernel, whose residuals are ordinary arrays.
2. Where JAX transposes the linear one, as `jax.grad` does, the transposed function takes its place:
   from residuals and cotangents to the cotangents of the arguments, a kernel too. What is linear
   is never lowered then, since kernels are lowered when they are compiled.
3. A residual that is a constant, an argument or a result is not stored once more, nor what is made
   of arguments by sums, products and the like. What `jax.checkpoint` leaves to the backward pass is
   computed there.
4. The three are kernels like the first, with derivatives of their own, of any order.

Arguments for this protocol: JAX decides what is differentiated, stored and computed again, so the
derivatives are JAX's, with its errors where there are none. Both equations are batched, looped over
and divided among devices as the kernel itself is.
"""

import functools
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal, Var, jaxpr_as_fun
from jax.interpreters import ad
from jax.interpreters.partial_eval import dce_jaxpr
from jaxtyping import Array

from onekernel.kernel import Kernel
from onekernel.keys import with_key, without_key

_QUICK = frozenset(
    {
        *("broadcast_in_dim", "convert_element_type", "copy", "expand_dims", "iota", "reshape"),
        *("concatenate", "rev", "slice", "squeeze", "stack", "transpose", "unstack"),
        *("add", "add_any", "mul", "neg", "sub", "eq", "ge", "gt", "le", "lt", "ne", "not"),
    }
)
"""Names of the primitives whose results are sooner computed again from arguments than loaded."""

Flags = tuple[bool, ...]


class _Divided(NamedTuple):
    """A `_Divided` is a function of one instance as two, and where the second one's numbers are."""

    forward: Kernel
    """From the arguments to the results and the residuals that are stored."""
    linear: Kernel
    """From what it needs of those, and the tangents, to the tangents of some results."""
    needed: list[tuple[bool, int]]
    """What it needs: whether that is a result of `forward` or else an argument, and its place."""
    results: list[int]
    """Places of the results that have a tangent."""


class Derivatives:
    """A `Derivatives` differentiates one kernel."""

    def __init__(
        self,
        function: Callable[..., list[Array]],
        arguments: Sequence[ShapedArray],
        results: Sequence[ShapedArray],
        *,
        trace: Callable[[Callable[..., Any], Iterable[ShapedArray]], ClosedJaxpr],
        make: Callable[[ClosedJaxpr], Kernel],
        is_ready: Callable[[Kernel], bool],
    ) -> None:
        """Prepare the derivatives of a kernel; they are made when they are needed.

        Args:
          function: what the kernel computes, which JAX can differentiate; of flat arrays.
          arguments: those of one instance.
          results: likewise.
          trace: traces a function of flat arrays.
          make: returns a traced function as a kernel that is lowered when it is compiled, with
            derivatives of its own.
          is_ready: is called with a kernel that will certainly be compiled; it lowers it, and
            returns whether it can be one. Otherwise XLA computes that derivative.
        """
        self._function, self._trace, self._make, self._is_ready = function, trace, make, is_ready
        self._arguments, self._results = arguments, results
        self._divided = functools.cache(self._divide)
        self._transposed = functools.cache(self._transpose)

    def jvp(
        self, primals: Sequence[Array], tangents: Sequence[Array | ad.Zero]
    ) -> tuple[list[Array], list[Array | ad.Zero]]:
        """Compute the kernel's results and their directional derivatives.

        Args:
          primals: the arguments, with any number of axes of the batch in front.
          tangents: theirs.
        """
        moves = tuple(map(_is_moving, primals, tangents))
        moving, _ = _split(moves, tangents)
        divided = self._divided(moves)
        found = self._run(divided.forward, primals)
        needed = [(found if is_result else primals)[k] for is_result, k in divided.needed]
        moved = divided.linear.as_function()([*needed, *moving]) if divided.results else []
        known = dict(zip(divided.results, moved, strict=True))
        results = found[: len(self._results)]
        zeros = [ad.Zero(jax.typeof(x).to_tangent_aval()) for x in results]
        return results, [known.get(k, zero) for k, zero in enumerate(zeros)]

    def transpose(
        self, cotangents: Sequence[Array | ad.Zero], arguments: Sequence[Array | ad.UndefinedPrimal]
    ) -> list[Array | ad.Zero | None]:
        """Compute the cotangents of the arguments in which the kernel is linear.

        Args:
          cotangents: those of its results.
          arguments: its arguments; those in which it is linear are not known.

        Returns:
          The cotangents of these, and None for all others.
        """
        unknown = tuple(map(ad.is_undefined_primal, arguments))
        given = tuple(not isinstance(x, ad.Zero) for x in cotangents)
        backward, places = self._transposed(unknown, given)
        _, known = _split(unknown, arguments)
        coming, _ = _split(given, cotangents)
        found = self._run(backward, [*known, *coming]) if places else []
        results = dict(zip(places, found, strict=True))
        return [
            results.get(k, ad.Zero(x.aval.to_ct_aval())) if ad.is_undefined_primal(x) else None
            for k, x in enumerate(arguments)
        ]

    def _run(self, kernel: Kernel, arguments: Sequence[Array]) -> list[Array]:
        """Compute a kernel that is certainly compiled; XLA does where it cannot be one."""
        if self._is_ready(kernel):
            return kernel.as_function()(arguments)
        function = kernel.fallback
        for _ in range(arguments[0].ndim - len(kernel.argument_shapes[0])):
            function = jax.vmap(function)
        return function(*arguments)

    def _divide(self, moves: Flags) -> _Divided:
        """Divide the function in two.

        Args:
          moves: which arguments have a tangent.
        """
        avals = self._arguments
        kinds: list[ShapedArray] = []
        trees: list[Any] = []

        def run(*arguments: Array) -> list[Array]:
            results, linear = self._linearized(moves, arguments)
            residuals, tree = jax.tree.flatten(linear)
            kinds[:], trees[:] = map(jax.typeof, residuals), [tree]
            return [*results, *map(without_key, residuals)]

        traced = self._trace(run, avals)
        count = len(self._results)
        stored, sources = _sources(traced.jaxpr, count)
        forward = _part(traced, [*range(count), *stored])
        # What is no result of the kernel is computed again, of arguments.
        places = [count + k for k, x in enumerate(sources) if x is None]
        again = _part(traced, places)
        needed = [(False, k) for k in _used(again)]
        needed += [(True, k) for k in dict.fromkeys(x for x in sources if x is not None)]

        def linear(*arrays: Array) -> list[Array]:
            words, tangents = dict(zip(needed, arrays, strict=False)), arrays[len(needed) :]
            zeros = [jnp.zeros(x.shape, x.dtype) for x in avals]
            arguments = [words.get((False, k), zero) for k, zero in enumerate(zeros)]
            computed = iter(jaxpr_as_fun(again)(*arguments))
            residuals = [next(computed) if k is None else words[True, k] for k in sources]
            return trees[0].unflatten(map(with_key, kinds, residuals))(*tangents)

        results = forward.out_avals
        types = [(results if is_result else avals)[k] for is_result, k in needed]
        whole = self._trace(linear, [*types, *_split(moves, avals)[0]])
        reached = _reached(whole.jaxpr, len(types))
        floats = [k for k, x in enumerate(results[:count]) if _is_float(x)]
        return _Divided(
            self._make(forward),
            self._make(_part(whole, reached)),
            needed,
            [floats[k] for k in reached],
        )

    def _linearized(
        self, moves: Flags, arguments: Sequence[Array]
    ) -> tuple[list[Array], Callable[..., list[Array]]]:
        """Return the results, and the tangents of those that are floats as a linear function."""
        floats = [_is_float(x) for x in self._results]
        moving, still = _split(moves, arguments)

        def function(*moving: Array) -> tuple[list[Array], list[Array]]:
            return _split(floats, self._function(*_merge(moves, moving, still)))

        results, linear, others = jax.linearize(function, *moving, has_aux=True)
        return _merge(floats, results, others), linear

    def _transpose(self, unknown: Flags, given: Flags) -> tuple[Kernel, list[int]]:
        """Transpose the function.

        Args:
          unknown: in which arguments it is linear.
          given: which results have a cotangent.

        Returns:
          The kernel, from the other arguments and these cotangents to the cotangents of arguments,
          and the places of those.
        """
        linear, known = _split(unknown, self._arguments)

        def backward(*arrays: Array) -> tuple[Array, ...]:
            others, coming = arrays[: len(known)], list(arrays[len(known) :])

            def forward(*moving: Array) -> list[Array]:
                return _split(given, self._function(*_merge(unknown, moving, others)))[0]

            return jax.linear_transpose(forward, *linear)(coming)

        cotangents, _ = _split(given, self._results)
        whole = self._trace(backward, [*known, *cotangents])
        reached = _reached(whole.jaxpr, len(known))
        places = [k for k, is_unknown in enumerate(unknown) if is_unknown]
        return self._make(_part(whole, reached)), [places[k] for k in reached]


def _is_float(x: Array | ShapedArray | jax.ShapeDtypeStruct) -> bool:
    return x.dtype.kind == "f"


def _is_moving(primal: Array, tangent: Array | ad.Zero) -> bool:
    return _is_float(primal) and not isinstance(tangent, ad.Zero)


def _split(flags: Iterable[bool], values: Sequence[Any]) -> tuple[list[Any], list[Any]]:
    """Return the values with a flag, and those without."""
    pairs = list(zip(flags, values, strict=True))
    return [x for flag, x in pairs if flag], [x for flag, x in pairs if not flag]


def _merge(flags: Iterable[bool], first: Sequence[Any], second: Sequence[Any]) -> list[Any]:
    """Return what `_split` divided."""
    ones, others = iter(first), iter(second)
    return [next(ones if flag else others) for flag in flags]


def _part(traced: ClosedJaxpr, places: Sequence[int]) -> ClosedJaxpr:
    """Return some results of a traced function, without the equations that they do not need."""
    needed = [k in places for k in range(len(traced.jaxpr.outvars))]
    jaxpr, _ = dce_jaxpr(traced.jaxpr, needed, True)
    return ClosedJaxpr(jaxpr, traced.consts)


def _used(closed: ClosedJaxpr) -> list[int]:
    """Return the places of the arguments that a function depends on."""
    jaxpr = closed.jaxpr
    used = {x for equation in jaxpr.eqns for x in equation.invars if not isinstance(x, Literal)}
    used.update(x for x in jaxpr.outvars if not isinstance(x, Literal))
    return [k for k, x in enumerate(jaxpr.invars) if x in used]


def _sources(jaxpr: Jaxpr, count: int) -> tuple[list[int], list[int | None]]:
    """Find out what must be stored of the results of a function that are residuals.

    Args:
      jaxpr: the function.
      count: the number of its other results, before them.

    Returns:
      Places of the results that are stored as well, and for each residual the place among the
      first results and these, or None: it is computed again.
    """
    quick: set[Var] = {*jaxpr.constvars, *jaxpr.invars}
    for equation in jaxpr.eqns:
        # What is computed of constants alone is one.
        operands = [x for x in equation.invars if not isinstance(x, Literal)]
        if equation.primitive.name in _QUICK and quick.issuperset(operands):
            quick.update(equation.outvars)
    known: dict[Var, int] = {}
    for place, atom in enumerate(jaxpr.outvars[:count]):
        if not isinstance(atom, Literal):
            known.setdefault(atom, place)
    stored: list[int] = []
    sources: list[int | None] = []
    for place, atom in enumerate(jaxpr.outvars[count:], count):
        if isinstance(atom, Literal) or atom in quick:
            sources.append(None)
            continue
        if atom not in known:
            known[atom] = count + len(stored)
            stored.append(place)
        sources.append(known[atom])
    return stored, sources


def _reached(jaxpr: Jaxpr, first: int) -> list[int]:
    """Return the places of the results that depend on the arguments from the first on."""
    reached = set(jaxpr.invars[first:])
    for equation in jaxpr.eqns:
        if not reached.isdisjoint(x for x in equation.invars if not isinstance(x, Literal)):
            reached.update(equation.outvars)
    return [k for k, x in enumerate(jaxpr.outvars) if not isinstance(x, Literal) and x in reached]
