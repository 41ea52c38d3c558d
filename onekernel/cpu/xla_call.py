"""Wrap a kernel as a function that XLA calls on a CPU, written as LLVM IR.

XLA passes the address of a call frame, a C structure with the addresses and shapes of all arguments
and results. `kernel_text` writes a function that reads the frame,
distributes blocks of instances to XLA's own threads, and copies each block between XLA's arrays and
a tile, whose rows hold one scalar of every instance of the block. A block has as many instances as
a vector register has lanes, and `step` advances all of them. No Python runs during the call.

The offsets are those of XLA's C header `xla/ffi/api/c_api.h`, version 0.3. Every structure states
its size, and the function returns without a result if a size differs from the expected one.
"""

import contextlib
from collections.abc import Iterable, Iterator, Sequence
from importlib import resources

from onekernel.codegen import (
    STEP,
    LlvmWriter,
    Value,
    map_function,
    memory_bytes,
    module_text,
    tile_function,
)
from onekernel.kernel import Kernel
from onekernel.lower import ScalarProgram

VERSION = (0, 3)
"""Version of XLA's foreign function interface that `xla_call.ll` is written for."""
SYMBOLS = ("malloc", "aligned_alloc", "free", "sched_yield")
"""Functions of the C library that a kernel calls."""

_BLOCKS_PER_THREAD = 4
"""Smallest number of blocks per thread; with fewer, a thread finishes before the next wakes up."""

MAX_WRITTEN_OUT = 256
"""Largest array of an instance that is copied without a loop."""

_ASSETS = resources.files("onekernel").joinpath("cpu")

MACHINES = ("x86_64", "aarch64")
"""Processors that a kernel can be written for."""

TEXT = _ASSETS.joinpath("xla_call.ll").read_text("utf-8")
"""The text that all kernels share: the function that XLA calls, and the work of its threads."""

BLOCK_PARAMETERS = ("ptr job", "u64 index", "ptr scratch")
"""Parameters of the function that computes a block."""


def kernel_text(kernel: Kernel, *, lanes: int, machine: str) -> str:
    """Write the LLVM module whose function XLA calls.

    The function takes and returns arrays of shape (instances, ...), whose words it copies as
    float32. With a table, it takes these arrays and the table, and returns the bytes of all
    instances, of shape (instances, items x results).

    Args:
      kernel: the kernel.
      lanes: the number of instances that make a step side by side; with a table, that of items.
      machine: the processor, one of `MACHINES`.

    Returns:
      The text of an LLVM module.

    Raises:
      UnsupportedError: the program has an operation that has no LLVM instruction.
    """
    if kernel.table is None:
        functions, instances = [*step_functions(kernel, lanes), _step_block(kernel, lanes)], lanes
    else:
        functions, instances = _map_functions(kernel, kernel.table.shape[1], lanes), 1
    return call_text(
        functions,
        instances_per_block=instances,
        blocks_per_thread=_BLOCKS_PER_THREAD,
        scratch=scratch_bytes(kernel, lanes),
        machine=machine,
    )


def scratch_bytes(kernel: Kernel, lanes: int) -> int:
    """Return the bytes of scratch memory that a block of a kernel takes, a multiple of 64.

    Its arrays are there: the stack of a thread is too small for them.

    Args:
      kernel: the kernel.
      lanes: the number of instances or items that run side by side.
    """
    # One part runs after the other.
    return max(memory_bytes(program, lanes) for program in kernel.programs)


