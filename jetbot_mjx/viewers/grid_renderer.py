"""Render a `RobotGrid`: one image of many robots with their goals and trails.

No model of all robots is compiled: a `GridRenderer` adds the geoms of one robot's model to MuJoCo's
scene once for each robot. Robots that are only a few pixels long are drawn by their largest geoms,
enlarged.
"""

import contextlib
import copy
import math
from collections.abc import Sequence

import mujoco
import numpy as np
from jaxtyping import Float

from jetbot_mjx.envs import QPOS_XYZ, JetBotEnv
from jetbot_mjx.viewers import offscreen
from jetbot_mjx.viewers.pose import set_pose
from jetbot_mjx.viewers.robot_grid import WIDEST_CELL, RobotGrid
from jetbot_mjx.viewers.video import Frame

_DETAILED = 18.0  # [pixels] length from which a robot is drawn with all its geoms
_MOST_DETAILED = 400  # robots drawn so at a time
_LARGEST_GEOMS = 5  # of a robot: what is drawn of it from far away
_SEGMENT_STEPS, _COARSE_SEGMENT_STEPS = 5, 20  # environment steps per segment of a trail
_FEW_ROBOTS = 256  # robots up to which trails are smooth
_TRAIL_HEIGHT = 0.004  # [m]
_HIDDEN_GROUP = 3  # group of the colliders, which are not drawn
_FLOOR = (0.25, 0.29, 0.36, 1.0)
_TRAIL = np.array((0.36, 0.66, 1.0, 1.0), np.float32)
_START_DISTANCE, _START_AZIMUTH, _START_ELEVATION = 0.85, 25.0, -30.0  # of the camera [m, degrees]


