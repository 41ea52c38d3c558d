"""Record arithmetic on scalars as a graph of operations.

An `ExprGraph` folds operations on constants, records equal operations once, and removes products
with zero. Most entries of the matrices of physics are zeros, so most of the arithmetic disappears.
A `Loop` and a `Branch` are recorded as units; `schedule` decides in which block of the program each
operation is computed.

Scalars are in registers, which no index can choose. What an index that is not constant reads is in
an array instead, in memory of the instance's own: one that holds given scalars (`ExprGraph.array`),
or one to which a loop adds a scalar in every iteration (`Loop.stacked`). Both are operations
whose value is an address, and which only `ExprGraph.load` takes as an operand. An array is never
changed after it is complete, so loads have no order among each other.

Three simplifications hold for finite numbers only: 0·x, 0/x and x - x are 0. A graph for numbers
that may be infinite or NaN goes without them, and reduces angles of any size.

Functions such as exp and log are recorded as polynomials, which are exact to a few units in the
last place and equal on every machine. GPUs have approximate instructions for some of them instead;
an approximate graph records these (see `_APPROXIMATE`).
"""

import dataclasses
import functools
from collections.abc import Callable, Hashable, Iterable, Sequence
from typing import TYPE_CHECKING, NamedTuple, Union, cast

import numpy as np

from onekernel.errors import UnsupportedError

if TYPE_CHECKING:
    from typing_extensions import TypeIs

Constant = np.bool_ | np.integer | np.floating
"""A scalar whose value is known while the program is recorded."""

Scalar = Union["Expr", Constant]
"""An `Expr`, or a NumPy scalar if the value is a constant."""


@dataclasses.dataclass(eq=False, repr=False, slots=True)
class Expr:
    """An `Expr` is a scalar whose value is known only when the program runs."""

    op: str
    """Name of the operation, as in `jax.lax`; `input` is an input of the program, `carry` a value
    that a loop carries between iterations, `counter` the index of an iteration, `result` a result
    of a loop or branch. `array` and `stack` are arrays, of given scalars and of a scalar of every
    iteration, and `load` is a scalar of an array."""
    operands: tuple[Scalar, ...]
    dtype: np.dtype
    """dtype of the result, or of the scalars of an array: float32, int32, uint32 or bool."""
    index: int
    """Position in the order of recording; operands have smaller indices."""
    owner: "Loop | Branch | None" = None
    """The loop or branch that a `carry`, `counter`, `result` or `stack` belongs to."""
    place: int = 0
    """Position of a `carry`, `result` or `stack` among those of its owner."""


@dataclasses.dataclass(eq=False, repr=False)
class Loop:
    """A `Loop` is a while loop that carries scalars, or a counted one, as of `jax.lax.scan`.

    All instances that run side by side make the iterations of a counted loop together.
    """

    index: int
    """Position in the order of recording, after all operations of an iteration."""
    carries: list[Expr]
    """The carried values at the start of an iteration."""
    initial: list[Scalar]
    """The carried values at the start of the first iteration."""
    updated: list[Scalar] = dataclasses.field(default_factory=list)
    """The carried values at the end of an iteration, as functions of `carries`."""
    condition: Scalar = dataclasses.field(init=False)
    """Whether there is another iteration, as a function of `carries`; True in a counted loop."""
    results: list[Scalar] = dataclasses.field(default_factory=list)
    """The results of the loop, as functions of the `carries` after the last iteration."""
    length: int | None = None
    """The number of iterations of a counted loop; None: `condition` decides."""
    reverse: bool = False
    """Whether the counter of a counted loop goes from `length - 1` to 0 instead of upwards."""
    counter: Expr | None = None
    """The index of an iteration of a counted loop, int32."""
    stacked: list[Scalar] = dataclasses.field(default_factory=list)
    """The scalars that an iteration of a counted loop stores at the index `counter`, each in an
    array of its own."""


@dataclasses.dataclass(eq=False, repr=False)
class Branch:
    """A `Branch` selects between two lists of scalars and computes only the selected side."""

    index: int
    """Position in the order of recording, after all operations of both sides."""
    condition: Scalar
    """Whether `if_true` is selected."""
    if_false: list[Scalar]
    if_true: list[Scalar]


def is_constant(x: Scalar) -> "TypeIs[Constant]":
    """Return whether a scalar is a constant."""
    return not isinstance(x, Expr)


COMPARISONS = ("lt", "le", "gt", "ge", "eq", "ne")

_OF_TRUTHS = {
    "max": ("or", False, False),
    "min": ("and", False, False),
    "add": ("or", False, False),
    "mul": ("and", False, False),
    "lt": ("and", True, False),
    "gt": ("and", False, True),
    "le": ("or", True, False),
    "ge": ("or", False, True),
}
"""What arithmetic and order are between truth values: the operation of logic that takes their
place, and whether it inverts its first and its second operand. False is below True."""

_FLOAT, _INT, _BOOL = np.dtype(np.float32), np.dtype(np.int32), np.dtype(bool)
_UINT = np.dtype(np.uint32)
_DTYPES = (_FLOAT, _INT, _UINT, _BOOL)


