"""Compile and launch kernels on NVIDIA GPUs; this module is a `jetbot_mjx.compiler.kernel.Backend`.

LLVM compiles a kernel to PTX, NVIDIA's portable assembly, and XLA passes the PTX to the driver
through its custom call for PTX kernels. That call is internal to XLA, so `obstacle` tries
whether the installed version has it. Each thread runs the whole program for one robot, with all
intermediate values in registers.
"""

import contextlib
import ctypes
import functools
import importlib
import math
from collections.abc import Mapping, Sequence
from importlib import resources
from string import Template
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from jetbot_mjx.compiler.background import in_background
from jetbot_mjx.compiler.kernel import Kernel, probe
from jetbot_mjx.compiler.llvm_codegen import LlvmEmitter

IMPL: str = "ptx"
PLATFORM: str = "cuda"

_MAX_THREADS = 256
"""Largest number of robots in a block: with 255 registers each, it fills a multiprocessor."""

_MIN_THREADS = 32

_ITEM_THREADS = 128
"""Number of threads that compute the items of a robot."""

_DIRECT_WORDS = 32
"""Number of words of a robot that its thread reads where they are. Of longer rows, the threads of a
block copy their part of an array to shared memory and back, each the word beside that of the next
thread: threads that each read a row of their own wait 70 µs for 65,536 rows of 77 words."""

_SHARED_MEMORY = {70: 49_152, 80: 98_304, 90: 98_304}
"""Bytes of shared memory for that, by target architecture; all GPUs that run its code have it."""

_BLOCKS = 128
"""Number of blocks above which blocks grow: a GPU has about as many multiprocessors."""

_TEXT = resources.files("jetbot_mjx").joinpath("assets/ptx_kernel.ll").read_text("utf-8")
"""Template of the kernels that step."""

_MAP_TEXT = resources.files("jetbot_mjx").joinpath("assets/ptx_map.ll").read_text("utf-8")
"""Template of the kernels with a table."""

_NAME = "physics"
_TARGET = "__gpu$xla.gpu.ptx"
_TRIPLE = "nvptx64-nvidia-cuda"
_LEVEL = 3
_ROBOTS = "ROBOTS"
"""Placeholder in the PTX for the number of robots."""

_FULL_BLOCKS = 2**31 - 1
"""Number of robots in the PTX if the blocks have no more threads than robots: the same text serves
all these numbers, and the driver assembles it once."""

_ARCHITECTURES = (70, 80, 90)
"""Target architectures, as ten times the compute capability; newer GPUs run PTX of older ones."""


@functools.cache
def obstacle() -> str | None:
    """Return why XLA cannot launch kernels that LLVM compiled for an NVIDIA GPU, or None."""
    try:
        device = jax.local_devices(backend=PLATFORM)[0]
    except (RuntimeError, IndexError):
        return "there is no NVIDIA GPU that JAX can use: pip install 'jax[cuda13]'"
    try:
        _binding()
    except (ImportError, OSError, RuntimeError) as error:
        return f"llvmlite cannot be used ({error}): pip install llvmlite"
    return probe(launch, device, robots=2)


def prepare(kernel: Kernel) -> None:
    """Begin to compile a kernel, as specified by `jetbot_mjx.compiler.kernel.Backend`."""
    in_background(lambda: assemble_ahead(_text(kernel, _FULL_BLOCKS)))


def launch(kernel: Kernel, leaves: Sequence[Array]) -> list[Array]:
    """Run a kernel, as specified by `jetbot_mjx.compiler.kernel.Backend`."""
    robots = leaves[0].shape[0]
    words = _shared_words(kernel, target_architecture())
    threads = threads_in_block(robots, words)
    blocks, rest = divmod(robots, threads)
    if kernel.table is not None:
        # A block computes all items of a robot.
        threads, blocks, rest = _ITEM_THREADS, robots, 0
    text = _text(kernel, robots if rest else _FULL_BLOCKS)
    blocks += rest > 0
    grid, shared = (blocks, 1, 1), 4 * threads * words
    return launch_ptx(_NAME, text, leaves, kernel.results(robots), grid, threads, shared)


