"""Render a policy that drives to the fixed goals of the report: videos, and plots from above."""

import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from PIL import Image

from jetbot_mjx import evaluation, runs
from jetbot_mjx.envs import AdaptedEnv, JetBotEnv, some_without_gpu
from jetbot_mjx.errors import UserError, check_count
from jetbot_mjx.terminal import Advance, stage
from jetbot_mjx.viewers.environment_video import (
    EnvironmentRenderer,
    require_model,
    split_motions,
)
from jetbot_mjx.viewers.video import (
    FADE_FRAMES,
    GIF_STRIDE,
    SIZE,
    Frame,
    VideoRenderer,
    join,
    resize_frame,
    split_trajectories,
    write_gif,
    write_mp4,
)

VIDEO_EPISODES, GALLERY_EPISODES = 8, 4
"""Default number of goals of the videos of one policy, and of a gallery."""

_ENVIRONMENT_EPISODES = 3  # default in an environment of one's own, whose episodes are longer

_GALLERY_SIZE = (1280, 480)  # [pixels] of the default video
_GIF_EPISODES = 8  # what a README or a chat still shows
_GIF_WIDTH = 640  # [pixels]


class Rendered(NamedTuple):
    """A `Rendered` holds the files rendered for one policy, or for several of one run."""

    successes: Mapping[int, int]
    """Number of goals reached, by the checkpoint's environment steps."""
    episodes: int
    """Number of goals that each policy drove to."""
    files: Mapping[str, Path]
    """The files by what they are: `video`, `gif`, `plot`, `plots` or `image`."""
    note: str = ""
    """A line for the user; empty if there is nothing to say."""

    def __repr__(self) -> str:
        """Return the goals reached by steps, and the files, in one line."""
        reached = {step: f"{count}/{self.episodes}" for step, count in self.successes.items()}
        files = {what: str(runs.shortened(path)) for what, path in self.files.items()}
        return f"Rendered(reached={reached}, files={files})"

    def describe(self) -> str:
        """Return what to print about it: lines for each checkpoint, the note, and each file."""
        lines = [
            f"{step:>12,} steps  {count:,} of {self.episodes:,} goals reached"
            for step, count in self.successes.items()
        ]
        lines += [self.note] if self.note else []
        return "\n".join([*lines, *(f"{f'{what}:':6} {path}" for what, path in self.files.items())])


def video_files(folder: Path, name: str) -> dict[str, Path]:
    """Make a folder, and return the paths of a video and a GIF in it."""
    runs.make_folder(folder)
    return {"video": folder / f"{name}.mp4", "gif": folder / f"{name}.gif"}


def render_run(
    run_or_checkpoint: str | Path,
    *,
    episodes: int | None = None,
    goals: Sequence[int] | None = None,
    which: runs.Which = "best",
    size: tuple[int, int] | None = None,
) -> Rendered:
    """Render deterministic episodes of one policy on some of the report's fixed goals.

    In an environment of one's own they begin with the report's fixed starts.

    Args:
      run_or_checkpoint: A run folder, or one of its checkpoint folders.
      episodes: The number of goals, from the first on; None: `VIDEO_EPISODES`, and 3 in an
        environment of one's own.
      goals: Indices of the goals in the order of the video, which replace `episodes`, or None.
      which: The checkpoint of a run folder.
      size: The width and height of the video, even numbers of pixels; None: `SIZE`.

    Returns:
      The files, in `videos/<env_steps>/` of the run folder. With `goals`, their names contain the
      indices; with another number of episodes than by default, that number.

    Raises:
      UserError: there is no usable checkpoint, no such goal, no OpenGL, no space on the disk, or
        the environment has no goals, or no model of MuJoCo.
    """
    # Choose the goals and the names of the files.
    if episodes is not None:
        check_count("episodes", episodes, evaluation.REPORT_GOALS)
    if goals is not None:
        goals = evaluation.check_goals(goals)
    checkpoint = runs.load_checkpoint(run_or_checkpoint, which)
    if checkpoint.config.environment is not None:
        return _render_environment(checkpoint, episodes or _ENVIRONMENT_EPISODES, goals, size)
    if goals is None:
        episodes = episodes or VIDEO_EPISODES
        goals = range(episodes)
        names = [
            evaluation.name_with_count(name, episodes, VIDEO_EPISODES)
            for name in ("episodes", "trajectories")
        ]
    else:
        names = (f"goals-{evaluation.format_goals(goals)}",) * 2
    # Run the episodes.
    setup = checkpoint.make_setup()
    env = setup.robot_env
    rolled_out = run_episodes([checkpoint], setup, goals)[0]
    folder = checkpoint.results_dir / "videos" / checkpoint.path.name
    files = video_files(folder, names[0]) | {"plot": folder / f"{names[1]}.png"}
    # Plot the trajectories and render the videos.
    with runs.writing_to(files["plot"]):
        _trajectory_plot(checkpoint, env, rolled_out, goals).save(files["plot"])
    with VideoRenderer(env, size or SIZE) as renderer:
        drives = split_trajectories(env, rolled_out, goals)
        total = sum(renderer.frame_count([drive]) for drive in drives)
        _write_videos(files, [renderer.render_episode(drive) for drive in drives], total)
    successes = {checkpoint.env_steps: int(rolled_out.success.sum())}
    return Rendered(successes, len(goals), files)


