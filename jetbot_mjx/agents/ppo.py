"""Train with proximal policy optimisation (PPO) as one pure step, built from Brax's parts.

Motivation: `brax.training.agents.ppo.train` keeps its training state in local variables. Here that
state is one value, `TrainState`, that can be saved and restored, and non-finite environment states
and gradients are stopped and counted.

Equation: each minibatch minimises Brax's loss, the sum of the clipped surrogate objective, the
value loss and the entropy bonus:

    L = L_policy + L_value + L_entropy
    L_policy  = -mean(min(ρ Â, clip(ρ, 1 - ε, 1 + ε) Â)),  ρ = π(a|s) / π_old(a|s)
    L_value   = ½ c_v mean((V' - V)²)
    L_entropy = -c_e mean(H)

The advantage Â and the value target V' come from `gae`, H is the entropy of the policy,
ε = `clipping_epsilon`, c_v = `vf_loss_coefficient` and c_e = `entropy_cost`. With
`normalize_advantage`, Â is normalised over the minibatch; each of several devices normalises its
share.

Protocol of a training step:

1. `collect` runs the current policy for `unroll_length` steps in every environment, until there are
   `batch_size * num_minibatches` unrolls.
2. The normaliser takes in all collected observations.
3. `Learner.update` makes `num_updates_per_batch` passes over the unrolls. Each pass shuffles them,
   splits them into `num_minibatches`, and for each minibatch computes the values, the advantages,
   the loss and its gradient, clips it to the global norm `max_grad_norm`, and applies one step of
   Adam.

A `Learner` computes actions and update. `XlaLearner` (`xla_learner`, with the loss in `loss`) is
the readable reference in JAX's functions. `FusedLearner`, with the same loss of one sample, does
the same faster by the kernels that docs/kernels.md explains; `ppo.update: auto`, the default,
chooses it where it can run.

Networks, action distribution, running statistics, steps, gradients and the ADAPTIVE_KL rule
are Brax's. On one device and with `normalizer: brax` and `update: xla`, the order of the random
keys is Brax's too, and every step equals a step of `brax.training.agents.ppo.train`. The deviations
from Brax are:

- An update with a non-finite gradient is skipped and counted.
- What reproduces the first non-finite state of an environment is returned as a `NanDump`.
- `normalizer: physical` bounds the standard deviation from below by the observation's scale.
- `learning_rate_schedule: LINEAR` lowers the step size to zero over the training.
- `FusedLearner` multiplies in float16 on GPUs, and draws shuffles and noise with other keys, many
  at once.
- GAE is unrolled, and of the next observations only those that the loss needs are stored.

The step is written for one shard of the environments. Under `jax.shard_map` over a `DeviceAxis`
each device steps and shuffles its own environments; only gradients, the normaliser's sums and
the metrics are exchanged between devices.

Source: J. Schulman et al., Proximal Policy Optimization Algorithms, arXiv:1707.06347;
google/brax v0.14.2, brax/training/agents/ppo.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree, UInt32

from jetbot_mjx.agents.brax_parts import Env, Normalizer, Transition, UInt64
from jetbot_mjx.agents.choose_learner import choose_learner, xla_instead
from jetbot_mjx.agents.learner import ONE_DEVICE, DeviceAxis, Learner
from jetbot_mjx.agents.networks import (
    NetworkParams,
    Networks,
    init_normalizer,
    update_normalizer,
)
from jetbot_mjx.agents.optimizer import make_optimizer
from jetbot_mjx.agents.random_keys import kernel_key, raw_key
from jetbot_mjx.agents.train_state import EPISODE_SUMS, TALLIED, NanDump, TrainState
from jetbot_mjx.agents.unrolls import find_nan_dump, joined
from jetbot_mjx.config import PPOConfig
from jetbot_mjx.packed import Packed, pack

# Pyright does not follow flax's dataclasses.
_UInt64: Any = UInt64


class PPO:
    """A `PPO` object trains one configuration in one environment; it holds no training state."""

    def __init__(
        self,
        config: PPOConfig,
        env: Env,
        networks: Networks,
        devices: DeviceAxis = ONE_DEVICE,
        learner: Learner | None = None,
    ) -> None:
        """Choose the learner; nothing is compiled yet.

        Args:
          config: the hyperparameters.
          env: the environment from `wrap_for_training`, which is batched, resets itself and reports
            `episode_metrics`.
          networks: the policy and value networks, from `make_networks`.
          devices: the devices over which the environments are sharded.
          learner: computes actions and update; None: the one that `ppo.update` asks for.

        Raises:
          UserError: `ppo.update` requests kernels that cannot compute this configuration.
        """
        self.config = config
        self.networks = networks
        self.learner = learner or choose_learner(config, env, networks, devices)
        self._env: Any = env
        self._devices = devices
        self._optimizer: Any = make_optimizer(config)
        self._min_std = (
            self._env.observation_min_std
            if config.normalize_observations and config.normalizer == "physical"
            else None
        )

    @property
    def has_success(self) -> bool:
        """Return whether the environment tells successes, which the tally counts."""
        return self._env.has_success

    # Before the first step: whether the learner can be used, and the state.

    def with_xla(self, reason: str) -> "PPO":
        """Return PPO whose update XLA compiles, for the same states between two calls.

        Args:
          reason: why the learner cannot be used, which is reported.

        Raises:
          UserError: `ppo.update` requests this learner.
        """
        layout = self.learner.layout
        learner = xla_instead(reason, self.config, self.networks, self._devices, layout)
        return PPO(self.config, self._env, self.networks, self._devices, learner)

    def launchable(self) -> "PPO":
        """Return this object if this process can launch its update, or PPO `with_xla`.

        Raises:
          UserError: `ppo.update` requests a learner that cannot be launched.
        """
        obstacle = self.learner.obstacle()
        return self if obstacle is None else self.with_xla(obstacle)

    def init(self, key: UInt32[Array, "2"]) -> TrainState:
        """Return the training state before the first step.

        Args:
          key: the key of the training, `jax.random.PRNGKey(seed)`.

        Returns:
          The state with all environments, so this must be called outside `jax.shard_map`.
        """
        # Split the keys in the order of Brax's train(), up to the first epoch.
        global_key, local_key = jax.random.split(kernel_key(key))
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
            env_state=self._env.reset(raw_key(jax.random.split(env_key, self.config.num_envs))),
            key=raw_key(jax.random.split(epoch_key, 1)[0]),
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
        # Convert parameters and moments to the form that the learner computes with.
        state = _map_learned(self.learner.to_working, state.replace(tally=tally))

        def body(_: Array, carry: tuple[TrainState, NanDump]) -> tuple[TrainState, NanDump]:
            before, nan_dump = carry
            state, metrics, found = self.train_step(before)
            nan_dump = jax.tree.map(
                lambda one, other: jnp.where(nan_dump.found, one, other), nan_dump, found
            )
            return state.replace(tally=before.tally + metrics), nan_dump

        # Run the steps, and keep the first dump.
        none = NanDump(
            found=jnp.zeros((), bool),
            env_state=jax.tree.map(lambda x: jnp.zeros(x.shape[1:], x.dtype), state.env_state),
            actions=jnp.zeros((self.config.unroll_length, self._env.action_size)),
            step=jnp.zeros((), jnp.int32),
        )
        state, nan_dump = jax.lax.fori_loop(0, num_steps, body, (state, none))
        return _map_learned(self.learner.from_working, state), nan_dump

    def packed(self, state: TrainState) -> TrainState:
        """Return a state with few arrays, as `advance` takes it; see the forms in `learner`.

        Args:
          state: the state, from `init` or on the host.
        """
        state = state.replace(env_state=pack(state.env_state, batch_axes=1))
        return _map_learned(self.learner.layout.pack, state)

    def unpacked(self, state: TrainState) -> TrainState:
        """Return a state with all arrays, the inverse of `packed`."""
        state = state.replace(env_state=state.env_state.unpack())
        return _map_learned(self.learner.layout.unpack, state)

    # The algorithm.

    def train_step(self, state: TrainState) -> tuple[TrainState, Float[Array, " metrics"], NanDump]:
        """Collect experience with the current policy, and update the policy with it.

        Args:
          state: the packed state of this shard, with parameters and moments in the working form.

        Returns:
          The next state; the metrics of `TALLIED`; and what reproduces the first non-finite state.
        """
        # Each device draws its own keys, and all devices continue from the same one. On CPUs,
        # kernels draw from these keys, with the numbers that JAX would draw.
        update_key, rollout_key, next_key = jax.random.split(kernel_key(state.key), 3)
        update_key = self._devices.own_key(update_key)
        rollout_key = self._devices.own_key(rollout_key)
        # 1. Collect experience with the current policy.
        env_state, data, nan_dump = self.collect(state, rollout_key)
        # 2. Update the normaliser with all observations.
        updated_normalizer = self._with_floor(
            update_normalizer(state.normalizer, data.observation, self._devices.name)
        )
        # 3. Update the networks in passes and minibatches. As in Brax, ADAPTIVE_KL uses the old
        # normaliser: it compares the new action distributions with those of the collection.
        adaptive = self.config.learning_rate_schedule == "ADAPTIVE_KL"
        normalizer = state.normalizer if adaptive else updated_normalizer
        params, optimizer_state, totals = self.learner.update(
            state.params, state.optimizer_state, normalizer, _without_statistics(data), update_key
        )
        # Go on from the next key, and report what happened.
        state = state.replace(
            params=params,
            optimizer_state=optimizer_state,
            normalizer=updated_normalizer,
            env_state=env_state,
            key=raw_key(next_key),
            env_steps=state.env_steps + self.config.steps_per_training_step,
        )
        return state, self._metrics(totals, data), nan_dump

    def collect(self, state: TrainState, key: PRNGKeyArray) -> tuple[Packed, Transition, NanDump]:
        """Collect unrolls until there are enough for all minibatches.

        Args:
          state: the state of this shard, as for `train_step`.
          key: the random key of the actions' noise.

        Returns:
          The environment states after the last unroll; the unrolls, of shape (unrolls, time, ...),
          with `next_observation` of their last step only; and what reproduces the first
          non-finite state.
        """
        unroll = self.learner.make_unroll(self._env, state)

        def next_unroll(
            carry: tuple[Packed, PRNGKeyArray], _: None
        ) -> tuple[tuple[Packed, PRNGKeyArray], tuple[Transition, NanDump]]:
            """Let the policy act for `unroll_length` steps in every environment."""
            start, key = carry
            key, next_key = jax.random.split(key)
            after, data = unroll(start, key)
            nan_dump = find_nan_dump(start, data)
            ends = jax.tree.map(lambda x: x[None], after.unpack().obs)
            return (after, next_key), (data._replace(next_observation=ends), nan_dump)

        # Run the unrolls one after the other, and keep the first dump.
        count = self.config.batch_size * self.config.num_minibatches // self.config.num_envs
        (env_state, _), (data, nan_dumps) = jax.lax.scan(
            next_unroll, (state.env_state, key), length=count
        )
        nan_dump = jax.tree.map(lambda x: x[jnp.argmax(nan_dumps.found)], nan_dumps)
        return env_state, joined(data), nan_dump

    # The normaliser and the metrics.

    def _with_floor(self, normalizer: Normalizer) -> Normalizer:
        """Bound each standard deviation from below by the observation's physical scale.

        The height and tilt of a robot on a flat floor vary by micrometres. Normalised by such a
        deviation, the slightly different contact of another simulator would be far outside of the
        training's range. The sums from which the next update computes `std` do not change.
        """
        if self._min_std is None:
            return normalizer
        raised: PyTree = normalizer
        return raised.replace(std=jax.tree.map(jnp.maximum, raised.std, self._min_std))

    def _metrics(
        self, totals: Float[Array, " totals"], data: Transition
    ) -> Float[Array, " metrics"]:
        """Return the metrics of a training step over all devices, in the order of `TALLIED`.

        Args:
          totals: the sums of the metrics of the applied updates and their number, from
            `Learner.update`.
          data: what was collected.
        """
        # One training step, what the applied updates add up to, and the number of the others.
        totals = self._devices.mean(totals)
        skipped = self.config.updates_per_training_step - totals[-1:]
        # The number and the sums of the episodes that ended during collection.
        ended = data.extras["state_extras"]["episode_done"]
        statistics: PyTree = data.extras["state_extras"]["episode_metrics"]
        terms = [ended]
        terms += [ended * statistics.get(name, jnp.zeros(())) for name in EPISODE_SUMS]
        episodes = self._devices.sum(jnp.stack(terms).sum(axis=(1, 2)))
        return jnp.concatenate([jnp.ones(1), totals[:-1], skipped, episodes])


def _without_statistics(data: Transition) -> Transition:
    """Return collected data without the statistics of episodes, which need not be shuffled."""
    extras = {
        "policy_extras": data.extras["policy_extras"],
        "state_extras": {"truncation": data.extras["state_extras"]["truncation"]},
    }
    return data._replace(extras=extras)


def _map_learned(change: Callable[[PyTree], PyTree], state: TrainState) -> TrainState:
    """Return a state with another form of its parameters and of the optimizer's state."""
    params, optimizer_state = change((state.params, state.optimizer_state))
    return state.replace(params=params, optimizer_state=optimizer_state)
