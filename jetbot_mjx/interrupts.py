"""Receive signals in a thread while the main thread is busy in C++, and print a line about them."""

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable
from typing import Self

INTERRUPTED = 130
"""Exit code of a command that Ctrl-C has ended."""

_SECONDS_TO_TELL = 0.5
"""Time to wait for standard error [s]."""

_END = 0
"""Byte that ends a listener; no signal has this number."""


class SignalListener:
    """A `SignalListener` calls a function in a thread for every signal that has a Python handler.

    Python runs a signal handler only in the main thread and only between two of its own
    instructions, so not while a program compiles there. Therefore Python's wakeup file descriptor
    sends the signal's number through a pipe to the thread. As a context manager it restores the
    former file descriptor at the end. It may only be entered in the main thread.
    """

    def __init__(self, receive: Callable[[int], None]) -> None:
        """Prepare to listen.

        Args:
          receive: the function that receives the number of each signal.
        """
        self._receive = receive

    def __enter__(self) -> Self:
        """Begin to listen."""
        self._reader, self._writer = os.pipe()
        # On Windows, Python 3.11 cannot do this, and does not need it.
        if hasattr(os, "set_blocking"):
            os.set_blocking(self._writer, False)
        self._former_fd = signal.set_wakeup_fd(self._writer, warn_on_full_buffer=False)
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        """Stop listening."""
        signal.set_wakeup_fd(self._former_fd)
        os.write(self._writer, bytes([_END]))
        self._thread.join()
        os.close(self._reader)
        os.close(self._writer)

    def _listen(self) -> None:
        while (number := os.read(self._reader, 1)[0]) != _END:
            self._receive(number)


def tell(text: str) -> None:
    """Print a line on standard error, but do not wait long for it.

    What must happen after a signal happens even if standard error cannot be written or its reader
    has stopped reading.
    """

    def write() -> None:
        with contextlib.suppress(OSError, ValueError):
            print(text, file=sys.stderr, flush=True)

    thread = threading.Thread(target=write, daemon=True)
    thread.start()
    thread.join(_SECONDS_TO_TELL)
