"""Write LLVM IR for the vector units of CPUs: loops, and a product of matrices.

The product keeps a tile of the result in registers, four rows of a few vectors each, and adds one
column of the left matrix times one row of the right matrix to it at each step. Matrices are float32
and given by the address of their first element and by strides; since the left one has a stride for
each axis, the same code also multiplies by its transpose.
"""

import contextlib
import struct
from collections.abc import Iterator, Sequence

from jetbot_mjx.compiler.llvm_codegen import LlvmEmitter
from jetbot_mjx.compiler.lower_jaxpr import ScalarProgram

ROWS = 4
"""Rows of a tile of the result."""

_PRODUCT = "product"


class VectorCode:
    """A `VectorCode` appends the instructions of one function; values are names of registers."""

    def __init__(self, lanes: int) -> None:
        """Begin with the block `entry`.

        Args:
          lanes: the number of float32 values in a vector register.
        """
        self.lines: list[str] = []
        self.lanes = lanes
        self.vector = f"<{lanes} x float>" if lanes > 1 else "float"
        self._label = "entry"
        self._count = 0

    def function(self, name: str, parameters: Sequence[str]) -> str:
        """Return the text of the function; it returns nothing."""
        head = f"define internal void @{name}({', '.join(parameters)}) noinline {{"
        return "\n".join([head, "entry:", *self.lines, "ret void", "}\n"])

    def let(self, instruction: str) -> str:
        """Append an instruction and return its result."""
        self._count += 1
        name = f"%x{self._count}"
        self.do(f"{name} = {instruction}")
        return name

    def do(self, instruction: str) -> None:
        """Append an instruction without a result."""
        self.lines.append(instruction)

    @contextlib.contextmanager
    def loop(self, count: str | int, *, down: bool = False) -> Iterator[str]:
        """Repeat what is appended inside.

        Args:
          count: the number of times, at least 0.
          down: whether to count down to 0 instead of up from it.

        Yields:
          The number of the iteration, from 0.
        """
        self._count += 1
        head, body, end = (f"{name}{self._count}" for name in ("head", "body", "end"))
        index, before = f"%i{self._count}", self._label
        self.do(f"br label %{head}")
        self._begin(head)
        phi = len(self.lines)
        self.do("")
        self.do(f"{index}.more = icmp slt i64 {index}, {count}")
        self.do(f"br i1 {index}.more, label %{body}, label %{end}")
        self._begin(body)
        yield self.let(f"sub i64 {self.sub(count, 1)}, {index}") if down else index
        self.do(f"{index}.next = add i64 {index}, 1")
        self.lines[phi] = f"{index} = phi i64 [0, %{before}], [{index}.next, %{self._label}]"
        self.do(f"br label %{head}")
        self._begin(end)

    def _begin(self, label: str) -> None:
        self.do(f"{label}:")
        self._label = label

    # Integers of 64 bits, and addresses of floats.

    def add(self, one: str | int, other: str | int) -> str:
        """Return a sum."""
        return self.let(f"add i64 {one}, {other}")

    def sub(self, one: str | int, other: str | int) -> str:
        """Return a difference."""
        return self.let(f"sub i64 {one}, {other}")

    def mul(self, one: str | int, other: str | int) -> str:
        """Return a product."""
        return self.let(f"mul i64 {one}, {other}")

    def smaller(self, one: str | int, other: str | int) -> str:
        """Return the smaller of two integers."""
        return self.select(self.let(f"icmp slt i64 {one}, {other}"), "i64", one, other)

    def select(self, condition: str, kind: str, yes: str | int, no: str | int) -> str:
        """Return one of two values."""
        return self.let(f"select i1 {condition}, {kind} {yes}, {kind} {no}")

    def at(self, array: str, *places: str | int) -> str:
        """Return the address of the float at the sum of some places."""
        for place in places:
            if place != 0:
                array = self.let(f"getelementptr float, ptr {array}, i64 {place}")
        return array

    # Floats and vectors in memory.

    def load(self, address: str, kind: str = "float") -> str:
        """Return a value from memory."""
        return self.let(f"load {kind}, ptr {address}, align 4")

    def index(self, address: str) -> str:
        """Return an integer of 32 bits from memory, as one of 64."""
        return self.let(f"sext i32 {self.load(address, 'i32')} to i64")

    def store(self, value: str, address: str, kind: str = "float") -> None:
        """Write a value to memory."""
        self.do(f"store {kind} {value}, ptr {address}, align 4")

    def copy(self, source: str, target: str, kind: str = "float") -> None:
        """Copy a value from one address to another."""
        self.store(self.load(source, kind), target, kind)

    def each(self, first: str, count: str) -> Iterator[tuple[str, str]]:
        """Repeat what is appended for all vectors of a range, and for all numbers that are left.

        Args:
          first: the first number.
          count: how many there are.

        Yields:
          Twice: the place of the vector or number, and its type.
        """
        whole = self.let(f"udiv i64 {count}, {self.lanes}")
        with self.loop(whole) as i:
            yield self.add(first, self.mul(i, self.lanes)), self.vector
        done = self.mul(whole, self.lanes)
        with self.loop(self.sub(count, done)) as i:
            yield self.add(first, self.add(done, i)), "float"

    def accumulate(self, source: str, count: int, target: str) -> None:
        """Add numbers in memory to another one."""
        with self.loop(count) as i:
            value = self.load(self.at(source, i))
            self.store(self.arithmetic("fadd", self.load(target), value), target)

    def fill(self, address: str, count: str | int, value: float = 0.0) -> None:
        """Write a number to an array of floats."""
        with self.loop(count) as i:
            self.store(number(value), self.at(address, i))

    def arithmetic(self, op: str, one: str, other: str, kind: str = "float") -> str:
        """Return the result of an operation of floats or vectors, for example `fadd`."""
        return self.let(f"{op} contract {kind} {one}, {other}")

    def splat(self, value: str) -> str:
        """Return a vector of one number."""
        if self.lanes == 1:
            return value
        first = self.let(f"insertelement {self.vector} poison, float {value}, i64 0")
        return self._shuffle(first, "poison", [0] * self.lanes)

    def transposed(self, rows: Sequence[str]) -> list[str]:
        """Return the columns of a square of vectors, whose number is a power of two."""
        size, result = len(rows), list(rows)
        distance = size // 2
        while distance:
            # Exchange the upper right and the lower left quarter of each square of two distances.
            low = [lane - distance + size if lane & distance else lane for lane in range(size)]
            high = [lane + size if lane & distance else lane + distance for lane in range(size)]
            before = list(result)
            for i in [i for i in range(size) if not i & distance]:
                pair = before[i], before[i + distance]
                result[i], result[i + distance] = (self._shuffle(*pair, x) for x in (low, high))
            distance //= 2
        return result

    def _shuffle(self, one: str, other: str, places: Sequence[int]) -> str:
        mask = ", ".join(f"i32 {place}" for place in places)
        pair = f"{self.vector} {one}, {self.vector} {other}"
        return self.let(f"shufflevector {pair}, <{len(places)} x i32> <{mask}>")

    def run(self, program: ScalarProgram, arguments: Sequence[str]) -> list[str]:
        """Append a program without loops and branches, once in a function; return its results."""
        emitter = LlvmEmitter(program, self.lanes)
        results = emitter.step(arguments)
        assert emitter.label == "entry"
        self.lines += emitter.lines
        return results

    def call(self, name: str, *arguments: str | int) -> None:
        """Call a function of this module; names in a template are addresses, numbers are i64."""
        self.do(f"call void @{name}({', '.join(map(str, arguments))})")

    def product(
        self,
        left: tuple[str, str | int, str | int],
        right: tuple[str, str | int],
        result: tuple[str, str | int],
        sizes: tuple[str | int, str | int, str | int],
        *,
        adds: bool = False,
    ) -> None:
        """Multiply two matrices.

        Args:
          left: address, stride from row to row, and stride along the sum.
          right: address, and stride along the sum; its rows are contiguous.
          result: address, and stride from row to row; its rows are contiguous.
          sizes: rows, columns (a multiple of a vector's lanes), and length of the sum.
          adds: whether to add the product to the result instead of replacing it.
        """
        addresses = [f"ptr {left[0]}", f"i64 {left[1]}", f"i64 {left[2]}"]
        for address, stride in (right, result):
            addresses += [f"ptr {address}", f"i64 {stride}"]
        numbers = [f"i64 {size}" for size in sizes]
        self.call(_PRODUCT, *addresses, *numbers, f"i1 {str(adds).lower()}")


