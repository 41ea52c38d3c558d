"""Render many robots in one scene, each of which drives to its own goal.

The episodes are recorded in one batch, each with a robot alone at the origin. A `RobotGrid` moves
each episode to its own cell of a grid. No model of all robots is compiled: a `GridRenderer` adds
the geoms of one robot's model to MuJoCo's scene once for each robot. Robots that are only a few
pixels long are drawn by their largest geoms, enlarged.
"""

import copy
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Self

import jax
import mujoco
import numpy as np
from jaxtyping import Float, Int
from PIL import Image, ImageDraw, ImageFont

from jetbot_mjx.compiler.program_cache import ProgramCache
from jetbot_mjx.compiler.xla_options import compiler_options
from jetbot_mjx.envs.jetbot_env import JetBotEnv
from jetbot_mjx.envs.robot_model import QPOS_XYZ
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation.evaluator import Evaluator, report_keys
from jetbot_mjx.evaluation.rollout import Episodes
from jetbot_mjx.runs.checkpoint import (
    Checkpoint,
    Which,
    explanation,
    find_checkpoint,
    load_checkpoint,
)
from jetbot_mjx.runs.checkpoint_store import checkpoint_path, checkpoint_steps
from jetbot_mjx.runs.run_dir import make_folder, writing_to
from jetbot_mjx.viewers.gallery import successes_table
from jetbot_mjx.viewers.offscreen import open_renderer, overview, reduce_image
from jetbot_mjx.viewers.pose import set_pose
from jetbot_mjx.viewers.video import FPS, GIF_STRIDE, Frame, resize_frame, write_gif, write_mp4

MOST_ROBOTS = 1024
"""Largest number of robots in one scene."""

MAX_GIF_BYTES = 3_000_000
"""Largest size of a GIF, which a README still shows quickly."""

_SIZE = (960, 540)  # [pixels] width and height of the video
_GIF_SCALES = (0.75, 0.6, 0.55, 0.5, 0.4, 0.33, 0.25)  # relative to the video, tried in this order
_WAVE_SECONDS = 5.0  # from the start of the first robot to that of the farthest
_PULL_BACK_SECONDS = 6.0  # duration of the camera's move
_TEXT = 22  # [pixels] height of the font
_FRONT = 0.5  # [m] first radius around the first robot within which others start
_HOLD_SECONDS = 1.0  # pause after the end

_SPACING = (1.5, 2.5)  # [m] smallest and largest distance between neighbouring cells
_ASPECT = 1.4  # columns per row of the grid: the view from above then fills the video

_DETAILED = 18.0  # [pixels] length from which a robot is drawn with all its geoms
_MOST_DETAILED = 400  # robots drawn so at a time
_LARGEST_GEOMS = 5  # of a robot: what is drawn of it from far away
_SEGMENT_STEPS = 20  # environment steps per segment of a trail
_TRAIL_HEIGHT = 0.004  # [m]
_HIDDEN_GROUP = 3  # group of the colliders, which are not drawn

_FLOOR = (0.25, 0.29, 0.36, 1.0)
_TRAIL = np.array((0.36, 0.66, 1.0, 1.0), np.float32)
_REACHED = np.array((0.20, 0.85, 0.30, 1.0), np.float32)

_FIRST_GOAL = (0.6, 0.1)  # [m] where the goal of the robot in the first frame should be
_START_DISTANCE, _START_AZIMUTH, _START_ELEVATION = 0.85, 25.0, -30.0  # of the camera [m, degrees]

# The strip of three policies.
_STRIP_SIDE = 480  # [pixels]
_STRIP_SPACING = (1.8, 1.8)  # [m] the same for all policies
_STRIP_ROBOT, _STRIP_MARKER, _STRIP_TRAIL = 18.0, 13.0, 2.0  # [pixels]
_EARLY_SUCCESS = 0.4  # the early policy is the one closest to this success rate


