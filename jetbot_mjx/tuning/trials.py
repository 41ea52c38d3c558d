"""Train several policies with different hyperparameters in one compiled program.

Settings that only enter the arithmetic of PPO, such as the learning rate, are arguments of the
program and carry an axis of trials, as do the seeds; `jax.vmap` runs over both. Settings that
change shapes, such as the number of environments, belong to the program: trials that differ in them
run one group after the other.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int32, PyTree, UInt32

from jetbot_mjx.agents import PPO, TrainState
from jetbot_mjx.config import Config
from jetbot_mjx.envs import AdaptedEnv, maybe_randomize
from jetbot_mjx.evaluation import (
    Episodes,
    ReturnEpisodes,
    policy_controller,
    return_rollout_fn,
    rollout_fn,
    training_keys,
)
from jetbot_mjx.runs import Setup, load_checkpoint, make_warm_start
from jetbot_mjx.terminal import stage
from jetbot_mjx.tuning.space import TRACED, Values

SECTION = "ppo."

Traced = Mapping[str, Float[Array, "*trials"]]
"""Values of settings of PPO by name, with an axis of trials or without."""


ScoredBy = Literal["success", "return"]
"""What a policy is scored by: the success rate, or the mean return where there is none."""

Objective = Literal["learning", "time"]
"""What a search improves: the mean score while learning, or the time to the goals at the end."""


class Outcome(NamedTuple):
    """An `Outcome` holds how one trial learned."""

    scores: tuple[float, ...]
    """Success rates after each interval of the training, on the goals of evaluations during
    training; or mean returns."""
    mean_seconds: float | None
    """Mean duration of the last evaluation's episodes [s]; a failed one counts in full. None in an
    environment of one's own."""
    params: PyTree
    """The last parameters of the policy, on the host; None if the trial was ended early."""
    scored_by: ScoredBy = "success"

    def value(self, objective: Objective) -> float:
        """Return what a search improves.

        For `learning`, that is the mean of the scores, which rewards learning early and well; for
        `time`, the last mean duration [s].
        """
        if objective == "learning":
            return float(np.mean(self.scores))
        assert self.mean_seconds is not None
        return self.mean_seconds


