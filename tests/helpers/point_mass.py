"""Small environments of one's own, which train in seconds: a point on a line, pushed to the origin.

`TINY` are the settings of such a training, `config` its configuration.
"""

import jax
import jax.numpy as jnp
import mujoco
from flax import struct

from jetbot_mjx.config import parse_config
from jetbot_mjx.envs.state import State

DT, FAR, NEAR = 0.1, 3.0, 0.2

MJCF = """
<mujoco model="point">
  <worldbody>
    <light pos="0 -2 4"/>
    <geom type="plane" size="5 5 0.1" rgba="0.8 0.8 0.8 1"/>
    <body name="point" pos="0 0 0.2">
      <joint name="slide" type="slide" axis="1 0 0"/>
      <geom type="sphere" size="0.2" mass="1" rgba="0.8 0.2 0.1 1"/>
    </body>
  </worldbody>
</mujoco>
"""


class Moving(struct.PyTreeNode):
    place: jax.Array
    speed: jax.Array


class PointMass:
    """An action pushes the point; the reward is high near the origin, and far away it ends."""

    action_size = 1
    dt = DT

    def __init__(self, strength=1.0, succeeds=False):
        self.strength, self.succeeds = strength, succeeds

    def reset(self, rng):
        place = jax.random.uniform(rng, (1,), minval=-1.0)
        return self.state(self.moving(place, jnp.zeros(1)))

    def step(self, state, action):
        place, speed = self.read(state.pipeline_state)
        speed = 0.9 * speed + DT * self.strength * self.force(action)
        return self.state(self.moving(place + DT * speed, speed))

    def state(self, moving):
        place, speed = self.read(moving)
        near = jnp.float32(jnp.abs(place[0]) < NEAR)
        metrics = {"near": near} | ({"success": near} if self.succeeds else {})
        done = jnp.float32(jnp.abs(place[0]) > FAR)
        return State(moving, jnp.concatenate([place, speed]), 1 - place[0] ** 2, done, metrics, {})

    def moving(self, place, speed):
        return Moving(place, speed)

    def read(self, moving):
        return moving.place, moving.speed

    def force(self, action):
        return action


class Choosing(PointMass):
    """The same, by a choice: push to the left, to the right, or not at all."""

    action_size = 3
    discrete_actions = True
    dt = None

    def force(self, action):
        return jnp.array([-1.0, 1.0, 0.0])[jnp.argmax(action)][None]


class Posed(struct.PyTreeNode):
    qpos: jax.Array
    qvel: jax.Array


class Shown(PointMass):
    """The same, with a model of MuJoCo for pictures."""

    def __init__(self):
        super().__init__()
        self.mj_model = mujoco.MjModel.from_xml_string(MJCF)

    def moving(self, place, speed):
        return Posed(place, speed)

    def read(self, moving):
        return moving.qpos, moving.qvel


TINY = {
    "checkpoint_interval": 1024,
    "task": {"episode_length": 16},
    "ppo": {
        "num_timesteps": 2048,
        "num_envs": 32,
        "unroll_length": 8,
        "batch_size": 16,
        "num_minibatches": 2,
        "num_updates_per_batch": 1,
        "network": {"policy_hidden_layer_sizes": [8], "value_hidden_layer_sizes": [8]},
    },
    "evaluation": {"episodes": 8},
}


def config(name="PointMass", **changed):
    """The configuration of a small training in one of these environments."""
    network = dict(TINY["ppo"]["network"])
    if name == "Choosing":
        network["distribution_type"] = "categorical"
    ppo = {**TINY["ppo"], "network": network}
    return parse_config(
        {**TINY, "ppo": ppo, "environment": f"helpers.point_mass:{name}", **changed}
    )
