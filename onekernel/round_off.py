"""Evaluate a JAX function with the round-off of another correct program.

Two correct programs of one function differ in the last bits of what they compute: one keeps a
product exact in the sum behind it, adds in another order, or has another polynomial for tanh. What
`noisy` returns differs so on purpose: it computes the function, and changes each float that
arithmetic makes by some units in its last place, wherever in the function that is. How far the
results of a few such evaluations lie apart tells how far the function enlarges round-off.

What is exact stays: selections, copies, conversions, rounding to whole numbers, random bits, and
arithmetic on whole numbers whose result is whole, such as a count of steps. The noise of a number
is a hash of its bits, its place in its array, its equation and a seed, so that loops need no
random key.
"""

from collections.abc import Callable, Sequence
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import ShapedArray
from jax.extend.core import ClosedJaxpr, JaxprEqn, Literal, Var
from jaxtyping import Array, Bool, Float, UInt32

from onekernel.lower import call_of, scan_ends

_NOISE = 2
"""Largest relative change of a number, in units of the difference between 1 and the next number: it
is 2 to 4 units in the last place."""

_NOISY_TRIPS = 1000
"""Number of iterations of a while loop that have noise. A loop that runs until nothing changes may
not end before."""

_EXACT = frozenset(
    {
        *("abs", "bitcast_convert_type", "broadcast_in_dim", "ceil", "clamp", "concatenate"),
        *("convert_element_type", "copy", "cummax", "cummin", "device_put", "dynamic_slice"),
        *("dynamic_update_slice", "floor", "gather", "iota", "max", "min", "neg", "nextafter"),
        *("pad", "reduce_max", "reduce_min", "reduce_precision", "reshape", "rev", "round"),
        *("scatter", "scatter-max", "scatter-min", "select_n", "sign", "slice", "sort", "squeeze"),
        *("stop_gradient", "top_k", "transpose"),
    }
)
"""Names of the primitives that choose, move or convert numbers."""

_SOLVERS = frozenset({"cholesky", "lu", "qr", "triangular_solve"})
"""Names of the primitives that divide on their way: whole numbers do not stay whole."""

_SUMS = _SOLVERS | frozenset(
    {
        *(
            "conv_general_dilated",
            "cumlogsumexp",
            "cumprod",
            "cumsum",
            "dot_general",
            "reduce_prod",
        ),
        *("reduce_sum", "scatter-add", "scatter-mul"),
    }
)
"""Names of the primitives whose results are each made of many numbers, and rounded on the way."""


def noisy(function: Callable[..., list[Array]]) -> Callable[..., list[Array]]:
    """Return a function whose floats are changed in their last bits; JAX can transform it.

    Args:
      function: a function of arrays that returns a list of arrays, and may be the fallback of a
        kernel.

    Returns:
      A function of a seed, a uint32, and of the arguments. With a seed of 0 there is no noise.
    """

    def run(seed: UInt32[Array, ""], *arguments: Array) -> list[Array]:
        evaluation = _Evaluation(seed)
        closed = jax.make_jaxpr(function)(*arguments)
        return evaluation.run(closed, [evaluation.rounded([x], x, x) for x in arguments])

    return run


