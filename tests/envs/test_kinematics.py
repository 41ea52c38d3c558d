"""Frames, angles and wheel speeds of a differential drive."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from helpers import motion
from jetbot_mjx.envs import kinematics

CONTROLLER = {"wheel_radius": 0.0325, "wheel_separation": 0.1125}


@pytest.mark.parametrize(
    ("twist", "expected"),
    [
        ((0.3, 1.0), (8.125, 11.875)),  # Isaac Sim's own test of its DifferentialController
        ((0.3, 0.0), (10.0, 10.0)),  # 0.3 / 0.03, both wheels alike
        ((0.0, 1.0), (-1.875, 1.875)),  # ±0.05625 / 0.03: the left wheel turns back
    ],
)
def test_wheel_speeds_match_published_numbers(twist, expected):
    got = kinematics.wheel_speeds(jnp.array(twist), wheel_radius=0.03, wheel_separation=0.1125)
    np.testing.assert_allclose(got, expected, rtol=1e-6)


@pytest.mark.parametrize(
    ("action", "expected"),
    [
        ((-1.0, 0.0), (0.0, 0.0)),
        ((0.0, 0.0), (0.5, 0.0)),  # the tutorial's zero action drives at half speed
        ((1.0, 1.0), (1.0, math.pi)),
        ((3.0, -7.0), (1.0, -math.pi)),  # clipped
    ],
)
def test_actions_map_to_the_tutorials_twist(action, expected):
    got = kinematics.twist_from_action(jnp.array(action), max_speed=1.0, max_yaw_rate=math.pi)
    np.testing.assert_allclose(got, expected, rtol=1e-6)


def test_the_fastest_wheel_turns_at_36_rad_per_second():
    twist = kinematics.twist_from_action(jnp.ones(2), max_speed=1.0, max_yaw_rate=math.pi)
    # (2·1 + π·0.1125) / 0.065 = 36.2066
    np.testing.assert_allclose(kinematics.wheel_speeds(twist, **CONTROLLER)[1], 36.2066, rtol=1e-5)


def test_inverses():
    twist = jnp.array([0.3, -1.2])
    wheels = kinematics.wheel_speeds(twist, **CONTROLLER)
    np.testing.assert_allclose(motion.body_twist(wheels, **CONTROLLER), twist, rtol=1e-5)
    limits = {"max_speed": 1.0, "max_yaw_rate": math.pi}
    action = kinematics.action_from_twist(twist, **limits)
    np.testing.assert_allclose(kinematics.twist_from_action(action, **limits), twist, rtol=1e-5)


def test_rotations_match_scipy():
    rotations = Rotation.random(64, random_state=0)
    quats = jnp.asarray(rotations.as_quat(scalar_first=True), jnp.float32)
    vectors = jax.random.normal(jax.random.PRNGKey(0), (64, 3))
    got = jax.vmap(kinematics.rotate)(quats, vectors)
    np.testing.assert_allclose(got, rotations.apply(vectors), atol=1e-5)
    x_axis, z_axis = rotations.apply([1, 0, 0]), rotations.apply([0, 0, 1])
    np.testing.assert_allclose(
        jax.vmap(kinematics.yaw)(quats), np.arctan2(x_axis[:, 1], x_axis[:, 0]), atol=1e-5
    )
    np.testing.assert_allclose(jax.vmap(motion.tilt)(quats), np.arccos(z_axis[:, 2]), atol=2e-3)


def test_pitching_turns_a_body_about_its_own_y_axis():
    rotations = Rotation.random(64, random_state=1)
    angles = np.linspace(-1.0, 1.0, 64)
    expected = rotations * Rotation.from_euler("y", angles[:, None])
    quats = jnp.asarray(rotations.as_quat(scalar_first=True), jnp.float32)
    got = jax.vmap(kinematics.pitched)(quats, jnp.asarray(angles, jnp.float32))
    apart = Rotation.from_quat(got, scalar_first=True) * expected.inv()
    assert apart.magnitude().max() < 1e-6


def test_yaw_ignores_the_sign_of_the_quaternion():
    quat = jnp.array([math.cos(0.4), 0.0, 0.0, math.sin(0.4)])
    np.testing.assert_allclose(kinematics.yaw(quat), 0.8, rtol=1e-6)
    np.testing.assert_allclose(kinematics.yaw(-quat), 0.8, rtol=1e-6)


def test_a_goal_to_the_north_is_left_of_a_robot_heading_east():
    got = kinematics.to_body(jnp.float32(0.0), jnp.array([0.0, 1.0]))
    np.testing.assert_allclose(got, (0.0, 1.0), atol=1e-7)
    got = kinematics.to_body(jnp.float32(math.pi / 2), jnp.array([0.0, 1.0]))
    np.testing.assert_allclose(got, (1.0, 0.0), atol=1e-7)
