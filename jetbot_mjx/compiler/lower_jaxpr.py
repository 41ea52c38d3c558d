"""Lower a JAX function of one robot to arithmetic on scalars.

JAX describes a function by operations on arrays; here every array is split into its scalars.
Slices, gathers, transposes and the like then cost nothing, and everything that depends only on the
model's constants is evaluated. The rest can run for thousands of robots in parallel, each in one
thread of a GPU, and no intermediate value goes through memory.

Small loops of known length are written out, and small branches become selections. The others stay
loops and branches. What a loop carries is first taken to be as constant as it begins, and only what
proves otherwise is carried. And what is the same function of other carried numbers before the loop
and after every trip is computed when a trip begins: of a solver that tests for convergence at the
end of an iteration and prepares the next one there, the last preparation is then not made.

The arithmetic is the function's own: results differ from JAX's by round-off alone, as
long as all numbers are finite.
"""

import contextlib
import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from jetbot_mjx.compiler.indexing import (
    RULES,
    Numbers,
    filled,
    known_array,
    known_values,
    numbers_of,
    shape_of,
    windows,
)
from jetbot_mjx.compiler.scalar_ir import (
    EVALUATE,
    Expr,
    ExprGraph,
    Loop,
    Scalar,
    UnsupportedError,
    converted,
    is_constant,
    is_same,
)
from jetbot_mjx.compiler.schedule import Block, PlacedBranch, PlacedLoop, schedule

MOST_TRIPS = 64
"""Of a loop that is written out."""

MOST_WRITTEN_OUT = 512
"""Operations of a loop that is written out although it could stay one."""

MOST_IN_PROGRAM = 100_000
"""Operations of a program: a CPU's compiler takes 15 s for so many, and for more soon minutes."""

LEAST_IN_BRANCH = 24
"""Operations for which a branch is better than computing both sides."""


