"""Write kernels as LLVM IR for NVIDIA GPUs: a step, whose thread runs one instance, or a map."""

from collections.abc import Iterator, Sequence

from onekernel import codegen
from onekernel.codegen import LlvmWriter, ProgramWriter, Value, run_program
from onekernel.kernel import Kernel

NAME = "onekernel"
"""Name of a kernel."""

MAX_THREADS = 256
"""Largest number of instances in a block: with 255 registers each, it fills a multiprocessor."""

ITEM_THREADS = 128
"""Number of threads that compute the items of an instance."""

INSTANCES = "INSTANCES"
"""Placeholder in the PTX for the number of instances."""

_BARRIER = "llvm.nvvm.barrier0"


def kernel_text(kernel: Kernel, *, shares: bool = False) -> str:
    """Write a kernel that steps as LLVM IR.

    Its parameters are the addresses of all argument leaves, followed by the addresses of all result
    leaves. Each is an array of shape (instances, ...), whose words are copied as float32.

    Args:
      kernel: the kernel.
      shares: whether the threads of a block copy arrays by way of shared memory.

    Returns:
      The text of an LLVM module.
    """
    sizes, stored = kernel.argument_words, kernel.result_words
    w = _writer(len(sizes) + len(stored))
    # Shared memory (address space 3) whose size the launch gives: an array of length 0.
    w.declare("@shared = external addrspace(3) global [0 x float], align 16")
    given, returned = w.parameters[: len(sizes)], w.parameters[len(sizes) :]
    # Find the instance of the thread. Threads beyond the last instance step the last one, too, but
    # do not store it: all threads must reach the barriers.
    thread, block, threads = (_register(w, name) for name in ("tid.x", "ctaid.x", "ntid.x"))
    first = block * threads
    wanted = first + thread
    # Inline assembly puts a placeholder into the PTX, which the launch replaces by the number.
    instances = w.let(f'call i32 asm "mov.u32 $0, {INSTANCES};", "=r"()', "u32")
    is_there = wanted < instances
    instance = w.select(is_there, wanted, instances - 1)
    wide = instance.to("u64")
    rows = _SharedRows(w, instance, thread, threads, first, instances) if shares else _Rows(wide)
    # Load the arguments, and compute those of the first step.
    rows.fetch(given, sizes)
    arguments = [address.load() for address in rows.addresses(given, sizes)]
    if kernel.before is not None:
        arguments = run_program(w, kernel.before, arguments, for_gpu=True)
    results = _steps(w, kernel, arguments)
    # Compute what comes after the last step. Load the arguments again instead of keeping them in
    # registers, which the steps need.
    if kernel.after is not None:
        again = [address.load() for address in rows.addresses(given, sizes)]
        results = run_program(w, kernel.after, [*again, *results], for_gpu=True)
    # Store the results.
    rows.release()
    with w.when(is_there):
        for address, result in zip(rows.addresses(returned, stored), results, strict=True):
            address.store(result)
    rows.deliver(returned, stored)
    return module_text(w, MAX_THREADS)


def _steps(w: LlvmWriter, kernel: Kernel, arguments: Sequence[Value]) -> list[Value]:
    """Append all steps, whose carried values begin with the arguments, and return their results."""
    program = kernel.program
    read, written = (
        sum(array.size for array in arrays)
        for arrays in (program.inputs[: kernel.carried], program.outputs)
    )
    # A function that runs once may return other arrays than it takes.
    carried = min(read, written)
    with w.repeat(w.constant(0, "u32"), *arguments[:carried]) as loop:
        step, *now = loop.carried
        # Without this barrier, threads whose loops make different numbers of iterations drift
        # apart until their instructions no longer fit into the cache: 540 instead of 760 M steps/s.
        w.call(_BARRIER)
        results = run_program(w, program, [*now, *arguments[carried:]], for_gpu=True)
        following = step + 1
        loop.again(following < kernel.steps, following, *results[:carried])
    return results


def map_kernel_text(kernel: Kernel) -> str:
    """Write a kernel with a table as LLVM IR.

    Its parameters are the addresses of all arguments, float32 arrays of shape (instances, ...), of
    the table, of shape (scalars of the program's last argument, items), and of the results, bytes
    of shape (instances, items x results). A block of threads computes one instance: each thread
    loads what the items share, computes what follows from it, and goes through the items in strides
    of a block.

    Args:
      kernel: the kernel.

    Returns:
      The text of an LLVM module.
    """
    *sizes, row = [array.size for array in kernel.program.inputs]
    assert kernel.table is not None
    items, count = kernel.table.shape[1], len(kernel.program.outputs)
    w = _writer(len(sizes) + 2)
    *given, table, out = w.parameters
    thread, instance = _register(w, "tid.x"), _register(w, "ctaid.x").to("u64")
    first = instance * items
    # Compute what all items share.
    body = ProgramWriter(w, kernel.program, fast_division=True, for_gpu=True)
    body.hoist(address.load() for address in _Rows(instance).addresses(given, sizes))
    # Compute the items of the thread.
    with w.when(thread < items), w.repeat(thread) as loop:
        (item,) = loop.carried
        place = item.to("u64")
        byte = (first + place) * count
        # Neighbouring threads read neighbouring words of a row, which a GPU does in one
        # transaction.
        columns = [(table + j * items + place).load() for j in range(row)]
        for i, result in enumerate(body.finish(columns)):
            out.at(byte + i, "u8").store(result.to("u8"))
        following = item + ITEM_THREADS
        loop.again(following < items, following)
    return module_text(w, ITEM_THREADS)


