"""Directions of pixels: lens models written forward and independently, in float64."""

import mujoco
import numpy as np
import pytest

from helpers.camera_scenes import ROBOT, make_model
from jetbot_mjx.config import CameraConfig, ConfigError, parse_config
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.camera.lens import Footprint, Rays, intrinsics, pixel_grid
from jetbot_mjx.envs.camera.render import Camera
from jetbot_mjx.errors import InvalidError

JETBOT = {"width": 224, "height": 224, "matrix": (114.0, 113.0, 113.5, 110.0)}
"""A wide lens: 160 degrees from corner to corner, as calibrations of JetBots give it."""

HALF = {"width": 112, "height": 112, "matrix": (57.0, 56.5, 56.5, 54.75)}
"""The same lens, with pixels of twice the size."""

RADIAL = {"lens": "opencv", "distortion": (-0.05, 0.01)}


def _whole(config, rays):
    shape = config.height, config.width
    return Rays(*(np.broadcast_to(np.asarray(x, np.float32), shape) for x in rays))


def footprint(config):
    """The centres of all pixels and their differences, as arrays of the image's size."""
    grid = pixel_grid(config)
    return Footprint(*(_whole(config, rays) for rays in grid.expand(grid.columns)[1]))


def sample_rays(config, samples):
    grid = pixel_grid(config.model_copy(update={"samples": samples}))
    return [_whole(config, rays) for rays in grid.expand(grid.columns)[0]]


def project_opencv(x, y, coefficients):
    """Distort directions as OpenCV's documentation of `projectPoints` states it."""
    k1, k2, p1, p2, k3, k4, k5, k6 = np.pad(coefficients, (0, 8 - len(coefficients)))
    r = np.sqrt(x**2 + y**2)
    radial = (1 + k1 * r**2 + k2 * r**4 + k3 * r**6) / (1 + k4 * r**2 + k5 * r**4 + k6 * r**6)
    return (
        radial * x + 2 * p1 * x * y + p2 * (r**2 + 2 * x**2),
        radial * y + p1 * (r**2 + 2 * y**2) + 2 * p2 * x * y,
    )


def project_fisheye(x, y, coefficients):
    """Distort directions as OpenCV's documentation of `fisheye::projectPoints` states it."""
    r = np.sqrt(x**2 + y**2)
    theta = np.arctan(r)
    distorted = theta + sum(k * theta ** (2 * i + 3) for i, k in enumerate(coefficients))
    scale = np.divide(distorted, r, out=np.ones_like(r), where=r > 0)
    return x * scale, y * scale


MODELS = {"opencv": project_opencv, "fisheye": project_fisheye, "pinhole": lambda x, y, _: (x, y)}


def pixels_of(config, rays, matrix):
    """Project directions, and return how far from their pixels they arrive [pixels]."""
    x, y = np.broadcast_arrays(np.asarray(rays.x, float), np.asarray(rays.y, float))
    x, y = MODELS[config.lens](x, y, config.distortion)
    fx, fy, cx, cy = matrix
    right, down = np.meshgrid(np.arange(config.width), np.arange(config.height))
    return fx * x + cx - right, fy * y + cy - down


@pytest.mark.parametrize(
    "camera",
    [
        JETBOT,
        JETBOT | {"lens": "fisheye"},
        JETBOT | {"lens": "fisheye", "distortion": (-0.02, 0.01, -0.004, 0.0005)},
        HALF | RADIAL,
        JETBOT | RADIAL,
        {"width": 64, "height": 48, "matrix": (60.0, 61.0, 30.0, 25.0), "lens": "opencv"}
        | {"distortion": (-0.3, 0.1, 0.002, -0.003, -0.02)},
        {"width": 64, "height": 48, "matrix": (60.0, 61.0, 30.0, 25.0), "lens": "opencv"}
        | {"distortion": (0.5, 0.2, 0.001, 0.001, 0.02, 0.6, 0.3, 0.05)},
    ],
    ids=[
        "pinhole",
        "equidistant",
        "fisheye",
        "radial",
        "radial of many pixels",
        "tangential",
        "rational",
    ],
)
def test_every_pixel_comes_back(camera):
    config = CameraConfig(**camera)
    off = pixels_of(config, footprint(config).centre, config.matrix)
    assert np.abs(off).max() < 1e-3

    # Points within the pixels, row by row, and the change across a pixel.
    samples = sample_rays(config, 2)
    for rays, (down, right) in zip(samples, np.ndindex(2, 2), strict=True):
        across, along = pixels_of(config, rays, config.matrix)
        np.testing.assert_allclose(across, right / 2 - 0.25, atol=1e-3)
        np.testing.assert_allclose(along, down / 2 - 0.25, atol=1e-3)


def test_a_camera_without_a_matrix_has_mujocos_field_of_view():
    model = make_model(["type='sphere' size='0.1'"], fovy=70.0)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    scene = mujoco.MjvScene(model, 10)
    camera = mujoco.MjvCamera()
    camera.type, camera.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, model.camera("eye").id
    everything = mujoco.mjtCatBit.mjCAT_ALL
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, camera, everything, scene)
    frustum = scene.camera[0]
    upper = frustum.frustum_top / frustum.frustum_near

    config = CameraConfig(width=40, height=30, fovy=70.0)
    rays, pixel = footprint(config).centre, footprint(config).down.y
    assert rays.y[0, 0] - pixel[0, 0] / 2 == pytest.approx(-upper, rel=1e-6)
    assert rays.x[0, -1] + footprint(config).right.x[0, -1] / 2 == pytest.approx(
        upper * 40 / 30, rel=1e-6
    )


