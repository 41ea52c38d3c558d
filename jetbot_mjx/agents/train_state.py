"""Hold what a training passes from step to step, and the names of the metrics that it sums."""

from typing import Any

from flax import struct
from jaxtyping import PyTree

from jetbot_mjx.agents.brax_parts import Normalizer, UInt64
from jetbot_mjx.agents.networks import PolicyParams

# The metrics of a training step, by name.

LOSSES = {
    "total_loss": "loss/total",
    "policy_loss": "loss/policy",
    "v_loss": "loss/value",
    "entropy_loss": "loss/entropy",
    "kl_mean": "policy/kl",
    "policy_dist_mean_std": "policy/std",
    "learning_rate": "policy/learning_rate",
}
"""Our names of a minibatch's metrics, by Brax's names."""

EPISODE_SUMS = {
    "sum_reward": "rollout/return",
    "length": "rollout/length",
    "success": "rollout/successes",
    "nonfinite_envs": "nonfinite_envs",
}
"""Our names of metrics that are summed over finished episodes, by those in `episode_metrics`."""

TALLIED = (
    "training_steps",
    *LOSSES.values(),
    "nonfinite_updates",
    "rollout/episodes",
    *EPISODE_SUMS.values(),
)
"""Names of the metrics in `TrainState.tally`: those of `LOSSES` are sums over the updates that were
applied, `nonfinite_updates` counts the others."""


class TrainState(struct.PyTreeNode):
    """A `TrainState` holds everything that a training needs to continue bit-identically.

    The leaves have the type `Any`, because they are also stacked over seeds, moved to the host, and
    replaced by their shapes.
    """

    # What is learned.
    params: PyTree
    """Weights of the networks, in the fields `policy` and `value`."""
    optimizer_state: PyTree
    """Adam's moments, step count and step size."""
    normalizer: Normalizer
    """Running mean and standard deviation of the observation."""
    # Where the environments and the random numbers are.
    env_state: PyTree
    """Batched state of all environments; in a packed state a `Packed`."""
    key: Any
    """Random key of the next training step."""
    # What is counted.
    env_steps: UInt64
    """Number of environment steps so far, over all devices."""
    tally: Any
    """Sums of the metrics of `TALLIED` over the last `training_steps`, in one vector: XLA computes
    each array that a loop carries by a kernel of its own."""

    @property
    def sums(self) -> dict[str, Any]:
        """Return the sums of the metrics by name."""
        return dict(zip(TALLIED, self.tally, strict=True))

    @property
    def policy_params(self) -> PolicyParams:
        """Return the parameters that inference needs."""
        return PolicyParams(self.normalizer, self.params.policy, self.params.value)


class NanDump(struct.PyTreeNode):
    """A `NanDump` holds what reproduces the first non-finite state of an unroll."""

    found: Any
    """Whether there is a non-finite state; otherwise the other fields have no meaning."""
    env_state: PyTree
    """The state of its environment at the start of the unroll; a `Packed` on devices."""
    actions: Any
    """The actions of the unroll from there, shape (time, action)."""
    step: Any
    """Index of the action that led to the non-finite state."""
