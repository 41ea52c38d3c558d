"""Render many robots in one scene, each of which drives to its own goal.

The episodes are recorded in one batch, placed on a `RobotGrid`, and drawn by a `GridRenderer`.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from jetbot_mjx import runs
from jetbot_mjx.errors import UserError, check_count
from jetbot_mjx.terminal import stage
from jetbot_mjx.viewers.gallery import (
    Rendered,
    run_episodes,
    run_folder,
    video_files,
    write_video,
)
from jetbot_mjx.viewers.grid_renderer import GridRenderer, camera_above, pull_back_camera
from jetbot_mjx.viewers.robot_grid import RobotGrid, place_on_grid
from jetbot_mjx.viewers.video import (
    FPS,
    REACHED,
    SIZE,
    Frame,
    resize_frame,
    with_lines,
    write_gif,
)

MOST_ROBOTS = 1024
"""Largest number of robots in one scene."""

MAX_GIF_BYTES = 3_000_000
"""Largest size of a GIF, which a README still shows quickly."""

_GIF_WIDTHS = (720, 640, 576, 528, 480, 384, 320, 240)  # [pixels] tried in this order
_PULL_BACK_SECONDS = 6.0  # duration of the camera's move
_TEXT = 0.04  # height of the font, relative to the video's
_HOLD_SECONDS = 1.0  # pause after the end

# The strip of three policies.
_STRIP_SIDE = 480  # [pixels]
_HEADING = 22  # [pixels] height of the font
_STRIP_SPACING = (1.8, 1.8)  # [m] the same for all policies
_STRIP_ROBOT, _STRIP_MARKER, _STRIP_TRAIL = 18.0, 13.0, 2.0  # [pixels]
_CLOSE = 0.15  # difference of success rates up to which the closest policy is close enough


def render_many(
    run_or_checkpoint: str | Path,
    *,
    robots: int = 1024,
    which: runs.Which = "best",
    size: tuple[int, int] | None = None,
) -> Rendered:
    """Render many robots with one policy that drive to the report's first goals in one scene.

    The camera starts close to one robot and moves back until it sees all. The robots start in the
    order of their distance from that robot.

    Args:
      run_or_checkpoint: A run folder, or one of its checkpoint folders.
      robots: The number of robots, at most `MOST_ROBOTS`.
      which: The checkpoint of a run folder.
      size: The width and height of the video, even numbers of pixels; None: `SIZE`.

    Returns:
      The files, in `videos/<env_steps>/` of the run folder. The GIF has at most `MAX_GIF_BYTES`.

    Raises:
      UserError: there is no usable checkpoint, no OpenGL, or no space on the disk.
    """
    check_count("robots", robots, MOST_ROBOTS)
    # Run the episodes.
    checkpoint = runs.load_checkpoint(run_or_checkpoint, which)
    setup = checkpoint.make_setup()
    env = setup.robot_env
    grid = place_on_grid(env, run_episodes([checkpoint], setup, range(robots))[0])
    folder = checkpoint.results_dir / "videos" / checkpoint.path.name
    files = video_files(folder, f"many-{robots}")
    # Render the frames, and write the animation in the largest size that fits.
    width, height = size or SIZE
    with GridRenderer(env, robots, width, height) as renderer:
        video = _video_frames(grid, renderer, width / height)
        frames = write_video(files["video"], [video], _frame_count(grid), _GIF_WIDTHS[0])
    with stage("writing the gif"), runs.writing_to(files["gif"]):
        for gif_width in _GIF_WIDTHS:
            scale = min(1.0, gif_width / frames[0].shape[1])
            write_gif(files["gif"], [resize_frame(frame, scale) for frame in frames])
            if files["gif"].stat().st_size <= MAX_GIF_BYTES:
                break
    return Rendered({checkpoint.env_steps: int(grid.reached.sum())}, robots, files)


def render_training_strip(run_dir: str | Path, *, robots: int = 16) -> Rendered:
    """Render the ends of the same episodes with an untrained, an early and a trained policy.

    The early policy is the checkpoint whose success rate in its own evaluation is closest to 40 %;
    if none is close, the result says so.
    Goals that a robot reached are green, and goals that it missed are red.

    Args:
      run_dir: A run folder with at least three checkpoints, the first of them untrained.
      robots: The number of robots of each policy, at most `MOST_ROBOTS`.

    Returns:
      The file, in `videos/` of the run folder.

    Raises:
      UserError: there is no usable checkpoint, no OpenGL, or no space on the disk.
    """
    check_count("robots", robots, MOST_ROBOTS)
    # Choose the checkpoints and run them on the same goals.
    path = run_folder(run_dir, "--strip")
    rates = {step: runs.stored_score(path, step) for step in runs.checkpoint_steps(path)}
    chosen = untrained_early_trained(rates)
    checkpoints = [runs.load_checkpoint(path, step) for step in chosen.values()]
    setup = checkpoints[0].make_setup()
    env = setup.robot_env
    grids = [
        place_on_grid(env, each, aspect=1.0, spacing=_STRIP_SPACING)
        for each in run_episodes(checkpoints, setup, range(robots))
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
    runs.make_folder(folder)
    png = folder / "training.png"
    with runs.writing_to(png):
        Image.fromarray(np.hstack(panels)).save(png)
    successes = {
        step: int(grid.reached.sum()) for step, grid in zip(chosen.values(), grids, strict=True)
    }
    return Rendered(successes, robots, {"image": png}, note_on_early(rates, chosen["early"]))


def _frame_count(grid: RobotGrid) -> int:
    """Return the number of the video's frames."""
    return math.ceil((max(grid.seconds, _PULL_BACK_SECONDS) + _HOLD_SECONDS) * FPS)


