"""Compile and launch kernels on CPUs; this module is a `onekernel.kernel.Backend`.

`llvmlite`, the Python binding of LLVM, compiles a kernel for the present processor, and XLA calls
it through its foreign function interface (FFI): `jax.ffi.register_ffi_target` tells XLA the address
of a C function under a name, and `jax.ffi.ffi_call` puts a call of this name into a program.
`obstacle` tries both with a small kernel. The name of a kernel is a hash of its content, so a
cached program always finds the kernel that it was compiled with.
"""

import ctypes
import functools
import hashlib
import importlib
import re
import threading
import time
from collections.abc import Mapping, Sequence
from types import ModuleType
from typing import TYPE_CHECKING, NamedTuple

import jax
from jaxtyping import Array

from onekernel.background import in_background
from onekernel.cpu import xla_call
from onekernel.cpu.xla_call import BLOCK_PARAMETERS as BLOCK_PARAMETERS
from onekernel.cpu.xla_call import array_of as array_of
from onekernel.cpu.xla_call import call_text as call_text
from onekernel.cpu.xla_call import instance_count as instance_count
from onekernel.cpu.xla_call import job_of_one as job_of_one
from onekernel.cpu.xla_call import scratch_bytes as scratch_bytes
from onekernel.cpu.xla_call import step_functions as step_functions
from onekernel.kernel import Compiled, Kernel, probe
from onekernel.trusted_files import cached_bytes

if TYPE_CHECKING:
    # At run time, `_binding` imports it late.
    from llvmlite.binding import ExecutionEngine, ModuleRef, TargetMachine

# Constants of `onekernel.kernel.Backend`.
IMPL: str = "llvm"
PLATFORM: str = "cpu"

NAME = "kernel"
"""Name of a kernel's function."""

_LEVEL = 2
"""Optimisation level of code generation; the program is already simplified, so no passes run."""

MAX_THREAD_BYTES = 8 << 20
"""Most memory for the arrays of all lanes of a thread, unless a single lane needs more. What does
not stay in the caches waits for memory: 8 lanes of 0.7 MB each are 1.6 times as fast as 16."""

_XLA_NAME = re.compile(r"onekernel_[0-9a-f]{64}")


_lock = threading.Lock()
_loaded: dict[str, tuple["ExecutionEngine", bytes]] = {}
"""The engine and machine code of loaded kernels, by the name under which XLA calls them. XLA may
call them until the process ends."""


class Host(NamedTuple):
    """A `Host` describes the processor in LLVM's terms."""

    machine: str
    name: str
    features: str
    lanes: int
    """Number of float32 values in a vector register."""
    registers: int
    """Number of vector registers."""
    version: str
    """Version of llvmlite and LLVM."""


@functools.cache
def obstacle() -> str | None:
    """Return why XLA cannot call kernels compiled by llvmlite on CPUs, or None if it can."""
    try:
        # Whatever fails here is an answer, not an error: callers then use XLA.
        device = jax.local_devices(backend=PLATFORM)[0]
        host = host_processor()
    except (ImportError, OSError, RuntimeError, AttributeError, TypeError) as error:
        # llvmlite is missing or does not know this processor, the C library lacks a function, or
        # JAX_PLATFORMS leaves out the CPU.
        return f"llvmlite cannot be used ({error}): pip install llvmlite"
    if host.machine not in xla_call.MACHINES:
        known = " and ".join(xla_call.MACHINES)
        return f"there are kernels for {known} processors, not for {host.machine}"
    # An odd number of instances, so that the last block is not full.
    return probe(launch, device, instances=2 * host.lanes + 1)


