"""Randomize the robot: give it fixed robot parameters, or draw them anew in every episode.

The drawn parameters and the states of actuators and sensors are data in `State.episode_params`:
`NewEpisodeWrapper` replaces them where a new episode begins, and checkpoints store them. `step`
makes the physics model from them, so one compiled program serves all robots.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs import Wrapper
from jaxtyping import Array, Float, UInt32

from jetbot_mjx.config import RandomizationConfig
from jetbot_mjx.envs import kinematics
from jetbot_mjx.envs.actuators import ActuatorState, initial_actuator_state, step_actuators
from jetbot_mjx.envs.jetbot_env import JetBotEnv
from jetbot_mjx.envs.robot_model import CONTROLLER_WHEEL_RADIUS, QPOS_QUAT, QPOS_XYZ
from jetbot_mjx.envs.robot_params import (
    MAX_ACTION_DELAY,
    MAX_OBSERVATION_DELAY,
    RobotParams,
    vary_model,
)
from jetbot_mjx.envs.sensors import SensorState, add_offsets, initial_sensor_state, step_sensors
from jetbot_mjx.envs.state import PhysicsState, State, robot_state

_INTEGERS = ("action_delay", "observation_delay")
"""Parameters in control steps: every integer of the range is equally likely."""

_MODEL = ("friction", "mass", "com_x", "com_y", "com_z")
_START = ("start_x", "start_y", "start_yaw")
# Separates these draws from those of task, controllers and later episodes with the same key.
_KEY_SALT = 0x76617279
_UNLIMITED = 1e6  # [rad/s]


class EpisodeParams(NamedTuple):
    """An `EpisodeParams` holds the robot parameters and model states of one episode."""

    drawn: Float[Array, " quantities"]
    """The drawn robot parameters, in the order of `RandomizationConfig.drawn`."""
    motors: ActuatorState
    """State of the actuator model."""
    sensors: SensorState
    """State of the sensor model."""


def draw(ranges: RandomizationConfig, key: UInt32[Array, "2"]) -> Float[Array, " quantities"]:
    """Draw robot parameters, each one uniformly from its range.

    Args:
      ranges: the range of every parameter that is drawn.
      key: a random key.

    Returns:
      The parameters, in the order of `ranges.drawn`.
    """
    spans = ranges.drawn
    low, high = np.asarray(list(spans.values()), np.float32).reshape(-1, 2).T
    is_integer = np.asarray([name in _INTEGERS for name in spans], bool)
    u = jax.random.uniform(key, (len(spans),))
    real = jnp.minimum(low + (high - low) * u, high)
    integer = jnp.minimum(jnp.floor(low + (high - low + 1.0) * u), high)
    return jnp.where(is_integer, integer, real)


class DomainRandomizationWrapper(Wrapper):
    """A wrapper that varies the robot: its physics model, actuators, sensors and start pose.

    Like the environment inside, it sees one robot without a batch axis. It observes numbers only:
    `with_camera` renders outside of it. A step is: wheel speed targets of the action, actuator
    model, physics with the varied model, sensor model, observation.
    """

    env: JetBotEnv

    def __init__(
        self,
        env: JetBotEnv,
        robot_params: RobotParams | None = None,
        ranges: RandomizationConfig | None = None,
    ) -> None:
        """Wrap one environment.

        Args:
          env: the environment, unbatched, with the model of its preset.
          robot_params: parameters of the robot in every episode, which may be traced; None: those
            of the preset.
          ranges: ranges of the parameters that are drawn anew in every episode, which replace
            those of `robot_params`; None: no parameter is drawn.
        """
        super().__init__(env.blind())
        self.camera = env.camera
        self._constant = robot_params or RobotParams()
        self._ranges = ranges or RandomizationConfig()
        self._max_action_delay = self._max_delay("action_delay", MAX_ACTION_DELAY)
        self._max_observation_delay = self._max_delay("observation_delay", MAX_OBSERVATION_DELAY)
        limit = env.robot.max_wheel_speed
        self._limit = math.inf if limit is None else limit
        self._full_speed = limit or env.config.task.max_speed / CONTROLLER_WHEEL_RADIUS

    def _max_delay(self, name: str, traced: int) -> int:
        """Return the longest delay that the program must support [control steps].

        Args:
          name: the robot parameter.
          traced: the limit if the delay is a traced value.
        """
        if name in self._ranges.drawn:
            return round(self._ranges.drawn[name][1])
        value = getattr(self._constant, name)
        return round(value) if isinstance(value, int | float) else traced

    def robot_params(self, state: State) -> RobotParams:
        """Return the robot parameters of this episode.

        Args:
          state: a state of this environment.
        """
        return self._robot_params(state.episode_params.drawn)

    def _robot_params(self, drawn: Float[Array, " quantities"]) -> RobotParams:
        return self._constant._replace(**dict(zip(self._ranges.drawn, drawn, strict=True)))

    def reset(self, rng: UInt32[Array, "2"]) -> State:
        """Begin an episode with newly drawn robot parameters; the goal is that of `env.reset`.

        Args:
          rng: a random key.
        """
        state = self.env.reset(rng)
        drawn = draw(self._ranges, jax.random.fold_in(rng, _KEY_SALT))
        robot_params = self._robot_params(drawn)
        physics = _at_start_pose(state.pipeline_state, robot_params)
        robot = robot_state(physics)
        noise_key = jax.random.fold_in(rng, _KEY_SALT + 1)
        sensors = initial_sensor_state(robot, noise_key, robot_params, self._max_observation_delay)
        motors = initial_actuator_state(robot_params, self._max_action_delay)
        return state.replace(
            pipeline_state=physics,
            obs=self.env.observe(add_offsets(robot, robot_params), state.goal),
            episode_params=EpisodeParams(drawn, motors, sensors),
        )

    def step(self, state: State, action: Float[Array, "2"]) -> State:
        """Make one environment step through actuator model, physics and sensor model.

        Args:
          state: a state of this environment.
          action: the action, in [-1, 1]².
        """
        drawn, motors, sensors = state.episode_params
        robot_params = self._robot_params(drawn)
        # The limit is electronic: it applies before the motor lag.
        command = jnp.clip(self.env.wheel_targets(action), -self._limit, self._limit)
        motors, ctrl = step_actuators(
            motors, command, robot_params, full_speed=self._full_speed, ctrl_dt=self.env.dt
        )
        state = self._env_of(robot_params).step_with_ctrl(state, action, ctrl)
        robot = robot_state(state.pipeline_state)
        count = jnp.round(state.pipeline_state.time / self.env.dt).astype(jnp.int32)
        sensors, measured = step_sensors(sensors, robot, robot_params, count)
        return state.replace(
            obs=self.env.observe(measured, state.goal),
            episode_params=EpisodeParams(drawn, motors, sensors),
        )

    def _env_of(self, robot_params: RobotParams) -> JetBotEnv:
        """Return the environment with the physics model of a varied robot."""
        model = self.env.mjx_model
        if self.env.robot.max_wheel_speed is not None:
            # `step` has limited the command already; gain and wheels may exceed the preset's limit.
            open_range = np.full(model.actuator_ctrlrange.shape, (-_UNLIMITED, _UNLIMITED))
            model = model.replace(actuator_ctrlrange=open_range.astype(np.float32))
        if robot_params.differs(*_MODEL):
            model = vary_model(model, self.env.mj_model, robot_params)
        return self.env if model is self.env.mjx_model else self.env.with_model(model)


def _at_start_pose(physics: PhysicsState, robot_params: RobotParams) -> PhysicsState:
    """Return the physics state with the robot moved to its start pose."""
    if not robot_params.differs(*_START):
        return physics
    x, y, yaw = (jnp.asarray(getattr(robot_params, name)) for name in _START)
    place = physics.qpos[QPOS_XYZ] + jnp.stack([x, y, jnp.zeros(())])
    attitude = kinematics.turned(physics.qpos[QPOS_QUAT], yaw)
    return physics.replace(qpos=physics.qpos.at[QPOS_XYZ].set(place).at[QPOS_QUAT].set(attitude))


def maybe_randomize(env: JetBotEnv) -> JetBotEnv | DomainRandomizationWrapper:
    """Apply the `randomization` section of an environment's configuration.

    Args:
      env: one environment, unwrapped.

    Returns:
      The wrapped environment, or `env` itself if the configuration randomizes nothing.
    """
    ranges = env.config.randomization
    return DomainRandomizationWrapper(env, ranges=ranges) if ranges.drawn else env
