"""Write a scalar program in LLVM's intermediate representation, for CPUs and GPUs.

On a CPU every number is a vector register wide: each lane does the whole program for one robot. On
a GPU each thread does. A loop ends when it has ended for all lanes, or for the thread: a finished
lane keeps its values, so that they do not depend on the other lanes. A side of a branch is skipped
if no lane takes it. Lanes that have left an enclosing loop, or that took the other side of an
enclosing branch, delay neither.

Source: LLVM Language Reference Manual.
"""

import struct
from collections.abc import Callable, Sequence

import numpy as np

from jetbot_mjx.compiler.lower_jaxpr import ScalarProgram
from jetbot_mjx.compiler.scalar_ir import COMPARISONS, Expr, Scalar, UnsupportedError, is_constant
from jetbot_mjx.compiler.schedule import Block, PlacedBranch, PlacedLoop

STEP = "step"
"""The function's name."""

_ELEMENTS = {"f": "float", "i": "i32", "b": "i1"}
"""Of each kind of dtype: LLVM's type."""

_EXTREMES = {"max": "maximum", "min": "minimum"}
_INTRINSICS = {"abs": "fabs", "floor": "floor", "sqrt": "sqrt"}


def step_text(program: ScalarProgram, *, carried: int, lanes: int) -> str:
    """Write a function that runs a program once and stores the results in the first arguments.

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
    writer = LlvmEmitter(program, lanes)
    number = writer.type("f")

    def row(place: int) -> str:
        address = writer.do(f"getelementptr {number}, ptr %tile, i64 {place}")
        return f"ptr {address}, align {4 * lanes}"

    count = sum(array.size for array in program.inputs)
    results = writer.step([writer.do(f"load {number}, {row(i)}") for i in range(count)])
    kept = sum(array.size for array in program.outputs[:carried])
    for i, result in enumerate(results[:kept]):
        writer.add(f"store {number} {result}, {row(i)}")
    return "\n".join(
        [
            *writer.declarations(),
            f"define internal void @{STEP}(ptr noalias %tile) noinline {{",
            "entry:",
            *writer.lines,
            "ret void",
            "}\n",
        ]
    )


def require(program: ScalarProgram) -> None:
    """Check that a program can be written.

    Raises:
      UnsupportedError: it has an operation that is not written here.
    """
    LlvmEmitter(program, lanes=1).step([""] * sum(array.size for array in program.inputs))


class LlvmEmitter:
    """An `LlvmEmitter` holds the lines of a function and the names of its values."""

    def __init__(self, program: ScalarProgram, lanes: int, label: str = "entry") -> None:
        """Begin with no lines.

        Args:
          program: what is done; its arguments are float32.
          lanes: robots side by side; 1: numbers are no vectors.
          label: of the block that the lines are in.

        Raises:
          UnsupportedError: an argument is not float32.
        """
        if any(x.dtype != np.float32 for array in program.inputs for x in array.ravel()):
            raise UnsupportedError("an argument that is not float32")
        self.lines: list[str] = []
        self.label = label
        self._program = program
        self._lanes = lanes
        self._count = 0
        self._names: dict[int, str] = {}
        # The lanes whose numbers matter here; none written: those of all.
        self._mask = ""

    def step(self, arguments: Sequence[str]) -> list[str]:
        """Write one run of the program.

        Args:
          arguments: the names of its arguments' numbers.

        Returns:
          The names of its results' numbers.
        """
        inputs = [x for array in self._program.inputs for x in array.ravel()]
        self._names = {x.index: name for x, name in zip(inputs, arguments, strict=True)}
        self._block(self._program.block)
        return [self._operand(x) for array in self._program.outputs for x in array.ravel()]

    def declarations(self) -> list[str]:
        """Return the lines outside of any function that the program needs."""
        number, whole, truth = self.type("f"), self.type("i"), self.type("b")
        lines = [f"declare {number} {self._function(x)}({number})" for x in _INTRINSICS.values()]
        lines.append(f"declare {whole} {self._function('fptosi.sat')}({number})")
        if self._lanes == 1:
            lines += [
                f"declare float {self._function(x)}(float, float)" for x in _EXTREMES.values()
            ]
        else:
            lines.append(f"declare i1 @llvm.vector.reduce.or.v{self._lanes}i1({truth})")
        return lines

    def type(self, kind: str) -> str:
        """Return LLVM's type of a number by the kind of its dtype."""
        element = _ELEMENTS[kind]
        return element if self._lanes == 1 else f"<{self._lanes} x {element}>"

    def do(self, instruction: str) -> str:
        """Add an instruction that has a result; return its name."""
        name = self._new()
        self.lines.append(f"{name} = {instruction}")
        return name

    def add(self, line: str) -> None:
        """Add an instruction that has no result."""
        self.lines.append(line)

    def begin(self, label: str) -> None:
        """Begin another basic block."""
        self.lines.append(f"{label}:")
        self.label = label

    def _new(self) -> str:
        self._count += 1
        return f"%v{self._count}"

    def _labels(self, *names: str) -> list[str]:
        self._count += 1
        return [f"{name}.{self._count}" for name in names]

    def _function(self, name: str) -> str:
        size = "" if self._lanes == 1 else f"v{self._lanes}"
        return f"@llvm.{name}.{size}i32.{size}f32" if "sat" in name else f"@llvm.{name}.{size}f32"

    def _operand(self, x: Scalar) -> str:
        return self._constant(x) if is_constant(x) else self._names[x.index]

    def _splat(self, kind: str, number: str) -> str:
        return number if self._lanes == 1 else f"splat ({_ELEMENTS[kind]} {number})"

    def _constant(self, x: Scalar) -> str:
        kind = x.dtype.kind
        return self._splat(kind, _float(x) if kind == "f" else str(int(x)))

    def _any(self, which: str) -> str:
        """Return a value that is true if a condition holds in any lane."""
        if self._lanes == 1:
            return which
        function = f"@llvm.vector.reduce.or.v{self._lanes}i1"
        return self.do(f"call i1 {function}({self.type('b')} {which})")

    def _block(self, block: Block) -> None:
        for item in block.items:
            if isinstance(item, PlacedLoop):
                self._loop(item)
            elif isinstance(item, PlacedBranch):
                self._branch(item)
            else:
                self._operation(item)

    def _masked_block(self, block: Block, mask: str) -> None:
        """Open a block in which only some of the enclosing block's active lanes matter."""
        around = self._mask
        # The only lane is there, or the block is not.
        self._mask = mask if self._lanes > 1 else ""
        self._block(block)
        self._mask = around

    def _loop(self, item: PlacedLoop) -> None:
        loop, before = item.loop, self.label
        head, body, end = self._labels("head", "body", "end")
        carries = [loop.carries[place] for place in item.places]
        first = [self._operand(loop.first[place]) for place in item.places]
        self.add(f"br label %{head}")
        self.begin(head)
        # What a trip ends with is not written yet: these lines are filled in below.
        start = len(self.lines)
        for carry in carries:
            self._names[carry.index] = self._new()
            self.add("")
        going_before = self._new()
        self.add("")
        self._block(item.head)
        truth = self.type("b")
        going = self.do(f"and {truth} {going_before}, {self._operand(loop.going)}")
        self.add(f"br i1 {self._any(going)}, label %{body}, label %{end}")
        self.begin(body)
        self._masked_block(item.body, going)
        following = [self._operand(loop.following[place]) for place in item.places]
        if self._lanes > 1:
            following = [
                self.do(self._chosen(going, carry.dtype.kind, new, self._names[carry.index]))
                for carry, new in zip(carries, following, strict=True)
            ]
        for i, (carry, a, b) in enumerate(zip(carries, first, following, strict=True), start):
            kind = self.type(carry.dtype.kind)
            self.lines[i] = (
                f"{self._names[carry.index]} = phi {kind} [{a}, %{before}], [{b}, %{self.label}]"
            )
        self.lines[start + len(carries)] = (
            f"{going_before} = phi {truth} [{self._mask or self._splat('b', 'true')}, %{before}],"
            f" [{going}, %{self.label}]"
        )
        self.add(f"br label %{head}")
        self.begin(end)
        for result in item.results:
            self._names[result.index] = self._operand(loop.outcomes[result.place])

    def _branch(self, item: PlacedBranch) -> None:
        branch = item.branch
        which = self._operand(branch.which)
        yes = self._side(item.yes, which, [branch.yes[x.place] for x in item.results])
        other = self.do(f"xor {self.type('b')} {which}, {self._splat('b', 'true')}")
        no = self._side(item.no, other, [branch.no[x.place] for x in item.results])
        for result, a, b in zip(item.results, yes, no, strict=True):
            self._names[result.index] = self.do(self._chosen(which, result.dtype.kind, a, b))

    def _side(self, block: Block, which: str, numbers: Sequence[Scalar]) -> list[str]:
        """Write one side of a branch; its values are arbitrary if no lane takes that side."""
        if not block.items:
            return [self._operand(x) for x in numbers]
        if self._mask:
            which = self.do(f"and {self.type('b')} {which}, {self._mask}")
        before = self.label
        taken, end = self._labels("taken", "end")
        self.add(f"br i1 {self._any(which)}, label %{taken}, label %{end}")
        self.begin(taken)
        self._masked_block(block, which)
        names, after = [self._operand(x) for x in numbers], self.label
        self.add(f"br label %{end}")
        self.begin(end)
        kinds = [self.type(x.dtype.kind) for x in numbers]
        return [
            self.do(f"phi {kind} [{name}, %{after}], [zeroinitializer, %{before}]")
            for kind, name in zip(kinds, names, strict=True)
        ]

    def _operation(self, value: Expr) -> None:
        kind = value.operands[0].dtype.kind if value.op != "select" else value.dtype.kind
        write = _WRITERS.get((value.op, kind))
        if write is None:
            raise UnsupportedError(f"{value.op} of {value.operands[0].dtype}")
        operands = [self._operand(x) for x in value.operands]
        self._names[value.index] = self.do(write(self, value, operands))

    # Of an operation, the last instruction; what comes before it is already among the lines.

    def _call(self, value: Expr, operands: list[str]) -> str:
        (x,) = operands
        return (
            f"call {self.type('f')} {self._function(_INTRINSICS[value.op])}({self.type('f')} {x})"
        )

    def _extreme(self, value: Expr, operands: list[str]) -> str:
        number = self.type("f")
        if self._lanes == 1:
            function = self._function(_EXTREMES[value.op])
            return f"call {number} {function}({number} {operands[0]}, {number} {operands[1]})"
        # One instruction on x86, which takes the second where one is not a number.
        ordered = sorted(
            zip(value.operands, operands, strict=True), key=lambda x: not is_constant(x[0])
        )
        (first, a), (_, b) = ordered
        better = "ogt" if value.op == "max" else "olt"
        best = self._chosen(self.do(f"fcmp {better} {number} {a}, {b}"), "f", a, b)
        if is_constant(first):
            return best
        best = self.do(best)
        return self._chosen(self.do(f"fcmp uno {number} {a}, {a}"), "f", a, best)

    def _finite(self, value: Expr, operands: list[str]) -> str:
        number = self.type("f")
        size = self.do(f"call {number} {self._function('fabs')}({number} {operands[0]})")
        return f"fcmp olt {number} {size}, {self._splat('f', _float(np.inf))}"

    def _magnitude(self, value: Expr, operands: list[str]) -> str:
        whole, (x,) = self.type("i"), operands
        zero = self._splat("i", "0")
        below = self.do(f"icmp slt {whole} {x}, {zero}")
        return self._chosen(below, "i", self.do(f"sub {whole} {zero}, {x}"), x)

    def _negative(self, value: Expr, operands: list[str]) -> str:
        return f"sub {self.type('i')} {self._splat('i', '0')}, {operands[0]}"

    def _negation(self, value: Expr, operands: list[str]) -> str:
        return f"xor {self.type('b')} {operands[0]}, {self._splat('b', 'true')}"

    def _larger(self, value: Expr, operands: list[str]) -> str:
        a, b = operands
        better = "sgt" if value.op == "max" else "slt"
        return self._chosen(self.do(f"icmp {better} {self.type('i')} {a}, {b}"), "i", a, b)

    def _chosen(self, which: str, kind: str, yes: str, no: str) -> str:
        return f"select {self.type('b')} {which}, {self.type(kind)} {yes}, {self.type(kind)} {no}"

    def _select(self, value: Expr, operands: list[str]) -> str:
        which, no, yes = operands
        return self._chosen(which, value.dtype.kind, yes, no)

    def _convert(self, value: Expr, operands: list[str]) -> str:
        source, to = value.operands[0].dtype.kind, value.dtype.kind
        if source == "f":
            function = self._function("fptosi.sat")
            return f"call {self.type('i')} {function}({self.type('f')} {operands[0]})"
        how = "zext" if to == "i" else "uitofp" if source == "b" else "sitofp"
        return f"{how} {self.type(source)} {operands[0]} to {self.type(to)}"

    def _comparison(self, value: Expr, operands: list[str]) -> str:
        kind = value.operands[0].dtype.kind
        pair = f"{self.type(kind)} {', '.join(operands)}"
        if kind == "f":
            # What is not a number differs from all.
            return f"fcmp {'une' if value.op == 'ne' else f'o{value.op}'} {pair}"
        sign = "" if value.op in ("eq", "ne") else "s"
        return f"icmp {sign}{value.op} {pair}"


