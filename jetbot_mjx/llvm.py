"""A program of single numbers in LLVM's intermediate representation, for CPUs.

Every number is a vector register wide: each lane does the whole program for one robot. What else a
kernel is made of, `xla_ffi` writes.

Source: LLVM Language Reference Manual.
"""

import struct
from collections.abc import Callable

import numpy as np

from jetbot_mjx.scalarize import Program
from jetbot_mjx.scalars import COMPARISONS, Scalar, UnsupportedError, Value, is_known

STEP = "step"
"""The function's name."""

_ELEMENTS = {"f": "float", "i": "i32", "b": "i1"}
"""Of each kind of dtype: LLVM's type."""

_INTRINSICS = {"abs": "fabs", "floor": "floor", "sqrt": "sqrt"}


def step_text(program: Program, *, carried: int, lanes: int) -> str:
    """Writes a function that does a program once, its results taking the first arguments' place.

    The function's parameter is the address of a tile: a row for each number of the arguments, of
    as many float32 as there are lanes, aligned to the length of a row.

    Args:
      program: a step; its results have the shapes of its first `carried` arguments.
      carried: how many leaves of the arguments the results replace.
      lanes: robots side by side.

    Returns:
      The function's text, and the declarations that it needs.

    Raises:
      UnsupportedError: the program has an operation that is not written here.
    """
    if any(x.dtype != np.float32 for array in program.inputs for x in array.ravel()):
        raise UnsupportedError("an argument that is not float32")
    return _Text(program, lanes).text(carried)


class _Text:
    """The lines of the function, and the names of its numbers."""

    def __init__(self, program: Program, lanes: int) -> None:
        self._program = program
        self._lanes = lanes
        self._count = 0
        self._names: dict[int, str] = {}
        self._lines: list[str] = []

    def text(self, carried: int) -> str:
        inputs = [x for array in self._program.inputs for x in array.ravel()]
        for row, x in enumerate(inputs):
            self._names[x.index] = self._do(f"load {self._type('f')}, {self._row(row)}")
        for value in self._program.values:
            if value.op != "input":
                self._operation(value)
        results = [x for array in self._program.outputs[:carried] for x in array.ravel()]
        for row, x in enumerate(results):
            place = self._row(row)
            self._lines.append(f"store {self._type('f')} {self._operand(x)}, {place}")
        number, whole = self._type("f"), self._type("i")
        lines = [
            *(f"declare {number} {self._function(x)}({number})" for x in _INTRINSICS.values()),
            f"declare {whole} {self._function('fptosi.sat')}({number})",
            f"define internal void @{STEP}(ptr noalias %tile) noinline {{",
            *self._lines,
            "ret void",
            "}",
        ]
        return "\n".join(lines) + "\n"

    def _type(self, kind: str) -> str:
        return f"<{self._lanes} x {_ELEMENTS[kind]}>"

    def _function(self, name: str) -> str:
        suffix = f"v{self._lanes}f32"
        return (
            f"@llvm.{name}.v{self._lanes}i32.{suffix}"
            if "sat" in name
            else f"@llvm.{name}.{suffix}"
        )

    def _row(self, row: int) -> str:
        address = self._do(f"getelementptr {self._type('f')}, ptr %tile, i64 {row}")
        return f"ptr {address}, align {4 * self._lanes}"

    def _do(self, instruction: str) -> str:
        self._count += 1
        self._lines.append(f"%v{self._count} = {instruction}")
        return f"%v{self._count}"

    def _operand(self, x: Scalar) -> str:
        return self._constant(x) if is_known(x) else self._names[x.index]

    def _constant(self, x: Scalar) -> str:
        kind = x.dtype.kind
        return f"splat ({_ELEMENTS[kind]} {_float(x) if kind == 'f' else int(x)})"

    def _operation(self, value: Value) -> None:
        kind = value.operands[0].dtype.kind if value.op != "select" else value.dtype.kind
        write = _WRITERS.get((value.op, kind))
        if write is None:
            raise UnsupportedError(f"{value.op} of {value.operands[0].dtype} on a CPU")
        operands = [self._operand(x) for x in value.operands]
        self._names[value.index] = self._do(write(self, value, operands))

    # Of an operation, the last instruction; what comes before it is already among the lines.

    def _call(self, value: Value, operands: list[str]) -> str:
        (x,) = operands
        return (
            f"call {self._type('f')} {self._function(_INTRINSICS[value.op])}({self._type('f')} {x})"
        )

    def _extreme(self, value: Value, operands: list[str]) -> str:
        # One instruction on x86, which takes the second where one is not a number.
        number = self._type("f")
        ordered = sorted(
            zip(value.operands, operands, strict=True), key=lambda x: not is_known(x[0])
        )
        (first, a), (_, b) = ordered
        better = "ogt" if value.op == "max" else "olt"
        best = self._chosen(self._do(f"fcmp {better} {number} {a}, {b}"), "f", a, b)
        if is_known(first):
            return best
        best = self._do(best)
        return self._chosen(self._do(f"fcmp uno {number} {a}, {a}"), "f", a, best)

    def _finite(self, value: Value, operands: list[str]) -> str:
        number = self._type("f")
        size = self._do(f"call {number} {self._function('fabs')}({number} {operands[0]})")
        return f"fcmp olt {number} {size}, splat (float {_float(np.inf)})"

    def _magnitude(self, value: Value, operands: list[str]) -> str:
        whole, (x,) = self._type("i"), operands
        below = self._do(f"icmp slt {whole} {x}, splat (i32 0)")
        return self._chosen(below, "i", self._do(f"sub {whole} splat (i32 0), {x}"), x)

    def _larger(self, value: Value, operands: list[str]) -> str:
        a, b = operands
        better = "sgt" if value.op == "max" else "slt"
        return self._chosen(self._do(f"icmp {better} {self._type('i')} {a}, {b}"), "i", a, b)

    def _chosen(self, which: str, kind: str, yes: str, no: str) -> str:
        return (
            f"select {self._type('b')} {which}, {self._type(kind)} {yes}, {self._type(kind)} {no}"
        )

    def _select(self, value: Value, operands: list[str]) -> str:
        which, no, yes = operands
        return self._chosen(which, value.dtype.kind, yes, no)

    def _convert(self, value: Value, operands: list[str]) -> str:
        source, to = value.operands[0].dtype.kind, value.dtype.kind
        if source == "f":
            function = self._function("fptosi.sat")
            return f"call {self._type('i')} {function}({self._type('f')} {operands[0]})"
        how = "zext" if to == "i" else "uitofp" if source == "b" else "sitofp"
        return f"{how} {self._type(source)} {operands[0]} to {self._type(to)}"

    def _comparison(self, value: Value, operands: list[str]) -> str:
        kind = value.operands[0].dtype.kind
        pair = f"{self._type(kind)} {', '.join(operands)}"
        if kind == "f":
            # What is not a number differs from all.
            return f"fcmp {'une' if value.op == 'ne' else f'o{value.op}'} {pair}"
        sign = "" if value.op in ("eq", "ne") else "s"
        return f"icmp {sign}{value.op} {pair}"


