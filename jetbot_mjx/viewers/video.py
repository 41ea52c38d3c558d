"""Films of episodes, and the files they go into.

Robots drive in real time, and every picture tells which of the report's fixed goals it shows,
the time, the distance that is left, and the outcome once there is one.
"""

import contextlib
import functools
import io
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Self

import imageio.v3 as iio
import jax
import mujoco
import numpy as np
from brax.training.agents.ppo import networks as ppo_networks
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont

from jetbot_mjx.agents.networks import PolicyParams
from jetbot_mjx.compiler.program_cache import ProgramCache
from jetbot_mjx.envs.jetbot_env import JetBotEnv
from jetbot_mjx.envs.robot_model import QPOS_XYZ
from jetbot_mjx.evaluation.evaluator import Evaluator, report_keys
from jetbot_mjx.evaluation.rollout import Episodes
from jetbot_mjx.viewers.offscreen import Renderer, overview

VIEW = 400
"""Side of one view [pixels]."""

FPS = 25
"""Frames a second of a film."""

GIF_STRIDE = 2
"""Every how manieth frame an animation shows; GIF counts in hundredths of a second."""

_HOLD_SECONDS = 0.6  # after the end, so that the eye sees it
_INSET = (0.30, 0.225)  # width and height of the onboard camera's picture, of the view's side
_MARGIN = 0.03  # from the border to text and inset, of the view's side
_TEXT = 0.05  # height of a letter, of the view's side
_TRAIL_STEPS = 4  # environment steps that one piece of the trail spans
# How much of a panel the way may fill; above is the room for text and inset.
_FILLED = {"sides": 0.92, "above": 0.42, "below": 0.92}
_AROUND = 0.12  # [m] about a position: the robot, or a cube, in any attitude

Frame = UInt8[np.ndarray, "height width 3"]


class Drive(NamedTuple):
    """One recorded episode, on the host."""

    goal_number: int
    """Index in the report's fixed goals."""
    qpos: Float[np.ndarray, "time nq"]
    """First state to last."""
    goal_w: Float[np.ndarray, "3"]
    """Where to go [m], world frame."""
    markers: Mapping[str, Float[np.ndarray, "3"]]
    """Positions of mocap bodies [m]."""
    reached: bool
    dt: float
    """Duration of one environment step [s]."""

    @property
    def steps(self) -> int:
        """Environment steps until the end."""
        return len(self.qpos) - 1

    def step_at(self, seconds: float) -> int:
        """Index of the state at a moment; after the end, that of the last one."""
        return min(round(seconds / self.dt), self.steps)

    def trail_w(self, step: int) -> Float[np.ndarray, "n 3"]:
        """Return the points of the way until then [m], just above the floor."""
        places = [*range(0, step, _TRAIL_STEPS), step]
        return np.pad(self.qpos[places][:, QPOS_XYZ][:, :2], ((0, 0), (0, 1)), constant_values=0.01)

    def distance(self, step: int) -> float:
        """Return what is left to the goal then [m], on the floor."""
        return float(np.linalg.norm(self.goal_w[:2] - self.qpos[step, QPOS_XYZ][:2]))


def drives(env: JetBotEnv, episodes: Episodes, goal_numbers: Sequence[int]) -> list[Drive]:
    """Take recorded episodes apart.

    Args:
      env: that they were driven in.
      episodes: recorded.
      goal_numbers: index of each one's goal in the report's fixed goals.

    Returns:
      One `Drive` for each.
    """
    host, markers = jax.device_get((episodes, jax.vmap(env.task.markers)(episodes.goal)))
    return [
        Drive(
            goal_number=number,
            qpos=host.qpos[index, : int(host.steps[index]) + 1],
            goal_w=host.goal_w[index],
            markers={name: places[index] for name, places in markers.items()},
            reached=bool(host.success[index]),
            dt=env.dt,
        )
        for index, number in enumerate(goal_numbers)
    ]


