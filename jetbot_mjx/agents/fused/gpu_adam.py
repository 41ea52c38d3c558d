"""Write the kernel that makes a step of Adam on GPUs.

Each block adds up the squares of the whole gradient, in the same order as all other blocks, and
then updates its own elements: so no block waits for another one.
"""

from jetbot_mjx.agents.fused import adam
from jetbot_mjx.agents.fused.adam import ARRAYS, SIZES, UPDATED, AdamRule, Factors
from jetbot_mjx.agents.fused.tensor_core import LANES, GpuWriter, Value

NAME = "ppo_adam"
"""Name of the kernel."""

THREADS = 1024
"""Threads of a block."""

SHARED_MEMORY = 4 * (THREADS + LANES)
"""Bytes of shared memory: a sum of squares for each thread, and then one for each lane."""

_EARLY = 4
"""Elements that a thread fetches before the threads wait for each other."""

_SUMS = 4
"""Sums of squares of a thread, so that no addition waits for the one before."""


def adam_text(rule: AdamRule, blocks: int) -> str:
    """Write the kernel.

    It takes `adam.ARRAYS` with the policies as their first axis, and changes `adam.UPDATED`.

    Args:
      rule: what the vectors hold.
      blocks: the number of blocks of a policy.

    Returns:
      The text of an LLVM module; its launch needs `SHARED_MEMORY` bytes of shared memory.
    """
    return _AdamKernel(rule, blocks).write()


class _AdamKernel:
    def __init__(self, rule: AdamRule, blocks: int) -> None:
        self.rule, self.blocks = rule, blocks
        self.ir = GpuWriter(NAME, len(ARRAYS) + len(UPDATED))

    def write(self) -> str:
        """Return the module."""
        ir, rule = self.ir, self.rule
        # The arrays of the policy, which the third axis of the grid says.
        self.thread, self.block = ir.register("tid.x"), ir.register("ctaid.x")
        policy = ir.register("ctaid.z")
        arrays = {
            name: ir.row(array, policy, rule.sizes[name])
            for name, array in zip(ARRAYS, ir.parameters, strict=False)
        }
        gradient, index = arrays["gradient"], arrays["index"].load("u32")
        before = ir.row(arrays["progress"], index, SIZES["progress"])
        # Begin to load everything before the threads wait for each other.
        given = [gradient[place] for place in rule.places]
        for name, array in (("progress", before), ("adam_terms", arrays["adam_terms"])):
            given += self._all(array, SIZES[name])
        places = self._places()
        early = [self._fetch(arrays, place) for place in places[:_EARLY]]
        # The norm of the gradient, and what follows from it for all elements.
        square = self._sum(self._squares(gradient))
        factors, element = adam.programs(rule)
        results = ir.run(factors, [square, *given])
        common, progress = results[: len(Factors._fields)], results[len(Factors._fields) :]
        # The elements of the thread.
        for i, place in enumerate(places):
            values = early[i] if i < _EARLY else self._fetch(arrays, place)
            updated = ir.run(element, [*values, *common])
            with ir.when(self._is_parameter(place)):
                for name, value in zip(UPDATED, updated, strict=False):
                    arrays[name][place] = value
        after = before + SIZES["progress"]
        with ir.when((self.block * THREADS + self.thread).equals(0)):
            for i, value in enumerate(progress):
                after[i] = value
        return ir.module(THREADS)

    def _all(self, array: Value, count: int) -> list[Value]:
        return [array[i] for i in range(count)]

    def _places(self) -> list[Value]:
        """Return where the thread's elements are; the last one may be beyond the end."""
        first, stride = self.block * THREADS + self.thread, self.blocks * THREADS
        return [first + start for start in range(0, self.rule.shape.size, stride)]

    def _fetch(self, arrays: dict[str, Value], place: Value) -> list[Value]:
        """Fetch what `element` takes of the vectors."""
        kept = self.ir.minimum(place, self.rule.shape.size - 1)
        return [arrays[name][kept] for name in (*UPDATED[:3], "gradient")]

    def _is_parameter(self, place: Value) -> Value:
        """Return whether an element is a parameter: metrics are behind those of each network."""
        ir, ((start, stop), (first, end)) = self.ir, self.rule.shape.ranges
        assert start == 0
        middle = ir.select(place < stop, first, place)
        return ir.select(middle < first, end, middle) < end

    def _squares(self, gradient: Value) -> list[Value]:
        """Return the thread's sums of squares over the whole gradient."""
        ir, size = self.ir, self.rule.shape.size
        sums = [ir.constant(0.0)] * _SUMS
        for i, start in enumerate(range(0, size, THREADS)):
            place, stop = self.thread + start, start + THREADS
            value = gradient[ir.minimum(place, size - 1) if stop > size else place]
            if not any(first <= start and stop <= last for first, last in self.rule.shape.ranges):
                value = ir.select(self._is_parameter(place), value, 0.0)
            sums[i % _SUMS] += value * value
        return sums

    def _sum(self, sums: list[Value]) -> Value:
        """Add up the sums of all threads of the block, in a fixed order, for all of them."""
        ir = self.ir
        total = sum(sums[1:], sums[0])
        ir.shared(self.thread * 4).store(total)
        ir.synchronize()
        with ir.when(self.thread < LANES):
            total = ir.constant(0.0)
            for i in range(THREADS // LANES):
                total += ir.shared(self.thread * 4, 4 * LANES * i).load()
            ir.shared(self.thread * 4, 4 * THREADS).store(total)
        ir.synchronize()
        total = ir.constant(0.0)
        for i in range(LANES):
            total += ir.shared(4 * (THREADS + i)).load()
        return total
