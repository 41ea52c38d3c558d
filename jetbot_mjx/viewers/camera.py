"""Compute where a camera has to be to see given points."""

import numpy as np
from jaxtyping import Float


def camera_axes(ahead_w: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3 3"]:
    """Return the axes of a level camera as rows: right, up and ahead.

    Args:
      ahead_w: the direction of view, of any length, not vertical.
    """
    ahead = ahead_w / np.linalg.norm(ahead_w)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(right, ahead), ahead])


def eye_that_sees(
    points_w: Float[np.ndarray, "n 3"],
    axes_w: Float[np.ndarray, "3 3"],
    slopes: Float[np.ndarray, "4"],
    nearest: float,
) -> Float[np.ndarray, "3"]:
    """Return the nearest position from which a camera sees all points between its borders.

    In camera axes (x right, y up, z ahead), let the camera be at height s and at distance d
    behind the origin, and let k and k' be the slopes of the upper and lower borders. A point is
    below the upper border if y - s ≤ k (z + d), and above the lower border if s - y ≤ k' (z + d).
    One s satisfies both for all points if (k + k') d ≥ max(y - k z) - min(y + k' z). The same holds
    for left and right.

    Args:
      points_w: the points [m], world frame.
      axes_w: the result of `camera_axes`.
      slopes: the left, right, lower and upper border between which the points have to be, as
        distances from the view's axis per distance ahead.
      nearest: the smallest distance from the camera to a point, along its axis [m].
    """
    x, y, z = axes_w @ points_w.T
    left, right, below, above = slopes
    distance = max(
        nearest - z.min(),
        (np.max(x - right * z) - np.min(x + left * z)) / (left + right),
        (np.max(y - above * z) - np.min(y + below * z)) / (below + above),
    )
    # Centre the camera between the smallest and the largest offsets that see all points.
    ahead = z + distance
    aside = (np.max(x - right * ahead) + np.min(x + left * ahead)) / 2
    height = (np.max(y - above * ahead) + np.min(y + below * ahead)) / 2
    return np.array([aside, height, -distance]) @ axes_w
