"""A task with solid obstacles: drive to the goal between pillars that the robot can run into.

    jetbot-mjx train pillars

Unlike the pillar of `obstacle_task.py`, which ends the episode, these are solid: contact forces
keep the robot out of them. A robot may brush past a pillar, or push against it until the time
limit. Touching costs a little in every step: without that cost, pushing looks no worse than a
detour.
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Bool, Float, UInt32

from jetbot_mjx.config import TaskConfig
from jetbot_mjx.envs import Field, GoalTask, RobotState, kinematics

PILLARS = 3
PILLAR_RADIUS = 0.06  # [m]
PILLAR_HEIGHT = 0.25  # [m]

# A sphere that encloses chassis and wheels, in the body frame. It makes one contact with each
# pillar, and the force acts at the height of the axle, so that it does not tip the robot.
BUMPER_RADIUS = 0.085  # [m]
BUMPER_POS = (-0.031, 0.0, 0.0)  # [m] middle of the chassis

CONTACT_COST = 0.01  # [m] cost of touching a pillar for one step; full speed covers 0.017 m
ARRIVAL = 0.5  # [m] reward for reaching the goal, besides the progress
TOUCH = 0.003  # [m] gap below which the robot counts as touching

CLEARANCE = PILLAR_RADIUS + 0.18  # [m] of a pillar's axis from start and goal


class PillarsGoal(NamedTuple):
    """The goal and the pillars that are drawn for one episode."""

    goal_w: Float[Array, "3"]
    """Position of the goal [m]."""
    pillars_w: Float[Array, "pillars 3"]
    """Centres of the pillars [m]; the first stands in the way."""


class PillarsTask(GoalTask):
    """A task to drive to the goal between solid pillars, one of which stands in the way."""

    def __init__(self, config: TaskConfig) -> None:
        """Build the task; use it with `task.observation: egocentric`."""
        super().__init__(config)
        self.layout = (
            *self.layout,
            *(Field(f"pillar_{i}_position", 2, "m", "body") for i in range(PILLARS)),
            *(Field(f"pillar_{i}_direction", 2, "1", "body") for i in range(PILLARS)),
            *(Field(f"pillar_{i}_distance", 1, "m", "body") for i in range(PILLARS)),
        )

    def sample(self, key: UInt32[Array, "2"]) -> PillarsGoal:
        """Draw a goal, a pillar on the way to it, and one more at either side of that pillar."""
        goal_key, pillar_key = jax.random.split(key)
        goal_w = super().sample(goal_key)
        distance = jnp.hypot(goal_w[0], goal_w[1])
        ahead = goal_w[:2] / distance
        left = jnp.stack([-ahead[1], ahead[0]])
        u = jax.random.uniform(pillar_key, (PILLARS, 2))
        along = CLEARANCE + u[:, 0] * (distance - 2 * CLEARANCE)
        # The first within 0.1 m of the straight line; the others 0.4 to 0.7 m to either side of it.
        aside = jnp.array([0.2, 0.3, 0.3]) * u[:, 1] + jnp.array([-0.1, 0.4, -0.7])
        places = along[:, None] * ahead + aside[:, None] * left
        height = jnp.full((PILLARS, 1), PILLAR_HEIGHT / 2)
        return PillarsGoal(goal_w, jnp.concatenate([places, height], axis=1))

    def observe(self, robot: RobotState, goal: PillarsGoal) -> Float[Array, " obs"]:
        """Return the base class's observation, then the pillars in the body frame by distance."""
        offset_w = goal.pillars_w[:, :2] - robot.position_w[:2]
        heading = kinematics.yaw(robot.quat)
        pillars_b = jax.vmap(kinematics.to_body, in_axes=(None, 0))(heading, offset_w)
        distance = jnp.linalg.norm(pillars_b, axis=1)
        nearest = jnp.argsort(distance)
        pillars_b, distance = pillars_b[nearest], distance[nearest]
        # The lower bound only guards the division: the bumper keeps the robot at a distance.
        direction = pillars_b / jnp.maximum(distance, 1e-3)[:, None]
        return jnp.concatenate(
            [super().observe(robot, goal), pillars_b.ravel(), direction.ravel(), distance]
        )

    def reward(
        self,
        before: RobotState,
        after: RobotState,
        goal: PillarsGoal,
        action: Float[Array, "2"],
    ) -> tuple[Float[Array, ""], Mapping[str, Float[Array, ""]]]:
        """Return the progress [m], less the cost of touching, plus a bonus at the goal."""
        progress, terms = super().reward(before, after, goal, action)
        contact = -CONTACT_COST * self.touches(after, goal).astype(jnp.float32)
        arrival = ARRIVAL * self.success(after, goal).astype(jnp.float32)
        return progress + contact + arrival, {**terms, "contact": contact, "arrival": arrival}

    def goal_position(self, goal: PillarsGoal) -> Float[Array, "3"]:
        """Return the position of the goal."""
        return goal.goal_w

    def move_goal(self, goal: PillarsGoal, position_w: Float[Array, "3"]) -> PillarsGoal:
        """Return the goal at another position, with the pillars unchanged."""
        return goal._replace(goal_w=position_w)

    def markers(self, goal: PillarsGoal) -> Mapping[str, Float[Array, "3"]]:
        """Return the positions of the red cube and of the solid pillars."""
        pillars = {f"pillar_{i}": goal.pillars_w[i] for i in range(PILLARS)}
        return {**super().markers(goal), **pillars}

    def build_scene(self, spec: mujoco.MjSpec) -> None:
        """Add a bumper to the robot, pillars to the scene, and a contact pair for each pillar.

        Geoms collide only where a pair exists: `contype` and `conaffinity` stay 0.
        """
        super().build_scene(spec)
        spec.body("jetbot").add_geom(
            name="bumper",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=(BUMPER_RADIUS, 0.0, 0.0),
            pos=BUMPER_POS,
            mass=0.0,
            group=3,
            contype=0,
            conaffinity=0,
        )
        for i in range(PILLARS):
            # Build the pillars away from the robot, which is first simulated until it rests.
            pillar = spec.worldbody.add_body(
                name=f"pillar_{i}", mocap=True, pos=(1.0, i - 1.0, PILLAR_HEIGHT / 2)
            )
            pillar.add_geom(
                type=mujoco.mjtGeom.mjGEOM_CYLINDER,
                size=(PILLAR_RADIUS, PILLAR_HEIGHT / 2, 0.0),
                rgba=(0.20, 0.38, 0.72, 1.0),
                contype=0,
                conaffinity=0,
            )
            # MJX computes a contact of sphere and capsule in closed form, but iterates for a
            # cylinder. At the height of the axle both have the same surface.
            pillar.add_geom(
                name=f"pillar_{i}",
                type=mujoco.mjtGeom.mjGEOM_CAPSULE,
                size=(PILLAR_RADIUS, PILLAR_HEIGHT / 2, 0.0),
                group=3,
                contype=0,
                conaffinity=0,
            )
            spec.add_pair(name=f"pillar_{i}", geomname1="bumper", geomname2=f"pillar_{i}", condim=1)

    def touches(self, robot: RobotState, goal: PillarsGoal) -> Bool[Array, ""]:
        """Return whether the bumper touches a pillar."""
        bumper_w = robot.position_w + kinematics.rotate(robot.quat, jnp.array(BUMPER_POS))
        gap = jnp.linalg.norm(goal.pillars_w[:, :2] - bumper_w[:2], axis=1)
        return (gap < PILLAR_RADIUS + BUMPER_RADIUS + TOUCH).any()
