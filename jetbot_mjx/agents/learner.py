"""State what `PPO` needs of a learner: actions for a collection, and an update of the networks.

`PPO` is the same algorithm whoever computes it. A learner says how: XLA from JAX's functions
(`xla_learner`), or kernels of this package (`fused.learner`).

Parameters and Adam's moments have three forms:

    saved     trees, in `PPO.init` and in checkpoints
    packed    between two calls of `PPO.advance`: what `Learner.layout` makes of the trees
    working   during a call: what `Learner.update` takes and returns

For an `XlaLearner` all three are trees, and for a `FusedLearner`, packed and working are vectors.
Packed vectors and working trees occur where an `XlaLearner` stands in for a `FusedLearner`.
"""

from collections.abc import Callable
from typing import NamedTuple, Protocol, runtime_checkable

import jax
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from jetbot_mjx.agents.brax_parts import Normalizer, Transition
from jetbot_mjx.agents.train_state import TrainState
from jetbot_mjx.packed import Packed

UnrollFn = Callable[[Packed, PRNGKeyArray], tuple[Packed, Transition]]
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
    """A `Layout` converts parameters and moments between the saved and the packed form.

    This one leaves them as the trees that they are.
    """

    def pack(self, tree: PyTree) -> PyTree:
        """Return the packed form of a tree of parameters and moments, on host or device."""
        return tree

    def unpack(self, tree: PyTree) -> PyTree:
        """Return the saved form, the inverse of `pack`."""
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

    The order of the calls: `obstacle` and `prepare` before `PPO.advance` is traced; `to_working` at
    its start; `make_unroll` and `update` in each training step; `from_working` at its end. While
    XLA compiles, `failure` checks the kernels. No call changes the learner.
    """

    # What others ask of it without knowing which it is.
    name: str
    """The value of `ppo.update` that asks for this learner."""
    layout: Layout
    """The packed form of parameters and moments."""

    # For the estimate of `training.memory`; the algorithm does not read them.
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

    def prepare(self, replicas: int) -> None:
        """Begin to compile kernels in threads, for a number of trainings that run at once."""

    # Inside the program: once around all steps, and in each step.

    def to_working(self, tree: PyTree) -> PyTree:
        """Return the working form of packed parameters and optimizer state."""
        return tree

    def from_working(self, tree: PyTree) -> PyTree:
        """Return the packed form, the inverse of `to_working`."""
        return tree

    def make_unroll(self, env: PackedEnv, state: TrainState) -> UnrollFn:
        """Return the function that collects unrolls with the policy of a state.

        Args:
          env: the environment.
          state: the packed state, with parameters in the working form.
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
          params: the parameters, in the working form.
          optimizer_state: the state of the optimizer, in the working form.
          normalizer: the statistics that normalise the observations.
          data: the unrolls, of shape (unrolls, time, ...); `next_observation` only of each
            unroll's last step.
          key: the random key of the shuffles and of the samples that estimate the entropy.

        Returns:
          The new parameters, the new state of the optimizer, and the sums of the metrics of
          `LOSSES` over the minibatches whose gradient was finite, followed by their number.
        """
        ...
