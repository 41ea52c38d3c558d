"""Write a scalar program as LLVM IR, for CPUs and GPUs.

On a CPU every scalar is a vector register, and each lane runs the whole program for one robot. On a
GPU each thread runs it for one robot, with plain scalars. A loop ends when it has ended for all
lanes; a lane that ends earlier keeps its values, so they do not depend on the other lanes. A side
of a branch is skipped if no lane takes it. Lanes that have left an enclosing loop, or took the
other side of an enclosing branch, do not count for either.

Source: LLVM Language Reference Manual.
"""

import math
import struct
from collections.abc import Callable, Sequence

import numpy as np

from jetbot_mjx.compiler.lower_jaxpr import ScalarProgram
from jetbot_mjx.compiler.scalar_ir import COMPARISONS, Expr, Scalar, UnsupportedError, is_constant
from jetbot_mjx.compiler.schedule import Block, Item, PlacedBranch, PlacedLoop

STEP = "step"
"""Name of the function that runs one step, or all items."""

_ELEMENTS = {"f": "float", "i": "i32", "u": "i32", "b": "i1"}
"""LLVM's type by the kind of a dtype."""

_EXTREMES = {"max": "maximum", "min": "minimum"}
_INTRINSICS = {"abs": "fabs", "floor": "floor", "round": "roundeven", "sqrt": "sqrt"}


def tile_text(program: ScalarProgram, *, lanes: int, name: str, rows: Sequence[int]) -> str:
    """Write an LLVM function that runs a program on a tile.

    The function's parameter is the address of a tile, whose rows are `lanes` float32 values, one of
    each robot, and are aligned to their size. The results are written to the first rows.

    Args:
      program: the program.
      lanes: the number of robots that the function steps side by side.
      name: the name of the function.
      rows: the row of each scalar of the arguments.

    Returns:
      The text of the function and of the declarations that it needs.

    Raises:
      UnsupportedError: the program has an operation that has no LLVM instruction here.
    """
    emitter = LlvmEmitter(program, lanes)
    vector = emitter.type("f")

    def row(place: int) -> str:
        address = emitter.do(f"getelementptr {vector}, ptr %tile, i64 {place}")
        return f"ptr {address}, align {4 * lanes}"

    results = emitter.step([emitter.do(f"load {vector}, {row(i)}") for i in rows])
    for i, result in enumerate(results):
        emitter.add(f"store {vector} {result}, {row(i)}")
    return "\n".join(
        [
            f"define internal void @{name}(ptr noalias %tile) noinline {{",
            "entry:",
            *emitter.lines,
            "ret void",
            "}\n",
        ]
    )


def map_text(program: ScalarProgram, *, lanes: int, items: int) -> str:
    """Write an LLVM function that runs a program for every item of a robot.

    The parameters of the function are the addresses of a robot's arguments, one after the other, of
    the table with a row of `items` values for each scalar of the program's last argument, all
    float32, and of the results, bytes of one item after the other.

    Args:
      program: the function of (arguments of a robot ..., a column of the table), with scalar
        results.
      lanes: the number of items that are computed side by side.
      items: the number of items, at least `lanes`.

    Returns:
      The text of the function and of the declarations that it needs.

    Raises:
      UnsupportedError: the program has an operation that has no LLVM instruction here.
    """
    emitter = LlvmEmitter(program, lanes, label="items")
    vector = emitter.type("f")
    *shared, row = [array.size for array in program.inputs]
    # Load what the items share, and compute what follows from it alone.
    arguments = [
        emitter.load_shared(f"%in{i}", j) for i, size in enumerate(shared) for j in range(size)
    ]
    columns = [f"%column{j}" for j in range(row)]
    rest = emitter.hoist([*arguments, *columns], row)
    before, emitter.lines = emitter.lines, []
    # Compute a group of items; the last group may overlap with the one before.
    for j, column in enumerate(columns):
        emitter.add(f"{column}.at = getelementptr float, ptr %table, i64 {j * items}")
        emitter.add(f"{column}.of = getelementptr float, ptr {column}.at, i64 %item")
        emitter.add(f"{column} = load {vector}, ptr {column}.of, align 4")
    kind, interleaved = emitter.interleave(emitter.finish(rest))
    place = emitter.do(f"mul i64 %item, {len(program.outputs)}")
    address = emitter.do(f"getelementptr i8, ptr %out, i64 {place}")
    emitter.add(f"store {kind} {interleaved}, ptr {address}, align 1")
    parameters = [f"ptr noalias %in{i}" for i in range(len(shared))]
    parameters += ["ptr noalias %table", "ptr noalias %out"]
    return "\n".join(
        [
            *emitter.declarations(),
            f"define internal void @{STEP}({', '.join(parameters)}) noinline {{",
            "entry:",
            *before,
            "br label %items",
            "items:",
            f"%group = phi i64 [0, %entry], [%next, %{emitter.label}]",
            f"%is.last = icmp ugt i64 %group, {items - lanes}",
            f"%item = select i1 %is.last, i64 {items - lanes}, i64 %group",
            *emitter.lines,
            f"%next = add i64 %group, {lanes}",
            f"%more = icmp ult i64 %next, {items}",
            "br i1 %more, label %items, label %done",
            "done:",
            "ret void",
            "}\n",
        ]
    )


