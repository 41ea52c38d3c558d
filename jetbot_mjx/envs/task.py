"""Tasks: goals, observations, rewards, termination. Pure functions of one robot.

`Task` is the contract; `GoalTask` is the tutorial's task and a base class for your own.
A task is built as `Class(task_config)` and named in YAML as `package.module:Class`.
Frames: `_w` world, `_b` body (x forward, y left, z up). No batch axis: `jax.vmap`.
"""

import importlib
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Bool, Float, PyTree, UInt32

from jetbot_mjx.config import TaskConfig
from jetbot_mjx.envs import kinematics
from jetbot_mjx.errors import UserError

Goal = PyTree
"""Whatever a task draws for an episode; the tutorial's is a position [m], world frame."""

GOAL_HEIGHT = 0.05  # [m] centre of the tutorial's cube of 0.1 m, ISAAC `VisualCuboid`


class RobotState(NamedTuple):
    """The robot as a task sees it: its axle midpoint and body frame, in the world frame."""

    position_w: Float[Array, "3"]
    """Axle midpoint [m]."""
    quat: Float[Array, "4"]
    """Attitude (w, x, y, z)."""
    linear_velocity_w: Float[Array, "3"]
    """Velocity of the axle midpoint [m/s]."""
    angular_velocity_w: Float[Array, "3"]
    """[rad/s]"""


class Field(NamedTuple):
    """One named stretch of the observation vector."""

    name: str
    size: int
    unit: str
    frame: str
    min_std: float | None = None
    """[unit] smallest deviation by which training normalises it; None: that of its unit."""


MIN_STD = {"m": 0.01, "m/s": 0.05, "rad": 0.05, "rad/s": 0.1, "1": 0.05}
"""Smallest deviation of an observation by its unit: changes below it may be the simulator's own."""

Layout = tuple[Field, ...]

# The tutorial's 16 numbers, in its order.
WORLD: Layout = (
    Field("position", 3, "m", "world"),
    Field("quaternion", 4, "1", "world"),
    Field("linear_velocity", 3, "m/s", "world"),
    Field("angular_velocity", 3, "rad/s", "world"),
    Field("goal_position", 3, "m", "world"),
)

# What a robot can know without a global pose.
EGOCENTRIC: Layout = (
    Field("goal_position", 2, "m", "body"),
    Field("goal_direction", 2, "1", "body"),
    Field("goal_distance", 1, "m", "body"),
    Field("forward_speed", 1, "m/s", "body"),
    Field("yaw_rate", 1, "rad/s", "body"),
)

LAYOUTS: dict[str, Layout] = {"world": WORLD, "egocentric": EGOCENTRIC}


def layout_size(layout: Layout) -> int:
    """Length of the observation vector that a layout describes."""
    return sum(field.size for field in layout)


def layout_data(layout: Layout) -> list[dict[str, Any]]:
    """Return what a policy has to know of its observation, as JSON: all but `min_std`."""
    return [
        {name: value for name, value in field._asdict().items() if name != "min_std"}
        for field in layout
    ]


def min_std(field: Field) -> float:
    """Return the smallest deviation by which training normalises a field [its unit].

    Raises:
      UserError: it is no positive number, or not given and its unit has none in `MIN_STD`.
    """
    if field.min_std is None:
        if field.unit not in MIN_STD:
            raise UserError(
                f"layout: {field.name!r} has the unit {field.unit!r}, for which no smallest"
                " deviation is known: state one, Field(..., min_std=0.1), or set"
                " ppo.normalizer=brax"
            )
        return MIN_STD[field.unit]
    if not (isinstance(field.min_std, int | float) and 0 < field.min_std < math.inf):
        raise UserError(
            f"layout: {field.name!r} has min_std = {field.min_std!r}: it should be a positive"
            f" number [{field.unit}]"
        )
    return field.min_std


def layout_table(layout: Layout) -> str:
    """Return the layout as a Markdown table: index, name, unit, frame."""
    lines = ["| index | observation | unit | frame |", "|---|---|---|---|"]
    start = 0
    for field in layout:
        end = start + field.size - 1
        index = f"{start}" if field.size == 1 else f"{start}-{end}"
        lines.append(f"| {index} | {field.name} | {field.unit} | {field.frame} |")
        start = end + 1
    return "\n".join(lines)


