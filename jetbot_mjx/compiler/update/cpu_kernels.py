"""Write the kernels that compute PPO's gradient on CPUs, one for each network.

A kernel divides the minibatch into parts of whole unrolls, which XLA's threads compute. A part goes
through its unrolls tile by tile: forward through all layers, the loss and its derivatives by the
outputs, and backward, where it adds to the part's gradient. Everything is float32. The number of
parts follows from the minibatch alone, so no result depends on the number of threads.

A column of ones beside the activations has the biases as its weights, so that one product computes
a layer with its biases, and another one the gradient of both.
"""

import dataclasses
import functools
import itertools

from jetbot_mjx.compiler import ffi_wrapper
from jetbot_mjx.compiler.llvm_codegen import LlvmEmitter
from jetbot_mjx.compiler.lower_jaxpr import ScalarProgram, scalarize
from jetbot_mjx.compiler.update import sample_loss
from jetbot_mjx.compiler.update.sample_loss import PolicySample, ValueStep, vector_of
from jetbot_mjx.compiler.update.shapes import (
    POLICY_METRICS,
    VALUE_METRICS,
    LossTerms,
    Minibatch,
    UpdateShape,
)
from jetbot_mjx.compiler.update.vector_code import (
    ROWS,
    VectorCode,
    number,
    product_declarations,
    product_text,
)

HEAD = 16
"""Columns of the last layer, of which those beyond its outputs are zero."""

_PAD = 16
"""Numbers between the rows of a matrix, so that they do not share few places of the cache."""

_TILE_ROWS = 64
"""Rows of a tile, at least, if there are as many."""

_PART_SAMPLES = 256
"""Samples of a part, about, if the minibatch has no more than `_MOST_PARTS` times as many."""

_MOST_PARTS = 32

_TERMS = LossTerms(*[vector_of()] * len(LossTerms._fields))


