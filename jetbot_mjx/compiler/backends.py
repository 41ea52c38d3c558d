"""Register the back ends that compile kernels, and check that a requested one is available."""

import jax

from jetbot_mjx.compiler import kernel, llvm_backend, ptx_backend
from jetbot_mjx.errors import UserError

BACKENDS: tuple[kernel.Backend, ...] = (ptx_backend, llvm_backend)
"""Back ends that can compile a kernel."""

kernel.register(*BACKENDS)


def require_backend(impl: str, setting: str) -> None:
    """Raise an error if a setting requests a back end that this process does not have.

    Args:
      impl: the setting's value: the name of a back end, `auto` or `xla`.
      setting: the setting's full key.

    Raises:
      UserError: the requested back end is not available.
    """
    for backend in BACKENDS:
        if impl == backend.IMPL and not backend.is_available():
            raise UserError(
                f"{setting} = {impl} needs {backend.NEEDS}; this is"
                f" {jax.default_backend()}: choose xla or auto"
            )
