"""Lower loops and branches: `scan`, `while` and `cond`.

Short loops of known length are unrolled, and short branches become selections. All others stay
loops and branches:

- A value that a loop carries is first assumed to be constant. Values that prove to change are
  carried in the next round, until a round finds no more of them.
- A carried value that is the same function of other carried values before the loop and after each
  iteration is not carried, but computed at the start of the iteration (`derived_carries`). In a
  solver that prepares the next iteration at the end of each one, this saves the last one.
- What a scan reads and returns step by step is in arrays in memory: an iteration loads the scalars
  of its step, and stores those that it returns.
"""

import contextlib
import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np
from jax.extend.core import ClosedJaxpr, JaxprEqn

from onekernel.errors import UnsupportedError
from onekernel.lower.arithmetic import at, elementwise, fold, where
from onekernel.lower.derived_carries import find_derived
from onekernel.lower.dynamic_indexing import read_at
from onekernel.lower.indexing import ScalarArray, constant_array, scalar_array, shape_of
from onekernel.lower.random_rules import like, words_of
from onekernel.lower.scalar_ir import (
    ExprGraph,
    Loop,
    Scalar,
    bits_of,
    check_scalars,
    is_constant,
    is_same,
)

MAX_UNROLLED_TRIPS = 64
"""Largest number of iterations of a loop that is unrolled."""

MAX_UNROLLED_OPERATIONS = 512
"""Largest number of operations of a loop that is unrolled although it could stay a loop."""

MAX_UNROLLED_SCAN_OPERATIONS = 16_384
"""Largest number of operations of an unrolled scan with sequences that could be a loop: as a loop,
it keeps them in memory. LLVM takes 2 s to compile that many for a CPU."""

MAX_ARRAY_BYTES = 4 << 20
"""Most memory for the arrays of one instance, about as many numbers as operations may be recorded.
Platforms may allow less."""

MIN_BRANCH_OPERATIONS = 24
"""Smallest number of operations for which a branch is faster than computing both sides."""

_INT = np.dtype(np.int32)
_Operand = TypeVar("_Operand")
CALLS = frozenset(
    {
        *("checkpoint", "closed_call", "custom_jvp_call", "custom_linear_solve"),
        *("custom_vjp_call", "eval_jaxpr", "jit", "pjit", "remat2"),
    }
)
"""Names of the primitives that call a function once."""


class _TooLargeError(UnsupportedError):
    """Raised when arrays take too much memory."""


def check_bytes(count: int) -> None:
    """Raise an `UnsupportedError` if the arrays of an instance take too much memory."""
    if count > MAX_ARRAY_BYTES:
        raise _TooLargeError(
            f"arrays of {count:,} bytes for each instance, more than {MAX_ARRAY_BYTES:,}"
        )


def scan_ends(equation: JaxprEqn) -> tuple[int, int]:
    """Return where among the operands of a scan the constants end, and where the carry does."""
    # Versions of JAX say so in parameters of other names. Inside, sequences have one axis less.
    body = equation.params["jaxpr"].jaxpr
    scanned, stacked = (
        sum(len(shape_of(a)) != len(shape_of(b)) for a, b in zip(outer, inner, strict=True))
        for outer, inner in ((equation.invars, body.invars), (equation.outvars, body.outvars))
    )
    last = len(equation.invars) - scanned
    return last - (len(equation.outvars) - stacked), last


def call_of(
    equation: JaxprEqn, operands: Sequence[_Operand]
) -> tuple[ClosedJaxpr, Sequence[_Operand]] | None:
    """Return the function that an operation calls once, and its arguments; None if it calls none.

    `jax.checkpoint` computes values again in the backward pass instead of storing them. Here all
    values are registers, and equal operations are recorded once.

    Args:
      equation: the operation.
      operands: its operands.
    """
    params = equation.params
    if equation.primitive.name not in CALLS:
        return None
    if equation.primitive.name == "custom_linear_solve":
        # The operands are the constants of four functions (matvec, vecmat, solve, transpose_solve),
        # then the right-hand sides. Only `solve` runs here; the others serve checks and
        # derivatives.
        lengths = params["const_lengths"]
        first = lengths.matvec + lengths.vecmat
        right = operands[first + lengths.solve + lengths.transpose_solve :]
        return params["jaxprs"].solve, [*operands[first : first + lengths.solve], *right]
    inner = params["jaxpr"] if "jaxpr" in params else params["call_jaxpr"]
    return inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ()), operands


