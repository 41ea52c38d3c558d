"""Divide the text of a kernel into what threads run without parting or waiting."""

import functools
import re
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from helpers.simt.block import PATTERNS, Block


class Instruction(NamedTuple):
    """An instruction, and the method of a `Block` that runs it."""

    text: str
    name: str
    """The register of its result, or nothing."""
    method: Callable[..., Any]
    operands: tuple[str | None, ...]


class Segment(NamedTuple):
    """Instructions of a basic block, up to its end or a barrier."""

    label: str
    phis: list[Instruction]
    rest: list[Instruction]


class Program(NamedTuple):
    """A kernel."""

    parameters: list[str]
    threads: int
    """Most threads of a block."""
    segments: list[Segment]
    starts: dict[str, int]
    """The first segment of each basic block."""
    tables: dict[str, np.ndarray]
    """Words that the module brings along, by their name."""


@functools.lru_cache(8)
def parsed(text):
    """Return the kernel of a module of LLVM IR."""
    parameters, body = re.search(
        r"^define ptx_kernel void @\w+\((.*?)\) \{\n(.*?)^\}", text, re.DOTALL | re.MULTILINE
    ).groups()
    segments, starts = [], {}
    for line in map(str.strip, body.splitlines()):
        if line.endswith(":"):
            starts[line[:-1]] = len(segments)
            segments.append(Segment(line[:-1], [], []))
        elif line and not line.startswith(";"):
            instruction = _instruction(line)
            is_phi = instruction.method is Block.phi
            (segments[-1].phis if is_phi else segments[-1].rest).append(instruction)
            if instruction.method is Block.barrier:
                segments.append(Segment(segments[-1].label, [], []))
    threads = int(re.search(r'"maxntidx", i32 (\d+)', text)[1])
    tables = {
        name: np.int32([word.split()[1] for word in words.split(", ")]).view(np.uint32)
        for name, words in re.findall(
            r"^(@\w+) = internal addrspace\(1\) constant \[\d+ x i32\] \[(.*?)\]",
            text,
            re.MULTILINE,
        )
    }
    return Program(re.findall(r"%[\w.]+", parameters), threads, segments, starts, tables)


def _instruction(line):
    name, what = line.split(" = ", 1) if line.startswith("%") else ("", line)
    for pattern, method in PATTERNS:
        if match := pattern.fullmatch(what):
            return Instruction(line, name, method, match.groups())
    raise NotImplementedError(line)
