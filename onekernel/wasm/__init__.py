"""Compile kernels to one WebAssembly module, for web pages.

A page has no XLA: it calls the module's functions itself. `step_text`, `map_text` and `blocks_text`
write each of them as an LLVM module, and `link` makes one WebAssembly module of all. Their
arguments are addresses, as in C, in the memory that the module exports. It has 32-bit addresses,
vectors of four numbers (SIMD), no threads, and imports nothing. The memory behind the address that
its global `__heap_base` tells is the page's to use.

`llvmlite` compiles, and LLVM's linker `wasm-ld` links.
"""

import functools
import importlib
import math
import shutil
import subprocess
import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import ModuleType

from onekernel import cpu
from onekernel.codegen import STEP, LlvmWriter, Value, map_function
from onekernel.codegen import module_text as module_text
from onekernel.errors import KernelError, UnsupportedError
from onekernel.kernel import Kernel

LANES = 4
"""Number of float32 values in a vector."""

REGISTERS = 16
"""Number of vectors to work with at once; those of the processor behind the browser."""

_TRIPLE = "wasm32-unknown-unknown"
_FEATURES = "+simd128,+bulk-memory,+nontrapping-fptoint,+sign-ext"
_LEVEL = 2
_STACK = 1 << 20
"""Bytes of the stack, below all other memory, so that running over it is an error."""

MAX_ARRAY_BYTES = 64 * 1024
"""Most memory for the arrays of one instance: those of all lanes are on the stack."""

_LINKERS = ("wasm-ld", *(f"wasm-ld-{version}" for version in range(24, 13, -1)))


def obstacle() -> str | None:
    """Return why this machine cannot make modules, with the remedy, or None if it can."""
    if _linker() is None:
        return "LLVM's linker wasm-ld is not installed: apt install lld, or brew install lld"
    try:
        _binding()
    except (ImportError, OSError, RuntimeError) as error:
        return f"llvmlite cannot be used ({error}): pip install llvmlite"
    return None


