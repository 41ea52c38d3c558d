"""Write what the kernels of PPO on CPUs share: loading a network, and its forward pass.

A stage divides its rows into parts, which XLA's threads compute, and a part into tiles. Everything
is float32.

A column of ones beside the activations has the biases as its weights, so that one product computes
a layer with its biases.
"""

import contextlib
from collections.abc import Iterator, Sequence

from jetbot_mjx.agents.fused.cpu_product import ROWS, Matrix, fill, matmul, rounded_up
from jetbot_mjx.agents.fused.cpu_stages import Call, Stage
from jetbot_mjx.agents.fused.shapes import UpdateShape, places
from onekernel.build import LlvmWriter, ScalarProgram, Value, run_program

HEAD = 16
"""Columns of the last layer, of which those beyond its outputs are zero."""

TILE_ROWS = 64
"""Rows of a tile, about, if there are as many."""

MOST_PARTS = 32
"""Parts of a stage at most: each has a gradient of its own, and arranges the weights."""

_PAD = 16
"""Numbers between the rows of a matrix, so that they do not share few places of the cache."""


class NetworkStage(Stage):
    """A `NetworkStage` takes rows through one of the networks.

    It divides its items, environments or unrolls, into parts, which XLA's threads compute, and the
    items of a part into tiles. A thread's scratch memory has these matrices of float32:

        weights0, weights1, ...  (inputs + 1, width) of each hidden layer; the last row are biases
        head                     (width + 1, HEAD), zero beyond the outputs
        layer0                   (rows of a tile, observations + 1), the last column ones
        layer1, layer2, ...      (rows, width + 1), likewise
        outputs                  (rows, HEAD)
    """

    is_policy = True
    """Whether the network is the policy's."""

    def __init__(
        self, shape: UpdateShape, lanes: int, items: int, part_items: int, steps: int = 1
    ) -> None:
        """Divide the rows.

        Args:
          shape: the networks.
          lanes: the number of float32 values in a vector register.
          items: the number of items.
          part_items: the number of items of a part; the last parts may have fewer.
          steps: the rows of an item.
        """
        self.shape, self.lanes = shape, lanes
        self.items, self.part_items, self.steps = items, part_items, steps
        of_policy, of_values = shape.outputs
        self.outputs = of_policy if self.is_policy else of_values
        self.parts = -(-items // part_items)
        self.tile_items = min(part_items, -(-TILE_ROWS // steps))
        # The rows of a tile that are stored, and the strides of those of a layer.
        self.rows = -(-self.tile_items * steps // ROWS) * ROWS
        self.stride = shape.width + _PAD
        self.first_stride = -(-(shape.observations + 1) // _PAD) * _PAD
        self.layout = places(self.scratch_sizes(), _PAD)
        """Where each array begins in a part's scratch memory, and its `size`, in floats."""
        self.scratch = self.layout["size"]

    def scratch_sizes(self) -> dict[str, int]:
        """Return the floats of each array of the scratch memory."""
        shape, rows = self.shape, self.rows
        sizes = {f"weights{i}": (n + 1) * self.stride for i, n, _ in shape.hidden_layers}
        sizes |= {"head": (shape.width + 1) * HEAD, "layer0": rows * self.first_stride}
        sizes |= {f"layer{i}": rows * self.stride for i in range(1, shape.layers + 1)}
        return sizes | {"outputs": rows * HEAD}

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
        lanes = self.lanes
        names = "ptr noalias one", "ptr noalias other", "u64 rows"
        w = LlvmWriter(name, *names, lanes=lanes)
        *layers, rows = w.parameters
        with w.loop(rows) as row:
            start = row * self.stride
            # Vectors of a row; the columns beside them stay as they are.
            with w.loop(self.shape.width // lanes) as i:
                place = start + i * lanes
                at = [layer + place for layer in layers]
                results = run_program(w, program, [at[x].load(w.vector) for x in reads])
                for result, x in zip(results, writes, strict=True):
                    at[x].store(result)
        return w

    def functions(self, call: Call) -> list[LlvmWriter]:
        """Write the function that computes one part, and those that it calls."""
        functions = self.own_functions()
        self.w, self.part = w, part = self.begin(self.lanes)
        # Find the arrays of the replica, the network's parameters and the scratch memory.
        self.sizes = call.sizes
        self.arrays = {name: call.array(part.job, part.replica, name) for name in call.sizes}
        start = 0 if self.is_policy else self.shape.policy_size
        self.params = self.arrays["params"] + start
        self.places = {name: part.scratch + place for name, place in self.layout.items()}
        self.begin_part()
        # Go through the items of the part in tiles.
        first = part.number * self.part_items
        there = w.minimum(self.items - first, self.part_items)
        per_tile = self.tile_items
        with w.loop(rounded_up(there, per_tile)) as tile:
            done = tile * per_tile
            count = w.minimum(there - done, per_tile)
            self.tile(first + done, count)
        self.end_part()
        return [*functions, w]

    def begin_part(self) -> None:
        """Arrange the weights, and set the numbers of the layers that no row changes."""
        w, shape, places = self.w, self.shape, self.places
        width, stride, lanes = shape.width, self.stride, w.lanes
        # The hidden layers' weights and biases, with room between their rows.
        for i, inputs, start in shape.hidden_layers:
            source = self.params + start
            with w.loop(inputs + 1) as row, w.loop(width // lanes) as j:
                place, target = row * width + j * lanes, row * stride + j * lanes
                (places[f"weights{i}"] + target).store((source + place).load(w.vector))
        # Those of the last layer, with zeros beyond its outputs.
        fill(places["head"], (width + 1) * HEAD)
        fill(places["layer0"], self.rows * self.first_stride)
        source, outputs = self.params + shape.head_start, self.outputs
        with w.loop(width + 1) as row, w.loop(outputs) as j:
            place, target = row * outputs + j, row * HEAD + j
            places["head"][target] = source[place]
        # The column of ones beside the activations.
        with w.loop(self.rows) as row:
            (places["layer0"] + row * self.first_stride)[shape.observations] = 1.0
            for i in range(1, shape.layers + 1):
                (places[f"layer{i}"] + row * stride)[width] = 1.0

    def end_part(self) -> None:
        """Write what is known after the last tile."""

    @contextlib.contextmanager
    def groups(self, count: Value) -> Iterator[Value]:
        """Repeat what is appended inside for as many rows at once as a vector has lanes.

        Args:
          count: the number of rows.

        Yields:
          The first row of the group.
        """
        lanes = self.lanes
        with self.w.loop(rounded_up(count, lanes)) as group:
            yield group * lanes

    @property
    def deviations(self) -> Value:
        """Return the address of the standard deviations that are parameters, or of any numbers."""
        return self.params + (self.shape.head_start + (self.shape.width + 1) * self.outputs)

    def gather(
        self,
        name: str,
        lane: Value,
        sources: Sequence[tuple[Value, int]],
        others: Sequence[Value] = (),
    ) -> None:
        """Copy what a function of single samples reads to a lane, a number to each row.

        Args:
          name: the array of scratch memory that it reads, of shape (numbers, lanes).
          lane: the lane.
          sources: addresses, and how many numbers there.
          others: the numbers behind these.
        """
        numbers = [source[i] for source, count in sources for i in range(count)]
        for i, number in enumerate([*numbers, *others]):
            (self.places[name] + lane)[i * self.lanes] = number

    def stored_rows(self, rows: Value) -> Value:
        """Return a number of rows, rounded up to whole register tiles of a product."""
        return rounded_up(rows, ROWS) * ROWS

    def load_observation(self, source: Value, row: Value) -> None:
        """Copy a normalised observation to a row of the tile."""
        # (observation - mean) / std.
        target = self.places["layer0"] + row * self.first_stride
        with self.w.loop(self.shape.observations) as i:
            value, mean = source[i], self.arrays["mean"][i]
            inverse_std = self.arrays["inverse_std"][i]
            target[i] = (value - mean) * inverse_std

    @property
    def activations(self) -> list[Matrix]:
        """Return the observations and the activations of each hidden layer."""
        strides = [self.first_stride, *[self.stride] * self.shape.layers]
        return [Matrix(self.places[f"layer{i}"], stride) for i, stride in enumerate(strides)]

    def forward(self, stored: Value) -> None:
        """Compute all layers of a tile, from its observations on.

        Args:
          stored: the number of rows, from `stored_rows`.
        """
        w, shape, places, activations = self.w, self.shape, self.places, self.activations
        none = Value(w, "null", "ptr")
        for i, inputs, _ in shape.hidden_layers:
            # The weighted sums with the biases, and then in their place the activations.
            weights, after = Matrix(places[f"weights{i}"], self.stride), activations[i + 1]
            matmul(activations[i], weights, after, (stored, shape.width, inputs + 1))
            w.call("activate", after.start, places.get(f"slopes{i + 1}", none), stored)
        # The last layer has no activation.
        head, outputs = Matrix(places["head"], HEAD), Matrix(places["outputs"], HEAD)
        matmul(activations[-1], head, outputs, (stored, HEAD, shape.width + 1))
