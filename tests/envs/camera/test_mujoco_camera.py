"""The camera by MuJoCo's renderer: the same directions, and an error of one line without OpenGL."""

import gc
import subprocess
import sys

import jax
import numpy as np
import pytest

from jetbot_mjx.agents.networks import PolicyParams, init_normalizer, make_networks
from jetbot_mjx.config import CameraConfig, load_config
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.camera import mujoco_camera
from jetbot_mjx.envs.camera.mujoco_camera import MujocoCamera
from jetbot_mjx.envs.camera.render import Camera
from jetbot_mjx.envs.camera.scenery import SCENERIES, draw_scenery
from jetbot_mjx.envs.state import robot_state
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation.evaluator import Evaluator, report_keys
from jetbot_mjx.evaluation.robustness import MujocoEvaluator
from jetbot_mjx.runs import Setup

MATRIX = {"matrix": (40.0, 40.0, 20.0, 28.0), "calibration_size": (48, 48)}
LENSES = {
    "pinhole": {},
    "off-centre": MATRIX,
    "opencv": {**MATRIX, "lens": "opencv", "distortion": (-0.1, 0.02, 0.002, -0.001)},
    "fisheye": {"lens": "fisheye", "fovy": 100.0, "distortion": (-0.01, 0.003)},
    "grey": {"colour": "grey"},
}
GOALS = np.array([[0.5, 0.0, 0.05], [0.3, 0.12, 0.05], [0.25, -0.1, 0.05]], np.float32)


@pytest.fixture(scope="module")
def env():
    return make_env(load_config("configs/jetbot_camera.yaml"))


def images(camera, env, goals=GOALS):
    robot = robot_state(env.reset(jax.random.PRNGKey(0)).pipeline_state)
    pose = camera.pose(robot.position_w, robot.quat)
    return np.asarray(jax.jit(jax.vmap(lambda goal: camera.render(pose, {"goal": goal})))(goals))


@pytest.mark.slow
@pytest.mark.parametrize(
    "lens",
    [
        *("opencv", "fisheye", "grey"),
        # The matrix is that of "opencv", and the pinhole that of "grey".
        *(pytest.param(lens, marks=pytest.mark.slow) for lens in ("pinhole", "off-centre")),
    ],
)
def test_the_pictures_look_in_the_directions_of_training(lens, env, with_opengl):
    config = CameraConfig(width=32, height=32, **LENSES[lens])
    ours = images(Camera(config, env.mj_model), env)
    theirs = images(MujocoCamera(config, env.mj_model), env)
    assert theirs.shape == ours.shape
    # What differs is the cube's shadow and shades of the light; moved by a pixel, far more does.
    inside = np.s_[:, 2:-2, 2:-2]
    apart = np.abs(ours.astype(int) - theirs)[inside].mean()
    assert apart < 4.0
    for shift in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        moved = np.abs(ours.astype(int) - np.roll(theirs, shift, axis=(1, 2)))[inside].mean()
        assert moved > 1.6 * apart, shift


@pytest.mark.slow
def test_every_robot_sees_a_scenery_of_its_own_and_always_the_same(env, with_opengl):
    config = CameraConfig(width=16, height=16)
    goals = np.tile(GOALS[:1], (SCENERIES + 1, 1))
    found = images(MujocoCamera(config, env.mj_model, appearance="varied"), env, goals).astype(int)
    plain = images(MujocoCamera(config, env.mj_model), env, goals[:1])[0].astype(int)
    for one in range(SCENERIES):
        for other in range(one):
            assert np.abs(found[one] - found[other]).mean() > 2.0
        assert np.abs(found[one] - plain).mean() > 4.0
    np.testing.assert_array_equal(found[SCENERIES], found[0])
    again = images(MujocoCamera(config, env.mj_model, appearance="varied"), env, goals)
    np.testing.assert_array_equal(again, found)


def test_a_scenery_has_nothing_as_red_as_the_cube():
    for number in range(SCENERIES):
        scenery = draw_scenery(number, 32)
        for texture in (scenery.floor, scenery.sky):
            red, green, blue = np.moveaxis(texture.astype(float), -1, 0)
            assert np.all(red <= 1.25 * np.maximum(green, blue) + 1)


