"""Draw what a policy sees and which parts of it the policy looks at."""

import numpy as np
from jaxtyping import Float, UInt8

_GREY = (0.299, 0.587, 0.114)  # weights of red, green and blue; source: ITU-R BT.601
_DIMMED = 0.6  # brightness of the image below a heat map
_HOT = np.array([[255, 60, 0], [255, 235, 60]])  # colours of half and of full heat


def resize_nearest(
    image: UInt8[np.ndarray, "h w c"], side: int
) -> UInt8[np.ndarray, "height width 3"]:
    """Return an image in RGB in another size, without smoothing.

    Pixels become squares; of an image that is much too large, every n-th pixel stays.

    Args:
      image: the image, in RGB or of one channel of grey.
      side: the longer side of the result, up to the rounding to whole squares [pixels].
    """
    longer = max(image.shape[:2])
    every, factor = (max(1, round(ratio)) for ratio in (longer / side, side / longer))
    image = image[::every, ::every]
    rgb = np.broadcast_to(image, (*image.shape[:2], 3))
    return rgb.repeat(factor, axis=0).repeat(factor, axis=1)


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