def _video_frames(grid: RobotGrid, renderer: GridRenderer, aspect: float) -> Iterator[Frame]:
    """Render the video's frames, labelled with the time and the number of goals reached."""
    for number in range(_frame_count(grid)):
        now = number / FPS
        camera = pull_back_camera(grid, renderer.fovy, aspect, now / _PULL_BACK_SECONDS)
        reached = int(grid.reached_at(grid.steps_at(now)).sum())
        lines = [
            (f"{len(grid.steps):,} robots   {min(now, grid.seconds):4.1f} s", "white"),
            (f"{reached:,} at their goals", REACHED),
        ]
        frame = renderer.frame(grid, now, camera)
        size = _TEXT * len(frame)
        yield with_lines(frame, lines, size, round(size / 2))


def _below_heading(frame: Frame, lines: Sequence[str]) -> Frame:
    """Add a white border to a frame, which is wider above it and holds lines of text."""
    border, height = 4, round(1.5 * _HEADING) * len(lines)
    widths = ((height, border), (border, border), (0, 0))
    image = Image.fromarray(np.pad(frame, widths, constant_values=255))
    font: object = ImageFont.load_default(_HEADING)
    ImageDraw.Draw(image).multiline_text((border, 2), "\n".join(lines), "black", font)
    return np.asarray(image)


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
    early = runs.early_checkpoint({step: success_rates[step] for step in steps[1:-1]})
    return {"untrained": steps[0], "early": early, "trained": steps[-1]}


def note_on_early(success_rates: Mapping[int, float], early: int) -> str:
    """Return a line for the user if the early policy of a strip is far from 40 %, else nothing.

    Args:
      success_rates: The success rate of each checkpoint in its own evaluation, by environment
        steps.
      early: The environment steps of the early policy.
    """
    if abs(success_rates[early] - runs.EARLY_SUCCESS) <= _CLOSE:
        return ""
    if max(success_rates.values()) < runs.EARLY_SUCCESS:
        remedy = "train longer, because none reached that"
    else:
        remedy = "train with a smaller checkpoint_interval or ppo.learning_rate"
    return (
        f"no checkpoint is close to {runs.EARLY_SUCCESS:.0%} success, the early one has"
        f" {success_rates[early]:.0%}: {remedy}"
    )
