"""Find out which parts of its camera's image a policy looks at.

A square covers one part of the image after the other, and the policy acts on each of these images.
Where a covered part changes the action, the policy looks at it. The square has the image's median
colour, a grey between sky and floor: one that stands out is itself a thing to drive to.

Source: M. D. Zeiler and R. Fergus, Visualizing and understanding convolutional networks, ECCV 2014.
"""

from collections.abc import Mapping

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt8

from jetbot_mjx.agents import Policy
from jetbot_mjx.envs import PIXELS
from jetbot_mjx.errors import InvalidError

_GREY = (0.299, 0.587, 0.114)  # weights of red, green and blue; source: ITU-R BT.601
_DIMMED = 0.6  # brightness of the image below a heat map
_HOT = np.array([[255, 60, 0], [255, 235, 60]])  # colours of half and of full heat

_SQUARES = 8  # squares side by side on the shorter side of an image, by default


def occlusion_map(
    policy: Policy,
    obs: Mapping[str, Array | np.ndarray],
    *,
    side: int | None = None,
    stride: int | None = None,
) -> Float[Array, "h w"]:
    """Return how far the action changes if a square of the median colour covers a pixel.

    A pixel has the mean of ‖a' - a‖₂ over the squares that cover it, where a is the action for the
    image and a' the action for the image with the square. Stacked images are covered all at once,
    and the numbers beside the image stay.

    Args:
      policy: a policy, which sees all squares as one batch; `jax.jit` may compile it all.
      obs: the observation of one robot: `pixels/front`, uint8 of shape (h, w, c), and any numbers.
      side: the side of the square [pixels]; None: an eighth of the image's shorter side.
      stride: the distance between neighbouring squares [pixels]; None: half of `side`.

    Returns:
      The changes, in the unit of an action: 0 for no change, at most √8 between opposite corners of
      [-1, 1]².

    Raises:
      InvalidError: the observation has no image, or no square of that side and stride covers it.
    """
    if not isinstance(obs, Mapping) or PIXELS not in obs:
        raise InvalidError(f"observation: it has no {PIXELS}, so nothing of it can be covered")
    image: UInt8[Array, "h w c"] = jnp.asarray(obs[PIXELS])
    height, width, _ = image.shape
    side = max(1, min(height, width) // _SQUARES) if side is None else side
    stride = max(1, side // 2) if stride is None else stride
    if not 1 <= stride <= side <= min(height, width):
        raise InvalidError(
            f"side = {side}, stride = {stride}: a square should fit into the image of"
            f" {height} x {width} pixels, and a stride should be from 1 to the side"
        )
    rows, columns = _covered(height, side, stride), _covered(width, side, stride)
    # Cover nothing first, then one part after the other, and let the policy act on all of them.
    squares = (rows[:, None, :, None] & columns[None, :, None, :]).reshape(-1, height, width, 1)
    squares = np.concatenate([np.zeros_like(squares[:1]), squares])
    colour = jnp.median(image, axis=(0, 1)).astype(jnp.uint8)
    images = jnp.where(squares, colour, image)
    copies = {
        name: jnp.broadcast_to(part, (len(squares), *jnp.shape(part))) for name, part in obs.items()
    }
    actions = policy({**copies, PIXELS: images})
    changes = jnp.linalg.norm(actions[1:] - actions[0], axis=-1)
    # Average over the squares that cover a pixel.
    total = rows.T.astype(np.float32) @ changes.reshape(len(rows), len(columns)) @ columns
    return total / np.outer(rows.sum(axis=0), columns.sum(axis=0))


def overlay_heat(
    image: UInt8[np.ndarray, "h w c"], heat: Float[np.ndarray, "h w"], largest: float
) -> UInt8[np.ndarray, "h w 3"]:
    """Return an image in grey below a heat map, from clear over red to yellow.

    Args:
      image: the image, in RGB or of one channel of grey.
      heat: the heat of each pixel, from 0 on.
      largest: the heat that is drawn in yellow.
    """
    grey = image @ np.array(_GREY) if image.shape[2] == 3 else image[..., 0]
    share = np.clip(heat / max(largest, 1e-9), 0.0, 1.0)[..., None]
    red, yellow = _HOT
    colour = red + (yellow - red) * np.clip(2 * share - 1, 0.0, 1.0)
    opacity = np.clip(2 * share, 0.0, 1.0)
    return np.round((1 - opacity) * _DIMMED * grey[..., None] + opacity * colour).astype(np.uint8)


def _covered(length: int, side: int, stride: int) -> Bool[np.ndarray, "squares length"]:
    """Return the pixels along an axis that each square covers; the last square ends the axis."""
    first = np.unique([*range(0, length - side, stride), length - side])
    pixels = np.arange(length)
    return (pixels >= first[:, None]) & (pixels < first[:, None] + side)
