"""Name the arrays that the kernels of PPO take and return, and check their shapes."""

import dataclasses
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jax.core import ShapedArray
from jaxtyping import Array, Float

from jetbot_mjx.agents.fused.adam import SIZES, AdamRule
from jetbot_mjx.agents.fused.shapes import DataSizes, LossTerms, UnrollSpec, UpdateShape

Arrays = Mapping[str, Array]
"""The arguments of a kernel by name, in its order."""

Spec = UpdateShape | AdamRule | UnrollSpec
"""The description for which a kernel is written."""

AXES = {
    # The parameters of both networks, in the order of `UpdateShape`.
    "params": "size",
    # Mean of the observations, and inverse of their standard deviations.
    "mean": "obs",
    "inverse_std": "obs",
    # The observations on which the actions of one step are drawn, and the noise of these.
    "observations": "environments obs",
    "action_noise": "environments action",
    # The states before an unroll, and the noise of all of its actions.
    "start": "environments state",
    "unroll_noise": "time environments action",
    # The collected steps, by `UpdateShape.columns`, and the observations after the last ones.
    "rows": "collected time columns",
    "last": "collected obs",
    # Which of the collected unrolls each minibatch has, and the noise that estimates the entropy.
    "unroll_indices": "minibatches unrolls",
    "noise": "minibatches time unrolls action",
    # The minibatch, which is also the step of Adam.
    "index": "",
    # The coefficients of the loss, an array of `LossTerms`.
    "terms": "terms",
    # The gradient, with the sums of the metrics at their places, and the moments of Adam.
    "gradient": "size",
    "mu": "size",
    "nu": "size",
    # A row of `Progress` before each step of Adam, and one after the last; an array of `AdamTerms`.
    "progress": "steps+1 progress",
    "adam_terms": "adam_terms",
}
"""The axes of each argument for one replica: one of several trainings that run at once, as those of
`--seeds` or of a search. `unroll_indices` and `index` are int32, the others float32; noise is
standard normal."""


class Actions(NamedTuple):
    """An `Actions` holds actions and how likely they were, under Brax's names."""

    action: Float[Array, "environments action"]
    raw_action: Float[Array, "environments action"]
    """The action before its tanh, if the distribution has one."""
    log_prob: Float[Array, " environments"]
    """Logarithm of the probability of the raw action."""
    distribution_params: Float[Array, "environments 2*action"]
    """Parameters of the distribution; of a `normal` one, means and standard deviations."""


