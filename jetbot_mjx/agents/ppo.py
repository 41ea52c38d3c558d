"""Train with proximal policy optimisation (PPO) as one pure step, built from Brax's parts.

Motivation: `brax.training.agents.ppo.train` keeps its training state in local variables. Here that
state is one value, `TrainState`, that can be saved and restored, and non-finite environment states
and gradients are stopped and counted.

Equation: each minibatch minimises Brax's loss, the sum of the clipped surrogate objective, the
value loss and the entropy bonus:

    L = L_policy + L_value + L_entropy
    L_policy  = -mean(min(ρ A, clip(ρ, 1 - ε, 1 + ε) A)),  ρ = π(a|s) / π_old(a|s)
    L_value   = ½ c_v mean((V_target - V)²)
    L_entropy = -c_e mean(H)

A and V_target come from `gae`, H is the entropy of the policy, ε = `clipping_epsilon`,
c_v = `vf_loss_coefficient` and c_e = `entropy_cost`. With `normalize_advantage`, A is normalised
over the minibatch.

Protocol of a training step:

1. `collect` runs the current policy for `unroll_length` steps in every environment, until there are
   `batch_size * num_minibatches` unrolls.
2. The normaliser takes in all collected observations.
3. `update` makes `num_updates_per_batch` passes over the unrolls. Each pass shuffles them, splits
   them into `num_minibatches` and applies one step of Adam to each minibatch.

Networks, action distribution, loss, running statistics, steps, gradients and the ADAPTIVE_KL rule
are Brax's. On one device and with `normalizer: brax` and `update: xla`, the order of the random
keys is Brax's too, and every step equals a step of `brax.training.agents.ppo.train`. The deviations
from Brax are:

- An update with a non-finite gradient is skipped and counted.
- The first non-finite environment state is returned as a `NanDump`.
- `normalizer: physical` bounds the standard deviation from below by the observation's scale.
- `learning_rate_schedule: LINEAR` lowers the step size to zero over the training.
- `update: fused` computes the same loss with kernels of this package, on GPUs with products of
  float16, and draws shuffles and noise with other keys, many at once.
- GAE is unrolled, and of the next observations only those that the loss needs are stored.

The step is written for one shard of the environments. Under `jax.shard_map` over `axis_name`
each device steps and shuffles its own environments; only gradients, the normaliser's sums and
the metrics are exchanged between devices.

Source: J. Schulman et al., Proximal Policy Optimization Algorithms, arXiv:1707.06347;
google/brax v0.14.2, brax/training/agents/ppo.
"""

from collections.abc import Mapping
from typing import Any

import jax
import jax.flatten_util
import jax.numpy as jnp
import optax
from brax.envs import Env
from brax.training.acme import running_statistics
from brax.training.agents.ppo import optimizer
from brax.training.types import Transition, UInt64
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PyTree, UInt32

from jetbot_mjx.agents import fused_update, update_probe
from jetbot_mjx.agents.networks import (
    NetworkParams,
    Networks,
    PolicyParams,
    init_normalizer,
    update_normalizer,
)
from jetbot_mjx.compiler.packed import Condensed, Packed, condense, pack
from jetbot_mjx.compiler.update import launch
from jetbot_mjx.config import PPOConfig
from jetbot_mjx.errors import UserError
from jetbot_mjx.fallbacks import Fallback, report

# Pyright does not follow flax's dataclasses.
_UInt64: Any = UInt64

_EXTRA_FIELDS = ("truncation", "episode_metrics", "episode_done")
"""Fields of the state's `info` that are collected."""

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

_EPISODE_SUMS = {
    "sum_reward": "rollout/return",
    "length": "rollout/length",
    "success": "rollout/successes",
    "nonfinite_envs": "nonfinite_envs",
}
"""Our names of metrics that are summed over finished episodes, by those in `episode_metrics`."""


