"""Write the stages of a call that compute PPO's gradient on CPUs, one for each network.

A stage divides the minibatch into parts of whole unrolls. A part goes through its unrolls tile by
tile: forward through all layers, the loss and its derivatives with respect to the outputs, and
backward, where it adds to the part's gradient. Since a column of ones stands beside the
activations, one product adds to the gradient of weights and biases.
"""

import abc
import functools

from jetbot_mjx.agents.fused import sample_loss
from jetbot_mjx.agents.fused.cpu_network import HEAD, MOST_PARTS, NetworkStage
from jetbot_mjx.agents.fused.cpu_product import (
    Matrix,
    add_all,
    add_to,
    fill,
    matmul,
    transposed,
    vector_loops,
)
from jetbot_mjx.agents.fused.cpu_stages import Stage, SumStage, integer_at, sample_function
from jetbot_mjx.agents.fused.sample_loss import ValueStep, vector_of
from jetbot_mjx.agents.fused.shapes import VALUE_METRICS, DataSizes, LossTerms, UpdateShape
from onekernel.build import LlvmWriter, ScalarProgram, Value, scalarize

_PART_SAMPLES = 256
"""Samples of a part, about, if the minibatch has no more than `MOST_PARTS` times as many."""


def gradient_stages(shape: UpdateShape, batch: DataSizes, lanes: int) -> list[list[Stage]]:
    """Return the stages of `arrays.GRADIENT`, from values to the sum of all parts.

    Args:
      shape: the networks.
      batch: the minibatch.
      lanes: the number of float32 values in a vector register.
    """
    values, policy = _ValueStage(shape, batch, lanes), _PolicyStage(shape, batch, lanes)
    vectors = {f"{stage.name}_vectors": stage.parts for stage in (policy, values)}
    return [[values], [policy], [SumStage(shape, lanes, vectors)]]


