"""What a policy sees and looks at, as images and on the page."""

import types
from pathlib import Path

import jax
import numpy as np
import pytest

from helpers import gliding
from jetbot_mjx.agents.networks import PolicyParams, init_normalizer, make_networks, make_policy
from jetbot_mjx.config import parse_config
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.camera.wrapper import PIXELS
from jetbot_mjx.envs.state import robot_state
from jetbot_mjx.evaluation.occlusion import occlusion_map, overlay_heat
from jetbot_mjx.runs.checkpoint import Checkpoint, about_policy
from jetbot_mjx.viewers import player as player_module
from jetbot_mjx.viewers.player import Player
from jetbot_mjx.viewers.policy_view import resize_nearest

SEEING = {
    "task": {"observation": "camera"},
    "camera": {"width": 20, "height": 16, "frames": 2},
    "ppo": {"network": {"cnn": "tiny", "policy_hidden_layer_sizes": [8]}},
}


def test_enlarging_makes_squares_and_grey_becomes_rgb():
    image = np.arange(4 * 6 * 3, dtype=np.uint8).reshape(4, 6, 3)
    large = resize_nearest(image, 20)  # 3.3 times as long
    assert large.shape == (12, 18, 3)
    np.testing.assert_array_equal(large[::3, ::3], image)
    for row in range(3):
        for column in range(3):
            np.testing.assert_array_equal(large[row::3, column::3], image)
    grey = resize_nearest(image[..., :1], 6)
    np.testing.assert_array_equal(grey, np.repeat(image[..., :1], 3, axis=2))
    np.testing.assert_array_equal(resize_nearest(image, 3), image[::2, ::2])


@pytest.mark.parametrize("channels", [1, 3])
def test_heat_lies_over_a_grey_image(channels):
    image = np.full((2, 3, channels), 100, np.uint8)
    heat = np.array([[0.0, 0.1, 0.2], [0.3, 0.4, 0.8]])
    drawn = overlay_heat(image, heat, 0.4).astype(int)
    np.testing.assert_array_equal(drawn[0, 0], 60)  # darker, and of no colour
    assert (np.diff(drawn[0, :, 0]) > 0).all()  # redder with the heat
    red, yellow, beyond = drawn[0, 2], drawn[1, 1], drawn[1, 2]
    assert red[0] == 255
    assert red[1] < 100 < yellow[1]
    np.testing.assert_array_equal(yellow, beyond)


@pytest.fixture(scope="module", autouse=True)
def glide():
    with gliding.everywhere():
        yield


@pytest.fixture(scope="module")
def player():
    """A player of two robots, whose policy has learnt nothing."""
    config = parse_config(SEEING)
    env = make_env(config)
    networks = make_networks(config.ppo, env.observation_size, 2)
    params = PolicyParams(
        normalizer=init_normalizer(env.observation_size),
        policy=networks.policy_network.init(jax.random.PRNGKey(0)),
        value=networks.value_network.init(jax.random.PRNGKey(1)),
    )
    path = Path("nowhere") / "checkpoints" / "0"
    about = about_policy(config, env)
    checkpoint = Checkpoint(path, path.parents[1], 0, config, params, networks, about)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(player_module, "load_checkpoint", lambda *_: checkpoint)
        player = Player("nowhere", agent="keyboard", robots=2)
    player.drive(0.3, 1.0)
    for _ in range(3):
        player.tick()
    return player


@pytest.mark.slow
def test_a_player_shows_the_newest_image_of_the_chosen_robot(player):
    images = []
    for player.robot in (0, 1):
        one = jax.tree.map(lambda leaf: leaf[player.robot], player._states)
        robot = robot_state(one.pipeline_state)
        camera = player.env.camera
        wanted = camera.render(
            camera.pose(robot.position_w, robot.quat), player.env.task.markers(one.goal)
        )
        images.append(player.image())
        assert images[-1].shape == (16, 20, 3)
        assert np.abs(images[-1].astype(int) - wanted).max() <= 1
        assert not np.array_equal(one.obs[PIXELS][..., :3], images[-1])  # the older image
    assert not np.array_equal(*images)
    assert player.sees


@pytest.mark.slow
def test_a_player_maps_what_the_policy_looks_at_for_the_chosen_robot(player):
    networks = make_networks(player.env.config.ppo, player.env.observation_size, 2)
    policy = make_policy(networks, player._params)
    maps = []
    for player.robot in (0, 1):
        obs = jax.tree.map(lambda part: part[player.robot], player._states.obs)
        maps.append(player.occlusion_map())
        np.testing.assert_allclose(maps[-1], occlusion_map(policy, obs), atol=1e-5)
        assert maps[-1].max() > 0
    assert not np.array_equal(*maps)


# In the panel of a page.


class Clocks:
    """Stands in for `time`: it goes on when it is told to."""

    now = 100.0

    def monotonic(self):
        return self.now


@pytest.fixture
def shown(monkeypatch):
    """The view of a fake player in a fake panel, and what was asked of the player."""
    pytest.importorskip("viser")
    from jetbot_mjx.viewers import viser_policy_view as module

    clock, asked = Clocks(), []
    monkeypatch.setattr(module, "time", clock)
    image = np.full((32, 32, 3), 200, np.uint8)
    heat = np.zeros((32, 32), np.float32)
    heat[4:8, 4:8] = 0.5
    player = types.SimpleNamespace(
        image=lambda: (asked.append("image"), image)[1],
        occlusion_map=lambda: (asked.append("map"), heat)[1],
    )
    gui = types.SimpleNamespace(
        add_image=lambda image, **given: types.SimpleNamespace(image=image, **given),
        add_checkbox=lambda label, value: types.SimpleNamespace(label=label, value=value),
    )
    view = module.PolicyView(gui, player)
    asked.clear()

    def after(seconds, updates=100):
        """What is asked for in some time, in which the page is updated so often."""
        asked.clear()
        for _ in range(updates):
            clock.now += seconds / updates
            view.update()
        return asked.count("image"), asked.count("map")

    return view, after, heat


def test_the_panel_shows_the_image_and_no_map_unless_it_is_switched_on(shown):
    view, after, _ = shown
    assert after(1.0) == (15, 0)
    assert view.image.image.shape == (192, 192, 3)
    assert view.image.label == "What the policy sees"


def test_the_map_lies_beside_the_image_and_is_computed_a_few_times_a_second(shown):
    view, after, heat = shown
    view.looks.value = True
    assert after(1 / 15, 1) == (1, 1)  # at once
    images, maps = after(1.0)
    assert images == 15
    assert 3 <= maps <= 4
    both = view.image.image
    assert both.shape == (128, 128 + 8 + 128, 4)
    assert (both[:, :128] == [200, 200, 200, 255]).all()
    assert not both[:, 128:136, 3].any()
    yellow = (both[:, 136:, :3] == [255, 235, 60]).all(axis=-1)
    np.testing.assert_array_equal(np.argwhere(yellow)[[0, -1]], [[16, 16], [31, 31]])
    assert view.image.label.endswith("up to 0.50)")
    # Changes that are all small light nothing up.
    heat *= 0.2
    after(0.5)
    assert view.image.label.endswith("up to 0.10)")
    assert (view.image.image[:, 136:, 0] < 200).all()
    view.looks.value = False
    assert after(0.5)[1] == 0
    assert view.image.label == "What the policy sees"
