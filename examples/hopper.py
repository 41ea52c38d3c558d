"""Gymnasium's Hopper-v5 as one kernel: hop forward on one leg.

    jetbot-mjx train hopper

Model, integrator (RK4 of 2 ms), 4 physics steps in a step, observation, reward, termination and
start are Gymnasium's. Two things differ. Numbers are float32. The contact solver makes at most 20
iterations, with 4 of its line search in each, and stops where one improves less than 1e-6;
Gymnasium's makes at most 100 and 50, and stops at 1e-8, which float32 cannot reach.
"""

import importlib.util
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Bool, Float, UInt32

from jetbot_mjx import State
from jetbot_mjx.errors import MissingPackageError
from onekernel.mujoco import MjxState, fuse_mjx

TERMS = ("reward/forward", "reward/survive", "reward/ctrl")


class Hopper:
    """A hopper with three motors; the policy observes all of its state but x."""

    def __init__(
        self,
        forward_reward_weight: float = 1.0,
        healthy_reward: float = 1.0,
        ctrl_cost_weight: float = 1e-3,
        reset_noise_scale: float = 5e-3,
    ) -> None:
        """Load the model; the arguments are those of `gymnasium.make("Hopper-v5")`."""
        self.mj_model = load_model()
        self.action_size = self.mj_model.nu
        self.dt = 4 * self.mj_model.opt.timestep
        self._step = fuse_mjx(self.mj_model, n_substeps=4)
        self._weights = jnp.array([forward_reward_weight, healthy_reward, -ctrl_cost_weight])
        self._noise = reset_noise_scale

    def reset(self, rng: UInt32[Array, "2"]) -> State:
        """Stand upright, with a little noise in every position and velocity."""
        noise = self._noise * jax.random.uniform(rng, (2, self.mj_model.nq), minval=-1.0)
        physics = self._step.init(self.mj_model.qpos0 + noise[0], noise[1])
        zero = jnp.zeros(())
        return State(physics, observe(physics), zero, zero, dict.fromkeys(TERMS, zero))

    def step(self, state: State, action: Float[Array, "3"]) -> State:
        """Apply torques of 200 N·m · action for 8 ms."""
        physics = self._step(state.pipeline_state, action)
        velocity = (physics.qpos[0] - state.pipeline_state.qpos[0]) / self.dt
        healthy = is_healthy(physics).astype(jnp.float32)
        terms = self._weights * jnp.stack([velocity, healthy, jnp.sum(action**2)])
        return state.replace(
            pipeline_state=physics,
            obs=observe(physics),
            reward=jnp.sum(terms),
            done=1.0 - healthy,
            metrics=state.metrics | dict(zip(TERMS, terms, strict=True)),
        )


def observe(physics: MjxState) -> Float[Array, "11"]:
    """Return all positions but x, and all velocities, which are clipped to ±10."""
    return jnp.concatenate([physics.qpos[1:], jnp.clip(physics.qvel, -10, 10)])


def is_healthy(physics: MjxState) -> Bool[Array, ""]:
    """Return whether the hopper stands, within 0.2 rad of upright."""
    height, angle = physics.qpos[1], physics.qpos[2]
    rest = jnp.concatenate([physics.qpos[2:], physics.qvel])
    return (height > 0.7) & (jnp.abs(angle) < 0.2) & jnp.all(jnp.abs(rest) < 100)


def load_model() -> mujoco.MjModel:
    """Return Gymnasium's model, with a solver for float32."""
    found = importlib.util.find_spec("gymnasium")
    if found is None or found.origin is None:
        raise MissingPackageError("hopper.py uses a model of gymnasium: pip install gymnasium")
    path = Path(found.origin).parent / "envs/mujoco/assets/hopper.xml"
    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.iterations, model.opt.ls_iterations, model.opt.tolerance = 20, 4, 1e-6
    return model
