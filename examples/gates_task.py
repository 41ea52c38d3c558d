"""A task with a memory: drive through gates, one after the other.

    jetbot-mjx train gates

The number of gates passed is part of the goal, and `advance` counts it. A gate counts when the
robot's axle midpoint crosses the line between its posts from the front; a robot that misses one
has to turn around and try again.
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Bool, Float, Int32, UInt32

from jetbot_mjx.config import TaskConfig
from jetbot_mjx.envs import Field, GoalTask, RobotState, kinematics

GATES = 3
OPENING = 0.3  # [m] between the axes of a gate's posts; the robot is 0.13 m wide
POST_RADIUS = 0.015  # [m]
POST_HEIGHT = 0.2  # [m]

LEG = (0.35, 0.55)  # [m] from one gate to the next
FIRST_TURN = 1.5  # [rad] largest bearing of the first gate from the start, to either side
TURN = 1.1  # [rad] largest turn from one leg to the next, to either side
BONUS = 0.2  # [m] reward for passing a gate, in the unit of progress


class GatesGoal(NamedTuple):
    """The course of one episode, and the robot's progress on it."""

    gates_w: Float[Array, "gates 3"]
    """Middles of the gates [m], at half the posts' height."""
    headings: Float[Array, " gates"]
    """Direction in which to pass each gate [rad], counter-clockwise from the world's x axis."""
    passed: Int32[Array, ""]
    """Number of gates that the robot has passed."""