def step_text(name: str, kernel: Kernel) -> str:
    """Write a function that takes instances through all steps of a kernel.

    Its arguments are the addresses of the arguments and the results, arrays of all instances, and
    the number of instances. A result may be where an argument of the same shape is.

    Args:
      name: the name of the function.
      kernel: the kernel, without a table.

    Returns:
      The text of an LLVM module.

    Raises:
      UnsupportedError: the program has an operation that has no LLVM instruction, or arrays that
        take too much memory.
    """
    w = _begin(name, len(kernel.argument_shapes) + len(kernel.results()), "u32 count")
    *arrays, count = w.parameters
    instances = count.to("u64")
    with w.loop((instances + (LANES - 1)) // LANES) as group:
        w.call("instances", *arrays, group * LANES, instances, *_memory(w, kernel))
    return module_text([*cpu.step_functions(kernel, LANES), w])


def map_text(name: str, kernel: Kernel) -> str:
    """Write a function that computes all items of instances.

    Its arguments are the addresses of the arguments, of the table and of the resulting bytes, and
    the number of instances.

    Args:
      name: the name of the function.
      kernel: the kernel, with a table.

    Returns:
      The text of an LLVM module.

    Raises:
      UnsupportedError: the program has an operation that has no LLVM instruction, or arrays that
        take too much memory.
    """
    assert kernel.table is not None
    items = kernel.table.shape[1]
    # Bytes from one instance to the next; all share the table.
    rows = [*(4 * math.prod(shape) for shape in kernel.argument_shapes), 0]
    rows.append(items * len(kernel.program.outputs))
    w = _begin(name, len(rows), "u32 count")
    *arrays, count = w.parameters
    with w.loop(count.to("u64")) as index:
        addresses = [x.at(index * size, "u8") for x, size in zip(arrays, rows, strict=True)]
        w.call(STEP, *addresses, *_memory(w, kernel))
    return module_text([map_function(kernel.program, lanes=LANES, items=items), w])


def _memory(w: LlvmWriter, kernel: Kernel) -> list[Value]:
    """Return the address of memory for a kernel's arrays, if it has any.

    Raises:
      UnsupportedError: they take too much.
    """
    count = kernel.array_bytes
    if count > MAX_ARRAY_BYTES:
        raise UnsupportedError(
            f"arrays of {count:,} bytes for each instance, more than {MAX_ARRAY_BYTES:,} on a page"
        )
    size = cpu.scratch_bytes(kernel, LANES)
    return [w.allocate(size, "u8", align=64)] if size else []


def blocks_text(name: str, functions: Iterable[LlvmWriter], arrays: int, blocks: int) -> str:
    """Write a function that computes the blocks of one instance, one after the other.

    Its arguments are the addresses of the arrays, and of scratch memory that is aligned to 64
    bytes.

    Args:
      name: the name of the function.
      functions: the function `block`, as for `cpu.call_text`, and those that it calls.
      arrays: the number of arrays.
      blocks: the number of blocks.

    Returns:
      The text of an LLVM module.
    """
    w = _begin(name, arrays, "ptr scratch")
    *addresses, scratch = w.parameters
    job = cpu.job_of_one(addresses)
    with w.loop(blocks) as index:
        w.call("block", job, index, scratch)
    return module_text([*functions, w])


def _begin(name: str, arrays: int, last: str) -> LlvmWriter:
    """Begin to write a function that the module exports."""
    return LlvmWriter(name, *(f"ptr a{i}" for i in range(arrays)), last, convention="external")


def link(texts: Mapping[str, str]) -> bytes:
    """Compile functions, and link them to one WebAssembly module.

    Args:
      texts: the text of each function's LLVM module, by the name of the function.

    Returns:
      The module. It exports the functions, `memory` and `__heap_base`.

    Raises:
      KernelError: this machine cannot make modules, or the linker refuses.
    """
    if reason := obstacle():
        raise KernelError(reason, "platform")
    linker = _linker()
    assert linker is not None
    with tempfile.TemporaryDirectory() as folder:
        objects = []
        for name, text in {**texts, "fma": _fma_text()}.items():
            objects.append(Path(folder, f"{name}.o"))
            objects[-1].write_bytes(_object(text))
        result = Path(folder, "module.wasm")
        command = [linker, "--no-entry", "--strip-all", "--gc-sections", "--stack-first"]
        command += ["-z", f"stack-size={_STACK}", "--export=__heap_base"]
        command += [*(f"--export={name}" for name in texts), "-o", result, *objects]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise KernelError(f"{linker}: {' '.join(done.stderr.split())[:300]}", "platform")
        return result.read_bytes()


@functools.cache
def _linker() -> str | None:
    return next(filter(None, map(shutil.which, _LINKERS)), None)


def _object(text: str) -> bytes:
    """Return the object file of an LLVM module."""
    binding = _binding()
    module = binding.parse_assembly(text, binding.create_context())
    target = binding.Target.from_triple(_TRIPLE).create_target_machine(
        cpu="generic", features=_FEATURES, opt=_LEVEL, reloc="static", codemodel="default"
    )
    module.triple, module.data_layout = _TRIPLE, str(target.target_data)
    return target.emit_object(module)


@functools.cache
def _binding() -> ModuleType:
    binding = importlib.import_module("llvmlite.binding")
    binding.initialize_all_targets()
    binding.initialize_all_asmprinters()
    return binding


def _fma_text() -> str:
    """Write the function `fma` of the C library, which LLVM calls: there is no such instruction.

    The result of a · b + c in `double` is rounded as if it had been computed with twice the digits.

    Source: T. J. Dekker, A floating-point technique for extending the available precision, 1971.
    """
    types = "double a", "double b", "double c"
    w = LlvmWriter("fma", *types, result="double", convention="external")
    a, b, c = w.parameters

    def halves(x: Value) -> tuple[Value, Value]:
        """Return two numbers of half as many digits, whose sum is the number."""
        scaled = x * float(2**27 + 1)
        high = scaled - (scaled - x)
        return high, x - high

    # The product and its rounding error, and then the sum and its own.
    (a1, a2), (b1, b2) = halves(a), halves(b)
    product = a * b
    error = a2 * b2 - (((product - a1 * b1) - a2 * b1) - a1 * b2)
    total = product + c
    added = total - product
    lost = (product - (total - added)) + (c - added)
    w.ret(total + (lost + error))
    return module_text([w])
