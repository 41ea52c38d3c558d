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
   loops and branches (`control_flow`).
4. `schedule` places the operations in blocks, and `onekernel.codegen` writes the blocks as LLVM IR.

Why this is correct: the operations and their order are those of the function, so results differ
from JAX's by round-off only, as long as all numbers are finite. Functions whose numbers may be
infinite or NaN are lowered with `finite=False`. The lowering knows nothing of instances.
"""

import dataclasses
import functools
import inspect
import itertools
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.extend import core as jex
from jax.extend import source_info_util
from jax.extend.core import ClosedJaxpr, JaxprEqn, Literal, Var
from jaxtyping import Array, PyTree
from numpy.typing import ArrayLike

from onekernel.errors import UnsupportedError
from onekernel.lower.arithmetic import ARITHMETIC_RULES, bitcast, elementwise
from onekernel.lower.control_flow import CALLS, ControlFlow, call_of, check_bytes
from onekernel.lower.dynamic_indexing import DYNAMIC_RULES, scatter
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
from onekernel.lower.random_rules import RANDOM_RULES
from onekernel.lower.scalar_ir import (
    EVALUATE,
    Expr,
    ExprGraph,
    Scalar,
    bits_of,
    bytes_of,
    is_constant,
)
from onekernel.lower.schedule import Block, schedule
from onekernel.lower.simplify import SIMPLE_POWERS, make_graph

MAX_PROGRAM_OPERATIONS = 100_000
"""Largest number of operations of a program; LLVM takes 15 s to compile that many for a CPU."""

_GRAPH_RULES = {**ARITHMETIC_RULES, **RANDOM_RULES, **DYNAMIC_RULES}
"""Lowering rules that take the graph before the equation and its operands."""

_NO_RULE = {
    "onekernel": "a step of fuse_mjx within a loop, a branch or a function: call it outside"
}
"""What is said of operations without a rule whose names say little."""

_FLOAT = np.dtype(np.float32)

_PACKAGE = str(Path(__file__).parents[1]) + os.sep

_MAX_FRAMES = 100
"""Number of frames among which the user's line is looked for, from the innermost."""


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
    def input_shapes(self) -> list[tuple[int, ...]]:
        """Return the shapes of the inputs."""
        return [array.shape for array in self.inputs]

    @property
    def output_shapes(self) -> list[tuple[int, ...]]:
        """Return the shapes of the outputs."""
        return [array.shape for array in self.outputs]

    @property
    def size(self) -> int:
        """Return the number of operations; each scalar that is stored in an array is one, too."""
        stores = sum(len(array.operands) for array in self._arrays())
        return stores + sum(1 for _ in self.block.values())

    @property
    def array_bytes(self) -> int:
        """Return the bytes of memory that the arrays of one instance take."""
        return sum(map(bytes_of, self._arrays()))

    def _arrays(self) -> Iterator[Expr]:
        return itertools.chain.from_iterable(self.block.arrays())


class LateProgram(ScalarProgram):
    """A `LateProgram` is lowered when its operations are first asked for.

    Most processes find compiled what is around it, and need to know no more than its shapes.
    """

    def __init__(
        self,
        lower: Callable[[], ScalarProgram],
        input_shapes: Sequence[tuple[int, ...]],
        output_shapes: Sequence[tuple[int, ...]],
    ) -> None:
        """Describe a program.

        Args:
          lower: lowers it.
          input_shapes: the shapes of the inputs.
          output_shapes: the shapes of the outputs.
        """
        # The base class is frozen.
        vars(self).update(_lower=lower, _inputs=[*input_shapes], _outputs=[*output_shapes])

    @functools.cached_property
    def lowered(self) -> ScalarProgram:
        """Return the program.

        Raises:
          UnsupportedError: the function has an operation that cannot be lowered.
        """
        return vars(self)["_lower"]()

    @property
    def inputs(self) -> list[ScalarArray]:
        """Return the scalars of the arguments."""
        return self.lowered.inputs

    @property
    def outputs(self) -> list[ScalarArray]:
        """Return the scalars of the result."""
        return self.lowered.outputs

    @property
    def block(self) -> Block:
        """Return all operations."""
        return self.lowered.block

    @property
    def input_shapes(self) -> list[tuple[int, ...]]:
        """Return the shapes of the inputs."""
        return vars(self)["_inputs"]

    @property
    def output_shapes(self) -> list[tuple[int, ...]]:
        """Return the shapes of the outputs."""
        return vars(self)["_outputs"]