class _GradientStage(NetworkStage):
    """A `_GradientStage` goes through the unrolls of a minibatch, for one of the networks.

    Its scratch memory also has these matrices of float32:

        turned1, turned2, ...  (width, width), weights transposed
        turned_head            (outputs, width)
        slopes1, slopes2, ...  (rows of a tile, width), derivatives of the activation function
        deltas0, deltas1       (rows, width), dL/dz: of the loss with respect to weighted sums
        errors                 (rows, HEAD), dL/dy: of the loss with respect to the outputs
        head_sums              (width + 1, HEAD), the gradient of the last layer
        tail_sums              (tail_sums, lanes), those of the deviations and the metrics
        statistics             (lanes), sums of the advantages, for their mean and variance
        loss, results          (numbers of a sample, lanes), what its loss reads and writes
    """

    tail_sums: int
    """Number of sums behind the head's parameters."""
    size: int
    """Length of the network's part of the vector of parameters."""
    loss_program: ScalarProgram
    """The loss of a sample with its derivatives."""
    loss_lanes: int
    """Number of samples whose losses are computed at once."""

    def __init__(self, shape: UpdateShape, batch: DataSizes, lanes: int) -> None:
        # A tile has whole unrolls, of the values each followed by its last observation.
        self.batch = batch
        unrolls = max(1, round(_PART_SAMPLES / batch.time), -(-batch.unrolls // MOST_PARTS))
        super().__init__(shape, lanes, batch.unrolls, unrolls, batch.time + (not self.is_policy))
        # A gradient of each part, of its network only.
        self.handed_on = {f"{self.name}_vectors": self.parts * self.size}

    def scratch_sizes(self) -> dict[str, int]:
        shape, stride, lanes, rows = self.shape, self.stride, self.lanes, self.rows
        reads, writes = (
            sum(array.size for array in arrays) * self.loss_lanes
            for arrays in (self.loss_program.inputs, self.loss_program.outputs)
        )
        sizes = {f"turned{i}": shape.width * stride for i in range(1, shape.layers)}
        sizes["turned_head"] = self.outputs * stride
        sizes |= {f"slopes{i}": rows * stride for i in range(1, shape.layers + 1)}
        sizes |= dict.fromkeys(("deltas0", "deltas1"), rows * stride)
        sizes |= {"errors": rows * HEAD, "head_sums": (shape.width + 1) * HEAD}
        sizes |= {"tail_sums": self.tail_sums * lanes, "statistics": lanes}
        return super().scratch_sizes() | sizes | {"loss": reads, "results": writes}

    def own_functions(self) -> list[LlvmWriter]:
        scalar = vector_of()
        activation = functools.partial(sample_loss.activation, self.shape.activation)
        activated, both = scalarize(activation, scalar), (0, 1)
        product = scalarize(lambda one, other: one * other, scalar, scalar)
        return [
            self.on_layers("activate", activated, (0,), both),
            self.on_layers("scale_by_slopes", product, both, (0,)),
            sample_function(f"{self.name}_loss", self.loss_program, self.loss_lanes),
        ]

    @abc.abstractmethod
    def add_losses(self, first: Value, count: Value) -> None:
        """Write the errors of a tile, and add to the sums."""

    def load_terms(self) -> LossTerms[Value]:
        """Return the coefficients of the loss."""
        return LossTerms(*(self.arrays["terms"][i] for i in range(len(LossTerms._fields))))

    def row_of(self, unroll: Value, step: Value) -> Value:
        """Return the address of the collected row of a step."""
        # The minibatch's unrolls are some of the collected ones.
        collected_step = self.collected(unroll) * self.batch.time + step
        return self.arrays["rows"] + collected_step * self.shape.columns["size"]

    def collected(self, unroll: Value) -> Value:
        """Return the index of an unroll of the minibatch among the collected ones."""
        return integer_at(self.arrays["unroll_indices"] + unroll)

    def begin_part(self) -> None:
        super().begin_part()
        shape, places = self.shape, self.places
        self.vector = self.arrays[f"{self.name}_vectors"] + self.part.number * self.size
        # Find the unrolls and the noise of the minibatch.
        noise = self.batch.samples * shape.actions
        for name, size in (("unroll_indices", self.batch.unrolls), ("noise", noise)):
            self.arrays[name] += self.part.minibatch * size
        # Transpose the weights for the backward pass, and set all sums to zero.
        for i, inputs, start in shape.hidden_layers:
            source = self.params + start
            fill(self.vector + start, (inputs + 1) * shape.width)
            if i:
                self._transpose(source, places[f"turned{i}"], inputs, shape.width)
        source = self.params + shape.head_start
        self._transpose(source, places["turned_head"], shape.width, self.outputs)
        for name in ("errors", "head_sums", "tail_sums"):
            fill(places[name], self.scratch_sizes()[name])

    def _transpose(self, source: Value, target: Value, rows: int, columns: int) -> None:
        """Copy a matrix of weights transposed."""
        w, stride, lanes = self.w, self.stride, self.w.lanes
        # Whole squares in registers, and single numbers if there is none.
        side = lanes if rows % lanes == columns % lanes == 0 else 1
        with w.loop(rows // side) as i, w.loop(columns // side) as j:
            row, column = i * side, j * side
            first = source + row * columns + column
            to = target + column * stride + row
            kind = w.vector if side > 1 else "float"
            square = [(first + k * columns).load(kind) for k in range(side)]
            for k, turned in enumerate(transposed(square)):
                (to + k * stride).store(turned)

    def tile(self, first: Value, count: Value) -> None:
        """Add the gradient of some unrolls, from the given one on."""
        w, shape, places = self.w, self.shape, self.places
        rows = count * self.steps
        stored = self.stored_rows(rows)
        # Forward.
        with w.loop(count) as i:
            unroll = first + i
            with w.loop(self.steps) as step:
                row = i * self.steps + step
                self.load_observation(self.observation(unroll, step), row)
        self.forward(stored)
        # The loss, and the errors: its derivatives dL/dy with respect to the outputs.
        self.add_losses(first, count)
        # Backward: the gradient of the head's weights and biases, [activations, 1]ᵀ @ dL/dy.
        width, stride, activations = shape.width, self.stride, self.activations
        errors, sums = Matrix(places["errors"], HEAD), Matrix(places["head_sums"], HEAD)
        matmul(activations[-1].transposed, errors, sums, (width + 1, HEAD, rows), adds=True)
        following, turned, length = errors, "turned_head", self.outputs
        for i, inputs, start in reversed(shape.hidden_layers):
            # dL/dz of this layer = (dL/dz of the next, or dL/dy, @ Wᵀ) · slopes; two buffers take
            # turns.
            deltas = Matrix(places[f"deltas{i % 2}"], stride)
            matmul(following, Matrix(places[turned], stride), deltas, (stored, width, length))
            w.call("scale_by_slopes", deltas.start, places[f"slopes{i + 1}"], stored)
            # The gradient of its weights and biases: [inputs, 1]ᵀ @ dL/dz.
            gradient = Matrix(self.vector + start, width)
            sizes = inputs + 1, width, rows
            matmul(activations[i].transposed, deltas, gradient, sizes, adds=True)
            # Layer 0 is the last, so there are no transposed weights of it.
            following, turned, length = deltas, f"turned{i}", width

    def observation(self, unroll: Value, step: Value) -> Value:
        """Return the address of the observation of a step."""
        return self.row_of(unroll, step)

    def end_part(self) -> None:
        # Copy the sums of the head and of the samples to the part's vector.
        w, shape, outputs = self.w, self.shape, self.outputs
        with w.loop(shape.width + 1) as row, w.loop(outputs) as j:
            value = (self.places["head_sums"] + row * HEAD)[j]
            (self.vector + shape.head_start + row * outputs)[j] = value
        with w.loop(self.tail_sums) as i:
            target = self.vector + (shape.head_start + (shape.width + 1) * outputs) + i
            target.store(0.0)
            add_all(self.places["tail_sums"] + i * w.lanes, w.lanes, target)


class _ValueStage(_GradientStage):
    """Values, advantages, and the gradient of the value network."""

    name = "values"
    is_policy = False

    def __init__(self, shape: UpdateShape, batch: DataSizes, lanes: int) -> None:
        self.tail_sums, self.size = len(VALUE_METRICS), shape.size - shape.policy_size
        self.loss_program, self.loss_lanes = sample_loss.value_step_program(batch.samples), 1
        super().__init__(shape, batch, lanes)
        self.handed_on = {**self.handed_on, "advantages": batch.samples}

    def observation(self, unroll: Value, step: Value) -> Value:
        # The row behind the steps has the observation after them. An address beyond the array is
        # computed, but not read from.
        is_step = step < self.batch.time
        last = self.arrays["last"] + self.collected(unroll) * self.shape.observations
        return self.w.select(is_step, self.row_of(unroll, step), last)

    def add_losses(self, first: Value, count: Value) -> None:
        """Run backwards through each unroll of the tile."""
        w, columns, time, places = self.w, self.shape.columns, self.batch.time, self.places
        reads, writes = places["loss"], places["results"]
        outputs, errors = places["outputs"], places["errors"]
        # What `value_step` reads: the step, target and estimate after it, and the coefficients.
        following = ValueStep._fields.index("next_value")
        for place, term in enumerate(self.load_terms(), start=following + 3):
            reads[place] = term
        with w.loop(count) as i:
            # Begin behind the last step, with the value of its observation.
            start = i * (time + 1)
            after = (start + time) * HEAD
            last = outputs[after]
            errors[after] = 0.0
            for place, value in enumerate((last, last, 0.0), start=following):
                reads[place] = value
            unroll = first + i
            with w.loop(time) as done:
                step = time - 1 - done
                row = (start + step) * HEAD
                source = self.row_of(unroll, step)
                reads.store(outputs[row])
                for place, name in enumerate(("reward", "discount", "truncation"), start=1):
                    reads[place] = source[columns[name]]
                w.call("values_loss", reads, writes)
                # Store the advantage and the error, and add up the squared distance to the target.
                self.arrays["advantages"][unroll * time + step] = writes[0]
                errors[row] = writes[1]
                add_to(places["tail_sums"], writes[2])
                # The value, the target and the estimate are those after the step before.
                for place in range(3):
                    reads[following + place] = writes[3 + place]


class _PolicyStage(_GradientStage):
    """The gradient of the policy network."""

    name = "policy"

    def __init__(self, shape: UpdateShape, batch: DataSizes, lanes: int) -> None:
        self.tail_sums, self.size = shape.slots - shape.outputs[0], shape.policy_size
        self.loss_program = sample_loss.policy_program(shape, batch.samples)
        self.loss_lanes = lanes
        super().__init__(shape, batch, lanes)

    def begin_part(self) -> None:
        super().begin_part()
        if self.shape.normalizes:
            # The mean of all advantages and 1 / (std + 1e-8). Every part computes them, in one
            # order: so none waits for another.
            self.mean = self._mean_advantage(None)
            variance = self._mean_advantage(self.mean)
            self.inverse_std = 1.0 / (self.w.intrinsic("sqrt", variance) + 1e-8)

    def _mean_advantage(self, centre: Value | None) -> Value:
        """Return the mean of the advantages, or of their squared distances from a centre."""
        w, samples, lanes = self.w, self.batch.samples, self.lanes
        total = self.places["statistics"]
        # A sum for each lane, and then one of all lanes.
        fill(total, lanes)
        for kind, loop in vector_loops(w.constant(0, "u64"), w.constant(samples, "u64")):
            with loop as place:
                value = (self.arrays["advantages"] + place).load(kind)
                if centre is not None:
                    distance = value - (centre if kind == "float" else centre.splat(lanes))
                    value = distance * distance
                add_to(total, value)
        add_all(total + 1, lanes - 1, total)
        return total[0] * (1 / samples)

    def add_losses(self, first: Value, count: Value) -> None:
        """Compute the losses of as many samples at once as a vector has lanes."""
        w, lanes, places = self.w, self.lanes, self.places
        rows, results = count * self.batch.time, places["results"]
        with self.groups(rows) as start:
            # Collect what the loss reads, sample by sample.
            with w.loop(lanes) as lane:
                self._load_sample(lane, start + lane, rows, first)
            w.call("policy_loss", places["loss"], results)
            # Store the errors, and add up what is behind them: the tail.
            there = w.minimum(rows - start, lanes)
            with w.loop(there) as lane, w.loop(self.outputs) as j:
                source = results + j * lanes + lane
                places["errors"][(start + lane) * HEAD + j] = source.load()
            with w.loop(self.tail_sums) as i:
                place = i * lanes
                value = (results + self.outputs * lanes + place).load(w.vector)
                add_to(places["tail_sums"] + place, value)

    def _load_sample(self, lane: Value, row: Value, rows: Value, first: Value) -> None:
        """Copy what the loss of a sample reads to a lane, in the order of `PolicySample`.

        Args:
          lane: the lane.
          row: the row of the sample.
          rows: the number of rows.
          first: the first unroll.
        """
        w, shape, batch = self.w, self.shape, self.batch
        columns, actions = shape.columns, shape.actions
        # Lanes beyond the last sample repeat it, with a weight of zero.
        weight = w.select(row < rows, w.constant(1.0), 0.0)
        row = w.minimum(row, rows - 1)
        unroll, step = first + row // batch.time, row % batch.time
        outputs = self.places["outputs"] + row * HEAD
        collected = self.row_of(unroll, step)
        noise = self.arrays["noise"] + (step * batch.unrolls + unroll) * actions
        advantage = self.arrays["advantages"][unroll * batch.time + step]
        if shape.normalizes:
            advantage = (advantage - self.mean) * self.inverse_std
        start, stop = columns["raw_action"], columns["reward"]
        sources = [
            (outputs, self.outputs),
            (self.deviations, actions),
            (collected + start, stop - start),
            (noise, actions),
        ]
        # The fields of `PolicySample`, one behind the other, and the coefficients.
        self.gather("loss", lane, sources, [advantage, weight, *self.load_terms()])
