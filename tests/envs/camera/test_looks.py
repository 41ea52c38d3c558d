"""What each look changes in the image, and what it does not."""

import dataclasses
import functools
import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jetbot_mjx.config import CameraConfig, Config, LookParams
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.camera.looks import PLAIN, Appearance, add_noise
from jetbot_mjx.envs.camera.render import Camera
from jetbot_mjx.envs.camera.scene import GOAL
from jetbot_mjx.envs.camera.surroundings import draw_surroundings

SIDE = 48
FOCAL = SIDE / 2  # [pixels] of 90 degrees
HEIGHT = 0.0325  # [m] of the axle midpoint
CUBE = np.array([0.5, 0.0, 0.05])
LATE = ("camera_delay", "camera_interval", "frame_drop")
PLACED = ("walls", "clutter")  # need surroundings to show anything
NAMES = [n for n in LookParams._fields if n not in (*LATE, *PLACED, "pixel_noise")]
# Of looks that the renderer asks for together, as of a colour's red and blue, one in each of these.
PROGRAMS = (
    (
        *("cube_brightness", "floor_brightness", "sky_brightness", "light", "camera_x"),
        *("camera_pitch", "cube_yaw", "floor_contrast", "exposure", "focal_length"),
    ),
    (
        *("cube_red", "floor_red", "sky_red", "light_x", "camera_y"),
        *("camera_roll", "floor_texture", "floor_scale", "red_gain", "blur"),
    ),
    (
        *("cube_blue", "floor_blue", "sky_blue", "light_y", "camera_z"),
        *("camera_yaw", "floor_yaw", "ambient", "blue_gain", "distortion"),
    ),
)
TOGETHER = LookParams(
    cube_brightness=0.8,
    cube_red=1.1,
    cube_blue=1.7,
    cube_yaw=0.5,
    floor_brightness=0.6,
    floor_red=1.2,
    floor_blue=0.8,
    floor_contrast=2.0,
    floor_texture=2,
    floor_scale=0.4,
    floor_yaw=0.3,
    sky_brightness=0.7,
    sky_red=1.1,
    sky_blue=0.8,
    walls=0.4,
    clutter=4,
    ambient=0.8,
    light=1.2,
    light_x=0.5,
    light_y=-0.5,
    exposure=1.2,
    red_gain=0.9,
    blue_gain=1.1,
    blur=0.7,
    camera_x=0.02,
    camera_y=0.003,
    camera_z=-0.004,
    camera_pitch=0.05,
    camera_roll=0.05,
    camera_yaw=0.05,
    focal_length=1.1,
    distortion=0.1,
)


@dataclasses.dataclass
class Eye:
    """A camera on a robot at the origin, and a cube half a metre ahead of it.

    Looks of one of its programs are data together: what is compiled for one of them serves all.
    """

    camera: Camera
    programs: tuple[tuple[str, ...], ...] = PROGRAMS

    def see(self, surroundings=PLAIN.surroundings, *, cube=CUBE, **looks):
        params = LookParams(**looks)
        return self.see_all(Appearance(params, surroundings), cube)

    def see_all(self, appearance, cube=CUBE):
        params = appearance.params
        differ = {name for name in params._fields if params.differs(name)}
        traced = differ.union(*(names for names in self.programs if differ & {*names}))
        values = {name: np.float32(getattr(params, name)) for name in sorted(traced)}
        return np.asarray(self._render(values, appearance.surroundings, np.float32(cube)))

    @functools.cached_property
    def _render(self):
        @jax.jit
        def render(values, surroundings, cube):
            params = LookParams()._replace(**values)
            pose = self.camera.pose(jnp.array([0.0, 0.0, HEIGHT]), jnp.eye(4)[0], params)
            return self.camera.render(pose, {GOAL: cube}, Appearance(params, surroundings))

        return render

    def draw(self, objects=4, key=0):
        """Walls and objects around the robot."""
        return self._draw(objects, jax.random.PRNGKey(key))

    @functools.cached_property
    def _draw(self):
        @functools.partial(jax.jit, static_argnums=0)
        def draw(objects, key):
            params = LookParams(walls=jnp.float32(0.4), clutter=jnp.float32(objects))
            return draw_surroundings(key, params, objects, self.camera.scene, jnp.asarray(CUBE))

        return draw


@functools.cache
def mj_model():
    return make_env(Config()).mj_model


def make_eye(**camera):
    settings = {"width": SIDE, "height": SIDE, "fovy": 90.0, "pitch": 0.0} | camera
    return Eye(Camera(CameraConfig(**settings), mj_model()))


@pytest.fixture(scope="module")
def eye():
    return make_eye()


@pytest.fixture(scope="module")
def eye_far_above():
    return make_eye(pitch=90.0, position=(0.26, 0.26, 2.5), samples=1)


