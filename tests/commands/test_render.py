"""The command `render`."""

import functools
import inspect
import os
import shutil
import subprocess
import sys

import imageio.v3 as iio
import jax
import numpy as np
import pytest

from helpers import gliding
from helpers.command_modules import render
from jetbot_mjx import evaluate
from jetbot_mjx.envs import opengl
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation import goal_set
from jetbot_mjx.evaluation.evaluator import Evaluator, report_keys
from jetbot_mjx.evaluation.goal_set import REPORT_GOALS
from jetbot_mjx.runs.checkpoint import load_checkpoint
from jetbot_mjx.terminal import progress
from jetbot_mjx.viewers import gallery, offscreen, render_gallery, render_run
from jetbot_mjx.viewers.video import VideoRenderer
from onekernel.aot.program_cache import ProgramCache


@pytest.fixture(scope="module")
def needs_opengl():
    try:
        opengl.find_backend()
    except UserError as error:
        pytest.skip(str(error))


def test_the_cameras_show_the_robot_the_cube_and_where_they_are(world_env, needs_opengl):
    qpos = np.array(world_env.mj_model.qpos0)
    with offscreen.Renderer(world_env.mj_model, width=160, height=160) as renderer:
        top = renderer.frame(qpos, {"goal": (0.9, 0.0, 0.05)}, "top").astype(int)
        left = renderer.frame(qpos, {"goal": (0.0, 0.9, 0.05)}, "top").astype(int)
        chase = renderer.frame(qpos, {"goal": (0.9, 0.0, 0.05)}, "chase").astype(int)
        onboard = renderer.frame(qpos, {"goal": (0.9, 0.0, 0.05)}, "onboard").astype(int)

    def red(image):
        r, g, b = np.moveaxis(image, -1, 0)
        return np.argwhere((r > 100) & (r > 2 * g) & (r > 2 * b)).mean(axis=0)

    assert top.shape == (160, 160, 3)
    row, column = red(top)  # world x is up in the picture, y to the left
    assert row < 60
    assert 70 < column < 90
    row, column = red(left)
    assert column < 60
    assert 70 < row < 90
    for image in (chase, onboard):
        assert 60 < red(image)[1] < 100  # straight ahead
    assert image.std() > 5


@pytest.fixture(scope="module", autouse=True)
def evaluator(smoke_run):
    """Every picture of this file is of two goals, to which a robot glides: their program is
    compiled once."""
    checkpoint = load_checkpoint(smoke_run)
    evaluator = Evaluator(checkpoint.make_env(), checkpoint.networks, ProgramCache({}), record=True)
    with gliding.everywhere(), pytest.MonkeyPatch.context() as patch:
        patch.setattr(
            gallery.evaluation, "Evaluator", lambda env, networks, programs, record: evaluator
        )
        yield evaluator


@pytest.fixture
def coarse(monkeypatch):
    """Films in few pictures."""
    monkeypatch.setattr(gallery, "VideoRenderer", functools.partial(VideoRenderer, fps=5))


@pytest.fixture
def filmed(monkeypatch):
    """The goals that would be rendered, without rendering them."""
    shots = []
    sizes = []

    class Listener:
        def __init__(self, env, size):
            sizes.append(size)

        def __enter__(self):
            return self

        def __exit__(self, *exception):
            pass

        def frame_count(self, drives):
            return 1

        def render_episode(self, drive):
            shots.append([("", drive)])
            yield np.zeros((2, 2, 3), np.uint8)

        def render_side_by_side(self, shown):
            shots.append(shown)
            yield np.zeros((2, 2, 3), np.uint8)

    monkeypatch.setattr(gallery, "VideoRenderer", Listener)
    return shots


@pytest.fixture
def run_copy(smoke_run, tmp_path):
    return shutil.copytree(smoke_run, tmp_path / "run")


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_rendering_writes_a_video_a_gif_and_a_plot(run_copy, needs_opengl, coarse, capsys):
    assert render.main([str(run_copy), "--episodes", "2", "--size", "720x80"]) == 0
    (folder,) = (run_copy / "videos").iterdir()
    film = iio.imread(folder / "episodes-2.mp4", plugin="pyav")
    assert film.shape[1:] == (80, 720, 3)
    assert film.shape[0] > 8
    assert np.abs(film[0].astype(int) - film[5]).max() > 50  # it moves
    assert iio.imread(folder / "episodes-2.gif").shape[1:] == (71, 640, 3)
    assert iio.imread(folder / "trajectories-2.png").shape[0] > 400
    shown = capsys.readouterr().out
    for name in ("episodes-2.mp4", "episodes-2.gif", "trajectories-2.png"):
        assert str(folder / name) in shown


