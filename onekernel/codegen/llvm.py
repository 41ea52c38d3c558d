"""Write a scalar program as LLVM IR, for CPUs and GPUs.

On a CPU every scalar of the program is a vector register of, say, 8 numbers. Each place in the
vector, a lane, runs the whole program for one instance. On a GPU each thread runs it for one
instance, with plain scalars.

The lanes of a vector cannot jump on their own. So a loop goes on until it has ended for all lanes.
A lane that ends earlier keeps its values, and its results do not depend on the other lanes. A side
of a branch is skipped only if no lane takes it. A mask says which lanes execute a block: those that
have left an enclosing loop, or took the other side of an enclosing branch, do not count.

Source: LLVM Language Reference Manual.
"""

import math
import operator
from collections.abc import Callable, Iterable, Sequence

import numpy as np

from onekernel.codegen.writer import LlvmWriter, Value, vector
from onekernel.errors import UnsupportedError
from onekernel.lower import (
    COMPARISONS,
    Block,
    Expr,
    Item,
    PlacedBranch,
    PlacedLoop,
    Scalar,
    ScalarProgram,
    is_constant,
)

STEP = "step"
"""Name of the function that runs one step, or all items."""

_ELEMENTS = {"f": "float", "i": "i32", "u": "u32", "b": "i1"}
"""Type of a scalar by the kind of its dtype."""

_EXTREMES = {"max": "maximum", "min": "minimum"}
_APPROXIMATIONS = {"exp": "ex2", "log": "lg2", "reciprocal": "rcp"}
_INTRINSICS = {"abs": "fabs", "floor": "floor", "round": "roundeven", "sqrt": "sqrt"}


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
    return ProgramWriter(writer, program, for_gpu=for_gpu).finish(arguments)


def tile_function(
    program: ScalarProgram, *, lanes: int, name: str, rows: Sequence[int]
) -> LlvmWriter:
    """Write a function that runs a program on a tile.

    The function's parameter is the address of a tile, whose rows are `lanes` float32 values, one of
    each instance, and are aligned to their size. The results are written to the first rows.

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
    w = LlvmWriter(name, "ptr noalias tile", lanes=lanes)
    (tile,) = w.parameters
    arguments = [tile.at(row, w.vector).load(w.vector, align=4 * lanes) for row in rows]
    for row, result in enumerate(run_program(w, program, arguments)):
        tile.at(row, w.vector).store(result, align=4 * lanes)
    return w


def map_function(program: ScalarProgram, *, lanes: int, items: int) -> LlvmWriter:
    """Write a function that runs a program for every item of an instance.

    The parameters of the function are the addresses of an instance's arguments, one after the
    other, of the table with a row of `items` values for each scalar of the program's last argument,
    all float32, and of the results, bytes of one item after the other.

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
    w = LlvmWriter(STEP, *(f"ptr noalias {name}" for name in names), lanes=lanes)
    *arrays, table, out = w.parameters
    # Load the arguments that the items share, and compute the operations on these alone, once.
    body = ProgramWriter(w, program)
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
        results = body.finish(columns)
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
        _write_of(value)


def _inputs(program: ScalarProgram) -> list[Expr]:
    """Return the scalars of a program's arguments.

    Raises:
      UnsupportedError: one of them is not float32.
    """
    inputs = [x for array in program.inputs for x in array.ravel()]
    if any(x.dtype != np.float32 for x in inputs):
        raise UnsupportedError("an argument that is not float32")
    return inputs