def call_text(
    functions: Iterable[LlvmWriter],
    *,
    instances_per_block: int = 1,
    blocks_per_instance: int = 1,
    blocks_per_thread: int,
    scratch: int = 0,
    machine: str,
) -> str:
    """Write the LLVM module of a function that XLA calls, around one that computes a block.

    Args:
      functions: the function `block`, which takes the address of a job, the index of a block, and
        the address of its thread's scratch memory, and those that it calls. If some blocks must
        wait for others, also `needed`, which takes the address of a job and the index of a block,
        and returns the number of blocks that must have ended before. Blocks begin in their order.
      instances_per_block: the number of instances of a block.
      blocks_per_instance: the number of blocks of as many instances.
      blocks_per_thread: the smallest number of blocks for which a thread is worth its start.
      scratch: bytes of scratch memory, a multiple of 64.
      machine: the processor, one of `MACHINES`.
    """
    # Unless the caller gives an order, no block waits for another one.
    functions = list(functions)
    if all(function.name != "needed" for function in functions):
        at_once = LlvmWriter("needed", "ptr job", "u64 index", result="u64")
        at_once.ret(at_once.constant(0, "u64"))
        functions.append(at_once)
    # Constants that `xla_call.ll` reads.
    constants = {
        "blocks_per_instance": blocks_per_instance,
        "blocks_per_thread": blocks_per_thread,
        "instances_per_block": instances_per_block,
        "scratch_bytes": scratch,
    }
    lines = (f"@{name} = internal constant i64 {value}" for name, value in constants.items())
    processor = _ASSETS.joinpath(f"xla_call.{machine}.ll").read_text("utf-8")
    return module_text(functions, *lines, processor, TEXT)


def instance_count(job: Value) -> Value:
    """Return the number of instances of a job."""
    # %Job in `xla_call.ll` begins with five numbers of 64 bits; the fifth is the number of
    # instances.
    return job.at(4, "u64").load("u64")


def array_of(job: Value, place: int) -> Value:
    """Return the address of one of the arrays of a job: first the arguments, then the results."""
    # Behind these numbers come the addresses of the arrays.
    return job.at(5 + place, "u64").load("ptr")


def job_of_one(arrays: Sequence[Value]) -> Value:
    """Return the address of a job of one instance, for calls of `block` by others than XLA.

    Args:
      arrays: the addresses of the arrays.
    """
    w = arrays[0].writer
    job = w.allocate(5 + len(arrays), "u64", align=8)
    job.at(4, "u64").store(w.constant(1, "u64"))
    for i, address in enumerate(arrays):
        job.at(5 + i, "u64").store(address)
    return job


def _step_block(kernel: Kernel, lanes: int) -> LlvmWriter:
    """Write the function that takes a block of instances through all steps."""
    w = LlvmWriter("block", *BLOCK_PARAMETERS)
    job, index, scratch = w.parameters
    instances = instance_count(job)
    first = index * lanes
    # `block` reads the addresses from the job; `instances` does the work and knows nothing of jobs.
    arrays = range(len(kernel.argument_shapes) + len(kernel.results()))
    memory = [scratch] if scratch_bytes(kernel, lanes) else []
    w.call("instances", *(array_of(job, i) for i in arrays), first, instances, *memory)
    return w


def step_functions(kernel: Kernel, lanes: int) -> list[LlvmWriter]:
    """Write a function that takes instances through all steps of a kernel, and those that it calls.

    It is called `instances`, and takes the addresses of the arguments and results, arrays of all
    instances, the first instance, and how many instances there are, and that of `scratch_bytes`,
    aligned to 64 bytes, if there are any; it steps as many as there are lanes.

    Args:
      kernel: the kernel, without a table.
      lanes: the number of instances that make a step side by side.

    Raises:
      UnsupportedError: the program has an operation that has no LLVM instruction.
    """
    sizes, results = kernel.argument_words, kernel.result_words
    # The tile begins with the rows of the step's arguments, where it also leaves its results. If
    # there are parts before the first step and after the last, the kernel's own arguments follow.
    step_rows = range(sum(array.size for array in kernel.program.inputs))
    stepped = range(sum(array.size for array in kernel.program.outputs))
    start = 0 if kernel.before is None else max(len(step_rows), len(stepped))
    rows = range(start, start + sum(sizes))
    # One function for each part; each reads its arguments from rows of the tile, and writes its
    # results to the first rows. So `after` finds the results of the step in the first rows, and its
    # arguments behind.
    functions = [tile_function(kernel.program, lanes=lanes, name=STEP, rows=step_rows)]
    if kernel.before is not None:
        functions.append(tile_function(kernel.before, lanes=lanes, name="before", rows=rows))
    if kernel.after is not None:
        own = [*rows, *stepped]
        functions.append(tile_function(kernel.after, lanes=lanes, name="after", rows=own))
    # The tile must hold whatever any part reads or writes.
    height = max(1, rows.stop, sum(results), len(stepped))
    return [*functions, _instances(kernel, lanes, start, height)]


