"""Lower a JAX function of one instance to a program of operations on scalars.

Motivation: XLA compiles an instance's step to hundreds of kernels, and every array between two
kernels goes through memory. An instance's arrays are small and mostly constant, so the same step
can be one straight program on scalars that runs for thousands of instances in parallel, one per
thread of a GPU or per lane of a CPU, with all intermediate values in registers.

Protocol, in the order in which a function passes through the package:

1. `jax.make_jaxpr` traces the function to a jaxpr, a list of equations on arrays.
2. `_JaxprLowering` splits every array into its scalars and records each equation's arithmetic in an
   `ExprGraph` (`scalar_ir`). Slices, gathers and transposes only rearrange scalars and record
   nothing (`indexing`). Everything that depends on constants alone is evaluated.
3. Short loops of known length are unrolled, and short branches become selections. All others stay
   loops and branches:

   - A value that a loop carries is first assumed to be constant. Values that prove to change are
     carried in the next round, until a round finds no more of them.
   - A carried value that is the same function of other carried values before the loop and after
     each iteration is not carried, but computed at the start of the iteration (`_find_derived`). In
     a solver that prepares the next iteration at the end of each one, this saves the last one.
   - What a scan reads and returns step by step is in arrays in memory: an iteration loads the
     scalars of its step, and stores those that it returns (`_rolled_scan`).

4. `schedule` places the operations in blocks, and `onekernel.codegen` writes the blocks as LLVM IR.

Arguments for this protocol: the operations and their order are those of the function, so results
differ from JAX's by round-off only, as long as all numbers are finite. (With `finite=False`
functions are lowered whose numbers may not be.) The lowering knows nothing of instances.
"""

import contextlib
import dataclasses
import functools
import inspect
from collections.abc import Callable, Hashable, Iterable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.extend import source_info_util
from jax.extend.core import ClosedJaxpr, JaxprEqn, Literal, Var
from jaxtyping import Array, PyTree
from numpy.typing import ArrayLike

from onekernel.errors import UnsupportedError
from onekernel.lower.dynamic_indexing import DYNAMIC_RULES, read_at
from onekernel.lower.expansions import EXPANSIONS, power, round_away_from_zero
from onekernel.lower.indexing import (
    RULES,
    Rule,
    ScalarArray,
    constant_array,
    dtype_of,
    full_array,
    scalar_array,
    shape_of,
)
from onekernel.lower.linear_algebra import MAX_ROWS, expansion
from onekernel.lower.random_rules import RANDOM_RULES, Key, like, words_of
from onekernel.lower.scalar_ir import (
    EVALUATE,
    SIMPLE_POWERS,
    ExprGraph,
    Loop,
    Scalar,
    check_scalars,
    identity,
    is_constant,
    is_same,
    length_of,
)
from onekernel.lower.schedule import Block, schedule

MAX_UNROLLED_TRIPS = 64
"""Largest number of iterations of a loop that is unrolled."""

MAX_UNROLLED_OPERATIONS = 512
"""Largest number of operations of a loop that is unrolled although it could stay a loop."""

MAX_PROGRAM_OPERATIONS = 100_000
"""Largest number of operations of a program; LLVM takes 15 s to compile that many for a CPU."""

MAX_ARRAY_BYTES = 64 * 1024
"""Most memory for the arrays of one instance: the lanes of a CPU have up to 1 MiB together on the
stack of a thread, and a GPU reserves it for every thread that it can hold."""

MIN_BRANCH_OPERATIONS = 24
"""Smallest number of operations for which a branch is faster than computing both sides."""


_GRAPH_RULES = {**RANDOM_RULES, **DYNAMIC_RULES}
"""Lowering rules that take the graph before the equation and its operands."""

_FLOAT, _INT = np.dtype(np.float32), np.dtype(np.int32)
_PairKey = tuple[Hashable, ...]
_WORDS = {_FLOAT, _INT, np.dtype(np.uint32), np.dtype(bool)}


@dataclasses.dataclass(frozen=True, repr=False)
class ScalarProgram:
    """A `ScalarProgram` holds a function's operations on scalars."""

    inputs: list[ScalarArray]
    """The scalars of each leaf of the arguments, in the leaf's shape."""
    outputs: list[ScalarArray]
    """The scalars of each leaf of the result, in the leaf's shape."""
    block: Block
    """All operations, in an order in which they can be executed."""

    @property
    def size(self) -> int:
        """Return the number of operations; each scalar that is stored in an array is one, too."""
        stores = sum(len(array.operands) for array in self.block.arrays())
        return stores + sum(1 for _ in self.block.values())

    @property
    def array_bytes(self) -> int:
        """Return the bytes of memory that the arrays of one instance take."""
        return sum(4 * length_of(array) for array in self.block.arrays())