class ManyRobotsVideo(NamedTuple):
    """A `ManyRobotsVideo` holds the files rendered for many robots with one policy."""

    mp4: Path
    gif: Path
    successes: int
    robots: int

    def describe(self) -> str:
        """Return what to print about it."""
        return (
            f"{self.successes:,} of {self.robots:,} goals reached\n"
            f"video: {self.mp4}\ngif:   {self.gif}"
        )


class TrainingStrip(NamedTuple):
    """A `TrainingStrip` holds the image of an untrained, an early and a trained policy."""

    png: Path
    successes: dict[int, int]
    """Number of goals reached, by the checkpoint's environment steps."""
    robots: int
    """Number of goals that each policy drove to."""

    def describe(self) -> str:
        """Return what to print about it."""
        return f"{successes_table(self.successes, self.robots)}\nimage: {self.png}"


class RobotGrid(NamedTuple):
    """A `RobotGrid` holds recorded episodes of n robots, each in its own cell, on the host."""

    qpos: Float[np.ndarray, "n time nq"]
    """Generalised positions in the common scene."""
    steps: Int[np.ndarray, " n"]
    """Environment steps of each episode."""
    markers: Mapping[str, Float[np.ndarray, "n 3"]]
    """Positions of the mocap bodies [m], world frame, by name."""
    reached: np.ndarray
    """Whether each episode ended with success."""
    start_seconds: Float[np.ndarray, " n"]
    """Time of the video at which each episode starts [s]."""
    corners_w: Float[np.ndarray, "4 3"]
    """Corners of the grid [m]."""
    dt: float
    """Duration of one environment step [s]."""

    @property
    def seconds(self) -> float:
        """Time of the video at which the last episode ends [s]."""
        return float((self.start_seconds + self.steps * self.dt).max())

    def steps_at(self, seconds: float) -> Int[np.ndarray, " n"]:
        """Return the index of each robot's state at a time of the video [s]."""
        step = np.round((seconds - self.start_seconds) / self.dt).astype(int)
        return np.clip(step, 0, self.steps)

    def reached_at(self, steps: Int[np.ndarray, " n"]) -> np.ndarray:
        """Return which robots have reached their goals at the states `steps`."""
        return self.reached & (steps == self.steps)

    @property
    def first(self) -> int:
        """Index of the robot that starts first, in the middle of the grid."""
        return int(self.start_seconds.argmin())


def render_many(
    run_or_checkpoint: str | Path, *, robots: int = 1024, which: Which = "best"
) -> ManyRobotsVideo:
    """Render many robots with one policy that drive to the report's first goals in one scene.

    The camera starts close to one robot and moves back until it sees all. The robots start in the
    order of their distance from that robot.

    Args:
      run_or_checkpoint: A run folder, or one of its checkpoint folders.
      robots: The number of robots, at most `MOST_ROBOTS`.
      which: The checkpoint of a run folder.

    Returns:
      The files, in `videos/<env_steps>/` of the run folder. The GIF has at most `MAX_GIF_BYTES`.

    Raises:
      UserError: there is no usable checkpoint, no OpenGL, or no space on the disk.
    """
    # Run the episodes.
    checkpoint = load_checkpoint(run_or_checkpoint, which)
    env = checkpoint.make_env()
    grid = place_on_grid(env, _run_episodes([checkpoint], env, robots)[0])
    folder = checkpoint.results_dir / "videos" / checkpoint.path.name
    make_folder(folder)
    name = f"many-{robots}"
    video = ManyRobotsVideo(
        folder / f"{name}.mp4", folder / f"{name}.gif", int(grid.reached.sum()), robots
    )
    # Render the frames, and write the animation in the largest size that fits.
    with GridRenderer(env, robots, *_SIZE) as renderer:
        frames = list(_video_frames(grid, renderer))
    with writing_to(video.mp4):
        write_mp4(video.mp4, frames)
    with writing_to(video.gif):
        for scale in _GIF_SCALES:
            write_gif(video.gif, [resize_frame(frame, scale) for frame in frames[::GIF_STRIDE]])
            if video.gif.stat().st_size <= MAX_GIF_BYTES:
                break
    return video