@dataclasses.dataclass(frozen=True)
class Division:
    """A `Division` divides a minibatch among the parts of a kernel."""

    shape: UpdateShape
    batch: Minibatch
    is_policy: bool
    lanes: int
    """Number of float32 values in a vector register."""

    @property
    def unrolls(self) -> int:
        """Return the number of unrolls of a part; the last parts may have fewer."""
        wanted = max(1, round(_PART_SAMPLES / self.batch.time))
        return max(wanted, -(-self.batch.unrolls // _MOST_PARTS))

    @property
    def parts(self) -> int:
        """Return the number of parts."""
        return -(-self.batch.unrolls // self.unrolls)

    @property
    def steps(self) -> int:
        """Return the rows of an unroll: its steps and, of the values, its last observation."""
        return self.batch.time + (not self.is_policy)

    @property
    def tile_unrolls(self) -> int:
        """Return the number of unrolls of a tile."""
        return min(self.unrolls, -(-_TILE_ROWS // self.steps))

    @property
    def rows(self) -> int:
        """Return the number of rows of a tile that are stored."""
        return _rounded(self.tile_unrolls * self.steps, ROWS)

    @property
    def outputs(self) -> int:
        """Return the number of outputs of the network."""
        return self.shape.outputs[not self.is_policy]

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
    def stride(self) -> int:
        """Return the stride of the rows of a layer."""
        return self.shape.width + _PAD

    @property
    def first_stride(self) -> int:
        """Return the stride of the rows of the observations."""
        return _rounded(self.shape.observations + 1, _PAD)

    @property
    def reads(self) -> int:
        """Return how many numbers the loss of a sample reads."""
        return 6 * self.shape.actions + self.outputs + 3 + len(LossTerms._fields)

    @functools.cached_property
    def layout(self) -> dict[str, int]:
        """Return where each array begins in a part's scratch memory, and its `size`, in floats."""
        shape, stride = self.shape, self.stride
        sizes = {f"weights{i}": (n + 1) * stride for i, n in enumerate(shape.inputs[:-1])}
        sizes |= {f"turned{i}": shape.width * stride for i in range(1, shape.layers)}
        sizes |= {"head": (shape.width + 1) * HEAD, "turned_head": self.outputs * stride}
        sizes["layer0"] = self.rows * self.first_stride
        for i in range(1, shape.layers + 1):
            sizes |= {f"layer{i}": self.rows * stride, f"slopes{i}": self.rows * stride}
        sizes |= dict.fromkeys(("deltas0", "deltas1"), self.rows * stride)
        sizes |= dict.fromkeys(("outputs", "errors"), self.rows * HEAD)
        sizes["head_sums"] = (shape.width + 1) * HEAD
        sizes |= {"sums": self.slots * self.lanes, "statistics": self.lanes}
        sizes |= {"loss": self.reads * self.lanes}
        sizes |= {"results": (HEAD + self.slots) * self.lanes}
        padded = [_rounded(size, _PAD) for size in sizes.values()]
        starts = list(itertools.accumulate(padded, initial=0))
        return {**dict(zip(sizes, starts, strict=False)), "size": starts[-1]}


def kernel_text(division: Division, *, registers: int, name: str, machine: str) -> str:
    """Write the LLVM module of a kernel, whose function XLA calls.

    The values' kernel takes the parameters of both networks, mean and 1 / std of the observations,
    the collected rows, the unrolls of the minibatch, the `LossTerms` and the last observations,
    each with the policies as the first axis. It returns the gradient of each part and the
    advantages. The policy's kernel takes noise, of shape (time, unrolls, action), and advantages
    instead of the last observations, and returns no advantages.

    Args:
      division: the division of the minibatch.
      registers: the number of vector registers.
      name: the name of the function.
      machine: the processor, one of `ffi_wrapper.MACHINES`.
    """
    kernel = (_PolicyKernel if division.is_policy else _ValueKernel)(division)
    lanes = division.lanes
    functions = [*kernel.functions(), product_text(lanes, registers), kernel.block()]
    lines = [product_declarations(lanes), "declare float @llvm.sqrt.f32(float)"]
    lines += [line for program in kernel.programs for line in program.declarations()]
    return ffi_wrapper.call_text(
        "\n".join([*dict.fromkeys(lines), *functions]),
        arguments=len(kernel.arguments),
        results=len(kernel.results),
        blocks_per_robot=division.parts,
        blocks_per_thread=1,
        scratch=4 * division.layout["size"],
        name=name,
        machine=machine,
    )


class _Kernel:
    """A `_Kernel` writes what both kernels share."""

    arguments: tuple[str, ...]
    results: tuple[str, ...]

    def __init__(self, division: Division) -> None:
        self.division, self.shape, self.batch = division, division.shape, division.batch
        self.programs: list[LlvmEmitter] = []
        self.code = VectorCode(division.lanes)

    def functions(self) -> list[str]:
        """Return the texts of the functions that `block` calls."""
        scalar = vector_of()
        activation = functools.partial(sample_loss.activation, self.shape.activation)
        return [
            self._on_layers(
                "activate", scalarize(activation, scalar), ["%one"], ["%one", "%other"]
            ),
            self._on_layers(
                "multiply",
                scalarize(lambda one, other: one * other, scalar, scalar),
                ["%one", "%other"],
                ["%one"],
            ),
            self.loss_function(),
        ]

    def loss_function(self) -> str:
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
        code = self.code
        return code.let(
            f"sext i32 {code.load(code.at(self.arrays['unrolls'], unroll), 'i32')} to i64"
        )

    def _on_layers(
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

    def _on_sample(self, name: str, program: ScalarProgram, lanes: int) -> str:
        """Write a function that applies a program to the rows of one array, into another."""
        code = VectorCode(lanes)
        self.programs.append(LlvmEmitter(program, lanes))
        count = sum(array.size for array in program.inputs)
        arguments = [code.load(code.at("%reads", i * lanes), code.vector) for i in range(count)]
        for i, result in enumerate(code.run(program, arguments)):
            code.store(result, code.at("%writes", i * lanes), code.vector)
        return code.function(name, ["ptr noalias %reads", "ptr noalias %writes"])

    def block(self) -> str:
        """Write the function that computes one part of one policy."""
        code, division, batch = self.code, self.division, self.batch
        policy = code.let(f"udiv i64 %index, {division.parts}")
        part = code.sub("%index", code.mul(policy, division.parts))
        sizes = self._sizes()
        self.arrays = {}
        for i, name in enumerate((*self.arguments, *self.results)):
            code.do(ffi_wrapper.address(i))
            of = "%index" if name == "vectors" else policy
            self.arrays[name] = code.at(f"%a{i}", code.mul(of, sizes[name]))
        start = 0 if division.is_policy else self.shape.policy_size
        self.params = code.at(self.arrays["params"], start)
        self.places = {
            name: code.at("%scratch", place)
            for name, place in division.layout.items()
            if name != "size"
        }
        self._begin()
        # Take the part's unrolls tile by tile.
        first = code.mul(part, division.unrolls)
        there = code.smaller(code.sub(batch.unrolls, first), division.unrolls)
        per_tile = division.tile_unrolls
        tiles = code.let(f"sdiv i64 {code.add(there, per_tile - 1)}, {per_tile}")
        with code.loop(tiles) as tile:
            done = code.mul(tile, per_tile)
            count = code.smaller(code.sub(there, done), per_tile)
            self._tile(code.add(first, done), count)
        self._end()
        return code.function("block", ["ptr %job", "i64 %index", "ptr %scratch"])

    def _sizes(self) -> dict[str, int]:
        """Return the number of floats of one policy, or of one part, in each array."""
        shape, batch = self.shape, self.batch
        return {
            "params": shape.size,
            "mean": shape.observations,
            "scale": shape.observations,
            "rows": batch.collected * batch.time * shape.columns["size"],
            "unrolls": batch.unrolls,
            "terms": len(LossTerms._fields),
            "last": batch.collected * shape.observations,
            "noise": batch.samples * shape.actions,
            "advantages": batch.samples,
            "vectors": self.division.size,
        }

    def _hidden(self) -> list[tuple[int, int, int]]:
        """Return number, inputs and first parameter of each hidden layer."""
        sizes = [(n + 1) * self.shape.width for n in self.shape.inputs[:-1]]
        starts = itertools.accumulate(sizes, initial=0)
        return [
            (i, n, start)
            for i, (n, start) in enumerate(zip(self.shape.inputs[:-1], starts, strict=False))
        ]

    def _begin(self) -> None:
        """Arrange the weights, and set to zero what is added to."""
        code, shape, division, places = self.code, self.shape, self.division, self.places
        width, stride, lanes = shape.width, division.stride, code.lanes
        for i, inputs, start in self._hidden():
            source = code.at(self.params, start)
            with code.loop(inputs + 1) as row, code.loop(width // lanes) as j:
                place = code.add(code.mul(row, width), code.mul(j, lanes))
                target = code.add(code.mul(row, stride), code.mul(j, lanes))
                code.copy(
                    code.at(source, place), code.at(places[f"weights{i}"], target), code.vector
                )
                to = code.at(self.arrays["vectors"], start, place)
                code.store("zeroinitializer", to, code.vector)
            if i:
                self._turn(source, places[f"turned{i}"], inputs, width)
        for name, count in (
            ("head", (width + 1) * HEAD),
            ("layer0", division.rows * division.first_stride),
            ("errors", division.rows * HEAD),
            ("head_sums", (width + 1) * HEAD),
            ("sums", division.slots * lanes),
        ):
            code.fill(places[name], count)
        source, outputs = code.at(self.params, shape.hidden), division.outputs
        with code.loop(width + 1) as row, code.loop(outputs) as j:
            place = code.add(code.mul(row, outputs), j)
            target = code.add(code.mul(row, HEAD), j)
            code.copy(code.at(source, place), code.at(places["head"], target))
        self._turn(source, places["turned_head"], width, outputs)
        with code.loop(division.rows) as row:
            one = number(1.0)
            at = code.at(places["layer0"], code.mul(row, division.first_stride))
            code.store(one, code.at(at, shape.observations))
            for i in range(1, shape.layers + 1):
                at = code.at(places[f"layer{i}"], code.mul(row, stride))
                code.store(one, code.at(at, width))

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

    def _tile(self, first: str, count: str) -> None:
        """Add the gradient of some unrolls, from the given one on."""
        code, shape, division, places = self.code, self.shape, self.division, self.places
        rows = code.mul(count, division.steps)
        stored = code.mul(code.let(f"udiv i64 {code.add(rows, ROWS - 1)}, {ROWS}"), ROWS)
        with code.loop(count) as i:
            unroll = code.add(first, i)
            with code.loop(division.steps) as step:
                row = code.add(code.mul(i, division.steps), step)
                self._load_observation(unroll, step, row)
        # Forward.
        width, stride = shape.width, division.stride
        strides = [division.first_stride, *[stride] * shape.layers]
        layers = [places[f"layer{i}"] for i in range(shape.layers + 1)]
        slopes = [places.get(f"slopes{i}", "") for i in range(shape.layers + 1)]
        for i, inputs, _ in self._hidden():
            code.product(
                (layers[i], strides[i], 1),
                (places[f"weights{i}"], stride),
                (layers[i + 1], stride),
                (stored, width, inputs + 1),
            )
            code.call("activate", f"ptr {layers[i + 1]}", f"ptr {slopes[i + 1]}", f"i64 {stored}")
        outputs, errors = (places["outputs"], HEAD), (places["errors"], HEAD)
        code.product(
            (layers[-1], stride, 1), (places["head"], HEAD), outputs, (stored, HEAD, width + 1)
        )
        self.add_losses(first, count)
        # Backward.
        code.product(
            (layers[-1], 1, stride),
            errors,
            (places["head_sums"], HEAD),
            (width + 1, HEAD, rows),
            adds=True,
        )
        left, right, length = (*errors, 1), places["turned_head"], division.outputs
        for i, inputs, start in reversed(self._hidden()):
            deltas = places[f"deltas{i % 2}"]
            code.product(left, (right, stride), (deltas, stride), (stored, width, length))
            code.call("multiply", f"ptr {deltas}", f"ptr {slopes[i + 1]}", f"i64 {stored}")
            code.product(
                (layers[i], 1, strides[i]),
                (deltas, stride),
                (code.at(self.arrays["vectors"], start), width),
                (inputs + 1, width, rows),
                adds=True,
            )
            left, right, length = (deltas, stride, 1), places.get(f"turned{i}", ""), width

    def _load_observation(self, unroll: str, step: str, row: str) -> None:
        """Copy a normalised observation to a row of the tile."""
        code, division, size = self.code, self.division, self.shape.observations
        source = self.row_of(unroll, step)
        if not division.is_policy:
            # The row behind the steps has the observation after them.
            is_step = code.let(f"icmp slt i64 {step}, {self.batch.time}")
            collected = self.collected(unroll)
            last = code.at(self.arrays["last"], code.mul(collected, size))
            # An address beyond the array is computed, but not read from.
            source = code.select(is_step, "ptr", source, f"{last}")
        target = code.at(self.places["layer0"], code.mul(row, division.first_stride))
        with code.loop(size) as i:
            value, mean, scale = (
                code.load(code.at(array, i))
                for array in (source, self.arrays["mean"], self.arrays["scale"])
            )
            centred = code.arithmetic("fsub", value, mean)
            code.store(code.arithmetic("fmul", centred, scale), code.at(target, i))

    def _end(self) -> None:
        """Copy the sums of the head and of the samples to the part's vector."""
        code, shape, division = self.code, self.shape, self.division
        outputs, vector = division.outputs, self.arrays["vectors"]
        with code.loop(shape.width + 1) as row, code.loop(outputs) as j:
            source = code.at(self.places["head_sums"], code.mul(row, HEAD), j)
            code.copy(source, code.at(vector, shape.hidden, code.mul(row, outputs), j))
        with code.loop(division.slots) as slot:
            target = code.at(vector, shape.hidden + (shape.width + 1) * outputs, slot)
            code.store(number(0.0), target)
            with code.loop(code.lanes) as lane:
                source = code.at(self.places["sums"], code.mul(slot, code.lanes), lane)
                self.accumulate(target, code.load(source))

    def accumulate(self, target: str, value: str, kind: str = "float") -> None:
        """Add a value to one in memory."""
        code = self.code
        code.store(code.arithmetic("fadd", code.load(target, kind), value, kind), target, kind)


class _ValueKernel(_Kernel):
    """Values, advantages, and the gradient of the value network."""

    arguments = ("params", "mean", "scale", "rows", "unrolls", "terms", "last")
    results = ("vectors", "advantages")

    def loss_function(self) -> str:
        program = scalarize(
            functools.partial(sample_loss.value_step, samples=self.batch.samples),
            ValueStep(*[vector_of()] * len(ValueStep._fields)),
            _TERMS,
        )
        return self._on_sample("loss", program, 1)

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
                code.call("loss", f"ptr {reads}", f"ptr {writes}")
                sample = code.add(code.mul(unroll, time), step)
                code.copy(writes, code.at(self.arrays["advantages"], sample))
                code.copy(code.at(writes, 1), code.at(places["errors"], row))
                self.accumulate(places["sums"], code.load(code.at(writes, 2)))
                for place in range(3):
                    code.copy(code.at(writes, 3 + place), code.at(reads, 4 + place))


class _PolicyKernel(_Kernel):
    """The gradient of the policy network."""

    arguments = ("params", "mean", "scale", "rows", "unrolls", "terms", "noise", "advantages")
    results = ("vectors",)

    def loss_function(self) -> str:
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
        return self._on_sample("loss", scalarize(loss, sample, _TERMS), self.division.lanes)

    def _begin(self) -> None:
        super()._begin()
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
                centres = centre if kind == "float" else self._splat(centre)
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

    def _splat(self, value: str) -> str:
        code = self.code
        first = code.let(f"insertelement {code.vector} poison, float {value}, i64 0")
        mask = f"<{code.lanes} x i32> zeroinitializer"
        return code.let(f"shufflevector {code.vector} {first}, {code.vector} poison, {mask}")

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
            code.call("loss", f"ptr {places['loss']}", f"ptr {results}")
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


def _rounded(size: int, multiple: int) -> int:
    return -(-size // multiple) * multiple
