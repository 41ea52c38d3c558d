"""Load a network into shared memory, and write its forward pass."""

import abc
import itertools
from collections.abc import Callable, Iterator, Mapping
from typing import Literal

from jetbot_mjx.agents.fused.gpu_tiling import MOST_OUTPUTS, OUTPUT_STRIDE, PAD, Tiling, padded
from jetbot_mjx.agents.fused.shapes import POLICY_METRICS, DataSizes, LossTerms
from jetbot_mjx.agents.fused.tensor_core import (
    LANES,
    TILE,
    Accumulators,
    GpuKernel,
    GpuWriter,
    Operand,
)
from onekernel.build import Value


class NetworkKernel(GpuKernel):
    """A `NetworkKernel` writes what the kernels share: a loop over tiles, and a forward pass.

    Shared memory has these matrices of float16, whose rows have `stride_of` numbers:

        weights0, weights1, ...  (inputs, width) of each hidden layer; inputs in whole tiles of 16
        head                     (width, 16), zero beyond the outputs
        layer0                   (rows of a tile, observations in whole tiles of 16), normalised
        layer1, layer2, ...      (rows, width), activations; without a backward pass only layer1

    and of float32 the biases of each layer (width), the observations' mean and inverse_std, and the
    outputs (rows of a tile, MOST_OUTPUTS + 1).
    """

    def __init__(
        self, shapes: Mapping[str, tuple[int, ...]], tiling: Tiling, batch: DataSizes, blocks: int
    ) -> None:
        """Prepare to write.

        Args:
          shapes: the shapes of all arrays for one replica.
          tiling: the division of the work.
          batch: the sizes of the data.
          blocks: the number of blocks along the first axis of the grid.
        """
        super().__init__(shapes, blocks, tiling.threads, tiling.layout["size"])
        self.tiling, self.shape, self.batch = tiling, tiling.shape, batch
        self.stride = self.shape.width + PAD
        self.padded_inputs = padded(self.shape.observations)

    def bytes_of(self, name: str) -> int:
        """Return the byte of shared memory where an array begins."""
        return self.tiling.layout[name]

    def read(self, name: str, place: Value | int, offset: int = 0) -> Value:
        """Return a number of an array of float32 in shared memory."""
        return self.w.shared(place * 4, self.bytes_of(name) + 4 * offset).load()

    def write(self, name: str, place: Value | int, value: Value, offset: int = 0) -> None:
        """Write a number of an array of float32 in shared memory."""
        self.w.shared(place * 4, self.bytes_of(name) + 4 * offset).store(value)

    def layer(self, number: int) -> str:
        """Return the name of a layer's activations; 0: the observations."""
        return f"layer{number if self.tiling.is_gradient else min(number, 1)}"

    def stride_of(self, name: str) -> int:
        """Return the float16 numbers from row to row of a matrix."""
        special = {"layer0": self.padded_inputs + PAD, "head": TILE + PAD, "errors": TILE + PAD}
        return special.get(name, self.stride)

    def load_terms(self) -> LossTerms[Value]:
        """Return the coefficients of the loss."""
        return LossTerms(*(self.arrays["terms"][i] for i in range(len(LossTerms._fields))))

    @abc.abstractmethod
    def begin(self) -> list[Value]:
        """Load what all tiles need, and return the values that the first tile begins with."""

    @abc.abstractmethod
    def tile(self, tile: Value, carried: list[Value]) -> list[Value]:
        """Compute a tile.

        Args:
          tile: its number.
          carried: the values that it begins with.

        Returns:
          Those that the block's next tile begins with.
        """

    def end(self, carried: list[Value]) -> None:
        """Store what the last tile returned."""

    def text(self) -> str:
        """Return the module."""
        w, tiles = self.w, self.tiling.tiles(self.batch)
        self._find_thread()
        self.find_arrays(w.register("ctaid.z"))
        initial = self.begin()
        w.synchronize()
        # The blocks take the tiles in turns. A tile overwrites nothing that is read after the last
        # barrier of the one before.
        with w.repeat(self.block, *initial) as loop:
            tile, *carried = loop.carried
            carried = self.tile(tile, carried)
            # By no constant: where the assembler sees that a loop ends at once, it makes code with
            # more registers.
            following = tile + w.register("nctaid.x")
            loop.again(following < tiles, following, *carried)
        self.end(carried)
        return w.module(self.threads)

    def _find_thread(self) -> None:
        """Read the thread's place in the grid, and derive its places in the matrices."""
        w, tiling = self.w, self.tiling
        self.thread, self.block = w.register("tid.x"), w.register("ctaid.x")
        lane, self.warp = self.thread % LANES, self.thread // LANES
        # Rows and columns of the matrices that a lane points `ldmatrix` at: see `tensor_core`.
        self.row_first = (lane % 16, lane // 16 * 8)
        self.column_first = (lane // 16 * 8 + lane % 8, lane // 8 % 2 * 8)
        self.sum_row, self.sum_column = lane // 4, lane % 4 * 2
        # The share of a layer's product that this warp computes.
        self.row_group = self.warp // tiling.column_groups
        self.row = self.row_group * (TILE * tiling.row_tiles)
        pairs = self.shape.width // TILE
        self.pairs = -(-pairs // tiling.column_groups)
        # The columns of the last warp may overlap those of the one before.
        column = self.warp % tiling.column_groups * self.pairs
        self.column = w.minimum(column, pairs - self.pairs) * TILE
        # Where the lane's sums are in a layer's activations.
        self.own_bytes = (self.row + self.sum_row) * (2 * self.stride) + (
            self.column + self.sum_column
        ) * 2

    def operand(
        self,
        side: Literal["left", "right"],
        name: str,
        contracted: Literal["rows", "columns"],
        row: Value | int = 0,
        column: Value | int = 0,
    ) -> Operand:
        """Return a matrix in shared memory as an operand of a product.

        Args:
          side: on which side of the product it stands.
          name: its name.
          contracted: what the product sums over, as the matrix lies in memory: `columns` of a left
            matrix or `rows` of a right one; the other of a matrix whose transpose is multiplied.
          row: the first row in memory.
          column: the first column in memory.
        """
        w, stride, by_rows = self.w, self.stride_of(name), contracted == "rows"
        # The row of 8 numbers at which the lane points `ldmatrix`, in bytes.
        first = self.row_first if (side == "left") != by_rows else self.column_first
        place = (first[0] + row) * (2 * stride) + (first[1] + column) * 2
        pointer = w.shared(place, self.bytes_of(name))

        # A step of the sum, like a tile of the result, is 16 rows of 2 * stride bytes, or 16
        # columns of 2 bytes.
        def fragments(tile: int, step: int) -> list[Value]:
            down, right = (step, tile) if by_rows else (tile, step)
            return w.matrices(pointer, 32 * (down * stride + right), transposed=by_rows)

        return fragments

    def each(self, count: int) -> list[Value]:
        """Return the thread's share of the numbers below a count; surplus ones repeat the last."""
        threads = self.tiling.threads
        full, rest = divmod(count, threads)
        numbers = [self.thread + threads * i for i in range(full)]
        if rest:
            numbers.append(self.w.minimum(self.thread + threads * full, count - 1))
        return numbers

    def pair_places(self, rows: int, columns: int) -> Iterator[tuple[Value, Value]]:
        """Yield the thread's share of a matrix: the row and first column of pairs of numbers."""
        half = columns // 2
        for i in self.each(rows * half):
            yield i // half, i % half * 2

    def load_network(self, params: Value, outputs: Value) -> None:
        """Copy a network and the observations' statistics to shared memory.

        Args:
          params: the address of the network's parameters.
          outputs: the number of its outputs.
        """
        shape, width = self.shape, self.shape.width
        self.params = params
        # The hidden layers, eight pairs of weights of a thread at a time.
        for layer, inputs, start in shape.hidden_layers:
            pairs = self.pair_places(padded(inputs), width)
            while some := list(itertools.islice(pairs, 8)):
                self._load_weights(start, layer, some)
            for i in self.each(width):
                self.write(f"biases{layer}", i, params[i + (start + inputs * width)])
        # The last layer; its columns beyond the outputs are zero.
        for row, column in self.pair_places(width, TILE):
            pair = [
                self._within(params, row * outputs + shape.head_start, column + j, outputs)
                for j in (0, 1)
            ]
            self._store_pair("head", row, column, pair)
        head_biases = outputs * width + shape.head_start
        for i in self.each(MOST_OUTPUTS):
            self.write("head_biases", i, self._within(params, head_biases, i, outputs))
        for name in ("mean", "inverse_std"):
            for i in self.each(self.padded_inputs):
                self.write(name, i, self._within(self.arrays[name], None, i, shape.observations))

    def _load_weights(self, offset: int, layer: int, places: list[tuple[Value, Value]]) -> None:
        """Copy pairs of a hidden layer's weights, with zeros beyond its inputs."""
        w, width, inputs = self.w, self.shape.width, self.shape.inputs[layer]
        # Fetch all pairs before the first one is stored, so that the thread waits only once.
        fetched = []
        for row, column in places:
            clamped = w.minimum(row, inputs - 1)
            pair = [self.params[clamped * width + column + (offset + j)] for j in (0, 1)]
            if inputs % TILE:
                pair = [w.select(row < inputs, x, 0.0) for x in pair]
            fetched.append((row, column, pair))
        for place in fetched:
            self._store_pair(f"weights{layer}", *place)

    def _within(self, array: Value, start: Value | None, index: Value, count: Value | int) -> Value:
        """Return an element of a row that starts somewhere; zero beyond the row's end."""
        clamped = self.w.select(index < count, index, 0)
        value = array[clamped if start is None else start + clamped]
        return self.w.select(index < count, value, 0.0)

    def load_observations(self, starts: Callable[[Value], Value]) -> None:
        """Fetch a tile's observations, and normalise them into layer 0.

        Args:
          starts: a function from a row of the tile to the pointer to its observation.
        """
        w, count = self.w, self.shape.observations
        # Fetch all pairs of the thread before the first one is stored.
        fetched = []
        for row, column in self.pair_places(self.tiling.rows, self.padded_inputs):
            start = starts(row)
            pair = [start[w.minimum(column + j, count - 1)] for j in (0, 1)]
            fetched.append((row, column, pair))
        # (observation - mean) / std.
        for row, column, pair in fetched:
            mean, inverse_std = (
                [self.read(name, column, j) for j in (0, 1)] for name in ("mean", "inverse_std")
            )
            normalized = [(pair[j] - mean[j]) * inverse_std[j] for j in (0, 1)]
            self._store_pair("layer0", row, column, normalized)

    def _store_pair(self, name: str, row: Value, column: Value, pair: list[Value]) -> None:
        """Store two neighbouring numbers of a matrix of float16."""
        place = row * (2 * self.stride_of(name)) + column * 2
        self.w.shared(place, self.bytes_of(name)).store(self.w.pack(*pair))

    def synchronize_rows(self) -> None:
        """Wait for the warps that compute the same rows."""
        self.w.synchronize_group(self.row_group, LANES * self.tiling.column_groups)

    def forward(self) -> Accumulators:
        """Write the forward pass of a tile, and return the outputs.

        Each warp computes `row_tiles` x `pairs` tiles of 16 x 16 of every layer.
        """
        w, shape, tiling, steps = self.w, self.shape, self.tiling, self.padded_inputs // TILE
        for layer in range(shape.layers):
            # The activations before the layer times its weights, added to its biases.
            left = self.operand("left", self.layer(layer), "columns", self.row)
            right = self.operand("right", f"weights{layer}", "rows", 0, self.column)
            column = self.column + self.sum_column
            biases = self._biases(column, f"biases{layer}", 2 * self.pairs)
            sums = w.product(biases, steps, left, right)
            if layer and not tiling.is_gradient:
                # The activations replace those of the layer before, which the other warps of these
                # rows have read by then.
                self.synchronize_rows()
            self._activate(sums, layer + 1)
            # The next layer reads the columns of the other warps of these rows.
            self.synchronize_rows()
            steps = shape.width // TILE
        left = self.operand("left", self.layer(shape.layers), "columns", self.row)
        right = self.operand("right", "head", "rows")
        biases = self._biases(self.sum_column, "head_biases", 1)
        return w.product(biases, steps, left, right)

    def store_outputs(self, sums: Accumulators) -> None:
        """Store the outputs of the network in shared memory, a row for each sample."""
        first = (self.row + self.sum_row) * OUTPUT_STRIDE + self.sum_column
        for m, (four,) in enumerate(sums):
            for i, value in enumerate(four):
                offset = OUTPUT_STRIDE * (TILE * m + 8 * (i // 2)) + i % 2
                self.write("outputs", first, value, offset)

    def outputs_of(self, row: Value, count: int) -> list[Value]:
        """Return the outputs of the network for a row of the tile."""
        place = row * OUTPUT_STRIDE
        return [self.read("outputs", place, i) for i in range(count)]

    def deviations(self) -> list[Value]:
        """Return the standard deviations that are parameters of the policy, or any numbers."""
        end = self.shape.policy_size - len(POLICY_METRICS)
        return [self.params[i] for i in range(end - self.shape.actions, end)]

    def _biases(self, place: Value, name: str, columns: int) -> Accumulators:
        """Return the sums with which a layer's product begins: a bias for each column."""
        pairs = [[self.read(name, place, 8 * n + j) for j in (0, 1)] for n in range(columns)]
        # A lane's four sums are in two rows of the same two columns.
        return [[[*pair, *pair] for pair in pairs] for _ in range(self.tiling.row_tiles)]

    def _activate(self, sums: Accumulators, layer: int) -> None:
        """Store the activations of a layer and, where `Tiling.stores_slopes`, the slopes."""
        w = self.w
        pointer = w.shared(self.own_bytes, self.bytes_of(self.layer(layer)))
        for offset, low, high in self.halves(sums):
            pair = [activation(w, self.shape.activation, z) for z in (low, high)]
            w.moved(pointer, offset).store(w.pack(*(value for value, _ in pair)))
            if self.tiling.stores_slopes:
                slopes = w.shared(self.own_bytes, self.bytes_of(f"slopes{layer}"))
                w.moved(slopes, offset).store(w.pack(*(x for _, x in pair if x is not None)))

    def halves(self, sums: Accumulators) -> list[tuple[int, Value, Value]]:
        """Return the bytes from the lane's place, and the two neighbouring sums that are there."""
        return [
            (2 * self.stride * (TILE * m + 8 * half) + 16 * n, four[2 * half], four[2 * half + 1])
            for m, row in enumerate(sums)
            for n, four in enumerate(row)
            for half in (0, 1)
        ]


# The activation functions. Except of `swish`, the slope follows from the activation.


def activation(w: GpuWriter, name: str, z: Value) -> tuple[Value, Value | None]:
    """Return an activation, and for `swish` the derivative, otherwise None."""
    if name == "tanh":
        return w.tanh(z), None
    if name == "relu":
        return w.select(z < 0.0, w.constant(0.0), z), None
    if name == "elu":
        return w.select(z < 0.0, w.exp(z) - 1.0, z), None
    gate = w.tanh(z * 0.5) * 0.5 + 0.5
    value = z * gate
    return value, gate + value * (1.0 - gate)


def times_slope(w: GpuWriter, name: str, stored: Value, factor: Value) -> Value:
    """Return factor · activation'(z).

    Args:
      w: the writer of the kernel.
      name: the name of the activation function.
      stored: what the forward pass has stored: activation(z), or activation'(z) of `swish`.
      factor: the factor.
    """
    if name == "tanh":
        return factor * (1.0 - stored * stored)
    if name == "relu":
        return w.select(w.constant(0.0) < stored, factor, 0.0)
    if name == "elu":
        return w.select(stored < 0.0, factor * (stored + 1.0), factor)
    return factor * stored
