"""Write functions in LLVM IR, the input of the LLVM compiler, with Python's operators.

LLVM IR is a typed assembly language with any number of registers. To read its text:

- `%v3 = fadd float %v1, %v2` adds two registers. Each register is written by one instruction only.
- A function is a list of blocks. A block begins with a label, and ends with `br`, a jump to one
  label or to one of two, or with `ret`. There are no other loops and branches.
- Where two ways meet in a block, `%v5 = phi float [%v3, %here], [%v4, %there]` is `%v3` if the
  block `here` was run last, and `%v4` if it was `there`. So a loop carries a value.
- `load` and `store` access memory; `getelementptr` only computes an address. `alloca` takes memory
  from the stack until the function returns.
- `llvm.sqrt.f32` and the like are LLVM's own functions (intrinsics), which the compiler replaces by
  instructions. Their names contain the types of their operands.
- `poison` is a value that nobody uses.

An `LlvmWriter` appends the instructions of one function. A `Value` is a number in a register: it is
known when the function runs, not when it is written. An operator on a `Value` appends the
instruction that computes it, so that formulas look as they do in Python, like those on JAX's
tracers. This function multiplies the numbers of an array by a factor, up to a limit of 1:

    w = LlvmWriter("scale", "ptr array", "float factor", "i64 count")
    array, factor, count = w.parameters
    with w.loop(count) as i:
        array[i] = w.minimum(array[i] * factor, 1.0)
    text = module_text([w])

A `for` of Python appends its body once for each element, so the function has it many times; inside
`with w.loop` or `with w.repeat` it is appended once, and the function runs it many times.

Types are strings. `i8`, `i32` and `i64` are integers with a sign, `u8`, `u32` and `u64` those
without; LLVM's text writes both as `i8`, `i32` and `i64`, since there instructions have signs, and
registers have none. `i1` is a truth value, `half`, `float` and `double` are numbers of 16, 32 and
64 bits, `ptr` is an address (`ptr addrspace(3)` one in another of a GPU's memories), and
`<8 x float>` is a vector, on which an operator works number by number.

Source: LLVM Language Reference Manual.
"""

import contextlib
import dataclasses
import functools
import re
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence

_MAX_ACCESSES = 256
"""Most accesses of memory in a row in one block."""

Number = bool | int | float
"""A number that is known when the function is written."""

_VECTOR = re.compile(r"<(\d+) x (\w+)>")
_UNSIGNED = re.compile(r"\bu(8|32|64)\b")
_WIDTHS = {"i1": 1, "half": 16, "float": 32, "double": 64}

_OPERATIONS = {
    "+": {"f": "fadd contract", "i": "add", "u": "add"},
    "-": {"f": "fsub contract", "i": "sub", "u": "sub"},
    "*": {"f": "fmul contract", "i": "mul", "u": "mul"},
    "/": {"f": "fdiv contract"},
    "//": {"i": "sdiv", "u": "udiv"},
    "%": {"i": "srem", "u": "urem"},
    "&": {"i": "and", "u": "and", "b": "and"},
    "|": {"i": "or", "u": "or", "b": "or"},
    "^": {"i": "xor", "u": "xor", "b": "xor"},
    "<<": {"i": "shl", "u": "shl"},
    ">>": {"i": "ashr", "u": "lshr"},
    "<": {"f": "fcmp olt", "i": "icmp slt", "u": "icmp ult"},
    "<=": {"f": "fcmp ole", "i": "icmp sle", "u": "icmp ule"},
    ">": {"f": "fcmp ogt", "i": "icmp sgt", "u": "icmp ugt"},
    ">=": {"f": "fcmp oge", "i": "icmp sge", "u": "icmp uge"},
    "==": {"f": "fcmp oeq", "i": "icmp eq", "u": "icmp eq", "b": "icmp eq"},
    "!=": {"f": "fcmp une", "i": "icmp ne", "u": "icmp ne", "b": "icmp ne"},
}
"""LLVM's instructions, by the operator and the kind of its operands: `f` a float, `i` an integer
with a sign, `u` one without, `b` a truth value. `contract` allows a fused multiply-add, which
rounds once instead of twice; it is left out for `double`, whose digits the formulas count on. The
comparisons of floats are false for NaN, except `!=` (`olt`: ordered and less than; `une`: unordered
or not equal)."""


