"""Kernels on NVIDIA GPUs: a `jetbot_mjx.compiler.kernel.Backend`.

LLVM compiles them to PTX, NVIDIA's portable assembly, and XLA hands that to the driver by its
custom call for PTX, an internal mechanism: `is_available` asks the installed XLA whether it knows
it. Each thread does the whole program for one robot; all numbers in between stay in registers.
"""

import functools
import importlib
import math
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jetbot_mjx.compiler.kernel import Kernel
from jetbot_mjx.compiler.llvm_codegen import LlvmEmitter
from jetbot_mjx.compiler.lower_jaxpr import ScalarProgram, scalarize

IMPL = "ptx"
PLATFORM = "cuda"
NEEDS = "an NVIDIA GPU, llvmlite (pip install llvmlite) and an XLA that launches PTX"

_MOST_THREADS = 256
"""Robots in one block at most: with 255 registers each, one block fills a multiprocessor."""

_LEAST_THREADS = 32

_BLOCKS = 128
"""Blocks that there should be before they grow: a GPU has about as many multiprocessors."""

_NAME = "physics"
_TARGET = "__gpu$xla.gpu.ptx"
_TRIPLE = "nvptx64-nvidia-cuda"
_LEVEL = 3
_ROBOTS = "ROBOTS"
"""Where in the PTX their number goes."""

_ARCHITECTURES = (70, 80, 90)
"""What PTX is written for, tens of the compute capability; later GPUs take that of earlier ones."""


@functools.cache
def is_available() -> bool:
    """Return whether JAX knows an NVIDIA GPU and its XLA launches a kernel that LLVM compiled."""
    try:
        device = jax.local_devices(backend=PLATFORM)[0]
        _binding()
    except (ImportError, OSError, RuntimeError, IndexError):
        return False
    probe = Kernel(
        scalarize(lambda x: x + 1.0, jax.ShapeDtypeStruct((1,), jnp.float32)),
        carried=1,
        steps=1,
        fallback=lambda x: [x + 1.0],
    )
    # Whoever asks may be in the middle of tracing something else.
    with jax.ensure_compile_time_eval(), jax.default_device(device):
        try:
            (result,) = jax.jit(lambda x: launch(probe, [x]))(jnp.zeros((2, 1)))
            return bool((np.asarray(result) == 1.0).all())
        except jax.errors.JaxRuntimeError:
            return False


def launch(kernel: Kernel, leaves: Sequence[Array]) -> list[Array]:
    """Run a kernel, as specified by `jetbot_mjx.compiler.kernel.Backend`."""
    robots = leaves[0].shape[0]
    threads = threads_in_block(robots)
    architecture = _architecture()
    text = kernel.text(f"{IMPL} {architecture}", lambda: compiled(kernel, architecture))
    results = leaves[: kernel.carried]
    call = jax.ffi.ffi_call(
        _TARGET, [jax.ShapeDtypeStruct(leaf.shape, jnp.float32) for leaf in results]
    )
    return list(
        call(
            *leaves,
            name=_NAME,
            kernel_type="ptx",
            kernel_data=text.replace(_ROBOTS, str(robots)),
            grid_x=np.int64(math.ceil(robots / threads)),
            grid_y=np.int64(1),
            grid_z=np.int64(1),
            block_x=np.int64(threads),
            block_y=np.int64(1),
            block_z=np.int64(1),
            shared_mem_bytes=np.int64(0),
            output_indices=tuple(range(len(leaves), len(leaves) + len(results))),
        )
    )


def threads_in_block(robots: int) -> int:
    """Return the robots per block: a power of two that leaves some for every multiprocessor."""
    wanted = 2 ** math.ceil(math.log2(max(1, robots / _BLOCKS)))
    return min(max(wanted, _LEAST_THREADS), _MOST_THREADS)


def compiled(kernel: Kernel, architecture: int) -> str:
    """Return the PTX of a kernel, with a placeholder for the number of robots.

    Args:
      kernel: the kernel.
      architecture: what it is for, tens of the compute capability.

    Returns:
      The text.

    Raises:
      UnsupportedError: the program has an operation that is not written in LLVM.
    """
    binding = _binding()
    text = kernel_text(kernel.program, carried=kernel.carried, steps=kernel.steps)
    module = binding.parse_assembly(text, binding.create_context())
    module.triple = _TRIPLE
    target = binding.Target.from_triple(_TRIPLE)
    machine = target.create_target_machine(
        cpu=f"sm_{architecture}", features="+ptx70" if architecture < 90 else "+ptx80", opt=_LEVEL
    )
    return machine.emit_assembly(module)


