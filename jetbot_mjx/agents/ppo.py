"""Train with proximal policy optimisation (PPO) as one pure step, built from Brax's parts.

Motivation: `brax.training.agents.ppo.train` keeps its training state in local variables. Here that
state is one value, `TrainState`, that can be saved and restored, and non-finite environment states
and gradients are stopped and counted.

Equation: each minibatch minimises Brax's loss

    L = -mean(min(ρ A, clip(ρ, 1 - ε, 1 + ε) A)) + ½ c_v mean((V_target - V)²) - c_e mean(H)

with ρ = π(a|s) / π_old(a|s), A and V_target from `gae`, A normalised over the minibatch if
`normalize_advantage`, ε = `clipping_epsilon`, c_v = `vf_loss_coefficient`, c_e = `entropy_cost`
and H the entropy of the policy.

Networks, action distribution, loss, running statistics, unrolls, gradients and the ADAPTIVE_KL
rule are Brax's; so is the order of the random keys: on one device, step for step and with
`normalizer: brax`, this is `brax.training.agents.ppo.train`.

The step is written for one shard of the environments. Under `jax.shard_map` over `axis_name`
each device steps and shuffles its own environments; only gradients, the normaliser's sums and
the metrics are exchanged between devices.

Source: J. Schulman et al., Proximal Policy Optimization Algorithms, arXiv:1707.06347;
google/brax v0.14.2, brax/training/agents/ppo.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from brax.envs import Env
from brax.training import acting, gradients
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo import losses, optimizer
from brax.training.agents.ppo import networks as ppo_networks
from brax.training.types import Transition, UInt64
from flax import struct
from jaxtyping import Array, Bool, Float, Int, PyTree, UInt32

from jetbot_mjx.agents import gae
from jetbot_mjx.agents.networks import PolicyParams
from jetbot_mjx.config import PPOConfig

# Pyright does not follow flax's dataclasses.
_NetworkParams: Any = losses.PPONetworkParams
_UInt64: Any = UInt64

LOSSES = {
    "total_loss": "loss/total",
    "policy_loss": "loss/policy",
    "v_loss": "loss/value",
    "entropy_loss": "loss/entropy",
    "kl_mean": "policy/kl",
    "policy_dist_mean_std": "policy/std",
    "learning_rate": "policy/learning_rate",
}
"""Brax's names of a minibatch's metrics, and ours."""

_EPISODE_SUMS = {
    "sum_reward": "rollout/return",
    "length": "rollout/length",
    "success": "rollout/successes",
    "nonfinite_envs": "nonfinite_envs",
}
"""Metrics summed over the episodes that end, by their name in `info["episode_metrics"]`."""


class TrainState(struct.PyTreeNode):
    """The complete training state: a training that is restored from it continues exactly.

    Its leaves are `Any`: they also travel stacked, on the host, and as bare shapes.
    """

    params: Any
    """Weights of the policy and value networks, `policy` and `value`."""
    optimizer_state: PyTree
    """Adam's moments, its step count and step size."""
    normalizer: running_statistics.RunningStatisticsState
    """Running mean and deviation of the observation."""
    env_state: Any
    """Every environment's state, batched."""
    key: Any
    """Random key of the next training step."""
    env_steps: UInt64
    """Environment steps so far, over all devices."""
    tally: dict[str, Any]
    """Sums of the metrics of the training steps since `tally["training_steps"]` was 0."""

    @property
    def policy_params(self) -> PolicyParams:
        """Return the parameters that inference needs."""
        return PolicyParams(self.normalizer, self.params.policy, self.params.value)


class NanDump(struct.PyTreeNode):
    """The first non-finite state of an unroll, and the actions that led to it."""

    found: Any
    """Whether there is one; otherwise the other fields have no meaning."""
    env_state: Any
    """The environment's state where the unroll began."""
    actions: Any
    """The actions from there on, shape (time, action)."""
    step: Any
    """Index of the action that led to the non-finite state."""


class StepOutput(NamedTuple):
    """A `StepOutput` holds what one training step reports beside its state."""

    metrics: dict[str, Float[Array, ""]]
    """Means over the minibatches, and counts over the collected steps."""
    nan_dump: NanDump
    """The first non-finite state of this shard."""