@functools.cache
def parts(type: str) -> tuple[str, int]:
    """Return the element type and the number of lanes of a type, 1 if it is not a vector."""
    match = _VECTOR.fullmatch(type)
    return (match[2], int(match[1])) if match else (type, 1)


@functools.cache
def vector(element: str, lanes: int) -> str:
    """Return the type of a vector; of one lane, that of its only element."""
    return element if lanes == 1 else f"<{lanes} x {element}>"


@functools.cache
def llvm_type(type: str) -> str:
    """Return the type as LLVM writes it."""
    return _UNSIGNED.sub(r"i\1", type)


@functools.cache
def _kind(type: str) -> str:
    """Return the kind of a type's elements, as in `_OPERATIONS`; `p` for an address."""
    element, _ = parts(type)
    if element == "i1":
        return "b"
    return {"h": "f", "f": "f", "d": "f", "i": "i", "u": "u"}.get(element[0], "p")


@functools.cache
def _instruction(operator: str, type: str) -> tuple[str, str]:
    """Return an operator's instruction with the type of its operands, and the result's type."""
    kind = _kind(type)
    if kind not in _OPERATIONS[operator]:
        raise TypeError(f"there is no {operator} of {type}")
    name = _OPERATIONS[operator][kind]
    if parts(type)[0] == "double":
        name = name.removesuffix(" contract")
    result = vector("i1", parts(type)[1]) if "cmp" in name else type
    return f"{name} {llvm_type(type)}", result


@functools.cache
def _conversion(source: str, to: str) -> str:
    """Return the instruction that converts an element; empty if the bits stay as they are."""
    one, other = _kind(source), _kind(to)
    if "p" in (one, other):
        raise TypeError(f"there is no conversion from {source} to {to}")
    a, b = _width(source), _width(to)
    if one == other == "f":
        return "" if a == b else "fpext" if a < b else "fptrunc"
    if other == "f":
        return "sitofp" if one == "i" else "uitofp"
    if one == "f":
        return "fptosi" if other == "i" else "fptoui"
    if a == b:
        return ""
    return "trunc" if a > b else "sext" if one == "i" else "zext"


def _width(element: str) -> int:
    return _WIDTHS.get(element) or int(element[1:])


def _binary(
    operator: str, *, swapped: bool = False
) -> Callable[["Value", "Value | Number"], "Value"]:
    """Return a method that applies an operator to a value and another one, or the reverse."""

    def apply(self: "Value", other: "Value | Number") -> "Value":
        # A number of Python takes the type of the other operand.
        if not isinstance(other, Value):
            other = self.writer.constant(other, self.type)
        elif other.type != self.type:
            raise TypeError(f"{self.type} {operator} {other.type}")
        first, second = (other, self) if swapped else (self, other)
        instruction, result = _instruction(operator, self.type)
        return self.writer.let(f"{instruction} {first.text}, {second.text}", result)

    return apply


_plus = _binary("+")