@dataclasses.dataclass(frozen=True)
class _Scan:
    """A `_Scan` holds a scan's body and what it is given."""

    body: ClosedJaxpr
    length: int
    reverse: bool
    constants: list[ScalarArray]
    carry: list[ScalarArray]
    """The carried values before the first iteration."""
    sequences: list[ScalarArray]
    """What an iteration is given one entry of, along the leading axis."""

    @classmethod
    def of(cls, equation: JaxprEqn, operands: Sequence[ScalarArray]) -> "_Scan":
        """Split the operands of a scan."""
        first, last = scan_ends(equation)
        return cls(
            equation.params["jaxpr"],
            equation.params["length"],
            equation.params["reverse"],
            list(operands[:first]),
            list(operands[first:last]),
            list(operands[last:]),
        )

    def row(self, i: int) -> list[ScalarArray]:
        """Return what an iteration is given of the sequences."""
        return [at(sequence, i) for sequence in self.sequences]


class ControlFlow:
    """A `ControlFlow` lowers the loops and branches of one program.

    Its rules are functions of the equation and its operands, as in `indexing`.
    """

    def __init__(
        self,
        graph: ExprGraph,
        lower: Callable[[ClosedJaxpr, Sequence[ScalarArray]], list[ScalarArray]],
    ) -> None:
        """Set the graph, and the function that lowers the jaxpr of a body or a branch."""
        self._graph, self._lower = graph, lower

    def scan(self, equation: JaxprEqn, *operands: ScalarArray) -> list[ScalarArray]:
        """Lower `jax.lax.scan`: as a loop, or unrolled if it is short or no loop can do it."""
        scan = _Scan.of(equation, operands)
        obstacle = None
        if not scan.sequences and len(scan.carry) == len(equation.outvars):
            rolled = self._counted_loop(scan)
            if rolled is not None:
                return rolled
        else:
            if scan.length <= MAX_UNROLLED_TRIPS:
                with contextlib.suppress(UnsupportedError):
                    return self._unrolled_scan(scan, MAX_UNROLLED_SCAN_OPERATIONS)
            try:
                return self._rolled_scan(scan)
            except _TooLargeError:
                # Written out, it would be too many operations.
                raise
            except UnsupportedError as error:
                # For example, what an index of the step chooses is to be written.
                obstacle = error
        try:
            return self._unrolled_scan(scan)
        except UnsupportedError as error:
            raise obstacle or error from None

    def _unrolled_scan(self, scan: "_Scan", limit: float = math.inf) -> list[ScalarArray]:
        """Lower the body of a scan once for each iteration, with its rows of the sequences.

        Raises:
          UnsupportedError: an operation cannot be lowered, or there are more than `limit`.
        """
        order, carry, count_before = range(scan.length), scan.carry, self._graph.count
        rows: dict[int, list[ScalarArray]] = {}
        for i in reversed(order) if scan.reverse else order:
            results = self._lower(scan.body, [*scan.constants, *carry, *scan.row(i)])
            carry, rows[i] = results[: len(carry)], results[len(carry) :]
            if self._graph.count - count_before > limit:
                raise UnsupportedError("a scan that is not short")
        stacked = scan.body.jaxpr.outvars[len(carry) :]
        return [*carry, *_columns([rows[i] for i in order], [shape_of(x) for x in stacked])]

    def _rolled_scan(self, scan: "_Scan") -> list[ScalarArray]:
        """Lower a scan to a counted loop, whose sequences are arrays in memory.

        Raises:
          UnsupportedError: an operation cannot be in a loop, or the arrays take too much memory.
        """
        graph, carry, length = self._graph, scan.carry, scan.length
        loop = graph.begin_loop(_flatten(carry), length, reverse=scan.reverse)
        counter = loop.counter
        assert counter is not None
        # Load this iteration's rows of the sequences. All of them have the same scalars, so one row
        # shows how theirs are arranged.
        flat = [_flatten(scan.row(i)) for i in range(length)]
        loaded = [read_at(graph, column, counter) for column in zip(*flat, strict=True)]
        slices = _unflatten(scan.row(0), loaded)
        # Record an iteration until all values that it carries are found. The rows that it returns
        # are those of the last attempt.
        rows: list[ScalarArray] = []

        def next_state(state: list[ScalarArray]) -> list[ScalarArray]:
            results = self._lower(scan.body, [*scan.constants, *state, *slices])
            rows[:] = results[len(carry) :]
            return results[: len(carry)]

        carried = self._record_iteration(loop, carry, next_state)
        # Store what differs between the iterations, and load it again behind the loop.
        returned = _flatten(rows)
        changing = [
            k for k, x in enumerate(returned) if not is_constant(x) and x.index > counter.index
        ]
        words = [returned[k] for k in changing]
        check_bytes(length * sum(bits_of(x.dtype) // 8 for x in words))
        loop.stacked = [graph.convert(x, _INT) if x.dtype == bool else x for x in words]
        end = self._end_loop(loop, carry, carried)
        stacks = dict(zip(changing, graph.stacks(loop), strict=True))

        def row(i: int) -> list[ScalarArray]:
            flat = [
                graph.convert(graph.load(stacks[k], np.int32(i)), x.dtype) if k in stacks else x
                for k, x in enumerate(returned)
            ]
            return _unflatten(rows, flat)

        return [*end, *_columns([row(i) for i in range(length)], [x.shape for x in rows])]

    def _counted_loop(self, scan: "_Scan") -> list[ScalarArray] | None:
        """Lower a scan without sequences; return None if it can only be unrolled."""

        def condition(state: list[ScalarArray]) -> Scalar:
            return self._graph.apply("lt", state[0].item(), np.int32(scan.length))

        def next_state(state: list[ScalarArray]) -> list[ScalarArray]:
            counter = elementwise(self._graph, "add", state[0], constant_array(np.int32(1)))
            return [counter, *self._lower(scan.body, [*scan.constants, *state[1:]])]

        # A scan counts its iterations itself; here the counter is the first carried value.
        state = [constant_array(np.int32(0)), *scan.carry]
        with contextlib.suppress(UnsupportedError):
            return self._unroll(state, condition, next_state, only_short=True)[1:]
        flags = self._end_flags(scan)

        def condition_with_flags(state: list[ScalarArray]) -> Scalar:
            goes_on = [state[1 + place].item() for place in flags]
            return fold(self._graph, "and", condition(state), goes_on)

        with contextlib.suppress(UnsupportedError):
            return self._record_loop(state, condition_with_flags, next_state)[1:]
        # For example, an index depends on the loop counter, which is constant once unrolled.
        return None

    def _end_flags(self, scan: "_Scan") -> list[int]:
        """Find carried truth values that end a scan: while one is False, nothing changes.

        Reverse-mode derivatives need scans, so what could be `jax.lax.while_loop` is often a scan
        whose body is `cond(goes_on, iterate, keep, ...)`. Such a scan may end early.

        Returns:
          Their places in the carry.
        """
        if not any(equation.primitive.name == "cond" for equation in scan.body.jaxpr.eqns):
            return []
        scalars = [(k, x.item()) for k, x in enumerate(scan.carry) if x.shape == ()]
        places = [k for k, x in scalars if words_of(x)[0].dtype == bool]
        found = []
        for place in places:
            # Run an iteration on values of which nothing is known but that this one is False.
            unknown = [self._graph.input(x.dtype) for x in _flatten(scan.carry)]
            state = _unflatten(scan.carry, unknown)
            state[place] = constant_array(np.bool_(False))
            with contextlib.suppress(UnsupportedError):
                updated = self._lower(scan.body, [*scan.constants, *state])
                pairs = zip(_flatten(state), _flatten(updated), strict=True)
                if all(is_same(*pair) for pair in pairs):
                    found.append(place)
        return found

    def while_loop(self, equation: JaxprEqn, *operands: ScalarArray) -> list[ScalarArray]:
        """Lower `jax.lax.while_loop`."""
        # The operands are the constants of the condition, those of the body, and the carried
        # values.
        first = equation.params["cond_nconsts"]
        second = first + equation.params["body_nconsts"]
        cond_consts, body_consts = operands[:first], operands[first:second]

        def row_conditions(state: list[ScalarArray]) -> ScalarArray:
            return self._lower(equation.params["cond_jaxpr"], [*cond_consts, *state])[0]

        def condition(state: list[ScalarArray]) -> Scalar:
            # A loop under `jax.vmap` has a condition for each row, and runs while any is true.
            return fold(self._graph, "or", np.bool_(False), row_conditions(state).ravel())

        def next_state(state: list[ScalarArray]) -> list[ScalarArray]:
            # Rows whose condition is false keep their values.
            rows = row_conditions(state)
            updated = self._lower(equation.params["body_jaxpr"], [*body_consts, *state])
            pairs = zip(state, updated, strict=True)
            return [where(self._graph, rows, *pair) for pair in pairs] if rows.ndim else updated

        state = list(operands[second:])
        try:
            return self._unroll_or_loop(state, condition, next_state)
        except UnsupportedError as error:
            # For example, an index depends on the loop counter, which is constant once unrolled.
            obstacle = error
        try:
            return self._unroll(state, condition, next_state)
        except UnsupportedError:
            raise obstacle from None

    def _unroll_or_loop(
        self,
        state: list[ScalarArray],
        condition: Callable[..., Scalar],
        next_state: Callable[..., list[ScalarArray]],
    ) -> list[ScalarArray]:
        """Unroll a loop if it is short and its length is known; otherwise record it as a loop."""
        with contextlib.suppress(UnsupportedError):
            return self._unroll(state, condition, next_state, only_short=True)
        return self._record_loop(state, condition, next_state)

    def _unroll(
        self,
        state: list[ScalarArray],
        condition: Callable[..., Scalar],
        next_state: Callable[..., list[ScalarArray]],
        only_short: bool = False,
    ) -> list[ScalarArray]:
        """Unroll a loop into all iterations that it can make.

        Args:
          state: the carried values before the first iteration.
          condition: a function of a state that returns whether there is another iteration.
          next_state: a function of a state that returns the next state.
          only_short: whether to reject a loop that has more than `MAX_UNROLLED_OPERATIONS` or whose
            number of iterations is not a constant.

        Returns:
          The state after the last iteration.

        Raises:
          UnsupportedError: the loop is rejected, or may make more than `MAX_UNROLLED_TRIPS`.
        """
        count_before = self._graph.count
        result = state
        # Whether the loop is still running, as a scalar of the program.
        active: Scalar = np.bool_(True)
        # `state` advances even after the loop may have ended, while `result` keeps the value at the
        # end. So a counter in `state` stays constant, and with it the number of iterations.
        for _ in range(MAX_UNROLLED_TRIPS + 1):
            active = self._graph.apply("and", active, condition(state))
            if is_constant(active) and not active:
                return result
            if only_short and (
                not is_constant(active)
                or self._graph.count - count_before > MAX_UNROLLED_OPERATIONS
            ):
                raise UnsupportedError("a loop that is not short")
            state = next_state(state)
            result = [where(self._graph, active, *pair) for pair in zip(result, state, strict=True)]
        raise UnsupportedError(f"a loop that may run more than {MAX_UNROLLED_TRIPS} times")

    def _record_loop(
        self,
        state: list[ScalarArray],
        condition: Callable[..., Scalar],
        next_state: Callable[..., list[ScalarArray]],
    ) -> list[ScalarArray]:
        """Record a loop that is not unrolled.

        Args:
          state: the carried values before the first iteration.
          condition: a function of a state that returns whether there is another iteration.
          next_state: a function of a state that returns the next state.

        Returns:
          The state after the last iteration.
        """
        loop = self._graph.begin_loop(_flatten(state))
        carried = self._record_iteration(loop, state, next_state)
        loop.condition = condition(_unflatten(state, loop.results))
        return self._end_loop(loop, state, carried)

    def _record_iteration(
        self,
        loop: Loop,
        state: list[ScalarArray],
        next_state: Callable[..., list[ScalarArray]],
    ) -> set[int]:
        """Record an iteration of a loop, and find the values that it carries.

        Args:
          loop: the loop, which is given its `updated` values and its `results`.
          state: the carried values before the first iteration.
          next_state: a function of a state that returns the next state.

        Returns:
          The places of the values that change between iterations.
        """
        # Every scalar of the state is a candidate for a carried value, with a placeholder
        # (`carries`) for its value at the start of an iteration.
        initial = loop.initial
        carried: set[int] = set()
        # Find the values that change between iterations, until a round finds no more of them.
        while True:
            start = [loop.carries[k] if k in carried else x for k, x in enumerate(initial)]
            loop.updated = _flatten(next_state(_unflatten(state, start)))
            changed = [
                k
                for k, x in enumerate(initial)
                if k not in carried and not is_same(x, loop.updated[k])
            ]
            if not changed:
                break
            carried.update(changed)
        # Compute derived values from the other carried values at the start of an iteration.
        derived = find_derived(self._graph, loop, carried)
        if derived:
            start = [derived.get(k, x) for k, x in enumerate(start)]
            loop.updated = _flatten(next_state(_unflatten(state, start)))
        # Values that the loop does not carry keep their initial value.
        loop.results = start
        return carried

    def _end_loop(
        self, loop: Loop, state: list[ScalarArray], carried: set[int]
    ) -> list[ScalarArray]:
        """Finish a loop, and return the state after the last iteration."""
        results = self._graph.end_loop(loop)
        end = [results[k] if k in carried else x for k, x in enumerate(loop.initial)]
        return _unflatten(state, end)

    def cond(
        self, equation: JaxprEqn, index: ScalarArray, *operands: ScalarArray
    ) -> list[ScalarArray]:
        """Lower `jax.lax.cond` and `jax.lax.switch`."""
        branches, selected = equation.params["branches"], index.item()
        if is_constant(selected):
            return self._lower(branches[min(max(int(selected), 0), len(branches) - 1)], operands)
        count_before = self._graph.count
        sides = [self._lower(branch, operands) for branch in branches]
        # All sides are recorded by now, so their size is known. Nest the choices, from the last
        # side to the first: side i if the index is not above i, else what the later sides choose.
        is_branch = self._graph.count - count_before >= MIN_BRANCH_OPERATIONS
        result = sides[-1]
        for i in reversed(range(len(sides) - 1)):
            later = self._graph.apply("gt", selected, selected.dtype.type(i))
            # `schedule` moves operations that only one side needs into the branch, which skips
            # them. Short sides are both computed, and a selection takes one result.
            if is_branch:
                flat = self._graph.branch(later, _flatten(sides[i]), _flatten(result))
                result = _unflatten(result, flat)
            else:
                pairs = zip(sides[i], result, strict=True)
                result = [where(self._graph, later, *pair) for pair in pairs]
        return result


def _columns(
    rows: Sequence[Sequence[ScalarArray]], shapes: Sequence[tuple[int, ...]]
) -> list[ScalarArray]:
    """Stack the rows that the iterations of a scan return.

    Args:
      rows: one array for each result, of each iteration.
      shapes: the shapes of these arrays.
    """
    return [
        scalar_array((x for row in rows for x in row[k].ravel()), (len(rows), *shape))
        for k, shape in enumerate(shapes)
    ]


def _flatten(arrays: Sequence[ScalarArray]) -> list[Scalar]:
    """Return all scalars of some arrays; a random key has two."""
    scalars = [word for array in arrays for x in array.ravel() for word in words_of(x)]
    check_scalars(scalars)
    return scalars


def _unflatten(arrays: Sequence[ScalarArray], flat: Sequence[Scalar]) -> list[ScalarArray]:
    """Split scalars into arrays like the given ones, the inverse of `_flatten`."""
    scalars = iter(flat)
    return [
        scalar_array((like(x, scalars) for x in array.ravel()), array.shape) for array in arrays
    ]
