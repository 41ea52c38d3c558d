"""Many robots in one scene, on episodes made by hand; nothing is compiled."""

import math
import shutil
from pathlib import Path

import imageio.v3 as iio
import jax
import mujoco
import numpy as np
import pytest

from helpers import gliding
from helpers.command_modules import render
from jetbot_mjx.envs import opengl
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation.evaluator import report_keys
from jetbot_mjx.evaluation.rollout import Episodes
from jetbot_mjx.viewers import grid_renderer, many, offscreen, robot_grid

ROBOTS = 6


@pytest.fixture(scope="module")
def needs_opengl():
    try:
        opengl.find_backend()
    except UserError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def episodes(world_env):
    """Robots that slide straight to their goals; every other one stops half-way."""
    goal = np.asarray(jax.vmap(world_env.task.sample)(report_keys(ROBOTS)))
    success = np.arange(ROBOTS) % 2.0
    qpos = np.tile(world_env.mj_model.qpos0, (ROBOTS, 31, 1))
    share = np.linspace(0, 1, 31)[:, None] * (0.5 + 0.5 * success)[:, None, None]
    qpos[:, :, :2] = share * goal[:, None, :2]
    zeros = np.zeros(ROBOTS)
    return Episodes(
        success=success,
        steps=zeros + 30,
        episode_return=zeros,
        terminated=success,
        nonfinite=zeros,
        path_length=zeros,
        start_w=np.zeros((ROBOTS, 2)),
        start_yaw=zeros,
        end_w=qpos[:, -1, :2],
        goal_w=goal,
        goal=goal,
        qpos=qpos,
    )


@pytest.fixture(scope="module")
def grid(world_env, episodes):
    return robot_grid.place_on_grid(world_env, episodes)


def test_each_robot_drives_in_its_own_cell_as_it_did_alone(grid, episodes):
    shift = grid.qpos[:, 0, :2] - episodes.qpos[:, 0, :2]
    np.testing.assert_allclose(grid.qpos[:, :, :2], episodes.qpos[:, :, :2] + shift[:, None])
    np.testing.assert_array_equal(grid.qpos[:, :, 2:], episodes.qpos[:, :, 2:])
    goal = grid.markers["goal"]
    np.testing.assert_allclose(goal[:, :2], episodes.goal_w[:, :2] + shift, atol=1e-6)
    # The boxes around the episodes do not overlap.
    points = np.concatenate([grid.qpos[:, :, :2], goal[:, None, :2]], axis=1)
    low, high = points.min(axis=1), points.max(axis=1)
    for one in range(ROBOTS):
        for other in range(one):
            assert np.any((high[one] < low[other]) | (high[other] < low[one]))
    assert np.all(np.abs(points) <= np.abs(grid.corners_w).max(axis=0)[:2])


def test_staggered_starts_begin_at_once_and_end_in_time(grid):
    assert grid.start_seconds[grid.first] == pytest.approx(0, abs=1e-9)
    assert grid.start_seconds.max() == pytest.approx(robot_grid._WAVE_SECONDS)
    np.testing.assert_array_equal(grid.steps_at(0.0), np.zeros(ROBOTS))
    ends = grid.steps_at(grid.seconds)
    np.testing.assert_array_equal(ends, grid.steps)
    np.testing.assert_array_equal(grid.reached_at(ends), [False, True] * 3)
    assert not grid.reached_at(grid.steps_at(0.0)).any()


def colours(frame):
    """Numbers of red and of green pixels."""
    r, g, b = np.moveaxis(frame.astype(int), -1, 0)
    red = (r > 100) & (r > 2 * g) & (r > 2 * b)
    return int(red.sum()), int(((g > 100) & (g > 2 * r) & (g > 2 * b)).sum())


@pytest.mark.parametrize("smallest", [1.0, 60.0])
@pytest.mark.parametrize("detailed", [0.0, math.inf])
def test_goals_turn_green_when_reached(
    world_env, grid, needs_opengl, monkeypatch, smallest, detailed
):
    monkeypatch.setattr(grid_renderer, "_DETAILED", detailed)
    with grid_renderer.GridRenderer(
        world_env, ROBOTS, 300, 300, smallest_marker=smallest
    ) as renderer:
        camera = grid_renderer.pull_back_camera(grid, renderer.fovy, 1.0, 1.0)
        start, end = (renderer.frame(grid, at, camera) for at in (0.0, grid.seconds))
        again = renderer.frame(grid, 0.0, camera)
    np.testing.assert_array_equal(start, again)
    assert colours(start)[0] > 6
    assert colours(start)[1] == 0
    assert 0 < colours(end)[0] < colours(start)[0]
    assert colours(end)[1] > 3


