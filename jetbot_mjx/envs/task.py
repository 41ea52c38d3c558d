"""Define tasks: goals, observations, rewards and termination, as pure functions of one robot.

`Task` is the interface; `GoalTask` is the tutorial's task and a base class for your own. A task is
built as `Class(task_config)` and named in YAML as `package.module:Class`. No method has a batch
axis: batch with `jax.vmap`. Frames: `_w` world, `_b` body (x forward, y left, z up).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Bool, Float, PyTree, UInt32

from jetbot_mjx.config import TaskConfig
from jetbot_mjx.envs import kinematics
from jetbot_mjx.envs.own_class import import_class
from jetbot_mjx.errors import InvalidError, UserError

Goal = PyTree
"""Arrays in any pytree that a task draws for an episode; `GoalTask` draws a position [m], world
frame."""

GOAL_HEIGHT = 0.05  # [m] centre of the tutorial's 0.1 m cube; source: ISAAC `VisualCuboid`


class RobotState(NamedTuple):
    """A `RobotState` holds what a task sees of the robot, in the world frame."""

    position_w: Float[Array, "3"]
    """Position of the axle midpoint [m]."""
    quat: Float[Array, "4"]
    """Attitude of the body as a unit quaternion (w, x, y, z)."""
    linear_velocity_w: Float[Array, "3"]
    """Velocity of the axle midpoint [m/s]."""
    angular_velocity_w: Float[Array, "3"]
    """Angular velocity of the body [rad/s]."""


class Field(NamedTuple):
    """A `Field` describes consecutive entries of the observation vector."""

    name: str
    size: int
    """Number of entries."""
    unit: str
    """Unit, such as `m`; `1` for quantities without a unit."""
    frame: str
    """Frame, such as `world` or `body`."""
    min_std: float | None = None
    """Smallest standard deviation by which training normalises the entries, in their unit; None:
    the value of `MIN_STD` for the unit."""


MIN_STD = {"m": 0.01, "m/s": 0.05, "rad": 0.05, "rad/s": 0.1, "1": 0.05}
"""Smallest standard deviation for observation normalisation, by unit: smaller changes may be
artefacts of the simulator."""

Layout = tuple[Field, ...]

# The tutorial's 16-number observation, in its order.
WORLD: Layout = (
    Field("position", 3, "m", "world"),
    Field("quaternion", 4, "1", "world"),
    Field("linear_velocity", 3, "m/s", "world"),
    Field("angular_velocity", 3, "rad/s", "world"),
    Field("goal_position", 3, "m", "world"),
)

# An observation that a real robot can measure without its global pose.
EGOCENTRIC: Layout = (
    Field("goal_position", 2, "m", "body"),
    Field("goal_direction", 2, "1", "body"),
    Field("goal_distance", 1, "m", "body"),
    Field("forward_speed", 1, "m/s", "body"),
    Field("yaw_rate", 1, "rad/s", "body"),
)

LAYOUTS: dict[str, Layout] = {"world": WORLD, "egocentric": EGOCENTRIC, "": ()}


def layout_size(layout: Layout) -> int:
    """Return the length of the observation vector that a layout describes."""
    return sum(field.size for field in layout)


LayoutData = Sequence[Mapping[str, Any]]
"""The fields of an observation, as checkpoints store them: name, size, unit and frame of each."""


def layout_data(layout: Layout) -> LayoutData:
    """Return a layout as JSON for the users of a trained policy: all but `min_std`."""
    names = Field._fields[:-1]
    return [{name: getattr(field, name) for name in names} for field in layout]


def min_std(field: Field) -> float:
    """Return the smallest standard deviation by which training normalises a field [its unit].

    Args:
      field: a field of a layout.

    Raises:
      UserError: `min_std` is not a positive number, or it is None and `MIN_STD` lacks the unit.
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
    """The interface of a task. All methods are pure functions of one robot.

    Two optional methods are declared in protocols of their own: `MovesGoal.move_goal` and
    `AdvancesGoal.advance`.
    """

    layout: Layout
    """Description of the observation: name, size, unit and frame of each part; empty if the policy
    sees images only."""

    def __init__(self, config: TaskConfig) -> None:
        """Build the task."""
        ...

    def sample(self, key: UInt32[Array, "2"]) -> Goal:
        """Draw the goal of one episode, arrays in any pytree."""
        ...

    def observe(self, robot: RobotState, goal: Goal) -> Float[Array, " obs"]:
        """Return the observation, in the order of `layout`."""
        ...

    def reward(
        self, before: RobotState, after: RobotState, goal: Goal, action: Float[Array, " action"]
    ) -> tuple[Float[Array, ""], Mapping[str, Float[Array, ""]]]:
        """Return the reward of one step and its named terms; names are the same at every step."""
        ...

    def terminated(self, robot: RobotState, goal: Goal) -> Bool[Array, ""]:
        """Return whether the task ends the episode, in success or failure."""
        ...

    def success(self, robot: RobotState, goal: Goal) -> Bool[Array, ""]:
        """Return whether the robot has solved the task."""
        ...

    def goal_position(self, goal: Goal) -> Float[Array, "3"]:
        """Return the goal's position [m], world frame, for baselines, images and reports."""
        ...

    def markers(self, goal: Goal) -> Mapping[str, Float[Array, "3"]]:
        """Return the positions [m] of the scene's mocap bodies, world frame, by name."""
        ...

    def build_scene(self, spec: mujoco.MjSpec) -> None:
        """Add the task's own bodies to the scene before it is compiled.

        Visual geoms need `contype=0, conaffinity=0`. A geom that the robot can hit needs a contact
        pair with a geom of the robot. A mocap body is placed at its position in `markers`.

        Args:
          spec: the scene with robot and floor; it is modified in place.
        """
        ...


