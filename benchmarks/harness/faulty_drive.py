"""Mount a folder as a drive that answers late or fails, through `drive_server.py`."""

import ctypes.util
import importlib.util
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from benchmarks import ROOT
from jetbot_mjx.errors import UserError

_SERVER = "from benchmarks.harness import drive_server; drive_server.serve()"
_TIMEOUT = 20.0  # [s]


def why_not() -> str:
    """Return why no drive can be mounted here, in one line; empty if one can."""
    if not os.access("/dev/fuse", os.R_OK | os.W_OK):
        return "FUSE is not here: /dev/fuse cannot be opened"
    if importlib.util.find_spec("mfusepy") is None:
        return "mfusepy is not installed: pip install mfusepy"
    if not any(map(ctypes.util.find_library, ("fuse3", "fuse"))):
        return "libfuse is not installed: apt-get install fuse3"
    return ""


class FaultyDrive:
    """A mounted drive whose faults can be set at any time; a context manager that unmounts it."""

    def __init__(self, folder: Path, mount: Path) -> None:
        """Mount a folder.

        Args:
          folder: the folder that holds the files.
          mount: the mount point, an empty folder.

        Raises:
          UserError: it cannot be mounted.
        """
        self.folder, self.mount = folder, mount
        command = [sys.executable, "-c", _SERVER, str(folder.absolute()), str(mount.absolute())]
        pipe = subprocess.PIPE
        self._server = subprocess.Popen(
            command, cwd=ROOT, stdin=pipe, stdout=pipe, stderr=pipe, text=True
        )
        began = time.monotonic()
        while not mount.is_mount():
            if self._server.poll() is not None or time.monotonic() - began > _TIMEOUT:
                self._server.kill()
                said = self._server.communicate()[1].strip().splitlines() or ["no answer"]
                raise UserError(f"{mount} cannot be mounted: {said[-1]}")
            time.sleep(0.01)

    def set(
        self,
        share: float = 0.0,
        error: str | None = None,
        seconds: tuple[float, float] = (0.0, 0.0),
    ) -> dict[str, Any]:
        """Set the faults from now on; without arguments there are none.

        Args:
          share: the share of the calls that meet the fault, drawn by chance.
          error: the name of the error with which they fail, as in `EIO`; None: they succeed.
          seconds: the shortest and the longest time by which they are late [s].

        Returns:
          The numbers of `calls` and `faults` until now.
        """
        assert self._server.stdin
        assert self._server.stdout
        values = {"share": share, "error": error, "seconds": seconds}
        print(json.dumps(values), file=self._server.stdin, flush=True)
        return json.loads(self._server.stdout.readline())

    def __enter__(self) -> "FaultyDrive":
        """Return this drive."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Unmount the drive, also while files are open in it."""
        program = "umount" if os.geteuid() == 0 else "fusermount3"
        flag = "--lazy" if program == "umount" else "-uz"
        subprocess.run([program, flag, str(self.mount)], check=True)
        self._server.kill()
        self._server.communicate()
