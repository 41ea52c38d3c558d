"""Ctrl-C from the first import of a command to its end: quiet, and never lost.

Python makes an exception of it, wherever the interpreter happens to be. While modules load that is
a traceback, or the exception ends in a library that catches others and goes on; in a callback, of
garbage collection for one, it is printed and forgotten. A training has its own way: `preemption`.
"""

import _thread
import signal
import sys
import threading
from typing import Any

_SOON = 0.05
"""[s] after which an interrupt that was lost comes again."""


def leave_at_once() -> None:
    """Let Ctrl-C end a command of this package, by the signal itself, while it is still importing.

    Nothing has begun by then that would have to be ended in order. Does nothing where the package
    is imported by another program.
    """
    # `python -m` says so while it looks for the module; later its path stands there.
    modules = [word.removeprefix("-m").partition(".")[0] for word in sys.orig_argv]
    if sys.argv[:1] == ["-m"] and __package__ in modules:
        _replace(signal.default_int_handler, signal.SIG_DFL)


def raise_again() -> None:
    """Let Ctrl-C be an exception again, and one that is raised anew where it was lost."""
    _replace(signal.SIG_DFL, signal.default_int_handler)
    if sys.unraisablehook is sys.__unraisablehook__:
        sys.unraisablehook = _look_for_interrupts


def _replace(former: Any, handler: Any) -> None:
    # A shell lets its background jobs ignore Ctrl-C: so do they here.
    in_main_thread = threading.current_thread() is threading.main_thread()
    if in_main_thread and signal.getsignal(signal.SIGINT) is former:
        signal.signal(signal.SIGINT, handler)


def _look_for_interrupts(lost: Any) -> None:
    if lost.exc_type is not KeyboardInterrupt:
        sys.__unraisablehook__(lost)
        return
    # Not now: it would be lost here too.
    timer = threading.Timer(_SOON, _interrupt)
    timer.daemon = True
    timer.start()


def _interrupt() -> None:
    if hasattr(signal, "pthread_kill"):
        # This wakes the main thread where it sleeps, too.
        main = threading.main_thread().ident
        assert main is not None
        signal.pthread_kill(main, signal.SIGINT)
    else:
        _thread.interrupt_main()
