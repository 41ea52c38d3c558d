"""Wrappers for training: termination and truncation apart, and a new goal in every episode.

Brax's `AutoResetWrapper` puts back the first state it ever saw, goal included. Here each
episode is drawn afresh from the environment's own key. The wrappers see one robot;
`jax.vmap` comes last, outermost.

What `info` holds from `reset` on, all float32 (Brax's trainer reads the first four):
  steps            environment steps of this episode so far, the last one's at its end
  truncation       1 where the episode was cut off (time limit, non-finite world): bootstraps
  episode_done     1 where an episode ended in this step
  episode_metrics  sums over the episode: every metric, `sum_reward` and `length`; with
                   `action_repeat` reward and metrics of a step are sums already
  terminated       1 where the task ended it: success or failure, does not bootstrap
  final_obs        what the policy would have seen next in the episode that ended
"""

from collections.abc import Callable
from typing import Any, Protocol

import jax
import jax.numpy as jnp
from brax.envs import Env, Wrapper
from brax.envs.wrappers.training import VmapWrapper
from jaxtyping import Array, Bool, Float, PyTree, UInt32

from jetbot_mjx.envs import mjx
from jetbot_mjx.envs.domain_randomization import maybe_randomize
from jetbot_mjx.envs.jetbot_env import JetBotEnv
from jetbot_mjx.envs.state import State

RandomizationFn = Callable[[mjx.Model], tuple[mjx.Model, PyTree]]
"""From one model to (a batch of models, the batch's axes as `jax.vmap` wants them)."""


class _Env(Protocol):
    """The interface that a wrapper needs of what it wraps."""

    def reset(self, rng: UInt32[Array, "2"]) -> State: ...

    def step(self, state: State, action: Float[Array, "2"]) -> State: ...


def wrap_for_training(
    env: JetBotEnv,
    episode_length: int,
    action_repeat: int = 1,
    randomization_fn: RandomizationFn | None = None,
) -> Env:
    """Wrap an environment as trainers need it, batched, with what its configuration draws.

    The signature is that of Brax's `wrap_env_fn`: pass this function to `ppo.train`.

    Args:
      env: one environment.
      episode_length: environment steps after which an episode is truncated.
      action_repeat: environment steps for which each action is held.
      randomization_fn: draws one physics model for each environment; the batch it returns
        must be as large as the batch of keys given to `reset`.

    Returns:
      The batched environment: `reset` takes keys of shape (n, 2), `step` actions (n, 2).
    """

    def chain(env: JetBotEnv) -> NewEpisodeWrapper:
        varied = maybe_randomize(env)
        return NewEpisodeWrapper(EpisodeWrapper(varied, episode_length, action_repeat))

    if randomization_fn is None:
        return VmapWrapper(chain(env))
    return RandomizedVmapWrapper(env, chain, randomization_fn)