def _render_environment(
    checkpoint: runs.Checkpoint,
    episodes: int,
    goals: Sequence[int] | None,
    size: tuple[int, int] | None,
) -> Rendered:
    """Render a policy from the report's first starts, in an environment of one's own.

    Raises:
      UserError: there are goals to drive to, no model of MuJoCo, or no OpenGL.
    """
    if goals is not None:
        raise UserError(
            f"--goals is for robots, and the run has environment ="
            f" {checkpoint.config.environment!r}: give --episodes"
        )
    setup = checkpoint.make_setup()
    env = setup.env
    assert isinstance(env, AdaptedEnv)
    require_model(env)
    evaluator = evaluation.ReturnEvaluator(env, setup.networks, setup.programs, record=True)
    found = jax.device_get(evaluator.run(checkpoint.params, evaluation.report_keys(episodes)))
    summary = evaluation.summarize_returns(found, has_success=env.has_success)
    motions = split_motions(env, found)
    name = evaluation.name_with_count("episodes", episodes, _ENVIRONMENT_EPISODES)
    files = video_files(checkpoint.results_dir / "videos" / checkpoint.path.name, name)
    with EnvironmentRenderer(env, size or SIZE) as renderer:
        total = sum(renderer.frame_count(one) for one in motions)
        _write_videos(files, [renderer.render_episode(one) for one in motions], total)
    note = (
        f"{checkpoint.env_steps:>12,} steps  return {summary.episode_return:.1f} in the mean of"
        f" {episodes:,} episode{'s' if episodes > 1 else ''}"
    )
    return Rendered({}, episodes, files, note)


