"""Compile and launch kernels on NVIDIA GPUs; this module is a `onekernel.kernel.Backend`.

LLVM compiles a kernel to PTX, NVIDIA's portable assembly, and XLA passes the PTX to the driver
through its custom call for PTX kernels. That call is internal to XLA, so `obstacle` tries
whether the installed version has it. Each thread runs the whole program for one instance, with all
intermediate values in registers.

In NVIDIA's terms, a launch runs a grid of blocks. The threads of a block run on one multiprocessor,
share a small fast memory (shared memory), and can wait for each other (a barrier). 32 threads of a
block, a warp, execute the same instruction at the same time.
"""

import contextlib
import ctypes
import functools
import importlib
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from types import ModuleType

import jax
import numpy as np
from jaxtyping import Array

from onekernel.background import in_background
from onekernel.gpu.kernel_text import (
    INSTANCES,
    ITEM_THREADS,
    MAX_THREADS,
    NAME,
    kernel_text,
    map_kernel_text,
)
from onekernel.gpu.kernel_text import module_text as module_text
from onekernel.kernel import Compiled, Kernel, probe
from onekernel.lower import most_kept

IMPL: str = "ptx"
PLATFORM: str = "cuda"

_MIN_THREADS = 32

_DIRECT_WORDS = 32
"""Largest number of words of an instance that its thread reads from the arrays directly. If rows
are longer, the threads of a block copy them to shared memory and back together: neighbouring
threads copy neighbouring words, which a GPU does in one access. If each thread read its own row,
the threads would wait 70 µs for 65,536 rows of 77 words."""

_SHARED_BYTES = {70: 49_152, 80: 98_304, 90: 98_304}
"""Bytes of shared memory for these rows, by target architecture: all GPUs that can run code for the
architecture have as much."""

_REGISTERS = 255
"""Most registers of a thread."""

_BLOCKS = 128
"""Number of blocks from which on blocks grow instead: a GPU has about as many multiprocessors."""

_TARGET = "__gpu$xla.gpu.ptx"
_TRIPLE = "nvptx64-nvidia-cuda"
_LEVEL = 3
_FULL_BLOCKS = 2**31 - 1
"""Number of instances in the PTX of a launch that has exactly as many threads as instances. No
thread reaches this number, so one text serves all such launches, and the driver assembles it once.
"""

MAX_ARRAY_BYTES = 64 * 1024
"""Most memory for the arrays of one instance: a GPU reserves as much for every thread that it can
hold, which on an H100 are 270,000."""

_NUM_REGS, _LOCAL_SIZE_BYTES = 4, 3
"""Attributes of a function, by their numbers in CUDA's driver API (`CUfunction_attribute`)."""

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
    return probe(launch, device, instances=2)


def refusal(kernel: Kernel) -> str | None:
    """Return why a kernel cannot run, as specified by `onekernel.kernel.Backend`."""
    count = kernel.array_bytes
    if count <= MAX_ARRAY_BYTES:
        return None
    return f"arrays of {count:,} bytes for each instance, more than {MAX_ARRAY_BYTES:,} on a GPU"


def prepare(kernel: Kernel) -> None:
    """Begin to compile a kernel, as specified by `onekernel.kernel.Backend`."""
    in_background(lambda: assemble_ahead(_text(kernel, _FULL_BLOCKS)))


def inspect(kernel: Kernel) -> Compiled:
    """Compile a kernel, as specified by `onekernel.kernel.Backend`."""
    architecture = target_architecture()
    begin = time.perf_counter()
    text = compiled(kernel, architecture).replace(INSTANCES, str(_FULL_BLOCKS))
    registers, local = _attributes(text)
    return Compiled(
        f"an NVIDIA GPU of compute capability {compute_capability() / 10}",
        time.perf_counter() - begin,
        f"{registers} of 255 a thread",
        f"{local:,} bytes of memory a thread",
    )


def launch(kernel: Kernel, leaves: Sequence[Array]) -> list[Array]:
    """Run a kernel, as specified by `onekernel.kernel.Backend`."""
    # Run one thread for each instance. If the last block has threads left over, the PTX must
    # contain the number of instances, so that the threads beyond it store nothing.
    instances = leaves[0].shape[0]
    words = _shared_words(kernel, target_architecture())
    threads = threads_in_block(instances, words)
    blocks, rest = divmod(instances, threads)
    if kernel.table is not None:
        # A block computes all items of an instance.
        threads, blocks, rest = ITEM_THREADS, instances, 0
    text = _text(kernel, instances if rest else _FULL_BLOCKS)
    blocks += rest > 0
    grid, shared = (blocks, 1, 1), 4 * threads * words
    return launch_ptx(NAME, text, leaves, kernel.results(instances), grid, threads, shared)


