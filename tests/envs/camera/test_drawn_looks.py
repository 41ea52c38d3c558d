"""Looks drawn for each episode, and delayed and lost images."""

import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import gliding
from helpers.command_modules import train
from helpers.further import slow_fixture
from jetbot_mjx.config import ConfigError, LookParams, load_config, parse_config
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.camera.looks import Appearance
from jetbot_mjx.envs.camera.wrapper import PIXELS, with_camera
from jetbot_mjx.envs.domain_randomization import DomainRandomizationWrapper
from jetbot_mjx.envs.wrappers import wrap_for_training
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation.evaluator import report_keys
from jetbot_mjx.runs.checkpoint_store import checkpoint_path, read_about
from jetbot_mjx.training import session

ENVS, LENGTH, EPISODES = 6, 5, 3
SIZE = {"width": 12, "height": 10, "samples": 1}


@pytest.fixture(scope="module", autouse=True)
def glide():
    with gliding.everywhere():
        yield


def make_config(randomization, length=LENGTH, **camera):
    return parse_config(
        {
            "task": {"observation": "camera", "episode_length": length},
            "camera": SIZE | camera,
            "randomization": randomization,
        }
    )


def episodes(config, envs, steps):
    """The states after reset and after each step, time first."""
    wrapped = wrap_for_training(make_env(config), config.task.episode_length)

    @jax.jit
    def run(keys):
        def step(state, action):
            nstate = wrapped.step(state, action)
            return nstate, nstate

        first = wrapped.reset(keys)
        actions = jax.random.uniform(keys[0], (steps, envs, 2), minval=-1.0)
        return first, jax.lax.scan(step, first, actions)[1]

    first, states = jax.device_get(run(jax.random.split(jax.random.PRNGKey(7), envs)))
    return jax.tree.map(lambda x, y: np.concatenate([x[None], y]), first, states)


@pytest.fixture(scope="module")
def ranges(root):
    return load_config(root / "configs" / "camera_real.yaml").randomization


@slow_fixture(scope="module")
def drawn(ranges):
    return episodes(make_config(ranges.model_dump()), ENVS, EPISODES * LENGTH)


@pytest.mark.slow
def test_each_look_is_constant_in_an_episode_and_another_one_in_each(drawn, ranges):
    camera = drawn.episode_params.camera
    whole = {"floor_texture", "clutter", "camera_delay", "camera_interval"}
    assert sorted(camera.values) == sorted(ranges.looks)
    for name, values in camera.values.items():
        within = values[:-1].reshape(EPISODES, LENGTH, ENVS)
        assert (within == within[:, :1]).all(), name
        low, high = ranges.drawn[name]
        assert (values >= np.float32(low)).all(), name
        assert (values <= np.float32(high)).all(), name
        if name in whole:
            assert (values == np.round(values)).all()
        else:
            assert len(np.unique(values)) == (EPISODES + 1) * ENVS, name
    for part in (camera.surroundings.walls, camera.surroundings.clutter, camera.key):
        flat = part.reshape(len(part), ENVS, -1)
        within = flat[:-1].reshape(EPISODES, LENGTH, ENVS, -1)
        assert (within == within[:, :1]).all()
        assert len(np.unique(flat.reshape(-1, flat.shape[-1]), axis=0)) == (EPISODES + 1) * ENVS


def test_looks_do_not_change_the_goals(drawn):
    first = make_env(make_config({}))
    goals = jax.jit(jax.vmap(lambda key: first.reset(key).goal))
    keys = jax.random.split(jax.random.PRNGKey(7), ENVS)
    np.testing.assert_array_equal(drawn.goal[0], goals(keys))


def test_an_image_is_that_of_its_looks(drawn, ranges):
    """Drawn from the state alone, without any wrapper."""
    camera = make_env(make_config({})).camera
    looks = drawn.episode_params.camera

    @jax.jit
    @jax.vmap
    def render(looks):
        params = looks.params
        pose = camera.pose(looks.seen.position_w, looks.seen.quat, params)
        return camera.render(pose, looks.seen.markers, Appearance(params, looks.surroundings))

    last = jax.tree.map(lambda x: x[-1], looks)
    difference = drawn.obs[PIXELS][-1].astype(float) - np.asarray(render(last))
    # What remains is noise, cut at black and white.
    for image, deviation in zip(difference, last.values["pixel_noise"], strict=True):
        assert np.abs(image).max() <= 3.5 * 255 * deviation + 1
    assert np.abs(difference).max() > 1


@pytest.fixture(scope="module")
def plain():
    """The plain image of every state, without delay."""
    return episodes(make_config({}, length=60), 4, 40).obs[PIXELS]


def late(**randomization):
    states = episodes(make_config(randomization, length=60), 4, 40)
    return states.obs[PIXELS], states.episode_params.camera


def test_a_delay_gives_the_image_of_so_many_steps_ago(plain):
    seen, camera = late(camera_delay=[0, 3])
    delays = camera.values["camera_delay"][0].astype(int)
    for robot, delay in enumerate(delays):
        for step in range(len(seen)):
            np.testing.assert_array_equal(seen[step, robot], plain[max(step - delay, 0), robot])
    assert delays.max() > 0
    assert len(np.unique(plain[:, 0], axis=0)) > 20


