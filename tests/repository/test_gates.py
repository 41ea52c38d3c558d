"""The example with a memory: the number of passed gates is part of the goal."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import gliding
from jetbot_mjx.config import load_config
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.state import robot_state
from jetbot_mjx.envs.wrappers import wrap_for_training


@pytest.fixture(scope="module")
def env(root):
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(root / "examples"))
        with gliding.everywhere():
            yield make_env(load_config(root / "examples" / "gates.yaml"))


@pytest.fixture(scope="module")
def start(env):
    """The first state of a course straight ahead, a gate every 0.3 m."""
    state = env.reset(jax.random.PRNGKey(0))
    gates_w = jnp.array([[0.3, 0.0, 0.1], [0.6, 0.0, 0.1], [0.9, 0.0, 0.1]])
    goal = state.goal._replace(gates_w=gates_w, headings=jnp.zeros(3))
    return state.replace(goal=goal)


@pytest.fixture(scope="module")
def drive(env, start):
    """Straight ahead at full speed along the course."""

    def step(state, _):
        state = env.step(state, jnp.array([1.0, 0.0]))
        seen = {
            "x": state.pipeline_state.qpos[0],
            "passed": state.goal.passed,
            "obs": state.obs,
            "done": state.done,
            **state.metrics,
        }
        return state, seen

    return jax.device_get(jax.jit(lambda: jax.lax.scan(step, start, length=75)[1])())


def robot_at(start, x, y):
    robot = robot_state(start.pipeline_state)
    return robot._replace(position_w=jnp.array([x, y, 0.0325]))


def test_gates_are_counted_as_the_robot_passes_them(drive):
    np.testing.assert_array_equal(drive["passed"], np.searchsorted([0.3, 0.6, 0.9], drive["x"]))
    assert drive["passed"][-1] == 3


def test_the_last_gate_ends_the_episode_with_success(drive):
    last = int(np.argmax(drive["passed"] == 3))
    assert drive["done"][last] == drive["success"][last] == 1
    assert drive["done"][:last].max() == drive["success"][:last].max() == 0


def test_a_gate_is_worth_its_bonus_once(drive):
    import gates_task

    steps = np.diff(drive["passed"], prepend=0)
    np.testing.assert_allclose(drive["reward/gate"], gates_task.BONUS * steps)


def test_the_next_gate_is_seen_in_the_step_that_passes_one(drive):
    at = int(np.argmax(drive["passed"] == 1))
    assert drive["obs"][at, 0] == pytest.approx(0.6 - drive["x"][at], abs=1e-5)
    assert drive["obs"][at, 10] == 2


@pytest.mark.parametrize(
    ("before", "after", "passed"),
    [
        pytest.param((0.29, 0.1), (0.31, 0.1), 1, id="through"),
        pytest.param((0.31, 0.0), (0.29, 0.0), 0, id="from behind"),
        pytest.param((0.29, 0.2), (0.31, 0.2), 0, id="past the post"),
        pytest.param((0.59, 0.0), (0.61, 0.0), 0, id="the next one first"),
    ],
)
def test_a_gate_counts_from_the_front_between_its_posts_in_its_turn(
    env, start, before, after, passed
):
    goal = env.task.advance(robot_at(start, *before), robot_at(start, *after), start.goal)
    assert goal.passed == passed


def test_a_new_episode_begins_with_no_gate_passed(env, start):
    batch = wrap_for_training(env, episode_length=75)
    state = batch.reset(jax.random.split(jax.random.PRNGKey(1), 2))
    course = jax.tree.map(lambda x: jnp.stack([x, x]), start.goal._replace(passed=jnp.int32(2)))
    before = robot_at(start, 0.89, 0.0).position_w
    qpos = state.pipeline_state.qpos.at[:, :3].set(before)
    qvel = state.pipeline_state.qvel.at[:, 0].set(1.0)
    physics = state.pipeline_state.replace(qpos=qpos, qvel=qvel)
    state = batch.step(state.replace(goal=course, pipeline_state=physics), jnp.ones((2, 2)))
    assert state.metrics["success"].tolist() == state.done.tolist() == [1, 1]
    assert state.goal.passed.tolist() == [0, 0]


def test_posts_stand_at_either_side_of_their_gate(env, start):
    import gates_task

    markers = env.task.markers(start.goal)
    left, right = markers["gate_1_left"], markers["gate_1_right"]
    np.testing.assert_allclose(left, [0.6, gates_task.OPENING / 2, 0.1], atol=1e-6)
    np.testing.assert_allclose(right, [0.6, -gates_task.OPENING / 2, 0.1], atol=1e-6)


def test_the_whole_course_moves_with_its_end(env, start):
    moved = env.task.move_goal(start.goal, jnp.array([0.9, 0.5, 0.1]))
    np.testing.assert_allclose(moved.gates_w[:, 1], 0.5)
    np.testing.assert_allclose(moved.gates_w[:, 0], [0.3, 0.6, 0.9])
