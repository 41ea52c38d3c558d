"""Describe networks and minibatches to the kernels of PPO's update."""

import itertools
import math
from typing import Any, NamedTuple

POLICY_METRICS = ("policy_loss", "entropy", "kl", "std")
VALUE_METRICS = ("value_loss",)
"""Sums over the samples, in the order of the vector of parameters."""


class UpdateShape(NamedTuple):
    """An `UpdateShape` describes both networks, which have the same hidden layers, and the loss.

    Their parameters are one vector: for each network and layer the weights, of shape (inputs,
    outputs), and the biases; then the policy's standard deviations, if the distribution is
    `normal`; then room for the sums of the metrics, which the gradient's vector has there.
    """

    observations: int
    width: int
    layers: int
    """Number of hidden layers."""
    actions: int
    distribution: str
    activation: str
    normalizes: bool = True
    """Whether advantages are normalised over the minibatch."""

    @property
    def outputs(self) -> tuple[int, int]:
        """Return the outputs of the policy network and of the value network."""
        return (self.actions if self.distribution == "normal" else 2 * self.actions), 1

    @property
    def inputs(self) -> tuple[int, ...]:
        """Return the number of inputs of each layer."""
        return (self.observations, *[self.width] * self.layers)

    @property
    def hidden(self) -> int:
        """Return the number of parameters of the hidden layers of one network."""
        return sum(self.width * (inputs + 1) for inputs in self.inputs[:-1])

    @property
    def deviations(self) -> int:
        """Return the number of standard deviations that are parameters."""
        return self.actions if self.distribution == "normal" else 0

    @property
    def slots(self) -> int:
        """Return the number of sums of the policy that single samples add to."""
        return self.outputs[0] + self.deviations + len(POLICY_METRICS)

    @property
    def policy_size(self) -> int:
        """Return the length of the policy's part of the vector."""
        return self.hidden + self.width * self.outputs[0] + self.slots

    @property
    def size(self) -> int:
        """Return the length of the vector."""
        return self.policy_size + self.hidden + self.width + 1 + len(VALUE_METRICS)

    @property
    def ranges(self) -> list[tuple[int, int]]:
        """Return the ranges of the vector that hold parameters; metrics are behind each."""
        policy = self.policy_size
        return [(0, policy - len(POLICY_METRICS)), (policy, self.size - len(VALUE_METRICS))]

    @property
    def drawn(self) -> list[int]:
        """Return how many numbers of each array of `launch.Actions` an environment has."""
        return [math.prod(shape) for shape in self.drawn_shapes(1)]

    def drawn_shapes(self, environments: int) -> list[tuple[int, ...]]:
        """Return the shapes of the arrays of `launch.Actions`."""
        each = environments, self.actions
        return [each, each, (environments,), (environments, 2 * self.actions)]

    @property
    def columns(self) -> dict[str, int]:
        """Return where the parts of a row of the collected data begin, and its `size`."""
        sizes = {
            "observation": self.observations,
            "raw_action": self.actions,
            "log_prob": 1,
            "distribution": 2 * self.actions,
            "reward": 1,
            "discount": 1,
            "truncation": 1,
        }
        begins = starts(sizes)
        return {**dict(zip(sizes, begins, strict=False)), "size": begins[-1]}


class Minibatch(NamedTuple):
    """A `Minibatch` says how many unrolls there are."""

    collected: int
    """Unrolls among which the minibatch's are."""
    unrolls: int
    time: int
    """Steps of an unroll."""
    count: int = 1
    """Number of minibatches of a training step, in all passes."""

    @property
    def samples(self) -> int:
        """Return the number of samples of the minibatch."""
        return self.unrolls * self.time


class LossTerms(NamedTuple):
    """A `LossTerms` holds the coefficients of the loss, under the names of the configuration.

    The kernels read them from an array, because they may differ between policies.
    """

    clipping_epsilon: Any
    entropy_cost: Any
    vf_loss_coefficient: Any
    discounting: Any
    gae_lambda: Any
    reward_scaling: Any


def starts(sizes: dict[str, int]) -> list[int]:
    """Return where parts of the given sizes begin, one after the other, and the end."""
    return list(itertools.accumulate(sizes.values(), initial=0))
