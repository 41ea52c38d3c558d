"""Learn by kernels of this package, which take parameters and moments as vectors.

Motivation: XLA passes the activations of every layer through memory between its kernels. It
launches 140 of them for a minibatch, and takes seconds to compile them. Here one kernel runs the
policy in all environments, and three compute advantages, the gradient of both networks and Adam's
step on GPUs, or one all minibatches on CPUs; docs/kernels.md explains them.

On GPUs, products round their operands to float16; everything else is float32.
"""

from collections.abc import Callable, Iterable, Mapping

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray, PyTree

from jetbot_mjx.agents.brax_parts import Normalizer, Transition
from jetbot_mjx.agents.fused import adam, arrays, launch, probe
from jetbot_mjx.agents.fused.adam import AdamRule, AdamTerms, Progress
from jetbot_mjx.agents.fused.layout import VectorLayout
from jetbot_mjx.agents.fused.shapes import DataSizes, LossTerms, UnrollSpec, UpdateShape
from jetbot_mjx.agents.learner import ONE_DEVICE, DeviceAxis, Learner, PackedEnv, UnrollFn
from jetbot_mjx.agents.optimizer import read_adam, write_adam
from jetbot_mjx.agents.random_keys import Keys
from jetbot_mjx.agents.train_state import LOSSES, TrainState
from jetbot_mjx.agents.unrolls import kept_of, step_by_step, transition
from jetbot_mjx.config import PPOConfig
from jetbot_mjx.packed import Packed, PackedStep, pack

Extras = dict[str, Array | tuple[Array, ...]]
"""What Brax keeps of actions, by name."""


def shape_of(
    config: PPOConfig, observation_size: int | Mapping[str, object], action_size: int
) -> UpdateShape | str:
    """Return the networks as the kernels know them, or why the kernels cannot compute them.

    Args:
      config: the settings of PPO, of which those of the networks are used.
      observation_size: the length of the observation, or the shapes of its parts.
      action_size: the length of the action.
    """
    network = config.network
    hidden = network.policy_hidden_layer_sizes
    # The kernels know one width, and one depth.
    if not isinstance(observation_size, int):
        return "it takes observations without images"
    if network.distribution_type == "categorical":
        return "it takes actions that are numbers, not choices"
    if hidden != network.value_hidden_layer_sizes or len(set(hidden)) > 1:
        return "it takes two networks of the same hidden layers of one width"
    sizes = observation_size, hidden[0], len(hidden), action_size
    kinds = network.distribution_type, network.activation
    return UpdateShape(*sizes, *kinds, config.normalize_advantage)


def make_fused_learner(
    config: PPOConfig,
    observation_size: int | Mapping[str, object],
    action_size: int,
    devices: DeviceAxis = ONE_DEVICE,
) -> "FusedLearner | str":
    """Return the learner of a configuration, or why this process cannot run its kernels.

    Args:
      config: the hyperparameters.
      observation_size: the length of the observation, or the shapes of its parts.
      action_size: the length of the action.
      devices: the devices that share a minibatch.
    """
    # Whether any kernels know such networks, and whether those of this device do.
    shape = shape_of(config, observation_size, action_size)
    if isinstance(shape, str):
        return shape
    learner = FusedLearner(config, shape, devices)
    return launch.refusal(shape, learner.batch) or learner


