"""Compute the observations that `policy.json` lists, from a pose on the floor and a goal.

A sense tells the driver what it needs in every control period: `PoseSense` from a pose source, and
`CameraSense` of camera_sense.py from pictures.

It needs Python 3.6 and the standard library. Height and tilt are those of the robot at rest.
"""

import math
from typing import Any, NamedTuple, Optional

from motors import DriveError
from poses import Pose

# Least distance by which `goal_direction` divides, as in training [m].
_MIN_DISTANCE = 1e-3


class Reading(NamedTuple):
    """What a sense tells in one control period."""

    fresh: bool
    """Whether it is new enough to drive by."""
    reached: bool
    """Whether the goal is reached."""
    inputs: tuple
    """The inputs of the policy; empty unless `fresh`."""
    distance: Optional[float]
    """Distance from the goal [m]; None: not known."""
    line: dict
    """Entries for the log."""


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


class PoseSense:
    """What a policy needs to know, from a pose source and a goal."""

    def __init__(self, poses: Any, spec: dict, settings: Any) -> None:
        """Check that the observation can be computed.

        Args:
          poses: A pose source of `poses.py`.
          spec: The policy spec.
          settings: Goal, `stale_after` and `arrive_within` of the drive.

        Raises:
          DriveError: The policy needs an observation that this driver cannot provide.
        """
        self._poses, self._settings = poses, settings
        if "image" in spec:
            raise DriveError("this policy sees: drive with --camera")
        self._observe = Observer(spec)

    def example(self) -> tuple:
        """Return the inputs of the policy's first call, which takes longest."""
        return (self._observe(Pose(0.0, 0.0, 0.0, 0.0, 0.0, 0.0), self._settings.goal),)

    def read(self, now: float) -> Reading:
        """Read the newest pose.

        Args:
          now: The time on the driver's clock [s].
        """
        pose, goal = self._poses.read(now), self._settings.goal
        if pose is None:
            return Reading(False, False, (), None, {})
        fresh = now - pose.time <= self._settings.stale_after
        distance = math.hypot(goal[0] - pose.x, goal[1] - pose.y)
        line = dict(pose._asdict(), pose_age=now - pose.time)
        del line["time"]
        inputs = (self._observe(pose, goal),) if fresh else ()
        reached = fresh and distance < self._settings.arrive_within
        return Reading(fresh, reached, inputs, distance, line)

    def commanded(self, now: float, left: float, right: float) -> None:
        """Pass the speeds [m/s] on to the pose source."""
        self._poses.commanded(now, left, right)
