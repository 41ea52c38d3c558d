"""Compute the observations that `policy.json` lists, from a pose on the floor and a goal.

It needs Python 3.6 and the standard library. Height and tilt are those of the robot at rest.
"""

import math

from motors import DriveError
from poses import Pose

# Least distance by which `goal_direction` divides, as in training [m].
_MIN_DISTANCE = 1e-3


class Observer:
    """A function from a pose and a goal to the observation of one policy."""

    def __init__(self, spec: dict) -> None:
        """Check that all parts of the observation can be computed.

        Args:
          spec: The policy spec, `policy.json`.

        Raises:
          DriveError: The policy needs something else.
        """
        self._spec = spec
        self._layout = [
            (part["name"], part["frame"], len(part["index"])) for part in spec["observation"]
        ]
        known = self._parts(Pose(0.0, 0.0, 0.0, 0.0, 0.0, 0.0), (1.0, 0.0))
        for name, frame, size in self._layout:
            if len(known.get((name, frame), ())) != size:
                raise DriveError(
                    f"the policy needs {name} ({size} numbers, {frame} frame), which this driver"
                    " cannot provide: add it to observations.py"
                )

    def __call__(self, pose: Pose, goal: tuple) -> list:
        """Return the observation, in the order of the policy.

        Args:
          pose: The robot's pose.
          goal: Position (x, y) of the goal in the frame of the pose [m].
        """
        parts = self._parts(pose, goal)
        return [number for name, frame, _ in self._layout for number in parts[name, frame]]

    def _parts(self, pose: Pose, goal: tuple) -> dict:
        cos, sin = math.cos(pose.yaw), math.sin(pose.yaw)
        x, y = goal[0] - pose.x, goal[1] - pose.y
        ahead, left = cos * x + sin * y, cos * y - sin * x
        distance = math.hypot(ahead, left)
        length = max(distance, _MIN_DISTANCE)
        # Product of heading and attitude at rest; as in MuJoCo, its sign changes with every turn.
        c, s = math.cos(0.5 * pose.yaw), math.sin(0.5 * pose.yaw)
        w, i, j, k = self._spec["rest_quaternion"]
        return {
            ("position", "world"): [pose.x, pose.y, self._spec["rest_height"]],
            ("quaternion", "world"): [c * w - s * k, c * i - s * j, c * j + s * i, c * k + s * w],
            ("linear_velocity", "world"): [pose.speed * cos, pose.speed * sin, 0.0],
            ("angular_velocity", "world"): [0.0, 0.0, pose.yaw_rate],
            ("goal_position", "world"): [goal[0], goal[1], self._spec["goal_height"]],
            ("goal_position", "body"): [ahead, left],
            ("goal_direction", "body"): [ahead / length, left / length],
            ("goal_distance", "body"): [distance],
            ("forward_speed", "body"): [pose.speed],
            ("yaw_rate", "body"): [pose.yaw_rate],
        }
