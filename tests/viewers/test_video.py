"""Videos of episodes made by hand; nothing is compiled."""

import functools
import itertools
from pathlib import Path

import imageio.v3 as iio
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from PIL import Image, ImageDraw

from jetbot_mjx.config import parse_config
from jetbot_mjx.envs import opengl
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.robot_model import QPOS_QUAT, QPOS_XYZ
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation.evaluator import report_keys
from jetbot_mjx.evaluation.rollout import Episodes
from jetbot_mjx.viewers import offscreen, video
from jetbot_mjx.viewers.video import (
    Trajectory,
    VideoRenderer,
    split_trajectories,
    write_gif,
    write_mp4,
)

SIDE, FPS = 240, 10.0
DT = 1 / 60


@pytest.fixture(scope="module")
def needs_opengl():
    try:
        opengl.find_backend()
    except UserError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def drive(world_env):
    """Makes the episode of a robot that slides straight to a place at 1 m/s."""

    def drive(end_w, goal_w, *, number=7, reached=True):
        qpos = np.tile(world_env.mj_model.qpos0, (1 + round(np.hypot(*end_w) / DT), 1))
        qpos[:, :2] = np.linspace(0, 1, len(qpos))[:, None] * end_w
        goal_w = np.array([*goal_w, 0.05])
        return Trajectory(number, qpos, goal_w, {"goal": goal_w}, reached, DT)

    return drive


@pytest.fixture(scope="module")
def renderer(world_env, needs_opengl):
    with VideoRenderer(world_env, (SIDE, SIDE), FPS) as renderer:
        yield renderer


@pytest.fixture
def places():
    """Where all that is `written` begins [pixels]."""
    return []


@pytest.fixture
def written(monkeypatch, places):
    """All that is written into pictures."""
    texts = []
    original = ImageDraw.ImageDraw.text

    def text(self, place, text, *arguments, **options):
        texts.append(" ".join(text.split()))
        places.append(place)
        return original(self, place, text, *arguments, **options)

    monkeypatch.setattr(ImageDraw.ImageDraw, "text", text)
    return texts


def test_an_episode_ends_where_its_robot_did(world_env):
    goal = np.asarray(jax.vmap(world_env.task.sample)(report_keys(2)))
    qpos = np.random.default_rng(0).normal(size=(2, 9, world_env.mj_model.nq))
    numbers = np.zeros(2)
    episodes = Episodes(
        success=np.array([1.0, 0.0]),
        steps=np.array([5.0, 8.0]),
        episode_return=numbers,
        terminated=numbers,
        nonfinite=numbers,
        path_length=numbers,
        start_w=np.zeros((2, 2)),
        start_yaw=numbers,
        end_w=qpos[:, -1, :2],
        goal_w=goal,
        goal=goal,
        qpos=qpos,
    )
    first, second = split_trajectories(world_env, episodes, [17, 3])
    assert [(one.goal_number, one.steps, one.reached) for one in (first, second)] == [
        (17, 5, True),
        (3, 8, False),
    ]
    np.testing.assert_array_equal(first.qpos, qpos[0, :6])
    np.testing.assert_array_equal(second.markers["goal"], goal[1])
    assert [first.step_at(seconds) for seconds in (0.0, 3 * DT, 4.0)] == [0, 3, 5]
    assert first.distance(5) == pytest.approx(np.linalg.norm(goal[0, :2] - qpos[0, 5, :2]))
    np.testing.assert_array_equal(second.trail_w(6)[:, :2], qpos[1, [0, 4, 6], :2])


@pytest.mark.parametrize(("reached", "outcome"), [(True, "reached"), (False, "missed")])
def test_goal_time_distance_and_outcome_are_written_in(renderer, drive, written, reached, outcome):
    frames = list(renderer.render_episode(drive((0.5, 0.0), (0.5, 0.3), reached=reached)))
    assert written[:2] == ["goal 7 0.00 s", "0.58 m to go"]
    assert written[-3:] == ["goal 7 0.50 s", "0.30 m to go", outcome]
    assert written.count(outcome) == 1
    assert frames[0].shape == (SIDE, SIDE, 3)
    # Real time, and then it stands for a while.
    assert len(frames) == 1 + 0.5 * FPS + round(video.HOLD_SECONDS * FPS)
    assert all(np.array_equal(frames[5], frame) for frame in frames[6:])


