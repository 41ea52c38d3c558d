"""Stop a training on request: on SIGTERM from a scheduler, and on Ctrl-C from the user.

After the first signal the training finishes its current call, saves and ends. In a command, which
uses `Preemption`, the process exits at once if that takes longer than the configured notice, or at
a second signal. The earlier checkpoints stay complete, because a checkpoint gets its name only when
it is complete. A program that imports the package uses `DeferredSignals`: its process never exits
here.
"""

import os
import signal
import sys
import threading
import time
from types import FrameType
from typing import Self

STOPPED = 75
"""Exit code of a training that was stopped on request and can be resumed (`EX_TEMPFAIL`)."""

_SIGNALS = (signal.SIGTERM, signal.SIGINT)
_SHARE_OF_NOTICE = 0.8
"""Share of the notice after which the process exits without saving."""
_END = 0
"""Byte that ends the listener; no signal has this number."""


class StopRequest:
    """A `StopRequest` says whether a training was asked to stop; this base class is never asked."""

    def __init__(self, notice: float) -> None:
        """Prepare to be asked.

        Args:
          notice: time after the request at which the training should have ended [s].
        """
        self.notice = notice
        self._requested = threading.Event()

    @property
    def requested(self) -> bool:
        """Return whether the training was asked to stop."""
        return self._requested.is_set()

    def wait(self, seconds: float) -> bool:
        """Wait for a request for some seconds, and return whether there is one."""
        return self._requested.wait(seconds)

    def __enter__(self) -> Self:
        """Return the object itself."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Do nothing."""


class DeferredSignals(StopRequest):
    """A `DeferredSignals` holds the first signal back until the training has saved.

    At the first SIGINT or SIGTERM it asks the training to stop and restores the program's own
    handlers, which receive every further signal. When the context ends they receive the first one,
    too: Ctrl-C raises a KeyboardInterrupt, as in any other Python code.
    """

    def __enter__(self) -> Self:
        """Begin to listen; do nothing outside the main thread, where Python allows no handlers."""
        self._former, self._deferred = {}, None
        if threading.current_thread() is threading.main_thread():
            for number in _SIGNALS:
                # Leave an ignored signal ignored, and a handler that is not Python's in its place.
                if signal.getsignal(number) not in (signal.SIG_IGN, None):
                    self._former[number] = signal.signal(number, self._defer)
        return self

    def __exit__(self, *exception: object) -> None:
        """Restore the handlers, and send the program the signal that was held back."""
        self._restore()
        # If a second Ctrl-C has ended the training, the program has learnt of it.
        if self._deferred is not None and not isinstance(exception[1], KeyboardInterrupt):
            signal.raise_signal(self._deferred)

    def _defer(self, number: int, frame: FrameType | None) -> None:
        self._deferred = number
        self._restore()
        self._requested.set()

    def _restore(self) -> None:
        for number, handler in self._former.items():
            signal.signal(number, handler)
        self._former = {}


class Preemption(StopRequest):
    """A `Preemption` listens for signals; as a context manager it restores the former handlers.

    Python runs a signal handler only between two of its own instructions, so not while a program
    compiles. Therefore Python's wakeup file descriptor sends the signal's number through a pipe to
    a thread, which also limits the time.
    """

    def __init__(self, notice: float) -> None:
        """Prepare to listen.

        Args:
          notice: time after a signal at which the process must have ended [s].
        """
        super().__init__(notice)
        self._timer: threading.Timer | None = None
        self._listener: threading.Thread | None = None

    def __enter__(self) -> Self:
        """Begin to listen; do nothing outside the main thread, where Python allows no handlers."""
        self._former = {}
        if threading.current_thread() is not threading.main_thread():
            return self
        self._reader, self._writer = os.pipe()
        # On Windows, Python 3.11 cannot do this, and does not need it.
        if hasattr(os, "set_blocking"):
            os.set_blocking(self._writer, False)
        self._former_fd = signal.set_wakeup_fd(self._writer, warn_on_full_buffer=False)
        for number in _SIGNALS:
            # A shell makes its background jobs ignore Ctrl-C; keep it so.
            if signal.getsignal(number) is not signal.SIG_IGN:
                self._former[number] = signal.signal(number, _ignore)
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()
        return self

    def __exit__(self, *exception: object) -> None:
        """Stop listening and restore the former handlers."""
        if self._listener is None:
            return
        for number, handler in self._former.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(self._former_fd)
        os.write(self._writer, bytes([_END]))
        self._listener.join()
        os.close(self._reader)
        os.close(self._writer)
        if self._timer is not None:
            self._timer.cancel()

    def _listen(self) -> None:
        """Read the numbers of the signals that arrive, until `_END`."""
        began = 0.0
        while (number := os.read(self._reader, 1)[0]) != _END:
            # The wakeup file descriptor receives every signal that has a Python handler.
            if number not in _SIGNALS:
                continue
            name = signal.Signals(number).name
            if not self._requested.is_set():
                began = time.monotonic()
                self._requested.set()
                limit = min(_SHARE_OF_NOTICE * self.notice, threading.TIMEOUT_MAX)
                self._timer = threading.Timer(
                    limit, _exit_without_saving, [f"{limit:.0f} s after {name}"]
                )
                self._timer.daemon = True
                self._timer.start()
                print(
                    f"\n{name}: finishing this step and saving (once more to leave without saving)",
                    file=sys.stderr,
                    flush=True,
                )
            # Ignore a repetition: schedulers and terminals also signal the whole process group.
            elif time.monotonic() - began > 0.5:
                _exit_without_saving(f"second {name}")


def _exit_without_saving(reason: str) -> None:
    """End this process at once, whatever its threads do."""
    print(
        f"{reason}: leaving without another save; the last complete checkpoint is intact",
        file=sys.stderr,
        flush=True,
    )
    os._exit(STOPPED)


def _ignore(number: int, frame: FrameType | None) -> None:
    """Do nothing, because the thread has received the signal through the pipe."""
