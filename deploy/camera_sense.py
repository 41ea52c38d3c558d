"""Drive by the robot's camera alone: the newest picture, a watchdog, and the end of a drive.

It needs Python 3.6 and NumPy. A camera has `value`, the newest picture as NVIDIA's `jetbot.Camera`
has it: uint8 of shape [height, width, 3], blue, green, red, the first row above.

A picture counts if it is one, is at least as large as the policy's image, differs from the one
before (the noise of a sensor makes no two alike), and is not black. While the newest that counts is
older than `stale_after` the motors stand still, and the robot drives on when the next one comes.

A policy that sees does not know its distance from the goal. The goal is reached when it stands on
the floor `arrive_within` metres from the axle: the image shows its colour where the floor at that
distance would be.
"""

import base64
import math
from typing import Any, NamedTuple, Optional

import numpy as np
from motors import Calibration, DriveError
from observations import Reading
from poses import Odometry
from undistort import LensCalibration, Reducer, distort_once

FRAME_STALE_AFTER = 0.25
"""[s] Four pictures at 20 a second may be lost. The motors are at zero within a control period
more."""

ARRIVE_WITHIN = 0.045
"""[m] from the axle to the nearest edge of the cube; its centre is then 0.095 to 0.116 m away, and
the success radius of training is 0.098 m on the floor."""

GOAL_COLOUR = (224, 36, 31)
"""Red, green and blue of the cube; only their ratio counts."""

_SIDE = 224  # [pixels] of the pictures that NVIDIA's camera is asked for
_BLACK = 10.0  # mean of a picture below which it is black; white is 255
_DIM = 30  # a pixel whose brightest channel is below has no colour
_LEAST_CHROMA = 0.1
_ARC = math.radians(75.0)  # bearings to both sides at which the floor is looked at
_ARC_POINTS = 61
_LEAST_POINTS = 10  # of the arc in the image
_ARRIVED = 0.12  # share of the arc's visible points that the goal covers when it is reached
_GREY = (0.299, 0.587, 0.114)  # weights of red, green and blue, as in training


class CameraSettings(NamedTuple):
    """The settings of a drive by camera."""

    stale_after: float = FRAME_STALE_AFTER
    """Age of a picture above which the motors are stopped [s]."""
    arrive_within: float = ARRIVE_WITHIN
    """Distance from the axle to the nearest edge of the goal, when it is reached [m]."""
    goal_colour: tuple = GOAL_COLOUR
    """Red, green and blue of the goal."""
    goal: Optional[tuple] = None
    """Position (x, y) of the goal from the start [m], for the log alone; None: not known."""
    lens: Optional[LensCalibration] = None
    """The lens to take out of the pictures; None: the policy knows it."""


def make_camera() -> Any:
    """Return the camera of NVIDIA's package `jetbot`.

    Raises:
      DriveError: The package is not installed, or the camera does not start.
    """
    try:
        from jetbot import Camera  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise DriveError(f"there is no camera here ({error}): run this on the JetBot")
    try:
        return Camera.instance(width=_SIDE, height=_SIDE)
    except RuntimeError as error:
        raise DriveError(f"the camera does not start: {error}")


def floor_arc(spec: dict, distance: float) -> tuple:
    """Return the pixels that show the floor at a distance from the axle, all around ahead.

    Args:
      spec: The policy spec.
      distance: The distance [m].

    Returns:
      Rows and columns of the image.

    Raises:
      DriveError: The camera does not see the floor there.
    """
    image, camera = spec["image"], spec["image"]["camera"]
    bearings = np.linspace(-_ARC, _ARC, _ARC_POINTS)
    zero = np.zeros_like(bearings)
    points = np.stack([distance * np.cos(bearings), distance * np.sin(bearings), zero], axis=1)
    points[:, 2] = -spec["rest_height"]
    points -= np.asarray(camera["position"])
    pitch = math.radians(camera["pitch_down_degrees"])
    ahead = np.array([math.cos(pitch), 0.0, -math.sin(pitch)])
    right = np.array([0.0, -1.0, 0.0])
    depth = np.dot(points, ahead)
    before = np.maximum(depth, 1e-6)
    x, y = np.dot(points, right) / before, np.dot(points, np.cross(ahead, right)) / before
    lens = LensCalibration((1, 1), (), tuple(camera["distortion"]), camera["lens"] == "fisheye")
    x, y, once = distort_once(x, y, calibration=lens)
    matrix = camera["matrix"]
    columns = np.rint(x * matrix["fx"] + matrix["cx"]).astype(int)
    rows = np.rint(y * matrix["fy"] + matrix["cy"]).astype(int)
    seen = once & (depth > 0) & (columns >= 0) & (columns < image["width"])
    seen &= (rows >= 0) & (rows < image["height"])
    if seen.sum() < _LEAST_POINTS:
        raise DriveError(
            f"--arrive-within {distance:g}: the camera does not see the floor there; give more"
        )
    return rows[seen], columns[seen]


