"""Record arithmetic on scalars as a graph of operations.

An `ExprGraph` folds operations on constants, records equal operations once, and removes products
with zero. Most entries of the matrices of physics are zeros, so most of the arithmetic disappears.
A `Loop` and a `Branch` are recorded as units; `schedule` decides in which block of the program each
operation is computed.

Scalars are in registers, which are chosen when the program is written. Where an index is known only
when it runs, the scalars it chooses from are in memory instead, in an array of the instance's own:
one that holds given scalars (`ExprGraph.array`), or one to which a loop adds a scalar in every
iteration (`Loop.stacked`). Both are operations whose value is an address, and which only
`ExprGraph.load` takes as an operand. An array is never changed after it is complete, so loads have
no order among each other.

Three simplifications hold for finite numbers only: 0·x, 0/x and x - x are 0. A graph for numbers
that may be infinite or NaN goes without them, and reduces angles of any size.

The rules that simplify or replace operations are in `simplify`, which passes them to a new graph
(`simplify.make_graph`).
"""

import dataclasses
import itertools
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Union, cast

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
    """dtype of the result, or of the scalars of an array, one of `DTYPES`."""
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

_INT, _BOOL = np.dtype(np.int32), np.dtype(bool)
_WORD, _LONG = np.dtype(np.uint32), np.dtype(np.uint64)

DTYPES = tuple(map(np.dtype, ("bool", "float32", "int32", "uint32", "float64", "int64", "uint64")))
"""All dtypes that scalars have; arrays have all but the first."""


_ROUNDING = ({"f", "i"}, {"f", "u"})
"""Kinds of a float32 and an integer of 64 bits, of which the latter is no exact copy."""


def bits_of(dtype: np.dtype) -> int:
    """Return the number of bits of a number in memory: a bool is there an int32."""
    return 32 if dtype == _BOOL else 8 * dtype.itemsize


def same_size(kind: str, dtype: np.dtype) -> np.dtype:
    """Return the dtype of a kind, such as `i`, whose numbers have as many bits as another one."""
    return np.dtype(f"{kind}{bits_of(dtype) // 8}")


