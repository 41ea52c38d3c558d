"""Images beside those of `mujoco.Renderer`: outlines, colours, checkers, sky and light."""

import importlib
from unittest import mock

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco.rendering.classic import gl_context
from numpy.lib.stride_tricks import sliding_window_view

from helpers.camera_scenes import Scenes, make_model, turned
from helpers.further import slow_fixture
from jetbot_mjx.config import CameraConfig, Config
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.camera.render import Camera
from jetbot_mjx.envs.opengl import find_backend
from jetbot_mjx.envs.state import robot_state
from jetbot_mjx.errors import UserError
from onekernel import Kernel

SIDE = 224
FOVY = 75.0

SKY = '<texture type="skybox" builtin="gradient" rgb1="{}" rgb2="{}" width="256" height="256"/>'
CHECKER = """
<texture name="{name}" type="2d" builtin="checker" rgb1="0.9 0.8 0.3" rgb2="0.2 0.3 0.5"
  width="512" height="512"/>
<material name="{name}" texture="{name}" texrepeat="{repeat}" texuniform="{uniform}" specular="0"
  rgba="{rgba}"/>
"""
COLOURS = {
    "red": 'rgba="0.88 0.14 0.12 1" specular="0"',
    "blue": 'rgba="0.1 0.3 0.8 1" specular="0" emission="0.4"',
    "white": 'rgba="0.95 0.95 0.95 1" specular="0"',
}
MATERIALS = "".join(f'<material name="{name}" {looks}/>' for name, looks in COLOURS.items())
SUN = '<light type="directional" dir="{}" diffuse="{}" specular="0 0 0" castshadow="false" {}/>'

SEVERAL = [
    'type="box" size="0.08 0.05 0.1" material="red"',
    'type="sphere" size="0.08" material="blue"',
    'type="capsule" size="0.03 0.1" euler="0.3 0.8 0" rgba="0.2 0.7 0.3 1"',
    'type="cylinder" size="0.06 0.08" material="white"',
    'type="ellipsoid" size="0.05 0.1 0.15" euler="0.5 0.6 0.7" rgba="0.8 0.5 0.1 1"',
]
FEW = [
    'type="box" size="0.1 0.1 0.1" euler="0.3 0.2 0.9" material="white"',
    'type="cylinder" size="0.12 0.03" euler="0.9 0.4 0" material="blue"',
]


def several():
    """An endless floor, a sky that fades, the sun and the headlight; five solids."""
    assets = MATERIALS + SKY.format("0.78 0.86 0.94", "0.3 0.5 0.9")
    assets += CHECKER.format(name="floor", repeat="2 3", uniform="true", rgba="1 1 1 1")
    world = SUN.format("-0.12 0.15 -1", "0.6 0.6 0.57", "")
    world += '<geom name="floor" type="plane" size="0 0 0.1" material="floor"/>'
    return make_model(SEVERAL, world, assets, fovy=FOVY)


def stretched():
    """A finite floor whose checker is stretched over it, no sky, two suns of which one is off."""
    assets = MATERIALS + CHECKER.format(
        name="floor", repeat="3 2", uniform="false", rgba="0.9 0.7 0.8 1"
    )
    world = SUN.format("0.5 0.2 -1", "0.4 0.3 0.2", 'ambient="0.1 0.15 0.2"')
    world += SUN.format("-0.5 0.6 -0.8", "0.2 0.1 0.3", "")
    world += SUN.format("0 0 -1", "1 1 1", 'ambient="1 1 1" active="false"')
    world += '<geom name="floor" type="plane" size="1 0.6 0.1" material="floor" euler="0 0 0.4"/>'
    return make_model(FEW, world, assets, fovy=FOVY)


def two_planes():
    """A small uniform checker above an endless one that is not uniform, one sky of one colour."""
    assets = MATERIALS + SKY.format("0.4 0.6 0.7", "0.4 0.6 0.7")
    assets += CHECKER.format(name="floor", repeat="4 1.5", uniform="false", rgba="1 1 1 1")
    assets += CHECKER.format(name="upper", repeat="5 5", uniform="true", rgba="0.5 1 1 1")
    world = SUN.format("-0.3 0 -1", "0.5 0.5 0.5", "")
    world += '<geom name="floor" type="plane" size="0 0 0.1" material="floor"/>'
    world += (
        '<geom name="upper" type="plane" size="0.5 0.37 0.1" pos="0.8 0 0.05" material="upper"/>'
    )
    return make_model(FEW[:1], world, assets, fovy=FOVY)


