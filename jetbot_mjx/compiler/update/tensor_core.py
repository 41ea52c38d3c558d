"""Write LLVM IR for the tensor cores of NVIDIA GPUs.

`IrWriter` appends instructions to a function, and `Value` lets Python's operators append them. The
products are those of `mma.sync.m16n8k16`: a warp multiplies 16 x 16 float16 numbers by 16 x 8 and
adds the result to 16 x 8 float32 sums, of which each lane holds four:

    lane = 4 g + t:  sums (g, 2t), (g, 2t + 1), (g + 8, 2t), (g + 8, 2t + 1)

The operands come from shared memory by `ldmatrix`, four matrices of 8 x 8 numbers at once, each
row at an address that one lane gives. With `.trans` each matrix is transposed on its way.
"""

import dataclasses
import struct
from collections.abc import Callable, Iterable, Sequence
from typing import Self

LANES = 32
"""Threads of a warp."""

TILE = 16
"""Rows of a product, and numbers along its sum."""

_QUAD = "{i32, i32, i32, i32}"
_SUMS = "{float, float, float, float}"
_MMA = "@llvm.nvvm.mma.m16n8k16.row.col.f32.f32"
_LDMATRIX = "@llvm.nvvm.ldmatrix.sync.aligned.m8n8.x4"

_DECLARATIONS = f"""\
declare {_SUMS} {_MMA}({", ".join(["<2 x half>"] * 6 + ["float"] * 4)})
declare {_QUAD} {_LDMATRIX}.b16.p3(ptr addrspace(3))
declare {_QUAD} {_LDMATRIX}.trans.b16.p3(ptr addrspace(3))
declare i32 @llvm.nvvm.read.ptx.sreg.tid.x()
declare i32 @llvm.nvvm.read.ptx.sreg.ctaid.x()
declare i32 @llvm.nvvm.read.ptx.sreg.ctaid.y()
declare i32 @llvm.nvvm.read.ptx.sreg.ctaid.z()
declare i32 @llvm.nvvm.read.ptx.sreg.nctaid.x()
@shared = external addrspace(3) global [0 x i8], align 16
"""
"""What a module declares before a function of an `IrWriter`."""


def module_text(
    name: str,
    arguments: int,
    lines: Sequence[str],
    threads: int,
    declarations: Iterable[str] = (),
) -> str:
    """Return the module of a kernel.

    Args:
      name: the name of the kernel.
      arguments: the number of its arrays.
      lines: its instructions, from an `IrWriter`.
      threads: the number of threads of a block.
      declarations: what the module declares beside what an `IrWriter` needs.
    """
    parameters = ", ".join(f"ptr addrspace(1) %a{i}" for i in range(arguments))
    parts = [
        _DECLARATIONS + "\n".join(declarations),
        f"define ptx_kernel void @{name}({parameters}) {{\nentry:",
        "\n  ".join(["", *lines, "ret void"])[1:],
        "}\nattributes #0 = { convergent nounwind }",
        f'!nvvm.annotations = !{{!0}}\n!0 = !{{ptr @{name}, !"maxntidx", i32 {threads}}}\n',
    ]
    return "\n".join(parts)


_OPERATIONS = {
    ("i32", "+"): "add",
    ("i32", "-"): "sub",
    ("i32", "*"): "mul",
    ("i32", "/"): "udiv",
    ("i32", "%"): "urem",
    ("i32", "<"): "icmp ult",
    ("i32", "=="): "icmp eq",
    ("float", "+"): "fadd contract",
    ("float", "-"): "fsub contract",
    ("float", "*"): "fmul contract",
    ("float", "<"): "fcmp olt",
    ("float", "<="): "fcmp ole",
}


@dataclasses.dataclass(frozen=True)
class Value:
    """A `Value` is a number in a register of each thread."""

    writer: "IrWriter"
    text: str
    """Its name or, of a constant, its text."""
    type: str

    def _apply(self, operation: str, other: "Value | float", *, swapped: bool = False) -> "Value":
        operand = other if isinstance(other, Value) else self.writer.constant(other, self.type)
        first, second = (operand, self) if swapped else (self, operand)
        name = _OPERATIONS[self.type, operation]
        kind = "i1" if "cmp" in name else self.type
        return self.writer.let(f"{name} {self.type} {first.text}, {second.text}", kind)

    def __add__(self, other: "Value | float") -> "Value":
        return self._apply("+", other)

    def __sub__(self, other: "Value | float") -> "Value":
        return self._apply("-", other)

    def __mul__(self, other: "Value | float") -> "Value":
        return self._apply("*", other)

    def __floordiv__(self, other: "Value | float") -> "Value":
        return self._apply("/", other)

    def __mod__(self, other: "Value | float") -> "Value":
        return self._apply("%", other)

    def __lt__(self, other: "Value | float") -> "Value":
        return self._apply("<", other)

    def __le__(self, other: "Value | float") -> "Value":
        return self._apply("<=", other)

    def equals(self, other: "Value | float") -> "Value":
        """Return whether two integers are equal."""
        return self._apply("==", other)

    def __rsub__(self, other: float) -> "Value":
        return self._apply("-", other, swapped=True)

    __radd__ = __add__
    __rmul__ = __mul__


