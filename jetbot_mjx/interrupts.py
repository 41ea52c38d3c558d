"""Handle Ctrl-C while a command imports and while it runs, without tracebacks or lost signals.

Python raises an exception for Ctrl-C wherever the interpreter happens to be. During imports this
prints a traceback, or a library catches the exception and continues. In a callback, for example of
garbage collection, it is printed and then ignored. While a program compiles, it is raised only at
the end of the compilation. A training handles Ctrl-C in `preemption`.
"""

import _thread
import contextlib
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any, Self

INTERRUPTED = 130
"""Exit code of a command that Ctrl-C has ended."""

_SOON = 0.05
"""[s] Time after which a lost interrupt is raised again."""

_PATIENCE = 1.5
"""[s] Time that the main thread has to return from a function of C++ after Ctrl-C."""

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
    thread.join(_SOON * 10)


@contextlib.contextmanager
def exit_on_interrupt() -> Iterator[None]:
    """Let Ctrl-C end the process at once inside the context, in which a command imports modules.

    At that time nothing needs an orderly shutdown. A handler that others have set is left alone: a
    shell's background jobs ignore Ctrl-C.
    """
    in_main_thread = threading.current_thread() is threading.main_thread()
    handler = signal.getsignal(signal.SIGINT)
    if not in_main_thread or handler not in (signal.default_int_handler, _raise_interrupt):
        yield
        return
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        yield
    finally:
        # An imported module may have set a handler of its own.
        if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
            signal.signal(signal.SIGINT, handler)


def repeat_lost_interrupts() -> None:
    """Raise a KeyboardInterrupt again if Python has printed and ignored it."""
    if sys.unraisablehook is sys.__unraisablehook__:
        sys.unraisablehook = _look_for_interrupts


def exit_if_interrupt_waits() -> None:
    """Let Ctrl-C end the process if a function of C++, such as a compiler, keeps the main thread.

    It works until the process ends. A handler that others have set is left alone.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _raise_interrupt)
        SignalListener(_expect_interrupt).__enter__()


_raised = threading.Event()
"""Set as soon as the main thread has raised one: then the command ends, in its own time."""


def _raise_interrupt(number: int, frame: FrameType | None) -> None:
    _raised.set()
    signal.default_int_handler(number, frame)


def _expect_interrupt(number: int) -> None:
    """Exit if the main thread does not raise the exception of this signal soon."""
    if number != signal.SIGINT or signal.getsignal(signal.SIGINT) is not _raise_interrupt:
        return
    if not _raised.wait(_PATIENCE):
        tell("interrupted")
        os._exit(INTERRUPTED)


def _look_for_interrupts(lost: Any) -> None:
    if lost.exc_type is not KeyboardInterrupt:
        sys.__unraisablehook__(lost)
        return
    # Raise it later, because it would be lost here too.
    timer = threading.Timer(_SOON, _interrupt)
    timer.daemon = True
    timer.start()


def _interrupt() -> None:
    if hasattr(signal, "pthread_kill"):
        # This also wakes the main thread if it sleeps.
        main = threading.main_thread().ident
        assert main is not None
        signal.pthread_kill(main, signal.SIGINT)
    else:
        _thread.interrupt_main()