class FusedLearner(Learner):
    """A `FusedLearner` computes actions, gradients and Adam by kernels.

    Parameters and moments are vectors during and between the calls.
    """

    name = "fused"
    keeps_activations = False
    draws_ahead = True

    def __init__(
        self, config: PPOConfig, shape: UpdateShape, devices: DeviceAxis = ONE_DEVICE
    ) -> None:
        """Divide the minibatches among the devices.

        Args:
          config: the hyperparameters.
          shape: the networks, from `shape_of`.
          devices: the devices that share a minibatch.
        """
        self.layout = VectorLayout(shape)
        self.shape = shape
        """The networks."""
        self._config, self._devices = config, devices
        # Each device has its share of the environments and of every minibatch.
        unrolls, steps = config.batch_size // devices.size, config.num_minibatches
        self.batch = DataSizes(
            collected=unrolls * steps,
            unrolls=unrolls,
            time=config.unroll_length,
            minibatches=steps * config.num_updates_per_batch,
            environments=config.num_envs // devices.size,
        )
        """The sizes of the data on one device."""
        schedule = config.learning_rate_schedule
        self.rule = AdamRule(shape, self.batch.samples, schedule, self.batch.minibatches)
        """What the vectors hold, and how the step size changes."""
        # Several devices average each gradient before Adam's step.
        self.at_once = devices.size == 1 and launch.has(arrays.UPDATE)
        """Whether one kernel computes all minibatches."""

    # Whether the kernels can be used.

    def obstacle(self) -> str | None:
        """Return why the back end of the kernels cannot be used in this process, or None."""
        return launch.backend().obstacle()

    def failure(self) -> str | None:
        """Return that the kernels of this GPU failed their comparison with the CPU's, or None."""
        # On a CPU, `obstacle` has tried the same compiler with a small kernel.
        if jax.default_backend() != "gpu" or probe.runs_correctly():
            return None
        return "its kernels failed their check on this machine"

    def prepare(self, replicas: int) -> None:
        """Begin to compile the kernels for a number of trainings that run at once."""
        # An unroll is prepared as soon as its environment is known.
        if not launch.has(arrays.UNROLL):
            launch.prepare(arrays.ACTIONS, self.shape, self.batch, replicas)
        if self.at_once:
            launch.prepare(arrays.UPDATE, self.rule, self.batch, replicas)
        else:
            launch.prepare(arrays.GRADIENT, self.shape, self.batch, replicas)
            launch.prepare(arrays.ADAM, self.rule, self.batch, replicas)

    # The collection.

    def make_unroll(self, env: PackedEnv, state: TrainState) -> UnrollFn:
        """Return an unroll by one kernel if a step of the environments is one, as in `Learner`."""
        # Policy and environments take turns where a step of these is more than one kernel.
        spec = self.unroll_spec(env, state.env_state)
        if spec is None:
            return step_by_step(env, self.policy(state.params, state.normalizer), self.action_noise)
        # All steps by one kernel, which writes what is kept of each state as a row of numbers.
        launch.prepare(arrays.UNROLL, spec, self.batch)
        statistics = self._statistics(state.normalizer)
        kept_like = jax.eval_shape(
            lambda x: pack(kept_of(x.unpack()), batch_axes=1), state.env_state
        )

        def unroll(start: Packed, key: PRNGKeyArray) -> tuple[Packed, Transition]:
            arguments = *statistics, start.words, self.action_noise(key)
            end, words, actions = launch.unroll(spec, state.params, *arguments)
            kept = kept_like.replace(words=words).unpack()
            # The observation before a step is that after the step before.
            obs = jnp.concatenate([start.unpack().obs[None], kept["obs"][:-1]])
            data = transition(obs, actions.action, self._extras(actions), kept)
            return start.replace(words=end), data

        return unroll

    def unroll_spec(self, env: PackedEnv, start: Packed) -> UnrollSpec | None:
        """Return the kernel of an unroll; None: the environments must be stepped one by one.

        Args:
          env: the environment from `wrap_for_training`.
          start: its states.
        """
        step = env.step_packed
        if not launch.has(arrays.UNROLL) or not isinstance(step, PackedStep):
            return None
        kernel = step.kernel(start)
        if kernel is None or jax.eval_shape(lambda x: x.unpack().obs, start).dtype != jnp.float32:
            return None
        # Where each number of a state is.
        places = start.places()
        kept = [x for leaf in jax.tree.leaves(kept_of(places)) for x in leaf.reshape(-1)]
        return UnrollSpec(self.shape, kernel, int(places.obs[0]), tuple(map(int, kept)))

    def policy(
        self, params: Float[Array, " size"], normalizer: Normalizer
    ) -> Callable[[Array, Array], tuple[Array, Extras]]:
        """Return the policy of a collection.

        Args:
          params: the parameters.
          normalizer: the statistics of the observations.

        Returns:
          A function from the observations of all environments, of shape (environments, obs), and
          standard normal noise, of shape (environments, actions), to the actions and what Brax
          keeps of them.
        """
        statistics = self._statistics(normalizer)

        def act(observations: Array, noise: Array) -> tuple[Array, Extras]:
            actions = launch.actions(self.shape, params, *statistics, observations, noise)
            return actions.action, self._extras(actions)

        return act

    def action_noise(self, key: PRNGKeyArray) -> Float[Array, "time environments actions"]:
        """Draw the noise of all actions of an unroll."""
        return jax.random.normal(
            key, (self.batch.time, self.batch.environments, self.shape.actions)
        )

    def _extras(self, actions: launch.Actions) -> Extras:
        """Return what Brax keeps of actions."""
        extras = actions._asdict()
        del extras["action"]
        if self.shape.distribution == "normal":
            extras["distribution_params"] = tuple(jnp.split(actions.distribution_params, 2, -1))
        return extras

    def _statistics(self, normalizer: Normalizer) -> tuple[Array, Array]:
        """Return the mean of the observations, and the inverse of their standard deviations."""
        if self._config.normalize_observations:
            statistics: PyTree = normalizer
            return statistics.mean, 1.0 / statistics.std
        size = self.shape.observations
        return jnp.zeros(size), jnp.ones(size)

    # The update.

    def update(
        self,
        params: Float[Array, " size"],
        optimizer_state: PyTree,
        normalizer: Normalizer,
        data: Transition,
        key: PRNGKeyArray,
    ) -> tuple[Float[Array, " size"], PyTree, Float[Array, " totals"]]:
        """Update the networks by one kernel, or by three for each minibatch, as in `Learner`."""
        collected = self.collected(data, normalizer)
        terms = self.adam_terms(optimizer_state)
        # Shuffle for all passes, and draw all noise, with all keys at once, unlike Brax's.
        shuffle_key, noise_key = jax.random.split(key)
        shuffle_keys = jax.random.split(shuffle_key, self._config.num_updates_per_batch)
        orders = jax.vmap(lambda key: jax.random.permutation(key, self.batch.collected))
        unroll_indices = orders(shuffle_keys).reshape(self.batch.minibatches, -1)
        noise = self.noise(jax.random.split(noise_key, self.batch.minibatches))
        state = self.first_vectors(params, optimizer_state)
        # All minibatches by one kernel.
        if self.at_once:
            arguments = *collected, unroll_indices, noise, self._loss_terms(), terms, *state
            return self.results(launch.update(self.rule, *arguments), optimizer_state)

        # Or one by one: advantages and gradient, and a step of Adam.
        def step(state: tuple[Array, ...]) -> tuple[Array, ...]:
            index, params, mu, nu, progress = state
            gradient = self.gradient(params, collected, unroll_indices, noise, index)
            vectors = launch.adam(self.rule, gradient, params, mu, nu, progress, index, terms)
            return index + 1, *vectors

        # `scan` would carry a counter of its own beside `index`, which would be another launch.
        first = jnp.zeros((), jnp.int32), *state
        last = jax.lax.while_loop(lambda state: state[0] < self.batch.minibatches, step, first)
        return self.results(last[1:], optimizer_state)

    def collected(self, data: Transition, normalizer: Normalizer) -> tuple[Array, ...]:
        """Return the collected data as the kernels read it.

        Args:
          data: the unrolls, of shape (unrolls, time, ...).
          normalizer: the statistics of the observations.

        Returns:
          The arrays `mean`, `inverse_std`, `rows` and `last` of `arrays.AXES`.
        """
        # A row for each step: what the policy saw and did, and what came of it.
        extras: PyTree = data.extras["policy_extras"]
        names = "raw_action", "log_prob", "distribution_params"
        parts = data.observation, *(extras[name] for name in names)
        results = data.reward, data.discount, data.extras["state_extras"]["truncation"]
        # Each is a number of a step or several; a `normal` distribution has two arrays.
        leaves = (x.reshape(*data.reward.shape, -1) for x in jax.tree.leaves((parts, results)))
        rows, last = jnp.concatenate([*leaves], axis=-1), data.next_observation[:, -1]
        return *self._statistics(normalizer), rows, last

    def noise(self, keys: Keys) -> Float[Array, "minibatches time unrolls actions"]:
        """Draw the noise that estimates the entropy, from the key of each minibatch."""
        # Brax draws the noise with time as the first axis.
        shape = self.batch.time, self.batch.unrolls, self.shape.actions
        return jax.vmap(lambda key: jax.random.normal(key, shape))(keys)

    def gradient(
        self,
        params: Float[Array, " size"],
        collected: tuple[Array, ...],
        unroll_indices: Int[Array, "minibatches unrolls"],
        noise: Float[Array, "minibatches time unrolls actions"],
        index: Int[Array, ""],
    ) -> Float[Array, " size"]:
        """Compute the gradient of Brax's PPO loss, the mean of all devices.

        Args:
          params: the parameters.
          collected: all data, from `collected`.
          unroll_indices: which of the collected unrolls are in each minibatch.
          noise: their noise, from `noise`.
          index: the minibatch.

        Returns:
          The gradient as a vector, with the sums of the metrics at their places.
        """
        # On GPUs by two kernels: first advantages and value targets, then both networks forward and
        # backward. On CPUs by one call.
        arguments = *collected, unroll_indices, noise, index, self._loss_terms()
        gradient = launch.gradient(self.shape, params, *arguments)
        return gradient if self._devices.size == 1 else self._devices.mean(gradient)

    def _loss_terms(self) -> Float[Array, " terms"]:
        return _array(getattr(self._config, name) for name in LossTerms._fields)

    # The state of the optimizer as vectors and an array of `adam.Progress`.

    def adam_terms(self, optimizer_state: PyTree) -> Float[Array, " terms"]:
        """Return the array of `AdamTerms` of a training step.

        Args:
          optimizer_state: the state before it.
        """
        config, fraction = self._config, 1.0 / self._config.gradient_steps
        return _array(
            AdamTerms(
                max_grad_norm=jnp.inf if config.max_grad_norm is None else config.max_grad_norm,
                learning_rate=config.learning_rate,
                fraction_done=read_adam(optimizer_state).count * fraction,
                fraction_per_step=fraction,
                desired_kl=config.desired_kl,
                min_rate=config.learning_rate_schedule_min_lr,
                max_rate=config.learning_rate_schedule_max_lr,
            )
        )

    def first_vectors(
        self, params: Array, optimizer_state: PyTree
    ) -> tuple[Array, Array, Array, Array]:
        """Return the parameters, Adam's moments, and the progress before the first minibatch."""
        # The powers of Adam's β are carried from step to step.
        state = read_adam(optimizer_state)
        progress = Progress(
            rate=state.rate,
            power_1=adam.BETA_1**state.count,
            power_2=adam.BETA_2**state.count,
            sums=[0.0] * len(adam.METRICS),
            rates=0.0,
            applied=0.0,
        )
        # A row before each step and one after the last: a kernel writes the next row while some of
        # its threads still read the present one.
        row = _array(jax.tree.leaves(progress))
        rows = jnp.zeros((self.rule.steps, len(row)))
        return params, state.mu, state.nu, jnp.concatenate([row[None], rows])

    def results(
        self, vectors: tuple[Array, ...], optimizer_state: PyTree
    ) -> tuple[Array, PyTree, Float[Array, " totals"]]:
        """Return the results of `update`.

        Args:
          vectors: the parameters, Adam's moments, and the progress after the last minibatch.
          optimizer_state: the state before the first one.
        """
        # The last row of the progress has the sums over all minibatches.
        params, mu, nu, progress = vectors
        rate, _, _, *sums, rates, applied = progress[-1]
        optimizer_state = write_adam(optimizer_state, rate, applied, mu, nu)
        metrics = {**self.metrics(jnp.stack(sums)), "learning_rate": rates}
        totals = jnp.stack([*(metrics[name] for name in LOSSES), applied])
        return params, optimizer_state, totals

    def metrics(self, sums: Float[Array, " metrics"]) -> dict[str, Array]:
        """Return the sums of some minibatches' metrics under Brax's names.

        Args:
          sums: the sums of `adam.METRICS` over all of their samples.
        """
        config = self._config
        mean = dict(zip(adam.METRICS, sums / self.rule.samples, strict=True))
        losses = {
            "policy_loss": mean["policy_loss"],
            "v_loss": mean["squared_error"] * (0.5 * config.vf_loss_coefficient),
            "entropy_loss": mean["entropy"] * -config.entropy_cost,
        }
        return {
            **losses,
            "total_loss": sum(losses.values(), jnp.zeros(())),
            "kl_mean": mean["kl"],
            "policy_dist_mean_std": mean["std"] / self.shape.actions,
        }


def _array(numbers: Iterable[Array | float]) -> Float[Array, " numbers"]:
    return jnp.stack([jnp.asarray(x, jnp.float32) for x in numbers])
