"""Render images of the simulation without a display."""

import contextlib
import copy
import itertools
import math
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from jetbot_mjx.envs import SceneRenderer
from jetbot_mjx.viewers.camera import camera_axes, eye_that_sees
from jetbot_mjx.viewers.pose import set_pose

_OVERSAMPLING = 2
"""Rendered pixels per pixel of the image, along each axis. This is as smooth as OpenGL's four
samples per pixel, and on a CPU it takes two thirds of the time (one third for small images)."""

_SHADOW_SIZE = 4096
"""Side of the shadow map [pixels]."""

_SHADOW_REACH = 6.0
"""Half the side of the floor that the shadow map covers [m]; one of its pixels is 3 mm wide."""

_SHADOW_MIDDLE = (2.5, -2.5)
"""Middle of that floor [m]: beyond its corner at +x and -y, which views from behind the start see,
the floor would shade itself."""

_REACHED = np.array((0.20, 0.85, 0.30, 1.0), np.float32)
_TRAIL = np.array((0.10, 0.35, 0.85, 1.0), np.float32)
_TRAIL_WIDTH = 0.009  # fraction of the image's height
_LABEL = np.array((0.20, 0.22, 0.26, 1.0), np.float32)
_LABEL_WIDTH = 0.004  # fraction of the image's height

_CELLS = 4  # of the grid, per metre
_FLOOR, _THIN, _THICK = (222, 225, 229), (196, 202, 209), (146, 155, 166)  # colours of the grid
_STROKES = {
    "1": [[(0, 0.75), (0.3, 1), (0.3, 0)]],
    "2": [[(0, 0.8), (0.2, 1), (0.4, 1), (0.6, 0.8), (0.6, 0.6), (0, 0), (0.6, 0)]],
    "m": [[(0, 0), (0, 0.65), (0.8, 0.65), (0.8, 0)], [(0.4, 0.65), (0.4, 0)]],
}  # how the labels of the grid are drawn

_NEAR = 0.005  # [m] near clipping plane: the onboard camera comes close to the goal
_ELEVATION = -50.0  # [degrees] elevation of the overview camera
_NEAREST = 1.2  # [m] smallest distance from the overview camera to a point


class Renderer(contextlib.AbstractContextManager["Renderer"]):
    """A `Renderer` renders a model; it is a context manager that frees its OpenGL context."""

    def __init__(self, mj_model: mujoco.MjModel, *, width: int = 480, height: int = 480) -> None:
        """Open an OpenGL context.

        Args:
          mj_model: the model with all visual elements.
          width: the width of an image [pixels].
          height: the height of an image [pixels].

        Raises:
          UserError: this machine has no OpenGL that works without a display.
        """
        self._model, self._renderer = open_renderer(mj_model, width, height)
        self._data = mujoco.MjData(self._model)
        self._goal_geoms = goal_geoms(self._model)

    def frame(
        self,
        qpos: Float[np.ndarray, " nq"],
        markers: Mapping[str, object],
        camera: str | mujoco.MjvCamera,
        *,
        shadows: bool = True,
        reached: bool = False,
        trail_w: Float[np.ndarray, "n 3"] | None = None,
        lines_w: Sequence[Float[np.ndarray, "n 3"]] = (),
    ) -> UInt8[np.ndarray, "height width 3"]:
        """Render one pose.

        Args:
          qpos: generalised position of the robot.
          markers: positions [m] of the mocap bodies, by name, as `Task.markers` returns them.
          camera: `chase`, `top` or `onboard`, or a camera object.
          shadows: whether to render shadows; without them, rendering takes less than half the time.
          reached: whether the goal is green because the robot has reached it.
          trail_w: points [m], world frame, to connect by a line, such as the path so far.
          lines_w: thin grey lines to draw in the same way, such as `METRE_LABELS`.

        Returns:
          The image, RGB.
        """
        set_pose(self._model, self._data, qpos, markers)
        # Cameras may follow a centre of mass.
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        self._renderer.update_scene(self._data, camera=camera)
        self._renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows
        if reached:
            paint_reached(self._renderer.scene, self._goal_geoms)
        height = self._renderer.height
        for line_w in lines_w:
            add_lines(self._renderer.scene, line_w, _LABEL_WIDTH * height, _LABEL)
        if trail_w is not None:
            width = _TRAIL_WIDTH * height
            add_lines(self._renderer.scene, np.asarray(trail_w, float), width, _TRAIL)
        return reduce_image(self._renderer.render())

    def __exit__(self, *exception: object) -> None:
        """Free the OpenGL context."""
        self._renderer.close()


def goal_geoms(mj_model: mujoco.MjModel) -> frozenset[int]:
    """Return the indices of the geoms of the goal; none if the model has no body `goal`."""
    goal = mujoco.mj_name2id(mj_model, mujoco.mjtObj.mjOBJ_BODY, "goal")
    return frozenset(np.flatnonzero(mj_model.geom_bodyid == goal).tolist())


def paint_reached(scene: mujoco.MjvScene, geoms: frozenset[int], first: int = 0) -> None:
    """Make the geoms of a goal that was reached green, in a scene from its element `first` on."""
    for geom in (scene.geoms[index] for index in range(first, scene.ngeom)):
        if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and geom.objid in geoms:
            geom.rgba[:] = _REACHED


