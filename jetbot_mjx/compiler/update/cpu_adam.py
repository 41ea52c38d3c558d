"""Write the kernel that makes a step of Adam on CPUs.

One thread serves a policy: it adds up the squares of the gradient, computes what all elements have
in common, and then goes through the vectors once.
"""

import functools
from collections.abc import Callable
from typing import Any

import jax

from jetbot_mjx.compiler import ffi_wrapper
from jetbot_mjx.compiler.llvm_codegen import LlvmEmitter
from jetbot_mjx.compiler.lower_jaxpr import ScalarProgram, scalarize_part
from jetbot_mjx.compiler.update import adam
from jetbot_mjx.compiler.update.adam import METRICS, SIZES, AdamRule, Factors
from jetbot_mjx.compiler.update.sample_loss import vector_of
from jetbot_mjx.compiler.update.vector_code import VectorCode

_ARRAYS = ("params", "mu", "nu", "gradient", "progress", "terms")
_RESULTS = ("params", "mu", "nu", "progress")

_SUMS = 4
"""Vectors of sums of squares, so that no addition waits for the one before."""


def adam_text(rule: AdamRule, lanes: int, *, name: str, machine: str) -> str:
    """Write the LLVM module of the kernel, whose function XLA calls.

    It takes the arrays of `adam.step` and returns its results, with the policies as their first
    axis.

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
        arguments=len(_ARRAYS),
        results=len(_RESULTS),
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
        scalar, metrics = vector_of(), vector_of(len(METRICS))
        arrays = vector_of(SIZES["progress"]), vector_of(SIZES["terms"])
        factors = _program(
            functools.partial(adam.factors, rule=self.rule), scalar, metrics, *arrays
        )
        element = _program(adam.element, *[scalar] * (4 + len(Factors._fields)))
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
            read = [code.load(code.at(f"%{x}", place), code.vector) for x in _ARRAYS[:4]]
            results = code.run(program, [*read, *common])
            for x, result in zip(_RESULTS, results, strict=False):
                code.store(result, code.at(f"%new.{x}", place), code.vector)
        names = [*_ARRAYS[:4], *(f"new.{x}" for x in _RESULTS[:3]), "factors"]
        return code.function(
            f"elements.{lanes}", [*(f"ptr noalias %{x}" for x in names), "i64 %count"]
        )

    def block(self) -> str:
        """Write the function that makes the step of one policy."""
        code, rule, lanes = VectorCode(self.lanes), self.rule, self.lanes
        sizes = dict.fromkeys(_ARRAYS, rule.shape.size) | SIZES
        arrays = []
        for i, name in enumerate((*_ARRAYS, *_RESULTS)):
            code.do(ffi_wrapper.address(i))
            arrays.append(code.at(f"%a{i}", code.mul("%index", sizes[name])))
        given = dict(zip(_ARRAYS, arrays, strict=False))
        new = dict(zip(_RESULTS, arrays[len(_ARRAYS) :], strict=True))
        # What `factors` reads: the sum of squares, the metrics, the progress, and the terms.
        reads, writes = code.at("%scratch", self.reads), code.at("%scratch", self.writes)
        code.store(self._square(code, given["gradient"]), reads)
        sources = [code.at(given["gradient"], place) for place in rule.places]
        sources += [code.at(given[x], i) for x in ("progress", "terms") for i in range(SIZES[x])]
        for i, source in enumerate(sources):
            code.copy(source, code.at(reads, i + 1))
        code.call("factors", f"ptr {reads}", f"ptr {writes}")
        progress = code.at(writes, len(Factors._fields))
        for i in range(SIZES["progress"]):
            code.copy(code.at(progress, i), code.at(new["progress"], i))
        for start, stop in rule.ranges:
            whole = (stop - start) // lanes
            rest = start + whole * lanes
            for width, first, count in ((lanes, start, whole), (1, rest, stop - rest)):
                places = [code.at(given[x], first) for x in _ARRAYS[:4]]
                places += [code.at(new[x], first) for x in _RESULTS[:3]]
                pointers = [f"ptr {x}" for x in (*places, writes)]
                code.call(f"elements.{width}", *pointers, f"i64 {count}")
        # Where the gradient has the metrics, the vectors stay as they are.
        for place in rule.places:
            for name in _RESULTS[:3]:
                code.copy(code.at(given[name], place), code.at(new[name], place))
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


def _program(function: Callable[..., Any], *arguments: jax.ShapeDtypeStruct) -> ScalarProgram:
    """Lower a function whose numbers may not be finite."""
    closed = jax.make_jaxpr(function)(*arguments)
    return scalarize_part(closed, closed.jaxpr.invars, closed.jaxpr.outvars, finite=False)
