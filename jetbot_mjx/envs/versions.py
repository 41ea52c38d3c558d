"""Tell the versions of the libraries on which results depend."""

import functools

LIBRARIES = ("brax", "flax", "jax", "jaxlib", "llvmlite", "mujoco", "mujoco-mjx", "numpy", "optax")
"""Libraries of whose releases the results of a training depend."""


@functools.cache
def installed_version(library: str) -> str | None:
    """Return the version of a library, or None if it is not installed."""
    # Commands that store no versions start without it.
    import importlib.metadata

    try:
        return importlib.metadata.version(library)
    except importlib.metadata.PackageNotFoundError:
        return None
