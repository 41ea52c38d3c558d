"""Write the kernels that compute PPO's gradient on CPUs, one for each network.

A kernel divides the minibatch into parts of whole unrolls. A part goes through its unrolls tile by
tile: forward through all layers, the loss and its derivatives by the outputs, and backward, where
it adds to the part's gradient. Since a column of ones stands beside the activations, one product
adds to the gradient of weights and biases.
"""

import dataclasses
import functools

from jetbot_mjx.compiler.lower_jaxpr import scalarize
from jetbot_mjx.compiler.update import sample_loss
from jetbot_mjx.compiler.update.cpu_network import HEAD, MOST_PARTS, Division, NetworkStage
from jetbot_mjx.compiler.update.cpu_stages import Call, Stage, SumStage
from jetbot_mjx.compiler.update.sample_loss import PolicySample, ValueStep, vector_of
from jetbot_mjx.compiler.update.shapes import (
    POLICY_METRICS,
    VALUE_METRICS,
    LossTerms,
    Minibatch,
    UpdateShape,
)
from jetbot_mjx.compiler.update.vector_code import number

_PART_SAMPLES = 256
"""Samples of a part, about, if the minibatch has no more than `MOST_PARTS` times as many."""

_TERMS = LossTerms(*[vector_of()] * len(LossTerms._fields))


