"""Shows policies drive: `python -m jetbot_mjx.render RUN` writes an mp4, a gif and a plot.

By default the best checkpoint and the first of the report's fixed goals; `--goals 3,17` films
those of them; `--gallery` has the first, the middle and the last checkpoint drive to the same
goals side by side.
"""

import argparse
import io
import re
from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
from PIL import Image

from jetbot_mjx import cli
from jetbot_mjx.compiler.program_cache import use_compilation_cache
from jetbot_mjx.envs.jetbot_env import JetBotEnv
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation.evaluator import REPORT_GOALS, Evaluator, report_keys
from jetbot_mjx.evaluation.plots import plot_trajectories
from jetbot_mjx.evaluation.rollout import Episodes
from jetbot_mjx.runs.checkpoint import Checkpoint, Which, find_checkpoint, load_checkpoint
from jetbot_mjx.runs.checkpoint_store import checkpoint_steps
from jetbot_mjx.runs.run_dir import make_folder, writing_to
from jetbot_mjx.viewers.video import (
    GIF_STRIDE,
    Frame,
    VideoRenderer,
    resize_frame,
    split_trajectories,
    write_gif,
    write_mp4,
)

_GIF_EPISODES = 8  # about 1 MB: what a README or a chat still shows
_GIF_SIZE, _GALLERY_GIF_SIZE = 0.6, 0.75  # of the film's


class Pictures(NamedTuple):
    """A `Pictures` tuple holds the files rendered for one policy."""

    mp4: Path
    gif: Path
    trajectories: Path
    successes: int
    episodes: int


class Gallery(NamedTuple):
    """A `Gallery` holds the files rendered for several policies of one run."""

    mp4: Path
    gif: Path
    plans: Path
    """Their trajectories from above, side by side."""
    successes: dict[int, int]
    """Goals reached, by the checkpoint's environment steps."""
    episodes: int
    """Goals that each policy drove to."""


def run(
    run_or_checkpoint: str | Path,
    *,
    episodes: int = 20,
    goals: Sequence[int] | None = None,
    which: Which = "best",
) -> Pictures:
    """Render deterministic episodes of one policy on some of the report's fixed goals.

    Args:
      run_or_checkpoint: a run folder, or one checkpoint folder of it.
      episodes: how many of the goals, from the first on.
      goals: their indices instead, in this order.
      which: the checkpoint of a run folder.

    Returns:
      The files, in `videos/<env_steps>/` of the run folder; those of `goals` are named by them.

    Raises:
      UserError: there is no usable checkpoint, no such goal, no OpenGL, or no room.
    """
    # Choose the goals and the names of the files.
    names = ("episodes", "trajectories")
    if goals is None:
        goals = range(episodes)
    else:
        check_goals(goals)
        names = (f"goals-{_spans(goals)}",) * 2
    # Run the episodes.
    checkpoint = load_checkpoint(run_or_checkpoint, which)
    env = checkpoint.make_env()
    driven = _drive([checkpoint], env, goals)[0]
    folder = checkpoint.run_dir / "videos" / checkpoint.path.name
    make_folder(folder)
    pictures = Pictures(
        mp4=folder / f"{names[0]}.mp4",
        gif=folder / f"{names[0]}.gif",
        trajectories=folder / f"{names[1]}.png",
        successes=int(driven.success.sum()),
        episodes=len(goals),
    )
    # Plot the trajectories and render the videos.
    with writing_to(pictures.trajectories):
        _plan(checkpoint, env, driven, goals).save(pictures.trajectories)
    with VideoRenderer(env) as renderer:
        films = [renderer.render_episode(drive) for drive in split_trajectories(env, driven, goals)]
        _write(pictures.mp4, pictures.gif, films, _GIF_SIZE)
    return pictures


