"""Tell how long this process has run, which is the clock of all times that are shown."""

import os
import time
from pathlib import Path

_IMPORTED = time.perf_counter()
_origin = 0.0
"""Time of the process at which `process_seconds` is 0 [s]."""


def process_seconds() -> float:
    """Return the time since this process started [s]: the clock of all times that are shown.

    In a program that imports the package it counts from the beginning of the last training. If the
    system does not tell when the process started, it counts from the import of this module.
    """
    return _process_seconds() - _origin


def restart_clock() -> None:
    """Let `process_seconds` count from now on, because a program begins a training."""
    global _origin
    _origin = _process_seconds()


def _process_seconds() -> float:
    try:
        after_name = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
        began = int(after_name[19]) / os.sysconf("SC_CLK_TCK")
        return time.clock_gettime(time.CLOCK_BOOTTIME) - began
    except (OSError, AttributeError, ValueError, IndexError):
        return time.perf_counter() - _IMPORTED
