"""Lazy imports, and what a command does not import."""

import subprocess
import sys
import types
from importlib.util import find_spec

import pytest

from jetbot_mjx.__main__ import COMMANDS
from jetbot_mjx.startup.lazy_imports import LazyModule, standing_in


def test_a_substitute_module_is_imported_inside_the_context_only():
    stand_in = types.ModuleType("not_there")
    with standing_in("not_there", stand_in):
        import colorsys  # any module that nobody has loaded yet

        import not_there
    assert not_there is stand_in
    assert "not_there" not in sys.modules
    assert sys.modules["colorsys"] is colorsys


def test_a_module_can_be_absent():
    with standing_in("wave", None), pytest.raises(ImportError):
        import wave  # noqa: F401


def test_a_module_that_is_loaded_stays():
    with standing_in("types", None):
        import types as found
    assert found is types


def test_an_error_inside_leaves_nothing_behind():
    with pytest.raises(ZeroDivisionError), standing_in("not_there", None):
        _ = 1 / 0
    assert "not_there" not in sys.modules


def test_a_module_that_was_put_off_is_there_when_it_is_needed(monkeypatch):
    monkeypatch.delitem(sys.modules, "fractions", raising=False)
    with standing_in("fractions", LazyModule("fractions")):
        import fractions
    assert "fractions" not in sys.modules
    assert fractions.Fraction(1, 2) == 0.5
    assert sys.modules["fractions"].Fraction is fractions.Fraction


def test_a_module_that_was_put_off_may_be_needed_while_it_is(monkeypatch):
    monkeypatch.delitem(sys.modules, "fractions", raising=False)
    with standing_in("fractions", LazyModule("fractions")):
        from fractions import Fraction
    assert sys.modules["fractions"].Fraction is Fraction


LIGHT = """
import sys
from jetbot_mjx.startup import install_lazy_imports
install_lazy_imports()
{then}
import jetbot_mjx.training.session
from jetbot_mjx.config import Config
from jetbot_mjx.runs import Setup
from jetbot_mjx.training.ppo_trainer import build_ppo
ppo = build_ppo(Setup(Config()))
heavy = ["PIL.Image", "flax.linen", "glfw", "jax.extend.pallas", "jaxopt",
    "orbax", "scipy.optimize", "scipy.spatial",
    "tensorboardX.comet_utils", "torch", "trimesh"]
print(*[name for name in heavy if name in sys.modules])
print(type(ppo.networks.policy_network).__name__)
import flax, jax.extend
print(flax.linen.Dense(3).features, jax.extend.pallas.__name__)
from brax.generalized import constraint
print(constraint.jaxopt.ProjectedGradient.__name__)
import inspect
import mujoco.mjx
from mujoco.mjx._src import mesh
print(mesh.spatial.ConvexHull.__name__, "import" in inspect.getsource(mujoco.mjx))
"""


@pytest.mark.parametrize("then", ["", "import brax.envs, mujoco.mjx"])
def test_a_training_loads_nothing_heavy_and_all_of_it_is_there_when_asked_for(then):
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", LIGHT.format(then=then)],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    # MJX prints where its optional Warp is missing, if a program imports MJX itself.
    lines = [one for one in done.stdout.splitlines() if not one.startswith("Failed to import ")]
    assert lines == [
        "",
        "FeedForwardNetwork",
        "3 jax.extend.pallas",
        "ProjectedGradient",
        "ConvexHull True",
    ]


@pytest.mark.skipif(find_spec("glfw") is None, reason="MuJoCo was installed without GLFW")
def test_glfw_is_there_when_asked_for():
    code = (
        "from jetbot_mjx.startup import install_lazy_imports; install_lazy_imports();"
        " import sys, mujoco.glfw as m; print('glfw' in sys.modules, m.glfw.init)"
    )
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code], capture_output=True, text=True
    )
    assert done.stdout.startswith("False <function init "), done.stderr[-2000:]


MISTYPED = {
    "train": ["smoke", "--sed", "1"],
    "evaluate": ["runs/mine", "--episodes", "1e3"],
    "render": ["runs/mine", "--goals", "99999"],
    "play": ["runs/mine", "--port", "99999"],
    "configs": ["--all"],
    "runs": ["--all"],
    "new-task": [],
    "check-env": [],
    "new-env": [],
    "new-robot": [],
    "check-robot": [],
    "plan": [],
    "tune": ["smoke"],
    "export": ["runs/mine", "--format", "torch"],
    "share": ["runs/mine"],
    "sim2real": ["log", "--delay", "x"],
    "replay": [],
    "pretrained": ["--all"],
}

REPORTED = """
import importlib, sys
from jetbot_mjx import __main__ as entry
for name, arguments in {mistyped}.items():
    module = importlib.import_module(f"jetbot_mjx.{{entry.COMMANDS[name][0]}}")
    try:
        module.main(arguments)
    except SystemExit as error:
        heavy = [one for one in {heavy} if one in sys.modules]
        print(name, error.code, *heavy, flush=True)
try:
    entry.main(["trian", "smoke"])
except SystemExit as error:
    print("-", error.code, *[one for one in {heavy} if one in sys.modules])
"""


def test_a_usage_error_is_reported_before_anything_heavy_is_imported():
    heavy = ["jax", "brax", "mujoco", "numpy", "matplotlib", "scipy", "orbax", "optuna", "PIL"]
    code = REPORTED.format(mistyped=MISTYPED, heavy=heavy)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.splitlines() == [f"{name} 2" for name in (*MISTYPED, "-")], done.stderr
    assert len(done.stderr.splitlines()) == len(MISTYPED) + 1
    assert set(MISTYPED) == set(COMMANDS)


MISNAMED = {
    "train": ["smok"],
    "evaluate": ["mine"],
    "render": ["mine"],
    "play": ["mine"],
    "check-env": ["--config", "smok"],
    "plan": ["smoke", "--set", "lr=1"],
    "tune": ["smoke", "--space", "ppo", "--set", "ppo.lerning_rate=1"],
    "export": ["mine"],
}

LISTED = """
import importlib, sys
from jetbot_mjx import __main__ as entry
from jetbot_mjx.errors import UserError
for name, arguments in {misnamed}.items():
    module = importlib.import_module(f"jetbot_mjx.{{entry.COMMANDS[name][0]}}")
    try:
        module.main(arguments)
    except UserError:
        print(name, *[one for one in {heavy} if one in sys.modules], flush=True)
from jetbot_mjx import list_runs
list_runs.main([])
print("runs", *[one for one in {heavy} if one in sys.modules])
"""


def test_a_wrong_name_is_reported_and_runs_are_listed_without_jax(tmp_path):
    heavy = ["jax", "brax", "mujoco", "matplotlib", "scipy", "orbax", "optuna", "PIL"]
    code = LISTED.format(misnamed=MISNAMED, heavy=heavy)
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path)
    lines = done.stdout.splitlines()
    assert lines[: len(MISNAMED)] == list(MISNAMED), done.stderr
    assert lines[-1] == "runs", done.stderr