def scalarize(
    function: Callable[..., PyTree],
    *arguments: PyTree,
    words: bool = False,
    finite: bool = True,
    approximate: bool = False,
    skips: bool = False,
) -> ScalarProgram:
    """Lower a function to a program on scalars; the module states the protocol.

    Args:
      function: a jittable function of one instance.
      *arguments: pytrees of arrays, or of objects with a shape and a dtype.
      words: as for `scalarize_part`.
      finite: whether all numbers are finite, as for `ExprGraph`.
      approximate: whether exp, log and 1/x are operations, which only GPUs have instructions for:
        approximate ones. Otherwise exp and log become polynomials.
      skips: whether matrix products skip, by a branch, the terms with a truth value that is false,
        such as the forces of a contact that does not touch. That pays where a thread computes an
        instance. The lanes of a vector skip what is false for all of them, which is seldom.

    Returns:
      The program.

    Raises:
      UnsupportedError: the function has an operation that cannot be lowered, or too many of them.
    """
    closed = jax.make_jaxpr(function)(*arguments)
    variables = closed.jaxpr.invars, closed.jaxpr.outvars
    options = {"finite": finite, "approximate": approximate, "skips": skips}
    return scalarize_part(closed, *variables, words=words, **options)


def scalarize_part(
    closed: ClosedJaxpr,
    arguments: Sequence[Var],
    results: Sequence[Var | Literal],
    *,
    words: bool = False,
    finite: bool = True,
    approximate: bool = False,
    skips: bool = False,
) -> ScalarProgram:
    """Lower the part of a traced function between some of its variables, as `scalarize` does.

    Args:
      closed: the function.
      arguments: the variables whose values the program is given. They need not be the function's
        own arguments: what is computed before them is left out.
      results: the variables or literals that the program returns.
      words: whether the program takes and returns float32 only. Other numbers are then passed as
        float32 with their bits, those of 64 bits as two (see `bitcast`), and a bool as 0 or 1.
      finite: whether all numbers are finite, as for `ExprGraph`.
      approximate: as for `scalarize`.
      skips: likewise.

    Returns:
      The program.

    Raises:
      UnsupportedError: as `scalarize`, or the function does more than return results.
    """
    _reject_effects(closed)
    # Start with the program's arguments, each split into scalars of the graph.
    graph = make_graph(finite=finite, approximate=approximate, skips=skips)
    lowering = _JaxprLowering(graph)
    env: dict[Var, ScalarArray] = {}
    inputs = []
    for variable in [*arguments, *results]:
        if jnp.issubdtype(dtype_of(variable), jax.dtypes.extended):
            raise UnsupportedError(f"an argument or result of {dtype_of(variable)}")
    for variable in arguments:
        dtype = np.dtype(dtype_of(variable))
        given = _FLOAT if words else dtype
        shape = word_shape(shape_of(variable), dtype, words)
        inputs.append(full_array(shape, lambda dtype=given: graph.input(dtype)))
        env[variable] = bitcast(graph, inputs[-1], given, dtype)
    # Record the operations of all equations that the results need.
    outputs = lowering.lower_part(closed, env, results)
    if words:
        outputs = [
            bitcast(graph, x, np.dtype(dtype_of(atom)), _FLOAT)
            for x, atom in zip(outputs, results, strict=True)
        ]
    # Arrange the recorded operations, without those on which no result depends.
    block = schedule(x for array in outputs for x in array.ravel())
    program = ScalarProgram(inputs, outputs, block)
    if program.size > MAX_PROGRAM_OPERATIONS:
        raise UnsupportedError(f"{program.size:,} operations, more than {MAX_PROGRAM_OPERATIONS:,}")
    check_bytes(program.array_bytes)
    return program


def _reject_effects(closed: ClosedJaxpr) -> None:
    """Raise an `UnsupportedError` if a function does more than return results."""
    if closed.effects:
        # For example `jax.debug.print`, on which no result depends.
        error = UnsupportedError(f"an effect: {', '.join(map(str, closed.effects))}")
        error.place = next((_place(x) for x in closed.jaxpr.eqns if x.effects), None)
        raise error


def word_shape(shape: Sequence[int], dtype: np.dtype, words: bool = True) -> tuple[int, ...]:
    """Return the shape in which a program takes or returns an array, mostly as words."""
    return (*shape, 2) if words and bits_of(dtype) == 64 else tuple(shape)


