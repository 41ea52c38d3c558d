"""Define the distribution of an action that is a choice, in the form of Brax's distributions.

An action is a vector with 1 at the choice and 0 elsewhere, so that actions have the same axes
whether they are choices or numbers.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, UInt32

# Before the rest of Brax.
from jetbot_mjx.agents import brax_parts as brax_parts

# isort: split
from brax.training.distribution import ParametricDistribution


class Choice(NamedTuple):
    """A `Choice` is a categorical distribution. Sums over the last axis are those of a choice."""

    log_probs: Float[Array, "*batch choices"]

    @property
    def probs(self) -> Float[Array, "*batch choices"]:
        """Return the probability of each choice."""
        return jnp.exp(self.log_probs)

    def sample(self, seed: UInt32[Array, "2"]) -> Float[Array, "*batch choices"]:
        """Draw a choice."""
        drawn = jax.random.categorical(seed, self.log_probs)
        return jax.nn.one_hot(drawn, self.log_probs.shape[-1])

    def mode(self) -> Float[Array, "*batch choices"]:
        """Return the most probable choice."""
        return jax.nn.one_hot(jnp.argmax(self.log_probs, -1), self.log_probs.shape[-1])

    def log_prob(self, x: Float[Array, "*batch choices"]) -> Float[Array, "*batch choices"]:
        """Return the logarithm of the probability of a choice, at its place."""
        return x * self.log_probs

    def entropy(self) -> Float[Array, "*batch choices"]:
        """Return the share of each choice in the entropy."""
        return -self.probs * self.log_probs

    def kl_divergence(self, old: "Choice") -> Float[Array, "*batch"]:
        """Return the divergence of the old distribution from this one, as Brax's normal does."""
        return jnp.sum(old.probs * (old.log_probs - self.log_probs), axis=-1)

    @property
    def scale(self) -> Float[Array, "*batch choices"]:
        """Return the standard deviation of each number of an action."""
        return jnp.sqrt(self.probs * (1.0 - self.probs))


class CategoricalDistribution(ParametricDistribution):
    """A `CategoricalDistribution` makes a `Choice` of the outputs of a policy network."""

    def __init__(self, event_size: int) -> None:
        """Set the sizes.

        Args:
          event_size: the number of choices.
        """
        super().__init__(event_size, _Identity(), event_ndims=1, reparametrizable=False)

    def create_dist(self, parameters: Float[Array, "*batch choices"]) -> Choice:
        """Return the distribution of unnormalised logarithms of probabilities."""
        return Choice(jax.nn.log_softmax(parameters))


class _Identity:
    """An `_Identity` leaves samples as they are, as a bijector of Brax's."""

    def forward(self, x: Array) -> Array:
        return x

    def inverse(self, y: Array) -> Array:
        return y

    def forward_log_det_jacobian(self, x: Array) -> Array:
        return jnp.zeros_like(x)
