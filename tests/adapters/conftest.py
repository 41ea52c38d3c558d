"""A window and OpenGL for the environments that draw."""

import contextlib

import pytest

from jetbot_mjx.envs.opengl import find_backend
from jetbot_mjx.errors import UserError
from jetbot_mjx.viewers import mujoco_window


class Window:
    """A substitute for MuJoCo's window: no test machine has a display."""

    def __init__(self):
        self.shown = []

    def launch_passive(self, model, data, **_):
        self._data = data
        return self

    def is_running(self):
        return True

    def lock(self):
        return contextlib.nullcontext()

    def sync(self):
        self.shown.append((self._data.qpos.copy(), self._data.mocap_pos.copy()))

    def close(self):
        self.shown.append("closed")


@pytest.fixture
def window(monkeypatch):
    from jetbot_mjx.adapters import renderer

    opened = Window()
    for module in (renderer, mujoco_window):
        monkeypatch.setattr(module, "require_window", lambda *_: opened)
    return opened


@pytest.fixture
def needs_opengl():
    try:
        find_backend()
    except UserError as error:
        pytest.skip(str(error))
