"""Write the kernel that makes a step of Adam on GPUs.

Each block adds up the squares of the whole gradient, in the same order as all other blocks, and
then updates its own elements: so no block waits for another one.
"""

from jetbot_mjx.agents.fused import adam
from jetbot_mjx.agents.fused.adam import SIZES, AdamRule, Factors
from jetbot_mjx.agents.fused.arrays import ADAM
from jetbot_mjx.agents.fused.shapes import Minibatch
from jetbot_mjx.agents.fused.tensor_core import LANES, GpuKernel, Value

_THREADS = 1024
"""Threads of a block."""

BLOCK_ELEMENTS = 2 * _THREADS
"""Elements of the vectors that a block updates, if the GPU has enough multiprocessors."""

_EARLY = 4
"""Elements that a thread fetches before the threads wait for each other."""

_SUMS = 4
"""Sums of squares of a thread, so that no addition waits for the one before."""


class AdamKernel(GpuKernel):
    """An `AdamKernel` takes the arrays of `arrays.ADAM`, and changes those that it returns."""

    name, arguments, returns = "ppo_adam", ADAM.arguments, tuple(ADAM.returns)

    def __init__(self, rule: AdamRule, blocks: int) -> None:
        """Prepare to write.

        Args:
          rule: what the vectors hold.
          blocks: the number of blocks of a policy.
        """
        # In shared memory, floats: a sum of squares of each thread, and then one of each lane.
        shared_memory = 4 * (_THREADS + LANES)
        super().__init__(ADAM.shapes(rule, Minibatch()), blocks, _THREADS, shared_memory)
        self.rule = rule

    def text(self) -> str:
        """Return the module."""
        ir, rule = self.ir, self.rule
        self.thread, self.block = ir.register("tid.x"), ir.register("ctaid.x")
        self.find_arrays(ir.register("ctaid.z"))
        gradient, index = self.arrays["gradient"], self.arrays["index"].load("u32")
        before = ir.row(self.arrays["progress"], index, SIZES["progress"])
        # Begin to load everything before the threads wait for each other.
        given = [gradient[place] for place in rule.places]
        for name, array in (("progress", before), ("adam_terms", self.arrays["adam_terms"])):
            given += [array[i] for i in range(SIZES[name])]
        places = self._places()
        early = [self._fetch(place) for place in places[:_EARLY]]
        # The norm of the gradient, and what follows from it for all elements.
        square = self._sum(self._squares(gradient))
        factors, element = adam.programs(rule)
        results = ir.run(factors, [square, *given])
        common, progress = results[: len(Factors._fields)], results[len(Factors._fields) :]
        # Update the elements of the thread.
        for i, place in enumerate(places):
            values = early[i] if i < _EARLY else self._fetch(place)
            updated = ir.run(element, [*values, *common])
            with ir.when(self._is_parameter(place)):
                for name, value in zip(self.returns, updated, strict=False):
                    self.arrays[name][place] = value
        # One thread of all writes the row behind that which the other blocks may still read.
        after = before + SIZES["progress"]
        with ir.when((self.block * _THREADS + self.thread).equals(0)):
            for i, value in enumerate(progress):
                after[i] = value
        return ir.module(_THREADS)

    def _places(self) -> list[Value]:
        """Return where the thread's elements are; the last one may be beyond the end."""
        first, stride = self.block * _THREADS + self.thread, self.blocks * _THREADS
        return [first + start for start in range(0, self.rule.shape.size, stride)]

    def _fetch(self, place: Value) -> list[Value]:
        """Fetch what `element` takes of the vectors."""
        kept = self.ir.minimum(place, self.rule.shape.size - 1)
        return [self.arrays[name][kept] for name in ("params", "mu", "nu", "gradient")]

    def _is_parameter(self, place: Value) -> Value:
        """Return whether an element is a parameter: metrics are behind those of each network."""
        ir, ((_, stop), (first, end)) = self.ir, self.rule.shape.ranges
        # Move those between the networks to the second one's start, and its metrics to the end.
        middle = ir.select(place < stop, first, place)
        return ir.select(middle < first, end, middle) < end

    def _squares(self, gradient: Value) -> list[Value]:
        """Return the thread's sums of squares over the whole gradient."""
        ir, size = self.ir, self.rule.shape.size
        sums = [ir.constant(0.0)] * _SUMS
        for i, start in enumerate(range(0, size, _THREADS)):
            place, stop = self.thread + start, start + _THREADS
            value = gradient[ir.minimum(place, size - 1) if stop > size else place]
            # Metrics are no part of the norm; most rows of threads have none.
            if not any(first <= start and stop <= last for first, last in self.rule.shape.ranges):
                value = ir.select(self._is_parameter(place), value, 0.0)
            sums[i % _SUMS] += value * value
        return sums

    def _sum(self, sums: list[Value]) -> Value:
        """Add up the sums of all threads of the block, in a fixed order, for all of them."""
        ir = self.ir
        total = sum(sums[1:], sums[0])
        ir.shared(self.thread * 4).store(total)
        # The first warp reads the sums of all threads, and then all threads those of its lanes.
        ir.synchronize()
        with ir.when(self.thread < LANES):
            rows = range(0, 4 * _THREADS, 4 * LANES)
            total = ir.total(ir.shared(self.thread * 4, row).load() for row in rows)
            ir.shared(self.thread * 4, 4 * _THREADS).store(total)
        ir.synchronize()
        return ir.total(ir.shared(4 * (_THREADS + i)).load() for i in range(LANES))