def _divide(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    if a.dtype.kind == "f":
        return np.divide(a, b)
    # By 0, JAX returns the number whose bits are all set.
    divisor = np.where(b == 0, b.dtype.type(1), b)
    quotient = np.floor_divide(a, divisor)
    # NumPy rounds down, JAX towards 0.
    is_lower = (np.remainder(a, divisor) != 0) & ((a < 0) != (divisor < 0))
    return np.where(b == 0, ~a.dtype.type(0), quotient + is_lower.astype(a.dtype))


def _rest(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    if a.dtype.kind == "f":
        return np.fmod(a, b)
    return np.where(b == 0, a, np.fmod(a, np.where(b == 0, b.dtype.type(1), b)))


def convert_constant(x: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """Convert to another dtype; integers saturate at their limits, and NaN becomes 0."""
    if x.dtype.kind == "f" and np.dtype(dtype).kind in "iu":
        ends = np.iinfo(dtype)
        wide = np.nan_to_num(x.astype(np.float64), posinf=np.inf, neginf=-np.inf)
        # The largest integers of 64 bits are no float64: the next power of 2 is.
        is_above, is_below = wide >= float(ends.max), wide <= float(ends.min)
        inside = np.where(is_above | is_below, 0.0, wide).astype(dtype)
        below = np.where(is_below, dtype.type(ends.min), inside)
        return np.where(is_above, dtype.type(ends.max), below)
    if x.dtype.itemsize > dtype.itemsize:
        with np.errstate(over="ignore"):
            return x.astype(dtype)
    return x.astype(dtype)


def _bitcast(x: np.ndarray) -> np.ndarray:
    return x.view(same_size("i" if x.dtype.kind == "f" else "f", x.dtype))


def _fused(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Return a · b + c, rounded as if it had been computed with twice the digits.

    Source: T. J. Dekker, A floating-point technique for extending the available precision, 1971.
    """
    if a.dtype == np.float32:
        wide = np.asarray(a, np.float64) * b.astype(np.float64) + c
        return wide.astype(np.float32)

    def halves(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        scaled = x * float(2**27 + 1)
        high = scaled - (scaled - x)
        return high, x - high

    (a1, a2), (b1, b2) = halves(a), halves(b)
    product = a * b
    error = a2 * b2 - (((product - a1 * b1) - a2 * b1) - a1 * b2)
    total = product + c
    added = total - product
    rest = (product - (total - added)) + (c - added) + error
    # The halves of the largest numbers overflow.
    return total + np.where(np.isfinite(rest), rest, 0.0)


def _reduced(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return an angle's nearest number of quarter turns, modulo 4, and the angle that is left."""
    # In float64, π/2 is exact to far more digits than the result needs.
    wide = x.astype(np.float64)
    angle = np.arctan2(np.sin(wide), np.cos(wide))
    turns = np.round(angle * (2 / np.pi))
    return np.mod(turns, 4).astype(x.dtype), (angle - turns * (np.pi / 2)).astype(x.dtype)


def _shift_right_logical(x: np.ndarray, by: np.ndarray) -> np.ndarray:
    unsigned = same_size("u", x.dtype)
    return (x.view(unsigned) >> by.view(unsigned)).view(x.dtype)


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
    "fma": _fused,
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
    "rotate_left": lambda x, by: (x << by) | (x >> (x.dtype.type(bits_of(x.dtype)) - by)),
    "round": np.round,
    "shift_left": np.left_shift,
    "shift_right_logical": _shift_right_logical,
    "sign": np.sign,
    "sin": np.sin,
    "sqrt": np.sqrt,
    "sub": np.subtract,
    "tanh": np.tanh,
    "xor": np.bitwise_xor,
}
"""The NumPy function of every operation except `select` and `convert`. `bitcast` takes the bits of
a float for an integer with a sign, or the other way round; `fma` is a · b + c, rounded once;
`round` rounds to the nearest whole number, and half of one to the nearest even. For a float32 angle
up to 2⁵⁰ and a float64 one from 1/4 on, `quarter_turns` is the nearest number of quarter turns,
modulo 4, and `angle_rest` the angle that is left, between -π/4 and π/4."""

MAX_OPERATIONS = 1_000_000
"""Largest number of recorded operations, including those that nothing depends on."""

# Operations whose operands may be exchanged: a + b and b + a are recorded once.
COMMUTATIVE = ("add", "and", "eq", "max", "min", "mul", "ne", "or", "xor")


Simplify = Callable[..., Scalar | None]
"""Takes the graph, the operands' dtype and the operands, and returns an equal but simpler scalar or
a formula of basic operations; None: there is none."""


class ExprGraph:
    """An `ExprGraph` records operations on scalars, each of them once."""

    def __init__(
        self, simplifications: Mapping[str, Simplify], *, finite: bool, skips: bool = False
    ) -> None:
        """Start with an empty graph.

        Args:
          simplifications: a function for each operation that may be an equal but simpler scalar.
          finite: whether all numbers are finite, and angles at most 10⁴.
          skips: whether matrix products skip what is multiplied by a truth value that is false.
        """
        self.finite, self.skips = finite, skips
        self._simplifications = simplifications
        self._values: dict[tuple[Hashable, ...], Expr] = {}
        self._made: dict[tuple[str, int], list[Scalar]] = {}
        self.count = 0
        """Number of recorded operations."""

    def is_exact(self, dtype: np.dtype) -> bool:
        """Return whether a rule for finite numbers, such as 0·x = 0, holds for a dtype here."""
        return self.finite or dtype.kind != "f"

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
        if operand_dtype not in DTYPES or any(x.dtype != operand_dtype for x in operands):
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
            dtype = same_size("i" if dtype.kind == "f" else "f", dtype)
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
        if x.dtype == dtype:
            return x
        if dtype not in DTYPES:
            raise UnsupportedError(f"a conversion to {dtype}")
        # A conversion between integers of one size keeps the bits: there and back, nothing changes.
        # So does a number of 32 bits that 64 bits hold without rounding.
        if x.op == "convert" and x.operands[0].dtype == dtype:
            kinds, rest = {x.dtype.kind, dtype.kind}, x.dtype.itemsize - dtype.itemsize
            if (not rest and kinds == {"i", "u"}) or (rest == 4 and kinds not in _ROUNDING):
                return x.operands[0]
        if dtype == _BOOL:
            return self.apply("ne", x, x.dtype.type(0))
        # A truth value that a loop has stacked is 0 or 1 in memory: there and back, it is the same.
        if x.op == "ne" and dtype == _INT and _is_stacked_truth(x.operands[0]):
            return x.operands[0]
        return self._record("convert", (x,), dtype)

    def halves(self, x: Scalar) -> tuple[Scalar, Scalar]:
        """Return the lower and the higher 32 bits of a uint64, as uint32."""
        high = self.apply("shift_right_logical", x, np.uint64(32))
        return self.convert(x, _WORD), self.convert(high, _WORD)

    def joined(self, low: Scalar, high: Scalar) -> Scalar:
        """Return the uint64 of its lower and its higher 32 bits, uint32."""
        shifted = self.apply("shift_left", self.convert(high, _LONG), np.uint64(32))
        return self.apply("or", shifted, self.convert(low, _LONG))

    def repeat(self, value: Expr, operands: Sequence[Scalar]) -> Expr:
        """Record an operation again with other operands, without simplifying it."""
        return self._record(value.op, tuple(operands), value.dtype)

    def once(self, name: str, x: Expr, make: Callable[[], list[Scalar]]) -> list[Scalar]:
        """Return what `make` records of one scalar under a name, and record it only once."""
        if (name, x.index) not in self._made:
            self._made[name, x.index] = make()
        return self._made[name, x.index]

    def array(self, scalars: Sequence[Scalar]) -> Expr:
        """Record an array of at least one scalar, all of one dtype, which is not bool."""
        first = scalars[0]
        if first.dtype not in DTYPES[1:] or any(x.dtype != first.dtype for x in scalars):
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
                and equals(x.operands[1], i)
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
            if array.dtype.kind == "i" and all(map(equals, array.operands, itertools.count())):
                return self.convert(index, array.dtype)
        elif is_constant(index):
            # Of such loads there are hundreds of thousands: take the shortest way.
            key = ("load", array.index, int(index))
            if key not in self._values:
                self._values[key] = self._new("load", (array, index), array.dtype)
            return self._values[key]
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
        key = (op, dtype, *(sorted(names, key=repr) if op in COMMUTATIVE else names))
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


def bytes_of(array: Expr) -> int:
    """Return the bytes of memory of an `array` or `stack`."""
    return length_of(array) * bits_of(array.dtype) // 8


def is_table(array: Expr) -> bool:
    """Return whether an array consists of constants, so that all instances can share it."""
    return array.op == "array" and all(map(is_constant, array.operands))


def _is_stacked_truth(x: Scalar) -> bool:
    """Return whether a scalar is loaded from where a loop has stored a truth value."""
    array = x.operands[0] if isinstance(x, Expr) and x.op == "load" else None
    if not (isinstance(array, Expr) and isinstance(array.owner, Loop)):
        return False
    stored = array.owner.stacked[array.place]
    return (
        isinstance(stored, Expr)
        and stored.op == "convert"
        and stored.operands[0].dtype == _BOOL
        and stored.dtype == _INT
    )


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


def equals(x: Scalar, number: float) -> bool:
    """Return whether a scalar is a constant of this value."""
    return is_constant(x) and x == number