def _shared_words(kernel: Kernel, architecture: int) -> int:
    """Return how many words of a robot are in shared memory; 0: a thread reads them directly."""
    if kernel.table is not None:
        return 0
    shapes = kernel.argument_shapes, [x.shape for x in kernel.results()]
    words = max(sum(map(math.prod, one)) for one in shapes)
    fits = 4 * _MIN_THREADS * words <= _SHARED_MEMORY[architecture]
    return words if words > _DIRECT_WORDS and fits else 0


def _text(kernel: Kernel, robots: int) -> str:
    """Return the PTX of a kernel for the present GPUs, which is compiled on first use."""
    architecture = target_architecture()
    text = kernel.text(f"{IMPL} {architecture}", lambda: compiled(kernel, architecture))
    return text.replace(_ROBOTS, str(robots))


def launch_ptx(
    name: str,
    text: str,
    arguments: Sequence[Array],
    results: Sequence[jax.ShapeDtypeStruct],
    grid: tuple[int, int, int],
    threads: int,
    shared_memory: int = 0,
    aliases: Mapping[int, int] | None = None,
) -> list[Array]:
    """Launch a kernel, while JAX lowers a program for an NVIDIA GPU.

    Args:
      name: the name of the kernel.
      text: its PTX. Its parameters are the addresses of the arguments, then of the results.
      arguments: the arrays that it reads.
      results: shapes and dtypes of the arrays that it writes.
      grid: the number of blocks along each axis.
      threads: the number of threads of a block.
      shared_memory: dynamic shared memory of a block [bytes].
      aliases: which arguments it changes, and as which results it returns them.

    Returns:
      The results.
    """
    assemble_ahead(text)
    sizes = {f"grid_{axis}": np.int64(n) for axis, n in zip("xyz", grid, strict=True)}
    sizes |= {f"block_{axis}": np.int64(n) for axis, n in zip("xyz", (threads, 1, 1), strict=True)}
    return list(
        jax.ffi.ffi_call(_TARGET, list(results), input_output_aliases=dict(aliases or {}))(
            *arguments,
            name=name,
            kernel_type="ptx",
            kernel_data=text,
            **sizes,
            shared_mem_bytes=np.int64(shared_memory),
            output_indices=tuple(range(len(arguments), len(arguments) + len(results))),
        )
    )


@functools.cache
def assemble_ahead(text: str) -> None:
    """Let the driver assemble PTX in a thread, while XLA compiles the rest of the program.

    The driver keeps the result in its own cache on disk, from which XLA's first launch takes it.

    Args:
      text: the PTX.
    """

    def load() -> None:
        # If this fails, or there is no GPU here, the first launch takes longer.
        with contextlib.suppress(OSError, AttributeError, RuntimeError):
            device = jax.local_devices(backend=PLATFORM)[0].local_hardware_id
            cuda = ctypes.CDLL("libcuda.so.1")
            context, module = ctypes.c_void_p(), ctypes.c_void_p()
            if cuda.cuDevicePrimaryCtxRetain(ctypes.byref(context), device):
                return
            cuda.cuCtxSetCurrent(context)
            if not cuda.cuModuleLoadData(ctypes.byref(module), text.encode()):
                cuda.cuModuleUnload(module)
            cuda.cuDevicePrimaryCtxRelease_v2(device)

    in_background(load)


def threads_in_block(robots: int, words: int = 0) -> int:
    """Return the number of robots per block, a power of two that occupies every multiprocessor.

    Args:
      robots: the number of all robots.
      words: how many words of a robot are in shared memory.
    """
    wanted = 2 ** math.ceil(math.log2(max(1, robots / _BLOCKS)))
    most = _MAX_THREADS
    if words:
        fitting = _SHARED_MEMORY[target_architecture()] // (4 * words)
        most = min(most, 2 ** int(math.log2(fitting)))
    return min(max(wanted, _MIN_THREADS), most)


