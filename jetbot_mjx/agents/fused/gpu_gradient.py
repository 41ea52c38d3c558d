"""Write the kernel that computes the gradient of PPO's loss for both networks.

A block has 256 threads, serves one network (`ctaid.y`: 0 the policy, 1 the values), and loops over
tiles of samples. Weights and activations are in shared memory as float16, all sums are float32,
and the sums of the gradient stay in registers until the last tile.
"""

import jax

from jetbot_mjx.agents.fused import sample_loss
from jetbot_mjx.agents.fused.arrays import GRADIENT
from jetbot_mjx.agents.fused.gpu_advantages import AdvantageKernel, estimate_shapes
from jetbot_mjx.agents.fused.gpu_network import NetworkKernel, times_slope
from jetbot_mjx.agents.fused.gpu_tiling import PAD, Tiling, padded, shares_of
from jetbot_mjx.agents.fused.shapes import VALUE_METRICS, DataSizes
from jetbot_mjx.agents.fused.tensor_core import LANES, TILE, Value

_ONES = 0x3C003C00
"""Two ones in float16."""

_LOSS_SCALE = 1 / 16
"""Loss scaling: of N samples, errors are stored in float16 as N/16 times the derivatives of the
mean loss, because those of the mean underflow; `_put_sum` divides by it."""

_LEAST_VARIANCE = 2**-20
"""Least variance of the advantages relative to the square of their mean: the difference from which
it is computed, E[x²] - E[x]² in float32, is about as uncertain."""


