"""Read and write files of executable code that no other user can have written.

A compiled program is machine code, and the folder that it is kept in may be shared. As ssh does
with its keys, a file is trusted where it and its folder belong to this user or to root, and nobody
else may write to either. Where the system knows no owners, as Windows, every file is trusted.
"""

import os
import stat
import sys
import tempfile
import threading
from pathlib import Path

_lock = threading.Lock()
_told: set[Path] = set()
"""Folders of which a line has been written."""


def read_trusted(path: Path) -> bytes | None:
    """Return the content of a file that nobody but this user and root can have written.

    Args:
      path: the file.

    Returns:
      The content; None where there is no such file, or where it is not trusted, which one line on
      stderr says, once for each folder.
    """
    try:
        reason = distrust(path.parent, path.parent.stat())
        if reason is None:
            with path.open("rb") as file:
                reason = distrust(path, os.fstat(file.fileno()))
                if reason is None:
                    return file.read()
    except OSError:
        return None
    tell_once(path.parent, reason)
    return None


def write_private(path: Path, content: bytes) -> None:
    """Write a file that `read_trusted` trusts, atomically.

    Args:
      path: the file. Nothing is written where its folder is not trusted: nobody would read it.
      content: all of it.

    Raises:
      OSError: the folder is not there, or the file cannot be written.
    """
    if distrust(path.parent, path.parent.stat()) is not None:
        return
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        written = Path(folder) / path.name
        with open(os.open(written, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as file:
            file.write(content)
        written.replace(path)


def distrust(path: Path, status: os.stat_result) -> str | None:
    """Return why a file or folder is not trusted, or None where it is.

    Args:
      path: the file or folder, for the message.
      status: its owner and mode.

    Returns:
      The reason and the remedy, on one line.
    """
    if not hasattr(os, "geteuid"):
        return None
    if status.st_uid not in (os.geteuid(), 0):
        return f"{path} belongs to another user, number {status.st_uid}"
    if status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        return f"others may write to {path}: chmod go-w {path}"
    return None


def tell_once(folder: Path, reason: str) -> None:
    """Write a line about a folder that is not trusted, or a file in it, to stderr.

    Args:
      folder: nothing is written where a line about it was.
      reason: of `distrust`.
    """
    with _lock:
        if folder in _told:
            return
        _told.add(folder)
    print(f"compiled programs are not read, but made anew: {reason}", file=sys.stderr)