@dataclasses.dataclass(eq=False, slots=True)
class Value:
    """A `Value` is a number, a vector or an address in a register, or a constant."""

    writer: "LlvmWriter"
    text: str
    """Name of the register, or text of the constant."""
    type: str

    @property
    def typed(self) -> str:
        """Return the type and the text, as instructions name an operand."""
        return f"{llvm_type(self.type)} {self.text}"

    def __bool__(self) -> bool:
        """Raise TypeError: whether a value is true is known only when the function runs."""
        raise TypeError("a Value is known when the function runs: use select or when")

    def __add__(self, other: "Value | Number") -> "Value":
        """Return a sum; an address plus n is the address n floats further."""
        if _kind(self.type) == "p":
            return self.at(other) if isinstance(other, Value) or other else self
        return _plus(self, other)

    __radd__ = _binary("+", swapped=True)
    __sub__ = _binary("-")
    __rsub__ = _binary("-", swapped=True)
    __mul__ = _binary("*")
    __rmul__ = _binary("*", swapped=True)
    __truediv__ = _binary("/")
    __rtruediv__ = _binary("/", swapped=True)
    # The quotient of two integers is rounded towards zero; the rest has the dividend's sign.
    __floordiv__ = _binary("//")
    __mod__ = _binary("%")
    __and__ = _binary("&")
    __or__ = _binary("|")
    __xor__ = _binary("^")
    __lshift__ = _binary("<<")
    __rshift__ = _binary(">>")
    __lt__ = _binary("<")
    __le__ = _binary("<=")
    __gt__ = _binary(">")
    __ge__ = _binary(">=")
    equals = _binary("==")
    differs = _binary("!=")

    def __neg__(self) -> "Value":
        # Not 0 - x, which of 0 would be 0 instead of -0.
        if _kind(self.type) == "f":
            return self.writer.let(f"fneg {self.typed}", self.type)
        return self.__rsub__(0)

    def __invert__(self) -> "Value":
        return self ^ True

    def to(self, element: str) -> "Value":
        """Return the number, or each of a vector, converted to another type."""
        own, lanes = parts(self.type)
        result, instruction = vector(element, lanes), _conversion(own, element)
        if not instruction:
            return Value(self.writer, self.text, result)
        return self.writer.let(f"{instruction} {self.typed} to {llvm_type(result)}", result)

    def bits_as(self, type: str) -> "Value":
        """Return the same bits as another type."""
        return self.writer.let(f"bitcast {self.typed} to {llvm_type(type)}", type)

    def splat(self, lanes: int) -> "Value":
        """Return a vector whose lanes all hold the number."""
        if lanes == 1:
            return self
        result = vector(self.type, lanes)
        # Put the number into the first lane, and then that lane into all lanes.
        first = self.writer.let(
            f"insertelement {llvm_type(result)} poison, {self.typed}, i64 0", result
        )
        return self.writer.shuffle(first, None, [0] * lanes)

    def at(self, place: "Value | Number", element: str = "float") -> "Value":
        """Return the address so many elements behind this address."""
        index = place if isinstance(place, Value) else self.writer.constant(place, "i64")
        pointed = llvm_type(element)
        return self.writer.let(f"getelementptr {pointed}, {self.typed}, {index.typed}", self.type)

    def __getitem__(self, place: "Value | int") -> "Value":
        """Return the float that is stored so many floats behind an address."""
        return (self + place).load()

    def __setitem__(self, place: "Value | int", value: "Value | float") -> None:
        """Write a value so many floats behind an address."""
        (self + place).store(value)

    def load(self, type: str = "float", *, align: int | None = None) -> "Value":
        """Return what is stored at an address.

        Args:
          type: its type.
          align: bytes that the address is a multiple of; None: the size of an element.
        """
        return self.writer.let(f"load {llvm_type(type)}, {self.typed}{_aligned(type, align)}", type)

    def store(self, value: "Value | Number", *, align: int | None = None) -> None:
        """Write a value, or a float, to an address.

        Args:
          value: the value.
          align: bytes that the address is a multiple of; None: the size of an element.
        """
        given = value if isinstance(value, Value) else self.writer.constant(value)
        self.writer.do(f"store {given.typed}, {self.typed}{_aligned(given.type, align)}")


