"""The physics of one joint with limits, which is traced in a fraction of the robot's time."""

import jax.numpy as jnp
import mujoco

from jetbot_mjx.config import parse_config
from jetbot_mjx.envs.physics import Physics
from jetbot_mjx.envs.state import PhysicsState

SLIDER = """
<mujoco>
  <worldbody>
    <body>
      <joint name="slider" type="slide" axis="1 0 0" range="-0.5 0.5" limited="true"/>
      <geom size="0.1"/>
    </body>
  </worldbody>
  <actuator><motor joint="slider"/></actuator>
</mujoco>
"""


def small_physics(**settings):
    """Return the physics of a slider, and its first state.

    Args:
      settings: of the configuration's section `physics`.
    """
    config = parse_config({"physics": settings})
    physics = Physics(mujoco.MjModel.from_xml_string(SLIDER), config.physics)
    return physics, PhysicsState(jnp.zeros(1), jnp.zeros(1), jnp.zeros(1), time=jnp.zeros(()))
