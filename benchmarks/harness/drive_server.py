"""Serve a folder as a drive that answers late or fails, as one on a network does.

It mounts the folder with FUSE and forwards all calls to it. A line of JSON on standard input sets
the faults, and a line that answers says how many calls there were. It needs mfusepy and libfuse;
`faulty_drive.py` starts it, in a process of its own.
"""

import errno
import functools
import json
import os
import random
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import mfusepy  # pyright: ignore[reportMissingImports]

_INTERRUPTIBLE = {"open", "create", "read", "write", "fsync", "fsyncdir", "truncate"}
"""The calls that a signal may interrupt. Linux lets no signal interrupt the flush of a close."""

_STATUS = ("mode", "nlink", "size", "atime_ns", "mtime_ns", "ctime_ns", "uid", "gid", "ino")


class Faults:
    """`Faults` make a share of the calls late, or lets them fail with an error."""

    def __init__(self) -> None:
        """Begin without any."""
        self._rng, self._lock = random.Random(0), threading.Lock()
        self._values: dict[str, Any] = {"share": 0.0, "error": None, "seconds": (0.0, 0.0)}
        self._counts = {"calls": 0, "faults": 0}

    def set(self, values: dict[str, Any]) -> dict[str, int]:
        """Replace the faults, and return the number of calls and of faults so far."""
        with self._lock:
            self._values |= values
            return dict(self._counts)

    def meet(self, operation: str) -> None:
        """Wait or raise an OSError before an operation, by chance."""
        with self._lock:
            error = self._values["error"]
            self._counts["calls"] += 1
            if error == "EINTR" and operation not in _INTERRUPTIBLE:
                return
            if self._rng.random() >= self._values["share"]:
                return
            self._counts["faults"] += 1
            seconds = self._rng.uniform(*self._values["seconds"])
        time.sleep(seconds)
        if error:
            raise OSError(getattr(errno, error), os.strerror(getattr(errno, error)))


def _faulty(function: Callable[..., Any]) -> Callable[..., Any]:
    @functools.wraps(function)
    def call(drive: "Drive", *given: Any) -> Any:
        drive.faults.meet(function.__name__)
        return function(drive, *given)

    return call


class Drive(mfusepy.Operations):
    """A `Drive` forwards the calls of FUSE to a folder, each after its fault, if it has one."""

    use_ns = True

    def __init__(self, folder: str, faults: Faults) -> None:
        """Serve a folder."""
        self._folder, self.faults = folder, faults

    def _at(self, path: str) -> str:
        return self._folder + path

    @_faulty
    def getattr(self, path: str, fh: int | None = None) -> dict[str, Any]:
        """Return the status of a file, which may be open."""
        status = os.lstat(self._at(path)) if fh is None else os.fstat(fh)
        return {f"st_{x.removesuffix('_ns')}": getattr(status, f"st_{x}") for x in _STATUS}

    @_faulty
    def readdir(self, path: str, fh: int) -> list[str]:
        """Return the names in a folder."""
        return [".", "..", *os.listdir(self._at(path))]

    @_faulty
    def statfs(self, path: str) -> dict[str, int]:
        """Return the free space."""
        space = os.statvfs(self._at(path))
        return {name: getattr(space, name) for name in dir(space) if name.startswith("f_")}

    @_faulty
    def mkdir(self, path: str, mode: int) -> None:
        """Create a folder."""
        os.mkdir(self._at(path), mode)

    @_faulty
    def rmdir(self, path: str) -> None:
        """Remove a folder."""
        os.rmdir(self._at(path))

    @_faulty
    def unlink(self, path: str) -> None:
        """Remove a file."""
        os.unlink(self._at(path))

    @_faulty
    def rename(self, old: str, new: str) -> None:
        """Rename a file or folder."""
        os.rename(self._at(old), self._at(new))

    @_faulty
    def chmod(self, path: str, mode: int) -> None:
        """Change the mode."""
        os.chmod(self._at(path), mode)

    @_faulty
    def utimens(self, path: str, times: tuple[int, int]) -> None:
        """Change the times [ns]."""
        os.utime(self._at(path), ns=times)

    @_faulty
    def open(self, path: str, flags: int) -> int:
        """Open a file."""
        # The system sends the end of the file as an offset.
        return os.open(self._at(path), flags & ~os.O_APPEND)

    @_faulty
    def create(self, path: str, mode: int, fi: Any = None) -> int:
        """Create and open a file."""
        return os.open(self._at(path), os.O_RDWR | os.O_CREAT, mode)

    @_faulty
    def read(self, path: str, size: int, offset: int, fh: int) -> bytes:
        """Read a part of a file."""
        return os.pread(fh, size, offset)

    @_faulty
    def write(self, path: str, data: bytes, offset: int, fh: int) -> int:
        """Write a part of a file."""
        return os.pwrite(fh, data, offset)

    @_faulty
    def truncate(self, path: str, length: int, fh: int | None = None) -> None:
        """Cut or extend a file."""
        os.truncate(self._at(path) if fh is None else fh, length)

    @_faulty
    def flush(self, path: str, fh: int) -> None:
        """Do what a close needs, of which this folder has nothing."""

    @_faulty
    def fsync(self, path: str, datasync: int, fh: int) -> None:
        """Sync a file."""
        os.fsync(fh)

    @_faulty
    def fsyncdir(self, path: str, datasync: int, fh: int) -> None:
        """Sync a folder, whose names are in the folder that is served."""

    def release(self, path: str, fh: int) -> None:
        """Close a file, whose errors nobody sees."""
        os.close(fh)


def serve() -> None:
    """Serve the folder of the first argument at that of the second until it is unmounted."""
    folder, mount = sys.argv[1:]
    faults = Faults()

    def obey() -> None:
        for line in sys.stdin:
            print(json.dumps(faults.set(json.loads(line))), flush=True)

    threading.Thread(target=obey, daemon=True).start()
    mfusepy.FUSE(Drive(folder, faults), mount, foreground=True)
