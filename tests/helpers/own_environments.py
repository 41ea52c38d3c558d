"""Small environments of one's own in plain JAX, one of each kind that the package takes."""

import types
from typing import NamedTuple

import jax
import jax.numpy as jnp

from jetbot_mjx import State

ZERO = jnp.zeros(())


class Point:
    """A point on a line that an action pushes; it ends 4 m away."""

    action_size = 1

    def __init__(self, start=0.0):
        self.start = start

    def reset(self, rng):
        x = self.start + jax.random.uniform(rng, minval=-0.1, maxval=0.1)
        return self.state(x, jnp.zeros(()), {"speed": ZERO})

    def step(self, state, action):
        inside = state.pipeline_state
        speed = inside["speed"] + 0.1 * action[0]
        return self.state(inside["x"] + 0.1 * speed, speed, {"speed": speed})

    def state(self, x, speed, metrics):
        inside = {"x": x, "speed": speed, "twice": 2.0 * x}
        done = jnp.float32(jnp.abs(x) > 4.0)
        return State(inside, jnp.stack([x, speed]), 1.0 - x**2, done, metrics)


class Walk:
    """A random walk whose random key is in `info`, of the kind that `typed` asks for."""

    action_size = 1

    def __init__(self, typed):
        self.typed = typed

    def reset(self, rng):
        key = jax.random.wrap_key_data(rng) if self.typed else rng
        return State(ZERO, jnp.zeros(1), ZERO, ZERO, {}, {"key": key})

    def step(self, state, action):
        key, now = jax.random.split(state.info["key"])
        x = state.pipeline_state + jax.random.normal(now)
        return state.replace(pipeline_state=x, obs=x[None], info={"key": key})


class Told:
    """An environment that says in `info` and `metrics` whatever a test has it say of step t."""

    action_size = 1

    def __init__(self, info=None, metrics=None, done=()):
        self.info, self.metrics, self.ends = info or {}, metrics or {}, done

    def reset(self, rng):
        return self.state(jnp.int32(0))

    def step(self, state, action):
        return self.state(state.pipeline_state + 1)

    def state(self, t):
        def at(steps):
            return jnp.any(t == jnp.array([*steps, -1])).astype(jnp.float32)

        told = [{name: at(steps) for name, steps in x.items()} for x in (self.metrics, self.info)]
        return State(t, jnp.float32(t)[None], ZERO, at(self.ends), *told)


class Named:
    """An environment whose observation has names, one of which only a simulator knows."""

    action_size = 2

    def reset(self, rng):
        return self.state(jnp.zeros(2))

    def step(self, state, action):
        return self.state(state.pipeline_state + action)

    def state(self, x):
        obs = {"velocity": 2.0 * x, "height": x[0], "privileged_state": jnp.full(7, 3.0)}
        return State(x, obs, ZERO, ZERO)


class Params(NamedTuple):
    """The parameters of a `Gymlike`."""

    gain: float = 1.0
    max_steps_in_episode: int = 3

    def replace(self, **changes):
        return self._replace(**changes)


class Gymlike:
    """An environment in the form of Gymnax's: parameters, a key in every step, and spaces."""

    default_params = Params()

    def __init__(self, choices=0):
        self.choices = choices

    def action_space(self, params):
        if self.choices:
            return types.SimpleNamespace(n=self.choices)
        return types.SimpleNamespace(low=-2.0, high=jnp.array([4.0, 2.0]), shape=(2,))

    def reset_env(self, key, params):
        state = {"x": jax.random.uniform(key), "t": 0, "action": jnp.zeros(self.shape)}
        return self.observe(state), state

    def step_env(self, key, state, action, params):
        x, t = state["x"] + params.gain * jax.random.normal(key), state["t"] + 1
        state = {"x": x, "t": t, "action": jnp.asarray(action, jnp.float32)}
        done = (t >= params.max_steps_in_episode) | (x > 100.0)
        return self.observe(state), state, x, done, {}

    @property
    def shape(self):
        return () if self.choices else (2,)

    def observe(self, state):
        return jnp.append(state["action"].ravel(), state["x"])


def gymlike(choices=0, gain=1.0):
    """An environment with its parameters, as `gymnax.make` returns them."""
    return Gymlike(choices), Params(gain)
