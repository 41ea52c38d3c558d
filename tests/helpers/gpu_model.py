"""A model in NumPy of the GPU that runs kernels of `tensor_core`: all threads of a block in step.

It executes the text of a kernel, instruction by instruction, for every block after the other, and
complains where two threads access a number in shared memory, one of them to change it, with no
barrier between them: on a GPU, the result would depend on which comes first.
"""

import re

import numpy as np

SHARED = 232_448

_ARITHMETIC = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "udiv": np.floor_divide,
    "urem": np.remainder,
    "shl": np.left_shift,
    "fadd contract": np.add,
    "fsub contract": np.subtract,
    "fmul contract": np.multiply,
    "icmp ult": np.less,
    "icmp eq": np.equal,
    "fcmp olt": np.less,
    "fcmp ole": np.less_equal,
    "fcmp ogt": np.greater,
    "fdiv contract": np.divide,
    "and": np.bitwise_and,
}
_INTRINSICS = {
    "fabs": np.abs,
    "maximum": np.maximum,
    "minimum": np.minimum,
    "sqrt": np.sqrt,
}
_FUNCTIONS = {
    "ex2.approx.ftz.f32": np.exp2,
    "lg2.approx.ftz.f32": np.log2,
    "rcp.approx.ftz.f32": np.reciprocal,
    "sqrt.approx.ftz.f32": np.sqrt,
    "tanh.approx.f32": np.tanh,
}
_OPERATION = "|".join(_ARITHMETIC)


