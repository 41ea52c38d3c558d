"""One robot in C MuJoCo, for who takes one step at a time: that of MJX takes several times as long.

The model is the one that MJX is given. All that is not physics, the draw of the goal, observation,
reward and the end, is the environment's own code, compiled by JAX for the CPU.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree, UInt32

from jetbot_mjx.compiling import on_host
from jetbot_mjx.config import Config
from jetbot_mjx.env import JetBotEnv, make_env
from jetbot_mjx.model import (
    CONTROLLER_WHEEL_RADIUS,
    CONTROLLER_WHEEL_SEPARATION,
    ROBOTS,
    make_mj_model,
)
from jetbot_mjx.state import PhysicsState, robot_state
from jetbot_mjx.task import RobotState


class Step(NamedTuple):
    """What came of one step."""

    obs: Float[np.ndarray, " obs"]
    reward: float
    terminated: bool
    success: bool
    finite: bool
    """Whether all of it is finite; where not, `obs` is the one before and nothing else counts."""


class _Programs(NamedTuple):
    """What robots of one configuration share."""

    env: JetBotEnv
    model: mujoco.MjModel
    begin: Any
    judge: Any


class RobotInC:
    """A robot and its goal."""

    def __init__(self, config: Config) -> None:
        """Builds the model, and compiles what is not physics.

        Args:
          config: robot, task and physics.

        Raises:
          UserError: the task cannot be built.
        """
        self.env, self.model, self._begin, self._judge = _programs(config.model_dump_json())
        self.data = mujoco.MjData(self.model)
        self.goal: PyTree = None
        self._task = config.task
        self._n_substeps = config.physics.n_substeps
        # Views, which stay true while MuJoCo steps.
        self._qpos, self._qvel, self._ctrl = self.data.qpos, self.data.qvel, self.data.ctrl
        self._before = self._pose()
        self._obs = np.zeros(self.env.observation_size, np.float32)

    def reset(
        self, key: UInt32[np.ndarray, "2"]
    ) -> tuple[Float[np.ndarray, " obs"], UInt32[np.ndarray, "2"]]:
        """Begins the episode that `JetBotEnv.reset` draws from a key.

        Args:
          key: of this episode.

        Returns:
          The first observation, and the key of the next episode.
        """
        qpos, qvel, self.goal, obs, next_key = self._begin(key)
        mujoco.mj_resetData(self.model, self.data)
        self._qpos[:], self._qvel[:] = qpos, qvel
        self._before, self._obs = self._pose(), np.array(obs)
        return self._obs.copy(), np.asarray(next_key)

    def step(self, action: Float[np.ndarray, "2"]) -> Step:
        """Holds an action for one environment step.

        Args:
          action: in [-1, 1]²; values outside are clipped.

        Returns:
          What came of it.
        """
        self._ctrl[:] = self.wheel_targets(action)
        mujoco.mj_step(self.model, self.data, self._n_substeps)
        # One array in and one out: every array more costs a third as much as physics.
        given = np.concatenate((self._before, self._qpos, self._qvel, action), dtype=np.float32)
        judged = np.array(self._judge(given, self.goal))
        reward, terminated, success, finite = judged[-4:].tolist()
        if not finite:
            return Step(self._obs.copy(), 0.0, False, False, False)
        self._before, self._obs = given[len(self._before) : -len(action)], judged[:-4]
        return Step(self._obs.copy(), reward, terminated > 0, success > 0, True)

    def wheel_targets(self, action: Float[np.ndarray, "2"]) -> tuple[float, float]:
        """Wheel speeds (left, right) [rad/s] that an action commands, before motor limits.

        `JetBotEnv.wheel_targets` in plain numbers, for a call of JAX would take as long as physics.
        """
        # Comparisons let through what is not a number, as `jnp.clip` does.
        drive, turn = (-1.0 if x < -1.0 else 1.0 if x > 1.0 else x for x in action.tolist())
        speed = 0.5 * (drive + 1.0) * self._task.max_speed
        half = 0.5 * turn * self._task.max_yaw_rate * CONTROLLER_WHEEL_SEPARATION
        return (speed - half) / CONTROLLER_WHEEL_RADIUS, (speed + half) / CONTROLLER_WHEEL_RADIUS

    def _pose(self) -> Float[np.ndarray, " nq+nv"]:
        return np.concatenate((self._qpos, self._qvel), dtype=np.float32)


@functools.lru_cache(maxsize=8)
def _programs(settings: str) -> _Programs:
    """Environment, model and programs of a configuration, given as JSON: it has no hash."""
    config = Config.model_validate_json(settings)
    env = make_env(config)
    model = make_mj_model(
        ROBOTS[config.robot.preset],
        config.physics,
        build_scene=env.task.build_scene,
        visual=False,
    )
    # A world that blows up is ours to tell; MuJoCo would put the robot back without a word.
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    nq, size = model.nq, model.nq + model.nv

    def begin(key: UInt32[Array, "2"]) -> tuple[Any, ...]:
        state = env.reset(key)
        physics = state.pipeline_state
        return physics.qpos, physics.qvel, state.goal, state.obs, state.key

    def robot_of(pose: Float[Array, " n"]) -> RobotState:
        nothing = jnp.zeros(())
        return robot_state(PhysicsState(pose[:nq], pose[nq:], jnp.zeros(model.nv), nothing))

    def judge(given: Float[Array, " n"], goal: PyTree) -> Float[Array, " m"]:
        before, after, action = jnp.split(given, [size, 2 * size])
        robot, moved = robot_of(before), robot_of(after)
        reward, _ = env.task.reward(robot, moved, goal, action)
        obs = env.task.observe(moved, goal)
        flags = (env.task.terminated(moved, goal), env.task.success(moved, goal))
        seen = jnp.concatenate([obs, jnp.stack([reward, *flags])])
        finite: Bool[Array, ""] = jnp.isfinite(jnp.concatenate([seen, given])).all()
        return jnp.append(seen, finite)

    # On a GPU every call would wait for the device.
    with on_host():
        key, given = np.zeros(2, np.uint32), np.zeros(2 * size + env.action_size, np.float32)
        begin_program = jax.jit(begin).lower(key).compile()
        judge_program = jax.jit(judge).lower(given, begin_program(key)[2]).compile()
    return _Programs(env, model, begin_program, judge_program)
