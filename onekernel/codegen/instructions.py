"""Write each operation on scalars as instructions of LLVM IR, for CPUs and GPUs.

Each function appends the instructions of one scalar of a program, and returns its value.

Source: LLVM Language Reference Manual.
"""

import math
import operator
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from onekernel.codegen.writer import LlvmWriter, Value, vector
from onekernel.errors import UnsupportedError
from onekernel.lower import COMPARISONS, Expr, is_constant, same_size

ELEMENTS = {
    np.dtype(np.float32): "float",
    np.dtype(np.float64): "double",
    np.dtype(np.int32): "i32",
    np.dtype(np.int64): "i64",
    np.dtype(np.uint32): "u32",
    np.dtype(np.uint64): "u64",
    np.dtype(bool): "i1",
}
"""Type of a scalar by its dtype."""

_EXTREMES = {"max": "maximum", "min": "minimum"}
_APPROXIMATIONS = {"exp": "ex2", "log": "lg2", "reciprocal": "rcp"}
_INTRINSICS = {
    "abs": "fabs",
    "floor": "floor",
    "fma": "fma",
    "round": "roundeven",
    "sqrt": "sqrt",
}


class Target(NamedTuple):
    """A `Target` is the function that instructions are appended to."""

    writer: LlvmWriter
    """The writer of the function; with one lane, values are scalars instead of vectors."""
    flags: str
    """`afn` where division and square root may be approximate, otherwise empty."""
    for_gpu: bool
    """Whether the function is for an NVIDIA GPU."""

    def type(self, dtype: np.dtype) -> str:
        """Return the type of a value by its dtype."""
        return vector(ELEMENTS[dtype], self.writer.lanes)


_Write = Callable[[Target, Expr, list[Value]], Value]


def _plain(apply: Callable[..., Value]) -> _Write:
    """Write an operation that is an operator of `Value`."""
    return lambda on, value, operands: apply(*operands)


def _intrinsic(on: Target, value: Expr, operands: list[Value]) -> Value:
    return on.writer.intrinsic(_INTRINSICS[value.op], *operands, flags=on.flags)


def _approximation(on: Target, value: Expr, operands: list[Value]) -> Value:
    (x,) = operands
    # The instructions are 2^x and log₂ x: exp(x) is 2^(x / ln 2), and log(x) is log₂(x) · ln 2.
    # LLVM has no function for them that is compiled to one instruction, so write it as assembly:
    # `$0` is the result and `$1` the operand, both in registers of floats ("=f,f").
    x = x * (1 / math.log(2)) if value.op == "exp" else x
    instruction = f"{_APPROXIMATIONS[value.op]}.approx.ftz.f32"
    result = on.writer.let(f'call float asm "{instruction} $0, $1;", "=f,f"({x.typed})', x.type)
    return result * math.log(2) if value.op == "log" else result


def _quotient(on: Target, value: Expr, operands: list[Value]) -> Value:
    x, y = operands
    if not on.flags:
        return x / y
    # `afn` allows an approximate division, for which the plain operator has no flag.
    return on.writer.let(f"fdiv {on.flags} contract {x.typed}, {y.text}", x.type)


def _extreme(on: Target, value: Expr, operands: list[Value]) -> Value:
    w = on.writer
    if on.for_gpu and value.dtype == np.float32:
        # `llvm.maximum` returns NaN if either operand is NaN, as JAX does. GPUs compute it in one
        # instruction of float32, CPUs do not.
        return w.intrinsic(_EXTREMES[value.op], *operands)
    # A comparison and a selection are one instruction on x86, which returns the second operand if
    # either is NaN. So NaN in the second operand is kept, and NaN in the first one is selected. A
    # constant is no NaN (the graph has simplified that): put it first, and save that selection.
    ordered = sorted(
        zip(value.operands, operands, strict=True), key=lambda x: not is_constant(x[0])
    )
    (first, a), (_, b) = ordered
    best = _larger(on, value, [a, b])
    return best if is_constant(first) else w.select(a.differs(a), a, best)


def _larger(on: Target, value: Expr, operands: list[Value]) -> Value:
    choose = on.writer.maximum if value.op == "max" else on.writer.minimum
    return choose(*operands)


def _finite(on: Target, value: Expr, operands: list[Value]) -> Value:
    # Neither infinity nor NaN is less than infinity.
    return on.writer.intrinsic("fabs", *operands) < math.inf


def _magnitude(on: Target, value: Expr, operands: list[Value]) -> Value:
    (x,) = operands
    return on.writer.select(x < 0, -x, x)


def _word_sum(on: Target, value: Expr, operands: list[Value]) -> Value:
    a, b = operands
    if not on.for_gpu or value.dtype != np.uint32:
        return a + b
    # LLVM's instruction selection for GPUs takes time quadratic in the number of sums with one of
    # the operands, and 13 s for a hundred random numbers from one key.
    return on.writer.let(
        f'call i32 asm "add.u32 $0, $1, $2;", "=r,r,r"({a.typed}, {b.typed})', a.type
    )


