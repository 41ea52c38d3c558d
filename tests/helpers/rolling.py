"""The inverse of `kinematics.wheel_speeds`: how a robot moves whose wheels roll."""

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