def _aligned(type: str, align: int | None) -> str:
    element, lanes = parts(type)
    # Without `align`, LLVM assumes that a vector is aligned to its whole size, and a load from
    # another address may crash.
    if align is None and lanes > 1:
        align = max(1, _width(element) // 8)
    return f", align {align}" if align else ""


class Phi:
    """A `Phi` is an instruction at the start of a block that selects a value by the block before.

    The ways into the block are added later, because the way back of a loop is written after it.
    """

    def __init__(self, value: Value) -> None:
        """Begin without a way into the block."""
        self.value = value
        self._ways: list[str] = []

    def joins(self, value: Value, label: str | None = None) -> None:
        """Add a way into the block.

        Args:
          value: the result if the function came this way.
          label: the block that the way comes from; None: the one that the writer appends to.
        """
        self._ways.append(f"[{value.text}, %{label or value.writer.label}]")

    def __str__(self) -> str:
        """Return the text of the instruction."""
        return f"{self.value.text} = phi {llvm_type(self.value.type)} {', '.join(self._ways)}"


class Repeat:
    """A `Repeat` is a loop that runs at least once and carries values between its iterations."""

    def __init__(self, writer: "LlvmWriter", initial: Sequence[Value]) -> None:
        """Begin the block of the loop."""
        self._writer = writer
        # The loop is one block that jumps to itself, with a phi for each value that it carries.
        self._label, self._after = writer.labels("loop", "after")
        before = writer.label
        writer.jump(self._label)
        writer.begin(self._label)
        self._phis = [writer.phi(value.type) for value in initial]
        for phi, value in zip(self._phis, initial, strict=True):
            phi.joins(value, before)
        self.carried = [phi.value for phi in self._phis]
        """The values at the start of an iteration."""
        self._is_ended = False

    def again(self, condition: Value, *following: Value) -> None:
        """End an iteration.

        Args:
          condition: whether there is another one.
          *following: the values that it begins with.
        """
        for phi, value in zip(self._phis, following, strict=True):
            phi.joins(value)
        self._writer.branch(condition, self._label, self._after)
        self._is_ended = True

    def end(self) -> None:
        """Begin the block after the loop."""
        assert self._is_ended, "the loop was not told when to run again"
        self._writer.begin(self._after)


class LlvmWriter:
    """An `LlvmWriter` appends the instructions of one function."""

    def __init__(
        self,
        name: str,
        *parameters: str,
        lanes: int = 1,
        result: str = "void",
        convention: str = "internal",
        keeps_blocks: bool = False,
    ) -> None:
        """Begin with the block `entry`.

        Args:
          name: the name of the function.
          *parameters: type, attributes and name of each parameter, such as `ptr noalias array`.
          lanes: the number of floats in a vector of the type `vector`.
          result: the type of the result.
          convention: `internal` for a function that only its own module calls, `external` for one
            that others call, `ptx_kernel` for one that a GPU launches.
          keeps_blocks: whether to forbid LLVM to compute a selection by a branch around a division.
        """
        self.name, self.lanes, self.result = name, lanes, result
        self.label = "entry"
        """The block that instructions are appended to."""
        self.declared: dict[str, None] = {}
        """Lines that the module needs beside the function, each of them once."""
        # Memory of the function, which the start of `entry` allocates.
        self._allocations: list[str] = []
        self._lines: list[str | Phi] = []
        self._count = 0
        self._suffix = ""
        if keeps_blocks:
            self.declare("!0 = !{}")
            self._suffix = ", !unpredictable !0"
        # The last word of a parameter is its name, the first one its type.
        given = [text.rpartition(" ")[::2] for text in parameters]
        self.parameters = [Value(self, f"%{name}", _parameter_type(kind)) for kind, name in given]
        texts = ", ".join(f"{llvm_type(kind)} %{name}" for kind, name in given)
        # Forbid LLVM to inline the functions of a kernel: one large function takes far longer to
        # compile than several small ones.
        attributes = " noinline" if convention == "internal" else ""
        self._head = f"define {convention} {llvm_type(result)} @{name}({texts}){attributes} {{"

    @property
    def vector(self) -> str:
        """Return the type of a vector of floats; with one lane, a float."""
        return vector("float", self.lanes)

    def text(self) -> str:
        """Return the text of the function; without `ret` at its end, it returns nothing."""
        last = [] if self._has_ended() else ["ret void"]
        lines = [*self._allocations, *map(str, self._lines), *last]
        return "\n  ".join([self._head + "\nentry:", *lines]) + "\n}\n"

    # Instructions.

    def do(self, instruction: str) -> None:
        """Append an instruction without a result."""
        self._lines.append(instruction)

    def let(self, instruction: str, type: str) -> Value:
        """Append an instruction, and return its result of the given type."""
        self._count += 1
        name = f"%v{self._count}"
        self._lines.append(f"{name} = {instruction}")
        return Value(self, name, type)

    def allocate(self, count: int, type: str, *, align: int) -> Value:
        """Return the address of memory that the function has until it returns.

        Args:
          count: the number of elements.
          type: their type.
          align: bytes that the address is a multiple of.
        """
        # Wherever it is used, memory is taken where the function begins: an `alloca` in a loop
        # would take more in every iteration.
        self._count += 1
        name = f"%v{self._count}"
        self._allocations.append(f"{name} = alloca [{count} x {llvm_type(type)}], align {align}")
        return Value(self, name, "ptr")

    def constant(self, number: Number, type: str = "float") -> Value:
        """Return a number that is known now; of a vector, all lanes hold it."""
        element, lanes = parts(type)
        kind = _kind(type)
        if kind == "f":
            # LLVM writes floats of all sizes as the hexadecimal bits of the `double` of the same
            # value. So round the number to a float32 first.
            number = (
                struct.unpack("f", struct.pack("f", number))[0] if _width(element) < 64 else number
            )
            text = f"0x{struct.pack('>d', number).hex().upper()}"
        elif kind == "b":
            text = "true" if number else "false"
        elif kind == "p":
            raise TypeError(f"there is no number {number} of type {type}")
        else:
            # LLVM writes integers with a sign: 2³² - 1 is -1.
            half = 1 << (_width(element) - 1)
            text = str((int(number) + half) % (2 * half) - half)
        return Value(self, text if lanes == 1 else f"splat ({llvm_type(element)} {text})", type)

    def select(self, condition: Value, yes: Value | Number, no: Value | Number) -> Value:
        """Return one of two values, of which at least one is no constant of Python."""
        one, other = self._alike(yes, no)
        operands = f"{condition.typed}, {one.typed}, {other.typed}"
        return self.let(f"select {operands}{self._suffix}", one.type)

    def minimum(self, one: Value | Number, other: Value | Number) -> Value:
        """Return the smaller of two numbers; the second if either is NaN."""
        a, b = self._alike(one, other)
        return self.select(a < b, a, b)

    def maximum(self, one: Value | Number, other: Value | Number) -> Value:
        """Return the larger of two numbers; the second if either is NaN."""
        a, b = self._alike(one, other)
        return self.select(a > b, a, b)

    def _alike(self, one: Value | Number, other: Value | Number) -> tuple[Value, Value]:
        """Return two values of the type that one of them has."""
        like = one if isinstance(one, Value) else other
        if not isinstance(like, Value):
            raise TypeError(f"{one} and {other} have no type")
        first, second = (
            x if isinstance(x, Value) else self.constant(x, like.type) for x in (one, other)
        )
        return first, second

    def shuffle(self, one: Value, other: Value | None, places: Sequence[int | None]) -> Value:
        """Return a vector of lanes of two vectors.

        Args:
          one: a vector.
          other: another one of its type; None: there is none.
          places: the lane that each lane of the result has, counted from the first of `one` to the
            last of `other`; None: any.
        """
        element, _ = parts(one.type)
        mask = ", ".join("i32 poison" if place is None else f"i32 {place}" for place in places)
        second = "poison" if other is None else other.text
        return self.let(
            f"shufflevector {one.typed}, {llvm_type(one.type)} {second},"
            f" <{len(places)} x i32> <{mask}>",
            f"<{len(places)} x {element}>",
        )

    def call(
        self, name: str, *operands: Value, result: str = "void", flags: str = "", suffix: str = ""
    ) -> Value:
        """Call a function, and return its result, which `void` does not have.

        Args:
          name: the name of the function, which is declared if it is LLVM's own.
          *operands: the arguments.
          result: the type of the result.
          flags: fast-math flags, such as `afn`.
          suffix: attributes of the call.
        """
        # Operands are written with their types.
        kind, given = llvm_type(result), ", ".join(x.typed for x in operands)
        # Functions of the module need no declaration.
        if name.startswith("llvm."):
            types = ", ".join(llvm_type(x.type) for x in operands)
            self.declare(f"declare {kind} @{name}({types})")
        words = ["call", flags, kind, f"@{name}({given})", suffix]
        instruction = " ".join(word for word in words if word)
        if result == "void":
            self.do(instruction)
            return Value(self, "", result)
        return self.let(instruction, result)

    def intrinsic(
        self, name: str, *operands: Value, result: str | None = None, flags: str = ""
    ) -> Value:
        """Call one of LLVM's functions that exist for many types, such as `sqrt`.

        Args:
          name: its name, without `llvm.` and types.
          *operands: the arguments.
          result: the type of the result; None: that of the first argument.
          flags: fast-math flags, such as `afn`.
        """
        # The full name has the types that vary, that of the result first:
        # `llvm.fptosi.sat.i32.f32`.
        types = [operands[0].type] if result is None else [result, operands[0].type]
        names = ".".join(_mangled(type) for type in types)
        return self.call(f"llvm.{name}.{names}", *operands, result=types[0], flags=flags)

    def declare(self, line: str) -> None:
        """Add a line to the module that the function is in, unless it has the same line."""
        # A dict keeps the order in which lines came, and each of them once.
        self.declared[line] = None

    # Control flow: a function is a list of blocks, of which each ends where it jumps to others.

    def labels(self, *names: str) -> list[str]:
        """Return labels for blocks that no other block has."""
        self._count += 1
        return [f"{name}{self._count}" for name in names]

    def begin(self, label: str) -> None:
        """Begin a block."""
        self._lines.append(f"{label}:")
        self.label = label

    def divide(self, place: int) -> None:
        """Begin another block in front of every 256th of many accesses of memory.

        LLVM compares the accesses of a block with each other, in a time quadratic in their number.

        Args:
          place: how many accesses came before.
        """
        if place and place % _MAX_ACCESSES == 0:
            (label,) = self.labels("more")
            self.jump(label)
            self.begin(label)

    def jump(self, label: str) -> None:
        """End a block, and go on at another one."""
        self.do(f"br label %{label}")

    def branch(self, condition: Value, yes: str, no: str) -> None:
        """End a block, and go on at one of two others."""
        self.do(f"br i1 {condition.text}, label %{yes}, label %{no}")

    def phi(self, type: str) -> Phi:
        """Begin a block with a value that depends on the block before."""
        self._count += 1
        phi = Phi(Value(self, f"%v{self._count}", type))
        self._lines.append(phi)
        return phi

    def ret(self, value: Value | None = None) -> None:
        """Return from the function."""
        self.do("ret void" if value is None else f"ret {value.typed}")

    def _has_ended(self) -> bool:
        return bool(self._lines) and str(self._lines[-1]).startswith("ret ")

    @contextlib.contextmanager
    def when(self, condition: Value) -> Iterator[None]:
        """Run what is appended inside only if a condition holds."""
        # Branch around the block of what is inside.
        then, end = self.labels("then", "end")
        self.branch(condition, then, end)
        self.begin(then)
        yield
        # A block that returns from the function does not go on at `end`.
        if not self._has_ended():
            self.jump(end)
        self.begin(end)

    @contextlib.contextmanager
    def loop(self, count: Value | int) -> Iterator[Value]:
        """Repeat what is appended inside.

        Args:
          count: the number of times, at least 0.

        Yields:
          The number of the iteration, from 0, of the type of `count` or else `u64`.
        """
        # The block `head` asks whether there is another iteration, `body` is one.
        type = count.type if isinstance(count, Value) else "u64"
        head, body, end = self.labels("head", "body", "end")
        before = self.label
        self.jump(head)
        self.begin(head)
        index = self.phi(type)
        index.joins(self.constant(0, type), before)
        self.branch(index.value < count, body, end)
        self.begin(body)
        yield index.value
        # What was appended inside may have begun other blocks: the way back comes from the last
        # one.
        index.joins(index.value + 1)
        self.jump(head)
        self.begin(end)

    @contextlib.contextmanager
    def repeat(self, *initial: Value) -> Iterator[Repeat]:
        """Repeat what is appended inside at least once, and carry values between the iterations.

        The values of the last iteration remain after the loop.

        Args:
          *initial: the values at the start of the first iteration.

        Yields:
          The loop, whose `again` must be called last.
        """
        loop = Repeat(self, initial)
        yield loop
        loop.end()


def _parameter_type(text: str) -> str:
    """Return the type of a parameter from its type and attributes."""
    # A vector, and an address in another memory, have types of several words.
    several = re.match(r"ptr addrspace\(\d+\)|<[^>]*>", text)
    return several[0] if several else text.split()[0]


def _mangled(type: str) -> str:
    """Return a type as it is part of the name of one of LLVM's functions: `f32`, `v8i32`."""
    element, lanes = parts(type)
    name = f"{'f' if _kind(type) == 'f' else 'i'}{_width(element)}"
    return name if lanes == 1 else f"v{lanes}{name}"


def module_text(functions: Iterable[LlvmWriter], *others: str) -> str:
    """Return the text of a module; functions and lines that are alike are in it once.

    Args:
      functions: its functions.
      *others: more text of the module.
    """
    functions = list(functions)
    # Declarations first, then the functions; a dict leaves out what comes twice.
    lines = [line for function in functions for line in function.declared]
    texts = [function.text() for function in functions]
    return "\n".join(dict.fromkeys([*lines, *texts, *others]))