@runtime_checkable
class Task(Protocol):
    """The interface of a task. All methods are pure and see one robot.

    Optional beside these: `move_goal`, of `MovesGoal`, and `advance`, of `AdvancesGoal`.
    """

    layout: Layout
    """The observation as data: name, size, unit and frame of each part."""

    def sample(self, key: UInt32[Array, "2"]) -> Goal:
        """Draw the goal of one episode: arrays in any pytree."""
        ...

    def observe(self, robot: RobotState, goal: Goal) -> Float[Array, " obs"]:
        """Return the observation, in the order of `layout`."""
        ...

    def reward(
        self,
        before: RobotState,
        after: RobotState,
        goal: Goal,
        action: Float[Array, "2"],
    ) -> tuple[Float[Array, ""], Mapping[str, Float[Array, ""]]]:
        """Return the reward of one step and its named terms, the same names at every step."""
        ...

    def terminated(self, robot: RobotState, goal: Goal) -> Bool[Array, ""]:
        """Return whether the episode has ended for good, in success or failure."""
        ...

    def success(self, robot: RobotState, goal: Goal) -> Bool[Array, ""]:
        """Return whether the task is done."""
        ...

    def goal_position(self, goal: Goal) -> Float[Array, "3"]:
        """Return the goal's position [m], world frame, for baselines, images and reports."""
        ...

    def markers(self, goal: Goal) -> Mapping[str, Float[Array, "3"]]:
        """Return where the scene's mocap bodies stand [m], by name."""
        ...

    def build_scene(self, spec: mujoco.MjSpec) -> None:
        """Add the task's own bodies to the scene before it is compiled.

        What only shows wants `contype=0, conaffinity=0`. What the robot can run into is given a
        contact pair with a geom of the robot; as a mocap body it stands where `markers` says.
        """
        ...


@runtime_checkable
class MovesGoal(Protocol):
    """An optional interface of a task whose goal a user can move while a robot drives."""

    def move_goal(self, goal: Goal, position_w: Float[Array, "3"]) -> Goal:
        """Return the same goal, elsewhere.

        Args:
          goal: what `sample` drew; all of it that is not the place to go stays.
          position_w: where the robot is to go instead [m], world frame.

        Returns:
          A tree of the same structure, shapes and dtypes.
        """
        ...


@runtime_checkable
class AdvancesGoal(Protocol):
    """An optional interface of a task whose goal changes as the robot drives.

    What an episode has to remember, such as how many gates are passed, is part of the goal.
    """

    def advance(self, before: RobotState, after: RobotState, goal: Goal) -> Goal:
        """Return the goal after a step.

        `reward` sees the goal before it; `terminated`, `success` and `observe` the one after.

        Args:
          before: the robot before the step.
          after: the robot after it.
          goal: until then.

        Returns:
          A tree of the same structure, shapes and dtypes.
        """
        ...


