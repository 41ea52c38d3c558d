"""Write what the kernels of PPO on CPUs share: loading a network, and its forward pass.

A stage divides its rows into parts, which XLA's threads compute, and a part into tiles. Everything
is float32.

A column of ones beside the activations has the biases as its weights, so that one product computes
a layer with its biases.
"""

import abc
import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any

from jetbot_mjx.agents.fused import sample_loss
from jetbot_mjx.agents.fused.cpu_product import ROWS, Matrix, fill, multiply, rounded_up
from jetbot_mjx.agents.fused.cpu_stages import Call, Stage
from jetbot_mjx.agents.fused.shapes import UpdateShape
from onekernel.build import LlvmWriter, ScalarProgram, Value, run_program

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
        self.division, self.shape = division, division.shape
        self.parts, self.scratch = division.parts, division.layout["size"]

    def own_functions(self) -> list[LlvmWriter]:
        """Write the functions that a part calls; `activate` is one of them."""
        raise NotImplementedError

    def tile(self, first: Value, count: Value) -> None:
        """Compute the rows of some items.

        Args:
          first: the first item.
          count: their number.
        """
        raise NotImplementedError

    def on_layers(
        self, name: str, program: ScalarProgram, reads: Sequence[int], writes: Sequence[int]
    ) -> LlvmWriter:
        """Write a function of two layers that applies a program to each of their numbers.

        Args:
          name: the name of the function.
          program: the program.
          reads: the layers that it reads, 0 or 1.
          writes: those that it writes.
        """
        lanes = self.division.lanes
        names = "ptr noalias one", "ptr noalias other", "u64 rows"
        w = LlvmWriter(name, *names, lanes=lanes)
        *layers, rows = w.parameters
        with w.loop(rows) as row:
            start = row * self.division.stride
            # Vectors of a row; the columns beside them stay as they are.
            with w.loop(self.shape.width // lanes) as i:
                place = start + i * lanes
                at = [layer + place for layer in layers]
                results = run_program(w, program, [at[x].load(w.vector) for x in reads])
                for result, x in zip(results, writes, strict=True):
                    at[x].store(result)
        return w

    def activation(self) -> Callable[..., Any]:
        """Return the activation with its derivative, as a function of a scalar."""
        return functools.partial(sample_loss.activation, self.shape.activation)

    def functions(self, call: Call) -> list[LlvmWriter]:
        """Write the function that computes one part, and those that it calls."""
        functions, division = self.own_functions(), self.division
        self.w, self.part = w, part = self.begin(division.lanes)
        # Find the arrays of the policy, the network's parameters and the scratch memory.
        self.arrays = {name: call.array(part.job, part.policy, name) for name in self.arrays_of}
        start = 0 if division.is_policy else self.shape.policy_size
        self.params = self.arrays["params"] + start
        self.places = {
            name: part.scratch + place for name, place in division.layout.items() if name != "size"
        }
        self.begin_part()
        # Go through the items of the part in tiles.
        first = part.number * division.part_items
        there = w.minimum(division.items - first, division.part_items)
        per_tile = division.tile_items
        with w.loop(rounded_up(there, per_tile)) as tile:
            done = tile * per_tile
            count = w.minimum(there - done, per_tile)
            self.tile(first + done, count)
        self.end_part()
        return [*functions, w]

    def hidden(self) -> list[tuple[int, int, int]]:
        """Return number, inputs and first parameter of each hidden layer."""
        sizes = [(n + 1) * self.shape.width for n in self.shape.inputs[:-1]]
        starts = itertools.accumulate(sizes, initial=0)
        return [
            (i, n, start)
            for i, (n, start) in enumerate(zip(self.shape.inputs[:-1], starts, strict=False))
        ]

    def begin_part(self) -> None:
        """Arrange the weights, and set the numbers of the layers that no row changes."""
        w, shape, division, places = self.w, self.shape, self.division, self.places
        width, stride, lanes = shape.width, division.stride, w.lanes
        # The hidden layers' weights and biases, with room between their rows.
        for i, inputs, start in self.hidden():
            source = self.params + start
            with w.loop(inputs + 1) as row, w.loop(width // lanes) as j:
                place, target = row * width + j * lanes, row * stride + j * lanes
                (places[f"weights{i}"] + target).store((source + place).load(w.vector))
        # Those of the last layer, with zeros beyond its outputs.
        fill(places["head"], (width + 1) * HEAD)
        fill(places["layer0"], division.rows * division.first_stride)
        source, outputs = self.params + shape.hidden, division.outputs
        with w.loop(width + 1) as row, w.loop(outputs) as j:
            place, target = row * outputs + j, row * HEAD + j
            places["head"][target] = source[place]
        # The column of ones beside the activations.
        with w.loop(division.rows) as row:
            (places["layer0"] + row * division.first_stride)[shape.observations] = 1.0
            for i in range(1, shape.layers + 1):
                (places[f"layer{i}"] + row * stride)[width] = 1.0

    def end_part(self) -> None:
        """Write what is known after the last tile."""

    def stored_rows(self, rows: Value) -> Value:
        """Return a number of rows, rounded up to whole register tiles of a product."""
        return rounded_up(rows, ROWS) * ROWS

    def load_observation(self, source: Value, row: Value) -> None:
        """Copy a normalised observation to a row of the tile."""
        # (observation - mean) / std, with 1 / std as `scale`.
        target = self.places["layer0"] + row * self.division.first_stride
        with self.w.loop(self.shape.observations) as i:
            value, mean, scale = source[i], self.arrays["mean"][i], self.arrays["scale"][i]
            target[i] = (value - mean) * scale

    @property
    def layers(self) -> list[Matrix]:
        """Return the observations and the activations of each hidden layer."""
        strides = [self.division.first_stride, *[self.division.stride] * self.shape.layers]
        return [Matrix(self.places[f"layer{i}"], stride) for i, stride in enumerate(strides)]

    def forward(self, stored: Value) -> None:
        """Compute all layers of a tile, from its observations on.

        Args:
          stored: the number of rows, from `stored_rows`.
        """
        w, shape, places, layers = self.w, self.shape, self.places, self.layers
        none = Value(w, "null", "ptr")
        for i, inputs, _ in self.hidden():
            # The weighted sums with the biases, and then in their place the activations.
            weights, after = Matrix(places[f"weights{i}"], self.division.stride), layers[i + 1]
            multiply(layers[i], weights, after, (stored, shape.width, inputs + 1))
            w.call("activate", after.start, places.get(f"slopes{i + 1}", none), stored)
        # The last layer has no activation.
        head, outputs = Matrix(places["head"], HEAD), Matrix(places["outputs"], HEAD)
        multiply(layers[-1], head, outputs, (stored, HEAD, shape.width + 1))


def rounded(size: int, multiple: int) -> int:
    """Return a size rounded up to a multiple of another."""
    return -(-size // multiple) * multiple
