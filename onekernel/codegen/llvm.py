"""Write a scalar program as LLVM IR, for CPUs and GPUs.

On a CPU every scalar of the program is a vector register of, say, 8 numbers. Each place in the
vector, a lane, runs the whole program for one instance. On a GPU each thread runs it for one
instance, with plain scalars. So does a CPU for a single instance, with the same instructions in the
same blocks as for vectors: LLVM then fuses the same products and sums, and the bits are the same.

The lanes of a vector cannot jump on their own. So a loop goes on until it has ended for all lanes.
A lane that ends earlier keeps its values, and its results do not depend on the other lanes. A side
of a branch is skipped only if no lane takes it. A mask says which lanes execute a block: those that
have left an enclosing loop, or took the other side of an enclosing branch, do not count.

An array is in memory, where on a CPU a vector holds an element for all lanes. In a counted loop,
all lanes are in the same iteration, so one load or store serves them; by any other index, each lane
loads its element alone. Lanes that do not execute a block store whatever they have: they do not
load it again, because a load is inside of the block that stores. In the memory of a CPU, what an
iteration stores is side by side: arrays one behind the other would be hundreds of pages that are
written in turns.

Source: LLVM Language Reference Manual.
"""

import functools
import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from onekernel.codegen.instructions import ELEMENTS, Target, write_of
from onekernel.codegen.writer import LlvmWriter, Value, llvm_type, vector
from onekernel.errors import UnsupportedError
from onekernel.lower import (
    Block,
    Expr,
    Item,
    PlacedBranch,
    PlacedLoop,
    Scalar,
    ScalarProgram,
    far_angle,
    is_constant,
    is_table,
    length_of,
    ordered,
    recomputable,
    same_size,
)

_FAR_ANGLES = ("quarter_turns", "angle_rest")

STEP = "step"
"""Name of the function that runs one step, or all items."""


def run_program(
    writer: LlvmWriter, program: ScalarProgram, arguments: Iterable[Value], *, for_gpu: bool = False
) -> list[Value]:
    """Append one run of a program to a function.

    Args:
      writer: the writer of the function, whose lanes run the program side by side.
      program: the program, whose arguments must be float32.
      arguments: the scalars of its arguments.
      for_gpu: whether the function is for an NVIDIA GPU.

    Returns:
      The scalars of its results.

    Raises:
      UnsupportedError: the program has an operation that has no LLVM instruction here.
    """
    return list(ProgramWriter(writer, program, for_gpu=for_gpu).finish(arguments))


def memory_bytes(program: ScalarProgram, lanes: int) -> int:
    """Return the bytes of memory, a multiple of 64, that a program's arrays take.

    Args:
      program: the program.
      lanes: the number of instances or items that run it side by side.
    """
    return sum(_size_of(together, lanes) for together in program.block.arrays())


def tile_function(
    program: ScalarProgram, *, lanes: int, name: str, rows: Sequence[int]
) -> LlvmWriter:
    """Write a function that runs a program on a tile.

    The function's parameter is the address of a tile, whose rows are `lanes` float32 values, one of
    each instance, and are aligned to their size. The results are written to the first rows. If the
    program has arrays, a second one is the address of `memory_bytes`, aligned to 64 bytes.

    Args:
      program: the program.
      lanes: the number of instances that the function steps side by side.
      name: the name of the function.
      rows: the row of each scalar of the arguments.

    Raises:
      UnsupportedError: the program has an operation that has no LLVM instruction here.
    """
    # `noalias` promises LLVM that no other address reaches this memory, so it may reorder loads and
    # stores.
    names = ("ptr noalias tile", *_memory_parameter(program))
    w = LlvmWriter(name, *names, lanes=lanes, keeps_blocks=lanes == 1)
    tile, *memory = w.parameters

    def load(row: int) -> Value:
        return tile.at(row, w.vector).load(w.vector, align=4 * lanes)

    # The steps of a scan of a single instance wait for each other more than for what was spilled:
    # in the order of the function, they are up to a fifth faster.
    program = ordered(program, scans=lanes > 1)
    # An argument that goes to an array is loaded when it is stored there: of thousands of them, few
    # wait in registers. One that is a result, too, must be loaded before results replace it.
    body = ProgramWriter(w, program, memory=memory[0] if memory else None)
    in_arrays = _sources(
        x for together in program.block.arrays() for array in together for x in array.operands
    )
    in_arrays -= _sources(x for array in program.outputs for x in array.ravel())
    scalars = [x for array in program.inputs for x in array.ravel()]
    arguments = [
        functools.partial(load, row) if x.index in in_arrays else load(row)
        for x, row in zip(scalars, rows, strict=True)
    ]
    for row, result in enumerate(body.finish(arguments)):
        w.divide(row)
        tile.at(row, w.vector).store(result, align=4 * lanes)
    return w


