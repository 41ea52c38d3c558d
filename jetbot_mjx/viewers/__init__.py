"""Show a policy: as a video, on a page in the browser, in MuJoCo's window."""

from typing import TYPE_CHECKING

from jetbot_mjx.imports import load_lazily

if TYPE_CHECKING:
    from jetbot_mjx.viewers.player import Player as Player

__getattr__, __dir__ = load_lazily(
    __name__,
    {
        "Player": "player",
    },
)
