"""The example of a new task: it loads by name, behaves as described, and trains.

And those of Stable-Baselines3 say that they need it.
"""

import json
import re
import runpy
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jetbot_mjx
from helpers import gliding
from helpers.tiny import TINY
from jetbot_mjx.config import load_config
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.state import robot_state
from jetbot_mjx.envs.task import layout_size
from jetbot_mjx.envs.wrappers import wrap_for_training
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation import evaluate_run
from jetbot_mjx.evaluation.evaluator import report_keys
from jetbot_mjx.training import session


@pytest.fixture(scope="module")
def load(root):
    """Return a loader of the example's configuration."""
    return lambda *overrides: load_config(root / "examples" / "obstacle.yaml", overrides)


@pytest.fixture(scope="module")
def env(load):
    return make_env(load())


@pytest.fixture(scope="module")
def drives(env):
    """Drive straight ahead at full speed for one second, twice: into the pillar, and past it."""
    goals = jnp.array([[1.0, 0.0, 0.05], [0.6, 0.0, 0.05]])
    pillars = jnp.array([[0.5, 0.1, 0.125], [0.3, 0.25, 0.125]])
    first = env.reset(jax.random.PRNGKey(0))

    def drive(goal_w, pillar_w):
        goal = first.goal._replace(goal_w=goal_w, pillar_w=pillar_w)

        def step(state, _):
            state = env.step(state, jnp.array([1.0, 0.0]))
            robot = robot_state(state.pipeline_state)
            seen = {
                "done": state.done,
                "terminated": state.info["terminated"],
                "reward": state.reward,
                "to_pillar": env.task.pillar_distance(robot, goal),
                **state.metrics,
            }
            return state, seen

        return jax.lax.scan(step, first.replace(goal=goal), length=60)[1]

    return jax.device_get(jax.jit(jax.vmap(drive))(goals, pillars))


@pytest.fixture(scope="module")
def episodes(env):
    """Run five episodes of two steps in each of eight environments; return obs and goals."""
    batch = wrap_for_training(env, episode_length=2)

    def step(state, _):
        state = batch.step(state, jnp.zeros((8, 2)))
        return state, (state.obs, state.done, state.goal)

    def run(keys):
        return jax.lax.scan(step, batch.reset(keys), length=10)[1]

    obs, done, goal = jax.device_get(jax.jit(run)(jax.random.split(jax.random.PRNGKey(1), 8)))
    np.testing.assert_array_equal(done, np.tile([[0.0], [1.0]], (5, 8)))
    return obs, goal


def test_observation_has_the_size_of_its_layout(env, episodes):
    obs, _ = episodes
    names = [field.name for field in env.task.layout]
    assert names[-3:] == ["pillar_position", "pillar_direction", "pillar_distance"]
    assert obs.shape[-1] == layout_size(env.task.layout) == env.observation_size


def test_observation_shows_the_pillar_in_the_body_frame(env):
    state = env.reset(jax.random.PRNGKey(0))
    goal = state.goal._replace(pillar_w=jnp.array([1.3, 0.6, 0.125]))
    # At (1, 1) and turned left by 90°: 0.3 m along x is to the right, 0.4 m down y is behind.
    robot = robot_state(state.pipeline_state)._replace(
        position_w=jnp.array([1.0, 1.0, 0.0325]), quat=jnp.array([0.5**0.5, 0.0, 0.0, 0.5**0.5])
    )
    seen = env.task.observe(robot, goal)[-5:]
    np.testing.assert_allclose(seen, [-0.4, -0.3, -0.8, -0.6, 0.5], atol=1e-6)


def test_pillar_ends_the_episode_without_success(drives, env):
    at = int(np.argmax(drives["done"][0]))
    assert drives["terminated"][0, at] == 1
    assert drives["success"][0].max() == 0
    assert drives["to_pillar"][0, at] < env.task.hit_distance <= drives["to_pillar"][0, at - 1]


def test_pillar_costs_the_penalty_once(drives, env):
    at = int(np.argmax(drives["done"][0]))
    collision, progress = drives["reward/collision"][0], drives["reward/progress"][0]
    assert np.all(collision[:at] == 0)
    assert collision[at] == -env.task.options.collision_penalty
    np.testing.assert_allclose(drives["reward"][0], progress + collision, rtol=1e-6)


def test_goal_past_the_pillar_is_a_success(drives, env):
    at = int(np.argmax(drives["done"][1]))
    assert drives["terminated"][1, at] == drives["success"][1, at] == 1
    assert drives["to_pillar"][1].min() > env.task.hit_distance


