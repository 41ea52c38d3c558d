"""Combine a robot model and a task into a `brax.envs.Env`.

The environment is pure, unbatched and stateless: batch it with `jax.vmap`, compile it with
`jax.jit`. The state holds only what physics integrates and what the task drew; `mjx.Data` is
rebuilt inside `step`.
"""

import copy
import functools
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float, PyTree, UInt32

from jetbot_mjx.config import Config, MjcfRobotConfig, Overrides, TaskConfig, load_config
from jetbot_mjx.envs import kinematics, mjx, robot_model
from jetbot_mjx.envs.camera.render import Camera
from jetbot_mjx.envs.camera.wrapper import NUMBERS, PIXELS, numbers_of, observation_shapes, see
from jetbot_mjx.envs.drive import Drive, jetbot_drive
from jetbot_mjx.envs.kernel_impl import KernelImpl
from jetbot_mjx.envs.mjcf_robot import RobotFileError
from jetbot_mjx.envs.mjcf_wheels import find_drive
from jetbot_mjx.envs.physics import Physics
from jetbot_mjx.envs.robot_trial import Trial, drive_trial
from jetbot_mjx.envs.state import Obs, PhysicsState, State, robot_state
from jetbot_mjx.envs.task import (
    GOAL_HEIGHT,
    AdvancesGoal,
    Goal,
    GoalTask,
    Layout,
    RobotState,
    Task,
    TaskClass,
    layout_size,
    make_task,
    min_std,
    reach_on_floor,
)
from jetbot_mjx.errors import InvalidError, UserError
from jetbot_mjx.mjx_import import Env


class TaskStep(NamedTuple):
    """A `TaskStep` holds the task's results for one step of the robot.

    It does not depend on which simulator moved the robot.
    """

    obs: Obs
    """Observation after the step, as of `JetBotEnv.observe`."""
    reward: Float[Array, ""]
    """Reward of the step."""
    terms: Mapping[str, Float[Array, ""]]
    """Named terms of the reward."""
    terminated: Float[Array, ""]
    """1 where the step ended the episode."""
    success: Float[Array, ""]
    """1 where the robot has solved the task."""
    goal: Goal
    """Goal after the step."""