@pytest.fixture(scope="module")
def plain(eye):
    return eye.see().astype(float)


def is_cube(image):
    """Pixels that are clearly redder than anything else."""
    red, green, blue = np.moveaxis(image.astype(float), -1, 0)
    return (red > 2.5 * green) & (red > 2.5 * blue)


FLOOR, SKY, CUBE_PLACE = np.s_[36:, :], np.s_[:12, :], np.s_[25:27, 23:25]
PLACES = {"cube": CUBE_PLACE, "floor": FLOOR, "sky": SKY}


def test_plain_looks_are_the_plain_image_to_the_bit_and_its_kernel(eye):
    kernels = set(eye.camera.kernel_impl.kernels)
    np.testing.assert_array_equal(eye.see_all(PLAIN), eye.see())
    assert len(set(eye.camera.kernel_impl.kernels) | kernels) == 1


def only_another_value_changes_the_image(eye, names):
    """Check looks one by one, as data of the image and not as constants of the kernel."""
    cube = (0.5, 0.1, 0.05)
    plain = eye.see(cube=cube).astype(int)
    same = {name: jnp.float32(getattr(LookParams(), name)) for name in names}
    assert np.abs(eye.see(cube=cube, **same) - plain).max() <= 1
    for name in names:
        other = eye.see(cube=cube, **same | {name: jnp.float32(getattr(TOGETHER, name))})
        assert (np.abs(other - plain) > 1).sum() > 8, name


@pytest.mark.parametrize("names", PROGRAMS, ids=["brightness", "red", "blue"])
def test_only_another_value_than_the_plain_one_changes_the_image(eye, names):
    only_another_value_changes_the_image(eye, names)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_look_that_alone_is_data_changes_the_image(eye, name):
    only_another_value_changes_the_image(Eye(eye.camera, programs=()), [name])


def test_every_look_of_a_pixel_is_data_of_one_program():
    assert sorted(itertools.chain(*PROGRAMS)) == sorted(NAMES)


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize(
    ("part", "factors"),
    [("brightness", (0.7, 0.7, 0.7)), ("red", (0.7, 1, 1)), ("blue", (1, 1, 0.7))],
)
def test_a_tint_multiplies_the_colour_of_its_place_and_of_no_other(
    eye, plain, place, part, factors
):
    image = eye.see(**{f"{place}_{part}": 0.7})
    for other, pixels in PLACES.items():
        wanted = plain[pixels] * (factors if other == place else 1.0)
        np.testing.assert_allclose(image[pixels], wanted, atol=1.01, err_msg=other)


@pytest.mark.parametrize(
    ("name", "factors"),
    [("exposure", (0.6, 0.6, 0.6)), ("red_gain", (0.6, 1, 1)), ("blue_gain", (1, 1, 0.6))],
)
def test_exposure_and_white_balance_multiply_channels(eye, plain, name, factors):
    np.testing.assert_allclose(eye.see(**{name: 0.6}), plain * factors, atol=1.01)


def test_an_image_that_is_exposed_too_long_is_white(eye):
    assert (eye.see(exposure=8.0)[SKY] == 255).all()


def test_contrast_is_about_the_mean_of_the_two_colours(eye, plain):
    flat = eye.see(floor_contrast=0.0)[FLOOR].astype(float)
    assert np.ptp(flat.reshape(-1, 3), axis=0).max() <= 1
    middle = 0.5 * (plain[FLOOR].max((0, 1)) + plain[FLOOR].min((0, 1)))
    np.testing.assert_allclose(flat.mean((0, 1)), middle, atol=3)
    np.testing.assert_allclose(
        np.ptp(eye.see(floor_contrast=0.5)[FLOOR].reshape(-1, 3), axis=0),
        0.5 * np.ptp(plain[FLOOR].reshape(-1, 3), axis=0),
        atol=1.5,
    )


@pytest.mark.parametrize("texture", range(4))
def test_a_texture_has_its_pattern(eye_far_above, texture):
    """How many colours there are, and in which directions they change."""
    eye = eye_far_above
    image = eye.see(floor_texture=texture, floor_contrast=1.5, cube=(0, 0, -5.0))
    image = image[..., 0].astype(int)
    dark = (image < 0.5 * (image.min() + image.max())).mean()
    between = ((image > image.min() + 9) & (image < image.max() - 9)).mean()
    # The image's rows run along x of the world, and its columns along y.
    forward, aside = (np.abs(np.diff(image, axis=axis)).sum() for axis in (0, 1))
    assert forward > 0
    assert (aside == 0) == (texture == 1)
    assert dark == pytest.approx(0.5, abs=0.12) if texture != 2 else dark > 0.6
    assert (between > 0.6) == (texture == 3)


