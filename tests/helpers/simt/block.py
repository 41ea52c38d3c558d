"""A block of threads, and what each instruction does in it."""

import re

import numpy as np

from helpers.simt.arithmetic import (
    ARITHMETIC,
    ASSEMBLY,
    INTRINSICS,
    TYPES,
    compare_floats,
    compare_integers,
    constant,
    signed,
)
from helpers.simt.memory import WARP, Clocks, Fault, Memory

PATTERNS = []
"""What the text of an instruction looks like, and the method of a `Block` that runs it."""

_NOWHERE = -1
_LOCAL = 0x4000
"""Number, in an address, of the first allocation of local memory."""
_FLAGS = r"(?: contract| afn| nsw| nuw)*"
_TYPE = r"(ptr addrspace\(\d\)|<2 x half>|\w+)"
_SPACE = r"ptr(?: addrspace\((\d)\))?"


def _runs(pattern):
    def register(method):
        PATTERNS.append((re.compile(pattern), method))
        return method

    return register


def _any(names):
    return "|".join(map(re.escape, names))


class Block:
    """A block of threads, which runs once."""

    def __init__(self, program, memories, registers, threads, shared_memory):
        self.program, self.memories, self.threads = program, memories, threads
        self.registers = registers | {"tid.x": np.arange(threads), "ntid.x": threads}
        # An address: the number of the array, from 1, in its upper 16 bits.
        bases = [np.full(threads, (i + 1) << 48, np.uint64) for i in range(len(memories))]
        parameters = bases[: len(program.parameters)]
        self.values = dict(zip(program.parameters, parameters, strict=True))
        # The kernel's tables are behind its parameters.
        first = len(memories) - len(program.tables)
        for i, name in enumerate(program.tables, start=first):
            self.values[name] = bases[i]
        self.values["@shared"] = np.zeros(threads, np.uint64)
        # What no thread has written is NaN.
        self.shared = Memory(np.full(shared_memory // 4, 0x7FFF7FFF, np.uint32))
        self.local = []
        self.clocks = Clocks(threads // WARP)
        # Where each thread is, the basic block from which it came, and the barrier it waits at.
        self.at = np.zeros(threads, int)
        self.origin = np.full(threads, _NOWHERE)
        self.awaited = np.full(threads, _NOWHERE)

    def run(self, number):
        """Run all threads to their ends, as the block of some number in the grid."""
        for memory in (self.shared, *self.memories):
            memory.enter(number, self.clocks)
        while (self.at != _NOWHERE).any():
            ready = (self.at != _NOWHERE) & (self.awaited == _NOWHERE)
            if not ready.any():
                raise Fault("a barrier that some of its threads never reach")
            here = self.at[ready].min()
            self.on = ready & (self.at == here)
            self.lanes, self.are_all = np.flatnonzero(self.on), bool(self.on.all())
            segment = self.program.segments[here]
            self.label = self.program.starts[segment.label]
            self.at[self.lanes] += 1
            # The phis of a basic block change their registers at once.
            results = [self._execute(x) for x in segment.phis]
            for phi, result in zip(segment.phis, results, strict=True):
                self._assign(phi.name, result)
            for instruction in segment.rest:
                result = self._execute(instruction)
                if instruction.name:
                    self._assign(instruction.name, result)

    def _execute(self, instruction):
        try:
            return instruction.method(self, *instruction.operands)
        except Fault as fault:
            place = {name: n for name, n in self.registers.items() if name.startswith("ctaid")}
            raise Fault(f"{fault}, in block {place}: {instruction.text}") from None

    def _assign(self, name, value):
        """Change a register of the running threads."""
        old = self.values.get(name)
        if not self.are_all and old is not None:
            if isinstance(value, list):
                value = [np.where(self.on, *pair) for pair in zip(value, old, strict=True)]
            else:
                value = np.where(self.on.reshape(-1, *[1] * (value.ndim - 1)), value, old)
        self.values[name] = value

    def _get(self, kind, text):
        """Return an operand in all threads."""
        # A constant is kept under its type and text.
        key = text if text.startswith(("%", "@")) else f"{kind} {text}"
        if key not in self.values and key != text:
            self.values[key] = np.full(self.threads, constant(kind, text))
        return self.values[key]

    def _given(self, operands):
        """Return the operands of a call."""
        return [self._get(*x.rsplit(" ", 1)) for x in operands.split(", ")]

    def _whole_warps(self):
        """Return the running warps."""
        on = self.on.reshape(-1, WARP)
        if (on.any(1) != on.all(1)).any():
            raise Fault("a part of a warp comes to an instruction of all its lanes")
        return np.flatnonzero(on[:, 0])

    # Control flow.

    @_runs(r"br label %(\S+)")
    def jump(self, target):
        self.at[self.lanes], self.origin[self.lanes] = self.program.starts[target], self.label

    @_runs(r"br i1 (\S+), label %(\S+), label %(\S+)")
    def branch(self, condition, yes, no):
        places = [self.program.starts[label] for label in (yes, no)]
        self.at[self.lanes] = np.where(self._get("i1", condition), *places)[self.lanes]
        self.origin[self.lanes] = self.label

    @_runs("ret void")
    def end(self):
        self.at[self.lanes] = _NOWHERE

    @_runs(rf"phi {_TYPE} (.*)")
    def phi(self, kind, pairs):
        covered, result = np.zeros(self.threads, bool), None
        for text, label in re.findall(r"\[\s*(\S+), %([\w.]+)\s*\]", pairs):
            comes = self.on & (self.origin == self.program.starts[label])
            if comes.any():
                value, covered = self._get(kind, text), covered | comes
                result = value if result is None else np.where(comes, value, result)
        assert covered[self.lanes].all(), "a phi without the block from which a thread came"
        return result

    @_runs(r'call void asm sideeffect "bar\.warp\.sync -1;", "~\{memory\}"\(\) #0')
    def warp_barrier(self):
        for warp in self._whole_warps():
            self.clocks.barrier(np.array([warp]))

    @_runs(
        r"call void (?:@llvm\.nvvm\.barrier0|asm sideeffect "
        r'"bar\.sync (?:0|\$0, (\d+));", "(?:r,)?~\{memory\}")\((?:i32 (\S+))?\)(?: #0)?'
    )
    def barrier(self, size, number):
        """Wait for as many threads at the barrier of some number, or for all at that of 0."""
        self._whole_warps()
        numbers = self._get("i32", number or "0")[self.lanes].astype(int)
        if (numbers >= 16).any():
            raise Fault("there are 16 barriers")
        if (numbers.reshape(-1, WARP) != numbers[::WARP, None]).any():
            raise Fault("a warp comes to several barriers")
        self.awaited[self.lanes] = numbers
        wanted = int(size or self.threads)
        for one in np.unique(numbers):
            arrived = np.flatnonzero(self.awaited == one)
            if len(arrived) > wanted:
                raise Fault(f"{len(arrived)} threads come to a barrier of {wanted}")
            if len(arrived) == wanted:
                self.awaited[arrived] = _NOWHERE
                self.clocks.barrier(np.unique(arrived // WARP))

    # Numbers.

    @_runs(rf"({_any(ARITHMETIC)}){_FLAGS} (\w+) (\S+), (\S+)")
    def arithmetic(self, name, kind, one, other):
        return ARITHMETIC[name](self._get(kind, one), self._get(kind, other))

    @_runs(r"fneg (\w+) (\S+)")
    def negation(self, kind, text):
        return -self._get(kind, text)

    @_runs(r"([fi]cmp) ([a-z]+) (\w+) (\S+), (\S+)")
    def comparison(self, which, name, kind, one, other):
        compare = compare_floats if which == "fcmp" else compare_integers
        return compare(name, self._get(kind, one), self._get(kind, other))

    @_runs(rf"select i1 (\S+), {_TYPE} (\S+), .* (\S+)")
    def selection(self, condition, kind, yes, no):
        return np.where(self._get("i1", condition), self._get(kind, yes), self._get(kind, no))

    @_runs(rf"bitcast {_TYPE} (\S+) to (\w+|<2 x half>)")
    def bits(self, kind, text, to):
        x = self._get(kind, text)
        return x[:, None].view(np.float16) if "half" in to else x.view(TYPES[to])

    @_runs(r"(zext|trunc|fpext|fptrunc|uitofp|sitofp|fptoui) (\w+) (\S+) to (\w+)")
    def conversion(self, name, kind, text, to):
        x = self._get(kind, text)
        if name == "fptoui":
            kept = np.trunc(x[self.lanes])
            if not ((kept >= 0) & (kept <= np.iinfo(TYPES[to]).max)).all():
                raise Fault(f"{to} cannot hold it")
        return (signed(x) if name == "sitofp" else x).astype(TYPES[to])

    @_runs(r"extractelement <2 x half> (\S+), i32 (\d)")
    def half(self, value, index):
        return self.values[value][:, int(index)]

    @_runs(r"extractvalue \{.*\} (\S+), (\d)")
    def part(self, value, index):
        return self.values[value][int(index)]

    @_runs(r"call i32 @llvm\.nvvm\.read\.ptx\.sreg\.([a-z.]+)\(\)")
    def special(self, name):
        return np.full(self.threads, self.registers[name], np.uint32)

    @_runs(rf"call{_FLAGS} (\w+) @llvm\.({_any(INTRINSICS)})(?:\.[if]\d+)+\((.*)\)")
    def intrinsic(self, kind, name, operands):
        result = INTRINSICS[name](*self._given(operands))
        return result.view(TYPES[kind]) if "sat" in name else result.astype(TYPES[kind])

    @_runs(rf'call \w+ asm(?: sideeffect)? "({_any(ASSEMBLY)}) [$0-9, ]*;", "[^"]*"\((.*)\)')
    def assembly(self, name, operands):
        return ASSEMBLY[name](*self._given(operands))

    @_runs(r'call i32 asm "mov\.u32 \$0, (\d+);", "=r"\(\)')
    def number(self, text):
        return self._get("i32", text)

    # Memory.

    @_runs(r"alloca \[(\d+) x (?:float|i32)\], align 4")
    def allocation(self, count):
        """Take local memory, of which each thread has its own; it is what nobody has written."""
        self.local.append(np.full((self.threads, int(count)), 0x7FFF7FFF, np.uint32))
        return np.full(self.threads, (_LOCAL + len(self.local) - 1) << 48, np.uint64)

    def _own(self, pointer):
        """Return the allocation that an address is in, and the running threads' words there."""
        addresses = self._get("ptr", pointer)[self.lanes]
        numbers = (addresses >> np.uint64(48)).astype(int) - _LOCAL
        offsets = (addresses & np.uint64((1 << 48) - 1)).astype(np.int64)
        if (numbers != numbers[0]).any() or not 0 <= numbers[0] < len(self.local):
            raise Fault("outside of an array of the thread")
        words = self.local[numbers[0]]
        if (offsets % 4).any() or (offsets // 4 >= words.shape[1]).any():
            raise Fault(f"beyond the {words.shape[1]} words of an array of the thread")
        return words, (self.lanes, offsets // 4)

    @_runs(r"getelementptr (\w+), ptr(?: addrspace\(\d\))? (\S+), (i32|i64) (\S+)")
    def element(self, kind, base, index_kind, index):
        index = signed(self._get(index_kind, index)).astype(np.int64)
        return self._get("ptr", base) + (index * np.dtype(TYPES[kind]).itemsize).view(np.uint64)

    def _located(self, space, pointer, kind):
        """Yield the memories that the running threads point to, those threads, and the words."""
        size, addresses = np.dtype(TYPES[kind]).itemsize, self._get("ptr", pointer)[self.lanes]
        if space == "3":
            yield self.shared, self.lanes, self.shared.places(addresses, size)
            return
        arrays = addresses >> np.uint64(48)
        for array in np.unique(arrays):
            if not 1 <= array <= len(self.memories):
                raise Fault("before the beginning of an array")
            memory, own = self.memories[int(array) - 1], arrays == array
            offsets = addresses[own] & np.uint64((1 << 48) - 1)
            yield memory, self.lanes[own], memory.places(offsets, size)

    @_runs(rf"load (\w+), {_SPACE} ([^ ,]+)(?:, align 4)?")
    def load(self, kind, space, pointer):
        result = np.zeros(self.threads, TYPES[kind])
        if space is None:
            words, places = self._own(pointer)
            result[self.lanes] = words[places].view(result.dtype)
            return result
        for memory, threads, places in self._located(space, pointer, kind):
            result[threads] = memory.load(threads, places).view(result.dtype)
        return result

    @_runs(rf"store (\w+) (\S+), {_SPACE} ([^ ,]+)(?:, align 4)?")
    def store(self, kind, value, space, pointer):
        words = self._get(kind, value)
        if space is None:
            own, places = self._own(pointer)
            own[places] = words[self.lanes].view(np.uint32)
            return
        for memory, threads, places in self._located(space, pointer, kind):
            memory.store(threads, places, words[threads].view(memory.words.dtype))

    # Matrices of float16.

    @_runs(
        r"call \{.*\} @llvm\.nvvm\.ldmatrix\.sync\.aligned\.m8n8\.x4(\.trans)?\.b16\.p3"
        r"\(ptr addrspace\(3\) (\S+)\) #0"
    )
    def matrices(self, transposed, pointer):
        """Load four matrices of 8 x 8 numbers, whose rows the lanes of each warp point at."""
        self._whole_warps()
        addresses = self._get("ptr", pointer)[self.lanes]
        if (addresses % np.uint64(16)).any():
            raise Fault("misaligned")
        rows = (addresses[:, None] + np.arange(0, 16, 4, dtype=np.uint64)).reshape(-1)
        words = self.shared.load(np.repeat(self.lanes, 4), self.shared.places(rows, 4))
        numbers = words.view(np.uint16).reshape(-1, 4, 8, 8)
        if transposed:
            numbers = numbers.swapaxes(2, 3)
        pairs = np.ascontiguousarray(numbers).view(np.uint32)
        results = np.zeros((4, self.threads), np.uint32)
        results[:, self.lanes] = pairs.swapaxes(0, 1).reshape(4, -1)
        return list(results)

    @_runs(r"call \{.*\} @llvm\.nvvm\.mma\.m16n8k16\.row\.col\.f32\.f32\((.*)\) #0")
    def product(self, operands):
        """Multiply 16 x 16 by 16 x 8 numbers in each warp, as NVIDIA distributes them to lanes."""
        self._whole_warps()
        given = self._given(operands)
        left, right, sums = given[:4], given[4:6], given[6:]
        warps, lane = self.threads // WARP, np.arange(WARP)
        g, t = lane // 4, lane % 4 * 2
        a = np.zeros((warps, 16, 16), np.float32)
        b, c = np.zeros((2, warps, 16, 8), np.float32)
        for i in range(4):
            for j, half in enumerate(left[i].T):
                a[:, g + 8 * (i % 2), t + 8 * (i // 2) + j] = half.reshape(warps, WARP)
            c[:, g + 8 * (i // 2), t + i % 2] = sums[i].reshape(warps, WARP)
        for i in range(2):
            for j, half in enumerate(right[i].T):
                b[:, t + 8 * i + j, g] = half.reshape(warps, WARP)
        c = c + a @ b
        return [c[:, g + 8 * (i // 2), t + i % 2].reshape(-1) for i in range(4)]
