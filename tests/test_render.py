import shutil

import imageio.v3 as iio
import numpy as np
import pytest

from jetbot_mjx import offscreen, render
from jetbot_mjx.errors import UserError


@pytest.fixture(scope="module")
def needs_opengl():
    try:
        offscreen.find_backend()
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


def test_rendering_writes_a_film_a_gif_and_a_plot(smoke_run, tmp_path, needs_opengl, capsys):
    run_dir = shutil.copytree(smoke_run, tmp_path / "run")
    assert render.main([str(run_dir), "--episodes", "2"]) == 0
    folder = next((run_dir / "videos").iterdir())
    film = iio.imread(folder / "episodes.mp4", plugin="pyav")
    assert film.shape[1:] == (400, 800, 3)
    assert film.shape[0] > 40
    assert np.abs(film[0].astype(int) - film[25]).mean() > 1  # it moves
    assert iio.imread(folder / "episodes.gif").shape[0] > 20
    assert iio.imread(folder / "trajectories.png").shape[0] > 400
    shown = capsys.readouterr().out
    for name in ("episodes.mp4", "episodes.gif", "trajectories.png"):
        assert str(folder / name) in shown


def test_without_opengl_one_line_names_the_remedy(monkeypatch, smoke_run, tmp_path):
    run_dir = shutil.copytree(smoke_run, tmp_path / "run")
    monkeypatch.setattr(offscreen, "_PROBE", "raise SystemExit(1) # {backend}")
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    offscreen.find_backend.cache_clear()
    try:
        with pytest.raises(UserError, match="apt-get install") as caught:
            render.run(run_dir, episodes=2)
    finally:
        offscreen.find_backend.cache_clear()
    assert "\n" not in str(caught.value)
    # What needs no OpenGL is there all the same.
    assert list(run_dir.glob("videos/*/trajectories.png"))


def test_a_wanted_backend_is_the_only_one_tried(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    monkeypatch.setattr(offscreen, "_PROBE", "raise SystemExit('{backend}' == 'osmesa')")
    offscreen.find_backend.cache_clear()
    try:
        with pytest.raises(UserError, match="MUJOCO_GL = 'osmesa'"):
            offscreen.find_backend()
    finally:
        offscreen.find_backend.cache_clear()