def add_lines(
    scene: mujoco.MjvScene,
    points_w: Float[np.ndarray, "n 3"],
    width: float,
    rgba: Float[np.ndarray, "4"],
) -> None:
    """Add lines between consecutive points to a scene, as far as it has room.

    Args:
      scene: the scene of a renderer.
      points_w: the points [m], world frame.
      width: the width of the lines, before `reduce_image` [pixels].
      rgba: their colour, float32.
    """
    kind = mujoco.mjtGeom.mjGEOM_LINE
    for start, end in itertools.pairwise(points_w):
        if scene.ngeom == scene.maxgeom:
            return
        geom = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.zeros(9), rgba)
        mujoco.mjv_connector(geom, kind, width, start, end)
        scene.ngeom += 1


def with_metre_grid(mj_model: mujoco.MjModel) -> mujoco.MjModel:
    """Return a copy of a robot's model with fine shadows and a grid of metres on its floor.

    Args:
      mj_model: the model, whose material `floor` has a texture that repeats every metre.
    """
    model = copy.copy(mj_model)
    model.vis.map.shadowclip = _SHADOW_REACH / model.stat.extent
    model.light_pos[:, :2] = _SHADOW_MIDDLE
    texture = int(model.mat_texid[model.material("floor").id, mujoco.mjtTextureRole.mjTEXROLE_RGB])
    side, first = model.tex_width[texture], model.tex_adr[texture]
    # The middle of the texture lies at the origin.
    away = np.abs(np.arange(side) - side // 2)
    tile = np.tile(np.array(_FLOOR, np.uint8), (side, side, 1))
    for lines, color in ((away % (side // _CELLS) < 1, _THIN), (away < 2, _THICK)):
        tile[lines], tile[:, lines] = color, color
    model.tex_data[first : first + tile.size] = tile.ravel()
    return model


def _label(text: str, left_w: Float[np.ndarray, "2"]) -> list[Float[np.ndarray, "n 3"]]:
    """Return the strokes of a label that lies on the floor and is read by who looks along x [m]."""
    strokes, size = [], 0.06
    for place, letter in enumerate(text):
        for stroke in _STROKES.get(letter, []):
            right, up = size * np.array(stroke).T
            x, y = left_w[0] + up + 0.3 * size, left_w[1] - right - 0.55 * size * place
            strokes.append(np.stack([x, y, 0 * x + 0.002], axis=1))
    return strokes


METRE_LABELS = tuple(
    stroke
    for metres in (1, 2)
    for x, y in ((metres, 0), (-metres, 0), (0, metres), (0, -metres))
    for stroke in _label(f"{metres} m", np.array([x, y - 0.03]))
)
"""Lines that write on the floor how far it is from the start, along both axes [m]."""


def open_renderer(
    mj_model: mujoco.MjModel, width: int, height: int, max_geoms: int = 10_000
) -> tuple[mujoco.MjModel, SceneRenderer]:
    """Open an OpenGL context for images that are rendered larger and then reduced.

    Args:
      mj_model: the model with all visual elements, which is not modified.
      width: the width of an image after `reduce_image` [pixels].
      height: the height of an image after `reduce_image` [pixels].
      max_geoms: the largest number of geoms in a scene.

    Returns:
      A copy of the model with the image's size and near clipping plane, and its renderer.

    Raises:
      UserError: this machine has no OpenGL that works without a display.
    """
    model = copy.copy(mj_model)
    width, height = _OVERSAMPLING * width, _OVERSAMPLING * height
    model.vis.map.znear = _NEAR / model.stat.extent
    model.vis.quality.offsamples = 0
    model.vis.quality.shadowsize = _SHADOW_SIZE
    model.vis.global_.offwidth = width
    model.vis.global_.offheight = height
    return model, SceneRenderer(model, max_geoms)


def reduce_image(image: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "height width 3"]:
    """Return a rendered image in its final size, each pixel the mean of those rendered for it."""
    return np.asarray(Image.fromarray(image).reduce(_OVERSAMPLING))


def overview(
    points_w: Float[np.ndarray, "n 3"],
    fovy: float,
    *,
    sides: float = 0.9,
    above: float = 0.9,
    below: float = 0.9,
) -> mujoco.MjvCamera:
    """Return the nearest camera that looks down along x and sees all points.

    Args:
      points_w: the points [m], world frame.
      fovy: the field of view in height and width [degrees].
      sides: the fraction of the image that the points may fill, from its middle to each side.
      above: the fraction from the middle upwards.
      below: the fraction from the middle downwards.

    Returns:
      A free camera.
    """
    angle = math.radians(_ELEVATION)
    axes_w = camera_axes(np.array([math.cos(angle), 0.0, math.sin(angle)]))
    slopes = math.tan(math.radians(fovy) / 2) * np.array([sides, sides, below, above])
    eye_w = eye_that_sees(points_w, axes_w, slopes, _NEAREST)
    camera = mujoco.MjvCamera()
    camera.azimuth, camera.elevation = 0.0, _ELEVATION
    # The camera turns around the point nearest to the origin.
    camera.distance = -float(axes_w[2] @ eye_w)
    camera.lookat[:] = eye_w + camera.distance * axes_w[2]
    return camera