def render_training_strip(run_dir: str | Path, *, robots: int = 16) -> TrainingStrip:
    """Render the ends of the same episodes with an untrained, an early and a trained policy.

    The early policy is the checkpoint whose success rate in its own evaluation is closest to 40 %.
    Goals that a robot reached are green, and goals that it missed are red.

    Args:
      run_dir: A run folder with at least three checkpoints, the first of them untrained.
      robots: The number of robots of each policy, at most `MOST_ROBOTS`.

    Returns:
      The file, in `videos/` of the run folder.

    Raises:
      UserError: there is no usable checkpoint, no OpenGL, or no space on the disk.
    """
    # Choose the checkpoints and run them on the same goals.
    path = Path(run_dir).absolute()
    if find_checkpoint(path, "last") == path:
        raise UserError(f"--strip {run_dir} is one checkpoint: give the run folder it lies in")
    rates = {
        step: float(explanation(checkpoint_path(path, step))["metrics"].get("success_rate", -1))
        for step in checkpoint_steps(path)
    }
    chosen = untrained_early_trained(rates)
    checkpoints = [load_checkpoint(path, step) for step in chosen.values()]
    env = checkpoints[0].make_env()
    grids = [
        place_on_grid(env, each, aspect=1.0, spacing=_STRIP_SPACING)
        for each in _run_episodes(checkpoints, env, robots)
    ]
    # Render the ends from above, side by side.
    with GridRenderer(
        env,
        robots,
        _STRIP_SIDE,
        _STRIP_SIDE,
        smallest_robot=_STRIP_ROBOT,
        smallest_marker=_STRIP_MARKER,
        trail_width=_STRIP_TRAIL,
    ) as renderer:
        panels = [
            _below_heading(
                renderer.frame(grid, grid.seconds, camera_above(grid, renderer.fovy)),
                (f"{name}: {step:,} steps", f"{grid.reached.sum()} of {robots} goals reached"),
            )
            for (name, step), grid in zip(chosen.items(), grids, strict=True)
        ]
    folder = path / "videos"
    make_folder(folder)
    png = folder / "training.png"
    with writing_to(png):
        Image.fromarray(np.hstack(panels)).save(png)
    successes = [int(grid.reached.sum()) for grid in grids]
    return TrainingStrip(png, dict(zip(chosen.values(), successes, strict=True)), robots)


def place_on_grid(
    env: JetBotEnv,
    episodes: Episodes,
    *,
    aspect: float = _ASPECT,
    spacing: tuple[float, float] = _SPACING,
) -> RobotGrid:
    """Move each recorded episode to its own cell of a grid.

    The middle between the outermost points of a robot's path and its markers lies in the middle of
    its cell. A cell is as wide as the widest episode, within the limits `spacing`.

    Args:
      env: The environment of the episodes.
      episodes: The episodes of n robots, recorded with `qpos`.
      aspect: The columns, along y, per row of the grid, along x.
      spacing: The smallest and the largest distance between cells [m].

    Returns:
      The episodes in their cells.
    """
    host, markers = jax.device_get((episodes, jax.vmap(env.task.markers)(episodes.goal)))
    qpos, places = np.array(host.qpos, float), {k: np.array(v) for k, v in markers.items()}
    path = qpos[:, :, QPOS_XYZ][:, :, :2]
    # Find the extent of each episode; the states after its end equal its last one.
    points = np.concatenate([path, *(place[:, None, :2] for place in places.values())], axis=1)
    low, high = points.min(axis=1), points.max(axis=1)
    width = float(np.clip((high - low).max() + 0.2, *spacing))
    # Fill the cells row by row, around the origin.
    count = len(qpos)
    columns = min(count, math.ceil(math.sqrt(count * aspect)))
    rows = math.ceil(count / columns)
    row, column = np.divmod(np.arange(count), columns)
    cell = width * np.stack([(rows - 1) / 2 - row, (columns - 1) / 2 - column], axis=-1)
    shift = cell - (low + high) / 2
    path += shift[:, None]
    qpos[:, :, QPOS_XYZ][:, :, :2] = path
    for place in places.values():
        place[:, :2] += shift
    # Start in the near half of the grid, at a robot whose goal lies ahead, then go outwards.
    goal = np.asarray(host.goal_w)[:, :2] - np.asarray(host.start_w)
    off_middle = np.linalg.norm(cell / width - [-0.15 * rows, 0.0], axis=-1)
    first = (np.linalg.norm(goal - _FIRST_GOAL, axis=-1) + 0.05 * off_middle).argmin()
    away = np.linalg.norm(cell - cell[first], axis=-1)
    # The front of starting robots grows like the camera's view.
    share = np.log(np.maximum(away, _FRONT) / _FRONT) / math.log(max(away.max(), width) / _FRONT)
    half = np.array([[x, y, 0.0] for x in (-0.5, 0.5) for y in (-0.5, 0.5)])
    return RobotGrid(
        qpos=qpos,
        steps=np.asarray(host.steps, int),
        markers=places,
        reached=np.asarray(host.success) > 0,
        start_seconds=_WAVE_SECONDS * _smoothstep_inverse(share),
        corners_w=half * [rows * width, columns * width, 0.0],
        dt=env.dt,
    )