Sums = list[list[list[Value]]]
"""Sums of a warp: four numbers of a lane for each (row tile of 16, column tile of 8)."""

Operand = Callable[[int, int], list[Value]]
"""Return the fragments of an operand by its tile of 16 rows or columns and the step of the sum."""


class IrWriter:
    """An `IrWriter` appends the instructions of one function."""

    def __init__(self) -> None:
        """Begin with the block `entry`."""
        self.lines: list[str] = []
        self.label = "entry"
        self._count = 0

    def _fresh(self) -> int:
        self._count += 1
        return self._count

    def do(self, instruction: str) -> None:
        """Append an instruction without a result."""
        self.lines.append(instruction)

    def let(self, instruction: str, kind: str = "i32") -> Value:
        """Append an instruction and return its result, of the given LLVM type."""
        name = f"%v{self._fresh()}"
        self.lines.append(f"{name} = {instruction}")
        return Value(self, name, kind)

    def constant(self, number: float, kind: str = "float") -> Value:
        """Return a constant."""
        if kind == "i32":
            return Value(self, str(int(number)), kind)
        (rounded,) = struct.unpack("f", struct.pack("f", number))
        return Value(self, f"0x{struct.pack('>d', rounded).hex().upper()}", kind)

    def register(self, name: str) -> Value:
        """Return a special register, for example `tid.x`."""
        return self.let(f"call i32 @llvm.nvvm.read.ptx.sreg.{name}()")

    def assembly(self, text: str, *operands: Value, result: str = "float") -> Value:
        """Return the result of an instruction of PTX on floats, which reads no memory."""
        places = ", ".join(f"${i + 1}" for i in range(len(operands)))
        letters = ",".join(["=f" if result == "float" else "=r"] + ["f"] * len(operands))
        given = ", ".join(f"float {operand.text}" for operand in operands)
        return self.let(f'call {result} asm "{text} $0, {places};", "{letters}"({given})', result)

    def select(self, condition: Value, yes: Value, no: Value | float) -> Value:
        """Return one of two numbers."""
        other = no if isinstance(no, Value) else self.constant(no, yes.type)
        return self.let(
            f"select i1 {condition.text}, {yes.type} {yes.text}, {yes.type} {other.text}", yes.type
        )

    def minimum(self, one: Value, other: Value | float) -> Value:
        """Return the smaller of two numbers."""
        return self.select(one < other, one, other)

    # Functions of floats, approximate to about 2^-22 but for the hyperbolic tangent with 2^-11.

    def exp(self, x: Value) -> Value:
        """Return the exponential function."""
        return self.assembly("ex2.approx.ftz.f32", x * 1.4426950408889634)

    def log(self, x: Value) -> Value:
        """Return the natural logarithm."""
        return self.assembly("lg2.approx.ftz.f32", x) * 0.6931471805599453

    def reciprocal(self, x: Value) -> Value:
        """Return 1 / x."""
        return self.assembly("rcp.approx.ftz.f32", x)

    def sqrt(self, x: Value) -> Value:
        """Return the square root."""
        return self.assembly("sqrt.approx.ftz.f32", x)

    def tanh(self, x: Value) -> Value:
        """Return the hyperbolic tangent."""
        return self.assembly("tanh.approx.f32", x)

    def sigmoid(self, x: Value) -> Value:
        """Return 1 / (1 + exp(-x))."""
        return self.reciprocal(self.exp(x * -1.0) + 1.0)

    def softplus(self, x: Value) -> Value:
        """Return log(1 + exp(x))."""
        positive = self.select(x < 0.0, self.constant(0.0), x)
        size = self.select(x < 0.0, x, x * -1.0)
        return positive + self.log(self.exp(size) + 1.0)

    # Control flow.

    def begin(self, label: str) -> None:
        """Begin a block."""
        self.lines.append(f"{label}:")
        self.label = label

    def when(self, condition: Value) -> "_When":
        """Return a context in which instructions run for threads that meet a condition."""
        return _When(self, condition)

    def synchronize(self) -> None:
        """Wait for all threads of the block."""
        self.do('call void asm sideeffect "bar.sync 0;", "~{memory}"() #0')

    def synchronize_group(self, group: Value, threads: int) -> None:
        """Wait for as many threads as belong to a group, by its number from 0."""
        if threads == LANES:
            self.do('call void asm sideeffect "bar.warp.sync -1;", "~{memory}"() #0')
        else:
            self.do(
                f'call void asm sideeffect "bar.sync $0, {threads};", "r,~{{memory}}"'
                f"(i32 {(group + 1).text}) #0"
            )

    # Memory: addresses in shared memory are bytes; global arrays are of floats.

    def shared(self, place: Value | int, offset: int = 0) -> Value:
        """Return the pointer to a byte of shared memory."""
        kind, text = "ptr addrspace(3)", place.text if isinstance(place, Value) else place
        pointer = self.let(f"getelementptr i8, {kind} @shared, i32 {text}", kind)
        return self.moved(pointer, offset)

    def moved(self, pointer: Value, offset: int) -> Value:
        """Return a pointer to shared memory, moved by bytes."""
        if offset == 0:
            return pointer
        text = f"getelementptr i8, {pointer.type} {pointer.text}, i32 {offset}"
        return self.let(text, pointer.type)

    def read(self, pointer: Value, kind: str = "float") -> Value:
        """Return a number from shared memory."""
        return self.let(f"load {kind}, ptr addrspace(3) {pointer.text}, align 4", kind)

    def write(self, value: Value, pointer: Value) -> None:
        """Store a number in shared memory."""
        self.do(f"store {value.type} {value.text}, ptr addrspace(3) {pointer.text}, align 4")

    def element(self, array: Value, index: Value) -> Value:
        """Return the pointer to an element of a global array."""
        kind = "ptr addrspace(1)"
        return self.let(f"getelementptr float, {kind} {array.text}, i32 {index.text}", kind)

    def row(self, array: Value, index: Value, size: int) -> Value:
        """Return the pointer to a row of a global array, which may have more than 2^31 elements."""
        wide = self.let(f"zext i32 {index.text} to i64", "i64")
        place = self.let(f"mul i64 {wide.text}, {size}", "i64")
        kind = "ptr addrspace(1)"
        return self.let(f"getelementptr float, {kind} {array.text}, i64 {place.text}", kind)

    def fetch(self, array: Value, index: Value, kind: str = "float") -> Value:
        """Return an element of a global array of floats or of integers of 32 bits."""
        return self.let(f"load {kind}, ptr addrspace(1) {self.element(array, index).text}", kind)

    def put(self, value: Value, array: Value, index: Value) -> None:
        """Store an element of a global array."""
        place = self.element(array, index)
        self.do(f"store float {value.text}, ptr addrspace(1) {place.text}")

    # Pairs of float16.

    def pack(self, low: Value, high: Value) -> Value:
        """Round two floats to a pair of float16, the first in the lower half.

        What is too large becomes the largest number; what is no number stays so.
        """
        return self.assembly("cvt.rn.satfinite.f16x2.f32", high, low, result="i32")

    def unpack(self, pair: Value) -> tuple[Value, Value]:
        """Return a pair of float16 as floats."""
        halves = self._halves(pair)
        low, high = (
            self.let(f"extractelement <2 x half> {halves.text}, i32 {i}", "half") for i in (0, 1)
        )
        return (
            self.let(f"fpext half {low.text} to float", "float"),
            self.let(f"fpext half {high.text} to float", "float"),
        )

    def _halves(self, pair: Value) -> Value:
        return self.let(f"bitcast i32 {pair.text} to <2 x half>", "<2 x half>")

    # Products.

    def matrices(self, pointer: Value, offset: int, *, transposed: bool) -> list[Value]:
        """Load four matrices of 8 x 8 numbers from the rows that the lanes point at."""
        place = self.moved(pointer, offset)
        name = f"{_LDMATRIX}{'.trans' if transposed else ''}.b16.p3"
        return self._parts(f"call {_QUAD} {name}(ptr addrspace(3) {place.text}) #0", _QUAD, "i32")

    def product(self, sums: Sums, steps: int, left: Operand, right: Operand) -> Sums:
        """Return sums + left @ right.

        Args:
          sums: the sums before; their columns are tiles of 8, of which `right` loads two at once.
          steps: numbers along the sum, in tiles of 16.
          left: the left operand.
          right: the right operand.
        """
        sums = [list(row) for row in sums]
        columns = len(sums[0])
        for step in range(steps):
            rows = [left(row, step) for row in range(len(sums))]
            for pair in range(-(-columns // 2)):
                fragments = right(pair, step)
                for column in range(2 * pair, min(2 * pair + 2, columns)):
                    half = fragments[2 * (column % 2) :][:2]
                    for row, fragment in enumerate(rows):
                        sums[row][column] = self.mma(sums[row][column], fragment, half)
        return sums

    def mma(
        self, sums: Sequence[Value], left: Sequence[Value], right: Sequence[Value]
    ) -> list[Value]:
        """Return the sums of one product of 16 x 16 by 16 x 8 numbers added to sums."""
        halves = [self._halves(pair) for pair in (*left, *right)]
        given = [f"{value.type} {value.text}" for value in (*halves, *sums)]
        return self._parts(f"call {_SUMS} {_MMA}({', '.join(given)}) #0", _SUMS, "float")

    def _parts(self, call: str, struct_type: str, kind: str) -> list[Value]:
        whole = self.let(call, struct_type)
        return [self.let(f"extractvalue {struct_type} {whole.text}, {i}", kind) for i in range(4)]


class _When:
    """A `_When` branches around the instructions of a `with` block."""

    def __init__(self, writer: IrWriter, condition: Value) -> None:
        self._writer, self._condition = writer, condition

    def __enter__(self) -> Self:
        number = self._writer._fresh()
        self._end = f"end{number}"
        condition = self._condition.text
        self._writer.do(f"br i1 {condition}, label %then{number}, label %{self._end}")
        self._writer.begin(f"then{number}")
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.do(f"br label %{self._end}")
        self._writer.begin(self._end)
