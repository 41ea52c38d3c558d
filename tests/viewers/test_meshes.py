"""Meshes of MuJoCo's geoms."""

import mujoco
import numpy as np
import pytest

from jetbot_mjx.viewers.meshes import visible_geoms

SHAPES = """
<mujoco>
  <asset>
    <mesh name="wedge" vertex="0 0 0  1 0 0  0 2 0  0 0 3"/>
    <material name="blue" rgba="0 0 1 1"/>
  </asset>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1"/>
    <geom name="unseen" type="box" size="1 1 1" group="3"/>
    <geom name="clear" type="box" size="1 1 1" rgba="1 1 1 0"/>
    <geom name="box" type="box" size="0.1 0.2 0.3" material="blue"/>
    <geom name="own" type="box" size="0.1 0.2 0.3" material="blue" rgba="0 1 0 1"/>
    <geom name="ball" type="sphere" size="0.2" rgba="1 0 0 0.5"/>
    <body name="arm" pos="1 0 0">
      <geom name="can" type="cylinder" size="0.1 0.3" pos="0 0 2" euler="0 90 0"/>
      <geom name="pill" type="capsule" size="0.1 0.3"/>
      <geom type="ellipsoid" size="0.1 0.2 0.3"/>
      <geom name="wedge" type="mesh" mesh="wedge" pos="0 1 0"/>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(SHAPES)


@pytest.fixture(scope="module")
def geoms(model):
    return {geom.name: geom for geom in visible_geoms(model)}


def test_every_visual_geom_is_drawn_and_no_other(model, geoms):
    nameless = str(model.geom("pill").id + 1)
    assert set(geoms) == {"box", "own", "ball", "can", "pill", nameless, "wedge"}
    assert geoms["can"].body == model.body("arm").id
    assert [name for name, geom in geoms.items() if geom.smooth] == ["ball", nameless]


@pytest.mark.parametrize(
    ("name", "half", "centre"),
    [
        ("box", (0.1, 0.2, 0.3), (0, 0, 0)),
        ("ball", (0.2, 0.2, 0.2), (0, 0, 0)),
        ("can", (0.3, 0.1, 0.1), (0, 0, 2)),
        ("pill", (0.1, 0.1, 0.4), (0, 0, 0)),
        ("8", (0.1, 0.2, 0.3), (0, 0, 0)),
    ],
)
def test_a_shape_has_its_size_about_its_centre(geoms, name, half, centre):
    low, high = geoms[name].mesh.bounds
    np.testing.assert_allclose(high - centre, half, rtol=0.01)
    np.testing.assert_allclose(low + high, 2 * np.array(centre), atol=1e-9)
    assert geoms[name].mesh.is_watertight


def test_a_mesh_lies_where_mujoco_puts_it(model, geoms):
    # MuJoCo moves a mesh into its own inertial frame, and the geom's pose back.
    wedge = geoms["wedge"]
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    rotation, place = data.xmat[wedge.body].reshape(3, 3), data.xpos[wedge.body]
    corners = wedge.mesh.vertices @ rotation.T + place
    # Body at x = 1, geom at y = 1.
    expected = [[1, 1, 0], [2, 1, 0], [1, 3, 0], [1, 1, 3]]
    for corner in expected:
        assert np.linalg.norm(corners - corner, axis=1).min() < 1e-6
    assert len(wedge.mesh.faces) == 4


def test_colours_are_those_that_mujoco_draws(geoms):
    assert geoms["box"].rgba == (0, 0, 1, 1)
    assert geoms["own"].rgba == (0, 1, 0, 1)
    assert geoms["ball"].rgba == (1, 0, 0, 0.5)
    assert geoms["can"].rgba == (0.5, 0.5, 0.5, 1)


def test_the_robot_shows_and_its_colliders_do_not(world_env):
    names = {geom.name for geom in visible_geoms(world_env.mj_model)}
    assert {"tray", "left_tyre", "right_rim", "camera_lens", "goal"} < names
    assert not {"floor", "left_wheel", "caster_front"} & names
