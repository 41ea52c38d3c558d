"""Write LLVM IR for the tensor cores of NVIDIA GPUs.

A `GpuWriter` writes a kernel, which each thread of a block runs. Products of matrices are those of
`mma.sync.m16n8k16`: a warp multiplies 16 x 16 float16 numbers by 16 x 8 and adds the result to
16 x 8 float32 sums, the accumulators, of which each lane holds four:

    lane = 4 g + t:  sums (g, 2t), (g, 2t + 1), (g + 8, 2t), (g + 8, 2t + 1)

The operands come from shared memory by `ldmatrix`, four matrices of 8 x 8 numbers at once, each
row at an address that one lane gives. With `.trans` each matrix is transposed on its way.
"""

import abc
import math
from collections.abc import Callable, Iterable, Mapping, Sequence

from onekernel.build import LlvmWriter, ScalarProgram, Value, gpu, run_program

LANES = 32
"""Threads of a warp."""

TILE = 16
"""M and K of m16n8k16: the rows of a product, and the numbers that one step of its sum takes."""

_QUAD = "{i32, i32, i32, i32}"
_SUMS = "{float, float, float, float}"
_PAIR = "<2 x half>"
_TOGETHER = "#0"
"""Attributes of a call for which the threads of a warp must stay together."""

Accumulators = list[list[list[Value]]]
"""Accumulators of a warp: four numbers of a lane for each (row tile of 16, column tile of 8)."""

Operand = Callable[[int, int], list[Value]]
"""Return the fragments of an operand by its tile of 16 rows or columns and the step of the sum."""


class GpuKernel(abc.ABC):
    """A `GpuKernel` writes one kernel, of which each thread of each block runs the same text.

    The third axis of the grid is the replica, and each replica has a row of every array.
    """

    name: str
    """Name of the kernel."""

    arguments: tuple[str, ...]
    """Names of the arrays that it reads or changes."""
    returns: tuple[str, ...]
    """Names of those that it returns, in memory of their own if they are no arguments."""
    networks = 1
    """Number of blocks along the second axis of the grid."""

    def __init__(
        self, shapes: Mapping[str, tuple[int, ...]], blocks: int, threads: int, shared_memory: int
    ) -> None:
        """Prepare to write.

        Args:
          shapes: the shapes of all arrays for one replica.
          blocks: the number of blocks along the first axis of the grid.
          threads: the threads of a block.
          shared_memory: the shared memory that a launch gives to each block [bytes].
        """
        self.shapes, self.blocks = shapes, blocks
        self.threads, self.shared_memory = threads, shared_memory
        self.w = GpuWriter(self.name, len(self.arguments) + len(self.returns))

    @abc.abstractmethod
    def text(self) -> str:
        """Return the kernel as a module of LLVM IR."""

    def find_arrays(self, replica: Value) -> None:
        """Set `arrays` to the addresses of a replica's rows."""
        # Arguments that it changes are among the results, too, at the same addresses.
        names = dict.fromkeys((*self.arguments, *self.returns))
        self.arrays = {
            name: self.w.row(array, replica, math.prod(self.shapes[name]))
            for name, array in zip(names, self.w.parameters, strict=False)
        }


