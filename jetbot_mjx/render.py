"""Shows a policy drive: `python -m jetbot_mjx.render RUN` writes an mp4, a gif and a plot."""

from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import NamedTuple

import imageio.v3 as iio
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from PIL import Image, ImageDraw, ImageFont

from jetbot_mjx import cli
from jetbot_mjx.checkpoint import Checkpoint, Which, load_checkpoint
from jetbot_mjx.env import JetBotEnv
from jetbot_mjx.evaluation import Evaluator, report_keys
from jetbot_mjx.offscreen import Renderer
from jetbot_mjx.rollout import Episodes
from jetbot_mjx.run_folder import make_folder

_VIEW = 400  # [pixels] side of one view
_VIDEO_FPS = 30
_GIF_FPS = _VIDEO_FPS // 2
# What every browser and notebook plays.
_H264 = {"plugin": "pyav", "codec": "libx264"}
_GIF_EPISODES = 8  # about 1 MB: what a README or a chat still shows
_HOLD_SECONDS = 0.4  # after the end, so that the eye sees it

Frame = UInt8[np.ndarray, "height width 3"]


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
    with Renderer(env.mj_model, width=_VIEW, height=_VIEW) as renderer:
        films = [_film(renderer, env, driven, index) for index in range(episodes)]
    iio.imwrite(pictures.mp4, np.stack(list(chain(*films))), fps=_VIDEO_FPS, **_H264)
    _write_gif(
        pictures.gif, [_half(frame) for film in films[:_GIF_EPISODES] for frame in film[::2]]
    )
    return pictures


def plot_trajectories(
    episodes: Episodes, title: str = "", others_w: Sequence[Float[np.ndarray, "n 3"]] = ()
) -> Figure:
    """Plan view of recorded episodes: where the robot went and where it should have gone.

    Args:
      episodes: recorded.
      title: of the figure.
      others_w: what else stood in each episode's world [m], drawn as grey dots.

    Returns:
      The figure.
    """
    if episodes.qpos is None:
        raise ValueError("these episodes were not recorded: make_rollout(..., record=True)")
    figure = Figure(figsize=(6.4, 6.4), layout="constrained")
    axes = figure.add_subplot()
    for qpos, goal_w, success, steps in zip(
        np.asarray(episodes.qpos),
        np.asarray(episodes.goal_w),
        np.asarray(episodes.success) > 0,
        np.asarray(episodes.steps, int),
        strict=True,
    ):
        colour = "tab:green" if success else "tab:red"
        way = qpos[: steps + 1, :2]
        axes.plot(way[:, 0], way[:, 1], color=colour, linewidth=1.2, alpha=0.8)
        axes.add_patch(
            Rectangle(
                (goal_w[0] - 0.05, goal_w[1] - 0.05), 0.1, 0.1, color=colour, alpha=0.35, lw=0
            )
        )
        axes.plot(*way[-1], marker="o", color=colour, markersize=4)
    for places in others_w:
        axes.scatter(places[:, 0], places[:, 1], color="grey", alpha=0.5, zorder=0)
    axes.plot(0, 0, marker=(3, 0, -90), color="black", markersize=11, label="start, heading +x")
    axes.plot([], [], color="tab:green", label="reached")
    axes.plot([], [], color="tab:red", label="not reached")
    axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title=title)
    reach = 1.1 * max(1.25, float(np.abs(np.asarray(episodes.goal_w)[:, :2]).max()))
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach))
    axes.grid(alpha=0.3)
    axes.legend(loc="upper left", fontsize="small")
    return figure


def _title(checkpoint: Checkpoint, episodes: Episodes) -> str:
    count = episodes.success.size
    return (
        f"{int(episodes.success.sum())} of {count} goals reached,"
        f" policy after {checkpoint.env_steps:,} steps"
    )


def _film(renderer: Renderer, env: JetBotEnv, episodes: Episodes, index: int) -> list[Frame]:
    """One episode in real time: the chase camera beside the view from above."""
    assert episodes.qpos is not None
    goal = jax.tree.map(lambda leaf: jnp.asarray(leaf[index]), episodes.goal)
    markers = env.task.markers(goal)
    steps = int(episodes.steps[index])
    stride = 1.0 / (_VIDEO_FPS * env.dt)
    times = [round(i * stride) for i in range(int(steps / stride) + 1)]
    film = []
    for time in [*times, steps]:
        views = [
            renderer.frame(np.asarray(episodes.qpos[index, time]), markers, camera)
            for camera in ("chase", "top")
        ]
        outcome = "" if time < steps else ("reached" if episodes.success[index] else "missed")
        label = f"goal {index + 1}   {time * env.dt:4.2f} s   {outcome}"
        film.append(_labelled(np.hstack(views), label))
    return film + [film[-1]] * round(_HOLD_SECONDS * _VIDEO_FPS)


def _labelled(frame: Frame, text: str) -> Frame:
    image = Image.fromarray(frame)
    draw = ImageDraw.Draw(image)
    draw.text((14, 12), text, fill="black", font=ImageFont.load_default(20))
    return np.asarray(image)


def _half(frame: Frame) -> Frame:
    image = Image.fromarray(frame)
    return np.asarray(image.resize((image.width // 2, image.height // 2), Image.Resampling.BOX))


def _write_gif(path: Path, frames: Sequence[Frame]) -> None:
    # One palette for all frames: a palette each flickers.
    images = [Image.fromarray(frame) for frame in frames]
    sample = Image.fromarray(np.vstack(frames[:: max(1, len(frames) // 8)]))
    palette = sample.quantize(256)
    reduced = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    reduced[0].save(
        path,
        save_all=True,
        append_images=reduced[1:],
        duration=round(1000 / _GIF_FPS),
        loop=0,
        optimize=True,
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
