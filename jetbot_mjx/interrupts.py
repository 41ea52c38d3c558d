"""Handle Ctrl-C from the first import of a command to its end, without tracebacks or lost signals.

Python raises an exception for Ctrl-C wherever the interpreter happens to be. During imports this
prints a traceback, or a library catches the exception and continues. In a callback, for example of
garbage collection, it is printed and then ignored. A training handles it in `preemption`.
"""

import _thread
import signal
import sys
import threading
from typing import Any

_SOON = 0.05
"""[s] Time after which a lost interrupt is raised again."""


def leave_at_once() -> None:
    """Let the signal of Ctrl-C end a command of this package while it is still importing.

    At that time nothing needs an orderly shutdown. If another program imports the package, the
    function does nothing.
    """
    # `sys.argv` starts with `-m` while `python -m` looks for the module, and later with its path.
    modules = [word.removeprefix("-m").partition(".")[0] for word in sys.orig_argv]
    if sys.argv[:1] == ["-m"] and __package__ in modules:
        _replace(signal.default_int_handler, signal.SIG_DFL)


def raise_again() -> None:
    """Let Ctrl-C raise an exception again, and repeat it where it was lost."""
    _replace(signal.SIG_DFL, signal.default_int_handler)
    if sys.unraisablehook is sys.__unraisablehook__:
        sys.unraisablehook = _look_for_interrupts


def _replace(former: Any, handler: Any) -> None:
    # Keep a handler that was set by others: a shell's background jobs ignore Ctrl-C.
    in_main_thread = threading.current_thread() is threading.main_thread()
    if in_main_thread and signal.getsignal(signal.SIGINT) is former:
        signal.signal(signal.SIGINT, handler)


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