@dataclasses.dataclass(frozen=True, eq=False)
class Signature:
    """A `Signature` says which arrays a kernel takes and returns."""

    name: str
    arguments: tuple[str, ...]
    """Names among `AXES`, in the order of the arguments. The first has one axis, so that all axes
    in front of it are replicas."""
    returns: Mapping[str, str]
    """The axes of each result; those with the name of an argument take its place in memory."""

    @property
    def aliases(self) -> dict[int, int]:
        """Return the places of the arguments that the kernel changes, with those of the results."""
        places = {name: i for i, name in enumerate(self.arguments)}
        return {places[name]: i for i, name in enumerate(self.returns) if name in places}

    def replica_axes(self, arrays: Sequence[Array | ShapedArray]) -> tuple[int, ...]:
        """Return the lengths of the axes that `jax.vmap` has put in front of the arguments."""
        return arrays[0].shape[:-1]

    def batch_of(self, spec: Spec, arrays: Sequence[Array | ShapedArray]) -> DataSizes:
        """Return the sizes of the data, and refuse what a kernel would read beyond its end.

        Args:
          spec: the description for which the kernel is written.
          arrays: its arguments, with any axes in front that `replica_axes` returns.

        Raises:
          TypeError: an argument has another dtype or shape.
        """
        lengths, replicas = _lengths(spec), self.replica_axes(arrays)
        for name, x in zip(self.arguments, arrays, strict=True):
            dtype = np.dtype(np.int32 if name in ("unroll_indices", "index") else np.float32)
            axes, shape = AXES[name].split(), x.shape[len(replicas) :]
            # The first array with an axis of the data says how long it is.
            wanted = tuple(lengths.setdefault(*axis) for axis in zip(axes, shape, strict=False))
            if len(axes) != len(shape) or x.shape != (*replicas, *wanted) or x.dtype != dtype:
                said = f"{name} is {x}, not {dtype} of {replicas} and {axes}: {lengths}"
                raise TypeError(f"{self.name}: {said}")
        samples = lengths.get("unrolls", 0) * lengths.get("time", 0)
        if isinstance(spec, AdamRule) and samples not in (0, spec.samples):
            raise TypeError(f"{self.name}: a minibatch of {samples} samples does not fit {spec}")
        return self.relevant(DataSizes(*(lengths.get(x, 0) for x in DataSizes._fields)))

    def relevant(self, batch: DataSizes) -> DataSizes:
        """Return the sizes that the kernel depends on, and zeros for the others."""
        axes = {axis for name in self.arguments for axis in AXES[name].split()}
        return DataSizes(**{x: n if x in axes else 0 for x, n in batch._asdict().items()})

    def shapes(self, spec: Spec, batch: DataSizes) -> dict[str, tuple[int, ...]]:
        """Return the shapes of all arguments and results for one replica, by name."""
        lengths = batch._asdict() | _lengths(spec)
        axes = {name: AXES[name] for name in self.arguments} | dict(self.returns)
        return {name: tuple(lengths[x] for x in axes[name].split()) for name in axes}

    def counts(self, spec: Spec, batch: DataSizes) -> dict[str, int]:
        """Return the numbers of one replica in each argument and result, by name."""
        return {name: math.prod(shape) for name, shape in self.shapes(spec, batch).items()}


def _lengths(spec: Spec) -> dict[str, int]:
    """Return how long the axes are that do not depend on the data."""
    shape = spec if isinstance(spec, UpdateShape) else spec.shape
    lengths = {"size": shape.size, "obs": shape.observations, "columns": shape.columns["size"]}
    lengths |= {"action": shape.actions, "2*action": 2 * shape.actions}
    lengths |= {"terms": len(LossTerms._fields), **SIZES}
    if isinstance(spec, AdamRule):
        lengths |= {"minibatches": spec.steps, "steps+1": spec.steps + 1}
    if isinstance(spec, UnrollSpec):
        lengths |= {"state": spec.state, "kept": len(spec.kept)}
        # The kernel writes the next state in the place of the one before.
        if [x.shape for x in spec.kernel.results()] != [(spec.state,)]:
            raise TypeError(f"unroll: a step does not return {spec.state} numbers")
    return lengths


# The kernels.

_NETWORK = ("params", "mean", "inverse_std")
_DATA = ("rows", "last", "unroll_indices", "noise")
_ACTIONS = dict.fromkeys(Actions._fields, "environments action")
_ACTIONS |= {"log_prob": "environments", "distribution_params": "environments 2*action"}
_STEPS = {name: f"time {axes}" for name, axes in _ACTIONS.items()}
_UPDATED = {name: AXES[name] for name in ("params", "mu", "nu", "progress")}

ACTIONS = Signature("actions", (*_NETWORK, "observations", "action_noise"), _ACTIONS)
UNROLL = Signature(
    "unroll",
    (*_NETWORK, "start", "unroll_noise"),
    {"end": "environments state", "kept": "time environments kept", **_STEPS},
)
GRADIENT = Signature("gradient", (*_NETWORK, *_DATA, "index", "terms"), {"gradient": "size"})
ADAM = Signature("adam", ("gradient", *_UPDATED, "index", "adam_terms"), _UPDATED)
# The index of the minibatch is no argument: all minibatches are computed by one call.
UPDATE = Signature("update", (*_NETWORK[1:], *_DATA, "terms", "adam_terms", *_UPDATED), _UPDATED)
