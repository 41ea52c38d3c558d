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
    vector_loops,
)
from jetbot_mjx.agents.fused.shapes import UpdateShape
from onekernel.build import LlvmWriter, ScalarProgram, Value, cpu, run_program

_CHUNKS = 8
"""Parts of a stage that goes through the vector of parameters once."""


class Part(NamedTuple):
    """A `Part` holds what the function of a stage is given, to compute one of its parts."""

    job: Value
    """Address of the call's job, which knows the arrays."""
    replica: Value
    number: Value
    """Which of the parts of the stage."""
    minibatch: Value
    scratch: Value
    """Scratch memory of the thread."""


_PARAMETERS = ("ptr job", "u64 replica", "u64 part", "u64 minibatch", "ptr scratch")


@dataclasses.dataclass(frozen=True)
class Call:
    """A `Call` holds the arrays of a call and its stages.

    XLA's threads take blocks: a block is one part of a stage, in one minibatch of one replica.
    """

    arrays: tuple[str, ...]
    """Names of the arrays that XLA passes: the arguments, the results, and those between the
    stages. Each has the replicas as its first axis."""
    sizes: Mapping[str, int]
    """Numbers of one replica in each array."""
    stages: Sequence[Sequence["Stage"]]
    """The stages in their order. In place of one there may be several of as many parts: a part of
    the second follows that of the first, whose numbers are still in the cache."""
    minibatches: int
    """How often to go through the stages. With an array `index`, that is the only minibatch."""

    def text(self, host: cpu.Host) -> str:
        """Return the LLVM module for a processor."""
        return cpu.call_text(
            [self._needed(), *self.functions(host.lanes, host.registers)],
            blocks_per_instance=self.blocks,
            blocks_per_thread=1,
            scratch=self.scratch,
            machine=host.machine,
        )

    def functions(self, lanes: int, registers: int) -> list[LlvmWriter]:
        """Write the function `block`, which computes a block, and those that it calls.

        Args:
          lanes: the number of float32 values in a vector register.
          registers: the number of vector registers.
        """
        # Stages share some functions, which are in the module once.
        stages = [stage for together in self.stages for stage in together]
        functions = [function for stage in stages for function in stage.functions(self)]
        return [*functions, *product_functions(lanes, registers), self._block()]

    @property
    def blocks(self) -> int:
        """Return the number of blocks of a replica."""
        return self._parts * self.minibatches

    @property
    def scratch(self) -> int:
        """Return the bytes of scratch memory of a thread, a multiple of 64."""
        return max(64 * -(-stage.scratch // 16) for together in self.stages for stage in together)

    def array(self, job: Value, replica: Value, name: str) -> Value:
        """Return the address of the array of a replica."""
        place = self.arrays.index(name)
        return cpu.array_of(job, place) + replica * self.sizes[name]

    @property
    def _parts(self) -> int:
        return sum(stage.parts for stage, *_ in self.stages)

    @property
    def _starts(self) -> list[int]:
        """Return the number of parts before each stage."""
        parts = (stage.parts for stage, *_ in self.stages)
        return list(itertools.accumulate(parts, initial=0))[:-1]

    def _decoded(self, job: Value, index: Value) -> tuple[Value, Value, Value]:
        """Return the replicas, and of a block its minibatch and its place in that."""
        replicas = cpu.instance_count(job)
        blocks = replicas * self._parts
        return replicas, index // blocks, index % blocks

    def _needed(self) -> LlvmWriter:
        """Write a function that returns how many blocks must have ended before a block begins."""
        w = LlvmWriter("needed", "ptr job", "u64 index", result="u64")
        replicas, minibatch, place = self._decoded(*w.parameters)
        # All blocks of the stages before, and of the minibatches before.
        before = w.constant(0, "u64")
        for start in self._starts[1:]:
            begins = replicas * start
            before = w.select(place >= begins, begins, before)
        w.ret(minibatch * (replicas * self._parts) + before)
        return w

    def _block(self) -> LlvmWriter:
        """Write the function that computes a block, by its index."""
        w = LlvmWriter("block", *cpu.BLOCK_PARAMETERS)
        job, index, scratch = w.parameters
        replicas, minibatch, place = self._decoded(job, index)
        # Find the stage, and then the replica and the part of the stage.
        for stages, start in zip(self.stages, self._starts, strict=True):
            parts = stages[0].parts
            with w.when(place < replicas * (start + parts)):
                within = place - replicas * start
                replica, part = within // parts, within % parts
                if "index" in self.arrays:
                    minibatch = integer_at(self.array(job, replica, "index"))
                for stage in stages:
                    w.call(stage.name, *Part(job, replica, part, minibatch, scratch))
                w.ret()
        return w


def integer_at(address: Value) -> Value:
    """Return an integer of 32 bits from memory, as a place or a count."""
    return address.load("i32").to("u64")


class Stage(abc.ABC):
    """A `Stage` writes a function for one of its parts."""

    name: str
    """Name of the function."""
    parts: int
    """Number of parts of a replica."""
    scratch: int = 0
    """Numbers in the scratch memory of a thread, which is aligned to 64 bytes."""
    handed_on: Mapping[str, int] = {}
    """Numbers of one replica in each array that it hands on to the stages behind it."""

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

    def __init__(self, shape: UpdateShape, lanes: int) -> None:
        """Prepare.

        Args:
          shape: the networks, whose parameters the vector holds.
          lanes: the number of float32 values in a vector register.
        """
        self.shape, self.lanes = shape, lanes

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

    def __init__(self, shape: UpdateShape, lanes: int, vectors: Mapping[str, int]) -> None:
        """Prepare.

        Args:
          shape: the networks.
          lanes: the number of float32 values in a vector register.
          vectors: how many vectors each array has, first that of the policy, then of the values.
        """
        super().__init__(shape, lanes)
        self._vectors, self.handed_on = vectors, {"gradient": shape.size}

    def functions(self, call: Call) -> list[LlvmWriter]:
        """Write the function."""
        w, (job, replica, part, *_) = self.begin(self.lanes)
        # The array of each network has a vector for each part of its stage.
        gradient, shape = call.array(job, replica, "gradient"), self.shape
        ends = shape.policy_size, shape.size
        networks = zip(self._vectors.items(), shape.ranges, ends, strict=True)
        for (name, count), (begin, stop), end in networks:
            vectors, size = call.array(job, replica, name), end - begin
            # The parameters, and the metrics behind them.
            for bounds in ((0, stop - begin), (stop - begin, size)):
                for kind, loop in vector_loops(*self.chunk(part, *bounds)):
                    with loop as place:
                        # An element's sum over the vectors of all parts, in their order.
                        source = vectors + place
                        total = source.load(kind)
                        for i in range(1, count):
                            total += (source + i * size).load(kind)
                        (gradient + begin + place).store(total)
        return [w]


class SquareStage(VectorStage):
    """A `SquareStage` adds up the squares of the gradient, for each chunk."""

    name, handed_on = "squares", {"squares": _CHUNKS}
    scratch = 16
    """A sum for each lane of the longest vectors."""

    def functions(self, call: Call) -> list[LlvmWriter]:
        """Write the function."""
        w, (job, replica, part, _, scratch) = self.begin(self.lanes)
        gradient, squares = (call.array(job, replica, name) for name in ("gradient", "squares"))
        # A sum for each lane, and then one of all lanes.
        fill(scratch, self.lanes)
        for start, stop in self.shape.ranges:
            for kind, loop in vector_loops(*self.chunk(part, start, stop)):
                with loop as place:
                    value = (gradient + place).load(kind)
                    add_to(scratch, value * value)
        target = squares + part
        target.store(0.0)
        add_all(scratch, self.lanes, target)
        return [w]