def scalarize(
    function: Callable[..., PyTree],
    *arguments: PyTree,
    finite: bool = True,
    approximate: bool = False,
) -> ScalarProgram:
    """Lower a function to a program on scalars; the module states the protocol.

    Args:
      function: a jittable function of one instance.
      *arguments: pytrees of arrays, or of objects with a shape and a dtype.
      finite: whether all numbers are finite, as for `ExprGraph`.
      approximate: whether the program is for GPUs, and may have their approximate instructions.

    Returns:
      The program.

    Raises:
      UnsupportedError: the function has an operation that cannot be lowered, or too many of them.
    """
    closed = jax.make_jaxpr(function)(*arguments)
    variables = closed.jaxpr.invars, closed.jaxpr.outvars
    return scalarize_part(closed, *variables, finite=finite, approximate=approximate)


def scalarize_part(
    closed: ClosedJaxpr,
    arguments: Sequence[Var],
    results: Sequence[Var | Literal],
    *,
    words: bool = False,
    finite: bool = True,
    approximate: bool = False,
) -> ScalarProgram:
    """Lower the part of a traced function between some of its variables, as `scalarize` does.

    Args:
      closed: the function.
      arguments: the variables whose values the program is given. They need not be the function's
        own arguments: what is computed before them is left out.
      results: the variables or literals that the program returns.
      words: whether the program takes and returns float32 only. A number of another dtype of 32
        bits is then passed as a float32 with the same bits, and a bool as 0 or 1.
      finite: whether all numbers are finite, as for `ExprGraph`.
      approximate: whether to use approximate instructions of GPUs, as for `ExprGraph`.

    Returns:
      The program.

    Raises:
      UnsupportedError: as `scalarize`, or the function does more than return results.
    """
    # Reject what cannot be lowered at all.
    if closed.effects:
        # For example `jax.debug.print`, on which no result depends.
        raise UnsupportedError(f"an effect: {', '.join(map(str, closed.effects))}")
    # Start with the program's arguments, each split into scalars of the graph.
    graph = ExprGraph(finite=finite, approximate=approximate)
    lowering = _JaxprLowering(graph)
    env: dict[Var, ScalarArray] = {}
    inputs = []
    for variable in [*arguments, *results]:
        if jnp.issubdtype(dtype_of(variable), jax.dtypes.extended):
            raise UnsupportedError(f"an argument or result of {dtype_of(variable)}")
    for variable in arguments:
        dtype = np.dtype(dtype_of(variable))
        given = _FLOAT if words else dtype
        inputs.append(full_array(shape_of(variable), lambda dtype=given: graph.input(dtype)))
        env[variable] = lowering.bitcast(inputs[-1], given, dtype)
    # Record the operations of all equations that the results need.
    outputs = lowering.lower_part(closed, env, results)
    if words:
        outputs = [
            lowering.bitcast(x, np.dtype(dtype_of(atom)), _FLOAT)
            for x, atom in zip(outputs, results, strict=True)
        ]
    # Arrange the recorded operations, without those on which no result depends.
    block = schedule(x for array in outputs for x in array.ravel())
    program = ScalarProgram(inputs, outputs, block)
    if program.size > MAX_PROGRAM_OPERATIONS:
        raise UnsupportedError(f"{program.size:,} operations, more than {MAX_PROGRAM_OPERATIONS:,}")
    _check_bytes(program.array_bytes)
    return program


def _check_bytes(count: int) -> None:
    """Raise an `UnsupportedError` if the arrays of an instance take too much memory."""
    if count > MAX_ARRAY_BYTES:
        raise UnsupportedError(
            f"arrays of {count:,} bytes for each instance, more than {MAX_ARRAY_BYTES:,}"
        )


