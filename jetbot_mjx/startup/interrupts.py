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
from collections.abc import Iterator
from types import FrameType

from jetbot_mjx.interrupts import INTERRUPTED, SignalListener, tell
from jetbot_mjx.startup.switch import is_plain

_SOON = 0.05
"""[s] Time after which a lost interrupt is raised again."""

_PATIENCE = 1.5
"""[s] Time that the main thread has to return from a function of C++ after Ctrl-C."""


@contextlib.contextmanager
def exit_on_interrupt() -> Iterator[None]:
    """Let Ctrl-C end the process at once inside the context, in which a command imports modules.

    At that time nothing needs an orderly shutdown. A handler that others have set is left alone: a
    shell's background jobs ignore Ctrl-C.
    """
    in_main_thread = threading.current_thread() is threading.main_thread()
    handler = signal.getsignal(signal.SIGINT)
    if (
        is_plain()
        or not in_main_thread
        or handler not in (signal.default_int_handler, _raise_interrupt)
    ):
        yield
        return
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        yield
    finally:
        # An imported module may have set a handler of its own.
        if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
            signal.signal(signal.SIGINT, handler)


def repeat_interrupts() -> None:
    """Raise a KeyboardInterrupt again if Python has printed and ignored it."""
    if not is_plain() and sys.unraisablehook is sys.__unraisablehook__:
        sys.unraisablehook = _look_for_interrupts


def exit_if_stuck() -> None:
    """Let Ctrl-C end the process if a function of C++, such as a compiler, keeps the main thread.

    It works until the process ends. A handler that others have set is left alone.
    """
    if not is_plain() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
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


def _look_for_interrupts(lost: "sys.UnraisableHookArgs") -> None:
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