class _Evaluation:
    """An `_Evaluation` computes jaxprs; each equation has noise of its own."""

    def __init__(self, seed: UInt32[Array, ""]) -> None:
        self.seed, self.count = seed, 0

    def run(self, closed: ClosedJaxpr, arguments: Sequence[Array]) -> list[Array]:
        """Return the results of a jaxpr."""
        variables = (*closed.jaxpr.constvars, *closed.jaxpr.invars)
        values = dict(zip(variables, (*closed.consts, *arguments), strict=True))

        def read(atom: Var | Literal) -> Array:
            if isinstance(atom, Literal):
                return jnp.asarray(atom.val, cast(ShapedArray, atom.aval).dtype)
            return values[atom]

        for equation in closed.jaxpr.eqns:
            results = self.results(equation, list(map(read, equation.invars)))
            values.update(zip(equation.outvars, results, strict=True))
        return list(map(read, closed.jaxpr.outvars))

    def shaken(self, x: Array) -> Array:
        """Return an array whose floats are changed by up to `_NOISE` units of themselves."""
        if not is_float(x):
            return x
        self.count += 1
        return _shaken(x, self.seed, np.uint32(self.count * 0x9E3779B9 % 2**32))

    def rounded(self, operands: Sequence[Array], x: Array, other: Array) -> Array:
        """Return a result where it is exact, and elsewhere another one with noise."""
        if not is_float(x):
            return other
        return jnp.where(_is_exact(operands, x), x, self.shaken(other))

    def results(self, equation: JaxprEqn, operands: list[Array]) -> Sequence[Array]:
        """Return the results of an equation."""
        name, params = equation.primitive.name, equation.params
        if call := getattr(self, f"_{name}", None):
            return call(equation, operands)
        if called := call_of(equation, operands):
            return self.run(*called)

        def bind(given: Sequence[Array]) -> Sequence[Array]:
            found = equation.primitive.bind(*given, **params)
            return found if equation.primitive.multiple_results else [found]

        plain = bind(operands)
        if name in _EXACT or not any(map(is_float, plain)):
            return plain
        other = bind(list(map(self.shaken, operands))) if name in _SUMS else plain
        if name in _SOLVERS:
            return list(map(self.shaken, other))
        pairs = zip(plain, other, strict=True)
        return [self.rounded(operands, x, y) for x, y in pairs]

    # Rules of primitives that call functions several times, each a method of the primitive's name.

    def _scan(self, equation: JaxprEqn, operands: list[Array]) -> list[Array]:
        first, last = scan_ends(equation)
        params = equation.params

        def step(carry: list[Array], row: list[Array]) -> tuple[list[Array], list[Array]]:
            results = self.run(params["jaxpr"], [*operands[:first], *carry, *row])
            return results[: last - first], results[last - first :]

        how = {"length": params["length"], "reverse": params["reverse"]}
        carry, rows = jax.lax.scan(step, operands[first:last], operands[last:], **how)
        return [*carry, *rows]

    def _while(self, equation: JaxprEqn, operands: list[Array]) -> list[Array]:
        params, seed = equation.params, self.seed
        first = params["cond_nconsts"]
        second = first + params["body_nconsts"]

        def is_going(state: Sequence[Array]) -> Array:
            return self.run(params["cond_jaxpr"], [*operands[:first], *state])[0]

        def step(carried: tuple[Array, Array, list[Array]]) -> tuple[Array, Array, list[Array]]:
            count, going, state = carried
            self.seed = jnp.where(count < _NOISY_TRIPS, seed, 0)
            after = self.run(params["body_jaxpr"], [*operands[first:second], *state])
            # A batched loop has a condition for each instance, and those that have ended wait.
            shapes = [going.shape + (1,) * (x.ndim - going.ndim) for x in state]
            triples = zip(shapes, after, state, strict=True)
            state = [jnp.where(going.reshape(shape), x, y) for shape, x, y in triples]
            going &= is_going(state)
            self.seed = seed
            return count + 1, going, state

        start = operands[second:]
        carried = jnp.int32(0), is_going(start), start
        return jax.lax.while_loop(lambda carried: carried[1].any(), step, carried)[2]

    def _cond(self, equation: JaxprEqn, operands: list[Array]) -> list[Array]:
        branches = equation.params["branches"]
        functions = [lambda *given, one=one: self.run(one, given) for one in branches]
        return jax.lax.switch(operands[0].astype(jnp.int32), functions, *operands[1:])


def is_float(x: Array) -> bool:
    """Return whether numbers are float32 or float64."""
    return x.dtype in (jnp.float32, jnp.float64)


@jax.jit
def _shaken(
    x: Float[Array, "..."], seed: UInt32[Array, ""], number: UInt32[Array, ""]
) -> Float[Array, "..."]:
    places = jnp.arange(x.size, dtype=jnp.uint32).reshape(x.shape)
    bits = jax.lax.bitcast_convert_type(x, jnp.uint32)
    if x.dtype == jnp.float64:
        bits = bits[..., 0] ^ bits[..., 1]
    bits ^= seed + number + places * np.uint32(0x85EBCA6B)
    # MurmurHash3 mixes the bits of a number so.
    bits = (bits ^ (bits >> 16)) * np.uint32(0x85EBCA6B)
    bits = (bits ^ (bits >> 13)) * np.uint32(0xC2B2AE35)
    bits = jax.lax.bitcast_convert_type(bits ^ (bits >> 16), jnp.int32)
    unit = _NOISE * jnp.finfo(x.dtype).eps
    size = jnp.where(seed == 0, x.dtype.type(0), x.dtype.type(unit / 2**31))
    return x * (1 + bits.astype(x.dtype) * size)


def _is_exact(operands: Sequence[Array], result: Array) -> Bool[Array, "..."]:
    """Return which numbers are whole and made of whole ones, so that nothing is rounded."""
    most = 2.0 ** (jnp.finfo(result.dtype).nmant + 1)
    exact = (result == jnp.round(result)) & (jnp.abs(result) < most)
    for x in operands:
        if is_float(x):
            is_whole = x == jnp.round(x)
            exact &= is_whole if x.shape in ((), result.shape) else is_whole.all()
    return exact
