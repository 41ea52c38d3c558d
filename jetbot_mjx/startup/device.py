"""Wake the device while the host imports, and turn JAX's compilation cache on."""

import contextlib
import ctypes
import os
import threading

from jetbot_mjx.startup.switch import is_plain


def wake_driver() -> None:
    """Start to open NVIDIA's driver in a thread, if there is one, while the host imports JAX.

    JAX opens it later, and holds Python's lock meanwhile: on an H200 for a fifth of a second.
    """

    def open_driver() -> None:
        # JAX reports what is wrong with the driver.
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL("libcuda.so.1").cuInit(0)

    platforms = os.environ.get("JAX_PLATFORMS")
    is_possible = not platforms or {"cuda", "gpu"} & set(platforms.split(","))
    if is_possible and not is_plain():
        threading.Thread(target=open_driver, daemon=True).start()


def wake_device() -> None:
    """Start to initialise the device in a thread, while the host continues.

    JAX then allocates GPU memory as needed, unless `XLA_PYTHON_CLIENT_PREALLOCATE` requests its
    default of allocating three quarters at once, which takes two seconds and leaves little memory
    for other processes.
    """
    if is_plain():
        return
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    import jax

    def touch() -> None:
        # The first code that needs the device will report the error.
        with contextlib.suppress(RuntimeError, AssertionError):
            jax.block_until_ready(jax.device_put(0.0, jax.local_devices()[0]))

    threading.Thread(target=touch, daemon=True).start()


def load_blas() -> None:
    """Have XLA load a GPU's libraries for matrix products in a thread: it takes half a second."""
    import jax
    import numpy as np

    if is_plain() or jax.default_backend() != "gpu" or jax.process_count() > 1:
        return

    def multiply() -> None:
        # The first program that multiplies matrices will report the error.
        with contextlib.suppress(RuntimeError):
            matrix = jax.ShapeDtypeStruct((128, 128), np.float32)
            jax.jit(lambda x: x @ x).trace(matrix).lower().compile()

    threading.Thread(target=multiply, daemon=True).start()


def divide_cpu(devices: int | None) -> None:
    """Divide the CPU into devices, if JAX has not begun yet; a training refuses another number.

    Args:
      devices: the setting `cpu_devices`; None: leave it to JAX.
    """
    import jax

    if devices is not None:
        with contextlib.suppress(RuntimeError):
            jax.config.update("jax_num_cpu_devices", devices)


def enable_jax_cache() -> None:
    """Enable JAX's compilation cache, as `devices.use_compilation_cache` describes it."""
    from jetbot_mjx.devices import use_compilation_cache

    if not is_plain():
        use_compilation_cache()
