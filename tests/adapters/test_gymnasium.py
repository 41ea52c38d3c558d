"""The environment for Gymnasium: one robot in C MuJoCo."""

import importlib
import subprocess
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium")

from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from helpers.gymnasium_cases import ENDS, GOAL, ID, sees
from jetbot_mjx.adapters import JetBotGymEnv, JetBotVectorEnv
from jetbot_mjx.adapters.base import observation_space
from jetbot_mjx.config import Config, parse_config
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.task import GOAL_HEIGHT
from jetbot_mjx.errors import UserError

ROOT = Path(__file__).parents[2]


@pytest.fixture
def env():
    return JetBotGymEnv()


def drive(env, actions):
    """Return observations, rewards, ends and infos of an environment under given actions."""
    return list(zip(*(env.step(action) for action in actions), strict=True))


# Contracts.


@pytest.mark.filterwarnings("ignore:.*A Box observation space m..imum value is -?infinity")
def test_gymnasiums_checker_passes_with_every_render_mode(window, needs_opengl, monkeypatch):
    monkeypatch.setenv("DISPLAY", ":0")
    check_env(gymnasium.make(ID).unwrapped)
    assert window.shown[-1] == "closed"


@pytest.mark.filterwarnings("ignore:.*A Box observation space m..imum value is -?infinity")
def test_gymnasiums_checker_passes_without_a_display(needs_opengl, monkeypatch):
    if sys.platform != "linux":
        pytest.skip("a missing display is told on Linux only")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    env = gymnasium.make(ID).unwrapped
    assert env.metadata["render_modes"] == ["rgb_array"]
    assert JetBotVectorEnv(1).metadata["render_modes"] == ["rgb_array"]
    check_env(env)


def test_the_tutorials_arguments_are_taken_by_name_and_place():
    by_name = gymnasium.make(
        ID,
        skip_frame=2,
        physics_dt=1 / 120,
        rendering_dt=1 / 30,
        max_episode_length=100,
        seed=3,
        headless=True,
    ).unwrapped
    by_place = JetBotGymEnv(2, 1 / 120, 1 / 30, 100, 3, True)
    for env in (by_name, by_place):
        assert env.config.physics.ctrl_dt == pytest.approx(1 / 60)
        assert env.config.physics.n_substeps == 2
        assert env.config.task.episode_length == 100
        assert env.render_mode is None
        np.testing.assert_array_equal(env.reset()[0], JetBotGymEnv().reset(seed=3)[0])


def test_nothing_given_is_the_tutorials_environment(env):
    assert env.config == Config()
    assert env.metadata["render_fps"] == 60
    assert (env.observation_space.shape, env.observation_space.dtype) == ((16,), np.float32)
    assert (env.observation_space.low == -np.inf).all()
    assert (env.observation_space.high == np.inf).all()
    assert (env.action_space.low.tolist(), env.action_space.high.tolist()) == ([-1, -1], [1, 1])


@pytest.mark.parametrize("form", ["path", "mapping", "config"])
def test_all_else_comes_from_a_configuration(form, tmp_path):
    path = tmp_path / "a.yaml"
    path.write_text("task: {observation: egocentric, episode_length: 7}")
    mapping = {"task": {"observation": "egocentric", "episode_length": 7}}
    source = {"path": path, "mapping": mapping, "config": parse_config(mapping)}[form]
    env = JetBotGymEnv(config=source)
    assert env.observation_space.contains(env.reset()[0])
    assert env.observation_space.shape == (7,)
    assert env.config.task.episode_length == 7


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"skip_frame": 0}, "skip_frame = 0"),
        ({"skip_frame": 1.5}, "skip_frame = 1.5"),
        ({"physics_dt": 0.0}, "physics_dt = 0.0"),
        ({"physics_dt": float("inf")}, "physics_dt = inf"),
        ({"rendering_dt": "a"}, "rendering_dt = 'a'"),
        ({"max_episode_length": 0}, "max_episode_length = 0"),
        ({"render_mode": "ascii"}, "render_mode = 'ascii' is unknown: known are human"),
        ({"seed": -1}, "seed = -1"),
        ({"config": 3}, "config = 3"),
        ({"config": {"task": {"observatoin": "world"}}}, "did you mean task.observation"),
        ({"config": "nothing.yaml"}, "does not exist"),
    ],
)
def test_a_wrong_argument_costs_one_line(arguments, said):
    with pytest.raises(UserError) as caught:
        JetBotGymEnv(**arguments)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_package_costs_one_line(monkeypatch):
    name = "jetbot_mjx.adapters.gymnasium"
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.delitem(sys.modules, name)
    with pytest.raises(UserError, match=r"pip install 'jetbot_mjx\[gymnasium\]'"):
        importlib.import_module(name)


