"""Choose JAX's devices, the options of XLA, and the folder of compiled programs.

On a CPU, most of the time before the first training step is spent on compilation, and optimisation
level 1 shortens it; a level that XLA_FLAGS names is left alone. Do not turn off the fusion emitters
to save even more: at level 2 without them, the same program has returned different bits from one
call to the next, and a program that uses its intermediate results often can grow without end.

The library YNNPACK, to which XLA leaves sums and products on CPUs, divides them by the number of
cores. Without it, the bits of a fused training do not depend on the machine's cores.
"""

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

import jax

from jetbot_mjx.errors import UserError
from jetbot_mjx.fallbacks import Fallback, report
from onekernel import cache_folder, known_options

Options = dict[str, bool | int | float | str]

_ON_CPU: Options = {
    "xla_backend_optimization_level": 1,
    "xla_cpu_experimental_ynn_fusion_type": "",
}

# Use no atomics, and choose no kernels by timing them, so that each process gets the same bits.
_DETERMINISTIC: Options = {"xla_gpu_deterministic_ops": True, "xla_gpu_autotune_level": 0}


def compiler_options(deterministic: bool) -> Options:
    """Return the compiler options for the programs of a run.

    Args:
      deterministic: whether each process must get the same bits on a GPU, too.

    Returns:
      The options as `jax.jit` takes them, without those that the installed XLA does not know.

    Raises:
      JaxRuntimeError: `deterministic` needs an option that XLA does not know.
    """
    wanted = dict(_DETERMINISTIC) if deterministic else {}
    return {**wanted, **known_options(_ON_CPU)} if jax.default_backend() == "cpu" else wanted


def require_float32() -> None:
    """Raise an error if JAX computes in 64 bits.

    Raises:
      UserError: it does.
    """
    if jax.config.values["jax_enable_x64"]:
        raise UserError("all is computed in float32, and JAX_ENABLE_X64 is set: unset it")


def use_compilation_cache() -> None:
    """Enable JAX's compilation cache in the user's cache folder, for later processes.

    `JAX_COMPILATION_CACHE_DIR` names another folder, and `JAX_ENABLE_COMPILATION_CACHE=false`
    turns it off. A folder that other users may write to is not used, because JAX runs the programs
    that it finds there.
    """
    settings = jax.config.values
    given = settings["jax_compilation_cache_dir"]
    # Leave remote folders such as gs:// to JAX.
    if not settings["jax_enable_compilation_cache"] or "://" in (given or ""):
        return
    folder = _cache_folder(given)
    jax.config.update("jax_compilation_cache_dir", folder and str(folder))
    if folder and not given:
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


def _cache_folder(given: str | None) -> Path | None:
    """Return the folder of compiled programs, created if missing; None if it cannot be used."""
    try:
        if given:
            return cache_folder(Path(given))
        root = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        return cache_folder(root / "jetbot_mjx", by_processor=True)
    except OSError as error:
        # Python's own errors name the file apart from what is wrong with it.
        name = f"{error.filename}: {error.strerror}" if error.strerror else str(error)
        report(Fallback("compilation cache", name))
    except RuntimeError:
        report(Fallback("compilation cache", "no home folder: set HOME or XDG_CACHE_HOME"))
    return None


def require_device() -> None:
    """Raise an error if JAX has no usable device.

    Raises:
      UserError: `JAX_PLATFORMS` names a missing platform, or JAX is set to 64 bits.
    """
    require_float32()
    try:
        jax.devices()
    # JAX fails by an assertion where the plugin for a platform is not installed.
    except (RuntimeError, AssertionError):
        wanted = os.environ.get("JAX_PLATFORMS")
        raise UserError(
            f"JAX_PLATFORMS = {wanted!r} cannot be used here: unset it, or install what it needs"
        ) from None


@contextlib.contextmanager
def default_device_cpu() -> Iterator[object]:
    """Run the computations inside on the host CPU, where small programs compile at once.

    Yields:
      JAX's device of the host CPU.
    """
    device = host_cpu()
    with jax.default_device(device):
        yield device


def host_cpu() -> object:
    """Return JAX's device of the host CPU, or the default device if `JAX_PLATFORMS` excludes it."""
    try:
        return jax.local_devices(backend="cpu")[0]
    except RuntimeError:
        return jax.local_devices()[0]