@pytest.mark.parametrize(("few", "segments"), [(ROBOTS, 6), (ROBOTS - 1, 2)])
def test_the_trails_of_few_robots_are_smooth(
    world_env, grid, needs_opengl, monkeypatch, few, segments
):
    monkeypatch.setattr(grid_renderer, "_FEW_ROBOTS", few)
    with grid_renderer.GridRenderer(world_env, ROBOTS, 100, 100) as renderer:
        camera = grid_renderer.pull_back_camera(grid, renderer.fovy, 1.0, 1.0)
        renderer.frame(grid, grid.seconds, camera)
        scene = renderer._renderer.scene
        kinds = [scene.geoms[index].type for index in range(scene.ngeom)]
    assert kinds.count(int(mujoco.mjtGeom.mjGEOM_LINE)) == ROBOTS * segments


def test_the_camera_moves_back_from_the_first_robot_until_it_sees_all(grid):
    near, middle, far = (
        grid_renderer.pull_back_camera(grid, 45.0, 16 / 9, at) for at in (0, 0.5, 1)
    )
    assert near.distance < middle.distance < far.distance
    first_w = grid.qpos[grid.first, 0, :2]
    assert np.linalg.norm(near.lookat[:2] - first_w) < 1.0
    wide = offscreen.overview(grid.corners_w, 45.0, sides=0.97 * 16 / 9, above=0.97, below=0.97)
    np.testing.assert_allclose(far.lookat, wide.lookat)
    assert far.distance == pytest.approx(wide.distance)


def test_a_strip_shows_the_first_one_that_fails_and_the_last():
    rates = {0: 0.0, 10: 0.05, 20: 0.45, 30: 0.9, 40: 0.4}
    chosen = many.untrained_early_trained(rates)
    assert chosen == {"untrained": 0, "early": 20, "trained": 40}
    assert many.note_on_early(rates, 20) == ""
    shown = many.Rendered({0: 0, 20: 9}, 16, {"image": Path("a.png")}, "a note").describe()
    assert shown.splitlines()[2:] == ["a note", "image: a.png"]
    with pytest.raises(UserError, match="smaller checkpoint_interval"):
        many.untrained_early_trained({0: 0.0, 10: 1.0})


@pytest.mark.parametrize(
    ("rates", "said"),
    [
        ({0: 0.0, 10: 0.56, 20: 0.9}, "56%: train with a smaller checkpoint_interval or ppo."),
        ({0: 0.0, 10: 0.02, 20: 0.95}, "2%: train with a smaller checkpoint_interval or ppo."),
        ({0: 0.0, 10: 0.02, 20: 0.21, 30: 0.3}, "21%: train longer, because none reached that"),
    ],
)
def test_what_helps_if_no_checkpoint_is_early_is_told(rates, said):
    early = many.untrained_early_trained(rates)["early"]
    expected = f"no checkpoint is close to 40% success, the early one has {said}"
    assert many.note_on_early(rates, early).startswith(expected)


def test_many_robots_and_a_strip_are_rendered(
    smoke_run, tmp_path, needs_opengl, monkeypatch, capsys
):
    monkeypatch.setattr(many, "FPS", 2)
    run = shutil.copytree(smoke_run, tmp_path / "run")
    with gliding.everywhere():
        assert render.main([str(run), "--many", "2", "--size", "160x96"]) == 0
    (gif,) = run.glob("videos/*/many-2.gif")
    assert gif.stat().st_size <= many.MAX_GIF_BYTES
    assert iio.imread(gif.with_suffix(".mp4"), plugin="pyav").shape[1:] == (96, 160, 3)
    with gliding.everywhere():
        assert render.main([str(run), "--strip", "--many", "2"]) == 0
    assert iio.imread(run / "videos" / "training.png").shape[1] > 3 * many._STRIP_SIDE
    shown = capsys.readouterr().out
    assert f"gif:   {gif}" in shown
    assert "of 2 goals reached" in shown
    with pytest.raises(UserError, match="is one checkpoint"):
        many.render_training_strip(gif.parents[2] / "checkpoints" / f"{65_536:012}")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--many", "0"], "--many"),
        (["--many", "4", "--goals", "3"], "not allowed with argument"),
        (["--many", "4", "--gallery"], "--many: cannot be combined with --gallery"),
        (["--strip", "--gallery"], "--strip: cannot be combined with --gallery"),
        (["--strip", "--goals", "3"], "--goals: cannot be combined with --strip"),
        (["--strip", "--episodes", "3"], "--episodes: cannot be combined with --strip"),
        (["--strip", "--checkpoint", "last"], "--checkpoint: cannot be combined with --strip"),
    ],
)
def test_options_that_contradict_are_refused_in_one_line(arguments, said, capsys):
    with pytest.raises(SystemExit) as left:
        render.main(["run", *arguments])
    assert left.value.code == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
