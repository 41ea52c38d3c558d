"""Wrap an environment for training: count, end and restart its episodes.

`wrap_for_training` is the entry point. The order, from the inside out:

    JetBotEnv > DomainRandomizationWrapper > EpisodeWrapper > NewEpisodeWrapper > KernelWrapper
      > CameraWrapper > BatchWrapper

All wrappers but the last one see a single robot without a batch axis.
"""

from collections.abc import Callable
from typing import Protocol

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, PyTree, UInt32

from jetbot_mjx.envs import mjx
from jetbot_mjx.envs.adapted_env import AdaptedEnv
from jetbot_mjx.envs.camera.wrapper import with_camera
from jetbot_mjx.envs.domain_randomization import maybe_randomize
from jetbot_mjx.envs.jetbot_env import JetBotEnv
from jetbot_mjx.envs.state import State
from jetbot_mjx.fallbacks import Fallback, report
from jetbot_mjx.mjx_import import Env, Wrapper
from jetbot_mjx.packed import Packed, PackedStep, pack
from onekernel import Fused, Kernel, UnsupportedError, fuse

RandomizationFn = Callable[[mjx.Model], tuple[mjx.Model, PyTree]]
"""A function from one model to (batch of models, their `in_axes` for `jax.vmap`), as in Brax."""


class _Env(Protocol):
    """The interface that a wrapper requires of the environment inside it."""

    unwrapped: JetBotEnv | AdaptedEnv

    def reset(self, rng: UInt32[Array, "2"]) -> State: ...

    def step(self, state: State, action: Float[Array, " action"]) -> State: ...


class _PackedEnv(_Env, Protocol):
    """The interface that a batch requires of the environment inside it."""

    def step_packed(self, packed: Packed, action: Float[Array, " action"]) -> Packed: ...


def wrap_for_training(
    env: JetBotEnv | AdaptedEnv,
    episode_length: int,
    action_repeat: int = 1,
    randomization_fn: RandomizationFn | None = None,
    *,
    final_images: bool = False,
) -> "BatchWrapper":
    """Wrap an environment for a trainer: batched, with automatic resets and domain randomization.

    The signature is that of Brax's `wrap_env_fn`, so this function can be passed to `ppo.train`.
    The `randomization` section of the environment's configuration is applied in every episode;
    `randomization_fn` is Brax's way to give each environment one fixed model.

    Args:
      env: one environment, unwrapped.
      episode_length: environment steps after which an episode is truncated.
      action_repeat: environment steps for which each action is repeated.
      randomization_fn: draws one physics model per environment. The batch of models must be as
        large as the batch of keys given to `reset`. None: all environments share one model.
      final_images: whether `info["final_obs"]` has images too, which costs a second image in every
        step; otherwise it has the numbers only.

    Returns:
      The batched environment: `reset` takes keys of shape (n, 2), `step` takes actions of shape
      (n, 2).
    """

    def wrap_one(env: JetBotEnv | AdaptedEnv) -> NewEpisodeWrapper:
        # Only a robot has a camera, and anything to draw.
        if isinstance(env, AdaptedEnv):
            return NewEpisodeWrapper(EpisodeWrapper(env, episode_length, action_repeat))
        varied = maybe_randomize(env)
        one = env.blind() if isinstance(varied, JetBotEnv) else varied
        if final_images:
            one = with_camera(one, env.camera)
        return NewEpisodeWrapper(EpisodeWrapper(one, episode_length, action_repeat))

    camera = None if final_images else env.camera
    if randomization_fn is None or isinstance(env, AdaptedEnv):
        return BatchWrapper(with_camera(KernelWrapper(wrap_one(env)), camera))
    return RandomizedBatchWrapper(
        env, lambda env: with_camera(wrap_one(env), camera), randomization_fn
    )


