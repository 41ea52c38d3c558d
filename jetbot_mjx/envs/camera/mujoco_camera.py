"""See through the robot's camera with MuJoCo's own renderer, in place of this package's.

Lights, shadows, reflections, haze and sky box are those of OpenGL. A picture is rendered large,
without distortion; its points are then taken along the rays of the lens, and every pixel is the
mean of its area. Programs call back for the pictures of all robots.

A context of OpenGL belongs to the thread in which it was made, and only that one can free it. So
this process has one thread per core that renders, for all cameras and as long as it lives. A camera
has a context in each of them; when it is collected, they are freed at the thread's next picture.
"""

import collections
import concurrent.futures
import copy
import functools
import math
import os
import weakref
from collections.abc import Mapping
from typing import NamedTuple

import jax
import mujoco
import numpy as np
from jaxtyping import Array, Float, UInt8

from jetbot_mjx.config import CameraConfig, LookParams
from jetbot_mjx.envs.camera.lens import pixel_grid
from jetbot_mjx.envs.camera.looks import PLAIN, Appearance
from jetbot_mjx.envs.camera.render import GREY, Camera, Pose
from jetbot_mjx.envs.camera.scenery import (
    SCENERIES,
    Scenery,
    SceneryKind,
    draw_scenery,
    paint,
    sky_side,
)
from jetbot_mjx.envs.opengl import SceneRenderer, find_backend
from jetbot_mjx.envs.robot_model import mocap_ids
from jetbot_mjx.errors import UserError

_SAMPLES = 4
"""Points per side of a pixel; fewer for images above 64 pixels."""

_MOST_PIXELS = 1024
"""Largest side of a picture before it is reduced."""

_NEAR = 0.005  # [m] near clipping plane
_MOST_GEOMS = 1000


class Lens(NamedTuple):
    """A `Lens` holds how a large picture without distortion becomes an image."""

    size: tuple[int, int]
    """Height and width of the large picture [pixels]."""
    span: tuple[float, float, float, float]
    """Directions (x/z, y/z) at its borders: left, right, top, bottom."""
    points: Float[np.ndarray, "h w s 2"] | None
    """Row and column in the large picture of each pixel's points; None: all pixels of an area."""