def compiled(kernel: Kernel, architecture: int) -> str:
    """Return the PTX of a kernel, with a placeholder for the number of robots.

    Args:
      kernel: the kernel.
      architecture: the target architecture, as ten times the compute capability.

    Returns:
      The PTX.

    Raises:
      UnsupportedError: the program has an operation that has no LLVM instruction.
    """
    if kernel.table is not None:
        return assembled(map_kernel_text(kernel), architecture)
    shares = _shared_words(kernel, architecture) > 0
    return assembled(kernel_text(kernel, shares=shares), architecture)


def assembled(text: str, architecture: int, version: int | None = None) -> str:
    """Return the PTX of a module of LLVM IR.

    Args:
      text: the module.
      architecture: the target architecture, as ten times the compute capability.
      version: ten times the version of PTX; None: the oldest that knows the architecture.
    """
    version = version or (70 if architecture < 90 else 80)
    binding = _binding()
    module = binding.parse_assembly(text, binding.create_context())
    module.triple = _TRIPLE
    target = binding.Target.from_triple(_TRIPLE)
    machine = target.create_target_machine(
        cpu=f"sm_{architecture}", features=f"+ptx{version}", opt=_LEVEL
    )
    return machine.emit_assembly(module)


def kernel_text(kernel: Kernel, *, shares: bool = False) -> str:
    """Write a kernel that steps as LLVM IR.

    Its parameters are the addresses of all argument leaves, followed by the addresses of all result
    leaves. Each is a float32 array of shape (robots, ...).

    Args:
      kernel: the kernel.
      shares: whether the threads of a block copy arrays by way of shared memory.

    Returns:
      The text of an LLVM module.
    """
    transfers = _shared_transfers if shares else _transfers
    sizes = [math.prod(shape) for shape in kernel.argument_shapes]
    arguments = [f"%in{i}.{j}" for i, size in enumerate(sizes) for j in range(size)]
    # Write what comes before the first step, which computes its arguments.
    program, before, entered = kernel.program, [], "load"
    if kernel.before is not None:
        first = LlvmEmitter(kernel.before, lanes=1, label=entered, prefix="before", for_gpu=True)
        arguments = first.step(arguments)
        before, entered = first.lines, first.label
    # Write one step, which reads the carried values as %now, and put it into the loop over the
    # steps, whose carries begin with the arguments.
    emitter = LlvmEmitter(program, lanes=1, label="steps", for_gpu=True)
    carried = sum(array.size for array in program.inputs[: kernel.carried])
    now = [f"%now{i}" for i in range(carried)]
    results = emitter.step([*now, *arguments[carried:]])
    end = emitter.label
    carries = [
        f"{name} = phi float [{initial}, %{entered}], [{updated}, %{end}]"
        for name, initial, updated in zip(now, arguments, results, strict=False)
    ]
    # Write what comes after the last step. It loads the arguments again, because registers that
    # held them meanwhile would be missing in the steps.
    after: list[str] = []
    if kernel.after is not None:
        last = LlvmEmitter(kernel.after, lanes=1, label="end", prefix="after", for_gpu=True)
        again = [f"%again{i}.{j}" for i, size in enumerate(sizes) for j in range(size)]
        results = last.step([*again, *results])
        after = [*transfers(sizes, "again"), *last.lines]
    stored = [math.prod(result.shape) for result in kernel.results()]
    barrier = "call void @llvm.nvvm.barrier0()"
    fetch, deliver = [], ["ret void"]
    if shares:
        fetch = [*_block_copies(sizes, "fetch"), barrier]
        deliver = [barrier, *_block_copies(stored, "deliver", len(sizes)), "ret void"]
    values = {
        "after": "\n  ".join(after),
        "before": "\n  ".join(before),
        "carries": "\n  ".join(carries),
        "declarations": "\n".join(emitter.declarations()),
        "deliver": "\n  ".join(deliver),
        "end": end,
        "entered": entered,
        "fetch": "\n  ".join(fetch),
        "loads": "\n  ".join(transfers(sizes, "in")),
        "max_threads": _MAX_THREADS,
        "name": _NAME,
        "parameters": ", ".join(f"ptr addrspace(1) %a{i}" for i in range(len(sizes) + len(stored))),
        # The results take the place of the arguments, which all threads have read by then.
        "release": barrier if shares else "",
        "robots": _ROBOTS,
        "step": "\n  ".join(emitter.lines),
        "steps": kernel.steps,
        "stores": "\n  ".join(transfers(stored, "out", len(sizes), results)),
    }
    return Template(_TEXT).substitute(values)