def kernel_text(kernel: Kernel, instances: int | None = None) -> str:
    """Return a kernel as LLVM IR for this processor.

    Args:
      kernel: the kernel.
      instances: the number of instances; None: many.

    Returns:
      The text of a module, which is written on first use.

    Raises:
      UnsupportedError: the program has an operation that has no LLVM instruction.
    """
    host = host_processor()
    # With a table, the lanes are items, of which there are many.
    if instances is None or kernel.table is not None:
        instances = host.lanes
    lanes = lanes_for(instances, kernel.array_bytes)
    write = functools.partial(xla_call.kernel_text, kernel, lanes=lanes, machine=host.machine)
    return kernel.text(f"{IMPL} {lanes}", write)


def lanes_for(instances: int, array_bytes: int = 0) -> int:
    """Return how many instances a kernel steps side by side.

    A lane without an instance costs as much as one that has one: wider vectors have slower
    divisions, roots and memory, and a single instance needs no masks and no vectors in its arrays.
    So the lanes are the fewest that hold all instances. The bits of an instance are the same in
    any number of lanes, because LLVM finds the same instructions in the same blocks, in which it
    looks for products and sums to fuse. They are fewer where the arrays of all lanes would take
    more than `MAX_THREAD_BYTES`.

    Args:
      instances: the number of all instances.
      array_bytes: the bytes of the arrays of one instance.
    """
    most = host_processor().lanes
    wanted = next((lanes for lanes in (1, 4, 8) if instances <= lanes < most), most)
    fewer = [lanes for lanes in (wanted, 8, 4) if lanes <= wanted]
    return next((lanes for lanes in fewer if lanes * array_bytes <= MAX_THREAD_BYTES), 1)


def refusal(kernel: Kernel) -> str | None:
    """Return why a kernel cannot run, as specified by `onekernel.kernel.Backend`."""
    return None


def prepare(kernel: Kernel) -> None:
    """Begin to compile a kernel, as specified by `onekernel.kernel.Backend`."""
    in_background(lambda: registered(kernel_text(kernel)))


def inspect(kernel: Kernel) -> Compiled:
    """Compile a kernel, as specified by `onekernel.kernel.Backend`."""
    text, host = kernel_text(kernel), host_processor()
    lanes = lanes_for(host.lanes, kernel.array_bytes)
    begin = time.perf_counter()
    _compile(text)
    seconds = time.perf_counter() - begin
    # The compiler marks in its assembly where it stores a register and loads it again.
    machine = _target_machine()
    machine.set_asm_verbosity(True)
    assembly = machine.emit_assembly(_module(text))
    stores, loads = assembly.count(" Spill"), assembly.count(" Reload")
    return Compiled(
        f"{host.name}, {lanes} instances side by side",
        seconds,
        f"{host.registers} vectors of {lanes} numbers",
        f"{stores:,} times stored, {loads:,} times loaded",
    )


def launch(kernel: Kernel, leaves: Sequence[Array]) -> list[Array]:
    """Run a kernel, as specified by `onekernel.kernel.Backend`."""
    instances = leaves[0].shape[0]
    return launch_text(kernel_text(kernel, instances), leaves, kernel.results(instances))


def launch_text(
    text: str,
    arguments: Sequence[Array],
    results: Sequence[jax.ShapeDtypeStruct],
    aliases: Mapping[int, int] | None = None,
) -> list[Array]:
    """Call a function, while JAX lowers a program for CPUs.

    Args:
      text: an LLVM module with the function `NAME`, from `xla_call`.
      arguments: the arrays that it reads.
      results: shapes and dtypes of the arrays that it writes.
      aliases: which arguments it changes, and as which results it returns them.

    Returns:
      The results.
    """
    call = jax.ffi.ffi_call(
        registered(text), list(results), input_output_aliases=dict(aliases or {})
    )
    return list(call(*arguments))


def registered(text: str) -> str:
    """Return the name under which XLA calls a function; compile and register it on first use.

    Args:
      text: an LLVM module with the function `NAME`, from `xla_call`.
    """
    # The hash covers the text, the processor and the version of LLVM: the same name is the same
    # code.
    name = f"onekernel_{hashlib.sha256(_key(text)).hexdigest()}"
    # Programs are traced in several threads.
    with _lock:
        if name not in _loaded:
            _register(name, _machine_code(text))
    return name


