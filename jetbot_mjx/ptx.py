"""A program of single numbers as one kernel in PTX, the assembly language of NVIDIA's GPUs.

Each thread does the whole program for one robot; all numbers in between stay in registers.
NVIDIA's assembler, a part of CUDA, takes it from there.

Source: NVIDIA, Parallel Thread Execution ISA, version 7.0.
"""

import math
import struct
from collections.abc import Callable, Sequence

import numpy as np

from jetbot_mjx.kernel import Kernel
from jetbot_mjx.scalarize import Program
from jetbot_mjx.scalars import COMPARISONS, Scalar, UnsupportedError, Value, is_known

_HEADER = """.version 7.0
.target sm_70
.address_size 64
"""
"""The oldest that has all that is used: Volta and what came after it."""

_REGISTERS = {"f": ("f32", "%f"), "i": ("s32", "%r"), "b": ("pred", "%p")}
"""Of each kind of dtype: PTX's type and how its registers are called here."""

_FLOAT_OPS = {"add": "add", "div": "div.rn", "mul": "mul", "sub": "sub"}
_INT_OPS = {"add": "add", "max": "max", "min": "min", "mul": "mul.lo", "sub": "sub"}


THREADS = 64
"""Robots in one block: so few that even thousands keep all multiprocessors of a GPU busy."""

_ROBOTS = "$robots"
"""Where in a kernel's text their number goes."""


def source(kernel: Kernel, robots: int) -> str:
    """The PTX for so many robots.

    Args:
      kernel: as `make_kernel` writes it.
      robots: how many.

    Returns:
      What NVIDIA's assembler takes.
    """
    return kernel.text.replace(_ROBOTS, str(robots))


def make_kernel(program: Program, *, carried: int, steps: int, name: str) -> Kernel:
    """Writes a kernel that repeats a program, its results becoming its first arguments.

    The kernel's parameters are the addresses of all leaves of the arguments and then of all
    leaves of the results, float32 arrays of shape (robots, ...).

    Args:
      program: a step; its results have the shapes of its first `carried` arguments.
      carried: how many leaves of the arguments are carried from step to step.
      steps: how often it is repeated.
      name: of the kernel, a C identifier.

    Returns:
      The kernel.

    Raises:
      UnsupportedError: the program has an operation that is not written in PTX here.
    """
    if any(x.dtype != np.float32 for array in program.inputs for x in array.ravel()):
        raise UnsupportedError("an argument that is not float32")
    return Kernel(name, _Text(program, carried).text(steps, name))


