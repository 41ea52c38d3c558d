"""Gymnasium's Reacher-v5 as one kernel: bring the tip of an arm to a target.

    jetbot-mjx train reacher

Model, integrator (RK4 of 10 ms), 2 physics steps in a step, observation, reward and start are
Gymnasium's, and no episode is terminated. Three things differ. Numbers are float32. The solver,
which keeps joints within their limits, makes at most 20 iterations, with 4 of its line search in
each, and stops where one improves less than 1e-6; Gymnasium's makes at most 100 and 50, and stops
at 1e-8, which float32 cannot reach. The place of the fingertip is that of the state after the step;
Gymnasium's is that of the integrator's last stage, up to 4 mm away where the arm moves fast.
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

TERMS = ("reward/dist", "reward/ctrl")


class Reacher:
    """An arm of two links in a plane, with a motor in each joint."""

    def __init__(self, reward_dist_weight: float = 1.0, reward_control_weight: float = 1.0) -> None:
        """Load the model; the arguments are those of `gymnasium.make("Reacher-v5")`."""
        self.mj_model = load_model()
        self.action_size = self.mj_model.nu
        self.dt = 2 * self.mj_model.opt.timestep
        self._step = fuse_mjx(self.mj_model, n_substeps=2)
        self._weights = jnp.array([-reward_dist_weight, -reward_control_weight])

    def reset(self, rng: UInt32[Array, "2"]) -> State:
        """Stretch the arm, with a little noise, and draw a target from a disk of 0.2 m."""
        arm_key, radius_key, angle_key = jax.random.split(rng, 3)
        noise = jax.random.uniform(arm_key, (2, 2), minval=-1.0)
        radius = 0.2 * jnp.sqrt(jax.random.uniform(radius_key))
        angle = jax.random.uniform(angle_key, maxval=2 * jnp.pi)
        target = radius * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
        qpos = jnp.concatenate([0.1 * noise[0], target])
        physics = self._step.init(qpos, jnp.concatenate([0.005 * noise[1], jnp.zeros(2)]))
        zero = jnp.zeros(())
        return State(physics, observe(physics), zero, zero, dict.fromkeys(TERMS, zero))

    def step(self, state: State, action: Float[Array, "2"]) -> State:
        """Apply torques of 200 N·m · action for 20 ms."""
        physics = self._step(state.pipeline_state, action)
        distance = jnp.linalg.norm(to_fingertip(physics))
        terms = self._weights * jnp.stack([distance, jnp.sum(action**2)])
        return state.replace(
            pipeline_state=physics,
            obs=observe(physics),
            reward=jnp.sum(terms),
            metrics=state.metrics | dict(zip(TERMS, terms, strict=True)),
        )


def to_fingertip(physics: MjxState) -> Float[Array, "2"]:
    """Return the vector from the target to the fingertip [m]: links of 0.1 m and 0.11 m."""
    first, both = physics.qpos[0], physics.qpos[0] + physics.qpos[1]
    direction = jnp.stack([jnp.cos(jnp.stack([first, both])), jnp.sin(jnp.stack([first, both]))])
    return direction @ jnp.array([0.1, 0.11]) - physics.qpos[2:]


def observe(physics: MjxState) -> Float[Array, "10"]:
    """Return the joints' cosines and sines, the target, their velocities, and target to tip."""
    angles = physics.qpos[:2]
    parts = jnp.cos(angles), jnp.sin(angles), physics.qpos[2:], physics.qvel[:2]
    return jnp.concatenate([*parts, to_fingertip(physics)])


def load_model() -> mujoco.MjModel:
    """Return Gymnasium's model, with a solver for float32."""
    found = importlib.util.find_spec("gymnasium")
    if found is None or found.origin is None:
        raise MissingPackageError("reacher.py uses a model of gymnasium: pip install gymnasium")
    path = Path(found.origin).parent / "envs/mujoco/assets/reacher.xml"
    model = mujoco.MjModel.from_xml_path(str(path))
    model.opt.iterations, model.opt.ls_iterations, model.opt.tolerance = 20, 4, 1e-6
    return model
