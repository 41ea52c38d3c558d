"""Environments of one's own, as small as can be, and what stands in for libraries of others."""

from types import SimpleNamespace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from jetbot_mjx import State
from jetbot_mjx.config import parse_config
from jetbot_mjx.envs.adapted_env import AdaptedEnv

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


class Measured(Point):
    """The same point, with metrics of names that a report must escape or the trainer uses too."""

    def state(self, x, speed, metrics):
        more = {"<steps>": ZERO + 1.0, "length": ZERO + 7.0, "broken": ZERO * jnp.inf}
        return super().state(x, speed, metrics | more)


@struct.dataclass
class OwnState:
    """A state that is not this package's."""

    place: jax.Array
    unread: jax.Array
    obs: object
    reward: jax.Array
    done: jax.Array
    metrics: dict
    info: dict


class NoisyPoint:
    """A point on a line, which its action moves, and noise; it has a time limit of its own."""

    action_size = 2

    def __init__(self, old_keys=False, limit=6, edge=1.0):
        self.old_keys, self.limit, self.edge = old_keys, limit, edge

    def reset(self, rng):
        if not self.old_keys:
            rng = jax.random.wrap_key_data(rng, impl="threefry2x32")
        key, own = jax.random.split(rng)
        place = 0.5 * jax.random.uniform(own, (2,), minval=-1.0)
        zero = jnp.zeros(())
        info = {"key": key, "count": 0, "success": zero, "truncation": zero}
        return OwnState(place, place, self.observe(place), zero, zero, {"distance": zero}, info)

    def step(self, state, action):
        # A key comes back as what it was.
        is_new = jnp.issubdtype(state.info["key"].dtype, jax.dtypes.prng_key)
        assert is_new is not self.old_keys
        key, own = jax.random.split(state.info["key"])
        place = state.place + 0.1 * action + 0.01 * jax.random.normal(own, (2,))
        count = state.info["count"] + 1
        beyond = (jnp.abs(place).max() > self.edge).astype(jnp.float32)
        late = (count >= self.limit) * (1.0 - beyond)
        info = {
            "key": key,
            "count": count,
            "success": (place[0] > 0).astype(jnp.float32),
            "truncation": late,
        }
        distance = jnp.linalg.norm(place)
        return OwnState(
            place,
            place**2,
            self.observe(place),
            -distance,
            jnp.maximum(beyond, late),
            {"distance": distance},
            info,
        )

    def observe(self, place):
        return {"velocity": place[:1], "angle": place[1], "privileged_state": jnp.ones(7)}


class Lever:
    """Two choices, of which one is right; the state is a single number."""

    action_size = 2
    discrete_actions = True

    def reset(self, rng):
        zero = jnp.zeros(())
        return OwnState(zero, zero, zero, zero, zero, {}, {})

    def step(self, state, action):
        return state.replace(place=state.place + 1.0, reward=action[1] - action[0])


def adapted(environment, **settings):
    """The environment of a class in this file, or of the one that is given."""
    kind = "categorical" if getattr(environment, "discrete_actions", False) else "tanh_normal"
    config = {
        "environment": f"{__name__}:{environment.__name__}",
        "ppo": {"network": {"distribution_type": kind}},
        **settings,
    }
    return AdaptedEnv(parse_config(config), environment)


class GymnaxParams(NamedTuple):
    """Parameters of an environment with Gymnax's interface."""

    max_steps_in_episode: int = 5
    edge: float = 9.0

    def replace(self, **changes):
        return self._replace(**changes)


class LineState(NamedTuple):
    place: jax.Array
    time: jax.Array


class Line:
    """An environment with Gymnax's interface: noise on a line, and the action in the observation.

    It counts its time limit among the ends, as Gymnax does.
    """

    default_params = GymnaxParams()

    def __init__(self, discrete):
        low, high = jnp.array([-2.0, 0.0]), jnp.array([2.0, 10.0])
        box = SimpleNamespace(low=low, high=high, shape=(2,))
        self.space = SimpleNamespace(n=3) if discrete else box

    def action_space(self, params):
        return self.space

    def reset_env(self, key, params):
        state = LineState(0.1 * jax.random.normal(key), 0)
        return self.observe(state, jnp.zeros(2)), state

    def step_env(self, key, state, action, params):
        state = LineState(state.place + 0.1 * jax.random.normal(key), state.time + 1)
        done = jnp.abs(state.place) > params.edge
        done |= state.time >= params.max_steps_in_episode
        return self.observe(state, action), state, -jnp.abs(state.place), done, {"discount": 1.0}

    def observe(self, state, action):
        return jnp.append(state.place, jnp.broadcast_to(action, (2,)))
