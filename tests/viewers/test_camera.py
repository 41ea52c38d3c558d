"""Where a camera stands to see given points."""

import numpy as np
import pytest

from jetbot_mjx.viewers.camera import camera_axes, eye_that_sees

SLOPES = np.array([0.5, 0.25, 0.4, 0.3])  # left, right, lower and upper border


@pytest.mark.parametrize("ahead", [(1.0, 0.0, 0.0), (0.0, 3.0, -1.0), (-1.0, 1.0, 5.0)])
def test_the_axes_are_those_of_a_level_camera(ahead):
    axes = camera_axes(np.array(ahead))
    right, up, along = axes
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(along, ahead / np.linalg.norm(ahead))
    np.testing.assert_allclose(np.cross(right, up), -along, atol=1e-12)
    assert right[2] == pytest.approx(0)
    assert up[2] > 0


def slack(points, eye, axes):
    """Distances of the points from the four borders, inwards [m]."""
    x, y, z = axes @ (points - eye).T
    left, right, below, above = SLOPES
    return np.stack([x + left * z, right * z - x, y + below * z, above * z - y])


def test_all_points_are_seen_and_one_pair_of_borders_is_touched():
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3))
    axes = camera_axes(np.array([1.0, 2.0, -0.5]))
    eye = eye_that_sees(points, axes, SLOPES, nearest=0.01)
    room = slack(points, eye, axes).min(axis=1)
    assert room.min() > -1e-9
    touched = np.isclose(room, 0)
    assert touched[:2].all() or touched[2:].all()
    # A little nearer, and a point is outside.
    assert slack(points, eye + 0.01 * axes[2], axes).min() < 0


def test_no_point_is_nearer_than_asked_for():
    axes = camera_axes(np.array([1.0, 0.0, 0.0]))
    eye = eye_that_sees(np.zeros((1, 3)), axes, SLOPES, nearest=0.7)
    assert axes[2] @ -eye == pytest.approx(0.7)