class JetBotEnv(Env):
    """An environment of one JetBot and its task.

    Action: two numbers, clipped to [-1, 1]. They command the speed v = (a₀ + 1)/2 · `max_speed`
    [m/s] and the yaw rate ω = a₁ · `max_yaw_rate` [rad/s]. The tutorial's differential controller
    turns both into wheel speed targets, which are held for one environment step.
    Observation: described by the task's `layout`; with `task.observation: camera` a dictionary, as
    described by `CameraWrapper`.
    State: `metrics` holds `success` and `reward/<term>` of the step; `info` holds `terminated`.
    `done` means termination only; `EpisodeWrapper` adds the time limit.
    """

    def __init__(self, config: Config, task_class: TaskClass | None = None) -> None:
        """Build the task and its models.

        Args:
          config: the configuration; the sections robot, task and physics are used.
          task_class: the class of the task; None: the one that `task.name` imports.

        Raises:
          UserError: the task or its scene cannot be built.
        """
        if config.environment is not None:
            raise InvalidError(
                f"environment = {config.environment!r} takes the place of the robot and its task:"
                " make_env builds it"
            )
        self.config = config
        self.task: Task = make_task(config.task, task_class)
        self.robot = config.robot
        make_model = functools.partial(
            robot_model.make_mj_model, self.robot, config.physics, build_scene=self.task.build_scene
        )
        try:
            self.mj_model: mujoco.MjModel = make_model()
            self.physics = Physics(make_model(visual=False), config.physics)
            self.drive, self.trial = _drive(config, self.physics.mj_model)
            self.camera = None
            if config.task.sees:
                body = robot_model.robot_body(self.mj_model)
                self.camera = Camera(config.camera, self.mj_model, body)
            # MJX may not support a custom scene: build its model now, to fail before a run begins.
            # The model of a built-in task is built later, when a program is compiled.
            own = isinstance(self.robot, MjcfRobotConfig)
            self._check_reach()
            if own or type(self.task).build_scene is not GoalTask.build_scene:
                _ = self.physics.model
        except UserError:
            raise
        except (RuntimeError, ValueError) as error:
            reason = " ".join(str(error).split())
            if isinstance(error, NotImplementedError):
                reason = f"MJX does not support {reason}"
            if isinstance(self.robot, MjcfRobotConfig):
                raise RobotFileError(self.robot, reason) from None
            if type(self.task).build_scene is GoalTask.build_scene:
                raise UserError(f"robot {self.robot.label}: {reason}") from None
            raise UserError(
                f"task.name = {config.task.name!r}: its scene cannot be simulated: {reason}"
                f" (jetbot-mjx check-env {config.task.name} says more)"
            ) from None

    def _check_reach(self) -> None:
        """Check that the robot is not so high above its goals that it reaches none."""
        height = float(self.mj_model.qpos0[2])
        if reach_on_floor(self.task, height) == 0.0:
            radius = np.hypot(height - GOAL_HEIGHT, TaskConfig().success_radius)
            raise UserError(
                f"task.success_radius = {self.config.task.success_radius:g} cannot be reached:"
                f" goals are {GOAL_HEIGHT:g} m above the floor, and the body of"
                f" {self.robot.label} is {height:.3g} m above it: set {radius:.2g}"
            )

    def __repr__(self) -> str:
        """Return the task, the robot and the sizes in one line."""
        task = self.config.task
        return (
            f"{type(self).__name__}(task={task.name!r}, robot={self.robot.label!r},"
            f" observation={task.observation!r}, observation_size={self.observation_size},"
            f" action_size={self.action_size})"
        )

    def blind(self) -> "JetBotEnv":
        """Return a copy of this environment that observes numbers only.

        Wrappers of a single robot take it, and `with_camera` renders outside of them.
        """
        return self._with(camera=None)

    def with_camera(self, camera: Camera) -> "JetBotEnv":
        """Return a copy of this environment that sees through another camera.

        Args:
          camera: a camera whose images have the same shape.
        """
        return self._with(camera=camera)

    @property
    def mjx_model(self) -> mjx.Model:
        """Return the MJX model that is stepped."""
        return self.physics.model

    def with_model(self, mjx_model: mjx.Model) -> "JetBotEnv":
        """Return a copy of this environment with another physics model.

        Args:
          mjx_model: a model of the same structure, for example with another friction.
        """
        return self.with_physics(self.physics.with_model(mjx_model))

    def with_physics(self, physics: Physics) -> "JetBotEnv":
        """Return a copy of this environment that steps its physics in another way.

        Args:
          physics: the physics of the same robot and scene.
        """
        return self._with(physics=physics)

    def with_task(self, task: Task) -> "JetBotEnv":
        """Return a copy of this environment with another task.

        Args:
          task: a task of the same scene, for example with another success radius.
        """
        return self._with(task=task)

    def _with(self, **changed: Camera | Physics | Task | None) -> "JetBotEnv":
        """Return a copy of this environment with other attributes."""
        env = copy.copy(self)
        vars(env).update(changed)
        return env

    def reset(self, rng: UInt32[Array, "2"]) -> State:
        """Begin an episode: the robot is at rest at the origin, and the task draws a goal.

        Args:
          rng: a legacy random key of shape (2,), `jax.random.PRNGKey`, as Brax's wrappers need it.

        Returns:
          The first state.

        Raises:
          InvalidError: `rng` has another shape, for example that of several keys.
        """
        typed = isinstance(rng, jax.Array) and jnp.issubdtype(rng.dtype, jax.dtypes.prng_key)
        _check_one("rng", rng, () if typed else (2,), "reset")
        key, goal_key = jax.random.split(rng)
        goal = self.task.sample(goal_key)
        physics = PhysicsState(
            qpos=jnp.asarray(self.mj_model.qpos0, jnp.float32),
            qvel=jnp.zeros(self.mj_model.nv),
            qacc_warmstart=jnp.zeros(self.mj_model.nv),
            time=jnp.zeros(()),
        )
        robot = robot_state(physics)
        # Only the names of the reward terms are needed here: a first state has no reward.
        _, terms = jax.eval_shape(self.task.reward, robot, robot, goal, jnp.zeros(self.action_size))
        zero = jnp.zeros(())
        state = State(
            pipeline_state=physics,
            obs=self.observe(robot, goal),
            reward=zero,
            done=zero,
            metrics={"success": zero, **{f"reward/{name}": zero for name in terms}},
            info={"terminated": zero},
            goal=goal,
            key=key,
        )
        return state if self.camera is None else see(self.camera, self.task, state)

    def step(self, state: State, action: Float[Array, " action"]) -> State:
        """Make one environment step.

        Args:
          state: a state of this environment.
          action: the action, in [-1, 1]².

        Returns:
          The next state, with the same tree structure, shapes and dtypes.

        Raises:
          InvalidError: the action has another shape, or the state is a batch of states.
        """
        _check_one("action", action, (self.action_size,), "step")
        _check_one("state.done", state.done, (), "step")
        ctrl = self.drive.controls(self.wheel_targets(action))
        if self.camera is None:
            return self.step_with_ctrl(state, action, ctrl)
        before = state.replace(obs=numbers_of(state.obs))
        nstate = self.step_with_ctrl(before, action, ctrl)
        return see(self.camera, self.task, nstate, state.obs[PIXELS], begins=False)

    def step_with_ctrl(
        self, state: State, action: Float[Array, " action"], ctrl: Float[Array, " nu"]
    ) -> State:
        """Make one environment step with given wheel speed targets, without the camera.

        Args:
          state: a state of this environment, whose observation has no images.
          action: the action, in [-1, 1]²; only the task's reward uses it.
          ctrl: controls of the actuators, constant during the step; of a JetBot the wheel speed
            targets (left, right) [rad/s].

        Returns:
          The next state, with the same tree structure, shapes and dtypes.
        """
        mocap_pos = self.mocap_positions(state.goal)
        physics = self.physics.step(state.pipeline_state, ctrl, mocap_pos)
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
        self, before: RobotState, after: RobotState, goal: Goal, action: Float[Array, " action"]
    ) -> TaskStep:
        """Compute the task's results for one step of the robot.

        `reward` gets the goal before the step; all other methods get the goal after the step.

        Args:
          before: the robot before the step.
          after: the robot after the step.
          goal: the goal before the step.
          action: the action of the step, as the caller gave it.
        """
        reward, terms = self.task.reward(before, after, goal, action)
        if isinstance(self.task, AdvancesGoal):
            goal = self.task.advance(before, after, goal)
        terminated = self.task.terminated(after, goal).astype(jnp.float32)
        success = self.task.success(after, goal).astype(jnp.float32)
        obs = self.observe(after, goal)
        return TaskStep(obs, reward, terms, terminated, success, goal)

    def observe(self, robot: RobotState, goal: Goal) -> Obs:
        """Return the task's observation: a vector, or an empty dictionary if its layout is empty.

        Args:
          robot: the robot as its sensors measure it.
          goal: the goal of the episode.
        """
        return self.task.observe(robot, goal) if self.task.layout else {}

    def mocap_positions(self, goal: Goal) -> Float[Array, "nmocap 3"] | None:
        """Return the positions of the task's solid mocap bodies during a step.

        Args:
          goal: the goal before the step.

        Returns:
          Positions [m], world frame, in the order of `physics.mocap_names`; None if the scene has
          no such bodies.

        Raises:
          UserError: the task's `markers` lacks one of the bodies.
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

    def wheel_targets(self, action: Float[Array, " action"]) -> Float[Array, " command"]:
        """Return what an action commands, before motor limits.

        Args:
          action: the action; values outside [-1, 1] are clipped.

        Returns:
          Wheel speed targets (left, right) [rad/s]; of a car a wheel speed [rad/s] and a curvature
          [1/m]; of a drive that is a function the action itself. `drive.controls` makes the
          controls of the actuators of it.
        """
        return self.drive.command(action)

    def action_of_twist(self, twist_b: Float[Array, "2"]) -> Float[Array, " action"]:
        """Return the action that commands a speed and a yaw rate to a JetBot.

        Args:
          twist_b: (v, ω), forward speed [m/s] and yaw rate [rad/s].

        Returns:
          The action. Of another length than two, it is cut off, or the other numbers are 0.
        """
        task, size = self.config.task, self.action_size
        action = kinematics.action_from_twist(
            twist_b, max_speed=task.max_speed, max_yaw_rate=task.max_yaw_rate
        )
        return action if size == 2 else jnp.pad(action, (0, max(size - 2, 0)))[:size]

    @property
    def observation_size(self) -> int | dict[str, tuple[int, ...]]:
        """Length of the observation vector; with a camera, the shapes of the parts by name."""
        length = layout_size(self.task.layout)
        if self.camera is None:
            return length
        return observation_shapes(self.camera, length)

    @property
    def observation_min_std(self) -> PyTree[np.ndarray]:
        """Smallest standard deviation by which training normalises each number of the observation.

        Raises:
          UserError: the task's layout does not define it.
        """
        layout = self.task.layout
        by_field = [min_std(field) for field in layout]
        smallest = np.repeat(np.array(by_field, np.float32), [field.size for field in layout])
        return smallest if self.camera is None else {NUMBERS: smallest} if layout else {}

    @property
    def action_size(self) -> int:
        """Length of the action: drive and turn, unless the robot's drive is a function."""
        return self.drive.action_size

    has_success = True

    @property
    def layout(self) -> Layout:
        """Return what the numbers of the observation are."""
        return self.task.layout

    @property
    def kernel_impl(self) -> KernelImpl:
        """Return the setting that decides whether a step is one kernel."""
        return self.physics.kernel_impl

    @property
    def may_be_kernel(self) -> bool:
        """Return whether physics may be a kernel, and so the whole step."""
        return self.physics.may_be_kernel

    @property
    def backend(self) -> str:
        """Name of the physics back end, for Brax."""
        return "mjx"

    @property
    def dt(self) -> float:
        """Duration of one environment step [s]."""
        return self.config.physics.ctrl_dt