class Studio:
    """The cameras of a film; a context manager that frees them."""

    def __init__(self, env: JetBotEnv, side: int = VIEW, fps: float = FPS) -> None:
        """Open what drawing needs.

        Args:
          env: whose robots are to be drawn.
          side: of one view [pixels].
          fps: frames a second.

        Raises:
          UserError: this machine has no OpenGL that works without a screen.
        """
        self._fovy = float(env.mj_model.vis.global_.fovy)
        self._side, self._fps = side, fps
        width, height = (round(share * side) for share in _INSET)
        with contextlib.ExitStack() as stack:
            self._view = stack.enter_context(Renderer(env.mj_model, width=side, height=side))
            self._inset = stack.enter_context(Renderer(env.mj_model, width=width, height=height))
            self._stack = stack.pop_all()

    def film_episode(self, drive: Drive) -> Iterator[Frame]:
        """Draw one episode: chase camera, onboard camera in its corner, plan view beside them.

        Args:
          drive: the episode.

        Yields:
          Frames.
        """
        shown, frame = -1, np.empty(0)
        for seconds in self._clock([drive]):
            step = drive.step_at(seconds)
            if step != shown:
                shown, frame = step, self._episode_frame(drive, step)
            yield frame

    def film_together(self, shots: Sequence[tuple[str, Drive]]) -> Iterator[Frame]:
        """Several robots side by side on one clock; whoever has finished stands where it ended.

        Each is seen from a fixed place behind the start, from where all of them, all their ways
        and goals are in the picture: none of it behind text or inset.

        Args:
          shots: a heading and an episode for each panel, from left to right.

        Yields:
          Frames.
        """
        extent = np.vstack([_extent(drive) for _, drive in shots])
        camera = overview(extent, self._fovy, **_FILLED)
        shown = [-1] * len(shots)
        panels = [np.empty(0)] * len(shots)
        for seconds in self._clock([drive for _, drive in shots]):
            for index, (heading, drive) in enumerate(shots):
                step = drive.step_at(seconds)
                if step != shown[index]:
                    shown[index] = step
                    panels[index] = self._panel(heading, drive, step, camera)
            yield np.hstack(panels)

    def _episode_frame(self, drive: Drive, step: int) -> Frame:
        chase = self._view.frame(drive.qpos[step], drive.markers, "chase")
        top = self._view.frame(
            drive.qpos[step], drive.markers, "top", shadows=False, trail_w=drive.trail_w(step)
        )
        # Below, beside the robot: a goal lies there only while the robot turns its back on it.
        chase = self._with_inset(chase, drive, step, top=False)
        return np.hstack([self._labelled(chase, drive, step), top])

    def _clock(self, shown: Sequence[Drive]) -> Iterator[float]:
        """Return the times of the frames [s], until the last robot has finished for a while."""
        longest = max(drive.steps * drive.dt for drive in shown)
        count = math.ceil(longest * self._fps) + round(_HOLD_SECONDS * self._fps)
        return (frame / self._fps for frame in range(count + 1))

    def _panel(self, heading: str, drive: Drive, step: int, camera: mujoco.MjvCamera) -> Frame:
        view = self._view.frame(
            drive.qpos[step], drive.markers, camera, shadows=False, trail_w=drive.trail_w(step)
        )
        # A line between neighbours.
        view = np.pad(view[:, :-1], ((0, 0), (0, 1), (0, 0)), constant_values=255)
        return self._labelled(self._with_inset(view, drive, step, top=True), drive, step, heading)

    def _with_inset(self, view: Frame, drive: Drive, step: int, *, top: bool) -> Frame:
        """Set the onboard camera's picture, in a white frame, into a corner on the right."""
        inset = self._inset.frame(drive.qpos[step], drive.markers, "onboard", shadows=False)
        inset = np.pad(inset, ((2, 2), (2, 2), (0, 0)), constant_values=255)
        height, width = inset.shape[:2]
        margin = round(_MARGIN * self._side)
        first = margin if top else self._side - margin - height
        view = view.copy()
        view[first : first + height, self._side - margin - width : self._side - margin] = inset
        return view

    def _labelled(self, frame: Frame, drive: Drive, step: int, heading: str = "") -> Frame:
        lines = [(heading, "black")] if heading else []
        lines += [
            (f"goal {drive.goal_number}  {step * drive.dt:4.2f} s", "black"),
            (f"{drive.distance(step):4.2f} m to go", "black"),
        ]
        if step == drive.steps:
            lines.append(("reached", "darkgreen") if drive.reached else ("missed", "firebrick"))
        image = Image.fromarray(frame)
        draw = ImageDraw.Draw(image)
        size, margin = _TEXT * self._side, round(_MARGIN * self._side)
        for row, (text, colour) in enumerate(lines):
            place = (margin, margin + row * 1.15 * size)
            # The halo keeps it readable on anything; it wants wider gaps between words.
            wide = text.replace(" ", "  ")
            draw.text(place, wide, colour, _font(size), stroke_width=size / 10, stroke_fill="white")
        return np.asarray(image)

    def __enter__(self) -> Self:
        """Enter."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Free the cameras."""
        self._stack.close()