def render_gallery(
    run_dir: str | Path,
    *,
    episodes: int = GALLERY_EPISODES,
    size: tuple[int, int] | None = None,
) -> Rendered:
    """Render the first, the middle and the last checkpoint of a run driving to the same goals.

    The goals are the report's, from the first on, so that none is chosen by its outcome.

    Args:
      run_dir: A run folder.
      episodes: The number of goals.
      size: The width and height of the video, even numbers of pixels; None: `_GALLERY_SIZE`.

    Returns:
      The files, in `videos/` of the run folder. Their names contain the number of goals if it is
      not the default.

    Raises:
      UserError: there is no usable checkpoint, no OpenGL, or no space on the disk.
    """
    check_count("episodes", episodes, evaluation.REPORT_GOALS)
    path = run_folder(run_dir, "--gallery")
    # Run all chosen checkpoints on the same goals.
    chosen = early_middle_final(runs.checkpoint_steps(path))
    checkpoints = [runs.load_checkpoint(path, one) for one in chosen]
    setup = checkpoints[0].make_setup()
    env, goals = setup.robot_env, range(episodes)
    rolled_out = run_episodes(checkpoints, setup, goals)
    name = evaluation.name_with_count("gallery", episodes, GALLERY_EPISODES)
    files = video_files(path / "videos", name) | {"plots": path / "videos" / f"{name}.png"}
    # Plot the trajectories side by side.
    plots = [
        np.asarray(_trajectory_plot(checkpoint, env, each, goals))
        for checkpoint, each in zip(checkpoints, rolled_out, strict=True)
    ]
    with runs.writing_to(files["plots"]):
        Image.fromarray(np.hstack(plots)).save(files["plots"])
    # Render the videos side by side, one goal after the other.
    headings = [f"{step:,} steps" for step in chosen]
    by_goal = list(zip(*(split_trajectories(env, each, goals) for each in rolled_out), strict=True))
    width, height = size or _GALLERY_SIZE
    # Views of equal width, and together an even number of pixels, as videos need it.
    with VideoRenderer(env, (2 * (width // (2 * len(chosen))), height)) as renderer:
        videos = [
            renderer.render_side_by_side(list(zip(headings, same_goal, strict=True)))
            for same_goal in by_goal
        ]
        total = sum(renderer.frame_count(same_goal) for same_goal in by_goal)
        _write_videos(files, videos, total)
    successes = {
        step: int(each.success.sum()) for step, each in zip(chosen, rolled_out, strict=True)
    }
    return Rendered(successes, episodes, files)


def early_middle_final(steps: Sequence[int]) -> list[int]:
    """Return the first, the middle and the last step, or all of them if there are at most two.

    Of two middle steps, the earlier one is returned.

    Args:
      steps: Environment steps of the checkpoints, in ascending order, at least one.
    """
    return sorted({steps[0], steps[(len(steps) - 1) // 2], steps[-1]})


def run_folder(run_dir: str | Path, option: str) -> Path:
    """Return the absolute path of a run folder.

    Raises:
      UserError: `run_dir` is not a run folder but, for example, one checkpoint.
    """
    path = Path(run_dir).absolute()
    if runs.find_checkpoint(path, "last") == path:
        raise UserError(
            f"{option} {run_dir} is one checkpoint: give the run folder that contains it"
        )
    return path


def run_episodes(
    checkpoints: Sequence[runs.Checkpoint], setup: runs.Setup, goals: Sequence[int]
) -> list[evaluation.Episodes]:
    """Run recorded episodes of several policies of one run with one compiled program.

    Args:
      checkpoints: The policies.
      setup: The environment and networks of the run.
      goals: Indices of the report's fixed goals.

    Returns:
      The episodes of each policy, on the host.
    """
    evaluator = evaluation.Evaluator(setup.robot_env, setup.networks, setup.programs, record=True)
    keys = evaluation.report_keys(max(goals) + 1)[np.asarray(goals)]
    return [jax.device_get(evaluator.run(each.params, keys)) for each in checkpoints]


def _trajectory_plot(
    checkpoint: runs.Checkpoint, env: JetBotEnv, episodes: evaluation.Episodes, goals: Sequence[int]
) -> Image.Image:
    """Plot the trajectories from above, with the index of each goal."""
    markers = jax.vmap(env.task.markers)(episodes.goal)
    others = [np.asarray(place) for name, place in markers.items() if name != "goal"]
    title = (
        f"{int(episodes.success.sum()):,} of {len(goals):,} goals reached,"
        f" policy after {checkpoint.env_steps:,} steps"
    )
    with evaluation.theme("light"):
        figure = evaluation.plot_trajectories(episodes, title, others)
        for number, goal_w in zip(goals, episodes.goal_w, strict=True):
            figure.axes[0].annotate(
                str(number), goal_w[:2], ha="center", va="center", fontsize="small"
            )
        return Image.open(io.BytesIO(evaluation.to_png(figure))).convert("RGB")


def _write_videos(files: Mapping[str, Path], videos: Sequence[Iterable[Frame]], total: int) -> None:
    """Write all videos to one mp4 file, and the first ones to a gif.

    Args:
      files: The result of `video_files`.
      videos: The frames of each video.
      total: The number of frames of all videos.
    """
    frames = write_video(files["video"], videos, total, _GIF_WIDTH)
    with stage("writing the gif"), runs.writing_to(files["gif"]):
        write_gif(files["gif"], frames)


def write_video(
    path: Path, videos: Sequence[Iterable[Frame]], total: int, gif_width: int
) -> list[Frame]:
    """Write videos one after the other to an mp4 file, and return the frames of its gif.

    Args:
      path: The path of the file.
      videos: The frames of each video.
      total: The number of frames of all videos.
      gif_width: The largest width of the gif [pixels].

    Returns:
      Frames of the first `_GIF_EPISODES` videos.
    """
    shown: list[list[Frame]] = [[] for _ in videos]

    def watched(video: Iterable[Frame], small: list[Frame], advance: Advance) -> Iterator[Frame]:
        for index, frame in enumerate(video):
            if index % GIF_STRIDE == 0:
                small.append(resize_frame(frame, min(1.0, gif_width / frame.shape[1])))
            yield frame
            advance(1)

    slowly = " (slow: no GPU with OpenGL)" * some_without_gpu()
    with stage(f"frames{slowly}", total) as advance, runs.writing_to(path):
        write_mp4(path, join(watched(*one, advance) for one in zip(videos, shown, strict=True)))
    return list(join(shown[:_GIF_EPISODES], FADE_FRAMES // GIF_STRIDE))