def _divide(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    if a.dtype.kind == "f":
        return np.divide(a, b)
    # By 0, JAX returns the number whose bits are all set.
    quotient = np.where(b == 0, -1, np.trunc(np.divide(a, np.where(b == 0, 1, b))))
    return quotient.astype(np.int64).astype(a.dtype)


def _rest(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    if a.dtype.kind == "f":
        return np.fmod(a, b)
    return np.where(b == 0, a, np.fmod(a, np.where(b == 0, 1, b))).astype(a.dtype)


def convert_constant(x: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """Convert to another dtype; integers saturate at their limits, and NaN becomes 0."""
    if x.dtype.kind == "f" and np.dtype(dtype).kind in "iu":
        ends = np.iinfo(dtype)
        finite = np.nan_to_num(x.astype(np.float64), posinf=np.inf, neginf=-np.inf)
        return np.clip(finite, ends.min, ends.max).astype(dtype)
    return x.astype(dtype)


def _bitcast(x: np.ndarray) -> np.ndarray:
    return x.view(_INT if x.dtype == _FLOAT else _FLOAT)


def _reduced(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return an angle's nearest number of quarter turns, modulo 4, and the angle that is left."""
    # In float64, π/2 is exact to far more digits than the result needs.
    wide = x.astype(np.float64)
    angle = np.arctan2(np.sin(wide), np.cos(wide))
    turns = np.round(angle * (2 / np.pi))
    return np.mod(turns, 4).astype(x.dtype), (angle - turns * (np.pi / 2)).astype(x.dtype)


def _erf_inv(x: np.ndarray) -> np.ndarray:
    from scipy import special

    return special.erfinv(x)


EVALUATE: dict[str, Callable[..., np.ndarray]] = {
    "abs": np.abs,
    "add": np.add,
    "add_any": np.add,
    "and": np.bitwise_and,
    "angle_rest": lambda x: _reduced(x)[1],
    "atan2": np.arctan2,
    "bitcast": _bitcast,
    "cos": np.cos,
    "div": _divide,
    "eq": np.equal,
    "erf_inv": _erf_inv,
    "exp": np.exp,
    "expm1": np.expm1,
    "floor": np.floor,
    "ge": np.greater_equal,
    "gt": np.greater,
    "is_finite": np.isfinite,
    "le": np.less_equal,
    "log": np.log,
    "log1p": np.log1p,
    "lt": np.less,
    "max": np.maximum,
    "min": np.minimum,
    "mul": np.multiply,
    "ne": np.not_equal,
    "neg": np.negative,
    "not": np.bitwise_not,
    "or": np.bitwise_or,
    "pow": np.power,
    "quarter_turns": lambda x: _reduced(x)[0],
    "reciprocal": np.reciprocal,
    "rem": _rest,
    "rotate_left": lambda x, by: (x << by) | (x >> (x.dtype.type(32) - by)),
    "round": np.round,
    "shift_left": np.left_shift,
    "shift_right_logical": lambda x, by: (x.view(np.uint32) >> by.view(np.uint32)).view(x.dtype),
    "sign": np.sign,
    "sin": np.sin,
    "sqrt": np.sqrt,
    "sub": np.subtract,
    "tanh": np.tanh,
    "xor": np.bitwise_xor,
}
"""The NumPy function of every operation except `select` and `convert`. `bitcast` takes the bits of
a float32 for an int32, or the other way round; `round` rounds to the nearest whole number, and half
of one to the nearest even. For an angle up to 2⁵⁰, `quarter_turns` is the nearest number of quarter
turns, modulo 4, and `angle_rest` the angle that is left, between -π/4 and π/4."""

MAX_OPERATIONS = 1_000_000
"""Largest number of recorded operations, including those that nothing depends on."""

# Operations whose operands may be exchanged: a + b and b + a are recorded once.
_COMMUTATIVE = ("add", "and", "eq", "max", "min", "mul", "ne", "or", "xor")


class ExprGraph:
    """An `ExprGraph` records operations on scalars, each of them once."""

    def __init__(self, *, finite: bool = True, approximate: bool = False) -> None:
        """Start with an empty graph.

        Args:
          finite: whether all numbers are finite, and angles at most 10⁴.
          approximate: whether to record functions that GPUs have approximate instructions for.
        """
        self.finite = finite
        self._simplifications = _SIMPLIFY | _APPROXIMATE if approximate else _SIMPLIFY
        self._values: dict[tuple[Hashable, ...], Expr] = {}
        self.count = 0
        """Number of recorded operations."""

    def is_exact(self, dtype: np.dtype) -> bool:
        """Return whether a rule for finite numbers, such as 0·x = 0, holds for a dtype here."""
        return self.finite or dtype != _FLOAT

    def input(self, dtype: np.dtype) -> Expr:
        """Add an input of the program."""
        return self._record("input", (np.int32(self.count),), np.dtype(dtype))

    def apply(self, op: str, *operands: Scalar) -> Scalar:
        """Record one operation, or return its result if all operands are constants.

        Args:
          op: a name in `EVALUATE`.
          *operands: scalars of one dtype.

        Returns:
          The result, possibly an existing or simpler scalar of the same value.

        Raises:
          UnsupportedError: the operation or the dtype is not supported.
        """
        if op not in EVALUATE:
            raise UnsupportedError(f"the operation {op}")
        recorded = [x for x in operands if isinstance(x, Expr)]
        # NumPy computes an operation on constants at once.
        if not recorded:
            with np.errstate(all="ignore"):
                return cast(Constant, np.asarray(EVALUATE[op](*operands))[()])
        operand_dtype = recorded[0].dtype
        # All operands have one dtype: jaxprs convert numbers explicitly, and the generated code
        # cannot.
        if operand_dtype not in _DTYPES or any(x.dtype != operand_dtype for x in operands):
            raise UnsupportedError(f"{op} of {', '.join(str(x.dtype) for x in operands)}")
        if operand_dtype == _BOOL and op in _OF_TRUTHS:
            logic, is_first_inverted, is_second_inverted = _OF_TRUTHS[op]
            x, y = operands
            x = self.apply("not", x) if is_first_inverted else x
            y = self.apply("not", y) if is_second_inverted else y
            return self.apply(logic, x, y)
        # A simplification may return an existing scalar, a constant, or a longer formula of basic
        # operations.
        if simplify := self._simplifications.get(op):
            simplified = simplify(self, operand_dtype, *operands)
            if simplified is not None:
                return simplified
        # Only comparisons and changes of bits have another dtype than their operands.
        dtype = _BOOL if op in COMPARISONS or op == "is_finite" else operand_dtype
        if op == "bitcast":
            dtype = _INT if dtype == _FLOAT else _FLOAT
        return self._record(op, operands, dtype)

    def select(self, condition: Scalar, on_false: Scalar, on_true: Scalar) -> Scalar:
        """Select one of two scalars of one dtype by a bool scalar."""
        if is_constant(condition):
            return on_true if condition else on_false
        check_scalars([on_false, on_true])
        if is_same(on_false, on_true):
            return on_false
        # Select the other way round instead of inverting the condition.
        if condition.op == "not":
            return self.select(condition.operands[0], on_true, on_false)
        dtype = on_true.dtype
        if dtype == _BOOL:
            # condition & on_true | ~condition & on_false
            selected = self.apply("and", condition, on_true)
            return self.apply(
                "or", selected, self.apply("and", self.apply("not", condition), on_false)
            )
        return self._record("select", (condition, on_false, on_true), dtype)

    def convert(self, x: Scalar, dtype: np.dtype) -> Scalar:
        """Convert a scalar to another dtype."""
        if is_constant(x):
            return cast(Constant, convert_constant(np.asarray(x), dtype)[()])
        # JAX has no 64-bit types by default, so no other dtypes occur.
        if dtype not in _DTYPES:
            raise UnsupportedError(f"a conversion to {dtype}")
        if x.dtype == dtype:
            return x
        # A conversion between int32 and uint32 keeps the bits: there and back, nothing changes.
        if x.op == "convert" and {x.dtype, dtype} == {_INT, _UINT}:
            before = x.operands[0]
            if before.dtype == dtype:
                return before
        if dtype == _BOOL:
            return self.apply("ne", x, x.dtype.type(0))
        return self._record("convert", (x,), dtype)

    def repeat(self, value: Expr, operands: Sequence[Scalar]) -> Expr:
        """Record an operation again with other operands, without simplifying it."""
        return self._record(value.op, tuple(operands), value.dtype)

    def array(self, scalars: Sequence[Scalar]) -> Expr:
        """Record an array of at least one scalar, all of one dtype, float32, int32 or uint32."""
        first = scalars[0]
        if first.dtype not in (_FLOAT, _INT, _UINT) or any(x.dtype != first.dtype for x in scalars):
            raise UnsupportedError(f"an array of {', '.join({str(x.dtype) for x in scalars})}")
        # What a loop has stacked is an array already.
        stack = first.operands[0] if isinstance(first, Expr) and first.op == "load" else None
        if (
            isinstance(stack, Expr)
            and length_of(stack) == len(scalars)
            and all(
                isinstance(x, Expr)
                and x.op == "load"
                and is_same(x.operands[0], stack)
                and _equals(x.operands[1], i)
                for i, x in enumerate(scalars)
            )
        ):
            return stack
        return self._record("array", tuple(scalars), first.dtype)

    def load(self, array: Expr, index: Scalar) -> Scalar:
        """Read a scalar of an array (`array` or `stack`).

        Args:
          array: the array.
          index: an int32, which must be inside of the array.
        """
        if array.op == "array":
            # At a constant index, an array of given scalars has one of them.
            if is_constant(index):
                return array.operands[int(index)]
            # `jnp.arange` has its index everywhere.
            if array.dtype == _INT and all(_equals(x, i) for i, x in enumerate(array.operands)):
                return index
        return self._record("load", (array, index), array.dtype)

    def begin_loop(
        self, initial: Sequence[Scalar], length: int | None = None, *, reverse: bool = False
    ) -> Loop:
        """Begin a loop; the operations of its iterations are recorded before `end_loop`.

        Args:
          initial: the carried values at the start of the first iteration.
          length: the number of iterations of a counted loop; None: its condition decides.
          reverse: whether a counted loop counts downwards.
        """
        loop = Loop(-1, [], list(initial), length=length, reverse=reverse)
        if length is not None:
            loop.condition = np.bool_(True)
            loop.counter = self._new("counter", (), _INT, loop)
        for place, scalar in enumerate(initial):
            # Whether a carry is needed is found later: `schedule` drops those that nothing uses.
            loop.carries.append(self._new("carry", (), scalar.dtype, loop, place))
        return loop

    def end_loop(self, loop: Loop) -> list[Expr]:
        """End a loop whose attributes are all set except `index`, and return its results."""
        loop.index = self._next()
        return [
            self._new("result", (), scalar.dtype, loop, place)
            for place, scalar in enumerate(loop.results)
        ]

    def stacks(self, loop: Loop) -> list[Expr]:
        """Return the arrays that a loop has stacked, after `end_loop`; none may be of bool."""
        return [
            self._new("stack", (), scalar.dtype, loop, place)
            for place, scalar in enumerate(loop.stacked)
        ]

    def branch(
        self, condition: Scalar, if_false: Sequence[Scalar], if_true: Sequence[Scalar]
    ) -> list[Scalar]:
        """Record a branch, of which only the selected side is computed, and return its results."""
        # The callers have recorded both sides, so the branch has a larger index than they have.
        branch = Branch(self._next(), condition, list(if_false), list(if_true))
        return [
            b if is_same(a, b) else self._new("result", (), b.dtype, branch, place)
            for place, (a, b) in enumerate(zip(if_false, if_true, strict=True))
        ]

    def _record(self, op: str, operands: tuple[Scalar, ...], dtype: np.dtype) -> Expr:
        names = [identity(x) for x in operands]
        # The key ignores the order of commutative operands, but the operation keeps the order in
        # which it was first recorded, so that the same function always lowers to the same text.
        key = (op, dtype, *(sorted(names, key=repr) if op in _COMMUTATIVE else names))
        if key not in self._values:
            self._values[key] = self._new(op, operands, dtype)
        return self._values[key]

    def _new(
        self,
        op: str,
        operands: tuple[Scalar, ...],
        dtype: np.dtype,
        owner: Loop | Branch | None = None,
        place: int = 0,
    ) -> Expr:
        return Expr(op, operands, dtype, self._next(), owner, place)

    def _next(self) -> int:
        if self.count >= MAX_OPERATIONS:
            raise UnsupportedError(f"more than {MAX_OPERATIONS:,} operations")
        self.count += 1
        return self.count - 1


def length_of(array: Expr) -> int:
    """Return the number of scalars of an `array` or `stack`."""
    if isinstance(array.owner, Loop):
        assert array.owner.length is not None
        return array.owner.length
    return len(array.operands)


def is_table(array: Expr) -> bool:
    """Return whether an array consists of constants, so that all instances can share it."""
    return array.op == "array" and all(map(is_constant, array.operands))


def check_scalars(values: Iterable[object]) -> None:
    """Raise an `UnsupportedError` if something is not a scalar, such as a random key."""
    for value in values:
        if not isinstance(value, Expr | np.generic):
            raise UnsupportedError(f"a choice between values such as {type(value).__name__}")


def is_same(x: Scalar, y: Scalar) -> bool:
    """Return whether two scalars are the same operation, or constants with equal bits."""
    return x is y or (_are_constant(x, y) and identity(x) == identity(y))


def identity(x: Scalar) -> Hashable:
    """Return a key that is shared only by the same operation, or by constants with equal bits."""
    # Compare bits: 0.0 == -0.0 although they differ, and NaN != NaN although they are the same.
    return x.index if isinstance(x, Expr) else (x.dtype.str, x.tobytes())


def _are_constant(x: Scalar, *others: Scalar) -> bool:
    return is_constant(x) and all(is_constant(other) for other in others)


def _equals(x: Scalar, number: float) -> bool:
    return is_constant(x) and x == number


_NEUTRAL = {"add": 0, "and": True, "mul": 1, "or": False, "xor": False}
"""The constant that leaves the other operand of an operation as it is."""

_ABSORBING = {"and": False, "mul": 0, "or": True}
"""The constant that is the result, whatever the other operand is."""

_INVERTING = {"mul": (-1, "neg"), "xor": (True, "not")}
"""The constant that inverts the other operand, and the operation that does so."""


def _simplify_commutative(
    graph: ExprGraph, dtype: np.dtype, x: Scalar, y: Scalar, *, op: str
) -> Scalar | None:
    # Combining a number with itself changes nothing.
    if x is y and op in ("and", "or", "max", "min"):
        return x
    # NaN wins against every number, as in JAX.
    if op in ("max", "min") and dtype == _FLOAT:
        for one in (x, y):
            if is_constant(one) and np.isnan(one):
                return one
    # On bits, the constants of the tables hold for truth values only.
    if op in ("and", "or", "xor") and dtype != _BOOL:
        return None
    # x · 0 = 0 (for finite x), x + 0 = x, x · 1 = x and x · -1 = -x, with the constant on either
    # side; and likewise for truth values.
    for one, other in ((x, y), (y, x)):
        if op in _ABSORBING and _equals(one, _ABSORBING[op]) and graph.is_exact(dtype):
            return dtype.type(_ABSORBING[op])
        if op in _NEUTRAL and _equals(one, _NEUTRAL[op]):
            return other
        if op in _INVERTING and _equals(one, _INVERTING[op][0]):
            return graph.apply(_INVERTING[op][1], other)
    return None


def _simplify_sub(graph: ExprGraph, dtype: np.dtype, x: Scalar, y: Scalar) -> Scalar | None:
    # x - x is NaN for an infinite x.
    if x is y and graph.is_exact(dtype):
        return dtype.type(0)
    if _equals(x, 0):
        return graph.apply("neg", y)
    return x if _equals(y, 0) else None


def _simplify_div(graph: ExprGraph, dtype: np.dtype, x: Scalar, y: Scalar) -> Scalar | None:
    # Integers whose divisor may be 0 or negative are divided by magnitudes, and the sign is set
    # afterwards.
    if dtype != _FLOAT and not _is_positive(y):
        return _divided(graph, dtype, x, y)[0]
    if _equals(x, 0) and graph.is_exact(dtype):
        return dtype.type(0)
    if _equals(y, 1):
        return x
    # Multiply by the reciprocal instead, since a division takes several times as long.
    if is_constant(y) and dtype == _FLOAT and y != 0:
        return graph.apply("mul", x, np.float32(1 / np.float64(y)))
    return None


def _simplify_rem(graph: ExprGraph, dtype: np.dtype, x: Scalar, y: Scalar) -> Scalar | None:
    if dtype == _FLOAT:
        return _float_rest(graph, x, y)
    return None if _is_positive(y) else _divided(graph, dtype, x, y)[1]


def _float_rest(graph: ExprGraph, x: Scalar, y: Scalar) -> Scalar:
    """Return the remainder of x / y as C's fmod does, with the sign of x.

    Its error is that of the product of the whole quotient and y.
    """
    do, zero = graph.apply, np.float32(0)
    size, rest = do("abs", y), do("abs", x)
    # A float32 quotient has 24 bits. If the whole quotient needs more, the first round leaves a
    # rest that is still larger than y, and the second round divides that.
    for _ in range(2):
        whole = do("floor", do("div", rest, size))
        rest = do("sub", rest, do("mul", whole, size))
        # The quotient may be rounded to the next whole number: bring the rest into 0 ... |y|.
        rest = graph.select(do("lt", rest, zero), rest, do("add", rest, size))
        rest = graph.select(do("ge", rest, size), rest, do("sub", rest, size))
    # If y is infinite, the remainder is x. If x is infinite or NaN, or y is 0 or NaN, it is NaN.
    rest = graph.select(do("eq", size, np.float32(np.inf)), rest, do("abs", x))
    is_number = do("and", do("lt", do("abs", x), np.float32(np.inf)), do("gt", size, zero))
    rest = graph.select(is_number, np.float32(np.nan), rest)
    # The rest has the sign of the dividend.
    return graph.select(do("lt", x, zero), rest, do("neg", rest))


def _is_positive(y: Scalar) -> bool:
    """Return whether an integer is known to be positive.

    Processors divide by such an integer without trouble; division by 0 stops a program on x86.
    """
    if is_constant(y):
        return bool(y > 0)
    return y.op == "max" and y.dtype == _UINT and any(is_constant(x) and x > 0 for x in y.operands)


def _divided(graph: ExprGraph, dtype: np.dtype, x: Scalar, y: Scalar) -> tuple[Scalar, Scalar]:
    """Return quotient and remainder of integers as JAX computes them, also of a division by 0.

    The magnitudes are divided, as integers without a sign; -2³¹ has a magnitude, too, as uint32.
    """
    do, zero, one = graph.apply, dtype.type(0), np.uint32(1)
    size_x, size_y = (graph.convert(_magnitude(graph, dtype, each), _UINT) for each in (x, y))
    # Divide by 1 in place of 0, which would stop the program on x86, and replace the result below.
    divisor = do("max", size_y, one)
    quotient = graph.convert(do("div", size_x, divisor), dtype)
    rest = graph.convert(do("rem", size_x, divisor), dtype)
    # The quotient is negative if the signs differ, and the remainder has the sign of the dividend.
    if dtype == _INT:
        is_below = do("lt", x, zero)
        differ = do("xor", is_below, do("lt", y, zero))
        quotient = graph.select(differ, quotient, do("neg", quotient))
        rest = graph.select(is_below, rest, do("neg", rest))
    # JAX divides n by 0 to a quotient with all bits set and the remainder n.
    is_zero = do("eq", y, zero)
    none = np.int32(-1) if dtype == _INT else np.uint32(2**32 - 1)
    return graph.select(is_zero, quotient, none), graph.select(is_zero, rest, x)


def _magnitude(graph: ExprGraph, dtype: np.dtype, x: Scalar) -> Scalar:
    return graph.apply("abs", x) if dtype == _INT else x


def _simplify_shift(
    graph: ExprGraph, dtype: np.dtype, x: Scalar, by: Scalar, *, op: str
) -> Scalar | None:
    """Expand a shift by an unknown number of bits into shifts by constants.

    Processors differ in what they do for 32 bits and more, and LLVM leaves it undefined.
    """
    do = graph.apply
    # In JAX, the result of a shift by 32 bits or more is 0.
    if is_constant(by):
        return None if 0 <= by < 32 else dtype.type(0)
    # Shift by each bit of the number that is set; beyond 31, nothing is left.
    for bit in range(5):
        is_set = do("ne", do("and", by, dtype.type(1 << bit)), dtype.type(0))
        x = graph.select(is_set, x, do(op, x, dtype.type(1 << bit)))
    count = graph.convert(by, _UINT)
    return graph.select(do("lt", count, np.uint32(32)), dtype.type(0), x)


def _simplify_inverse(op: str) -> Callable[..., Scalar | None]:
    """Return the simplification of an operation that is its own inverse."""
    return lambda graph, dtype, x: x.operands[0] if x.op == op else None


def _simplify_not(graph: ExprGraph, dtype: np.dtype, x: Expr) -> Scalar | None:
    if dtype == _BOOL:
        return x.operands[0] if x.op == "not" else None
    return graph.apply("xor", x, cast(Constant, np.array(-1).astype(dtype)[()]))


SIMPLE_POWERS = {1.0, 2.0, 0.5, 1.5}
"""Exponents for which no logarithm is needed."""


def _simplify_pow(graph: ExprGraph, dtype: np.dtype, x: Scalar, y: Scalar) -> Scalar | None:
    if _equals(y, 1):
        return x
    if _equals(y, 2):
        return graph.apply("mul", x, x)
    if not any(_equals(y, power) for power in (0.5, -0.5, 1.5)):
        return None
    root, factor = graph.apply("sqrt", x), x
    if not graph.finite:
        # By convention, powers of -inf that are no whole numbers are those of inf.
        is_lowest = graph.apply("eq", x, dtype.type(-np.inf))
        root = graph.select(is_lowest, root, dtype.type(np.inf))
        factor = graph.apply("abs", x)
    if _equals(y, -0.5):
        # The derivative of a root.
        return graph.apply("div", dtype.type(1), root)
    # To the power of 1.5: of the square of a distance, its third power.
    return root if _equals(y, 0.5) else graph.apply("mul", factor, root)


def _simplify_sign(graph: ExprGraph, dtype: np.dtype, x: Scalar) -> Scalar:
    zero, one = dtype.type(0), dtype.type(1)
    if dtype.kind == "u":
        return graph.select(graph.apply("gt", x, zero), zero, one)
    # sign(x) is x itself where it is neither positive nor negative: 0, -0 or NaN.
    below = graph.select(graph.apply("lt", x, zero), x, -one)
    return graph.select(graph.apply("gt", x, zero), below, one)


# π/2 as a sum of three parts (Cody-Waite range reduction). The first two have so few bits that
# their products with a whole number are exact, so subtracting quarter turns loses no precision.
_COARSE = np.float64(1.5703125)
_FINE = np.float64((np.float32(np.pi / 2 - _COARSE).view(np.uint32) & 0xFFFFE000).view(np.float32))
_QUARTER_TURN = [np.float32(part) for part in (_COARSE, _FINE, np.pi / 2 - _COARSE - _FINE)]


class _Polynomial(NamedTuple):
    """A `_Polynomial` interpolates a function in an interval, once a program needs it."""

    function: Callable[[np.ndarray], np.ndarray]
    degree: int
    low: float
    high: float


@functools.cache
def _coefficients(polynomial: _Polynomial) -> list[np.float32]:
    """Return the coefficients of a polynomial, lowest first."""
    function, degree, *domain = polynomial
    # Interpolation at Chebyshev's points is close to the best polynomial of its degree, with almost
    # the same error everywhere in the interval. Horner's scheme needs the coefficients of powers.
    fit = np.polynomial.Chebyshev.interpolate(function, degree, domain=domain)
    power = fit.convert(kind=np.polynomial.Polynomial, domain=[-1, 1], window=[-1, 1])
    return [np.float32(c) for c in power.coef]


def _horner(graph: ExprGraph, polynomial: _Polynomial, x: Scalar) -> Scalar:
    """Return the value of a polynomial."""
    coefficients = _coefficients(polynomial)
    total: Scalar = coefficients[-1]
    for coefficient in reversed(coefficients[:-1]):
        total = graph.apply("add", graph.apply("mul", total, x), coefficient)
    return total


# sin(r)/r and cos(r) are polynomials in s = r², for |r| up to π/4. NumPy's sinc(x) is sin(πx)/(πx).
_SINE = _Polynomial(lambda s: np.sinc(np.sqrt(s) / np.pi), 4, 0.0, (np.pi / 4) ** 2)  # sin(r)/r
_COSINE = _Polynomial(lambda s: np.cos(np.sqrt(s)), 5, 0.0, (np.pi / 4) ** 2)


def _simplify_sine(graph: ExprGraph, dtype: np.dtype, x: Scalar, ahead: int = 0) -> Scalar:
    """Expand sin(x + ahead π/2) to basic arithmetic, equal on every machine.

    If the graph's numbers are finite, |x| is at most 10⁴; otherwise any number.
    """
    # Reduce the angle to r = x - turns π/2, with |r| at most π/4.
    do = graph.apply
    if graph.finite:
        turns = do("floor", do("add", do("mul", x, np.float32(2 / np.pi)), np.float32(0.5)))
        # r = x - turns · (coarse + fine + finest): the products with the first two parts are exact.
        r = x
        for part in _QUARTER_TURN:
            r = do("sub", r, do("mul", turns, part))
    else:
        # Beyond, neighbouring numbers are thousands of turns apart; infinity becomes NaN.
        is_angle = do("lt", do("abs", x), np.float32(2**50))
        x = graph.select(is_angle, do("mul", x, np.float32(0)), x)
        turns, r = do("quarter_turns", x), do("angle_rest", x)
    s = do("mul", r, r)

    def modulo(count: Scalar, of: float) -> Scalar:
        whole = do("floor", do("mul", count, np.float32(1 / of)))
        return do("sub", count, do("mul", whole, np.float32(of)))

    # Evaluate both polynomials, and select value and sign by the quadrant.
    sine, cosine = do("mul", r, _horner(graph, _SINE, s)), _horner(graph, _COSINE, s)
    # sin(r + k π/2) is sin r, cos r, -sin r, -cos r for k = 0, 1, 2, 3.
    quarter = modulo(do("add", turns, np.float32(ahead)), 4.0)
    odd = do("ge", modulo(quarter, 2.0), np.float32(1))
    value = graph.select(odd, sine, cosine)
    return graph.select(do("ge", quarter, np.float32(2)), value, do("neg", value))


_LN2 = float(np.log(2.0))
# ln 2 as a sum of two parts. The first has so few bits that its product with an exponent is exact.
_LN2_COARSE = np.float32(round(_LN2 * 2**14) / 2**14)
_LN2_FINE = np.float32(_LN2 - float(_LN2_COARSE))
_EXP = _Polynomial(np.exp, 6, -_LN2 / 2, _LN2 / 2)
_ROOT = float(np.sqrt(2.0))
_LOG_END = ((_ROOT - 1.0) / (_ROOT + 1.0)) ** 2
# atanh(t)/t in s = t², and tanh(x)/x in s = x².
_ARTANH = _Polynomial(lambda s: np.arctanh(np.sqrt(s)) / np.sqrt(s), 3, 1e-12 * _LOG_END, _LOG_END)
# expm1(x)/x
_EXPM1_END = 0.5
_EXPM1 = _Polynomial(lambda x: np.expm1(x) / x, 7, -_EXPM1_END, _EXPM1_END + 1e-9)
_TANH_END = 0.6
_TANH = _Polynomial(lambda s: np.tanh(np.sqrt(s)) / np.sqrt(s), 5, 1e-12, _TANH_END**2)
# atan(t)/t in s = t², for t up to tan(π/8).
_ATAN_END = float(np.tan(np.pi / 8))
_ATAN = _Polynomial(lambda s: np.arctan(np.sqrt(s)) / np.sqrt(s), 5, 1e-12, _ATAN_END**2)
# For w = -log(1 - x²), erf⁻¹(x)/x is a polynomial in w up to `_ERF_INV_NEAR`, and one in √w up to
# `_ERF_INV_FAR`; beyond, float32 has no x below 1.
_ERF_INV_NEAR = 5.0
_ERF_INV_FAR = 16.7
_ERF_INV_CENTRE = float((np.sqrt(_ERF_INV_NEAR) + np.sqrt(_ERF_INV_FAR)) / 2)


def _simplify_exp(graph: ExprGraph, dtype: np.dtype, x: Scalar) -> Scalar:
    """Expand exp(x) to basic arithmetic; where the result is subnormal, it is 0."""
    # exp(x) = 2^n exp(r) with |r| at most ln(2)/2, where n is x / ln(2) rounded. Near 1.5 · 2^23,
    # neighbouring float32 differ by 1: so the sum is rounded to a whole number, and its last bits
    # are those of n.
    do = graph.apply
    rounding = np.float32(1.5 * 2**23)
    rounded = do("add", do("mul", x, np.float32(1 / _LN2)), rounding)
    n = do("sub", rounded, rounding)
    r = do("sub", do("sub", x, do("mul", n, _LN2_COARSE)), do("mul", n, _LN2_FINE))
    # Multiply by 2^n: add n to the exponent, which begins at bit 23 of a float32.
    shifted = do("shift_left", do("bitcast", rounded), np.int32(23))
    result = do("bitcast", do("add", do("bitcast", _horner(graph, _EXP, r)), shifted))
    result = graph.select(do("lt", x, np.float32(-87.336)), result, np.float32(0))
    # Infinity where the result is too large for float32, and NaN of NaN: both are x · ∞.
    beyond = do("mul", x, np.float32(np.inf))
    return graph.select(do("lt", x, np.float32(88.722839)), beyond, result)


def _simplify_expm1(graph: ExprGraph, dtype: np.dtype, x: Scalar) -> Scalar:
    """Expand exp(x) - 1 to basic arithmetic."""
    do = graph.apply
    # exp(x) - 1 would lose all digits near 0; there, x times a polynomial keeps them.
    near = do("mul", x, _horner(graph, _EXPM1, x))
    far = do("sub", do("exp", x), np.float32(1))
    return graph.select(do("lt", do("abs", x), np.float32(_EXPM1_END)), far, near)


def _simplify_log(graph: ExprGraph, dtype: np.dtype, x: Scalar) -> Scalar:
    """Expand log(x) to basic arithmetic; subnormal numbers are taken for 0."""
    # x = 2^n m with m from √½ to √2, and log(m) = 2 artanh((m - 1) / (m + 1)).
    do = graph.apply
    bits = do("bitcast", x)
    # The bits of a positive float32 are 8 bits e and 23 bits f, and its value is 2^(e - 127) · 1.f.
    # So n is e - 127, and m has the bits of x with the exponent 127 in place of e.
    n = graph.convert(do("shift_right_logical", bits, np.int32(23)), _FLOAT)
    n = do("sub", n, np.float32(127))
    m = do("bitcast", do("or", do("and", bits, np.int32((1 << 23) - 1)), np.int32(127 << 23)))
    # If m is above √2, take m/2 and n + 1: so m is near 1, and a short polynomial is enough.
    is_high = do("gt", m, np.float32(_ROOT))
    m = graph.select(is_high, m, do("mul", m, np.float32(0.5)))
    n = graph.select(is_high, n, do("add", n, np.float32(1)))
    series = _log_near_one(graph, do("sub", m, np.float32(1)))
    result = do("add", do("mul", n, _LN2_COARSE), do("add", do("mul", n, _LN2_FINE), series))
    # log 0 is -∞, and that of a negative number NaN.
    smallest = np.finfo(np.float32).tiny
    result = graph.select(do("lt", x, smallest), result, np.float32(-np.inf))
    result = graph.select(do("lt", x, np.float32(0)), result, np.float32(np.nan))
    # Infinity and NaN are their own logarithms.
    return graph.select(do("lt", x, np.float32(np.inf)), x, result)


def _log_near_one(graph: ExprGraph, x: Scalar) -> Scalar:
    """Expand log(1 + x) to basic arithmetic, for 1 + x from √½ to √2."""
    do = graph.apply
    # log(1 + x) = 2 artanh(t), t = x / (x + 2); 2 t is not smaller than the smallest x.
    double = do("div", do("add", x, x), do("add", x, np.float32(2)))
    t = do("mul", double, np.float32(0.5))
    return do("mul", double, _horner(graph, _ARTANH, do("mul", t, t)))


def _simplify_log1p(graph: ExprGraph, dtype: np.dtype, x: Scalar) -> Scalar:
    """Expand log(1 + x) to basic arithmetic."""
    do = graph.apply
    # The sum 1 + x would lose the last digits of a small x, and the series in x does not. It holds
    # for 1 + x from √½ to √2, that is for x between -0.29 and 0.41.
    far = do("log", do("add", x, np.float32(1)))
    is_near = do("lt", do("abs", do("sub", x, np.float32(0.06))), np.float32(0.35))
    return graph.select(is_near, far, _log_near_one(graph, x))


def _simplify_tanh(graph: ExprGraph, dtype: np.dtype, x: Scalar) -> Scalar:
    """Expand tanh(x) to basic arithmetic."""
    do = graph.apply
    # Near 0, x times a polynomial; beyond, tanh|x| = 1 - 2 / (exp(2|x|) + 1), which is 1 when exp
    # is infinite.
    near = do("mul", x, _horner(graph, _TANH, do("mul", x, x)))
    size = do("abs", x)
    grown = do("add", do("exp", do("add", size, size)), np.float32(1))
    far = do("sub", np.float32(1), do("div", np.float32(2), grown))
    far = graph.select(do("lt", x, np.float32(0)), far, do("neg", far))
    return graph.select(do("lt", size, np.float32(_TANH_END)), far, near)


def _simplify_atan2(graph: ExprGraph, dtype: np.dtype, y: Scalar, x: Scalar) -> Scalar:
    """Expand atan2(y, x) to basic arithmetic, with the sign of y even if it is zero."""
    do = graph.apply
    # The angle from the nearest axis is atan(t) with t up to 1, or π/4 + atan((t - 1) / (t + 1)).
    across, along = do("abs", y), do("abs", x)
    small, large = do("min", across, along), do("max", across, along)
    t = do("div", small, large)
    # 0 / 0: the angle of the origin is 0.
    t = graph.select(do("eq", large, np.float32(0)), t, np.float32(0))
    # Infinity in both directions is halfway between them.
    t = graph.select(do("eq", small, np.float32(np.inf)), t, np.float32(1))
    beyond = do("gt", t, np.float32(_ATAN_END))
    turned = do("div", do("sub", t, np.float32(1)), do("add", t, np.float32(1)))
    # In both cases |u| is at most tan(π/8), so one polynomial serves both.
    u = graph.select(beyond, t, turned)
    angle = do("mul", u, _horner(graph, _ATAN, do("mul", u, u)))
    angle = graph.select(beyond, angle, do("add", angle, np.float32(np.pi / 4)))
    # This is the angle from the nearest axis: reflect it at the diagonal if that is the axis of y,
    # and at the axis of y if x is negative.
    steep = do("gt", across, along)
    angle = graph.select(steep, angle, do("sub", np.float32(np.pi / 2), angle))
    # Test the sign bit, because -0 is not less than 0 but counts as negative here.
    backwards = do("lt", do("bitcast", x), np.int32(0))
    angle = graph.select(backwards, angle, do("sub", np.float32(np.pi), angle))
    return graph.select(do("lt", do("bitcast", y), np.int32(0)), angle, do("neg", angle))


def _simplify_erf_inv(graph: ExprGraph, dtype: np.dtype, x: Scalar) -> Scalar:
    """Expand the inverse of the error function to basic arithmetic.

    Source: M. Giles, Approximating the erfinv function, GPU Computing Gems 2 (2010), for the form
    x p(w) with w = -log(1 - x²); the polynomials are interpolated here.
    """
    do = graph.apply
    # Compute 1 - x² as (1 - x)(1 + x). Near ±1, where it is small, this loses no digits: the small
    # factor is exact.
    w = do("neg", do("log", do("mul", do("sub", np.float32(1), x), do("add", x, np.float32(1)))))
    # Evaluate both polynomials, around the centres of their intervals, where powers stay small.
    near, far = _inverse_error_polynomials()
    inside = _horner(graph, near, do("sub", w, np.float32(_ERF_INV_NEAR / 2)))
    root = do("sub", do("sqrt", w), np.float32(_ERF_INV_CENTRE))
    factor = graph.select(do("lt", w, np.float32(_ERF_INV_NEAR)), _horner(graph, far, root), inside)
    result = do("mul", x, factor)
    # erf⁻¹(±1) is ±∞.
    is_end = do("eq", do("abs", x), np.float32(1))
    return graph.select(is_end, result, do("mul", x, np.float32(np.inf)))


@functools.cache
def _inverse_error_polynomials() -> tuple[_Polynomial, _Polynomial]:
    """Return polynomials of erf⁻¹(x)/x in w and in √w, around the centres of their intervals."""
    # Imported late, because few programs draw normal numbers.
    from scipy import special

    def factor(w: np.ndarray) -> np.ndarray:
        # 1 - x = 1 - √(1 - e^-w), without cancellation.
        x = np.sqrt(-np.expm1(-w))
        return special.erfcinv(np.exp(-w) / (1 + x)) / x

    near = _Polynomial(
        lambda d: factor(d + _ERF_INV_NEAR / 2), 8, 1e-9 - _ERF_INV_NEAR / 2, _ERF_INV_NEAR / 2
    )
    half = (np.sqrt(_ERF_INV_FAR) - np.sqrt(_ERF_INV_NEAR)) / 2
    far = _Polynomial(lambda d: factor((d + _ERF_INV_CENTRE) ** 2), 8, -half, half)
    return near, far


_SIMPLIFY: dict[str, Callable[..., Scalar | None]] = {
    **{op: functools.partial(_simplify_commutative, op=op) for op in _COMMUTATIVE},
    # A sum of derivatives.
    "add_any": lambda graph, dtype, x, y: graph.apply("add", x, y),
    "atan2": _simplify_atan2,
    "cos": functools.partial(_simplify_sine, ahead=1),
    "div": _simplify_div,
    "erf_inv": _simplify_erf_inv,
    "exp": _simplify_exp,
    "expm1": _simplify_expm1,
    "log": _simplify_log,
    "log1p": _simplify_log1p,
    "neg": _simplify_inverse("neg"),
    "not": _simplify_not,
    "pow": _simplify_pow,
    "rem": _simplify_rem,
    **{
        op: functools.partial(_simplify_shift, op=op)
        for op in ("shift_left", "shift_right_logical")
    },
    "sign": _simplify_sign,
    "sin": _simplify_sine,
    "sub": _simplify_sub,
    "tanh": _simplify_tanh,
}
"""Functions that return an equal but simpler scalar; None: there is none."""


def _approximate_div(graph: ExprGraph, dtype: np.dtype, x: Scalar, y: Scalar) -> Scalar | None:
    """Divide by a product with the reciprocal, which all quotients of one divisor share."""
    # Some quotients need no reciprocal at all, such as those by a constant.
    simplified = _simplify_div(graph, dtype, x, y)
    if simplified is not None or dtype != _FLOAT:
        return simplified
    return graph.apply("mul", x, graph.apply("reciprocal", y))


def _approximate_tanh(graph: ExprGraph, dtype: np.dtype, x: Scalar) -> Scalar:
    """Expand tanh(x) = 2 / (1 + exp(-2x)) - 1."""
    do = graph.apply
    grown = do("add", do("exp", do("mul", x, np.float32(-2))), np.float32(1))
    return do("sub", do("mul", do("reciprocal", grown), np.float32(2)), np.float32(1))


_APPROXIMATE: dict[str, Callable[..., Scalar | None]] = {
    # Instructions of their own.
    **dict.fromkeys(("exp", "log"), lambda graph, dtype, x: None),
    # Functions of these.
    "div": _approximate_div,
    "expm1": lambda graph, dtype, x: graph.apply("sub", graph.apply("exp", x), np.float32(1)),
    "log1p": lambda graph, dtype, x: graph.apply("log", graph.apply("add", x, np.float32(1))),
    "tanh": _approximate_tanh,
}
"""Functions that replace those of `_SIMPLIFY` in an approximate graph, whose `exp`, `log` and
`reciprocal` are instructions of a GPU with a relative error of about 2⁻²². For x near 0, expm1,
log1p and tanh have that as an absolute error, and so lose digits."""