def run_gallery(run_dir: str | Path, *, episodes: int = 4) -> Gallery:
    """Render the first, the middle and the last checkpoint of a run driving to the same goals.

    Goals are the report's, from the first on, so that nothing is chosen by its outcome.

    Args:
      run_dir: a run folder.
      episodes: how many goals.

    Returns:
      The files, in `videos/` of the run folder.

    Raises:
      UserError: there is no usable checkpoint, no OpenGL, or no room.
    """
    path = Path(run_dir).absolute()
    if find_checkpoint(path, "last") == path:
        raise UserError(f"--gallery {run_dir} is one checkpoint: give the run folder it lies in")
    # Run all chosen checkpoints on the same goals.
    chosen = early_middle_final(checkpoint_steps(path))
    checkpoints = [load_checkpoint(path, one) for one in chosen]
    env = checkpoints[0].make_env()
    goals = range(episodes)
    driven = _drive(checkpoints, env, goals)
    folder = path / "videos"
    make_folder(folder)
    gallery = Gallery(
        mp4=folder / "gallery.mp4",
        gif=folder / "gallery.gif",
        plans=folder / "gallery.png",
        successes={
            step: int(each.success.sum()) for step, each in zip(chosen, driven, strict=True)
        },
        episodes=episodes,
    )
    # Plot the trajectories side by side.
    plans = [
        np.asarray(_plan(checkpoint, env, each, goals))
        for checkpoint, each in zip(checkpoints, driven, strict=True)
    ]
    with writing_to(gallery.plans):
        Image.fromarray(np.hstack(plans)).save(gallery.plans)
    # Render the videos side by side, one goal after the other.
    headings = [f"{step:,} steps" for step in chosen]
    by_goal = zip(*(split_trajectories(env, each, goals) for each in driven), strict=True)
    with VideoRenderer(env) as renderer:
        films = [
            renderer.render_side_by_side(list(zip(headings, same_goal, strict=True)))
            for same_goal in by_goal
        ]
        _write(gallery.mp4, gallery.gif, films, _GALLERY_GIF_SIZE)
    return gallery


