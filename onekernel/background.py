"""Run a function in a thread that the process does not wait for."""

import contextvars
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import TypeVar

_Result = TypeVar("_Result")

# Python keeps the frames of a thread in pieces of 16 KiB. A call that does not fit into the last
# piece asks the system for another, which its return gives back. JAX traces and lowers about that
# deep, where a loop may ask for a piece in every turn: 90,000 times while PPO's programs are
# compiled, 0.6 s of the system's time. A frame of this many slots of 8 bytes makes Python ask for
# one piece of 256 KiB, half of which is left to the calls below (CPython 3.11 to 3.13).
_FRAME_SLOTS = 16_000


def in_background(function: Callable[[], _Result]) -> Future[_Result]:
    """Compute a function's result in a thread, for which the process does not wait at its end.

    The thread has the caller's context variables.
    """
    future: Future[_Result] = Future()

    def run() -> None:
        try:
            future.set_result(function())
        except BaseException as error:  # `result` raises it in the caller's thread.
            future.set_exception(error)

    run.__code__ = run.__code__.replace(co_stacksize=_FRAME_SLOTS)
    # A daemon thread: the interpreter does not wait for a compiler when it exits.
    threading.Thread(target=contextvars.copy_context().run, args=(run,), daemon=True).start()
    return future