def colour_share(pixels: np.ndarray, colour: tuple) -> float:
    """Return the share of pixels that have a colour, whatever its brightness.

    A pixel counts if its chromaticity is nearer to the colour's than to grey, along the line
    between them.

    Args:
      pixels: The pixels, uint8 of shape [n, 3], red, green, blue.
      colour: Red, green and blue.

    Raises:
      DriveError: The colour is grey.
    """
    values = pixels.astype(np.float32)
    towards = np.asarray(colour, np.float32) / max(float(sum(colour)), 1e-6) - np.float32(1 / 3)
    length = float(np.dot(towards, towards))
    if not sum(colour) or length < _LEAST_CHROMA**2:
        raise DriveError(f"--goal-colour {' '.join(map(str, colour))} is grey: the goal needs one")
    chroma = values / np.maximum(values.sum(axis=1, keepdims=True), 1.0) - np.float32(1 / 3)
    counts = (np.dot(chroma, towards) > 0.5 * length) & (values.max(axis=1) >= _DIM)
    return float(counts.mean())


class CameraSense:
    """What a policy needs to know, from a camera; dead reckoning is logged beside it."""

    name = "camera"

    def __init__(
        self, camera: Any, policy: Any, calibration: Calibration, settings: CameraSettings
    ) -> None:
        """Check that the policy needs images only.

        Args:
          camera: The camera, with `value`.
          policy: The policy, with `spec` and `stack`.
          calibration: The calibration of the motors, for dead reckoning.
          settings: The settings of the drive.

        Raises:
          DriveError: The policy needs something else, or the goal's colour is none.
        """
        if "image" not in policy.spec:
            raise DriveError("--camera: this policy observes numbers: give --goal X Y instead")
        if policy.spec["observation"]:
            name = policy.spec["observation"][0]["name"]
            raise DriveError(f"--camera: the policy needs {name} beside the image: train another")
        self._camera, self._policy, self._settings = camera, policy, settings
        self._image_spec = policy.spec["image"]
        self._odometry = Odometry(calibration)
        self._reducers = {}  # type: dict
        self._before = None  # type: Optional[np.ndarray]
        self._image = None  # type: Optional[np.ndarray]
        self._near = 0.0
        self._time = 0.0
        self._stacked = None  # type: Optional[np.ndarray]
        self._arc = floor_arc(policy.spec, settings.arrive_within)
        colour_share(np.zeros((1, 3), np.uint8), settings.goal_colour)

    def example(self) -> tuple:
        """Return the inputs of the policy's first call, which takes longest."""
        shape = self._image_spec["height"], self._image_spec["width"]
        return (self._stack(np.zeros((*shape, 3), np.uint8), None),)

    def read(self, now: float) -> Reading:
        """Look at the newest picture.

        Args:
          now: The time on the driver's clock [s].
        """
        pose = self._odometry.read(now)
        line = {"x": pose.x, "y": pose.y, "yaw": pose.yaw, "pose_age": 0.0}  # type: dict
        problem = self._take(self._camera.value, now)
        fresh = self._image is not None and now - self._time <= self._settings.stale_after
        if self._image is None or not fresh:
            # What was seen before a gap says nothing about the movement after it.
            self._stacked = None
            return Reading(False, False, (), None, dict(line, problem=problem or "late"))
        line.update(frame_age=now - self._time, near=self._near)
        if problem is None:
            line["picture"] = base64.b64encode(self._image.tobytes()).decode()
        else:
            line["problem"] = problem
        self._stacked = self._stack(self._image, self._stacked)
        reached = self._near >= _ARRIVED
        return Reading(True, reached, (self._stacked,), None, line)

    def commanded(self, now: float, left: float, right: float) -> None:
        """Store the speeds [m/s] that the wheels are commanded from now on."""
        self._odometry.commanded(now, left, right)

    def close(self) -> None:
        """Stop the camera, if it can be stopped."""
        stop = getattr(self._camera, "stop", None)
        if stop is not None:
            stop()

    def _take(self, picture: Any, now: float) -> Optional[str]:
        """Take a picture if it counts; otherwise return why not."""
        if not (
            isinstance(picture, np.ndarray)
            and picture.dtype == np.uint8
            and picture.ndim == 3
            and picture.shape[2] == 3
        ):
            return "missing"
        shape = picture.shape[:2]
        if shape[0] < self._image_spec["height"] or shape[1] < self._image_spec["width"]:
            return "too small"
        if self._before is not None and np.array_equal(picture, self._before):
            return "no new picture"
        self._before = picture.copy()
        if picture.mean() < _BLACK:
            return "black"
        if shape not in self._reducers:
            self._reducers = {shape: Reducer(self._image_spec, shape, self._settings.lens)}
        # The camera's channels are blue, green, red.
        image = self._reducers[shape](picture)[:, :, ::-1]
        self._near = colour_share(image[self._arc], self._settings.goal_colour)
        self._image = image
        self._time = now
        return None

    def _stack(self, image: np.ndarray, before: Optional[np.ndarray]) -> np.ndarray:
        if self._image_spec["grey"]:
            image = np.floor(np.dot(image.astype(np.float32), _GREY) + 0.5)[:, :, None]
            image = image.astype(np.uint8)
        if self._image_spec["frames"] == 1:
            return np.ascontiguousarray(image)
        return self._policy.stack(image, before)
