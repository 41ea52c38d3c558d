"""A JAX function of one robot as straight-line arithmetic on single numbers.

JAX describes a function by operations on arrays; here every array is taken apart into its numbers.
Slices, gathers, transposes and the like then cost nothing, loops are written out, branches become
selections, and what a model's constants decide is decided. What is left can be done for
thousands of robots side by side, each by one thread of a GPU, without any number in between
going through memory.

The arithmetic is the function's own: results differ from JAX's by round-off alone, as
long as all numbers are finite.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from jetbot_mjx.moving import (
    RULES,
    Numbers,
    filled,
    known_array,
    known_values,
    numbers_of,
    shape_of,
    windows,
)
from jetbot_mjx.scalars import EVALUATE, Graph, Scalar, UnsupportedError, Value, in_order, is_known

MOST_TRIPS = 64
"""Of a loop that is written out."""


@dataclasses.dataclass(frozen=True)
class Program:
    """What a function does, number by number."""

    inputs: list[Numbers]
    """The numbers of each leaf of the arguments, in their shapes."""
    outputs: list[Numbers]
    """The numbers of each leaf of the result."""
    values: list[Value]
    """All that is computed, operands first."""

    def evaluate(self, leaves: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Runs the program in NumPy.

        Args:
          leaves: of the arguments, each with the same leading batch axes.

        Returns:
          The leaves of the result, with the same batch axes.
        """
        batch = leaves[0].shape[: leaves[0].ndim - self.inputs[0].ndim]
        known: dict[int, np.ndarray] = {}
        for numbers, leaf in zip(self.inputs, leaves, strict=True):
            columns = leaf.reshape(*batch, numbers.size)
            known |= {x.index: columns[..., i] for i, x in enumerate(numbers.ravel())}

        def look_up(x: Scalar) -> np.ndarray:
            return np.broadcast_to(x, batch) if is_known(x) else known[x.index]

        with np.errstate(all="ignore"):
            for value in self.values:
                if value.op == "input":
                    continue
                operands = [look_up(x) for x in value.operands]
                if value.op == "select":
                    known[value.index] = np.where(operands[0], operands[2], operands[1])
                elif value.op == "convert":
                    known[value.index] = operands[0].astype(value.dtype)
                else:
                    known[value.index] = EVALUATE[value.op](*operands)
        return [
            np.stack([look_up(x) for x in numbers.ravel()], -1).reshape(*batch, *numbers.shape)
            for numbers in self.outputs
        ]


def scalarize(function: Callable[..., Any], *arguments: Any) -> Program:
    """Writes a function down as arithmetic on single numbers.

    Args:
      function: what `jax.jit` takes; its shapes and indices must not depend on its arguments.
      *arguments: pytrees of arrays, or of what has their shape and dtype.

    Returns:
      The program.

    Raises:
      UnsupportedError: the function does what cannot be written down so.
    """
    closed = jax.make_jaxpr(function)(*arguments)
    graph = Graph()
    inputs = [
        filled(leaf.shape, lambda dtype=leaf.dtype: graph.input(dtype))
        for leaf in jax.tree.leaves(arguments)
    ]
    outputs = _Writer(graph).closed(closed, inputs)
    return Program(inputs, outputs, in_order(x for array in outputs for x in array.ravel()))


