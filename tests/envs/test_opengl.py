"""The choice of an OpenGL back end, and the error where there is none."""

import subprocess
import sys
import weakref
from unittest import mock

import mujoco
import pytest

from jetbot_mjx.envs import opengl
from jetbot_mjx.errors import UserError


@pytest.fixture
def probes(monkeypatch):
    """The back ends that were tried; `works` names those that draw."""

    class Probes(list):
        works = ()

        def run(self, command, env, **_):
            self.append(env["MUJOCO_GL"])
            return subprocess.CompletedProcess(command, env["MUJOCO_GL"] not in self.works)

    found = Probes()
    monkeypatch.setattr(opengl.subprocess, "run", found.run)
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "MUJOCO_GL"):
        monkeypatch.delenv(name, raising=False)
    return found


def test_the_first_back_end_that_works_is_used(probes):
    probes.works = ("osmesa",)
    assert opengl.find_backend.__wrapped__() == "osmesa"
    assert probes == ["egl", "osmesa"]


def test_only_the_back_end_that_the_user_names_is_tried(probes, monkeypatch):
    probes.works = ("egl",)
    monkeypatch.setenv("MUJOCO_GL", "osmesa")
    with pytest.raises(UserError, match=r"^MUJOCO_GL = 'osmesa' does not work here: unset it"):
        opengl.find_backend.__wrapped__()
    assert probes == ["osmesa"]


def test_a_window_is_tried_only_where_there_is_a_display(probes, monkeypatch):
    with pytest.raises(UserError, match=r"^no OpenGL to render with"):
        opengl.find_backend.__wrapped__()
    assert "glfw" not in probes
    monkeypatch.setenv("DISPLAY", ":0")
    probes.works = ("glfw",)
    assert opengl.find_backend.__wrapped__() == "glfw"


def test_an_unknown_back_end_is_refused_and_nothing_is_tried(probes, monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "vulkan")
    with pytest.raises(UserError, match=r"^MUJOCO_GL = 'vulkan': there is no such back end"):
        opengl.find_backend.__wrapped__()
    assert probes == []


@pytest.mark.parametrize(("system", "said"), [("linux", "libegl1"), ("darwin", "GLFW")])
def test_without_opengl_the_remedy_is_one_of_this_system(monkeypatch, system, said):
    monkeypatch.setattr(sys, "platform", system)
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    failed = subprocess.CompletedProcess([], 1)
    monkeypatch.setattr(opengl.subprocess, "run", lambda *args, **kwargs: failed)
    with pytest.raises(UserError, match=said) as caught:
        opengl.find_backend.__wrapped__()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("device", "without_gpu"),
    [("llvmpipe (LLVM 15.0.6, 256 bits)", True), ("NVIDIA H100 80GB HBM3/PCIe/SSE2", False)],
)
def test_a_renderer_tells_whether_the_processor_draws(monkeypatch, device, without_gpu):
    for name in ("MjrContext", "MjvScene", "mjr_setBuffer"):
        monkeypatch.setattr(opengl.mujoco, name, mock.Mock())
    monkeypatch.setattr(opengl, "_import_back_end", mock.Mock())
    monkeypatch.setattr(opengl, "_open", weakref.WeakSet())
    # PyOpenGL loads a library when it is imported, and there may be none.
    fake = mock.Mock(**{"glGetString.return_value": device.encode()})
    monkeypatch.setitem(sys.modules, "OpenGL", mock.Mock(GL=fake))
    assert not opengl.some_without_gpu()
    renderer = opengl.SceneRenderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 1)
    assert opengl.some_without_gpu() is without_gpu
    renderer.end()
    assert not opengl.some_without_gpu()
