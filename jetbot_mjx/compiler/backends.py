"""Register the back ends that compile kernels, and check that a requested one is available."""

from typing import Any

import jax

from jetbot_mjx.compiler import kernel, llvm_backend, ptx_backend
from jetbot_mjx.errors import UserError

BACKENDS: tuple[kernel.Backend, ...] = (ptx_backend, llvm_backend)
"""Back ends that can compile a kernel."""

kernel.register(*BACKENDS)


_PLATFORMS = {"gpu": "cuda"}
"""Names of lowering platforms, where they differ from those of JAX's devices."""


def default_backend(impl: str) -> kernel.Backend | None:
    """Return the back end that runs kernels on JAX's default device, if there is one.

    Args:
      impl: the name of the back end that must run them, or `auto`.
    """
    backend = _platform_backend()
    return backend if backend in available_backends(impl) else None


def obstacle(impl: str) -> str | None:
    """Return why JAX's default device runs no kernels, although its platform may; None otherwise.

    Args:
      impl: the setting's value: the name of a back end, `auto` or `xla`.
    """
    backend = _platform_backend()
    return backend.obstacle() if impl == "auto" and backend else None


def _platform_backend() -> kernel.Backend | None:
    """Return the back end for the platform of JAX's default device, if there is one."""
    settings: Any = jax.config
    device = settings.jax_default_device or jax.local_devices()[0]
    platform = device if isinstance(device, str) else device.platform
    platform = _PLATFORMS.get(platform, platform)
    return next((x for x in BACKENDS if platform == x.PLATFORM), None)


def available_backends(impl: str) -> list[kernel.Backend]:
    """Return the back ends that a setting allows and this process has.

    Args:
      impl: the setting's value: the name of a back end, `auto` or `xla`.
    """
    return [x for x in BACKENDS if impl in ("auto", x.IMPL) and not x.obstacle()]


def require_float32() -> None:
    """Raise an error if JAX computes in 64 bits.

    Raises:
      UserError: it does.
    """
    if jax.config.values["jax_enable_x64"]:
        raise UserError("all is computed in float32, and JAX_ENABLE_X64 is set: unset it")


def require_backend(impl: str, setting: str) -> None:
    """Raise an error if a setting requests a back end that this process does not have.

    Args:
      impl: the setting's value: the name of a back end, `auto` or `xla`.
      setting: the setting's full key.

    Raises:
      UserError: the requested back end is not available.
    """
    for backend in BACKENDS:
        if impl == backend.IMPL and (obstacle := backend.obstacle()):
            raise UserError(f"{setting} = {impl}: {obstacle}; or choose xla or auto")
