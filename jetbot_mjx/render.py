"""Shows a policy drive: `python -m jetbot_mjx.render RUN` writes an mp4, a gif and a plot."""

from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from jetbot_mjx import cli
from jetbot_mjx.checkpoint import Checkpoint, Which, load_checkpoint
from jetbot_mjx.evaluation import Evaluator, report_keys
from jetbot_mjx.film import VIEW, film_episode, write_gif, write_mp4
from jetbot_mjx.offscreen import Renderer
from jetbot_mjx.plots import plot_trajectories
from jetbot_mjx.rollout import Episodes
from jetbot_mjx.run_folder import make_folder

_GIF_EPISODES = 8  # about 1 MB: what a README or a chat still shows


class Pictures(NamedTuple):
    """The files made."""

    mp4: Path
    gif: Path
    trajectories: Path
    successes: int
    episodes: int


def run(run_or_checkpoint: str | Path, *, episodes: int = 20, which: Which = "best") -> Pictures:
    """Draws deterministic episodes on the first of the fixed goals.

    Args:
      run_or_checkpoint: a run folder, or one checkpoint folder of it.
      episodes: how many.
      which: the checkpoint of a run folder.

    Returns:
      The files, in `videos/<env_steps>/` of the run folder.

    Raises:
      UserError: there is no usable checkpoint, or no OpenGL.
    """
    checkpoint = load_checkpoint(run_or_checkpoint, which)
    env = checkpoint.make_env()
    evaluator = Evaluator(env, checkpoint.networks, record=True)
    driven = jax.device_get(evaluator.run(checkpoint.params, report_keys(episodes)))
    folder = checkpoint.run_dir / "videos" / checkpoint.path.name
    make_folder(folder)
    pictures = Pictures(
        mp4=folder / "episodes.mp4",
        gif=folder / "episodes.gif",
        trajectories=folder / "trajectories.png",
        successes=int(driven.success.sum()),
        episodes=episodes,
    )
    markers = jax.vmap(env.task.markers)(driven.goal)
    others = [np.asarray(place) for name, place in markers.items() if name != "goal"]
    figure = plot_trajectories(driven, _title(checkpoint, driven), others)
    figure.savefig(pictures.trajectories, dpi=120)
    with Renderer(env.mj_model, width=VIEW, height=VIEW) as renderer:
        films = [film_episode(renderer, env, driven, index) for index in range(episodes)]
    write_mp4(pictures.mp4, list(chain(*films)))
    write_gif(pictures.gif, list(chain(*films[:_GIF_EPISODES])))
    return pictures


def _title(checkpoint: Checkpoint, episodes: Episodes) -> str:
    count = episodes.success.size
    return (
        f"{int(episodes.success.sum())} of {count} goals reached,"
        f" policy after {checkpoint.env_steps:,} steps"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Parses the command line and draws.

    Args:
      arguments: without the program's name; None: those of the process.

    Returns:
      The exit code.
    """
    parser = cli.Parser(prog="python -m jetbot_mjx.render", description=__doc__)
    cli.add_checkpoint_arguments(parser)
    parser.add_argument("--episodes", type=cli.positive_int, default=20)
    options = parser.parse_args(arguments)
    cli.require_device()
    cli.use_compilation_cache()
    pictures = run(options.run, episodes=options.episodes, which=options.checkpoint)
    print(
        f"{pictures.successes} of {pictures.episodes} goals reached\n"
        f"video: {pictures.mp4}\n"
        f"gif:   {pictures.gif}\n"
        f"plot:  {pictures.trajectories}"
    )
    return 0


if __name__ == "__main__":
    cli.run_command(main)
