"""Videos of episodes made by hand; nothing is compiled."""

import functools
import itertools
import os

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

WIDTH, HEIGHT, FPS = 240, 120, 10.0
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
    with VideoRenderer(world_env, (WIDTH, HEIGHT), FPS) as renderer:
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
    assert frames[0].shape == (HEIGHT, WIDTH, 3)
    # Real time, and then it stands for a while.
    assert len(frames) == 1 + 0.5 * FPS + round(video.HOLD_SECONDS * FPS)
    assert all(np.array_equal(frames[5], frame) for frame in frames[6:])


def test_finished_robots_stop_while_the_others_drive(renderer, drive, written):
    short, long = drive((0.3, 0.0), (0.4, 0.0)), drive((-0.9, 0.0), (0.4, 0.0), reached=False)
    frames = list(renderer.render_side_by_side([("0 steps", short), ("9 steps", long)]))
    assert len(frames) == 1 + 0.9 * FPS + round(video.HOLD_SECONDS * FPS)
    assert frames[0].shape == (HEIGHT, 2 * WIDTH, 3)
    left, right = ([frame[:, at : at + WIDTH] for frame in frames] for at in (0, WIDTH))
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


def test_the_floor_does_not_shade_itself(world_env, needs_opengl):
    """Seven metres of it: where nothing stands, shadows add no edges."""
    camera = mujoco.MjvCamera()
    camera.azimuth, camera.elevation, camera.distance = 0.0, -50.0, 7.0
    model = offscreen.with_metre_grid(world_env.mj_model)

    def edges(frame):
        return np.abs(np.diff(frame.astype(int).sum(axis=-1), axis=1))

    with offscreen.Renderer(model, width=320, height=320) as renderer:
        draw = functools.partial(renderer.frame, model.qpos0, {"goal": (0, 0, -9)}, camera)
        added = np.abs(edges(draw()) - edges(draw(shadows=False)))
    added[140:200, 140:180] = 0  # the robot
    assert (added > 30).sum() < 10


def test_text_and_inset_stay_above_what_happens(world_env, drive, needs_opengl):
    """Their pixels are those that differ from the bare view, the narrowest of a gallery."""
    one = drive((1.5, 1.5), (-1.0, -0.5), number=1023, reached=False)
    width, height = 426, 480
    with VideoRenderer(world_env, (width, height), FPS) as renderer:
        camera = renderer._overview([one])
        renderer._episode_view("", one, camera, 0)  # a first image may be rounded otherwise
        panel = renderer._episode_view("123,456,789 steps", one, camera, one.steps)
        bare = renderer._view.frame(
            one.qpos[-1],
            one.markers,
            camera,
            trail_w=one.trail_w(one.steps),
            lines_w=offscreen.METRE_LABELS,
        )
    rows, columns = np.nonzero((panel != bare).any(axis=-1))
    assert rows.min() < 0.05 * height
    assert rows.max() < (1 - video._FILLED["above"]) / 2 * height
    assert columns.max() > 0.9 * width
    # And they are not on top of each other: bare columns lie between them.
    assert set(range(columns.max())) - set(columns)


def test_the_inset_is_what_the_robot_sees(renderer, drive):
    def red_in_corner(goal_w):
        one = drive((0.0, 0.2), goal_w)
        frame = next(renderer.render_episode(one)).astype(int)
        corner = frame[: round(0.28 * HEIGHT), WIDTH - round(0.34 * HEIGHT) :]
        r, g, b = np.moveaxis(corner, -1, 0)
        return int(((r > 90) & (r > 3 * g) & (r > 3 * b)).sum())

    assert red_in_corner((0.3, 0.0)) > 5
    assert red_in_corner((-0.9, 0.0)) == 0


def test_the_floor_has_a_grid_and_labels(world_env, needs_opengl):
    """A square metre of it, from straight above: its borders are dark, and labels are in it."""
    qpos = world_env.mj_model.qpos0.copy()
    qpos[0] = 5.0  # out of sight
    camera = mujoco.MjvCamera()
    camera.lookat[:] = (0.5, -0.5, 0.0)
    camera.azimuth, camera.elevation = 0.0, -90.0
    with offscreen.Renderer(
        offscreen.with_metre_grid(world_env.mj_model), width=240, height=240
    ) as renderer:
        # Half a metre beyond the square on every side.
        camera.distance = 1.0 / np.tan(np.radians(world_env.mj_model.vis.global_.fovy / 2))
        draw = functools.partial(renderer.frame, qpos, {"goal": (9, 9, 0)}, camera, shadows=False)
        floor, labelled = draw().astype(int), draw(lines_w=offscreen.METRE_LABELS).astype(int)
    across = floor[100:110].mean(axis=(0, 2))
    darkest = {at for at in range(2, 238) if across[at] < across[[at - 2, at + 2]].min() - 20}
    assert {round(at / 30) for at in darkest} == {2, 6}  # at whole metres
    fine = {at for at in range(2, 238) if across[at] < across[[at - 2, at + 2]].min() - 3}
    assert {round(at / 30) for at in fine} == {1, 2, 3, 4, 5, 6, 7}  # every quarter
    # "1 m" at one metre ahead and at one metre to the right.
    marked = np.argwhere(np.abs(labelled - floor).max(axis=-1) > 30)
    assert {tuple(place) for place in np.round(marked / 60).astype(int).tolist()} == {
        (1, 1),
        (3, 3),
    }


def test_the_end_of_a_video_fades_into_its_start():
    dark, light = (np.full((2, 2, 3), shade, np.uint8) for shade in (0, 200))
    shades = [int(frame.mean()) for frame in video.join([[dark, dark], [light]], fade_frames=3)]
    assert shades == [0, 0, 50, 100, 150, 200, 150, 100, 50]
    assert list(video.join([])) == []


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
    width, height = 480, 240
    with VideoRenderer(seeing_env, (width, height), FPS) as renderer:
        frame = next(renderer.render_episode(one))
        margin, border, square = round(0.03 * height), 2, 4
        right = width - margin
        corner = frame[margin : margin + 12 * square + 2 * border, :right][
            :, -16 * square - 2 * border :
        ]
        inner = corner[border:-border, border:-border]
        np.testing.assert_allclose(inner[::square, ::square].astype(int), seen, atol=1)
        np.testing.assert_array_equal(inner[::square], inner[1::square])
        assert (corner[:border] == 255).all()
        assert (corner[:, -border:] == 255).all()
        # The text is at the upper left, of several views in each.
        assert written[0] == "goal 7 0.00 s"
        views = next(renderer.render_side_by_side([("0 steps", one), ("9 steps", one)]))
        assert {x < 0.1 * width for x, _ in places} == {True}
        np.testing.assert_array_equal(
            views[margin:, : width + right][: len(corner), -len(corner[0]) :], corner
        )


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

    def full(descriptor):
        os.ftruncate(descriptor, 10)
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(OSError, match="No space"):
            write(path, frames(3))
    assert [one.name for one in tmp_path.iterdir()] == ["a.film"]
    assert path.read_bytes() == b"as it was"
    write(path, frames(3))
    assert [one.name for one in tmp_path.iterdir()] == ["a.film"]
    assert len(path.read_bytes()) > 100
