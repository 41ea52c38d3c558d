"""Build policy and value networks that see: convolutions in front of Brax's networks.

Motivation: Brax's vision networks give the policy and the value function convolutions of their own,
which doubles the most expensive part of an update, and XLA's gradients of convolutions are slow on
CPUs. Here both share one encoder by default, and a convolution is a matrix product.

Equations: the encoder maps an image to features φ, and Brax's networks see (φ, normalised numbers):

    x₀ = pixels / 255,  x_i = relu(x_{i-1} * W_i + b_i),  φ = relu(W flatten(x) + b)

The encoder's parameters are part of the policy's, because inference needs them. The loss encodes a
minibatch once, and passes the features to Brax's loss as its observation, so that gradients flow
from policy and value function into one encoder.

Source: V. Mnih et al., Nature 518 (2015), 529-533, for `nature`; google/brax v0.14.2,
brax/training/agents/ppo/networks_vision.py.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree, UInt8

# Before the rest of Brax.
from jetbot_mjx.agents.brax_parts import Normalizer
from jetbot_mjx.agents.cnn_sizes import CNNS, Shapes, compute_dtype, is_image
from jetbot_mjx.config import NetworkConfig

# isort: split
from brax.training import networks as brax_networks
from brax.training.agents.ppo import networks as ppo_networks

Images = Mapping[str, Array]
"""An observation with images, by the names of its parts."""

_POLICY, _VALUE = "policy", "value"

ENCODER, HEAD = "encoder", "head"
"""Keys of the parts of a network's parameters."""


class VisionNetworks(NamedTuple):
    """A `VisionNetworks` has the attributes of Brax's `PPONetworks`, and its encoder."""

    policy_network: brax_networks.FeedForwardNetwork
    """The policy: parameters and observation to the parameters of the action distribution."""
    value_network: brax_networks.FeedForwardNetwork
    """The value function; it takes encoded observations if its encoder is the policy's."""
    parametric_action_distribution: Any
    heads: ppo_networks.PPONetworks
    """The networks behind the encoder, which take encoded observations."""
    encode: Callable[[Normalizer, PyTree, PyTree], dict[str, Float[Array, "*batch features"]]]
    """Encode observations: (normaliser, parameters of both networks, observation)."""


class _ObservationEncoder(NamedTuple):
    """An `_ObservationEncoder` joins the features of the images and the normalised numbers."""

    encoder: "Encoder"
    shapes: Shapes
    normalize: Callable[[PyTree, Normalizer], PyTree]

    @property
    def features(self) -> int:
        """Return the length of an encoded observation."""
        numbers = (shape[0] for name, shape in self.shapes.items() if not is_image(name))
        return self.encoder.features + sum(numbers)

    def init(self, key: Array) -> PyTree:
        """Return initial parameters of the encoder."""
        images = {name: (1, *shape) for name, shape in self.shapes.items() if is_image(name)}
        pixels = {name: jnp.zeros(shape, jnp.uint8) for name, shape in sorted(images.items())}
        return self.encoder.init(key, _joined(pixels))

    def __call__(
        self, normalizer: Normalizer, params: PyTree, obs: Mapping[str, Array]
    ) -> Float[Array, "*batch features"]:
        # Encode all images at once, and join the features and the normalised numbers.
        images = {name: obs[name] for name in sorted(self.shapes) if is_image(name)}
        numbers = {name: obs[name] for name in sorted(self.shapes) if name not in images}
        values = self.normalize(numbers, normalizer)
        features: Any = self.encoder.apply(params[ENCODER], _joined(images))
        return jnp.concatenate([features, *(values[name] for name in numbers)], axis=-1)


def make_vision_networks(
    config: NetworkConfig,
    shapes: Shapes,
    action_size: int,
    *,
    make_heads: Callable[..., ppo_networks.PPONetworks],
    normalize: Callable[[PyTree, Normalizer], PyTree],
) -> VisionNetworks:
    """Build the networks for an observation with images.

    Args:
      config: the layers, the activation and the action distribution.
      shapes: the shapes of the observation's parts.
      action_size: the length of the action.
      make_heads: builds Brax's networks from (observation_size, action_size, ...).
      normalize: a function of (numbers, statistics) that normalises the numbers.
    """
    # An encoder, and Brax's networks behind it, which take features and numbers as one vector.
    layers = CNNS[config.cnn]
    encoder = Encoder(layers.convolutions, layers.features, config.cnn_dtype)
    encode_one = _ObservationEncoder(encoder, shapes, normalize)
    brax_heads = make_heads(encode_one.features, action_size)

    def encode(normalizer: Normalizer, params: PyTree, obs: Images) -> dict[str, Array]:
        for_policy = encode_one(normalizer, params.policy, obs)
        if config.shared_cnn:
            return {_POLICY: for_policy, _VALUE: for_policy}
        return {_POLICY: for_policy, _VALUE: encode_one(normalizer, params.value, obs)}

    policy, value = brax_heads.policy_network, brax_heads.value_network
    # Pyright does not follow flax's dataclasses.
    networks: Any = ppo_networks.PPONetworks
    heads = networks(
        _on_features(_POLICY, policy, encode_one),
        _on_features(_VALUE, value, None if config.shared_cnn else encode_one),
        brax_heads.parametric_action_distribution,
    )

    # For inference: encode and apply one network.
    def with_encoder(
        name: str, head: brax_networks.FeedForwardNetwork
    ) -> brax_networks.FeedForwardNetwork:
        def apply(normalizer: Normalizer, params: PyTree, obs: Images) -> Array:
            return head.apply(None, params, {name: encode_one(normalizer, params, obs)})

        return brax_networks.FeedForwardNetwork(init=head.init, apply=apply)

    on_images = with_encoder(_VALUE, heads.value_network)
    return VisionNetworks(
        policy_network=with_encoder(_POLICY, heads.policy_network),
        value_network=heads.value_network if config.shared_cnn else on_images,
        parametric_action_distribution=heads.parametric_action_distribution,
        heads=heads,
        encode=encode,
    )