def map_kernel_text(kernel: Kernel) -> str:
    """Write a kernel with a table as LLVM IR.

    Its parameters are the addresses of all arguments, float32 arrays of shape (robots, ...), of the
    table, of shape (scalars of the program's last argument, items), and of the results, bytes of
    shape (robots, items x results). A block of threads computes one robot: each thread loads what
    the items share, computes what follows from it, and goes through the items in strides of a
    block.

    Args:
      kernel: the kernel.

    Returns:
      The text of an LLVM module.
    """
    emitter = LlvmEmitter(kernel.program, lanes=1, label="items", approximate=True, for_gpu=True)
    *sizes, row = [array.size for array in kernel.program.inputs]
    assert kernel.table is not None
    items = kernel.table.shape[1]
    shared = [f"%in{i}.{j}" for i, size in enumerate(sizes) for j in range(size)]
    columns = [f"%column{j}" for j in range(row)]
    rest = emitter.hoist([*shared, *columns], row)
    before, emitter.lines = emitter.lines, []
    results = emitter.finish(rest)
    table = len(sizes)
    loads = [
        f"{column}.at = getelementptr float, ptr addrspace(1) %a{table}, i64 {j * items}\n"
        f"  {column}.of = getelementptr float, ptr addrspace(1) {column}.at, i64 %wide.item\n"
        f"  {column} = load float, ptr addrspace(1) {column}.of"
        for j, column in enumerate(columns)
    ]
    stores = [
        f"%byte{i} = fptoui float {result} to i8\n"
        f"  %out{i} = add i64 %first.byte, {i}\n"
        f"  %out{i}.at = getelementptr i8, ptr addrspace(1) %a{table + 1}, i64 %out{i}\n"
        f"  store i8 %byte{i}, ptr addrspace(1) %out{i}.at"
        for i, result in enumerate(results)
    ]
    values = {
        "columns": "\n  ".join(loads),
        "declarations": "\n".join(emitter.declarations()),
        "end": emitter.label,
        "hoisted": "\n  ".join(before),
        "item": "\n  ".join(emitter.lines),
        "items": items,
        "loads": "\n  ".join(_transfers(sizes, "in")),
        "max_threads": _ITEM_THREADS,
        "name": _NAME,
        "parameters": ", ".join(f"ptr addrspace(1) %a{i}" for i in range(table + 2)),
        "results": len(results),
        "stores": "\n  ".join(stores),
        "threads": _ITEM_THREADS,
    }
    return Template(_MAP_TEXT).substitute(values)


def _transfers(
    sizes: Sequence[int], name: str, first: int = 0, results: Sequence[str] = ()
) -> list[str]:
    """Return the lines that load a robot's row of each array, or store results in them.

    Args:
      sizes: the number of scalars of a robot in each array.
      name: what the names of the loaded values begin with.
      first: the number of the first array.
      results: the names of the values to store; without, values are loaded.
    """
    lines, names = [], iter(results)
    for i, size in enumerate(sizes):
        array = f"%a{i + first}"
        lines.append(f"%{name}{i} = mul i64 %wide, {4 * size}")
        lines.append(f"%{name}p{i} = getelementptr i8, ptr addrspace(1) {array}, i64 %{name}{i}")
        for j in range(size):
            place = f"%{name}p{i}.{j}"
            lines.append(f"{place} = getelementptr float, ptr addrspace(1) %{name}p{i}, i64 {j}")
            lines.append(
                f"store float {next(names)}, ptr addrspace(1) {place}"
                if results
                else f"%{name}{i}.{j} = load float, ptr addrspace(1) {place}"
            )
    return lines