TaskClass = Callable[[TaskConfig], Task]
"""The class of a task, which is built from the task section."""


@runtime_checkable
class MovesGoal(Protocol):
    """An optional interface of tasks whose goal a user can move while a robot drives."""

    def move_goal(self, goal: Goal, position_w: Float[Array, "3"]) -> Goal:
        """Return the goal moved to another position.

        Args:
          goal: the goal that `sample` drew; its other parts stay the same.
          position_w: the new position [m], world frame.

        Returns:
          A tree of the same structure, shapes and dtypes.
        """
        ...


@runtime_checkable
class AdvancesGoal(Protocol):
    """An optional interface of tasks whose goal changes while the robot drives.

    The memory of an episode, such as the number of gates passed, is part of the goal.
    """

    def advance(self, before: RobotState, after: RobotState, goal: Goal) -> Goal:
        """Return the goal after a step.

        `reward` gets the goal before the step; `terminated`, `success` and `observe` get the goal
        after the step.

        Args:
          before: the robot before the step.
          after: the robot after the step.
          goal: the goal before the step.

        Returns:
          A tree of the same structure, shapes and dtypes.
        """
        ...


class GoalTask:
    """The tutorial's task: drive to a cube at a random position around the start.

    Goals: the distance is r = span·√u + minimum, and the direction is uniform. Adding the minimum
    makes near goals rarer than a uniform draw over the ring would; the tutorial samples so.
    Reward: the progress d(t-1) - d(t), so that the return is the distance covered towards the goal,
    less `step_cost`, which the tutorial has not.
    Success and termination: the 3-D distance from the axle midpoint to the cube's centre is below
    `success_radius`. Since the centre lies 18 mm higher, that is 98.4 mm on the floor.

    Source: Isaac Sim 2022.x documentation, section 9.9.
    """

    def __init__(self, config: TaskConfig) -> None:
        """Build the task.

        Args:
          config: the range of goals, the success radius and the observation layout.
        """
        self.config = config
        self.layout: Layout = LAYOUTS[config.numbers]

    def sample(self, key: UInt32[Array, "2"]) -> Float[Array, "3"]:
        """Draw a goal position [m], world frame.

            α = 2π u₁,  r = span √u₂ + minimum,  goal = (r sin α, r cos α, 0.05)

        Args:
          key: the random key of the episode.
        """
        u1, u2 = jax.random.uniform(key, (2,))
        angle = 2.0 * math.pi * u1
        distance = self.config.goal_distance_span * jnp.sqrt(u2) + self.config.goal_distance_min
        return jnp.stack(
            [distance * jnp.sin(angle), distance * jnp.cos(angle), jnp.float32(GOAL_HEIGHT)]
        )

    def observe(self, robot: RobotState, goal: Goal) -> Float[Array, " obs"]:
        """Return the numbers in the configured layout: `WORLD`, `EGOCENTRIC` or none."""
        if not self.config.numbers:
            return jnp.zeros(0)
        position_w = self.goal_position(goal)
        if self.config.numbers == "world":
            return jnp.concatenate([*robot, position_w])
        heading = kinematics.yaw(robot.quat)
        goal_b = kinematics.to_body(heading, position_w[:2] - robot.position_w[:2])
        distance = jnp.hypot(*goal_b)
        forward_speed = kinematics.to_body(heading, robot.linear_velocity_w[:2])[0]
        # The minimum only guards the division: an episode ends at 98 mm.
        direction = goal_b / jnp.maximum(distance, 1e-3)
        scalars = jnp.stack([distance, forward_speed, robot.angular_velocity_w[2]])
        return jnp.concatenate([goal_b, direction, scalars])

    def reward(
        self, before: RobotState, after: RobotState, goal: Goal, action: Float[Array, " action"]
    ) -> tuple[Float[Array, ""], Mapping[str, Float[Array, ""]]]:
        """Return the progress towards the goal in this step [m], d(t-1) - d(t), less its cost."""
        progress = self.distance(before, goal) - self.distance(after, goal)
        cost = self.config.step_cost
        # Without a cost the program stays what it is.
        if not cost:
            return progress, {"progress": progress}
        return progress - cost, {"progress": progress, "step_cost": jnp.full_like(progress, -cost)}

    def terminated(self, robot: RobotState, goal: Goal) -> Bool[Array, ""]:
        """Return whether the robot has reached the goal; nothing else ends an episode."""
        return self.success(robot, goal)

    def success(self, robot: RobotState, goal: Goal) -> Bool[Array, ""]:
        """Return whether the distance to the goal is below `success_radius`."""
        return self.distance(robot, goal) < self.config.success_radius

    def goal_position(self, goal: Goal) -> Float[Array, "3"]:
        """Return the goal, which is a position."""
        return goal

    def move_goal(self, goal: Goal, position_w: Float[Array, "3"]) -> Goal:
        """Return the new position as the goal.

        A task whose goal has other parts must override this method.
        """
        return position_w

    def markers(self, goal: Goal) -> Mapping[str, Float[Array, "3"]]:
        """Return the position of the red cube, which marks the goal."""
        return {"goal": self.goal_position(goal)}

    def build_scene(self, spec: mujoco.MjSpec) -> None:
        """Add nothing: the cube is part of the base scene."""

    def distance(self, robot: RobotState, goal: Goal) -> Float[Array, ""]:
        """Return the 3-D distance from the axle midpoint to the goal [m]."""
        return jnp.linalg.norm(self.goal_position(goal) - robot.position_w)