def test_between_two_images_the_last_one_stays(plain):
    seen, _ = late(camera_interval=[3, 3])
    for step in range(len(seen)):
        np.testing.assert_array_equal(seen[step], plain[step - step % 3])


def test_lost_images_leave_the_one_before_and_are_as_many_as_drawn(plain):
    seen, camera = late(frame_drop=[0.3, 0.3], pixel_noise=[0.1, 0.1])
    times = camera.seen.time
    lost = times[1:] == times[:-1]
    assert lost.mean() == pytest.approx(0.3, abs=0.09)  # 160 draws
    assert len(np.unique(lost, axis=1).T) == 4
    # The image that stays has the same noise, and every other image another.
    for before, after, is_lost in zip(seen[:-1], seen[1:], lost, strict=True):
        np.testing.assert_array_equal((before == after).all((1, 2, 3)), is_lost)
    assert 3 < np.abs(seen.astype(float) - plain).mean() < 40


def test_nothing_drawn_of_the_looks_leaves_the_camera_as_it_was():
    wrapped = wrap_for_training(make_env(make_config({"friction": [0.5, 1.0]})), LENGTH)
    state = jax.eval_shape(wrapped.reset, report_keys(2))
    assert state.episode_params.camera is None


def test_fixed_looks_are_those_of_every_episode():
    env = make_env(make_config({}))
    key = report_keys(1)[0]
    plain = jax.jit(env.reset)(key).obs[PIXELS].astype(float)
    darker = with_camera(
        DomainRandomizationWrapper(env, look_params=LookParams(exposure=0.5)), env.camera
    )
    image = np.asarray(jax.jit(darker.reset)(key).obs[PIXELS]).astype(float)
    np.testing.assert_allclose(image, 0.5 * plain, atol=1)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("task.observation=world", "randomization.exposure = [0.5, 1.5] changes an image, and"),
        ("randomization.exposure=[0.5]", "randomization.exposure = [0.5] is wrong"),
        ("randomization.exposure=[2, 1]", "from 0 to 8, the smaller one first"),
        ("randomization.clutter=[0, 1.5]", "whole numbers from 0 to 8"),
        ("randomization.camera_interval=[0, 2]", "whole numbers from 1 to 60"),
        ("randomization.walls=[0, 2]", "numbers from 0 to 0.8"),
        ("randomization.exposur=[1, 2]", "did you mean randomization.exposure?"),
    ],
)
def test_a_wrong_range_is_refused_in_one_line(tmp_path, override, message):
    path = tmp_path / "mine.yaml"
    path.write_text("task: {observation: camera}\nrandomization: {exposure: [0.5, 1.5]}\n")
    with pytest.raises(ConfigError) as error:
        load_config(path, [override])
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_looks_without_a_camera_are_refused_by_the_wrapper_too(world_env, ranges):
    with pytest.raises(UserError, match=r"cube_brightness changes an image.*'world' sees none"):
        DomainRandomizationWrapper(world_env, ranges=ranges)
    with pytest.raises(UserError, match="exposure changes an image"):
        DomainRandomizationWrapper(world_env, look_params=LookParams(exposure=jnp.float32(1.0)))


# The fast suite resumes with some of the looks drawn, and with everything but looks.
@pytest.mark.slow
def test_a_training_resumes_to_the_bit_with_all_looks_drawn(ranges, tmp_path):
    layers = {f"{name}_hidden_layer_sizes": [8] for name in ("policy", "value")}
    ppo = {"num_envs": 8, "batch_size": 8, "num_minibatches": 1, "unroll_length": 4}
    tiny = {
        "checkpoint_interval": 64,
        "task": {"observation": "camera", "episode_length": 6},
        "camera": {"width": 16, "height": 16, "samples": 1, "frames": 2},
        "randomization": ranges.model_dump(mode="json"),
        "ppo": ppo | {"num_timesteps": 128, "network": layers | {"cnn": "tiny"}},
        "evaluation": {"episodes": 2},
        "tensorboard": False,
    }
    whole = tmp_path / "whole"
    session.run(parse_config(tiny), whole)
    stopped = shutil.copytree(whole, tmp_path / "stopped")
    shutil.rmtree(checkpoint_path(stopped, 128))
    assert train.main(["--resume", str(stopped)]) == 0
    sums = [read_about(checkpoint_path(run_dir, 128))["sha256"] for run_dir in (whole, stopped)]
    assert sums[0] == sums[1]
    assert sums[0] != read_about(checkpoint_path(stopped, 64))["sha256"]


def test_the_robot_is_drawn_as_by_the_configuration_that_does_not_see(root, ranges):
    """But for what a policy that sees does not observe, and for longer control steps."""
    blind = load_config(root / "configs" / "real_jetbot.yaml").randomization
    own = {"action_delay", "position_noise", "yaw_noise", "speed_noise", "yaw_rate_noise"}
    own |= {"observation_delay"}
    for name, span in blind.drawn.items():
        assert getattr(ranges, name) == span or name in own, name
    assert set(ranges.drawn) - set(ranges.looks) <= set(blind.drawn)
