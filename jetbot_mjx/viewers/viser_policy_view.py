"""Show what a policy sees, and what it looks at, in the panel of a player's page."""

import time

import numpy as np
import viser
from jaxtyping import UInt8

from jetbot_mjx.evaluation import overlay_heat
from jetbot_mjx.viewers.player import Player
from jetbot_mjx.viewers.policy_view import resize_nearest
from jetbot_mjx.viewers.realtime import Clock

_SIDE, _SIDE_OF_TWO = 200, 140  # [pixels] longer side of one image, and of two side by side
_GAP = 8  # [pixels] between the two
_IMAGES_PER_SECOND, _MAPS_PER_SECOND = 15, 4
_LEAST_HEAT = 0.5  # change of the action that is drawn in yellow, if none is larger

_SEES = "What the policy sees"
_LOOKS = "What it sees, and what it looks at (the action changes by up to {:.2f})"


class PolicyView:
    """A `PolicyView` shows the chosen robot's image and, if switched on, its occlusion map."""

    def __init__(self, gui: viser.GuiApi, player: Player) -> None:
        """Add the image and the checkbox to the panel.

        Args:
          gui: the controls of the page.
          player: a player whose policy sees.
        """
        self._player = player
        now = time.monotonic()
        self._image_clock = Clock(1 / _IMAGES_PER_SECOND, now)
        self._map_clock = Clock(1 / _MAPS_PER_SECOND, now)
        self._map: UInt8[np.ndarray, "height width 3"] | None = None
        image = resize_nearest(player.image(), _SIDE)
        self.image = gui.add_image(image, label=_SEES, format="png")
        self.looks = gui.add_checkbox("What it looks at", False)

    def update(self) -> None:
        """Show the present image and map, each a few times a second; call it at any rate."""
        now = time.monotonic()
        if self._image_clock.due(now):
            self._show(redraw=bool(self._map_clock.due(now)))

    def _show(self, redraw: bool) -> None:
        """Send the image, beside the map if that is switched on.

        Args:
          redraw: whether to compute the map again.
        """
        image = self._player.image()
        if not self.looks.value:
            self._map = None
            self.image.image = resize_nearest(image, _SIDE)
            self._set_label(_SEES)
            return
        if redraw or self._map is None:
            heat = self._player.occlusion_map()
            largest = float(heat.max())
            overlay = overlay_heat(image, heat, max(largest, _LEAST_HEAT))
            self._map = resize_nearest(overlay, _SIDE_OF_TWO)
            self._set_label(_LOOKS.format(largest))
        self.image.image = _side_by_side(resize_nearest(image, _SIDE_OF_TWO), self._map)

    def _set_label(self, label: str) -> None:
        # Do not assign equal values: the page would rebuild the control.
        if label != self.image.label:
            self.image.label = label


def _side_by_side(
    left: UInt8[np.ndarray, "h w 3"], right: UInt8[np.ndarray, "h w 3"]
) -> UInt8[np.ndarray, "h both 4"]:
    """Return two images with a transparent gap between them."""
    opaque = [np.pad(one, ((0, 0), (0, 0), (0, 1)), constant_values=255) for one in (left, right)]
    gap = np.zeros((len(left), _GAP, 4), np.uint8)
    return np.hstack([opaque[0], gap, opaque[1]])
