"""Wrap a kernel as a function that XLA calls on a CPU, written as LLVM IR.

XLA passes the address of a call frame. `kernel_text` writes a function that reads the frame,
distributes blocks of robots to XLA's own threads, and copies each block between XLA's arrays and a
tile, whose rows hold one scalar of every robot of the block. A block has as many robots as a vector
register has lanes, and `step` advances all of them. No Python runs during the call.

The offsets are those of XLA's C header `xla/ffi/api/c_api.h`, version 0.3. Every structure states
its size, and the function returns without a result if a size differs from the expected one.
"""

import math
from collections.abc import Sequence
from importlib import resources
from string import Template
from typing import Any

from jetbot_mjx.compiler.kernel import Kernel
from jetbot_mjx.compiler.llvm_codegen import STEP, declarations, map_text, tile_text

VERSION = (0, 3)
"""Version of XLA's foreign function interface."""

SYMBOLS = ("malloc", "aligned_alloc", "free", "sched_yield")
"""Functions of the C library that a kernel calls."""

_BLOCKS_PER_THREAD = 4
"""Smallest number of blocks per thread; with fewer, a thread finishes before the next wakes up."""

_PATIENCE = 1000
"""Number of polls for the other threads, about 20 µs, before a thread yields its core."""

_ASSETS = resources.files("jetbot_mjx").joinpath("assets")

MACHINES = ("x86_64", "aarch64")
"""Processors that a kernel can be written for."""

TEXT = _ASSETS.joinpath("xla_call.ll").read_text("utf-8")
"""Template of all kernels."""


def kernel_text(kernel: Kernel, *, lanes: int, name: str, machine: str) -> str:
    """Write the LLVM module whose function XLA calls.

    The function takes and returns float32 arrays of shape (robots, ...). With a
    table, it takes these arrays and the table, and returns the bytes of all robots, of shape
    (robots, items x results).

    Args:
      kernel: the kernel.
      lanes: the number of robots that make a step side by side; with a table, that of items.
      name: the name of the function, a C identifier.
      machine: the processor, one of `MACHINES`.

    Returns:
      The text of an LLVM module.

    Raises:
      UnsupportedError: the program has an operation that has no LLVM instruction.
    """
    sizes = [math.prod(shape) for shape in kernel.argument_shapes]
    if kernel.table is None:
        block = _step_block(kernel, lanes)
        arguments, results, robots = len(sizes), len(kernel.results()), lanes
    else:
        block = _map_block(kernel, sizes, kernel.table.shape[1], lanes)
        arguments, results, robots = len(sizes) + 1, 1, 1
    return call_text(
        block,
        arguments=arguments,
        results=results,
        robots_per_block=robots,
        blocks_per_thread=_BLOCKS_PER_THREAD,
        name=name,
        machine=machine,
    )


def call_text(
    block: str,
    *,
    arguments: int,
    results: int,
    robots_per_block: int = 1,
    blocks_per_robot: int = 1,
    blocks_per_thread: int,
    scratch: int = 0,
    needed: str = "add i64 0, 0",
    name: str,
    machine: str,
) -> str:
    """Write the LLVM module of a function that XLA calls, around one that computes a block.

    Args:
      block: the text of the function `block`, which takes the address of a job, the index of a
        block, and the address of its thread's scratch memory, and of what it needs; `address`
        reads the arrays from a job.
      arguments: the number of arrays that it reads; the first axis of the first one has the robots.
      results: the number of arrays that it writes.
      robots_per_block: the number of robots of a block.
      blocks_per_robot: the number of blocks of as many robots.
      blocks_per_thread: the smallest number of blocks for which a thread is worth its start.
      scratch: bytes of scratch memory, a multiple of 64.
      needed: an instruction whose result is the number of blocks that must have ended before block
        `%index` of `%job` begins. Blocks begin in their order.
      name: the name of the function, a C identifier.
      machine: the processor, one of `MACHINES`.
    """
    arrays = arguments + results
    values = {
        "arrays": arrays,
        "block": block,
        "blocks_per_robot": blocks_per_robot,
        "blocks_per_thread": blocks_per_thread,
        "fill": robots_per_block - 1,
        "major": VERSION[0],
        "minor": VERSION[1],
        "name": name,
        "needed": needed,
        "patience": _PATIENCE,
        "pointers": "\n  ".join(_pointer(i, arguments) for i in range(arrays)),
        "robots_per_block": robots_per_block,
        "scratch": scratch,
    }
    processor = _ASSETS.joinpath(f"xla_call.{machine}.ll").read_text("utf-8")
    return processor + Template(TEXT).substitute(values)


def _step_block(kernel: Kernel, lanes: int) -> str:
    """Write the function that takes a block of robots through all steps."""
    arrays = range(len(kernel.argument_shapes) + len(kernel.results()))
    values = {
        "addresses": "\n  ".join(map(address, arrays)),
        "arrays": ", ".join(f"ptr %a{i}" for i in arrays),
        "lanes": lanes,
    }
    declared = "\n".join(declarations(lanes)) + "\n"
    block = _template("xla_block.ll").substitute(values)
    return declared + step_text(kernel, lanes) + block


