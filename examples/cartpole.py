"""Cart-pole swing-up as one kernel: swing a pole up by pushing its cart, and balance it.

    jetbot-mjx train cartpole

The model is in this file. An episode is a success if the pole is within 12° of upright at every
step of its second half.
"""

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Float, UInt32

from jetbot_mjx import State
from onekernel.mujoco import MjxState, fuse_mjx

MJCF = """
<mujoco model="cartpole">
  <option timestep="0.01" iterations="20" ls_iterations="4" tolerance="1e-6"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <light pos="0 -2 4" dir="0 0.4 -1"/>
    <geom type="capsule" fromto="-2 0 0 2 0 0" size="0.02" rgba="0.6 0.6 0.6 1"/>
    <body name="cart">
      <joint name="slide" type="slide" axis="1 0 0" range="-1.8 1.8" limited="true"/>
      <geom type="box" size="0.2 0.15 0.1" mass="1" rgba="0.2 0.4 0.7 1"/>
      <body name="pole">
        <joint name="hinge" type="hinge" axis="0 1 0" damping="1e-4"/>
        <geom type="capsule" fromto="0 0 0 0 0 1" size="0.045" mass="0.1" rgba="0.9 0.5 0.1 1"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor joint="slide" gear="10" ctrlrange="-1 1" ctrllimited="true"/></actuator>
</mujoco>
"""
UPRIGHT = jnp.cos(jnp.deg2rad(12))


class Cartpole:
    """A cart on a rail of 3.6 m with a pole of 1 m that hangs down when an episode begins."""

    action_size = 1

    def __init__(self, duration: float = 10.0) -> None:
        """Load the model.

        Args:
          duration: length of an episode [s], `task.episode_length` steps of 40 ms.
        """
        self.mj_model = mujoco.MjModel.from_xml_string(MJCF)
        self.dt = 4 * self.mj_model.opt.timestep
        self.duration = duration
        self._step = fuse_mjx(self.mj_model, n_substeps=4)

    def reset(self, rng: UInt32[Array, "2"]) -> State:
        """Let the pole hang within 0.5 rad, anywhere near the middle, with some velocity."""
        noise = jax.random.uniform(rng, (2, 2), minval=-1.0) * 0.5
        physics = self._step.init(noise[0] + jnp.array([0.0, jnp.pi]), noise[1])
        zero = jnp.zeros(())
        metrics = {"upright": zero, "success": zero}
        return State(physics, observe(physics), zero, zero, metrics, {"fallen_at": zero})

    def step(self, state: State, action: Float[Array, "1"]) -> State:
        """Push the cart by 10 N · action for 40 ms."""
        physics = self._step(state.pipeline_state, action)
        x, cosine = physics.qpos[0], jnp.cos(physics.qpos[1])
        upright = cosine > UPRIGHT
        fallen_at = jnp.where(upright, state.info["fallen_at"], physics.time)
        # Times are sums of float32: compare them within half a step.
        is_over = physics.time > self.duration - self.dt / 2
        success = is_over & (fallen_at < self.duration / 2 + self.dt / 2)
        metrics = {"upright": jnp.float32(upright), "success": jnp.float32(success)}
        reward = 0.5 * (1 + cosine) * (1 - 0.1 * x**2) / (1 + 0.05 * physics.qvel[1] ** 2)
        return state.replace(
            pipeline_state=physics,
            obs=observe(physics),
            reward=reward - 0.01 * action[0] ** 2,
            metrics=state.metrics | metrics,
            info=state.info | {"fallen_at": fallen_at},
        )


def observe(physics: MjxState) -> Float[Array, "5"]:
    """Return the cart's position, the pole's sine and cosine, and both velocities."""
    x, angle = physics.qpos
    return jnp.stack([x, jnp.sin(angle), jnp.cos(angle), *physics.qvel])