def test_scale_and_yaw_change_the_pattern_as_the_world_does():
    high = make_eye(pitch=90.0, position=(0.0, 0.0, 2.0 - HEIGHT), samples=1)
    far = make_eye(pitch=90.0, position=(0.0, 0.0, 4.0 - HEIGHT), samples=1)
    nothing = (0, 0, -5.0)
    doubled = far.see(floor_scale=2.0, cube=nothing).astype(int)
    assert (np.abs(doubled - high.see(cube=nothing)) > 8).mean() < 0.02
    quarter = high.see(floor_yaw=np.pi / 2, cube=nothing).astype(int)
    assert (np.abs(quarter - np.rot90(high.see(cube=nothing))) > 8).mean() < 0.05


def test_pitch_moves_the_horizon_and_roll_tilts_it(eye, plain):
    def horizon(image, column):
        """Row of the sharpest change of the sky to the floor."""
        steps = np.abs(np.diff(image[:, column].astype(float).sum(-1)))
        return int(steps.argmax())

    row = horizon(plain, 4)
    assert row == pytest.approx(SIDE / 2 - 1, abs=1)
    angle = 0.2
    down = eye.see(camera_pitch=angle)
    assert row - horizon(down, 4) == pytest.approx(FOCAL * np.tan(angle), abs=1.01)
    rolled = eye.see(camera_roll=angle)
    rise = horizon(rolled, 4) - horizon(rolled, SIDE - 5)
    # Right goes down with the camera, so the world rises there.
    assert rise == pytest.approx((SIDE - 9) * np.tan(angle), abs=1.5)


def test_the_mount_moves_the_cube_in_the_image(eye, plain):
    def middle(image):
        rows, columns = np.nonzero(is_cube(image))
        return columns.mean(), rows.mean()

    def size(image):
        return np.sqrt(is_cube(image).sum())

    x, y = middle(plain)
    face = 0.45 - 0.018  # [m] from the camera to the cube's face
    angle, shift = 0.2, 0.03
    assert middle(eye.see(camera_yaw=angle))[0] - x == pytest.approx(FOCAL * np.tan(angle), abs=0.6)
    assert middle(eye.see(camera_y=shift))[0] - x == pytest.approx(FOCAL * shift / face, abs=0.5)
    assert middle(eye.see(camera_z=shift))[1] - y == pytest.approx(FOCAL * shift / face, abs=0.8)
    nearer = eye.see(camera_x=0.05)
    assert size(nearer) / size(plain) == pytest.approx(face / (face - 0.05), rel=0.12)
    assert size(eye.see(focal_length=1.5)) / size(plain) == pytest.approx(1.5, rel=0.12)


def test_distortion_leaves_the_middle_and_bends_the_corner(eye, plain):
    image = eye.see(distortion=0.2).astype(float)
    middle = np.s_[20:28, 20:28]
    assert np.abs(image[middle] - plain[middle]).mean() < 4
    # The ray of the farthest pixel is that of a focal length that is so much shorter.
    short = eye.see(focal_length=1 / 1.2).astype(float)
    corners = np.s_[[0, 0, -1, -1], [0, -1, 0, -1]]
    np.testing.assert_allclose(image[corners], short[corners], atol=2)


def test_blur_spreads_edges_and_keeps_the_mean(eye, plain):
    image = eye.see(blur=2.0).astype(float)
    box = np.s_[16:34, 14:34]
    np.testing.assert_allclose(image[box].mean((0, 1)), plain[box].mean((0, 1)), rtol=0.03)

    def sharpest(picture):
        return np.abs(np.diff(picture[26, :, 1])).max()

    assert sharpest(image) < 0.75 * sharpest(plain)


def test_a_turned_cube_shows_other_faces(eye):
    near = (0.25, 0.0, 0.05)
    straight, turned = eye.see(cube=near), eye.see(cube_yaw=np.pi / 4, cube=near)
    wide = [np.ptp(np.nonzero(is_cube(image))[1]) + 1 for image in (straight, turned)]
    # Half widths over depths: 0.05 over 0.182, and 0.0707 over 0.232 m.
    assert wide[1] / wide[0] == pytest.approx(0.0707 / 0.232 / (0.05 / 0.182), abs=0.12)
    left, right = (turned[25, column].astype(int) for column in (20, 28))
    assert np.abs(left - right).max() < 40
    # The edge that is nearest to the camera reaches lowest.
    lowest = [np.nonzero(is_cube(turned)[:, column])[0].max() for column in (18, 24, 29)]
    assert lowest[1] > max(lowest[0], lowest[2])
    quarter = eye.see(cube_yaw=np.pi / 2, cube=near).astype(int)
    assert (np.abs(quarter - straight) > 2).mean() < 0.02


