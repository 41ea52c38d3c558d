"""A machine for the PTX that `jetbot_mjx.ptx` writes: all threads at once, in NumPy."""

import re
import struct

import numpy as np

COMPARE = {
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
    "eq": np.equal,
    "ne": np.not_equal,
    "neu": np.not_equal,
    "nan": lambda a, b: np.isnan(a) | np.isnan(b),
}
ARITHMETIC = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "mul.lo": np.multiply,
    "div.rn": np.divide,
    "max": np.fmax,
    "min": np.fmin,
    "abs": np.abs,
    "neg": np.negative,
    "sqrt.rn": np.sqrt,
    "and": np.logical_and,
    "or": np.logical_or,
    "xor": np.logical_xor,
    "not": np.logical_not,
}


def run(source, blocks, arguments, outputs):
    """Runs a kernel; `outputs` are float32 arrays of (robots, ...) that it writes into."""
    threads = int(re.search(r"\.maxntid (\d+)", source)[1])
    names = re.findall(r"\.param \.u64 (\w+)", source)
    memory = dict(zip(names, [x.reshape(len(x), -1) for x in (*arguments, *outputs)], strict=True))
    code = [line.strip() for line in source.partition("{")[2].splitlines()]
    code = [line for line in code if line and not line.startswith(".") and line != "}"]
    labels = {line[:-1]: i for i, line in enumerate(code) if line.endswith(":")}
    count = blocks * threads
    registers = {}
    alive = np.ones(count, bool)
    pointer = None

    def value(name):
        if name.startswith("0f"):
            return np.float32(struct.unpack(">f", bytes.fromhex(name[2:]))[0])
        if name.startswith("%ctaid"):
            return np.arange(count) // threads
        if name.startswith("%tid"):
            return np.arange(count) % threads
        return registers[name] if name.startswith("%") else int(name)

    at = 0
    with np.errstate(all="ignore"):
        while at < len(code):
            line = code[at].rstrip(";")
            at += 1
            if line.endswith(":"):
                continue
            guard, line = re.match(r"(?:@(%\w+) )?(.*)", line).groups()
            op, _, rest = line.partition(" ")
            args = [arg.strip() for arg in rest.split(",")] if rest else []
            if op == "ret":
                if guard is None:
                    break
                alive &= ~registers[guard]
            elif op == "bra":
                taken = registers[guard][alive]
                assert taken.all() or not taken.any()
                at = labels[args[0]] if taken.all() else at
            elif op == "ld.param.u64":
                pointer = memory[args[1].strip("[]")]
            elif op == "mul.wide.u32":
                assert int(args[2]) == 4 * pointer.shape[1]
            elif op in ("cvta.to.global.u64", "add.u64"):
                pass
            elif op == "ld.global.f32":
                column = np.zeros(count, np.float32)
                column[alive] = pointer[:, offset(args[1])]
                registers[args[0]] = column
            elif op == "st.global.f32":
                pointer[:, offset(args[0])] = value(args[1])[alive]
            else:
                registers[args[0]] = compute(op, [value(arg) for arg in args[1:]])
            if args and args[0] in registers:
                registers[args[0]] = np.broadcast_to(registers[args[0]], (count,))


def offset(place):
    return int(re.fullmatch(r"\[%address\+(\d+)\]", place)[1]) // 4


def compute(op, values):
    first, _, kind = op.rpartition(".")
    if first.startswith("setp"):
        return COMPARE[first.split(".")[1]](*values)
    if first == "mad.lo":
        return values[0] * values[1] + values[2]
    if first == "mov":
        return values[0]
    if first == "selp":
        return np.where(values[2], values[0], values[1])
    if op == "cvt.rmi.f32.f32":
        return np.floor(values[0])
    if op == "cvt.rn.f32.s32":
        return np.float32(values[0])
    if op == "cvt.rzi.s32.f32":
        return np.trunc(values[0]).astype(np.int32)
    if op == "testp.finite.f32":
        return np.isfinite(values[0])
    result = ARITHMETIC[first](*values)
    return np.float32(result) if kind == "f32" else result
