"""Write the kernel that makes a step of Adam on CPUs.

One thread serves a policy: it adds up the squares of the gradient, computes what all elements have
in common, and then goes through the vectors once.
"""

from jetbot_mjx.compiler import ffi_wrapper
from jetbot_mjx.compiler.llvm_codegen import LlvmEmitter
from jetbot_mjx.compiler.lower_jaxpr import ScalarProgram
from jetbot_mjx.compiler.update import adam
from jetbot_mjx.compiler.update.adam import ARRAYS, METRICS, SIZES, UPDATED, AdamRule, Factors
from jetbot_mjx.compiler.update.vector_code import VectorCode

_VECTORS = (*UPDATED[:3], "gradient")

_SUMS = 4
"""Vectors of sums of squares, so that no addition waits for the one before."""


def adam_text(rule: AdamRule, lanes: int, *, name: str, machine: str) -> str:
    """Write the LLVM module of the kernel, whose function XLA calls.

    It takes `adam.ARRAYS` with the policies as their first axis, and changes `adam.UPDATED`.

    Args:
      rule: what the vectors hold.
      lanes: the number of float32 values in a vector register.
      name: the name of the function.
      machine: the processor, one of `ffi_wrapper.MACHINES`.
    """
    writer = _Writer(rule, lanes)
    functions = [*writer.functions(), writer.block()]
    lines = [line for program in writer.programs for line in program.declarations()]
    return ffi_wrapper.call_text(
        "\n".join([*dict.fromkeys(lines), *functions]),
        arguments=len(ARRAYS),
        results=len(UPDATED),
        blocks_per_thread=1,
        scratch=writer.scratch,
        name=name,
        machine=machine,
    )


class _Writer:
    def __init__(self, rule: AdamRule, lanes: int) -> None:
        self.rule, self.lanes = rule, lanes
        self.programs: list[LlvmEmitter] = []
        # Scratch memory: sums of squares, what `factors` reads, and what it returns.
        self.reads = _SUMS * lanes
        self.writes = self.reads + 1 + len(METRICS) + sum(SIZES.values())
        size = 4 * (self.writes + len(Factors._fields) + SIZES["progress"])
        self.scratch = -(-size // 64) * 64

    def functions(self) -> list[str]:
        """Return the texts of the functions that `block` calls."""
        factors, element = adam.programs(self.rule)
        return [self._factors(factors), *(self._elements(element, n) for n in {self.lanes, 1})]

    def _factors(self, program: ScalarProgram) -> str:
        code = VectorCode(1)
        self.programs.append(LlvmEmitter(program, 1))
        count = sum(array.size for array in program.inputs)
        values = [code.load(code.at("%reads", i)) for i in range(count)]
        for i, result in enumerate(code.run(program, values)):
            code.store(result, code.at("%writes", i))
        return code.function("factors", ["ptr noalias %reads", "ptr noalias %writes"])

    def _elements(self, program: ScalarProgram, lanes: int) -> str:
        """Write a function that goes through a range, some elements at once."""
        code = VectorCode(lanes)
        self.programs.append(LlvmEmitter(program, lanes))
        common = [code.load(code.at("%factors", i)) for i in range(len(Factors._fields))]
        common = [code.splat(x) for x in common]
        with code.loop("%count") as i:
            place = code.mul(i, lanes)
            at = {x: code.at(f"%{x}", place) for x in _VECTORS}
            values = [code.load(at[x], code.vector) for x in _VECTORS]
            for x, result in zip(UPDATED, code.run(program, [*values, *common]), strict=False):
                code.store(result, at[x], code.vector)
        parameters = [f"ptr noalias %{x}" for x in (*_VECTORS, "factors")]
        return code.function(f"elements.{lanes}", [*parameters, "i64 %count"])

    def block(self) -> str:
        """Write the function that makes the step of one policy."""
        code, rule, lanes = VectorCode(self.lanes), self.rule, self.lanes
        arrays, sizes = {}, rule.sizes
        for i, name in enumerate(ARRAYS):
            code.do(ffi_wrapper.address(i))
            arrays[name] = code.at(f"%a{i}", code.mul("%index", sizes[name]))
        # What `factors` reads: the sum of squares, the metrics, the progress, and the terms.
        reads, writes = code.at("%scratch", self.reads), code.at("%scratch", self.writes)
        code.store(self._square(code, arrays["gradient"]), reads)
        rows = code.mul(code.index(arrays["index"]), SIZES["progress"])
        before = code.at(arrays["progress"], rows)
        sources = [code.at(arrays["gradient"], place) for place in rule.places]
        sources += [code.at(before, i) for i in range(SIZES["progress"])]
        sources += [code.at(arrays["terms"], i) for i in range(SIZES["terms"])]
        for i, source in enumerate(sources):
            code.copy(source, code.at(reads, i + 1))
        code.call("factors", f"ptr {reads}", f"ptr {writes}")
        progress, after = code.at(writes, len(Factors._fields)), code.at(before, SIZES["progress"])
        for i in range(SIZES["progress"]):
            code.copy(code.at(progress, i), code.at(after, i))
        for start, stop in rule.ranges:
            whole = (stop - start) // lanes
            rest = start + whole * lanes
            for width, first, count in ((lanes, start, whole), (1, rest, stop - rest)):
                places = [code.at(arrays[x], first) for x in _VECTORS]
                pointers = [f"ptr {x}" for x in (*places, writes)]
                code.call(f"elements.{width}", *pointers, f"i64 {count}")
        return code.function("block", ["ptr %job", "i64 %index", "ptr %scratch"])

    def _square(self, code: VectorCode, gradient: str) -> str:
        """Return the sum of the squares of the gradient's parameters."""
        lanes, total = self.lanes, "%scratch"
        code.fill(total, _SUMS * lanes)

        def add(place: str, at: str, kind: str) -> None:
            value = code.load(code.at(gradient, place), kind)
            square = code.arithmetic("fmul", value, value, kind)
            code.store(code.arithmetic("fadd", code.load(at, kind), square, kind), at, kind)

        for start, stop in self.rule.ranges:
            step = _SUMS * lanes
            whole = (stop - start) // step
            with code.loop(whole) as i:
                for j in range(_SUMS):
                    place = code.add(code.mul(i, step), start + j * lanes)
                    add(place, code.at(total, j * lanes), code.vector)
            with code.loop((stop - start) % step) as i:
                add(code.add(i, start + whole * step), total, "float")
        with code.loop(_SUMS * lanes - 1) as i:
            at = code.at(total, code.add(i, 1))
            code.store(code.arithmetic("fadd", code.load(total), code.load(at)), total)
        return code.load(total)
