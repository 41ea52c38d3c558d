"""Being asked to stop: SIGTERM from a scheduler, Ctrl-C from a person.

The first signal asks the training to finish what it is at, save and go. If that takes too long
for the notice given, or a second signal comes, the process leaves at once: what was saved
stays whole, because checkpoints appear under their name only when they are complete.
"""

import os
import signal
import sys
import threading
import time
from types import FrameType
from typing import Self

STOPPED = 75
"""Exit code: stopped on request before the end; the same command goes on (`EX_TEMPFAIL`)."""

_SIGNALS = (signal.SIGTERM, signal.SIGINT)
_SHARE_OF_NOTICE = 0.8
_END = 0
"""Through the pipe, where no signal has this number: nothing more will come."""


class Preemption:
    """Listens for the signals; a context manager that puts the former handlers back.

    Python runs a handler only between two of its own instructions, which a compiler's minute
    is not: so the signal's number goes through a pipe to a thread, which keeps the clock.
    """

    def __init__(self, notice: float) -> None:
        """Prepare to listen.

        Args:
          notice: how long after a signal the process may still be there [s].
        """
        self._notice = notice
        self._requested = threading.Event()
        self._clock: threading.Timer | None = None
        self._listener: threading.Thread | None = None

    @property
    def requested(self) -> bool:
        """Return whether a signal has come."""
        return self._requested.is_set()

    def wait(self, seconds: float) -> bool:
        """Wait for a signal, and tells whether one has come."""
        return self._requested.wait(seconds)

    def __enter__(self) -> Self:
        """Begin to listen; does nothing outside the main thread, where Python allows none."""
        self._former = {}
        if threading.current_thread() is not threading.main_thread():
            return self
        self._reader, self._writer = os.pipe()
        os.set_blocking(self._writer, False)
        self._former_fd = signal.set_wakeup_fd(self._writer, warn_on_full_buffer=False)
        for number in _SIGNALS:
            # A shell lets its background jobs ignore Ctrl-C: so do they here.
            if signal.getsignal(number) is not signal.SIG_IGN:
                self._former[number] = signal.signal(number, _do_nothing)
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()
        return self

    def __exit__(self, *exception: object) -> None:
        """Stop listening and puts the former handlers back."""
        if self._listener is None:
            return
        for number, handler in self._former.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(self._former_fd)
        os.write(self._writer, bytes([_END]))
        self._listener.join()
        os.close(self._reader)
        os.close(self._writer)
        if self._clock is not None:
            self._clock.cancel()

    def _listen(self) -> None:
        """Read the numbers of the signals that come, until the end is told."""
        began = 0.0
        while (number := os.read(self._reader, 1)[0]) != _END:
            # Python tells of every signal that has a handler, whoever set it.
            if number not in _SIGNALS:
                continue
            name = signal.Signals(number).name
            if not self._requested.is_set():
                began = time.monotonic()
                self._requested.set()
                limit = min(_SHARE_OF_NOTICE * self._notice, threading.TIMEOUT_MAX)
                self._clock = threading.Timer(limit, _leave, [f"{limit:.0f} s after {name}"])
                self._clock.daemon = True
                self._clock.start()
                print(
                    f"\n{name}: finishing this step and saving (once more to leave without saving)",
                    file=sys.stderr,
                    flush=True,
                )
            # Schedulers and terminals may send the same signal to a whole group, twice over.
            elif time.monotonic() - began > 0.5:
                _leave(f"second {name}")


def _leave(reason: str) -> None:
    print(
        f"{reason}: leaving without another save; the last complete checkpoint holds",
        file=sys.stderr,
        flush=True,
    )
    os._exit(STOPPED)


def _do_nothing(number: int, frame: FrameType | None) -> None:
    """Do nothing: the pipe has told the thread already."""
