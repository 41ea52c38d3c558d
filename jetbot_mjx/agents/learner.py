"""State what `PPO` needs of a learner: actions for a collection, and an update of the networks.

`PPO` is the same algorithm whoever computes it. A learner says how: XLA from JAX's functions
(`xla_learner`), or kernels of this package (`fused`).
"""

from collections.abc import Callable
from typing import NamedTuple, Protocol, runtime_checkable

import jax
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from jetbot_mjx.agents.brax_parts import Normalizer, Transition
from jetbot_mjx.agents.train_state import TrainState
from jetbot_mjx.packed import Packed

Unroll = Callable[[Packed, PRNGKeyArray], tuple[Packed, Transition]]
"""Steps the environments with actions of the policy: from their states and a random key to the
states after the last step, and the data of all steps, of shape (time, environments, ...)."""


class DeviceAxis(NamedTuple):
    """A `DeviceAxis` says over which devices the environments are sharded."""

    size: int = 1
    """The number of devices."""
    name: str | None = None
    """The axis of the mesh inside `jax.shard_map`; None: there is no mesh."""

    def mean(self, tree: PyTree) -> PyTree:
        """Return the means of some arrays over all devices."""
        return tree if self.name is None else jax.lax.pmean(tree, self.name)

    def sum(self, tree: PyTree) -> PyTree:
        """Return the sums of some arrays over all devices."""
        return tree if self.name is None else jax.lax.psum(tree, self.name)

    def own_key(self, key: PRNGKeyArray) -> PRNGKeyArray:
        """Return another key on each of several devices."""
        if self.size == 1:
            return key
        return jax.random.fold_in(key, jax.lax.axis_index(self.name))


ONE_DEVICE = DeviceAxis()


class Layout:
    """A `Layout` is the form of parameters and moments between two calls of `PPO.advance`.

    This one leaves them as the trees that they are.
    """

    def pack(self, tree: PyTree) -> PyTree:
        """Return a tree of parameters and moments in this form, on host or device."""
        return tree

    def unpack(self, tree: PyTree) -> PyTree:
        """Return the tree, the inverse of `pack`."""
        return tree


TREES = Layout()


@runtime_checkable
class PackedEnv(Protocol):
    """A `PackedEnv` is an environment from `wrap_for_training`, seen by who collects."""

    # A protocol's attribute could be written; this one is only read.
    @property
    def step_packed(self) -> Callable[[Packed, Array], Packed]:
        """Return the step of all environments, a `PackedStep` if a kernel may do it."""
        ...


@runtime_checkable
class Learner(Protocol):
    """A `Learner` computes the actions of a collection and the update of the networks.

    The order of the calls: `obstacle` and `prepare` before `PPO.advance` is traced; `begin` at its
    start; `unroll` and `update` in each training step; `end` at its end. While XLA compiles,
    `failure` checks the kernels. No call changes the learner.
    """

    # What others ask of it without knowing which it is.
    name: str
    """The value of `ppo.update` that asks for this learner."""
    layout: Layout
    """The form of parameters and moments between two calls of `PPO.advance`."""
    keeps_activations: bool
    """Whether a gradient passes the activations of a minibatch through memory."""
    draws_ahead: bool
    """Whether the noise of all minibatches is in memory before the first one."""

    # Before a program is traced, and while it is compiled.

    def obstacle(self) -> str | None:
        """Return why this process cannot launch the update; None: it can."""
        return None

    def failure(self) -> str | None:
        """Return why a check on this machine forbids the update; None: nothing does."""
        return None

    def prepare(self, policies: int) -> None:
        """Begin to compile kernels in threads, for a number of policies that train at once."""

    # Inside the program: once around all steps, and in each step.

    def begin(self, tree: PyTree) -> PyTree:
        """Return parameters and optimizer state as `update` takes them, from `layout.pack`."""
        return tree

    def end(self, tree: PyTree) -> PyTree:
        """Return parameters and optimizer state in the layout, the inverse of `begin`."""
        return tree

    def unroll(self, env: PackedEnv, state: TrainState) -> Unroll:
        """Return the function that collects unrolls with the policy of a state.

        Args:
          env: the environment.
          state: the packed state, with parameters from `begin`.
        """
        ...

    def update(
        self,
        params: PyTree,
        optimizer_state: PyTree,
        normalizer: Normalizer,
        data: Transition,
        key: PRNGKeyArray,
    ) -> tuple[PyTree, PyTree, Float[Array, " totals"]]:
        """Update the networks in several passes over the collected data, in minibatches.

        Args:
          params: the parameters, from `begin`.
          optimizer_state: the state of the optimizer, from `begin`.
          normalizer: the statistics that normalise the observations.
          data: the unrolls, of shape (unrolls, time, ...); of the last steps `next_observation`.
          key: the random key of the shuffles and of the samples that estimate the entropy.

        Returns:
          The new parameters, the new state of the optimizer, and the sums of the metrics of
          `LOSSES` over the minibatches whose gradient was finite, followed by their number.
        """
        ...