class EpisodeWrapper(Wrapper):
    """Keeps an episode's books: steps, sums, the time limit, and worlds that blew up.

    A world whose state, observation or reward is not finite ends here: the step counts for
    nothing (reward 0, truncated, so the loss masks it), the learner sees the last finite
    observation instead, and `nonfinite_envs` counts it.
    """

    env: _Env

    def __init__(self, env: Env, episode_length: int, action_repeat: int = 1) -> None:
        """Wrap one environment.

        Args:
          env: unbatched.
          episode_length: environment steps after which an episode is truncated.
          action_repeat: environment steps for which each action is held.
        """
        super().__init__(env)
        self.episode_length = episode_length
        self.action_repeat = action_repeat

    def reset(self, rng: UInt32[Array, "2"]) -> State:
        """Begin an episode with empty books."""
        state = self.env.reset(rng)
        zero = jnp.zeros(())
        metrics = {**state.metrics, "nonfinite_envs": zero}
        info = {
            **state.info,
            "steps": zero,
            "truncation": zero,
            "episode_done": zero,
            "episode_metrics": {
                "sum_reward": zero,
                "length": zero,
                **dict.fromkeys(metrics, zero),
            },
            "final_obs": state.obs,
        }
        return state.replace(metrics=metrics, info=info)

    def step(self, state: State, action: Float[Array, "2"]) -> State:
        """Make one step: `action_repeat` environment steps, unless the episode ends before."""
        begins = state.info["episode_done"] > 0
        steps = jnp.where(begins, 0.0, state.info["steps"])
        nstate, length = self._repeat(state, action, steps)
        finite = _all_finite((nstate.pipeline_state, nstate.obs, nstate.reward))
        nstate = _select(finite, nstate, _discarded(state))

        steps = steps + length
        out_of_time = steps >= self.episode_length
        terminated = nstate.info["terminated"]
        truncation = jnp.where(out_of_time | ~finite, 1.0 - terminated, 0.0)
        done = jnp.maximum(terminated, truncation)

        metrics = {**nstate.metrics, "nonfinite_envs": 1.0 - finite.astype(jnp.float32)}
        step_values = {"sum_reward": nstate.reward, "length": length, **metrics}
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
        self, state: State, action: Float[Array, "2"], steps: Float[Array, ""]
    ) -> tuple[State, Float[Array, ""]]:
        """Hold an action until it was held long enough, the task has ended or the time is out.

        Args:
          state: where to start.
          action: in [-1, 1]².
          steps: environment steps of this episode so far.

        Returns:
          The last state, its reward and metrics added up over the environment steps that were
          made, and how many these were.
        """
        nstate = self.env.step(state.replace(done=jnp.zeros(())), action)
        length = jnp.ones(())
        if self.action_repeat == 1:
            return nstate, length

        def again(carry: tuple[State, PyTree, Array], _: None) -> tuple[PyTree, None]:
            state, sums, length = carry
            going = (state.done == 0) & (steps + length < self.episode_length)
            nstate = self.env.step(state, action)
            added = jax.tree.map(jnp.add, sums, (nstate.reward, nstate.metrics))
            carry = _select(going, (nstate, added), (state, sums))
            return (*carry, length + going), None

        first = (nstate, (nstate.reward, nstate.metrics), length)
        (nstate, (reward, metrics), length), _ = jax.lax.scan(
            again, first, length=self.action_repeat - 1
        )
        return nstate.replace(reward=reward, metrics=metrics), length


class NewEpisodeWrapper(Wrapper):
    """A wrapper that begins the next episode where one ends, with everything about it drawn anew.

    `reward`, `done`, `metrics` and `info` still tell of the step that ended the old episode;
    physics, goal, `obs` and the robot's `episode_params` are already the new one's.
    """

    env: _Env

    def step(self, state: State, action: Float[Array, "2"]) -> State:
        """Make one step, and a reset where it ended the episode."""
        state = self.env.step(state, action)
        fresh = self.env.reset(state.key)
        begun = _select(state.done > 0, _episode(fresh), _episode(state))
        physics, obs, goal, key, episode_params = begun
        return state.replace(
            pipeline_state=physics, obs=obs, goal=goal, key=key, episode_params=episode_params
        )


class RandomizedVmapWrapper(Wrapper):
    """A batch of environments, each with a physics model of its own."""

    env: JetBotEnv

    def __init__(
        self,
        env: JetBotEnv,
        chain: Callable[[JetBotEnv], Any],
        randomization_fn: RandomizationFn,
    ) -> None:
        """Draw the models.

        Args:
          env: one environment.
          chain: the wrappers to put around it.
          randomization_fn: draws the batch of models.
        """
        super().__init__(env)
        self._chain = chain
        self._models, self._axes = randomization_fn(env.mjx_model)

    def reset(self, rng: UInt32[Array, "n 2"]) -> State:
        """Begin an episode in every environment."""

        def reset(model: mjx.Model, rng: UInt32[Array, "2"]) -> State:
            return self._chain(self.env.with_model(model)).reset(rng)

        return jax.vmap(reset, in_axes=(self._axes, 0))(self._models, rng)

    def step(self, state: State, action: Float[Array, "n 2"]) -> State:
        """Step every environment."""

        def step(model: mjx.Model, state: State, action: Float[Array, "2"]) -> State:
            return self._chain(self.env.with_model(model)).step(state, action)

        return jax.vmap(step, in_axes=(self._axes, 0, 0))(self._models, state, action)


def _episode(state: State) -> tuple[PyTree, ...]:
    """Return what belongs to an episode, as against the step that led here."""
    return state.pipeline_state, state.obs, state.goal, state.key, state.episode_params


def _discarded(state: State) -> State:
    """Return a state in place of a non-finite one: the state before the step, and no step taken."""
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
