"""Write a step of Adam on CPUs: first the squares of the gradient, and then all elements.

The call of all minibatches makes the stages of the gradient and then these for each of them. The
squares follow the sum of the gradients without a wait: a part squares what it has just written.
"""

from jetbot_mjx.agents.fused import adam
from jetbot_mjx.agents.fused.adam import METRICS, SIZES, AdamRule, Factors
from jetbot_mjx.agents.fused.cpu_gradient import gradient_stages
from jetbot_mjx.agents.fused.cpu_product import add_all
from jetbot_mjx.agents.fused.cpu_stages import (
    Call,
    SquareStage,
    Stage,
    VectorStage,
    sample_function,
)
from jetbot_mjx.agents.fused.shapes import DataSizes
from onekernel.build import LlvmWriter, ScalarProgram, run_program

_VECTORS = ("params", "mu", "nu", "gradient")


def adam_stages(rule: AdamRule, batch: DataSizes, lanes: int) -> list[list[Stage]]:
    """Return the stages of `arrays.ADAM`.

    Args:
      rule: what the vectors hold.
      batch: the data, which a step does not read.
      lanes: the number of float32 values in a vector register.
    """
    del batch
    return [[SquareStage(rule.shape, lanes)], [_AdamStage(rule, lanes)]]


def update_stages(rule: AdamRule, batch: DataSizes, lanes: int) -> list[list[Stage]]:
    """Return the stages of `arrays.UPDATE`, through which the call goes for each minibatch.

    Args:
      rule: what the vectors hold.
      batch: the minibatch.
      lanes: the number of float32 values in a vector register.
    """
    *parts, total = gradient_stages(rule.shape, batch, lanes)
    squares, step = adam_stages(rule, batch, lanes)
    return [*parts, total + squares, step]


class _AdamStage(VectorStage):
    """Computes what all elements have in common in each chunk, and then updates its elements."""

    name = "adam"

    def __init__(self, rule: AdamRule, lanes: int) -> None:
        super().__init__(rule.shape, lanes)
        self.rule = rule
        # Scratch memory: what `factors` reads, and what it returns.
        self.writes = 1 + len(METRICS) + sum(SIZES.values())
        self.scratch = self.writes + len(Factors._fields) + SIZES["progress"]

    def functions(self, call: Call) -> list[LlvmWriter]:
        """Write the function, and those that it calls."""
        # Elements are updated a vector at a time, and those at the end one by one.
        rule, lanes = self.rule, self.lanes
        factors, element = adam.programs(rule)
        elements = [_elements_function(element, n) for n in (lanes, 1)]
        w, (job, replica, part, minibatch, scratch) = self.begin(lanes)
        names = *_VECTORS, "progress", "adam_terms", "squares"
        *vectors, rows, terms, squares = (call.array(job, replica, name) for name in names)
        # What `factors` reads: the sum of squares, the metrics, the progress, and the terms.
        reads, writes = scratch, scratch + self.writes
        reads.store(0.0)
        add_all(squares, self.parts, reads)
        before = rows + minibatch * SIZES["progress"]
        sources = [vectors[-1] + place for place in rule.metric_places]
        sources += [before + i for i in range(SIZES["progress"])]
        sources += [terms + i for i in range(SIZES["adam_terms"])]
        for i, source in enumerate(sources, start=1):
            reads[i] = source.load()
        w.call("factors", reads, writes)
        # One part stores the progress behind the row before, which the others still read.
        progress, after = writes + len(Factors._fields), before + SIZES["progress"]
        own = w.select(part.equals(0), w.constant(SIZES["progress"], "u64"), 0)
        with w.loop(own) as i:
            after[i] = progress[i]
        # Update the elements of the chunk, first vectors and then the numbers that are left.
        for start, stop in rule.shape.ranges:
            first, count = self.chunk(part, start, stop)
            whole = count // lanes
            done = whole * lanes
            for width, begin, length in ((lanes, first, whole), (1, first + done, count - done)):
                w.call(f"elements.{width}", *(x + begin for x in vectors), writes, length)
        return [sample_function("factors", factors, 1), *elements, w]


def _elements_function(program: ScalarProgram, lanes: int) -> LlvmWriter:
    """Write a function that updates a range of elements, as many at once as there are lanes."""
    names = (f"ptr noalias {name}" for name in (*_VECTORS, "factors"))
    w = LlvmWriter(f"elements.{lanes}", *names, "u64 count", lanes=lanes)
    *vectors, factors, count = w.parameters
    # All lanes have the same factors.
    common = [factors[i].splat(lanes) for i in range(len(Factors._fields))]
    with w.loop(count) as i:
        places = [vector + i * lanes for vector in vectors]
        values = [place.load(w.vector) for place in places]
        results = run_program(w, program, [*values, *common])
        for place, result in zip(places, results, strict=False):
            place.store(result)
    return w