def test_what_has_not_moved_is_not_rendered_again(env, with_opengl, monkeypatch):
    camera = MujocoCamera(CameraConfig(width=8, height=8), env.mj_model)
    drawn = []
    draw = camera._draw
    monkeypatch.setattr(camera, "_draw", lambda *one: drawn.append(1) or draw(*one))
    pose = np.tile([0.0, 0.0, 0.1], (3, 1)), np.tile(np.eye(3), (3, 1, 1))
    first = camera.pictures(*pose, {"goal": GOALS})
    moved = GOALS + np.array([[0, 0, 0], [0.1, 0, 0], [0, 0, 0]], np.float32)
    second = camera.pictures(*pose, {"goal": moved})
    assert len(drawn) == 4
    np.testing.assert_array_equal(second[[0, 2]], first[[0, 2]])


@pytest.mark.slow
def test_a_policy_is_evaluated_by_both_appearances(with_opengl, monkeypatch):
    settings = ["camera.width=16", "camera.height=16", "task.episode_length=25"]
    settings += ["ppo.network.cnn=tiny"]
    config = load_config("configs/jetbot_camera.yaml", [*settings, "camera.frames=2"])
    env = make_env(config)
    networks = make_networks(config.ppo, env.observation_size, env.action_size)
    normalizer = init_normalizer(env.observation_size)
    policy = networks.policy_network.init(jax.random.PRNGKey(0))
    params = PolicyParams(normalizer, policy, None)
    keys = report_keys(3)
    setup = Setup(env.config, env=env, networks=networks)
    rollouts, run = [], Evaluator.run

    def recorded(*given):
        rollouts.append(run(*given))
        return rollouts[-1]

    monkeypatch.setattr(Evaluator, "run", recorded)
    found = MujocoEvaluator(setup, pictures=True).run(params, keys)
    assert list(found.rendered) == ["plain", "varied"]
    assert {one.episodes for one in found.rendered.values()} == {3}
    assert found.rendered["plain"].episode_return != found.rendered["varied"].episode_return
    # What is not asked for is not rendered. The episodes were run already.
    monkeypatch.setattr(Evaluator, "run", lambda *given: rollouts[0])
    assert MujocoEvaluator(setup).run(params, keys).rendered is None


def test_without_opengl_one_line_says_so(env, monkeypatch):
    def missing():
        raise UserError("no OpenGL to render with: install one")

    monkeypatch.setattr(mujoco_camera, "find_backend", missing)
    with pytest.raises(UserError, match="no OpenGL") as caught:
        MujocoCamera(CameraConfig(), env.mj_model)
    assert "\n" not in str(caught.value)


def test_a_camera_that_is_gone_takes_nothing_from_the_next(env, with_opengl):
    place = np.array([0.0, 0.0, 0.0325]), np.array([1.0, 0.0, 0.0, 0.0])
    cube, config = {"goal": GOALS[0]}, CameraConfig(width=16, height=16)
    first = MujocoCamera(config, env.mj_model, appearance="varied")
    first.picture(*place, cube, 3)
    second = MujocoCamera(config, env.mj_model, appearance="varied")
    wanted = second.picture(*place, cube, 3)
    first.picture(*place, cube, 5)
    np.testing.assert_array_equal(second.picture(*place, cube, 3), wanted)
    del first
    gc.collect()
    np.testing.assert_array_equal(second.picture(*place, cube, 3), wanted)
    assert np.abs(second.picture(*place, cube, 5).astype(int) - wanted).mean() > 2.0


ONE_PICTURE = """
import numpy as np
from jetbot_mjx.config import CameraConfig, load_config
from jetbot_mjx.envs.camera.mujoco_camera import MujocoCamera
from jetbot_mjx.envs.build import make_env

env = make_env(load_config("configs/jetbot_camera.yaml"))
camera = MujocoCamera(CameraConfig(width=16, height=16), env.mj_model)
camera.picture(np.array([0, 0, 0.03]), np.array([1.0, 0, 0, 0]), {"goal": np.array([0.5, 0, 0.05])})
"""


@pytest.mark.slow
def test_a_program_that_has_drawn_ends_without_a_word(root, with_opengl):
    done = subprocess.run(
        [sys.executable, "-c", ONE_PICTURE], cwd=root, capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (0, "")
