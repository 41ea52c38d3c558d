"""What tests ask of a robot's motion: how it moves while its wheels roll, and how far it tilts."""

import jax.numpy as jnp


def body_twist(wheel_speeds, *, wheel_radius, wheel_separation):
    """Return the body twist of a differential drive that rolls without slip.

        v = r (ω_L + ω_R) / 2        ω = r (ω_R - ω_L) / b

    Args:
      wheel_speeds: (ω_L, ω_R) [rad/s].
      wheel_radius: r [m].
      wheel_separation: b, distance between the two wheels' contact points [m].

    Returns:
      (v, ω), forward speed [m/s] and yaw rate [rad/s].
    """
    left, right = wheel_speeds
    return wheel_radius * jnp.stack([0.5 * (left + right), (right - left) / wheel_separation])


def tilt(quat):
    """Return the angle between the z axes of a body and of the world.

    Args:
      quat: the attitude (w, x, y, z) of the body in the world frame.

    Returns:
      Tilt in [0, π] [rad]; π is upside down.
    """
    _, x, y, _ = quat
    return 2.0 * jnp.arcsin(jnp.clip(jnp.hypot(x, y), 0.0, 1.0))
