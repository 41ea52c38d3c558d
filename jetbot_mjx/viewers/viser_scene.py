"""Build the 3-D scene of a player's page in viser: robot, floor and a goal that can be moved."""

import time
from collections.abc import Callable
from typing import Any, Literal, get_args

import mujoco
import numpy as np
import trimesh
import viser
from trimesh.exchange import gltf
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from jetbot_mjx.envs.robot_model import QPOS_XYZ
from jetbot_mjx.viewers.meshes import visible_geoms
from jetbot_mjx.viewers.player import Player
from jetbot_mjx.viewers.pose import set_pose

FPS = 30
"""Frames per second that the page receives."""

Camera = Literal["free", "looks at the robot", "behind the robot"]
CAMERAS: tuple[Camera, ...] = get_args(Camera)

_FLOOR_PER_REACH = 2.5  # half the side of the floor, relative to the largest goal distance
_CELL, _SECTION = 0.25, 0.5  # [m] spacing of the thin and thick lines on the floor
_LINES = (
    ("thin", _CELL, 0.003, (165, 170, 176)),
    ("thick", _SECTION, 0.006, (125, 131, 139)),
)  # name, spacing [m], width [m], colour
_EYE_PER_REACH = (-0.43, -0.88, 1.0)  # initial camera position, relative to the same distance
_LOOK_AT_PER_REACH = (
    0.12,
    -0.08,
    0.0,
)  # initial target: beside the origin, which the panel would hide
_BEHIND_B = (-0.65, 0.45)  # [m] position of the following camera behind and above the robot
_AHEAD_B = 0.3  # [m] its target in front of the robot
_LAG_SECONDS = 0.35  # time constant of its yaw


