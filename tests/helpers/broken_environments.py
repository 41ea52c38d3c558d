"""Environments that are each wrong in one way, for the check before a training to find out."""

import itertools
import types

import jax
import jax.numpy as jnp
import numpy as np

from helpers.own_environments import ZERO, Point

count = itertools.count(1)


class TurnsOnFloat64(Point):
    def __init__(self):
        super().__init__()
        jax.config.update("jax_enable_x64", True)


class DecidesInPython(Point):
    def step(self, state, action):
        if action[0] > 0:
            return super().step(state, action)
        return state


class CallsNumpy(Point):
    def step(self, state, action):
        after = super().step(state, action)
        return after.replace(reward=jnp.float32(np.clip(np.asarray(action), 0, 1)[0]))


class DividesByZero(Point):
    def step(self, state, action):
        after = super().step(state, action)
        return after.replace(reward=(action[0] - action[0]) / jnp.zeros(()))


class OverflowsInAMetric(Point):
    def step(self, state, action):
        after = super().step(state, action)
        return after.replace(metrics={"speed": jnp.log(-jnp.ones(()))})


class ObservesNothingFinite(Point):
    def reset(self, rng):
        first = super().reset(rng)
        return first.replace(obs=first.obs / 0.0 * 0.0)


class GrowsItsObservation(Point):
    def step(self, state, action):
        after = super().step(state, action)
        return after.replace(obs=jnp.append(after.obs, 0.0))


class GrowsItsState(Point):
    def step(self, state, action):
        after = super().step(state, action)
        x = jnp.stack([after.pipeline_state["x"]] * 2)
        return after.replace(pipeline_state=after.pipeline_state | {"x": x})


class ChangesAType(Point):
    def step(self, state, action):
        after = super().step(state, action)
        twice = after.pipeline_state["twice"].astype(jnp.int32)
        return after.replace(pipeline_state=after.pipeline_state | {"twice": twice})


class CountsInItself(Point):
    steps = 0

    def step(self, state, action):
        self.steps += 1
        after = super().step(state, action)
        return after.replace(reward=after.reward - 0.01 * self.steps)


class RemembersItsState(Point):
    last = 0.0

    def step(self, state, action):
        after = super().step(state, action)
        reward, self.last = after.reward - self.last, after.reward
        return after.replace(reward=reward)


class DrawsFromNumpy(Point):
    def step(self, state, action):
        return super().step(state, action + np.random.default_rng().normal())


class DrawsAResetFromNumpy(Point):
    def reset(self, rng):
        return self.state(
            jnp.float32(np.random.default_rng().uniform()), jnp.zeros(()), {"speed": ZERO}
        )


class NamesAMetricAnewEachTime(Point):
    def state(self, x, speed, metrics):
        return super().state(x, speed, {f"speed_{next(count)}": speed})


class ResetsSlowly(Point):
    def reset(self, rng):
        first = super().reset(rng)
        x = jax.lax.fori_loop(0, 1_000_000, lambda i, x: jnp.sin(x + 0.1), first.obs[0])
        return first.replace(obs=first.obs.at[0].set(x))


class IsAlwaysDone(Point):
    def step(self, state, action):
        return super().step(state, action).replace(done=jnp.ones(()))


class EndsAtOnce(Point):
    """It takes the first step of an episode for its last."""

    def reset(self, rng):
        return super().reset(rng).replace(info={"t": jnp.zeros(())})

    def step(self, state, action):
        info = {"t": state.info["t"] + 1.0}
        return super().step(state, action).replace(done=jnp.float32(info["t"] == 1), info=info)


class IsHalfDone(Point):
    def step(self, state, action):
        return super().step(state, action).replace(done=jnp.full((), 0.5))


class IsDoneByMinusOne(Point):
    def step(self, state, action):
        return super().step(state, action).replace(done=-jnp.ones(()))


class HalfSucceeds(Point):
    def state(self, x, speed, metrics):
        return super().state(x, speed, metrics | {"success": 0.5 * (x > 0)})


class CountsItsSuccesses(Point):
    def state(self, x, speed, metrics):
        state = super().state(x, speed, metrics)
        return state.replace(info={"success": jnp.float32(2.0)})


class SucceedsByNothing(Point):
    def state(self, x, speed, metrics):
        return super().state(x, speed, metrics | {"success": jnp.log(-1.0 - x**2)})


@jax.custom_batching.custom_vmap
def advantage(reward):
    return reward


@advantage.def_vmap
def advantage_of_a_batch(size, is_batched, reward):
    return reward - reward.mean(), True


