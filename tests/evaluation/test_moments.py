"""The images in the report of a policy that sees, and what the policy looked at."""

import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import gliding
from helpers.further import slow_fixture
from helpers.reports import make_episodes, polar
from jetbot_mjx.agents.networks import make_policy
from jetbot_mjx.evaluation import evaluate_run
from jetbot_mjx.evaluation.evaluator import Evaluator, report_keys
from jetbot_mjx.evaluation.moments import (
    MOST_FAILURES,
    MomentFinder,
    largest_change,
    plot_moments,
    shown_goals,
)
from jetbot_mjx.evaluation.occlusion import occlusion_map
from jetbot_mjx.runs.checkpoint import load_checkpoint
from onekernel.aot.program_cache import ProgramCache

GOALS = 12


@pytest.fixture(scope="module", autouse=True)
def glide():
    with gliding.everywhere():
        yield


@pytest.fixture(scope="module")
def checkpoint():
    """The policy that comes with the package, so weakened that it misses most goals."""
    checkpoint = load_checkpoint("pretrained:jetbot_camera")
    return checkpoint._replace(params=jax.tree.map(lambda x: 0.6 * x, checkpoint.params))


@pytest.fixture(scope="module")
def env(checkpoint):
    return checkpoint.make_env()


@slow_fixture(scope="module")
def episodes(checkpoint, env):
    evaluator = Evaluator(env, checkpoint.networks, ProgramCache({}), record=True)
    return jax.device_get(evaluator.run(checkpoint.params, report_keys(GOALS)))


@slow_fixture(scope="module")
def seen(checkpoint, env, episodes):
    finder = MomentFinder(env, checkpoint.networks, ProgramCache({}))
    return finder.find(checkpoint.params, report_keys(GOALS), episodes)


def test_one_success_and_the_first_failures_are_shown():
    won = np.array([0, 0, 1, 1, *[0] * 9])
    episodes = make_episodes(polar(np.full(13, 0.5), np.linspace(0, 300, 13)), won)
    assert shown_goals(episodes) == [2, 0, 1, *range(4, 10)]
    assert len(shown_goals(episodes)) == 1 + MOST_FAILURES
    assert shown_goals(episodes._replace(success=np.ones(13))) == [0]
    assert shown_goals(episodes._replace(success=np.zeros(13))) == [*range(8)]


@pytest.mark.slow
def test_images_are_those_of_the_recorded_episodes(env, episodes, seen):
    assert [one.goal for one in seen] == shown_goals(episodes)
    assert {one.success for one in seen} == {True, False}
    camera = env.camera
    for one in seen:
        last = int(episodes.steps[one.goal])
        goal = jax.tree.map(lambda x, index=one.goal: jnp.asarray(x[index]), episodes.goal)
        for time, seconds, image in zip((0, last // 2, last), one.seconds, one.images, strict=True):
            assert seconds == pytest.approx(time * env.dt)
            qpos = jnp.asarray(episodes.qpos[one.goal, time])
            wanted = camera.render(camera.pose(qpos[:3], qpos[3:7]), env.task.markers(goal))
            # A border between two surfaces may lie on the other side of a ray.
            assert np.mean(np.abs(image.astype(int) - np.asarray(wanted)) > 2) < 0.02


def test_maps_are_those_of_the_policy(checkpoint, seen):
    policy = make_policy(checkpoint.networks, checkpoint.params)
    for one in seen[:2]:
        wanted = occlusion_map(policy, {"pixels/front": one.images[1]})
        np.testing.assert_allclose(one.heat[1], wanted, atol=1e-4)
    assert largest_change(seen) == max(one.heat.max() for one in seen)


def test_the_figure_has_a_row_for_each_episode(seen):
    figure = plot_moments(seen)
    assert len(figure.axes) == 6 * len(seen)
    first = seen[0]
    np.testing.assert_array_equal(figure.axes[2].images[0].get_array(), first.images[1])
    assert figure.axes[0].get_title() == "start, 0.00 s"
    assert figure.axes[0].get_ylabel() == f"goal {first.goal}\nreached"
    assert figure.axes[6].get_ylabel().endswith("missed")


@pytest.mark.slow
def test_a_report_shows_what_the_policy_saw(tmp_path):
    report = evaluate_run("pretrained:jetbot_camera", episodes=GOALS, output=tmp_path)
    assert len(report.seen) >= 1
    told = json.loads((tmp_path / "report.json").read_text())["seen"]
    assert told["goals"] == [one.goal for one in report.seen]
    assert (told["successes"], told["failures"]) == (1, len(report.seen) - 1)
    assert (tmp_path / "seen.png").stat().st_size > 10_000
    page = (tmp_path / "report.html").read_text("utf-8")
    assert "What the policy saw" in page
    assert "The first goal reached" in page
    assert "(seen.png)" in (tmp_path / "report.md").read_text("utf-8")
