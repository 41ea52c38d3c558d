"""Record arithmetic on scalars as a graph of operations.

An `ExprGraph` records operations on scalars. Operations on constants are computed at once, an
operation that was recorded before is not recorded again, and products with zero are removed: most
entries of the matrices of a robot's physics are zeros, so most of the arithmetic disappears. A
`Loop` and a `Branch` are recorded as wholes; where each operation is done, `schedule` decides.

Two rules hold for finite numbers only: 0·x is 0, and x - x is 0.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np


class UnsupportedError(Exception):
    """Raised when a JAX function cannot be written as arithmetic on scalars."""


Scalar = Any
"""An `Expr`, or a NumPy scalar where the number is known."""


class Expr:
    """A scalar that is known only when the program runs."""

    __slots__ = ("dtype", "index", "op", "operands", "owner", "place")

    def __init__(
        self,
        op: str,
        operands: tuple[Scalar, ...],
        dtype: np.dtype,
        index: int,
        owner: "Loop | Branch | None" = None,
        place: int = 0,
    ) -> None:
        """Describe one operation.

        Args:
          op: its name, as in `jax.lax`; `input` for what the program is given, `carry` for what a
            loop hands from trip to trip, `result` for what a loop or a branch ends with.
          operands: numbers that it takes.
          dtype: dtype of the result: float32, int32 or bool.
          index: place in the order of recording; operands have smaller ones.
          owner: of a `carry` or a `result`: the loop or branch.
          place: of a `carry` or a `result`: which of them it is.
        """
        self.op = op
        self.operands = operands
        self.dtype = dtype
        self.index = index
        self.owner = owner
        self.place = place


@dataclasses.dataclass(eq=False)
class Loop:
    """A loop over scalars that are computed again as long as a condition on them holds."""

    index: int
    """Place in the order of recording, after all that a trip computes."""
    carries: list[Expr]
    """The values that an iteration begins with."""
    first: list[Scalar]
    """The values that the first iteration begins with."""
    following: list[Scalar] = dataclasses.field(default_factory=list)
    """The values that the next iteration begins with."""
    going: Scalar = None
    """Whether there is another iteration, as a function of `carries`."""
    outcomes: list[Scalar] = dataclasses.field(default_factory=list)
    """What the loop ends with, of the `carries` for which there is no trip."""


@dataclasses.dataclass(eq=False)
class Branch:
    """A branch of which only one side is computed."""

    index: int
    """Place in the order of recording, after all that either side computes."""
    which: Scalar
    """Which side."""
    no: list[Scalar]
    yes: list[Scalar]


def is_constant(x: Scalar) -> bool:
    """Return whether a scalar is a constant."""
    return not isinstance(x, Expr)


COMPARISONS = ("lt", "le", "gt", "ge", "eq", "ne")

_FLOAT, _INT, _BOOL = np.dtype(np.float32), np.dtype(np.int32), np.dtype(bool)


def _divide(a: Any, b: Any) -> Any:
    if a.dtype.kind == "f":
        return np.divide(a, b)
    return np.trunc(np.divide(a, b)).astype(a.dtype)


def converted(x: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """Convert to another dtype; integers saturate at their limits, and NaN becomes 0."""
    if x.dtype.kind == "f" and np.dtype(dtype).kind in "iu":
        ends = np.iinfo(dtype)
        finite = np.nan_to_num(x.astype(np.float64), posinf=np.inf, neginf=-np.inf)
        return np.clip(finite, ends.min, ends.max).astype(dtype)
    return x.astype(dtype)


EVALUATE: dict[str, Callable[..., Any]] = {
    "abs": np.abs,
    "add": np.add,
    "and": np.bitwise_and,
    "atan2": np.arctan2,
    "cos": np.cos,
    "div": _divide,
    "eq": np.equal,
    "exp": np.exp,
    "floor": np.floor,
    "ge": np.greater_equal,
    "gt": np.greater,
    "is_finite": np.isfinite,
    "le": np.less_equal,
    "log": np.log,
    "lt": np.less,
    "max": np.maximum,
    "min": np.minimum,
    "mul": np.multiply,
    "ne": np.not_equal,
    "neg": np.negative,
    "not": np.bitwise_not,
    "or": np.bitwise_or,
    "pow": np.power,
    "rem": np.fmod,
    "sign": np.sign,
    "sin": np.sin,
    "sqrt": np.sqrt,
    "sub": np.subtract,
    "tanh": np.tanh,
    "xor": np.bitwise_xor,
}
"""Every operation but `select` and `convert`, as NumPy does it."""

MOST_VALUES = 1_000_000
"""Operations that are recorded at most, those that nothing needs included."""

_COMMUTATIVE = ("add", "and", "eq", "max", "min", "mul", "ne", "or", "xor")


class ExprGraph:
    """An `ExprGraph` records operations on scalars, each of them once."""

    def __init__(self) -> None:
        """Start with an empty graph."""
        self._values: dict[tuple[Any, ...], Expr] = {}
        self._count = 0

    def input(self, dtype: np.dtype) -> Expr:
        """Add an input of the program."""
        return self._record("input", (np.int32(self._count),), np.dtype(dtype))

    def apply(self, op: str, *operands: Scalar) -> Scalar:
        """Record one operation, or return its result if all operands are constants.

        Args:
          op: a name in `EVALUATE`.
          *operands: scalars of one dtype.

        Returns:
          The number.

        Raises:
          UnsupportedError: the operation or the dtype is not known here.
        """
        if op not in EVALUATE:
            raise UnsupportedError(f"the operation {op}")
        if all(is_constant(x) for x in operands):
            with np.errstate(all="ignore"):
                return np.asarray(EVALUATE[op](*operands))[()]
        kind = next(x.dtype for x in operands if not is_constant(x))
        if kind not in (_FLOAT, _INT, _BOOL):
            raise UnsupportedError(f"{op} of {kind}")
        shorter = _SHORTER.get(op, _unchanged)(self, kind, *operands)
        if shorter is not None:
            return shorter
        dtype = _BOOL if op in COMPARISONS or op == "is_finite" else kind
        return self._record(op, operands, dtype)

    def select(self, which: Scalar, on_false: Scalar, on_true: Scalar) -> Scalar:
        """Select one of two scalars of one dtype by a bool scalar."""
        if is_constant(which):
            return on_true if which else on_false
        if on_false is on_true or (_known_and(on_true, on_false) and on_false == on_true):
            return on_false
        if which.op == "not":
            return self.select(which.operands[0], on_true, on_false)
        dtype = on_true.dtype
        if dtype == _BOOL:
            # which & on_true | ~which & on_false
            yes = self.apply("and", which, on_true)
            return self.apply("or", yes, self.apply("and", self.apply("not", which), on_false))
        return self._record("select", (which, on_false, on_true), dtype)

    def convert(self, x: Scalar, dtype: np.dtype) -> Scalar:
        """Convert a scalar to another dtype."""
        if is_constant(x):
            return converted(np.asarray(x), dtype)[()]
        # Without 64-bit types, as JAX has them by default, only these are met.
        if dtype not in (_FLOAT, _INT, _BOOL):
            raise UnsupportedError(f"a conversion to {dtype}")
        if x.dtype == dtype:
            return x
        if dtype == _BOOL:
            return self.apply("ne", x, x.dtype.type(0))
        return self._record("convert", (x,), dtype)

    def repeat(self, value: Expr, operands: Sequence[Scalar]) -> Expr:
        """Record an operation again with other operands, without simplifying it."""
        return self._record(value.op, tuple(operands), value.dtype)

    def begin_loop(self, first: Sequence[Scalar]) -> Loop:
        """Begin a loop; the operations of its iterations are recorded before `end_loop`."""
        loop = Loop(-1, [], list(first))
        for place, number in enumerate(first):
            loop.carries.append(self._new("carry", (), number.dtype, loop, place))
        return loop

    def end_loop(self, loop: Loop) -> list[Expr]:
        """End a loop whose attributes are all set except `index`, and return its results."""
        loop.index = self._next()
        return [
            self._new("result", (), number.dtype, loop, place)
            for place, number in enumerate(loop.outcomes)
        ]

    def branch(self, which: Expr, no: Sequence[Scalar], yes: Sequence[Scalar]) -> list[Scalar]:
        """Record a branch, of which only the selected side is computed, and return its results."""
        branch = Branch(self._next(), which, list(no), list(yes))
        return [
            b if is_same(a, b) else self._new("result", (), b.dtype, branch, place)
            for place, (a, b) in enumerate(zip(no, yes, strict=True))
        ]

    @property
    def count(self) -> int:
        """Return the number of recorded operations."""
        return self._count

    def _record(self, op: str, operands: tuple[Scalar, ...], dtype: np.dtype) -> Expr:
        names = [_identity(x) for x in operands]
        # Found in whichever order, but kept as given: what is recorded twice in the same way looks
        # the same.
        key = (op, dtype, *(sorted(names, key=repr) if op in _COMMUTATIVE else names))
        if key not in self._values:
            self._values[key] = self._new(op, operands, dtype)
        return self._values[key]

    def _new(self, op: str, operands: tuple[Scalar, ...], dtype: np.dtype, *owner: Any) -> Expr:
        return Expr(op, operands, dtype, self._next(), *owner)

    def _next(self) -> int:
        if self._count >= MOST_VALUES:
            raise UnsupportedError(f"more than {MOST_VALUES:,} operations")
        self._count += 1
        return self._count - 1


def is_same(x: Scalar, y: Scalar) -> bool:
    """Return whether two scalars are the same operation, or constants with equal bits."""
    return x is y or (_known_and(x, y) and _identity(x) == _identity(y))


def _identity(x: Scalar) -> Any:
    # By bits, or 0.0 would be -0.0, and NaN not itself.
    return x.index if isinstance(x, Expr) else (x.dtype.str, x.tobytes())


def _known_and(x: Scalar, *others: Scalar) -> bool:
    return is_constant(x) and all(is_constant(other) for other in others)


def _is(x: Scalar, number: float) -> bool:
    return is_constant(x) and x == number


def _unchanged(graph: ExprGraph, kind: np.dtype, *operands: Scalar) -> None:
    return None


def _simplify_add(graph: ExprGraph, kind: np.dtype, x: Scalar, y: Scalar) -> Scalar | None:
    if _is(x, 0):
        return y
    return x if _is(y, 0) else None


def _simplify_sub(graph: ExprGraph, kind: np.dtype, x: Scalar, y: Scalar) -> Scalar | None:
    if x is y:
        return kind.type(0)
    if _is(x, 0):
        return graph.apply("neg", y)
    return x if _is(y, 0) else None


def _simplify_mul(graph: ExprGraph, kind: np.dtype, x: Scalar, y: Scalar) -> Scalar | None:
    for one, other in ((x, y), (y, x)):
        if _is(one, 0):
            return kind.type(0)
        if _is(one, 1):
            return other
        if _is(one, -1):
            return graph.apply("neg", other)
    return None


def _simplify_div(graph: ExprGraph, kind: np.dtype, x: Scalar, y: Scalar) -> Scalar | None:
    if _is(x, 0):
        return kind.type(0)
    if _is(y, 1):
        return x
    if is_constant(y) and kind == _FLOAT and y != 0:
        return graph.apply("mul", x, np.float32(1 / np.float64(y)))
    return None


def _simplify_neg(graph: ExprGraph, kind: np.dtype, x: Scalar) -> Scalar | None:
    return x.operands[0] if x.op == "neg" else None


def _simplify_not(graph: ExprGraph, kind: np.dtype, x: Scalar) -> Scalar | None:
    return x.operands[0] if x.op == "not" else None


def _simplify_and(graph: ExprGraph, kind: np.dtype, x: Scalar, y: Scalar) -> Scalar | None:
    if x is y:
        return x
    for one, other in ((x, y), (y, x)):
        if kind == _BOOL and is_constant(one):
            return other if one else np.bool_(False)
    return None


def _simplify_or(graph: ExprGraph, kind: np.dtype, x: Scalar, y: Scalar) -> Scalar | None:
    if x is y:
        return x
    for one, other in ((x, y), (y, x)):
        if kind == _BOOL and is_constant(one):
            return np.bool_(True) if one else other
    return None


def _simplify_xor(graph: ExprGraph, kind: np.dtype, x: Scalar, y: Scalar) -> Scalar | None:
    for one, other in ((x, y), (y, x)):
        if kind == _BOOL and is_constant(one):
            return graph.apply("not", other) if one else other
    return None


def _simplify_extreme(graph: ExprGraph, kind: np.dtype, x: Scalar, y: Scalar) -> Scalar | None:
    return x if x is y else None


def _simplify_pow(graph: ExprGraph, kind: np.dtype, x: Scalar, y: Scalar) -> Scalar | None:
    if _is(y, 1):
        return x
    if _is(y, 2):
        return graph.apply("mul", x, x)
    return graph.apply("sqrt", x) if _is(y, 0.5) else None


def _simplify_sign(graph: ExprGraph, kind: np.dtype, x: Scalar) -> Scalar:
    zero, one = kind.type(0), kind.type(1)
    below = graph.select(graph.apply("lt", x, zero), x, -one)
    return graph.select(graph.apply("gt", x, zero), below, one)


# π/2 in three parts, of which the first two have so few bits that a whole number times them is
# exact: what is left of an angle after so many quarter turns loses nothing.
_COARSE = np.float64(1.5703125)
_FINE = np.float64((np.float32(np.pi / 2 - _COARSE).view(np.uint32) & 0xFFFFE000).view(np.float32))
_QUARTER_TURN = [np.float32(part) for part in (_COARSE, _FINE, np.pi / 2 - _COARSE - _FINE)]


def _polynomial(function: Callable[[np.ndarray], np.ndarray], degree: int) -> list[np.float32]:
    """Return a function's coefficients in s = r², lowest first, for r up to an eighth of a turn."""
    end = (np.pi / 4) ** 2
    fit = np.polynomial.Chebyshev.interpolate(
        lambda s: function(np.sqrt(s)), degree, domain=[0.0, end]
    )
    power = fit.convert(kind=np.polynomial.Polynomial, domain=[-1, 1], window=[-1, 1])
    return [np.float32(c) for c in power.coef]


