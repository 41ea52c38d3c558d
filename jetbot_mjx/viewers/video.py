"""Render episodes to video frames, and write videos and animations.

Videos play in real time, and their end fades into their start. Every frame shows the number of the
report's fixed goal, the time, the remaining distance, and the outcome at the end; a goal turns
green when its robot reaches it. The floor has a line every quarter of a metre.
"""

import contextlib
import functools
import io
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import av
import jax
import mujoco
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw, ImageFont, ImageOps

from jetbot_mjx.agents import PolicyParams
from jetbot_mjx.envs import QPOS_QUAT, QPOS_XYZ, JetBotEnv
from jetbot_mjx.evaluation import Episodes, Evaluator, report_keys
from jetbot_mjx.runs import Setup, write_bytes
from jetbot_mjx.viewers import offscreen
from jetbot_mjx.viewers.offscreen import Renderer, overview
from jetbot_mjx.viewers.policy_view import resize_nearest

SIZE = (1280, 720)
"""Width and height of a video [pixels]."""

FPS = 25
"""Frames per second of a video."""

GIF_STRIDE = 2
"""Frames of a video per frame of a GIF, whose frame times are multiples of 10 ms."""

HOLD_SECONDS = 0.6
"""Pause after the end, so that the viewer sees it [s]."""

FADE_FRAMES = 8
"""Frames from the end of one episode to the start of the next."""

# Lengths as fractions of a view's shorter side.
_INSET = (0.30, 0.225)  # width and height of the onboard camera's image
_SEEN = 0.25  # longer side of what a policy sees
_MARGIN = 0.03  # between the border and text or inset
_TEXT = 0.04  # height of the font
_SMALLEST_TEXT = 11  # [pixels] still readable
_TRAIL_STEPS = 4  # environment steps per segment of the trail
# Fraction of a view, from its middle, that the trajectory may fill; text and inset are above.
_FILLED = {"sides": 0.92, "above": 0.42, "below": 0.92}
_AROUND = 0.12  # [m] around a position, so that the robot and cubes are inside the frame

REACHED, MISSED = "#7be08a", "#ff9a6b"
"""Colours of an outcome on a dark ground."""

Frame = UInt8[np.ndarray, "height width 3"]


class Trajectory(NamedTuple):
    """A `Trajectory` holds one recorded episode, on the host."""

    goal_number: int
    """Index of the goal in the report's fixed goals."""
    qpos: Float[np.ndarray, "time nq"]
    """Generalised positions from the first state to the last."""
    goal_w: Float[np.ndarray, "3"]
    """Position of the goal [m], world frame."""
    markers: Mapping[str, Float[np.ndarray, "3"]]
    """Positions of the mocap bodies [m], world frame, by name."""
    reached: bool
    """Whether the episode ended with success."""
    dt: float
    """Duration of one environment step [s]."""

    @property
    def steps(self) -> int:
        """Number of environment steps of the episode."""
        return len(self.qpos) - 1

    def step_at(self, seconds: float) -> int:
        """Return the index of the state at a time [s]; after the end, the index of the last one."""
        return min(round(seconds / self.dt), self.steps)

    def reached_at(self, step: int) -> bool:
        """Return whether the goal is reached at a step."""
        return self.reached and step == self.steps

    def trail_w(self, step: int) -> Float[np.ndarray, "n 3"]:
        """Return the points of the path up to a step [m], just above the floor."""
        steps = [*range(0, step, _TRAIL_STEPS), step]
        return np.pad(self.qpos[steps][:, QPOS_XYZ][:, :2], ((0, 0), (0, 1)), constant_values=0.01)

    def distance(self, step: int) -> float:
        """Return the horizontal distance to the goal at a step [m]."""
        return float(np.linalg.norm(self.goal_w[:2] - self.qpos[step, QPOS_XYZ][:2]))