def test_finished_robots_stop_while_the_others_drive(renderer, drive, written):
    short, long = drive((0.3, 0.0), (0.4, 0.0)), drive((-0.9, 0.0), (0.4, 0.0), reached=False)
    frames = list(renderer.render_side_by_side([("0 steps", short), ("9 steps", long)]))
    assert len(frames) == 1 + 0.9 * FPS + round(video.HOLD_SECONDS * FPS)
    assert frames[0].shape == (SIDE, 2 * SIDE, 3)
    left, right = ([frame[:, at : at + SIDE] for frame in frames] for at in (0, SIDE))
    assert all(np.array_equal(left[3], panel) for panel in left[4:])
    for before, after in itertools.pairwise(right[:10]):
        assert not np.array_equal(before, after)
    assert written.count("reached") == written.count("missed") == 1
    assert {"0 steps", "9 steps"} <= set(written)
    last = written.index("missed")
    assert written[last - 3 : last] == ["9 steps", "goal 7 0.90 s", "1.30 m to go"]


@pytest.mark.parametrize("reached", [True, False])
def test_a_goal_turns_green_when_it_is_reached(renderer, drive, reached):
    def green(frame):
        r, g, b = np.moveaxis(frame.astype(int), -1, 0)
        return int(((g > 120) & (g > 2 * r) & (g > 2 * b)).sum())

    one = drive((0.5, 0.0), (0.6, 0.0), reached=reached)
    for frames in (renderer.render_episode(one), renderer.render_side_by_side([("", one)])):
        first, *_, last = frames
        assert (green(last) > green(first) + 10) == reached
        assert abs(green(last) - green(first)) < 5 or reached


def test_the_edges_of_shadows_are_fine(renderer):
    model = renderer._view._model
    width = 2 * model.vis.map.shadowclip * model.stat.extent
    assert width / model.vis.quality.shadowsize < 0.004  # [m]; a pixel of the chase view is 3 mm


@pytest.mark.parametrize("size", [(240, 240), (426, 240), (320, 400)])
def test_text_and_inset_stay_above_what_happens(world_env, drive, size, needs_opengl):
    """Their pixels are those that differ from the bare view."""
    one = drive((1.5, 1.5), (-1.0, -0.5), number=1023, reached=False)
    with VideoRenderer(world_env, size, FPS) as renderer:
        camera = renderer._overview([one])
        panel = renderer._episode_view("123,456,789 steps", one, camera, one.steps)
        bare = renderer._view.frame(
            one.qpos[-1],
            one.markers,
            camera,
            trail_w=one.trail_w(one.steps),
            lines_w=offscreen.METRE_LABELS,
        )
    rows, columns = np.nonzero(np.abs(panel.astype(int) - bare).max(axis=-1) > 3)
    assert rows.min() < 0.05 * size[1]
    assert rows.max() < (1 - video._FILLED["above"]) / 2 * size[1]
    assert columns.max() > 0.9 * size[0]


def test_the_inset_is_what_the_robot_sees(renderer, drive):
    def red_in_corner(goal_w):
        one = drive((0.0, 0.2), goal_w)
        frame = next(renderer.render_episode(one)).astype(int)
        corner = frame[: round(0.28 * SIDE), SIDE - round(0.34 * SIDE) : SIDE]
        r, g, b = np.moveaxis(corner, -1, 0)
        return int(((r > 90) & (r > 3 * g) & (r > 3 * b)).sum())

    assert red_in_corner((0.3, 0.0)) > 5
    assert red_in_corner((-0.9, 0.0)) == 0