@pytest.mark.parametrize("make", [JetBotGymEnv, JetBotVectorEnv])
def test_a_step_before_the_first_reset_is_refused(make):
    env = make(render_mode="rgb_array")
    for act in (lambda: env.step(env.action_space.sample()), env.render):
        with pytest.raises(gymnasium.error.ResetNeeded):
            act()


# One robot.


def test_wheel_speeds_are_the_controllers(env):
    env.reset()
    actions = np.random.default_rng(0).uniform(-1, 1, (100, 2)).astype(np.float32)
    actions[:4] = [[1, 1], [1, -1], [-1, 1], [-1, -1]]
    for action in actions:
        v, yaw_rate = (float(action[0]) + 1) / 2 * 1.0, float(action[1]) * np.pi
        wanted = [(2 * v + sign * yaw_rate * 0.1125) / (2 * 0.0325) for sign in (-1, 1)]
        env.step(action)
        np.testing.assert_allclose(env.robot.data.ctrl, wanted, rtol=0, atol=1e-6)
        # In float32 a number of 36 rad/s is known to 4e-6.
        in_jax = env.robot.env.wheel_targets(jnp.asarray(action))
        np.testing.assert_allclose(in_jax, wanted, rtol=1e-6, atol=1e-6)


def test_actions_outside_are_clipped(env):
    env.reset()
    env.step(np.array([3.0, -3.0]))
    outside = env.robot.data.ctrl.copy()
    env.step(np.array([1.0, -1.0]))
    np.testing.assert_array_equal(outside, env.robot.data.ctrl)


@pytest.mark.parametrize("action", [[0.0], [0.0, 0.0, 0.0], 0.3, None, [[0.0, 0.0]], ["a", "b"]])
def test_an_action_of_another_shape_is_refused(env, action):
    env.reset(seed=0)
    with pytest.raises(UserError, match=r"it should be (numbers )?\(2,\)"):
        env.step(action)


def test_actions_of_another_shape_are_not_dealt_out_to_other_robots():
    batch = JetBotVectorEnv(3)
    batch.reset(seed=0)
    for wrong in (np.zeros((2, 3)), np.zeros(6), np.zeros((3, 2, 1))):
        with pytest.raises(UserError, match=r"it should be \(3, 2\)"):
            batch.step(wrong)


@pytest.mark.slow
def test_infinite_actions_are_clipped_and_nan_actions_end_the_episode():
    actions = np.array([[np.inf, -np.inf], [-np.inf, np.inf], [np.nan, 0.0], [0.0, np.nan]])
    ours = JetBotVectorEnv(4)
    theirs = SyncVectorEnv([JetBotGymEnv] * 4, autoreset_mode=AutoresetMode.SAME_STEP)
    for batch in (ours, theirs):
        clipped = []
        for given in (np.clip(actions, -1.0, 1.0), actions):
            batch.reset(seed=0)
            obs, reward, terminated, truncated, infos = batch.step(given)
            assert truncated.tolist() == [False, False, True, True]
            assert infos["final_info"]["nonfinite_world"].tolist() == truncated.tolist()
            assert not terminated.any()
            clipped.append((obs, reward))
        for bounded, infinite in zip(*clipped, strict=True):
            np.testing.assert_array_equal(bounded, infinite)