def _drive(config: Config, model: mujoco.MjModel) -> tuple[Drive, Trial | None]:
    """Return the drive of a configuration's robot; one that is a model of its own must drive.

    Returns:
      The drive, and how the robot follows it; None where that is not tried.
    """
    if not isinstance(config.robot, MjcfRobotConfig):
        return jetbot_drive(config), None
    drive = find_drive(config.robot, config.task, model)
    return drive, drive_trial(config, model, drive)


def _check_one(name: str, array: object, shape: tuple[int, ...], method: str) -> None:
    """Check that an argument of a method is that of one robot.

    Raises:
      InvalidError: it has another shape.
    """
    given = getattr(array, "shape", None)
    if given == shape:
        return
    if given is not None and given[1:] == shape:
        raise InvalidError(
            f"{name}: got {given[0]} of them, and an environment is of one robot: batch it, as in"
            f" jax.vmap(env.{method})"
        )
    got = type(array).__name__ if given is None else f"shape {list(given)}"
    raise InvalidError(f"{name}: expected an array of shape {list(shape)}; got {got}")


def make_jetbot_env(
    config: str | Path | Config,
    overrides: Overrides = (),
    *,
    task_class: TaskClass | None = None,
) -> JetBotEnv:
    """Build the environment of a robot and its task, of a configuration without `environment`.

    Args:
      config: the configuration, its name or its file, as for `load_config`; the sections robot,
        task and physics are used.
      overrides: the settings to change, as for `load_config`.
      task_class: the class of the task; None: the one that `task.name` imports.

    Returns:
      The environment, unbatched and unwrapped.

    Raises:
      UserError: the configuration is invalid, or the task or its scene cannot be built.
    """
    return JetBotEnv(load_config(config, overrides), task_class)