def _memory_parameter(program: ScalarProgram) -> list[str]:
    """Return the parameter of a function that runs a program with arrays; without, none."""
    return ["ptr noalias memory"] if any(program.block.arrays()) else []


def _sources(scalars: Iterable[Scalar]) -> set[int]:
    """Return the indices of the scalars from which some words are converted."""
    return {x.index for x in map(_source, scalars) if not is_constant(x)}


def map_function(program: ScalarProgram, *, lanes: int, items: int) -> LlvmWriter:
    """Write a function that runs a program for every item of an instance.

    The parameters of the function are the addresses of an instance's arguments, one after the
    other, of the table with a row of `items` values for each scalar of the program's last argument,
    all float32, and of the results, bytes of one item after the other; and that of memory for
    arrays as for `tile_function`.

    Args:
      program: the function of (arguments of an instance ..., a column of the table), with scalar
        results.
      lanes: the number of items that are computed side by side.
      items: the number of items, at least `lanes`.

    Raises:
      UnsupportedError: the program has an operation that has no LLVM instruction here.
    """
    *shared, row = [array.size for array in program.inputs]
    names = (*(f"in{i}" for i in range(len(shared))), "table", "out")
    parameters = [*(f"ptr noalias {name}" for name in names), *_memory_parameter(program)]
    w = LlvmWriter(STEP, *parameters, lanes=lanes)
    arrays, (table, out, *memory) = w.parameters[: len(shared)], w.parameters[len(shared) :]
    # Load the arguments that the items share, and compute the operations on these alone, once.
    body = ProgramWriter(w, program, memory=memory[0] if memory else None)
    body.hoist(
        array[j].splat(lanes)
        for array, size in zip(arrays, shared, strict=True)
        for j in range(size)
    )
    # Compute a group of items; the last group may overlap with the one before.
    with w.repeat(w.constant(0, "u64")) as loop:
        (group,) = loop.carried
        item = w.select(group > items - lanes, items - lanes, group)
        # Neighbouring items of a row are neighbours in memory: one load fills all lanes.
        columns = [(table + j * items + item).load(w.vector) for j in range(row)]
        results = list(body.finish(columns))
        out.at(item * len(results), "u8").store(_interleaved(w, results))
        following = group + lanes
        loop.again(following < items, following)
    return w


def _interleaved(w: LlvmWriter, results: Sequence[Value]) -> Value:
    """Convert vectors of floats from 0 to 255 to bytes, those of a lane one after the other."""
    lanes, count = w.lanes, len(results)
    # Join two vectors at a time; then bring the bytes of each lane together.
    joined, *others = (result.to("u8") for result in results)
    for i, part in enumerate(others, start=1):
        # Both operands of a shuffle have one length.
        padding = [None] * ((i - 1) * lanes)
        part = w.shuffle(part, None, [*range(lanes), *padding])
        joined = w.shuffle(joined, part, range((i + 1) * lanes))
    # The joined vector has all first results, then all second ones, and so on: read across it.
    places = [i * lanes + lane for lane in range(lanes) for i in range(count)]
    return w.shuffle(joined, None, places) if others else joined


