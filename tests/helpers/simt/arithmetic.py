"""What the instructions that compute numbers do to arrays over the threads."""

import numpy as np

TYPES = {
    "i1": np.bool_,
    "i8": np.uint8,
    "i32": np.uint32,
    "i64": np.uint64,
    "half": np.float16,
    "float": np.float32,
    "double": np.float64,
}
"""NumPy's types by those of LLVM."""


def constant(kind, text):
    """Return a constant: floats by the bits of a double, integers with a sign."""
    if text == "zeroinitializer":
        return TYPES[kind](0)
    if kind == "i1":
        return np.bool_(text in ("true", "1"))
    if kind.startswith("i"):
        return TYPES[kind](int(text) % 2 ** int(kind[1:]))
    number = np.uint64(int(text, 16)).view(np.float64) if text.startswith("0x") else float(text)
    return TYPES[kind](number)


def signed(x):
    """Return integers as those with a sign."""
    return -x.astype(np.int8) if x.dtype == bool else x.view(f"i{x.itemsize}")


def _quotient(a, b):
    """Divide towards zero; by zero, a GPU's result is unspecified."""
    a, b = signed(a).astype(np.int64), signed(b).astype(np.int64)
    return (np.sign(a) * np.sign(b) * (np.abs(a) // np.maximum(np.abs(b), 1))).astype(np.uint32)


def _rest(a, b):
    return np.fmod(signed(a), signed(b)).view(a.dtype)


ARITHMETIC = {
    **dict.fromkeys(("add", "fadd"), np.add),
    **dict.fromkeys(("sub", "fsub"), np.subtract),
    **dict.fromkeys(("mul", "fmul"), np.multiply),
    "udiv": np.floor_divide,
    "urem": np.remainder,
    "fdiv": np.divide,
    "sdiv": _quotient,
    "srem": _rest,
    "and": np.bitwise_and,
    "or": np.bitwise_or,
    "xor": np.bitwise_xor,
    "shl": np.left_shift,
    "lshr": np.right_shift,
}
_COMPARISONS = {
    "eq": np.equal,
    "ne": np.not_equal,
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
}


def compare_floats(name, a, b):
    """Return `fcmp`: for NaN, names that begin with `o` return false, those with `u` true."""
    unordered = np.isnan(a) | np.isnan(b)
    if name in ("ord", "uno"):
        return unordered == (name == "uno")
    result = _COMPARISONS[name[1:]](a, b)
    return result | unordered if name[0] == "u" else result & ~unordered


def compare_integers(name, a, b):
    """Return `icmp`."""
    if name in ("eq", "ne"):
        return _COMPARISONS[name](a, b)
    return _COMPARISONS[name[1:]](*((signed(a), signed(b)) if name[0] == "s" else (a, b)))


def _fused(a, b, c):
    """Multiply and add in what has the most digits, which is not quite exact for float64."""
    return a.astype(np.longdouble) * b + c


def _rotated(a, b, by):
    """Shift two words, one behind the other, to the left, and keep the first."""
    both = (a.astype(np.uint64) << np.uint64(32)) | b
    return (both << (by % 32).astype(np.uint64)) >> np.uint64(32)


def _saturated(x, kind):
    limits = np.iinfo(kind)
    return np.clip(np.nan_to_num(x.astype(np.float64)), limits.min, limits.max).astype(kind)


INTRINSICS = {
    "fabs": np.abs,
    "floor": np.floor,
    "roundeven": np.rint,
    "sqrt": np.sqrt,
    "maximum": np.maximum,
    "minimum": np.minimum,
    "umin": np.minimum,
    "fma": _fused,
    "fshl": _rotated,
    "fptosi.sat": lambda x: _saturated(x, np.int32),
    "fptoui.sat": lambda x: _saturated(x, np.uint32),
}


def _packed(high, low):
    """Round to a pair of float16; what is too large becomes the largest number."""
    most = np.finfo(np.float16).max
    halves = [np.clip(x, -most, most).astype(np.float16) for x in (low, high)]
    return np.stack(halves, axis=-1).view(np.uint32)[:, 0]


_APPROXIMATE = {
    "ex2.approx.ftz.f32": np.exp2,
    "lg2.approx.ftz.f32": np.log2,
    "rcp.approx.ftz.f32": np.reciprocal,
    "sqrt.approx.ftz.f32": np.sqrt,
    "tanh.approx.f32": np.tanh,
}
ASSEMBLY = {
    "add.u32": np.add,
    "cvt.rn.satfinite.f16x2.f32": _packed,
    "mov.f32": np.copy,
    **{
        name: lambda x, function=function: function(x.astype(np.float64)).astype(np.float32)
        for name, function in _APPROXIMATE.items()
    },
}
