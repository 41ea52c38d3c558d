"""MJX as it is imported here."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import jetbot_mjx

MESH = """
import sys
from jetbot_mjx.startup import install_lazy_imports
install_lazy_imports()
assert not [name for name in sys.modules if name.startswith("trimesh")]
import mujoco
from jetbot_mjx.envs import mjx
text = '''<mujoco><asset><mesh name="m" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/></asset>
  <worldbody><geom type="plane" size="1 1 1"/>
  <body><freejoint/><geom type="mesh" mesh="m"/></body></worldbody></mujoco>'''
mjx.put_model(mujoco.MjModel.from_xml_string(text))
assert "trimesh" in sys.modules
import trimesh
print(trimesh.creation.box().volume)
"""


@pytest.mark.slow
def test_trimesh_is_loaded_when_a_mesh_needs_it_and_prints_nothing():
    done = subprocess.run([sys.executable, "-c", MESH], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "1.0\n"), done.stderr[-2000:]


@pytest.mark.parametrize(
    "statement",
    [
        "from jetbot_mjx import JetBotEnv, load_config; import jetbot_mjx.agents.ppo",
        # A process each, and the next test finds whoever imports Brax or MJX before our own.
        pytest.param("import jetbot_mjx.agents.ppo", marks=pytest.mark.slow),
        pytest.param("import jetbot_mjx.agents.vision", marks=pytest.mark.slow),
        pytest.param("import jetbot_mjx.evaluation.rollout", marks=pytest.mark.slow),
        pytest.param("import jetbot_mjx.runs.warm_start", marks=pytest.mark.slow),
        pytest.param("import jetbot_mjx.training.brax_trainer", marks=pytest.mark.slow),
    ],
)
def test_importing_prints_nothing(statement):
    command = [sys.executable, "-W", "ignore", "-c", statement]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_a_module_that_imports_brax_or_mjx_first_imports_what_drops_their_lines():
    package = Path(jetbot_mjx.__file__).parent
    first = re.compile(
        r"^from jetbot_mjx(\.\w+)* import .*(mjx_import|brax_parts)|(mjx_import|brax_parts) import"
    )
    theirs = re.compile(r"^(from|import) (brax|mujoco\.mjx)\b|^from mujoco import mjx")
    for path in package.rglob("*.py"):
        lines = path.read_text("utf-8").splitlines()
        found = [line for line in lines if first.search(line) or theirs.search(line)]
        assert path.stem == "mjx_import" or not found or first.search(found[0]), path
