"""Make the physics model of a robot that differs from its preset.

One compiled program serves all values of a traced parameter, and `jax.vmap` gives each robot its
own. Friction and masses enter the physics model here; wheels and motors enter in `actuators`, and
measurement errors in `sensors`.
"""

import jax.numpy as jnp
import mujoco
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from jetbot_mjx.config import RobotParams
from jetbot_mjx.envs import mjx

_CHASSIS = "jetbot"
_SIDES = ("left", "right")
_COM = ("com_x", "com_y", "com_z")


def vary_model(model: mjx.Model, mj_model: mujoco.MjModel, robot_params: RobotParams) -> mjx.Model:
    """Return the physics model of a varied robot, equal to one that MuJoCo compiles.

    Args:
      model: the MJX model of the preset.
      mj_model: the C model of the preset, with or without visual elements.
      robot_params: the robot parameters; friction, mass and centre of mass are used.

    Returns:
      A model of the same structure. Constants that MuJoCo derives from the masses are updated if
      the contacts of this robot use them; the others stay those of the preset.
    """
    changed = {}
    # Friction of the wheels.
    if robot_params.differs("friction"):
        wheels = np.zeros(mj_model.npair, bool)
        wheels[[mj_model.pair(f"{side}_wheel").id for side in _SIDES]] = True
        # Tangential friction only: a contact with condim 3 has no torsional or rolling friction.
        tangential = wheels[:, None] & (np.arange(5) < 2)
        factor = jnp.where(tangential, robot_params.friction, 1.0)
        changed["pair_friction"] = model.pair_friction * factor
    changed |= _chassis(model, robot_params)
    if robot_params.differs("mass", *_COM):
        changed["body_invweight0"] = _invweights(model, mj_model, robot_params)
    return model.replace(**changed)


def vary_own_model(model: mjx.Model, robot_params: RobotParams) -> mjx.Model:
    """Return the model of a varied robot that is a model of its own.

    Its friction is that of all geoms, of which the larger counts in a contact. Constants that
    MuJoCo derives from the masses stay those of the model.

    Args:
      model: the robot's MJX model.
      robot_params: the robot parameters; friction, mass and centre of mass are used.
    """
    changed = {}
    if robot_params.differs("friction"):
        for name in ("geom_friction", "pair_friction"):
            values = getattr(model, name)
            sliding = np.arange(values.shape[1]) < (1 if name == "geom_friction" else 2)
            changed[name] = values * jnp.where(sliding, robot_params.friction, 1.0)
    return model.replace(**changed, **_chassis(model, robot_params))


def _chassis(model: mjx.Model, robot_params: RobotParams) -> dict[str, Array]:
    """Return the arrays of a model with another mass and centre of mass of the robot's body."""
    changed = {}
    body = np.arange(model.nbody) == model.jnt_bodyid[0]
    if robot_params.differs("mass"):
        mass = jnp.where(body, robot_params.mass, 1.0)
        changed["body_mass"] = model.body_mass * mass
        changed["body_inertia"] = model.body_inertia * mass[:, None]
    if robot_params.differs(*_COM):
        shift = jnp.where(body[:, None], _com_shift(robot_params), 0.0)
        changed["body_ipos"] = model.body_ipos + shift
    return changed


def _com_shift(robot_params: RobotParams) -> Float[Array, "3"]:
    return jnp.stack([jnp.asarray(getattr(robot_params, name)) for name in _COM])


def _invweights(
    model: mjx.Model, mj_model: mujoco.MjModel, robot_params: RobotParams
) -> Float[Array, "bodies 2"]:
    """Return `body_invweight0`, which sets the softness of contacts, for a varied chassis.

    MuJoCo computes it from the diagonal of J M⁻¹ Jᵀ in the initial pose, averaged over the three
    translations and over the three rotations of each body. The inertia of a wheel does not depend
    on its angle. Of a wheel's spin inertia s the rest of the robot feels s a / (s + a), where a is
    the rotor inertia. Hence the robot acts like one rigid body of mass m, centre of mass c and
    inertia J about c. With A = J⁻¹, d = p - c and e = a / (s + a):

        translation of a body at p   1/m + (|d|² tr A - dᵀ A d) / 3
        rotation of the chassis      tr A / 3
        rotation of a wheel          (A_xx + A_zz + 1/(s + a) + e² A_yy) / 3

    Args:
      model: the MJX model of the preset.
      mj_model: the C model of the preset.
      robot_params: the robot parameters; mass and centre of mass are used.
    """
    bodies = [mj_model.body(name).id for name in (_CHASSIS, "left_wheel", "right_wheel")]
    chassis, *wheels = bodies
    masses, inertias = mj_model.body_mass, mj_model.body_inertia
    rotor = mj_model.dof_armature[mj_model.joint("left_wheel_joint").dofadr[0]]
    spin = inertias[wheels[0], 1]
    felt = inertias[wheels[0]].copy()
    felt[1] = spin * rotor / (spin + rotor)

    def weights(
        mass: Float[ArrayLike, ""], shift: Float[ArrayLike, "3"]
    ) -> Float[Array, "bodies 2"]:
        parts = [
            (
                mass * masses[chassis],
                mj_model.body_ipos[chassis] + jnp.asarray(shift),
                mass * inertias[chassis],
            ),
            *((masses[wheel], mj_model.body_pos[wheel], felt) for wheel in wheels),
        ]
        total = sum(part for part, _, _ in parts)
        centre = sum(part * place for part, place, _ in parts) / total
        arms = jnp.stack([place - centre for _, place, _ in parts])
        about = jnp.zeros((3, 3))
        for (part, _, moments), arm in zip(parts, arms, strict=True):
            about += jnp.diag(jnp.asarray(moments))
            about += part * (arm @ arm * jnp.eye(3) - jnp.outer(arm, arm))
        loose = _inverse(about)
        trace = jnp.trace(loose)
        swing = (arms**2).sum(axis=1) * trace - (arms * (arms @ loose)).sum(axis=1)
        through = rotor / (spin + rotor)
        wheel = trace + (through**2 - 1.0) * loose[1, 1] + 1.0 / (spin + rotor)
        rotation = jnp.stack([trace, wheel, wheel]) / 3.0
        return jnp.stack([1.0 / total + swing / 3.0, rotation], axis=1)

    shift = _com_shift(robot_params)
    varied = model.body_invweight0.at[np.asarray(bodies)].set(weights(robot_params.mass, shift))
    # Bit-identical to the preset where mass and centre of mass are those of the preset.
    is_preset = (jnp.asarray(robot_params.mass) == 1.0) & (shift == 0.0).all()
    return jnp.where(is_preset, model.body_invweight0, varied)


def _inverse(a: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Invert a symmetric matrix by cross products, without a call of LAPACK or cuSOLVER."""
    rows = [jnp.cross(a[1], a[2]), jnp.cross(a[2], a[0]), jnp.cross(a[0], a[1])]
    return jnp.stack(rows, axis=1) / (a[0] * rows[0]).sum()
