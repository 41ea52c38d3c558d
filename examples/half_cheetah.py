"""Gymnasium's HalfCheetah-v5 as one kernel: run forward.

    jetbot-mjx train half_cheetah

Model, integrator (Euler of 10 ms), 5 physics steps in a step, observation, reward and start are
Gymnasium's, and no episode is terminated. Two things differ. Numbers are float32. The contact
solver makes at most 20 iterations, with 4 of its line search in each, and stops where one improves
less than 1e-6; Gymnasium's makes at most 100 and 50, and stops at 1e-8, which float32 cannot reach.
"""

import importlib.util
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Float, UInt32

from jetbot_mjx import State
from jetbot_mjx.errors import MissingPackageError
from onekernel.mujoco import MjxState, fuse_mjx

TERMS = ("reward/forward", "reward/ctrl")


class HalfCheetah:
    """A cheetah in a plane with six motors; the policy observes all of its state but x."""

    def __init__(
        self,
        forward_reward_weight: float = 1.0,
        ctrl_cost_weight: float = 0.1,
        reset_noise_scale: float = 0.1,
    ) -> None:
        """Load the model; the arguments are those of `gymnasium.make("HalfCheetah-v5")`."""
        self.mj_model = load_model()
        self.action_size = self.mj_model.nu
        self.dt = 5 * self.mj_model.opt.timestep
        self._step = fuse_mjx(self.mj_model, n_substeps=5)
        self._weights = jnp.array([forward_reward_weight, -ctrl_cost_weight])
        self._noise = reset_noise_scale

    def reset(self, rng: UInt32[Array, "2"]) -> State:
        """Stand, with noise in every position and velocity."""
        position_key, velocity_key = jax.random.split(rng)
        offset = jax.random.uniform(position_key, (self.mj_model.nq,), minval=-1.0)
        velocity = jax.random.normal(velocity_key, (self.mj_model.nv,))
        qpos = self.mj_model.qpos0 + self._noise * offset
        physics = self._step.init(qpos, self._noise * velocity)
        zero = jnp.zeros(())
        return State(physics, observe(physics), zero, zero, dict.fromkeys(TERMS, zero))

    def step(self, state: State, action: Float[Array, "6"]) -> State:
        """Apply torques of 30 to 120 N·m · action for 50 ms."""
        physics = self._step(state.pipeline_state, action)
        velocity = (physics.qpos[0] - state.pipeline_state.qpos[0]) / self.dt
        terms = self._weights * jnp.stack([velocity, jnp.sum(action**2)])
        return state.replace(
            pipeline_state=physics,
            obs=observe(physics),
            reward=jnp.sum(terms),
            metrics=state.metrics | dict(zip(TERMS, terms, strict=True)),
        )


def observe(physics: MjxState) -> Float[Array, "17"]:
    """Return all positions but x, and all velocities."""
    return jnp.concatenate([physics.qpos[1:], physics.qvel])


def load_model() -> mujoco.MjModel:
    """Return Gymnasium's model, with a solver for float32."""
    found = importlib.util.find_spec("gymnasium")
    if found is None or found.origin is None:
        raise MissingPackageError(
            "half_cheetah.py uses a model of gymnasium: pip install gymnasium"
        )
    path = Path(found.origin).parent / "envs/mujoco/assets/half_cheetah.xml"
    # MuJoCo warns of this attribute; it does what the two lines after it do.
    mjcf = path.read_text("utf-8").replace('settotalmass="14"', "")
    model = mujoco.MjModel.from_xml_string(mjcf)
    mujoco.mj_setTotalmass(model, 14)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    model.opt.iterations, model.opt.ls_iterations, model.opt.tolerance = 20, 4, 1e-6
    return model