def declarations(lanes: int) -> list[str]:
    """Return the declarations of the LLVM intrinsics that programs call, once for a module."""
    return LlvmEmitter(ScalarProgram([], [], Block()), lanes).declarations()


def require(program: ScalarProgram) -> None:
    """Check that a program can be written as LLVM IR.

    Raises:
      UnsupportedError: the program has an operation that has no LLVM instruction here.
    """
    LlvmEmitter(program, lanes=1).step([""] * sum(array.size for array in program.inputs))


class LlvmEmitter:
    """An `LlvmEmitter` collects the lines of an LLVM function and the names of its values."""

    def __init__(
        self,
        program: ScalarProgram,
        lanes: int,
        label: str = "entry",
        *,
        approximate: bool = False,
        prefix: str = "v",
        for_gpu: bool = False,
    ) -> None:
        """Begin with no lines.

        Args:
          program: the program, whose arguments must be float32.
          lanes: the number of robots side by side; with 1, values are scalars instead of vectors.
          label: the label of the basic block that the first lines belong to.
          approximate: whether division and square root may be off by some units in the last place,
            as a GPU's own instructions for them are.
          prefix: what the names of values begin with, which differs between the programs of one
            function.
          for_gpu: whether the function is for an NVIDIA GPU.

        Raises:
          UnsupportedError: an argument is not float32.
        """
        if any(x.dtype != np.float32 for array in program.inputs for x in array.ravel()):
            raise UnsupportedError("an argument that is not float32")
        self.lines: list[str] = []
        self.label = label
        self._program = program
        self._prefix = prefix
        self._for_gpu = for_gpu
        self._lanes = lanes
        self._fast = "afn " if approximate else ""
        self._count = 0
        self._names: dict[int, str] = {}
        # The value that is true in the lanes that execute the current block; empty: all lanes do.
        self._mask = ""

    def step(self, arguments: Sequence[str]) -> list[str]:
        """Write one run of the program.

        Args:
          arguments: the names of the scalars of the program's arguments.

        Returns:
          The names of the scalars of the program's results.
        """
        return self.finish(self.hoist(arguments, varying=len(arguments)))

    def hoist(self, arguments: Sequence[str], varying: int) -> list[Item]:
        """Write the operations that do not depend on the last arguments.

        Args:
          arguments: the names of the scalars of the program's arguments.
          varying: the number of scalars at the end of them that differ from item to item.

        Returns:
          The operations that depend on them, for `finish`.
        """
        inputs = [x for array in self._program.inputs for x in array.ravel()]
        self._names = {x.index: name for x, name in zip(inputs, arguments, strict=True)}
        known = {x.index for x in inputs[: len(inputs) - varying]}
        rest: list[Item] = []
        for item in self._program.block.items:
            if isinstance(item, Expr) and all(
                is_constant(x) or x.index in known for x in item.operands
            ):
                self._operation(item)
                known.add(item.index)
            else:
                rest.append(item)
        return rest

    def finish(self, rest: Sequence[Item]) -> list[str]:
        """Write the operations that `hoist` left, and return the names of the program's results."""
        self._block(Block(items=list(rest)))
        return [self._operand(x) for array in self._program.outputs for x in array.ravel()]

    def load_shared(self, array: str, place: int) -> str:
        """Load one float of an array into all lanes, and return its name."""
        address = self.do(f"getelementptr float, ptr {array}, i64 {place}")
        name = self.do(f"load float, ptr {address}")
        if self._lanes == 1:
            return name
        vector = self.type("f")
        first = self.do(f"insertelement {vector} poison, float {name}, i64 0")
        mask = f"<{self._lanes} x i32> zeroinitializer"
        return self.do(f"shufflevector {vector} {first}, {vector} poison, {mask}")

    def interleave(self, names: Sequence[str]) -> tuple[str, str]:
        """Convert vectors of floats from 0 to 255 to bytes, those of a lane one after the other.

        Args:
          names: the names of the vectors.

        Returns:
          LLVM's type and the name of the vector of all bytes.
        """
        lanes, vector = self._lanes, self.type("f")

        def shuffle(size: int, one: str, other: str, places: Sequence[int | None]) -> str:
            mask = ", ".join("i32 poison" if i is None else f"i32 {i}" for i in places)
            kind = f"<{size} x i8>"
            return self.do(
                f"shufflevector {kind} {one}, {kind} {other}, <{len(places)} x i32> <{mask}>"
            )

        joined = ""
        for i, name in enumerate(names):
            part = self.do(f"fptoui {vector} {name} to <{lanes} x i8>")
            if i == 0:
                joined = part
                continue
            size = i * lanes
            # Both operands of a shuffle have one length.
            padding = [None] * (size - lanes)
            part = shuffle(lanes, part, "poison", [*range(lanes), *padding])
            joined = shuffle(size, joined, part, range(size + lanes))
        count = len(names)
        if count > 1:
            places = [i * lanes + lane for lane in range(lanes) for i in range(count)]
            joined = shuffle(count * lanes, joined, "poison", places)
        return f"<{count * lanes} x i8>", joined

    def declarations(self) -> list[str]:
        """Return the declarations of the LLVM intrinsics that programs call, once for a module."""
        number, whole, truth = self.type("f"), self.type("i"), self.type("b")
        lines = [f"declare {number} {self._function(x)}({number})" for x in _INTRINSICS.values()]
        lines += [
            f"declare {whole} {self._function(x)}({number})" for x in ("fptosi.sat", "fptoui.sat")
        ]
        wide = self._wide
        lines += [
            f"declare {wide} @llvm.{name}.{self._suffix}f64({', '.join([wide] * count)})"
            for name, count in (("roundeven", 1), ("floor", 1), ("fma", 3))
        ]
        lines.append(f"declare {whole} @llvm.fshl.{self._suffix}i32({whole}, {whole}, {whole})")
        if self._lanes == 1:
            lines += [
                f"declare float {self._function(x)}(float, float)" for x in _EXTREMES.values()
            ]
        else:
            lines.append(f"declare i1 @llvm.vector.reduce.or.v{self._lanes}i1({truth})")
        return lines

    def type(self, kind: str) -> str:
        """Return LLVM's type of a value by the kind of its dtype."""
        element = _ELEMENTS[kind]
        return element if self._lanes == 1 else f"<{self._lanes} x {element}>"

    def do(self, instruction: str) -> str:
        """Add an instruction that has a result, and return the name of the result."""
        name = self._new()
        self.lines.append(f"{name} = {instruction}")
        return name

    def add(self, line: str) -> None:
        """Add an instruction that has no result."""
        self.lines.append(line)

    def begin(self, label: str) -> None:
        """Begin a new basic block."""
        self.lines.append(f"{label}:")
        self.label = label

    def _new(self) -> str:
        self._count += 1
        return f"%{self._prefix}{self._count}"

    def _labels(self, *names: str) -> list[str]:
        self._count += 1
        return [f"{name}.{self._prefix}{self._count}" for name in names]

    @property
    def _suffix(self) -> str:
        return "" if self._lanes == 1 else f"v{self._lanes}"

    def _function(self, name: str) -> str:
        size = self._suffix
        return f"@llvm.{name}.{size}i32.{size}f32" if "sat" in name else f"@llvm.{name}.{size}f32"

    def _operand(self, x: Scalar) -> str:
        return self._constant(x) if is_constant(x) else self._names[x.index]

    def _splat(self, kind: str, number: str) -> str:
        return number if self._lanes == 1 else f"splat ({_ELEMENTS[kind]} {number})"

    def _constant(self, x: Scalar) -> str:
        kind = x.dtype.kind
        if kind == "u":
            # LLVM's integers have no sign, but its text has.
            x = x.view(np.int32)
        if kind == "f" and np.isnan(x):
            # Bits of whole numbers may be such a float, which LLVM's text would change.
            whole = self._splat("i", str(int(x.view(np.int32))))
            return self.do(f"bitcast {self.type('i')} {whole} to {self.type('f')}")
        return self._splat(kind, _float(x) if kind == "f" else str(int(x)))

    def _any(self, condition: str) -> str:
        """Return the name of an `i1` that is true if a condition holds in any lane."""
        if self._lanes == 1:
            return condition
        function = f"@llvm.vector.reduce.or.v{self._lanes}i1"
        return self.do(f"call i1 {function}({self.type('b')} {condition})")

    def _block(self, block: Block) -> None:
        for item in block.items:
            if isinstance(item, PlacedLoop):
                self._loop(item)
            elif isinstance(item, PlacedBranch):
                self._branch(item)
            else:
                self._operation(item)

    def _masked_block(self, block: Block, mask: str) -> None:
        """Write a block that only some of the active lanes execute."""
        enclosing = self._mask
        # With a single lane the block is executed by that lane or skipped: no mask is needed.
        self._mask = mask if self._lanes > 1 else ""
        self._block(block)
        self._mask = enclosing

    def _loop(self, item: PlacedLoop) -> None:
        # Begin the block of the condition with one phi for each carry and one for the active lanes.
        loop, before = item.loop, self.label
        head, body, end = self._labels("head", "body", "end")
        carries = [loop.carries[place] for place in item.places]
        initial = [self._operand(loop.initial[place]) for place in item.places]
        self.add(f"br label %{head}")
        self.begin(head)
        # These lines stay empty until the values at the end of an iteration have names.
        start = len(self.lines)
        for carry in carries:
            self._names[carry.index] = self._new()
            self.add("")
        active_before = self._new()
        self.add("")
        # Compute the condition, and then an iteration for the lanes in which it holds.
        self._block(item.head)
        mask_type = self.type("b")
        active = self.do(f"and {mask_type} {active_before}, {self._operand(loop.condition)}")
        self.add(f"br i1 {self._any(active)}, label %{body}, label %{end}")
        self.begin(body)
        self._masked_block(item.body, active)
        updated = [self._operand(loop.updated[place]) for place in item.places]
        if self._lanes > 1:
            updated = [
                self.do(self._select_text(active, carry.dtype.kind, new, self._names[carry.index]))
                for carry, new in zip(carries, updated, strict=True)
            ]
        # Fill in the phis, and take the results from the block of the condition.
        for i, (carry, a, b) in enumerate(zip(carries, initial, updated, strict=True), start):
            kind = self.type(carry.dtype.kind)
            self.lines[i] = (
                f"{self._names[carry.index]} = phi {kind} [{a}, %{before}], [{b}, %{self.label}]"
            )
        self.lines[start + len(carries)] = (
            f"{active_before} = phi {mask_type}"
            f" [{self._mask or self._splat('b', 'true')}, %{before}],"
            f" [{active}, %{self.label}]"
        )
        self.add(f"br label %{head}")
        self.begin(end)
        for result in item.results:
            self._names[result.index] = self._operand(loop.results[result.place])

    def _branch(self, item: PlacedBranch) -> None:
        branch = item.branch
        condition = self._operand(branch.condition)
        if_true = [branch.if_true[x.place] for x in item.results]
        if_false = [branch.if_false[x.place] for x in item.results]
        if not item.if_false.items:
            # One side computes nothing: its values remain, and are chosen where the other is taken.
            names = self._side(item.if_true, condition, if_true, if_false)
        elif not item.if_true.items:
            inverse = self._inverse(condition)
            names = self._side(item.if_false, inverse, if_false, if_true)
        else:
            there = self._side(item.if_true, condition, if_true, None)
            names = self._side(item.if_false, self._inverse(condition), if_false, there)
        for result, name in zip(item.results, names, strict=True):
            self._names[result.index] = name

    def _inverse(self, condition: str) -> str:
        return self.do(f"xor {self.type('b')} {condition}, {self._splat('b', 'true')}")

    def _side(
        self,
        block: Block,
        condition: str,
        scalars: Sequence[Scalar],
        others: Sequence[Scalar] | Sequence[str] | None,
    ) -> list[str]:
        """Write one side of a branch.

        Args:
          block: the operations of this side.
          condition: the name of the condition under which a lane takes this side.
          scalars: the values of this side.
          others: the values of lanes that do not take it, as scalars or as names; None: any.

        Returns:
          The names of the values after the branch.
        """
        taking = condition
        if self._mask:
            taking = self.do(f"and {self.type('b')} {condition}, {self._mask}")
        kinds = [x.dtype.kind for x in scalars]
        absent = ["zeroinitializer"] * len(scalars)
        if others is not None:
            absent = [x if isinstance(x, str) else self._operand(x) for x in others]
        before = self.label
        taken, end = self._labels("taken", "end")
        self.add(f"br i1 {self._any(taking)}, label %{taken}, label %{end}")
        self.begin(taken)
        self._masked_block(block, taking)
        names = [self._operand(x) for x in scalars]
        if others is not None and self._lanes > 1:
            names = [
                self.do(self._select_text(condition, kind, name, other))
                for kind, name, other in zip(kinds, names, absent, strict=True)
            ]
        after = self.label
        self.add(f"br label %{end}")
        self.begin(end)
        return [
            self.do(f"phi {self.type(kind)} [{name}, %{after}], [{other}, %{before}]")
            for kind, name, other in zip(kinds, names, absent, strict=True)
        ]

    def _operation(self, value: Expr) -> None:
        kind = value.operands[0].dtype.kind if value.op != "select" else value.dtype.kind
        emit = _EMIT.get((value.op, kind))
        if emit is None:
            raise UnsupportedError(f"{value.op} of {value.operands[0].dtype}")
        operands = [self._operand(x) for x in value.operands]
        self._names[value.index] = self.do(emit(self, value, operands))

    # Each method below returns the last instruction of an operation, and adds those before it.

    def _call(self, value: Expr, operands: list[str]) -> str:
        (x,) = operands
        number, function = self.type("f"), self._function(_INTRINSICS[value.op])
        return f"call {self._fast}{number} {function}({number} {x})"

    def _quotient(self, value: Expr, operands: list[str]) -> str:
        return f"fdiv {self._fast}{_FUSED} {self.type('f')} {', '.join(operands)}"

    def _extreme(self, value: Expr, operands: list[str]) -> str:
        number = self.type("f")
        if self._lanes == 1:
            function = self._function(_EXTREMES[value.op])
            return f"call {number} {function}({number} {operands[0]}, {number} {operands[1]})"
        # This is one instruction on x86, which returns the second operand if either is NaN.
        ordered = sorted(
            zip(value.operands, operands, strict=True), key=lambda x: not is_constant(x[0])
        )
        (first, a), (_, b) = ordered
        better = "ogt" if value.op == "max" else "olt"
        best = self._select_text(self.do(f"fcmp {better} {number} {a}, {b}"), "f", a, b)
        if is_constant(first):
            return best
        best = self.do(best)
        return self._select_text(self.do(f"fcmp uno {number} {a}, {a}"), "f", a, best)

    def _finite(self, value: Expr, operands: list[str]) -> str:
        number = self.type("f")
        size = self.do(f"call {number} {self._function('fabs')}({number} {operands[0]})")
        return f"fcmp olt {number} {size}, {self._splat('f', _float(np.inf))}"

    def _magnitude(self, value: Expr, operands: list[str]) -> str:
        whole, (x,) = self.type("i"), operands
        zero = self._splat("i", "0")
        below = self.do(f"icmp slt {whole} {x}, {zero}")
        return self._select_text(below, "i", self.do(f"sub {whole} {zero}, {x}"), x)

    def _word_sum(self, value: Expr, operands: list[str]) -> str:
        a, b = operands
        if self._for_gpu:
            # LLVM's instruction selection for GPUs takes time quadratic in the number of sums with
            # one of the operands, and 13 s for a hundred random numbers from one key.
            return f'call i32 asm "add.u32 $0, $1, $2;", "=r,r,r"(i32 {a}, i32 {b})'
        return f"add {self.type('u')} {a}, {b}"

    def _rotation(self, value: Expr, operands: list[str]) -> str:
        whole, (x, by) = self.type("u"), operands
        function = f"@llvm.fshl.{self._suffix}i32"
        return f"call {whole} {function}({whole} {x}, {whole} {x}, {whole} {by})"

    @property
    def _wide(self) -> str:
        return "double" if self._lanes == 1 else f"<{self._lanes} x double>"

    def _call_wide(self, name: str, *operands: str) -> str:
        arguments = ", ".join(f"{self._wide} {x}" for x in operands)
        return self.do(f"call {self._wide} @llvm.{name}.{self._suffix}f64({arguments})")

    def _wide_constant(self, x: float) -> str:
        number = _float(x)
        return number if self._lanes == 1 else f"splat (double {number})"

    def _angle(self, value: Expr, operands: list[str]) -> str:
        wide, (x,) = self._wide, operands
        angle = self.do(f"fpext {self.type('f')} {x} to {wide}")
        turns = self.do(f"fmul {wide} {angle}, {self._wide_constant(2 / math.pi)}")
        turns = self._call_wide("roundeven", turns)
        if value.op == "quarter_turns":
            quarter = self.do(f"fmul {wide} {turns}, {self._wide_constant(0.25)}")
            whole = self._call_wide("floor", quarter)
            result = self._call_wide("fma", whole, self._wide_constant(-4.0), turns)
        else:
            # π/2 in two parts; each product is exact in a fused multiply-add.
            result = angle
            for part in _HALF_PI:
                result = self._call_wide("fma", turns, self._wide_constant(-part), result)
        return f"fptrunc {wide} {result} to {self.type('f')}"

    def _negative(self, value: Expr, operands: list[str]) -> str:
        return f"sub {self.type('i')} {self._splat('i', '0')}, {operands[0]}"

    def _negation(self, value: Expr, operands: list[str]) -> str:
        return f"xor {self.type('b')} {operands[0]}, {self._splat('b', 'true')}"

    def _larger(self, value: Expr, operands: list[str]) -> str:
        a, b = operands
        sign = "u" if value.dtype.kind == "u" else "s"
        better = f"{sign}gt" if value.op == "max" else f"{sign}lt"
        return self._select_text(self.do(f"icmp {better} {self.type('i')} {a}, {b}"), "i", a, b)

    def _select_text(self, condition: str, kind: str, if_true: str, if_false: str) -> str:
        cases = f"{self.type(kind)} {if_true}, {self.type(kind)} {if_false}"
        return f"select {self.type('b')} {condition}, {cases}"

    def _select(self, value: Expr, operands: list[str]) -> str:
        condition, if_false, if_true = operands
        return self._select_text(condition, value.dtype.kind, if_true, if_false)

    def _convert(self, value: Expr, operands: list[str]) -> str:
        source, to = value.operands[0].dtype.kind, value.dtype.kind
        if source == "f":
            function = self._function("fptoui.sat" if to == "u" else "fptosi.sat")
            return f"call {self.type('i')} {function}({self.type('f')} {operands[0]})"
        if to == "f":
            how = "sitofp" if source == "i" else "uitofp"
        else:
            how = "zext" if source == "b" else "bitcast"
        return f"{how} {self.type(source)} {operands[0]} to {self.type(to)}"

    def _bitcast(self, value: Expr, operands: list[str]) -> str:
        source, to = value.operands[0].dtype.kind, value.dtype.kind
        return f"bitcast {self.type(source)} {operands[0]} to {self.type(to)}"

    def _comparison(self, value: Expr, operands: list[str]) -> str:
        kind = value.operands[0].dtype.kind
        pair = f"{self.type(kind)} {', '.join(operands)}"
        if kind == "f":
            # NaN differs from every number, so `ne` is the only unordered comparison.
            return f"fcmp {'une' if value.op == 'ne' else f'o{value.op}'} {pair}"
        sign = "" if value.op in ("eq", "ne") else "u" if kind == "u" else "s"
        return f"icmp {sign}{value.op} {pair}"


