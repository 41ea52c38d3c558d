"""Handle Ctrl-C while a command imports and while it runs, without tracebacks or lost signals.

Python raises an exception for Ctrl-C wherever the interpreter happens to be. During imports this
prints a traceback, or a library catches the exception and continues. In a callback, for example of
garbage collection, it is printed and then ignored. A training handles it in `preemption`.
"""

import _thread
import contextlib
import signal
import sys
import threading
from collections.abc import Iterator
from typing import Any

_SOON = 0.05
"""[s] Time after which a lost interrupt is raised again."""


@contextlib.contextmanager
def exit_on_interrupt() -> Iterator[None]:
    """Let Ctrl-C end the process at once inside the context, in which a command imports modules.

    At that time nothing needs an orderly shutdown. A handler that others have set is left alone: a
    shell's background jobs ignore Ctrl-C.
    """
    in_main_thread = threading.current_thread() is threading.main_thread()
    if not in_main_thread or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        yield
    finally:
        # An imported module may have set a handler of its own.
        if signal.getsignal(signal.SIGINT) is signal.SIG_DFL:
            signal.signal(signal.SIGINT, signal.default_int_handler)


def repeat_lost_interrupts() -> None:
    """Raise a KeyboardInterrupt again if Python has printed and ignored it."""
    if sys.unraisablehook is sys.__unraisablehook__:
        sys.unraisablehook = _look_for_interrupts


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