class TrainState(struct.PyTreeNode):
    """A `TrainState` holds everything that a training needs to continue bit-identically.

    The leaves have the type `Any`, because they are also stacked over seeds, moved to the host, and
    replaced by their shapes.
    """

    params: Any
    """Weights of the networks, in the fields `policy` and `value`."""
    optimizer_state: PyTree
    """Adam's moments, step count and step size."""
    normalizer: running_statistics.RunningStatisticsState
    """Running mean and standard deviation of the observation."""
    env_state: Any
    """Batched state of all environments; in a packed state a `Packed`."""
    key: Any
    """Random key of the next training step."""
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
    """A `NanDump` holds the first non-finite state of an unroll and the actions that led to it."""

    found: Any
    """Whether there is a non-finite state; otherwise the other fields have no meaning."""
    env_state: Any
    """The state of one environment at the start of the unroll; a `Packed` on devices."""
    actions: Any
    """The actions of the unroll, shape (time, action)."""
    step: Any
    """Index of the action that led to the non-finite state."""


class PPO:
    """A `PPO` object trains one configuration in one environment; it holds no training state."""

    def __init__(
        self,
        config: PPOConfig,
        env: Env,
        networks: Networks,
        *,
        axis_name: str | None = None,
        device_count: int = 1,
    ) -> None:
        """Build the optimizer and the loss.

        Args:
          config: the hyperparameters.
          env: the environment from `wrap_for_training`, which is batched, resets itself and reports
            `episode_metrics`.
          networks: the policy and value networks, from `make_networks`.
          axis_name: the mesh axis over which the environments are sharded; None: no sharding.
          device_count: the size of that axis.
        """
        self.config = config
        self._env: Any = env
        self._axis = axis_name
        self._device_count = device_count
        self.networks = networks
        self._min_std = (
            self._env.observation_min_std
            if config.normalize_observations and config.normalizer == "physical"
            else None
        )
        self._optimizer: Any = make_optimizer(config)
        loss: Any = self._loss
        value_and_gradient = jax.value_and_grad(loss, has_aux=True)

        def mean_gradient(*arguments: Any) -> Any:
            value, gradient = value_and_gradient(*arguments)
            if axis_name is None:
                return value, gradient
            if device_count == 1:
                return value, jax.lax.pmean(gradient, axis_name)
            # One vector: CPUs wait for each other in every mean.
            vector, unravel = jax.flatten_util.ravel_pytree(gradient)
            return value, unravel(jax.lax.pmean(vector, axis_name))

        self._loss_and_gradient = mean_gradient
        self._fallback: Fallback | None = None
        """Why the kernels of the update do not run, although they may."""
        self._fused: fused_update.FusedUpdate | None = None
        # The layout of states between calls stays, even if XLA takes over the update.
        self._layout: fused_update.FusedUpdate | None = None
        if config.update != "xla":
            sizes = self._env.observation_size, self._env.action_size
            found = fused_update.choose(config, *sizes, device_count, axis_name)
            if isinstance(found, fused_update.FusedUpdate):
                self._fused = found
                self._layout = found
            else:
                self._refuse_fused(found)

    def _refuse_fused(self, reason: str) -> None:
        """Let XLA compile the update.

        Args:
          reason: why the kernels cannot run.

        Raises:
          UserError: `ppo.update` requests the kernels.
        """
        self._fused = None
        if self.config.update == "fused":
            raise UserError(f"ppo.update = fused: {reason}: choose auto or xla")
        self._fallback = Fallback("ppo.update", reason)
        report(self._fallback)

    @property
    def is_fused(self) -> bool:
        """Return whether kernels of this package compute the update."""
        return self._fused is not None

    def prepare(self, policies: int) -> None:
        """Begin to compile the kernels of the update, before `advance` is traced.

        Args:
          policies: the number of policies that are trained at once.

        Raises:
          UserError: `ppo.update` requests the kernels, and XLA cannot launch them.
        """
        # Try the back end first: LLVM does one thing at a time, and physics waits for this.
        self.try_backend()
        if self._fused is not None:
            self._fused.prepare(policies)

    def try_backend(self) -> None:
        """Let XLA compile the update if the back end of its kernels is not available.

        Raises:
          UserError: `ppo.update` requests the kernels.
        """
        if self._fused is not None and (obstacle := launch.backend().obstacle()):
            self._refuse_fused(obstacle)

    def check(self) -> bool:
        """Return whether `advance`, as it was traced, computes correctly on this machine.

        If not, XLA compiles the update when `advance` is traced again.

        Raises:
          UserError: `ppo.update` requests the kernels.
        """
        # A CPU's kernels are compiled by what compiled the probe of its back end.
        on_gpu = jax.default_backend() == "gpu"
        if self._fused is None or not on_gpu or update_probe.runs_correctly():
            return True
        self._refuse_fused("its kernels failed their check on this machine")
        return False

    def init(self, key: UInt32[Array, "2"]) -> TrainState:
        """Return the training state before the first step.

        Args:
          key: the key of the training, `jax.random.PRNGKey(seed)`.

        Returns:
          The state with all environments, so this must be called outside `jax.shard_map`.
        """
        # Split the keys in the order of Brax's train(), up to the first epoch.
        global_key, local_key = jax.random.split(key)
        local_key = jax.random.fold_in(local_key, 0)
        local_key, env_key, _ = jax.random.split(local_key, 3)
        policy_key, value_key = jax.random.split(global_key)
        epoch_key, _ = jax.random.split(local_key)
        # Initialise networks, optimizer, normaliser and environments.
        params = NetworkParams(
            policy=self.networks.policy_network.init(policy_key),
            value=self.networks.value_network.init(value_key),
        )
        state = TrainState(
            params=params,
            optimizer_state=self._optimizer.init(params),
            normalizer=self._with_floor(init_normalizer(self._env.observation_size)),
            env_state=self._env.reset(jax.random.split(env_key, self.config.num_envs)),
            key=jax.random.split(epoch_key, 1)[0],
            env_steps=_UInt64(hi=0, lo=0),
            tally=jnp.zeros(len(TALLIED)),
        )
        # Remove weak types, which Python numbers have and for which the step would compile again.
        return jax.tree.map(lambda x: jnp.asarray(x).astype(jnp.asarray(x).dtype), state)

    def advance(
        self, state: TrainState, num_steps: Int[Array, ""], restart: Bool[Array, ""]
    ) -> tuple[TrainState, NanDump]:
        """Run several training steps; one program serves any number of them.

        Args:
          state: the training state of this shard, from `packed`.
          num_steps: the number of training steps.
          restart: whether to reset the tally before the first step.

        Returns:
          The packed state after the last step, and the shard's first `NanDump` of these steps.
        """
        tally = jnp.where(restart, 0.0, state.tally)
        if not self._fused:
            state = self._with_trees(state)

        def body(_: Array, carry: tuple[TrainState, NanDump]) -> tuple[TrainState, NanDump]:
            before, nan_dump = carry
            state, metrics, found = self.train_step(before)
            nan_dump = jax.tree.map(
                lambda one, other: jnp.where(nan_dump.found, one, other), nan_dump, found
            )
            return state.replace(tally=before.tally + metrics), nan_dump

        none = NanDump(
            found=jnp.zeros((), bool),
            env_state=jax.tree.map(lambda x: jnp.zeros(x.shape[1:], x.dtype), state.env_state),
            actions=jnp.zeros((self.config.unroll_length, self._env.action_size)),
            step=jnp.zeros((), jnp.int32),
        )
        state, nan_dump = jax.lax.fori_loop(0, num_steps, body, (state.replace(tally=tally), none))
        return (state if self._fused else self._with_vectors(state)), nan_dump

    def packed(self, state: TrainState) -> TrainState:
        """Return a state with few arrays, as `advance` takes it.

        Args:
          state: the state, from `init` or on the host.
        """
        return self._with_vectors(state.replace(env_state=pack(state.env_state, batch_axes=1)))

    def unpacked(self, state: TrainState) -> TrainState:
        """Return a state with all arrays, the inverse of `packed`."""
        return self._with_trees(state.replace(env_state=state.env_state.unpack()))

    def _with_vectors(self, state: TrainState) -> TrainState:
        """Replace parameters and moments by vectors if the update may be fused."""
        if self._layout is None:
            return state
        params, optimizer_state = self._layout.pack((state.params, state.optimizer_state))
        return state.replace(params=params, optimizer_state=optimizer_state)

    def _with_trees(self, state: TrainState) -> TrainState:
        """Replace the vectors of `_with_vectors` by trees."""
        if self._layout is None:
            return state
        params, optimizer_state = self._layout.unpack((state.params, state.optimizer_state))
        return state.replace(params=params, optimizer_state=optimizer_state)

    def train_step(self, state: TrainState) -> tuple[TrainState, Float[Array, " metrics"], NanDump]:
        """Collect experience with the current policy, and update the policy with it.

        Args:
          state: the packed state of this shard; parameters and moments are trees unless the update
            is fused.

        Returns:
          The next state; the metrics of `TALLIED`, which are means over the minibatches and sums
          over the episodes that ended during collection; and the first non-finite state.
        """
        # Each device draws its own keys, and all devices continue from the same one.
        update_key, rollout_key, next_key = jax.random.split(state.key, 3)
        if self._device_count > 1:
            index = jax.lax.axis_index(self._axis)
            update_key = jax.random.fold_in(update_key, index)
            rollout_key = jax.random.fold_in(rollout_key, index)
        # Collect experience, and update the normaliser with all of its observations.
        env_state, data, nan_dump = self.collect(state, rollout_key)
        updated_normalizer = self._with_floor(
            update_normalizer(state.normalizer, data.observation, self._axis)
        )
        # Update the networks. As in Brax, ADAPTIVE_KL uses the old normaliser, because it compares
        # the new action distributions with those of the collection.
        adaptive = self.config.learning_rate_schedule == "ADAPTIVE_KL"
        normalizer = state.normalizer if adaptive else updated_normalizer
        params, optimizer_state, metrics = self.update(
            state.params, state.optimizer_state, normalizer, data, update_key
        )
        state = state.replace(
            params=params,
            optimizer_state=optimizer_state,
            normalizer=updated_normalizer,
            env_state=env_state,
            key=next_key,
            env_steps=state.env_steps + self.config.steps_per_training_step,
        )
        return state, jnp.concatenate([jnp.ones(1), metrics, self._episode_sums(data)]), nan_dump

    def _with_floor(
        self, normalizer: running_statistics.RunningStatisticsState
    ) -> running_statistics.RunningStatisticsState:
        """Bound each standard deviation from below by the observation's physical scale.

        The height and tilt of a robot on a flat floor vary by micrometres. Normalised by such a
        deviation, the slightly different contact of another simulator would be far outside of the
        training's range. The sums from which the next update computes `std` do not change.
        """
        if self._min_std is None:
            return normalizer
        raised: Any = normalizer
        return raised.replace(std=jax.tree.map(jnp.maximum, raised.std, self._min_std))

    def collect(
        self, state: TrainState, key: UInt32[Array, "2"]
    ) -> tuple[Packed, Transition, NanDump]:
        """Collect unrolls until there are enough for all minibatches.

        Args:
          state: the state of this shard, as for `train_step`.
          key: the random key of the actions' noise.

        Returns:
          The environment states after the last unroll; the unrolls, of shape (unrolls, time, ...),
          with `next_observation` of their last step only; and the first non-finite state.
        """
        fused, length = self._fused, self.config.unroll_length
        at_once: Any = None
        if fused:
            policy: Any = fused.policy(state.params, state.normalizer)
            given = state.env_state, state.params, state.normalizer, _kept
            at_once = fused.unroll(self._env, *given)
        else:
            from brax.training.agents.ppo.networks import make_inference_fn

            # Brax takes whatever has the attributes of its `PPONetworks`.
            any_networks: Any = self.networks
            policy = make_inference_fn(any_networks)(tuple(state.policy_params))

        def transition(obs: Any, action: Array, extras: Any, kept: dict[str, Any]) -> Transition:
            # The loss needs the next observation only at the end of an unroll, where it is in the
            # state: the others, possibly images, are not even stored.
            nothing: Any = None
            all_extras: Any = {"policy_extras": extras, "state_extras": kept["info"]}
            return Transition(
                observation=obs,
                action=action,
                reward=kept["reward"],
                discount=1 - kept["done"],
                next_observation=nothing,
                extras=all_extras,
            )

        def step(start: Packed, drawn: Array) -> tuple[Packed, Packed]:
            obs = start.unpack().obs
            action, extras = policy(obs, drawn)
            after = self._env.step_packed(start, action)
            data = transition(obs, action, extras, _kept(after.unpack()))
            return after, pack(data, batch_axes=1)

        def steps(start: Packed, drawn: Array) -> tuple[Packed, Transition]:
            if at_once is None:
                after, packed = jax.lax.scan(step, start, drawn)
                return after, packed.unpack()
            after, kept, action, extras = at_once(start, drawn)
            obs = jnp.concatenate([start.unpack().obs[None], kept["obs"][:-1]])
            return after, transition(obs, action, extras, kept)

        def unroll(carry: Any, _: None) -> Any:
            start, key = carry
            key, next_key = jax.random.split(key)
            drawn = fused.action_noise(key) if fused else _action_keys(key, length)
            after, data = steps(start, drawn)
            nan_dump = _find_nan_dump(start, data)
            ends = jax.tree.map(lambda x: x[None], after.unpack().obs)
            return (after, next_key), (data._replace(next_observation=ends), nan_dump)

        # Run the unrolls one after the other, and return the first non-finite state of all.
        count = self.config.batch_size * self.config.num_minibatches // self.config.num_envs
        (env_state, _), (data, nan_dumps) = jax.lax.scan(
            unroll, (state.env_state, key), length=count
        )
        nan_dump = jax.tree.map(lambda x: x[jnp.argmax(nan_dumps.found)], nan_dumps)
        # Reshape from (unrolls, time, environments) to (unrolls x environments, time).
        data = jax.tree.map(lambda x: jnp.swapaxes(x, 1, 2), data)
        data = jax.tree.map(lambda x: x.reshape((-1, *x.shape[2:])), data)
        return env_state, data, nan_dump

    def update(
        self,
        params: PyTree,
        optimizer_state: PyTree,
        normalizer: running_statistics.RunningStatisticsState,
        data: Transition,
        key: UInt32[Array, "2"],
    ) -> tuple[PyTree, PyTree, Float[Array, " metrics"]]:
        """Update the networks in several passes over the collected data, in minibatches.

        Each minibatch applies one step of Adam along the gradient of the loss L that the module
        states, clipped to the global norm `max_grad_norm`.

        Args:
          params: the parameters of the networks; a vector if the update is fused.
          optimizer_state: the state of the optimizer from `make_optimizer`, with vectors likewise.
          normalizer: the statistics that normalise the observations.
          data: the unrolls, shape (unrolls, time, ...); `next_observation` may hold only the last.
          key: the random key of the shuffles and of the samples that estimate the entropy.

        Returns:
          The new parameters, the new optimizer state, and the mean metrics of `LOSSES` over the
          minibatches whose gradient was finite, followed by the number of the others.
        """
        # Drop the episode statistics, which need not be shuffled.
        extras = {
            "policy_extras": data.extras["policy_extras"],
            "state_extras": {"truncation": data.extras["state_extras"]["truncation"]},
        }
        data = data._replace(extras=extras)
        if self._fused:
            update = self._fused.update
            params, optimizer_state, means = update(params, optimizer_state, normalizer, data, key)
            totals = jnp.stack([*(means[name] for name in LOSSES), means["applied"]])
        else:
            update = self._update_by_xla
            params, optimizer_state, totals = update(params, optimizer_state, normalizer, data, key)
        return params, optimizer_state, self._mean_metrics(totals)

    def _update_by_xla(
        self, params: PyTree, optimizer_state: PyTree, normalizer: Any, data: Transition, key: Array
    ) -> tuple[PyTree, PyTree, Float[Array, " metrics"]]:
        """Update the networks; return the sums of the metrics and the number of updates, too."""
        if self._fallback:
            report(self._fallback)

        def step(carry: Condensed, batch: Any) -> tuple[Condensed, None]:
            params, optimizer_state, totals = carry.restore()
            params, optimizer_state, metrics = self._minibatch_step(
                params, optimizer_state, normalizer, *batch
            )
            # A metric of an update that was not applied may be NaN.
            totals += jnp.where(metrics[-1] > 0, metrics, 0.0)
            return condense((params, optimizer_state, totals)), None

        def one_pass(carry: Condensed, drawn: tuple[Array, Array]) -> tuple[Condensed, None]:
            order, loss_keys = drawn

            def minibatches(x: Array) -> Array:
                return x[order].reshape((self.config.num_minibatches, -1, *x.shape[1:]))

            return jax.lax.scan(step, carry, (jax.tree.map(minibatches, data), loss_keys))

        # XLA computes each array that a loop carries by a kernel of its own.
        start = condense((params, optimizer_state, jnp.zeros(len(LOSSES) + 1)))
        end, _ = jax.lax.scan(one_pass, start, self._draw_passes(key, data.reward.shape[0]))
        return end.restore()

    def _draw_passes(self, key: Array, unrolls: int) -> tuple[Array, Array]:
        """Draw the order of the unrolls in each pass, and the keys of its minibatches, as Brax."""
        passes, count = self.config.num_updates_per_batch, self.config.num_minibatches

        def draw_loss_keys(key: Array) -> Array:
            return jax.lax.scan(lambda key, _: tuple(jax.random.split(key)), key, length=count)[1]

        def draw(key: Array, _: None) -> tuple[Array, tuple[Array, Array]]:
            key, shuffle_key, minibatch_key = jax.random.split(key, 3)
            return key, (shuffle_key, minibatch_key)

        _, (shuffle_keys, minibatch_keys) = jax.lax.scan(draw, key, length=passes)
        # Shuffle for all passes at once: a GPU takes about as long for one.
        orders = jax.vmap(lambda key: jax.random.permutation(key, unrolls))(shuffle_keys)
        return orders, jax.vmap(draw_loss_keys)(minibatch_keys)

    def _mean_metrics(self, totals: Float[Array, " metrics"]) -> Float[Array, " metrics"]:
        """Average the metrics over the applied updates of all devices, and count the others.

        Args:
          totals: the sums of the metrics of the applied updates, followed by their number.
        """
        if self._axis is not None:
            totals = jax.lax.pmean(totals, self._axis)
        means = totals[:-1] / jnp.maximum(totals[-1], 1.0)
        updates = self.config.num_updates_per_batch * self.config.num_minibatches
        return jnp.append(means, updates - totals[-1])

    def _minibatch_step(
        self,
        params: PyTree,
        optimizer_state: PyTree,
        normalizer: Any,
        batch: Any,
        key: Array,
    ) -> tuple[PyTree, PyTree, Float[Array, " metrics"]]:
        """Apply one gradient step, or skip it if the gradient is not finite.

        Returns:
          The new parameters and state of the optimizer; the metrics of `LOSSES`, and whether the
          step was applied.
        """
        (_, metrics), gradient = self._loss_and_gradient(params, normalizer, batch, key)
        finite = jnp.isfinite(optax.tree.norm(gradient))
        # Adapt the step size to the KL divergence, and compute the update.
        before = params, optimizer_state
        if self.config.learning_rate_schedule == "ADAPTIVE_KL":
            kl = metrics["kl_mean"]
            optimizer_state, _ = optimizer.adaptive_kl_learning_rate(
                # Pass a copy, because the function modifies its argument.
                jax.tree.map(lambda x: x, optimizer_state),
                kl if self._axis is None else jax.lax.pmean(kl, self._axis),
                self.config.desired_kl,
                min_learning_rate=self.config.learning_rate_schedule_min_lr,
                max_learning_rate=self.config.learning_rate_schedule_max_lr,
            )
        change, optimizer_state = self._optimizer.update(gradient, optimizer_state, params)
        after = optax.apply_updates(params, change), optimizer_state
        # Keep the old parameters and optimizer state if the gradient is not finite.
        params, optimizer_state = jax.tree.map(
            lambda new, old: jnp.where(finite, new, old), after, before
        )
        rate = optimizer_state[-1].hyperparams["learning_rate"]
        metrics = {**metrics, "learning_rate": rate}
        row = jnp.stack([*(metrics[name] for name in LOSSES), finite.astype(jnp.float32)])
        return params, optimizer_state, row

    def _loss(
        self,
        params: PyTree,
        normalizer: running_statistics.RunningStatisticsState,
        batch: Transition,
        key: UInt32[Array, "2"],
    ) -> tuple[Array, Mapping[str, Array]]:
        """Compute Brax's PPO loss L = L_policy + L_value + L_entropy, as the module states it."""
        # Late: a training whose programs are found compiled needs no loss.
        from brax.training.agents.ppo import losses

        from jetbot_mjx.agents import gae

        networks: Any = self.networks
        if not isinstance(self._env.observation_size, int):
            batch = _encoded(networks, normalizer, params, batch)
            networks = networks.heads
        with gae.unrolled():
            return losses.compute_ppo_loss(
                params,
                normalizer,
                batch,
                key,
                ppo_network=networks,
                entropy_cost=self.config.entropy_cost,
                discounting=self.config.discounting,
                reward_scaling=self.config.reward_scaling,
                gae_lambda=self.config.gae_lambda,
                clipping_epsilon=self.config.clipping_epsilon,
                normalize_advantage=self.config.normalize_advantage,
                vf_coefficient=self.config.vf_loss_coefficient,
            )

    def _episode_sums(self, data: Transition) -> Float[Array, " sums"]:
        """Sum the metrics of the episodes that ended during collection over all devices."""
        ended = data.extras["state_extras"]["episode_done"]
        statistics: Any = data.extras["state_extras"]["episode_metrics"]
        terms = [ended]
        terms += [ended * statistics.get(name, jnp.zeros(())) for name in _EPISODE_SUMS]
        sums = jnp.stack(terms).sum(axis=(1, 2))
        return sums if self._axis is None else jax.lax.psum(sums, self._axis)


