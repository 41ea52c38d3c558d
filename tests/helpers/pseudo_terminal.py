"""A terminal whose contents a test can read."""

import os
import threading
import time

PATIENCE = 60


class Screen:
    """A terminal as a pseudo-terminal: what is written to `stream` is in `text`."""

    def __init__(self):
        self._master, slave = os.openpty()
        self.stream = os.fdopen(slave, "w", encoding="utf-8", newline="")
        self._data = b""
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self):
        while True:
            try:
                self._data += os.read(self._master, 4096)
            except OSError:
                return

    @property
    def text(self):
        return self._data.decode("utf-8", "replace")

    def until(self, text):
        deadline = time.monotonic() + PATIENCE
        while text not in self.text:
            assert time.monotonic() < deadline, self.text
            time.sleep(0.01)

    def close(self):
        self.stream.close()
        self._thread.join()
        os.close(self._master)
