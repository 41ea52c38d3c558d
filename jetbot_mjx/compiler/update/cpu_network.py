"""Write what the kernels of PPO on CPUs share: loading a network, and its forward pass.

A stage divides its rows into parts, which XLA's threads compute, and a part into tiles. Everything
is float32.

A column of ones beside the activations has the biases as its weights, so that one product computes
a layer with its biases.
"""

import abc
import functools
import itertools
from collections.abc import Callable
from typing import Any

from jetbot_mjx.compiler.llvm_codegen import LlvmEmitter
from jetbot_mjx.compiler.lower_jaxpr import ScalarProgram
from jetbot_mjx.compiler.update import sample_loss
from jetbot_mjx.compiler.update.cpu_stages import Call, Stage
from jetbot_mjx.compiler.update.shapes import UpdateShape
from jetbot_mjx.compiler.update.vector_code import ROWS, VectorCode, number

HEAD = 16
"""Columns of the last layer, of which those beyond its outputs are zero."""

TILE_ROWS = 64
"""Rows of a tile, about, if there are as many."""

MOST_PARTS = 32

_PAD = 16
"""Numbers between the rows of a matrix, so that they do not share few places of the cache."""


class Division(abc.ABC):
    """A `Division` divides the rows of a kernel into parts and tiles of whole items."""

    shape: UpdateShape
    lanes: int
    """Number of float32 values in a vector register."""
    is_policy: bool
    """Whether the network is the policy's."""

    @property
    @abc.abstractmethod
    def items(self) -> int:
        """Return the number of items, for example unrolls."""

    @property
    @abc.abstractmethod
    def part_items(self) -> int:
        """Return the number of items of a part; the last parts may have fewer."""

    @property
    @abc.abstractmethod
    def steps(self) -> int:
        """Return the rows of an item."""

    @abc.abstractmethod
    def extra_sizes(self) -> dict[str, int]:
        """Return the floats of each array of the scratch memory beside those of `Kernel`."""

    @property
    def parts(self) -> int:
        """Return the number of parts."""
        return -(-self.items // self.part_items)

    @property
    def tile_items(self) -> int:
        """Return the number of items of a tile."""
        return min(self.part_items, -(-TILE_ROWS // self.steps))

    @property
    def rows(self) -> int:
        """Return the number of rows of a tile that are stored."""
        return rounded(self.tile_items * self.steps, ROWS)

    @property
    def outputs(self) -> int:
        """Return the number of outputs of the network."""
        return self.shape.outputs[not self.is_policy]

    @property
    def stride(self) -> int:
        """Return the stride of the rows of a layer."""
        return self.shape.width + _PAD

    @property
    def first_stride(self) -> int:
        """Return the stride of the rows of the observations."""
        return rounded(self.shape.observations + 1, _PAD)

    @functools.cached_property
    def layout(self) -> dict[str, int]:
        """Return where each array begins in a part's scratch memory, and its `size`, in floats."""
        shape, stride = self.shape, self.stride
        sizes = {f"weights{i}": (n + 1) * stride for i, n in enumerate(shape.inputs[:-1])}
        sizes |= {"head": (shape.width + 1) * HEAD, "layer0": self.rows * self.first_stride}
        sizes |= {f"layer{i}": self.rows * stride for i in range(1, shape.layers + 1)}
        sizes |= {"outputs": self.rows * HEAD, **self.extra_sizes()}
        padded = [rounded(size, _PAD) for size in sizes.values()]
        starts = list(itertools.accumulate(padded, initial=0))
        return {**dict(zip(sizes, starts, strict=False)), "size": starts[-1]}


class NetworkStage(Stage):
    """A `NetworkStage` takes tiles of rows through one of the networks."""

    arrays_of: tuple[str, ...]
    """Names of the arrays that it reads or writes."""

    def __init__(self, division: Any) -> None:
        """Prepare.

        Args:
          division: the `Division` of its rows.
        """
        super().__init__()
        self.division, self.shape = division, division.shape
        self.parts, self.scratch = division.parts, division.layout["size"]
        self.code = VectorCode(division.lanes)

    def functions(self) -> list[str]:
        """Return the texts of the functions that a part calls; `activate` is one of them."""
        raise NotImplementedError

    def tile(self, first: str, count: str) -> None:
        """Compute the rows of some items.

        Args:
          first: the first item.
          count: their number.
        """
        raise NotImplementedError

    def on_layers(
        self, name: str, program: ScalarProgram, reads: list[str], writes: list[str]
    ) -> str:
        """Write a function of two layers that applies a program to each of their numbers."""
        code = VectorCode(self.division.lanes)
        self.programs.append(LlvmEmitter(program, code.lanes))
        with code.loop("%rows") as row:
            start = code.mul(row, self.division.stride)
            with code.loop(self.shape.width // code.lanes) as i:
                place = code.add(start, code.mul(i, code.lanes))
                at = {array: code.at(array, place) for array in ("%one", "%other")}
                results = code.run(program, [code.load(at[x], code.vector) for x in reads])
                for result, array in zip(results, writes, strict=True):
                    code.store(result, at[array], code.vector)
        return code.function(name, ["ptr noalias %one", "ptr noalias %other", "i64 %rows"])

    def activation(self) -> Callable[..., Any]:
        """Return the activation with its derivative, as a function of a scalar."""
        return functools.partial(sample_loss.activation, self.shape.activation)

    def on_sample(self, name: str, program: ScalarProgram, lanes: int) -> str:
        """Write a function that applies a program to the rows of one array, into another."""
        code = VectorCode(lanes)
        self.programs.append(LlvmEmitter(program, lanes))
        count = sum(array.size for array in program.inputs)
        arguments = [code.load(code.at("%reads", i * lanes), code.vector) for i in range(count)]
        for i, result in enumerate(code.run(program, arguments)):
            code.store(result, code.at("%writes", i * lanes), code.vector)
        return code.function(name, ["ptr noalias %reads", "ptr noalias %writes"])

    def texts(self, call: Call) -> list[str]:
        """Return the texts of the function that computes one part, and of those that it calls."""
        functions, code, division = self.functions(), self.code, self.division
        self.arrays = {name: call.array(code, name) for name in self.arrays_of}
        start = 0 if division.is_policy else self.shape.policy_size
        self.params = code.at(self.arrays["params"], start)
        self.places = {
            name: code.at("%scratch", place)
            for name, place in division.layout.items()
            if name != "size"
        }
        self.begin()
        first = code.mul("%part", division.part_items)
        there = code.smaller(code.sub(division.items, first), division.part_items)
        per_tile = division.tile_items
        tiles = code.let(f"sdiv i64 {code.add(there, per_tile - 1)}, {per_tile}")
        with code.loop(tiles) as tile:
            done = code.mul(tile, per_tile)
            count = code.smaller(code.sub(there, done), per_tile)
            self.tile(code.add(first, done), count)
        self.end()
        return [*functions, self.function(code)]

    def hidden(self) -> list[tuple[int, int, int]]:
        """Return number, inputs and first parameter of each hidden layer."""
        sizes = [(n + 1) * self.shape.width for n in self.shape.inputs[:-1]]
        starts = itertools.accumulate(sizes, initial=0)
        return [
            (i, n, start)
            for i, (n, start) in enumerate(zip(self.shape.inputs[:-1], starts, strict=False))
        ]

    def begin(self) -> None:
        """Arrange the weights, and set what is no number of a row."""
        code, shape, division, places = self.code, self.shape, self.division, self.places
        width, stride, lanes = shape.width, division.stride, code.lanes
        for i, inputs, start in self.hidden():
            source = code.at(self.params, start)
            with code.loop(inputs + 1) as row, code.loop(width // lanes) as j:
                place = code.add(code.mul(row, width), code.mul(j, lanes))
                target = code.add(code.mul(row, stride), code.mul(j, lanes))
                code.copy(
                    code.at(source, place), code.at(places[f"weights{i}"], target), code.vector
                )
        code.fill(places["head"], (width + 1) * HEAD)
        code.fill(places["layer0"], division.rows * division.first_stride)
        source, outputs = code.at(self.params, shape.hidden), division.outputs
        with code.loop(width + 1) as row, code.loop(outputs) as j:
            place = code.add(code.mul(row, outputs), j)
            target = code.add(code.mul(row, HEAD), j)
            code.copy(code.at(source, place), code.at(places["head"], target))
        with code.loop(division.rows) as row:
            one = number(1.0)
            at = code.at(places["layer0"], code.mul(row, division.first_stride))
            code.store(one, code.at(at, shape.observations))
            for i in range(1, shape.layers + 1):
                at = code.at(places[f"layer{i}"], code.mul(row, stride))
                code.store(one, code.at(at, width))

    def end(self) -> None:
        """Write what is known after the last tile."""

    def stored_rows(self, rows: str) -> str:
        """Return a number of rows, rounded up to whole tiles of a product."""
        code = self.code
        return code.mul(code.let(f"udiv i64 {code.add(rows, ROWS - 1)}, {ROWS}"), ROWS)

    def load_observation(self, source: str, row: str) -> None:
        """Copy a normalised observation to a row of the tile."""
        code, size = self.code, self.shape.observations
        target = code.at(self.places["layer0"], code.mul(row, self.division.first_stride))
        with code.loop(size) as i:
            value, mean, scale = (
                code.load(code.at(array, i))
                for array in (source, self.arrays["mean"], self.arrays["scale"])
            )
            centred = code.arithmetic("fsub", value, mean)
            code.store(code.arithmetic("fmul", centred, scale), code.at(target, i))

    @property
    def layers(self) -> list[tuple[str, int]]:
        """Return address and stride of the observations and of each hidden layer."""
        strides = [self.division.first_stride, *[self.division.stride] * self.shape.layers]
        return [(self.places[f"layer{i}"], stride) for i, stride in enumerate(strides)]

    def forward(self, stored: str) -> None:
        """Compute all layers of a tile, from its observations on.

        Args:
          stored: the number of rows, from `stored_rows`.
        """
        code, shape, places = self.code, self.shape, self.places
        stride, layers = self.division.stride, self.layers
        for i, inputs, _ in self.hidden():
            after, _ = layers[i + 1]
            code.product(
                (*layers[i], 1),
                (places[f"weights{i}"], stride),
                layers[i + 1],
                (stored, shape.width, inputs + 1),
            )
            slopes = places.get(f"slopes{i + 1}", "null")
            code.call("activate", f"ptr {after}", f"ptr {slopes}", f"i64 {stored}")
        head, outputs = (places["head"], HEAD), (places["outputs"], HEAD)
        code.product((*layers[-1], 1), head, outputs, (stored, HEAD, shape.width + 1))


def rounded(size: int, multiple: int) -> int:
    """Return a size rounded up to a multiple of another."""
    return -(-size // multiple) * multiple
