"""Depth and segmentation: what `mj_ray` finds along the ray through every pixel's centre."""

import numpy as np
import pytest

from helpers.camera_scenes import Scenes, make_model, turned

FLOOR = '<geom type="plane" size="0 0 0.1"/>'
ALL_KINDS = [
    'type="box" size="0.05 0.08 0.1"',
    'type="sphere" size="0.07"',
    'type="capsule" size="0.03 0.1"',
    'type="cylinder" size="0.06 0.08"',
    'type="ellipsoid" size="0.05 0.1 0.15"',
    'type="box" size="0.04 0.1 0.02" euler="0.4 0.9 -0.6"',
    'type="cylinder" size="0.1 0.02" euler="1.2 0.3 0.5"',
    'type="capsule" size="0.02 0.15" euler="-0.7 1.4 0.2"',
]
FEW = ['type="box" size="0.05 0.05 0.05"']
TURNED = [
    'type="plane" size="0.3 0.2 0.1" euler="0.3 -0.4 0.8"',
    'type="ellipsoid" size="0.03 0.12 0.06" euler="0.5 0.6 0.7"',
    'type="box" size="0.15 0.05 0.1" euler="0 0 0.5"',
]


def pinhole(width, height, fovy):
    """Directions (x, y) of the pixels' centres."""
    focal = height / 2 / np.tan(np.radians(fovy) / 2)
    across = (np.arange(width)[None] + 0.5 - width / 2) / focal
    return across, (np.arange(height)[:, None] + 0.5 - height / 2) / focal


def draw(scenes, count, seed):
    """Random scenes: poses (n, 3) and (n, 3, 3), places (n, bodies, 3); the eye outside of all.

    A third of the cameras look along an axis exactly, half of these at a body's very height and
    side; a third stand millimetres to centimetres from a surface; overlaps happen by themselves.
    """
    rng = np.random.default_rng(seed)
    found = []
    while len(found) < count:
        index = len(found)
        places = rng.uniform((-0.5, -0.5, 0.0), (0.5, 0.5, 0.3), (len(scenes.names), 3))
        position = rng.uniform((-1.0, -1.0, 0.02), (1.0, 1.0, 0.6))
        rotation = turned(*rng.uniform((-np.pi, -0.6, -0.3), (np.pi, 1.0, 0.3)))
        if index % 3 == 0:
            rotation = turned(np.pi / 2 * rng.integers(4), np.pi / 2 * (index % 12 == 0))
            if index % 2:
                # In a body's plane of symmetry, where a coordinate is exactly zero.
                position[1:] = places[0, 1:] = places[0, 1:].astype(np.float32)
        places, position = places.astype(np.float32), position.astype(np.float32)
        scenes.place(position, rotation, places)
        clearance = scenes.clearance()
        if clearance > 1e-3 and (index % 3 != 1 or clearance < 0.03):
            found.append((position, rotation, places))
    return [np.stack(part) for part in zip(*found, strict=True)]


@pytest.mark.parametrize(
    ("geoms", "world", "size", "fovy", "count"),
    [
        (ALL_KINDS, FLOOR, (25, 16), 90.0, 90),
        (FEW, FLOOR, (21, 21), 70.0, 70),
        (TURNED, "", (16, 27), 100.0, 70),
    ],
    ids=["eight kinds on a floor", "a cube on a floor", "turned, without a floor"],
)
def test_every_pixel_is_what_mj_ray_finds(geoms, world, size, fovy, count):
    width, height = size
    scenes = Scenes(make_model(geoms, world), width=width, height=height, fovy=fovy)
    drawn = draw(scenes, count, seed=width)
    depth, ids = scenes.trace(*drawn)

    x, y = pinhole(width, height, fovy)
    wanted_depth, wanted_ids = np.empty_like(depth, np.float64), np.empty_like(ids)
    for index, scene in enumerate(zip(*drawn, strict=True)):
        scenes.place(*scene)
        wanted_depth[index], wanted_ids[index] = scenes.mj_trace(*scene[:2], x, y)

    # The scenes hold what they should: every geom and the open sky.
    assert len(np.unique(wanted_ids)) == len(geoms) + bool(world) + 1
    same = ids == wanted_ids
    assert same.mean() >= 0.999, f"{same.mean():.5f}, worst {same.mean((1, 2)).argmin()}"
    seen = same & (ids >= 0)
    np.testing.assert_allclose(depth[seen], wanted_depth[seen], rtol=1e-3)
    assert np.isinf(depth[ids == -1]).all()
