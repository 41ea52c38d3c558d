"""Scenes for the camera's tests, and what MuJoCo itself sees in them."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jetbot_mjx.config import CameraConfig
from jetbot_mjx.envs.camera.render import Camera, Pose

ROBOT = "jetbot"

_XML = """
<mujoco>
  <compiler angle="radian"/>
  <statistic extent="1"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <visual>
    <headlight ambient="{ambient}" diffuse="{headlight}" specular="0 0 0"/>
    <map znear="0.01" zfar="1000"/>
    <quality shadowsize="0" offsamples="4"/>
    <global offwidth="1024" offheight="1024"/>
  </visual>
  <asset>{assets}</asset>
  <worldbody>
    {world}
    <body name="jetbot" mocap="true">
      <geom name="eye" type="sphere" size="0.001" group="3"/>
      <camera name="eye" fovy="{fovy}"/>
    </body>
    {bodies}
  </worldbody>
</mujoco>
"""


def make_model(
    geoms, world="", assets="", *, fovy=60.0, ambient="0.3 0.3 0.3", headlight="0.2 0.2 0.2"
):
    """Compile a scene whose geoms stand on mocap bodies `0`, `1`, ..., the eye on the robot."""
    bodies = "".join(
        f'<body name="{i}" mocap="true"><geom name="{i}" {geom}/></body>'
        for i, geom in enumerate(geoms)
    )
    xml = _XML.format(
        assets=assets, world=world, bodies=bodies, fovy=fovy, ambient=ambient, headlight=headlight
    )
    return mujoco.MjModel.from_xml_string(xml)


class Scenes:
    """One model and one camera; our functions are compiled for a batch of scenes."""

    def __init__(self, model, **camera):
        self.model, self.data = model, mujoco.MjData(model)
        self.config = CameraConfig(**{"position": (0.0, 0.0, 0.0), "pitch": 0.0} | camera)
        self.camera = Camera(self.config, model, ROBOT)
        self.names = [
            model.body(body).name
            for body in range(model.nbody)
            if model.body_mocapid[body] >= 0 and model.body(body).name != ROBOT
        ]
        self._trace = jax.jit(jax.vmap(self.camera.trace))
        self._render = jax.jit(jax.vmap(self.camera.render))

    def arguments(self, positions, rotations, places):
        """A batch of poses and of places, (n, 3), (n, 3, 3) and (n, names, 3), as we take them."""
        pose = Pose(jnp.asarray(positions), jnp.asarray(rotations))
        return pose, {name: jnp.asarray(places[:, i]) for i, name in enumerate(self.names)}

    def trace(self, *scenes):
        return jax.tree.map(np.asarray, self._trace(*self.arguments(*scenes)))

    def render(self, *scenes):
        return np.asarray(self._render(*self.arguments(*scenes)))

    def place(self, position, rotation, places):
        """Move MuJoCo's eye and bodies."""
        model, data = self.model, self.data
        eye = model.body(ROBOT).mocapid[0]
        data.mocap_pos[eye] = position
        right, down, forward = np.asarray(rotation, float).T
        axes = np.stack([right, -down, -forward], axis=1)
        mujoco.mju_mat2Quat(data.mocap_quat[eye], axes.flatten())
        for name, place in zip(self.names, places, strict=True):
            data.mocap_pos[model.body(name).mocapid[0]] = place
        mujoco.mj_forward(model, data)

    def clearance(self):
        """The distance from the eye to the nearest surface [m], negative inside; after `place`."""
        eye = self.model.geom("eye").id
        others = [geom for geom in range(self.model.ngeom) if geom != eye]
        distances = [
            mujoco.mj_geomDistance(self.model, self.data, eye, geom, 1.0, None) for geom in others
        ]
        return min(distances, default=1.0)

    def mj_trace(self, position, rotation, x, y):
        """Depths and ids that `mj_ray` finds along directions (x, y, 1); after `place`."""
        eye = self.model.body(ROBOT).id
        groups = np.array([1, 1, 1, 0, 0, 0], np.uint8)
        found = np.zeros(1, np.int32)
        rotation, position = np.asarray(rotation, float), np.asarray(position, float)
        rays = np.stack([*np.broadcast_arrays(x, y), np.ones(np.broadcast(x, y).shape)], -1)
        depths, ids = np.full(rays.shape[:2], np.inf), np.full(rays.shape[:2], -1)
        for index in np.ndindex(rays.shape[:2]):
            ray = rotation @ rays[index]
            depth = mujoco.mj_ray(self.model, self.data, position, ray, groups, 1, eye, found)
            if found[0] >= 0:
                depths[index], ids[index] = depth, found[0]
        return depths, ids


def turned(yaw, pitch, roll=0.0):
    """Axes (right, down, forward) of a camera, as columns; exact at multiples of 90 degrees."""

    def about(angle, axis):
        cosine, sine = np.cos(angle), np.sin(angle)
        cosine, sine = (0.0 if abs(x) < 1e-9 else x for x in (cosine, sine))
        matrix = np.eye(3)
        first, second = (k for k in range(3) if k != axis)
        sign = -1.0 if axis == 1 else 1.0
        matrix[first, first] = matrix[second, second] = cosine
        matrix[first, second], matrix[second, first] = -sign * sine, sign * sine
        return matrix

    ahead = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], float)
    return (about(yaw, 2) @ about(pitch, 1) @ about(roll, 0) @ ahead).astype(np.float32)
