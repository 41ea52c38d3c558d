"""Describe networks, data and unrolls to the writers of PPO's kernels."""

import itertools
from collections.abc import Mapping
from typing import Generic, NamedTuple, TypeVar

from onekernel import Kernel

Number = TypeVar("Number")

POLICY_METRICS = ("policy_loss", "entropy", "kl", "std")
"""Sums over the samples, behind the policy's parameters: of L_policy, of the entropy H, of the KL
divergence from the policy of the collection, and of the actions' standard deviations."""

VALUE_METRICS = ("squared_error",)
"""Sums over the samples, behind the parameters of the value network: of (V' - V)²."""


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
    def head_start(self) -> int:
        """Return where the head begins, a network's last layer: behind the hidden layers."""
        return sum(self.width * (inputs + 1) for inputs in self.inputs[:-1])

    @property
    def hidden_layers(self) -> list[tuple[int, int, int]]:
        """Return of each hidden layer its number, its inputs, and where its parameters begin."""
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
        """Return the policy's sums over single samples: of head biases, deviations and metrics."""
        return self.outputs[0] + self.deviations + len(POLICY_METRICS)

    @property
    def policy_size(self) -> int:
        """Return the length of the policy's part of the vector."""
        return self.head_start + self.width * self.outputs[0] + self.slots

    @property
    def size(self) -> int:
        """Return the length of the vector."""
        return self.policy_size + self.head_start + self.width + 1 + len(VALUE_METRICS)

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


class DataSizes(NamedTuple):
    """A `DataSizes` holds the sizes of one replica's data on one device.

    A size is 0 where the kernel does not depend on it.
    """

    collected: int = 0
    """Unrolls that a training step collects."""
    unrolls: int = 0
    """Unrolls in a minibatch."""
    time: int = 0
    """Steps of an unroll."""
    minibatches: int = 1
    """Minibatches of a training step, in all passes."""
    environments: int = 0

    @property
    def samples(self) -> int:
        """Return the samples in a minibatch."""
        return self.unrolls * self.time


class UnrollSpec(NamedTuple):
    """An `UnrollSpec` says for which networks and environment an unroll's kernel is written."""

    shape: UpdateShape
    kernel: Kernel
    """The step of an environment, from the numbers of its state and an action to the next state."""
    observation: int
    """Where the observation begins among the numbers of a state."""
    kept: tuple[int, ...]
    """Which numbers of each state are kept."""

    @property
    def state(self) -> int:
        """Return how many numbers a state has."""
        return self.kernel.argument_shapes[0][0]


class LossTerms(NamedTuple, Generic[Number]):
    """A `LossTerms` holds the coefficients of the loss, under the names of the configuration.

    The kernels read them from an array, because replicas may have different ones.
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