def test_the_requested_goals_are_rendered(run_copy, filmed):
    pictures = render_run(run_copy, goals=[3, 1])
    env = load_checkpoint(run_copy).make_env()
    goals_w = {drive.goal_number: drive.goal_w for ((_, drive),) in filmed}
    assert list(goals_w) == [3, 1]
    assert pictures.episodes == 2
    every = jax.vmap(env.reset)(report_keys(4)).goal
    for number, goal_w in goals_w.items():
        # Another program draws it, and may round the last bit otherwise.
        np.testing.assert_allclose(goal_w, every[number], rtol=1e-6)
    assert names(pictures.files["video"].parent) == [
        "goals-3,1.gif",
        "goals-3,1.mp4",
        "goals-3,1.png",
    ]
    # The plan view has the style of the report's plots, in which nothing is quite black.
    plot = iio.imread(pictures.files["video"].with_suffix(".png"))
    assert plot.min() > 0


@pytest.mark.parametrize(
    ("text", "goals", "name"),
    [
        ("3,17", [3, 17], "3,17"),
        ("0-7", [0, 1, 2, 3, 4, 5, 6, 7], "0-7"),
        ("17, 3-5,1023", [17, 3, 4, 5, 1023], "17,3-5,1023"),
        ("5,4", [5, 4], "5,4"),
        ("4,5", [4, 5], "4-5"),
    ],
)
def test_goals_are_written_as_indices_and_ranges(text, goals, name):
    assert goal_set.parse_goals(text) == goals
    assert goal_set.format_goals(goals) == name


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--goals", "1024"], "goal 1024 is not one of the 1,024 fixed goals: they are 0 to 1023"),
        (["--goals", "5-999999999"], "goal 1024 is not one of the 1,024 fixed goals"),
        (["--goals", "3,x"], "'x' is not a goal: write indices and ranges, as in 3,17 or 0-7"),
        (["--goals", "3,"], "'' is not a goal"),
        (["--goals=-3"], "'-3' is not a goal"),
        (["--goals", "²"], "'²' is not a goal"),
        (["--goals", "7-3"], "7-3 is a reversed range: write 3-7"),
        (["--goals", "3,1-4"], "goal 3 is given twice: give it once"),
        (["--goals", "3", "--episodes", "2"], "--episodes: not allowed with argument --goals"),
        (["--size", "1280"], "--size: '1280' is not a size: write it as in 1280x720"),
        (["--size", "1280x720p"], "--size: '1280x720p' is not a size"),
        (
            ["--size", "1280x719"],
            "--size: size = 1280x719 is wrong: it should be two even numbers from 64 to 4096",
        ),
        (["--size", "62x720"], "--size: size = 62x720 is wrong"),
        (["--size", "1280x4098"], "--size: size = 1280x4098 is wrong"),
        (["--size", "640x480", "--strip"], "--size: cannot be combined with --strip"),
        (["--gallery", "--goals", "3"], "--goals: cannot be combined with --gallery"),
        (["--gallery", "--checkpoint", "last"], "--checkpoint: cannot be combined with --gallery"),
    ],
)
def test_an_invalid_range_is_refused_in_one_line(arguments, said, capsys):
    with pytest.raises(SystemExit) as left:
        render.main(["run", *arguments])
    assert left.value.code == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("goals", [[], [-1], [1024], [2, 2]])
def test_goals_that_are_none_are_refused_from_python_too(goals):
    with pytest.raises(UserError, match="goal"):
        render_run("run", goals=goals)


def test_a_report_has_as_many_goals_as_can_be_rendered():
    assert inspect.signature(evaluate).parameters["episodes"].default == REPORT_GOALS


@pytest.mark.parametrize(
    ("steps", "chosen"),
    [
        ([0], [0]),
        ([0, 10], [0, 10]),
        ([0, 10, 20], [0, 10, 20]),
        ([0, 10, 20, 30], [0, 10, 30]),
        ([5, 10, 20, 30, 70], [5, 20, 70]),
    ],
)
def test_a_gallery_shows_the_first_the_middle_and_the_last(steps, chosen):
    assert gallery.early_middle_final(steps) == chosen


@pytest.fixture
def stages(monkeypatch):
    """Name and total of every stage that is shown, however short."""
    shown, original = [], progress._lines

    def lines(stream):
        show = original(stream)

        def record(name, total):
            shown.append((name, total))
            return show(name, total)

        return record

    monkeypatch.setattr(progress, "_lines", lines)
    return shown