def require(program: ScalarProgram) -> None:
    """Check that a program can be written as LLVM IR for CPUs, without writing it.

    Raises:
      UnsupportedError: the program has an operation that has no LLVM instruction here.
    """
    _inputs(program)
    for value in program.block.values():
        if value.op not in ("array", "load"):
            write_of(value)


def _inputs(program: ScalarProgram, *, is_part: bool = False) -> list[Expr]:
    """Return the scalars of a program's arguments.

    Raises:
      UnsupportedError: one of them is not float32, and it is no part of a program.
    """
    inputs = [x for array in program.inputs for x in array.ravel()]
    if not is_part and any(x.dtype != np.float32 for x in inputs):
        raise UnsupportedError("an argument that is not float32")
    return inputs


class _Array(NamedTuple):
    """An `_Array` is where the numbers of an array are."""

    rows: Value
    """The address of the first row."""
    row: str
    """A type of the size of a row."""
    offset: int = 0
    """Bytes in a row before the number of the array, of all lanes."""


def _row_bytes(together: Sequence[Expr], lanes: int) -> int:
    """Return the bytes of a row: a number of each array."""
    return lanes * sum(x.dtype.itemsize for x in together)


def _size_of(together: Sequence[Expr], lanes: int) -> int:
    """Return the bytes of arrays whose numbers are side by side, a multiple of 64."""
    return 64 * -(-length_of(together[0]) * _row_bytes(together, lanes) // 64)


class ProgramWriter:
    """A `ProgramWriter` appends the operations of one program to a function."""

    def __init__(
        self,
        writer: LlvmWriter,
        program: ScalarProgram,
        *,
        fast_division: bool = False,
        for_gpu: bool = False,
        is_part: bool = False,
        memory: Value | None = None,
    ) -> None:
        """Begin without values.

        Args:
          writer: the writer of the function; with one lane, values are scalars instead of vectors.
          program: the program, whose arguments must be float32.
          fast_division: whether division and square root may be off by some units in the last
            place, as a GPU's own instructions for them are.
          for_gpu: whether the function is for an NVIDIA GPU. Only such a function can run a program
            that `scalarize` has lowered with `approximate`.
          is_part: whether arguments of other dtypes are given as such.
          memory: the address of memory for arrays, as for `tile_function`; None: they are on the
            stack of the thread.

        Raises:
          UnsupportedError: an argument is not float32.
        """
        self._inputs = _inputs(program, is_part=is_part)
        self._writer = writer
        self._on = Target(writer, "afn" if fast_division else "", for_gpu)
        self._program = program
        self._rest: list[Item] = program.block.items
        self._values: dict[int, Value | Callable[[], Value]] = {}
        # The arrays, how many bytes of the memory they take, and the counters of loops, one number
        # for all lanes.
        self._arrays: dict[int, _Array] = {}
        self._rows: dict[tuple[str, str, str], Value] = {}
        self._memory, self._taken = memory, 0
        self._counters: dict[int, Value] = {}
        # The values that the current loops compute again instead of keeping them in registers, and
        # what has been computed again so far, by the index of the value and the basic block.
        self._recomputed: frozenset[int] = frozenset()
        self._again: dict[tuple[int, str], Value] = {}
        # A vector of truth values: the lanes that execute the current block; None: all lanes.
        self._mask: Value | None = None

    def hoist(self, arguments: Iterable[Value]) -> None:
        """Append the operations that depend on nothing but the first arguments.

        Args:
          arguments: the scalars of these arguments.
        """
        for x, value in zip(self._inputs, arguments, strict=False):
            self._values[x.index] = value
        # Items stand behind what they depend on, so one pass finds all of them. A loop or branch
        # stays.
        rest: list[Item] = []
        for item in self._rest:
            if isinstance(item, Expr) and all(
                is_constant(x) or x.index in self._values for x in item.operands
            ):
                self._operation(item)
            else:
                rest.append(item)
        self._rest = rest

    def finish(self, arguments: Iterable[Value | Callable[[], Value]]) -> Iterator[Value]:
        """Append the other operations.

        Args:
          arguments: the scalars of the arguments that `hoist` was not given, or functions that load
            them anew for every use.

        Returns:
          The scalars of the program's results, of which those in memory are loaded one by one.
        """
        # The other arguments are known only now, such as the columns of a table in a loop over its
        # items.
        others = [x for x in self._inputs if x.index not in self._values]
        self._values |= {x.index: value for x, value in zip(others, arguments, strict=True)}
        self._block(Block(items=list(self._rest)))
        return (self._operand(x) for array in self._program.outputs for x in array.ravel())

    def _operand(self, x: Scalar) -> Value:
        if not is_constant(x):
            if self._is_deferred(x):
                return self._load(x) if x.op == "load" else self._computed(x)
            if x.index in self._recomputed:
                return self._computed_again(x)
            if x.op == "counter":
                return self._counters[x.index].splat(self._writer.lanes)
            value = self._values[x.index]
            return value if isinstance(value, Value) else value()
        if x.dtype.kind == "f" and np.isnan(x):
            # The bits of an integer that is passed as a float may be those of a NaN. LLVM's text of
            # a NaN would not keep all of them: write the integer, and reinterpret it.
            word = x.view(same_size("i", x.dtype))
            whole = self._writer.constant(int(word), self._on.type(word.dtype))
            return whole.bits_as(self._on.type(x.dtype))
        return self._writer.constant(x.item(), self._on.type(x.dtype))

    def _any(self, condition: Value) -> Value:
        """Return whether a condition holds in any lane."""
        w = self._writer
        if w.lanes == 1:
            return condition
        return w.call(f"llvm.vector.reduce.or.v{w.lanes}i1", condition, result="i1")

    # Blocks, loops and branches.

    def _block(self, block: Block) -> None:
        for item in block.items:
            if isinstance(item, PlacedLoop):
                enclosing = self._recomputed
                # A CPU reads a value from memory as cheaply as it computes it again.
                self._recomputed |= recomputable(item) if self._on.for_gpu else frozenset()
                write = self._loop if item.loop.counter is None else self._counted_loop
                write(item)
                self._recomputed = enclosing
            elif isinstance(item, PlacedBranch):
                self._branch(item)
            else:
                self._operation(item)

    def _masked_block(self, block: Block, mask: Value) -> None:
        """Append a block that only some of the active lanes execute."""
        enclosing = self._mask
        # With a single lane, the block is run for that lane or skipped, so no mask is needed.
        self._mask = mask if self._writer.lanes > 1 else None
        self._block(block)
        self._mask = enclosing

    def _counted_loop(self, item: PlacedLoop) -> None:
        w, loop = self._writer, item.loop
        counter, length = loop.counter, loop.length
        assert counter is not None
        assert length is not None
        self._allocate(item.stacks)
        # As in `_loop`, but the counter alone decides. Lanes that do not execute the enclosing
        # block go through the iterations, too, and nobody takes their values.
        carries = [loop.carries[place] for place in item.places]
        first = w.constant(length - 1 if loop.reverse else 0, "i32")
        initial = [first, *(self._operand(loop.initial[place]) for place in item.places)]
        head, body, end = w.labels("head", "body", "end")
        before = w.label
        w.jump(head)
        w.begin(head)
        phis = [w.phi(value.type) for value in initial]
        count = self._counters[counter.index] = phis[0].value
        self._values |= {x.index: phi.value for x, phi in zip(carries, phis[1:], strict=True)}
        self._block(item.head)
        w.branch(count >= 0 if loop.reverse else count < length, body, end)
        w.begin(body)
        self._block(item.body)
        # Store what the iteration returns.
        for stack in item.stacks:
            value = self._operand(loop.stacked[stack.place])
            self._store(stack, count, value)
        following = count + (-1 if loop.reverse else 1)
        updated = [following, *(self._operand(loop.updated[place]) for place in item.places)]
        for phi, start, new in zip(phis, initial, updated, strict=True):
            phi.joins(start, before)
            phi.joins(new)
        w.jump(head)
        w.begin(end)
        for result in item.results:
            self._values[result.index] = self._operand(loop.results[result.place])

    def _loop(self, item: PlacedLoop) -> None:
        # The loop has two blocks of code: `head` computes the condition, and `body` an iteration.
        # Begin the head with one phi for each carry, and one for the lanes that are still active.
        w, loop = self._writer, item.loop
        carries = [loop.carries[place] for place in item.places]
        initial = [self._operand(loop.initial[place]) for place in item.places]
        initial.append(
            w.constant(True, self._on.type(np.dtype(bool))) if self._mask is None else self._mask
        )
        head, body, end = w.labels("head", "body", "end")
        before = w.label
        w.jump(head)
        w.begin(head)
        phis = [w.phi(value.type) for value in initial]
        self._values |= {x.index: phi.value for x, phi in zip(carries, phis, strict=False)}
        # Compute the condition, and then an iteration for the lanes in which it holds.
        self._block(item.head)
        active = phis[-1].value & self._operand(loop.condition)
        w.branch(self._any(active), body, end)
        w.begin(body)
        self._masked_block(item.body, active)
        # A lane that has ended keeps its values: the vector goes on until all lanes have ended.
        updated = [self._operand(loop.updated[place]) for place in item.places]
        if w.lanes > 1:
            updated = [
                w.select(active, new, phi.value) for phi, new in zip(phis, updated, strict=False)
            ]
        # At the head, the values are the initial ones on the way from before the loop, and the
        # updated ones on the way back.
        for phi, first, following in zip(phis, initial, [*updated, active], strict=True):
            phi.joins(first, before)
            phi.joins(following)
        w.jump(head)
        # Take the results from the block of the condition.
        w.begin(end)
        for result in item.results:
            self._values[result.index] = self._operand(loop.results[result.place])

    def _branch(self, item: PlacedBranch) -> None:
        branch = item.branch
        condition = self._operand(branch.condition)
        if_true = [branch.if_true[x.place] for x in item.results]
        if_false = [branch.if_false[x.place] for x in item.results]
        if not item.if_false.items:
            # One side computes nothing: run the other one, and take the ready values in all lanes
            # that do not take it.
            values = self._side(item.if_true, condition, if_true, if_false)
        elif not item.if_true.items:
            values = self._side(item.if_false, ~condition, if_false, if_true)
        else:
            # Both sides compute: run one and then the other, each skipped if no lane takes it. The
            # first leaves its values for the lanes that did not take the second.
            there = self._side(item.if_true, condition, if_true, None)
            values = self._side(item.if_false, ~condition, if_false, there)
        for result, value in zip(item.results, values, strict=True):
            self._values[result.index] = value

    def _side(
        self,
        block: Block,
        condition: Value,
        scalars: Sequence[Scalar],
        others: Sequence[Scalar] | Sequence[Value] | None,
    ) -> list[Value]:
        """Append one side of a branch.

        Args:
          block: the operations of this side.
          condition: the condition under which a lane takes this side.
          scalars: the values of this side.
          others: the values of the lanes that do not take it; None: they may have any values.

        Returns:
          The values after the branch.
        """
        w = self._writer
        # Lanes that do not execute the enclosing block take no side.
        taking = condition if self._mask is None else condition & self._mask
        absent = [Value(w, "zeroinitializer", self._on.type(x.dtype)) for x in scalars]
        if others is not None:
            absent = [x if isinstance(x, Value) else self._operand(x) for x in others]
        # Jump over the side if no lane takes it; behind it, both ways meet.
        taken, end = w.labels("taken", "end")
        before = w.label
        w.branch(self._any(taking), taken, end)
        w.begin(taken)
        self._masked_block(block, taking)
        values = [self._operand(x) for x in scalars]
        if others is not None and w.lanes > 1:
            values = [w.select(condition, *pair) for pair in zip(values, absent, strict=True)]
        after = w.label
        w.jump(end)
        w.begin(end)
        # The values depend on the way: computed on this side, or those of the lanes that did not
        # take it.
        phis = [w.phi(value.type) for value in values]
        for phi, value, other in zip(phis, values, absent, strict=True):
            phi.joins(value, after)
            phi.joins(other, before)
        return [phi.value for phi in phis]

    # Arrays.

    def _allocate(self, together: Sequence[Expr]) -> None:
        """Take memory for arrays of one length, whose numbers are side by side."""
        w = self._writer
        if self._memory is None:
            for array in together:
                type, align = self._on.type(array.dtype), self._alignment(array.dtype)
                rows = w.allocate(length_of(array), type, align=align)
                self._arrays[array.index] = _Array(rows, type)
        elif together:
            rows = self._memory.at(self._taken, "u8")
            row, offset = f"[{_row_bytes(together, w.lanes)} x i8]", 0
            for array in together:
                self._arrays[array.index] = _Array(rows, row, offset)
                offset += array.dtype.itemsize * w.lanes
            self._taken += _size_of(together, w.lanes)

    def _address(self, array: _Array, place: Value | int) -> Value:
        """Return the address of a number of an array, of all lanes."""
        # Compute the address of a row once in a basic block: its numbers are at constant distances.
        # LLVM finds that out for few arrays, and keeps an address for each of many.
        text = place.text if isinstance(place, Value) else str(place)
        key = array.rows.text, text, self._writer.label
        if key not in self._rows:
            self._rows[key] = array.rows.at(place, array.row)
        row = self._rows[key]
        return row.at(array.offset, "u8") if array.offset else row

    def _alignment(self, dtype: np.dtype) -> int:
        """Return the bytes to which numbers of all lanes are aligned in an array."""
        # In a row, wide numbers may be behind a narrow one.
        return (dtype.itemsize if self._memory is None else 4) * self._writer.lanes

    def _store(self, array: Expr, place: Value | int, value: Value) -> None:
        address = self._address(self._arrays[array.index], place)
        address.store(value, align=self._alignment(array.dtype))

    def _array(self, array: Expr) -> None:
        """Append an array of given scalars."""
        if is_table(array):
            element = ELEMENTS[array.dtype]
            self._arrays[array.index] = _Array(self._table(array), element)
            return
        self._allocate([array])
        for i, x in enumerate(array.operands):
            self._writer.divide(i)
            self._store(array, i, self._operand(x))

    def _table(self, array: Expr) -> Value:
        """Return the address of an array of constants, of which the module has one for all lanes.

        Its words are written as integers, which keep the bits of a NaN.
        """
        kind = same_size("i", array.dtype)
        numbers = np.array([np.asarray(x) for x in array.operands]).view(kind)
        element, size = ELEMENTS[kind], kind.itemsize
        # The same bytes may be a table of 32 and of 64 bits.
        content = numbers.tobytes() + (b"" if size == 4 else element.encode())
        name = f"@table_{hashlib.sha256(content).hexdigest()[:16]}"
        words = ", ".join(f"{element} {number}" for number in numbers)
        # On a GPU, it is in address space 1, as the arrays of XLA.
        space = " addrspace(1)" if self._on.for_gpu else ""
        type = f"[{len(numbers)} x {element}]"
        self._writer.declare(f"{name} = internal{space} constant {type} [{words}], align {size}")
        return Value(self._writer, name, f"ptr{space}")

    def _load(self, value: Expr) -> Value:
        """Append a load of a scalar of an array."""
        w = self._writer
        array, index = value.operands
        assert isinstance(array, Expr)
        numbers, is_one = self._arrays[array.index], is_table(array)
        element, vectors = ELEMENTS[value.dtype], self._on.type(value.dtype)
        # A constant or a counter is the same in all lanes: load the vector of all of them, or the
        # one number of a table.
        if is_constant(index) or index.op == "counter":
            place = int(index) if is_constant(index) else self._counters[index.index]
            if is_one:
                return self._address(numbers, place).load(element).splat(w.lanes)
            return self._address(numbers, place).load(vectors, align=self._alignment(value.dtype))
        places, align = self._operand(index), None if is_one or self._memory is None else 4
        if w.lanes == 1:
            return self._address(numbers, places).load(element, align=align)
        # Otherwise each lane loads its own number, which in memory is among those of its vector.
        result = Value(w, "poison", vectors)
        for lane in range(w.lanes):
            place = w.let(f"extractelement {places.typed}, i64 {lane}", "i32")
            address = self._address(numbers, place)
            address = address if is_one else address.at(lane, element)
            number = address.load(element, align=align)
            result = w.let(
                f"insertelement {llvm_type(vectors)} {result.text}, {number.typed}, i64 {lane}",
                vectors,
            )
        return result

    def _operation(self, value: Expr) -> None:
        if value.op == "array":
            self._array(value)
            return
        if self._is_deferred(value):
            return
        write = self._load if value.op == "load" else self._computed
        self._values[value.index] = write(value)

    def _far_angle(self, op: str, angle: Value) -> Value:
        """Append a call of a function that the module has once, and that few angles need."""
        w = self._writer
        for line in _far_angle_lines(op, w.lanes, for_gpu=self._on.for_gpu):
            w.declare(line)
        return w.call(op, angle, result=angle.type)

    def _is_deferred(self, x: Expr) -> bool:
        """Return whether a number is loaded, and its bits converted, wherever it is used.

        Of the thousands of numbers that an array may hold, few wait in registers then.
        """
        source = _source(x)
        if is_constant(source):
            return False
        if source.op == "load":
            return is_constant(source.operands[1])
        return source is not x and callable(self._values.get(source.index))

    def _computed_again(self, value: Expr) -> Value:
        """Append an operation from before a loop once more, in the present basic block."""
        key = value.index, self._writer.label
        if key not in self._again:
            operands = [self._operand(x) for x in value.operands]
            place = next(i for i, x in enumerate(value.operands) if not is_constant(x))
            # LLVM would find the equal operation before the loop, and take its value: pass an
            # operand through an instruction that LLVM does not know.
            operand = operands[place]
            size, register = ("f32", "f") if operand.type == "float" else ("f64", "d")
            operands[place] = self._writer.let(
                f'call {operand.type} asm sideeffect "mov.{size} $0, $1;",'
                f' "={register},{register}"({operand.typed})',
                operand.type,
            )
            self._again[key] = write_of(value, for_gpu=True)(self._on, value, operands)
        return self._again[key]

    def _computed(self, value: Expr) -> Value:
        if value.op in _FAR_ANGLES and value.dtype == np.float64:
            return self._far_angle(value.op, self._operand(value.operands[0]))
        write = write_of(value, for_gpu=self._on.for_gpu)
        return write(self._on, value, [self._operand(x) for x in value.operands])


@functools.cache
def _far_angle_lines(op: str, lanes: int, *, for_gpu: bool) -> list[str]:
    """Return the lines of a module with the function of `quarter_turns` or `angle_rest`."""
    type = vector("double", lanes)
    w = LlvmWriter(op, f"{type} x", lanes=lanes, result=type)
    (result,) = ProgramWriter(w, far_angle(op), for_gpu=for_gpu, is_part=True).finish(w.parameters)
    w.ret(result)
    return [*w.declared, w.text()]


def _source(x: Scalar) -> Scalar:
    """Return the scalar from which a word is converted, or the scalar itself."""
    while not is_constant(x):
        is_truth = x.op == "ne" and is_constant(x.operands[1])
        if not is_truth and x.op not in ("bitcast", "convert"):
            break
        x = x.operands[0]
    return x
