"""Build the 3-D scene of a player's page in viser: robots, floor and goals that can be moved.

Robots that do not see one another stand in cells of a common floor. Each visible part of the robot
is one mesh, which viser draws at the poses of all robots.
"""

import itertools
import math
import time
from collections.abc import Callable

import mujoco
import numpy as np
import trimesh
import viser
from jaxtyping import Float, UInt8
from trimesh.exchange import gltf
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from jetbot_mjx.envs import QPOS_QUAT, QPOS_XYZ
from jetbot_mjx.runs import JsonObject
from jetbot_mjx.viewers.meshes import Geom, visible_geoms
from jetbot_mjx.viewers.offscreen import METRE_LABELS
from jetbot_mjx.viewers.player import Player
from jetbot_mjx.viewers.pose import set_pose
from jetbot_mjx.viewers.viser_camera import Cameras

FPS = 30
"""Frames per second that the page receives."""

_FLOOR_PER_REACH = 2.5  # from the outermost cells to the floor's edge, per largest goal distance
_CELL_PER_REACH = 1.0  # distance between neighbouring robots' cells
_CELL, _SECTION = 0.25, 1.0  # [m] spacing of the thin and thick lines on the floor
_LINES = (
    ("thin", _CELL, 0.003, (165, 170, 176)),
    ("thick", _SECTION, 0.006, (125, 131, 139)),
)  # name, spacing [m], width [m], colour
_FEW_ROBOTS = 9  # robots up to which round parts are drawn finely, and lines thinly
_SECTIONS, _COARSE_SECTIONS = 48, 12  # faces around a round part
_COARSE_LINES = 2  # factor on spacing and width of lines

_LABEL_RGB, _LABEL_WIDTH = (110, 118, 128), 0.006  # of the metres on the floor; width in [m]

_TRAIL_POINTS = 40  # of one robot
_TRAIL_PER_REACH = 2.0  # length of a trail, relative to the largest goal distance
_TRAIL_FRAMES = 3  # frames per update of the trails
_TOUCH_FLOOR_HEIGHT = -0.002  # [m] below lines and trails
_TRAIL_HEIGHT = 0.004  # [m]
_TRAIL_WIDTH = 0.012  # [m]
_TRAIL_RGB, _CHOSEN_RGB = (25, 90, 215), (235, 120, 0)
_REACHED_RGB = (40, 170, 60)