class GridRenderer(contextlib.AbstractContextManager["GridRenderer"]):
    """A `GridRenderer` renders a `RobotGrid`; it is a context manager that frees OpenGL."""

    def __init__(
        self,
        env: JetBotEnv,
        robots: int,
        width: int,
        height: int,
        *,
        smallest_robot: float = 8.0,
        smallest_marker: float = 6.0,
        trail_width: float = 1.5,
    ) -> None:
        """Open an OpenGL context.

        Args:
          env: The environment of the episodes.
          robots: The largest number of robots in a frame.
          width: The width of a frame [pixels].
          height: The height of a frame [pixels].
          smallest_robot: The length below which a robot is drawn enlarged [pixels].
          smallest_marker: The length below which a mocap body is drawn enlarged [pixels].
          trail_width: The width of a trail [pixels].

        Raises:
          UserError: this machine has no OpenGL that works without a display.
        """
        self._steps = _SEGMENT_STEPS if robots <= _FEW_ROBOTS else _COARSE_SEGMENT_STEPS
        segments = math.ceil(env.config.task.episode_length / self._steps) + 1
        markers = int((env.mj_model.body_mocapid[env.mj_model.geom_bodyid] >= 0).sum())
        most = robots * (segments + _LARGEST_GEOMS + markers)
        most += min(robots, _MOST_DETAILED) * env.mj_model.ngeom + 100
        # OpenGL gets the size of the floor once: it must be as wide as the widest view.
        model = copy.copy(env.mj_model)
        floor = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
        model.geom_size[floor, :2] = 10 + 4 * WIDEST_CELL * math.sqrt(robots)
        self._model, self._renderer = offscreen.open_renderer(model, width, height, most)
        self._data = mujoco.MjData(self._model)
        self._size, self._trail_width = (width, height), trail_width
        model = self._model
        # From far away, only the largest geoms of a robot are drawn, and all of a mocap body.
        shown = (model.geom_bodyid > 0) & (model.geom_group != _HIDDEN_GROUP)
        self._mocap_ids = model.body_mocapid[model.geom_bodyid]
        mocap, robot = shown & (self._mocap_ids >= 0), shown & (self._mocap_ids < 0)
        volume = np.where(robot, model.geom_aabb[:, 3:].prod(axis=1), 0.0)
        is_far = mocap.copy()
        is_far[np.argsort(volume)[-_LARGEST_GEOMS:]] = True
        self._goal_geoms = offscreen.goal_geoms(model)
        self._length = _length(model, robot)
        # Pixels of a metre below which a geom is drawn enlarged.
        self._smallest = np.where(
            mocap, smallest_marker / _length(model, mocap), smallest_robot / self._length
        )
        # The geoms of one robot are added robot by robot, and the floor only once.
        model.geom_group[:] = np.select([floor, is_far & shown, shown], [0, 1, 2], _HIDDEN_GROUP)
        self._floor_option, self._far_option, self._detailed_option = (
            _show_groups(groups) for groups in ((0,), (1,), (1, 2))
        )
        # The floor is darker than the robots.
        model.geom_rgba[floor] = model.mat_rgba[model.geom_matid[floor]] = _FLOOR
        self.fovy = float(model.vis.global_.fovy)
        """Field of view of the camera in height [degrees]."""

    def frame(self, grid: RobotGrid, seconds: float, camera: mujoco.MjvCamera) -> Frame:
        """Render the state at one time of the video.

        Args:
          grid: The episodes.
          seconds: The time [s].
          camera: A free camera.

        Returns:
          The image, RGB.
        """
        # Draw the floor, between clipping planes that suit the camera's distance.
        model, scene = self._model, self._renderer.scene
        far = 2 * camera.distance + 2 * float(np.abs(grid.corners_w).max())
        model.vis.map.znear = 0.05 * camera.distance / model.stat.extent
        model.vis.map.zfar = far / model.stat.extent
        mujoco.mj_kinematics(model, self._data)
        mujoco.mj_camlight(model, self._data)
        self._renderer.update_scene(self._data, camera, self._floor_option)
        scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        scene.flags[mujoco.mjtRndFlag.mjRND_HAZE] = False
        # Compute how many pixels a metre has at each robot.
        steps = grid.steps_at(seconds)
        reached = grid.reached_at(steps)
        eye_w = np.mean([np.asarray(one.pos) for one in scene.camera], axis=0)
        robots_w = grid.qpos[np.arange(len(steps)), steps][:, QPOS_XYZ]
        focal_length = self._size[1] / (2 * math.tan(math.radians(self.fovy) / 2))
        pixels = focal_length / np.linalg.norm(robots_w - eye_w, axis=-1)
        detailed = pixels * self._length > _DETAILED
        detailed[np.argsort(-pixels)[_MOST_DETAILED:]] = False
        # Add the robots with their goals and trails.
        for index, step in enumerate(steps.tolist()):
            places = {name: place[index] for name, place in grid.markers.items()}
            set_pose(model, self._data, grid.qpos[index, step], places)
            self._add_trail(grid.qpos[index, : step + 1, :2])
            self._add_robot(
                robots_w[index],
                float(pixels[index]),
                detailed=bool(detailed[index]),
                reached=bool(reached[index]),
            )
        return offscreen.reduce_image(self._renderer.render())

    def _add_robot(
        self, robot_w: Float[np.ndarray, "3"], pixels: float, *, detailed: bool, reached: bool
    ) -> None:
        """Add the geoms of the robot and of its markers in their current pose.

        Args:
          robot_w: The position of the robot [m].
          pixels: The pixels of a metre.
          detailed: Whether to add all geoms, or only the largest, enlarged around their bodies.
          reached: Whether the robot is at its goal.
        """
        scene, first = self._renderer.scene, self._renderer.scene.ngeom
        option = self._detailed_option if detailed else self._far_option
        everything = int(mujoco.mjtCatBit.mjCAT_ALL)
        perturbation = mujoco.MjvPerturb()
        mujoco.mjv_addGeoms(self._model, self._data, option, perturbation, everything, scene)
        if reached:
            offscreen.paint_reached(scene, self._goal_geoms, first)
        for geom in (scene.geoms[index] for index in range(first, scene.ngeom)):
            if not detailed:
                mocap_id = self._mocap_ids[geom.objid]
                centre = robot_w if mocap_id < 0 else self._data.mocap_pos[mocap_id]
                scale = max(1.0, self._smallest[geom.objid] / pixels)
                ground = np.array([centre[0], centre[1], 0.0])
                geom.matid = -1  # plain colours are seen from farther away than materials
                if geom.type == mujoco.mjtGeom.mjGEOM_CYLINDER:
                    geom.size[2] = geom.size[0]  # so are wide wheels
                geom.size[:] *= scale
                geom.pos[:] = ground + scale * (geom.pos - ground)

    def _add_trail(self, path_w: Float[np.ndarray, "time 2"]) -> None:
        """Add lines along the path of a robot, up to its current position."""
        last = len(path_w) - 1
        points = np.full((-(-last // self._steps) + 1, 3), _TRAIL_HEIGHT)
        points[:-1, :2], points[-1, :2] = path_w[: last : self._steps], path_w[last]
        width = self._trail_width * self._renderer.height / self._size[1]
        offscreen.add_lines(self._renderer.scene, points, width, _TRAIL)

    def __exit__(self, *exception: object) -> None:
        """Free the OpenGL context."""
        self._renderer.close()


def _show_groups(groups: Sequence[int]) -> mujoco.MjvOption:
    """Return the option to draw the geoms of some groups only."""
    option = mujoco.MjvOption()
    option.geomgroup[:] = np.isin(np.arange(len(option.geomgroup)), groups)
    return option


def _length(model: mujoco.MjModel, geoms: np.ndarray) -> float:
    """Return the largest length of any of these geoms along an axis [m]."""
    return float(2 * model.geom_aabb[geoms, 3:].max(initial=0.01))


def camera_above(grid: RobotGrid, fovy: float) -> mujoco.MjvCamera:
    """Return the camera above the middle of a square grid that sees all of it in a square frame.

    Args:
      grid: The episodes.
      fovy: The field of view [degrees].
    """
    camera = mujoco.MjvCamera()
    half = float(np.abs(grid.corners_w).max())
    camera.distance = 1.02 * half / math.tan(math.radians(fovy) / 2)
    camera.azimuth, camera.elevation = 0.0, -90.0
    return camera


def pull_back_camera(
    grid: RobotGrid, fovy: float, aspect: float, progress: float
) -> mujoco.MjvCamera:
    """Return the camera of the video, which moves back from one robot until it sees all.

    The logarithm of its distance changes smoothly, so that the image shrinks at an even rate.

    Args:
      grid: The episodes.
      fovy: The field of view in height [degrees].
      aspect: The width of the frame, relative to its height.
      progress: The time as a fraction of the move's duration.

    Returns:
      A free camera.
    """
    camera = offscreen.overview(grid.corners_w, fovy, sides=0.97 * aspect, above=0.97, below=0.97)
    share = min(max(progress, 0.0), 1.0)
    share = share * share * (3 - 2 * share)
    # The camera looks at the middle between the first robot and its goal, at first.
    near_w = (grid.qpos[grid.first, [0, -1]][:, QPOS_XYZ] * [1, 1, 0]).mean(axis=0)
    end_w, end_distance = np.array(camera.lookat), camera.distance
    start_distance = min(_START_DISTANCE, end_distance)
    distance = start_distance * (end_distance / start_distance) ** share
    moved = (distance - start_distance) / max(end_distance - start_distance, 1e-6)
    camera.distance = distance
    camera.lookat[:] = near_w + moved * (end_w - near_w)
    camera.azimuth = (1 - share) * _START_AZIMUTH
    camera.elevation = _START_ELEVATION + share * (camera.elevation - _START_ELEVATION)
    return camera