_Writer = Callable[[LlvmEmitter, Expr, list[str]], str]


def _plain(instruction: str, kind: str) -> _Writer:
    def write(text: LlvmEmitter, value: Expr, operands: list[str]) -> str:
        return f"{instruction} {text.type(kind)} {', '.join(operands)}"

    return write


def _float(x: float) -> str:
    """Return a constant by its bits, which LLVM writes as those of a double."""
    return f"0x{struct.pack('>d', float(x)).hex().upper()}"


# A product and a sum may be rounded once instead of twice.
_FUSED = "contract"

_WRITERS: dict[tuple[str, str], _Writer] = {
    **{(op, "f"): _plain(f"f{op} {_FUSED}", "f") for op in ("add", "div", "mul", "sub")},
    **{(op, "i"): _plain(op, "i") for op in ("add", "mul", "sub")},
    **{(op, "b"): _plain(op, "b") for op in ("and", "or", "xor")},
    **{(op, kind): LlvmEmitter._comparison for op in COMPARISONS for kind in "fi"},
    **{(op, "b"): LlvmEmitter._comparison for op in ("eq", "ne")},
    **{(op, "f"): LlvmEmitter._call for op in _INTRINSICS},
    **{(op, "f"): LlvmEmitter._extreme for op in ("max", "min")},
    **{(op, "i"): LlvmEmitter._larger for op in ("max", "min")},
    **{("select", kind): LlvmEmitter._select for kind in "fi"},
    **{("convert", kind): LlvmEmitter._convert for kind in "fib"},
    ("abs", "i"): LlvmEmitter._magnitude,
    ("is_finite", "f"): LlvmEmitter._finite,
    ("neg", "f"): _plain("fneg", "f"),
    ("neg", "i"): LlvmEmitter._negative,
    ("not", "b"): LlvmEmitter._negation,
}
"""By operation and kind of the operands' dtype."""
