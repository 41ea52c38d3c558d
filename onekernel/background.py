"""Run a function in a thread that the process does not wait for."""

import contextvars
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import TypeVar

_Result = TypeVar("_Result")


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

    # A daemon thread: the interpreter does not wait for a compiler when it exits.
    threading.Thread(target=contextvars.copy_context().run, args=(run,), daemon=True).start()
    return future
