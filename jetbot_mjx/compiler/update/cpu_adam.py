"""Write a step of Adam on CPUs: first the squares of the gradient, and then all elements."""

from jetbot_mjx.compiler.llvm_codegen import LlvmEmitter
from jetbot_mjx.compiler.lower_jaxpr import ScalarProgram
from jetbot_mjx.compiler.update import adam
from jetbot_mjx.compiler.update.adam import ARRAYS, METRICS, SIZES, UPDATED, AdamRule, Factors
from jetbot_mjx.compiler.update.cpu_stages import SQUARES, Call, SquareStage, Stage, VectorStage
from jetbot_mjx.compiler.update.vector_code import VectorCode, number

_VECTORS = (*UPDATED[:3], "gradient")


def adam_call(rule: AdamRule, lanes: int) -> Call:
    """Return the call of a step, which takes `adam.ARRAYS` and changes `adam.UPDATED`.

    Args:
      rule: what the vectors hold.
      lanes: the number of float32 values in a vector register.
    """
    sizes = {**rule.sizes, "squares": SQUARES}
    return Call(ARRAYS, (*UPDATED, "squares"), sizes, adam_stages(rule, lanes), minibatches=None)


def adam_stages(rule: AdamRule, lanes: int) -> list[Stage]:
    """Return the stages that change `adam.UPDATED` by the array `gradient`.

    Args:
      rule: what the vectors hold.
      lanes: the number of float32 values in a vector register.
    """
    return [SquareStage(lanes, rule.shape.ranges), _AdamStage(rule, lanes)]


class _AdamStage(VectorStage):
    """Computes what all elements have in common in each chunk, and then updates its elements."""

    name = "adam"

    def __init__(self, rule: AdamRule, lanes: int) -> None:
        super().__init__()
        self.rule, self.lanes = rule, lanes
        # Scratch memory: what `factors` reads, and what it returns.
        self.writes = 1 + len(METRICS) + sum(SIZES.values())
        self.scratch = self.writes + len(Factors._fields) + SIZES["progress"]

    def texts(self, call: Call) -> list[str]:
        """Return the texts of the function, and of those that it calls."""
        factors, element = adam.programs(self.rule)
        elements = [self._elements(element, n) for n in (self.lanes, 1)]
        return [self._factors(factors), *elements, self._step(call)]

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

    def _step(self, call: Call) -> str:
        code, rule, lanes = VectorCode(self.lanes), self.rule, self.lanes
        names = *_VECTORS, "progress", "adam_terms", "squares"
        *vectors, rows, terms, squares = (call.array(code, name) for name in names)
        # What `factors` reads: the sum of squares, the metrics, the progress, and the terms.
        reads, writes = "%scratch", code.at("%scratch", self.writes)
        code.store(number(0.0), reads)
        code.accumulate(squares, SQUARES, reads)
        before = code.at(rows, code.mul("%minibatch", SIZES["progress"]))
        sources = [code.at(vectors[-1], place) for place in rule.places]
        sources += [code.at(before, i) for i in range(SIZES["progress"])]
        sources += [code.at(terms, i) for i in range(SIZES["adam_terms"])]
        for i, source in enumerate(sources):
            code.copy(source, code.at(reads, i + 1))
        code.call("factors", f"ptr {reads}", f"ptr {writes}")
        # The other chunks still read the row before.
        progress, after = code.at(writes, len(Factors._fields)), code.at(before, SIZES["progress"])
        is_first = code.let("icmp eq i64 %part, 0")
        with code.loop(code.select(is_first, "i64", SIZES["progress"], 0)) as i:
            code.copy(code.at(progress, i), code.at(after, i))
        for start, stop in rule.shape.ranges:
            first, count = self.chunk(code, start, stop)
            whole = code.let(f"udiv i64 {count}, {lanes}")
            done = code.mul(whole, lanes)
            for width, begin, length in (
                (lanes, first, whole),
                (1, code.add(first, done), code.sub(count, done)),
            ):
                pointers = [f"ptr {code.at(x, begin)}" for x in vectors]
                code.call(f"elements.{width}", *pointers, f"ptr {writes}", f"i64 {length}")
        return self.function(code)
