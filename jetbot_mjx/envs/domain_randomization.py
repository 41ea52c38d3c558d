"""Randomize the robot and what it sees: fixed parameters, or drawn in every episode.

The drawn parameters and the states of actuators, sensors and camera are data in
`State.episode_params`: `NewEpisodeWrapper` replaces them where a new episode begins, and
checkpoints store them. `step` makes the physics model from them, so one compiled program serves
all robots.
"""

import math
from typing import NamedTuple, TypeVar, overload

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt32

from jetbot_mjx.config import (
    QUANTITIES,
    LookParams,
    MjcfRobotConfig,
    RandomizationConfig,
    RobotParams,
)
from jetbot_mjx.envs import kinematics
from jetbot_mjx.envs.actuators import ActuatorState, initial_actuator_state, step_actuators
from jetbot_mjx.envs.adapted_env import AdaptedEnv
from jetbot_mjx.envs.camera.scene import GOAL
from jetbot_mjx.envs.camera.surroundings import draw_surroundings
from jetbot_mjx.envs.camera.timing import CameraState, initial_camera_state, step_camera
from jetbot_mjx.envs.camera.wrapper import seen_pose
from jetbot_mjx.envs.drive import OwnDrive
from jetbot_mjx.envs.jetbot_env import JetBotEnv
from jetbot_mjx.envs.robot_model import QPOS_QUAT, QPOS_XYZ
from jetbot_mjx.envs.robot_params import vary_model, vary_own_model
from jetbot_mjx.envs.sensors import SensorState, add_offsets, initial_sensor_state, step_sensors
from jetbot_mjx.envs.state import PhysicsState, State, robot_state
from jetbot_mjx.errors import InvalidError
from jetbot_mjx.mjx_import import Wrapper

LARGEST_TRACED = {"action_delay": 9, "observation_delay": 6, "camera_delay": 9, "clutter": 4}
"""Largest values of the quantities for which a program reserves memory, if they are traced: delays
[control steps], 150 and 100 ms at the default `ctrl_dt`, and objects around."""

_Params = TypeVar("_Params", RobotParams, LookParams)

_MODEL = ("friction", "mass", "com_x", "com_y", "com_z")
_START = ("start_x", "start_y", "start_yaw")
# Separates these draws from those of task, controllers and later episodes with the same key.
_KEY_SALT = 0x76617279
_UNLIMITED = 1e6  # [rad/s]


class EpisodeParams(NamedTuple):
    """An `EpisodeParams` holds the robot parameters and model states of one episode."""

    drawn: Float[Array, " quantities"]
    """The drawn robot and look parameters, in the order of `RandomizationConfig.drawn`."""
    motors: ActuatorState
    """State of the actuator model."""
    sensors: SensorState
    """State of the sensor model."""
    camera: CameraState | None
    """Looks of the episode and poses of its last steps; None: the camera sees the plain scene."""


def draw(ranges: RandomizationConfig, key: UInt32[Array, "2"]) -> Float[Array, " quantities"]:
    """Draw robot and look parameters, each one uniformly from its range.

    Args:
      ranges: the range of every parameter that is drawn.
      key: a random key.

    Returns:
      The parameters, in the order of `ranges.drawn`.
    """
    spans = ranges.drawn
    low, high = np.asarray(list(spans.values()), np.float32).reshape(-1, 2).T
    is_integer = np.asarray([QUANTITIES[name].bounds.whole for name in spans], bool)
    u = jax.random.uniform(key, (len(spans),))
    real = jnp.minimum(low + (high - low) * u, high)
    integer = jnp.minimum(jnp.floor(low + (high - low + 1.0) * u), high)
    return jnp.where(is_integer, integer, real)