class GatesTask(GoalTask):
    """A task to drive through all gates, in their order and direction."""

    def __init__(self, config: TaskConfig) -> None:
        """Build the task; it ignores `task.observation` and the settings of the goal."""
        super().__init__(config)
        self.layout = (
            Field("gate_position", 2, "m", "body"),
            Field("gate_direction", 2, "1", "body"),
            Field("gate_heading", 2, "1", "body"),
            Field("next_gate_position", 2, "m", "body"),
            Field("next_gate_heading", 2, "1", "body"),
            Field("gates_left", 1, "1", "body"),
            Field("forward_speed", 1, "m/s", "body"),
            Field("yaw_rate", 1, "rad/s", "body"),
        )

    def sample(self, key: UInt32[Array, "2"]) -> GatesGoal:
        """Draw a course: each leg turns from the one before, and a gate stands at its end.

        headingₖ = headingₖ₋₁ + turnₖ,  gateₖ = gateₖ₋₁ + legₖ · (cos headingₖ, sin headingₖ)
        """
        turn_key, leg_key = jax.random.split(key)
        most = jnp.array([FIRST_TURN] + [TURN] * (GATES - 1))
        headings = jnp.cumsum(most * jax.random.uniform(turn_key, (GATES,), minval=-1.0))
        legs = jax.random.uniform(leg_key, (GATES, 1), minval=LEG[0], maxval=LEG[1])
        places = jnp.cumsum(legs * _direction(headings), axis=0)
        gates_w = jnp.concatenate([places, jnp.full((GATES, 1), POST_HEIGHT / 2)], axis=1)
        return GatesGoal(gates_w, headings, jnp.int32(0))

    def advance(self, before: RobotState, after: RobotState, goal: GatesGoal) -> GatesGoal:
        """Return the goal with the gate counted that the robot passed in this step."""
        ahead_before, _ = self._seen_from_gate(before, goal)
        ahead_after, aside = self._seen_from_gate(after, goal)
        through = (ahead_before < 0) & (ahead_after >= 0) & (jnp.abs(aside) < OPENING / 2)
        still = goal.passed < GATES
        return goal._replace(passed=goal.passed + (through & still).astype(jnp.int32))

    def observe(self, robot: RobotState, goal: GatesGoal) -> Float[Array, " obs"]:
        """Return the next two gates in the body frame; at the end the last gate twice."""
        heading = kinematics.yaw(robot.quat)

        def seen(index: Int32[Array, ""]) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
            index = jnp.minimum(index, GATES - 1)
            offset_w = goal.gates_w[index, :2] - robot.position_w[:2]
            return (
                kinematics.to_body(heading, offset_w),
                _direction(goal.headings[index] - heading),
            )

        gate_b, gate_heading_b = seen(goal.passed)
        next_b, next_heading_b = seen(goal.passed + 1)
        # The lower bound only guards the division.
        direction = gate_b / jnp.maximum(jnp.hypot(*gate_b), 1e-3)
        forward_speed = kinematics.to_body(heading, robot.linear_velocity_w[:2])[0]
        left = jnp.float32(GATES) - goal.passed
        rest = jnp.stack([left, forward_speed, robot.angular_velocity_w[2]])
        return jnp.concatenate([gate_b, direction, gate_heading_b, next_b, next_heading_b, rest])

    def reward(
        self,
        before: RobotState,
        after: RobotState,
        goal: GatesGoal,
        action: Float[Array, "2"],
    ) -> tuple[Float[Array, ""], Mapping[str, Float[Array, ""]]]:
        """Return the progress towards the next gate [m], and a bonus for passing it."""
        del action
        progress = self._to_gate(before, goal) - self._to_gate(after, goal)
        passed = self.advance(before, after, goal).passed - goal.passed
        bonus = BONUS * passed.astype(jnp.float32)
        return progress + bonus, {"progress": progress, "gate": bonus}

    def success(self, robot: RobotState, goal: GatesGoal) -> Bool[Array, ""]:
        """Return whether all gates are passed; that also ends the episode."""
        del robot
        return goal.passed >= GATES

    def goal_position(self, goal: GatesGoal) -> Float[Array, "3"]:
        """Return the position of the last gate."""
        return goal.gates_w[-1]

    def move_goal(self, goal: GatesGoal, position_w: Float[Array, "3"]) -> GatesGoal:
        """Return the whole course, shifted so that its last gate stands at the position."""
        shift = (position_w - goal.gates_w[-1]).at[2].set(0.0)
        return goal._replace(gates_w=goal.gates_w + shift)

    def markers(self, goal: GatesGoal) -> Mapping[str, Float[Array, "3"]]:
        """Return the positions of the posts; the tutorial's cube is below the floor."""
        left = _direction(goal.headings + jnp.pi / 2) * OPENING / 2
        left = jnp.concatenate([left, jnp.zeros((GATES, 1))], axis=1)
        posts = {f"gate_{i}_left": goal.gates_w[i] + left[i] for i in range(GATES)}
        posts |= {f"gate_{i}_right": goal.gates_w[i] - left[i] for i in range(GATES)}
        return {"goal": jnp.array([0.0, 0.0, -1.0]), **posts}

    def build_scene(self, spec: mujoco.MjSpec) -> None:
        """Add the posts: mocap bodies, placed by `markers`, that take no part in physics."""
        super().build_scene(spec)
        for i in range(GATES):
            # The colour goes from light to dark, in the order of the gates.
            shade = 1.0 - i / GATES
            for side in ("left", "right"):
                post = spec.worldbody.add_body(name=f"gate_{i}_{side}", mocap=True)
                post.add_geom(
                    type=mujoco.mjtGeom.mjGEOM_CYLINDER,
                    size=(POST_RADIUS, POST_HEIGHT / 2, 0.0),
                    rgba=(shade, 0.45 * shade, 0.1, 1.0),
                    contype=0,
                    conaffinity=0,
                )

    def _to_gate(self, robot: RobotState, goal: GatesGoal) -> Float[Array, ""]:
        """Return the distance on the floor to the middle of the next gate [m]."""
        gate_w = goal.gates_w[jnp.minimum(goal.passed, GATES - 1), :2]
        return jnp.linalg.norm(gate_w - robot.position_w[:2])

    def _seen_from_gate(self, robot: RobotState, goal: GatesGoal) -> Float[Array, "2"]:
        """Return how far the robot is behind the next gate, and left of its middle [m]."""
        index = jnp.minimum(goal.passed, GATES - 1)
        offset_w = robot.position_w[:2] - goal.gates_w[index, :2]
        return kinematics.to_body(goal.headings[index], offset_w)


def _direction(angle: Float[Array, "*n"]) -> Float[Array, "*n 2"]:
    """Return the unit vector at an angle."""
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