def kernel_text(program: ScalarProgram, *, carried: int, steps: int) -> str:
    """Write a kernel in LLVM's representation.

    Its parameters are the addresses of all leaves of the arguments and then of all leaves of the
    results, float32 arrays of shape (robots, ...).

    Args:
      program: a step; its results have the shapes of its first `carried` arguments.
      carried: how many leaves of the arguments are carried from step to step.
      steps: how often it is repeated.

    Returns:
      The text of a module.
    """
    writer = LlvmEmitter(program, lanes=1, label="steps")
    sizes = [array.size for array in program.inputs]
    first = _transfers(sizes, "load")
    arguments = [f"%in{i}.{j}" for i, size in enumerate(sizes) for j in range(size)]
    changing = sum(sizes[:carried])
    ahead = [f"%now{i}" for i in range(changing)]
    # What a step ends with is not written yet: its first lines are filled in below.
    results = writer.step([*ahead, *arguments[changing:]])[:changing]
    end = writer.label
    carries = [
        f"{now} = phi float [{before}, %load], [{after}, %{end}]"
        for now, before, after in zip(ahead, arguments, results, strict=False)
    ]
    parameters = ", ".join(f"ptr addrspace(1) %a{i}" for i in range(len(sizes) + carried))
    lines = [
        *writer.declarations(),
        "declare i32 @llvm.nvvm.read.ptx.sreg.tid.x()",
        "declare i32 @llvm.nvvm.read.ptx.sreg.ctaid.x()",
        "declare i32 @llvm.nvvm.read.ptx.sreg.ntid.x()",
        "declare void @llvm.nvvm.barrier0()",
        f"define ptx_kernel void @{_NAME}({parameters}) {{",
        "entry:",
        "%thread = call i32 @llvm.nvvm.read.ptx.sreg.tid.x()",
        "%block = call i32 @llvm.nvvm.read.ptx.sreg.ctaid.x()",
        "%threads = call i32 @llvm.nvvm.read.ptx.sreg.ntid.x()",
        "%before = mul i32 %block, %threads",
        "%wanted = add i32 %before, %thread",
        f'%robots = call i32 asm "mov.u32 $0, {_ROBOTS};", "=r"()',
        "%is.there = icmp ult i32 %wanted, %robots",
        # Threads beyond the last robot do what its thread does: a warp is always whole.
        "%last = sub i32 %robots, 1",
        "%robot = select i1 %is.there, i32 %wanted, i32 %last",
        "br label %load",
        "load:",
        "%wide = zext i32 %robot to i64",
        *first,
        "br label %steps",
        "steps:",
        f"%count = phi i32 [0, %load], [%count.next, %{end}]",
        *carries,
        # Threads whose loops take different numbers of trips drift apart, until each of them waits
        # for instructions that the cache has no room for: 540 instead of 760 M steps/s.
        "call void @llvm.nvvm.barrier0()",
        *writer.lines,
        "%count.next = add i32 %count, 1",
        f"%again = icmp ult i32 %count.next, {steps}",
        "br i1 %again, label %steps, label %end",
        "end:",
        "br i1 %is.there, label %store, label %done",
        "store:",
        *_transfers(sizes[:carried], "store", len(sizes), results),
        "br label %done",
        "done:",
        "ret void",
        "}",
        "!nvvm.annotations = !{!0}",
        f'!0 = !{{ptr @{_NAME}, !"maxntidx", i32 {_MOST_THREADS}}}',
    ]
    return "\n".join(lines) + "\n"


def _transfers(
    sizes: Sequence[int], do: str, first: int = 0, results: Sequence[str] = ()
) -> list[str]:
    """Return the lines that load a robot's rows of several arrays, or store results there."""
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
def _architecture() -> int:
    """Return the architecture to write PTX for, from the GPUs that are present."""
    capability = min(
        round(10 * float(device.compute_capability))
        for device in jax.local_devices(backend=PLATFORM)
    )
    return max((x for x in _ARCHITECTURES if x <= capability), default=_ARCHITECTURES[0])


@functools.cache
def _binding() -> Any:
    """Return the LLVM binding with its target for NVIDIA's GPUs.

    Raises:
      RuntimeError: this LLVM has none.
    """
    binding = importlib.import_module("llvmlite.binding")
    binding.initialize_all_targets()
    binding.initialize_all_asmprinters()
    binding.Target.from_triple(_TRIPLE)
    return binding