def _rotation(on: Target, value: Expr, operands: list[Value]) -> Value:
    x, by = operands
    # A funnel shift of a number with itself is a rotation.
    return on.writer.intrinsic("fshl", x, x, by)


def _angle(on: Target, value: Expr, operands: list[Value]) -> Value:
    """Write `quarter_turns` or `angle_rest` of an angle (see `EVALUATE`), computed in `double`."""
    w = on.writer
    angle = operands[0].to("double")

    def constant(x: float) -> Value:
        return w.constant(x, angle.type)

    turns = w.intrinsic("roundeven", angle * (2 / math.pi))
    if value.op == "quarter_turns":
        whole = w.intrinsic("floor", turns * 0.25)
        return w.intrinsic("fma", whole, constant(-4.0), turns).to("float")
    # π/2 in two parts; each product is exact in a fused multiply-add.
    result = angle
    for part in _HALF_PI:
        result = w.intrinsic("fma", turns, constant(-part), result)
    return result.to("float")


def _logical_shift(on: Target, value: Expr, operands: list[Value]) -> Value:
    """Shift to the right, and fill up with zeros: so an integer without a sign is shifted."""
    unsigned = ELEMENTS[same_size("u", value.dtype)]
    x, by = (operand.to(unsigned) for operand in operands)
    return (x >> by).to(ELEMENTS[value.dtype])


def _select(on: Target, value: Expr, operands: list[Value]) -> Value:
    condition, if_false, if_true = operands
    return on.writer.select(condition, if_true, if_false)


def _convert(on: Target, value: Expr, operands: list[Value]) -> Value:
    (x,), to = operands, value.dtype
    if value.operands[0].dtype.kind != "f" or to.kind == "f":
        return x.to(ELEMENTS[to])
    # Saturating conversions: numbers beyond the range become its ends and NaN becomes 0, as in JAX,
    # where the plain instruction would be undefined.
    name = "fptoui.sat" if to.kind == "u" else "fptosi.sat"
    return on.writer.intrinsic(name, x, result=on.type(to))


def _bitcast(on: Target, value: Expr, operands: list[Value]) -> Value:
    return operands[0].bits_as(on.type(value.dtype))


_HALF_PI = (math.pi / 2, 6.123233995736766e-17)
"""π/2 as a sum of two numbers of 64 bits."""

_COMPARE = {
    **{name: getattr(operator, name) for name in ("lt", "le", "gt", "ge")},
    "eq": Value.equals,
    "ne": Value.differs,
}

_OPERATIONS: dict[tuple[str, str], _Write] = {
    **{(op, kind): _plain(getattr(operator, op)) for op in ("mul", "sub") for kind in "fiu"},
    **{("add", kind): _plain(operator.add) for kind in "fi"},
    ("add", "u"): _word_sum,
    **{("and", kind): _plain(operator.and_) for kind in "iub"},
    **{("or", kind): _plain(operator.or_) for kind in "iub"},
    **{("xor", kind): _plain(operator.xor) for kind in "iub"},
    **{(op, kind): _plain(_COMPARE[op]) for op in COMPARISONS for kind in "fiu"},
    **{(op, "b"): _plain(_COMPARE[op]) for op in ("eq", "ne")},
    **{(op, "f"): _approximation for op in _APPROXIMATIONS},
    **{(op, "f"): _intrinsic for op in _INTRINSICS},
    **{(op, "f"): _extreme for op in _EXTREMES},
    **{(op, kind): _larger for op in _EXTREMES for kind in "iu"},
    **{("select", kind): _select for kind in "fiu"},
    **{("convert", kind): _convert for kind in "fiub"},
    **{("bitcast", kind): _bitcast for kind in "fi"},
    ("abs", "i"): _magnitude,
    **{(op, "f"): _angle for op in ("angle_rest", "quarter_turns")},
    ("div", "f"): _quotient,
    ("is_finite", "f"): _finite,
    **{("neg", kind): _plain(Value.__neg__) for kind in "fiu"},
    **{("div", kind): _plain(operator.floordiv) for kind in "iu"},
    **{("rem", kind): _plain(operator.mod) for kind in "iu"},
    ("not", "b"): _plain(Value.__invert__),
    ("rotate_left", "u"): _rotation,
    **{("shift_left", kind): _plain(operator.lshift) for kind in "iu"},
    **{("shift_right_logical", kind): _logical_shift for kind in "iu"},
}
"""Functions that write an operation, by its name and the kind of its operands."""


def write_of(value: Expr, *, for_gpu: bool = False) -> _Write:
    """Return the function that writes an operation.

    Raises:
      UnsupportedError: there is none for numbers of this type, or on this device.
    """
    # The instruction depends on the operands' dtype; the first operand of a selection is its
    # condition.
    kind = value.operands[0].dtype.kind if value.op != "select" else value.dtype.kind
    write = _OPERATIONS.get((value.op, kind))
    if write is None:
        raise UnsupportedError(f"{value.op} of {value.operands[0].dtype}")
    if write is _approximation and not for_gpu:
        raise UnsupportedError(f"an approximate {value.op} on a CPU")
    return write