_SINE = _polynomial(lambda r: np.sinc(r / np.pi), 4)  # sin(r)/r
_COSINE = _polynomial(np.cos, 5)


def _simplify_sine(graph: ExprGraph, kind: np.dtype, x: Scalar, ahead: int = 0) -> Scalar:
    """Expand a sine to basic arithmetic, equal on every machine; for |x| up to some 10⁴."""
    do = graph.apply
    turns = do("floor", do("add", do("mul", x, np.float32(2 / np.pi)), np.float32(0.5)))
    r = x
    for part in _QUARTER_TURN:
        r = do("sub", r, do("mul", turns, part))
    s = do("mul", r, r)

    def horner(coefficients: list[np.float32]) -> Scalar:
        total: Scalar = coefficients[-1]
        for coefficient in reversed(coefficients[:-1]):
            total = do("add", do("mul", total, s), coefficient)
        return total

    def modulo(count: Scalar, of: float) -> Scalar:
        whole = do("floor", do("mul", count, np.float32(1 / of)))
        return do("sub", count, do("mul", whole, np.float32(of)))

    sine, cosine = do("mul", r, horner(_SINE)), horner(_COSINE)
    quarter = modulo(do("add", turns, np.float32(ahead)), 4.0)
    odd = do("ge", modulo(quarter, 2.0), np.float32(1))
    value = graph.select(odd, sine, cosine)
    return graph.select(do("ge", quarter, np.float32(2)), value, do("neg", value))


def _simplify_cosine(graph: ExprGraph, kind: np.dtype, x: Scalar) -> Scalar:
    return _simplify_sine(graph, kind, x, ahead=1)


_SHORTER: dict[str, Callable[..., Scalar | None]] = {
    "add": _simplify_add,
    "and": _simplify_and,
    "cos": _simplify_cosine,
    "div": _simplify_div,
    "max": _simplify_extreme,
    "min": _simplify_extreme,
    "mul": _simplify_mul,
    "neg": _simplify_neg,
    "not": _simplify_not,
    "or": _simplify_or,
    "pow": _simplify_pow,
    "sign": _simplify_sign,
    "sin": _simplify_sine,
    "sub": _simplify_sub,
    "xor": _simplify_xor,
}
"""What else gives the same number; None: nothing does."""
