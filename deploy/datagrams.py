"""Check a tracker's datagrams, and make the key to sign them: `python3 datagrams.py tracker.key`.

It needs Python 3.6 and the standard library. A datagram is one JSON object with the numbers `time`,
`x`, `y` and `yaw`, which poses.py describes. With a shared key, the 32 bytes of their HMAC-SHA256
come before them:

    hmac.new(key, body, "sha256").digest() + body

Without the key nobody can make a valid datagram. A recorded datagram that is sent again is rejected
by its `time`, which must increase: during a drive and, because the newest time is saved in a file
beside the key, from drive to drive. The sender must therefore use a clock that is never set back,
such as `time.time()`.
"""

import argparse
import hashlib
import hmac
import json
import os
import secrets
import stat
import sys
from typing import Any, NamedTuple, Optional

from motors import DriveError

MAX_DATAGRAM_SIZE = 1024
"""[bytes] A longer datagram is not parsed."""

_MIN_KEY_SIZE = 16
_MAX_KEY_SIZE = 4096
_SIGNATURE = hashlib.sha256().digest_size

# [s], [m], [m] and [rad]; an int of any length compares with these without becoming a float.
_BOUNDS = (("time", 1e12), ("x", 1000.0), ("y", 1000.0), ("yaw", 1e6))


class RejectedDatagram(Exception):
    """Raised when a datagram is rejected; the message says why."""


class TrackedPose(NamedTuple):
    """The pose in one datagram."""

    time: float
    """Time of the sender's clock [s]."""
    x: float
    """[m]"""
    y: float
    """[m]"""
    yaw: float
    """Heading from x, counter-clockwise [rad]."""


class Key:
    """A key that a tracker shares with this robot, and the newest signed time."""

    def __init__(self, path: str) -> None:
        """Read the key and the newest time.

        Args:
          path: Path of the key; the newest time is saved beside it, in `PATH.newest`.

        Raises:
          DriveError: The key cannot be read, is short, or can be read by others; or the newest
            time cannot be saved.
        """
        self._path, self._newest_path = path, path + ".newest"
        self._secret = self._read_secret()
        self._newest = self._read_newest()
        # Save it once now, so that an error comes before the drive and not after it.
        self.close()

    def check(self, datagram: bytes) -> TrackedPose:
        """Return the pose in a signed datagram.

        Args:
          datagram: Signature and JSON.

        Returns:
          The pose, which is newer than all before.

        Raises:
          RejectedDatagram: It is not signed with this key, is not a pose, or is not newer.
        """
        signature, body = datagram[:_SIGNATURE], datagram[_SIGNATURE:]
        if not hmac.compare_digest(hmac.new(self._secret, body, "sha256").digest(), signature):
            raise RejectedDatagram("it is not signed with " + self._path)
        tracked = parse(body)
        if not tracked.time > self._newest:
            raise RejectedDatagram(
                f"its time {tracked.time!r} is not later than {self._newest!r}, the newest so far:"
                f" a replay, or the tracker's clock was set back (then remove {self._newest_path})"
            )
        self._newest = tracked.time
        return tracked

    def close(self) -> None:
        """Save the newest time for the next drive.

        Raises:
          DriveError: It cannot be written.
        """
        unfinished = self._newest_path + ".unfinished"
        try:
            with open(unfinished, "w") as file:
                file.write(repr(self._newest))
            os.replace(unfinished, self._newest_path)
        except OSError as error:
            raise DriveError(f"--tracker-key: {self._newest_path}: {error.strerror}")

    def _read_secret(self) -> bytes:
        try:
            with open(self._path, "rb") as file:
                mode = os.fstat(file.fileno()).st_mode
                secret = file.read(_MAX_KEY_SIZE).strip()
        except (OSError, ValueError) as error:
            raise DriveError(f"--tracker-key {self._path}: {getattr(error, 'strerror', error)}")
        if os.name == "posix" and stat.S_IMODE(mode) & 0o077:
            raise DriveError(
                f"--tracker-key {self._path} can be read by others: chmod 600 {self._path}"
            )
        if len(secret) < _MIN_KEY_SIZE:
            raise DriveError(
                f"--tracker-key {self._path} has {len(secret)} bytes: use at least {_MIN_KEY_SIZE}"
            )
        return secret

    def _read_newest(self) -> float:
        try:
            with open(self._newest_path) as file:
                return float(file.read(100))
        except FileNotFoundError:
            return float("-inf")
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise DriveError(f"--tracker-key: {self._newest_path}: {reason}")


def parse(body: bytes) -> TrackedPose:
    """Return the pose in the JSON of a datagram.

    Args:
      body: Any bytes.

    Returns:
      The pose, of finite numbers within bounds.

    Raises:
      RejectedDatagram: The bytes are not a pose.
    """
    if len(body) > MAX_DATAGRAM_SIZE:
        raise RejectedDatagram(f"it is longer than {MAX_DATAGRAM_SIZE} bytes")
    try:
        values: Any = json.loads(body.decode("utf-8"))
    except (ValueError, RecursionError):
        raise RejectedDatagram("it is not JSON")
    if not isinstance(values, dict):
        raise RejectedDatagram("it is not a JSON object")
    numbers = []
    for name, bound in _BOUNDS:
        value: Any = values.get(name)
        # This excludes bool, which is a subclass of int.
        if type(value) not in (int, float) or not -bound <= value <= bound:
            raise RejectedDatagram(f"its {name} is not a number between -{bound:g} and {bound:g}")
        numbers.append(float(value))
    return TrackedPose(*numbers)


def main(arguments: Optional[list] = None) -> int:
    """Write a new key that only this user can read.

    Args:
      arguments: Arguments without the program's name; None: those of the process.

    Returns:
      The exit code: 0, or 2 where the file exists already or cannot be written.
    """
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", help="file to write the key to; copy it to the tracker's machine")
    path = parser.parse_args(arguments).file
    try:
        handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except (OSError, ValueError) as error:
        print(f"error: {path}: {getattr(error, 'strerror', error)}", file=sys.stderr)
        return 2
    with os.fdopen(handle, "w") as file:
        file.write(secrets.token_hex(32) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