def _on_features(
    name: str, head: brax_networks.FeedForwardNetwork, encoder: _ObservationEncoder | None
) -> brax_networks.FeedForwardNetwork:
    """Return one of Brax's networks as a network of an encoded observation.

    Args:
      name: the part of the encoded observation that the network takes.
      head: Brax's network of features.
      encoder: the encoder whose parameters are among the network's; None: another has them.
    """

    def init(key: Array) -> PyTree:
        encoder_key, head_key = jax.random.split(key)
        own = {} if encoder is None else {ENCODER: encoder.init(encoder_key)}
        return {HEAD: head.init(head_key), **own}

    return brax_networks.FeedForwardNetwork(
        init=init,
        apply=lambda _, params, encoded: head.apply(None, params[HEAD], encoded[name]),
    )


def _joined(images: Mapping[str, UInt8[Array, "*batch h w c"]]) -> UInt8[Array, "*batch h w c"]:
    """Return several images of one size as the channels of one."""
    return jnp.concatenate(list(images.values()), axis=-1)


class Encoder(nn.Module):
    """An `Encoder` maps images to features."""

    convolutions: tuple[tuple[int, int, int], ...]
    """Channels, side of the kernel and stride of each convolution [pixels]."""
    features: int
    dtype: str
    """`auto`, `float32` or `bfloat16`."""

    @nn.compact
    def __call__(self, pixels: UInt8[Array, "*batch h w c"]) -> Float[Array, "*batch features"]:
        """Return the features of images, at any number of batch axes."""
        dtype = compute_dtype(self.dtype)
        batch = pixels.shape[:-3]
        x = pixels.reshape(-1, *pixels.shape[-3:])
        for i, (channels, side, stride) in enumerate(self.convolutions):
            shape = (side, side, x.shape[-1], channels)
            kernel = self.param(f"conv_{i}_kernel", nn.initializers.lecun_normal(), shape)
            bias = self.param(f"conv_{i}_bias", nn.initializers.zeros_init(), (channels,))
            if i == 0:
                # Divide the few weights instead of the many pixels.
                kernel = kernel / 255.0
            x = nn.relu(convolve(x, kernel.astype(dtype), stride) + bias.astype(dtype))
        # All outputs of the last convolution to the features, in float32 for what follows.
        x = x.reshape(x.shape[0], -1)
        x = nn.relu(nn.Dense(self.features, dtype=dtype, name="dense")(x))
        return x.astype(jnp.float32).reshape(*batch, self.features)


def convolve(
    x: Array, kernel: Float[Array, "side side c_in c_out"], stride: int
) -> Float[Array, "n h_out w_out c_out"]:
    """Convolve images without padding, as one matrix product.

    The image is cut into squares as large as the stride, whose pixels become channels; a kernel
    covers m × m of them, side = m stride, and their shifted copies become channels again. XLA's own
    gradients of convolutions take many times as long on CPUs.

    Args:
      x: images of shape (n, h, w, c_in), of any dtype.
      kernel: the weights, of the dtype to compute with; its side is a multiple of the stride.
      stride: the stride of the convolution [pixels].

    Returns:
      The images convolved, as `jax.lax.conv` does with padding VALID.
    """
    count, height, width, c_in = x.shape
    side, _, _, c_out = kernel.shape
    m = side // stride
    rows, columns = ((size - side) // stride + 1 for size in (height, width))
    # Cut into squares: (n, row, column, square).
    down, right = rows + m - 1, columns + m - 1
    x = x[:, : down * stride, : right * stride]
    x = x.reshape(count, down, stride, right, stride, c_in).transpose(0, 1, 3, 2, 4, 5)
    x = x.reshape(count, down, right, stride * stride * c_in)
    # Join the squares that a kernel covers, and order its weights likewise.
    parts = [x[:, i : i + rows, j : j + columns] for i in range(m) for j in range(m)]
    patches = jnp.concatenate(parts, axis=-1).astype(kernel.dtype)
    weights = kernel.reshape(m, stride, m, stride, c_in, c_out).transpose(0, 2, 1, 3, 4, 5)
    weights = weights.reshape(math.prod(kernel.shape[:3]), c_out)
    return patches @ weights