def _register(name: str, code: bytes) -> None:
    # XLA finds the function by its name in the program, and calls it at its address. The engine
    # owns the memory of the code, so it must not be collected.
    engine = _load(code)
    address = ctypes.c_void_p(engine.get_function_address(NAME))
    jax.ffi.register_ffi_target(name, jax.ffi.pycapsule(address), platform="cpu")
    _loaded[name] = engine, code


def kernels_in(lowered: str) -> dict[str, bytes]:
    """Return the kernels that a program calls.

    Args:
      lowered: the text of the lowered program.

    Returns:
      Their machine code, by the names under which XLA calls them.
    """
    return {name: _loaded[name][1] for name in sorted(set(_XLA_NAME.findall(lowered)))}


def register(kernels: Mapping[str, bytes]) -> None:
    """Register kernels with XLA, before XLA loads a program that calls them.

    Args:
      kernels: a result of `kernels_in` on the same processor with the same library versions.
    """
    with _lock:
        for name, code in kernels.items():
            if name not in _loaded:
                _register(name, code)


def _key(text: str) -> bytes:
    """Return the cache key: everything that a kernel's machine code depends on."""
    host = host_processor()
    return "\n".join([host.version, host.name, host.features, str(_LEVEL), text]).encode()


def _machine_code(text: str) -> bytes:
    """Return a kernel's object file, from the folder of compiled programs if it is cached there."""
    return cached_bytes("object", _key(text), lambda: _compile(text))


def _compile(text: str) -> bytes:
    # From text to LLVM's own form, and from that to an object file for this processor.
    return _target_machine().emit_object(_module(text))


def _module(text: str) -> "ModuleRef":
    binding = _binding()
    module = binding.parse_assembly(text, binding.create_context())
    module.triple = binding.get_process_triple()
    return module


def _load(code: bytes) -> "ExecutionEngine":
    binding = _binding()
    # llvmlite loads object files into an engine, which begins with a module; this one is empty.
    empty = binding.parse_assembly("", binding.create_context())
    engine = binding.create_mcjit_compiler(empty, _target_machine())
    engine.add_object_file(binding.ObjectFileRef.from_data(code))
    engine.finalize_object()
    return engine


def _target_machine() -> "TargetMachine":
    binding, host = _binding(), host_processor()
    target = binding.Target.from_triple(binding.get_process_triple())
    return target.create_target_machine(
        cpu=host.name, features=host.features, opt=_LEVEL, codemodel="jitdefault", jit=True
    )


@functools.cache
def _binding() -> ModuleType:
    """Return the LLVM binding, which is imported late because it takes a while to load."""
    binding = importlib.import_module("llvmlite.binding")
    binding.initialize_native_target()
    binding.initialize_native_asmprinter()
    # LLVM must find the C functions that a kernel calls: tell it their addresses in this process.
    process = ctypes.CDLL(None)
    for name in xla_call.SYMBOLS:
        address = ctypes.cast(getattr(process, name), ctypes.c_void_p).value
        binding.add_symbol(name, address)
    return binding


@functools.cache
def host_processor() -> Host:
    """Return a description of this machine's processor."""
    binding = _binding()
    features = binding.get_host_cpu_features()
    # A vector register holds 16 floats with AVX-512, 8 with AVX2, and 4 with SSE or NEON.
    lanes = 16 if features.get("avx512f") else 8 if features.get("avx2") else 4
    machine = binding.get_process_triple().partition("-")[0]
    version = f"{importlib.import_module('llvmlite').__version__} {binding.llvm_version_info}"
    # Apple's name for the same instruction set.
    machine = "aarch64" if machine == "arm64" else machine
    return Host(
        machine=machine,
        name=binding.get_host_cpu_name(),
        features=features.flatten(),
        lanes=lanes,
        registers=32 if lanes == 16 or machine == "aarch64" else 16,
        version=version,
    )
