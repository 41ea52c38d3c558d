"""Write a function that XLA calls on a CPU, whose threads go through several stages together.

A stage is divided into parts. The threads take the parts of all stages in order, and a part waits
until all parts of the stages before have ended. XLA wakes its threads once for a call; between two
calls they go to sleep, and come back late.

How many parts a stage has follows from the sizes alone, so no result depends on the number of
threads.
"""

import abc
import dataclasses
import itertools
from collections.abc import Mapping, Sequence

from jetbot_mjx.compiler import ffi_wrapper
from jetbot_mjx.compiler.llvm_codegen import LlvmEmitter
from jetbot_mjx.compiler.update.vector_code import (
    VectorCode,
    number,
    product_declarations,
    product_text,
)

_CHUNKS = 8
"""Parts of a stage that goes through the vector of parameters once."""

_PARAMETERS = ("ptr %job", "i64 %policy", "i64 %part", "i64 %minibatch", "ptr %scratch")


@dataclasses.dataclass(frozen=True)
class Call:
    """A `Call` holds the arrays of a call and its stages."""

    arguments: tuple[str, ...]
    """Names of the arrays that it reads; all have the policies as their first axis."""
    results: tuple[str, ...]
    sizes: Mapping[str, int]
    """Numbers of one policy in each array."""
    stages: Sequence["Stage"]
    minibatches: int | None = 1
    """How often to go through the stages; None: once, for the minibatch of the array `index`."""

    def text(self, *, lanes: int, registers: int, name: str, machine: str) -> str:
        """Return the LLVM module.

        Args:
          lanes: the number of float32 values in a vector register.
          registers: the number of vector registers.
          name: the name of the function.
          machine: the processor, one of `ffi_wrapper.MACHINES`.
        """
        functions = [text for stage in self.stages for text in stage.texts(self)]
        programs = [program for stage in self.stages for program in stage.programs]
        lines = [product_declarations(lanes), "declare float @llvm.sqrt.f32(float)"]
        lines += [line for program in programs for line in program.declarations()]
        functions += [product_text(lanes, registers), self._needed(), self._block()]
        return ffi_wrapper.call_text(
            "\n".join(dict.fromkeys([*lines, *functions])),
            arguments=len(self.arguments),
            results=len(self.results),
            blocks_per_robot=self._parts * (self.minibatches or 1),
            blocks_per_thread=1,
            scratch=max(64 * -(-stage.scratch // 16) for stage in self.stages),
            needed="call i64 @needed(ptr %job, i64 %index)",
            name=name,
            machine=machine,
        )

    def array(self, code: VectorCode, name: str, policy: str = "%policy") -> str:
        """Return the address of the array of a policy."""
        place = (*self.arguments, *self.results).index(name)
        address = code.let(f"getelementptr %Job, ptr %job, i32 0, i32 5, i64 {place}")
        return code.at(code.let(f"load ptr, ptr {address}"), code.mul(policy, self.sizes[name]))

    @property
    def _parts(self) -> int:
        return sum(stage.parts for stage in self.stages)

    @property
    def _starts(self) -> list[int]:
        """Return the number of parts before each stage."""
        return [sum(x.parts for x in self.stages[:i]) for i in range(len(self.stages))]

    def _decoded(self, code: VectorCode) -> tuple[str, str, str]:
        """Return the policies, and of block `%index` its minibatch and its place in that."""
        policies = code.let(
            f"load i64, ptr {code.let('getelementptr %Job, ptr %job, i32 0, i32 4')}"
        )
        blocks = code.mul(policies, self._parts)
        minibatch, place = (code.let(f"{op} i64 %index, {blocks}") for op in ("udiv", "urem"))
        return policies, minibatch, place

    def _needed(self) -> str:
        """Write a function that returns how many blocks must have ended before a block begins."""
        code = VectorCode(1)
        policies, minibatch, place = self._decoded(code)
        before: str | int = 0
        for start in self._starts[1:]:
            begins = code.mul(policies, start)
            is_there = code.let(f"icmp uge i64 {place}, {begins}")
            before = code.select(is_there, "i64", begins, before)
        done = code.mul(minibatch, code.mul(policies, self._parts))
        lines = "\n".join([*code.lines, f"%needed = add i64 {done}, {before}", "ret i64 %needed"])
        return f"define internal i64 @needed(ptr %job, i64 %index) {{\n{lines}\n}}\n"

    def _block(self) -> str:
        """Write the function that computes a block, by its index."""
        code = VectorCode(1)
        policies, minibatch, place = self._decoded(code)
        for i, (stage, start) in enumerate(zip(self.stages, self._starts, strict=True)):
            end = code.mul(policies, start + stage.parts)
            is_here = code.let(f"icmp ult i64 {place}, {end}")
            code.do(f"br i1 {is_here}, label %stage{i}, label %beyond{i}")
            code.do(f"stage{i}:")
            within = code.sub(place, code.mul(policies, start))
            policy, part = (
                code.let(f"{op} i64 {within}, {stage.parts}") for op in ("udiv", "urem")
            )
            if self.minibatches is None:
                minibatch = code.index(self.array(code, "index", policy))
            numbers = (f"i64 {x}" for x in (policy, part, minibatch))
            code.call(stage.name, "ptr %job", *numbers, "ptr %scratch")
            code.do("ret void")
            code.do(f"beyond{i}:")
        return code.function("block", ["ptr %job", "i64 %index", "ptr %scratch"])


class Stage(abc.ABC):
    """A `Stage` writes a function for one of its parts."""

    name: str
    """Name of the function."""
    parts: int
    """Number of parts of a policy."""
    scratch: int = 0
    """Numbers in the scratch memory of a thread, which is aligned to 64 bytes."""

    def __init__(self) -> None:
        """Begin without programs."""
        self.programs: list[LlvmEmitter] = []

    @abc.abstractmethod
    def texts(self, call: Call) -> list[str]:
        """Return the texts of the function, and of those that it calls."""

    def function(self, code: VectorCode) -> str:
        """Return the text of the function from its instructions."""
        return code.function(self.name, _PARAMETERS)


class VectorStage(Stage):
    """A `VectorStage` goes through the vector of parameters, in chunks."""

    parts = _CHUNKS

    def chunk(self, code: VectorCode, start: int, stop: int) -> tuple[str, str]:
        """Return the first element of the part's share of a range, and the number of elements."""
        size = stop - start
        per = -(-size // (16 * _CHUNKS)) * 16
        first = code.smaller(code.mul("%part", per), size)
        return code.add(first, start), code.smaller(code.sub(size, first), per)


class SumStage(VectorStage):
    """A `SumStage` adds up the gradients of all parts, in their order."""

    def __init__(self, lanes: int, ranges: Mapping[str, tuple[int, Sequence[int]]]) -> None:
        """Prepare.

        Args:
          lanes: the number of float32 values in a vector register.
          ranges: of each array of vectors their number, and where in the gradient they begin, where
            their parameters end, and where they end.
        """
        super().__init__()
        self.name, self._lanes, self._ranges = "total", lanes, ranges

    def texts(self, call: Call) -> list[str]:
        """Return the text of the function."""
        code = VectorCode(self._lanes)
        gradient = call.array(code, "gradient")
        for name, (count, places) in self._ranges.items():
            vectors, begin, size = call.array(code, name), places[0], places[-1] - places[0]
            for start, stop in itertools.pairwise(places):
                for place, kind in code.each(*self.chunk(code, start - begin, stop - begin)):
                    source = code.at(vectors, place)
                    total = code.load(source, kind)
                    for i in range(1, count):
                        other = code.load(code.at(source, i * size), kind)
                        total = code.arithmetic("fadd", total, other, kind)
                    code.store(total, code.at(gradient, begin, place), kind)
        return [self.function(code)]


class SquareStage(VectorStage):
    """A `SquareStage` adds up the squares of the gradient, for each chunk."""

    def __init__(self, lanes: int, ranges: Sequence[tuple[int, int]]) -> None:
        """Prepare.

        Args:
          lanes: the number of float32 values in a vector register.
          ranges: where the gradient holds parameters.
        """
        super().__init__()
        self.name, self._lanes, self._ranges, self.scratch = "squares", lanes, ranges, lanes

    def texts(self, call: Call) -> list[str]:
        """Return the text of the function."""
        code = VectorCode(self._lanes)
        gradient, squares = call.array(code, "gradient"), call.array(code, "squares")
        code.fill("%scratch", self._lanes)
        for start, stop in self._ranges:
            for place, kind in code.each(*self.chunk(code, start, stop)):
                value = code.load(code.at(gradient, place), kind)
                total = code.load("%scratch", kind)
                square = code.arithmetic("fmul", value, value, kind)
                code.store(code.arithmetic("fadd", total, square, kind), "%scratch", kind)
        target = code.at(squares, "%part")
        code.store(number(0.0), target)
        code.accumulate("%scratch", self._lanes, target)
        return [self.function(code)]


class JoinedStage(Stage):
    """A `JoinedStage` is two stages: a part of the second reads what that of the first wrote.

    No thread waits between them, and a part's numbers are still in its cache.
    """

    def __init__(self, first: Stage, second: Stage) -> None:
        """Prepare, for two stages of the same number of parts."""
        super().__init__()
        assert first.parts == second.parts
        self._stages = first, second
        self.name, self.parts = f"{first.name}_and_{second.name}", first.parts
        self.scratch = max(first.scratch, second.scratch)

    def texts(self, call: Call) -> list[str]:
        """Return the texts of both functions, and of one that calls them."""
        code = VectorCode(1)
        texts = [text for stage in self._stages for text in stage.texts(call)]
        for stage in self._stages:
            code.call(stage.name, *_PARAMETERS)
            self.programs += stage.programs
        return [*texts, self.function(code)]


SQUARES = _CHUNKS
"""Length of the array `squares` of a policy."""