class EpisodeWrapper(Wrapper):
    """A wrapper that ends episodes and accumulates their statistics.

    Motivation: PPO must tell two ends of an episode apart. Where the task ended it (termination),
    the value of the next state is zero. Where the time limit or a simulation error cut it off
    (truncation), the episode could have gone on: the loss masks that step, and the return is
    bootstrapped from the value function. A non-finite state must not reach the learner at all,
    since a single NaN destroys the network. Brax's `EpisodeWrapper` does not check for non-finite
    states, and with `action_repeat` it steps on after an episode has ended.

    Protocol: the environment writes `obs`, `reward`, `metrics` and `info["terminated"]`; this
    wrapper writes the fields below at every step, all float32; `NewEpisodeWrapper` reads `done` and
    leaves `info` and `metrics` as they are. The same names are present from `reset` on.

      field                    value                                            read by
      done                     1 where the episode ended in this step, by       PPO, adapters,
                               termination or truncation                        NewEpisodeWrapper
      info["terminated"]       1 where the task ended it, in success or         adapters, evaluation
                               failure; the return is not bootstrapped
      info["truncation"]       1 where it was cut off by the time limit or a    PPO, adapters
                               non-finite state; the return is bootstrapped
      info["steps"]            environment steps of this episode so far         this wrapper
      info["episode_done"]     the same as `done`, where Brax's trainer reads   PPO, this wrapper
                               it
      info["episode_metrics"]  sums over the episode so far: every metric,      PPO, for its logs
                               `sum_reward` and `length`
      info["final_obs"]        the observation after this step, of the old      adapters
                               episode even where a new one has begun
      metrics["nonfinite_envs"]
                               1 where this step was not finite                 PPO, viewers

    The order within a step:

      1. If the previous step ended an episode, `steps` and `episode_metrics` start from zero.
      2. Step the environment up to `action_repeat` times, until the task or the time limit ends
         the episode. Reward and metrics of the repeated steps are summed.
      3. If state, observation or reward is not finite, discard the step: the state before it
         remains, reward and metrics are 0, and the episode is truncated. If the observation of a
         reset is not finite, it is replaced by zeros, and the first step is discarded.
      4. Compute truncation and `done`: terminated excludes truncated.
      5. Add reward, length and metrics of the step to `episode_metrics`.
    """

    env: _Env

    def __init__(self, env: Env, episode_length: int, action_repeat: int = 1) -> None:
        """Wrap one environment.

        Args:
          env: the environment, unbatched.
          episode_length: environment steps after which an episode is truncated.
          action_repeat: environment steps for which each action is repeated.
        """
        super().__init__(env)
        self.episode_length = episode_length
        self.action_repeat = action_repeat

    def reset(self, rng: UInt32[Array, "2"]) -> State:
        """Begin an episode with zero counters and sums.

        Args:
          rng: a random key.
        """
        state = _with_finite_obs(self.env.reset(rng))
        zero = jnp.zeros(())
        metrics = {**state.metrics, "nonfinite_envs": zero}
        info = {
            **state.info,
            "steps": zero,
            "truncation": zero,
            "episode_done": zero,
            "episode_metrics": {**dict.fromkeys(metrics, zero), "sum_reward": zero, "length": zero},
            "final_obs": state.obs,
        }
        return state.replace(metrics=metrics, info=info)

    def step(self, state: State, action: Float[Array, " action"]) -> State:
        """Make one step of up to `action_repeat` environment steps.

        Args:
          state: the state after `reset` or after the previous step.
          action: the action, in [-1, 1]².
        """
        # Step the environment; after an episode's end the counters begin again.
        begins = state.info["episode_done"] > 0
        steps = jnp.where(begins, 0.0, state.info["steps"])
        nstate, length = self._repeat(state, action, steps)
        # Replace a non-finite state.
        finite = _all_finite((nstate.pipeline_state, nstate.obs, nstate.reward))
        nstate = _select(finite, nstate, _without_step(state))

        # Decide how the episode ends, if it does.
        steps = steps + length
        terminated = nstate.info["terminated"]
        # An environment of one's own may have a time limit of its own.
        out_of_time = (steps >= self.episode_length) | (nstate.done > terminated)
        truncation = jnp.where(out_of_time | ~finite, 1.0 - terminated, 0.0)
        done = jnp.maximum(terminated, truncation)

        # Add the step to the sums of the episode.
        metrics = {**nstate.metrics, "nonfinite_envs": 1.0 - finite.astype(jnp.float32)}
        # An environment of one's own may have metrics of these names.
        step_values = {**metrics, "sum_reward": nstate.reward, "length": length}
        sums = {
            name: jnp.where(begins, 0.0, total) + step_values[name]
            for name, total in state.info["episode_metrics"].items()
        }
        info = {
            **nstate.info,
            "steps": steps,
            "truncation": truncation,
            "episode_done": done,
            "episode_metrics": sums,
            "final_obs": nstate.obs,
        }
        return nstate.replace(done=done, metrics=metrics, info=info)

    def _repeat(
        self, state: State, action: Float[Array, " action"], steps: Float[Array, ""]
    ) -> tuple[State, Float[Array, ""]]:
        """Repeat an action `action_repeat` times, or until the episode ends.

        Args:
          state: the state before the first step.
          action: the action, in [-1, 1]².
          steps: environment steps of this episode so far.

        Returns:
          The last state, with reward and metrics summed over the steps made, and their number.
        """
        nstate = self.env.step(state.replace(done=jnp.zeros(())), action)
        length = jnp.ones(())
        if self.action_repeat == 1:
            return nstate, length

        def repeat_once(carry: tuple[State, PyTree, Array], _: None) -> tuple[PyTree, None]:
            state, sums, length = carry
            is_running = (state.done == 0) & (steps + length < self.episode_length)
            nstate = self.env.step(state, action)
            added = jax.tree.map(jnp.add, sums, (nstate.reward, nstate.metrics))
            carry = _select(is_running, (nstate, added), (state, sums))
            return (*carry, length + is_running), None

        first = (nstate, (nstate.reward, nstate.metrics), length)
        (nstate, (reward, metrics), length), _ = jax.lax.scan(
            repeat_once, first, length=self.action_repeat - 1
        )
        return nstate.replace(reward=reward, metrics=metrics), length