class _JaxprLowering:
    """A `_JaxprLowering` records the operations of a jaxpr on scalars.

    The lowering rule of the JAX primitive `name` is `RULES[name]` or the method `_name`: a function
    of the equation and its operands that returns the results. The rules of random numbers and of
    indices that are not constant are in `_GRAPH_RULES`. An operation in `EXPANSIONS` is replaced by
    a formula of other JAX operations, which is traced and lowered in its place.
    """

    def __init__(self, graph: ExprGraph) -> None:
        self._graph = graph

    def lower(self, closed: ClosedJaxpr, arguments: Sequence[ScalarArray]) -> list[ScalarArray]:
        env = dict(zip(closed.jaxpr.invars, arguments, strict=True))
        return self.lower_part(closed, env, closed.jaxpr.outvars)

    def lower_part(
        self, closed: ClosedJaxpr, env: dict[Var, ScalarArray], results: Sequence[Var | Literal]
    ) -> list[ScalarArray]:
        """Lower the equations that some results need.

        Args:
          closed: the jaxpr.
          env: the scalars of the variables that are known, to which others are added.
          results: variables or literals of the jaxpr.
        """

        def read(atom: Var | Literal) -> ScalarArray:
            if isinstance(atom, Literal):
                return constant_array(np.asarray(atom.val, dtype_of(atom)))
            return env[atom]

        # Walk backwards from the results to find the equations that they need. A variable of `env`
        # is known already, so the walk does not go beyond it: this cuts a part out of a function.
        needed = {atom for atom in results if not isinstance(atom, Literal)} - env.keys()
        equations = []
        for equation in reversed(closed.jaxpr.eqns):
            if any(variable in needed for variable in equation.outvars):
                equations.append(equation)
                atoms = (atom for atom in equation.invars if not isinstance(atom, Literal))
                needed |= {atom for atom in atoms if atom not in env}
        # Split the constants into scalars, but only the needed ones: others may be what cannot be
        # lowered.
        for variable, constant in zip(closed.jaxpr.constvars, closed.consts, strict=True):
            if variable in needed:
                env[variable] = _constants(constant)
        # Lower these equations in the order of the function.
        for equation in reversed(equations):
            values = self._lower_eqn(equation, [read(atom) for atom in equation.invars])
            env |= dict(zip(equation.outvars, values, strict=True))
        return [read(atom) for atom in results]

    def _lower_eqn(self, equation: JaxprEqn, operands: list[ScalarArray]) -> list[ScalarArray]:
        try:
            return self._apply_rule(equation, operands)
        except UnsupportedError as error:
            # The innermost equation is the one that the user wrote.
            error.place = error.place or source_info_util.summarize(equation.source_info)
            raise

    def _apply_rule(self, equation: JaxprEqn, operands: list[ScalarArray]) -> list[ScalarArray]:
        name = equation.primitive.name
        # Most operations on single elements have the same name in JAX and in the graph, and need
        # no rule of their own.
        if name in EVALUATE and not hasattr(self, f"_{name}"):
            return [self._elementwise(name, *operands)]
        # Otherwise look for a rule, in this order: a rearrangement, a method of this class, a rule
        # that takes the graph, a formula in JAX, JAX's own expansion. Names such as `scatter-add`
        # have a hyphen, which a method's name cannot.
        rule = RULES.get(name) or getattr(self, f"_{name.replace('-', '_')}", None)
        if rule is None and name in _GRAPH_RULES:
            rule = functools.partial(_GRAPH_RULES[name], self._graph)
        if rule is None and name in EXPANSIONS:
            rule = self._expand_by(EXPANSIONS[name], equation)
        if rule is None and _is_expandable(equation):
            rule = self._expand
        if rule is None:
            raise UnsupportedError(f"the operation {name}")
        result = rule(equation, *operands)
        return result if isinstance(result, list) else [result]

    def _expand_by(self, function: Callable[..., Array], equation: JaxprEqn) -> Rule:
        """Return the rule that lowers an operation as a function of its operands.

        Args:
          function: the function; its keyword arguments are parameters of the operation.
          equation: the equation.
        """
        # The formula's keyword arguments name the parameters of the equation that it needs. With
        # them given, it is traced like any function of arrays.
        names = inspect.getfullargspec(function).kwonlyargs
        called = functools.partial(function, **{name: equation.params[name] for name in names})
        closed = jax.make_jaxpr(called)(*(x.aval for x in equation.invars))
        return lambda _, *operands: self.lower(closed, operands)

    def _expand(self, equation: JaxprEqn, *operands: ScalarArray) -> list[ScalarArray]:
        """Lower an operation that JAX itself expands into others (see `_is_expandable`)."""

        def expanded(*arrays: Array) -> PyTree:
            with equation.ctx.manager:
                return equation.primitive.to_lojax(*arrays, **equation.params)

        return self.lower(jax.make_jaxpr(expanded)(*(x.aval for x in equation.invars)), operands)

    def _elementwise(self, op: str, *operands: ScalarArray) -> ScalarArray:
        arrays = np.broadcast_arrays(*operands)
        rows = zip(*(array.ravel() for array in arrays), strict=True)
        return scalar_array((self._graph.apply(op, *row) for row in rows), arrays[0].shape)

    def _where(
        self, condition: Scalar | ScalarArray, if_false: ScalarArray, if_true: ScalarArray
    ) -> ScalarArray:
        """Select between two arrays by one condition, or one for each index of leading axes."""
        if not isinstance(condition, np.ndarray):
            condition = scalar_array([condition], ())
        # Give the condition axes of length 1 behind its own, so that it broadcasts along the
        # others.
        trailing = [1] * (if_false.ndim - condition.ndim)
        arrays = np.broadcast_arrays(
            condition.reshape((*condition.shape, *trailing)), if_false, if_true
        )
        rows = zip(*(array.ravel() for array in arrays), strict=True)
        return scalar_array((self._select(*row) for row in rows), if_false.shape)

    def _select(
        self, condition: Scalar, if_false: Scalar | Key, if_true: Scalar | Key
    ) -> Scalar | Key:
        """Select between two scalars, or the words of two random keys."""
        pairs = zip(words_of(if_false), words_of(if_true), strict=True)
        return like(if_true, (self._graph.select(condition, *pair) for pair in pairs))

    # Rules of primitives that call functions: jit, scan, while, cond.

    def _jit(self, equation: JaxprEqn, *operands: ScalarArray) -> list[ScalarArray]:
        return self.lower(equation.params["jaxpr"], operands)

    _pjit = _jit

    def _custom_jvp_call(self, equation: JaxprEqn, *operands: ScalarArray) -> list[ScalarArray]:
        return self.lower(equation.params["call_jaxpr"], operands)

    _custom_vjp_call = _custom_jvp_call

    def _platform_index(self, equation: JaxprEqn) -> ScalarArray:
        # `jax.lax.platform_dependent`: choose the case that is written for all platforms, whose
        # names are None. A scalar program does not know which platform it is for.
        platforms = equation.params["platforms"]
        index = next((i for i, names in enumerate(platforms) if names is None), len(platforms) - 1)
        return constant_array(np.int32(index))

    def _remat2(self, equation: JaxprEqn, *operands: ScalarArray) -> list[ScalarArray]:
        # `jax.checkpoint` computes values again in the backward pass instead of storing them. Here
        # all values are registers, and equal operations are recorded once.
        return self.lower(ClosedJaxpr(equation.params["jaxpr"], ()), operands)

    _checkpoint = _remat2

    def _custom_linear_solve(self, equation: JaxprEqn, *operands: ScalarArray) -> list[ScalarArray]:
        # The operands are the constants of four functions (matvec, vecmat, solve, transpose_solve),
        # then the right-hand sides. Only `solve` runs here; the others serve checks and
        # derivatives.
        lengths, solve = equation.params["const_lengths"], equation.params["jaxprs"].solve
        first = lengths.matvec + lengths.vecmat
        right = operands[first + lengths.solve + lengths.transpose_solve :]
        return self.lower(solve, [*operands[first : first + lengths.solve], *right])

    def _scan(self, equation: JaxprEqn, *operands: ScalarArray) -> list[ScalarArray]:
        body, length = equation.params["jaxpr"], equation.params["length"]
        # Split the operands into constants, carry and sequences, which have one axis less inside.
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
        # Record the scan as a loop, and unroll it if it is short or no loop can do it.
        reverse = equation.params["reverse"]
        obstacle = None
        if not scanned and not stacked:
            rolled = self._counted_loop(body, length, constants, carry)
            if rolled is not None:
                return rolled
        elif length > MAX_UNROLLED_TRIPS:
            try:
                return self._rolled_scan(body, length, reverse, constants, carry, sequences)
            except UnsupportedError as error:
                # For example, what an index of the step chooses is to be written.
                obstacle = error
        try:
            return self._unrolled_scan(body, length, reverse, constants, carry, sequences)
        except UnsupportedError as error:
            raise obstacle or error from None

    def _unrolled_scan(
        self,
        body: ClosedJaxpr,
        length: int,
        reverse: bool,
        constants: Sequence[ScalarArray],
        carry: list[ScalarArray],
        sequences: Sequence[ScalarArray],
    ) -> list[ScalarArray]:
        """Lower the body of a scan once for each iteration, with its rows of the sequences."""
        order = range(length)
        rows: dict[int, list[ScalarArray]] = {}
        carried = len(carry)
        for i in reversed(order) if reverse else order:
            slices = [_at(sequence, i) for sequence in sequences]
            results = self.lower(body, [*constants, *carry, *slices])
            carry, rows[i] = results[:carried], results[carried:]
        stacked = body.jaxpr.outvars[carried:]
        return [*carry, *_columns([rows[i] for i in order], [shape_of(x) for x in stacked])]

    def _rolled_scan(
        self,
        body: ClosedJaxpr,
        length: int,
        reverse: bool,
        constants: Sequence[ScalarArray],
        carry: list[ScalarArray],
        sequences: Sequence[ScalarArray],
    ) -> list[ScalarArray]:
        """Lower a scan to a counted loop, whose sequences are arrays in memory.

        Raises:
          UnsupportedError: an operation cannot be in a loop, or the arrays take too much memory.
        """
        graph = self._graph
        loop = graph.begin_loop(_flatten(carry), length, reverse=reverse)
        counter = loop.counter
        assert counter is not None
        # Load this iteration's rows of the sequences. All of them have the same scalars, so one row
        # shows how theirs are arranged.
        slices = []
        for sequence in sequences:
            flat = [_flatten([_at(sequence, i)]) for i in range(length)]
            loaded = [read_at(graph, column, counter) for column in zip(*flat, strict=True)]
            slices += _unflatten([_at(sequence, 0)], loaded)
        # Record an iteration until all values that it carries are found. The rows that it returns
        # are those of the last attempt.
        rows: list[ScalarArray] = []

        def next_state(state: list[ScalarArray]) -> list[ScalarArray]:
            results = self.lower(body, [*constants, *state, *slices])
            rows[:] = results[len(carry) :]
            return results[: len(carry)]

        carried = self._record_iteration(loop, carry, next_state)
        # Store what differs between the iterations, and load it again behind the loop.
        returned = _flatten(rows)
        changing = [k for k, x in enumerate(returned) if _index(x) > counter.index]
        _check_bytes(4 * length * len(changing))
        words = (returned[k] for k in changing)
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

    def _counted_loop(
        self,
        body: ClosedJaxpr,
        length: int,
        constants: Sequence[ScalarArray],
        carry: list[ScalarArray],
    ) -> list[ScalarArray] | None:
        """Lower a scan without sequences; return None if it can only be unrolled."""

        def condition(state: list[ScalarArray]) -> Scalar:
            return self._graph.apply("lt", state[0].item(), np.int32(length))

        def next_state(state: list[ScalarArray]) -> list[ScalarArray]:
            counter = self._elementwise("add", state[0], constant_array(np.int32(1)))
            return [counter, *self.lower(body, [*constants, *state[1:]])]

        # A scan counts its iterations itself; here the counter is the first carried value.
        state = [constant_array(np.int32(0)), *carry]
        with contextlib.suppress(UnsupportedError):
            return self._unroll(state, condition, next_state, only_short=True)[1:]
        flags = self._end_flags(body, constants, carry)

        def condition_with_flags(state: list[ScalarArray]) -> Scalar:
            goes_on = [state[1 + place].item() for place in flags]
            return self._fold("and", condition(state), goes_on)

        with contextlib.suppress(UnsupportedError):
            return self._record_loop(state, condition_with_flags, next_state)[1:]
        # For example, an index depends on the loop counter, which is constant once unrolled.
        return None

    def _end_flags(
        self, body: ClosedJaxpr, constants: Sequence[ScalarArray], carry: Sequence[ScalarArray]
    ) -> list[int]:
        """Find carried truth values that end a scan: while one is False, nothing changes.

        Reverse-mode derivatives need scans, so what could be `jax.lax.while_loop` is often a scan
        whose body is `cond(goes_on, iterate, keep, ...)`. Such a scan may end early.

        Args:
          body: the body of the scan.
          constants: its constants.
          carry: the carried values before the first iteration.

        Returns:
          Their places in the carry.
        """
        if not any(equation.primitive.name == "cond" for equation in body.jaxpr.eqns):
            return []
        places = [k for k, x in enumerate(carry) if x.shape == () and x.item().dtype == bool]
        found = []
        for place in places:
            # Run an iteration on values of which nothing is known but that this one is False.
            unknown = [self._graph.input(x.dtype) for x in _flatten(carry)]
            state = _unflatten(carry, unknown)
            state[place] = constant_array(np.bool_(False))
            with contextlib.suppress(UnsupportedError):
                updated = self.lower(body, [*constants, *state])
                pairs = zip(_flatten(state), _flatten(updated), strict=True)
                if all(is_same(*pair) for pair in pairs):
                    found.append(place)
        return found

    def _while(self, equation: JaxprEqn, *operands: ScalarArray) -> list[ScalarArray]:
        # The operands are the constants of the condition, those of the body, and the carried
        # values.
        first = equation.params["cond_nconsts"]
        second = first + equation.params["body_nconsts"]
        cond_consts, body_consts = operands[:first], operands[first:second]

        def row_conditions(state: list[ScalarArray]) -> ScalarArray:
            return self.lower(equation.params["cond_jaxpr"], [*cond_consts, *state])[0]

        def condition(state: list[ScalarArray]) -> Scalar:
            # A loop under `jax.vmap` has a condition for each row, and runs while any is true.
            return self._fold("or", np.bool_(False), row_conditions(state).ravel())

        def next_state(state: list[ScalarArray]) -> list[ScalarArray]:
            # Rows whose condition is false keep their values.
            rows = row_conditions(state)
            updated = self.lower(equation.params["body_jaxpr"], [*body_consts, *state])
            pairs = zip(state, updated, strict=True)
            return [self._where(rows, *pair) for pair in pairs] if rows.ndim else updated

        state = list(operands[second:])
        with contextlib.suppress(UnsupportedError):
            return self._unroll_or_loop(state, condition, next_state)
        # For example, an index depends on the loop counter, which is constant once unrolled.
        return self._unroll(state, condition, next_state)

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
            result = [self._where(active, *pair) for pair in zip(result, state, strict=True)]
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
        derived = _find_derived(self._graph, loop, carried)
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

    def _cond(
        self, equation: JaxprEqn, index: ScalarArray, *operands: ScalarArray
    ) -> list[ScalarArray]:
        branches, selected = equation.params["branches"], index.item()
        if is_constant(selected):
            return self.lower(branches[min(max(int(selected), 0), len(branches) - 1)], operands)
        count_before = self._graph.count
        sides = [self.lower(branch, operands) for branch in branches]
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
                result = [self._where(later, *pair) for pair in pairs]
        return result

    # Rules of primitives with arithmetic on more than single elements.

    def _convert_element_type(self, equation: JaxprEqn, x: ScalarArray) -> ScalarArray:
        dtype = np.dtype(equation.params["new_dtype"])
        return scalar_array((self._graph.convert(one, dtype) for one in x.ravel()), x.shape)

    def _bitcast_convert_type(self, equation: JaxprEqn, x: ScalarArray) -> ScalarArray:
        source, to = dtype_of(equation.invars[0]), equation.params["new_dtype"]
        if bool in (source, to):
            raise UnsupportedError("a bitcast of truth values")
        return self.bitcast(x, np.dtype(source), np.dtype(to))

    def bitcast(self, x: ScalarArray, source: np.dtype, to: np.dtype) -> ScalarArray:
        """Return the same bits as another dtype; a bool is 0 or 1.

        Args:
          x: the scalars.
          source: their dtype.
          to: the dtype of the result.
        """
        if source == to:
            return x
        if not {source, to} <= _WORDS:
            raise UnsupportedError(f"the bits of {source} as {to}")

        def cast(one: Scalar) -> Scalar:
            # Between a float32 and an integer, take the bits as they are. Between integers of 32
            # bits, a conversion keeps them.
            if {source.kind, to.kind} in ({"f", "i"}, {"f", "u"}):
                # The graph's `bitcast` is between float32 and int32 only.
                whole = one if source.kind == "f" else self._graph.convert(one, np.dtype(np.int32))
                one = self._graph.apply("bitcast", whole)
            return self._graph.convert(one, to)

        return scalar_array(map(cast, x.ravel()), x.shape)

    def _select_n(self, equation: JaxprEqn, which: ScalarArray, *cases: ScalarArray) -> ScalarArray:
        result = cases[-1]
        for i in reversed(range(len(cases) - 1)):
            # The index of a case is a bool or an integer.
            later = [
                x if x.dtype == bool else self._graph.apply("gt", x, x.dtype.type(i))
                for x in which.ravel()
            ]
            result = self._where(scalar_array(later, which.shape), cases[i], result)
        return result

    def _clamp(
        self, equation: JaxprEqn, low: ScalarArray, x: ScalarArray, high: ScalarArray
    ) -> ScalarArray:
        return self._elementwise("min", self._elementwise("max", x, low), high)

    def _round(self, equation: JaxprEqn, x: ScalarArray) -> ScalarArray:
        if equation.params["rounding_method"] == jax.lax.RoundingMethod.TO_NEAREST_EVEN:
            return self._elementwise("round", x)
        return self._expand_by(round_away_from_zero, equation)(equation, x)[0]

    def _square(self, equation: JaxprEqn, x: ScalarArray) -> ScalarArray:
        return self._elementwise("mul", x, x)

    def _integer_pow(self, equation: JaxprEqn, x: ScalarArray) -> ScalarArray:
        one = constant_array(np.ones(x.shape, dtype_of(equation.outvars[0])))
        # x⁻ⁿ is (1/x)ⁿ. Where a derivative needs it, the function mostly has 1/x already.
        base = x if equation.params["y"] >= 0 else self._elementwise("div", one, x)
        result = one
        for _ in range(abs(equation.params["y"])):
            result = self._elementwise("mul", result, base)
        return result

    def _pow(self, equation: JaxprEqn, x: ScalarArray, y: ScalarArray) -> ScalarArray:
        exponents = {float(one) if is_constant(one) else None for one in y.ravel()}
        if exponents <= SIMPLE_POWERS:
            return self._elementwise("pow", x, y)
        return self._expand_by(power, equation)(equation, x, y)[0]

    def _logistic(self, equation: JaxprEqn, x: ScalarArray) -> ScalarArray:
        one = constant_array(np.float32(1))
        exp = self._elementwise("exp", self._elementwise("neg", x))
        return self._elementwise("div", one, self._elementwise("add", one, exp))

    def _rsqrt(self, equation: JaxprEqn, x: ScalarArray) -> ScalarArray:
        return self._elementwise("div", constant_array(np.float32(1)), self._elementwise("sqrt", x))

    def _reduce(self, op: str, initial: Scalar, equation: JaxprEqn, x: ScalarArray) -> ScalarArray:
        # Each group holds the scalars of one result, which are combined in their order.
        (groups,) = _group_axes(x, (), equation.params["axes"])
        scalars = (self._fold(op, initial, group) for group in groups)
        return scalar_array(scalars, shape_of(equation.outvars[0]))

    def _fold(self, op: str, initial: Scalar, scalars: Iterable[Scalar]) -> Scalar:
        """Combine scalars by an operation, one after the other."""
        return functools.reduce(functools.partial(self._graph.apply, op), scalars, initial)

    def _reduce_sum(self, equation: JaxprEqn, x: ScalarArray) -> ScalarArray:
        return self._reduce("add", dtype_of(equation.outvars[0]).type(0), equation, x)

    def _reduce_prod(self, equation: JaxprEqn, x: ScalarArray) -> ScalarArray:
        return self._reduce("mul", dtype_of(equation.outvars[0]).type(1), equation, x)

    def _reduce_and(self, equation: JaxprEqn, x: ScalarArray) -> ScalarArray:
        zero = dtype_of(equation.outvars[0]).type(0)
        return self._reduce("and", np.bitwise_not(zero), equation, x)

    def _reduce_or(self, equation: JaxprEqn, x: ScalarArray) -> ScalarArray:
        return self._reduce("or", dtype_of(equation.outvars[0]).type(0), equation, x)

    def _reduce_max(self, equation: JaxprEqn, x: ScalarArray) -> ScalarArray:
        # Start with the number that changes nothing: max(-inf, x) is x.
        return self._reduce("max", _lowest(equation), equation, x)

    def _reduce_min(self, equation: JaxprEqn, x: ScalarArray) -> ScalarArray:
        return self._reduce("min", -_lowest(equation), equation, x)

    def _cumulate(self, op: str, equation: JaxprEqn, x: ScalarArray) -> ScalarArray:
        # Go along the axis, and combine each entry with the one before it (behind it, if reversed).
        result = np.moveaxis(x.copy(), equation.params["axis"], 0)
        order = range(1, len(result))
        for i in [len(result) - 1 - i for i in order] if equation.params["reverse"] else order:
            previous = _at(result, i + 1 if equation.params["reverse"] else i - 1)
            # Assign to a slice: assigned to an element, the array would become a nested object.
            result[i : i + 1] = self._elementwise(op, previous, _at(result, i))[None]
        return np.moveaxis(result, 0, equation.params["axis"])

    _cummax = functools.partialmethod(_cumulate, "max")
    _cummin = functools.partialmethod(_cumulate, "min")
    _cumprod = functools.partialmethod(_cumulate, "mul")
    _cumsum = functools.partialmethod(_cumulate, "add")

    def _arg_extreme(self, better: str, equation: JaxprEqn, x: ScalarArray) -> ScalarArray:
        (axis,) = equation.params["axes"]
        kind = dtype_of(equation.outvars[0]).type
        # The graph cannot compare truth values.
        if dtype_of(equation.invars[0]) == np.dtype(bool):
            x = scalar_array(
                (self._graph.convert(one, np.dtype(np.int32)) for one in x.ravel()), x.shape
            )
        x = np.moveaxis(x, axis, -1)
        places = full_array(x.shape[:-1], lambda: kind(0))
        # Keep the best scalar so far and its place; a later one must be better, so the first of
        # equals wins.
        for row in np.ndindex(*x.shape[:-1]):
            best = x[row][0]
            for i, scalar in enumerate(x[row][1:], start=1):
                wins = self._graph.apply(better, scalar, best)
                if not self._graph.finite and scalar.dtype.kind == "f":
                    # The first NaN wins.
                    is_nan = self._graph.apply("ne", scalar, scalar)
                    is_first = self._graph.apply("eq", best, best)
                    wins = self._graph.apply("or", wins, self._graph.apply("and", is_nan, is_first))
                best = self._graph.select(wins, best, scalar)
                places[row] = self._graph.select(wins, places.item(*row), kind(i))
        return places

    _argmin = functools.partialmethod(_arg_extreme, "lt")
    _argmax = functools.partialmethod(_arg_extreme, "gt")

    def _linear_algebra(self, equation: JaxprEqn, *operands: ScalarArray) -> list[ScalarArray]:
        function = expansion(equation)
        if function is None:
            rows = shape_of(equation.invars[0])[-1]
            raise UnsupportedError(
                f"the operation {equation.primitive.name} of {rows} rows, more than {MAX_ROWS}"
            )
        return self.lower(jax.make_jaxpr(function)(*(x.aval for x in equation.invars)), operands)

    _cholesky = _lu = _qr = _triangular_solve = _linear_algebra

    def _dot_general(self, equation: JaxprEqn, a: ScalarArray, b: ScalarArray) -> ScalarArray:
        # Group the axes of both operands as (batch, free, summed); the result has (batch, free a,
        # free b).
        (sum_a, sum_b), (batch_a, batch_b) = equation.params["dimension_numbers"]
        rows = _group_axes(a, batch_a, sum_a)
        columns = _group_axes(b, batch_b, sum_b)
        dtype = np.dtype(dtype_of(equation.outvars[0]))
        sums = []
        for row_group, column_group in zip(rows, columns, strict=True):
            for row in row_group:
                for column in column_group:
                    total: Scalar = dtype.type(0)
                    for pair in zip(row, column, strict=True):
                        # The operands may have different dtypes, such as int32 and float32.
                        x, y = (self._graph.convert(scalar, dtype) for scalar in pair)
                        product = self._graph.apply("mul", x, y)
                        total = self._graph.apply("add", total, product)
                    sums.append(total)
        return scalar_array(sums, shape_of(equation.outvars[0]))


