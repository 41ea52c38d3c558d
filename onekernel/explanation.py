"""Tell what a function is as one kernel, or what keeps it from being one."""

import time
from collections.abc import Callable

from jaxtyping import PyTree

from onekernel.backends import default_backend
from onekernel.errors import UnsupportedError
from onekernel.fused import Fused, fuse
from onekernel.kernel import Kernel


def explain(function: Callable[..., PyTree], *arguments: PyTree, **keywords: PyTree) -> None:
    """Print what a function is as one kernel on JAX's default device.

    That is the number of operations of one instance (those of a loop count once), what an instance
    reads and writes, and how the compiler fits it into the processor's registers. What does not fit
    is spilled, which means stored in memory and loaded again: many spills make a kernel slow. If
    there is no kernel, it is the first operation that stands in the way, with the line of it.

    Args:
      function: a function of one instance, fused or not.
      arguments: its arguments, or their shapes and dtypes.
      keywords: likewise.
    """
    one = function if isinstance(function, Fused) else fuse(function, on_unsupported="xla")
    begin = time.perf_counter()
    kernel = one.lowered(*arguments, **keywords).one
    seconds = time.perf_counter() - begin
    name = getattr(one, "__name__", "function")
    if isinstance(kernel, UnsupportedError):
        print(f"{name} is no kernel: one kernel cannot do {kernel}")
        return
    rows = [
        ("operations", f"{_operations(kernel):,}"),
        ("reads", f"{4 * sum(kernel.argument_words):,} bytes an instance"),
        ("writes", f"{4 * sum(kernel.result_words):,} bytes an instance"),
        ("traced and lowered in", f"{seconds:.2f} s"),
    ]
    backend = default_backend()
    obstacle = "no kernels for this device"
    if backend is not None:
        obstacle = backend.obstacle() or backend.refusal(kernel)
    if backend is None or obstacle:
        rows.append(("compiled", f"not here: {obstacle}"))
    else:
        compiled = backend.inspect(kernel)
        rows += [
            ("compiled in", f"{compiled.seconds:.2f} s, for {compiled.target}"),
            ("registers", compiled.registers),
            ("spilled", compiled.spilled),
        ]
    print(f"{name} is one kernel")
    for label, value in rows:
        print(f"  {label:<22} {value}")


def _operations(kernel: Kernel) -> int:
    return sum(program.size for program in kernel.programs)