def test_the_floor_has_a_thick_line_each_metre_and_a_thin_one_each_quarter(world_env, needs_opengl):
    """Seen from above: along x at y = 0.125, between the lines that are parallel to it."""
    model = offscreen.with_metre_grid(world_env.mj_model)
    camera = mujoco.MjvCamera()
    camera.lookat[:] = 0.125, 0.0, 0.0
    camera.distance, camera.elevation, camera.azimuth = 2.0, -90.0, 0.0
    away = {"goal": (9.0, 9.0, 0.0)}
    qpos = model.qpos0 + np.eye(model.nq)[0] * 9
    with offscreen.Renderer(model, width=800, height=100) as renderer:
        image = renderer.frame(qpos, away, camera, shadows=False)
    row = image[20].mean(axis=-1)
    scale = 50 / (2.0 * np.tan(np.radians(model.vis.global_.fovy) / 2))  # [pixels/m]
    place = (np.arange(800) - 399.5) / scale
    # Thin lines are fainter than a pixel is wide.
    lines, thick = place[row < row.max() - 1], place[row < row.max() - 30]
    assert set(np.round(4 * lines[np.abs(lines) < 2.1])) == set(range(-8, 9))
    assert set(np.round(4 * thick[np.abs(thick) < 2.1])) == {-8, -4, 0, 4, 8}
    assert model.tex_data.sum() != world_env.mj_model.tex_data.sum()


def test_videos_are_joined_to_a_loop():
    black, grey, white = (np.full((2, 2, 3), value, np.uint8) for value in (0, 100, 200))
    joined = [int(frame[0, 0, 0]) for frame in video.join([[black, grey], [white]], 3)]
    assert joined == [0, 100, 125, 150, 175, 200, 150, 100, 50]
    assert list(video.join([[], []])) == []


@pytest.fixture(scope="module")
def seeing_env():
    config = {"task": {"observation": "camera"}, "camera": {"width": 16, "height": 12, "frames": 2}}
    return make_env(parse_config(config))


def test_what_a_policy_sees_is_in_the_upper_right_corner(
    seeing_env, drive, written, places, needs_opengl
):
    one = drive((0.0, 0.2), (0.3, 0.1))
    camera = seeing_env.camera
    qpos = jnp.asarray(one.qpos[0])
    seen = np.asarray(camera.render(camera.pose(qpos[QPOS_XYZ], qpos[QPOS_QUAT]), one.markers))
    assert ((seen[..., 0] > 90) & (seen[..., 1] < 40)).any()  # the cube
    with VideoRenderer(seeing_env, (SIDE, SIDE), FPS) as renderer:
        frame = next(renderer.render_episode(one))
        margin, border, square = round(0.03 * SIDE), 2, 4
        right = SIDE - margin - border
        inner = frame[margin + border :, right - 16 * square : right][: 12 * square]
        np.testing.assert_allclose(inner[::square, ::square].astype(int), seen, atol=1)
        np.testing.assert_array_equal(inner[::square], inner[1::square])
        assert (frame[margin : margin + border, right - 16 * square : right] == 255).all()
        # The text is at the upper left, of each of several views too.
        assert written[0] == "goal 7 0.00 s"
        assert max(x for x, _ in places) < SIDE / 4
        views = next(renderer.render_side_by_side([("0 steps", one), ("9 steps", one)]))
        corner = views[margin + border :, right - 16 * square : right][: 12 * square]
        np.testing.assert_array_equal(corner, inner)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("filled", [{}, video._FILLED], ids=["middle", "panel"])
def test_the_overview_is_the_nearest_that_shows_all(seed, filled):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(50, 3)) * [1.5, rng.uniform(0.1, 3), 0.05] + [0.5, -0.4, 0.1]
    camera = offscreen.overview(points, 45.0, **filled)
    angle = np.radians(camera.elevation)
    ahead = np.array([np.cos(angle), 0, np.sin(angle)])
    up = np.array([-np.sin(angle), 0, np.cos(angle)])
    offset = points - (np.array(camera.lookat) - camera.distance * ahead)
    depth = offset @ ahead * np.tan(np.radians(45.0 / 2))
    x, y = offset @ [0, -1, 0] / depth, offset @ up / depth
    shares = {"sides": 0.9, "above": 0.9, "below": 0.9, **filled}
    fit = {"sides": np.abs(x).max(), "above": y.max(), "below": -y.min()}
    assert depth.min() > 0
    assert all(fit[name] <= shares[name] + 1e-9 for name in fit)
    touching = [name for name in fit if fit[name] > shares[name] - 1e-9]
    # Any nearer, and two opposite ones would be outside.
    assert touching == ["sides"] or {"above", "below"} <= set(touching)


