"""Describe networks, data and unrolls to the writers of PPO's kernels."""

import itertools
from collections.abc import Mapping
from typing import Generic, NamedTuple, TypeVar

from onekernel import Kernel

Number = TypeVar("Number")

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
    def hidden_layers(self) -> list[tuple[int, int, int]]:
        """Return number, inputs and first parameter of each hidden layer of a network."""
        # Weights, of shape (inputs, width), and biases of a layer precede those of the next one.
        sizes = (self.width * (inputs + 1) for inputs in self.inputs[:-1])
        starts = itertools.accumulate(sizes, initial=0)
        return list(zip(range(self.layers), self.inputs, starts, strict=False))

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
        # The policy's weights, biases and deviations, its metrics; the values', and theirs.
        policy = self.policy_size
        return [(0, policy - len(POLICY_METRICS)), (policy, self.size - len(VALUE_METRICS))]

    @property
    def columns(self) -> dict[str, int]:
        """Return where the parts of a row of the collected data begin, and its `size`."""
        # What the policy saw and did, and what came of it.
        sizes = {"observation": self.observations, "raw_action": self.actions}
        sizes |= {"log_prob": 1, "distribution": 2 * self.actions}
        return places(sizes | dict.fromkeys(("reward", "discount", "truncation"), 1))


class Minibatch(NamedTuple):
    """A `Minibatch` says how much data of one policy there is, on one device."""

    collected: int = 0
    """Unrolls among which the minibatch's are."""
    unrolls: int = 0
    time: int = 0
    """Steps of an unroll."""
    minibatches: int = 1
    """Number of minibatches of a training step, in all passes."""
    environments: int = 0

    @property
    def samples(self) -> int:
        """Return the number of samples of the minibatch."""
        return self.unrolls * self.time


class Unroll(NamedTuple):
    """An `Unroll` describes a step of an unroll."""

    shape: UpdateShape
    kernel: Kernel
    """The step of an environment, from the numbers of its state and an action to the next state."""
    observation: int
    """Where the observation begins among the numbers of a state."""
    kept: tuple[int, ...]
    """Places of the numbers that are kept of each state."""

    @property
    def state(self) -> int:
        """Return how many numbers a state has."""
        return self.kernel.argument_shapes[0][0]


class LossTerms(NamedTuple, Generic[Number]):
    """A `LossTerms` holds the coefficients of the loss, under the names of the configuration.

    The kernels read them from an array, because they may differ between policies.
    """

    clipping_epsilon: Number
    entropy_cost: Number
    vf_loss_coefficient: Number
    discounting: Number
    gae_lambda: Number
    reward_scaling: Number


def places(sizes: Mapping[str, int], multiple: int = 1) -> dict[str, int]:
    """Return where parts begin that lie one behind the other, and their `size` together.

    Args:
      sizes: the size of each part.
      multiple: what each size is rounded up to a multiple of.
    """
    # A part begins where the ones before it end.
    padded = (-(-size // multiple) * multiple for size in sizes.values())
    return dict(zip((*sizes, "size"), itertools.accumulate(padded, initial=0), strict=True))