class PPO:
    """PPO for one configuration and one environment; the object itself holds no state."""

    def __init__(
        self,
        config: PPOConfig,
        env: Env,
        networks: ppo_networks.PPONetworks,
        *,
        num_envs: int | None = None,
        axis_name: str | None = None,
        device_count: int = 1,
    ) -> None:
        """Build the optimizer and the loss.

        Args:
          config: the hyperparameters.
          env: wrapped for training: batched, resets itself, keeps `episode_metrics`.
          networks: the policy and value networks, from `make_networks`.
          num_envs: environments, all devices together; `config.num_envs` by default.
          axis_name: mesh axis that the environments are sharded over; None: no sharding.
          device_count: its size.
        """
        self.config = config
        self.num_envs = num_envs or config.num_envs
        self._env: Any = env
        self._axis = axis_name
        self._device_count = device_count
        self.networks = networks
        self._min_std = (
            self._env.observation_min_std
            if config.normalize_observations and config.normalizer == "physical"
            else None
        )
        self._make_policy = ppo_networks.make_inference_fn(self.networks)
        self._optimizer: Any = make_optimizer(config)
        loss: Any = self._loss
        self._loss_and_gradient = gradients.loss_and_pgrad(
            loss, pmap_axis_name=axis_name, has_aux=True
        )

    def init(self, key: UInt32[Array, "2"]) -> TrainState:
        """Return the training state before the first step.

        Args:
          key: `jax.random.PRNGKey(seed)`.

        Returns:
          The state, all environments in it: to be computed outside `jax.shard_map`.
        """
        # The order of Brax's train(), up to the first epoch.
        global_key, local_key = jax.random.split(key)
        local_key = jax.random.fold_in(local_key, 0)
        local_key, env_key, _ = jax.random.split(local_key, 3)
        policy_key, value_key = jax.random.split(global_key)
        epoch_key, _ = jax.random.split(local_key)
        params = _NetworkParams(
            policy=self.networks.policy_network.init(policy_key),
            value=self.networks.value_network.init(value_key),
        )
        state = TrainState(
            params=params,
            optimizer_state=self._optimizer.init(params),
            normalizer=self._with_floor(
                running_statistics.init_state(
                    specs.Array((self._env.observation_size,), jnp.dtype("float32"))
                )
            ),
            env_state=self._env.reset(jax.random.split(env_key, self.num_envs)),
            key=jax.random.split(epoch_key, 1)[0],
            env_steps=_UInt64(hi=0, lo=0),
            tally=dict.fromkeys(TALLIED, jnp.zeros(())),
        )
        # Python's numbers make weakly typed arrays, for which the step would compile again.
        return jax.tree.map(lambda x: jnp.asarray(x).astype(jnp.asarray(x).dtype), state)

    def advance(
        self, state: TrainState, num_steps: Int[Array, ""], restart: Bool[Array, ""]
    ) -> tuple[TrainState, NanDump]:
        """Run several training steps; their number is an argument, so that one program serves all.

        Args:
          state: where to start.
          num_steps: training steps.
          restart: whether the tally starts from nothing.

        Returns:
          The state after them, and the first nan_dump among them on this shard.
        """
        tally = jax.tree.map(lambda x: jnp.where(restart, 0.0, x), state.tally)

        def body(_: Array, carry: tuple[TrainState, NanDump]) -> tuple[TrainState, NanDump]:
            before, nan_dump = carry
            state, output = self.train_step(before)
            added = {**output.metrics, "training_steps": jnp.ones(())}
            tally = {name: total + added[name] for name, total in before.tally.items()}
            nan_dump = _first(nan_dump, output.nan_dump)
            return state.replace(tally=tally), nan_dump

        none = NanDump(
            found=jnp.zeros((), bool),
            env_state=jax.tree.map(lambda x: jnp.zeros(x.shape[1:], x.dtype), state.env_state),
            actions=jnp.zeros((self.config.unroll_length, self._env.action_size)),
            step=jnp.zeros((), jnp.int32),
        )
        return jax.lax.fori_loop(0, num_steps, body, (state.replace(tally=tally), none))

    def train_step(self, state: TrainState) -> tuple[TrainState, StepOutput]:
        """Collect experience with the current policy, and update the policy with it.

        Args:
          state: the state of this shard.

        Returns:
          The next state and what happened on the way.
        """
        update_key, rollout_key, next_key = jax.random.split(state.key, 3)
        if self._device_count > 1:
            index = jax.lax.axis_index(self._axis)
            update_key = jax.random.fold_in(update_key, index)
            rollout_key = jax.random.fold_in(rollout_key, index)
        env_state, data, nan_dump = self.collect(state, rollout_key)
        seen = self._with_floor(
            running_statistics.update(state.normalizer, data.observation, pmap_axis_name=self._axis)
        )
        # As Brax does it: ADAPTIVE_KL compares with distributions under the old normaliser.
        adaptive = self.config.learning_rate_schedule == "ADAPTIVE_KL"
        normalizer = state.normalizer if adaptive else seen
        params, optimizer_state, metrics = self.update(
            state.params, state.optimizer_state, normalizer, data, update_key
        )
        metrics = {**metrics, **self._episode_sums(data)}
        state = state.replace(
            params=params,
            optimizer_state=optimizer_state,
            normalizer=seen,
            env_state=env_state,
            key=next_key,
            env_steps=state.env_steps + self.config.steps_per_training_step,
        )
        return state, StepOutput(metrics, nan_dump)

    def _with_floor(
        self, normalizer: running_statistics.RunningStatisticsState
    ) -> running_statistics.RunningStatisticsState:
        """Raise each standard deviation to at least the observation's physical scale.

        A robot that never leaves its floor sees heights and tilts that differ by micrometres.
        Divided by such a deviation, another simulator's contact is far outside of all that was
        seen. The sums from which `std` is computed at the next update are left as they are.
        """
        if self._min_std is None:
            return normalizer
        raised: Any = normalizer
        return raised.replace(std=jnp.maximum(raised.std, self._min_std))

    def collect(
        self, state: TrainState, key: UInt32[Array, "2"]
    ) -> tuple[PyTree, Transition, NanDump]:
        """Collect unrolls, one after the other, until there are enough for all minibatches.

        Args:
          state: the state of this shard.
          key: random key for the actions' noise.

        Returns:
          The environments' states after it, the unrolls of shape (unrolls, time, ...), of whose
          `next_observation` only the last is kept, and the first non-finite state.
        """
        policy = self._make_policy(tuple(state.policy_params))

        def unroll(carry: tuple[Any, Array], _: None) -> tuple[tuple[Any, Array], PyTree]:
            env_state, key = carry
            key, next_key = jax.random.split(key)
            after, data = acting.generate_unroll(
                self._env,
                env_state,
                policy,
                key,
                self.config.unroll_length,
                extra_fields=("truncation", "episode_metrics", "episode_done"),
            )
            nan_dump = _find_fault(env_state, data)
            # The loss needs the next observation only at the end of an unroll.
            data = data._replace(next_observation=data.next_observation[-1:])
            return (after, next_key), (data, nan_dump)

        count = self.config.batch_size * self.config.num_minibatches // self.num_envs
        (env_state, _), (data, nan_dumps) = jax.lax.scan(
            unroll, (state.env_state, key), length=count
        )
        nan_dump = jax.tree.map(lambda x: x[jnp.argmax(nan_dumps.found)], nan_dumps)
        # From (unrolls, time, environments) to (unrolls x environments, time).
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
    ) -> tuple[PyTree, PyTree, dict[str, Float[Array, ""]]]:
        """Update the networks in several passes over the collected data, in minibatches.

        Args:
          params: parameters of the networks.
          optimizer_state: state of the optimizer of `make_optimizer`.
          normalizer: statistics that normalise the observations.
          data: unrolls, shape (unrolls, time, ...); `next_observation` may hold the last only.
          key: random key for the shuffles and the entropy's samples.

        Returns:
          Parameters, optimizer state, and the mean metrics of the minibatches.
        """
        # Episode statistics are not shuffled.
        extras = {
            "policy_extras": data.extras["policy_extras"],
            "state_extras": {"truncation": data.extras["state_extras"]["truncation"]},
        }
        data = data._replace(extras=extras)

        def one_pass(carry: PyTree, _: None) -> tuple[PyTree, PyTree]:
            params, optimizer_state, key = carry
            key, shuffle_key, minibatch_key = jax.random.split(key, 3)

            order = jax.random.permutation(shuffle_key, data.reward.shape[0])

            def minibatches(x: Array) -> Array:
                return x[order].reshape((self.config.num_minibatches, -1, *x.shape[1:]))

            (params, optimizer_state, _), metrics = jax.lax.scan(
                lambda carry, batch: self._minibatch_step(carry, batch, normalizer),
                (params, optimizer_state, minibatch_key),
                jax.tree.map(minibatches, data),
            )
            return (params, optimizer_state, key), metrics

        (params, optimizer_state, _), metrics = jax.lax.scan(
            one_pass, (params, optimizer_state, key), length=self.config.num_updates_per_batch
        )
        if self._axis is not None:
            metrics = jax.lax.pmean(metrics, self._axis)
        applied = metrics.pop("applied")
        count = jnp.maximum(applied.sum(), 1.0)
        means = {
            ours: jnp.where(applied > 0, metrics[theirs], 0.0).sum() / count
            for theirs, ours in LOSSES.items()
        }
        return params, optimizer_state, {**means, "nonfinite_updates": (1.0 - applied).sum()}

    def _minibatch_step(
        self,
        carry: tuple[PyTree, PyTree, UInt32[Array, "2"]],
        batch: Transition,
        normalizer: running_statistics.RunningStatisticsState,
    ) -> tuple[PyTree, dict[str, Float[Array, ""]]]:
        """Apply one gradient step, or skip it where the gradient is not finite."""
        params, optimizer_state, key = carry
        key, loss_key = jax.random.split(key)
        (_, metrics), gradient = self._loss_and_gradient(params, normalizer, batch, loss_key)
        finite = jnp.isfinite(optax.tree.norm(gradient))
        before = params, optimizer_state
        if self.config.learning_rate_schedule == "ADAPTIVE_KL":
            kl = metrics["kl_mean"]
            optimizer_state, _ = optimizer.adaptive_kl_learning_rate(
                # It modifies the state that it is given.
                jax.tree.map(lambda x: x, optimizer_state),
                kl if self._axis is None else jax.lax.pmean(kl, self._axis),
                self.config.desired_kl,
                min_learning_rate=self.config.learning_rate_schedule_min_lr,
                max_learning_rate=self.config.learning_rate_schedule_max_lr,
            )
        change, optimizer_state = self._optimizer.update(gradient, optimizer_state, params)
        after = optax.apply_updates(params, change), optimizer_state
        params, optimizer_state = jax.tree.map(
            lambda new, old: jnp.where(finite, new, old), after, before
        )
        metrics = {
            **metrics,
            "learning_rate": optimizer_state[-1].hyperparams["learning_rate"],
            "applied": finite.astype(jnp.float32),
        }
        return (params, optimizer_state, key), metrics

    def _loss(
        self,
        params: PyTree,
        normalizer: running_statistics.RunningStatisticsState,
        batch: Transition,
        key: UInt32[Array, "2"],
    ) -> tuple[Array, Mapping[str, Array]]:
        """Compute Brax's PPO loss under this configuration; the module states the equation."""
        with gae.unrolled():
            return losses.compute_ppo_loss(
                params,
                normalizer,
                batch,
                key,
                ppo_network=self.networks,
                entropy_cost=self.config.entropy_cost,
                discounting=self.config.discounting,
                reward_scaling=self.config.reward_scaling,
                gae_lambda=self.config.gae_lambda,
                clipping_epsilon=self.config.clipping_epsilon,
                normalize_advantage=self.config.normalize_advantage,
                vf_coefficient=self.config.vf_loss_coefficient,
            )

    def _episode_sums(self, data: Transition) -> dict[str, Float[Array, ""]]:
        """Sum the metrics of the episodes that ended during collection, over all devices."""
        ended = data.extras["state_extras"]["episode_done"]
        statistics: Any = data.extras["state_extras"]["episode_metrics"]
        sums = {
            ours: (ended * statistics.get(theirs, jnp.zeros(()))).sum()
            for theirs, ours in _EPISODE_SUMS.items()
        }
        sums["rollout/episodes"] = ended.sum()
        return sums if self._axis is None else jax.lax.psum(sums, self._axis)


