"""Reduce a camera's picture to the image of a policy, and take out the lens's distortion.

It needs Python 3.6 and NumPy, and no OpenCV. A pixel of the image is the mean of its area in the
picture, as in training. With a calibration of OpenCV the area is looked up through the lens, so
that the image is that of the camera without distortion that the policy was trained with.
"""

import re
from typing import NamedTuple, Optional

import numpy as np
from motors import DriveError

_LEAST_COVERED = 0.75
"""Least share of the image's points that must lie in the picture."""

_LARGEST_SIDE = 100000
"""Largest side of a picture [pixels]."""

_MOST_CHARACTERS = 1000000
"""Longest file of a calibration."""

_LARGEST_NUMBER = 1e6
"""Largest number of a calibration: a length in pixels, or a coefficient without a unit."""

_TURN_STEPS = 64
"""Steps from the optical axis to a direction in which a polynomial that turns back is found."""

_MATRIX = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "K")
_DISTORTION = ("distortion_coefficients", "dist_coeffs", "distCoeffs", "Distortion_Coefficients")
_DISTORTION += ("D",)


class LensCalibration(NamedTuple):
    """A calibration of OpenCV."""

    size: tuple
    """Width and height of the pictures of the calibration [pixels]."""
    matrix: tuple
    """fx, fy, cx, cy [pixels]."""
    distortion: tuple
    """Coefficients in OpenCV's order, at most 8; of a fisheye at most 4."""
    fisheye: bool
    """Whether they are those of `cv2.fisheye`."""


def read_lens(path: str) -> LensCalibration:
    """Read a calibration that `cv2.FileStorage`, OpenCV's samples or ROS wrote.

    Args:
      path: A YAML file with `camera_matrix`, `distortion_coefficients`, `image_width` and
        `image_height`. `fisheye_model: 1` or `distortion_model: equidistant` says that the
        coefficients are those of `cv2.fisheye`.

    Raises:
      DriveError: The file is missing, or is not a calibration.
    """
    try:
        with open(path, encoding="utf-8") as file:
            text = file.read(_MOST_CHARACTERS)
    except OSError as error:
        raise DriveError(f"--undistort {path}: {error.strerror}")
    except UnicodeDecodeError:
        raise DriveError(f"--undistort {path} is not a calibration: it is not text")
    matrix = _numbers(text, _MATRIX, path)
    if len(matrix) != 9:
        raise DriveError(f"--undistort {path}: camera_matrix has {len(matrix)} numbers, not 9")
    distortion = tuple(_numbers(text, _DISTORTION, path))
    kind = re.search(r"^\s*distortion_model:\s*\"?(\w+)", text, re.MULTILINE)
    fisheye = bool(re.search(r"^\s*fisheye_model:\s*1", text, re.MULTILINE))
    fisheye = fisheye or (kind is not None and kind.group(1) in ("equidistant", "fisheye"))
    most = 4 if fisheye else 8
    if any(distortion[most:]):
        raise DriveError(f"--undistort {path}: this lens takes {most} coefficients at most")
    fx, fy, cx, cy = matrix[0], matrix[4], matrix[2], matrix[5]
    if not (fx > 0 and fy > 0):
        raise DriveError(f"--undistort {path}: fx = {fx:g} and fy = {fy:g} should be above 0")
    return LensCalibration(_size(text, path), (fx, fy, cx, cy), distortion[:most], fisheye)


def _numbers(text: str, names: tuple, path: str) -> list:
    # Only these keys may stand before the list: the next one with a list is another matrix.
    before = r"(?:[^\[:]|\b(?:rows|cols|dt|data):)*?"
    found = re.search(
        r"^\s*(?:" + "|".join(names) + "):" + before + r"\[([^\]]*)\]", text, re.MULTILINE
    )
    if found is None:
        raise DriveError(
            f"--undistort {path} is not a calibration: it lacks {names[0]} with its data in [...]"
        )
    try:
        numbers = [float(one) for one in found.group(1).replace(",", " ").split()]
    except ValueError as error:
        raise DriveError(f"--undistort {path} is not a calibration: {names[0]}: {error}")
    for number in numbers:
        if not abs(number) <= _LARGEST_NUMBER:
            raise DriveError(f"--undistort {path}: {names[0]} has {number:g}, which no lens has")
    return numbers


def _size(text: str, path: str) -> tuple:
    pair = re.search(r"^\s*cameraResolution:\s*\[\s*(\d+),?\s+(\d+)", text, re.MULTILINE)
    sides = [] if pair is None else [_side(pair.group(1)), _side(pair.group(2))]
    for name in () if pair else ("image_width", "image_height"):
        found = re.search(r"^\s*" + name + r":\s*(\d+)", text, re.MULTILINE | re.IGNORECASE)
        if found is None:
            raise DriveError(f"--undistort {path} is not a calibration: it lacks {name}")
        sides.append(_side(found.group(1)))
    if not 1 <= min(sides) <= max(sides) <= _LARGEST_SIDE:
        raise DriveError(
            f"--undistort {path}: pictures of {sides[0]} x {sides[1]} pixels are impossible"
        )
    return sides[0], sides[1]


def _side(digits: str) -> int:
    """Return a number, or one that is too large for more digits than Python reads."""
    return int(digits) if len(digits) < 10 else _LARGEST_SIDE + 1