def test_a_fisheye_without_a_matrix_has_its_field_of_view_too():
    config = CameraConfig(width=31, height=31, lens="fisheye", fovy=115.0)
    top = footprint(config).centre.y[0, 15]
    assert np.degrees(np.arctan(top)) == pytest.approx(-115 / 2 * 30 / 31, rel=1e-6)


def test_a_calibration_counts_for_other_sizes():
    """A point of the sensor keeps its direction, so that small pixels tile large ones."""
    large = CameraConfig(**JETBOT, lens="fisheye", distortion=(-0.02, 0.01))
    small = large.model_copy(update={"width": 32, "height": 56, "calibration_size": (224, 224)})
    assert intrinsics(small).fx == pytest.approx(114 / 7)
    of_seven, of_four = footprint(large).centre, footprint(small).centre
    # The middle pixel of 7 columns, and the middle of 4 rows, which lies between two.
    rows = (of_seven.y[1::4, 3::7] + of_seven.y[2::4, 3::7]) / 2
    np.testing.assert_allclose(of_four.x, of_seven.x[1::4, 3::7], rtol=0.02, atol=0.02)
    np.testing.assert_allclose(of_four.y, rows, rtol=0.02, atol=0.02)
    off = pixels_of(small, of_four, intrinsics(small))
    assert np.abs(off).max() < 1e-3


@pytest.mark.parametrize(
    "camera",
    [
        # The radius of the image turns back before the corners.
        JETBOT | {"lens": "opencv", "distortion": (-0.3,)},
        # It turns twice: the corners would be found beyond, where the image repeats.
        JETBOT | {"lens": "opencv", "distortion": (-0.8, 0.25)},
        # No pixel lies near either turn: each is found exactly, on one of both sides.
        {"width": 8, "height": 8, "matrix": (4.0, 4.0, 3.5, 3.5), "lens": "opencv"}
        | {"distortion": (-0.8, 0.2592), "samples": 1},
        JETBOT | {"lens": "opencv", "distortion": (0.0, 0.0, 0.0, 0.0, 0.0, -0.5)},
        JETBOT | {"lens": "opencv", "distortion": (1e30,)},
        JETBOT | {"lens": "fisheye", "distortion": (-0.5,)},
        # The corners would look backwards.
        JETBOT | {"lens": "fisheye", "matrix": (60.0, 60.0, 112.0, 112.0)},
        {"lens": "fisheye", "fovy": 170.0},
    ],
)
def test_an_invalid_lens_is_refused_in_one_line(camera):
    with pytest.raises(InvalidError, match=r"^camera\.") as error:
        Camera(CameraConfig(**camera), make_model([]), ROBOT)
    assert "\n" not in str(error.value)
    assert "is not a lens: every pixel should look" in str(error.value)


def test_an_environment_says_what_is_wrong_with_its_lens():
    config = parse_config(
        {"task": {"observation": "camera"}, "camera": {"lens": "fisheye", "fovy": 170.0}}
    )
    with pytest.raises(InvalidError, match=r"^camera\."):
        make_env(config)


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        ({"distortion": [0.1]}, "camera: distortion has 1 coefficients: lens = pinhole takes"),
        ({"lens": "fisheye", "distortion": [0.1] * 5}, "takes at most 4"),
        ({"lens": "opencv", "distortion": [float("inf")]}, "should be finite numbers"),
        ({"matrix": [1, 2, 3]}, "camera.matrix"),
        ({"matrix": [-1, 2, 3, 4]}, "camera.matrix"),
        ({"position": [0.1, 0.2]}, "camera.position"),
        ({"position": 0.1}, "camera.position = 0.1 is wrong: it should be a list"),
        ({"width": 7}, "camera.width = 7 is wrong"),
        ({"width": 16.5}, "camera.width = 16.5 is wrong"),
        ({"height": 513}, "camera.height = 513 is wrong"),
        ({"frames": 0}, "camera.frames = 0 is wrong"),
        ({"samples": 9}, "camera.samples = 9 is wrong"),
        ({"fovy": 180}, "camera.fovy = 180 is wrong"),
        ({"pitch": 91}, "camera.pitch = 91 is wrong"),
        ({"colour": "blue"}, "camera.colour = 'blue' is wrong"),
        ({"lens": "wide"}, "camera.lens = 'wide' is wrong"),
        ({"color": "rgb"}, "camera.color = 'rgb' is unknown: did you mean camera.colour?"),
        ({"calibration_size": [224, 224]}, "camera: calibration_size"),
    ],
)
def test_a_wrong_camera_is_refused_in_one_line(camera, message):
    with pytest.raises(ConfigError) as error:
        parse_config({"camera": camera})
    assert "\n" not in str(error.value)
    assert message in str(error.value)
