"""MuJoCo's window, with a substitute because no test machine has a display."""

import contextlib
import sys
import time
import types

import mujoco
import numpy as np
import pytest

from helpers import gliding
from jetbot_mjx.errors import UserError
from jetbot_mjx.viewers import mujoco_window
from jetbot_mjx.viewers.player import Player


@pytest.fixture(scope="module", autouse=True)
def glide(smoke_run):
    """All robots of these tests glide, after the run was trained with those that do not."""
    with gliding.everywhere():
        yield


@pytest.fixture(scope="module")
def player(smoke_run):
    return Player(smoke_run, agent="keyboard")


class Window:
    """Open for so many pictures; presses a key before the second."""

    def __init__(self, pictures, key):
        self._left, self._key = pictures, key
        self.shown, self.texts, self.closed = [], [], False

    def launch_passive(self, model, data, *, key_callback, show_left_ui, show_right_ui):
        assert not show_left_ui
        assert not show_right_ui
        self._model, self._data, self._press = model, data, key_callback
        return self

    def close(self):
        self.closed = True

    def is_running(self):
        self._left -= 1
        return self._left >= 0

    def lock(self):
        return contextlib.nullcontext()

    def set_texts(self, texts):
        self.texts.append(texts)

    def sync(self):
        self.shown.append((self._data.qpos.copy(), self._data.mocap_pos.copy()))
        if len(self.shown) == 1:
            self._press(self._key)


@pytest.mark.parametrize(("key", "sign"), [(265, 1), (264, 0), (73, 0)])
def test_the_window_shows_the_robot_drive_and_hears_the_arrow_keys(player, monkeypatch, key, sign):
    player.reset()
    player.drive(0.0, 0.0)
    window = Window(pictures=20, key=key)
    monkeypatch.setattr(mujoco_window, "require_window", lambda *_: window)
    mujoco_window.run(player)
    assert window.closed
    assert len(window.shown) == 20
    qpos, mocap = window.shown[-1]
    np.testing.assert_allclose(qpos, player.snapshot.qpos)
    np.testing.assert_allclose(mocap[0], player.snapshot.goal_w)
    assert player.command[0] == pytest.approx(sign / 8)
    assert (qpos[0] > 1e-3) == (sign > 0)
    assert "keyboard" in window.texts[-1][3]
    assert player.frames.per_second(time.monotonic()) > 10


def test_without_a_display_one_line_names_the_other_viewer(monkeypatch):
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setitem(sys.modules, "glfw", types.SimpleNamespace(init=lambda: False))
    monkeypatch.setitem(sys.modules, "mujoco.viewer", types.ModuleType("mujoco.viewer"))
    monkeypatch.setattr(mujoco, "viewer", sys.modules["mujoco.viewer"], raising=False)
    with pytest.raises(UserError, match="no display: use --viewer browser") as caught:
        mujoco_window.require_window()
    assert "\n" not in str(caught.value)


def test_a_window_that_cannot_open_is_reported_in_one_line(player, monkeypatch):
    def launch_passive(*_, **__):
        raise RuntimeError("requires mjpython")

    viewer = types.SimpleNamespace(launch_passive=launch_passive)
    monkeypatch.setattr(mujoco_window, "require_window", lambda *_: viewer)
    with pytest.raises(UserError, match=r"\(requires mjpython\): use --viewer browser"):
        mujoco_window.run(player)
