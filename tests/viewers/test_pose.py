"""A pose that is written into MuJoCo's data."""

import mujoco
import numpy as np

from jetbot_mjx.viewers.pose import set_pose

SCENE = """
<mujoco><worldbody>
  <body name="robot"><freejoint/><geom size="0.1"/></body>
  <body name="other" mocap="true"><geom size="0.1"/></body>
  <body name="goal" mocap="true"><geom size="0.1"/></body>
</worldbody></mujoco>
"""


def test_the_robot_and_the_markers_are_where_they_are_put():
    model = mujoco.MjModel.from_xml_string(SCENE)
    data = mujoco.MjData(model)
    set_pose(model, data, np.array([1.0, 2.0, 3.0, 1.0, 0.0, 0.0, 0.0]), {"goal": [4.0, 5.0, 6.0]})
    np.testing.assert_array_equal(data.body("robot").xpos, [1, 2, 3])
    np.testing.assert_array_equal(data.body("goal").xpos, [4, 5, 6])
    np.testing.assert_array_equal(data.body("other").xpos, [0, 0, 0])