@pytest.fixture(scope="module")
def opengl():
    try:
        context = importlib.import_module(f"mujoco.{find_backend()}").GLContext
    except UserError as error:
        pytest.skip(str(error))
    with mock.patch.object(gl_context, "GLContext", context, create=True):
        yield


class Beside:
    """One model's scenes in our pictures and in MuJoCo's, all of 224 x 224 pixels."""

    def __init__(self, model, count, seed):
        self.scenes = Scenes(model, width=SIDE, height=SIDE, fovy=FOVY, samples=1)
        self.drawn = self.draw(count, seed)
        self.images = self.scenes.render(*self.drawn)
        self.depths, self.ids = self.scenes.trace(*self.drawn)
        self.mj_images, self.mj_ids = self.mujoco()
        # What shows one geom in 5 x 5 pixels in both is away from edges.
        self.inside = np.stack(
            [_even(one) & _even(other) for one, other in zip(self.ids, self.mj_ids, strict=True)]
        )

    def draw(self, count, seed):
        rng = np.random.default_rng(seed)
        found = []
        while len(found) < count:
            places = rng.uniform(
                (0.2, -0.5, 0.05), (1.0, 0.5, 0.25), (len(self.scenes.names), 3)
            ).astype(np.float32)
            position = rng.uniform((-0.4, -0.2, 0.06), (0.0, 0.2, 0.6)).astype(np.float32)
            rotation = turned(*rng.uniform((-0.3, -0.1, -0.2), (0.3, 0.6, 0.2)))
            self.scenes.place(position, rotation, places)
            if self.scenes.clearance() > 0.02:
                found.append((position, rotation, places))
        return [np.stack(part) for part in zip(*found, strict=True)]

    def mujoco(self):
        model, images, ids = self.scenes.model, [], []
        with mujoco.Renderer(model, SIDE, SIDE) as renderer:
            for scene in zip(*self.drawn, strict=True):
                self.scenes.place(*scene)
                renderer.update_scene(self.scenes.data, camera="eye")
                renderer.scene.flags[mujoco.mjtRndFlag.mjRND_HAZE] = False
                images.append(renderer.render())
                renderer.enable_segmentation_rendering()
                found = renderer.render()
                geom = found[..., 1] == mujoco.mjtObj.mjOBJ_GEOM
                ids.append(np.where(geom, found[..., 0], -1))
                renderer.disable_segmentation_rendering()
        return np.stack(images), np.stack(ids)


def _even(ids):
    """Where all of the 5 x 5 pixels around a pixel show the same."""
    windows = sliding_window_view(np.pad(ids, 2, constant_values=-2), (5, 5))
    return (windows == ids[..., None, None]).all((-1, -2))


SCENES = {"several": (several, 4, 1), "stretched": (stretched, 3, 2), "planes": (two_planes, 3, 3)}


@slow_fixture(scope="module", params=list(SCENES))
def beside(request, opengl):
    build, count, seed = SCENES[request.param]
    return Beside(build(), count, seed)


def _range_around(images, reach):
    """The least and the greatest colour within some pixels of every pixel."""
    pad = [(0, 0), (reach, reach), (reach, reach), (0, 0)]
    side = 2 * reach + 1
    windows = sliding_window_view(np.pad(images, pad, mode="edge"), (side, side), axis=(1, 2))
    return windows.min((-1, -2)).astype(int), windows.max((-1, -2)).astype(int)


@pytest.mark.slow
def test_outlines_are_mujocos_to_one_pixel(beside):
    for ours, mujocos in zip(beside.ids, beside.mj_ids, strict=True):
        for geom in np.unique(mujocos):
            one, other = ours == geom, mujocos == geom
            if other.sum() > 400:
                assert (one & other).sum() / (one | other).sum() >= 0.97
        near = sliding_window_view(np.pad(mujocos, 1, mode="edge"), (3, 3))
        assert (near == ours[..., None, None]).any((-1, -2)).all()