def split_trajectories(
    env: JetBotEnv, episodes: Episodes, goal_numbers: Sequence[int]
) -> list[Trajectory]:
    """Split a batch of recorded episodes into trajectories on the host.

    Args:
      env: the environment of the episodes.
      episodes: the batch, recorded with `qpos`.
      goal_numbers: the index of each episode's goal in the report's fixed goals.
    """
    host, markers = jax.device_get((episodes, jax.vmap(env.task.markers)(episodes.goal)))
    return [
        Trajectory(
            goal_number=number,
            qpos=host.qpos[index, : int(host.steps[index]) + 1],
            goal_w=host.goal_w[index],
            markers={name: places[index] for name, places in markers.items()},
            reached=bool(host.success[index]),
            dt=env.dt,
        )
        for index, number in enumerate(goal_numbers)
    ]


class VideoRenderer(contextlib.ExitStack):
    """A `VideoRenderer` renders trajectories; it is a context manager that frees its cameras."""

    def __init__(
        self,
        env: JetBotEnv,
        size: tuple[int, int] = SIZE,
        fps: float = FPS,
        *,
        shadows: bool = True,
    ) -> None:
        """Open the renderers.

        Args:
          env: the environment of the trajectories.
          size: the width and height of one view [pixels].
          fps: frames per second.
          shadows: whether to render shadows, which takes twice as long.

        Raises:
          UserError: this machine has no OpenGL that works without a display.
        """
        super().__init__()
        self._fovy = float(env.mj_model.vis.global_.fovy)
        self._size, self._fps, self._shadows = size, fps, shadows
        self._side = min(size)
        width, height = (round(share * self._side) for share in _INSET)
        self._policy_image = None
        if (camera := env.camera) is not None:
            self._policy_image = jax.jit(
                lambda qpos, markers: camera.render(
                    camera.pose(qpos[QPOS_XYZ], qpos[QPOS_QUAT]), markers
                )
            )
        model = offscreen.with_metre_grid(env.mj_model)
        self._view = self.enter_context(Renderer(model, width=size[0], height=size[1]))
        self._inset = self.enter_context(Renderer(model, width=width, height=height))

    def render_episode(self, trajectory: Trajectory, speed: int = 1) -> Iterator[Frame]:
        """Render one episode, as `render_side_by_side` does.

        Args:
          trajectory: the episode.
          speed: the pace, as a multiple of real time.

        Returns:
          Frames, one view wide.
        """
        return self.render_side_by_side([("", trajectory)], speed)

    def render_side_by_side(
        self, episodes: Sequence[tuple[str, Trajectory]], speed: int = 1
    ) -> Iterator[Frame]:
        """Render several episodes side by side in the same time; finished robots stand still.

        All views have the same fixed camera behind the start, which sees all paths and goals
        without overlap with text or inset. The inset is the image of the onboard camera, or what
        the policy sees.

        Args:
          episodes: a heading and a trajectory for each view, from left to right.
          speed: the pace, as a multiple of real time.

        Returns:
          Frames, one view wide per episode.
        """
        trajectories = [trajectory for _, trajectory in episodes]
        camera = self._overview(trajectories)
        # A view is rendered again only if its robot has made a step.
        draws = [
            functools.lru_cache(1)(functools.partial(self._episode_view, *one, camera))
            for one in episodes
        ]
        for frame in range(self.frame_count(trajectories, speed)):
            steps = [trajectory.step_at(speed * frame / self._fps) for trajectory in trajectories]
            views = [draw(step) for draw, step in zip(draws, steps, strict=True)]
            # A white line between neighbouring views.
            yield np.hstack([*map(_with_white_border, views[:-1]), views[-1]])

    def _overview(self, trajectories: Sequence[Trajectory]) -> mujoco.MjvCamera:
        """Return the camera that sees all episodes below text and inset."""
        width, height = self._size
        filled = _FILLED | {"sides": _FILLED["sides"] * width / height}
        return overview(np.vstack([*map(_extent, trajectories)]), self._fovy, **filled)

    def frame_count(self, trajectories: Sequence[Trajectory], speed: int = 1) -> int:
        """Return the number of frames of a video of one trajectory, or of several side by side."""
        longest = max(trajectory.steps * trajectory.dt for trajectory in trajectories)
        return math.ceil(longest * self._fps / speed) + round(HOLD_SECONDS * self._fps) + 1

    def _episode_view(
        self, heading: str, trajectory: Trajectory, camera: mujoco.MjvCamera, step: int
    ) -> Frame:
        """Render one state with everything that belongs to it."""
        view = self._view.frame(
            trajectory.qpos[step],
            trajectory.markers,
            camera,
            shadows=self._shadows,
            reached=trajectory.reached_at(step),
            trail_w=trajectory.trail_w(step),
            lines_w=offscreen.METRE_LABELS,
        )
        inset = self._inset_image(trajectory, step)
        return self._with_text(self._with_inset(view, inset), trajectory, step, heading)

    def _inset_image(self, trajectory: Trajectory, step: int) -> Frame:
        """Return what the policy sees, or the onboard camera's image, with a white border."""
        qpos, markers = trajectory.qpos[step], trajectory.markers
        if self._policy_image is None:
            reached = trajectory.reached_at(step)
            image = self._inset.frame(qpos, markers, "onboard", shadows=False, reached=reached)
        else:
            seen = np.asarray(self._policy_image(qpos, markers))
            image = resize_nearest(seen, round(_SEEN * self._side))
        return np.pad(image, ((2, 2), (2, 2), (0, 0)), constant_values=255)

    def _with_inset(self, view: Frame, inset: Frame) -> Frame:
        """Insert an image in the upper right corner of a view."""
        height, width = inset.shape[:2]
        margin = round(_MARGIN * self._side)
        left = self._size[0] - margin - width
        view = view.copy()
        view[margin : margin + height, left : left + width] = inset
        return view

    def _with_text(self, frame: Frame, trajectory: Trajectory, step: int, heading: str) -> Frame:
        """Write heading, goal number, time, remaining distance and outcome into a view."""
        lines = [(heading, "white")] if heading else []
        lines += [
            (f"goal {trajectory.goal_number}   {step * trajectory.dt:4.2f} s", "white"),
            (f"{trajectory.distance(step):4.2f} m to go", "white"),
        ]
        if step == trajectory.steps:
            lines.append(("reached", REACHED) if trajectory.reached else ("missed", MISSED))
        return with_lines(frame, lines, _TEXT * self._side, round(_MARGIN * self._side))


