"""Load a network into shared memory, and write its forward pass."""

from collections.abc import Callable

from jetbot_mjx.agents.fused.gpu_tiling import MOST_OUTPUTS, OUTPUT_BYTES, PAD, Tiling, padded
from jetbot_mjx.agents.fused.shapes import POLICY_METRICS, LossTerms, Minibatch
from jetbot_mjx.agents.fused.tensor_core import (
    LANES,
    TILE,
    GpuWriter,
    Sums,
    Value,
)
from onekernel.build import Repeat


class NetworkKernel:
    """A `NetworkKernel` writes what the kernels share: a loop over tiles, and a forward pass."""

    def __init__(
        self, name: str, arrays: int, tiling: Tiling, batch: Minibatch, tiles: int
    ) -> None:
        """Prepare to write.

        Args:
          name: the name of the kernel.
          arrays: the number of its arrays.
          tiling: the division of the work.
          batch: the minibatch.
          tiles: the number of tiles of the minibatch.
        """
        self.tiling, self.shape, self.batch, self.tiles = tiling, tiling.shape, batch, tiles
        self.stride = self.shape.width + PAD
        self.first = padded(self.shape.observations)
        self.ir = GpuWriter(name, arrays)

    def write(self) -> str:
        """Return the kernel as a module of LLVM IR."""
        raise NotImplementedError

    def bytes_of(self, name: str) -> int:
        """Return the byte of shared memory where an array begins."""
        return self.tiling.layout[name]

    def source(self, layer: int) -> tuple[str, int]:
        """Return the name and the row stride of a layer's activations; 0: the observations."""
        if layer == 0:
            return "layer0", self.first + PAD
        return f"layer{layer if self.tiling.is_gradient else 1}", self.stride

    def argument(self, index: int, seed: Value, size: int) -> Value:
        """Return the array of a seed."""
        return self.ir.row(self.ir.parameters[index], seed, size)

    def minibatch(self, array: Value) -> Value:
        """Return which minibatch to compute."""
        return array.load("u32")

    def load_terms(self, array: Value) -> LossTerms:
        """Return the coefficients of the loss."""
        count = len(LossTerms._fields)
        return LossTerms(*(array[i] for i in range(count)))

    def share(self, total: int, groups: int, group: Value) -> Value:
        """Return the first of a group's tiles; the last group's may overlap the one before."""
        per = -(-total // groups)
        return self.ir.minimum(group * per, total - per)

    def prepare(self) -> None:
        """Read the thread's place in the grid, and derive its places in the matrices."""
        ir, tiling = self.ir, self.tiling
        self.thread = ir.register("tid.x")
        self.block, self.blocks = ir.register("ctaid.x"), ir.register("nctaid.x")
        lane, self.warp = self.thread % LANES, self.thread // LANES
        # Rows and columns of the matrices that a lane points `ldmatrix` at: see `tensor_core`.
        self.row_first = (lane % 16, lane // 16 * 8)
        self.column_first = (lane // 16 * 8 + lane % 8, lane // 8 % 2 * 8)
        self.sum_row, self.sum_column = lane // 4, lane % 4 * 2
        # The part of a layer's product that this warp computes.
        self.row_group = self.warp // tiling.column_groups
        self.row = self.row_group * (TILE * tiling.row_tiles)
        pairs = self.shape.width // TILE
        self.pairs = -(-pairs // tiling.column_groups)
        column_group = self.warp % tiling.column_groups
        self.column = self.share(pairs, tiling.column_groups, column_group) * TILE
        # Where the lane's sums are in a layer's activations.
        self.place = (self.row + self.sum_row) * (2 * self.stride) + (
            self.column + self.sum_column
        ) * 2

    def lanes(
        self,
        name: str,
        stride: int,
        pattern: tuple[Value, Value],
        row: Value | int = 0,
        column: Value | int = 0,
    ) -> Value:
        """Return the lane's pointer into a matrix of float16, from a row and a column on."""
        place = (pattern[0] + row) * (2 * stride) + (pattern[1] + column) * 2
        return self.ir.shared(place, self.bytes_of(name))

    def each(self, count: int) -> list[Value]:
        """Return the thread's share of the numbers below a count; surplus ones repeat the last."""
        threads = self.tiling.threads
        full, rest = divmod(count, threads)
        numbers = [self.thread + threads * i for i in range(full)]
        if rest:
            numbers.append(self.ir.minimum(self.thread + threads * full, count - 1))
        return numbers

    def load_network(self, params: Value, outputs: Value, mean: Value, scale: Value) -> None:
        """Copy a network and the observations' statistics to shared memory."""
        ir, shape, width = self.ir, self.shape, self.shape.width
        offset = 0
        for layer, inputs in enumerate(shape.inputs[:-1]):
            places = self.each(padded(inputs) * width // 2)
            for start in range(0, len(places), 8):
                self._load_weights(params, offset, layer, places[start : start + 8])
            offset += inputs * width
            for i in self.each(width):
                bias = params[i + offset]
                ir.shared(i * 4, self.bytes_of(f"biases{layer}")).store(bias)
            offset += width
        # The columns beyond the outputs are zero.
        for i in self.each(width * TILE // 2):
            row, column = i // (TILE // 2), i % (TILE // 2) * 2
            pair = [
                self._within(params, row * outputs + offset, column + j, outputs) for j in (0, 1)
            ]
            place = row * (2 * (TILE + PAD)) + column * 2
            packed = ir.pack(*pair)
            ir.shared(place, self.bytes_of("head")).store(packed)
        head_biases = outputs * width + offset
        for i in self.each(MOST_OUTPUTS):
            bias = self._within(params, head_biases, i, outputs)
            ir.shared(i * 4, self.bytes_of("head_biases")).store(bias)
        for name, array in (("mean", mean), ("scale", scale)):
            for i in self.each(self.first):
                value = self._within(array, None, i, shape.observations)
                ir.shared(i * 4, self.bytes_of(name)).store(value)

    def _load_weights(self, params: Value, offset: int, layer: int, places: list[Value]) -> None:
        ir, width, inputs = self.ir, self.shape.width, self.shape.inputs[layer]
        pairs = []
        for i in places:
            row, column = i // (width // 2), i % (width // 2) * 2
            kept = ir.minimum(row, inputs - 1)
            pair = [params[kept * width + column + (offset + j)] for j in (0, 1)]
            if inputs % TILE:
                pair = [ir.select(row < inputs, x, 0.0) for x in pair]
            pairs.append((row * (2 * self.stride) + column * 2, pair))
        for place, pair in pairs:
            packed = ir.pack(*pair)
            ir.shared(place, self.bytes_of(f"weights{layer}")).store(packed)

    def _within(self, array: Value, start: Value | None, index: Value, count: Value | int) -> Value:
        """Return an element of a row that starts somewhere; zero beyond the row's end."""
        kept = self.ir.select(index < count, index, 0)
        value = array[kept if start is None else start + kept]
        return self.ir.select(index < count, value, 0.0)

    def load_observations(self, starts: Callable[[Value], Value]) -> Callable[[], None]:
        """Fetch a tile's observations, and return a function that normalises them into layer 0.

        Args:
          starts: a function from a row of the tile to the pointer to its observation.
        """
        ir, count = self.ir, self.shape.observations
        fetched = []
        for i in self.each(self.tiling.rows * self.first // 2):
            row, column = i // (self.first // 2), i % (self.first // 2) * 2
            start = starts(row)
            pair = [start[ir.minimum(column + j, count - 1)] for j in (0, 1)]
            fetched.append((row, column, pair))

        def store() -> None:
            for row, column, pair in fetched:
                mean, scale = (
                    [ir.shared(column * 4, self.bytes_of(name) + 4 * j).load() for j in (0, 1)]
                    for name in ("mean", "scale")
                )
                normalized = [(pair[j] - mean[j]) * scale[j] for j in (0, 1)]
                place = row * (2 * (self.first + PAD)) + column * 2
                packed = ir.pack(*normalized)
                ir.shared(place, self.bytes_of("layer0")).store(packed)

        return store

    def synchronize_rows(self) -> None:
        """Wait for the warps that compute the same rows."""
        self.ir.synchronize_group(self.row_group, LANES * self.tiling.column_groups)

    def forward(self) -> Sums:
        """Write the forward pass of a tile, and return the outputs' sums."""
        ir, tiling, steps = self.ir, self.tiling, self.first // TILE
        for layer in range(self.shape.layers):
            name, stride = self.source(layer)
            left = self.lanes(name, stride, self.row_first, self.row)
            right = self.lanes(f"weights{layer}", self.stride, self.row_first, 0, self.column)
            biases = ir.shared((self.column + self.sum_column) * 4, self.bytes_of(f"biases{layer}"))
            sums = ir.product(
                self._biases(biases, tiling.row_tiles, 2 * self.pairs),
                steps,
                lambda row, k, at=left, by=stride: ir.matrices(
                    at, 32 * row * by + 32 * k, transposed=False
                ),
                lambda pair, k, at=right: ir.matrices(
                    at, 32 * k * self.stride + 32 * pair, transposed=True
                ),
            )
            if layer and not self.tiling.is_gradient:
                # The activations replace those of the layer before.
                self.synchronize_rows()
            self._activate(sums, layer + 1)
            self.synchronize_rows()
            steps = self.shape.width // TILE
        name, stride = self.source(self.shape.layers)
        left = self.lanes(name, stride, self.row_first, self.row)
        right = self.lanes("head", TILE + PAD, self.row_first)
        biases = ir.shared(self.sum_column * 4, self.bytes_of("head_biases"))
        return ir.product(
            self._biases(biases, tiling.row_tiles, 1),
            steps,
            lambda row, k: ir.matrices(left, 32 * row * self.stride + 32 * k, transposed=False),
            lambda _, k: ir.matrices(right, 32 * k * (TILE + PAD), transposed=True),
        )

    def store_outputs(self, sums: Sums) -> None:
        """Store the outputs of the network in shared memory, a row for each sample."""
        ir, stride = self.ir, OUTPUT_BYTES
        pointer = ir.shared(
            (self.row + self.sum_row) * stride + self.sum_column * 4, self.bytes_of("outputs")
        )
        for m, (four,) in enumerate(sums):
            for i, value in enumerate(four):
                ir.moved(pointer, stride * (TILE * m + 8 * (i // 2)) + 4 * (i % 2)).store(value)

    def outputs_of(self, row: Value, count: int) -> list[Value]:
        """Return the outputs of the network for a row of the tile."""
        place = self.ir.shared(row * OUTPUT_BYTES, self.bytes_of("outputs"))
        return [self.ir.moved(place, 4 * i).load() for i in range(count)]

    def deviations(self, params: Value) -> list[Value]:
        """Return the standard deviations that are parameters of the policy, or any numbers."""
        count = self.shape.actions
        if not self.shape.deviations:
            return [self.ir.constant(0.0)] * count
        place = self.shape.policy_size - len(POLICY_METRICS) - count
        return [params[place + i] for i in range(count)]

    def _biases(self, pointer: Value, row_tiles: int, columns: int) -> Sums:
        ir = self.ir
        pairs = [[ir.moved(pointer, 32 * n + 4 * j).load() for j in (0, 1)] for n in range(columns)]
        return [[[*pair, *pair] for pair in pairs] for _ in range(row_tiles)]

    def _activate(self, sums: Sums, layer: int) -> None:
        """Store the activations of a layer and, if they do not tell it, the slopes."""
        ir = self.ir
        pointer = ir.shared(self.place, self.bytes_of(self.source(layer)[0]))
        for offset, low, high in self.halves(sums):
            pair = [_activated(ir, self.shape.activation, z) for z in (low, high)]
            values = ir.pack(pair[0][0], pair[1][0])
            ir.moved(pointer, offset).store(values)
            if self.shape.activation == "swish" and self.tiling.is_gradient:
                slopes = ir.shared(self.place, self.bytes_of(f"slopes{layer}"))
                derivatives = ir.pack(pair[0][1], pair[1][1])
                ir.moved(slopes, offset).store(derivatives)

    def halves(self, sums: Sums) -> list[tuple[int, Value, Value]]:
        """Return the bytes from the lane's place, and the two neighbouring sums that are there."""
        return [
            (2 * self.stride * (TILE * m + 8 * half) + 16 * n, four[2 * half], four[2 * half + 1])
            for m, row in enumerate(sums)
            for n, four in enumerate(row)
            for half in (0, 1)
        ]

    def module(self) -> str:
        """Return the module of the kernel."""
        return self.ir.module(self.tiling.threads)

    def next_tile(self, loop: Repeat, tile: Value, *carried: Value) -> None:
        """End an iteration of the loop over a block's tiles, which carries some values."""
        following = tile + self.blocks
        loop.again(following < self.tiles, following, *carried)


def _activated(ir: GpuWriter, name: str, z: Value) -> tuple[Value, Value]:
    """Return an activation, and for `swish` its slope."""
    if name == "tanh":
        return ir.tanh(z), z
    if name == "relu":
        return ir.select(z < 0.0, ir.constant(0.0), z), z
    if name == "elu":
        return ir.select(z < 0.0, ir.exp(z) - 1.0, z), z
    gate = ir.tanh(z * 0.5) * 0.5 + 0.5
    value = z * gate
    return value, gate + value * (1.0 - gate)