def number(value: float) -> str:
    """Return a float as LLVM writes it: by the bits of a double."""
    (rounded,) = struct.unpack("f", struct.pack("f", value))
    return f"0x{struct.pack('>d', rounded).hex().upper()}"


def product_text(lanes: int, registers: int) -> str:
    """Write the function that `VectorCode.product` calls, and what it calls.

    Args:
      lanes: the number of float32 values in a vector register.
      registers: the number of vector registers.

    Returns:
      The text of the functions.
    """
    columns = 4 if registers >= 32 else 2
    tiles = (_tile_text(r, c, lanes) for r in (ROWS, 1) for c in (columns, 1))
    return "\n".join([*tiles, _blocks_text(columns, lanes)])


_PARAMETERS = (
    "ptr noalias %a",
    "i64 %a.row",
    "i64 %a.step",
    "ptr noalias %b",
    "i64 %b.step",
    "ptr noalias %c",
    "i64 %c.row",
)


def _tile_name(rows: int, columns: int) -> str:
    return f"{_PRODUCT}.{rows}.{columns}"


def _blocks_text(columns: int, lanes: int) -> str:
    """Write the function that divides a product into tiles."""
    code = VectorCode(lanes)

    def tile(rows: int, vectors: int, row: str, column: str) -> None:
        a = code.at("%a", code.mul(row, "%a.row"))
        c = code.at("%c", code.mul(row, "%c.row"), column)
        code.call(
            _tile_name(rows, vectors),
            *(f"ptr {a}", "i64 %a.row", "i64 %a.step"),
            *(f"ptr {code.at('%b', column)}", "i64 %b.step", f"ptr {c}", "i64 %c.row"),
            *("i64 %steps", "i1 %adds"),
        )

    def down(vectors: int, column: str) -> None:
        # The columns of the right matrix stay in the cache while all rows pass.
        blocks = code.let(f"udiv i64 %rows, {ROWS}")
        with code.loop(blocks) as i:
            tile(ROWS, vectors, code.mul(i, ROWS), column)
        first = code.mul(blocks, ROWS)
        with code.loop(code.sub("%rows", first)) as i:
            tile(1, vectors, code.add(first, i), column)

    wide = columns * lanes
    blocks = code.let(f"udiv i64 %columns, {wide}")
    with code.loop(blocks) as i:
        down(columns, code.mul(i, wide))
    first = code.mul(blocks, wide)
    rest = code.let(f"udiv i64 {code.sub('%columns', first)}, {lanes}")
    with code.loop(rest) as i:
        down(1, code.add(first, code.mul(i, lanes)))
    return code.function(
        _PRODUCT, [*_PARAMETERS, "i64 %rows", "i64 %columns", "i64 %steps", "i1 %adds"]
    )