_AROUND = 0.15  # [m] around robot and goal that the camera shows
_TOP = 0.12  # [m] height of what it shows


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
        self._server, self._player, self._ask = server, player, ask
        self._model = player.env.mj_model
        self._data = mujoco.MjData(self._model)
        self._grabbed_w = np.zeros(3)
        self._dragging = False
        task = player.env.config.task
        self._reach = task.goal_distance_min + task.goal_distance_span
        self._cells_w = _cells(player.robots, _CELL_PER_REACH * self._reach)
        self._area = float(np.abs(self._cells_w).max()) + self._reach
        self._edge = self._area + (_FLOOR_PER_REACH - 1) * self._reach
        self._few = player.robots <= _FEW_ROBOTS
        self._lines_scale = 1 if self._few else _COARSE_LINES
        self.cameras = Cameras(server, "robot and goal" if player.robots == 1 else "overview")
        """The cameras of all clients."""
        self._add_surroundings()
        self._parts = self._add_bodies()
        server.scene.on_click()(self._on_click)
        self._add_touch_floor()
        robots_w = self._robots_w()
        self._path_w = np.repeat(robots_w[:, None], _TRAIL_POINTS, axis=1)
        self._low_w, self._high_w = robots_w.copy(), robots_w.copy()
        self._steps = np.full(player.robots, np.inf)
        self._frame = 0
        self._trails = server.scene.add_line_segments(
            "/trails",
            self._segments(),
            self._trail_colors(),
            thickness=_TRAIL_WIDTH * self._lines_scale,
        )
        self.show()

    def show(self) -> None:
        """Send the present poses to all clients."""
        crowd = self._player.crowd
        positions, quats = self._poses()
        self._extend_paths()
        reached = (crowd.done * crowd.success > 0)[:, None]
        with self._server.atomic():
            for body, rgb, node in self._parts:
                node.batched_positions, node.batched_wxyzs = positions[:, body], quats[:, body]
                if self._model.body(body).name == "goal":
                    node.batched_colors = np.where(reached, _page_rgb(_REACHED_RGB), rgb)
            if self._frame % _TRAIL_FRAMES == 0:
                self._trails.points = self._segments()
                self._trails.colors = self._trail_colors()
        self._frame += 1
        self._aim()
        self._player.frames.count(time.monotonic())

    def _poses(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the positions [m] and quaternions of all bodies of all robots, in their cells."""
        crowd, bodies = self._player.crowd, (self._player.robots, self._model.nbody)
        positions, quats = np.empty((*bodies, 3), np.float32), np.empty((*bodies, 4), np.float32)
        for robot, cell_w in enumerate(self._cells_w):
            markers = {name: places[robot] for name, places in crowd.markers.items()}
            set_pose(self._model, self._data, np.asarray(crowd.qpos[robot]), markers)
            positions[robot] = self._data.xpos + cell_w
            quats[robot] = self._data.xquat
        return positions, quats

    def _robots_w(self) -> Float[np.ndarray, "robots 3"]:
        """Return the positions of the robots in their cells [m]."""
        return np.asarray(self._player.crowd.qpos)[:, QPOS_XYZ] + self._cells_w

    def _extend_paths(self) -> None:
        """Add the robots' positions to their trails, and to the boxes around their paths."""
        robots_w, steps = self._robots_w(), np.asarray(self._player.crowd.steps)
        began = steps < self._steps
        self._steps = steps
        self._path_w[began] = robots_w[began, None]
        self._low_w[began], self._high_w[began] = robots_w[began], robots_w[began]
        self._low_w = np.minimum(self._low_w, robots_w)
        self._high_w = np.maximum(self._high_w, robots_w)
        # The last point moves with the robot; the others are an equal distance apart.
        self._path_w[:, -1] = robots_w
        moved = np.linalg.norm(robots_w - self._path_w[:, -2], axis=-1)
        far = moved > _TRAIL_PER_REACH * self._reach / _TRAIL_POINTS
        self._path_w[far, :-1] = self._path_w[far, 1:]

    def _segments(self) -> Float[np.ndarray, "segments 2 3"]:
        """Return the lines of all trails on the floor [m]."""
        floor_w = self._path_w * [1, 1, 0] + [0, 0, _TRAIL_HEIGHT]
        return np.stack([floor_w[:, :-1], floor_w[:, 1:]], axis=2).reshape(-1, 2, 3)

    def _trail_colors(self) -> np.ndarray:
        """Return the colours of all trails; that of the chosen one of many robots stands out."""
        colors = np.tile(_page_rgb(_TRAIL_RGB), (self._player.robots, _TRAIL_POINTS - 1, 2, 1))
        if self._player.robots > 1:
            colors[self._player.robot] = _page_rgb(_CHOSEN_RGB)
        return colors.reshape(-1, 2, 3)

    def _aim(self) -> None:
        """Move the cameras as their mode says, except while the user drags a goal."""
        player, robot = self._player, self._player.robot
        match self.cameras.mode:
            case "behind the robot":
                w, x, y, z = np.asarray(player.snapshot.qpos)[QPOS_QUAT]
                yaw = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
                self.cameras.chase(self._robots_w()[robot], yaw)
            case "robot and goal" if not self._dragging:
                goal_w = player.snapshot.goal_w + self._cells_w[robot]
                low_w = np.minimum(self._low_w[robot], goal_w) - _AROUND
                high_w = np.maximum(self._high_w[robot], goal_w) + _AROUND
                self.cameras.show(low_w * [1, 1, 0], high_w * [1, 1, 0] + [0, 0, _TOP])
            case "overview":
                self.cameras.show(
                    np.array([-self._area, -self._area, 0.0]), np.full(3, self._area) * [1, 1, 0]
                )
            case _:
                pass

    def point(
        self,
        origin: object,
        direction: object,
        grabbed: object = (0.0, 0.0, 0.0),
        robot: int | None = None,
    ) -> None:
        """Move a goal to where a ray meets a horizontal plane, if that is on the floor.

        Args:
          origin: the origin of the ray [m], world frame.
          direction: the direction of the ray, of any length.
          grabbed: the point by which the goal is dragged [m]: x and y relative to the goal, and
            the height above the floor, which is that of the plane.
          robot: the robot whose goal is moved, or None for the robot whose cell is nearest. The
            player chooses it.
        """
        origin, direction, grabbed = map(np.asarray, (origin, direction, grabbed))
        if direction[2] >= 0:
            return
        goal_w = origin + (grabbed[2] - origin[2]) / direction[2] * direction - grabbed
        if np.abs(goal_w[:2]).max() <= self._edge:
            if robot is None:
                robot = int(np.linalg.norm((self._cells_w - goal_w)[:, :2], axis=-1).argmin())
            x, y, _ = (goal_w - self._cells_w[robot]).tolist()
            self._ask(setattr, self._player, "robot", robot)
            self._ask(self._player.move_goal, x, y)

    def cast_shadows(self, cast: bool) -> None:
        """Switch shadows on or off.

        Args:
          cast: whether to show shadows, on a solid floor instead of lines.
        """
        with self._server.atomic():
            self._sun.cast_shadow = cast
            self._plane.visible = cast
            self._lines.visible = not cast

    def _add_surroundings(self) -> None:
        """Add the floor and the lights."""
        scene = self._server.scene
        # Without a GPU in the browser, a plane that fills the page takes half of the render time.
        # Therefore the floor is lines on the white page, and the plane is shown only with shadows.
        self._plane = scene.add_grid(
            "/floor",
            width=2 * self._edge,
            height=2 * self._edge,
            cell_size=_CELL * self._lines_scale,
            section_size=_SECTION * self._lines_scale,
            cell_color=(190, 195, 201),
            section_color=(140, 147, 155),
            plane_color=(214, 218, 223),
            plane_opacity=1.0,
            shadow_opacity=0.35,
            visible=False,
        )
        self._lines = scene.add_glb(
            "/lines", _lines(self._edge, self._lines_scale), cast_shadow=False, receive_shadow=False
        )
        if self._player.robots == 1:
            strokes = [np.stack([line[:-1], line[1:]], axis=1) for line in METRE_LABELS]
            labels_w = np.concatenate(strokes)
            scene.add_line_segments("/metres", labels_w, _LABEL_RGB, thickness=_LABEL_WIDTH)
        # viser's default lights cast shadows and reflect; without a GPU, that gives two frames per
        # second.
        scene.configure_environment_map(None)
        scene.configure_default_lights(enabled=False)
        scene.add_light_hemisphere("/sky", ground_color=(170, 170, 170), intensity=2.0)
        self._sun = scene.add_light_directional("/sun", position=(-1.0, -2.0, 4.0), intensity=2.0)

    def _add_bodies(self) -> list[tuple[int, UInt8[np.ndarray, "3"], viser.BatchedMeshHandle]]:
        """Add the meshes; return the body, the colour and the node of each.

        Parts of one body and one colour are one mesh.
        """

        def look(geom: Geom) -> tuple[int, bool, tuple[float, ...]]:
            return geom.body, geom.smooth, geom.rgba

        sections = _SECTIONS if self._few else _COARSE_SECTIONS
        geoms = sorted(visible_geoms(self._model, sections), key=look)
        positions, quats = self._poses()
        parts = []
        for number, ((body, smooth, rgba), same) in enumerate(itertools.groupby(geoms, look)):
            mesh = trimesh.util.concatenate([geom.mesh for geom in same])
            assert isinstance(mesh, trimesh.Trimesh)
            name = self._model.body(body).name or f"body {body}"
            rgb = _page_rgb(255 * np.array(rgba[:3]))
            node = self._server.scene.add_batched_meshes_simple(
                f"/{name}/{number}",
                mesh.vertices,
                mesh.faces,
                batched_positions=positions[:, body],
                batched_wxyzs=quats[:, body],
                batched_colors=np.tile(rgb, (self._player.robots, 1)),
                opacity=None if rgba[3] == 1 else rgba[3],
                flat_shading=not smooth,
                lod="off",
            )
            if name == "goal" and not self._player.cannot_move_goal:
                node.on_drag("left")(self._on_drag)
            parts.append((body, rgb, node))
        return parts

    def _add_touch_floor(self) -> None:
        """Add a floor that nobody sees, for fingers: viser tells their taps on objects only."""
        edge = self._edge
        corners = [(-edge, -edge, 0.0), (edge, -edge, 0.0), (edge, edge, 0.0), (-edge, edge, 0.0)]
        floor = self._server.scene.add_mesh_simple(
            "/touch floor",
            np.array(corners, np.float32),
            np.array([(0, 1, 2), (0, 2, 3)], np.uint32),
            # Of three lines, for a plane that fills the page would halve the frame rate.
            wireframe=True,
            opacity=0.0,
            cast_shadow=False,
            receive_shadow=False,
            position=(0.0, 0.0, _TOUCH_FLOOR_HEIGHT),
        )
        floor.on_click(self._on_click)

    def _on_click(
        self, event: viser.SceneClickEvent | viser.SceneNodePointerEvent[viser.MeshHandle]
    ) -> None:
        self.point(event.ray_origin, event.ray_direction)

    async def _on_drag(self, event: viser.SceneNodeDragEvent[viser.BatchedMeshHandle]) -> None:
        robot = event.instance_index or 0
        self._dragging = event.phase != "end"
        if event.phase == "start":
            goal_w = self._player.crowd.goal_w[robot] + self._cells_w[robot]
            self._grabbed_w = np.subtract(event.start_position, goal_w)
            self._grabbed_w[2] = event.start_position[2]
        # viser reports the pointer in a plane that faces the camera; project it onto the floor.
        eye = event.client.camera.position
        self.point(eye, np.subtract(event.end_position, eye), self._grabbed_w, robot)


def _page_rgb(rgb: object) -> UInt8[np.ndarray, "3"]:
    """Convert a colour in [0, 255] from sRGB to linear light, which pages expect in arrays."""
    share = np.asarray(rgb) / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return np.round(255 * linear).astype(np.uint8)


def _cells(robots: int, spacing: float) -> Float[np.ndarray, "robots 3"]:
    """Return the origins of the robots' worlds on the common floor, row by row around its middle.

    Args:
      robots: the number of robots.
      spacing: the distance between neighbours [m].
    """
    columns = math.ceil(math.sqrt(robots))
    rows = math.ceil(robots / columns)
    row, column = np.divmod(np.arange(robots), columns)
    middle = [(columns - 1) / 2, (rows - 1) / 2, 0.0]
    return spacing * (np.stack([column, rows - 1 - row, 0 * row], axis=-1) - middle)


def _lines(edge: float, scale: float) -> bytes:
    """Return the grid lines of a square floor around the origin as binary glTF.

    Args:
      edge: half the side of the square [m].
      scale: a factor on spacing and width of the lines.
    """
    scene = trimesh.Scene()
    for name, *lengths, color in _LINES:
        spacing, width = (scale * length for length in lengths)
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


def _unlit(tree: JsonObject) -> None:
    """Mark all materials as unlit: lighting the lines would cost more than the robot does."""
    tree["extensionsUsed"] = ["KHR_materials_unlit"]
    for material in tree["materials"]:
        material["extensions"] = {"KHR_materials_unlit": {}}