_Writer = Callable[[_Text, Value, list[str]], str]


def _plain(instruction: str, kind: str, *before: str) -> _Writer:
    def write(text: _Text, value: Value, operands: list[str]) -> str:
        return f"{instruction} {text._type(kind)} {', '.join([*before, *operands])}"

    return write


def _float(x: float) -> str:
    """A constant by its bits: of a double, as LLVM has it."""
    return f"0x{struct.pack('>d', float(x)).hex().upper()}"


# A product and a sum may be rounded once instead of twice.
_FUSED = "contract"

_WRITERS: dict[tuple[str, str], _Writer] = {
    **{(op, "f"): _plain(f"f{op} {_FUSED}", "f") for op in ("add", "div", "mul", "sub")},
    **{(op, "i"): _plain(op, "i") for op in ("add", "mul", "sub")},
    **{(op, "b"): _plain(op, "b") for op in ("and", "or", "xor")},
    **{(op, kind): _Text._comparison for op in COMPARISONS for kind in "fi"},
    **{(op, "b"): _Text._comparison for op in ("eq", "ne")},
    **{(op, "f"): _Text._call for op in _INTRINSICS},
    **{(op, "f"): _Text._extreme for op in ("max", "min")},
    **{(op, "i"): _Text._larger for op in ("max", "min")},
    **{("select", kind): _Text._select for kind in "fi"},
    **{("convert", kind): _Text._convert for kind in "fib"},
    ("abs", "i"): _Text._magnitude,
    ("is_finite", "f"): _Text._finite,
    ("neg", "f"): _plain("fneg", "f"),
    ("neg", "i"): _plain("sub", "i", "splat (i32 0)"),
    ("not", "b"): _plain("xor", "b", "splat (i1 1)"),
}
"""By operation and kind of the operands' dtype."""