def early_middle_final(steps: Sequence[int]) -> list[int]:
    """Return the first, the middle and the last step, or all of them if there are at most two.

    Of two middle steps, the earlier one is returned.

    Args:
      steps: environment steps of the checkpoints, in ascending order, at least one.
    """
    return sorted({steps[0], steps[(len(steps) - 1) // 2], steps[-1]})


def _drive(
    checkpoints: Sequence[Checkpoint], env: JetBotEnv, goals: Sequence[int]
) -> list[Episodes]:
    """Run recorded episodes of several policies of one run with one compiled program."""
    evaluator = Evaluator(env, checkpoints[0].networks, record=True)
    keys = report_keys(max(goals) + 1)[np.asarray(goals)]
    return [jax.device_get(evaluator.run(each.params, keys)) for each in checkpoints]


def _plan(
    checkpoint: Checkpoint, env: JetBotEnv, episodes: Episodes, goals: Sequence[int]
) -> Image.Image:
    """Draw the trajectories from above, each goal with its number."""
    markers = jax.vmap(env.task.markers)(episodes.goal)
    others = [np.asarray(place) for name, place in markers.items() if name != "goal"]
    title = (
        f"{int(episodes.success.sum())} of {len(goals)} goals reached,"
        f" policy after {checkpoint.env_steps:,} steps"
    )
    figure = plot_trajectories(episodes, title, others)
    for number, goal_w in zip(goals, episodes.goal_w, strict=True):
        figure.axes[0].annotate(str(number), goal_w[:2], ha="center", va="center", fontsize="small")
    file = io.BytesIO()
    figure.savefig(file, dpi=120)
    return Image.open(file).convert("RGB")


def _write(mp4: Path, gif: Path, films: Sequence[Iterable[Frame]], size: float) -> None:
    """Write all videos to one mp4 file, and the first ones to a gif."""
    kept: list[Frame] = []

    def frames() -> Iterator[Frame]:
        for place, film in enumerate(films):
            for index, frame in enumerate(film):
                if place < _GIF_EPISODES and index % GIF_STRIDE == 0:
                    kept.append(resize_frame(frame, size))
                yield frame

    with writing_to(mp4):
        write_mp4(mp4, frames())
    with writing_to(gif):
        write_gif(gif, kept)


def check_goals(goals: Sequence[int]) -> None:
    """Raise an error if an index is outside of the fixed goal set or occurs twice.

    Args:
      goals: the indices.

    Raises:
      UserError: an index is invalid or occurs twice, or there is none.
    """
    if not goals:
        raise UserError("goals = [] names none: give at least one index")
    for place, goal in enumerate(goals):
        if not 0 <= goal < REPORT_GOALS:
            raise UserError(
                f"goal {goal} is none of the {REPORT_GOALS:,} fixed goals: they are 0 to"
                f" {REPORT_GOALS - 1}"
            )
        if goal in goals[:place]:
            raise UserError(f"goal {goal} is named twice: once will do")


def _spans(goals: Sequence[int]) -> str:
    """Format indices as `3,17`, or `0-7` for consecutive ones."""
    runs = [
        [goal for _, goal in run] for _, run in groupby(enumerate(goals), lambda p: p[1] - p[0])
    ]
    return ",".join(f"{run[0]}-{run[-1]}" if len(run) > 1 else f"{run[0]}" for run in runs)


def _goals(text: str) -> list[int]:
    """Parse an argument that lists goals by indices and ranges."""
    goals: list[int] = []
    for part in text.split(","):
        found = re.fullmatch(r"(\d{1,9})(?:-(\d{1,9}))?", part.strip(), re.ASCII)
        if found is None:
            raise argparse.ArgumentTypeError(
                f"{part!r} is no goal: write indices and ranges, as in 3,17 or 0-7"
            )
        first, last = int(found[1]), int(found[2] or found[1])
        if last < first:
            raise argparse.ArgumentTypeError(f"{part} runs backwards: write {last}-{first}")
        # Limit the length: an index beyond the last goal is rejected below anyway.
        goals += range(first, min(last, first + REPORT_GOALS) + 1)
    try:
        check_goals(goals)
    except UserError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    return goals


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and render.

    Args:
      arguments: arguments without the program's name; None: those of the process.

    Returns:
      The exit code.
    """
    parser = cli.Parser(prog="python -m jetbot_mjx.render", description=__doc__)
    cli.add_checkpoint_arguments(parser)
    which_goals = parser.add_mutually_exclusive_group()
    which_goals.add_argument(
        "--episodes",
        type=cli.whole_number(1, REPORT_GOALS),
        metavar="N",
        help="the first N of the fixed goals (default: 20, of a gallery 4)",
    )
    which_goals.add_argument(
        "--goals", type=_goals, metavar="I,J-K", help="these of the fixed goals, as in 3,17 or 0-7"
    )
    parser.add_argument(
        "--gallery",
        action="store_true",
        help="the first, the middle and the last checkpoint of the run side by side",
    )
    options = parser.parse_args(arguments)
    if options.gallery and options.goals:
        parser.error("--goals: a gallery shows the first goals, chosen before anyone saw them")
    if options.gallery and options.checkpoint != "best":
        parser.error("--checkpoint: a gallery shows the first, the middle and the last")
    cli.require_device()
    use_compilation_cache()
    if options.gallery:
        return _main_gallery(options)
    pictures = run(
        options.run,
        episodes=options.episodes or 20,
        goals=options.goals,
        which=options.checkpoint,
    )
    print(
        f"{pictures.successes} of {pictures.episodes} goals reached\n"
        f"video: {pictures.mp4}\n"
        f"gif:   {pictures.gif}\n"
        f"plot:  {pictures.trajectories}"
    )
    return 0


def _main_gallery(options: argparse.Namespace) -> int:
    gallery = run_gallery(options.run, episodes=options.episodes or 4)
    for step, successes in gallery.successes.items():
        print(f"{step:>12,} steps  {successes} of {gallery.episodes} goals reached")
    print(f"video: {gallery.mp4}\ngif:   {gallery.gif}\nplans: {gallery.plans}")
    return 0


if __name__ == "__main__":
    cli.run_command(main)
