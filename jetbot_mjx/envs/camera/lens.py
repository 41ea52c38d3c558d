"""Compute the direction in which every pixel of a camera looks.

Frames: image coordinates as in OpenCV, x to the right, y down, z along the optical axis; pixel
(0, 0) is the upper left one, and its centre lies at (0, 0). Directions are scaled to z = 1.

Everything here is NumPy and runs once: a lens costs a compiled program nothing but the constants.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jetbot_mjx.config import CameraConfig
from jetbot_mjx.envs.camera.geometry import Scalar
from jetbot_mjx.errors import InvalidError

_MAX_ANGLE = np.radians(89.0)


class Rays(NamedTuple):
    """A `Rays` holds directions (x, y, 1), as arrays that broadcast or as scalars of one pixel."""

    x: Scalar
    y: Scalar


class Footprint(NamedTuple):
    """A `Footprint` holds the centre of pixels and how the direction changes across them."""

    centre: Rays
    right: Rays
    """Change of (x, y) to the next pixel on the right."""
    down: Rays
    """Change of (x, y) to the next pixel below."""


class Intrinsics(NamedTuple):
    """An `Intrinsics` holds a camera matrix in pixels, as OpenCV calibrates it."""

    fx: float
    fy: float
    cx: float
    cy: float


def intrinsics(config: CameraConfig) -> Intrinsics:
    """Return the camera matrix for the size of the image.

    Args:
      config: the camera section; without a matrix, `fovy` and the middle of the image count.
    """
    width, height = config.width, config.height
    if config.matrix is not None:
        of_width, of_height = config.calibration_size or (width, height)
        fx, fy, cx, cy = config.matrix
        right, down = width / of_width, height / of_height
        # The middle of the upper left pixel is the origin, and stays half a pixel from the corner.
        return Intrinsics(fx * right, fy * down, (cx + 0.5) * right - 0.5, (cy + 0.5) * down - 0.5)
    half = np.radians(config.fovy) / 2
    focal = height / 2 / (half if config.lens == "fisheye" else np.tan(half))
    return Intrinsics(focal, focal, (width - 1) / 2, (height - 1) / 2)


class PixelGrid(NamedTuple):
    """A `PixelGrid` holds what differs between the pixels of a camera, and what follows from it."""

    columns: tuple[Float[np.ndarray, "h w"], ...]
    """Arrays that broadcast to the size of the image."""
    expand: Callable[[Sequence[Scalar]], tuple[list[Rays], Footprint]]
    """From the columns, or their entries for one pixel, to the directions of its samples, row by
    row, and to its footprint."""


def pixel_grid(config: CameraConfig) -> PixelGrid:
    """Return the directions of a regular grid of `samples`² points within every pixel.

    Args:
      config: the camera section.
    """
    points = (np.arange(config.samples) + 0.5) / config.samples - 0.5
    offsets = [(right, down) for down in points for right in points]
    centre = _rays(config, 0.0, 0.0)
    if not config.distortion and config.lens != "fisheye":
        # Without distortion, directions are linear in the pixel: compute all from its centre.
        matrix = intrinsics(config)
        pitch_x, pitch_y = 1 / matrix.fx, 1 / matrix.fy

        def expand_linear(columns: Sequence[Scalar]) -> tuple[list[Rays], Footprint]:
            x, y = columns
            rays = [Rays(x + right * pitch_x, y + down * pitch_y) for right, down in offsets]
            return rays, Footprint(Rays(x, y), Rays(pitch_x, 0.0), Rays(0.0, pitch_y))

        return PixelGrid(tuple(map(np.asarray, centre)), expand_linear)
    left, right = _rays(config, -0.5, 0.0), _rays(config, 0.5, 0.0)
    upper, lower = _rays(config, 0.0, -0.5), _rays(config, 0.0, 0.5)
    samples = [_rays(config, *offset) for offset in offsets]

    def expand(columns: Sequence[Scalar]) -> tuple[list[Rays], Footprint]:
        centre, to_right, to_lower, *rays = (
            Rays(*columns[i : i + 2]) for i in range(0, len(columns), 2)
        )
        return rays, Footprint(centre, to_right, to_lower)

    to_right = Rays(right.x - left.x, right.y - left.y)
    to_lower = Rays(lower.x - upper.x, lower.y - upper.y)
    every = [centre, to_right, to_lower, *samples]
    return PixelGrid(tuple(np.asarray(column) for rays in every for column in rays), expand)


def _rays(config: CameraConfig, right: float, down: float) -> Rays:
    """Return the directions of all pixels' points at an offset from their centres [pixels]."""
    matrix = intrinsics(config)
    x = (np.arange(config.width)[None, :] + right - matrix.cx) / matrix.fx
    y = (np.arange(config.height)[:, None] + down - matrix.cy) / matrix.fy
    if config.lens == "fisheye":
        x, y = _undistort_fisheye(x, y, config.distortion)
    elif config.distortion:
        x, y = _undistort(x, y, config.distortion)
    return Rays(np.asarray(x, np.float32), np.asarray(y, np.float32))


