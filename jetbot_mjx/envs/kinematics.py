"""Compute planar differential-drive kinematics and frame changes, as pure functions of one robot.

No batch axis: batch with `jax.vmap`. SI units. Frames: `_w` world, `_b` body
(x forward, y left, z up). Angles are counter-clockwise positive. Quaternions are
MuJoCo's (w, x, y, z).
"""

import jax.numpy as jnp
from jaxtyping import Array, Float


def twist_from_action(
    action: Float[Array, "2"], *, max_speed: float, max_yaw_rate: float
) -> Float[Array, "2"]:
    """Return the body twist that the tutorial's action commands.

        v = (a₀ + 1)/2 · v_max        ω = a₁ · ω_max

    The robot cannot reverse: a₀ = -1 means standstill, and a₀ = 0 is half speed.

    Args:
      action: (a₀, a₁), each in [-1, 1]; values outside are clipped.
      max_speed: v_max [m/s].
      max_yaw_rate: ω_max [rad/s].

    Returns:
      (v, ω), forward speed [m/s] and yaw rate [rad/s].

    Source: Isaac Sim 2022.x documentation, section 9.9, `JetBotEnv.step`.
    """
    drive, turn = jnp.clip(action, -1.0, 1.0)
    return jnp.stack([0.5 * (drive + 1.0) * max_speed, turn * max_yaw_rate])


def action_from_twist(
    twist_b: Float[Array, "2"], *, max_speed: float, max_yaw_rate: float
) -> Float[Array, "2"]:
    """Return the action that commands a body twist: the inverse of `twist_from_action`, clipped.

    Args:
      twist_b: (v, ω), forward speed [m/s] and yaw rate [rad/s].
      max_speed: v_max [m/s].
      max_yaw_rate: ω_max [rad/s].

    Returns:
      The action in [-1, 1]².
    """
    v, yaw_rate = twist_b
    action = jnp.stack([2.0 * v / max_speed - 1.0, yaw_rate / max_yaw_rate])
    return jnp.clip(action, -1.0, 1.0)


def wheel_speeds(
    twist_b: Float[Array, "2"], *, wheel_radius: float, wheel_separation: float
) -> Float[Array, "2"]:
    """Return the wheel speeds with which a differential drive follows a body twist.

        ω_L = (v - ω b/2) / r        ω_R = (v + ω b/2) / r

    The wheels roll without slip; actuator limits are not applied.

    Args:
      twist_b: (v, ω), forward speed [m/s] and yaw rate [rad/s].
      wheel_radius: r [m].
      wheel_separation: b, distance between the two wheels' contact points [m].

    Returns:
      (ω_L, ω_R), left and right wheel speeds [rad/s].

    Source: Isaac Sim `DifferentialController` (it calls b `wheel_base`).
    """
    v, yaw_rate = twist_b
    turn = 0.5 * yaw_rate * wheel_separation
    return jnp.stack([v - turn, v + turn]) / wheel_radius


def rotate(quat: Float[Array, "4"], vector: Float[Array, "3"]) -> Float[Array, "3"]:
    """Rotate a vector by a unit quaternion: body frame to world frame.

    Args:
      quat: the attitude (w, x, y, z) of the body in the world frame.
      vector: the vector in the body frame.

    Returns:
      The same vector in the world frame.
    """
    w, axis = quat[0], quat[1:]
    # Two cross products instead of a matrix: element-wise operations never use TF32.
    t = 2.0 * jnp.cross(axis, vector)
    return vector + w * t + jnp.cross(axis, t)


def yaw(quat: Float[Array, "4"]) -> Float[Array, ""]:
    """Return the heading of a body: the angle of its x axis about the world's z axis.

    Args:
      quat: the attitude (w, x, y, z) of the body in the world frame.

    Returns:
      Yaw in (-π, π] [rad].
    """
    w, x, y, z = quat
    return jnp.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def turned(quat: Float[Array, "4"], angle: Float[Array, ""]) -> Float[Array, "4"]:
    """Return the attitude of a body rotated about the world's z axis.

        q' = (cos α/2, 0, 0, sin α/2) ⊗ q

    Args:
      quat: the attitude (w, x, y, z) of the body in the world frame.
      angle: α, counter-clockwise [rad].

    Returns:
      The attitude after the rotation, (w, x, y, z).
    """
    c, s = jnp.cos(0.5 * angle), jnp.sin(0.5 * angle)
    w, x, y, z = quat
    return jnp.stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w])


def pitched(quat: Float[Array, "4"], angle: Float[Array, ""]) -> Float[Array, "4"]:
    """Return the attitude of a body rotated about its own y axis.

        q' = q ⊗ (cos α/2, 0, sin α/2, 0)

    Args:
      quat: the attitude (w, x, y, z) of the body in the world frame.
      angle: α [rad]; positive lowers the nose.

    Returns:
      The attitude after the rotation, (w, x, y, z).
    """
    c, s = jnp.cos(0.5 * angle), jnp.sin(0.5 * angle)
    w, x, y, z = quat
    return jnp.stack([c * w - s * y, c * x - s * z, c * y + s * w, c * z + s * x])


def to_body(heading: Float[Array, ""], vector_w: Float[Array, "2"]) -> Float[Array, "2"]:
    """Rotate a horizontal vector from the world frame into the body frame.

    Args:
      heading: the yaw of the body [rad].
      vector_w: the vector (x, y) in the world frame.

    Returns:
      (forward, left) in the body frame.
    """
    cos, sin = jnp.cos(heading), jnp.sin(heading)
    x, y = vector_w
    return jnp.stack([cos * x + sin * y, cos * y - sin * x])