class _Text:
    """The lines of one kernel, and the registers that they name."""

    def __init__(self, program: Program, carried: int) -> None:
        self._program = program
        self._carried = carried
        self._count = dict.fromkeys(_REGISTERS, 0)
        self._names: dict[int, str] = {}
        self._lines: list[str] = []

    def text(self, steps: int, name: str) -> str:
        inputs = [[self._new("f") for _ in array.ravel()] for array in self._program.inputs]
        for array, names in zip(self._program.inputs, inputs, strict=True):
            for value, register in zip(array.ravel(), names, strict=True):
                self._names[value.index] = register
        for value in self._program.values:
            if value.op != "input":
                self._operation(value)
        carried = [register for names in inputs[: self._carried] for register in names]
        results = [self._operand(x) for array in self._program.outputs for x in array.ravel()]
        copies = [self._new("f") for _ in carried]
        body = [
            *self._lines,
            # All are read before any is written.
            *_moves(copies, results),
            *_moves(carried, copies),
        ]
        first, last = len(inputs), len(inputs) + self._carried
        parameters = ", ".join(f".param .u64 a{i}" for i in range(last))
        lines = [
            f".visible .entry {name}({parameters})",
            f".maxntid {THREADS}, 1, 1",
            "{",
            ".reg .u32 %block, %thread, %robot, %step;",
            ".reg .pred %stop;",
            ".reg .u64 %address, %offset;",
            *self._declarations(),
            "mov.u32 %block, %ctaid.x;",
            "mov.u32 %thread, %tid.x;",
            f"mad.lo.u32 %robot, %block, {THREADS}, %thread;",
            f"setp.ge.u32 %stop, %robot, {_ROBOTS};",
            "@%stop ret;",
            *self._transfers("ld.global.f32 {register}, [%address+{offset}];", 0, inputs),
            "mov.u32 %step, 0;",
            "again:",
            *body,
            "add.u32 %step, %step, 1;",
            f"setp.lt.u32 %stop, %step, {steps};",
            "@%stop bra again;",
            *self._transfers(
                "st.global.f32 [%address+{offset}], {register};", first, inputs[: self._carried]
            ),
            "ret;",
            "}",
        ]
        return _HEADER + "\n".join(lines) + "\n"

    def _declarations(self) -> list[str]:
        return [
            f".reg .{_REGISTERS[kind][0]} {_REGISTERS[kind][1]}<{count}>;"
            for kind, count in self._count.items()
            if count
        ]

    def _transfers(self, line: str, first: int, arrays: Sequence[Sequence[str]]) -> list[str]:
        """Between memory and registers, one robot's rows of several arrays."""
        lines = []
        for i, registers in enumerate(arrays, start=first):
            lines += [
                f"ld.param.u64 %address, [a{i}];",
                "cvta.to.global.u64 %address, %address;",
                f"mul.wide.u32 %offset, %robot, {4 * len(registers)};",
                "add.u64 %address, %address, %offset;",
                *(line.format(register=r, offset=4 * j) for j, r in enumerate(registers)),
            ]
        return lines

    def _new(self, kind: str) -> str:
        self._count[kind] += 1
        return f"{_REGISTERS[kind][1]}{self._count[kind] - 1}"

    def _operand(self, x: Scalar) -> str:
        if not is_known(x):
            return self._names[x.index]
        if x.dtype.kind == "f":
            return _float(float(x))
        if x.dtype.kind == "b":
            register = self._new("b")
            self._lines.append(f"setp.ne.s32 {register}, {int(x)}, 0;")
            return register
        return str(int(x))

    def _operation(self, value: Value) -> None:
        kind = value.operands[0].dtype.kind if value.op != "select" else value.dtype.kind
        operands = [self._operand(x) for x in value.operands]
        result = self._new(value.dtype.kind)
        self._names[value.index] = result
        write = _WRITERS.get((value.op, kind))
        if write is None:
            raise UnsupportedError(f"{value.op} of {value.operands[0].dtype} on a GPU")
        self._lines += write(self, value, result, operands)

    def _extreme(self, value: Value, result: str, operands: list[str]) -> list[str]:
        # PTX's own extremes pass over NaN, JAX's do not.
        unordered = self._new("b")
        pair = ", ".join(operands)
        return [
            f"{value.op}.f32 {result}, {pair};",
            f"setp.nan.f32 {unordered}, {pair};",
            f"selp.f32 {result}, {_float(math.nan)}, {result}, {unordered};",
        ]

    def _convert(self, value: Value, result: str, operands: list[str]) -> list[str]:
        (x,) = operands
        source = value.operands[0].dtype.kind
        to = value.dtype.kind
        if source == "b":
            one, zero = (_float(1.0), _float(0.0)) if to == "f" else ("1", "0")
            return [f"selp.{_REGISTERS[to][0]} {result}, {one}, {zero}, {x};"]
        conversion = "cvt.rn.f32.s32" if to == "f" else "cvt.rzi.s32.f32"
        return [f"{conversion} {result}, {x};"]

    def _comparison(self, value: Value, result: str, operands: list[str]) -> list[str]:
        kind = value.operands[0].dtype.kind
        if kind == "b":
            different = [f"xor.pred {result}, {', '.join(operands)};"]
            return different if value.op == "ne" else [*different, f"not.pred {result}, {result};"]
        # What is not a number differs from all.
        op = "neu" if value.op == "ne" and kind == "f" else value.op
        return [f"setp.{op}.{_REGISTERS[kind][0]} {result}, {', '.join(operands)};"]


_Writer = Callable[[_Text, Value, str, list[str]], list[str]]


def _plain(instruction: str) -> _Writer:
    def write(text: _Text, value: Value, result: str, operands: list[str]) -> list[str]:
        return [f"{instruction} {result}, {', '.join(operands)};"]

    return write


def _select(text: _Text, value: Value, result: str, operands: list[str]) -> list[str]:
    which, no, yes = operands
    return [f"selp.{_REGISTERS[value.dtype.kind][0]} {result}, {yes}, {no}, {which};"]


_WRITERS: dict[tuple[str, str], _Writer] = {
    **{(op, "f"): _plain(f"{name}.f32") for op, name in _FLOAT_OPS.items()},
    **{(op, "i"): _plain(f"{name}.s32") for op, name in _INT_OPS.items()},
    **{(op, kind): _Text._comparison for op in COMPARISONS for kind in "fi"},
    **{(op, "b"): _Text._comparison for op in ("eq", "ne")},
    **{(op, "b"): _plain(f"{op}.pred") for op in ("and", "not", "or", "xor")},
    **{(op, "f"): _Text._extreme for op in ("max", "min")},
    **{(op, "f"): _plain(f"{op}.f32") for op in ("abs", "neg")},
    **{(op, "i"): _plain(f"{op}.s32") for op in ("abs", "neg")},
    **{("select", kind): _select for kind in "fi"},
    **{("convert", kind): _Text._convert for kind in "fib"},
    ("floor", "f"): _plain("cvt.rmi.f32.f32"),
    ("is_finite", "f"): _plain("testp.finite.f32"),
    ("sqrt", "f"): _plain("sqrt.rn.f32"),
}
"""By operation and kind of the operands' dtype."""


def _moves(to: Sequence[str], what: Sequence[str]) -> list[str]:
    return [f"mov.f32 {a}, {b};" for a, b in zip(to, what, strict=True)]


def _float(x: float) -> str:
    """A constant by its bits."""
    return f"0f{struct.pack('>f', x).hex().upper()}"