def _undistort(
    x: np.ndarray, y: np.ndarray, coefficients: tuple[float, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Invert OpenCV's radial and tangential distortion (k1, k2, p1, p2, k3, k4, k5, k6).

    x" = x (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶) + 2 p1 x y + p2 (r² + 2 x²),
    and y" likewise with p1 and p2 exchanged; solved by Newton's method from x" itself.

    Raises:
      InvalidError: the coefficients do not describe a lens for the whole image.
    """
    k1, k2, p1, p2, k3, k4, k5, k6 = (*coefficients, *[0.0] * (8 - len(coefficients)))

    def distort(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return x" and y", and the derivatives dx"/dx, dx"/dy = dy"/dx and dy"/dy."""
        r2 = x * x + y * y
        above, below = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        radial = above / below
        # By the square of the radius.
        rising = k1 + r2 * (2 * k2 + r2 * 3 * k3) - radial * (k4 + r2 * (2 * k5 + r2 * 3 * k6))
        rising = 2 * rising / below
        return (
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y),
            radial + x * x * rising + 2 * p1 * y + 6 * p2 * x,
            x * y * rising + 2 * p1 * x + 2 * p2 * y,
            radial + y * y * rising + 2 * p2 * x + 6 * p1 * y,
        )

    wanted_x, wanted_y = np.broadcast_arrays(x, y)
    x, y = wanted_x, wanted_y
    # Coefficients that describe no lens may overflow here; the check of the error refuses them.
    with np.errstate(all="ignore"):
        for _ in range(50):
            at_x, at_y, xx, xy, yy = distort(x, y)
            error_x, error_y = wanted_x - at_x, wanted_y - at_y
            if max(np.abs(error_x).max(), np.abs(error_y).max()) < 1e-12:
                break
            determinant = xx * yy - xy * xy
            x = x + (yy * error_x - xy * error_y) / determinant
            y = y + (xx * error_y - xy * error_x) / determinant
        at_x, at_y, *_ = distort(x, y)
        error = np.maximum(np.abs(at_x - wanted_x), np.abs(at_y - wanted_y))
        # Past a turning point of the polynomial the image would show a direction twice. All pixels
        # lie between the centre and the image's edge.
        edge = [np.concatenate([z[0], z[-1], z[:, 0], z[:, -1]]) for z in (x, y)]
        *_, xx, xy, yy = distort(*(np.linspace(0.0, 1.0, 65)[:, None] * z for z in edge))
        if not (np.all(xx * yy - xy * xy > 0) and np.all(error < 1e-5)):
            raise _no_lens(coefficients)
    return x, y


def _undistort_fisheye(
    x: np.ndarray, y: np.ndarray, coefficients: tuple[float, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Invert OpenCV's fisheye model: r = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸).

    Raises:
      InvalidError: a corner would look 89 degrees aside or more, or the polynomial turns.
    """
    powers = np.array([1.0, *coefficients])
    x, y = np.broadcast_arrays(x, y)
    radius = np.hypot(x, y)
    angles = np.linspace(0.0, _MAX_ANGLE, 20_001)
    radii = angles * np.polynomial.polynomial.polyval(angles**2, powers)
    if (np.diff(radii) <= 0).any() or radius.max() > radii[-1]:
        raise _no_lens(coefficients)
    angle = np.interp(radius, radii, angles)
    scale = np.where(radius > 1e-9, np.tan(angle) / np.maximum(radius, 1e-9), 1.0)
    return x * scale, y * scale


def _no_lens(coefficients: tuple[float, ...]) -> InvalidError:
    return InvalidError(
        f"camera.distortion = {list(coefficients)} with this lens, matrix and field of view is not"
        " a lens: every pixel should look less than 89 degrees aside, in a direction of its own"
    )
