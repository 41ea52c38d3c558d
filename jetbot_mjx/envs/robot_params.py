"""Robots that differ from their preset, and the physics model of each.

A `RobotParams` is data, not structure: one compiled program serves every value, traced or not,
and `jax.vmap` gives each robot its own. Floor and masses enter physics through the model; wheels,
motors and what the robot sees of itself stand before and behind it, in `motors` and `sensors`.
"""

from typing import NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float

from jetbot_mjx.envs import mjx

MAX_ACTION_DELAY = 9
"""Longest `action_delay` [control steps] of a robot whose delay is not known when its program is
compiled: 150 ms at the default `ctrl_dt`."""

MAX_OBSERVATION_DELAY = 6
"""Longest `observation_delay` likewise: 100 ms."""

_CHASSIS = "jetbot"
_SIDES = ("left", "right")

Quantity = Float[ArrayLike, ""]


class RobotParams(NamedTuple):
    """Differences of one robot from its preset. `RobotParams()` does not differ at all.

    What is left at its default costs nothing: no program contains it.
    """

    friction: Quantity = 1.0
    """Factor on the Coulomb coefficient of wheel on floor."""
    mass: Quantity = 1.0
    """Factor on mass and inertia of the chassis; the wheels keep theirs."""
    com_x: Quantity = 0.0
    """Shift of the chassis's centre of mass [m], body frame: forward."""
    com_y: Quantity = 0.0
    """To the left."""
    com_z: Quantity = 0.0
    """Up."""
    wheel_radius: Quantity = 1.0
    """Factor on the radius of both wheels."""
    wheel_radius_mismatch: Quantity = 0.0
    """(left - right) / mean radius."""
    wheel_separation: Quantity = 1.0
    """Factor on the distance between the wheels."""
    motor_gain: Quantity = 1.0
    """Factor on the wheel speeds that the motors make of a command, and on their limit."""
    motor_gain_mismatch: Quantity = 0.0
    """(left - right) / mean gain."""
    supply_voltage: Quantity = 1.0
    """Factor on the voltage at the motors, and so on their speed. A low one also widens the
    dead-band."""
    dead_band: Quantity = 0.0
    """Fraction of full voltage below which a wheel stands still."""
    motor_lag: Quantity = 0.0
    """Time constant of a first-order lag [s], ahead of the motors' own run-up."""
    action_delay: Quantity = 0.0
    """From command to motor [control steps], rounded; until the first command arrives the motors
    hold the robot still."""
    position_noise: Quantity = 0.0
    """Deviation of the position (x, y) that the robot takes itself to be at [m]."""
    yaw_noise: Quantity = 0.0
    """Of its heading [rad]."""
    speed_noise: Quantity = 0.0
    """Of its velocity (x, y) [m/s]."""
    yaw_rate_noise: Quantity = 0.0
    """Of its yaw rate [rad/s]."""
    observation_delay: Quantity = 0.0
    """By how much the robot sees itself late [control steps], rounded; the goal it knows."""
    height_offset: Quantity = 0.0
    """By how much higher than it is the robot takes itself to be [m], in the whole episode."""
    pitch_offset: Quantity = 0.0
    """Likewise by how much its nose is lower [rad]."""
    start_x: Quantity = 0.0
    """Where the episode starts [m], world frame: forward of the origin."""
    start_y: Quantity = 0.0
    """To the left."""
    start_yaw: Quantity = 0.0
    """Heading at the start [rad], counter-clockwise."""

    def differs(self, *names: str) -> bool:
        """Return whether any of some quantities may differ from the preset's; a traced one may."""
        presets = type(self)._field_defaults
        values = {name: getattr(self, name) for name in names}
        return any(
            not (isinstance(value, int | float) and value == presets[name])
            for name, value in values.items()
        )


def vary_model(model: mjx.Model, mj_model: mujoco.MjModel, robot_params: RobotParams) -> mjx.Model:
    """Return the physics model of a varied robot, as MuJoCo would compile it.

    Args:
      model: the preset's.
      mj_model: the same robot for C, with or without what only shows.
      robot_params: its friction, mass and centre of mass.

    Returns:
      A model of the same structure. The constants that MuJoCo derives from the masses when it
      compiles, and its contacts read, follow exactly; those that no part of this robot reads
      stay as they were.
    """
    changed = {}
    if robot_params.differs("friction"):
        wheels = np.zeros(mj_model.npair, bool)
        wheels[[mj_model.pair(f"{side}_wheel").id for side in _SIDES]] = True
        # Tangential only: torsion and rolling take no part in a contact of three dimensions.
        tangential = wheels[:, None] & (np.arange(5) < 2)
        factor = jnp.where(tangential, robot_params.friction, 1.0)
        changed["pair_friction"] = model.pair_friction * factor
    chassis = np.arange(model.nbody) == mj_model.body(_CHASSIS).id
    if robot_params.differs("mass"):
        mass = jnp.where(chassis, robot_params.mass, 1.0)
        changed["body_mass"] = model.body_mass * mass
        changed["body_inertia"] = model.body_inertia * mass[:, None]
    if robot_params.differs("com_x", "com_y", "com_z"):
        shift = jnp.where(chassis[:, None], _com_shift(robot_params), 0.0)
        changed["body_ipos"] = model.body_ipos + shift
    if robot_params.differs("mass", "com_x", "com_y", "com_z"):
        changed["body_invweight0"] = _invweights(model, mj_model, robot_params)
    return model.replace(**changed)


def _com_shift(robot_params: RobotParams) -> Float[Array, "3"]:
    return jnp.stack(
        [jnp.asarray(x) for x in (robot_params.com_x, robot_params.com_y, robot_params.com_z)]
    )


def _invweights(
    model: mjx.Model, mj_model: mujoco.MjModel, robot_params: RobotParams
) -> Float[Array, "bodies 2"]:
    """`body_invweight0`, the softness of contacts, which follows chassis mass and centre of mass.

    MuJoCo takes it from the diagonal of J M⁻¹ Jᵀ in the initial pose, averaged over the three
    translations and the three rotations of each body. A wheel is as heavy however it is turned,
    and of its spin s the rest of the robot feels only what the rotor's a lets through,
    s a / (s + a). So all is one rigid body of mass m, centre c and inertia J about it, and with
    A = J⁻¹, d = p - c, e = a / (s + a):

        a point p     1/m + (|d|² tr A - dᵀ A d) / 3
        the chassis   tr A / 3
        a wheel       (A_xx + A_zz + 1/(s + a) + e² A_yy) / 3
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
    # Where it is the preset's robot, to the bit.
    return jnp.where(_is_preset(robot_params, shift), model.body_invweight0, varied)


def _is_preset(robot_params: RobotParams, shift: Float[Array, "3"]) -> Bool[Array, ""]:
    return (jnp.asarray(robot_params.mass) == 1.0) & (shift == 0.0).all()


def _inverse(a: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Decompose a symmetric matrix without a call of LAPACK or cuSOLVER."""
    rows = [jnp.cross(a[1], a[2]), jnp.cross(a[2], a[0]), jnp.cross(a[0], a[1])]
    return jnp.stack(rows, axis=1) / (a[0] * rows[0]).sum()
