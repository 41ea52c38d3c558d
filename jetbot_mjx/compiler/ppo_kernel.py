"""Write the kernels of PPO's update for NVIDIA's tensor cores; docs/update.md explains them.

`gradient_text` writes the gradient of both networks by the loss of `jetbot_mjx.agents.ppo`, and
`values_text` writes the values of the value network, as LLVM IR. A block has 256 threads, serves
one network (`ctaid.y`: 0 the policy, 1 the values) of one seed (`ctaid.z`), and loops over tiles of
samples. Weights and activations are in shared memory as bfloat16, all sums are float32, and the
sums of the gradient stay in registers until the last tile.

Parameters are one vector for both networks: of each layer the weights, of shape (inputs, outputs),
and the biases; then the policy's standard deviations, if the distribution is `normal`; then room
for the sums of the metrics, which the gradient's vector has at these places.
"""

import dataclasses
import functools
import math
from typing import NamedTuple

from jetbot_mjx.compiler.tensor_core import DECLARATIONS, LANES, TILE, IrWriter, Sums, Value

THREADS = 256
"""Threads of a block."""

NAME = "update"
"""Name of the kernels."""

POLICY_METRICS = ("policy_loss", "entropy", "kl", "std")
VALUE_METRICS = ("value_loss",)
"""Sums over the samples, in the order of the vector."""

MOST_OUTPUTS = 8
MOST_SUMS = 176
"""Sums of the gradient that the registers of a thread hold beside those of a layer."""

MOST_OBSERVATIONS = 64
MOST_WIDTH = 128

_WARPS = THREADS // LANES
_HEAD = MOST_OUTPUTS
"""Columns of the last layer that are computed."""
_PAD = 8
"""Numbers between the rows of a matrix in shared memory, so that eight rows meet all banks."""
_MIN_STD = 0.001
_HALF_LOG_TWO_PI = 0.5 * math.log(2 * math.pi)