def _find_derived(graph: ExprGraph, loop: Loop, carried: set[int]) -> dict[int, Scalar]:
    """Find carried values of a loop that are functions of other carried values.

    A carried value is derived if it is the same function of the others before the first iteration
    and after every iteration. Example: a loop carries x and y, starts with y = f(x₀), and ends each
    iteration with y = f(x). Then y need not be carried, but is f(x) at the start of an iteration.
    The two expressions are compared operation by operation.

    Returns:
      How each derived value is computed from the others, by its place.
    """
    derived: dict[int, Scalar] = {}
    known: dict[_PairKey, Scalar] = {}
    # Begin with the values that were recorded first, because others may be derived from them.
    for place in sorted(carried, key=lambda k: _index(loop.updated[k])):
        # If an earlier place has the same two values, take its value; otherwise try to rebuild both
        # values from what is known at the start of an iteration.
        pair = loop.initial[place], loop.updated[place]
        found = known.get(_pair_key(pair))
        if found is None:
            found = _matched(graph, known, *pair)
        if found is not None:
            derived[place] = found
        # From here on, this pair is computed from the carried or derived value.
        known[_pair_key(pair)] = loop.carries[place] if found is None else found
    return derived


def _matched(
    graph: ExprGraph, known: dict[_PairKey, Scalar], before: Scalar, after: Scalar
) -> Scalar | None:
    """Return one expression for both `before` and `after`; None if there is none.

    Args:
      graph: the graph, to which the expression is added.
      known: for pairs of a value before the loop and after an iteration, the scalar that has this
        value at the start of every iteration.
      before: a carried value before the first iteration.
      after: the same value after an iteration.
    """
    # Walk down both expressions at once, with a stack instead of recursion: they may be thousands
    # of operations deep. A pair stays on the stack until all pairs of its operands are found.
    pending = [(before, after)]
    found: dict[_PairKey, Scalar | None] = {}
    while pending:
        pair = pending[-1]
        key = _pair_key(pair)
        if key in known or key in found:
            pending.pop()
            continue
        # An operation on different values matches if all of its operands do.
        parts = _parts(*pair)
        if parts is None:
            # The two have no common operation, so the expressions that contain them differ.
            return None
        # Each operand is the same scalar on both sides, a known pair, a pair found before, or still
        # missing.
        operands, missing = [], []
        for part in parts:
            key_of_part = None if is_same(*part) else _pair_key(part)
            if key_of_part is None:
                operands.append(part[0])
            elif key_of_part in known:
                operands.append(known[key_of_part])
            elif key_of_part in found:
                operands.append(found[key_of_part])
            else:
                missing.append(part)
        if missing:
            pending += missing
            continue
        # All operands are there: record the operation once more, on them.
        _, operation = pair
        assert not is_constant(operation)
        found[key] = graph.repeat(operation, operands)
        pending.pop()
    return found[_pair_key((before, after))]