def _tile_text(rows: int, columns: int, lanes: int) -> str:
    """Write the function that computes one tile of a product."""
    code = VectorCode(lanes)
    vector = code.vector
    tiles = [(r, c) for r in range(rows) for c in range(columns)]
    left = [code.at("%a", code.mul("%a.row", r)) for r in range(rows)]
    result = [code.at("%c", code.mul("%c.row", r)) for r in range(rows)]
    places = {(r, c): code.at(result[r], c * lanes) for r, c in tiles}
    first = {}
    for at in tiles:
        before = code.load(places[at], vector)
        first[at] = code.select("%adds", vector, before, "zeroinitializer")
    code.do("br label %steps.begin")
    code.do("steps.begin:")
    code.do("%k = phi i64 [0, %entry], [%k.next, %steps.begin]")
    code.do("%a.at = phi i64 [0, %entry], [%a.next, %steps.begin]")
    code.do("%b.at = phi ptr [%b, %entry], [%b.next, %steps.begin]")
    for r, c in tiles:
        code.do(f"%s{r}.{c} = phi {vector} [{first[r, c]}, %entry], [%n{r}.{c}, %steps.begin]")
    right = [code.load(code.at("%b.at", c * lanes), vector) for c in range(columns)]
    for r in range(rows):
        one = code.load(code.at(left[r], "%a.at"))
        alone = code.let(f"insertelement {vector} poison, float {one}, i64 0")
        mask = f"<{lanes} x i32> zeroinitializer"
        each = code.let(f"shufflevector {vector} {alone}, {vector} poison, {mask}")
        for c in range(columns):
            code.do(
                f"%n{r}.{c} = call {vector} @llvm.fmuladd.v{lanes}f32"
                f"({vector} {each}, {vector} {right[c]}, {vector} %s{r}.{c})"
            )
    code.do("%k.next = add i64 %k, 1")
    code.do("%a.next = add i64 %a.at, %a.step")
    code.do("%b.next = getelementptr float, ptr %b.at, i64 %b.step")
    code.do("%more = icmp slt i64 %k.next, %steps")
    code.do("br i1 %more, label %steps.begin, label %steps.end")
    code.do("steps.end:")
    for r, c in tiles:
        code.store(f"%n{r}.{c}", places[r, c], vector)
    return code.function(_tile_name(rows, columns), [*_PARAMETERS, "i64 %steps", "i1 %adds"])


def product_declarations(lanes: int) -> str:
    """Return the declaration of the intrinsic that the product calls."""
    vector = f"<{lanes} x float>"
    return f"declare {vector} @llvm.fmuladd.v{lanes}f32({vector}, {vector}, {vector})"