class Scene:
    """A `Scene` shows the player and handles clicks and drags."""

    def __init__(self, server: viser.ViserServer, player: Player, ask: Callable[..., None]) -> None:
        """Build the scene.

        Args:
          server: the viser server.
          player: the player.
          ask: a function that queues a call for the player's thread, since viser calls back from
            its own threads.
        """
        self.camera: Camera = "free"
        """Behaviour of the camera, one of `CAMERAS`."""
        self._server, self._player, self._ask = server, player, ask
        self._model = player.env.mj_model
        self._data = mujoco.MjData(self._model)
        self._grabbed_w = np.zeros(3)
        self._camera_yaw = 0.0
        task = player.env.config.task
        reach = task.goal_distance_min + task.goal_distance_span
        self._edge = _FLOOR_PER_REACH * reach
        server.initial_camera.position = reach * np.array(_EYE_PER_REACH)
        server.initial_camera.look_at = reach * np.array(_LOOK_AT_PER_REACH)
        server.initial_camera.fov = np.deg2rad(55)
        self._add_floor()
        self._add_lights()
        self._frames = self._add_bodies()
        server.scene.on_click()(self._on_click)
        self.show()

    def show(self) -> None:
        """Send the present poses to all clients."""
        snapshot = self._player.snapshot
        set_pose(self._model, self._data, np.asarray(snapshot.qpos), snapshot.markers)
        mujoco.mj_kinematics(self._model, self._data)
        with self._server.atomic():
            for body, frame in self._frames.items():
                frame.position = self._data.xpos[body]
                frame.wxyz = self._data.xquat[body]
        if self.camera != "free":
            self._aim()
        self._player.frames.count(time.monotonic())

    def point(self, origin: Any, direction: Any, grabbed: Any = (0.0, 0.0, 0.0)) -> None:
        """Move the goal to where a ray meets a horizontal plane, if that is on the floor.

        Args:
          origin: the origin of the ray [m], world frame.
          direction: the direction of the ray, of any length.
          grabbed: the point by which the goal is dragged [m]: x and y relative to the goal, and
            the height above the floor, which is that of the plane.
        """
        origin, direction, grabbed = map(np.asarray, (origin, direction, grabbed))
        if direction[2] >= 0:
            return
        goal_w = origin + (grabbed[2] - origin[2]) / direction[2] * direction - grabbed
        if np.abs(goal_w[:2]).max() <= self._edge:
            self._ask(self._player.move_goal, float(goal_w[0]), float(goal_w[1]))

    def cast_shadows(self, cast: bool) -> None:
        """Switch shadows on or off.

        Args:
          cast: whether to show shadows, on a solid floor instead of lines.
        """
        with self._server.atomic():
            self._sun.cast_shadow = cast
            self._plane.visible = cast
            self._lines.visible = not cast

    def _add_floor(self) -> None:
        scene = self._server.scene
        # Without a GPU in the browser, a plane that fills the page takes half of the render time.
        # Therefore the floor is lines on the white page, and the plane is shown only with shadows.
        self._plane = scene.add_grid(
            "/floor",
            width=2 * self._edge,
            height=2 * self._edge,
            cell_size=_CELL,
            section_size=_SECTION,
            cell_color=(190, 195, 201),
            section_color=(140, 147, 155),
            plane_color=(214, 218, 223),
            plane_opacity=1.0,
            shadow_opacity=0.35,
            visible=False,
        )
        self._lines = scene.add_glb(
            "/lines", _lines(self._edge), cast_shadow=False, receive_shadow=False
        )

    def _add_lights(self) -> None:
        scene = self._server.scene
        # viser's default lights cast shadows and reflect; without a GPU, that gives two frames per
        # second.
        scene.configure_environment_map(None)
        scene.configure_default_lights(enabled=False)
        scene.add_light_hemisphere("/sky", ground_color=(170, 170, 170), intensity=2.0)
        self._sun = scene.add_light_directional("/sun", position=(-1.0, -2.0, 4.0), intensity=2.0)

    def _add_bodies(self) -> dict[int, viser.FrameHandle]:
        scene, frames = self._server.scene, {}
        for geom in visible_geoms(self._model):
            name = self._model.body(geom.body).name or f"body {geom.body}"
            if geom.body not in frames:
                frames[geom.body] = scene.add_frame(f"/{name}", show_axes=False)
            node = scene.add_mesh_simple(
                f"/{name}/{geom.name}",
                geom.mesh.vertices,
                geom.mesh.faces,
                color=geom.rgba[:3],
                opacity=None if geom.rgba[3] == 1 else geom.rgba[3],
                flat_shading=not geom.smooth,
                position=geom.position_b,
                wxyz=geom.quat_b,
            )
            if name == "goal" and not self._player.cannot_move_goal:
                node.on_drag("left")(self._on_drag)
        return frames

    def _on_click(self, event: viser.SceneClickEvent) -> None:
        self.point(event.ray_origin, event.ray_direction)

    async def _on_drag(self, event: viser.SceneNodeDragEvent[Any]) -> None:
        if event.phase == "start":
            self._grabbed_w = np.subtract(event.start_position, self._player.snapshot.goal_w)
            self._grabbed_w[2] = event.start_position[2]
        # viser reports the pointer in a plane that faces the camera; project it onto the floor.
        eye = event.client.camera.position
        self.point(eye, np.subtract(event.end_position, eye), self._grabbed_w)

    def _aim(self) -> None:
        """Turn the cameras of all clients to the robot."""
        robot_w = np.asarray(self._player.snapshot.qpos[QPOS_XYZ])
        x_w = self._data.body("jetbot").xmat.reshape(3, 3)[:, 0]
        turn = np.arctan2(x_w[1], x_w[0]) - self._camera_yaw
        turn = (turn + np.pi) % (2 * np.pi) - np.pi
        self._camera_yaw += turn / (FPS * _LAG_SECONDS)
        ahead = np.array([np.cos(self._camera_yaw), np.sin(self._camera_yaw), 0.0])
        for client in self._server.get_clients().values():
            if self.camera == "behind the robot":
                client.camera.position = robot_w + _BEHIND_B[0] * ahead + [0.0, 0.0, _BEHIND_B[1]]
                client.camera.look_at = robot_w + _AHEAD_B * ahead
            else:
                client.camera.look_at = robot_w


def _lines(edge: float) -> bytes:
    """Return the grid lines of a square floor around the origin as binary glTF.

    Args:
      edge: half the side of the square [m].
    """
    scene = trimesh.Scene()
    for name, spacing, width, color in _LINES:
        # Each line is a rectangle with corners (low, -end) and (high, end), along x and along y.
        count = int(edge / spacing)
        middle = spacing * np.arange(-count, count + 1)
        low, high, end = middle - width / 2, middle + width / 2, np.full_like(middle, edge)
        boxes = np.stack(
            [np.r_[low, -end], np.r_[-end, low], np.r_[high, end], np.r_[end, high]], axis=1
        )
        corners = boxes[:, [[0, 1], [2, 1], [2, 3], [0, 3]]].reshape(-1, 2)
        first = 4 * np.arange(len(boxes))[:, None, None]
        faces = (first + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
        mesh = trimesh.Trimesh(np.pad(corners, ((0, 0), (0, 1))), faces, process=False)
        material = PBRMaterial(name=name, baseColorFactor=(*color, 255))
        mesh.visual = TextureVisuals(material=material)
        scene.add_geometry(mesh, geom_name=name)
    return gltf.export_glb(scene, include_normals=False, tree_postprocessor=_unlit)


def _unlit(tree: dict[str, Any]) -> None:
    """Mark all materials as unlit: lighting the lines would cost more than the robot does."""
    tree["extensionsUsed"] = ["KHR_materials_unlit"]
    for material in tree["materials"]:
        material["extensions"] = {"KHR_materials_unlit": {}}