class ProgramWriter:
    """A `ProgramWriter` appends the operations of one program to a function."""

    def __init__(
        self,
        writer: LlvmWriter,
        program: ScalarProgram,
        *,
        approximate: bool = False,
        for_gpu: bool = False,
    ) -> None:
        """Begin without values.

        Args:
          writer: the writer of the function; with one lane, values are scalars instead of vectors.
          program: the program, whose arguments must be float32.
          approximate: whether division and square root may be off by some units in the last place,
            as a GPU's own instructions for them are.
          for_gpu: whether the function is for an NVIDIA GPU.

        Raises:
          UnsupportedError: an argument is not float32.
        """
        self._inputs = _inputs(program)
        self.writer, self.for_gpu = writer, for_gpu
        self.flags = "afn" if approximate else ""
        self._program = program
        self._rest: list[Item] = program.block.items
        self._values: dict[int, Value] = {}
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

    def finish(self, arguments: Iterable[Value]) -> list[Value]:
        """Append the other operations.

        Args:
          arguments: the scalars of the arguments that `hoist` was not given.

        Returns:
          The scalars of the program's results.
        """
        # The other arguments are known only now, such as the columns of a table in a loop over its
        # items.
        others = [x for x in self._inputs if x.index not in self._values]
        self._values |= {x.index: value for x, value in zip(others, arguments, strict=True)}
        self._block(Block(items=list(self._rest)))
        return [self._operand(x) for array in self._program.outputs for x in array.ravel()]

    def type(self, kind: str) -> str:
        """Return the type of a value by the kind of its dtype."""
        return vector(_ELEMENTS[kind], self.writer.lanes)

    def _operand(self, x: Scalar) -> Value:
        if not is_constant(x):
            return self._values[x.index]
        if x.dtype.kind == "f" and np.isnan(x):
            # The bits of an integer that is passed as a float may be those of a NaN. LLVM's text of
            # a NaN would not keep all of them: write the integer, and reinterpret it.
            whole = self.writer.constant(int(x.view(np.int32)), self.type("i"))
            return whole.bits_as(self.type("f"))
        return self.writer.constant(x.item(), self.type(x.dtype.kind))

    def _any(self, condition: Value) -> Value:
        """Return whether a condition holds in any lane."""
        w = self.writer
        if w.lanes == 1:
            return condition
        return w.call(f"llvm.vector.reduce.or.v{w.lanes}i1", condition, result="i1")

    # Blocks, loops and branches.

    def _block(self, block: Block) -> None:
        for item in block.items:
            if isinstance(item, PlacedLoop):
                self._loop(item)
            elif isinstance(item, PlacedBranch):
                self._branch(item)
            else:
                self._operation(item)

    def _masked_block(self, block: Block, mask: Value) -> None:
        """Append a block that only some of the active lanes execute."""
        enclosing = self._mask
        # With a single lane, the block is run for that lane or skipped, so no mask is needed.
        self._mask = mask if self.writer.lanes > 1 else None
        self._block(block)
        self._mask = enclosing

    def _loop(self, item: PlacedLoop) -> None:
        # The loop has two blocks of code: `head` computes the condition, and `body` an iteration.
        # Begin the head with one phi for each carry, and one for the lanes that are still active.
        w, loop = self.writer, item.loop
        carries = [loop.carries[place] for place in item.places]
        initial = [self._operand(loop.initial[place]) for place in item.places]
        initial.append(w.constant(True, self.type("b")) if self._mask is None else self._mask)
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
        w = self.writer
        # Lanes that do not execute the enclosing block take no side.
        taking = condition if self._mask is None else condition & self._mask
        absent = [Value(w, "zeroinitializer", self.type(x.dtype.kind)) for x in scalars]
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

    def _operation(self, value: Expr) -> None:
        write = _write_of(value, for_gpu=self.for_gpu)
        operands = [self._operand(x) for x in value.operands]
        self._values[value.index] = write(self, value, operands)


# Operations: each function appends those of one scalar of a program, and returns it.

_Write = Callable[[ProgramWriter, Expr, list[Value]], Value]


def _plain(apply: Callable[..., Value]) -> _Write:
    """Write an operation that is an operator of `Value`."""
    return lambda on, value, operands: apply(*operands)


def _intrinsic(on: ProgramWriter, value: Expr, operands: list[Value]) -> Value:
    return on.writer.intrinsic(_INTRINSICS[value.op], *operands, flags=on.flags)