def _shared_transfers(
    sizes: Sequence[int], name: str, first: int = 0, results: Sequence[str] = ()
) -> list[str]:
    """Return the lines of `_transfers` for rows in shared memory."""
    lines, names, start = [], iter(results), 0
    for i, size in enumerate(sizes):
        # The rows of an array follow those of the arrays before it, for all threads of the block.
        lines.append(f"%{name}{i}.all = mul i32 %threads, {start}")
        lines.append(f"%{name}{i}.row = mul i32 %local, {size}")
        lines.append(f"%{name}{i} = add i32 %{name}{i}.all, %{name}{i}.row")
        for j in range(size):
            place = f"%{name}p{i}.{j}"
            lines.append(f"%{name}w{i}.{j} = add i32 %{name}{i}, {j}")
            lines.append(
                f"{place} = getelementptr float, ptr addrspace(3) @shared, i32 %{name}w{i}.{j}"
            )
            lines.append(
                f"store float {next(names)}, ptr addrspace(3) {place}"
                if results
                else f"%{name}{i}.{j} = load float, ptr addrspace(3) {place}"
            )
        start += size
    return lines


def _block_copies(sizes: Sequence[int], name: str, first: int = 0) -> list[str]:
    """Return the lines in which a block copies its rows of all arrays to shared memory or back.

    Args:
      sizes: the number of words of a robot in each array.
      name: `fetch` or `deliver`, with which names begin.
      first: the number of the first array.
    """
    lines, start = [], 0
    if name == "fetch":
        lines += [
            "%local = sub i32 %robot, %before",
            "%after.before = sub i32 %robots, %before",
            "%is.full = icmp ult i32 %threads, %after.before",
            "%rows = select i1 %is.full, i32 %threads, i32 %after.before",
        ]
    for i, size in enumerate(sizes):
        at = f"%{name}{i}"
        lines += [
            f"{at}.first = mul i32 %before, {size}",
            f"{at}.long = zext i32 {at}.first to i64",
            f"{at}.there = getelementptr float, ptr addrspace(1) %a{i + first}, i64 {at}.long",
            f"{at}.begin = mul i32 %threads, {start}",
            f"{at}.here = getelementptr float, ptr addrspace(3) @shared, i32 {at}.begin",
            f"{at}.count = mul i32 %rows, {size}",
            f"{at}.last = sub i32 {at}.count, 1",
        ]
        # Load all words before the first store: a thread waits for memory once.
        stores = []
        wanted = "%thread"
        for j in range(size):
            word = f"{at}.{j}"
            source, target = f"ptr addrspace(1) {word}.wide", f"ptr addrspace(3) {word}.shared"
            if name == "deliver":
                source, target = target, source
            lines += [
                # In the last block, some threads copy the last word too.
                f"{word}.k = call i32 @llvm.umin.i32(i32 {wanted}, i32 {at}.last)",
                f"{word}.shared = getelementptr float, ptr addrspace(3) {at}.here, i32 {word}.k",
                f"{word}.wide = getelementptr float, ptr addrspace(1) {at}.there, i32 {word}.k",
                f"{word}.value = load float, {source}",
                f"{word}.next = add i32 {wanted}, %threads",
            ]
            wanted = f"{word}.next"
            stores.append(f"store float {word}.value, {target}")
        lines += stores
        start += size
    return lines


@functools.cache
def compute_capability() -> int:
    """Return ten times the lowest compute capability of the present GPUs."""
    return min(
        round(10 * float(device.compute_capability))
        for device in jax.local_devices(backend=PLATFORM)
    )


def processor_count() -> int:
    """Return the number of multiprocessors of a GPU."""
    return jax.local_devices(backend=PLATFORM)[0].core_count


def target_architecture() -> int:
    """Return the newest supported architecture that all present GPUs can run."""
    supported = [x for x in _ARCHITECTURES if x <= compute_capability()]
    return max(supported, default=_ARCHITECTURES[0])


@functools.cache
def _binding() -> Any:
    """Return the LLVM binding with its target for NVIDIA's GPUs.

    Raises:
      RuntimeError: this LLVM has no such target.
    """
    binding = importlib.import_module("llvmlite.binding")
    binding.initialize_all_targets()
    binding.initialize_all_asmprinters()
    binding.Target.from_triple(_TRIPLE)
    return binding
