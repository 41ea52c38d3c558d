"""Find a time that no program can go below, from the operations that need one another.

The processor begins an operation when its operands are there. So a call for one instance takes at
least the time of a call that does nothing and of the longest chain of dependent operations, however
many operations run at once.
The chain is that of `onekernel`'s scalar program, run with the numbers of an argument; the time of
an operation is measured, by many of it in a row. The bound holds for float32 code that

- computes the same operations on the same numbers in the same order (sums and products in another
  order round otherwise), and functions such as exp by the same polynomials,
- and is free in everything else: a sum may be one instruction with a product before it, all
  branches, selections, minima and maxima are predicted, loops are unrolled, and comparisons,
  conversions, bits and memory take no time.
"""

import functools
import itertools
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PyTree

from onekernel import fuse
from onekernel.lower.jaxpr import scalarize
from onekernel.lower.scalar_ir import EVALUATE, Expr, Scalar, convert_constant, is_constant
from onekernel.lower.schedule import Block, PlacedBranch, PlacedLoop

_TIMED: dict[str, Callable[[Array], Array]] = {
    "add": lambda x: x + 1.0,
    "mul": lambda x: x * 0.999,
    "fma": lambda x: x * 0.5 + 1.0,
    "div": lambda x: 1.5 / x,
    "sqrt": jnp.sqrt,
    "round": jnp.round,
    "count": lambda x: (x + 1) ^ 6,
}
"""The operations that take time. `fma` is a product and a sum in one instruction, and `count` are
two operations on integers; all others are on floats."""

_KINDS = {"sub": "add", "floor": "round"}
"""Operations that take the time of another one."""

_IN_A_ROW, _ITERATIONS = 16, 10_000


def measure_times() -> dict[str, float]:
    """Measure the time from the operands of each operation to its result, and that of a call [s].

    It is the shortest of many repeats: other programs only make them longer.
    """

    def chain(name: str, x: Array) -> Array:
        def iterate(_: int, x: Array) -> Array:
            return functools.reduce(lambda x, _: _TIMED[name](x), range(_IN_A_ROW), x)

        return jax.lax.fori_loop(0, _ITERATIONS, iterate, x)

    times = {"call": _shortest(lambda x: x + 1, jnp.int32(1), repeats=1000)}
    for name in _TIMED:
        x = jnp.int32(1) if name == "count" else jnp.float32(1.3)
        seconds = _shortest(functools.partial(chain, name), x, repeats=50)
        times[name] = (seconds - times["call"]) / (_ITERATIONS * _IN_A_ROW)
    return times


def _shortest(function: Callable[[Array], Array], x: Array, repeats: int) -> float:
    program = jax.jit(fuse(function, on_unsupported="raise")).lower(x).compile()

    def call() -> float:
        begin = time.perf_counter()
        jax.block_until_ready(program(x))
        return time.perf_counter() - begin

    return min(call() for _ in range(repeats))


def lower_bound(
    function: Callable[[Array], PyTree], argument: Array, times: Mapping[str, float]
) -> float:
    """Return a time that no call of a function goes below [s].

    Args:
      function: a function of one instance that can be one kernel.
      argument: its argument, on which iterations, branches and selections depend.
      times: the time of each operation and of a call, as `measure_times` returns them.
    """
    program = scalarize(function, argument, finite=False)
    given = zip(program.inputs[0].ravel(), np.asarray(argument).ravel(), strict=True)
    run = _Run(times, {x.index: _Number(value) for x, value in given})
    with np.errstate(all="ignore"):
        run.block(program.block)
    ready = (run.get(x).ready for array in program.outputs for x in array.ravel())
    return times["call"] + max(ready)


class _Number(NamedTuple):
    """A `_Number` is a scalar and the time at which it is there."""

    value: Any
    ready: float = 0.0
    before: float | None = None
    """Of a product: the time at which its factors are there."""


class _Run:
    """A `_Run` computes the operations of a program one by one."""

    def __init__(self, times: Mapping[str, float], known: dict[int, _Number]) -> None:
        self._times, self._known = times, known
        self._arrays: dict[int, list[_Number]] = {}

    def get(self, x: Scalar) -> _Number:
        return _Number(x) if is_constant(x) else self._known[x.index]

    def block(self, block: Block) -> None:
        for item in block.items:
            if isinstance(item, PlacedLoop):
                self._loop(item)
            elif isinstance(item, PlacedBranch):
                is_true = self.get(item.branch.condition).value
                self.block(item.if_true if is_true else item.if_false)
                side = item.branch.if_true if is_true else item.branch.if_false
                self._known |= {x.index: self.get(side[x.place]) for x in item.results}
            elif item.op == "array":
                self._arrays[item.index] = [self.get(x) for x in item.operands]
            else:
                self._known[item.index] = self._computed(item)

    def _loop(self, item: PlacedLoop) -> None:
        loop, carries = item.loop, [item.loop.carries[i].index for i in item.places]
        numbers = [self.get(loop.initial[i]) for i in item.places]
        self._arrays |= {
            x.index: [_Number(x.dtype.type(0))] * (loop.length or 0) for x in item.stacks
        }
        for count in itertools.count():
            self._known |= zip(carries, numbers, strict=True)
            place = loop.length - 1 - count if loop.reverse and loop.length else count
            if loop.counter is not None:
                self._known[loop.counter.index] = _Number(np.int32(place))
            self.block(item.head)
            if count == loop.length or not self.get(loop.condition).value:
                break
            self.block(item.body)
            for stack in item.stacks:
                self._arrays[stack.index][place] = self.get(loop.stacked[stack.place])
            numbers = [self.get(loop.updated[i]) for i in item.places]
        self._known |= {x.index: self.get(loop.results[x.place]) for x in item.results}

    def _computed(self, x: Expr) -> _Number:
        if x.op == "load":
            source, index = x.operands[0], self.get(x.operands[1])
            array = self._arrays[source.index] if isinstance(source, Expr) else []
            found = array[min(max(int(index.value), 0), len(array) - 1)]
            return found._replace(ready=max(found.ready, index.ready), before=None)
        operands = [self.get(operand) for operand in x.operands]
        values, before = [one.value for one in operands], max(one.ready for one in operands)
        if x.op == "select":
            return operands[1 + bool(values[0])]
        if x.op == "convert":
            return _Number(convert_constant(np.asarray(values[0]), x.dtype)[()], before)
        value = EVALUATE[x.op](*values)[()]
        if x.op == "neg":
            return operands[0]._replace(value=value)
        if x.op in ("max", "min"):
            ready = [one.ready for one in operands if one.value == value]
            return _Number(value, min(ready, default=0.0))
        if x.dtype.kind != "f":
            is_count = x.op in ("add", "sub", "mul")
            return _Number(value, before + self._times["count"] / 2 * is_count)
        seconds = self._times.get(_KINDS.get(x.op, x.op), 0.0)
        if x.op in ("add", "sub"):
            return _Number(value, max(self._sum(one, seconds) for one in operands))
        return _Number(value, before + seconds, before if x.op == "mul" else None)

    def _sum(self, operand: _Number, seconds: float) -> float:
        """Return when the sum with an operand is there, fused with its product or not."""
        apart = operand.ready + seconds
        return apart if operand.before is None else min(apart, operand.before + self._times["fma"])
