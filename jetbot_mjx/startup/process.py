"""Set the garbage collector and the environment variables of a command, and end its process."""

import ctypes
import gc
import os
import sys
import threading
from typing import NoReturn

from jetbot_mjx.startup.switch import is_plain

_GARBAGE_THRESHOLDS = 1_000_000, 50, 100
"""Thresholds of Python's garbage collector during the start of a command. With its own, which begin
at 700 objects, it takes a third of the time that imports and JAX's tracing take, and finds nothing.
A start that finds its programs compiled makes fewer objects than the first of these.
"""

_START_SECONDS = 60
"""Time after which the collector works as usual, for commands that run for long [s]."""

_ENVIRONMENT = {
    # JAX computes. NumPy would start a thread for every core, which takes longer than its import.
    "OPENBLAS_NUM_THREADS": "1",
    # Pydantic would look for plugins in all installed packages.
    "PYDANTIC_DISABLE_PLUGINS": "__all__",
}


_MAX_ARENAS = -8
"""The option M_ARENA_MAX of `mallopt`."""


def collect_garbage_late() -> None:
    """Let Python collect garbage rarely during the start of a command."""
    if is_plain():
        return
    usual = gc.get_threshold()
    gc.set_threshold(*_GARBAGE_THRESHOLDS)
    timer = threading.Timer(_START_SECONDS, gc.set_threshold, usual)
    timer.daemon = True
    timer.start()


def set_environment() -> None:
    """Set variables that libraries read when they are imported, unless the user has set them."""
    if not is_plain():
        for name, value in _ENVIRONMENT.items():
            os.environ.setdefault(name, value)


def share_memory() -> None:
    """Let all threads take memory from few arenas, with the C library of GNU.

    A hundred threads would have as many, and each keep what is freed in it: a training of 10¹⁰
    steps grew by 3 MB with every checkpoint, and by nothing with two arenas, at the same speed. A
    user's own `MALLOC_ARENA_MAX` stays.
    """
    if "MALLOC_ARENA_MAX" in os.environ or not sys.platform.startswith("linux"):
        return
    # Other C libraries have no such function.
    if set_option := getattr(ctypes.CDLL(None), "mallopt", None):
        set_option(_MAX_ARENAS, 2)


def keep_own_files() -> None:
    """Let this user read and write what the process makes, whatever the umask.

    A checkpoint that its own training cannot read again is lost.
    """
    before = os.umask(0o077)
    os.umask(before & 0o077)


def exit_at_once(code: int) -> NoReturn:
    """Exit without Python's clean-up.

    JAX takes a second to release a GPU, and a compiler's thread, which cannot be interrupted, may
    abort the process.
    """
    if is_plain():
        sys.exit(code)
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)
