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
from typing import NamedTuple

from jetbot_mjx.agents.fused.cpu_product import (
    add_all,
    add_to,
    fill,
    product_functions,
    vectors_of,
)
from onekernel.build import LlvmWriter, ScalarProgram, Value, cpu, run_program

_CHUNKS = 8
"""Parts of a stage that goes through the vector of parameters once."""


class Part(NamedTuple):
    """A `Part` holds what the function of a stage is given, to compute one of its parts."""

    job: Value
    """Address of the call's job, which knows the arrays."""
    policy: Value
    number: Value
    """Which of the parts of the stage."""
    minibatch: Value
    scratch: Value
    """Scratch memory of the thread."""


_PARAMETERS = ("ptr job", "u64 policy", "u64 part", "u64 minibatch", "ptr scratch")


@dataclasses.dataclass(frozen=True)
class Call:
    """A `Call` holds the arrays of a call and its stages."""

    arguments: tuple[str, ...]
    """Names of the arrays that it reads; all have the policies as their first axis."""
    results: tuple[str, ...]
    sizes: Mapping[str, int]
    """Numbers of one policy in each array."""
    stages: Sequence["Stage"]
    minibatches: int
    """How often to go through the stages. With an array `index`, that is the only minibatch."""

    def text(self, *, lanes: int, registers: int, machine: str) -> str:
        """Return the LLVM module.

        Args:
          lanes: the number of float32 values in a vector register.
          registers: the number of vector registers.
          machine: the processor, one of `MACHINES`.
        """
        # Stages share some functions, which are in the module once.
        functions = [function for stage in self.stages for function in stage.functions(self)]
        functions += [*product_functions(lanes, registers), self._needed(), self._block()]
        return cpu.call_text(
            functions,
            blocks_per_instance=self._parts * self.minibatches,
            blocks_per_thread=1,
            scratch=max(64 * -(-stage.scratch // 16) for stage in self.stages),
            machine=machine,
        )

    def array(self, job: Value, policy: Value, name: str) -> Value:
        """Return the address of the array of a policy."""
        # XLA passes the arguments and then the results, each with the policies as its first axis.
        place = (*self.arguments, *self.results).index(name)
        return cpu.array_of(job, place) + policy * self.sizes[name]

    @property
    def _parts(self) -> int:
        return sum(stage.parts for stage in self.stages)

    @property
    def _starts(self) -> list[int]:
        """Return the number of parts before each stage."""
        return [sum(x.parts for x in self.stages[:i]) for i in range(len(self.stages))]

    def _decoded(self, job: Value, index: Value) -> tuple[Value, Value, Value]:
        """Return the policies, and of a block its minibatch and its place in that."""
        policies = cpu.instance_count(job)
        blocks = policies * self._parts
        return policies, index // blocks, index % blocks

    def _needed(self) -> LlvmWriter:
        """Write a function that returns how many blocks must have ended before a block begins."""
        w = LlvmWriter("needed", "ptr job", "u64 index", result="u64")
        policies, minibatch, place = self._decoded(*w.parameters)
        # All blocks of the stages before, and of the minibatches before.
        before = w.constant(0, "u64")
        for start in self._starts[1:]:
            begins = policies * start
            before = w.select(place >= begins, begins, before)
        w.ret(minibatch * (policies * self._parts) + before)
        return w

    def _block(self) -> LlvmWriter:
        """Write the function that computes a block, by its index."""
        w = LlvmWriter("block", *cpu.BLOCK_PARAMETERS)
        job, index, scratch = w.parameters
        policies, minibatch, place = self._decoded(job, index)
        # Find the stage, and then the policy and the part of the stage.
        for stage, start in zip(self.stages, self._starts, strict=True):
            with w.when(place < policies * (start + stage.parts)):
                within = place - policies * start
                policy, part = within // stage.parts, within % stage.parts
                if "index" in self.arguments:
                    minibatch = integer_at(self.array(job, policy, "index"))
                w.call(stage.name, *Part(job, policy, part, minibatch, scratch))
                w.ret()
        return w


class Stages(NamedTuple):
    """A `Stages` holds the stages of a call, in their order."""

    stages: Sequence["Stage"]
    between: Mapping[str, int] = {}
    """Numbers of one policy in each array that the stages hand on to each other."""


def integer_at(address: Value) -> Value:
    """Return an integer of 32 bits from memory, as a place or a count."""
    return address.load("i32").to("u64")


class Stage(abc.ABC):
    """A `Stage` writes a function for one of its parts."""

    name: str
    """Name of the function."""
    parts: int
    """Number of parts of a policy."""
    scratch: int = 0
    """Numbers in the scratch memory of a thread, which is aligned to 64 bytes."""

    @abc.abstractmethod
    def functions(self, call: Call) -> list[LlvmWriter]:
        """Write the function, and those that it calls."""

    def begin(self, lanes: int) -> tuple[LlvmWriter, Part]:
        """Begin to write the function, with vectors of some lanes."""
        w = LlvmWriter(self.name, *_PARAMETERS, lanes=lanes)
        return w, Part(*w.parameters)


def sample_function(name: str, program: ScalarProgram, lanes: int) -> LlvmWriter:
    """Write a function that applies a program to the rows of one array, into another.

    Args:
      name: the name of the function.
      program: the program; a row has one of its scalars, of each sample.
      lanes: the number of samples.
    """
    w = LlvmWriter(name, "ptr noalias reads", "ptr noalias writes", lanes=lanes)
    reads, writes = w.parameters
    count = sum(array.size for array in program.inputs)
    # A row of the array holds one scalar of all samples.
    arguments = [(reads + i * lanes).load(w.vector) for i in range(count)]
    for i, result in enumerate(run_program(w, program, arguments)):
        (writes + i * lanes).store(result)
    return w


class VectorStage(Stage):
    """A `VectorStage` goes through the vector of parameters, in chunks."""

    parts = _CHUNKS

    def chunk(self, part: Value, start: int, stop: int) -> tuple[Value, Value]:
        """Return the first element of a part's share of a range, and the number of elements."""
        w, size = part.writer, stop - start
        # Multiples of 16 numbers, as many as the longest vectors have.
        per = -(-size // (16 * _CHUNKS)) * 16
        first = w.minimum(part * per, size)
        return first + start, w.minimum(size - first, per)


class SumStage(VectorStage):
    """A `SumStage` adds up the gradients of all parts, in their order."""

    name = "total"

    def __init__(self, lanes: int, ranges: Mapping[str, tuple[int, Sequence[int]]]) -> None:
        """Prepare.

        Args:
          lanes: the number of float32 values in a vector register.
          ranges: of each array of vectors their number, and where in the gradient they begin, where
            their parameters end, and where they end.
        """
        self._lanes, self._ranges = lanes, ranges

    def functions(self, call: Call) -> list[LlvmWriter]:
        """Write the function."""
        w, (job, policy, part, *_) = self.begin(self._lanes)
        # The array of each network has a vector for each part of its stage.
        gradient = call.array(job, policy, "gradient")
        for name, (count, places) in self._ranges.items():
            vectors, begin, size = call.array(job, policy, name), places[0], places[-1] - places[0]
            for start, stop in itertools.pairwise(places):
                for place, kind in vectors_of(*self.chunk(part, start - begin, stop - begin)):
                    # An element's sum over the vectors of all parts, in their order.
                    source = vectors + place
                    total = source.load(kind)
                    for i in range(1, count):
                        total += (source + i * size).load(kind)
                    (gradient + begin + place).store(total)
        return [w]


class SquareStage(VectorStage):
    """A `SquareStage` adds up the squares of the gradient, for each chunk."""

    name = "squares"

    def __init__(self, lanes: int, ranges: Sequence[tuple[int, int]]) -> None:
        """Prepare.

        Args:
          lanes: the number of float32 values in a vector register.
          ranges: where the gradient holds parameters.
        """
        self._lanes, self._ranges, self.scratch = lanes, ranges, lanes

    def functions(self, call: Call) -> list[LlvmWriter]:
        """Write the function."""
        w, (job, policy, part, _, scratch) = self.begin(self._lanes)
        gradient, squares = (call.array(job, policy, name) for name in ("gradient", "squares"))
        # A sum for each lane, and then one of all lanes.
        fill(scratch, self._lanes)
        for start, stop in self._ranges:
            for place, kind in vectors_of(*self.chunk(part, start, stop)):
                value = (gradient + place).load(kind)
                add_to(scratch, value * value)
        target = squares + part
        target.store(0.0)
        add_all(scratch, self._lanes, target)
        return [w]


class JoinedStage(Stage):
    """A `JoinedStage` is two stages: a part of the second reads what that of the first wrote.

    No thread waits between them, and a part's numbers are still in its cache.
    """

    def __init__(self, first: Stage, second: Stage) -> None:
        """Prepare, for two stages of the same number of parts."""
        assert first.parts == second.parts
        self._stages = first, second
        self.name, self.parts = f"{first.name}_and_{second.name}", first.parts
        self.scratch = max(first.scratch, second.scratch)

    def functions(self, call: Call) -> list[LlvmWriter]:
        """Write both functions, and one that calls them."""
        w, part = self.begin(1)
        # Both functions get the same part.
        for stage in self._stages:
            w.call(stage.name, *part)
        return [*(function for stage in self._stages for function in stage.functions(call)), w]


SQUARES = _CHUNKS
"""Length of the array `squares` of a policy."""
