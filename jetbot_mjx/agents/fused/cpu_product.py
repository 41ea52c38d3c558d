"""Write products of matrices on CPUs, and other loops over numbers in memory.

A product keeps a register tile of the result, four rows of a few vectors each, and adds one
column of the left matrix times one row of the right matrix to it at each step.
"""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager
from typing import NamedTuple

from onekernel.build import LlvmWriter, Value

ROWS = 4
"""Rows of a register tile."""

_MATMUL = "matmul"


class Matrix(NamedTuple):
    """A `Matrix` is the place of a matrix of floats in memory."""

    start: Value
    """Address of its first element."""
    row: Value | int
    """Floats from row to row."""
    column: Value | int = 1
    """Floats from column to column."""

    @property
    def transposed(self) -> "Matrix":
        """Return the same numbers with rows as columns."""
        return Matrix(self.start, self.column, self.row)


def matmul(
    left: Matrix,
    right: Matrix,
    result: Matrix,
    sizes: tuple[Value | int, Value | int, Value | int],
    *,
    adds: bool = False,
) -> None:
    """Call the function that multiplies two matrices.

    Args:
      left: the left matrix.
      right: the right one, whose rows are contiguous.
      result: the product, whose rows are contiguous.
      sizes: rows, columns (a multiple of a vector's lanes), and length of the sum.
      adds: whether to add the product to the result instead of replacing it.
    """
    w = result.start.writer

    # Sizes that are known now become constants.
    def value(x: Value | int) -> Value:
        return x if isinstance(x, Value) else w.constant(x, "u64")

    places = [*left, *right[:2], *result[:2], *sizes]
    w.call(_MATMUL, *map(value, places), w.constant(adds, "i1"))


def product_functions(lanes: int, registers: int) -> list[LlvmWriter]:
    """Write the function that `matmul` calls, and those that it calls.

    Args:
      lanes: the number of float32 values in a vector register.
      registers: the number of vector registers.
    """
    columns = 4 if registers >= 32 else 2
    tiles = [_tile_function(r, c, lanes) for r in (ROWS, 1) for c in (columns, 1)]
    return [*tiles, _product_function(columns, lanes)]


_PARAMETERS = (
    *("ptr noalias a", "u64 a.row", "u64 a.column"),
    *("ptr noalias b", "u64 b.row", "ptr noalias c", "u64 c.row"),
)


def _product_function(columns: int, lanes: int) -> LlvmWriter:
    """Write the function that divides a product into register tiles.

    Args:
      columns: the number of vectors in a row of a register tile.
      lanes: the number of float32 values in a vector.
    """
    sizes = "u64 rows", "u64 columns", "u64 length", "i1 adds"
    w = LlvmWriter(_MATMUL, *_PARAMETERS, *sizes)
    a, a_row, a_column, b, b_row, c, c_row, rows, width, length, adds = w.parameters

    def tile(height: int, vectors: int, row: Value, column: Value) -> None:
        left, result = a + row * a_row, c + row * c_row + column
        places = left, a_row, a_column, b + column, b_row, result, c_row
        w.call(_tile_name(height, vectors), *places, length, adds)

    # Go down through all rows, first by whole register tiles and then one by one.
    def down(vectors: int, column: Value) -> None:
        # The columns of the right matrix stay in the cache while all rows pass.
        blocks = rows // ROWS
        with w.loop(blocks) as i:
            tile(ROWS, vectors, i * ROWS, column)
        first = blocks * ROWS
        with w.loop(rows - first) as i:
            tile(1, vectors, first + i, column)

    # Take register tiles of full width, and then those of one vector.
    wide = columns * lanes
    blocks = width // wide
    with w.loop(blocks) as i:
        down(columns, i * wide)
    first = blocks * wide
    with w.loop((width - first) // lanes) as i:
        down(1, first + i * lanes)
    return w


def _tile_name(rows: int, columns: int) -> str:
    return f"{_MATMUL}.{rows}.{columns}"


def _tile_function(rows: int, columns: int, lanes: int) -> LlvmWriter:
    """Write the function that computes a register tile: rows of some vectors each."""
    name = _tile_name(rows, columns)
    w = LlvmWriter(name, *_PARAMETERS, "u64 length", "i1 adds", lanes=lanes)
    a, a_row, a_column, b, b_row, c, c_row, length, adds = w.parameters
    # Load the sums that the product is added to, or begin with zeros.
    left = [a + a_row * r for r in range(rows)]
    result = [c + c_row * r for r in range(rows)]
    places = [line + i * lanes for line in result for i in range(columns)]
    sums = [w.select(adds, place.load(w.vector), 0.0) for place in places]
    zero = w.constant(0, "u64")
    with w.repeat(zero, zero, b, *sums) as loop:
        step, column, row, *sums = loop.carried
        # Add a column of the left matrix times a row of the right one.
        right = [(row + i * lanes).load(w.vector) for i in range(columns)]
        before, sums = iter(sums), []
        for line in left:
            factor = line[column].splat(lanes)
            sums += [w.intrinsic("fmuladd", factor, x, next(before)) for x in right]
        following = step + 1, column + a_column, row + b_row
        loop.again(following[0] < length, *following, *sums)
    # Store the register tile.
    for place, total in zip(places, sums, strict=True):
        place.store(total)
    return w


# Loops over numbers in memory.


def fill(array: Value, count: Value | int, number: float = 0.0) -> None:
    """Write a number to an array of floats."""
    with array.writer.loop(count) as i:
        array[i] = number


def add_all(source: Value, count: Value | int, target: Value) -> None:
    """Add the floats of an array to another float in memory."""
    with target.writer.loop(count) as i:
        add_to(target, source[i])


def add_to(target: Value, value: Value) -> None:
    """Add a number or a vector to one in memory."""
    target.store(target.load(value.type) + value)


def vector_loops(first: Value, count: Value) -> Iterator[tuple[str, AbstractContextManager[Value]]]:
    """Yield the two loops that go through a range: over whole vectors, and over the numbers left.

    Args:
      first: the first number.
      count: how many there are.

    Yields:
      The type of what the loop goes through, and the loop, which yields its place.
    """
    w = first.writer

    @contextlib.contextmanager
    def loop(count: Value, place: Callable[[Value], Value]) -> Iterator[Value]:
        with w.loop(count) as i:
            yield place(i)

    whole = count // w.lanes
    yield w.vector, loop(whole, lambda i: first + i * w.lanes)
    done = whole * w.lanes
    yield "float", loop(count - done, lambda i: first + (done + i))


def rounded_up(number: Value, multiple: int) -> Value:
    """Return how many multiples hold a number."""
    return (number + (multiple - 1)) // multiple


def transposed(rows: Sequence[Value]) -> list[Value]:
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
            for place, lanes in ((i, low), (i + distance, high)):
                result[place] = pair[0].writer.shuffle(*pair, lanes)
        distance //= 2
    return result