def test_a_gallery_has_the_same_goals_driven_by_each(run_copy, filmed, capsys, stages, monkeypatch):
    monkeypatch.setattr(gallery, "some_without_gpu", lambda: True)
    assert render.main([str(run_copy), "--gallery", "--episodes", "2"]) == 0
    assert len(filmed) == 2
    for number, shots in enumerate(filmed):
        headings, shown = zip(*shots, strict=True)
        assert headings == ("0 steps", "32,768 steps", "65,536 steps")
        assert {drive.goal_number for drive in shown} == {number}
        for drive in shown[1:]:
            np.testing.assert_array_equal(drive.goal_w, shown[0].goal_w)
        # Three policies, not one thrice.
        ends = {tuple(drive.qpos[min(drive.steps, 20)]) for drive in shown}
        assert len(ends) == 3
    shown = capsys.readouterr().out
    slowly = "frames (slow: no GPU with OpenGL)"
    assert stages[-2:] == [(slowly, 2), ("writing the gif", None)]
    assert stages.count(("2 episodes, policy", None)) == 3
    assert "           0 steps  0 of 2 goals reached" in shown
    for suffix in ("mp4", "gif", "png"):
        assert str(run_copy / "videos" / f"gallery-2.{suffix}") in shown


@pytest.mark.slow
def test_a_gallery_has_a_video_an_animation_and_a_sheet(run_copy, needs_opengl, coarse):
    rendered = render_gallery(run_copy, episodes=2, size=(250, 80))
    film = iio.imread(rendered.files["video"], plugin="pyav")
    assert film.shape[1:] == (80, 246, 3)  # three equal widths, together even
    assert names(run_copy / "videos") == ["gallery-2.gif", "gallery-2.mp4", "gallery-2.png"]
    assert iio.imread(rendered.files["gif"]).shape[1:] == (80, 246, 3)
    height, width, _ = iio.imread(rendered.files["plots"]).shape
    assert width == 3 * height
    assert list(rendered.successes) == [0, 32_768, 65_536]


@pytest.mark.slow
def test_the_smallest_gallery_is_rendered(run_copy, needs_opengl, coarse):
    rendered = render_gallery(run_copy, episodes=1, size=(64, 64))
    assert iio.imread(rendered.files["video"], plugin="pyav").shape[1:] == (64, 60, 3)


def test_one_checkpoint_makes_no_gallery(run_copy):
    with pytest.raises(UserError, match="is one checkpoint: give the run folder that contains it"):
        render_gallery(run_copy / "checkpoints" / f"{65_536:012}")
    with pytest.raises(UserError, match="no such folder"):
        render_gallery(run_copy / "nothing")


def test_without_opengl_one_line_names_the_remedy(monkeypatch, run_copy):
    monkeypatch.setattr(opengl, "_PROBE", "raise SystemExit(1) # {backend}")
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    opengl.find_backend.cache_clear()
    try:
        with pytest.raises(UserError, match="apt-get install") as caught:
            render_run(run_copy, episodes=2)
    finally:
        opengl.find_backend.cache_clear()
    assert "\n" not in str(caught.value)
    # What needs no OpenGL is there all the same.
    assert list(run_copy.glob("videos/*/trajectories-2.png"))


def test_a_wanted_backend_is_the_only_one_tried(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    monkeypatch.setattr(opengl, "_PROBE", "raise SystemExit('{backend}' == 'osmesa')")
    opengl.find_backend.cache_clear()
    try:
        with pytest.raises(UserError, match="'osmesa' does not work here: unset it, or install"):
            opengl.find_backend()
    finally:
        opengl.find_backend.cache_clear()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("wanted", "said"),
    [
        ("osmesa", "'osmesa' does not work here"),
        ("software", "'software': there is no such back end"),
    ],
)
def test_what_needs_no_opengl_works_without_a_back_end(tmp_path, monkeypatch, wanted, said):
    (tmp_path / "OpenGL.py").write_text("None.glGetError", "utf-8")  # what PyOpenGL does
    monkeypatch.setenv("MUJOCO_GL", wanted)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    program = """
from jetbot_mjx import errors, startup
startup.install_lazy_imports()
import jetbot_mjx.envs.physics
from jetbot_mjx.envs import opengl
from jetbot_mjx.viewers import gallery, offscreen, render_gallery, render_run
try:
    opengl.find_backend()
except errors.UserError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert said in done.stdout
