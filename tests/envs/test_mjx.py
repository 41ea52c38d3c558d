"""MJX as it is imported here."""

import subprocess
import sys

MESH = """
import sys
from jetbot_mjx.imports import install_lazy_imports
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


def test_trimesh_is_loaded_when_a_mesh_needs_it_and_prints_nothing():
    done = subprocess.run([sys.executable, "-c", MESH], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (0, "1.0\n"), done.stderr[-2000:]