class Trials:
    """A `Trials` trains groups of policies under one configuration's static settings."""

    def __init__(self, config: Config, names: Sequence[str], evaluations: int) -> None:
        """Prepare the programs, which compile at their first use.

        Args:
          config: the run; the values of its traced settings do not matter.
          names: the settings among `TRACED` that differ between the trials.
          evaluations: how often each policy is evaluated, at equal distances.

        Raises:
          UserError: the environment or the networks refuse a setting, or do not fit `init_from`.
        """
        assert set(names) <= set(TRACED), names
        self.config = config
        self._names = tuple(names)
        setup = Setup(config)
        self._env, self._networks = setup.training_env, setup.networks
        # Choose and report the learner once, and not with every program.
        learner = PPO(config.ppo, self._env, self._networks).launchable().learner
        chosen = config.ppo.model_copy(update={"update": learner.name})
        self.config = config.model_copy(update={"ppo": chosen})
        self._warm_start = None
        if config.init_from is not None:
            self._warm_start = make_warm_start(load_checkpoint(config.init_from), setup)
        policies, length = [policy_controller(self._networks)], config.task.episode_length
        self._scored_by: ScoredBy = "success"
        if isinstance(setup.env, AdaptedEnv):
            episodes = return_rollout_fn(setup.env, policies, length)
            self._scored_by = "success" if setup.env.has_success else "return"
        else:
            episodes = rollout_fn(maybe_randomize(setup.env), policies, length)
        steps = np.linspace(0, config.ppo.training_steps, evaluations + 1).round().astype(np.int32)
        self._steps = np.diff(steps)
        init = jax.vmap(lambda traced, seed: self._ppo(traced).init(jax.random.PRNGKey(seed)))

        def advance(traced: Traced, state: TrainState, steps: Int32[Array, ""]) -> TrainState:
            ppo = self._ppo(traced)
            return ppo.unpacked(ppo.advance(ppo.packed(state), steps, jnp.ones((), bool))[0])

        # `jax.jit` compiles again for each number of trials.
        self._compiled: set[int] = set()
        jit = functools.partial(jax.jit, compiler_options=setup.programs.options)
        self._init = jit(init)
        self._advance = jit(jax.vmap(advance, in_axes=(0, 0, None)), donate_argnums=1)
        self._episodes = jit(jax.vmap(episodes, in_axes=(None, 0, None)))

    def run(
        self,
        values: Sequence[Values],
        seeds: Sequence[int],
        goes_on: Callable[[int, Outcome], bool] = lambda trial, outcome: True,
    ) -> list[Outcome]:
        """Train one policy for each trial, all at once.

        Args:
          values: the traced settings of each trial.
          seeds: the seed of each trial.
          goes_on: asked after each interval but the last with the index of a trial and its outcome
            so far; if it returns false, the trial ends.

        Returns:
          The outcome of each trial.
        """
        count = len(values)
        width = self._width(count)
        padded = [values[min(i, count - 1)] for i in range(width)]
        traced = {
            name.removeprefix(SECTION): jnp.asarray([one[name] for one in padded], jnp.float32)
            for name in self._names
        }
        keys = jnp.asarray([seeds[min(i, count - 1)] for i in range(width)], jnp.uint32)
        # Train, and evaluate after each interval.
        goals = training_keys(self.config.evaluation.episodes)
        state = self._prepare(traced, keys, goals)
        # The trials that still train, by their row of the state.
        rows, outcomes = dict(enumerate(range(count))), [Outcome((), None, None)] * count
        with stage(
            f"training {count} {'policy' if count == 1 else 'policies'}, intervals",
            len(self._steps),
        ) as advance:
            for left, steps in zip(reversed(range(len(self._steps))), self._steps, strict=True):
                state = self._advance(traced, state, np.int32(steps))
                episodes = self.evaluate(state.policy_params, goals)
                scores = mean_scores(episodes, self._scored_by)
                seconds = mean_seconds(episodes, self.config)
                for row, trial in rows.items():
                    so_far = (*outcomes[trial].scores, scores[row])
                    outcomes[trial] = Outcome(so_far, seconds[row], None, self._scored_by)
                advance(1)
                if not left:
                    break
                rows = {row: i for row, i in rows.items() if goes_on(i, outcomes[i])}
                if not rows:
                    return outcomes
                # A quarter of the rows takes a processor a quarter of the time, and another program
                # to compile; a GPU would not be done much sooner.
                if 4 * len(rows) <= width and jax.default_backend() == "cpu":
                    width //= 4
                    chosen = np.resize([*rows], width)
                    traced, state = jax.tree.map(lambda x, i=chosen: x[i], (traced, state))
                    rows = dict(enumerate(rows.values()))
        params = jax.device_get(state.policy_params)
        for row, trial in rows.items():
            own = jax.tree.map(lambda x, i=row: x[i], params)
            outcomes[trial] = outcomes[trial]._replace(params=own)
        return outcomes

    def evaluate(self, params: PyTree, keys: UInt32[Array, "n 2"]) -> Episodes | ReturnEpisodes:
        """Run deterministic episodes of several policies.

        Args:
          params: parameters of the policies, stacked.
          keys: one reset key for each episode.

        Returns:
          The episodes, with the axes (policies, n).
        """
        return self._episodes(0, params, keys)

    def _width(self, count: int) -> int:
        """Return how many policies to train for so many trials."""
        if jax.default_backend() != "cpu" and (wider := [x for x in self._compiled if x >= count]):
            # A GPU trains them about as fast, and nothing is compiled.
            return min(wider)
        # A power of two, so that few widths are compiled.
        return 1 << (count - 1).bit_length()

    def _prepare(
        self, traced: Traced, seeds: UInt32[Array, " n"], goals: UInt32[Array, "n 2"]
    ) -> TrainState:
        """Return the stacked states before the first step, with compiled programs for them."""
        width = len(seeds)
        # Numbers of policies share programs: 3 train as 4 of which one is not looked at.
        many = "one policy" if width == 1 else f"up to {width} policies"
        with stage(f"compiling the training of {many}"):
            state = self._begin(traced, seeds)
            if width not in self._compiled:
                state = self._advance(traced, state, np.int32(0))
                self.evaluate(state.policy_params, goals)
                self._compiled.add(width)
            return state

    def _begin(self, traced: Traced, seeds: UInt32[Array, " n"]) -> TrainState:
        """Return the stacked states before the first step."""
        state = self._init(traced, seeds)
        if self._warm_start is None:
            return state
        each = [jax.tree.map(lambda x, i=i: x[i], state) for i in range(len(seeds))]
        return jax.tree.map(lambda *x: jnp.stack(x), *map(self._warm_start.apply, each))

    def _ppo(self, traced: Traced) -> PPO:
        # `model_copy` does not validate, so that traced values pass.
        return PPO(self.config.ppo.model_copy(update=dict(traced)), self._env, self._networks)


def mean_scores(episodes: Episodes | ReturnEpisodes, scored_by: ScoredBy) -> list[float]:
    """Return the success rate or the mean return of each policy."""
    each = episodes.success if scored_by == "success" else episodes.episode_return
    return np.asarray(each, float).mean(axis=1).tolist()


def mean_seconds(episodes: Episodes | ReturnEpisodes, config: Config) -> list[float] | list[None]:
    """Return the mean duration of each policy's episodes [s]; a failed one counts in full.

    In an environment of one's own, there is none.
    """
    if config.environment is not None:
        return [None] * len(episodes.steps)
    success, steps = np.asarray(episodes.success), np.asarray(episodes.steps)
    lasted = np.where(success > 0, steps, config.task.episode_length)
    return (lasted.mean(axis=1) * config.physics.ctrl_dt).tolist()