class UpdateShape(NamedTuple):
    """An `UpdateShape` describes both networks, which have the same hidden layers."""

    observations: int
    width: int
    layers: int
    """Number of hidden layers."""
    actions: int
    distribution: str
    activation: str

    @property
    def outputs(self) -> tuple[int, int]:
        """Return the outputs of the policy network and of the value network."""
        return (self.actions if self.distribution == "normal" else 2 * self.actions), 1

    @property
    def inputs(self) -> tuple[int, ...]:
        """Return the number of inputs of each layer."""
        return (self.observations, *[self.width] * self.layers)

    @property
    def hidden(self) -> int:
        """Return the number of parameters of the hidden layers of one network."""
        return sum(self.width * (inputs + 1) for inputs in self.inputs[:-1])

    @property
    def deviations(self) -> int:
        """Return the number of standard deviations that are parameters."""
        return self.actions if self.distribution == "normal" else 0

    @property
    def policy_size(self) -> int:
        """Return the length of the policy's part of the vector."""
        head = (self.width + 1) * self.outputs[0] + self.deviations
        return self.hidden + head + len(POLICY_METRICS)

    @property
    def sums(self) -> int:
        """Return how many sums of the gradient of the weights a thread holds."""
        tiles = self.width // TILE
        shares = [_Shares.of(tiles, _padded(n) // TILE) for n in self.inputs[:-1]]
        return sum(8 * share.row_tiles * share.pairs for share in shares)

    @property
    def size(self) -> int:
        """Return the length of the vector."""
        return self.policy_size + self.hidden + self.width + 1 + len(VALUE_METRICS)


class LossTerms(NamedTuple):
    """A `LossTerms` holds the constants of the loss."""

    clipping_epsilon: float
    entropy_cost: float
    value_coefficient: float


@dataclasses.dataclass(frozen=True)
class Tiling:
    """A `Tiling` divides the work of a block among its warps."""

    shape: UpdateShape
    rows: int
    """Samples of a tile."""
    row_tiles: int = 1
    """Row tiles of a warp in a layer's product."""

    @property
    def row_groups(self) -> int:
        """Return how many groups of warps share a tile's rows."""
        return self.rows // (TILE * self.row_tiles)

    @property
    def column_groups(self) -> int:
        """Return how many warps share a group's columns."""
        return _WARPS // self.row_groups

    @functools.cached_property
    def layout(self) -> dict[str, int]:
        """Return the byte of shared memory where each array begins, and their `size`."""
        shape, rows = self.shape, self.rows
        stride = shape.width + _PAD
        first = _padded(shape.observations)
        sizes = {f"weights{i}": 2 * _padded(n) * stride for i, n in enumerate(shape.inputs[:-1])}
        sizes["head"] = 2 * shape.width * (TILE + _PAD)
        sizes |= {f"biases{i}": 4 * shape.width for i in range(shape.layers)}
        sizes |= {"head_biases": 4 * _HEAD, "mean": 4 * first, "scale": 4 * first}
        sizes["layer0"] = 2 * rows * (first + _PAD)
        sizes |= {f"layer{i + 1}": 2 * rows * stride for i in range(shape.layers)}
        if shape.activation == "swish":
            sizes |= {f"slopes{i + 1}": 2 * rows * stride for i in range(shape.layers)}
        sizes["outputs"] = 4 * rows * (_HEAD + 1)
        sizes["errors"] = 2 * rows * (TILE + _PAD)
        slots = shape.outputs[0] + shape.deviations + len(POLICY_METRICS)
        sizes["slots"] = 4 * slots * (rows + 1)
        places, end = {}, 0
        for name, size in sizes.items():
            places[name] = end
            end += -(-size // 16) * 16
        return {**places, "size": end}


def choose_tiling(shape: UpdateShape, shared_memory: int) -> Tiling | None:
    """Return the tiling with the largest tile that fits.

    Args:
      shape: the networks.
      shared_memory: bytes of shared memory that a block may have.

    Returns:
      The tiling; None: not even the smallest tile fits.
    """
    tilings = [Tiling(shape, 128, 2), Tiling(shape, 64), Tiling(shape, 32)]
    return next((x for x in tilings if x.layout["size"] <= shared_memory), None)


def _padded(number: int) -> int:
    return -(-number // TILE) * TILE


class _Shares(NamedTuple):
    """A `_Shares` says which tiles of a gradient's matrix a warp sums up.

    Where the tiles cannot be divided evenly, several warps compute and store the same ones.
    """

    row_tiles: int
    """Tiles of 16 rows of a warp."""
    pairs: int
    """Pairs of column tiles, 16 columns, of a warp."""
    groups: int
    """Groups of rows."""

    @classmethod
    def of(cls, rows: int, pairs: int) -> "_Shares":
        """Return the shares with the fewest sums and, of these, with the fewest loads."""
        options = []
        for row_tiles in range(1, rows + 1):
            groups = -(-rows // row_tiles)
            if groups <= _WARPS:
                options.append(cls(row_tiles, -(-pairs // (_WARPS // groups)), groups))
        return min(options, key=lambda x: (x.row_tiles * x.pairs, x.row_tiles + x.pairs))


class _Kernel:
    """A `_Kernel` writes what both kernels share: loading a network, and its forward pass."""

    def __init__(self, tiling: Tiling, samples: int) -> None:
        self.tiling, self.shape, self.samples = tiling, tiling.shape, samples
        self.stride = self.shape.width + _PAD
        self.first = _padded(self.shape.observations)
        self.ir = IrWriter()

    def bytes_of(self, name: str) -> int:
        return self.tiling.layout[name]

    def source(self, layer: int) -> tuple[str, int]:
        """Return the name and the row stride of a layer's activations; 0: the observations."""
        return f"layer{layer}", self.first + _PAD if layer == 0 else self.stride

    def argument(self, index: int, seed: Value, size: int) -> Value:
        """Return the array of a seed."""
        return self.ir.row(Value(self.ir, f"%a{index}", "ptr addrspace(1)"), seed, size)

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
        """Return the lane's pointer into a matrix of bfloat16, from a row and a column on."""
        place = (pattern[0] + row) * (2 * stride) + (pattern[1] + column) * 2
        return self.ir.shared(place, self.bytes_of(name))

    def each(self, count: int, threads: int = THREADS) -> list[Value]:
        """Return the thread's share of the numbers below a count; surplus ones repeat the last."""
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
            places = self.each(_padded(inputs) * width // 2)
            for start in range(0, len(places), 8):
                self._load_weights(params, offset, layer, places[start : start + 8])
            offset += inputs * width
            for i in self.each(width):
                bias = ir.fetch(params, i + offset)
                ir.write(bias, ir.shared(i * 4, self.bytes_of(f"biases{layer}")))
            offset += width
        # The columns beyond the outputs are zero.
        for i in self.each(width * TILE // 2):
            row, column = i // (TILE // 2), i % (TILE // 2) * 2
            pair = [
                self._within(params, row * outputs + offset, column + j, outputs) for j in (0, 1)
            ]
            place = row * (2 * (TILE + _PAD)) + column * 2
            ir.write(ir.pack(*pair), ir.shared(place, self.bytes_of("head")))
        head_biases = outputs * width + offset
        for i in self.each(_HEAD):
            bias = self._within(params, head_biases, i, outputs)
            ir.write(bias, ir.shared(i * 4, self.bytes_of("head_biases")))
        for name, array in (("mean", mean), ("scale", scale)):
            for i in self.each(self.first):
                value = self._within(array, None, i, ir.constant(shape.observations, "i32"))
                ir.write(value, ir.shared(i * 4, self.bytes_of(name)))

    def _load_weights(self, params: Value, offset: int, layer: int, places: list[Value]) -> None:
        ir, width, inputs = self.ir, self.shape.width, self.shape.inputs[layer]
        pairs = []
        for i in places:
            row, column = i // (width // 2), i % (width // 2) * 2
            kept = ir.minimum(row, inputs - 1)
            pair = [ir.fetch(params, kept * width + column + (offset + j)) for j in (0, 1)]
            if inputs % TILE:
                pair = [ir.select(row < inputs, x, 0.0) for x in pair]
            pairs.append((row * (2 * self.stride) + column * 2, pair))
        for place, pair in pairs:
            ir.write(ir.pack(*pair), ir.shared(place, self.bytes_of(f"weights{layer}")))

    def _within(self, array: Value, start: Value | None, index: Value, count: Value) -> Value:
        """Return an element of a row that starts somewhere; zero beyond the row's end."""
        kept = self.ir.select(index < count, index, self.ir.constant(0, "i32"))
        value = self.ir.fetch(array, kept if start is None else start + kept)
        return self.ir.select(index < count, value, 0.0)

    def load_observations(self, arrays: list[Value], lengths: list[int], tile: Value) -> None:
        """Normalise a tile's observations into layer 0; further arrays follow the first one's."""
        ir, count = self.ir, self.shape.observations
        pairs = []
        for i in self.each(self.tiling.rows * self.first // 2):
            row, column = i // (self.first // 2), i % (self.first // 2) * 2
            sample = self.sample(tile, row)
            array = arrays[0]
            for other, length in zip(arrays[1:], lengths, strict=False):
                array = ir.select(sample < length, array, other)
                sample = ir.select(sample < length, sample, sample - length)
            start = sample * count
            numbers = [ir.fetch(array, start + ir.minimum(column + j, count - 1)) for j in (0, 1)]
            pairs.append((row, column, numbers))
        for row, column, numbers in pairs:
            normalized = []
            for j, number in enumerate(numbers):
                mean, scale = (
                    ir.read(ir.shared(column * 4, self.bytes_of(name) + 4 * j))
                    for name in ("mean", "scale")
                )
                normalized.append((number - mean) * scale)
            place = row * (2 * (self.first + _PAD)) + column * 2
            ir.write(ir.pack(*normalized), ir.shared(place, self.bytes_of("layer0")))

    def sample(self, tile: Value, row: Value) -> Value:
        """Return the sample in a row of a tile; rows beyond the last repeat it."""
        return self.ir.minimum(tile * self.tiling.rows + row, self.samples - 1)

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
            self._activate(sums, layer + 1)
            self.synchronize_rows()
            steps = self.shape.width // TILE
        left = self.lanes(f"layer{self.shape.layers}", self.stride, self.row_first, self.row)
        right = self.lanes("head", TILE + _PAD, self.row_first)
        biases = ir.shared(self.sum_column * 4, self.bytes_of("head_biases"))
        return ir.product(
            self._biases(biases, tiling.row_tiles, 1),
            steps,
            lambda row, k: ir.matrices(left, 32 * row * self.stride + 32 * k, transposed=False),
            lambda _, k: ir.matrices(right, 32 * k * (TILE + _PAD), transposed=True),
        )

    def _biases(self, pointer: Value, row_tiles: int, columns: int) -> Sums:
        ir = self.ir
        pairs = [
            [ir.read(ir.moved(pointer, 32 * n + 4 * j)) for j in (0, 1)] for n in range(columns)
        ]
        return [[[*pair, *pair] for pair in pairs] for _ in range(row_tiles)]

    def _activate(self, sums: Sums, layer: int) -> None:
        """Store the activations of a layer and, if they do not tell it, the slopes."""
        ir = self.ir
        pointer = ir.shared(self.place, self.bytes_of(f"layer{layer}"))
        for offset, low, high in self.halves(sums):
            pair = [_activated(ir, self.shape.activation, z) for z in (low, high)]
            ir.write(ir.pack(pair[0][0], pair[1][0]), ir.moved(pointer, offset))
            if self.shape.activation == "swish":
                slopes = ir.shared(self.place, self.bytes_of(f"slopes{layer}"))
                ir.write(ir.pack(pair[0][1], pair[1][1]), ir.moved(slopes, offset))

    def halves(self, sums: Sums) -> list[tuple[int, Value, Value]]:
        """Return the bytes from the lane's place, and the two neighbouring sums that are there."""
        return [
            (2 * self.stride * (TILE * m + 8 * half) + 16 * n, *four[2 * half :][:2])
            for m, row in enumerate(sums)
            for n, four in enumerate(row)
            for half in (0, 1)
        ]

    def text(self, arguments: int, carries: list[str]) -> str:
        """Return the module."""
        parameters = ", ".join(f"ptr addrspace(1) %a{i}" for i in range(arguments))
        body = "\n  ".join(self.ir.lines)
        carried = "\n  ".join(carries)
        return (
            f"{DECLARATIONS}define ptx_kernel void @{NAME}({parameters}) {{\nentry:\n  "
            + body.replace("CARRIES", carried)
            + "\n  ret void\n}\nattributes #0 = { convergent nounwind }\n"
            f'!nvvm.annotations = !{{!0}}\n!0 = !{{ptr @{NAME}, !"maxntidx", i32 {THREADS}}}\n'
        )

    def begin_tiles(self) -> Value:
        """Begin the loop over the tiles of a block, and return the tile."""
        self.ir.do("br label %tiles")
        self.before = self.ir.label
        self.ir.begin("tiles")
        self.ir.do("CARRIES")
        return Value(self.ir, "%tile", "i32")

    def end_tiles(self, tile: Value) -> list[str]:
        """End the loop over the tiles, and return its first carry."""
        ir = self.ir
        following = tile + self.blocks
        more = following < -(-self.samples // self.tiling.rows)
        carry = (
            f"%tile = phi i32 [{self.block.text}, %{self.before}], [{following.text}, %{ir.label}]"
        )
        self.last = ir.label
        ir.do(f"br i1 {more.text}, label %tiles, label %after")
        ir.begin("after")
        return [carry]


def _activated(ir: IrWriter, name: str, z: Value) -> tuple[Value, Value]:
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


class _ValuesKernel(_Kernel):
    """Arguments: parameters, mean, 1 / std, observations, last observations; result: the values of
    all samples, first of the former and then of the latter."""

    def __init__(self, tiling: Tiling, samples: int, last: int) -> None:
        super().__init__(tiling, samples + last)
        self.lengths = [samples, last]

    def write(self) -> str:
        ir, shape = self.ir, self.shape
        self.prepare()
        seed = ir.register("ctaid.z")
        sizes = (shape.size, shape.observations, shape.observations)
        params, mean, scale = (self.argument(i, seed, size) for i, size in enumerate(sizes))
        observations = [
            self.argument(3 + i, seed, length * shape.observations)
            for i, length in enumerate(self.lengths)
        ]
        values = self.argument(5, seed, self.samples)
        params = ir.element(params, ir.constant(shape.policy_size, "i32"))
        self.load_network(params, ir.constant(1, "i32"), mean, scale)
        ir.synchronize()
        tile = self.begin_tiles()
        self.load_observations(observations, self.lengths, tile)
        ir.synchronize()
        sums = self.forward()
        first = tile * self.tiling.rows + self.row + self.sum_row
        for m, (four,) in enumerate(sums):
            for half in (0, 1):
                sample = first + (TILE * m + 8 * half)
                # A lane beside the first column or beyond the last sample stores nothing.
                sample = ir.select(
                    self.sum_column.equals(0), sample, ir.constant(self.samples, "i32")
                )
                with ir.when(sample < self.samples):
                    ir.put(four[2 * half], values, sample)
        ir.synchronize()
        carries = self.end_tiles(tile)
        return self.text(6, carries)


class _GradientKernel(_Kernel):
    """Arguments: parameters, mean, 1 / std, observations, raw actions, their log-probabilities,
    distribution parameters of the collection, noise, advantages, value targets; result: the
    gradient's parts and the sums of the metrics, a vector for each block."""

    def __init__(self, tiling: Tiling, samples: int, terms: LossTerms) -> None:
        super().__init__(tiling, samples)
        self.terms = terms
        width, tiles = self.shape.width, self.shape.width // TILE
        self.shares = [_Shares.of(tiles, _padded(n) // TILE) for n in self.shape.inputs[:-1]]
        self.carries: list[tuple[str, Value]] = []
        self.width = width

    def write(self) -> str:
        ir, shape = self.ir, self.shape
        self.prepare()
        self.network, seed = ir.register("ctaid.y"), ir.register("ctaid.z")
        self.is_policy = self.network.equals(0)
        sizes = [shape.size, shape.observations, shape.observations]
        sizes += [self.samples * n for n in (shape.observations, shape.actions, 1)]
        sizes += [self.samples * n for n in (2 * shape.actions, shape.actions, 1, 1)]
        self.arrays = [self.argument(i, seed, size) for i, size in enumerate(sizes)]
        part = seed * self.blocks + self.block
        start = self.network * shape.policy_size
        parts = ir.row(Value(ir, "%a10", "ptr addrspace(1)"), part, shape.size)
        self.part = ir.element(parts, start)
        params = self.params = ir.element(self.arrays[0], start)
        self.outputs = ir.select(
            self.is_policy, ir.constant(shape.outputs[0], "i32"), ir.constant(1, "i32")
        )
        self.load_network(params, self.outputs, self.arrays[1], self.arrays[2])
        self._clear()
        ir.synchronize()
        tile = self.begin_tiles()
        self._begin_sums()
        self.load_observations([self.arrays[3]], [self.samples], tile)
        ir.synchronize()
        self._store_outputs(self.forward())
        ir.synchronize()
        with ir.when(self.thread < self.tiling.rows):
            self._loss(tile)
        ir.synchronize()
        self._backward()
        ir.synchronize()
        carries = self.end_tiles(tile)
        carries += self._end_sums()
        self._store_gradient()
        return self.text(11, carries)

    def _clear(self) -> None:
        ir = self.ir
        zero = ir.constant(0, "i32")
        for name, following in (("errors", "slots"), ("slots", "size")):
            for i in self.each((self.bytes_of(following) - self.bytes_of(name)) // 4):
                ir.write(zero, ir.shared(i * 4, self.bytes_of(name)))

    # The sums of the gradient are carried from tile to tile.

    def _begin_sums(self) -> None:
        def zeros(rows: int, columns: int, name: str) -> Sums:
            return [
                [
                    [Value(self.ir, f"%{name}.{m}.{n}.{i}", "float") for i in range(4)]
                    for n in range(columns)
                ]
                for m in range(rows)
            ]

        self.weight_sums = [
            zeros(share.row_tiles, 2 * share.pairs, f"w{i}") for i, share in enumerate(self.shares)
        ]
        self.bias_sums = [zeros(1, 1, f"b{i}") for i in range(self.shape.layers)]
        self.head_sums = zeros(1, 1, "h")
        self.begun = self._all_sums()

    def _all_sums(self) -> list[Value]:
        groups = [*self.weight_sums, *self.bias_sums, self.head_sums]
        return [x for group in groups for row in group for four in row for x in four]

    def _end_sums(self) -> list[str]:
        return [
            f"{name.text} = phi float [0.0, %{self.before}], [{end.text}, %{self.last}]"
            for name, end in zip(self.begun, self._all_sums(), strict=True)
        ]

    def _store_outputs(self, sums: Sums) -> None:
        """Store the outputs of the network in shared memory, a row for each sample."""
        ir, stride = self.ir, 4 * (_HEAD + 1)
        pointer = ir.shared(
            (self.row + self.sum_row) * stride + self.sum_column * 4, self.bytes_of("outputs")
        )
        for m, (four,) in enumerate(sums):
            for i, value in enumerate(four):
                ir.write(value, ir.moved(pointer, stride * (TILE * m + 8 * (i // 2)) + 4 * (i % 2)))

    def _loss(self, tile: Value) -> None:
        """Write the derivative of the loss by the outputs of one sample, a thread for each."""
        ir = self.ir
        index = tile * self.tiling.rows + self.thread
        self.is_there = index < self.samples
        self.index = ir.minimum(index, self.samples - 1)
        self.own = ir.shared(self.thread * (4 * (_HEAD + 1)), self.bytes_of("outputs"))
        with ir.when(self.is_policy):
            self._policy_loss()
        with ir.when(self.network.equals(1)):
            value = ir.read(self.own)
            error = value - ir.fetch(self.arrays[9], self.index)
            slope = error * (self.terms.value_coefficient / self.samples)
            self._store_errors([slope], [error * error])

    def _policy_loss(self) -> None:
        ir, shape, terms = self.ir, self.shape, self.terms
        actions = range(shape.actions)
        tanh = shape.distribution == "tanh_normal"
        if tanh:
            raw = [ir.read(ir.moved(self.own, 4 * (shape.actions + i))) for i in actions]
            scale = [ir.softplus(x) + _MIN_STD for x in raw]
        else:
            raw = []
            place = ir.constant(shape.policy_size - len(POLICY_METRICS) - shape.actions, "i32")
            scale = [ir.fetch(self.params, place + i) for i in actions]
        mean = [ir.read(ir.moved(self.own, 4 * i)) for i in actions]
        inverse = [ir.reciprocal(x) for x in scale]
        log_scale = [ir.log(x) for x in scale]
        row = self.index * shape.actions
        action = [ir.fetch(self.arrays[4], row + i) for i in actions]
        noise = [ir.fetch(self.arrays[7], row + i) for i in actions]
        distance = [(action[i] - mean[i]) * inverse[i] for i in actions]
        # The clipped surrogate objective.
        log_ratio = ir.fetch(self.arrays[5], self.index) * -1.0
        for i in actions:
            log_ratio += distance[i] * distance[i] * -0.5 - log_scale[i] - _HALF_LOG_TWO_PI
            if tanh:
                log_ratio -= _log_slope(ir, action[i])
        ratio, advantage = ir.exp(log_ratio), ir.fetch(self.arrays[8], self.index)
        low, high = ir.constant(1 - terms.clipping_epsilon), 1 + terms.clipping_epsilon
        clipped = ir.select(ratio < low, low, ir.minimum(ratio, high)) * advantage
        surrogate = ratio * advantage
        by_log = ir.select(surrogate <= clipped, surrogate * (-1 / self.samples), ir.constant(0.0))
        # The entropy, of a sample of the current policy.
        weight = -terms.entropy_cost / self.samples
        entropy = ir.constant(0.0)
        by_mean, by_scale = [], []
        for i in actions:
            entropy += log_scale[i] + (0.5 + _HALF_LOG_TWO_PI)
            pull, push = by_log * distance[i] * inverse[i], inverse[i] * weight
            if tanh:
                sample = noise[i] * scale[i] + mean[i]
                entropy += _log_slope(ir, sample)
                slope = (ir.sigmoid(sample * -2.0) * 4.0 - 2.0) * weight
                pull, push = pull + slope, push + slope * noise[i]
            by_mean.append(pull)
            by_scale.append(by_log * (distance[i] * distance[i] - 1.0) * inverse[i] + push)
        if tanh:
            by_scale = [x * ir.sigmoid(z) for x, z in zip(by_scale, raw, strict=True)]
        divergence = self._divergence(mean, scale, inverse, tanh=tanh)
        spread = sum(scale[1:], scale[0])
        metrics = [ir.minimum(surrogate, clipped) * -1.0, entropy, divergence, spread]
        if tanh:
            self._store_errors([*by_mean, *by_scale], metrics)
        else:
            self._store_errors(by_mean, [*by_scale, *metrics])

    def _divergence(
        self, mean: list[Value], scale: list[Value], inverse: list[Value], *, tanh: bool
    ) -> Value:
        """Return the KL divergence of the current distribution from that of the collection."""
        ir, count = self.ir, self.shape.actions
        row, total = self.index * (2 * count), ir.constant(0.0)
        for i in range(count):
            old_mean = ir.fetch(self.arrays[6], row + i)
            old_scale = ir.fetch(self.arrays[6], row + (count + i))
            if tanh:
                old_scale = ir.softplus(old_scale) + _MIN_STD
            difference = old_mean - mean[i]
            square = (old_scale * old_scale + difference * difference) * 0.5
            log = ir.log(scale[i] * ir.reciprocal(old_scale) + 1e-5)
            total += log + square * inverse[i] * inverse[i] - 0.5
        return total

    def _store_errors(self, slopes: list[Value], sums: list[Value]) -> None:
        """Store a sample's derivatives by the outputs, and add them and the sums to their slots."""
        ir = self.ir
        kept = [ir.select(self.is_there, x, 0.0) for x in (*slopes, *sums)]
        errors = ir.shared(self.thread * (2 * (TILE + _PAD)), self.bytes_of("errors"))
        zero = ir.constant(0.0)
        padded = [*kept[: len(slopes)], zero]
        for i in range(0, len(slopes), 2):
            ir.write(ir.pack(padded[i], padded[i + 1]), ir.moved(errors, 2 * i))
        slots = ir.shared(self.thread * 4, self.bytes_of("slots"))
        for i, value in enumerate(kept):
            place = ir.moved(slots, 4 * i * (self.tiling.rows + 1))
            ir.write(ir.read(place) + value, place)

    def _backward(self) -> None:
        """Add a tile's gradient of all weights to the sums, from the last layer to the first."""
        ir, shape, tiling = self.ir, self.shape, self.tiling
        samples, tiles = tiling.rows // TILE, self.width // TILE
        # The head's weights: the activations, transposed, times the errors.
        column = ir.minimum(self.warp, tiles - 1) * TILE
        left = self.lanes(f"layer{shape.layers}", self.stride, self.column_first, 0, column)
        right = self.lanes("errors", TILE + _PAD, self.row_first)
        self.head_sums = ir.product(
            self.head_sums,
            samples,
            lambda _, k: ir.matrices(left, 32 * k * self.stride, transposed=True),
            lambda _, k: ir.matrices(right, 32 * k * (TILE + _PAD), transposed=True),
        )
        self._propagate(shape.layers, "errors", TILE + _PAD, "head", TILE + _PAD, 1)
        for layer in reversed(range(shape.layers)):
            self._add_weights(layer)
            if layer:
                name = f"layer{layer + 1}"
                self._propagate(layer, name, self.stride, f"weights{layer}", self.stride, tiles)

    def _propagate(
        self, layer: int, errors: str, stride: int, weights: str, by: int, steps: int
    ) -> None:
        """Replace a layer's activations by the derivatives before its activation function."""
        ir, tiling = self.ir, self.tiling
        left = self.lanes(errors, stride, self.row_first, self.row)
        right = self.lanes(weights, by, self.column_first, self.column)
        zero = ir.constant(0.0)
        sums = ir.product(
            [[[zero] * 4 for _ in range(2 * self.pairs)] for _ in range(tiling.row_tiles)],
            steps,
            lambda row, k: ir.matrices(left, 32 * row * stride + 32 * k, transposed=False),
            lambda pair, k: ir.matrices(right, 32 * pair * by + 32 * k, transposed=False),
        )
        kind = self.shape.activation
        name = f"slopes{layer}" if kind == "swish" else f"layer{layer}"
        values = ir.shared(self.place, self.bytes_of(name))
        pairs = []
        for offset, low, high in self.halves(sums):
            first, second = ir.unpack(ir.read(ir.moved(values, offset), "i32"))
            low, high = _slope(ir, kind, first, low), _slope(ir, kind, second, high)
            pairs.append((offset, ir.pack(low, high)))
        # The gradient of the weights above has read the activations before they are replaced.
        ir.synchronize()
        pointer = ir.shared(self.place, self.bytes_of(f"layer{layer}"))
        for offset, pair in pairs:
            ir.write(pair, ir.moved(pointer, offset))
        ir.synchronize()

    def _add_weights(self, layer: int) -> None:
        """Add a tile's gradient of a layer's weights and biases, transposed: (outputs, inputs)."""
        ir, share = self.ir, self.shares[layer]
        samples = self.tiling.rows // TILE
        name, stride = self.source(layer)
        errors = f"layer{layer + 1}"
        row, column = self._share_of_warp(layer)
        left = self.lanes(errors, self.stride, self.column_first, 0, row)
        right = self.lanes(name, stride, self.row_first, 0, column)
        self.weight_sums[layer] = ir.product(
            self.weight_sums[layer],
            samples,
            lambda m, k: ir.matrices(left, 32 * k * self.stride + 32 * m, transposed=True),
            lambda pair, k: ir.matrices(right, 32 * k * stride + 32 * pair, transposed=True),
        )
        # The biases: the same with ones in place of the layer's inputs.
        tiles = self.width // TILE
        place = ir.minimum(self.warp, tiles - 1) * TILE
        own = self.lanes(errors, self.stride, self.column_first, 0, place)
        one = ir.constant(0x3F803F80, "i32")
        self.bias_sums[layer] = ir.product(
            self.bias_sums[layer],
            samples,
            lambda _, k: ir.matrices(own, 32 * k * self.stride, transposed=True),
            lambda *_: [one] * 4,
        )

    def _share_of_warp(self, layer: int) -> tuple[Value, Value]:
        """Return the first row (output) and column (input) of the warp's share of a gradient."""
        share = self.shares[layer]
        columns = _padded(self.shape.inputs[layer]) // TILE
        groups = _WARPS // share.groups
        row = self.ir.minimum(
            self.warp % share.groups * share.row_tiles, self.width // TILE - share.row_tiles
        )
        column = self.ir.minimum(self.warp // share.groups * share.pairs, columns - share.pairs)
        del groups
        return row * TILE, column * TILE

    def _store_gradient(self) -> None:
        """Store the block's sums."""
        ir, shape, offset = self.ir, self.shape, 0
        for layer, inputs in enumerate(shape.inputs[:-1]):
            row, column = self._share_of_warp(layer)
            output, first = row + self.sum_row, column + self.sum_column
            for m, sums in enumerate(self.weight_sums[layer]):
                for n, four in enumerate(sums):
                    for i, value in enumerate(four):
                        at = first + (8 * n + i % 2)
                        place = at * self.width + output + (offset + TILE * m + 8 * (i // 2))
                        if inputs % TILE:
                            with ir.when(at < inputs):
                                ir.put(value, self.part, place)
                        else:
                            ir.put(value, self.part, place)
            offset += inputs * self.width
            ((four,),) = self.bias_sums[layer]
            place = ir.minimum(self.warp, self.width // TILE - 1) * TILE + self.sum_row + offset
            with ir.when(self.sum_column.equals(0)):
                ir.put(four[0], self.part, place)
                ir.put(four[2], self.part, place + 8)
            offset += self.width
        self._store_head(offset)

    def _store_head(self, offset: int) -> None:
        """Store the sums of the last layer, and of what the slots hold."""
        ir, shape = self.ir, self.shape
        ((four,),) = self.head_sums
        row = ir.minimum(self.warp, self.width // TILE - 1) * TILE + self.sum_row
        for i, value in enumerate(four):
            column = self.sum_column + i % 2
            place = (row + 8 * (i // 2)) * self.outputs + column + offset
            with ir.when(column < self.outputs):
                ir.put(value, self.part, place)
        slots = shape.outputs[0] + shape.deviations + len(POLICY_METRICS)
        count = ir.select(
            self.is_policy,
            ir.constant(slots, "i32"),
            ir.constant(1 + len(VALUE_METRICS), "i32"),
        )
        with ir.when(self.thread < count):
            first = ir.shared(self.thread * (4 * (self.tiling.rows + 1)), self.bytes_of("slots"))
            total = ir.constant(0.0)
            for i in range(self.tiling.rows):
                total += ir.read(ir.moved(first, 4 * i))
            ir.put(total, self.part, self.outputs * self.width + self.thread + offset)


def _log_slope(ir: IrWriter, x: Value) -> Value:
    """Return log(1 - tanh(x)^2), as Brax computes it."""
    return (math.log(2.0) - x - ir.softplus(x * -2.0)) * 2.0


def _slope(ir: IrWriter, activation: str, value: Value, factor: Value) -> Value:
    """Return the slope of an activation, from its value or for `swish` from itself, times a factor."""
    if activation == "tanh":
        return factor * (1.0 - value * value)
    if activation == "relu":
        return ir.select(ir.constant(0.0) < value, factor, 0.0)
    if activation == "elu":
        return ir.select(value < 0.0, factor * (value + 1.0), factor)
    return factor * value


def gradient_text(tiling: Tiling, samples: int, terms: LossTerms) -> str:
    """Write the gradient as LLVM IR.

    Args:
      tiling: the division of the work.
      samples: the number of samples of a minibatch.
      terms: the constants of the loss.

    Returns:
      The text of an LLVM module; its launch needs `tiling.layout["size"]` bytes of shared memory.
    """
    return _GradientKernel(tiling, samples, terms).write()


def values_text(tiling: Tiling, samples: int, last: int) -> str:
    """Write the values as LLVM IR.

    Args:
      tiling: the division of the work.
      samples: the number of samples.
      last: the number of samples after them, in an array of their own.

    Returns:
      The text of an LLVM module; its launch needs `tiling.layout["size"]` bytes of shared memory.
    """
    return _ValuesKernel(tiling, samples, last).write()