def module_text(kernel: LlvmWriter, threads: int) -> str:
    """Return the module of a kernel, whose blocks have at most so many threads."""
    # Metadata with which LLVM tells the driver the largest block, and that a multiprocessor need
    # not hold more than one. Otherwise the driver gives the threads of a large program as few as 32
    # registers each, so that more blocks fit, and half_cheetah makes half as many steps.
    limits = {"maxntidx": threads, "minctasm": 1}
    annotations = [
        f'!{i} = !{{ptr @{kernel.name}, !"{name}", i32 {limit}}}'
        for i, (name, limit) in enumerate(limits.items())
    ]
    return codegen.module_text([kernel], "!nvvm.annotations = !{!0, !1}", *annotations)


def _writer(arrays: int) -> LlvmWriter:
    """Begin a kernel, whose parameters are the addresses of so many arrays."""
    # Address space 1 is the GPU's main memory, where XLA's arrays are.
    parameters = (f"ptr addrspace(1) a{i}" for i in range(arrays))
    return LlvmWriter(NAME, *parameters, convention="ptx_kernel")


def _register(w: LlvmWriter, name: str) -> Value:
    """Return a special register of the thread."""
    return w.call(f"llvm.nvvm.read.ptx.sreg.{name}", result="u32")


class _Rows:
    """A `_Rows` gives a thread the rows of its instance, directly in XLA's arrays.

    The methods `fetch`, `release` and `deliver` do nothing here; `_SharedRows` copies rows in them.
    """

    def __init__(self, instance: Value) -> None:
        self._instance = instance

    def fetch(self, arrays: Sequence[Value], sizes: Sequence[int]) -> None:
        """Prepare to load the rows of some arrays."""

    def release(self) -> None:
        """Prepare to store rows."""

    def deliver(self, arrays: Sequence[Value], sizes: Sequence[int]) -> None:
        """Finish the rows of some arrays."""

    def addresses(self, arrays: Sequence[Value], sizes: Sequence[int]) -> Iterator[Value]:
        """Yield the addresses of all scalars of an instance.

        Args:
          arrays: the arrays.
          sizes: the number of scalars of an instance in each array.
        """
        for array, size in zip(arrays, sizes, strict=True):
            # An array holds the rows of all instances, one after the other.
            row = array.at(self._instance * (4 * size), "u8")
            for i in range(size):
                yield row.at(i)


class _SharedRows(_Rows):
    """A `_SharedRows` lets the threads of a block copy their rows to shared memory and back."""

    def __init__(
        self,
        w: LlvmWriter,
        instance: Value,
        thread: Value,
        threads: Value,
        first: Value,
        instances: Value,
    ) -> None:
        """Find the rows of the block.

        Args:
          w: the writer.
          instance: the instance of the thread.
          thread: the place of the thread in the block.
          threads: the number of threads of a block.
          first: the first instance of the block.
          instances: the number of all instances.
        """
        self._shared = Value(w, "@shared", "ptr addrspace(3)")
        self._writer, self._thread, self._threads, self._first = w, thread, threads, first
        # The row of the thread within the block, and how many rows of the block exist.
        self._local = instance - first
        self._rows = w.minimum(threads, instances - first)

    def fetch(self, arrays: Sequence[Value], sizes: Sequence[int]) -> None:
        # After the barrier, each thread finds its row whole, whichever threads have copied it.
        self._copy(arrays, sizes, to_shared=True)
        self._writer.call(_BARRIER)

    def release(self) -> None:
        # The results overwrite the arguments in shared memory: wait until all threads of the block
        # have read theirs.
        self._writer.call(_BARRIER)

    def deliver(self, arrays: Sequence[Value], sizes: Sequence[int]) -> None:
        self._writer.call(_BARRIER)
        self._copy(arrays, sizes, to_shared=False)

    def addresses(self, arrays: Sequence[Value], sizes: Sequence[int]) -> Iterator[Value]:
        start = 0
        for size in sizes:
            # The rows of an array follow those of the arrays before it, for the whole block.
            place = self._threads * start + self._local * size
            for i in range(size):
                yield self._shared + (place + i)
            start += size

    def _copy(self, arrays: Sequence[Value], sizes: Sequence[int], *, to_shared: bool) -> None:
        """Copy the block's rows of all arrays to shared memory or back, word by word."""
        start = 0
        for array, size in zip(arrays, sizes, strict=True):
            there = array + (self._first * size).to("u64")
            here = self._shared + self._threads * start
            last = self._rows * size - 1
            # Load all words before the first store: a thread waits for memory once.
            words, word = [], self._thread
            for _ in range(size):
                # In the last block, some threads copy the last word too.
                place = self._writer.intrinsic("umin", word, last)
                shared, other = here + place, there + place
                source, target = (other, shared) if to_shared else (shared, other)
                words.append((source.load(), target))
                word = word + self._threads
            for value, target in words:
                target.store(value)
            start += size
