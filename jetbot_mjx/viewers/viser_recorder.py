"""Record what one client of the page sees, as a video that its browser downloads.

The page draws the frames, so this machine needs no OpenGL.
"""

import threading
import time
from collections.abc import Iterator

import numpy as np
import viser

from jetbot_mjx.viewers.video import Frame, encode_mp4

MOST_SECONDS = 20.0
"""Longest duration of a clip [s]."""

_FPS = 15
_MOST_HEIGHT = 720  # [pixels]
_PATIENCE = 10.0  # [s] for one frame
_LABELS = "Record a clip", "Stop and save the clip"
_FILE = "jetbot.mp4"


class Recorder:
    """A `Recorder` is a button that starts a recording, and ends it when it is clicked again.

    All clients share the button, so there is one recording at a time. viser calls `toggle` in a
    thread of its own, and the player goes on meanwhile.
    """

    def __init__(self, gui: viser.GuiApi) -> None:
        """Add the button.

        Args:
          gui: the panel of the page.
        """
        self.button = gui.add_button(_LABELS[0])
        self.button.on_click(lambda event: self.toggle(event.client))
        self._recording, self._ended = threading.Lock(), threading.Event()

    def toggle(self, client: viser.ClientHandle | None) -> None:
        """End the recording; if there is none, record what a client sees, and send it the file.

        Args:
          client: the client that clicked; None: it has left.
        """
        if not self._recording.acquire(blocking=False):
            self._ended.set()
            return
        try:
            self._ended.clear()
            self.button.label = _LABELS[1]
            if client is not None:
                mp4 = encode_mp4(self._frames(client), _FPS)
                client.send_file_download(_FILE, mp4, save_immediately=True)
        except RuntimeError:
            pass  # The client has left, and with it the one who wanted the clip.
        except (TimeoutError, OSError, ValueError) as error:
            # A page that does not answer, or sends what is not a picture.
            assert client is not None
            client.add_notification("No clip", f"The page sent no picture: {error}", color="red")
        finally:
            self.button.label = _LABELS[0]
            self._recording.release()

    def _frames(self, client: viser.ClientHandle) -> Iterator[Frame]:
        """Yield frames until the recording ends; a page that is slow shows each for longer.

        Raises:
          RuntimeError: the client has left.
          TimeoutError: the page does not answer.
          ValueError: it sent something else than was asked for.
        """
        height, width = _frame_size(client.camera.image_height, client.camera.image_width)
        began, told = time.monotonic(), 0
        while not self._ended.is_set():
            picture = client.get_render(height, width, timeout=_PATIENCE)
            if picture.shape != (height, width, 3):
                raise ValueError(f"its shape is {picture.shape}")
            elapsed = time.monotonic() - began
            due = max(told + 1, round(elapsed * _FPS))
            for _ in range(told, due):
                yield np.asarray(picture, np.uint8)
            told = due
            if elapsed > MOST_SECONDS:
                return
            # Do not ask faster than the video shows.
            self._ended.wait(began + told / _FPS - time.monotonic())


def _frame_size(height: int, width: int) -> tuple[int, int]:
    """Return the height and width of a clip: those of the page, or smaller, and even for H.264."""
    scale = min(1.0, _MOST_HEIGHT / max(height, 1))
    return max(2, int(height * scale) // 2 * 2), max(2, int(width * scale) // 2 * 2)
