"""Write the kernel that makes a step of Adam on GPUs.

Each block adds up the squares of the whole gradient, in the same order as all other blocks, and
then updates its own elements: so no block waits for another one.
"""

from jetbot_mjx.compiler.llvm_codegen import LlvmEmitter
from jetbot_mjx.compiler.lower_jaxpr import ScalarProgram
from jetbot_mjx.compiler.update import adam
from jetbot_mjx.compiler.update.adam import ARRAYS, SIZES, UPDATED, AdamRule, Factors
from jetbot_mjx.compiler.update.tensor_core import LANES, IrWriter, Value, module_text

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
        self.ir = IrWriter()
        self.declarations: list[str] = []

    def write(self) -> str:
        """Return the module."""
        ir, rule = self.ir, self.rule
        self.thread, self.block = ir.register("tid.x"), ir.register("ctaid.x")
        policy, pointer = ir.register("ctaid.z"), "ptr addrspace(1)"
        arrays = {
            name: ir.row(Value(ir, f"%a{i}", pointer), policy, rule.sizes[name])
            for i, name in enumerate(ARRAYS)
        }
        gradient, zero = arrays["gradient"], ir.constant(0, "i32")
        index = ir.fetch(arrays["index"], zero, "i32")
        before = ir.row(arrays["progress"], index, SIZES["progress"])
        # Begin to load everything before the threads wait for each other.
        given = [ir.fetch(gradient, ir.constant(place, "i32")) for place in rule.places]
        for name, array in (("progress", before), ("adam_terms", arrays["adam_terms"])):
            given += self._all(array, SIZES[name])
        places = self._places()
        early = [self._fetch(arrays, place) for place in places[:_EARLY]]
        square = self._sum(self._squares(gradient))
        factors, element = adam.programs(rule)
        results = self._run(factors, [square, *given], "common")
        common, progress = results[: len(Factors._fields)], results[len(Factors._fields) :]
        for i, place in enumerate(places):
            values = early[i] if i < _EARLY else self._fetch(arrays, place)
            updated = self._run(element, [*values, *common], f"element{i}.")
            with ir.when(self._is_parameter(place)):
                for name, value in zip(UPDATED, updated, strict=False):
                    ir.put(value, arrays[name], place)
        after = ir.element(before, ir.constant(SIZES["progress"], "i32"))
        with ir.when((self.block * THREADS + self.thread).equals(0)):
            for i, value in enumerate(progress):
                ir.put(value, after, ir.constant(i, "i32"))
        arguments, declared = len(ARRAYS) + len(UPDATED), dict.fromkeys(self.declarations)
        return module_text(NAME, arguments, ir.lines, THREADS, declared)

    def _all(self, array: Value, count: int) -> list[Value]:
        return [self.ir.fetch(array, self.ir.constant(i, "i32")) for i in range(count)]

    def _places(self) -> list[Value]:
        """Return where the thread's elements are; the last one may be beyond the end."""
        first, stride = self.block * THREADS + self.thread, self.blocks * THREADS
        return [first + start for start in range(0, self.rule.shape.size, stride)]

    def _fetch(self, arrays: dict[str, Value], place: Value) -> list[Value]:
        """Fetch what `element` takes of the vectors."""
        kept = self.ir.minimum(place, self.rule.shape.size - 1)
        return [self.ir.fetch(arrays[name], kept) for name in (*UPDATED[:3], "gradient")]

    def _is_parameter(self, place: Value) -> Value:
        """Return whether an element is a parameter: metrics are behind those of each network."""
        ir, ((start, stop), (first, end)) = self.ir, self.rule.shape.ranges
        assert start == 0
        middle = ir.select(place < stop, ir.constant(first, "i32"), place)
        return ir.select(middle < first, ir.constant(end, "i32"), middle) < end

    def _squares(self, gradient: Value) -> list[Value]:
        """Return the thread's sums of squares over the whole gradient."""
        ir, size = self.ir, self.rule.shape.size
        sums = [ir.constant(0.0)] * _SUMS
        for i, start in enumerate(range(0, size, THREADS)):
            place, stop = self.thread + start, start + THREADS
            value = ir.fetch(gradient, ir.minimum(place, size - 1) if stop > size else place)
            if not any(first <= start and stop <= last for first, last in self.rule.shape.ranges):
                value = ir.select(self._is_parameter(place), value, 0.0)
            sums[i % _SUMS] += value * value
        return sums

    def _sum(self, sums: list[Value]) -> Value:
        """Add up the sums of all threads of the block, in a fixed order, for all of them."""
        ir = self.ir
        ir.write(sum(sums[1:], sums[0]), ir.shared(self.thread * 4))
        ir.synchronize()
        with ir.when(self.thread < LANES):
            total = ir.constant(0.0)
            for i in range(THREADS // LANES):
                total += ir.read(ir.shared(self.thread * 4, 4 * LANES * i))
            ir.write(total, ir.shared(self.thread * 4, 4 * THREADS))
        ir.synchronize()
        total = ir.constant(0.0)
        for i in range(LANES):
            total += ir.read(ir.shared(4 * (THREADS + i)))
        return total

    def _run(self, program: ScalarProgram, values: list[Value], prefix: str) -> list[Value]:
        """Append a program without loops and branches, and return its results."""
        ir = self.ir
        emitter = LlvmEmitter(program, 1, ir.label, prefix=prefix, for_gpu=True)
        names = emitter.step([value.text for value in values])
        assert emitter.label == ir.label
        ir.lines += emitter.lines
        self.declarations += emitter.declarations()
        return [Value(ir, name, "float") for name in names]
