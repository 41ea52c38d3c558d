"""Choose XLA's compiler options for programs that are cached, of those that this XLA knows."""

import functools
import os
import time

import jax

Options = dict[str, bool | int | float | str]

# Choose no kernels by timing them.
_UNTUNED: Options = {"xla_gpu_autotune_level": 0}


def untuned_options() -> Options:
    """Return options with which XLA times no kernels on a GPU, which takes it a second."""
    return known_options(_UNTUNED) if jax.default_backend() == "gpu" else {}


def unseen_options() -> Options:
    """Return an option that changes nothing on CPUs, with a value that JAX's cache has not seen."""
    # The option means nothing on a CPU, but is part of JAX's cache key: a value that was never used
    # before makes JAX compile the program.
    return known_options(
        {"xla_gpu_nccl_termination_timeout_seconds": time.time_ns() % 1_000_000_000}
    )


def known_options(options: Options) -> Options:
    """Return the options that XLA knows and that XLA_FLAGS does not name."""
    flags = os.environ.get("XLA_FLAGS", "")
    return {
        name: value
        for name, value in options.items()
        if name not in flags and _is_known(name, value)
    }


@functools.cache
def _is_known(name: str, value: bool | int | float | str) -> bool:
    """Return whether XLA knows an option; XLA refuses to compile with an unknown one."""
    try:
        # Compile a program that does nothing with this option.
        jax.jit(lambda: 0, compiler_options={name: value}).lower().compile()
    except jax.errors.JaxRuntimeError as error:
        if "No such compile option" not in str(error):
            raise
        return False
    return True