def test_the_overview_is_where_mujoco_puts_its_camera(world_env, needs_opengl):
    goal = np.array([1.0, -0.8, 0.0])
    points = np.array([[0.0, 0.0, 0.0], goal])
    camera = offscreen.overview(points, 45.0, sides=0.5, above=0.5, below=0.5)
    with offscreen.Renderer(world_env.mj_model, width=160, height=160) as renderer:
        picture = renderer.frame(world_env.mj_model.qpos0, {"goal": goal}, camera, shadows=False)
    r, g, b = np.moveaxis(picture.astype(int), -1, 0)
    row, column = np.argwhere((r > 100) & (r > 2 * g) & (r > 2 * b)).mean(axis=0)
    assert column == pytest.approx(80 * 1.5, abs=6)
    assert 35 < row < 80


def test_a_trail_is_drawn_without_changing_the_model(world_env, needs_opengl):
    model = world_env.mj_model
    before = (model.vis.quality.offsamples, model.vis.global_.offwidth, model.vis.map.znear)
    trail = np.array([[0.3, -1.0, 0.01], [0.3, 1.0, 0.01]])
    with offscreen.Renderer(model, width=90, height=60) as renderer:
        draw = functools.partial(
            renderer.frame, model.qpos0, {"goal": (5.0, 5.0, 0.0)}, "top", shadows=False
        )
        without, with_trail, again = draw(), draw(trail_w=trail), draw()
    assert without.shape == (60, 90, 3)
    r, g, b = np.moveaxis(with_trail.astype(int), -1, 0)
    blue = np.argwhere((b > r + 60) & (b > g + 40))
    assert np.ptp(blue[:, 0]) <= 2  # a line from left to right
    assert np.ptp(blue[:, 1]) > 40
    np.testing.assert_array_equal(without, again)
    now = (model.vis.quality.offsamples, model.vis.global_.offwidth, model.vis.map.znear)
    assert now == before


def frames(count):
    """Pictures of which no two are alike."""
    rng = np.random.default_rng(1)
    return [rng.integers(0, 255, (32, 48, 3), dtype=np.uint8) for _ in range(count)]


def test_a_video_plays_in_real_time(tmp_path):
    write_mp4(tmp_path / "a.mp4", iter(frames(20)))
    read = iio.imread(tmp_path / "a.mp4", plugin="pyav")
    assert read.shape == (20, 32, 48, 3)
    assert iio.immeta(tmp_path / "a.mp4", plugin="pyav")["fps"] == video.FPS
    write_gif(tmp_path / "a.gif", frames(20)[:: video.GIF_STRIDE])
    with Image.open(tmp_path / "a.gif") as image:
        assert image.n_frames == 10
        shown = 0
        for index in range(10):
            image.seek(index)
            shown += image.info["duration"]
    assert shown == 1000 * 20 / video.FPS


def test_an_animation_keeps_the_colours_of_small_things(tmp_path):
    # As many shades as a lit floor and a sky have, and a few pixels of blue.
    pictures = np.random.default_rng(2).integers(120, 255, (8, 60, 60, 3), dtype=np.uint8)
    for picture in pictures:
        picture[30, 5:9] = (20, 90, 220)
    write_gif(tmp_path / "a.gif", list(pictures))
    read = iio.imread(tmp_path / "a.gif").astype(int)
    assert np.abs(read[:, 30, 5:9] - (20, 90, 220)).max() < 25


@pytest.mark.parametrize("write", [write_mp4, write_gif])
def test_a_file_is_whole_or_as_it_was(tmp_path, monkeypatch, write):
    path = tmp_path / "a.film"
    path.write_bytes(b"as it was")
    original = Path.write_bytes

    def full(self, content):
        original(self, content[:10])
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", full)
        with pytest.raises(OSError, match="No space"):
            write(path, frames(3))
    assert [one.name for one in tmp_path.iterdir()] == ["a.film"]
    assert path.read_bytes() == b"as it was"
    write(path, frames(3))
    assert [one.name for one in tmp_path.iterdir()] == ["a.film"]
    assert len(path.read_bytes()) > 100
