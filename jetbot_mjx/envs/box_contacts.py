"""Let a box touch the floor with each corner below it, as in C MuJoCo.

MJX keeps the corners within 1 mm of the deepest. A chassis that tips onto its front edge then
stands on one corner where C MuJoCo has two, and turns otherwise.
"""

import contextlib
import threading
from collections.abc import Iterator
from unittest import mock

from jaxtyping import Array

from jetbot_mjx.envs.mjx import Data, GeomType, Model, collision_driver

_PAIR = (GeomType.PLANE, GeomType.BOX)
_collide = collision_driver._COLLISION_FUNC[_PAIR]
_SCALE = 2.0**-10
"""A power of two, by which float32 multiplies without an error."""
_lock = threading.RLock()


class _Thread(threading.local):
    """Hold what is true for the present thread alone: others may trace MJX meanwhile."""

    in_context = False


_thread = _Thread()


@contextlib.contextmanager
def every_corner() -> Iterator[None]:
    """Replace MJX's collision of plane and box by this module's, for the present thread."""
    # One thread at a time: otherwise a second thread would restore the first one's replacement.
    with (
        _lock,
        mock.patch.dict(collision_driver._COLLISION_FUNC, {_PAIR: _plane_box}),
        mock.patch.object(_thread, "in_context", True),
    ):
        yield


def _plane_box(
    m: Model, d: Data, key: collision_driver.FunctionKey, geom: Array
) -> tuple[Array, Array, Array]:
    """Return distances, positions and frames of the contacts of planes and boxes.

    MJX's own function sees a scene a thousand times smaller, in which its 1 mm are 1 m.

    Args:
      m: the model.
      d: the simulation data.
      key: the types of the geoms.
      geom: the pairs' geoms.
    """
    if not _thread.in_context:
        return _collide(m, d, key, geom)
    small_model = m.replace(geom_size=m.geom_size * _SCALE)
    small_data = d.replace(geom_xpos=d.geom_xpos * _SCALE)
    dist, pos, frame = _collide(small_model, small_data, key, geom)
    return dist / _SCALE, pos / _SCALE, frame


_plane_box.ncon = _collide.ncon  # type: ignore[attr-defined]