_Emit = Callable[[LlvmEmitter, Expr, list[str]], str]


def _instruction(instruction: str, kind: str) -> _Emit:
    def emit(text: LlvmEmitter, value: Expr, operands: list[str]) -> str:
        return f"{instruction} {text.type(kind)} {', '.join(operands)}"

    return emit


def _float(x: float) -> str:
    """Return a constant by its bits, which LLVM writes as those of a double."""
    return f"0x{struct.pack('>d', float(x)).hex().upper()}"


_HALF_PI = (math.pi / 2, 6.123233995736766e-17)
"""π/2 as a sum of two numbers of 64 bits."""

# Allow fused multiply-add, which rounds once instead of twice.
_FUSED = "contract"

_EMIT: dict[tuple[str, str], _Emit] = {
    **{(op, "f"): _instruction(f"f{op} {_FUSED}", "f") for op in ("add", "mul", "sub")},
    **{(op, "i"): _instruction(op, "i") for op in ("add", "mul", "sub")},
    **{(op, "u"): _instruction(op, "u") for op in ("mul", "sub")},
    ("add", "u"): LlvmEmitter._word_sum,
    **{(op, kind): _instruction(op, kind) for op in ("and", "or", "xor") for kind in "iub"},
    **{(op, kind): LlvmEmitter._comparison for op in COMPARISONS for kind in "fiu"},
    **{(op, "b"): LlvmEmitter._comparison for op in ("eq", "ne")},
    **{(op, "f"): LlvmEmitter._call for op in _INTRINSICS},
    **{(op, "f"): LlvmEmitter._extreme for op in ("max", "min")},
    **{(op, kind): LlvmEmitter._larger for op in ("max", "min") for kind in "iu"},
    **{("select", kind): LlvmEmitter._select for kind in "fiu"},
    **{("convert", kind): LlvmEmitter._convert for kind in "fiub"},
    **{("bitcast", kind): LlvmEmitter._bitcast for kind in "fi"},
    ("abs", "i"): LlvmEmitter._magnitude,
    **{(op, "f"): LlvmEmitter._angle for op in ("angle_rest", "quarter_turns")},
    ("div", "f"): LlvmEmitter._quotient,
    ("is_finite", "f"): LlvmEmitter._finite,
    ("neg", "f"): _instruction("fneg", "f"),
    **{("neg", kind): LlvmEmitter._negative for kind in "iu"},
    ("div", "i"): _instruction("sdiv", "i"),
    ("div", "u"): _instruction("udiv", "u"),
    ("rem", "i"): _instruction("srem", "i"),
    ("rem", "u"): _instruction("urem", "u"),
    ("not", "b"): LlvmEmitter._negation,
    ("rotate_left", "u"): LlvmEmitter._rotation,
    **{("shift_left", kind): _instruction("shl", kind) for kind in "iu"},
    **{("shift_right_logical", kind): _instruction("lshr", kind) for kind in "iu"},
}
"""Functions that return an operation's last instruction, by operation and kind of the operands."""
