"""The sensor model: delays of whole steps and noise of the configured size."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import motion
from jetbot_mjx.config import RobotParams
from jetbot_mjx.envs import kinematics
from jetbot_mjx.envs.sensors import initial_sensor_state, step_sensors
from jetbot_mjx.envs.task import RobotState

KEY = jax.random.PRNGKey(0)
SAMPLES = 2_000


def robot(x=0.0, heading=0.0):
    quat = jnp.array([jnp.cos(heading / 2), 0.0, 0.0, jnp.sin(heading / 2)])
    return RobotState(jnp.array([x, 0.0, 0.03]), quat, jnp.zeros(3), jnp.zeros(3))


def test_a_delayed_observation_is_the_earlier_state():
    robot_params = RobotParams(observation_delay=jnp.float32(2.0))
    sensors = initial_sensor_state(robot(), KEY, robot_params, 4)
    seen = []
    for step in range(5):
        sensors, now = step_sensors(
            sensors, robot(1.0 + step, 0.1 * step), robot_params, jnp.int32(step)
        )
        seen.append((float(now.position_w[0]), float(kinematics.yaw(now.quat))))
    expected = [(0.0, 0.0), (0.0, 0.0), (1.0, 0.0), (2.0, 0.1), (3.0, 0.2)]
    np.testing.assert_allclose(seen, expected, atol=1e-6)


@pytest.fixture(scope="module")
def seen():
    """One robot that stands, as it sees itself over many steps, at noise of four sizes."""
    robot_params = RobotParams(
        position_noise=jnp.float32(0.02),
        yaw_noise=jnp.float32(0.03),
        speed_noise=jnp.float32(0.01),
        yaw_rate_noise=jnp.float32(0.04),
    )
    one = functools.partial(step_sensors, initial_sensor_state(robot(), KEY, robot_params, 0))
    _, found = jax.jit(jax.vmap(lambda step: one(robot(heading=0.5), robot_params, step)))(
        jnp.arange(SAMPLES)
    )
    return found


def test_noise_has_the_deviation_asked_for_and_no_mean(seen):
    yaw = np.asarray(jax.vmap(kinematics.yaw)(seen.quat)) - 0.5
    columns = [
        (np.asarray(seen.position_w)[:, 0], 0.02),
        (np.asarray(seen.position_w)[:, 1], 0.02),
        (yaw, 0.03),
        (np.asarray(seen.linear_velocity_w)[:, 0], 0.01),
        (np.asarray(seen.linear_velocity_w)[:, 1], 0.01),
        (np.asarray(seen.angular_velocity_w)[:, 2], 0.04),
    ]
    for values, deviation in columns:
        assert values.std() == pytest.approx(deviation, rel=0.1)
        assert abs(values.mean()) < 4 * deviation / np.sqrt(SAMPLES)
    together = np.corrcoef([values for values, _ in columns]) - np.eye(6)
    assert np.abs(together).max() < 0.1


def test_noise_leaves_height_and_level_and_is_new_at_every_step(seen):
    np.testing.assert_array_equal(np.asarray(seen.position_w)[:, 2], np.float32(0.03))
    np.testing.assert_array_equal(np.asarray(seen.angular_velocity_w)[:, :2], 0.0)
    assert np.abs(np.asarray(jax.vmap(motion.tilt)(seen.quat))).max() < 1e-3
    assert len(np.unique(np.asarray(seen.position_w)[:, 0])) > 0.99 * SAMPLES


def test_offsets_raise_the_robot_and_lower_its_nose_whatever_its_delay_and_heading():
    robot_params = RobotParams(observation_delay=1, height_offset=0.003, pitch_offset=0.02)
    sensors = initial_sensor_state(robot(), KEY, robot_params, 1)
    sensors, _ = step_sensors(sensors, robot(1.0, 0.7), robot_params, jnp.int32(0))
    _, now = step_sensors(sensors, robot(2.0, 0.9), robot_params, jnp.int32(1))
    # Height and pitch differ, and nothing else; the delayed state has them once.
    np.testing.assert_allclose(now.position_w, (1.0, 0.0, 0.033), atol=1e-7)
    ahead = kinematics.rotate(now.quat, jnp.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(ahead[2], -np.sin(0.02), atol=1e-6)
    assert float(kinematics.yaw(now.quat)) == pytest.approx(0.7, abs=1e-6)
    assert float(motion.tilt(now.quat)) == pytest.approx(0.02, abs=1e-6)


def test_an_exact_robot_sees_every_bit_and_remembers_nothing():
    sensors = initial_sensor_state(robot(), KEY, RobotParams(), 0)
    assert sensors == (None, None)
    _, now = step_sensors(sensors, robot(1.5, 0.7), RobotParams(), jnp.int32(3))
    jax.tree.map(np.testing.assert_array_equal, now, robot(1.5, 0.7))