class _Writer:
    """Goes through a function's operations and records what they do to numbers."""

    def __init__(self, graph: Graph) -> None:
        self._graph = graph

    def closed(self, closed: ClosedJaxpr, arguments: Sequence[Numbers]) -> list[Numbers]:
        constants = [known_array(constant) for constant in closed.consts]
        return self._write(closed.jaxpr, constants, arguments)

    def _write(
        self, jaxpr: Jaxpr, constants: Sequence[Numbers], arguments: Sequence[Numbers]
    ) -> list[Numbers]:
        known: dict[Any, Numbers] = dict(zip(jaxpr.constvars, constants, strict=True))
        known |= dict(zip(jaxpr.invars, arguments, strict=True))

        def read(atom: Any) -> Numbers:
            if isinstance(atom, Literal):
                aval: Any = atom.aval
                return known_array(np.asarray(atom.val, aval.dtype))
            return known[atom]

        for equation in jaxpr.eqns:
            results = self._operation(equation, [read(atom) for atom in equation.invars])
            known |= dict(zip(equation.outvars, results, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    def _operation(self, equation: Any, operands: list[Numbers]) -> list[Numbers]:
        name = equation.primitive.name
        if name in EVALUATE:
            return [self._each(name, *operands)]
        rule = RULES.get(name) or getattr(self, f"_{name.replace('-', '_')}", None)
        if rule is None:
            raise UnsupportedError(f"the operation {name}")
        result = rule(equation, equation.params, *operands)
        return result if isinstance(result, list) else [result]

    def _each(self, op: str, *operands: Numbers) -> Numbers:
        arrays = np.broadcast_arrays(*operands)
        rows = zip(*(array.ravel() for array in arrays), strict=True)
        return numbers_of((self._graph.apply(op, *row) for row in rows), arrays[0].shape)

    def _choose(self, which: Scalar, no: Numbers, yes: Numbers) -> Numbers:
        pairs = zip(no.ravel(), yes.ravel(), strict=True)
        return numbers_of((self._graph.select(which, a, b) for a, b in pairs), no.shape)

    # Functions within functions.

    def _jit(self, equation: Any, params: Any, *operands: Numbers) -> list[Numbers]:
        return self.closed(params["jaxpr"], operands)

    _pjit = _jit

    def _custom_jvp_call(self, equation: Any, params: Any, *operands: Numbers) -> list[Numbers]:
        return self.closed(params["call_jaxpr"], operands)

    def _scan(self, equation: Any, params: Any, *operands: Numbers) -> list[Numbers]:
        body = params["jaxpr"].jaxpr
        # Only what is scanned over has one axis less inside.
        scanned = sum(
            len(shape_of(outer)) != len(shape_of(inner))
            for outer, inner in zip(equation.invars, body.invars, strict=True)
        )
        stacked = sum(
            len(shape_of(outer)) != len(shape_of(inner))
            for outer, inner in zip(equation.outvars, body.outvars, strict=True)
        )
        carried = len(equation.outvars) - stacked
        first = len(operands) - scanned
        constants, carry = operands[: first - carried], list(operands[first - carried : first])
        order = range(params["length"])
        rows: dict[int, list[Numbers]] = {}
        for i in reversed(order) if params["reverse"] else order:
            slices = [_at(sequence, i) for sequence in operands[first:]]
            results = self.closed(params["jaxpr"], [*constants, *carry, *slices])
            carry, rows[i] = results[:carried], results[carried:]
        shapes = [shape_of(variable) for variable in equation.outvars[carried:]]
        columns = [
            numbers_of((x for i in order for x in rows[i][k].ravel()), shape)
            for k, shape in enumerate(shapes)
        ]
        return [*carry, *columns]

    def _while(self, equation: Any, params: Any, *operands: Numbers) -> list[Numbers]:
        first = params["cond_nconsts"]
        second = first + params["body_nconsts"]
        in_condition, in_body = operands[:first], operands[first:second]
        state = result = list(operands[second:])
        going: Scalar = np.bool_(True)
        # The loop goes on past its end, on numbers that are then not taken: so a counter among
        # them stays known, and with it how often the loop is written out.
        for _ in range(MOST_TRIPS + 1):
            (condition,) = self.closed(params["cond_jaxpr"], [*in_condition, *state])
            going = self._graph.apply("and", going, condition.item())
            if is_known(going) and not going:
                return result
            state = self.closed(params["body_jaxpr"], [*in_body, *state])
            result = [self._choose(going, *pair) for pair in zip(result, state, strict=True)]
        raise UnsupportedError(f"a loop that may run more than {MOST_TRIPS} times")

    def _cond(
        self, equation: Any, params: Any, index: Numbers, *operands: Numbers
    ) -> list[Numbers]:
        which = index.item()
        branches = params["branches"]
        if is_known(which):
            last = len(branches) - 1
            return self.closed(branches[min(max(int(which), 0), last)], operands)
        if len(branches) != 2:
            raise UnsupportedError("a branch into more than two")
        no, yes = (self.closed(branch, operands) for branch in branches)
        which = self._graph.convert(which, np.dtype(bool))
        return [self._choose(which, *pair) for pair in zip(no, yes, strict=True)]

    # What depends on how numbers are moved.

    def _dynamic_slice(self, equation: Any, params: Any, x: Numbers, *starts: Numbers) -> Numbers:
        for axis, (start, size) in enumerate(zip(starts, params["slice_sizes"], strict=True)):
            last = x.shape[axis] - size
            cases = [np.take(x, range(i, i + size), axis) for i in range(last + 1)]
            at = start.item()
            if is_known(at):
                x = cases[min(max(int(at), 0), last)]
                continue
            x = cases[last]
            for i in reversed(range(last)):
                before = self._graph.apply("le", at, at.dtype.type(i))
                x = self._choose(before, x, cases[i])
        return x

    def _scatter(
        self,
        equation: Any,
        params: Any,
        x: Numbers,
        indices: Numbers,
        updates: Numbers,
        op: str | None = None,
    ) -> Numbers:
        numbers = params["dimension_numbers"]
        fixed = (*numbers.inserted_window_dims, *numbers.operand_batching_dims)
        window = iter(updates.shape[axis] for axis in numbers.update_window_dims)
        places = windows(
            x.shape,
            known_values(indices, np.int64),
            offset_dims=numbers.update_window_dims,
            collapsed=numbers.inserted_window_dims,
            index_map=numbers.scatter_dims_to_operand_dims,
            batching=numbers.operand_batching_dims,
            indices_batching=numbers.scatter_indices_batching_dims,
            sizes=[1 if axis in fixed else next(window) for axis in range(x.ndim)],
            clip="CLIP" in str(params["mode"]),
        )
        result = x.flatten()
        for place, update in zip(places.ravel(), updates.ravel(), strict=True):
            if place >= 0:
                old = result[place]
                result[place] = update if op is None else self._graph.apply(op, old, update)
        return result.reshape(x.shape)

    def _scatter_add(self, equation: Any, params: Any, *operands: Numbers) -> Numbers:
        return self._scatter(equation, params, *operands, op="add")

    def _scatter_mul(self, equation: Any, params: Any, *operands: Numbers) -> Numbers:
        return self._scatter(equation, params, *operands, op="mul")

    # Arithmetic beyond one number at a time.

    def _convert_element_type(self, equation: Any, params: Any, x: Numbers) -> Numbers:
        dtype = np.dtype(params["new_dtype"])
        return numbers_of((self._graph.convert(one, dtype) for one in x.ravel()), x.shape)

    def _select_n(self, equation: Any, params: Any, which: Numbers, *cases: Numbers) -> Numbers:
        if len(cases) != 2:
            raise UnsupportedError("a selection from more than two")
        which = np.broadcast_to(which, cases[0].shape)
        rows = zip(which.ravel(), cases[0].ravel(), cases[1].ravel(), strict=True)
        return numbers_of((self._graph.select(*row) for row in rows), cases[0].shape)

    def _clamp(
        self, equation: Any, params: Any, low: Numbers, x: Numbers, high: Numbers
    ) -> Numbers:
        return self._each("min", self._each("max", x, low), high)

    def _square(self, equation: Any, params: Any, x: Numbers) -> Numbers:
        return self._each("mul", x, x)

    def _integer_pow(self, equation: Any, params: Any, x: Numbers) -> Numbers:
        one = known_array(np.ones(x.shape, equation.outvars[0].aval.dtype))
        result = one
        for _ in range(abs(params["y"])):
            result = self._each("mul", result, x)
        return result if params["y"] >= 0 else self._each("div", one, result)

    def _rsqrt(self, equation: Any, params: Any, x: Numbers) -> Numbers:
        return self._each("div", known_array(np.float32(1)), self._each("sqrt", x))

    def _reduce(self, op: str, start: Scalar, params: Any, x: Numbers) -> Numbers:
        axes = tuple(params["axes"])
        kept = [axis for axis in range(x.ndim) if axis not in axes]
        shape = [x.shape[axis] for axis in kept]
        results = filled(shape, lambda: start)
        x = x.transpose(*kept, *axes)
        for place in np.ndindex(*shape):
            for number in x[place].ravel() if axes else [x[place]]:
                results[place] = self._graph.apply(op, results[place], number)
        return results

    def _reduce_sum(self, equation: Any, params: Any, x: Numbers) -> Numbers:
        return self._reduce("add", equation.outvars[0].aval.dtype.type(0), params, x)

    def _reduce_and(self, equation: Any, params: Any, x: Numbers) -> Numbers:
        return self._reduce("and", np.bool_(True), params, x)

    def _reduce_or(self, equation: Any, params: Any, x: Numbers) -> Numbers:
        return self._reduce("or", np.bool_(False), params, x)

    def _reduce_max(self, equation: Any, params: Any, x: Numbers) -> Numbers:
        return self._reduce("max", _lowest(equation), params, x)

    def _reduce_min(self, equation: Any, params: Any, x: Numbers) -> Numbers:
        return self._reduce("min", -_lowest(equation), params, x)

    def _cumsum(self, equation: Any, params: Any, x: Numbers) -> Numbers:
        result = np.moveaxis(x.copy(), params["axis"], 0)
        order = range(1, len(result))
        for i in [len(result) - 1 - i for i in order] if params["reverse"] else order:
            before = _at(result, i + 1 if params["reverse"] else i - 1)
            # Through a slice: a row of one axis would be stored as an array in an array.
            result[i : i + 1] = self._each("add", before, _at(result, i))[None]
        return np.moveaxis(result, 0, params["axis"])

    def _argmin(self, equation: Any, params: Any, x: Numbers) -> Numbers:
        return self._extreme("lt", equation, params, x)

    def _argmax(self, equation: Any, params: Any, x: Numbers) -> Numbers:
        return self._extreme("gt", equation, params, x)

    def _extreme(self, better: str, equation: Any, params: Any, x: Numbers) -> Numbers:
        (axis,) = params["axes"]
        kind = equation.outvars[0].aval.dtype.type
        x = np.moveaxis(x, axis, -1)
        places = filled(x.shape[:-1], lambda: kind(0))
        for row in np.ndindex(*x.shape[:-1]):
            best = x[row][0]
            for i, number in enumerate(x[row][1:], start=1):
                wins = self._graph.apply(better, number, best)
                best = self._graph.select(wins, best, number)
                places[row] = self._graph.select(wins, places[row], kind(i))
        return places

    def _dot_general(self, equation: Any, params: Any, a: Numbers, b: Numbers) -> Numbers:
        (sum_a, sum_b), (batch_a, batch_b) = params["dimension_numbers"]
        rows = _grouped(a, batch_a, sum_a)
        columns = _grouped(b, batch_b, sum_b)
        dtype = np.dtype(equation.outvars[0].aval.dtype)
        sums = []
        for block, other in zip(rows, columns, strict=True):
            for row in block:
                for column in other:
                    total: Scalar = dtype.type(0)
                    for pair in zip(row, column, strict=True):
                        # JAX multiplies whole numbers by others here.
                        x, y = (self._graph.convert(number, dtype) for number in pair)
                        product = self._graph.apply("mul", x, y)
                        total = self._graph.apply("add", total, product)
                    sums.append(total)
        return numbers_of(sums, shape_of(equation.outvars[0]))


def _at(numbers: Numbers, i: int) -> Numbers:
    """One of the leading axis, as an array even where it is a single number."""
    return numbers[i : i + 1].reshape(numbers.shape[1:])


def _lowest(equation: Any) -> Any:
    dtype = equation.outvars[0].aval.dtype
    if dtype.kind != "f":
        raise UnsupportedError(f"the extreme of {dtype}")
    return dtype.type(-np.inf)


def _grouped(x: Numbers, batch: Sequence[int], summed: Sequence[int]) -> Numbers:
    """As (batch, free, summed)."""
    free = [axis for axis in range(x.ndim) if axis not in batch and axis not in summed]
    sizes = [
        int(np.prod([x.shape[axis] for axis in axes], dtype=int)) for axes in (batch, free, summed)
    ]
    return x.transpose(*batch, *free, *summed).reshape(sizes)