def test_goal_and_pillar_at_once_is_a_failure(env):
    state = env.reset(jax.random.PRNGKey(0))
    robot = robot_state(state.pipeline_state)
    # 0.09 m to the goal, 0.16 m to the pillar behind it.
    goal = state.goal._replace(
        goal_w=jnp.array([0.09, 0.0, 0.05]), pillar_w=jnp.array([0.16, 0.0, 0.125])
    )
    assert env.task.distance(robot, goal) < env.config.task.success_radius
    assert env.task.terminated(robot, goal)
    assert not env.task.success(robot, goal)


def test_every_episode_has_its_own_pillar(episodes):
    _, goal = episodes
    # Steps 2, 4, … begin an episode; the goal stays the same until the next.
    pillars = goal.pillar_w[1::2].reshape(-1, 3)
    assert len(np.unique(pillars, axis=0)) == 40
    np.testing.assert_array_equal(goal.pillar_w[1:9:2], goal.pillar_w[2:10:2])


def test_observations_are_finite(episodes):
    obs, _ = episodes
    assert np.all(np.isfinite(obs))


def test_pillar_stands_in_the_way_and_clear_of_start_and_goal(env):
    keys = jax.random.split(jax.random.PRNGKey(2), 4096)
    goal = jax.device_get(jax.jit(jax.vmap(env.task.sample))(keys))
    goal_w, pillar_w = goal.goal_w[:, :2], goal.pillar_w[:, :2]
    to_goal = np.linalg.norm(goal_w, axis=-1)
    assert np.linalg.norm(pillar_w, axis=-1).min() >= env.task.clearance - 1e-5
    assert np.linalg.norm(goal_w - pillar_w, axis=-1).min() >= env.task.clearance - 1e-5
    x, y = goal_w.T / to_goal
    aside = np.abs(x * pillar_w[:, 1] - y * pillar_w[:, 0])
    assert aside.max() < env.task.hit_distance
    assert aside.max() == pytest.approx(env.task.options.pillar_offset, rel=0.01)


def test_markers_place_mocap_bodies_of_the_scene(env):
    markers = env.task.markers(env.reset(jax.random.PRNGKey(0)).goal)
    assert set(markers) == {"goal", "pillar"}
    assert all(env.mj_model.body(name).mocapid[0] >= 0 for name in markers)


def test_pillar_takes_no_part_in_physics(env, world_env):
    assert env.mjx_model.ngeom == world_env.mjx_model.ngeom
    assert env.mj_model.ngeom == world_env.mj_model.ngeom + 1


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("task.options.pilar_radius=0.1", "pilar_radius"),
        ("task.options.pillar_radius=-0.1", "pillar_radius = -0.1"),
        ("task.goal_distance_min=0.3", "make it at least 0.78"),
    ],
)
def test_wrong_settings_are_refused(load, override, message):
    with pytest.raises(UserError, match=message):
        make_env(load(override))


@pytest.mark.usefixtures("blank_figures")
def test_training_and_evaluation_run_end_to_end(load, env, tmp_path):
    with gliding.everywhere():
        result = session.run(load(*TINY), tmp_path / "run")
        report = evaluate_run(result.run_dir, episodes=4)
    lines = (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()
    assert [json.loads(line)["env_steps"] for line in lines] == [0, 1024, 2048]
    policy = jetbot_mjx.load_policy(result.run_dir, "last")
    assert policy(jnp.zeros((3, 12))).shape == (3, 2)
    # A goal that is more than a position is evaluated and reported like any other.
    goals = jax.vmap(env.reset)(report_keys(4)).goal.goal_w
    distances = np.linalg.norm(goals[:, :2], axis=-1)
    told = {failure.goal: failure.distance for failure in report.failures}
    assert told
    assert all(distance == pytest.approx(distances[goal]) for goal, distance in told.items())
    assert (report.folder / "report.html").is_file()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pillars", "gates"])
def test_the_larger_examples_reach_nine_tenths(name, tmp_path):
    session.run(load_config(name), tmp_path / "run")
    assert evaluate_run(tmp_path / "run").policy.success_rate >= 0.9


@pytest.mark.parametrize("name", ["sb3_train", "sb3_eval"])
def test_what_an_example_needs_is_told(name, root, monkeypatch, capsys):
    packages = ("stable_baselines3", "torch", "gymnasium")
    # Python finds a module that is loaded without asking for its package.
    for module in {*packages, *(x for x in sys.modules if x.startswith(packages))}:
        monkeypatch.setitem(sys.modules, module, None)
    for argument, code in (([], 2), (["--help"], 0)):
        monkeypatch.setattr(sys, "argv", [f"{name}.py", *argument])
        with pytest.raises(SystemExit) as ended:
            runpy.run_path(str(root / "examples" / f"{name}.py"), run_name="__main__")
        assert ended.value.code == code
    told = capsys.readouterr()
    assert re.fullmatch(rf"error: {name}\.py needs .*: pip install .*sb3\].*\n", told.err)
    assert f"usage: {name}.py" in told.out