@dataclasses.dataclass(frozen=True)
class GradientDivision(Division):
    """A `GradientDivision` divides the unrolls of a minibatch."""

    shape: UpdateShape
    batch: Minibatch
    is_policy: bool
    lanes: int

    @property
    def items(self) -> int:
        """Return the number of unrolls."""
        return self.batch.unrolls

    @property
    def part_items(self) -> int:
        """Return the number of unrolls of a part."""
        wanted = max(1, round(_PART_SAMPLES / self.batch.time))
        return max(wanted, -(-self.batch.unrolls // MOST_PARTS))

    @property
    def steps(self) -> int:
        """Return the rows of an unroll: its steps and, of the values, its last observation."""
        return self.batch.time + (not self.is_policy)

    @property
    def slots(self) -> int:
        """Return the number of sums behind the head's parameters."""
        if self.is_policy:
            return self.shape.deviations + len(POLICY_METRICS)
        return len(VALUE_METRICS)

    @property
    def size(self) -> int:
        """Return the length of the network's part of the vector of parameters."""
        policy = self.shape.policy_size
        return policy if self.is_policy else self.shape.size - policy

    @property
    def reads(self) -> int:
        """Return how many numbers the loss of a sample reads."""
        return 6 * self.shape.actions + self.outputs + 3 + len(LossTerms._fields)

    def extra_sizes(self) -> dict[str, int]:
        """Return the floats of what the backward pass and the loss need."""
        shape, stride, lanes = self.shape, self.stride, self.lanes
        sizes = {f"turned{i}": shape.width * stride for i in range(1, shape.layers)}
        sizes["turned_head"] = self.outputs * stride
        sizes |= {f"slopes{i}": self.rows * stride for i in range(1, shape.layers + 1)}
        sizes |= dict.fromkeys(("deltas0", "deltas1"), self.rows * stride)
        sizes |= {"errors": self.rows * HEAD, "head_sums": (shape.width + 1) * HEAD}
        sizes |= {"sums": self.slots * lanes, "statistics": lanes, "loss": self.reads * lanes}
        return sizes | {"results": (HEAD + self.slots) * lanes}


GRADIENT_ARGUMENTS = (
    *("params", "mean", "scale", "rows", "last"),
    *("unrolls", "noise", "index", "terms"),
)
"""The arrays of `launch.gradient`."""

BETWEEN = ("values_vectors", "policy_vectors", "advantages")
"""The arrays that the stages of a gradient hand on."""


def divisions(
    shape: UpdateShape, batch: Minibatch, lanes: int
) -> tuple[GradientDivision, GradientDivision]:
    """Return how the values' stage and the policy's stage divide a minibatch."""
    return GradientDivision(shape, batch, False, lanes), GradientDivision(shape, batch, True, lanes)


def gradient_stages(shape: UpdateShape, batch: Minibatch, lanes: int) -> list[Stage]:
    """Return the stages that compute the array `gradient`, from values to the sum of all parts.

    Args:
      shape: the networks.
      batch: the minibatch.
      lanes: the number of float32 values in a vector register.
    """
    values, policy = divisions(shape, batch, lanes)
    (begin, end), (values_begin, values_end) = shape.ranges
    ranges = {
        "policy_vectors": (policy.parts, (begin, end, values_begin)),
        "values_vectors": (values.parts, (values_begin, values_end, shape.size)),
    }
    return [_ValueStage(values), _PolicyStage(policy), SumStage(lanes, ranges)]


def gradient_sizes(shape: UpdateShape, batch: Minibatch, lanes: int) -> dict[str, int]:
    """Return the numbers of one policy in each array of these stages."""
    values, policy = divisions(shape, batch, lanes)
    return {
        "params": shape.size,
        "mean": shape.observations,
        "scale": shape.observations,
        "rows": batch.collected * batch.time * shape.columns["size"],
        "last": batch.collected * shape.observations,
        "unrolls": batch.count * batch.unrolls,
        "noise": batch.count * batch.samples * shape.actions,
        "index": 1,
        "terms": len(LossTerms._fields),
        "values_vectors": values.parts * values.size,
        "policy_vectors": policy.parts * policy.size,
        "advantages": batch.samples,
        "gradient": shape.size,
    }


def gradient_call(shape: UpdateShape, batch: Minibatch, lanes: int) -> Call:
    """Return the call of a minibatch's gradient, which takes the arrays of `launch.gradient`.

    Args:
      shape: the networks.
      batch: the minibatch.
      lanes: the number of float32 values in a vector register.
    """
    sizes, results = gradient_sizes(shape, batch, lanes), ("gradient", *BETWEEN)
    stages = gradient_stages(shape, batch, lanes)
    return Call(GRADIENT_ARGUMENTS, results, sizes, stages, minibatches=None)


class _GradientStage(NetworkStage):
    """A `_GradientStage` writes what both networks share."""

    def __init__(self, division: GradientDivision) -> None:
        super().__init__(division)
        self.batch = division.batch

    def functions(self) -> list[str]:
        scalar = vector_of()
        activated, both = scalarize(self.activation(), scalar), ["%one", "%other"]
        scaled = scalarize(lambda one, other: one * other, scalar, scalar)
        return [
            self.on_layers("activate", activated, ["%one"], both),
            self.on_layers("multiply", scaled, both, ["%one"]),
            self.loss_function(f"{self.name}_loss"),
        ]

    def loss_function(self, name: str) -> str:
        raise NotImplementedError

    def add_losses(self, first: str, count: str) -> None:
        raise NotImplementedError

    def load_terms(self) -> list[str]:
        """Return the coefficients of the loss."""
        code, array = self.code, self.arrays["terms"]
        return [code.load(code.at(array, i)) for i in range(len(LossTerms._fields))]

    def row_of(self, unroll: str, step: str) -> str:
        """Return the address of the collected row of a step."""
        code = self.code
        sample = code.add(code.mul(self.collected(unroll), self.batch.time), step)
        return code.at(self.arrays["rows"], code.mul(sample, self.shape.columns["size"]))

    def collected(self, unroll: str) -> str:
        """Return the index of an unroll of the minibatch among the collected ones."""
        return self.code.index(self.code.at(self.arrays["unrolls"], unroll))

    def begin(self) -> None:
        super().begin()
        code, shape, division, places = self.code, self.shape, self.division, self.places
        vectors = self.arrays[f"{self.name}_vectors"]
        self.vector = code.at(vectors, code.mul("%part", division.size))
        for name, size in (
            ("unrolls", self.batch.unrolls),
            ("noise", self.batch.samples * shape.actions),
        ):
            if name in self.arrays:
                self.arrays[name] = code.at(self.arrays[name], code.mul("%minibatch", size))
        for i, inputs, start in self.hidden():
            source = code.at(self.params, start)
            code.fill(code.at(self.vector, start), (inputs + 1) * shape.width)
            if i:
                self._turn(source, places[f"turned{i}"], inputs, shape.width)
        source = code.at(self.params, shape.hidden)
        self._turn(source, places["turned_head"], shape.width, division.outputs)
        for name, count in (
            ("errors", division.rows * HEAD),
            ("head_sums", (shape.width + 1) * HEAD),
            ("sums", division.slots * code.lanes),
        ):
            code.fill(places[name], count)

    def _turn(self, source: str, target: str, rows: int, columns: int) -> None:
        """Transpose a matrix of weights."""
        code, stride, lanes = self.code, self.division.stride, self.code.lanes
        # Whole squares in registers, and single numbers if there is none.
        side = lanes if rows % lanes == columns % lanes == 0 else 1
        with code.loop(rows // side) as i, code.loop(columns // side) as j:
            row, column = code.mul(i, side), code.mul(j, side)
            first = code.at(source, code.mul(row, columns), column)
            to = code.at(target, code.mul(column, stride), row)
            kind = code.vector if side > 1 else "float"
            square = [code.load(code.at(first, k * columns), kind) for k in range(side)]
            for k, turned in enumerate(code.transposed(square)):
                code.store(turned, code.at(to, k * stride), kind)

    def tile(self, first: str, count: str) -> None:
        """Add the gradient of some unrolls, from the given one on."""
        code, shape, division, places = self.code, self.shape, self.division, self.places
        rows = code.mul(count, division.steps)
        stored = self.stored_rows(rows)
        with code.loop(count) as i:
            unroll = code.add(first, i)
            with code.loop(division.steps) as step:
                row = code.add(code.mul(i, division.steps), step)
                self.load_observation(self.observation(unroll, step), row)
        self.forward(stored)
        self.add_losses(first, count)
        # Backward.
        width, stride, layers = shape.width, division.stride, self.layers
        errors, (last, last_stride) = (places["errors"], HEAD), layers[-1]
        sums = places["head_sums"], HEAD
        code.product((last, 1, last_stride), errors, sums, (width + 1, HEAD, rows), adds=True)
        left, right, length = (*errors, 1), places["turned_head"], division.outputs
        for i, inputs, start in reversed(self.hidden()):
            deltas = places[f"deltas{i % 2}"]
            code.product(left, (right, stride), (deltas, stride), (stored, width, length))
            code.call(
                "multiply", f"ptr {deltas}", f"ptr {places[f'slopes{i + 1}']}", f"i64 {stored}"
            )
            layer, layer_stride = layers[i]
            code.product(
                (layer, 1, layer_stride),
                (deltas, stride),
                (code.at(self.vector, start), width),
                (inputs + 1, width, rows),
                adds=True,
            )
            left, right, length = (deltas, stride, 1), places.get(f"turned{i}", ""), width

    def observation(self, unroll: str, step: str) -> str:
        """Return the address of the observation of a step."""
        return self.row_of(unroll, step)

    def end(self) -> None:
        # Copy the sums of the head and of the samples to the part's vector.
        code, shape, division = self.code, self.shape, self.division
        outputs, vector = division.outputs, self.vector
        with code.loop(shape.width + 1) as row, code.loop(outputs) as j:
            source = code.at(self.places["head_sums"], code.mul(row, HEAD), j)
            code.copy(source, code.at(vector, shape.hidden, code.mul(row, outputs), j))
        with code.loop(division.slots) as slot:
            target = code.at(vector, shape.hidden + (shape.width + 1) * outputs, slot)
            code.store(number(0.0), target)
            source = code.at(self.places["sums"], code.mul(slot, code.lanes))
            code.accumulate(source, code.lanes, target)

    def accumulate(self, target: str, value: str, kind: str = "float") -> None:
        """Add a value to one in memory."""
        code = self.code
        code.store(code.arithmetic("fadd", code.load(target, kind), value, kind), target, kind)


class _ValueStage(_GradientStage):
    """Values, advantages, and the gradient of the value network."""

    name = "values"
    arrays_of = (
        *("params", "mean", "scale", "rows", "last", "unrolls", "terms"),
        *("values_vectors", "advantages"),
    )

    def loss_function(self, name: str) -> str:
        program = scalarize(
            functools.partial(sample_loss.value_step, samples=self.batch.samples),
            ValueStep(*[vector_of()] * len(ValueStep._fields)),
            _TERMS,
        )
        return self.on_sample(name, program, 1)

    def observation(self, unroll: str, step: str) -> str:
        # The row behind the steps has the observation after them. An address beyond the array is
        # computed, but not read from.
        code = self.code
        is_step = code.let(f"icmp slt i64 {step}, {self.batch.time}")
        place = code.mul(self.collected(unroll), self.shape.observations)
        last = code.at(self.arrays["last"], place)
        return code.select(is_step, "ptr", self.row_of(unroll, step), last)

    def add_losses(self, first: str, count: str) -> None:
        """Run backwards through each unroll of the tile."""
        code, shape, time, places = self.code, self.shape, self.batch.time, self.places
        reads, writes = places["loss"], places["results"]
        for place, term in enumerate(self.load_terms(), start=len(ValueStep._fields)):
            code.store(term, code.at(reads, place))
        with code.loop(count) as i:
            start = code.mul(i, time + 1)
            last = code.load(code.at(places["outputs"], code.mul(code.add(start, time), HEAD)))
            code.store(
                number(0.0), code.at(places["errors"], code.mul(code.add(start, time), HEAD))
            )
            for place, value in enumerate((last, last, number(0.0)), start=4):
                code.store(value, code.at(reads, place))
            unroll = code.add(first, i)
            with code.loop(time, down=True) as step:
                row = code.mul(code.add(start, step), HEAD)
                source = self.row_of(unroll, step)
                code.copy(code.at(places["outputs"], row), reads)
                for place, name in enumerate(("reward", "discount", "truncation"), start=1):
                    code.copy(code.at(source, shape.columns[name]), code.at(reads, place))
                code.call("values_loss", f"ptr {reads}", f"ptr {writes}")
                sample = code.add(code.mul(unroll, time), step)
                code.copy(writes, code.at(self.arrays["advantages"], sample))
                code.copy(code.at(writes, 1), code.at(places["errors"], row))
                self.accumulate(places["sums"], code.load(code.at(writes, 2)))
                for place in range(3):
                    code.copy(code.at(writes, 3 + place), code.at(reads, 4 + place))


class _PolicyStage(_GradientStage):
    """The gradient of the policy network."""

    name = "policy"
    arrays_of = (
        *("params", "mean", "scale", "rows", "unrolls", "noise", "terms"),
        *("policy_vectors", "advantages"),
    )

    def loss_function(self, name: str) -> str:
        actions = self.shape.actions
        sample = PolicySample(
            outputs=vector_of(self.division.outputs),
            deviations=vector_of(actions),
            action=vector_of(actions),
            log_prob=vector_of(),
            old=vector_of(2 * actions),
            noise=vector_of(actions),
            advantage=vector_of(),
            weight=vector_of(),
        )
        loss = functools.partial(
            sample_loss.policy_sample,
            samples=self.batch.samples,
            tanh=self.shape.distribution == "tanh_normal",
        )
        return self.on_sample(name, scalarize(loss, sample, _TERMS), self.division.lanes)

    def begin(self) -> None:
        super().begin()
        if self.shape.normalizes:
            self._load_statistics()

    def _load_statistics(self) -> None:
        """Compute the mean of all advantages and 1 / (std + 1e-8)."""
        code = self.code
        self.mean = self._mean_advantage(None)
        variance = self._mean_advantage(self.mean)
        deviation = code.let(f"call float @llvm.sqrt.f32(float {variance})")
        deviation = code.arithmetic("fadd", deviation, number(1e-8))
        self.scale = code.arithmetic("fdiv", number(1.0), deviation)

    def _mean_advantage(self, centre: str | None) -> str:
        """Return the mean of the advantages, or of their squared distances from a centre."""
        code, samples, lanes = self.code, self.batch.samples, self.code.lanes
        total = self.places["statistics"]
        code.fill(total, lanes)

        def add(place: str, kind: str) -> None:
            value = code.load(code.at(self.arrays["advantages"], place), kind)
            if centre is not None:
                centres = centre if kind == "float" else code.splat(centre)
                value = code.arithmetic("fsub", value, centres, kind)
                value = code.arithmetic("fmul", value, value, kind)
            self.accumulate(total, value, kind)

        whole = samples // lanes
        with code.loop(whole) as i:
            add(code.mul(i, lanes), code.vector)
        with code.loop(samples % lanes) as i:
            add(code.add(i, whole * lanes), "float")
        with code.loop(lanes - 1) as i:
            self.accumulate(total, code.load(code.at(total, code.add(i, 1))))
        return code.arithmetic("fmul", code.load(total), number(1 / samples))

    def add_losses(self, first: str, count: str) -> None:
        """Compute the losses of as many samples at once as a vector has lanes."""
        code, time, places = self.code, self.batch.time, self.places
        division, lanes = self.division, code.lanes
        rows = code.mul(count, time)
        groups = code.let(f"udiv i64 {code.add(rows, lanes - 1)}, {lanes}")
        results = places["results"]
        with code.loop(groups) as group:
            start = code.mul(group, lanes)
            there = code.smaller(code.sub(rows, start), lanes)
            with code.loop(lanes) as lane:
                # Lanes beyond the last sample repeat it, with a weight of zero.
                is_there = code.let(f"icmp slt i64 {lane}, {there}")
                row = code.smaller(code.add(start, lane), code.sub(rows, 1))
                within = code.let(f"udiv i64 {row}, {time}")
                step = code.sub(row, code.mul(within, time))
                self._load_sample(code.add(first, within), step, row, is_there, lane)
            code.call("policy_loss", f"ptr {places['loss']}", f"ptr {results}")
            with code.loop(there) as lane, code.loop(division.outputs) as j:
                source = code.at(results, code.mul(j, lanes), lane)
                row = code.mul(code.add(start, lane), HEAD)
                code.copy(source, code.at(places["errors"], row, j))
            # Behind the derivatives by the outputs are the sums.
            with code.loop(division.slots) as slot:
                place = code.mul(slot, lanes)
                source = code.at(results, division.outputs * lanes, place)
                value = code.load(source, code.vector)
                self.accumulate(code.at(places["sums"], place), value, code.vector)

    def _load_sample(self, unroll: str, step: str, row: str, is_there: str, lane: str) -> None:
        """Copy what the loss of a sample reads to a lane, in the order of `PolicySample`."""
        code, shape, batch = self.code, self.shape, self.batch
        columns, actions = shape.columns, shape.actions
        outputs = code.at(self.places["outputs"], code.mul(row, HEAD))
        collected = self.row_of(unroll, step)
        deviations = code.at(self.params, shape.hidden + (shape.width + 1) * self.division.outputs)
        noise = code.add(code.mul(step, batch.unrolls), unroll)
        noise = code.at(self.arrays["noise"], code.mul(noise, actions))
        sample = code.add(code.mul(unroll, batch.time), step)
        advantage = code.load(code.at(self.arrays["advantages"], sample))
        if self.shape.normalizes:
            advantage = code.arithmetic("fsub", advantage, self.mean)
            advantage = code.arithmetic("fmul", advantage, self.scale)
        sources = [(outputs, self.division.outputs)]
        if shape.deviations:
            sources.append((deviations, actions))
        else:
            sources.append((outputs, actions))
        first = columns["raw_action"]
        sources.append((code.at(collected, first), columns["reward"] - first))
        sources.append((noise, actions))
        values = [code.load(code.at(source, i)) for source, count in sources for i in range(count)]
        values += [advantage, code.select(is_there, "float", number(1.0), number(0.0))]
        values += self.load_terms()
        target = code.at(self.places["loss"], lane)
        for i, value in enumerate(values):
            code.store(value, code.at(target, i * code.lanes))