def make_lens(config: CameraConfig) -> Lens:
    """Compute how the image of a camera is taken from a picture without distortion.

    Args:
      config: the camera section.
    """
    samples = max(1, min(_SAMPLES, 256 // max(config.width, config.height)))
    finer = config.model_copy(update={"samples": samples})
    grid = pixel_grid(finer)
    rays, footprint = grid.expand(grid.columns)
    shape = config.height, config.width
    x, y = (
        np.stack([np.broadcast_to(axis, shape) for axis in axes], -1).astype(float)
        for axes in ([ray.x for ray in rays], [ray.y for ray in rays])
    )
    pitch_x, pitch_y = (
        float(np.abs(step).min()) / samples for step in (footprint.right.x, footprint.down.y)
    )
    left, right = x.min() - pitch_x / 2, x.max() + pitch_x / 2
    top, bottom = y.min() - pitch_y / 2, y.max() + pitch_y / 2
    if not config.distortion and config.lens != "fisheye":
        size = samples * config.height, samples * config.width
        return Lens(size, (left, right, top, bottom), None)
    height, width = (
        min(math.ceil(extent / pitch), _MOST_PIXELS)
        for extent, pitch in ((bottom - top, pitch_y), (right - left, pitch_x))
    )
    rows = (y - top) / (bottom - top) * height - 0.5
    columns = (x - left) / (right - left) * width - 0.5
    return Lens(
        (height, width),
        (left, right, top, bottom),
        np.stack([rows.clip(0, height - 1), columns.clip(0, width - 1)], axis=-1),
    )


def reduce_picture(
    picture: UInt8[np.ndarray, "H W 3"], lens: Lens, shape: tuple[int, int]
) -> Float[np.ndarray, "h w 3"]:
    """Return an image from the large picture: each pixel the mean of its points.

    Args:
      picture: the large picture, of the lens's size.
      lens: the lens.
      shape: height and width of the image [pixels].
    """
    if lens.points is None:
        height, width = shape
        parts = picture.reshape(height, len(picture) // height, width, -1, 3)
        return parts.mean(axis=(1, 3))
    at = np.floor(lens.points).astype(int)
    down, right = np.moveaxis(lens.points - at, -1, 0)[..., None]
    (row, column), (last_row, last_column) = np.moveaxis(at, -1, 0), np.array(lens.size) - 1
    lower, further = np.minimum(row + 1, last_row), np.minimum(column + 1, last_column)
    upper_points = (1.0 - right) * picture[row, column] + right * picture[row, further]
    lower_points = (1.0 - right) * picture[lower, column] + right * picture[lower, further]
    return ((1.0 - down) * upper_points + down * lower_points).mean(axis=2)


class MujocoCamera(Camera):
    """A `MujocoCamera` is a `Camera` whose images are `mujoco.Renderer`'s kind of pictures.

    Like `Camera` it is pure in `render`; what robot i of a batch sees with varied appearance is the
    scenery of number i modulo `SCENERIES`.
    """

    def __init__(
        self,
        config: CameraConfig,
        model: mujoco.MjModel,
        robot: str = "jetbot",
        *,
        appearance: SceneryKind = "plain",
    ) -> None:
        """Find an OpenGL, and compute the lens.

        Args:
          config: the camera section.
          model: the compiled model with its visual elements, which is not modified.
          robot: the name of the body that carries the camera, and is not drawn.
          appearance: `plain` or `varied`.

        Raises:
          UserError: this machine has no OpenGL that works without a display; or as for `Camera`.
        """
        super().__init__(config, model, robot)
        find_backend()
        self._lens = make_lens(config)
        self._base = _without_robot(model, robot, self._lens)
        self._mocap_ids = mocap_ids(model)
        self._sceneries: list[Scenery] = []
        if appearance == "varied":
            side = sky_side(model)
            self._sceneries = [draw_scenery(number, side) for number in range(SCENERIES)]
        self._stages: dict[int, _Stage] = {}
        weakref.finalize(self, _discard, self._stages).atexit = False
        self._last: dict[int, tuple[bytes, np.ndarray]] = {}

    def render(
        self,
        pose: Pose,
        mocap_positions: Mapping[str, Float[Array, "3"]],
        appearance: Appearance = PLAIN,
    ) -> UInt8[Array, "h w c"]:
        """Return the image, as `Camera.render` does.

        Args:
          pose: the pose of the camera.
          mocap_positions: positions [m] of mocap bodies, world frame, by name.
          appearance: the plain one.

        Raises:
          UserError: looks are drawn, which MuJoCo's pictures cannot show.
        """
        if appearance is not PLAIN:
            raise UserError(
                "MuJoCo's own pictures show the scene as it is: leave the looks out of the"
                f" randomization ({', '.join(LookParams._fields[:3])}, ...)"
            )
        return jax.pure_callback(
            self.pictures,
            jax.ShapeDtypeStruct(self.shape, np.uint8),
            pose.position,
            pose.rotation,
            {name: mocap_positions[name] for name in mocap_positions if name in self._mocap_ids},
            vmap_method="broadcast_all",
        )

    def pictures(
        self,
        positions: Float[Array | np.ndarray, "*n 3"],
        rotations: Float[Array | np.ndarray, "*n 3 3"],
        mocap_positions: Mapping[str, Float[Array | np.ndarray, "*n 3"]],
    ) -> UInt8[np.ndarray, "*n h w c"]:
        """Return the images of any number of robots, on the host.

        Args:
          positions: optical centres [m], world frame.
          rotations: axes of the images (right, down, forward) as columns.
          mocap_positions: positions [m] of mocap bodies, world frame, by name.
        """
        batch = np.shape(positions)[:-1]
        count = int(np.prod(batch))
        places = np.asarray(positions, float).reshape(count, 3)
        axes = np.asarray(rotations, float).reshape(count, 3, 3)
        standing = self._base.body_pos[self._base.body_mocapid >= 0]
        mocap = np.tile(standing, (count, 1, 1))
        for name, values in mocap_positions.items():
            mocap[:, self._mocap_ids[name]] = np.asarray(values, float).reshape(count, 3)
        images = np.empty((count, *self.shape), np.uint8)
        threads = _render_threads()
        todo: dict[int, list[tuple[int, _View]]] = {}
        for i in range(count):
            view = _View(i % SCENERIES if self._sceneries else i, places[i], axes[i], mocap[i])
            # An ended episode is stepped again from the same state, and looks the same again.
            key = b"".join(part.tobytes() for part in view[1:])
            known = self._last.get(i)
            if known is not None and known[0] == key:
                images[i] = known[1]
            else:
                todo.setdefault(view.number % len(threads), []).append((i, view))
                self._last[i] = key, images[i]

        def draw(thread: int, views: list[tuple[int, _View]]) -> None:
            # In the order of their sceneries, so that each is uploaded once.
            for i, view in sorted(views, key=lambda one: one[1].number):
                images[i] = self._draw(thread, view)

        for done in [threads[one].pool.submit(draw, one, views) for one, views in todo.items()]:
            done.result()
        return images.reshape(*batch, *self.shape)

    def picture(
        self,
        position_w: Float[np.ndarray, "3"],
        quat: Float[np.ndarray, "4"],
        mocap_positions: Mapping[str, Float[np.ndarray, "3"]],
        scenery: int = 0,
    ) -> UInt8[np.ndarray, "h w c"]:
        """Return the image of one robot, on the host.

        Args:
          position_w: position of the axle midpoint [m], world frame.
          quat: attitude of the robot as a unit quaternion (w, x, y, z).
          mocap_positions: positions [m] of mocap bodies, world frame, by name.
          scenery: number of the scenery, with varied appearance.
        """
        body = np.empty(9)
        mujoco.mju_quat2Mat(body, np.asarray(quat, float))
        body = body.reshape(3, 3)
        mocap = self._base.body_pos[self._base.body_mocapid >= 0]
        for name, place in mocap_positions.items():
            mocap[self._mocap_ids[name]] = place
        position = np.asarray(position_w, float) + body @ self._mount_position
        view = _View(scenery % SCENERIES, position, body @ self._mount_rotation, mocap)
        return _render_threads()[0].pool.submit(self._draw, 0, view).result()

    def _draw(self, thread: int, view: "_View") -> UInt8[np.ndarray, "h w c"]:
        """Draw one image; only the thread of that number may call it."""
        discarded = _render_threads()[thread].discarded
        while discarded:
            discarded.pop().renderer.close()
        if thread not in self._stages:
            self._stages[thread] = _Stage(copy.copy(self._base))
        stage = self._stages[thread]
        if self._sceneries:
            stage.set_scenery(view.number, self._sceneries[view.number])
        image = reduce_picture(stage.picture(view), self._lens, self.shape[:2])
        if self.config.colour == "grey":
            image = image @ np.array(GREY)[:, None]
        return np.floor(image + 0.5).astype(np.uint8)


class _View(NamedTuple):
    """A `_View` holds what one picture shows."""

    number: int
    """Number of the scenery, with varied appearance."""
    position: Float[np.ndarray, "3"]
    """Optical centre [m], world frame."""
    rotation: Float[np.ndarray, "3 3"]
    """Axes of the image (right, down, forward) as columns."""
    mocap: Float[np.ndarray, "nmocap 3"]
    """Positions of the mocap bodies [m], world frame."""


class _RenderThread(NamedTuple):
    """A `_RenderThread` is a thread in which OpenGL is called."""

    pool: concurrent.futures.ThreadPoolExecutor
    discarded: "collections.deque[_Stage]"
    """Stages of collected cameras, which this thread frees before its next picture. They are not
    freed where a camera is collected, because that thread may hold any lock."""


@functools.cache
def _render_threads() -> list[_RenderThread]:
    count = max(1, os.cpu_count() or 1)
    pools = [concurrent.futures.ThreadPoolExecutor(1) for _ in range(count)]
    return [_RenderThread(pool, collections.deque()) for pool in pools]


def _discard(stages: "dict[int, _Stage]") -> None:
    """Hand the stages of a garbage-collected camera to their threads, which free them."""
    for thread, stage in stages.items():
        _render_threads()[thread].discarded.append(stage)


class _Stage:
    """A `_Stage` renders large pictures, in the thread that made it."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model, self._data = model, mujoco.MjData(model)
        self._data.mocap_quat[:] = model.body_quat[model.body_mocapid >= 0]
        self.renderer = SceneRenderer(model, _MOST_GEOMS)
        self.renderer.scene.flags[mujoco.mjtRndFlag.mjRND_HAZE] = True
        self._number: int | None = None

    def set_scenery(self, number: int, scenery: Scenery) -> None:
        """Show a scenery, and upload its textures unless they are there."""
        if number != self._number:
            self._number = number
            self.renderer.upload(paint(self._model, scenery))

    def picture(self, view: _View) -> UInt8[np.ndarray, "H W 3"]:
        """Render a picture."""
        model, data = self._model, self._data
        data.mocap_pos[:] = view.mocap
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        eye = model.ncam - 1
        data.cam_xpos[eye] = view.position
        # MuJoCo's cameras look along their negative z axis.
        data.cam_xmat[eye] = (view.rotation * np.array([1.0, -1.0, -1.0])).reshape(-1)
        self.renderer.update_scene(data, eye)
        return self.renderer.render()


def _without_robot(model: mujoco.MjModel, robot: str, lens: Lens) -> mujoco.MjModel:
    """Return a copy of a model whose last camera has a lens's frustum, without the robot's geoms.

    Args:
      model: the model, which has at least one camera.
      robot: the name of the robot's body.
      lens: the lens.
    """
    found = copy.copy(model)
    root = model.body(robot).id
    own = model.body_rootid[model.geom_bodyid] == model.body_rootid[root]
    found.geom_rgba[own, 3] = 0.0
    found.geom_matid[own] = -1
    found.geom_group[own] = mujoco.mjNGROUP - 1
    left, right, top, bottom = lens.span
    eye = model.ncam - 1
    found.cam_projection[eye] = mujoco.mjtProjection.mjPROJ_PERSPECTIVE
    found.cam_sensorsize[eye] = right - left, bottom - top
    found.cam_intrinsic[eye] = 1.0, 1.0, (left + right) / 2, (top + bottom) / 2
    found.cam_resolution[eye] = lens.size[::-1]
    found.vis.map.znear = _NEAR / model.stat.extent
    # Each picture is reduced, which smooths edges as well as OpenGL's samples do, and faster.
    found.vis.quality.offsamples = 0
    found.vis.quality.shadowsize = 512
    found.vis.global_.offheight, found.vis.global_.offwidth = lens.size
    return found