def _instances(kernel: Kernel, lanes: int, start: int, height: int) -> LlvmWriter:
    """Write the function `instances` of `step_functions`.

    Args:
      kernel: the kernel.
      lanes: the number of instances that make a step side by side.
      start: the first row of the tile for the arguments; those of the results begin at 0.
      height: the number of rows of the tile.
    """
    sizes, results = kernel.argument_words, kernel.result_words
    names = [f"ptr a{i}" for i in range(len(sizes) + len(results))]
    parameters = [*names, "u64 first", "u64 instances"]
    parameters += ["ptr memory"] if scratch_bytes(kernel, lanes) else []
    w = LlvmWriter("instances", *parameters, lanes=lanes)
    arrays, (first, instances, *memory) = w.parameters[: len(names)], w.parameters[len(names) :]
    # Rows of the tile are scalars, columns are instances.
    tile = w.let(f"alloca [{height} x {w.vector}], align {4 * lanes}", "ptr")
    zero, last = w.constant(0, "u64"), instances - 1
    # Copy the arguments to the tile.
    with w.repeat(zero) as loop:
        (lane,) = loop.carried
        wanted = first + lane
        # Lanes beyond the last instance step a copy of it, so that they compute valid numbers.
        instance = w.select(wanted < instances, wanted, last)
        row = start
        for array, size in zip(arrays, sizes, strict=False):
            begin = instance * size
            with _indices(w, size) as indices:
                for i in indices:
                    value = array[begin + i]
                    (tile + (i + row) * lanes)[lane] = value
            row += size
        following = lane + 1
        loop.again(following < lanes, following)
    # Step.
    if kernel.before is not None:
        _run("before", kernel.before, tile, memory)
    with w.repeat(zero) as loop:
        # The results overwrite the rows of the carried arguments; the other arguments stay for the
        # next step.
        _run(STEP, kernel.program, tile, memory)
        following = loop.carried[0] + 1
        loop.again(following < kernel.steps, following)
    if kernel.after is not None:
        _run("after", kernel.after, tile, memory)
    # Copy the results from the tile.
    with w.repeat(zero) as loop:
        (lane,) = loop.carried
        instance, row = first + lane, 0
        for array, size in zip(arrays[len(sizes) :], results, strict=True):
            begin = instance * size
            with _indices(w, size) as indices:
                for i in indices:
                    value = (tile + (i + row) * lanes)[lane]
                    array[begin + i] = value
            row += size
        following = lane + 1
        # Do not store the lanes beyond the last instance.
        loop.again((following < lanes) & (instance + 1 < instances), following)
    return w


def _run(name: str, program: ScalarProgram, tile: Value, memory: Sequence[Value]) -> None:
    """Append a call of a `tile_function`, with memory if the program has arrays."""
    w = tile.writer
    w.call(name, tile, *(memory if memory_bytes(program, w.lanes) else []))


@contextlib.contextmanager
def _indices(w: LlvmWriter, size: int) -> Iterator[Iterable[Value | int]]:
    """Yield the indices of an array, for each of which to append its accesses.

    Those of a large array are one index, of a loop around what is appended inside.
    """
    # LLVM takes a time quadratic in the number of accesses: 20 s for 2,000.
    if size <= MAX_WRITTEN_OUT:
        yield range(size)
    else:
        with w.loop(size) as i:
            yield [i]


def _map_functions(kernel: Kernel, items: int, lanes: int) -> list[LlvmWriter]:
    """Write the function that computes all items of an instance, and the one that it calls."""
    w = LlvmWriter("block", *BLOCK_PARAMETERS)
    job, index, scratch = w.parameters
    # All instances share the table, which stands between the arguments and the results.
    # Bytes from one instance to the next in each array: float32 arguments, the table, the results.
    rows = [*(4 * words for words in kernel.argument_words), 0]
    rows.append(items * len(kernel.program.outputs))
    arrays = [array_of(job, i) for i in range(len(rows))]
    addresses = [array.at(index * size, "u8") for array, size in zip(arrays, rows, strict=True)]
    memory = [scratch] if scratch_bytes(kernel, lanes) else []
    w.call(STEP, *addresses, *memory)
    return [map_function(kernel.program, lanes=lanes, items=items), w]
