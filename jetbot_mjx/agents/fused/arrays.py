"""Name the arrays that the kernels of PPO take and return, and check their shapes."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jax.core import ShapedArray
from jaxtyping import Array, Float

from jetbot_mjx.agents.fused import adam
from jetbot_mjx.agents.fused.adam import SIZES, UPDATED, AdamRule
from jetbot_mjx.agents.fused.cpu_actions import PARAMETERS
from jetbot_mjx.agents.fused.cpu_gradient import GRADIENT_ARGUMENTS
from jetbot_mjx.agents.fused.cpu_unroll import Unroll
from jetbot_mjx.agents.fused.cpu_update import ARGUMENTS as UPDATE_ARGUMENTS
from jetbot_mjx.agents.fused.shapes import LossTerms, Minibatch, UpdateShape

Arrays = Mapping[str, Array]
"""The arguments of a kernel by name, in its order."""

Spec = UpdateShape | AdamRule | Unroll
"""The description for which a kernel is written."""

AXES = {
    # The parameters of both networks, in the order of `UpdateShape`.
    "params": "size",
    # Mean of the observations, and inverse of their standard deviations.
    "mean": "obs",
    "scale": "obs",
    # The observations on which the actions of one step are drawn, and the noise of these.
    "observations": "environments obs",
    "action_noise": "environments action",
    # The states before an unroll, and the noise of all of its actions.
    "start": "environments state",
    "unroll_noise": "time environments action",
    # The collected steps, by `UpdateShape.columns`, and the observations after the last ones.
    "rows": "collected time columns",
    "last": "collected obs",
    # The unrolls of all minibatches, as indices of the collected ones, and the noise that
    # estimates the entropy.
    "unrolls": "minibatches unrolls",
    "noise": "minibatches time unrolls action",
    # The minibatch, which is also the step of Adam.
    "index": "",
    # The coefficients of the loss, an array of `LossTerms`.
    "terms": "terms",
    # The gradient, with the sums of the metrics at their places; its mean, and that of its squares.
    "gradient": "size",
    "mu": "size",
    "nu": "size",
    # A row of `Progress` before each step of Adam, and one after the last; an array of `AdamTerms`.
    "progress": "steps+1 progress",
    "adam_terms": "adam_terms",
}
"""The axes of each argument for one policy. `unrolls` and `index` are int32, the others float32;
noise is standard normal."""


class Actions(NamedTuple):
    """An `Actions` holds actions and how likely they were, under Brax's names."""

    action: Float[Array, "environments action"]
    raw_action: Float[Array, "environments action"]
    """The action before its tanh, if the distribution has one."""
    log_prob: Float[Array, " environments"]
    """Logarithm of the probability of the raw action."""
    distribution_params: Float[Array, "environments 2*action"]
    """Parameters of the distribution; of a `normal` one, means and standard deviations."""


class Signature(NamedTuple):
    """A `Signature` says which arrays a kernel takes and returns."""

    name: str
    arguments: tuple[str, ...]
    """Names among `AXES`, in the order of the arguments."""
    returns: tuple[str, ...]
    """The axes of each result."""
    updated: tuple[str, ...] = ()
    """Names of the arguments that it changes in place, and returns."""

    def results(self, spec: Spec, arrays: Sequence[Array | ShapedArray]) -> list[tuple[int, ...]]:
        """Return the shapes of the results, and refuse what a kernel would read beyond its end.

        Args:
          spec: the description for which the kernel is written.
          arrays: its arguments, with any axes of policies in front.

        Raises:
          TypeError: an argument has another dtype or shape.
        """
        sizes, batch = _sizes(spec), arrays[0].shape[:-1]
        for name, x in zip(self.arguments, arrays, strict=True):
            dtype = np.dtype(np.int32 if name in ("unrolls", "index") else np.float32)
            axes, shape = AXES[name].split(), x.shape[len(batch) :]
            # The first array with an axis of the data says how long it is.
            wanted = tuple(sizes.setdefault(*axis) for axis in zip(axes, shape, strict=False))
            if len(axes) != len(shape) or x.shape != (*batch, *wanted) or x.dtype != dtype:
                said = f"{name} is {x}, not {dtype} of {batch} and {axes}: {sizes}"
                raise TypeError(f"{self.name}: {said}")
        samples = sizes.get("unrolls", 0) * sizes.get("time", 0)
        if isinstance(spec, AdamRule) and samples not in (0, spec.samples):
            raise TypeError(f"{self.name}: a minibatch of {samples} samples does not fit {spec}")
        return [(*batch, *(sizes[axis] for axis in axes.split())) for axes in self.returns]


def minibatch_of(arrays: Arrays) -> Minibatch:
    """Return the minibatch of a kernel's arguments, which have one axis of policies in front."""
    _, collected, time, _ = arrays["rows"].shape
    _, count, unrolls = arrays["unrolls"].shape
    return Minibatch(collected, unrolls, time, count)


def _sizes(spec: Spec) -> dict[str, int]:
    """Return how long the axes are that do not depend on the data."""
    shape = spec if isinstance(spec, UpdateShape) else spec.shape
    sizes = {"size": shape.size, "obs": shape.observations, "columns": shape.columns["size"]}
    sizes |= {"action": shape.actions, "2*action": 2 * shape.actions}
    sizes |= {"terms": len(LossTerms._fields), **SIZES}
    if isinstance(spec, AdamRule):
        sizes |= {"minibatches": spec.steps, "steps+1": spec.steps + 1}
    if isinstance(spec, Unroll):
        sizes |= {"state": spec.state, "kept": len(spec.kept)}
        # The kernel writes the next state in the place of the one before.
        if [x.shape for x in spec.kernel.results()] != [(spec.state,)]:
            raise TypeError(f"unroll: a step does not return {spec.state} numbers")
    return sizes


_EACH = "environments action", "environments action", "environments", "environments 2*action"
_LEARNED = tuple(AXES[name] for name in UPDATED)

ACTIONS = Signature("actions", (*PARAMETERS, "observations", "action_noise"), _EACH)
UNROLL = Signature(
    "unroll",
    (*PARAMETERS, "start", "unroll_noise"),
    ("environments state", "time environments kept", *(f"time {x}" for x in _EACH)),
)
GRADIENT = Signature("gradient", GRADIENT_ARGUMENTS, ("size",))
ADAM = Signature("adam", adam.ARRAYS, _LEARNED, UPDATED)
UPDATE = Signature("update", UPDATE_ARGUMENTS, _LEARNED, UPDATED)