class NewEpisodeWrapper(Wrapper):
    """A wrapper that begins a new episode in the step in which one ends.

    Brax's `AutoResetWrapper` restores the first state it ever saw, goal included. This wrapper
    draws a new goal and new robot parameters, from the key in the state.

    After a step that ended an episode, `reward`, `done`, `metrics` and `info` belong to the old
    episode; `pipeline_state`, `obs`, `goal`, `key` and `episode_params` belong to the new one.
    """

    env: _Env

    def step(self, state: State, action: Float[Array, " action"]) -> State:
        """Make one step, and reset the environment if the episode ended.

        Args:
          state: the state before the step.
          action: the action, in [-1, 1]².
        """
        state = self.env.step(state, action)
        new_episode = self.env.reset(state.key)
        fields = _select(state.done > 0, _episode_fields(new_episode), _episode_fields(state))
        physics, obs, goal, key, episode_params = fields
        return state.replace(
            pipeline_state=physics, obs=obs, goal=goal, key=key, episode_params=episode_params
        )


class KernelWrapper(Wrapper):
    """A wrapper that compiles a step as one kernel, and a reset as another, if physics is one.

    Beside the methods of an environment it has `step_packed`, from a packed state and an action to
    the next packed state.
    """

    env: _Env

    def __init__(self, env: Env) -> None:
        """Wrap one environment, which observes numbers only.

        Args:
          env: the environment, in all wrappers of a single robot but that of the camera.
        """
        super().__init__(env)
        unwrapped = self.env.unwrapped

        def report_unsupported(error: UnsupportedError) -> None:
            # If physics is not a kernel, it has reported the reason already.
            if unwrapped.may_be_kernel:
                reason = f"one kernel cannot do {error}: the page on own tasks says what to avoid"
                report(Fallback("environment step", reason))

        def compiled(function: Callable[..., PyTree]) -> Callable[..., PyTree]:
            return fuse(
                function,
                on_unsupported=report_unsupported,
                may_be_kernel=lambda: unwrapped.may_be_kernel,
                explain=unwrapped.kernel_impl.explain,
                on_fallback=unwrapped.kernel_impl.report_fallback,
            )

        def step_packed(packed: Packed, action: Float[Array, " action"]) -> Packed:
            return pack(self.env.step(packed.unpack(), action))

        self.reset = compiled(self.env.reset)
        self.step = compiled(self.env.step)
        # A step of a packed state has one array in and one array out.
        self.step_packed = compiled(step_packed)


