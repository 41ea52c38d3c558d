"""Write the kernel that makes a step of Adam on GPUs.

Each block adds up the squares of the whole gradient, in the same order as all other blocks, and
then updates its own elements: so no block waits for another one.
"""

from jetbot_mjx.agents.fused import adam
from jetbot_mjx.agents.fused.adam import SIZES, AdamRule, Factors
from jetbot_mjx.agents.fused.arrays import ADAM
from jetbot_mjx.agents.fused.shapes import DataSizes
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
          blocks: the number of blocks of a replica.
        """
        # In shared memory, floats: a sum of squares of each thread, and then one of each lane.
        shared_memory = 4 * (_THREADS + LANES)
        super().__init__(ADAM.shapes(rule, DataSizes()), blocks, _THREADS, shared_memory)
        self.rule = rule

    def text(self) -> str:
        """Return the module."""
        w, rule = self.w, self.rule
        self.thread, self.block = w.register("tid.x"), w.register("ctaid.x")
        self.find_arrays(w.register("ctaid.z"))
        gradient, index = self.arrays["gradient"], self.arrays["index"].load("u32")
        before = w.row(self.arrays["progress"], index, SIZES["progress"])
        # Begin to load everything before the threads wait for each other.
        common_values = [gradient[place] for place in rule.metric_places]
        for name, array in (("progress", before), ("adam_terms", self.arrays["adam_terms"])):
            common_values += [array[i] for i in range(SIZES[name])]
        places = self._places()
        early = [self._fetch(place) for place in places[:_EARLY]]
        # The norm of the gradient, and what follows from it for all elements.
        square = self._sum(self._squares(gradient))
        factors, element = adam.programs(rule)
        results = w.run(factors, [square, *common_values])
        common, progress = results[: len(Factors._fields)], results[len(Factors._fields) :]
        # Update the elements of the thread.
        for i, place in enumerate(places):
            values = early[i] if i < _EARLY else self._fetch(place)
            updated = w.run(element, [*values, *common])
            with w.when(self._is_parameter(place)):
                for name, value in zip(self.returns, updated, strict=False):
                    self.arrays[name][place] = value
        # One thread of all writes the row behind that which the other blocks may still read.
        after = before + SIZES["progress"]
        with w.when((self.block * _THREADS + self.thread).equals(0)):
            for i, value in enumerate(progress):
                after[i] = value
        return w.module(_THREADS)

    def _places(self) -> list[Value]:
        """Return where the thread's elements are; the last one may be beyond the end."""
        first, stride = self.block * _THREADS + self.thread, self.blocks * _THREADS
        return [first + start for start in range(0, self.rule.shape.size, stride)]

    def _fetch(self, place: Value) -> list[Value]:
        """Fetch what `element` takes of the vectors."""
        clamped = self.w.minimum(place, self.rule.shape.size - 1)
        return [self.arrays[name][clamped] for name in ("params", "mu", "nu", "gradient")]

    def _is_parameter(self, place: Value) -> Value:
        """Return whether an element is a parameter: metrics are behind those of each network."""
        w, ((_, stop), (first, end)) = self.w, self.rule.shape.ranges
        # Move those between the networks to the second one's start, and its metrics to the end.
        middle = w.select(place < stop, first, place)
        return w.select(middle < first, end, middle) < end

    def _squares(self, gradient: Value) -> list[Value]:
        """Return the thread's sums of squares over the whole gradient."""
        w, size = self.w, self.rule.shape.size
        sums = [w.constant(0.0)] * _SUMS
        for i, start in enumerate(range(0, size, _THREADS)):
            place, stop = self.thread + start, start + _THREADS
            value = gradient[w.minimum(place, size - 1) if stop > size else place]
            # Metrics are no part of the norm; most rows of threads have none.
            if not any(first <= start and stop <= last for first, last in self.rule.shape.ranges):
                value = w.select(self._is_parameter(place), value, 0.0)
            sums[i % _SUMS] += value * value
        return sums

    def _sum(self, sums: list[Value]) -> Value:
        """Add up the sums of all threads of the block, in a fixed order, for all of them."""
        w = self.w
        total = sum(sums[1:], sums[0])
        w.shared(self.thread * 4).store(total)
        # The first warp reads the sums of all threads, and then all threads those of its lanes.
        w.synchronize()
        with w.when(self.thread < LANES):
            rows = range(0, 4 * _THREADS, 4 * LANES)
            total = w.total(w.shared(self.thread * 4, row).load() for row in rows)
            w.shared(self.thread * 4, 4 * _THREADS).store(total)
        w.synchronize()
        return w.total(w.shared(4 * (_THREADS + i)).load() for i in range(LANES))
