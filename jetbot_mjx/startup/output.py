"""Let a command finish its work when nobody reads its output any more.

A reader such as `head` may leave, a disk may be full, and a terminal may be closed. What is written
to standard output or standard error then is dropped instead of raised as an exception, wherever in
the program it is written. At the end, `run_command` in `cli` prints a line about it and chooses the
exit code.
"""

import contextlib
import io
import os
import select
import sys
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer


class _Output(io.FileIO):
    """A file descriptor that keeps the error of a failed write and drops what it should write."""

    error: OSError | None = None

    def write(self, data: "ReadableBuffer", /) -> int:
        """Write bytes, and return how many were written or dropped."""
        try:
            # None: the file descriptor does not block, and its reader is slower than this process.
            while (count := super().write(data)) is None:
                select.select([], [self], [])
            return count
        except OSError as error:
            self.error = error
            return memoryview(data).nbytes


def protect_output() -> None:
    """Drop what can no longer be written to standard output and standard error.

    A stream that another program has put in the place of Python's own is left alone.
    """
    for number, name in ((1, "stdout"), (2, "stderr")):
        stream = getattr(sys, name)
        if stream is None:
            _occupy(number)
        elif stream is not getattr(sys, f"__{name}__") or stream is _protected.get(name):
            continue
        else:
            stream.flush()
        _protected[name] = io.TextIOWrapper(
            io.BufferedWriter(_Output(number, "w", closefd=False)),
            encoding=stream.encoding if stream else "utf-8",
            # A character that the terminal cannot show must not fail a command that has finished.
            errors="backslashreplace",
            line_buffering=stream is None or stream.line_buffering or stream.write_through,
        )
        setattr(sys, name, _protected[name])
        setattr(sys, f"__{name}__", _protected[name])


_protected: dict[str, io.TextIOWrapper] = {}
"""The streams of this process that `protect_output` has put in place, by name."""


def _occupy(number: int) -> None:
    """Open a closed file descriptor so that no file that is opened later gets its number.

    Otherwise what a library writes to standard error would end up in that file. Nothing can be
    written to it, so that a command notices that its output is lost.
    """
    with contextlib.suppress(OSError):
        os.fstat(number)
        return
    opened = os.open(os.devnull, os.O_RDONLY)
    if opened != number:
        os.dup2(opened, number)
        os.close(opened)