@functools.cache
def _font(size: float) -> Any:
    return ImageFont.load_default(size)


def _extent(drive: Drive) -> Float[np.ndarray, "n 3"]:
    """Return the corners of all that an episode shows [m]."""
    way = np.pad(drive.qpos[:, QPOS_XYZ][:, :2], ((0, 0), (0, 1)))
    places = np.vstack([way, *(p * [1, 1, 0] for p in (drive.goal_w, *drive.markers.values()))])
    steps = np.meshgrid([-_AROUND, _AROUND], [-_AROUND, _AROUND], [0, _AROUND])
    return (places[:, None] + np.stack(steps, -1).reshape(-1, 3)).reshape(-1, 3)


class EvaluationVideo:
    """Films a training's policies on the report's first goals, by one small compiled program."""

    GOALS = 4
    """How many robots are seen side by side."""

    _SIDE, _FPS = 256, 12.5  # what a training can wait for

    def __init__(
        self, env: JetBotEnv, networks: ppo_networks.PPONetworks, programs: ProgramCache
    ) -> None:
        """Prepare the program; it compiles at its first use.

        Args:
          env: one environment, unwrapped.
          networks: of the policies.
          programs: the cache of compiled programs of the environment's configuration.
        """
        self._env = env
        self._evaluator = Evaluator(env, networks, programs, record=True)

    def write(self, path: Path, params: PolicyParams, env_steps: int) -> None:
        """Drive and films.

        Args:
          path: of the mp4 file.
          params: the policy's.
          env_steps: that it was trained for.

        Raises:
          UserError: this machine has no OpenGL that works without a screen.
        """
        episodes = self._evaluator.run(params, report_keys(self.GOALS))
        shown = drives(self._env, episodes, range(self.GOALS))
        with Studio(self._env, self._SIDE, self._FPS) as studio:
            frames = studio.film_together([(f"{env_steps:,} steps", one) for one in shown])
            write_mp4(path, frames, self._FPS)


def shrunk(frame: Frame, factor: float) -> Frame:
    """Return a frame at a fraction of its size."""
    image = Image.fromarray(frame)
    size = (round(image.width * factor), round(image.height * factor))
    return np.asarray(image.resize(size, Image.Resampling.BOX))


def write_mp4(path: Path, frames: Iterable[Frame], fps: float = FPS) -> None:
    """Write a film that every browser and notebook plays."""
    # In memory, where nothing can go wrong half-way.
    file = io.BytesIO()
    with iio.imopen(file, "w", plugin="pyav", extension=".mp4") as opened:
        video: Any = opened
        video.init_video_stream("libx264", fps=fps, pixel_format="yuv420p")
        for frame in frames:
            video.write_frame(frame)
    _write_whole(path, file.getvalue())


def write_gif(path: Path, frames: Sequence[Frame]) -> None:
    """Write an animation in one palette, each frame `GIF_STRIDE` times as long as a film's."""
    # One palette for all frames: a palette each flickers.
    images = [Image.fromarray(frame) for frame in frames]
    sample = Image.fromarray(np.vstack(frames[:: max(1, len(frames) // 8)]))
    # An octree gives few pixels of a strong colour their own: the trail, the outcome.
    palette = sample.quantize(256, Image.Quantize.FASTOCTREE)
    reduced = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    file = io.BytesIO()
    reduced[0].save(
        file,
        format="GIF",
        save_all=True,
        append_images=reduced[1:],
        duration=round(1000 * GIF_STRIDE / FPS),
        loop=0,
        optimize=True,
    )
    _write_whole(path, file.getvalue())


def _write_whole(path: Path, content: bytes) -> None:
    """Leave the file that was there until the one in its place is complete."""
    unfinished = path.with_name(f".{path.name}.unfinished")
    try:
        unfinished.write_bytes(content)
        unfinished.replace(path)
    finally:
        unfinished.unlink(missing_ok=True)
