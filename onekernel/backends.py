"""Register the back ends that compile kernels."""

import jax

from onekernel import cpu, gpu
from onekernel.kernel import Backend, register
from onekernel.kernel import Kernel as Kernel  # the face takes it from here: with its back ends

BACKENDS: tuple[Backend, ...] = (gpu, cpu)
"""Back ends that can compile a kernel."""

register(*BACKENDS)


_PLATFORMS = {"gpu": "cuda"}
"""Names of lowering platforms, where they differ from those of JAX's devices."""


def default_backend() -> Backend | None:
    """Return the back end for the platform of JAX's default device, if there is one.

    Its `obstacle` tells whether it can run kernels in this process.
    """
    # JAX adds its options to the class at run time.
    default = jax.config.jax_default_device  # pyright: ignore[reportAttributeAccessIssue]
    device = default or jax.local_devices()[0]
    platform = device if isinstance(device, str) else device.platform
    platform = _PLATFORMS.get(platform, platform)
    return next((x for x in BACKENDS if platform == x.PLATFORM), None)
