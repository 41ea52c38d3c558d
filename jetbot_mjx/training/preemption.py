"""Stop a training on request: on SIGTERM from a scheduler, and on Ctrl-C from the user.

After the first signal the training finishes its current call, saves and ends. In a command, which
uses `Preemption`, the process exits at once if that takes longer than the configured notice, or at
a second signal. The earlier checkpoints stay complete, because a checkpoint gets its name only when
it is complete. A program that imports the package uses `DeferredSignals`: its process never exits
here.

A training that still compiles has nothing to save, so its command does not wait for the compiler.
"""

import contextlib
import os
import signal
import threading
import time
from collections.abc import Callable
from types import FrameType
from typing import Self

from jetbot_mjx.interrupts import SignalListener, tell

STOPPED = 75
"""Exit code of a training that was stopped on request and can be resumed (`EX_TEMPFAIL`)."""

# A terminal that is closed sends SIGHUP, which Windows does not have.
_SIGNALS = (signal.SIGTERM, signal.SIGINT, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else []))
_Handler = Callable[[int, FrameType | None], object] | int | None
"""A handler of a signal, as the module `signal` returns it."""

_SHARE_OF_NOTICE = 0.8
"""Share of the notice after which the process exits without saving."""
_COMPILING_SECONDS = 1.0
"""Time after which the process exits while the training compiles [s]."""


_WITHOUT_SAVING = "leaving without another save; the last complete checkpoint is intact"


class StopRequest(contextlib.AbstractContextManager["StopRequest"]):
    """A `StopRequest` says whether a training was asked to stop; this base class never was."""

    def __init__(self, notice: float) -> None:
        """Prepare to be asked.

        Args:
          notice: time after the request at which the training should have ended [s].
        """
        self.notice = notice
        self._requested = threading.Event()
        self.compiling: Callable[[], None] | None = None
        """While the training compiles, and there is nothing to save yet: a function that prints the
        last message of a process that ends meanwhile. None: the training saves when it is asked to
        stop."""
        self._former: dict[int, _Handler] = {}

    @property
    def requested(self) -> bool:
        """Return whether the training was asked to stop."""
        return self._requested.is_set()

    def wait(self, seconds: float) -> bool:
        """Wait for a request for some seconds, and return whether there is one."""
        return self._requested.wait(seconds)

    def __exit__(self, *exception: object) -> None:
        """Restore the former handlers."""
        self._restore()

    def _handle(self, handler: Callable[[int, FrameType | None], None]) -> None:
        """Handle the signals from now on; do nothing outside the main thread, as Python does."""
        if threading.current_thread() is threading.main_thread():
            for number in _SIGNALS:
                # A shell makes its background jobs ignore Ctrl-C; keep it so. None: not Python's.
                if signal.getsignal(number) not in (signal.SIG_IGN, None):
                    self._former[number] = signal.signal(number, handler)

    def _restore(self) -> None:
        for number, handler in self._former.items():
            signal.signal(number, handler)
        self._former = {}


class DeferredSignals(StopRequest):
    """A `DeferredSignals` holds the first signal back until the training has saved.

    At the first SIGINT or SIGTERM it asks the training to stop and restores the program's own
    handlers, which receive every further signal. When the context ends they receive the first one,
    too: Ctrl-C raises a KeyboardInterrupt, as in any other Python code.
    """

    def __enter__(self) -> Self:
        """Begin to listen."""
        self._deferred: int | None = None
        self._handle(self._defer)
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


class Preemption(StopRequest):
    """A `Preemption` listens for signals; as a context manager it restores the former handlers."""

    def __init__(self, notice: float) -> None:
        """Prepare to listen.

        Args:
          notice: time after a signal at which the process must have ended [s].
        """
        super().__init__(notice)
        self._began = 0.0
        self._timer: threading.Timer | None = None
        self._listener: SignalListener | None = None

    def __enter__(self) -> Self:
        """Begin to listen; do nothing outside the main thread, which alone may do so."""
        if threading.current_thread() is threading.main_thread():
            self._listener = SignalListener(self._receive).__enter__()
        self._handle(_ignore)
        return self

    def __exit__(self, *exception: object) -> None:
        """Stop listening and restore the former handlers."""
        self._restore()
        if self._listener is not None:
            self._listener.__exit__(*exception)
        if self._timer is not None:
            self._timer.cancel()

    def _receive(self, number: int) -> None:
        """Handle a signal."""
        # The wakeup file descriptor receives every signal that has a Python handler.
        if number not in _SIGNALS:
            return
        name = signal.Signals(number).name
        compiling = self.compiling
        if not self._requested.is_set():
            self._began = time.monotonic()
            self._requested.set()
            limit = min(_SHARE_OF_NOTICE * self.notice, threading.TIMEOUT_MAX)
            if compiling:
                limit = min(limit, _COMPILING_SECONDS)
            say = compiling or (lambda: tell(f"{limit:.0f} s after {name}: {_WITHOUT_SAVING}"))
            self._timer = threading.Timer(limit, _exit, [say])
            self._timer.daemon = True
            self._timer.start()
            saving = "finishing this step and saving (once more to leave without saving)"
            tell(f"\n{name}: {'ending' if compiling else saving}")
        # Ignore a repetition: schedulers and terminals also signal the whole process group.
        elif time.monotonic() - self._began > 0.5:
            _exit(compiling or (lambda: tell(f"second {name}: {_WITHOUT_SAVING}")))


def _exit(say: Callable[[], None]) -> None:
    """End this process at once, whatever its threads do and whoever reads its output."""
    try:
        say()
    finally:
        os._exit(STOPPED)


def _ignore(number: int, frame: FrameType | None) -> None:
    """Do nothing, because the thread has received the signal through the pipe."""
