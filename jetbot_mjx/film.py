"""Films of episodes, and the files they go into."""

from collections.abc import Sequence
from pathlib import Path

import imageio.v3 as iio
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

from jetbot_mjx.env import JetBotEnv
from jetbot_mjx.offscreen import Renderer
from jetbot_mjx.rollout import Episodes

VIEW = 400
"""Side of one view [pixels]."""

FPS = 30
"""Frames a second; robots drive in real time."""

_HOLD_SECONDS = 0.4  # after the end, so that the eye sees it

Frame = UInt8[np.ndarray, "height width 3"]


def film_episode(renderer: Renderer, env: JetBotEnv, episodes: Episodes, index: int) -> list[Frame]:
    """One episode in real time: the chase camera beside the view from above.

    Args:
      renderer: of the environment's model, `VIEW` pixels wide and high.
      env: that the episodes were driven in.
      episodes: recorded.
      index: of the episode.

    Returns:
      Frames, `FPS` of them a second.
    """
    assert episodes.qpos is not None
    goal = jax.tree.map(lambda leaf: jnp.asarray(leaf[index]), episodes.goal)
    markers = env.task.markers(goal)
    steps = int(episodes.steps[index])
    stride = 1.0 / (FPS * env.dt)
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
    return film + [film[-1]] * round(_HOLD_SECONDS * FPS)


def _labelled(frame: Frame, text: str) -> Frame:
    image = Image.fromarray(frame)
    draw = ImageDraw.Draw(image)
    draw.text((14, 12), text, fill="black", font=ImageFont.load_default(20))
    return np.asarray(image)


def _half(frame: Frame) -> Frame:
    image = Image.fromarray(frame)
    return np.asarray(image.resize((image.width // 2, image.height // 2), Image.Resampling.BOX))


def write_mp4(path: Path, frames: Sequence[Frame]) -> None:
    """Writes a film that every browser and notebook plays."""
    iio.imwrite(path, np.stack(frames), fps=FPS, plugin="pyav", codec="libx264")


def write_gif(path: Path, frames: Sequence[Frame]) -> None:
    """Writes every second frame at half the size, in one palette."""
    # One palette for all frames: a palette each flickers.
    images = [Image.fromarray(_half(frame)) for frame in frames[::2]]
    sample = Image.fromarray(
        np.vstack([np.asarray(i) for i in images[:: max(1, len(images) // 8)]])
    )
    palette = sample.quantize(256)
    reduced = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    reduced[0].save(
        path,
        save_all=True,
        append_images=reduced[1:],
        duration=round(2000 / FPS),
        loop=0,
        optimize=True,
    )