def _parts(before: Scalar, after: Scalar) -> list[tuple[Scalar, Scalar]] | None:
    """Return the operands of two equal operations in pairs; None if the operations differ."""
    if is_constant(before) or is_constant(after) or not before.operands:
        return None
    if before.op != after.op or before.dtype != after.dtype or before.op == "input":
        return None
    # Arrays may have different lengths.
    if len(before.operands) != len(after.operands):
        return None
    return list(zip(before.operands, after.operands, strict=True))


def _pair_key(pair: tuple[Scalar, Scalar]) -> _PairKey:
    """Return a key that two pairs share if they are the same operations or equal constants."""
    before, after = pair
    return identity(before), identity(after)


def _index(x: Scalar) -> int:
    return -1 if is_constant(x) else x.index


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


def _constants(array: ArrayLike) -> ScalarArray:
    """Convert a constant of a jaxpr to scalars.

    Raises:
      UnsupportedError: it is not known yet, or an array of random keys.
    """
    dtype = getattr(array, "dtype", float)
    if isinstance(array, Tracer) or jnp.issubdtype(dtype, jax.dtypes.extended):
        raise UnsupportedError(f"a constant {array}")
    return constant_array(array)


def _is_expandable(equation: JaxprEqn) -> bool:
    """Return whether JAX has an expansion of an operation, as of `jnp.nonzero` since JAX 0.12.

    JAX calls these primitives high: it traces them to one equation, and replaces that by their
    expansion before it compiles.
    """
    is_high = getattr(equation.primitive, "is_high", None)
    return bool(is_high and is_high(*(x.aval for x in equation.invars), **equation.params))


def _at(array: ScalarArray, i: int) -> ScalarArray:
    """Return one entry along the leading axis, as an array even if it is a single scalar."""
    return array[i : i + 1].reshape(array.shape[1:])


def _lowest(equation: JaxprEqn) -> np.floating:
    dtype = dtype_of(equation.outvars[0])
    if dtype.kind != "f":
        raise UnsupportedError(f"the extreme of {dtype}")
    return dtype.type(-np.inf)


def _group_axes(x: ScalarArray, batch: Sequence[int], summed: Sequence[int]) -> ScalarArray:
    """Return an array with its axes grouped as (batch, free, summed)."""
    free = [axis for axis in range(x.ndim) if axis not in batch and axis not in summed]
    sizes = [
        int(np.prod([x.shape[axis] for axis in axes], dtype=int)) for axes in (batch, free, summed)
    ]
    return x.transpose(*batch, *free, *summed).reshape(sizes)