class BatchWrapper(Wrapper):
    """A batch of environments, with the methods of one."""

    env: _PackedEnv

    def reset(self, rng: UInt32[Array, "n 2"]) -> State:
        """Begin an episode in every environment.

        Args:
          rng: one random key per environment.
        """
        return self._call("reset", rng)

    def step(self, state: State, action: Float[Array, "n action"]) -> State:
        """Step every environment.

        Args:
          state: the batch of states.
          action: one action per environment, in [-1, 1]².
        """
        return self._call("step", state, action)

    def _call(self, method: str, *batch: PyTree) -> State:
        """Call a method of every environment."""
        return jax.vmap(getattr(self.env, method))(*batch)

    @property
    def step_packed(self) -> PackedStep:
        """Return the step of every environment, with few arrays for XLA to pass on.

        It takes the batch of states, and one action per environment, in [-1, 1]².
        """
        return PackedStep(jax.vmap(self.env.step_packed), self._packed_kernel)

    def _packed_kernel(self, packed: Packed) -> Kernel | None:
        """Return the kernel of a step, as `PackedStep.kernel`."""
        step = self.env.step_packed
        if packed.others or not isinstance(step, Fused):
            return None
        one = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape[1:], x.dtype), packed)
        return step.kernel_for(one, jax.ShapeDtypeStruct((self.action_size,), jnp.float32))


class RandomizedBatchWrapper(BatchWrapper):
    """A batch of environments, each with its own fixed physics model.

    It has the place of Brax's `DomainRandomizationVmapWrapper`.
    """

    env: JetBotEnv

    def __init__(
        self,
        env: JetBotEnv,
        wrap_one: Callable[[JetBotEnv], Env],
        randomization_fn: RandomizationFn,
    ) -> None:
        """Draw the models.

        Args:
          env: one environment, unwrapped.
          wrap_one: adds the wrappers of a single environment.
          randomization_fn: draws the batch of models.
        """
        super().__init__(env)
        self._wrap_one = wrap_one
        self._models, self._axes = randomization_fn(env.mjx_model)

    def _call(self, method: str, *batch: PyTree) -> State:
        """Call a method of every environment, each with its own model."""

        def call(model: mjx.Model, *given: PyTree) -> State:
            return getattr(self._wrap_one(self.env.with_model(model)), method)(*given)

        return jax.vmap(call, in_axes=(self._axes, *[0] * len(batch)))(self._models, *batch)

    @property
    def step_packed(self) -> PackedStep:
        """Return the step of every environment, which is more than one kernel."""
        return PackedStep(
            lambda packed, action: pack(self.step(packed.unpack(), action), batch_axes=1),
            lambda packed: None,
        )


def _episode_fields(state: State) -> tuple[PyTree, ...]:
    """Return the fields that belong to the episode and not to the last step."""
    return state.pipeline_state, state.obs, state.goal, state.key, state.episode_params


def _with_finite_obs(state: State) -> State:
    """Return the state after a reset, with an observation of zeros in place of a non-finite one.

    Its physics is then NaN, so that the first step is not finite and ends the episode.
    """
    finite = _all_finite((state.obs, state.reward))

    def spoil(x: PyTree) -> PyTree:
        return jnp.where(finite, x, jnp.nan) if jnp.issubdtype(x.dtype, jnp.floating) else x

    return state.replace(
        obs=jax.tree.map(lambda x: jnp.where(finite, x, jnp.zeros_like(x)), state.obs),
        pipeline_state=jax.tree.map(spoil, state.pipeline_state),
    )


def _without_step(state: State) -> State:
    """Return the state before a step, with zero reward and metrics, to replace a non-finite one."""
    zeros = jax.tree.map(jnp.zeros_like, state.metrics)
    return state.replace(
        reward=jnp.zeros(()),
        done=jnp.zeros(()),
        metrics=zeros,
        info={**state.info, "terminated": jnp.zeros(())},
    )


def _select(condition: Bool[Array, ""], yes: PyTree, no: PyTree) -> PyTree:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def _all_finite(tree: PyTree) -> Bool[Array, ""]:
    leaves = [jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(tree)]
    return jnp.all(jnp.stack(leaves))