class Races:
    """Who accessed each number of shared memory when, in barriers of the accessing warp.

    A warp knows of another one what that one did before the last barrier of both. Of its own lanes
    it knows what they did before its last barrier.
    """

    def __init__(self, threads):
        warps = threads // 32
        self.lane, self.warp = np.arange(threads), np.arange(threads) // 32
        self.time = np.ones(warps, int)
        self.known = np.zeros((warps, warps), int)
        self.writer = np.full(SHARED // 2, -1)
        self.written = np.zeros(SHARED // 2, int)
        # The last reader of each warp; -2 if there were several lanes.
        self.reader = np.full((SHARED // 2, warps), -1, np.int16)
        self.read = np.zeros((SHARED // 2, warps), np.int32)

    def barrier(self, warps):
        """Let some warps wait for each other."""
        for warp in warps:
            self.known[warp, warps] = self.time[warps]
        everything = self.known[warps].max(0)
        self.known[warps] = everything
        self.time[warps] += 1

    def load(self, threads, places):
        """Threads read halves of words."""
        writer, warp = self.writer[places], self.warp[threads]
        other = (writer >= 0) & (writer != threads)
        known = self.known[warp, np.where(other, writer, 0) // 32]
        assert not (other & (self.written[places] > known)).any(), "read while it is written"
        same = self.read[places, warp] == self.time[warp]
        several = same & (self.reader[places, warp] != threads)
        self.reader[places, warp] = np.where(several, -2, threads)
        self.read[places, warp] = self.time[warp]
        # Lanes that read one number together.
        clashing = self.reader[places, warp] != threads
        self.reader[places[clashing], warp[clashing]] = -2

    def store(self, threads, places, *, changed):
        """Threads write halves of words; writing what is there already disturbs nobody."""
        threads, places = threads[changed], places[changed]
        warp = self.warp[threads]
        writer = self.writer[places]
        other = (writer >= 0) & (writer != threads)
        known = self.known[warp, np.where(other, writer, 0) // 32]
        assert not (other & (self.written[places] > known)).any(), "two threads write it"
        late = self.read[places] > self.known[warp]
        late[np.arange(len(places)), warp] &= self.reader[places, warp] != threads
        assert not late.any(), "written while it is read"
        self.writer[places], self.written[places] = threads, self.time[warp]


class Gpu:
    """A GPU with the arrays that a kernel is given."""

    def __init__(self, text, arrays):
        self.threads = int(re.search(r'"maxntidx", i32 (\d+)', text)[1])
        body = text.partition("entry:\n")[2].partition("\n}")[0]
        self.lines = [line.strip() for line in body.splitlines()]
        self.labels = {line[:-1]: i for i, line in enumerate(self.lines) if line.endswith(":")}
        self.arrays = [x.reshape(-1) for x in arrays]

    def run(self, blocks, networks=1, seeds=1):
        """Run the kernel in all blocks of a grid."""
        for seed in range(seeds):
            for network in range(networks):
                for block in range(blocks):
                    grid = {"ctaid.x": block, "ctaid.y": network, "ctaid.z": seed}
                    self._block({**grid, "nctaid.x": blocks, "tid.x": np.arange(self.threads)})

    def _block(self, registers):
        self.special = registers
        zero = np.zeros(self.threads, int)
        self.values = {f"%a{i}": (zero + i, zero) for i in range(len(self.arrays))}
        # What was not written is not a number.
        self.memory = np.full(SHARED // 4, 0x7FFF7FFF, np.uint32)
        self.active = [np.ones(self.threads, bool)]
        self.races = Races(self.threads)
        self.label, self.before, at = "entry", "", 0
        while self.lines[at] != "ret void":
            at = self._step(self.lines[at], at)

    def _step(self, line, at):
        if line.endswith(":"):
            self.label, self.before = line[:-1], self.label
            if self.label.startswith("end"):
                self.active.pop()
        elif jump := re.fullmatch(r"br i1 (\S+), label %(\S+), label %(\S+)", line):
            condition, yes, no = jump.groups()
            if yes.startswith("then"):
                self.active.append(self.active[-1] & self._get("i1", condition))
            else:
                return self.labels[yes if self._get("i1", condition).all() else no]
        elif not line.startswith("br "):
            name, _, what = line.rpartition(" = ") if line.startswith("%") else ("", "", line)
            result = self._execute(what)
            if name:
                self.values[name] = result
        return at + 1

    def _get(self, kind, text):
        """The numbers of an operand in all threads."""
        if text.startswith("%"):
            return self.values[text]
        if kind == "float":
            bits = int(text, 16) if text.startswith("0x") else None
            number = float(text) if bits is None else np.uint64(bits).view(np.float64)
            return np.full(self.threads, number, np.float32)
        return np.full(self.threads, int(text) & 0xFFFFFFFF, np.uint32)

    def _execute(self, what):
        with np.errstate(all="ignore"):
            for pattern, method in _INSTRUCTIONS:
                if match := pattern.fullmatch(what):
                    return method(self, *match.groups())
        raise AssertionError(f"unknown: {what}")

    def _arithmetic(self, name, kind, one, other):
        return _ARITHMETIC[name](self._get(kind, one), self._get(kind, other))

    def _select(self, condition, kind, yes, no):
        condition, yes, no = self._get("i1", condition), self._get(kind, yes), self._get(kind, no)
        if kind.startswith("ptr"):
            return tuple(
                np.where(condition, one, other) for one, other in zip(yes, no, strict=True)
            )
        return np.where(condition, yes, no)

    def _phi(self, kind, one, one_label, other, other_label):
        assert self.before in (one_label, other_label), (self.before, one_label, other_label)
        return self._get(kind, one if self.before == one_label else other)

    def _special(self, name):
        return np.full(self.threads, 0, np.uint32) + np.asarray(self.special[name], np.uint32)

    def _shared(self, base, offset):
        start = np.zeros(self.threads, int) if base == "@shared" else self.values[base]
        return start + self._get("i32", offset).astype(int)

    def _element(self, base, index):
        array, start = self.values[base]
        return array, start + self._get("i32", index).astype(int)

    def _load_shared(self, kind, pointer):
        place = self.values[pointer]
        assert (place % 4 == 0).all()
        on = self.active[-1]
        self._note(self.races.load, on, place)
        words = np.where(on, self.memory[np.where(on, place // 4, 0)], 0).astype(np.uint32)
        return words.view(np.float32) if kind == "float" else words

    def _store_shared(self, kind, value, pointer):
        words = self._get(kind, value)
        words = np.asarray(words, np.float32 if kind == "float" else np.uint32).view(np.uint32)
        on, place = self.active[-1], self.values[pointer]
        written, unchanged = words[on], self.memory[place[on] // 4] == words[on]
        self._note(self.races.store, on, place, changed=np.repeat(~unchanged, 2))
        self.memory[place[on] // 4] = written
        # Threads that write one number together must agree.
        assert (self.memory[place[on] // 4] == written).all(), "two threads write it"

    def _note(self, access, on, place, **options):
        """Note an access to words, which are two halves each."""
        threads = np.repeat(self.races.lane[on], 2)
        access(threads, (place[on][:, None] // 2 + np.arange(2)).reshape(-1), **options)

    def _load(self, kind, pointer):
        arrays, places = self.values[pointer]
        result = np.zeros(self.threads, np.float32 if kind == "float" else np.uint32)
        for number in np.unique(arrays):
            on = self.active[-1] & (arrays == number)
            assert (places[on] >= 0).all()
            result[on] = self.arrays[number][places[on]]
        return result

    def _store(self, value, pointer):
        arrays, place = self.values[pointer]
        on = self.active[-1]
        assert (place[on] >= 0).all()
        self.arrays[arrays[0]][place[on]] = self._get("float", value)[on]

    def _halves(self, value):
        return np.asarray(self._get("i32", value), np.uint32)[:, None].view(np.float16)

    def _half(self, value, index):
        return self.values[value][:, int(index)]

    def _bitcast(self, value):
        return np.asarray(self.values[value], np.uint32).view(np.float32)

    def _assembly(self, name, operands):
        given = [self._get("float", x.split()[1]) for x in operands.split(", ")]
        if name == "cvt.rn.satfinite.f16x2.f32":
            most = np.finfo(np.float16).max
            high, low = (np.clip(x, -most, most).astype(np.float16) for x in given)
            return np.stack([low, high], axis=-1).view(np.uint32)[:, 0]
        return _FUNCTIONS[name](given[0])

    def _intrinsic(self, name, operands):
        return _INTRINSICS[name](*(self._get(*x.split()) for x in operands.split(", ")))

    def _matrices(self, transposed, pointer):
        """Four matrices of 8 x 8 numbers, whose rows the lanes of each warp point at."""
        place = self.values[pointer].reshape(-1, 4, 8)
        assert (place % 16 == 0).all()
        places = place[..., None] // 2 + np.arange(8)
        self.races.load(np.repeat(self.races.lane, 8), places.reshape(-1))
        numbers = self.memory.view(np.uint16)[places]
        if transposed:
            numbers = numbers.swapaxes(2, 3)
        pairs = np.ascontiguousarray(numbers).view(np.uint32)
        return [pairs[:, i].reshape(-1) for i in range(4)]

    def _extract(self, value, index):
        return self.values[value][int(index)]

    def _mma(self, operands):
        given = [self._get(*x.rsplit(" ", 1)) for x in operands.split(", ")]
        left, right, sums = given[:4], given[4:6], given[6:]

        warps, lane = self.threads // 32, np.arange(32)
        g, t = lane // 4, lane % 4 * 2
        a = np.zeros((warps, 16, 16), np.float32)
        b = np.zeros((warps, 16, 8), np.float32)
        c = np.zeros((warps, 16, 8), np.float32)
        for i in range(4):
            for j, half in enumerate(left[i].T):
                a[:, g + 8 * (i % 2), t + 8 * (i // 2) + j] = half.reshape(warps, 32)
            c[:, g + 8 * (i // 2), t + i % 2] = sums[i].reshape(warps, 32)
        for i in range(2):
            for j, half in enumerate(right[i].T):
                b[:, t + 8 * i + j, g] = half.reshape(warps, 32)
        c = c + a @ b
        return [c[:, g + 8 * (i // 2), t + i % 2].reshape(-1) for i in range(4)]

    def _barrier(self, text):
        assert self.active[-1].all(), "some threads do not come to the barrier"
        warps = np.arange(self.threads // 32)
        if "bar.sync 0" in text:
            self.races.barrier(warps)
        elif "bar.warp" in text:
            for warp in warps:
                self.races.barrier(warps[warp : warp + 1])
        else:
            count, name = re.search(r"bar.sync \$0, (\d+).*i32 (\S+)\)", text).groups()
            group = self.values[name].reshape(-1, 32)
            assert (group == group[:, :1]).all()
            for number in np.unique(group):
                members = warps[group[:, 0] == number]
                assert 0 < number < 16
                assert 32 * len(members) == int(count)
                self.races.barrier(members)


_INSTRUCTIONS = [
    (re.compile(pattern), method)
    for pattern, method in (
        (rf"({_OPERATION}) (\w+) (\S+), (\S+)", Gpu._arithmetic),
        (r"select i1 (\S+), (ptr addrspace\(1\)|\w+) (\S+), .* (\S+)", Gpu._select),
        (r"phi (\w+) \[(\S+), %(\S+)\], \[(\S+), %(\S+)\]", Gpu._phi),
        (r"call i32 @llvm\.nvvm\.read\.ptx\.sreg\.(\S+)\(\)", Gpu._special),
        (r"getelementptr i8, ptr addrspace\(3\) (\S+), i32 (\S+)", Gpu._shared),
        (r"getelementptr float, ptr addrspace\(1\) (\S+), i(?:32|64) (\S+)", Gpu._element),
        (r"load (\w+), ptr addrspace\(3\) (\S+), align 4", Gpu._load_shared),
        (r"store (\w+) (\S+), ptr addrspace\(3\) (\S+), align 4", Gpu._store_shared),
        (r"load (\w+), ptr addrspace\(1\) (\S+)", Gpu._load),
        (r"store float (\S+), ptr addrspace\(1\) (\S+)", Gpu._store),
        (r"zext i32 (\S+) to i64", lambda gpu, value: gpu.values[value]),
        (r"bitcast i32 (\S+) to float", Gpu._bitcast),
        (r"bitcast i32 (\S+) to <2 x half>", Gpu._halves),
        (r"extractelement <2 x half> (\S+), i32 (\d)", Gpu._half),
        (r"fpext half (\S+) to float", lambda gpu, value: gpu.values[value].astype(np.float32)),
        (r"extractvalue \{.*\} (\S+), (\d+)", Gpu._extract),
        (r"call float @llvm\.(\w+)\.f32\((.*)\)", Gpu._intrinsic),
        (r'(call void asm sideeffect "bar.*)', Gpu._barrier),
        (r'call \w+ asm "(\S+) [^"]*", "[^"]*"\((.*)\)', Gpu._assembly),
        (
            r"call \{.*\} @llvm\.nvvm\.ldmatrix\S*x4(\.trans)?\.b16\.p3\(\S+ \S+ (\S+)\) #0",
            Gpu._matrices,
        ),
        (r"call \{.*\} @llvm\.nvvm\.mma\S*f32\((.*)\) #0", Gpu._mma),
    )
]
