"""Checks what a tracker sends, and makes the key to sign it: `python3 datagrams.py tracker.key`.

Python 3.6 and the standard library. A datagram is one JSON object with the numbers `time`, `x`, `y`
and `yaw`, as poses.py tells. Where a key is shared, the HMAC-SHA256 of these bytes stands before
them, 32 bytes long:

    hmac.new(key, body, "sha256").digest() + body

That keeps out whoever does not know the key. A datagram that was recorded and sent again is kept
out by its `time`, which must grow: during a drive and, because the newest is kept in a file beside
the key, from drive to drive. So the sender takes it from a clock that is never set back, such as
`time.time()`.
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

LONGEST = 1024
"""[bytes] More is no pose: a longer one is not parsed."""

_SHORTEST_KEY = 16
_LONGEST_KEY = 4096
_SIGNATURE = hashlib.sha256().digest_size

# [s], [m], [m] and [rad]; an int of any length compares with these without becoming a float.
_BOUNDS = (("time", 1e12), ("x", 1000.0), ("y", 1000.0), ("yaw", 1e6))


class Refused(Exception):
    """A datagram that is not believed; the message says why."""


class Sighting(NamedTuple):
    """What one datagram says."""

    time: float
    """Of the sender's clock [s]."""
    x: float
    """[m]"""
    y: float
    """[m]"""
    yaw: float
    """Heading from x, counter-clockwise [rad]."""


class Key:
    """A key that a tracker shares with this robot, and the newest time that it signed."""

    def __init__(self, path: str) -> None:
        """Read both.

        Args:
          path: of the key; the newest time is kept beside it, in `PATH.newest`.

        Raises:
          DriveError: the key cannot be read, is short, or can be read by others; or the newest
            time cannot be kept.
        """
        self._path, self._newest_path = path, path + ".newest"
        self._secret = self._read_secret()
        self._newest = self._read_newest()
        # What cannot be written is told now and not after a drive.
        self.close()

    def check(self, datagram: bytes) -> Sighting:
        """Return what a signed datagram says.

        Args:
          datagram: signature and JSON.

        Returns:
          What it says, which is newer than all before.

        Raises:
          Refused: it is not signed with this key, no pose, or no news.
        """
        signature, body = datagram[:_SIGNATURE], datagram[_SIGNATURE:]
        if not hmac.compare_digest(hmac.new(self._secret, body, "sha256").digest(), signature):
            raise Refused("it is not signed with " + self._path)
        sighting = parse(body)
        if not sighting.time > self._newest:
            raise Refused(
                f"its time {sighting.time!r} is not later than {self._newest!r}, the newest so far:"
                f" a replay, or the tracker's clock was set back (then remove {self._newest_path})"
            )
        self._newest = sighting.time
        return sighting

    def close(self) -> None:
        """Keep the newest time for the next drive.

        Raises:
          DriveError: it cannot be written.
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
                secret = file.read(_LONGEST_KEY).strip()
        except (OSError, ValueError) as error:
            raise DriveError(f"--tracker-key {self._path}: {getattr(error, 'strerror', error)}")
        if os.name == "posix" and stat.S_IMODE(mode) & 0o077:
            raise DriveError(
                f"--tracker-key {self._path} can be read by others: chmod 600 {self._path}"
            )
        if len(secret) < _SHORTEST_KEY:
            raise DriveError(
                f"--tracker-key {self._path} holds {len(secret)} bytes: make it at least"
                f" {_SHORTEST_KEY}"
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


def parse(body: bytes) -> Sighting:
    """Return what the JSON of a datagram says.

    Args:
      body: any bytes.

    Returns:
      What it says; finite numbers within bounds.

    Raises:
      Refused: it is no pose.
    """
    if len(body) > LONGEST:
        raise Refused(f"it is longer than {LONGEST} bytes")
    try:
        values: Any = json.loads(body.decode("utf-8"))
    except (ValueError, RecursionError):
        raise Refused("it is no JSON")
    if not isinstance(values, dict):
        raise Refused("it is no JSON object")
    numbers = []
    for name, bound in _BOUNDS:
        value: Any = values.get(name)
        # Not bool, which is an int too.
        if type(value) not in (int, float) or not -bound <= value <= bound:
            raise Refused(f"its {name} is no number between -{bound:g} and {bound:g}")
        numbers.append(float(value))
    return Sighting(*numbers)


def main(arguments: Optional[list] = None) -> int:
    """Write a new key, which nobody else can read.

    Args:
      arguments: without the program's name; None: those of the process.

    Returns:
      The exit code: 0, or 2 where the file is there already or cannot be written.
    """
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("file", help="to be written; copy it to the tracker's machine")
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
