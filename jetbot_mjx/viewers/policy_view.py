"""Make what a policy sees large enough for a video or a page."""

import numpy as np
from jaxtyping import UInt8


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