class GpuWriter(LlvmWriter):
    """A `GpuWriter` writes a kernel: addresses in shared memory count bytes, integers are `u32`."""

    def __init__(self, name: str, arrays: int) -> None:
        """Begin with the block `entry`.

        Args:
          name: the name of the kernel.
          arrays: the number of its arrays, whose addresses are `parameters`.
        """
        parameters = (f"ptr addrspace(1) a{i}" for i in range(arrays))
        super().__init__(name, *parameters, convention="ptx_kernel")
        self.declare("attributes #0 = { convergent nounwind }")

    def module(self, threads: int) -> str:
        """Return the module of the kernel, whose blocks have so many threads."""
        return gpu.module_text(self, threads)

    def register(self, name: str) -> Value:
        """Return a special register, for example `tid.x`."""
        return self.call(f"llvm.nvvm.read.ptx.sreg.{name}", result="u32")

    def assembly(self, text: str, *operands: Value, result: str = "float") -> Value:
        """Return the result of an instruction of PTX on floats, which reads no memory."""
        places = ", ".join(f"${i + 1}" for i in range(len(operands)))
        letters = ",".join(["=f" if result == "float" else "=r"] + ["f"] * len(operands))
        given = ", ".join(operand.typed for operand in operands)
        kind = "float" if result == "float" else "i32"
        return self.let(f'call {kind} asm "{text} $0, {places};", "{letters}"({given})', result)

    # Functions of floats, approximate to about 2^-22 but for the hyperbolic tangent with 2^-11.

    def exp(self, x: Value) -> Value:
        """Return the exponential function."""
        return self.assembly("ex2.approx.ftz.f32", x * 1.4426950408889634)

    def reciprocal(self, x: Value) -> Value:
        """Return 1 / x."""
        return self.assembly("rcp.approx.ftz.f32", x)

    def sqrt(self, x: Value) -> Value:
        """Return the square root."""
        return self.assembly("sqrt.approx.ftz.f32", x)

    def tanh(self, x: Value) -> Value:
        """Return the hyperbolic tangent."""
        return self.assembly("tanh.approx.f32", x)

    def total(self, numbers: Iterable[Value]) -> Value:
        """Return the sum of some numbers, added one by one in their order."""
        return sum(numbers, self.constant(0.0))

    def run(self, program: ScalarProgram, values: Iterable[Value]) -> list[Value]:
        """Append a program, and return its results."""
        return run_program(self, program, values, for_gpu=True)

    # Barriers. Without the one between a thread's store and another one's load, these would race.

    def synchronize(self) -> None:
        """Wait for all threads of the block."""
        self.do('call void asm sideeffect "bar.sync 0;", "~{memory}"() #0')

    def synchronize_group(self, group: Value, threads: int) -> None:
        """Wait for as many threads as belong to a group, by its number from 0."""
        # A warp has a barrier of its own; the hardware's barrier 0 is that of the whole block.
        if threads == LANES:
            self.do('call void asm sideeffect "bar.warp.sync -1;", "~{memory}"() #0')
        else:
            self.do(
                f'call void asm sideeffect "bar.sync $0, {threads};", "r,~{{memory}}"'
                f"(i32 {(group + 1).text}) #0"
            )

    # Memory.

    def shared(self, place: Value | int, offset: int = 0) -> Value:
        """Return the pointer to a byte of shared memory."""
        self.declare("@shared = external addrspace(3) global [0 x i8], align 16")
        start = Value(self, "@shared", "ptr addrspace(3)")
        return self.moved(start.at(place, "i8"), offset)

    def moved(self, pointer: Value, offset: int) -> Value:
        """Return a pointer to shared memory, moved by bytes."""
        return pointer.at(offset, "i8") if offset else pointer

    def row(self, array: Value, index: Value, size: int) -> Value:
        """Return the pointer to a row of a global array, which may have more than 2^31 elements."""
        return array + index.to("u64") * size

    # Pairs of float16.

    def pack(self, low: Value, high: Value) -> Value:
        """Round two floats to a pair of float16, the first in the lower half.

        A number too large for float16 becomes the largest one; NaN stays NaN.
        """
        return self.assembly("cvt.rn.satfinite.f16x2.f32", high, low, result="u32")

    def unpack(self, pair: Value) -> tuple[Value, Value]:
        """Return a pair of float16 as floats."""
        # The two halves of 32 bits.
        halves = pair.bits_as(_PAIR)
        low, high = (self.let(f"extractelement {halves.typed}, i32 {i}", "half") for i in (0, 1))
        return low.to("float"), high.to("float")

    # Products.

    def matrices(self, pointer: Value, offset: int, *, transposed: bool) -> list[Value]:
        """Load four matrices of 8 x 8 numbers from the rows that the lanes point at."""
        place = self.moved(pointer, offset)
        kind = ".trans.b16.p3" if transposed else ".b16.p3"
        name = f"llvm.nvvm.ldmatrix.sync.aligned.m8n8.x4{kind}"
        return self._parts(self.call(name, place, result=_QUAD, suffix=_TOGETHER), "u32")

    def zeros(self, rows: int, columns: int) -> Accumulators:
        """Return zeros as the sums of a warp's row and column tiles."""
        return [[[self.constant(0.0)] * 4 for _ in range(columns)] for _ in range(rows)]

    def product(
        self, sums: Accumulators, steps: int, left: Operand, right: Operand
    ) -> Accumulators:
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
            # Load the left fragments once for all columns, the right ones pair by pair.
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
        halves = [pair.bits_as(_PAIR) for pair in (*left, *right)]
        name = "llvm.nvvm.mma.m16n8k16.row.col.f32.f32"
        whole = self.call(name, *halves, *sums, result=_SUMS, suffix=_TOGETHER)
        return self._parts(whole, "float")

    def _parts(self, whole: Value, kind: str) -> list[Value]:
        return [self.let(f"extractvalue {whole.typed}, {i}", kind) for i in range(4)]