class GoalTask:
    """The tutorial's task: drive to a cube that lies anywhere around the start.

    Goals: distance r = span·√u + minimum and any direction. The added minimum makes nearby
    goals rarer than a uniform draw over the ring would; that is the tutorial's sampler.
    Reward: progress, d(t-1) - d(t), so an episode's return is what distance it covered.
    Success, and the end: the 3-D distance of the axle midpoint to the cube's centre is below
    `success_radius`. Since the cube's centre lies 18 mm higher, that is 98.4 mm on the floor.

    Source: Isaac Sim 2022.x documentation, section 9.9.
    """

    def __init__(self, config: TaskConfig) -> None:
        """Build the task.

        Args:
          config: ranges, radius and the observation's layout.
        """
        self.config = config
        self.layout: Layout = LAYOUTS[config.observation]

    def sample(self, key: UInt32[Array, "2"]) -> Float[Array, "3"]:
        """Draw a goal position [m], world frame.

        α = 2π u₁,  r = span √u₂ + minimum,  goal = (r sin α, r cos α, 0.05)
        """
        u1, u2 = jax.random.uniform(key, (2,))
        angle = 2.0 * math.pi * u1
        distance = self.config.goal_distance_span * jnp.sqrt(u2) + self.config.goal_distance_min
        return jnp.stack(
            [distance * jnp.sin(angle), distance * jnp.cos(angle), jnp.float32(GOAL_HEIGHT)]
        )

    def observe(self, robot: RobotState, goal: Goal) -> Float[Array, " obs"]:
        """Return the observation in the configured layout, see `WORLD` and `EGOCENTRIC`."""
        position_w = self.goal_position(goal)
        if self.config.observation == "world":
            return jnp.concatenate([*robot, position_w])
        heading = kinematics.yaw(robot.quat)
        goal_b = kinematics.to_body(heading, position_w[:2] - robot.position_w[:2])
        distance = jnp.hypot(*goal_b)
        forward_speed = kinematics.to_body(heading, robot.linear_velocity_w[:2])[0]
        # The floor under the distance only guards the division; an episode ends at 98 mm.
        direction = goal_b / jnp.maximum(distance, 1e-3)
        rest = jnp.stack([distance, forward_speed, robot.angular_velocity_w[2]])
        return jnp.concatenate([goal_b, direction, rest])

    def reward(
        self,
        before: RobotState,
        after: RobotState,
        goal: Goal,
        action: Float[Array, "2"],
    ) -> tuple[Float[Array, ""], Mapping[str, Float[Array, ""]]]:
        """Progress towards the goal in this step [m]."""
        del action
        progress = self.distance(before, goal) - self.distance(after, goal)
        return progress, {"progress": progress}

    def terminated(self, robot: RobotState, goal: Goal) -> Bool[Array, ""]:
        """Return whether the episode has succeeded, which ends it."""
        return self.success(robot, goal)

    def success(self, robot: RobotState, goal: Goal) -> Bool[Array, ""]:
        """Return whether the goal is nearer than the success radius."""
        return self.distance(robot, goal) < self.config.success_radius

    def goal_position(self, goal: Goal) -> Float[Array, "3"]:
        """Return the goal itself."""
        return goal

    def move_goal(self, goal: Goal, position_w: Float[Array, "3"]) -> Goal:
        """Return the position itself; a task that draws more says where in its draw it goes."""
        del goal
        return position_w

    def markers(self, goal: Goal) -> Mapping[str, Float[Array, "3"]]:
        """Return the place of the red cube, which stands on the goal."""
        return {"goal": self.goal_position(goal)}

    def build_scene(self, spec: mujoco.MjSpec) -> None:
        """Nothing to add: the cube is part of the scene."""
        del spec

    def distance(self, robot: RobotState, goal: Goal) -> Float[Array, ""]:
        """3-D distance from the axle midpoint to the goal [m]."""
        return jnp.linalg.norm(self.goal_position(goal) - robot.position_w)


def make_task(config: TaskConfig) -> Task:
    """Import and builds the task that a configuration names.

    Args:
      config: its `name` is `package.module:Class`.

    Returns:
      The task.

    Raises:
      UserError: the name is malformed, cannot be imported, or is no task.
    """
    module_name, separator, class_name = config.name.partition(":")
    if not separator or not module_name.strip(".") or module_name[0] == "." or not class_name:
        raise UserError(f"task.name = {config.name!r} is wrong: write package.module:Class")
    try:
        module = importlib.import_module(module_name)
    except ModuleNotFoundError as error:
        raise UserError(
            f"task.name = {config.name!r}: no module named {error.name!r} can be imported;"
            " install it, or name its folder in PYTHONPATH"
        ) from None
    task_class: Any = getattr(module, class_name, None)
    if task_class is None:
        raise UserError(f"task.name = {config.name!r}: {module_name} has no {class_name!r}")
    _check_members(config.name, task_class, METHODS)
    if task_class is Task:
        raise UserError(f"task.name = {config.name!r} is the contract, not a task: derive from it")
    task = task_class(config)
    _check_members(config.name, task, ("layout",))
    return task


def _check_members(name: str, thing: object, members: Sequence[str]) -> None:
    missing = [member for member in members if not hasattr(thing, member)]
    if missing:
        raise UserError(f"task.name = {name!r} is no task: it lacks {', '.join(missing)}")


METHODS = (
    "sample",
    "observe",
    "reward",
    "terminated",
    "success",
    "goal_position",
    "markers",
    "build_scene",
)