class GradientKernel(NetworkKernel):
    """A `GradientKernel` takes arguments of `arrays.GRADIENT` and the results of the advantages.

    It returns as many vectors as there are blocks for each network: into vector b, block b of each
    network writes that network's part. The sum of the vectors is the gradient, with the sums of the
    metrics at their places.

    In shared memory it also has, with a row for each sample of a tile where nothing else is said:

        layer1, layer2, ...    float16 (rows, width), activations; the backward pass replaces them
                               by dL/dz: of the loss with respect to the weighted sums
        slopes1, slopes2, ...  float16 (rows, width), activation'(z), of `swish` only
        errors                 float16 (rows, 16), dL/dy: with respect to the outputs
        extras                 float32 (rows, numbers that the loss reads beside the outputs)
        statistics             float32, sums of the lanes, then mean and 1 / std of the advantages
        slots                  float32 (sums that single samples add to, rows + 1)
    """

    name = "ppo_gradient"
    arguments = (
        *("params", "mean", "inverse_std", "rows", "unroll_indices", "noise", "index"),
        *(*AdvantageKernel.returns, "terms"),
    )
    returns = ("gradients",)
    networks = 2

    def __init__(
        self, tiling: Tiling, batch: DataSizes, blocks: int, advantage_blocks: int
    ) -> None:
        """Prepare to write.

        Args:
          tiling: the division of the work.
          batch: the minibatch.
          blocks: the number of blocks of each network of a replica.
          advantage_blocks: the number of blocks of the kernel of the advantages.
        """
        shapes = GRADIENT.shapes(tiling.shape, batch) | estimate_shapes(batch, advantage_blocks)
        shapes["gradients"] = blocks, tiling.shape.size
        super().__init__(shapes, tiling, batch, blocks)
        self.advantage_blocks = advantage_blocks
        self.width, self.shares = self.shape.width, shares_of(self.shape)
        self.error_scale = batch.samples * _LOSS_SCALE

    def begin(self) -> list[Value]:
        """Load the block's network, and begin with sums of zero."""
        w, shape, batch = self.w, self.shape, self.batch
        # The second axis of the grid is the network.
        self.network = w.register("ctaid.y")
        self.is_policy = self.network.equals(0)
        self.outputs = w.select(self.is_policy, w.constant(shape.outputs[0], "u32"), 1)
        # The warp's 16 units, of which it computes the gradient of the biases before the activation
        # and of the head's weights behind it.
        self.own_tile = w.minimum(self.warp, self.width // TILE - 1) * TILE
        # Find the data of the minibatch, and the block's own gradient, of one of the networks.
        index, noise = self.arrays["index"].load("u32"), batch.samples * shape.actions
        self.unroll_indices = w.row(self.arrays["unroll_indices"], index, batch.unrolls)
        self.noise = w.row(self.arrays["noise"], index, noise)
        start = self.network * shape.policy_size
        self.vector = w.row(self.arrays["gradients"], self.block, shape.size) + start
        # Load what all tiles need into shared memory.
        self.terms = self.load_terms()
        self.load_network(self.arrays["params"] + start, self.outputs)
        self._clear()
        if shape.normalizes:
            self._load_statistics()
        # The sums of the gradient are carried from tile to tile.
        sums = (
            [w.zeros(share.row_tiles, 2 * share.pairs) for share in self.shares],
            [w.zeros(1, 1) for _ in range(shape.layers)],
            w.zeros(1, 1),
        )
        zeros, self.sums_tree = jax.tree.flatten(sums)
        return zeros

    def tile(self, tile: Value, carried: list[Value]) -> list[Value]:
        """Add the gradient of a tile of samples to the sums."""
        w = self.w
        self._take_sums(carried)
        # 1. Load the samples. Barrier: a warp reads rows that others have loaded.
        self._load_tile(tile)
        w.synchronize()
        # 2. Forward pass. Barrier: a thread reads all outputs of a sample.
        self.store_outputs(self.forward())
        w.synchronize()
        # 3. Loss, a thread for each sample. Barrier: a warp reads the errors of all samples.
        with w.when(self.thread < self.tiling.rows):
            self._loss(tile)
        w.synchronize()
        # 4. Backward pass. Barrier: the next tile overwrites what it reads.
        self._backward()
        w.synchronize()
        return jax.tree.leaves((self.weight_sums, self.bias_sums, self.head_sums))

    def _take_sums(self, values: list[Value]) -> None:
        """Set the sums of the weights and biases of the layers, and those of the head."""
        sums = jax.tree.unflatten(self.sums_tree, values)
        self.weight_sums, self.bias_sums, self.head_sums = sums

    def _clear(self) -> None:
        w = self.w
        zero = w.constant(0, "u32")
        # Errors beyond the outputs stay zero, and the slots begin so.
        for name in ("errors", "slots"):
            for i in self.each(self.tiling.sizes[name] // 4):
                self.write(name, i, zero)

    def _load_statistics(self) -> None:
        """Compute the mean of the advantages and 1 / std from the sums of all blocks."""
        w = self.w
        # A warp adds up the sums of the blocks, and a thread those of the lanes.
        with w.when(self.thread < LANES):
            for i in range(2):
                total = w.constant(0.0)
                for j in range(0, self.advantage_blocks, LANES):
                    block = self.thread + j
                    clamped = w.minimum(block, self.advantage_blocks - 1)
                    value = self.arrays["statistics"][clamped * 2 + i]
                    total += w.select(block < self.advantage_blocks, value, 0.0)
                self.write("statistics", self.thread, total, LANES * i)
        w.synchronize()
        with w.when(self.thread < 1):
            mean, square = (
                w.total(self.read("statistics", LANES * i, lane) for lane in range(LANES))
                * (1 / self.batch.samples)
                for i in range(2)
            )
            variance = w.maximum(square - mean * mean, mean * mean * _LEAST_VARIANCE)
            self.write("statistics", 2 * LANES, mean)
            self.write("statistics", 2 * LANES + 1, w.reciprocal(w.sqrt(variance) + 1e-8))

    def _load_tile(self, tile: Value) -> None:
        """Copy a tile's observations and what else the loss reads to shared memory."""
        w, time, columns = self.w, self.batch.time, self.shape.columns

        def place(row: Value) -> tuple[Value, Value, Value, Value]:
            sample = w.minimum(tile * self.tiling.rows + row, self.batch.samples - 1)
            unroll, step = sample // time, sample % time
            collected = (self.unroll_indices + unroll).load("u32")
            collected_row = w.row(self.arrays["rows"], collected * time + step, columns["size"])
            return sample, unroll, step, collected_row

        # Fetch everything before anything is stored.
        own = w.minimum(self.thread, self.tiling.rows - 1)
        sample, unroll, step, collected_row = place(own)
        extras = [collected_row[i] for i in range(columns["raw_action"], columns["reward"])]
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
        """Compute the loss of the thread's sample: store the errors, and add to the slots."""
        w, end = self.w, self.tiling.extras
        self.is_there = tile * self.tiling.rows + self.thread < self.batch.samples
        # All threads of a block serve one network, so they take the same way.
        with w.when(self.is_policy):
            self._policy_loss()
        with w.when(self.network.equals(1)):
            program = sample_loss.value_program(self.batch.samples)
            value_and_target = [*self.outputs_of(self.thread, 1), *self._extras(end - 1, end)]
            results = w.run(program, [*value_and_target, self.terms.vf_loss_coefficient])
            self._take_results(results, 1)

    def _policy_loss(self) -> None:
        w, shape = self.w, self.shape
        *extras, advantage = self._extras(0, self.tiling.extras - 1)
        if shape.normalizes:
            mean, inverse_std = (self.read("statistics", 2 * LANES + i) for i in (0, 1))
            advantage = (advantage - mean) * inverse_std
        # A `PolicySample` and the coefficients.
        outputs = self.outputs_of(self.thread, shape.outputs[0])
        sample = [*outputs, *self.deviations(), *extras, advantage, w.constant(1.0), *self.terms]
        program = sample_loss.policy_program(shape, self.batch.samples, for_gpu=True)
        self._take_results(w.run(program, sample), shape.outputs[0])

    def _take_results(self, results: list[Value], outputs: int) -> None:
        """Take what a loss returns: errors of so many outputs, and what is only summed up."""
        # Rows beyond the last sample add nothing. The errors are the gradient of the head's biases,
        # too, and float32 there: an error that is not finite reaches the norm, though `pack`
        # replaces infinity by the largest float16.
        terms = [self.w.select(self.is_there, x, 0.0) for x in results]
        self._store_errors(terms[:outputs])
        self._add_to_slots(terms)

    def _store_errors(self, errors: list[Value]) -> None:
        """Store the errors of the thread's sample, scaled, as the operand of a product."""
        w = self.w
        row = w.shared(self.thread * (2 * (TILE + PAD)), self.bytes_of("errors"))
        zero = w.constant(0.0)
        padded = [*(x * self.error_scale for x in errors), zero]
        for i in range(0, len(errors), 2):
            w.moved(row, 2 * i).store(w.pack(padded[i], padded[i + 1]))

    def _add_to_slots(self, terms: list[Value]) -> None:
        """Add a term to each slot's sum of the thread's row, which no other thread changes."""
        for i, value in enumerate(terms):
            offset = i * (self.tiling.rows + 1)
            total = self.read("slots", self.thread, offset) + value
            self.write("slots", self.thread, total, offset)

    def _backward(self) -> None:
        """Add a tile's gradient of all weights to the sums, from the last layer to the first."""
        w, shape, tiling = self.w, self.shape, self.tiling
        samples, tiles = tiling.rows // TILE, self.width // TILE
        # The head's weights: activationsᵀ @ dL/dy. Its biases are among the slots.
        left = self.operand("left", f"layer{shape.layers}", "rows", 0, self.own_tile)
        right = self.operand("right", "errors", "rows")
        self.head_sums = w.product(self.head_sums, samples, left, right)
        # Then layer by layer: dL/dz in place of the activations, and from it the weights' gradient.
        self._propagate(shape.layers, "errors", "head", 1)
        for layer in reversed(range(shape.layers)):
            self._add_weights(layer)
            if layer:
                self._propagate(layer, f"layer{layer + 1}", f"weights{layer}", tiles)

    def _propagate(self, layer: int, output_errors: str, weights: str, steps: int) -> None:
        """Replace a layer's activations by dL/dz, derivatives with respect to its weighted sums.

        Args:
          layer: the number of the layer, from 1.
          output_errors: the matrix that has the derivatives one layer further.
          weights: the weights between both.
          steps: their columns, in tiles of 16.
        """
        w = self.w
        # The derivatives one layer further, times the transposed weights,
        left = self.operand("left", output_errors, "columns", self.row)
        right = self.operand("right", weights, "columns", self.column)
        zeros = w.zeros(self.tiling.row_tiles, 2 * self.pairs)
        sums = w.product(zeros, steps, left, right)
        # times the slopes, which are stored where the results go, or follow from what is.
        kind = self.shape.activation
        name = f"slopes{layer}" if self.tiling.stores_slopes else f"layer{layer}"
        values = w.shared(self.own_bytes, self.bytes_of(name))
        pairs = []
        for offset, low, high in self.halves(sums):
            first, second = w.unpack(w.moved(values, offset).load("u32"))
            low, high = times_slope(w, kind, first, low), times_slope(w, kind, second, high)
            pairs.append((offset, w.pack(low, high)))
        # The gradient of the weights further on has read the activations before they are replaced.
        w.synchronize()
        pointer = w.shared(self.own_bytes, self.bytes_of(f"layer{layer}"))
        for offset, pair in pairs:
            w.moved(pointer, offset).store(pair)
        w.synchronize()

    def _add_weights(self, layer: int) -> None:
        """Add a tile's gradient of a layer's weights and biases, transposed: (outputs, inputs)."""
        w = self.w
        samples, errors = self.tiling.rows // TILE, f"layer{layer + 1}"
        # The weights: (dL/dz)ᵀ @ inputs.
        row, column = self._share_of_warp(layer)
        left = self.operand("left", errors, "rows", 0, row)
        right = self.operand("right", self.layer(layer), "rows", 0, column)
        self.weight_sums[layer] = w.product(self.weight_sums[layer], samples, left, right)
        # The biases: (dL/dz)ᵀ @ ones.
        left = self.operand("left", errors, "rows", 0, self.own_tile)
        ones = [w.constant(_ONES, "u32")] * 4
        self.bias_sums[layer] = w.product(self.bias_sums[layer], samples, left, lambda *_: ones)

    def _share_of_warp(self, layer: int) -> tuple[Value, Value]:
        """Return the first row (output) and column (input) of the warp's share of a gradient."""
        share, rows = self.shares[layer], self.width // TILE
        columns = padded(self.shape.inputs[layer]) // TILE
        row = self.w.minimum(self.warp % share.groups * share.row_tiles, rows - share.row_tiles)
        column = self.w.minimum(self.warp // share.groups * share.pairs, columns - share.pairs)
        return row * TILE, column * TILE

    def _put_sum(self, value: Value, place: Value) -> None:
        """Store a sum of products with scaled errors."""
        self.vector[place] = value * (1 / self.error_scale)

    def end(self, carried: list[Value]) -> None:
        """Store the block's sums."""
        w, shape = self.w, self.shape
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
                            with w.when(at < inputs):
                                self._put_sum(value, place)
                        else:
                            self._put_sum(value, place)
            # The bias of an output is in all columns of its sums.
            ((four,),) = self.bias_sums[layer]
            place = self.own_tile + self.sum_row + (start + inputs * self.width)
            with w.when(self.sum_column.equals(0)):
                self._put_sum(four[0], place)
                self._put_sum(four[2], place + 8)
        self._store_head(shape.head_start)

    def _store_head(self, offset: int) -> None:
        """Store the sums of the last layer, and of what the slots hold."""
        w, shape = self.w, self.shape
        ((four,),) = self.head_sums
        row = self.own_tile + self.sum_row
        for i, value in enumerate(four):
            column = self.sum_column + i % 2
            place = (row + 8 * (i // 2)) * self.outputs + column + offset
            with w.when(column < self.outputs):
                self._put_sum(value, place)
        # A thread adds up a slot over the rows of a tile: biases, deviations and metrics.
        slots = w.constant(shape.slots, "u32")
        count = w.select(self.is_policy, slots, 1 + len(VALUE_METRICS))
        with w.when(self.thread < count):
            first = self.thread * (self.tiling.rows + 1)
            total = w.total(self.read("slots", first, i) for i in range(self.tiling.rows))
            self.vector[self.outputs * self.width + self.thread + offset] = total