TALLIED = (
    "training_steps",
    "nonfinite_updates",
    "rollout/episodes",
    *_EPISODE_SUMS.values(),
    *LOSSES.values(),
)
"""The names in `TrainState.tally`."""


def make_optimizer(config: PPOConfig) -> optax.GradientTransformation:
    """Return Adam, preceded by clipping of the global gradient norm if configured.

    Args:
      config: step size, its schedule, and the norm.

    Returns:
      A chain whose last state holds the step size in `hyperparams["learning_rate"]`.
    """
    rate: Any = config.learning_rate
    if config.learning_rate_schedule == "LINEAR":
        updates = config.training_steps * config.num_minibatches * config.num_updates_per_batch
        rate = optax.linear_schedule(config.learning_rate, 0.0, updates)
    fixed = ("b1", "b2", "eps", "eps_root")
    adam = optax.inject_hyperparams(optax.adam, static_args=fixed)(learning_rate=rate)
    if config.max_grad_norm is None:
        return optax.chain(adam)
    return optax.chain(optax.clip_by_global_norm(config.max_grad_norm), adam)


def _find_fault(start: PyTree, data: Transition) -> NanDump:
    """Return the first non-finite state of an unroll, from data of shape (time, world)."""
    statistics: Any = data.extras["state_extras"]["episode_metrics"]
    ended = data.extras["state_extras"]["episode_done"]
    blown = ended * statistics.get("nonfinite_envs", jnp.zeros(())) > 0
    # In order of time, then of the worlds.
    first = jnp.argmax(blown)
    step, world = jnp.divmod(first, blown.shape[1])
    return NanDump(
        found=blown.any(),
        env_state=jax.tree.map(lambda x: x[world], start),
        actions=data.action[:, world],
        step=step,
    )


def _first(one: NanDump, other: NanDump) -> NanDump:
    """Return the earlier of two non-finite states, if there is one."""
    return jax.tree.map(lambda a, b: jnp.where(one.found, a, b), one, other)