class DomainRandomizationWrapper(Wrapper):
    """A wrapper that varies the robot: its model, actuators, sensors, start pose, and what it sees.

    Like the environment inside, it sees one robot without a batch axis. It observes numbers only:
    `with_camera` renders outside of it, with the looks that the state holds. A step is: wheel speed
    targets of the action, actuator model, physics with the varied model, sensor model, observation.
    """

    env: JetBotEnv

    def __init__(
        self,
        env: JetBotEnv,
        robot_params: RobotParams | None = None,
        ranges: RandomizationConfig | None = None,
        look_params: LookParams | None = None,
    ) -> None:
        """Wrap one environment.

        Args:
          env: the environment, unbatched, with the model of its preset.
          robot_params: parameters of the robot in every episode, which may be traced; None: those
            of the preset.
          ranges: ranges of the parameters that are drawn in every episode, which replace
            those of `robot_params` and `look_params`; None: no parameter is drawn.
          look_params: look parameters in every episode, which may be traced; None: the plain scene.

        Raises:
          UserError: looks differ, and the environment has no camera.
        """
        super().__init__(env.blind())
        self.camera = env.camera
        # A car has no motors on two sides: what differs in them is left out.
        kept = {name: getattr(robot_params or RobotParams(), name) for name in env.robot.quantities}
        self._constant = RobotParams()._replace(**kept)
        self._constant_looks = look_params or LookParams()
        self._ranges = ranges or RandomizationConfig()
        looks = self._ranges.looks
        looks += [name for name in LookParams._fields if self._constant_looks.differs(name)]
        if looks and self.camera is None:
            raise InvalidError(
                f"randomization.{looks[0]} changes an image, and a policy with task.observation ="
                f" {env.config.task.observation!r} sees none: leave it out"
            )
        self._sees_looks = bool(looks)
        self._largest = {name: self._largest_value(name) for name in LARGEST_TRACED}
        limit = env.robot.max_wheel_speed
        self._limit = math.inf if limit is None else limit
        self._full_speed = math.inf
        if not isinstance(env.drive, OwnDrive):
            self._full_speed = limit or env.drive.max_speed / env.drive.wheel_radius

    def _largest_value(self, name: str) -> int:
        """Return the largest value of a whole number that the program must support."""
        if name in self._ranges.drawn:
            return round(self._ranges.drawn[name][1])
        value = (self._constant._asdict() | self._constant_looks._asdict())[name]
        return round(value) if isinstance(value, int | float) else LARGEST_TRACED[name]

    def robot_params(self, state: State) -> RobotParams:
        """Return the robot parameters of this episode.

        Args:
          state: a state of this environment.
        """
        return self._with_drawn(self._constant, state.episode_params.drawn)

    def _with_drawn(self, params: _Params, drawn: Float[Array, " quantities"]) -> _Params:
        """Return parameters of one kind, of which those that are drawn replace the others."""
        named = zip(self._ranges.drawn, drawn, strict=True)
        return params._replace(**{name: x for name, x in named if name in params._fields})

    def _begin_camera(
        self, state: State, drawn: Float[Array, " quantities"], rng: UInt32[Array, "2"]
    ) -> CameraState | None:
        """Return the state of the camera at the start of an episode."""
        if not self._sees_looks:
            return None
        assert self.camera is not None
        params = self._with_drawn(self._constant_looks, drawn)
        key, image_key = jax.random.split(jax.random.fold_in(rng, _KEY_SALT + 2))
        start = seen_pose(self.env.task, state)
        surroundings = draw_surroundings(
            key, params, self._largest["clutter"], self.camera.scene, start.markers.get(GOAL)
        )
        longest = self._largest["camera_delay"]
        return initial_camera_state(start, image_key, params, surroundings, longest)

    def reset(self, rng: UInt32[Array, "2"]) -> State:
        """Begin an episode with newly drawn robot parameters; the goal is that of `env.reset`.

        Args:
          rng: a random key.
        """
        state = self.env.reset(rng)
        drawn = draw(self._ranges, jax.random.fold_in(rng, _KEY_SALT))
        robot_params = self._with_drawn(self._constant, drawn)
        physics = _at_start_pose(state.pipeline_state, robot_params)
        robot = robot_state(physics)
        noise_key = jax.random.fold_in(rng, _KEY_SALT + 1)
        longest = self._largest["observation_delay"]
        sensors = initial_sensor_state(robot, noise_key, robot_params, longest)
        size = self.env.action_size
        motors = initial_actuator_state(robot_params, self._largest["action_delay"], size)
        state = state.replace(
            pipeline_state=physics,
            obs=self.env.observe(add_offsets(robot, robot_params), state.goal),
        )
        camera = self._begin_camera(state, drawn, rng)
        return state.replace(episode_params=EpisodeParams(drawn, motors, sensors, camera))

    def step(self, state: State, action: Float[Array, " action"]) -> State:
        """Make one environment step through actuator model, physics and sensor model.

        Args:
          state: a state of this environment.
          action: the action, in [-1, 1]².
        """
        drawn, motors, sensors, camera = state.episode_params
        robot_params = self._with_drawn(self._constant, drawn)
        # The limit is electronic: it applies before the motor lag.
        command = jnp.clip(self.env.wheel_targets(action), -self._limit, self._limit)
        motors, command = step_actuators(
            motors, command, robot_params, full_speed=self._full_speed, ctrl_dt=self.env.dt
        )
        state = self._env_of(robot_params).step_with_ctrl(
            state, action, self.env.drive.controls(command)
        )
        robot = robot_state(state.pipeline_state)
        count = jnp.round(state.pipeline_state.time / self.env.dt).astype(jnp.int32)
        sensors, measured = step_sensors(sensors, robot, robot_params, count)
        if camera is not None:
            camera = step_camera(camera, seen_pose(self.env.task, state), count)
        return state.replace(
            obs=self.env.observe(measured, state.goal),
            episode_params=EpisodeParams(drawn, motors, sensors, camera),
        )

    def _env_of(self, robot_params: RobotParams) -> JetBotEnv:
        """Return the environment with the physics model of a varied robot."""
        model = self.env.mjx_model
        if self.env.robot.max_wheel_speed is not None:
            # `step` has limited the command already; gain and wheels may exceed the preset's limit.
            open_range = np.full(model.actuator_ctrlrange.shape, (-_UNLIMITED, _UNLIMITED))
            model = model.replace(actuator_ctrlrange=open_range.astype(np.float32))
        if robot_params.differs(*_MODEL):
            if isinstance(self.env.robot, MjcfRobotConfig):
                model = vary_own_model(model, robot_params)
            else:
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


@overload
def maybe_randomize(env: JetBotEnv) -> JetBotEnv | DomainRandomizationWrapper: ...
@overload
def maybe_randomize(
    env: JetBotEnv | AdaptedEnv,
) -> JetBotEnv | AdaptedEnv | DomainRandomizationWrapper: ...
def maybe_randomize(
    env: JetBotEnv | AdaptedEnv,
) -> JetBotEnv | AdaptedEnv | DomainRandomizationWrapper:
    """Apply the `randomization` section of an environment's configuration.

    Args:
      env: one environment, unwrapped.

    Returns:
      The wrapped environment, or `env` itself if the configuration randomizes nothing.
    """
    ranges = env.config.randomization
    # Only a robot has anything to draw: the configuration refuses ranges for other environments.
    if isinstance(env, AdaptedEnv) or not ranges.drawn:
        return env
    return DomainRandomizationWrapper(env, ranges=ranges)
