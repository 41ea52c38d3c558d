"""Videos of environments of one's own: from their first camera, in real time, else one line."""

import imageio.v3 as iio
import mujoco
import numpy as np
import pytest

from helpers import point_mass
from jetbot_mjx import library, training
from jetbot_mjx.errors import UserError
from jetbot_mjx.viewers.environment_video import view_of
from jetbot_mjx.viewers.video import FADE_FRAMES, FPS, HOLD_SECONDS


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A run in an environment with a model."""
    folder = tmp_path_factory.mktemp("shown") / "run"
    training.run(point_mass.config("Shown"), folder)
    return folder


@pytest.mark.slow
def test_episodes_are_rendered_in_real_time(folder, with_opengl):
    rendered = library.render(folder, episodes=1, size=(160, 96))
    assert {name: path.name for name, path in rendered.files.items()} == {
        "video": "episodes-1.mp4",
        "gif": "episodes-1.gif",
    }
    assert rendered.describe().splitlines()[0].endswith("in the mean of 1 episode")
    frames = iio.imread(rendered.files["video"])
    seconds = 16 * point_mass.DT
    assert len(frames) == round(seconds * FPS) + round(HOLD_SECONDS * FPS) + 1 + FADE_FRAMES
    assert frames[0].shape == (96, 160, 3)
    # The point is red, and it is to be seen.
    red = frames[0].astype(int)
    assert ((red[..., 0] > 120) & (red[..., 1] < 70) & (red[..., 2] < 70)).sum() > 20


@pytest.mark.slow
def test_a_training_renders_its_policies(tmp_path, with_opengl):
    config = point_mass.config("Shown", evaluation={"episodes": 4, "video": "last"})
    training.run(config, tmp_path / "run")
    (path,) = (tmp_path / "run" / "videos").rglob("*.mp4")
    assert path.parts[-2:] == ("000000002048", "evaluation.mp4")
    assert iio.imread(path)[0].shape == (240, 320, 3)
    assert path.with_suffix(".gif").is_file()


def test_a_training_that_cannot_be_shown_is_refused_before_a_folder_is_made(tmp_path):
    config = point_mass.config(evaluation={"video": True})
    with pytest.raises(UserError, match=r"^evaluation.video = True: .* has no `mj_model`"):
        training.run(config, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_the_view_is_the_first_camera_or_follows_what_moves():
    follows = view_of(mujoco.MjModel.from_xml_string(point_mass.MJCF))
    assert follows.type == mujoco.mjtCamera.mjCAMERA_TRACKING
    assert follows.trackbodyid == 1
    camera = '<camera pos="0 -3 1" xyaxes="1 0 0 0 1 2"/>'
    first = view_of(
        mujoco.MjModel.from_xml_string(point_mass.MJCF.replace("<light", camera + "<light", 1))
    )
    assert (first.type, first.fixedcamid) == (mujoco.mjtCamera.mjCAMERA_FIXED, 0)
    still = view_of(mujoco.MjModel.from_xml_string("<mujoco><worldbody/></mujoco>"))
    assert still.type == mujoco.mjtCamera.mjCAMERA_FREE
    assert np.isfinite(still.distance)


@pytest.mark.slow
def test_what_cannot_be_rendered_is_refused_in_one_line(folder, tmp_path):
    with pytest.raises(UserError, match=r"--goals is for robots, and the run has environment = "):
        library.render(folder, goals=[1])
    for option in ({"gallery": True}, {"many": 4}, {"strip": True}):
        with pytest.raises(UserError, match="has no robot that drives to a goal"):
            library.render(folder, **option)
    training.run(point_mass.config(), tmp_path / "run")
    with pytest.raises(UserError, match="cannot be rendered: it has no `mj_model`, or its state"):
        library.render(tmp_path / "run")
    assert not (tmp_path / "run" / "videos").exists()
