"""The environment: one model and one task, wired into a `brax.envs.Env`.

Pure, unbatched and stateless: batch with `jax.vmap`, compile with `jax.jit`. The state holds
only what physics integrates and what the task drew; `mjx.Data` is rebuilt inside `step`.
"""

import copy
from collections.abc import Mapping
from typing import NamedTuple

import brax.envs
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float, UInt32

from jetbot_mjx.config import Config
from jetbot_mjx.envs import kinematics, mjx
from jetbot_mjx.envs.physics import Physics
from jetbot_mjx.envs.robot_model import (
    CONTROLLER_WHEEL_RADIUS,
    CONTROLLER_WHEEL_SEPARATION,
    ROBOTS,
    make_mj_model,
)
from jetbot_mjx.envs.state import PhysicsState, State, robot_state
from jetbot_mjx.envs.task import (
    AdvancesGoal,
    Goal,
    GoalTask,
    RobotState,
    Task,
    layout_size,
    make_task,
    min_std,
)
from jetbot_mjx.errors import UserError


class TaskStep(NamedTuple):
    """A `TaskStep` holds the task's answer to one step of the robot, whoever moved it."""

    obs: Float[Array, " obs"]
    """Observation after the step."""
    reward: Float[Array, ""]
    """Reward of the step."""
    terms: Mapping[str, Float[Array, ""]]
    """Named terms of the reward."""
    terminated: Float[Array, ""]
    """1 where the step ended the episode."""
    success: Float[Array, ""]
    """1 where the task is done."""
    goal: Goal
    """Goal after the step."""


