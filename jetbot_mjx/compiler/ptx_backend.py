"""Compile and launch kernels on NVIDIA GPUs; this module is a `jetbot_mjx.compiler.kernel.Backend`.

LLVM compiles a kernel to PTX, NVIDIA's portable assembly, and XLA passes the PTX to the driver
through its custom call for PTX kernels. That call is internal to XLA, so `is_available` tries
whether the installed version has it. Each thread runs the whole program for one robot, with all
intermediate values in registers.
"""

import contextlib
import ctypes
import functools
import importlib
import math
from collections.abc import Sequence
from importlib import resources
from string import Template
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from jetbot_mjx.compiler.background import in_background
from jetbot_mjx.compiler.kernel import Kernel, runs_correctly
from jetbot_mjx.compiler.llvm_codegen import LlvmEmitter

IMPL: str = "ptx"
PLATFORM: str = "cuda"
NEEDS: str = "an NVIDIA GPU, llvmlite (pip install llvmlite) and an XLA that launches PTX"

_MAX_THREADS = 256
"""Largest number of robots in a block: with 255 registers each, it fills a multiprocessor."""

_MIN_THREADS = 32

_ITEM_THREADS = 128
"""Number of threads that compute the items of a robot."""

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
def is_available() -> bool:
    """Return whether JAX has an NVIDIA GPU and XLA can launch a kernel that LLVM compiled."""
    try:
        device = jax.local_devices(backend=PLATFORM)[0]
        _binding()
    except (ImportError, OSError, RuntimeError, IndexError):
        return False
    return runs_correctly(launch, device, robots=2)


def prepare(kernel: Kernel) -> None:
    """Begin to compile a kernel, as specified by `jetbot_mjx.compiler.kernel.Backend`."""
    in_background(lambda: assemble_ahead(_text(kernel, _FULL_BLOCKS)))


def launch(kernel: Kernel, leaves: Sequence[Array]) -> list[Array]:
    """Run a kernel, as specified by `jetbot_mjx.compiler.kernel.Backend`."""
    robots = leaves[0].shape[0]
    threads = threads_in_block(robots)
    blocks, rest = divmod(robots, threads)
    if kernel.table is not None:
        # A block computes all items of a robot.
        threads, blocks, rest = _ITEM_THREADS, robots, 0
    text = _text(kernel, robots if rest else _FULL_BLOCKS)
    blocks += rest > 0
    return launch_ptx(_NAME, text, leaves, kernel.results(robots), (blocks, 1, 1), threads)


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

    Returns:
      The results.
    """
    assemble_ahead(text)
    sizes = {f"grid_{axis}": np.int64(n) for axis, n in zip("xyz", grid, strict=True)}
    sizes |= {f"block_{axis}": np.int64(n) for axis, n in zip("xyz", (threads, 1, 1), strict=True)}
    return list(
        jax.ffi.ffi_call(_TARGET, list(results))(
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


def threads_in_block(robots: int) -> int:
    """Return the number of robots per block, a power of two that occupies every multiprocessor."""
    wanted = 2 ** math.ceil(math.log2(max(1, robots / _BLOCKS)))
    return min(max(wanted, _MIN_THREADS), _MAX_THREADS)


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
    return assembled(
        (kernel_text if kernel.table is None else map_kernel_text)(kernel), architecture
    )


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


def kernel_text(kernel: Kernel) -> str:
    """Write a kernel that steps as LLVM IR.

    Its parameters are the addresses of all argument leaves, followed by the addresses of all result
    leaves. Each is a float32 array of shape (robots, ...).

    Args:
      kernel: the kernel.

    Returns:
      The text of an LLVM module.
    """
    # Write one step, which reads the carried values as %now and the others as %in.
    program, carried = kernel.program, kernel.carried
    emitter = LlvmEmitter(program, lanes=1, label="steps")
    sizes = [array.size for array in program.inputs]
    arguments = [f"%in{i}.{j}" for i, size in enumerate(sizes) for j in range(size)]
    carried_scalars = sum(sizes[:carried])
    now = [f"%now{i}" for i in range(carried_scalars)]
    results = emitter.step([*now, *arguments[carried_scalars:]])[:carried_scalars]
    # Insert it into the loop over the steps, whose carries begin with the arguments.
    end = emitter.label
    carries = [
        f"{name} = phi float [{before}, %load], [{after}, %{end}]"
        for name, before, after in zip(now, arguments, results, strict=False)
    ]
    values = {
        "carries": "\n  ".join(carries),
        "declarations": "\n".join(emitter.declarations()),
        "end": end,
        "loads": "\n  ".join(_transfers(sizes, "load")),
        "max_threads": _MAX_THREADS,
        "name": _NAME,
        "parameters": ", ".join(f"ptr addrspace(1) %a{i}" for i in range(len(sizes) + carried)),
        "robots": _ROBOTS,
        "step": "\n  ".join(emitter.lines),
        "steps": kernel.steps,
        "stores": "\n  ".join(_transfers(sizes[:carried], "store", len(sizes), results)),
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
    emitter = LlvmEmitter(kernel.program, lanes=1, label="items", approximate=True)
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
        "loads": "\n  ".join(_transfers(sizes, "load")),
        "max_threads": _ITEM_THREADS,
        "name": _NAME,
        "parameters": ", ".join(f"ptr addrspace(1) %a{i}" for i in range(table + 2)),
        "results": len(results),
        "stores": "\n  ".join(stores),
        "threads": _ITEM_THREADS,
    }
    return Template(_MAP_TEXT).substitute(values)


def _transfers(
    sizes: Sequence[int], do: str, first: int = 0, results: Sequence[str] = ()
) -> list[str]:
    """Return the lines that load a robot's row of each array, or store results in them."""
    lines, names = [], iter(results)
    for i, size in enumerate(sizes):
        array = f"%a{i + first}"
        lines.append(f"%{do}{i} = mul i64 %wide, {4 * size}")
        lines.append(f"%{do}p{i} = getelementptr i8, ptr addrspace(1) {array}, i64 %{do}{i}")
        for j in range(size):
            place = f"%{do}p{i}.{j}"
            lines.append(f"{place} = getelementptr float, ptr addrspace(1) %{do}p{i}, i64 {j}")
            lines.append(
                f"%in{i}.{j} = load float, ptr addrspace(1) {place}"
                if do == "load"
                else f"store float {next(names)}, ptr addrspace(1) {place}"
            )
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