class Reducer:
    """A function from a picture of one size to the image of a policy, in colour."""

    def __init__(
        self, image: dict, shape: tuple, calibration: Optional[LensCalibration] = None
    ) -> None:
        """Compute which parts of the picture make up each pixel.

        Args:
          image: The entry `image` of the policy spec.
          shape: Height and width of the picture [pixels].
          calibration: The lens to take out; None: the picture is only made smaller.

        Raises:
          DriveError: The policy was trained with a lens, or the picture shows too little.
        """
        self._size = image["height"], image["width"]
        self._points = None  # type: Optional[tuple]
        if calibration is None:
            self._rows, self._columns = (
                _area_weights(small, large) for small, large in zip(self._size, shape)
            )
        else:
            self._points = _points(image, shape, calibration)

    def __call__(self, picture: np.ndarray) -> np.ndarray:
        """Return the image, uint8 of shape [height, width, 3], colours in the picture's order.

        Args:
          picture: The picture, uint8 of shape [height, width, 3].
        """
        values = picture.astype(np.float32)
        if self._points is None:
            values = np.tensordot(self._rows, values, (1, 0))
            values = np.tensordot(values, self._columns, (1, 1)).transpose(0, 2, 1)
        else:
            (row, lower, down), (column, further, right) = self._points
            upper = values[row, column] * (1 - right) + values[row, further] * right
            under = values[lower, column] * (1 - right) + values[lower, further] * right
            values = (upper * (1 - down) + under * down).mean(axis=2)
        return np.floor(values + np.float32(0.5)).astype(np.uint8)


def _area_weights(small: int, large: int) -> np.ndarray:
    """Return the share of each of `large` pixels in each of `small`; every row adds up to 1."""
    edges = np.arange(small + 1) * (float(large) / small)
    starts = np.arange(large)
    overlap = np.minimum(edges[1:, None], starts + 1) - np.maximum(edges[:-1, None], starts)
    weights = np.maximum(overlap, 0.0)
    return (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)


def _points(image: dict, shape: tuple, calibration: LensCalibration) -> tuple:
    """Return rows and columns of the picture, with the next ones and the shares of those."""
    camera = image["camera"]
    if camera["lens"] != "pinhole":
        raise DriveError(
            f"--undistort: the policy was trained with the lens {camera['lens']!r}, and takes the"
            " picture as it is"
        )
    height, width = shape
    samples = max(1, int(np.ceil(max(height / image["height"], width / image["width"]) / 2)))
    matrix = camera["matrix"]
    offsets = (np.arange(samples) + 0.5) / samples - 0.5
    down, right = (one.reshape(-1) for one in np.meshgrid(offsets, offsets, indexing="ij"))
    x = (np.arange(image["width"])[None, :, None] + right - matrix["cx"]) / matrix["fx"]
    y = (np.arange(image["height"])[:, None, None] + down - matrix["cy"]) / matrix["fy"]
    x, y, once = distort_once(*np.broadcast_arrays(x, y), calibration=calibration)
    fx, fy, cx, cy = calibration.matrix
    # The origin is the middle of the first pixel, and stays half a pixel from the corner.
    scale_x, scale_y = width / calibration.size[0], height / calibration.size[1]
    columns = (x * fx + cx + 0.5) * scale_x - 0.5
    rows = (y * fy + cy + 0.5) * scale_y - 0.5
    inside = once & (columns > -1) & (columns < width) & (rows > -1) & (rows < height)
    if not inside.mean() >= _LEAST_COVERED:
        raise DriveError(
            f"--undistort: the picture shows {inside.mean():.0%} of what the policy was trained to"
            f" see, and {_LEAST_COVERED:.0%} are needed: train with this lens (docs/camera.md)"
        )
    return _between(rows, height), _between(columns, width)


def _between(at: np.ndarray, count: int) -> tuple:
    at = np.clip(at, 0, count - 1)
    low = np.floor(at).astype(int)
    return low, np.minimum(low + 1, count - 1), (at - low)[..., None].astype(np.float32)


def distort_once(x: np.ndarray, y: np.ndarray, *, calibration: LensCalibration) -> tuple:
    """Return where a lens shows a direction, if its polynomial shows no nearer one there.

    Beyond the directions of its calibration a polynomial may turn back towards the middle, where
    the lens shows something else.

    Args:
      x: Direction x/z, to the right.
      y: Direction y/z, down.
      calibration: The lens.

    Returns:
      x and y before the camera matrix, and whether the polynomial has not turned; where it has,
      x and y are those at the turn.
    """
    found_x, found_y = np.zeros_like(x), np.zeros_like(y)
    once = np.ones(x.shape, bool)
    for part in np.linspace(0.0, 1.0, _TURN_STEPS + 1)[1:]:
        bent_x, bent_y = distort(part * x, part * y, calibration=calibration)
        once &= np.hypot(bent_x, bent_y) >= np.hypot(found_x, found_y)
        found_x, found_y = np.where(once, bent_x, found_x), np.where(once, bent_y, found_y)
    return found_x, found_y, once


def distort(x: np.ndarray, y: np.ndarray, *, calibration: LensCalibration) -> tuple:
    """Return where a lens shows a direction, by OpenCV's models.

    Args:
      x: Direction x/z, to the right.
      y: Direction y/z, down.
      calibration: The lens.

    Returns:
      x and y before the camera matrix.
    """
    k = calibration.distortion + (0.0,) * (8 - len(calibration.distortion))
    r2 = x * x + y * y
    if calibration.fisheye:
        radius = np.sqrt(r2)
        angle = np.arctan(radius)
        a2 = angle * angle
        bent = angle * (1 + a2 * (k[0] + a2 * (k[1] + a2 * (k[2] + a2 * k[3]))))
        scale = np.where(radius > 1e-9, bent / np.maximum(radius, 1e-9), 1.0)
        return x * scale, y * scale
    k1, k2, p1, p2, k3, k4, k5, k6 = k
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y),
    )