def test_an_episode_that_arrives_is_terminated_and_a_success():
    env = JetBotGymEnv(max_episode_length=60, config=ENDS)
    arrived = []
    for _ in range(10):
        obs, _ = env.reset()
        before, over = np.linalg.norm(obs[GOAL] - obs[:3]), False
        while not over:
            obs, reward, terminated, truncated, info = env.step(np.array([1.0, 0.2]))
            distance = np.linalg.norm(obs[GOAL] - obs[:3])
            assert terminated == info["is_success"] == (distance < 0.6)
            assert reward == pytest.approx(before - distance, abs=1e-6)
            before, over = distance, terminated or truncated
        arrived.append(terminated)
    assert set(arrived) == {True, False}


def test_the_time_limit_truncates_and_is_no_success():
    env = JetBotGymEnv(max_episode_length=5)
    for _ in range(2):
        env.reset()
        _, _, terminated, truncated, infos = drive(env, [np.array([-1.0, 0.0])] * 5)
        assert terminated == (False,) * 5
        assert truncated == (False,) * 4 + (True,)
        assert not any(info["is_success"] for info in infos)


def test_a_longer_frame_is_made_of_more_physics_steps():
    env = JetBotGymEnv(skip_frame=3, max_episode_length=4)
    assert env.config.physics.n_substeps == 6
    assert env.metadata["render_fps"] == 20
    env.reset()
    truncated = drive(env, [np.zeros(2)] * 4)[3]
    assert truncated == (False, False, False, True)  # environment steps, not physics steps
    assert env.robot.data.time == pytest.approx(12 / 60)


@pytest.mark.parametrize(
    ("physics_dt", "substeps"), [(1 / 240, 1), (1 / 120, 1), (1 / 100, 2), (1 / 60, 2)]
)
def test_a_frame_is_the_same_however_many_make_a_step(physics_dt, substeps):
    one, three = JetBotGymEnv(1, physics_dt), JetBotGymEnv(3, physics_dt)
    assert one.config.physics.n_substeps == substeps
    assert three.config.physics.n_substeps == 3 * substeps
    one.reset()
    three.reset()
    for action in np.random.default_rng(0).uniform(-1, 1, (8, 2)).astype(np.float32):
        short = [one.step(action) for _ in range(3)]
        obs, reward, *_ = three.step(action)
        np.testing.assert_allclose(obs, short[-1][0], atol=1e-6)
        assert reward == pytest.approx(sum(step[1] for step in short), abs=1e-6)


def test_time_steps_that_fit_after_rounding_are_kept():
    env = JetBotGymEnv(config={"physics": {"sim_dt": 0.008325}})  # 2.002 times into 1/60
    assert env.config.physics.n_substeps == 2


