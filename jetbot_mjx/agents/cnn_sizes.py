"""Tell the sizes of the encoders of images: their layers, smallest images and memory.

This module is apart from `vision`, whose libraries take a while to import, because every training
needs it.
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jetbot_mjx.config import NetworkConfig
from jetbot_mjx.errors import InvalidError

Shapes = Mapping[str, tuple[int, ...]]
"""Shapes of the parts of an observation, by name."""


class _Layers(NamedTuple):
    """A `_Layers` holds the sizes of an encoder."""

    convolutions: tuple[tuple[int, int, int], ...]
    """Channels, side of the kernel and stride of each convolution [pixels]."""
    features: int

    @property
    def smallest(self) -> int:
        """Return the side of the smallest image [pixels], which leaves one row of outputs."""
        # Back through the layers: a stride for each output but the first, which takes a kernel.
        size = 1
        for _, side, stride in reversed(self.convolutions):
            size = (size - 1) * stride + side
        return size


CNNS = {
    "nature": _Layers(((32, 8, 4), (64, 4, 2), (64, 3, 1)), 512),
    "small": _Layers(((16, 4, 2), (32, 4, 2), (32, 3, 1)), 128),
    "tiny": _Layers(((16, 4, 4), (32, 4, 2)), 64),
}
"""Encoders by the name that `ppo.network.cnn` takes."""


def is_image(name: str) -> bool:
    """Return whether a part of an observation holds images, as Brax's networks decide it."""
    return name.startswith("pixels/")


def activation_bytes(config: NetworkConfig, shapes: Shapes) -> int:
    """Return the memory of what the encoders compute from one observation [bytes].

    Args:
      config: the layers, and whether policy and value function share them.
      shapes: the shapes of the observation's parts.
    """
    layers = CNNS[config.cnn]
    images = [shape for name, shape in shapes.items() if is_image(name)]
    height, width, _ = images[0]
    channels = sum(shape[2] for shape in images)
    # The features, and of each convolution its outputs and the patches that it multiplies.
    count = layers.features
    for c_out, side, stride in layers.convolutions:
        height, width = ((size - side) // stride + 1 for size in (height, width))
        count += height * width * (side * side * channels + c_out)
        channels = c_out
    # Separate networks encode the image twice.
    encoders = 1 if config.shared_cnn else 2
    return encoders * count * jnp.dtype(compute_dtype(config.cnn_dtype)).itemsize


def check_size(cnn: str, shapes: Shapes) -> None:
    """Check that convolutions leave something of the images.

    Args:
      cnn: the name of the encoder.
      shapes: the shapes of the observation's parts.

    Raises:
      InvalidError: an image is too small.
    """
    # Brax's networks see images by the prefix of their names.
    for height, width, _ in (shape for name, shape in shapes.items() if is_image(name)):
        if min(height, width) < CNNS[cnn].smallest:
            sizes = ", ".join(f"{name}: {layers.smallest}" for name, layers in CNNS.items())
            raise InvalidError(
                f"camera.width = {width} and camera.height = {height} are too small for"
                f" ppo.network.cnn = {cnn!r}: make both at least that of the network ({sizes})"
            )


def compute_dtype(name: str) -> jax.typing.DTypeLike:
    """Return the type of number that `ppo.network.cnn_dtype` names, on JAX's default device."""
    if name == "auto":
        return jnp.float32 if jax.default_backend() == "cpu" else jnp.bfloat16
    return jnp.dtype(name)
