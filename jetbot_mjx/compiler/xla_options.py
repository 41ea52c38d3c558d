"""Choose XLA's compiler options, and pass only those that the installed version knows.

On a CPU, most of the time before the first training step is spent on compilation, and optimisation
level 1 shortens it; a level that XLA_FLAGS names is left alone. Do not turn off the fusion emitters
to save even more: at level 2 without them, the same program has returned different bits from one
call to the next, and a program that uses its intermediate results often can grow without end.

The library YNNPACK, to which XLA leaves sums and products on CPUs, divides them by the number of
cores. Without it, the bits of a fused training do not depend on the machine's cores.
"""

import contextlib
import functools
import os
import time
from collections.abc import Iterator
from typing import Any

import jax

from jetbot_mjx.config import Config

Options = dict[str, Any]

_ON_CPU: Options = {
    "xla_backend_optimization_level": 1,
    "xla_cpu_experimental_ynn_fusion_type": "",
}

# Choose no kernels by timing them.
_UNTUNED: Options = {"xla_gpu_autotune_level": 0}

# Use no atomics either, so that each process gets the same bits.
_DETERMINISTIC: Options = {"xla_gpu_deterministic_ops": True, **_UNTUNED}


def compiler_options(config: Config) -> Options:
    """Return the compiler options for the programs of a run.

    Args:
      config: the configuration of the run.

    Returns:
      The options as `jax.jit` takes them, without those that the installed XLA does not know.

    Raises:
      JaxRuntimeError: `deterministic` needs an option that XLA does not know.
    """
    wanted = dict(_DETERMINISTIC) if config.deterministic else {}
    return {**wanted, **_possible(_ON_CPU)} if jax.default_backend() == "cpu" else wanted


def untuned_options() -> Options:
    """Return options with which XLA times no kernels on a GPU, which takes it a second."""
    return _possible(_UNTUNED) if jax.default_backend() == "gpu" else {}


def unseen_options() -> Options:
    """Return an option that changes nothing on CPUs, with a value that JAX's cache has not seen."""
    return _possible({"xla_gpu_nccl_termination_timeout_seconds": time.time_ns() % 1_000_000_000})


def _possible(options: Options) -> Options:
    """Return the options that XLA knows and that XLA_FLAGS does not name."""
    flags = os.environ.get("XLA_FLAGS", "")
    return {
        name: value
        for name, value in options.items()
        if name not in flags and _is_known(name, value)
    }


@functools.cache
def _is_known(name: str, value: Any) -> bool:
    """Return whether XLA knows an option; XLA refuses to compile with an unknown one."""
    try:
        jax.jit(lambda: 0, compiler_options={name: value}).lower().compile()
    except jax.errors.JaxRuntimeError as error:
        if "No such compile option" not in str(error):
            raise
        return False
    return True


@contextlib.contextmanager
def default_device_cpu() -> Iterator[Any]:
    """Run the computations inside on the host CPU, where small programs compile at once.

    Yields:
      JAX's device of the host CPU.
    """
    device = host_cpu()
    with jax.default_device(device):
        yield device


def host_cpu() -> Any:
    """Return JAX's device of the host CPU, or the default device if `JAX_PLATFORMS` excludes it."""
    try:
        return jax.local_devices(backend="cpu")[0]
    except RuntimeError:
        return jax.local_devices()[0]