def test_the_same_seed_gives_the_same_episodes_and_each_has_a_goal_of_its_own():
    def goals(env, seed):
        return np.array([env.reset(seed=seed)[0][GOAL], *(env.reset()[0][GOAL] for _ in range(9))])

    first, again, other = (goals(JetBotGymEnv(), seed) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    np.testing.assert_array_equal(goals(JetBotGymEnv(seed=1), None), other)
    assert len(np.unique(np.concatenate([first, other])[:, 0])) == 20
    assert (first[:, 2] == np.float32(GOAL_HEIGHT)).all()
    reach = np.linalg.norm(first[:, :2], axis=1)
    assert ((reach > 0.2) & (reach < 1.2)).all()


@pytest.mark.parametrize("blow_up", ["velocity", "action"])
def test_a_non_finite_state_is_truncated_and_reported(env, blow_up, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before, _ = env.reset()
    qpos = env.robot.data.qpos.copy()
    action = np.zeros(2)
    if blow_up == "velocity":
        env.robot.data.qvel[0] = np.nan
    else:
        action[1] = np.nan
    obs, reward, terminated, truncated, info = env.step(action)
    assert (reward, terminated, truncated) == (0.0, False, True)
    assert info == {"is_success": False, "nonfinite_world": True}
    np.testing.assert_array_equal(obs, before)
    np.testing.assert_array_equal(env.robot.data.qpos, qpos)  # to be shown
    assert list(tmp_path.iterdir()) == []  # MuJoCo would write a log of its own
    env.reset()
    assert drive(env, [np.zeros(2)] * 3)[3] == (False,) * 3


def test_a_picture_shows_the_robot_where_it_is(needs_opengl):
    env = gymnasium.make(ID, render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    assert first.shape == (480, 480, 3)
    assert first.dtype == np.uint8
    for _ in range(30):
        env.step(np.array([0.5, 1.0]))
    assert np.abs(env.render().astype(int) - first).mean() > 5
    env.close()


@pytest.fixture(scope="module")
def fresh_process():
    """A process that makes the environment by its name, draws it, and does not close it."""
    program = f"""
import gymnasium
env = gymnasium.make({ID!r}, render_mode="rgb_array").unwrapped
print(env.spec.id, flush=True)
env.reset()
print(env.render().shape)
"""
    command = [sys.executable, "-W", "ignore", "-c", program]
    return subprocess.run(command, capture_output=True, text=True)


@pytest.mark.slow
def test_gymnasium_finds_the_environment_in_a_fresh_process(fresh_process):
    assert fresh_process.stdout.startswith("JetBot-v0\n"), fresh_process.stderr[-2000:]


@pytest.mark.slow
def test_an_environment_that_is_not_closed_prints_nothing_at_exit(needs_opengl, fresh_process):
    told = fresh_process
    assert (told.returncode, told.stderr) == (0, "")
    assert told.stdout == "JetBot-v0\n(480, 480, 3)\n"


def test_a_window_follows_the_robot_in_real_time(window):
    env = JetBotGymEnv(headless=False, rendering_dt=1 / 30)
    obs, _ = env.reset()
    for _ in range(8):
        env.step(np.array([1.0, 0.0]))
    assert len(window.shown) == 1 + 4
    qpos, mocap = window.shown[-1]
    np.testing.assert_allclose(qpos, env.robot.data.qpos)
    np.testing.assert_allclose(mocap[0], obs[GOAL], atol=1e-6)
    env.close()
    env.close()
    assert window.shown[-1] == "closed"


def test_without_a_display_one_line_names_the_other_way(monkeypatch):
    if sys.platform != "linux":
        pytest.skip("a missing display is told on Linux only")
    monkeypatch.setitem(sys.modules, "glfw", type(sys)("glfw"))
    sys.modules["glfw"].init = lambda: False
    monkeypatch.setitem(sys.modules, "mujoco.viewer", type(sys)("mujoco.viewer"))
    for make in (JetBotGymEnv, JetBotVectorEnv):
        with pytest.raises(UserError, match="no display: take render_mode='rgb_array'") as caught:
            make(headless=False)
        assert "\n" not in str(caught.value)


# What the camera sees.


def test_the_spaces_of_images_say_how_they_are_ordered():
    def space(config):
        return observation_space(make_env(parse_config(config)).observation_size)

    box = space(sees(colour="grey", frames=2))
    assert box == gymnasium.spaces.Box(0, 255, (36, 40, 2), np.uint8)
    parts = space(sees("camera+egocentric"))
    assert isinstance(parts, gymnasium.spaces.Dict)
    assert set(parts) == {"pixels/front", "state"}
    assert parts["pixels/front"] == gymnasium.spaces.Box(0, 255, (36, 40, 3), np.uint8)
    assert parts["state"] == gymnasium.spaces.Box(-np.inf, np.inf, (7,), np.float32)


@pytest.mark.filterwarnings("ignore:.*A Box observation space m..imum value is -?infinity")
@pytest.mark.parametrize(
    "observation", ["camera", pytest.param("camera+egocentric", marks=pytest.mark.slow)]
)
def test_gymnasiums_checker_passes_with_images(observation):
    check_env(JetBotGymEnv(config=sees(observation)), skip_render_check=True)
    batch = JetBotVectorEnv(2, config=sees(observation))
    obs, _ = batch.reset(seed=0)
    assert batch.observation_space.contains(obs)
    obs, *_ = batch.step(np.zeros((2, 2), np.float32))
    assert batch.observation_space.contains(obs)
