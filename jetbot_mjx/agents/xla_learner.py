"""Learn by JAX's functions, which XLA compiles: Brax's networks, loss and order of random keys."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.flatten_util
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PRNGKeyArray, PyTree

from jetbot_mjx.agents.brax_parts import Normalizer, Transition
from jetbot_mjx.agents.learner import TREES, DeviceAxis, Layout, Learner, PackedEnv, UnrollFn
from jetbot_mjx.agents.networks import Networks
from jetbot_mjx.agents.optimizer import adapt_step_size, make_optimizer, read_adam
from jetbot_mjx.agents.train_state import LOSSES, TrainState
from jetbot_mjx.agents.unrolls import action_keys, step_by_step
from jetbot_mjx.config import PPOConfig
from jetbot_mjx.fallbacks import Fallback, report
from jetbot_mjx.packed import Condensed, condense


class XlaLearner(Learner):
    """An `XlaLearner` computes everything by JAX's functions, which XLA compiles for any device."""

    name = "xla"
    keeps_activations = True
    draws_ahead = False

    def __init__(
        self,
        config: PPOConfig,
        networks: Networks,
        devices: DeviceAxis,
        layout: Layout = TREES,
        fallback: Fallback | None = None,
    ) -> None:
        """Build the optimizer.

        Args:
          config: the hyperparameters.
          networks: the policy and value networks, from `make_networks`.
          devices: the devices over which gradients are averaged.
          layout: the form of the states between calls.
          fallback: why this learner stands in for another one, reported with every program that
            contains it; None: it was asked for.
        """
        self.layout = layout
        self._config, self._networks, self._devices = config, networks, devices
        self._fallback = fallback
        self._optimizer = make_optimizer(config)

    def to_working(self, tree: PyTree) -> PyTree:
        """Return the trees of packed parameters and optimizer state."""
        return self.layout.unpack(tree)

    def from_working(self, tree: PyTree) -> PyTree:
        """Return the packed form of trees of parameters and optimizer state."""
        return self.layout.pack(tree)

    def make_unroll(self, env: PackedEnv, state: TrainState) -> UnrollFn:
        """Return the unroll of Brax's policy with Brax's keys of the noise, as in `Learner`."""
        from brax.training.agents.ppo.networks import make_inference_fn

        # Brax takes whatever has the attributes of its `PPONetworks`.
        networks: Any = self._networks
        act: Any = make_inference_fn(networks)(tuple(state.policy_params))
        return step_by_step(env, act, lambda key: action_keys(key, self._config.unroll_length))

    def update(
        self,
        params: PyTree,
        optimizer_state: PyTree,
        normalizer: Normalizer,
        data: Transition,
        key: PRNGKeyArray,
    ) -> tuple[PyTree, PyTree, Float[Array, " totals"]]:
        """Update the networks: passes, minibatches, loss, and a step of Adam, as in `Learner`."""
        # While a program is traced: the cache stores the report with it, and repeats it whenever
        # the program is loaded.
        if self._fallback:
            report(self._fallback)

        # A minibatch: its gradient step, and the sums of the metrics.
        def step(carry: Condensed, batch: tuple[Transition, Array]) -> tuple[Condensed, None]:
            params, optimizer_state, totals = carry.restore()
            params, optimizer_state, metrics = self.minibatch_step(
                params, optimizer_state, normalizer, *batch
            )
            # A metric of an update that was not applied may be NaN.
            totals += jnp.where(metrics[-1] > 0, metrics, 0.0)
            # XLA computes each array that a loop carries by a kernel of its own: carry few.
            return condense((params, optimizer_state, totals)), None

        # A pass: shuffle the unrolls, and split them into minibatches.
        def one_pass(carry: Condensed, drawn: tuple[Array, Array]) -> tuple[Condensed, None]:
            order, loss_keys = drawn

            def minibatches(x: Array) -> Array:
                return x[order].reshape((self._config.num_minibatches, -1, *x.shape[1:]))

            return jax.lax.scan(step, carry, (jax.tree.map(minibatches, data), loss_keys))

        # All passes.
        start = condense((params, optimizer_state, jnp.zeros(len(LOSSES) + 1)))
        end, _ = jax.lax.scan(one_pass, start, self._draw_passes(key, data.reward.shape[0]))
        return end.restore()

    def _draw_passes(self, key: PRNGKeyArray, unrolls: int) -> tuple[Array, Array]:
        """Draw the order of the unrolls in each pass, and the keys of its minibatches, as Brax."""
        passes, count = self._config.num_updates_per_batch, self._config.num_minibatches

        def draw_loss_keys(key: Array) -> Array:
            return jax.lax.scan(lambda key, _: tuple(jax.random.split(key)), key, length=count)[1]

        def draw(key: Array, _: None) -> tuple[Array, tuple[Array, Array]]:
            key, shuffle_key, minibatch_key = jax.random.split(key, 3)
            return key, (shuffle_key, minibatch_key)

        _, (shuffle_keys, minibatch_keys) = jax.lax.scan(draw, key, length=passes)
        # Shuffle for all passes at once: a GPU takes about as long for one.
        orders = jax.vmap(lambda key: jax.random.permutation(key, unrolls))(shuffle_keys)
        return orders, jax.vmap(draw_loss_keys)(minibatch_keys)

    def minibatch_step(
        self,
        params: PyTree,
        optimizer_state: PyTree,
        normalizer: Normalizer,
        batch: Transition,
        key: PRNGKeyArray,
    ) -> tuple[PyTree, PyTree, Float[Array, " metrics"]]:
        """Apply one gradient step, or skip it if the gradient is not finite.

        Returns:
          The new parameters and state of the optimizer; the metrics of `LOSSES`, and whether the
          step was applied.
        """
        metrics, gradient = self.gradient(params, normalizer, batch, key)
        finite = jnp.isfinite(optax.tree.norm(gradient))
        # Adapt the step size to the KL divergence, and compute the update.
        before = params, optimizer_state
        if self._config.learning_rate_schedule == "ADAPTIVE_KL":
            kl = self._devices.mean(metrics["kl_mean"])
            optimizer_state = adapt_step_size(optimizer_state, kl, self._config)
        change, optimizer_state = self._optimizer.update(gradient, optimizer_state, params)
        after = optax.apply_updates(params, change), optimizer_state
        # Keep the old parameters and optimizer state if the gradient is not finite.
        params, optimizer_state = jax.tree.map(
            lambda new, old: jnp.where(finite, new, old), after, before
        )
        metrics = {**metrics, "learning_rate": read_adam(optimizer_state).rate}
        row = jnp.stack([*(metrics[name] for name in LOSSES), finite.astype(jnp.float32)])
        return params, optimizer_state, row

    def gradient(
        self, params: PyTree, normalizer: Normalizer, batch: Transition, key: PRNGKeyArray
    ) -> tuple[Mapping[str, Array], PyTree]:
        """Differentiate the loss of a minibatch.

        Returns:
          The metrics on this device, and the gradient, the mean of all devices.
        """
        differentiate: Any = jax.value_and_grad(self.loss, has_aux=True)
        (_, metrics), gradient = differentiate(params, normalizer, batch, key)
        if self._devices.size == 1:
            return metrics, gradient
        # One vector: CPUs wait for each other in every mean.
        vector, unravel = jax.flatten_util.ravel_pytree(gradient)
        return metrics, unravel(self._devices.mean(vector))

    def loss(
        self, params: PyTree, normalizer: Normalizer, batch: Transition, key: PRNGKeyArray
    ) -> tuple[Array, Mapping[str, Array]]:
        """Compute the loss of a minibatch; images are encoded to features first."""
        # Late: a training whose programs are found compiled needs no loss.
        from jetbot_mjx.agents.loss import ppo_loss

        networks: Any = self._networks
        if isinstance(batch.observation, Mapping):
            batch = _encoded(networks, normalizer, params, batch)
            networks = networks.heads
        return ppo_loss(params, normalizer, batch, key, networks=networks, config=self._config)


def _encoded(
    networks: Networks, normalizer: Normalizer, params: PyTree, batch: Transition
) -> Transition:
    """Replace the observations of a minibatch, of shape (unrolls, time, ...), by their features."""
    # Encode the last next observations along with the others: one product is faster than two.
    joined = jax.tree.map(
        lambda x, last: jnp.concatenate([x, last[:, -1:]], axis=1),
        batch.observation,
        batch.next_observation,
    )
    encoded = networks.encode(normalizer, params, joined)
    return batch._replace(
        observation=jax.tree.map(lambda x: x[:, :-1], encoded),
        next_observation=jax.tree.map(lambda x: x[:, -1:], encoded),
    )