@dataclasses.dataclass(frozen=True)
class ScalarProgram:
    """A `ScalarProgram` holds a function's operations on scalars."""

    inputs: list[Numbers]
    """The numbers of each leaf of the arguments, in their shapes."""
    outputs: list[Numbers]
    """The numbers of each leaf of the result."""
    block: Block
    """All that is computed."""

    @property
    def size(self) -> int:
        """Return the number of recorded operations."""
        return sum(1 for _ in self.block.values())

    def evaluate(self, leaves: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Run the program in NumPy.

        Args:
          leaves: the leaves of the arguments, each with the same leading batch axes.

        Returns:
          The leaves of the result, with the same batch axes.
        """
        batch = leaves[0].shape[: leaves[0].ndim - self.inputs[0].ndim]
        run = _Evaluation(batch)
        for numbers, leaf in zip(self.inputs, leaves, strict=True):
            columns = leaf.reshape(*batch, numbers.size)
            run.known |= {x.index: columns[..., i] for i, x in enumerate(numbers.ravel())}
        with np.errstate(all="ignore"):
            run.block(self.block)
        return [
            np.stack([run.look_up(x) for x in numbers.ravel()], -1).reshape(*batch, *numbers.shape)
            for numbers in self.outputs
        ]


class _Evaluation:
    """The values of a program that runs in NumPy, for all robots."""

    def __init__(self, batch: tuple[int, ...]) -> None:
        self._batch = batch
        # Of which robots the numbers matter here.
        self._mask = np.ones(batch, bool)
        self.known: dict[int, np.ndarray] = {}

    def look_up(self, x: Scalar) -> np.ndarray:
        return np.broadcast_to(x, self._batch) if is_constant(x) else self.known[x.index]

    def block(self, block: Block) -> None:
        for item in block.items:
            if isinstance(item, PlacedLoop):
                self._loop(item)
            elif isinstance(item, PlacedBranch):
                self._branch(item)
            else:
                self.known[item.index] = self._operation(item)

    def _masked_block(self, block: Block, mask: np.ndarray) -> None:
        around, self._mask = self._mask, mask
        self.block(block)
        self._mask = around

    def _operation(self, value: Expr) -> np.ndarray:
        operands = [self.look_up(x) for x in value.operands]
        if value.op == "select":
            return np.where(operands[0], operands[2], operands[1])
        if value.op == "convert":
            return converted(operands[0], value.dtype)
        return EVALUATE[value.op](*operands)

    def _loop(self, item: PlacedLoop) -> None:
        loop = item.loop
        state = [self.look_up(loop.first[place]) for place in item.places]
        going = self._mask
        while True:
            for place, numbers in zip(item.places, state, strict=True):
                self.known[loop.carries[place].index] = numbers
            self.block(item.head)
            going = going & self.look_up(loop.going)
            if not going.any():
                break
            self._masked_block(item.body, going)
            following = [self.look_up(loop.following[place]) for place in item.places]
            state = [np.where(going, b, a) for a, b in zip(state, following, strict=True)]
        for result in item.results:
            self.known[result.index] = self.look_up(loop.outcomes[result.place])

    def _branch(self, item: PlacedBranch) -> None:
        branch = item.branch
        which = self.look_up(branch.which)
        self._masked_block(item.no, ~which & self._mask)
        self._masked_block(item.yes, which & self._mask)
        for result in item.results:
            sides = [self.look_up(side[result.place]) for side in (branch.yes, branch.no)]
            self.known[result.index] = np.where(which, *sides)


def scalarize(function: Callable[..., Any], *arguments: Any) -> ScalarProgram:
    """Lower a function to arithmetic on scalars.

    Args:
      function: a jittable function; its shapes and indices must not depend on its arguments.
      *arguments: pytrees of arrays, or of objects with their shape and dtype.

    Returns:
      The program.

    Raises:
      UnsupportedError: the function has an operation that cannot be lowered.
    """
    closed = jax.make_jaxpr(function)(*arguments)
    graph = ExprGraph()
    inputs = [
        filled(leaf.shape, lambda dtype=leaf.dtype: graph.input(dtype))
        for leaf in jax.tree.leaves(arguments)
    ]
    outputs = _JaxprLowering(graph).closed(closed, inputs)
    block = schedule(x for array in outputs for x in array.ravel())
    program = ScalarProgram(inputs, outputs, block)
    if program.size > MOST_IN_PROGRAM:
        raise UnsupportedError(f"{program.size:,} operations, more than {MOST_IN_PROGRAM:,}")
    return program


class _JaxprLowering:
    """A `_JaxprLowering` walks a function's jaxpr and records its operations on scalars."""

    def __init__(self, graph: ExprGraph) -> None:
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
        """Select one of two arrays by one condition for all elements."""
        pairs = zip(no.ravel(), yes.ravel(), strict=True)
        return numbers_of((self._graph.select(which, a, b) for a, b in pairs), no.shape)

    def _choose_rows(self, which: Numbers, no: Numbers, yes: Numbers) -> Numbers:
        """Select between two arrays by one condition for each index of the leading axes."""
        which = which.reshape(*which.shape, *[1] * (no.ndim - which.ndim))
        rows = zip(np.broadcast_to(which, no.shape).ravel(), no.ravel(), yes.ravel(), strict=True)
        return numbers_of((self._graph.select(*row) for row in rows), no.shape)

    # Functions within functions.

    def _jit(self, equation: Any, params: Any, *operands: Numbers) -> list[Numbers]:
        return self.closed(params["jaxpr"], operands)

    _pjit = _jit

    def _custom_jvp_call(self, equation: Any, params: Any, *operands: Numbers) -> list[Numbers]:
        return self.closed(params["call_jaxpr"], operands)

    def _scan(self, equation: Any, params: Any, *operands: Numbers) -> list[Numbers]:
        body, length = params["jaxpr"], params["length"]
        # Only what is scanned over has one axis less inside.
        scanned, stacked = (
            sum(len(shape_of(a)) != len(shape_of(b)) for a, b in zip(outer, inner, strict=True))
            for outer, inner in (
                (equation.invars, body.jaxpr.invars),
                (equation.outvars, body.jaxpr.outvars),
            )
        )
        carried = len(equation.outvars) - stacked
        last = len(operands) - scanned
        constants, carry = operands[: last - carried], list(operands[last - carried : last])
        sequences = operands[last:]
        if not scanned and not stacked:
            rolled = self._counted_loop(body, length, constants, carry)
            if rolled is not None:
                return rolled
        order = range(length)
        rows: dict[int, list[Numbers]] = {}
        for i in reversed(order) if params["reverse"] else order:
            slices = [_at(sequence, i) for sequence in sequences]
            results = self.closed(body, [*constants, *carry, *slices])
            carry, rows[i] = results[:carried], results[carried:]
        shapes = [shape_of(variable) for variable in equation.outvars[carried:]]
        columns = [
            numbers_of((x for i in order for x in rows[i][k].ravel()), shape)
            for k, shape in enumerate(shapes)
        ]
        return [*carry, *columns]

    def _counted_loop(
        self, body: ClosedJaxpr, length: int, constants: Sequence[Numbers], carry: list[Numbers]
    ) -> list[Numbers] | None:
        """Lower a scan without inputs; return None if it must be unrolled, however long it is."""

        def going(state: list[Numbers]) -> Scalar:
            return self._graph.apply("lt", state[0].item(), np.int32(length))

        def trip(state: list[Numbers]) -> list[Numbers]:
            counter = self._each("add", state[0], known_array(np.int32(1)))
            return [counter, *self.closed(body, [*constants, *state[1:]])]

        state = [known_array(np.int32(0)), *carry]
        with contextlib.suppress(UnsupportedError):
            return self._short_or_loop(state, going, trip)[1:]
        # An index that counts the trips, say: written out it is known.
        return None

    def _while(self, equation: Any, params: Any, *operands: Numbers) -> list[Numbers]:
        first = params["cond_nconsts"]
        second = first + params["body_nconsts"]
        in_condition, in_body = operands[:first], operands[first:second]

        def rows_going(state: list[Numbers]) -> Numbers:
            return self.closed(params["cond_jaxpr"], [*in_condition, *state])[0]

        def going(state: list[Numbers]) -> Scalar:
            # Several loops that `jax.vmap` made one go on as long as any of them does.
            rows = rows_going(state)
            return self._reduce("or", np.bool_(False), {"axes": range(rows.ndim)}, rows).item()

        def trip(state: list[Numbers]) -> list[Numbers]:
            rows = rows_going(state)
            following = self.closed(params["body_jaxpr"], [*in_body, *state])
            pairs = zip(state, following, strict=True)
            return [self._choose_rows(rows, *pair) for pair in pairs] if rows.ndim else following

        state = list(operands[second:])
        with contextlib.suppress(UnsupportedError):
            return self._short_or_loop(state, going, trip)
        # An index that counts the trips, say: written out it is known.
        return self._written_out(state, going, trip)

    def _short_or_loop(
        self, state: list[Numbers], going: Callable[..., Scalar], trip: Callable[..., list[Numbers]]
    ) -> list[Numbers]:
        """Unroll a loop if it is small and its length is known, and else keep it as a loop."""
        with contextlib.suppress(UnsupportedError):
            return self._written_out(state, going, trip, is_short=True)
        return self._loop(state, going, trip)

    def _written_out(
        self,
        state: list[Numbers],
        going: Callable[..., Scalar],
        trip: Callable[..., list[Numbers]],
        is_short: bool = False,
    ) -> list[Numbers]:
        """Unroll a loop into all iterations that it may make.

        Args:
          state: the carry of the first iteration.
          going: a function of a state that returns whether there is another iteration.
          trip: a function of a state that returns the next state.
          is_short: refuses one that makes more operations than can be written out, or of which is
            not known how often it runs.

        Returns:
          The state at the end.
        """
        before = self._graph.count
        result = state
        still: Scalar = np.bool_(True)
        # The loop goes on past its end, on numbers that are then not taken: so a counter among
        # them stays known, and with it how often the loop is written out.
        for _ in range(MOST_TRIPS + 1):
            still = self._graph.apply("and", still, going(state))
            if is_constant(still) and not still:
                return result
            if is_short and (
                not is_constant(still) or self._graph.count - before > MOST_WRITTEN_OUT
            ):
                raise UnsupportedError("a loop that is not short")
            state = trip(state)
            result = [self._choose(still, *pair) for pair in zip(result, state, strict=True)]
        raise UnsupportedError(f"a loop that may run more than {MOST_TRIPS} times")

    def _loop(
        self, state: list[Numbers], going: Callable[..., Scalar], trip: Callable[..., list[Numbers]]
    ) -> list[Numbers]:
        """Record a loop that is not unrolled.

        Args:
          state: the carry of the first iteration.
          going: a function of a state that returns whether there is another iteration.
          trip: a function of a state that returns the next state.

        Returns:
          The state at the end.
        """
        first = _flat(state)
        loop = self._graph.begin_loop(first)
        carried: set[int] = set()
        # Each round finds more that changes from trip to trip, until nothing else does.
        while True:
            begins = [loop.carries[k] if k in carried else x for k, x in enumerate(first)]
            loop.following = _flat(trip(_like(state, begins)))
            changed = [
                k
                for k, x in enumerate(first)
                if k not in carried and not is_same(x, loop.following[k])
            ]
            if not changed:
                break
            carried.update(changed)
        derived = _Derivation(self._graph, loop, carried).derived()
        if derived:
            begins = [derived.get(k, x) for k, x in enumerate(begins)]
            loop.following = _flat(trip(_like(state, begins)))
        loop.going = going(_like(state, begins))
        loop.outcomes = begins
        results = self._graph.end_loop(loop)
        ends = [results[k] if k in carried else x for k, x in enumerate(first)]
        return _like(state, ends)

    def _cond(
        self, equation: Any, params: Any, index: Numbers, *operands: Numbers
    ) -> list[Numbers]:
        branches, which = params["branches"], index.item()
        if is_constant(which):
            return self.closed(branches[min(max(int(which), 0), len(branches) - 1)], operands)
        before = self._graph.count
        sides = [self.closed(branch, operands) for branch in branches]
        is_branch = self._graph.count - before >= LEAST_IN_BRANCH
        result = sides[-1]
        for i in reversed(range(len(sides) - 1)):
            later = self._graph.apply("gt", which, which.dtype.type(i))
            if is_branch:
                flat = self._graph.branch(later, _flat(sides[i]), _flat(result))
                result = _like(result, flat)
            else:
                pairs = zip(sides[i], result, strict=True)
                result = [self._choose(later, *pair) for pair in pairs]
        return result

    # What depends on how numbers are moved.

    def _dynamic_slice(self, equation: Any, params: Any, x: Numbers, *starts: Numbers) -> Numbers:
        for axis, (start, size) in enumerate(zip(starts, params["slice_sizes"], strict=True)):
            last = x.shape[axis] - size
            cases = [np.take(x, range(i, i + size), axis) for i in range(last + 1)]
            at = start.item()
            if is_constant(at):
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
        shape = cases[0].shape
        which = np.broadcast_to(which, shape)
        result = cases[-1]
        for i in reversed(range(len(cases) - 1)):
            later = [self._is_after(number, i) for number in which.ravel()]
            rows = zip(later, cases[i].ravel(), result.ravel(), strict=True)
            result = numbers_of((self._graph.select(*row) for row in rows), shape)
        return result

    def _is_after(self, which: Scalar, case: int) -> Scalar:
        """Return whether a branch index, bool or integer, selects a later case."""
        if which.dtype == bool:
            return which
        return self._graph.apply("gt", which, which.dtype.type(case))

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


class _Derivation:
    """The carried values of a loop that are functions of its other carried values.

    A carried number follows from others if it is the same function of them before the first trip
    and after every one. The two are compared operation by operation.
    """

    def __init__(self, graph: ExprGraph, loop: Loop, carried: set[int]) -> None:
        self._graph = graph
        self._loop = loop
        # What has fewer operations first: the others may follow from it.
        self._places = sorted(carried, key=lambda k: _recorded(loop.following[k]))
        self._known: dict[Any, Scalar] = {}

    def derived(self) -> dict[int, Scalar]:
        """Return which carried values are derived, and how each is computed from the others."""
        result: dict[int, Scalar] = {}
        for place in self._places:
            ends = self._loop.first[place], self._loop.following[place]
            number = self._known.get(_names(ends))
            if number is None:
                number = self._matched(*ends)
            if number is not None:
                result[place] = number
            self._known[_names(ends)] = self._loop.carries[place] if number is None else number
        return result

    def _matched(self, before: Scalar, after: Scalar) -> Scalar | None:
        """Return one expression for both `before` and `after`; None if there is none."""
        pending = [(before, after)]
        found: dict[Any, Scalar | None] = {}
        while pending:
            ends = pending[-1]
            names = _names(ends)
            if names in self._known or names in found:
                pending.pop()
                continue
            parts = _parts(*ends)
            if parts is None:
                # Nothing in common: then nothing above it has.
                return None
            missing = [
                part
                for part in parts
                if not is_same(*part) and _names(part) not in self._known.keys() | found.keys()
            ]
            if missing:
                pending += missing
                continue
            operands = [
                a if is_same(a, b) else self._known.get(_names((a, b)), found.get(_names((a, b))))
                for a, b in parts
            ]
            found[names] = self._graph.repeat(ends[1], operands)
            pending.pop()
        return found[_names((before, after))]


def _parts(before: Scalar, after: Scalar) -> list[tuple[Scalar, Scalar]] | None:
    """Return the operands of two matching operations, in pairs."""
    if is_constant(before) or is_constant(after) or not before.operands:
        return None
    if before.op != after.op or before.dtype != after.dtype or before.op == "input":
        return None
    return list(zip(before.operands, after.operands, strict=True))


def _names(numbers: tuple[Scalar, Scalar]) -> tuple[Any, ...]:
    return tuple((x.dtype.str, x.tobytes()) if is_constant(x) else x.index for x in numbers)


def _recorded(x: Scalar) -> int:
    return -1 if is_constant(x) else x.index


def _flat(arrays: Sequence[Numbers]) -> list[Scalar]:
    return [x for array in arrays for x in array.ravel()]


def _like(arrays: Sequence[Numbers], flat: Sequence[Scalar]) -> list[Numbers]:
    """Return scalars in the shapes of the given arrays."""
    numbers = iter(flat)
    return [filled(array.shape, lambda: next(numbers)) for array in arrays]


def _at(numbers: Numbers, i: int) -> Numbers:
    """Return one entry along the leading axis, as an array even if it is a single number."""
    return numbers[i : i + 1].reshape(numbers.shape[1:])


def _lowest(equation: Any) -> Any:
    dtype = equation.outvars[0].aval.dtype
    if dtype.kind != "f":
        raise UnsupportedError(f"the extreme of {dtype}")
    return dtype.type(-np.inf)


def _grouped(x: Numbers, batch: Sequence[int], summed: Sequence[int]) -> Numbers:
    """Return an array with its axes grouped as (batch, free, summed)."""
    free = [axis for axis in range(x.ndim) if axis not in batch and axis not in summed]
    sizes = [
        int(np.prod([x.shape[axis] for axis in axes], dtype=int)) for axes in (batch, free, summed)
    ]
    return x.transpose(*batch, *free, *summed).reshape(sizes)
