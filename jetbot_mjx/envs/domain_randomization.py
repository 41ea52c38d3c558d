"""A robot that differs from its preset: by given robot parameters, or anew in every episode.

One mechanism for both. What was drawn, and what motors and sensors remember, is data of the
episode, in `State.episode_params`: the wrappers replace all of it where a new episode begins, and
a checkpoint holds it. The physics model is made from it inside `step`.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs import Wrapper
from jaxtyping import Array, Float, Int, UInt32

from jetbot_mjx.config import RandomizationConfig
from jetbot_mjx.envs import kinematics
from jetbot_mjx.envs.actuators import ActuatorState, drive_motors, motors_at_rest
from jetbot_mjx.envs.jetbot_env import JetBotEnv
from jetbot_mjx.envs.robot_model import CONTROLLER_WHEEL_RADIUS, QPOS_QUAT, QPOS_XYZ
from jetbot_mjx.envs.robot_params import (
    MAX_ACTION_DELAY,
    MAX_OBSERVATION_DELAY,
    RobotParams,
    vary_model,
)
from jetbot_mjx.envs.sensors import SensorState, sense, sensors_at_start, with_offsets
from jetbot_mjx.envs.state import PhysicsState, State, robot_state

_WHOLE = ("action_delay", "observation_delay")
"""Counted in control steps: every whole number of the range is equally likely."""

_MODEL = ("friction", "mass", "com_x", "com_y", "com_z")
_START = ("start_x", "start_y", "start_yaw")
# Apart from what the task, controllers and later episodes draw from the same key.
_OWN_DRAWS = 0x76617279
_NO_LIMIT = 1e6  # [rad/s]


class EpisodeParams(NamedTuple):
    """The robot of one episode, where it differs from its preset."""

    drawn: Float[Array, " quantities"]
    """The drawn quantities, in the order of `RandomizationConfig.drawn`."""
    motors: ActuatorState
    sensors: SensorState


def draw(ranges: RandomizationConfig, key: UInt32[Array, "2"]) -> Float[Array, " quantities"]:
    """Draw a robot, each quantity uniformly from its range.

    Args:
      ranges: of what is drawn.
      key: a random key.

    Returns:
      The quantities, in the order of `ranges.drawn`.
    """
    spans = ranges.drawn
    low, high = np.asarray(list(spans.values()), np.float32).reshape(-1, 2).T
    whole = np.asarray([name in _WHOLE for name in spans], bool)
    u = jax.random.uniform(key, (len(spans),))
    anywhere = jnp.minimum(low + (high - low) * u, high)
    counted = jnp.minimum(jnp.floor(low + (high - low + 1.0) * u), high)
    return jnp.where(whole, counted, anywhere)


class DomainRandomizationWrapper(Wrapper):
    """An environment whose robot differs from its preset.

    One robot, like the environment itself; the robot parameters may be traced.
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
          env: unbatched, with its preset's model.
          robot_params: how its robot differs in every episode; None: not at all.
          ranges: what is drawn anew in every episode instead.
        """
        super().__init__(env)
        self._constant = robot_params or RobotParams()
        self._ranges = ranges or RandomizationConfig()
        self._action_delay = self._longest("action_delay", MAX_ACTION_DELAY)
        self._observation_delay = self._longest("observation_delay", MAX_OBSERVATION_DELAY)
        limit = env.robot.max_wheel_speed
        self._limit = math.inf if limit is None else limit
        self._full_speed = limit or env.config.task.max_speed / CONTROLLER_WHEEL_RADIUS

    def _longest(self, name: str, traced: int) -> int:
        """Control steps that a delay may last, as far as is known when the program is compiled."""
        if name in self._ranges.drawn:
            return round(self._ranges.drawn[name][1])
        value = getattr(self._constant, name)
        return round(value) if isinstance(value, int | float) else traced

    def robot_params(self, state: State) -> RobotParams:
        """Return how the robot of this episode differs."""
        return self._robot_params(state.episode_params.drawn)

    def _robot_params(self, drawn: Float[Array, " quantities"]) -> RobotParams:
        return self._constant._replace(**dict(zip(self._ranges.drawn, drawn, strict=True)))

    def reset(self, rng: UInt32[Array, "2"]) -> State:
        """Begin an episode: a robot drawn, no command on its way; the goal as without wrapper."""
        state = self.env.reset(rng)
        drawn = draw(self._ranges, jax.random.fold_in(rng, _OWN_DRAWS))
        robot_params = self._robot_params(drawn)
        physics = _placed(state.pipeline_state, robot_params)
        robot = robot_state(physics)
        noise_key = jax.random.fold_in(rng, _OWN_DRAWS + 1)
        sensors = sensors_at_start(robot, noise_key, robot_params, self._observation_delay)
        motors = motors_at_rest(robot_params, self._action_delay)
        return state.replace(
            pipeline_state=physics,
            obs=self.env.task.observe(with_offsets(robot, robot_params), state.goal),
            episode_params=EpisodeParams(drawn, motors, sensors),
        )

    def step(self, state: State, action: Float[Array, "2"]) -> State:
        """Give a command, drives by those that have arrived, and sees what there is to see."""
        drawn, motors, sensors = state.episode_params
        robot_params = self._robot_params(drawn)
        # Ahead of the lag: an electronic limit, towards which the motors then run up.
        command = jnp.clip(self.env.wheel_targets(action), -self._limit, self._limit)
        motors, ctrl = drive_motors(
            motors, command, robot_params, full_speed=self._full_speed, ctrl_dt=self.env.dt
        )
        state = self._robot(robot_params).step_with_ctrl(state, action, ctrl)
        sensors, seen = sense(
            sensors, robot_state(state.pipeline_state), robot_params, self._step_count(state)
        )
        return state.replace(
            obs=self.env.task.observe(seen, state.goal),
            episode_params=EpisodeParams(drawn, motors, sensors),
        )

    def _robot(self, robot_params: RobotParams) -> JetBotEnv:
        """Return the environment with the physics model of one robot."""
        model = self.env.mjx_model
        if self.env.robot.max_wheel_speed is not None:
            # What comes out of the motors is limited before gain and wheels, not after them.
            open_range = np.full(model.actuator_ctrlrange.shape, (-_NO_LIMIT, _NO_LIMIT))
            model = model.replace(actuator_ctrlrange=open_range.astype(np.float32))
        if robot_params.differs(*_MODEL):
            model = vary_model(model, self.env.mj_model, robot_params)
        return self.env if model is self.env.mjx_model else self.env.with_model(model)

    def _step_count(self, state: State) -> Int[Array, ""]:
        return jnp.round(state.pipeline_state.time / self.env.dt).astype(jnp.int32)


def _placed(physics: PhysicsState, robot_params: RobotParams) -> PhysicsState:
    """Return where the episode starts."""
    if not robot_params.differs(*_START):
        return physics
    x, y, yaw = (jnp.asarray(getattr(robot_params, name)) for name in _START)
    place = physics.qpos[QPOS_XYZ] + jnp.stack([x, y, jnp.zeros(())])
    attitude = kinematics.turned(physics.qpos[QPOS_QUAT], yaw)
    return physics.replace(qpos=physics.qpos.at[QPOS_XYZ].set(place).at[QPOS_QUAT].set(attitude))


def maybe_randomize(env: JetBotEnv) -> JetBotEnv | DomainRandomizationWrapper:
    """Return the environment with what its configuration draws; itself where that is nothing.

    Args:
      env: one environment, unwrapped.

    Returns:
      What a policy of this configuration learns in.
    """
    ranges = env.config.randomization
    return DomainRandomizationWrapper(env, ranges=ranges) if ranges.drawn else env
