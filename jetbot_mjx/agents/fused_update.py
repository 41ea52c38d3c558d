"""Draw the actions of a step, and compute PPO's update, by kernels of this package.

Motivation: XLA passes the activations of every layer through memory between its kernels. It
launches 140 of them for a minibatch, and takes seconds to compile them. Here one kernel runs the
policy in all environments, and three compute advantages, the gradient of both networks and Adam's
step on GPUs, or one all minibatches on CPUs; docs/update.md explains them.

Protocol: the parameters and Adam's moments are one vector each during an update (`pack`, `unpack`).
On GPUs, products round their operands to float16; everything else is float32.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from brax.training.types import Transition
from jaxtyping import Array, Float, Int, PyTree, UInt32

from jetbot_mjx.agents.networks import NetworkParams
from jetbot_mjx.compiler.packed import Packed, pack
from jetbot_mjx.compiler.update import adam, launch
from jetbot_mjx.compiler.update.adam import AdamRule, AdamTerms, Progress
from jetbot_mjx.compiler.update.cpu_unroll import Unroll
from jetbot_mjx.compiler.update.shapes import (
    POLICY_METRICS,
    VALUE_METRICS,
    LossTerms,
    Minibatch,
    UpdateShape,
)
from jetbot_mjx.config import PPOConfig


class _Place(NamedTuple):
    """A `_Place` is where a parameter lies in the vector."""

    network: str
    path: tuple[str, ...]
    shape: tuple[int, ...]
    start: int

    @property
    def stop(self) -> int:
        return self.start + math.prod(self.shape)


class Collected(NamedTuple):
    """A `Collected` holds the data of a training step as the kernels read it."""

    rows: Float[Array, "unrolls time columns"]
    """A row for each step, with the columns of `UpdateShape.columns`."""
    last: Float[Array, "unrolls obs"]
    """The observations after the last steps."""
    mean: Float[Array, " obs"]
    """What is subtracted from the observations."""
    scale: Float[Array, " obs"]
    """What they are then multiplied by."""


def shape_of(
    config: PPOConfig, observation_size: int | Mapping[str, Any], action_size: int
) -> UpdateShape | str:
    """Return the networks as the kernels know them, or why the kernels cannot compute them.

    Args:
      config: the settings of PPO, of which those of the networks are used.
      observation_size: the length of the observation, or the shapes of its parts.
      action_size: the length of the action.
    """
    network = config.network
    hidden = network.policy_hidden_layer_sizes
    widths = {*hidden, *network.value_hidden_layer_sizes}
    shape = UpdateShape(
        observation_size if isinstance(observation_size, int) else 0,
        max(widths),
        len(hidden),
        action_size,
        network.distribution_type,
        network.activation,
        config.normalize_advantage,
    )
    if not isinstance(observation_size, int):
        return "it takes observations without images"
    if hidden != network.value_hidden_layer_sizes or len(widths) > 1:
        return "it takes two networks of the same hidden layers of one width"
    return shape


def choose(
    config: PPOConfig,
    observation_size: int | Mapping[str, Any],
    action_size: int,
    device_count: int,
    axis_name: str | None,
) -> "FusedUpdate | str":
    """Return the fused update of a configuration, or why this process cannot run it.

    Args:
      config: the hyperparameters.
      observation_size: the length of the observation, or the shapes of its parts.
      action_size: the length of the action.
      device_count: the number of devices that share a minibatch.
      axis_name: the mesh axis over which gradients are averaged; None: none.
    """
    shape = shape_of(config, observation_size, action_size)
    if isinstance(shape, str):
        return shape
    fused = FusedUpdate(config, shape, device_count, axis_name)
    return launch.refusal(shape, fused.batch) or fused


class FusedUpdate:
    """A `FusedUpdate` computes losses and gradients of both networks, as vectors."""

    def __init__(
        self, config: PPOConfig, shape: UpdateShape, device_count: int, axis_name: str | None
    ) -> None:
        """Prepare.

        Args:
          config: the hyperparameters.
          shape: the networks, from `shape_of`.
          device_count: the number of devices that share a minibatch.
          axis_name: the mesh axis over which gradients are averaged; None: none.
        """
        self._config, self._shape = config, shape
        self._axis = axis_name if device_count > 1 else None
        self._at_once = self._axis is None and launch.computes_at_once()
        unrolls, steps = config.batch_size // device_count, config.num_minibatches
        self.batch = Minibatch(
            unrolls * steps, unrolls, config.unroll_length, steps * config.num_updates_per_batch
        )
        """A minibatch on one device."""
        self._environments = config.num_envs // device_count
        schedule = config.learning_rate_schedule
        self._rule = AdamRule(shape, self.batch.samples, schedule, self.batch.count)
        self._places = _places(shape)

    def prepare(self, policies: int) -> None:
        """Begin to compile the kernels for a number of policies that train at once."""
        launch.prepare(self._rule, self.batch, self._environments, policies, at_once=self._at_once)

    def pack(self, tree: PyTree) -> PyTree:
        """Return a tree with a vector in place of every `NetworkParams`, on host or device."""

        def vector(node: Any) -> Any:
            if not isinstance(node, NetworkParams):
                return node
            library: Any = np if isinstance(jax.tree.leaves(node)[0], np.ndarray) else jnp
            parts, end = [], 0
            for place in self._places:
                leaf = getattr(node, place.network)
                for key in place.path:
                    leaf = leaf[key]
                parts += [np.zeros(place.start - end, np.float32), leaf.reshape(-1)]
                end = place.stop
            return library.concatenate([*parts, np.zeros(self._shape.size - end, np.float32)])

        return jax.tree.map(vector, tree, is_leaf=lambda x: isinstance(x, NetworkParams))

    def unpack(self, tree: PyTree) -> PyTree:
        """Return a tree with `NetworkParams` in place of every vector of that length."""
        return jax.tree.map(
            lambda x: self.network_params(x) if x.shape == (self._shape.size,) else x, tree
        )

    def network_params(self, vector: Float[Array, " size"]) -> Any:
        """Return the `NetworkParams` that a vector holds."""
        networks: dict[str, Any] = {"policy": {}, "value": {}}
        for place in self._places:
            inner = networks[place.network]
            for key in place.path[:-1]:
                inner = inner.setdefault(key, {})
            inner[place.path[-1]] = vector[place.start : place.stop].reshape(place.shape)
        return NetworkParams(**networks)

    def collected(self, data: Transition, normalizer: Any) -> Collected:
        """Return the collected data as the kernels read it.

        Args:
          data: the unrolls, of shape (unrolls, time, ...).
          normalizer: the statistics of the observations.
        """
        extras: Any = data.extras
        distribution = extras["policy_extras"]["distribution_params"]
        if self._shape.distribution == "normal":
            distribution = jnp.concatenate(distribution, axis=-1)
        rows = [
            data.observation,
            extras["policy_extras"]["raw_action"],
            extras["policy_extras"]["log_prob"][..., None],
            distribution,
            data.reward[..., None],
            data.discount[..., None],
            extras["state_extras"]["truncation"][..., None],
        ]
        last = data.next_observation[:, -1]
        return Collected(jnp.concatenate(rows, axis=-1), last, *self._statistics(normalizer))

    def _statistics(self, normalizer: Any) -> tuple[Array, Array]:
        """Return what is subtracted from the observations, and what they are multiplied by."""
        if self._config.normalize_observations:
            return normalizer.mean, 1.0 / normalizer.std
        size = self._shape.observations
        return jnp.zeros(size), jnp.ones(size)

    def policy(
        self, params: Float[Array, " size"], normalizer: Any
    ) -> Callable[[Array, Array], tuple[Array, dict[str, Any]]]:
        """Return the policy of a collection.

        Args:
          params: the parameters, from `pack`.
          normalizer: the statistics of the observations.

        Returns:
          A function from the observations of all environments, of shape (environments, obs), and
          standard normal noise, of shape (environments, actions), to the actions and what Brax
          keeps of them.
        """
        statistics = self._statistics(normalizer)

        def act(observations: Array, noise: Array) -> tuple[Array, dict[str, Any]]:
            drawn = launch.actions(self._shape, params, *statistics, observations, noise)
            return drawn.action, self._kept(drawn)

        return act

    def _kept(self, drawn: launch.Actions) -> dict[str, Any]:
        """Return what Brax keeps of actions."""
        kept = drawn._asdict()
        del kept["action"]
        if self._shape.distribution == "normal":
            kept["distribution_params"] = tuple(jnp.split(drawn.distribution_params, 2, -1))
        return kept

    def unroll(
        self,
        env: Any,
        start: Packed,
        params: Float[Array, " size"],
        normalizer: Any,
        keep: Callable[[Any], PyTree],
    ) -> Callable[[Packed, Array], tuple[Packed, PyTree, Array, dict[str, Any]]] | None:
        """Return a function that makes all steps of an unroll, if one kernel can.

        Args:
          env: the environment from `wrap_for_training`.
          start: its states.
          params: the parameters, from `pack`.
          normalizer: the statistics of the observations.
          keep: returns what is kept of the state after each step.

        Returns:
          A function from the states and the noise of all steps to the states after the last step,
          what is kept of all states, the actions, and what Brax keeps of them. All but the first
          have the steps as their first axis.
        """
        if not launch.unrolls_at_once():
            return None
        # A wrapper with a step of its own does not have the method of the one inside.
        stepped = getattr(env.step_packed, "__self__", None)
        find = getattr(type(stepped), "packed_kernel", None)
        kernel = find and find(stepped, start)
        if kernel is None or jax.eval_shape(lambda x: x.unpack().obs, start).dtype != jnp.float32:
            return None
        # Where each number of a state is.
        numbers = np.arange(start.words.shape[-1], dtype=np.float32)
        shapes = tuple((shape, np.dtype(np.float32)) for shape, _ in start.shapes)
        places = start.replace(words=numbers, shapes=shapes).unpack()
        kept = jax.eval_shape(lambda x: pack(keep(x.unpack()), batch_axes=1), start)
        spec = Unroll(
            self._shape,
            kernel,
            observation=int(places.obs[0]),
            kept=tuple(int(x) for leaf in jax.tree.leaves(keep(places)) for x in leaf.reshape(-1)),
        )
        launch.prepare_unroll(spec, self._environments, self.batch.time)

        def unroll(start: Packed, noise: Array) -> tuple[Packed, PyTree, Array, dict[str, Any]]:
            given = *self._statistics(normalizer), start.words, noise
            end, words, drawn = launch.unroll(spec, params, *given)
            steps = kept.replace(words=words).unpack()
            return start.replace(words=end), steps, drawn.action, self._kept(drawn)

        return unroll

    def action_noise(self, key: UInt32[Array, "2"]) -> Float[Array, "time environments actions"]:
        """Draw the noise of all actions of an unroll."""
        return jax.random.normal(key, (self.batch.time, self._environments, self._shape.actions))

    def update(
        self,
        params: Float[Array, " size"],
        optimizer_state: PyTree,
        normalizer: Any,
        data: Transition,
        key: UInt32[Array, "2"],
    ) -> tuple[Float[Array, " size"], PyTree, dict[str, Array]]:
        """Update the networks in several passes over the collected data, in minibatches.

        Args:
          params: the parameters, from `pack`.
          optimizer_state: the state of the optimizer, from `pack`.
          normalizer: the statistics of the observations.
          data: the unrolls, of shape (unrolls, time, ...).
          key: the random key of the shuffles and of the samples that estimate the entropy.

        Returns:
          The new parameters and state; and by Brax's names the sums of the metrics over the
          minibatches whose gradient was finite, with their number as `applied`.
        """
        collected = self.collected(data, normalizer)
        terms = self._adam_terms(optimizer_state)
        # All keys at once, unlike Brax's.
        shuffle_key, noise_key = jax.random.split(key)
        shuffle_keys = jax.random.split(shuffle_key, self._config.num_updates_per_batch)
        orders = jax.vmap(lambda key: jax.random.permutation(key, self.batch.collected))
        unrolls = orders(shuffle_keys).reshape(self.batch.count, -1)
        noise = self.noise(jax.random.split(noise_key, self.batch.count))
        state = self._begin(params, optimizer_state)
        if self._at_once:
            rows, last, mean, scale = collected
            given = mean, scale, rows, last, unrolls, noise, self._loss_terms(), terms
            return self._end(launch.update(self._rule, *given, *state), optimizer_state)

        def step(state: tuple[Array, ...]) -> tuple[Array, ...]:
            index, params, mu, nu, progress = state
            gradient = self.gradient(params, collected, unrolls, noise, index)
            made = launch.adam(self._rule, gradient, params, mu, nu, progress, index, terms)
            return index + 1, *made

        # One counter, unlike that of `scan` beside its own, which would be another launch.
        begun = jnp.zeros((), jnp.int32), *state
        ended = jax.lax.while_loop(lambda state: state[0] < self.batch.count, step, begun)
        return self._end(ended[1:], optimizer_state)

    def noise(
        self, keys: UInt32[Array, "minibatches 2"]
    ) -> Float[Array, "minibatches time unrolls actions"]:
        """Draw the noise that estimates the entropy, from the key of each minibatch."""
        # Brax draws the noise with time as the first axis.
        shape = self.batch.time, self.batch.unrolls, self._shape.actions
        return jax.vmap(lambda key: jax.random.normal(key, shape))(keys)

    def gradient(
        self,
        params: Float[Array, " size"],
        collected: Collected,
        unrolls: Int[Array, "minibatches unrolls"],
        noise: Float[Array, "minibatches time unrolls actions"],
        index: Int[Array, ""],
    ) -> Float[Array, " size"]:
        """Compute the gradient of Brax's PPO loss, the mean of all devices.

        Args:
          params: the parameters, from `pack`.
          collected: all data, from `collected`.
          unrolls: the unrolls of all minibatches.
          noise: their noise, from `noise`.
          index: the minibatch.

        Returns:
          The gradient as a vector, with the sums of the metrics at their places.
        """
        rows, last, mean, scale = collected
        arrays = params, mean, scale, rows, last, unrolls, noise, index, self._loss_terms()
        gradient = launch.gradient(self._shape, *arrays)
        return gradient if self._axis is None else jax.lax.pmean(gradient, self._axis)

    def _loss_terms(self) -> Float[Array, " terms"]:
        return _array(getattr(self._config, name) for name in LossTerms._fields)

    def metrics(self, sums: Float[Array, " metrics"]) -> dict[str, Array]:
        """Return the sums of some minibatches' metrics under Brax's names.

        Args:
          sums: the sums of `adam.METRICS` over all of their samples.
        """
        config = self._config
        mean = dict(zip(adam.METRICS, sums / self._rule.samples, strict=True))
        losses = {
            "policy_loss": mean["policy_loss"],
            "v_loss": mean["value_loss"] * (0.5 * config.vf_loss_coefficient),
            "entropy_loss": mean["entropy"] * -config.entropy_cost,
        }
        return {
            **losses,
            "total_loss": sum(losses.values(), jnp.zeros(())),
            "kl_mean": mean["kl"],
            "policy_dist_mean_std": mean["std"] / self._shape.actions,
        }

    # The state of the optimizer as vectors and an array of `adam.Progress`.

    def _adam_terms(self, optimizer_state: PyTree) -> Float[Array, " terms"]:
        config, (adam_state, *_) = self._config, optimizer_state[-1].inner_state
        share = 1.0 / config.gradient_steps
        return _array(
            AdamTerms(
                max_grad_norm=jnp.inf if config.max_grad_norm is None else config.max_grad_norm,
                learning_rate=config.learning_rate,
                begun=adam_state.count * share,
                share=share,
                desired_kl=config.desired_kl,
                min_rate=config.learning_rate_schedule_min_lr,
                max_rate=config.learning_rate_schedule_max_lr,
            )
        )

    def _begin(self, params: Array, optimizer_state: PyTree) -> tuple[Array, Array, Array, Array]:
        """Return the parameters, Adam's means, and the progress before the first minibatch."""
        adam_state, *_ = optimizer_state[-1].inner_state
        progress = Progress(
            rate=optimizer_state[-1].hyperparams["learning_rate"],
            power_1=adam.BETA_1**adam_state.count,
            power_2=adam.BETA_2**adam_state.count,
            sums=[0.0] * len(adam.METRICS),
            rates=0.0,
            applied=0.0,
        )
        row = _array(jax.tree.leaves(progress))
        rows = jnp.zeros((self._rule.steps, len(row)))
        return params, adam_state.mu, adam_state.nu, jnp.concatenate([row[None], rows])

    def _end(
        self, state: tuple[Array, ...], optimizer_state: PyTree
    ) -> tuple[Array, PyTree, dict[str, Array]]:
        """Return the parameters, the state of the optimizer, and the sums of the metrics."""
        params, mu, nu, progress = state
        rate, _, _, *sums, rates, applied = progress[-1]
        *before, injected = optimizer_state
        adam_state, *rest = injected.inner_state

        def later(count: Array) -> Array:
            return count + applied.astype(count.dtype)

        after = injected._replace(
            count=later(injected.count),
            hyperparams={"learning_rate": rate},
            hyperparams_states=jax.tree.map(later, injected.hyperparams_states),
            inner_state=(
                adam_state._replace(count=later(adam_state.count), mu=mu, nu=nu),
                *rest,
            ),
        )
        metrics = {**self.metrics(jnp.stack(sums)), "learning_rate": rates, "applied": applied}
        return params, (*before, after), metrics


def _array(numbers: Iterable[Any]) -> Float[Array, " numbers"]:
    return jnp.stack([jnp.asarray(x, jnp.float32) for x in numbers])


def _places(shape: UpdateShape) -> list[_Place]:
    """Return where each parameter lies, in the order of the vector."""
    normal, places, start = shape.distribution == "normal", [], 0

    def add(network: str, path: tuple[str, ...], *sizes: int) -> None:
        nonlocal start
        places.append(_Place(network, ("params", *path), sizes, start))
        start = places[-1].stop

    for network, outputs, metrics in zip(
        ("policy", "value"), shape.outputs, (POLICY_METRICS, VALUE_METRICS), strict=True
    ):
        by_mean = normal and network == "policy"
        for layer, inputs in enumerate(shape.inputs):
            path = (*(["MLP_0"] if by_mean else []), f"hidden_{layer}")
            size = shape.width
            if layer == shape.layers:
                path, size = (("Dense_0",) if by_mean else path), outputs
            add(network, (*path, "kernel"), inputs, size)
            add(network, (*path, "bias"), size)
        if by_mean:
            add(network, ("std_param", "value"), shape.actions)
        start += len(metrics)
    return places
