"""Programs on scalars run in NumPy: the reference for what the back ends compile."""

import numpy as np

from onekernel.lower.indexing import scalar_array
from onekernel.lower.jaxpr import ScalarProgram
from onekernel.lower.scalar_ir import EVALUATE, convert_constant, is_constant
from onekernel.lower.schedule import PlacedBranch, PlacedLoop, schedule

# Words at the ends of what integers hold, and around what float32 holds of them.
WORDS = np.uint32([0, 1, 7, 2**24 + 1, 2**31 - 1, 2**31, 2**31 + 129, 2**32 - 129, 2**32 - 1])


def evaluate(program, leaves):
    """The results of a program; all leaves have the same leading batch axes."""
    batch = leaves[0].shape[: leaves[0].ndim - program.inputs[0].ndim]
    run = _Evaluation(batch)
    for array, leaf in zip(program.inputs, leaves, strict=True):
        columns = leaf.reshape(*batch, array.size)
        run.values |= {x.index: columns[..., i] for i, x in enumerate(array.ravel())}
    with np.errstate(all="ignore"):
        run.block(program.block)
    # Nothing cannot be stacked: of an array of size 0, NumPy makes the result from the shape alone.
    columns = [[run.look_up(x) for x in array.ravel()] for array in program.outputs]
    return [
        (np.stack(found, -1) if found else np.zeros(0)).reshape(*batch, *array.shape)
        for found, array in zip(columns, program.outputs, strict=True)
    ]


def evaluate_scalar(result, *inputs):
    """What one value comes to, of inputs and the numbers that each of them has."""
    values, columns = zip(*inputs, strict=True)
    leaves = [scalar_array([value], ()) for value in values]
    program = ScalarProgram(leaves, [scalar_array([result], ())], schedule([result]))
    (ends,) = evaluate(program, columns)
    return ends


class _Evaluation:
    """The values of a program that runs for a batch of robots."""

    def __init__(self, batch):
        self._batch = batch
        # The robots that execute the current block; the values of the others are arbitrary.
        self._mask = np.ones(batch, bool)
        self.values = {}

    def look_up(self, x):
        return np.broadcast_to(x, self._batch) if is_constant(x) else self.values[x.index]

    def block(self, block):
        for item in block.items:
            if isinstance(item, PlacedLoop):
                self._loop(item)
            elif isinstance(item, PlacedBranch):
                self._branch(item)
            else:
                self.values[item.index] = self._operation(item)

    def _masked_block(self, block, mask):
        enclosing, self._mask = self._mask, mask
        self.block(block)
        self._mask = enclosing

    def _operation(self, value):
        operands = [self.look_up(x) for x in value.operands]
        if value.op == "select":
            return np.where(operands[0], operands[2], operands[1])
        if value.op == "array":
            return np.stack(operands, -1)
        if value.op == "load":
            array, index = operands
            # Robots that do not execute the block may have any index.
            index = np.where(self._mask, index, 0)
            return np.take_along_axis(array, index[..., None], -1)[..., 0]
        if value.op == "convert":
            return convert_constant(operands[0], value.dtype)
        return EVALUATE[value.op](*operands)

    def _loop(self, item):
        loop = item.loop
        state = [self.look_up(loop.initial[place]) for place in item.places]
        active = self._mask
        for stack in item.stacks:
            nothing = np.full((*self._batch, loop.length), 77, stack.dtype)
            self.values[stack.index] = nothing
        counts = iter(range(loop.length or 0)[:: -1 if loop.reverse else 1])
        while True:
            for place, value in zip(item.places, state, strict=True):
                self.values[loop.carries[place].index] = value
            self.block(item.head)
            count = next(counts, None)
            active = active & self.look_up(loop.condition)
            if not active.any() or (loop.length is not None and count is None):
                break
            if loop.counter is not None:
                self.values[loop.counter.index] = np.full(self._batch, count, np.int32)
            self._masked_block(item.body, active)
            for stack in item.stacks:
                kept = self.values[stack.index][..., count]
                new = np.where(active, self.look_up(loop.stacked[stack.place]), kept)
                self.values[stack.index][..., count] = new
            updated = [self.look_up(loop.updated[place]) for place in item.places]
            state = [np.where(active, b, a) for a, b in zip(state, updated, strict=True)]
        for result in item.results:
            self.values[result.index] = self.look_up(loop.results[result.place])

    def _branch(self, item):
        branch = item.branch
        condition = self.look_up(branch.condition)
        self._masked_block(item.if_false, ~condition & self._mask)
        self._masked_block(item.if_true, condition & self._mask)
        for result in item.results:
            sides = [self.look_up(side[result.place]) for side in (branch.if_true, branch.if_false)]
            self.values[result.index] = np.where(condition, *sides)
