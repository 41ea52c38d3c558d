"""Observations as `policy.json` lays them out, from a pose on the floor and a goal.

Python 3.6 and the standard library. Height and tilt are those of the robot at rest.
"""

import math

from motors import DriveError
from poses import Pose

# The floor under the distance in `goal_direction`, as in training [m].
_NEAR = 1e-3


class Observer:
    """Makes the observation that one policy wants."""

    def __init__(self, contract: dict) -> None:
        """Looks whether all that is wanted can be made.

        Args:
          contract: `policy.json`.

        Raises:
          DriveError: the policy wants something else.
        """
        self._contract = contract
        self._wanted = [
            (part["name"], part["frame"], len(part["index"])) for part in contract["observation"]
        ]
        known = self._parts(Pose(0.0, 0.0, 0.0, 0.0, 0.0, 0.0), (1.0, 0.0))
        for name, frame, size in self._wanted:
            if len(known.get((name, frame), ())) != size:
                raise DriveError(
                    f"the policy wants {name} ({size} numbers, {frame} frame), which this driver"
                    " cannot give: add it to observations.py"
                )

    def __call__(self, pose: Pose, goal: tuple) -> list:
        """The observation, in the policy's order.

        Args:
          pose: of the robot.
          goal: (x, y) in the frame of the pose [m].
        """
        parts = self._parts(pose, goal)
        return [number for name, frame, _ in self._wanted for number in parts[name, frame]]

    def _parts(self, pose: Pose, goal: tuple) -> dict:
        cos, sin = math.cos(pose.yaw), math.sin(pose.yaw)
        x, y = goal[0] - pose.x, goal[1] - pose.y
        ahead, left = cos * x + sin * y, cos * y - sin * x
        distance = math.hypot(ahead, left)
        length = max(distance, _NEAR)
        # The heading times the attitude at rest; its sign goes on over whole turns, as MuJoCo's.
        c, s = math.cos(0.5 * pose.yaw), math.sin(0.5 * pose.yaw)
        w, i, j, k = self._contract["rest_quaternion"]
        return {
            ("position", "world"): [pose.x, pose.y, self._contract["rest_height"]],
            ("quaternion", "world"): [c * w - s * k, c * i - s * j, c * j + s * i, c * k + s * w],
            ("linear_velocity", "world"): [pose.speed * cos, pose.speed * sin, 0.0],
            ("angular_velocity", "world"): [0.0, 0.0, pose.yaw_rate],
            ("goal_position", "world"): [goal[0], goal[1], self._contract["goal_height"]],
            ("goal_position", "body"): [ahead, left],
            ("goal_direction", "body"): [ahead / length, left / length],
            ("goal_distance", "body"): [distance],
            ("forward_speed", "body"): [pose.speed],
            ("yaw_rate", "body"): [pose.yaw_rate],
        }