def reach_on_floor(task: Task, height: float) -> float | None:
    """Return the distance on the floor within which a robot has reached its goal [m].

    Args:
      task: the task.
      height: height of the robot's body above the floor [m].

    Returns:
      The distance; 0 where the robot reaches no goal; None for a task with goals of its own.
    """
    own = ("sample", "distance", "success")
    if not isinstance(task, GoalTask) or any(
        getattr(type(task), name) is not getattr(GoalTask, name) for name in own
    ):
        return None
    radius, apart = task.config.success_radius, GOAL_HEIGHT - height
    return math.sqrt(max(radius**2 - apart**2, 0.0))


def make_task(config: TaskConfig, task_class: TaskClass | None = None) -> Task:
    """Import and build the task that a configuration names.

    Args:
      config: the task section; its `name` is `package.module:Class`.
      task_class: the class, if it was already imported from the source that a run stored.

    Raises:
      UserError: the name is malformed, cannot be imported, or does not name a task.
    """
    found = task_class or import_class("task.name", config.name)
    _check_members(config.name, found, METHODS)
    if found is Task:
        raise InvalidError(
            f"task.name = {config.name!r} is the contract, not a task: derive from it"
        )
    task = found(config)
    _check_members(config.name, task, ("layout",))
    return task


def _check_members(name: str, task: object, members: Sequence[str]) -> None:
    """Raise an error if a task or its class lacks members of the interface."""
    missing = [member for member in members if not hasattr(task, member)]
    if missing:
        raise InvalidError(f"task.name = {name!r} is not a task: it lacks {', '.join(missing)}")


METHODS = tuple(name for name in vars(Task) if name[0] != "_" and callable(getattr(Task, name)))
"""Methods that every task must have."""