def _with_white_border(view: Frame) -> Frame:
    """Return a view whose last column is white."""
    return np.pad(view[:, :-1], ((0, 0), (0, 1), (0, 0)), constant_values=255)


def with_lines(
    frame: Frame, lines: Sequence[tuple[str, str]], size: float, margin: float = 0
) -> Frame:
    """Write lines of text on a dark ground into the upper left corner of a frame.

    Args:
      frame: the frame, which is not modified.
      lines: each line with the name of its colour.
      size: the height of the font [pixels].
      margin: the distance from the frame's borders [pixels].
    """
    size = max(size, _SMALLEST_TEXT)
    image = Image.fromarray(frame)
    panel = Image.new("RGBA", image.size)
    draw = ImageDraw.Draw(panel)
    inner, spacing = 0.45 * size, 1.25 * size
    width = max(draw.textlength(text, _font(size)) for text, _ in lines)
    corner = (margin + width + 2 * inner, margin + spacing * len(lines) + 1.4 * inner)
    draw.rounded_rectangle((margin, margin, *corner), inner, (10, 14, 20, 170))
    for row, (text, colour) in enumerate(lines):
        place = (margin + inner, margin + 0.5 * inner + row * spacing)
        draw.text(place, text, colour, _font(size))
    image.paste(panel, mask=panel)
    return np.asarray(image)


@functools.cache
def _font(size: float) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)


def _extent(trajectory: Trajectory) -> Float[np.ndarray, "n 3"]:
    """Return the corners of boxes around the path, the goal and the markers [m]."""
    path = np.pad(trajectory.qpos[:, QPOS_XYZ][:, :2], ((0, 0), (0, 1)))
    positions = np.vstack(
        [path, *(p * [1, 1, 0] for p in (trajectory.goal_w, *trajectory.markers.values()))]
    )
    corners = np.meshgrid([-_AROUND, _AROUND], [-_AROUND, _AROUND], [0, _AROUND])
    return (positions[:, None] + np.stack(corners, -1).reshape(-1, 3)).reshape(-1, 3)


