"""Occlusion maps of policies for which they are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jetbot_mjx.envs.camera.wrapper import NUMBERS, PIXELS
from jetbot_mjx.errors import InvalidError
from jetbot_mjx.evaluation.occlusion import occlusion_map

HEIGHT, WIDTH, SIDE = 24, 32, 4


@pytest.fixture
def obs():
    """An image of one colour with a patch of another, and numbers beside it."""
    image = np.full((HEIGHT, WIDTH, 3), 200, np.uint8)
    image[8:16, 12:20] = (150, 20, 20)
    return {PIXELS: image, NUMBERS: np.array([0.5, -1.0], np.float32)}


def patch_policy(rows, columns, channels=slice(None)):
    """Drives by the mean brightness of one region, and turns by a number."""

    def policy(obs, key=None):
        del key
        patch = jnp.asarray(obs[PIXELS], jnp.float32)[..., rows, columns, channels]
        return jnp.stack([patch.mean(axis=(-3, -2, -1)) / 255, obs[NUMBERS][..., 1]], axis=-1)

    return policy


def inside(rows, columns):
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[rows, columns] = True
    return mask


def test_the_map_is_lit_exactly_where_the_policy_looks(obs):
    region = slice(8, 12), slice(12, 20)
    heat = np.asarray(occlusion_map(patch_policy(*region), obs, side=SIDE, stride=SIDE))
    assert heat.shape == (HEIGHT, WIDTH)
    np.testing.assert_array_equal(heat > 0, inside(*region))
    # A square hides half of the region: 200 where (150, 20, 20) was.
    change = (200 * 3 - 190) / 3 / 2 / 255
    np.testing.assert_allclose(heat[region], change, rtol=1e-5)


def test_squares_that_overlap_light_its_surroundings_less(obs):
    region = slice(8, 16), slice(12, 20)
    heat = np.asarray(occlusion_map(patch_policy(*region), obs, side=SIDE, stride=1))
    near = inside(slice(8 - SIDE + 1, 16 + SIDE - 1), slice(12 - SIDE + 1, 20 + SIDE - 1))
    np.testing.assert_array_equal(heat > 0, near)
    assert heat[inside(*region)].min() > heat[~inside(*region)].max()
    # All squares over its middle lie inside of it.
    assert heat[11:13, 15:17].min() == pytest.approx(heat.max(), rel=1e-5)


@pytest.mark.parametrize("side", [None, 3, 5, HEIGHT])
def test_every_pixel_is_covered_by_some_square(obs, side):
    whole = slice(0, HEIGHT), slice(0, WIDTH)
    noise = np.random.default_rng(0).integers(0, 256, obs[PIXELS].shape, np.uint8)

    def policy(obs, key=None):
        # One number that no two coverings share.
        pixels = jnp.asarray(obs[PIXELS], jnp.float32)[..., *whole, :]
        return jnp.stack([jnp.sum(pixels**2, axis=(-3, -2, -1)) / 1e6, obs[NUMBERS][..., 0]], -1)

    heat = np.asarray(occlusion_map(policy, {**obs, PIXELS: noise}, side=side))
    assert np.isfinite(heat).all()
    assert heat.min() > 0


def test_all_stacked_images_are_covered_and_the_older_ones_count(obs):
    stacked = {**obs, PIXELS: np.concatenate([obs[PIXELS]] * 2, axis=-1)}
    region = slice(8, 12), slice(12, 20)
    oldest = patch_policy(*region, slice(0, 3))
    heat = np.asarray(occlusion_map(oldest, stacked, side=SIDE, stride=SIDE))
    np.testing.assert_array_equal(heat > 0, inside(*region))


def test_a_policy_that_ignores_the_image_lights_nothing_and_jit_changes_nothing(obs):
    def blind(obs, key=None):
        return jnp.asarray(obs[NUMBERS])

    assert not np.asarray(occlusion_map(blind, obs)).any()
    policy = patch_policy(slice(0, 8), slice(0, 8))
    compiled = jax.jit(lambda obs: occlusion_map(policy, obs))(obs)
    np.testing.assert_allclose(compiled, occlusion_map(policy, obs), atol=1e-6)


@pytest.mark.parametrize("sizes", [{"side": 25}, {"side": 0}, {"side": 4, "stride": 5}])
def test_squares_that_do_not_cover_the_image_are_refused(obs, sizes):
    with pytest.raises(InvalidError, match=r"24 x 32 pixels"):
        occlusion_map(patch_policy(slice(0, 8), slice(0, 8)), obs, **sizes)


def test_an_observation_of_numbers_is_refused():
    with pytest.raises(InvalidError, match="no pixels/front"):
        occlusion_map(lambda obs, key=None: obs, np.zeros(16, np.float32))
