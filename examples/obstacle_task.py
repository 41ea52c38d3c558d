"""A task outside the package: drive to the goal and around a pillar.

Name the class in a YAML file beside this one, and train it:

    jetbot-mjx train obstacle

A subclass of `GoalTask` overrides only what differs: what is drawn for an episode, the
observation, the reward, and when the episode ends. Environment, trainer, evaluation and rendering
use the subclass as they use `GoalTask`. Every method takes one robot and is pure: no `if` on an
array, no state in `self`, random numbers from `key` alone.
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Bool, Float, UInt32
from pydantic import BaseModel, ConfigDict, ValidationError

from jetbot_mjx.config import NonNegative, Positive, TaskConfig
from jetbot_mjx.envs import Field, GoalTask, Layout, RobotState, kinematics
from jetbot_mjx.errors import UserError

# The pillar in the observation, in the form of the goal: position of its axis.
PILLAR: Layout = (
    Field("pillar_position", 2, "m", "body"),
    Field("pillar_direction", 2, "1", "body"),
    Field("pillar_distance", 1, "m", "body"),
)


class Options(BaseModel):
    """The keys of `task.options` in YAML, with their defaults."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    pillar_radius: Positive = 0.08
    """Radius of the pillar [m]."""
    pillar_height: Positive = 0.25
    """Height of the pillar [m]; it only matters for rendering."""
    pillar_offset: NonNegative = 0.1
    """Largest distance of the pillar's axis from the straight line to the goal [m]."""
    robot_radius: Positive = 0.11
    """Radius of the circle around the axle midpoint that encloses the whole robot [m]."""
    margin: Positive = 0.2
    """Free distance between the pillar and a robot at the start or on the goal [m]."""
    collision_penalty: NonNegative = 1.0
    """Penalty for hitting the pillar [m], in the unit of progress."""


class ObstacleGoal(NamedTuple):
    """The goal and the pillar that are drawn for one episode."""

    goal_w: Float[Array, "3"]
    """Position of the goal [m]."""
    pillar_w: Float[Array, "3"]
    """Centre of the pillar [m]."""