TALLIED = (
    "training_steps",
    *LOSSES.values(),
    "nonfinite_updates",
    "rollout/episodes",
    *_EPISODE_SUMS.values(),
)
"""Names of the metrics in `TrainState.tally`."""


def make_optimizer(config: PPOConfig) -> optax.GradientTransformation:
    """Return Adam, preceded by clipping of the global gradient norm if configured.

    Args:
      config: the hyperparameters, of which the step size, its schedule and the norm are used.

    Returns:
      A chain whose last state holds the step size in `hyperparams["learning_rate"]`.
    """
    rate: Any = config.learning_rate
    if config.learning_rate_schedule == "LINEAR":
        rate = optax.linear_schedule(config.learning_rate, 0.0, config.gradient_steps)
    fixed = ("b1", "b2", "eps", "eps_root")
    adam = optax.inject_hyperparams(optax.adam, static_args=fixed)(learning_rate=rate)
    if config.max_grad_norm is None:
        return optax.chain(adam)
    return optax.chain(optax.clip_by_global_norm(config.max_grad_norm), adam)


def _kept(state: Any) -> dict[str, Any]:
    """Return what a collection keeps of the state after a step."""
    info = {name: state.info[name] for name in _EXTRA_FIELDS}
    return {"obs": state.obs, "reward": state.reward, "done": state.done, "info": info}


def _action_keys(key: UInt32[Array, "2"], time: int) -> UInt32[Array, "time 2"]:
    """Return Brax's keys of the actions of an unroll, each of which follows from the one before."""

    def split(key: Array, _: None) -> tuple[Array, Array]:
        own, following = jax.random.split(key)
        return following, own

    return jax.lax.scan(split, key, length=time)[1]


def _encoded(networks: Networks, normalizer: Any, params: PyTree, batch: Transition) -> Transition:
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


def _find_nan_dump(start: Packed, data: Transition) -> NanDump:
    """Return the first non-finite state of an unroll, from data of shape (time, environment)."""
    statistics: Any = data.extras["state_extras"]["episode_metrics"]
    ended = data.extras["state_extras"]["episode_done"]
    nonfinite = ended * statistics.get("nonfinite_envs", jnp.zeros(())) > 0
    # The flat index is ordered by time and then by environment.
    first = jnp.argmax(nonfinite)
    step, env_index = jnp.divmod(first, nonfinite.shape[1])
    return NanDump(
        found=nonfinite.any(),
        env_state=jax.tree.map(lambda x: x[env_index], start),
        actions=data.action[:, env_index],
        step=step,
    )