def _smoothstep_inverse(y: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
    """Return x in [0, 1] with 3 x² - 2 x³ = y."""
    return np.clip(0.5 - np.sin(np.arcsin(1 - 2 * y) / 3), 0.0, 1.0)


class GridRenderer:
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
        segments = math.ceil(env.config.task.episode_length / _SEGMENT_STEPS) + 1
        markers = int((env.mj_model.body_mocapid[env.mj_model.geom_bodyid] >= 0).sum())
        most = robots * (segments + _LARGEST_GEOMS + markers)
        most += min(robots, _MOST_DETAILED) * env.mj_model.ngeom + 100
        # OpenGL gets the size of the floor once: it must be as wide as the widest view.
        model = copy.copy(env.mj_model)
        floor = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
        model.geom_size[floor, :2] = 10 + 4 * _SPACING[1] * math.sqrt(robots)
        self._model, self._renderer = open_renderer(model, width, height, most)
        self._data = mujoco.MjData(self._model)
        self._size, self._trail_width = (width, height), trail_width
        model = self._model
        # The geoms of one robot are added robot by robot, and the floor only once.
        shown = (model.geom_bodyid > 0) & (model.geom_group != _HIDDEN_GROUP)
        model.geom_group[:] = np.select([floor, shown], [0, 1], _HIDDEN_GROUP)
        self._floor_option, self._robot_option = mujoco.MjvOption(), mujoco.MjvOption()
        self._floor_option.geomgroup[1:] = 0
        self._robot_option.geomgroup[:] = np.arange(len(self._robot_option.geomgroup)) == 1
        # The floor is darker than the robots.
        model.geom_rgba[floor] = _FLOOR
        model.mat_rgba[model.geom_matid[floor]] = _FLOOR
        # From far away, only the largest geoms of a robot are drawn, and all of a mocap body.
        mocap = shown & (model.body_mocapid[model.geom_bodyid] >= 0)
        volume = np.where(shown & ~mocap, model.geom_aabb[:, 3:].prod(axis=1), 0.0)
        largest = np.argsort(volume)[-_LARGEST_GEOMS:]
        self._goal_geoms = frozenset(np.flatnonzero(mocap & _of_body(model, "goal")).tolist())
        self._far_geoms = [
            _FarGeom(model, int(index), smallest)
            for indices, smallest in (
                (largest[volume[largest] > 0], smallest_robot / _length(model, shown & ~mocap)),
                (np.flatnonzero(mocap), smallest_marker / _length(model, mocap)),
            )
            for index in indices
        ]
        self._length = _length(model, shown & ~mocap)

    @property
    def fovy(self) -> float:
        """Field of view of the camera in height [degrees]."""
        return float(self._model.vis.global_.fovy)

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
            mujoco.mj_kinematics(model, self._data)
            self._add_trail(grid.qpos[index, : step + 1, :2])
            if detailed[index]:
                self._add_detailed(reached=bool(reached[index]))
            else:
                self._add_far(robots_w[index], float(pixels[index]), reached=bool(reached[index]))
        return reduce_image(self._renderer.render())

    def _add_detailed(self, *, reached: bool) -> None:
        """Add all geoms of the robot and of its markers in their current pose."""
        scene, first = self._renderer.scene, self._renderer.scene.ngeom
        everything = int(mujoco.mjtCatBit.mjCAT_ALL)
        perturbation = mujoco.MjvPerturb()
        mujoco.mjv_addGeoms(
            self._model, self._data, self._robot_option, perturbation, everything, scene
        )
        if reached:
            for index in range(first, scene.ngeom):
                if scene.geoms[index].objid in self._goal_geoms:
                    scene.geoms[index].rgba[:] = _REACHED

    def _add_far(self, robot_w: Float[np.ndarray, "3"], pixels: float, *, reached: bool) -> None:
        """Add the largest geoms of the robot and its markers, enlarged around their bodies.

        Args:
          robot_w: The position of the robot [m].
          pixels: The pixels of a metre.
          reached: Whether the robot is at its goal.
        """
        scene, data = self._renderer.scene, self._data
        for far in self._far_geoms:
            scale = max(1.0, far.smallest / pixels)
            centre = robot_w if far.mocap_id < 0 else data.mocap_pos[far.mocap_id]
            ground = np.array([centre[0], centre[1], 0.0])
            rotation = data.geom_xmat[far.index]
            position = data.geom_xpos[far.index] + rotation.reshape(3, 3) @ far.offset
            mujoco.mjv_initGeom(
                scene.geoms[scene.ngeom],
                far.kind,
                scale * far.size,
                ground + scale * (position - ground),
                rotation,
                _REACHED if reached and far.index in self._goal_geoms else far.rgba,
            )
            scene.ngeom += 1

    def _add_trail(self, path_w: Float[np.ndarray, "time 2"]) -> None:
        """Add lines along the path of a robot, up to its current position."""
        scene, kind = self._renderer.scene, mujoco.mjtGeom.mjGEOM_LINE
        last = len(path_w) - 1
        points = np.full((-(-last // _SEGMENT_STEPS) + 1, 3), _TRAIL_HEIGHT)
        points[:-1, :2], points[-1, :2] = path_w[:last:_SEGMENT_STEPS], path_w[last]
        width = self._trail_width * self._renderer.height / self._size[1]
        for start, end in itertools.pairwise(points):
            geom = scene.geoms[scene.ngeom]
            mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.zeros(9), _TRAIL)
            mujoco.mjv_connector(geom, kind, width, start, end)
            scene.ngeom += 1

    def __enter__(self) -> Self:
        """Return the renderer."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Free the OpenGL context."""
        self._renderer.close()


class _FarGeom:
    """A `_FarGeom` holds how one geom of the model is drawn if it is far away."""

    def __init__(self, model: mujoco.MjModel, index: int, smallest: float) -> None:
        """Read the geom; a mesh is drawn as the box around it."""
        self.index = index
        self.smallest = smallest  # pixels of a metre below which it is drawn enlarged
        self.mocap_id = int(model.body_mocapid[model.geom_bodyid[index]])
        material = model.geom_matid[index]
        rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[index]
        self.rgba = np.array(rgba, np.float32)
        kind = int(model.geom_type[index])
        self.kind, size, self.offset = kind, np.array(model.geom_size[index]), np.zeros(3)
        if kind in (mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_CAPSULE):
            size = size[[0, 0, 1]]
        elif kind == mujoco.mjtGeom.mjGEOM_SPHERE:
            size = size[[0, 0, 0]]
        elif kind not in (mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_ELLIPSOID):
            self.kind = int(mujoco.mjtGeom.mjGEOM_BOX)
            self.offset, size = np.split(np.array(model.geom_aabb[index]), 2)
        self.size = size


def _of_body(model: mujoco.MjModel, name: str) -> np.ndarray:
    """Return which geoms belong to a body; none if the model has no such body."""
    return model.geom_bodyid == mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)


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
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    half = float(np.abs(grid.corners_w).max())
    camera.distance = 1.02 * half / math.tan(math.radians(fovy) / 2)
    camera.azimuth, camera.elevation = 0.0, -90.0
    camera.lookat[:] = 0.0
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
    camera = overview(grid.corners_w, fovy, sides=0.97 * aspect, above=0.97, below=0.97)
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


def _video_frames(grid: RobotGrid, renderer: GridRenderer) -> Iterator[Frame]:
    """Render the video's frames, labelled with the numbers of robots and of goals reached."""
    seconds = max(grid.seconds, _PULL_BACK_SECONDS) + _HOLD_SECONDS
    aspect = _SIZE[0] / _SIZE[1]
    for number in range(math.ceil(seconds * FPS)):
        now = number / FPS
        camera = pull_back_camera(grid, renderer.fovy, aspect, now / _PULL_BACK_SECONDS)
        reached = int(grid.reached_at(grid.steps_at(now)).sum())
        lines = (f"{len(grid.steps):,} robots", f"{reached:,} at their goals")
        yield _with_label(renderer.frame(grid, now, camera), lines)


def _with_label(frame: Frame, lines: Sequence[str]) -> Frame:
    """Write lines of white text on a dark ground into the upper left corner of a frame."""
    image = Image.fromarray(frame)
    draw = ImageDraw.Draw(image, "RGBA")
    font: Any = ImageFont.load_default(_TEXT)
    text, margin = "\n".join(lines), _TEXT / 2
    right, lower = draw.multiline_textbbox((margin, margin), text, font, spacing=_TEXT / 4)[2:]
    draw.rectangle((0, 0, right + margin, lower + margin), (10, 14, 20, 190))
    draw.multiline_text((margin, margin), text, "white", font, spacing=_TEXT / 4)
    return np.asarray(image)


def _below_heading(frame: Frame, lines: Sequence[str]) -> Frame:
    """Add a white border to a frame, which is wider above it and holds lines of text."""
    border, height = 4, round(1.5 * _TEXT) * len(lines)
    widths = ((height, border), (border, border), (0, 0))
    image = Image.fromarray(np.pad(frame, widths, constant_values=255))
    font: Any = ImageFont.load_default(_TEXT)
    ImageDraw.Draw(image).multiline_text((border, 2), "\n".join(lines), "black", font)
    return np.asarray(image)


def _run_episodes(checkpoints: Sequence[Checkpoint], env: JetBotEnv, robots: int) -> list[Episodes]:
    """Run recorded episodes of several policies of one run with one compiled program."""
    programs = ProgramCache(compiler_options(env.config))
    evaluator = Evaluator(env, checkpoints[0].networks, programs, record=True)
    return [jax.device_get(evaluator.run(one.params, report_keys(robots))) for one in checkpoints]


def untrained_early_trained(success_rates: Mapping[int, float]) -> dict[str, int]:
    """Choose the checkpoints of a strip by their success rates.

    Args:
      success_rates: The success rate by environment steps, in ascending order.

    Returns:
      The environment steps of the first checkpoint, of that between the first and the last whose
      rate is closest to 40 %, and of the last.

    Raises:
      UserError: there are fewer than three checkpoints.
    """
    steps = list(success_rates)
    if len(steps) < 3:
        raise UserError(
            f"a strip needs three checkpoints, and the run has {len(steps)}: train with a smaller"
            " checkpoint_interval"
        )
    early = min(steps[1:-1], key=lambda step: abs(success_rates[step] - _EARLY_SUCCESS))
    return {"untrained": steps[0], "early": early, "trained": steps[-1]}