class EvaluationVideo:
    """An `EvaluationVideo` renders policies of a training on the report's first goals."""

    GOALS = 4
    """Number of episodes side by side."""

    _SIZE, _FPS = (256, 256), FPS / GIF_STRIDE  # small, so that training waits only briefly

    def __init__(self, setup: Setup) -> None:
        """Prepare the program, which compiles at its first use.

        Args:
          setup: the environment, networks and programs of the training.
        """
        self._env = setup.robot_env
        self._evaluator = Evaluator(setup.robot_env, setup.networks, setup.programs, record=True)

    def write(self, path: Path, params: PolicyParams, env_steps: int) -> None:
        """Run the episodes and write their video, and a GIF of the same name.

        Args:
          path: the path of the mp4 file.
          params: the parameters of the policy.
          env_steps: the environment steps that the policy was trained for.

        Raises:
          UserError: this machine has no OpenGL that works without a display.
        """
        episodes = self._evaluator.run(params, report_keys(self.GOALS))
        trajectories = split_trajectories(self._env, episodes, range(self.GOALS))
        with VideoRenderer(self._env, self._SIZE, self._FPS, shadows=False) as renderer:
            headed = [(f"{env_steps:,} steps", one) for one in trajectories]
            frames = list(renderer.render_side_by_side(headed))
        write_mp4(path, frames, self._FPS)
        write_gif(path.with_suffix(".gif"), frames)


def resize_frame(frame: Frame, factor: float) -> Frame:
    """Return a frame scaled in both directions.

    Args:
      frame: the frame, RGB.
      factor: the factor on width and height, below 1.
    """
    return np.asarray(ImageOps.scale(Image.fromarray(frame), factor, Image.Resampling.BOX))


def join(videos: Iterable[Iterable[Frame]], fade_frames: int = FADE_FRAMES) -> Iterator[Frame]:
    """Yield the frames of videos one after the other, as a loop: the last fades into the first.

    Args:
      videos: the frames of each video, all of the same size.
      fade_frames: the number of frames between two videos.
    """
    first = last = None
    for video in videos:
        for number, frame in enumerate(video):
            if number == 0 and last is not None:
                yield from _fade(last, frame, fade_frames)
            first = frame if first is None else first
            yield frame
            last = frame
    if first is not None and last is not None:
        yield from _fade(last, first, fade_frames)


def _fade(before: Frame, after: Frame, frames: int) -> Iterator[Frame]:
    for number in range(frames):
        share = (number + 1) / (frames + 1)
        yield np.round((1 - share) * before + share * after).astype(np.uint8)


def write_mp4(path: Path, frames: Iterable[Frame], fps: float = FPS) -> None:
    """Write a video in H.264, which browsers and notebooks play.

    Args:
      path: the path of the file; an existing file is replaced.
      frames: the frames, RGB, all of the same size.
      fps: frames per second.
    """
    # Encode in memory, so that a full disk leaves no partial file.
    write_bytes(path, encode_mp4(frames, fps))


def encode_mp4(frames: Iterable[Frame], fps: float) -> bytes:
    """Return a video as `write_mp4` writes it."""
    file = io.BytesIO()
    with av.open(file, "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=Fraction(fps), pix_fmt="yuv420p")
        for number, frame in enumerate(frames):
            if number == 0:
                stream.height, stream.width = frame.shape[:2]
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame)))
        container.mux(stream.encode())
    return file.getvalue()


def write_gif(path: Path, frames: Sequence[Frame]) -> None:
    """Write a GIF animation whose frames last `GIF_STRIDE` times as long as a video's.

    Args:
      path: the path of the file; an existing file is replaced.
      frames: the frames, RGB, all of the same size.
    """
    # Use one palette for all frames: with one per frame, the colours flicker.
    images = [Image.fromarray(frame) for frame in frames]
    sample = Image.fromarray(np.vstack(frames[:: max(1, len(frames) // 8)]))
    # An octree keeps strong colours of few pixels: the trail, the outcome.
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
    write_bytes(path, file.getvalue())