def _shared_words(kernel: Kernel, architecture: int) -> int:
    """Return how many words of an instance are in shared memory; 0: it reads them directly."""
    # What a thread has no register for waits in a cache, which is the smaller the more of the same
    # memory is shared: walker2d makes a fifth more steps without.
    if kernel.table is not None or most_kept(kernel.program.block) > _REGISTERS:
        return 0
    # Shared memory holds the arguments first, and the results later.
    words = max(sum(kernel.argument_words), sum(kernel.result_words))
    # Even the smallest block must fit.
    fits = 4 * _MIN_THREADS * words <= _SHARED_BYTES[architecture]
    return words if words > _DIRECT_WORDS and fits else 0


def _text(kernel: Kernel, instances: int) -> str:
    """Return the PTX of a kernel for the present GPUs, which is compiled on first use."""
    architecture = target_architecture()
    text = kernel.text(f"{IMPL} {architecture}", lambda: compiled(kernel, architecture))
    return text.replace(INSTANCES, str(instances))


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
    # XLA's custom call takes these attributes: the PTX, the kernel's name in it, and the launch.
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
            # Which parameters of the kernel are results.
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
        with contextlib.suppress(OSError, AttributeError, RuntimeError), _loaded(text):
            pass

    in_background(load)


@contextlib.contextmanager
def _loaded(text: str) -> Iterator[tuple[ctypes.CDLL, ctypes.c_void_p]]:
    """Load PTX with the driver into the context that JAX uses, and unload it at the end.

    What stays is the entry in the driver's cache.

    Raises:
      RuntimeError: the driver refuses the PTX.
    """
    device = jax.local_devices(backend=PLATFORM)[0].local_hardware_id
    cuda = ctypes.CDLL("libcuda.so.1")
    context, module = ctypes.c_void_p(), ctypes.c_void_p()
    if cuda.cuDevicePrimaryCtxRetain(ctypes.byref(context), device):
        raise RuntimeError("the driver has no context for the GPU")
    try:
        cuda.cuCtxSetCurrent(context)
        if cuda.cuModuleLoadData(ctypes.byref(module), text.encode()):
            raise RuntimeError("the driver does not load the kernel")
        yield cuda, module
        cuda.cuModuleUnload(module)
    finally:
        cuda.cuDevicePrimaryCtxRelease_v2(device)


def _attributes(text: str) -> tuple[int, int]:
    """Return how many registers and how many bytes of local memory a kernel's thread has."""
    with _loaded(text) as (cuda, module):
        function = ctypes.c_void_p()
        cuda.cuModuleGetFunction(ctypes.byref(function), module, NAME.encode())
        found = ctypes.c_int()
        values = []
        for attribute in (_NUM_REGS, _LOCAL_SIZE_BYTES):
            cuda.cuFuncGetAttribute(ctypes.byref(found), attribute, function)
            values.append(found.value)
    registers, local = values
    return registers, local


def threads_in_block(instances: int, words: int = 0) -> int:
    """Return the number of instances per block, a power of two that occupies every multiprocessor.

    Args:
      instances: the number of all instances.
      words: how many words of an instance are in shared memory.
    """
    # Let blocks grow only once there are `_BLOCKS` of them: fewer would leave processors idle.
    wanted = 2 ** math.ceil(math.log2(max(1, instances / _BLOCKS)))
    most = MAX_THREADS
    if words:
        # As many instances as fit into the shared memory of a block.
        fitting = _SHARED_BYTES[target_architecture()] // (4 * words)
        most = min(most, 2 ** int(math.log2(fitting)))
    return min(max(wanted, _MIN_THREADS), most)


def compiled(kernel: Kernel, architecture: int) -> str:
    """Return the PTX of a kernel, with a placeholder for the number of instances.

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
    # A version of PTX knows the architectures that were there when it was defined.
    version = version or (70 if architecture < 90 else 80)
    binding = _binding()
    module = binding.parse_assembly(text, binding.create_context())
    module.triple = _TRIPLE
    # LLVM's NVPTX back end writes assembly text, which the driver assembles for the GPU at hand.
    target = binding.Target.from_triple(_TRIPLE)
    machine = target.create_target_machine(
        cpu=f"sm_{architecture}", features=f"+ptx{version}", opt=_LEVEL
    )
    return machine.emit_assembly(module)


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
    # PTX for an architecture also runs on all newer ones, but not the other way round.
    supported = [x for x in _ARCHITECTURES if x <= compute_capability()]
    return max(supported, default=_ARCHITECTURES[0])


@functools.cache
def _binding() -> ModuleType:
    """Return the LLVM binding with its target for NVIDIA's GPUs.

    Raises:
      RuntimeError: this LLVM has no such target.
    """
    binding = importlib.import_module("llvmlite.binding")
    binding.initialize_all_targets()
    binding.initialize_all_asmprinters()
    binding.Target.from_triple(_TRIPLE)
    return binding