def test_colours_are_mujocos(beside):
    """Solids and sky to 3 of 255, what is round to 6: OpenGL lights corners of its facets only.

    Away from outlines, and where MuJoCo's own colours one pixel around leave no doubt. Of a plane's
    checker, whose edges OpenGL blurs by a texel: two pixels around, and up to 0.6 m away.
    """
    kinds = {geom.geom_id: geom.kind for geom in beside.scenes.camera.scene.geoms}
    ours = beside.images.astype(int)
    for geom in np.unique(beside.ids):
        kind = kinds.get(geom, "sky")
        least, most = _range_around(beside.mj_images, 2 if kind == "plane" else 1)
        off = np.maximum(np.maximum(least - ours, ours - most), 0)
        compared = beside.inside & (beside.ids == geom)
        compared &= (beside.depths < 0.6) | (kind != "plane")
        assert off[compared].max(initial=0) <= (3 if kind in ("plane", "box", "sky") else 6), kind


def test_a_far_checker_has_mujocos_mean_colour(beside):
    """Where many squares lie in a pixel, no phase counts, only how both colours are mixed."""
    planes = [g.geom_id for g in beside.scenes.camera.scene.geoms if g.kind == "plane"]
    floor = np.isin(beside.ids, planes) & beside.inside
    far = floor & (beside.depths > 1.5) & (beside.depths < 20)
    if far.any():
        difference = beside.images[far].mean(0) - beside.mj_images[far].mean(0)
        assert np.abs(difference).max() < 2.0


def test_a_small_picture_looks_like_a_large_one_made_smaller(beside):
    """32 x 32 pixels of 2 x 2 rays beside means of 7 x 7 of MuJoCo's pixels, and of our own.

    The share of a pixel that an edge cuts is known to a quarter, and a checker's mean is that of
    the rectangle around the pixel's footprint: 3 of 255 in the mean, 40 where an edge runs.
    """
    small = Scenes(beside.scenes.model, width=32, height=32, fovy=FOVY, samples=2)
    images = small.render(*beside.drawn)
    for large in (beside.mj_images, beside.images):
        difference = np.abs(images - large.reshape(-1, 32, 7, 32, 7, 3).mean((2, 4)))
        assert difference.mean() < 3.0
        assert np.percentile(difference, 99) < 40


@pytest.mark.parametrize(
    "change",
    [
        {},
        {"lens": "fisheye", "colour": "grey", "samples": 1},
        pytest.param({"lens": "fisheye"}, marks=pytest.mark.slow),
        pytest.param({"colour": "grey", "samples": 1}, marks=pytest.mark.slow),
    ],
)
def test_the_kernel_draws_what_xla_draws(change):
    env = make_env(Config())
    shared = {"width": 24, "height": 24, **change}
    one, other = (
        Camera(CameraConfig(impl=impl, **shared), env.mj_model) for impl in ("auto", "xla")
    )
    keys = jax.random.split(jax.random.PRNGKey(0), 16)
    states = jax.jit(jax.vmap(env.reset))(keys)

    def images(camera):
        def render(state):
            robot = robot_state(state.pipeline_state)
            pose = camera.pose(robot.position_w, robot.quat)
            return camera.render(pose, env.task.markers(state.goal))

        return np.asarray(jax.jit(jax.vmap(render))(states)).astype(int)

    ours, theirs = images(one), images(other)
    assert all(isinstance(kernel, Kernel) for kernel in one.kernel_impl.kernels.values())
    assert len(one.kernel_impl.kernels) == 1
    assert not other.kernel_impl.kernels
    assert np.abs(ours - theirs).max() <= 1 or (np.abs(ours - theirs) > 1).mean() < 1e-3
    assert ours.std() > 10


def test_a_plane_that_is_infinite_one_way_only_ends_the_other_way():
    strip = '<geom type="plane" size="0.3 0 0.1" rgba="1 0 0 1"/>'
    scenes = Scenes(
        make_model([], strip, ""), width=16, height=16, fovy=FOVY, samples=1, impl="xla"
    )
    pose = scenes.camera.pose(jnp.array([0.0, 0.0, 0.1]), jnp.array([1.0, 0.0, 0.0, 0.0]))
    image, (_, found) = jax.jit(
        lambda: (scenes.camera.render(pose, {}), scenes.camera.trace(pose, {}))
    )()
    is_seen = np.asarray(found) >= 0
    assert 0 < is_seen.sum() < 112  # of 128 below the horizon
    assert ((np.asarray(image)[..., 0] > 0) == is_seen).all()


def test_a_light_that_is_off_may_have_a_position():
    lamp = '<light type="spot" pos="0 0 1" active="{}"/>'
    assert Scenes(make_model([], lamp.format("false"))).camera.scene.lights == ()
    with pytest.raises(UserError, match="has a position"):
        Scenes(make_model([], lamp.format("true")))
