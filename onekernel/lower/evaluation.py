"""Run a scalar program in NumPy, without a compiler: the reference for what the back ends run."""

from collections.abc import Sequence

import numpy as np

from onekernel.errors import UnsupportedError
from onekernel.lower.jaxpr import ScalarProgram
from onekernel.lower.scalar_ir import EVALUATE, Expr, Scalar, convert_constant, is_constant


def evaluate(program: ScalarProgram, scalars: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Run a program without loops and branches for many instances, in the dtypes of its inputs.

    A program with approximate instructions (`approximate` of `scalarize`) can be run in float64,
    too. Others need float32, because their formulas of exp and log work on its bits.

    Args:
      program: the program.
      scalars: the numbers of all instances for each scalar of the program's arguments.

    Returns:
      The numbers of all instances for each scalar of the program's results.

    Raises:
      UnsupportedError: the program has a loop or a branch.
    """
    # The numbers of each scalar, by its place in the order of recording.
    inputs = [x for array in program.inputs for x in array.ravel()]
    values = {x.index: numbers for x, numbers in zip(inputs, scalars, strict=True)}

    # A constant stands for all instances.
    def value(x: Scalar) -> np.ndarray:
        return np.asarray(x) if is_constant(x) else values[x.index]

    # Each operation for all instances at once.
    with np.errstate(all="ignore"):
        for item in program.block.items:
            if not isinstance(item, Expr):
                raise UnsupportedError("a loop or a branch, evaluated in NumPy")
            operands = [value(x) for x in item.operands]
            if item.op == "select":
                condition, if_false, if_true = operands
                values[item.index] = np.where(condition, if_true, if_false)
            elif item.op == "array":
                # The scalars are along the last axis.
                values[item.index] = np.stack(np.broadcast_arrays(*operands), -1)
            elif item.op == "load":
                array, index = operands
                instances = np.broadcast_shapes(array.shape[:-1], index.shape)
                rows = np.broadcast_to(array, (*instances, array.shape[-1]))
                places = np.broadcast_to(index, instances)[..., None]
                values[item.index] = np.take_along_axis(rows, places, -1)[..., 0]
            elif item.op == "convert":
                values[item.index] = convert_constant(operands[0], item.dtype)
            else:
                values[item.index] = EVALUATE[item.op](*operands)
    return [value(x) for array in program.outputs for x in array.ravel()]