def step_text(kernel: Kernel, lanes: int) -> str:
    """Write a function that takes robots through all steps of a kernel.

    It is called `robots`, and takes the addresses of the arguments and results, arrays of all
    robots, the first robot, and how many robots there are; it steps as many as there are lanes.

    Args:
      kernel: the kernel, without a table.
      lanes: the number of robots that make a step side by side.

    Returns:
      The text of the function and of those that it calls, without `llvm_codegen.declarations`.

    Raises:
      UnsupportedError: the program has an operation that has no LLVM instruction.
    """
    sizes = [math.prod(shape) for shape in kernel.argument_shapes]
    results = [math.prod(result.shape) for result in kernel.results()]
    # The tile begins with the rows of the step, or its results; the arguments follow, if what comes
    # before or after the step reads them too.
    step_rows = range(sum(array.size for array in kernel.program.inputs))
    stepped = range(sum(array.size for array in kernel.program.outputs))
    start = 0 if kernel.before is None else max(len(step_rows), len(stepped))
    rows = range(start, start + sum(sizes))
    functions: dict[str, tuple[Any, Sequence[int]]] = {STEP: (kernel.program, step_rows)}
    if kernel.before is not None:
        functions["before"] = kernel.before, rows
    if kernel.after is not None:
        functions["after"] = kernel.after, [*rows, *stepped]
    values = {
        "after": "" if kernel.after is None else "call void @after(ptr %tile)",
        "alignment": 4 * lanes,
        "before": "" if kernel.before is None else "call void @before(ptr %tile)",
        "lanes": lanes,
        "pointers": ", ".join(f"ptr %a{i}" for i in range(len(sizes) + len(results))),
        "reads": _copies("%r{i} = mul i64 %robot, {size}", _READ, sizes, lanes, row=start),
        "rows": max(1, rows.stop, sum(results), len(stepped)),
        "step": STEP,
        "steps": kernel.steps,
        "writes": _copies("%w{i} = mul i64 %to, {size}", _WRITE, results, lanes, first=len(sizes)),
    }
    texts = [
        tile_text(program, lanes=lanes, name=name, rows=rows)
        for name, (program, rows) in functions.items()
    ]
    return "".join(texts) + _template("xla_step.ll").substitute(values)


def _map_block(kernel: Kernel, sizes: Sequence[int], items: int, lanes: int) -> str:
    """Write the function that computes all items of a robot."""
    # The address of a robot's row is that of its array, plus the row; all share the table.
    rows = [*(4 * size for size in sizes), 0, items * len(kernel.program.outputs)]
    values = {
        "addresses": "\n  ".join(
            f"{address(i)}\n"
            f"  %row{i} = mul i64 %index, {size}\n"
            f"  %p{i} = getelementptr i8, ptr %a{i}, i64 %row{i}"
            for i, size in enumerate(rows)
        ),
        "pointers": ", ".join(f"ptr %p{i}" for i in range(len(rows))),
        "step": STEP,
    }
    function = map_text(kernel.program, lanes=lanes, items=items)
    return function + _template("xla_map.ll").substitute(values)


def _template(file: str) -> Template:
    return Template(_ASSETS.joinpath(file).read_text("utf-8"))


def address(i: int) -> str:
    """Return the lines that load the address of array `i` of a job as `%a{i}`."""
    return (
        f"%a{i}.at = getelementptr %Job, ptr %job, i32 0, i32 5, i64 {i}\n"
        f"  %a{i} = load ptr, ptr %a{i}.at"
    )


def _pointer(i: int, arguments: int) -> str:
    """Return the lines that copy an argument's or result's address from the call frame to a job."""
    source, place = ("buffers", i) if i < arguments else ("outputs", i - arguments)
    return (
        f"%b{i}.at = getelementptr ptr, ptr %{source}, i64 {place}\n"
        f"  %b{i} = load ptr, ptr %b{i}.at\n"
        f"  %d{i}.at = getelementptr i8, ptr %b{i}, i64 24\n"
        f"  %d{i} = load ptr, ptr %d{i}.at\n"
        f"  %j{i} = getelementptr %Job, ptr %job, i32 0, i32 5, i64 {i}\n"
        f"  store ptr %d{i}, ptr %j{i}"
    )


_READ = """\
%ri{i}.{j} = add i64 %r{i}, {j}
  %rp{i}.{j} = getelementptr float, ptr %a{i}, i64 %ri{i}.{j}
  %rv{i}.{j} = load float, ptr %rp{i}.{j}
  %rt{i}.{j} = getelementptr <{lanes} x float>, ptr %tile, i64 {row}, i64 %lane
  store float %rv{i}.{j}, ptr %rt{i}.{j}"""
"""Lines that copy one scalar of a robot's arguments into its lane of the tile."""

_WRITE = """\
%wt{i}.{j} = getelementptr <{lanes} x float>, ptr %tile, i64 {row}, i64 %out
  %wv{i}.{j} = load float, ptr %wt{i}.{j}
  %wi{i}.{j} = add i64 %w{i}, {j}
  %wp{i}.{j} = getelementptr float, ptr %a{i}, i64 %wi{i}.{j}
  store float %wv{i}.{j}, ptr %wp{i}.{j}"""
"""Lines that copy one scalar of a robot's results from its lane of the tile."""


def _copies(
    start: str, copy: str, sizes: Sequence[int], lanes: int, first: int = 0, row: int = 0
) -> str:
    """Return the lines that copy arrays, the first of which has the number `first`.

    Args:
      start: the line that computes where a robot's row of an array begins.
      copy: the lines that copy one scalar.
      sizes: the number of scalars per robot in each array.
      lanes: the number of robots in a block.
      first: the number of the first array.
      row: the row of the tile of its first scalar.
    """
    lines = []
    for i, size in enumerate(sizes, start=first):
        lines.append(start.format(i=i, size=size))
        for j in range(size):
            lines.append(copy.format(i=i, j=j, row=row, lanes=lanes))
            row += 1
    return "\n  ".join(lines)