def primitives() -> dict[str, list[str]]:
    """Return the names of the JAX primitives that have a rule, by what the rule does."""
    own = [name[1:] for name in dir(_JaxprLowering(make_graph())) if name[:2] != "__"]
    kinds = {
        "an operation for each element": EVALUATE,
        "scalars rearranged, nothing computed": RULES,
        "several operations": ARITHMETIC_RULES,
        "indices known only at run time, sorting": DYNAMIC_RULES,
        "random numbers": RANDOM_RULES,
        "a formula of other operations": EXPANSIONS,
        "loops, branches, calls, linear algebra": [*own, *CALLS],
    }
    public = {x.name for x in vars(jex.primitives).values() if isinstance(x, jex.Primitive)}
    found: dict[str, list[str]] = {}
    for kind, names in kinds.items():
        found[kind] = sorted(public.intersection(names))
        public -= set(found[kind])
    return found


class _JaxprLowering:
    """A `_JaxprLowering` records the operations of a jaxpr on scalars.

    The lowering rule of the JAX primitive `name` is `RULES[name]` or the method `_name`: a function
    of the equation and its operands that returns the results. The rules of arithmetic, of random
    numbers and of indices that are not constant are in `_GRAPH_RULES`. An operation in `EXPANSIONS`
    is replaced by a formula of other JAX operations, which is traced and lowered in its place.
    """

    def __init__(self, graph: ExprGraph) -> None:
        self._graph = graph
        control = ControlFlow(graph, self.lower)
        self._scan, self._while, self._cond = control.scan, control.while_loop, control.cond

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
            error.place = error.place or _place(equation)
            raise

    def _apply_rule(self, equation: JaxprEqn, operands: list[ScalarArray]) -> list[ScalarArray]:
        if call := call_of(equation, operands):
            return self.lower(*call)
        name = equation.primitive.name
        # Most operations on single elements have the same name in JAX and in the graph, and need
        # no rule of their own.
        if name in EVALUATE and not hasattr(self, f"_{name}"):
            return [elementwise(self._graph, name, *operands)]
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
            raise UnsupportedError(_NO_RULE.get(name, f"the operation {name}"))
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

    def _scatter(
        self, equation: JaxprEqn, *operands: ScalarArray
    ) -> ScalarArray | list[ScalarArray]:
        if equation.params["update_jaxpr"] is None:
            return DYNAMIC_RULES["scatter"](self._graph, equation, *operands)
        # `x.at[i].apply(function)` computes the new numbers by a function of the old ones.
        closed = ClosedJaxpr(equation.params["update_jaxpr"], equation.params["update_consts"])

        def combine(old: Scalar, new: Scalar) -> Scalar:
            (result,) = self.lower(closed, [scalar_array([x], ()) for x in (old, new)])
            return result.item()

        return scatter(self._graph, equation, *operands, combine=combine)

    def _platform_index(self, equation: JaxprEqn) -> ScalarArray:
        # `jax.lax.platform_dependent`: choose the case that is written for all platforms, whose
        # names are None. A scalar program does not know which platform it is for.
        platforms = equation.params["platforms"]
        index = next((i for i, names in enumerate(platforms) if names is None), len(platforms) - 1)
        return constant_array(np.int32(index))

    def _round(self, equation: JaxprEqn, x: ScalarArray) -> ScalarArray:
        if equation.params["rounding_method"] == jax.lax.RoundingMethod.TO_NEAREST_EVEN:
            return elementwise(self._graph, "round", x)
        return self._expand_by(round_away_from_zero, equation)(equation, x)[0]

    def _pow(self, equation: JaxprEqn, x: ScalarArray, y: ScalarArray) -> ScalarArray:
        exponents = {float(one) if is_constant(one) else None for one in y.ravel()}
        if exponents <= SIMPLE_POWERS:
            return elementwise(self._graph, "pow", x, y)
        return self._expand_by(power, equation)(equation, x, y)[0]

    def _linear_algebra(self, equation: JaxprEqn, *operands: ScalarArray) -> list[ScalarArray]:
        function = expansion(equation)
        if function is None:
            rows = shape_of(equation.invars[0])[-1]
            raise UnsupportedError(
                f"the operation {equation.primitive.name} of {rows} rows, more than {MAX_ROWS}"
            )
        return self.lower(jax.make_jaxpr(function)(*(x.aval for x in equation.invars)), operands)

    _cholesky = _lu = _qr = _triangular_solve = _linear_algebra


def _place(equation: JaxprEqn) -> str | None:
    """Return the innermost line outside of this package that made an equation, if one is known."""
    lines = source_info_util.summarize(equation.source_info, num_frames=_MAX_FRAMES).split("\n")
    return next((line for line in reversed(lines) if line and not line.startswith(_PACKAGE)), None)


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