def _approximation(on: ProgramWriter, value: Expr, operands: list[Value]) -> Value:
    (x,) = operands
    # The instructions are 2^x and log₂ x: exp(x) is 2^(x / ln 2), and log(x) is log₂(x) · ln 2.
    # LLVM has no function for them that is compiled to one instruction, so write it as assembly:
    # `$0` is the result and `$1` the operand, both in registers of floats ("=f,f").
    x = x * (1 / math.log(2)) if value.op == "exp" else x
    instruction = f"{_APPROXIMATIONS[value.op]}.approx.ftz.f32"
    result = on.writer.let(f'call float asm "{instruction} $0, $1;", "=f,f"({x.typed})', x.type)
    return result * math.log(2) if value.op == "log" else result


def _quotient(on: ProgramWriter, value: Expr, operands: list[Value]) -> Value:
    x, y = operands
    if not on.flags:
        return x / y
    # `afn` allows an approximate division, for which the plain operator has no flag.
    return on.writer.let(f"fdiv {on.flags} contract {x.typed}, {y.text}", x.type)


def _extreme(on: ProgramWriter, value: Expr, operands: list[Value]) -> Value:
    w = on.writer
    if w.lanes == 1:
        # `llvm.maximum` returns NaN if either operand is NaN, as JAX does. GPUs compute it in one
        # instruction, CPUs do not.
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


def _larger(on: ProgramWriter, value: Expr, operands: list[Value]) -> Value:
    choose = on.writer.maximum if value.op == "max" else on.writer.minimum
    return choose(*operands)


def _finite(on: ProgramWriter, value: Expr, operands: list[Value]) -> Value:
    # Neither infinity nor NaN is less than infinity.
    return on.writer.intrinsic("fabs", *operands) < math.inf


def _magnitude(on: ProgramWriter, value: Expr, operands: list[Value]) -> Value:
    (x,) = operands
    return on.writer.select(x < 0, -x, x)


def _word_sum(on: ProgramWriter, value: Expr, operands: list[Value]) -> Value:
    a, b = operands
    if not on.for_gpu:
        return a + b
    # LLVM's instruction selection for GPUs takes time quadratic in the number of sums with one of
    # the operands, and 13 s for a hundred random numbers from one key.
    return on.writer.let(
        f'call i32 asm "add.u32 $0, $1, $2;", "=r,r,r"({a.typed}, {b.typed})', a.type
    )


def _rotation(on: ProgramWriter, value: Expr, operands: list[Value]) -> Value:
    x, by = operands
    # A funnel shift of a number with itself is a rotation.
    return on.writer.intrinsic("fshl", x, x, by)


def _angle(on: ProgramWriter, value: Expr, operands: list[Value]) -> Value:
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


def _logical_shift(on: ProgramWriter, value: Expr, operands: list[Value]) -> Value:
    """Shift to the right, and fill up with zeros: so an integer without a sign is shifted."""
    x, by = (operand.to("u32") for operand in operands)
    return (x >> by).to(_ELEMENTS[value.dtype.kind])


def _select(on: ProgramWriter, value: Expr, operands: list[Value]) -> Value:
    condition, if_false, if_true = operands
    return on.writer.select(condition, if_true, if_false)


def _convert(on: ProgramWriter, value: Expr, operands: list[Value]) -> Value:
    (x,), to = operands, value.dtype.kind
    if value.operands[0].dtype.kind != "f":
        return x.to(_ELEMENTS[to])
    # Saturating conversions: numbers beyond the range become its ends and NaN becomes 0, as in JAX,
    # where the plain instruction would be undefined.
    name = "fptoui.sat" if to == "u" else "fptosi.sat"
    return on.writer.intrinsic(name, x, result=on.type(to))


def _bitcast(on: ProgramWriter, value: Expr, operands: list[Value]) -> Value:
    return operands[0].bits_as(on.type(value.dtype.kind))


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


def _write_of(value: Expr, *, for_gpu: bool = False) -> _Write:
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