def test_light_brightens_only_where_it_shines(eye, plain):
    dark = eye.see(light=0.0, ambient=0.0).astype(float)
    assert dark[FLOOR].max() < 0.2 * plain[FLOOR].max()  # the headlight falls flat on it
    np.testing.assert_array_equal(dark[SKY], plain[SKY])
    twice = eye.see(ambient=2.0).astype(float)
    assert (twice[CUBE_PLACE] > 1.2 * plain[CUBE_PLACE]).all()
    # Light from behind the robot falls on the face that the camera sees.
    behind, ahead = eye.see(light_x=2.0).astype(float), eye.see(light_x=-2.0).astype(float)
    assert behind[CUBE_PLACE][..., 0].mean() > 1.3 * ahead[CUBE_PLACE][..., 0].mean()


def test_walls_stand_at_their_distance_and_hide_nothing_before_them(eye, plain):
    walls = eye.draw()._replace(clutter=None)
    straight = walls._replace(walls=walls.walls.at[0].set(0.0).at[1].set(1.0))
    np.testing.assert_array_equal(eye.see(straight, walls=jnp.float32(0.0)), plain)
    distance, above = 1 / 0.4 - 0.018, HEIGHT + 0.059
    image = eye.see(straight, walls=0.4)
    colour = 255 * np.asarray(straight.walls[2:5])
    column = np.abs(image[:, 24].astype(float) - colour).max(-1) < 3
    top, bottom = (FOCAL * h / distance for h in (1.0 - above, -above))
    assert column.sum() == pytest.approx(top - bottom, abs=2.1)
    assert np.nonzero(column)[0][0] == pytest.approx(SIDE / 2 - top, abs=1.1)
    assert is_cube(image).sum() == is_cube(plain.astype(np.uint8)).sum()


def test_objects_stand_around_and_look_like_no_goal(eye, plain):
    seen, places = 0, []
    nominal = np.asarray(next(g.rgb for g in eye.camera.scene.geoms if g.mocap == GOAL))
    for key in range(24):
        around = eye.draw(key=key)._replace(walls=None)
        clutter = np.asarray(around.clutter)
        places.append(clutter[:, :2])
        hues = clutter[:, 2:] - clutter[:, 2:].mean(-1, keepdims=True)
        assert (hues @ (nominal - nominal.mean()) <= 1e-3).all()
        np.testing.assert_array_equal(eye.see(around, clutter=jnp.float32(0.0)), plain)
        image = eye.see(around, clutter=4)
        assert is_cube(image).sum() <= is_cube(plain.astype(np.uint8)).sum()
        seen += (np.abs(image - plain).max(-1) > 8).any()
    places = np.concatenate(places)
    assert seen > 8
    distances = np.linalg.norm(places, axis=-1)
    assert distances.min() >= 0.5 - 1e-6
    assert distances.max() <= 2.5 + 1e-6
    assert np.linalg.norm(places - CUBE[:2], axis=-1).min() >= 0.25


@pytest.mark.slow
@pytest.mark.parametrize(
    "camera",
    [
        {"colour": "grey", "lens": "fisheye"},
        pytest.param({}, marks=pytest.mark.slow),
        pytest.param({"colour": "grey"}, marks=pytest.mark.slow),
        pytest.param({"lens": "fisheye"}, marks=pytest.mark.slow),
    ],
)
def test_the_kernel_draws_what_xla_draws_with_everything_drawn(camera):
    images = []
    for impl in ("auto", "xla"):
        eye = make_eye(impl=impl, width=24, height=24, pitch=20.0, **camera)
        traced = LookParams(*map(jnp.float32, TOGETHER))._replace(
            **{name: getattr(LookParams(), name) for name in (*LATE, "pixel_noise")}
        )
        images.append(eye.see_all(Appearance(traced, eye.draw(key=3))).astype(int))
        assert any(eye.camera.kernel_impl.kernels.values()) == (impl == "auto")
    difference = np.abs(images[0] - images[1])
    assert difference.max() <= 1 or (difference > 1).mean() < 2e-3
    assert images[0].std() > 10


def test_noise_has_its_deviation_is_white_and_another_one_in_every_image():
    grey = jnp.full((64, 64, 3), 128, jnp.uint8)
    add = jax.jit(add_noise)
    noisy = [np.asarray(add(grey, 0.05, jnp.uint32(seed))).astype(float) for seed in range(8)]
    noise = np.stack(noisy) - 128
    assert noise.mean() == pytest.approx(0.0, abs=0.2)
    assert noise.std() == pytest.approx(0.05 * 255, rel=0.02)
    flat = noise.reshape(8, -1)
    assert np.abs(np.corrcoef(flat) - np.eye(8)).max() < 0.05
    for axis in (1, 2, 3):
        shifted = np.roll(noise, 1, axis)
        assert abs((noise * shifted).mean() / noise.var()) < 0.02
    np.testing.assert_array_equal(add(grey, 0.0, jnp.uint32(1)), grey)
