"""Write the kernel that computes the gradient of both networks by PPO's loss.

A block has 256 threads, serves one network (`ctaid.y`: 0 the policy, 1 the values), and loops over
tiles of samples. Weights and activations are in shared memory as float16, all sums are float32,
and the sums of the gradient stay in registers until the last tile.
"""

import jax

from jetbot_mjx.agents.fused import sample_loss
from jetbot_mjx.agents.fused.arrays import GRADIENT
from jetbot_mjx.agents.fused.gpu_advantages import AdvantageKernel, estimate_shapes
from jetbot_mjx.agents.fused.gpu_network import NetworkKernel
from jetbot_mjx.agents.fused.gpu_tiling import PAD, Tiling, padded, shares_of
from jetbot_mjx.agents.fused.shapes import VALUE_METRICS, Minibatch
from jetbot_mjx.agents.fused.tensor_core import LANES, TILE, GpuWriter, Value

_ONES = 0x3C003C00
"""Two ones in float16."""

_MEAN_SCALE = 1 / 16
"""Derivatives by the outputs are those of the sum over this fraction of the samples: of the mean
over many, they would be too small for float16."""


class GradientKernel(NetworkKernel):
    """A `GradientKernel` takes arguments of `arrays.GRADIENT` and the results of the advantages.

    It returns a vector for each block. The sum of the vectors is the gradient, with the sums of the
    metrics at their places.

    In shared memory it also has, with a row for each sample of a tile where nothing else is said:

        layer1, layer2, ...    float16 (rows, width); the backward pass puts derivatives there
        slopes1, slopes2, ...  the same, of `swish` only, whose slopes its values do not tell
        errors                 float16 (rows, 16), derivatives of the loss by the outputs
        extras                 float32 (rows, numbers that the loss reads beside the outputs)
        statistics             float32, sums of the lanes, then mean and 1 / std of the advantages
        slots                  float32 (sums that single samples add to, rows + 1)
    """

    name = "ppo_gradient"
    arguments = (
        *("params", "mean", "scale", "rows", "unrolls", "noise", "index"),
        *(*AdvantageKernel.returns, "terms"),
    )
    returns = ("gradients",)
    networks = 2

    def __init__(
        self, tiling: Tiling, batch: Minibatch, blocks: int, advantage_blocks: int
    ) -> None:
        """Prepare to write.

        Args:
          tiling: the division of the work.
          batch: the minibatch.
          blocks: the number of blocks of each network of a policy.
          advantage_blocks: the number of blocks of the kernel of the advantages.
        """
        shapes = GRADIENT.shapes(tiling.shape, batch) | estimate_shapes(batch, advantage_blocks)
        shapes["gradients"] = blocks, tiling.shape.size
        super().__init__(shapes, tiling, batch, blocks)
        self.advantage_blocks = advantage_blocks
        self.width, self.shares = self.shape.width, shares_of(self.shape)
        self.error_scale = batch.samples * _MEAN_SCALE

    def begin(self) -> list[Value]:
        """Load the block's network, and begin with sums of zero."""
        ir, shape, batch = self.ir, self.shape, self.batch
        # The second axis of the grid is the network.
        self.network = ir.register("ctaid.y")
        self.is_policy = self.network.equals(0)
        self.outputs = ir.select(self.is_policy, ir.constant(shape.outputs[0], "u32"), 1)
        # The first of the 16 units behind which the warp computes the gradient of biases and head.
        self.own_tile = ir.minimum(self.warp, self.width // TILE - 1) * TILE
        # Find the data of the minibatch, and the block's own gradient, of one of the networks.
        index, noise = self.arrays["index"].load("u32"), batch.samples * shape.actions
        self.unrolls = ir.row(self.arrays["unrolls"], index, batch.unrolls)
        self.noise = ir.row(self.arrays["noise"], index, noise)
        start = self.network * shape.policy_size
        self.vector = ir.row(self.arrays["gradients"], self.block, shape.size) + start
        # Load what all tiles need into shared memory.
        self.load_terms()
        self.load_network(self.arrays["params"] + start, self.outputs)
        self._clear()
        if shape.normalizes:
            self._load_statistics()
        # The sums of the gradient are carried from tile to tile.
        sums = (
            [ir.zeros(share.row_tiles, 2 * share.pairs) for share in self.shares],
            [ir.zeros(1, 1) for _ in range(shape.layers)],
            ir.zeros(1, 1),
        )
        zeros, self.sums_tree = jax.tree.flatten(sums)
        return zeros

    def tile(self, tile: Value, carried: list[Value]) -> list[Value]:
        """Add the gradient of a tile of samples to the sums."""
        ir = self.ir
        self._take_sums(carried)
        self._load_tile(tile)
        # Warps read rows that others have loaded,
        ir.synchronize()
        self.store_outputs(self.forward())
        # the loss all outputs of a row,
        ir.synchronize()
        with ir.when(self.thread < self.tiling.rows):
            self._loss(tile)
        # and the backward pass the errors of all rows.
        ir.synchronize()
        self._backward()
        # The next tile overwrites what the backward pass reads.
        ir.synchronize()
        return jax.tree.leaves((self.weight_sums, self.bias_sums, self.head_sums))

    def _take_sums(self, values: list[Value]) -> None:
        """Set the sums of the weights and biases of the layers, and those of the head."""
        sums = jax.tree.unflatten(self.sums_tree, values)
        self.weight_sums, self.bias_sums, self.head_sums = sums

    def _clear(self) -> None:
        ir = self.ir
        zero = ir.constant(0, "u32")
        # Errors beyond the outputs stay zero, and the slots begin so.
        for name, following in (("errors", "extras"), ("slots", "size")):
            for i in self.each((self.bytes_of(following) - self.bytes_of(name)) // 4):
                self.write(name, i, zero)

    def _load_statistics(self) -> None:
        """Compute the mean of the advantages and 1 / std from the sums of all blocks."""
        ir = self.ir
        # A warp adds up the sums of the blocks, and a thread those of the lanes.
        with ir.when(self.thread < LANES):
            for i in range(2):
                total = ir.constant(0.0)
                for j in range(0, self.advantage_blocks, LANES):
                    block = self.thread + j
                    kept = ir.minimum(block, self.advantage_blocks - 1)
                    value = self.arrays["statistics"][kept * 2 + i]
                    total += ir.select(block < self.advantage_blocks, value, 0.0)
                self.write("statistics", self.thread, total, LANES * i)
        ir.synchronize()
        with ir.when(self.thread < 1):
            mean, square = (
                ir.total(self.read("statistics", LANES * i, lane) for lane in range(LANES))
                * (1 / self.batch.samples)
                for i in range(2)
            )
            variance = square - mean * mean
            variance = ir.select(variance < 0.0, ir.constant(0.0), variance)
            self.write("statistics", 2 * LANES, mean)
            self.write("statistics", 2 * LANES + 1, ir.reciprocal(ir.sqrt(variance) + 1e-8))

    def _load_tile(self, tile: Value) -> None:
        """Copy a tile's observations and what else the loss reads to shared memory."""
        ir, time, columns = self.ir, self.batch.time, self.shape.columns

        def place(row: Value) -> tuple[Value, Value, Value, Value]:
            sample = ir.minimum(tile * self.tiling.rows + row, self.batch.samples - 1)
            unroll, step = sample // time, sample % time
            collected = (self.unrolls + unroll).load("u32")
            start = ir.row(self.arrays["rows"], collected * time + step, columns["size"])
            return sample, unroll, step, start

        # Fetch everything before anything is stored.
        own = ir.minimum(self.thread, self.tiling.rows - 1)
        sample, unroll, step, start = place(own)
        first, last = columns["raw_action"], columns["reward"]
        extras = [start[i] for i in range(first, last)]
        noise = (step * self.batch.unrolls + unroll) * self.shape.actions
        extras += [self.noise[noise + i] for i in range(self.shape.actions)]
        extras += [self.arrays[name][sample] for name in ("advantages", "targets")]
        self.load_observations(lambda row: place(row)[3])
        # Store it in a row for each sample.
        first = own * self.tiling.extras
        for i, value in enumerate(extras):
            self.write("extras", first, value, i)

    def _extras(self, start: int, stop: int) -> list[Value]:
        """Return numbers that `_load_tile` has stored for the loss of the thread's sample."""
        first = self.thread * self.tiling.extras
        return [self.read("extras", first, i) for i in range(start, stop)]

    def _loss(self, tile: Value) -> None:
        """Write the derivative of the loss by the outputs of one sample, a thread for each."""
        ir, end = self.ir, self.tiling.extras
        self.is_there = tile * self.tiling.rows + self.thread < self.batch.samples
        # All threads of a block have the same network, so none of them waits here.
        with ir.when(self.is_policy):
            self._policy_loss()
        with ir.when(self.network.equals(1)):
            program = sample_loss.value_program(self.batch.samples)
            given = [*self.outputs_of(self.thread, 1), *self._extras(end - 1, end)]
            slope, square = ir.run(program, [*given, self.terms.vf_loss_coefficient])
            self._store_errors([slope], [square])

    def _policy_loss(self) -> None:
        ir, shape = self.ir, self.shape
        *extras, advantage = self._extras(0, self.tiling.extras - 1)
        if shape.normalizes:
            mean, scale = (self.read("statistics", 2 * LANES + i) for i in (0, 1))
            advantage = (advantage - mean) * scale
        # A `PolicySample` and the coefficients.
        outputs = self.outputs_of(self.thread, shape.outputs[0])
        sample = [*outputs, *self.deviations(), *extras, advantage, ir.constant(1.0), *self.terms]
        program = sample_loss.policy_program(shape, self.batch.samples, for_gpu=True)
        results = ir.run(program, sample)
        self._store_errors(results[: shape.outputs[0]], results[shape.outputs[0] :])

    def _store_errors(self, slopes: list[Value], sums: list[Value]) -> None:
        """Store a sample's derivatives by the outputs, and add them and the sums to their slots."""
        ir = self.ir
        # Rows beyond the last sample add nothing.
        kept = [ir.select(self.is_there, x, 0.0) for x in (*slopes, *sums)]
        # The derivatives, as the operand of a product.
        errors = ir.shared(self.thread * (2 * (TILE + PAD)), self.bytes_of("errors"))
        zero = ir.constant(0.0)
        padded = [*(x * self.error_scale for x in kept[: len(slopes)]), zero]
        for i in range(0, len(slopes), 2):
            ir.moved(errors, 2 * i).store(ir.pack(padded[i], padded[i + 1]))
        # Sums of a row of a tile, of which one thread changes each.
        for i, value in enumerate(kept):
            offset = i * (self.tiling.rows + 1)
            total = self.read("slots", self.thread, offset) + value
            self.write("slots", self.thread, total, offset)

    def _backward(self) -> None:
        """Add a tile's gradient of all weights to the sums, from the last layer to the first."""
        ir, shape, tiling = self.ir, self.shape, self.tiling
        samples, tiles = tiling.rows // TILE, self.width // TILE
        # The head's weights: the activations, transposed, times the errors.
        left = self.operand("left", f"layer{shape.layers}", "rows", 0, self.own_tile)
        right = self.operand("right", "errors", "rows")
        self.head_sums = ir.product(self.head_sums, samples, left, right)
        # Back through the layers; the weights of one need the errors behind it.
        self._propagate(shape.layers, "errors", "head", 1)
        for layer in reversed(range(shape.layers)):
            self._add_weights(layer)
            if layer:
                self._propagate(layer, f"layer{layer + 1}", f"weights{layer}", tiles)

    def _propagate(self, layer: int, errors: str, weights: str, steps: int) -> None:
        """Replace a layer's activations by the derivatives before its activation function."""
        ir = self.ir
        # The errors times the weights, transposed.
        left = self.operand("left", errors, "columns", self.row)
        right = self.operand("right", weights, "columns", self.column)
        zeros = ir.zeros(self.tiling.row_tiles, 2 * self.pairs)
        sums = ir.product(zeros, steps, left, right)
        # Times the slopes of the activations, which stand where the results go.
        kind = self.shape.activation
        name = f"slopes{layer}" if kind == "swish" else f"layer{layer}"
        values = ir.shared(self.place, self.bytes_of(name))
        pairs = []
        for offset, low, high in self.halves(sums):
            first, second = ir.unpack(ir.moved(values, offset).load("u32"))
            low, high = _slope(ir, kind, first, low), _slope(ir, kind, second, high)
            pairs.append((offset, ir.pack(low, high)))
        # The gradient of the weights above has read the activations before they are replaced.
        ir.synchronize()
        pointer = ir.shared(self.place, self.bytes_of(f"layer{layer}"))
        for offset, pair in pairs:
            ir.moved(pointer, offset).store(pair)
        ir.synchronize()

    def _add_weights(self, layer: int) -> None:
        """Add a tile's gradient of a layer's weights and biases, transposed: (outputs, inputs)."""
        ir = self.ir
        samples, errors = self.tiling.rows // TILE, f"layer{layer + 1}"
        # The weights: the errors, transposed, times the inputs of the layer.
        row, column = self._share_of_warp(layer)
        left = self.operand("left", errors, "rows", 0, row)
        right = self.operand("right", self.layer(layer), "rows", 0, column)
        self.weight_sums[layer] = ir.product(self.weight_sums[layer], samples, left, right)
        # The biases: the same with ones in place of the layer's inputs.
        left = self.operand("left", errors, "rows", 0, self.own_tile)
        ones = [ir.constant(_ONES, "u32")] * 4
        self.bias_sums[layer] = ir.product(self.bias_sums[layer], samples, left, lambda *_: ones)

    def _share_of_warp(self, layer: int) -> tuple[Value, Value]:
        """Return the first row (output) and column (input) of the warp's share of a gradient."""
        share, rows = self.shares[layer], self.width // TILE
        columns = padded(self.shape.inputs[layer]) // TILE
        row = self.ir.minimum(self.warp % share.groups * share.row_tiles, rows - share.row_tiles)
        column = self.ir.minimum(self.warp // share.groups * share.pairs, columns - share.pairs)
        return row * TILE, column * TILE

    def _put_sum(self, value: Value, place: Value) -> None:
        """Store a sum of products with errors."""
        self.vector[place] = value * (1 / self.error_scale)

    def end(self, carried: list[Value]) -> None:
        """Store the block's sums."""
        ir, shape = self.ir, self.shape
        self._take_sums(carried)
        # A lane has four sums of each product; `tensor_core` says which.
        for layer, inputs, start in shape.hidden_layers:
            row, column = self._share_of_warp(layer)
            output, first = row + self.sum_row, column + self.sum_column
            for m, sums in enumerate(self.weight_sums[layer]):
                for n, four in enumerate(sums):
                    for i, value in enumerate(four):
                        at = first + (8 * n + i % 2)
                        place = at * self.width + output + (start + TILE * m + 8 * (i // 2))
                        if inputs % TILE:
                            with ir.when(at < inputs):
                                self._put_sum(value, place)
                        else:
                            self._put_sum(value, place)
            # The bias of an output is in all columns of its sums.
            ((four,),) = self.bias_sums[layer]
            place = self.own_tile + self.sum_row + (start + inputs * self.width)
            with ir.when(self.sum_column.equals(0)):
                self._put_sum(four[0], place)
                self._put_sum(four[2], place + 8)
        self._store_head(shape.hidden)

    def _store_head(self, offset: int) -> None:
        """Store the sums of the last layer, and of what the slots hold."""
        ir, shape = self.ir, self.shape
        ((four,),) = self.head_sums
        row = self.own_tile + self.sum_row
        for i, value in enumerate(four):
            column = self.sum_column + i % 2
            place = (row + 8 * (i // 2)) * self.outputs + column + offset
            with ir.when(column < self.outputs):
                self._put_sum(value, place)
        # A thread adds up a slot over the rows of a tile: biases, deviations and metrics.
        slots = ir.constant(shape.slots, "u32")
        count = ir.select(self.is_policy, slots, 1 + len(VALUE_METRICS))
        with ir.when(self.thread < count):
            first = self.thread * (self.tiling.rows + 1)
            total = ir.total(self.read("slots", first, i) for i in range(self.tiling.rows))
            self.vector[self.outputs * self.width + self.thread + offset] = total


def _slope(ir: GpuWriter, activation: str, value: Value, factor: Value) -> Value:
    """Return a factor times the slope of an activation, by its value or, of `swish`, its slope."""
    if activation == "tanh":
        return factor * (1.0 - value * value)
    if activation == "relu":
        return ir.select(ir.constant(0.0) < value, factor, 0.0)
    if activation == "elu":
        return ir.select(value < 0.0, factor * (value + 1.0), factor)
    return factor * value