class ComparesInstances(Point):
    """The reward is what an instance has more than the others."""

    def step(self, state, action):
        after = super().step(state, action)
        return after.replace(reward=advantage(after.reward))


class ResetsTheBatch(Point):
    """All instances begin at the place of the first."""

    def reset(self, rng):
        def same_place(x):
            return np.full_like(x, np.asarray(x).flat[0])

        like = jax.ShapeDtypeStruct((), jnp.float32)
        x = jax.random.uniform(rng)
        x = jax.pure_callback(same_place, like, x, vmap_method="broadcast_all")
        return self.state(x, jnp.zeros(()), {"speed": ZERO})


class CallsOneInPython(Point):
    def step(self, state, action):
        after = super().step(state, action)
        like = jax.ShapeDtypeStruct((), jnp.float32)
        return after.replace(reward=jax.pure_callback(np.sin, like, after.reward))


class ObservesAMatrix(Point):
    def state(self, x, speed, metrics):
        return super().state(x, speed, metrics).replace(obs=jnp.stack([x, speed])[None])


class ObservesImages(Point):
    def state(self, x, speed, metrics):
        image = jnp.zeros((8, 8, 3))
        return super().state(x, speed, metrics).replace(obs={"pixels": image, "x": x})


class ObservesNothing(Point):
    def state(self, x, speed, metrics):
        return super().state(x, speed, metrics).replace(obs=jnp.zeros(0))


class RewardsAVector(Point):
    def state(self, x, speed, metrics):
        return super().state(x, speed, metrics).replace(reward=jnp.stack([x, speed]))


class IsABatch(Point):
    def reset(self, rng):
        return self.state(jax.random.uniform(rng, (16,)), jnp.zeros(16), {"speed": jnp.zeros(16)})


class HasNoActionSize(Point):
    action_size = None


class HasNoReset:
    action_size = 1

    def step(self, state, action):
        return state


class CannotBeBuilt(Point):
    def __init__(self):
        self.table = {}["table"]


class Chooses(Point):
    discrete_actions = True
    action_size = 3


class MeasuresLater(Point):
    def step(self, state, action):
        after = super().step(state, action)
        return after.replace(metrics=after.metrics | {"distance": after.obs[0]})


class HoldsText(Point):
    def reset(self, rng):
        return super().reset(rng).replace(info={"phase": "swing"})


class StepsAsGymnasium(Point):
    def step(self, state, action):
        after = super().step(state, action)
        return after.obs, after.reward, after.done, False, {}


class ResetsAsGymnasium(Point):
    def reset(self, rng):
        return super().reset(rng).obs, {}


class TakesNoKey(Point):
    def reset(self):
        return super().reset(jax.random.PRNGKey(0))


class TakesNoAction(Point):
    def step(self, state):
        return super().step(state, jnp.zeros(1))


class ForgetsToReturn(Point):
    def step(self, state, action):
        super().step(state, action)


class HasNoReward(Point):
    def state(self, x, speed, metrics):
        return types.SimpleNamespace(obs=jnp.stack([x, speed]), done=ZERO)


def returns_nothing():
    """A function that forgets to return an environment."""


NOT_CALLABLE = Point()


class OfGymnasium:
    """Stands for an environment of Gymnasium's, which need not be installed."""

    __module__ = "gymnasium.envs.classic_control.pendulum"

    def reset(self, *, seed=None, options=None):
        return np.zeros(3, np.float32), {}

    def step(self, action):
        return np.zeros(3, np.float32), 0.0, False, False, {}


class IsRarelyNotFinite(Point):
    """Its reward has no end in the one step of a thousand that is its instance's 64th."""

    def reset(self, rng):
        first = super().reset(rng)
        inside = first.pipeline_state | {"t": jnp.zeros((), jnp.int32), "odds": rng[1] % 4}
        return first.replace(pipeline_state=inside)

    def step(self, state, action):
        after = super().step(state, action)
        inside = state.pipeline_state
        t, odds = inside["t"] + 1, inside["odds"]
        lost = (t == 64) & (odds == 0)
        return after.replace(
            pipeline_state=after.pipeline_state | {"t": t, "odds": odds},
            reward=jnp.where(lost, jnp.inf, after.reward),
        )


class Sorts(Point):
    """What one kernel cannot do is no mistake."""

    def step(self, state, action):
        after = super().step(state, action)
        return after.replace(reward=after.reward + jnp.linalg.eigh(jnp.diag(after.obs))[0][0])


class NeverEnds(Point):
    """The time limit is the trainer's."""

    def step(self, state, action):
        return super().step(state, action).replace(done=ZERO)


class Sound(Point):
    """Nothing is wrong with this one."""