class ObstacleTask(GoalTask):
    """A task to drive to the goal without hitting a round pillar in the way.

    The pillar is virtual: it is rendered, but takes no part in physics. A robot hits it when the
    axle midpoint comes nearer to the pillar's axis than the sum of the two radii; that ends the
    episode as a failure and costs `collision_penalty`. Success is reaching the goal.
    """

    def __init__(self, config: TaskConfig) -> None:
        """Build the task.

        Args:
          config: The task's configuration; its `options` are the fields of `Options`.

        Raises:
          UserError: An option is wrong, or goals can be too near to place a pillar before them.
        """
        super().__init__(config)
        try:
            self.options = Options.model_validate(config.options)
        except ValidationError as error:
            wrong = error.errors()[0]
            key = ".".join(str(part) for part in wrong["loc"])
            raise UserError(
                f"task.options.{key} = {wrong['input']!r} is wrong: {wrong['msg']};"
                f" options are {', '.join(Options.model_fields)}"
            ) from None
        if config.goal_distance_min < 2 * self.clearance:
            raise UserError(
                f"task.goal_distance_min = {config.goal_distance_min:g} leaves no room for a"
                f" pillar: make it at least {2 * self.clearance:g}"
            )
        self.layout = (*self.layout, *PILLAR)

    @property
    def hit_distance(self) -> float:
        """Return the distance of axle midpoint and pillar's axis at which they touch [m]."""
        return self.options.pillar_radius + self.options.robot_radius

    @property
    def clearance(self) -> float:
        """Return the least distance of the pillar's axis from start and goal [m]."""
        return self.hit_distance + self.options.margin

    def sample(self, key: UInt32[Array, "2"]) -> ObstacleGoal:
        """Draw a goal, and a pillar between it and the start.

            pillar = s · e + o · e⊥,  s ∈ [clearance, r - clearance],  o ∈ [-offset, offset]

        with e the direction from the start to the goal, and r the distance on the floor.
        """
        goal_key, pillar_key = jax.random.split(key)
        goal_w = super().sample(goal_key)
        distance = jnp.hypot(goal_w[0], goal_w[1])
        ahead = goal_w[:2] / distance
        left = jnp.stack([-ahead[1], ahead[0]])
        along, aside = jax.random.uniform(pillar_key, (2,))
        way = self.clearance + along * (distance - 2 * self.clearance)
        offset = (2 * aside - 1) * self.options.pillar_offset
        height = jnp.full(1, self.options.pillar_height / 2)
        return ObstacleGoal(goal_w, jnp.concatenate([way * ahead + offset * left, height]))

    def observe(self, robot: RobotState, goal: ObstacleGoal) -> Float[Array, " obs"]:
        """Return the base class's observation, then the pillar in the body frame."""
        heading = kinematics.yaw(robot.quat)
        pillar_b = kinematics.to_body(heading, goal.pillar_w[:2] - robot.position_w[:2])
        distance = self.pillar_distance(robot, goal)
        # The lower bound only guards the division: a hit ends the episode before.
        direction = pillar_b / jnp.maximum(distance, 1e-3)
        return jnp.concatenate([super().observe(robot, goal), pillar_b, direction, distance[None]])

    def reward(
        self,
        before: RobotState,
        after: RobotState,
        goal: ObstacleGoal,
        action: Float[Array, "2"],
    ) -> tuple[Float[Array, ""], Mapping[str, Float[Array, ""]]]:
        """Return the progress towards the goal [m], less the penalty for hitting the pillar."""
        progress, terms = super().reward(before, after, goal, action)
        collision = -self.options.collision_penalty * self.hit(after, goal).astype(jnp.float32)
        return progress + collision, {**terms, "collision": collision}

    def terminated(self, robot: RobotState, goal: ObstacleGoal) -> Bool[Array, ""]:
        """Return whether the robot reaches the goal or hits the pillar."""
        return self.success(robot, goal) | self.hit(robot, goal)

    def success(self, robot: RobotState, goal: ObstacleGoal) -> Bool[Array, ""]:
        """Return whether the goal is reached without a hit in the same step."""
        return super().success(robot, goal) & ~self.hit(robot, goal)

    def goal_position(self, goal: ObstacleGoal) -> Float[Array, "3"]:
        """Return the position of the goal; `GoalTask` reads it from here alone."""
        return goal.goal_w

    def move_goal(self, goal: ObstacleGoal, position_w: Float[Array, "3"]) -> ObstacleGoal:
        """Return the goal at another position, with the pillar unchanged."""
        return goal._replace(goal_w=position_w)

    def markers(self, goal: ObstacleGoal) -> Mapping[str, Float[Array, "3"]]:
        """Return the positions of the red cube and of the pillar."""
        return {**super().markers(goal), "pillar": goal.pillar_w}

    def build_scene(self, spec: mujoco.MjSpec) -> None:
        """Add the pillar: a mocap body, placed by `markers`, that takes no part in physics."""
        super().build_scene(spec)
        pillar = spec.worldbody.add_body(name="pillar", mocap=True)
        pillar.add_geom(
            name="pillar",
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=(self.options.pillar_radius, self.options.pillar_height / 2, 0.0),
            rgba=(0.20, 0.38, 0.72, 1.0),
            contype=0,
            conaffinity=0,
        )

    def pillar_distance(self, robot: RobotState, goal: ObstacleGoal) -> Float[Array, ""]:
        """Return the distance on the floor from the axle midpoint to the pillar's axis [m]."""
        return jnp.linalg.norm(goal.pillar_w[:2] - robot.position_w[:2])

    def hit(self, robot: RobotState, goal: ObstacleGoal) -> Bool[Array, ""]:
        """Return whether the robot touches the pillar."""
        return self.pillar_distance(robot, goal) < self.hit_distance
