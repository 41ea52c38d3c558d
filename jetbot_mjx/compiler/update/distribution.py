"""Write the distribution of one action for the kernels on GPUs, as Brax defines it."""

import math
from collections.abc import Sequence
from typing import NamedTuple

from jetbot_mjx.compiler.update.shapes import MOST_OUTPUTS, POLICY_METRICS, UpdateShape
from jetbot_mjx.compiler.update.tensor_core import IrWriter, Value

HALF_LOG_TWO_PI = 0.5 * math.log(2 * math.pi)

OUTPUT_BYTES = 4 * (MOST_OUTPUTS + 1)
"""Bytes from one sample's outputs to those of the next in shared memory."""

_MIN_STD = 0.001


class Distribution(NamedTuple):
    """A `Distribution` holds the normal distribution of each number before its tanh."""

    mean: list[Value]
    scale: list[Value]
    """Standard deviations."""
    raw: list[Value]
    """The outputs that the standard deviations follow from; none if they are parameters."""

    @classmethod
    def of(cls, ir: IrWriter, shape: UpdateShape, outputs: Value, params: Value) -> "Distribution":
        """Return the distribution of a sample.

        Args:
          ir: the writer.
          shape: the networks.
          outputs: the pointer to the sample's outputs in shared memory.
          params: the policy's parameters.
        """
        count = shape.actions
        mean = [ir.read(ir.moved(outputs, 4 * i)) for i in range(count)]
        if shape.distribution == "tanh_normal":
            raw = [ir.read(ir.moved(outputs, 4 * (count + i))) for i in range(count)]
            return cls(mean, [ir.softplus(x) + _MIN_STD for x in raw], raw)
        place = ir.constant(shape.policy_size - len(POLICY_METRICS) - count, "i32")
        return cls(mean, [ir.fetch(params, place + i) for i in range(count)], [])


def log_prob(
    ir: IrWriter, distances: Sequence[Value], log_scale: Sequence[Value], tanh: Sequence[Value]
) -> Value:
    """Return the logarithm of a probability.

    Args:
      ir: the writer.
      distances: the distances from the mean, in standard deviations.
      log_scale: the logarithms of the standard deviations.
      tanh: the numbers whose tanh is taken, if it is.
    """
    total = ir.constant(0.0)
    for distance, log in zip(distances, log_scale, strict=True):
        total += distance * distance * -0.5 - log - HALF_LOG_TWO_PI
    for x in tanh:
        total -= log_slope(ir, x)
    return total


def old_scale(ir: IrWriter, shape: UpdateShape, value: Value) -> Value:
    """Return a standard deviation from a parameter of the collection's distribution."""
    return ir.softplus(value) + _MIN_STD if shape.distribution == "tanh_normal" else value


def log_slope(ir: IrWriter, x: Value) -> Value:
    """Return log(1 - tanh(x)^2), as Brax computes it."""
    return (math.log(2.0) - x - ir.softplus(x * -2.0)) * 2.0
