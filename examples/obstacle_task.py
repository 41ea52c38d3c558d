"""A task of your own, without touching the package: drive to the goal and round a pillar.

Put this folder on `PYTHONPATH` and name the class in YAML, as `examples/obstacle.yaml` does:

    PYTHONPATH=examples python -m jetbot_mjx.train --config examples/obstacle.yaml

A subclass of `GoalTask` says only what differs: what is drawn for an episode, what is seen,
what is rewarded, and when it ends. Environment, trainer, evaluation and pictures follow.
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Bool, Float, UInt32
from pydantic import BaseModel, ConfigDict, ValidationError

from jetbot_mjx.config import NonNegative, Positive, TaskConfig
from jetbot_mjx.envs import kinematics
from jetbot_mjx.envs.task import Field, GoalTask, Layout, RobotState
from jetbot_mjx.errors import UserError

# What the policy sees beside the goal, in the same form: where the pillar's axis stands.
PILLAR: Layout = (
    Field("pillar_position", 2, "m", "body"),
    Field("pillar_direction", 2, "1", "body"),
    Field("pillar_distance", 1, "m", "body"),
)


class Options(BaseModel):
    """The keys of `task.options` in YAML, with their defaults."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    pillar_radius: Positive = 0.08
    """[m]"""
    pillar_height: Positive = 0.25
    """[m]; only shows."""
    pillar_offset: NonNegative = 0.1
    """[m] largest distance of the pillar's axis from the straight line to the goal."""
    robot_radius: Positive = 0.11
    """[m] circle about the axle midpoint that holds the whole robot, its rear corners too."""
    margin: Positive = 0.2
    """[m] free room between pillar and robot at the start, and were it to stand on the goal."""
    collision_penalty: NonNegative = 1.0
    """[m] what hitting the pillar costs, in the unit of progress."""


class ObstacleGoal(NamedTuple):
    """What is drawn for one episode."""

    goal_w: Float[Array, "3"]
    """Where to go [m]."""
    pillar_w: Float[Array, "3"]
    """Centre of the pillar [m]."""


class ObstacleTask(GoalTask):
    """Drive to the goal without hitting a round pillar that stands in the way.

    The pillar is virtual: it shows, but nothing touches it. A robot hits it where its axle
    midpoint comes nearer to the pillar's axis than the two radii together; that ends the
    episode as a failure and costs `collision_penalty`. Success is reaching the goal.
    """

    def __init__(self, config: TaskConfig) -> None:
        """Builds the task.

        Args:
          config: as for `GoalTask`; its `options` are those of `Options`.

        Raises:
          UserError: an option is wrong, or goals can be too near for a pillar to stand before
            them.
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
        """Distance of axle midpoint and pillar's axis below which they touch [m]."""
        return self.options.pillar_radius + self.options.robot_radius

    @property
    def clearance(self) -> float:
        """Distance that the pillar's axis keeps from start and goal [m]."""
        return self.hit_distance + self.options.margin

    def sample(self, key: UInt32[Array, "2"]) -> ObstacleGoal:
        """Draws a goal, and a pillar between it and the start.

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
        """The base class's observation, and the pillar as the robot sees it."""
        heading = kinematics.yaw(robot.quat)
        pillar_b = kinematics.to_body(heading, goal.pillar_w[:2] - robot.position_w[:2])
        distance = self.pillar_distance(robot, goal)
        # The floor under the distance only guards the division: a hit ends the episode before.
        direction = pillar_b / jnp.maximum(distance, 1e-3)
        return jnp.concatenate([super().observe(robot, goal), pillar_b, direction, distance[None]])

    def reward(
        self,
        before: RobotState,
        after: RobotState,
        goal: ObstacleGoal,
        action: Float[Array, "2"],
    ) -> tuple[Float[Array, ""], Mapping[str, Float[Array, ""]]]:
        """Progress towards the goal [m], less the penalty where the pillar is hit."""
        progress, terms = super().reward(before, after, goal, action)
        collision = -self.options.collision_penalty * self.hit(after, goal).astype(jnp.float32)
        return progress + collision, {**terms, "collision": collision}

    def terminated(self, robot: RobotState, goal: ObstacleGoal) -> Bool[Array, ""]:
        """The episode ends at the goal and at the pillar."""
        return self.success(robot, goal) | self.hit(robot, goal)

    def success(self, robot: RobotState, goal: ObstacleGoal) -> Bool[Array, ""]:
        """Whether the goal is reached; a robot that hits the pillar in that step has failed."""
        return super().success(robot, goal) & ~self.hit(robot, goal)

    def goal_position(self, goal: ObstacleGoal) -> Float[Array, "3"]:
        """Where to go; all of `GoalTask` that needs the goal asks here."""
        return goal.goal_w

    def move_goal(self, goal: ObstacleGoal, position_w: Float[Array, "3"]) -> ObstacleGoal:
        """The cube moves, the pillar stays where it was drawn."""
        return goal._replace(goal_w=position_w)

    def markers(self, goal: ObstacleGoal) -> Mapping[str, Float[Array, "3"]]:
        """The red cube stands on the goal, the pillar on its place."""
        return {**super().markers(goal), "pillar": goal.pillar_w}

    def build_scene(self, spec: mujoco.MjSpec) -> None:
        """Adds the pillar: a mocap body, placed by `markers`, that takes no part in physics."""
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
        """Distance on the floor from the axle midpoint to the pillar's axis [m]."""
        return jnp.linalg.norm(goal.pillar_w[:2] - robot.position_w[:2])

    def hit(self, robot: RobotState, goal: ObstacleGoal) -> Bool[Array, ""]:
        """Whether the robot touches the pillar."""
        return self.pillar_distance(robot, goal) < self.hit_distance