class JetBotEnv(brax.envs.Env):
    """A JetBot and its task.

    Action: two numbers in [-1, 1], clipped; v = (a₀ + 1)/2 · `max_speed` [m/s] and
    ω = a₁ · `max_yaw_rate` [rad/s], turned into wheel speeds by the tutorial's differential
    controller and held for one environment step. Observation: as the task's `layout` says.
    `metrics` holds `reward/<term>` of every step and `success`; `info` holds `terminated`.
    `done` is termination; the time limit belongs to the wrappers.
    """

    def __init__(self, config: Config) -> None:
        """Build the models.

        Args:
          config: robot, task and physics.

        Raises:
          UserError: the task cannot be built.
        """
        self.config = config
        self.task: Task = make_task(config.task)
        self.robot = ROBOTS[config.robot.preset]
        try:
            self.mj_model: mujoco.MjModel = make_mj_model(
                self.robot, config.physics, build_scene=self.task.build_scene
            )
            physics_model = make_mj_model(
                self.robot, config.physics, build_scene=self.task.build_scene, visual=False
            )
            self.physics = Physics(physics_model, config.physics)
            # A scene of its own may be more than MJX can simulate: better said before a run begins.
            # The model of a task that comes with the package is built when something is compiled.
            if type(self.task).build_scene is not GoalTask.build_scene:
                _ = self.physics.model
        except (RuntimeError, ValueError) as error:
            reason = " ".join(str(error).split())
            if isinstance(error, NotImplementedError):
                reason = f"MJX does not support {reason}"
            raise UserError(
                f"task.name = {config.task.name!r}: its scene cannot be simulated: {reason}"
                f" (python -m jetbot_mjx.check_env {config.task.name} says more)"
            ) from None

    @property
    def mjx_model(self) -> mjx.Model:
        """Return the model that is stepped."""
        return self.physics.model

    def with_model(self, mjx_model: mjx.Model) -> "JetBotEnv":
        """Return this environment on another physics model, as a new object.

        Args:
          mjx_model: a model of the same structure, such as one with other friction.

        Returns:
          A copy; `self` stays as it is.
        """
        return self.with_physics(self.physics.with_model(mjx_model))

    def with_physics(self, physics: Physics) -> "JetBotEnv":
        """Return this environment with something else to step its physics, as a new object.

        Args:
          physics: of the same robot and scene.

        Returns:
          A copy; `self` stays as it is.
        """
        env = copy.copy(self)
        env.physics = physics
        return env

    def reset(self, rng: UInt32[Array, "2"]) -> State:
        """Begin an episode: the robot at rest at the origin, a new goal.

        Args:
          rng: a legacy key, `jax.random.PRNGKey`; Brax's wrappers rely on its shape.

        Returns:
          The first state.
        """
        key, goal_key = jax.random.split(rng)
        goal = self.task.sample(goal_key)
        physics = PhysicsState(
            qpos=jnp.asarray(self.mj_model.qpos0, jnp.float32),
            qvel=jnp.zeros(self.mj_model.nv),
            qacc_warmstart=jnp.zeros(self.mj_model.nv),
            time=jnp.zeros(()),
        )
        robot = robot_state(physics)
        # The names of the terms, without computing them: a first state has none.
        _, terms = jax.eval_shape(self.task.reward, robot, robot, goal, jnp.zeros(self.action_size))
        zero = jnp.zeros(())
        return State(
            pipeline_state=physics,
            obs=self.task.observe(robot, goal),
            reward=zero,
            done=zero,
            metrics={"success": zero, **{f"reward/{name}": zero for name in terms}},
            info={"terminated": zero},
            goal=goal,
            key=key,
        )

    def step(self, state: State, action: Float[Array, "2"]) -> State:
        """Hold an action for one environment step.

        Args:
          state: of the same environment.
          action: in [-1, 1]².

        Returns:
          The next state, with the same tree, shapes and dtypes.
        """
        return self.step_with_ctrl(state, action, self.wheel_targets(action))

    def step_with_ctrl(
        self, state: State, action: Float[Array, "2"], ctrl: Float[Array, "2"]
    ) -> State:
        """Step the environment with wheel speeds other than those that the action commands.

        Args:
          state: of the same environment.
          action: in [-1, 1]², for the task's reward alone.
          ctrl: wheel speed targets (left, right) [rad/s], held throughout.

        Returns:
          The next state.
        """
        mocap_pos = self.mocap_positions(state.goal)
        physics = self.step_physics(state.pipeline_state, ctrl, mocap_pos)
        before, after = robot_state(state.pipeline_state), robot_state(physics)
        task = self.task_step(before, after, state.goal, action)
        rewards = {f"reward/{name}": term for name, term in task.terms.items()}
        return state.replace(
            pipeline_state=physics,
            obs=task.obs,
            reward=task.reward,
            done=task.terminated,
            metrics={**state.metrics, "success": task.success, **rewards},
            info={**state.info, "terminated": task.terminated},
            goal=task.goal,
        )

    def task_step(
        self, before: RobotState, after: RobotState, goal: Goal, action: Float[Array, "2"]
    ) -> TaskStep:
        """Apply the task to one step of the robot.

        `reward` is given the goal before the step, all else the goal after it.

        Args:
          before: the robot before the step.
          after: the robot after it.
          goal: the goal before the step.
          action: the action of the step, as it was given.

        Returns:
          Observation, reward, end and the next goal.
        """
        reward, terms = self.task.reward(before, after, goal, action)
        if isinstance(self.task, AdvancesGoal):
            goal = self.task.advance(before, after, goal)
        terminated = self.task.terminated(after, goal).astype(jnp.float32)
        success = self.task.success(after, goal).astype(jnp.float32)
        obs = self.task.observe(after, goal)
        return TaskStep(obs, reward, terms, terminated, success, goal)

    def mocap_positions(self, goal: Goal) -> Float[Array, "nmocap 3"] | None:
        """Return where the task's solid mocap bodies stand.

        Args:
          goal: the goal of the episode, before the step in which they stand there.

        Returns:
          Positions [m], world frame, in the order of `physics.mocap_names`; None: there are none.

        Raises:
          UserError: `markers` leaves one out.
        """
        names = self.physics.mocap_names
        if not names:
            return None
        markers = self.task.markers(goal)
        if missing := [name for name in names if name not in markers]:
            raise UserError(
                f"task.name = {self.config.task.name!r}: markers does not say where"
                f" {', '.join(missing)} stands, a solid mocap body of build_scene"
            )
        return jnp.stack([markers[name] for name in names])

    def wheel_targets(self, action: Float[Array, "2"]) -> Float[Array, "2"]:
        """Wheel speeds (left, right) [rad/s] that an action commands, before motor limits."""
        twist_b = kinematics.twist_from_action(
            action,
            max_speed=self.config.task.max_speed,
            max_yaw_rate=self.config.task.max_yaw_rate,
        )
        return kinematics.wheel_speeds(
            twist_b,
            wheel_radius=CONTROLLER_WHEEL_RADIUS,
            wheel_separation=CONTROLLER_WHEEL_SEPARATION,
        )

    def step_physics(
        self,
        physics: PhysicsState,
        ctrl: Float[Array, "2"],
        mocap_pos: Float[Array, "nmocap 3"] | None = None,
    ) -> PhysicsState:
        """Integrate one environment step.

        Args:
          physics: where to start.
          ctrl: wheel speed targets (left, right) [rad/s], held throughout.
          mocap_pos: where the task's solid bodies stand [m], world frame; None: where they were
            built.

        Returns:
          The physics state one `ctrl_dt` later.
        """
        return self.physics.step(physics, ctrl, mocap_pos)

    @property
    def observation_size(self) -> int:
        """Length of the observation, from the task's layout."""
        return layout_size(self.task.layout)

    @property
    def observation_min_std(self) -> Float[np.ndarray, " obs"]:
        """Smallest deviation by which training normalises each number of the observation.

        Raises:
          UserError: the task's layout does not tell it.
        """
        layout = self.task.layout
        scales = [min_std(field) for field in layout]
        return np.repeat(np.array(scales, np.float32), [field.size for field in layout])

    @property
    def action_size(self) -> int:
        """Two: drive and turn."""
        return 2

    @property
    def backend(self) -> str:
        """Return the physics back end, in Brax's terms."""
        return "mjx"

    @property
    def dt(self) -> float:
        """Duration of one environment step [s]."""
        return self.config.physics.ctrl_dt


def make_env(config: Config) -> JetBotEnv:
    """Build the environment that a configuration describes.

    Args:
      config: robot, task and physics.

    Returns:
      The environment, unbatched and unwrapped.

    Raises:
      UserError: the task cannot be built.
    """
    return JetBotEnv(config)
