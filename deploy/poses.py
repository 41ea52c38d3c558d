"""Where the robot is: by dead reckoning, or from a tracker that sends datagrams.

Python 3.6 and the standard library. A source has three methods: `read(now)` gives the newest pose,
or None, `commanded(now, left, right)` is told what the motors were set to, and `close()` ends it.

`Odometry` needs nothing and sees nothing: a JetBot has no encoders, so it adds up the speeds that
were commanded. It drifts, by centimetres for every metre on a calibrated robot, and never grows
stale. Its frame is the robot's at the start.

`Tracker` listens to whoever sees the robot from outside, such as a camera above the floor. One
datagram is one JSON object, `{"time": 12.25, "x": 0.31, "y": -0.02, "yaw": 1.57}`: seconds of the
sender's own clock, metres, and radians counter-clockwise from x. `time` must grow; what repeats
is no news, so a tracker that hangs counts as one that is silent. From another machine datagrams
are signed, see datagrams.py.
"""

import ipaddress
import math
import socket
from typing import Callable, NamedTuple, Optional

from datagrams import LONGEST, Key, Refused, Sighting, parse
from motors import Calibration, DriveError

# [s] of a low-pass over the speeds: millimetres of noise are 0.1 m/s from picture to picture.
SMOOTHING = 0.03

# [s] without news after which a tracker may begin a new count of time.
_FORGET_AFTER = 0.5

_LONGEST_DATAGRAM = 2 * LONGEST
"""[bytes] Longer ones are cut off here, and are too long all the same."""

_MOST_AT_ONCE = 256
"""Datagrams; a flood of them must not keep the driver from its motors."""


class Pose(NamedTuple):
    """Where the axle midpoint is, and how it moves; counter-clockwise is positive."""

    time: float
    """When it was had, on our clock [s]."""
    x: float
    """[m]"""
    y: float
    """[m]"""
    yaw: float
    """Heading from x [rad], without jumps."""
    speed: float
    """Along the heading [m/s]."""
    yaw_rate: float
    """[rad/s]"""


class Odometry:
    """Dead reckoning of what was commanded, through the motors' lag."""

    name = "odometry"

    def __init__(self, calibration: Calibration) -> None:
        """Begins at the origin, heading along x.

        Args:
          calibration: its lag and separation.
        """
        self._calibration = calibration
        self._pose = None  # type: Optional[Pose]
        self._wheels = (0.0, 0.0)
        self._targets = (0.0, 0.0)

    def read(self, now: float) -> Pose:
        """The pose reckoned for now."""
        pose = self._pose or Pose(now, 0.0, 0.0, 0.0, 0.0, 0.0)
        self._pose = self._advance(pose, now)
        return self._pose

    def commanded(self, now: float, left: float, right: float) -> None:
        """Notes the speeds [m/s] that the wheels are asked for from now on."""
        self.read(now)
        self._targets = (left, right)

    def close(self) -> None:
        """Does nothing."""

    def _advance(self, pose: Pose, now: float) -> Pose:
        lag, dt = self._calibration.lag, now - pose.time
        if dt <= 0.0:
            return pose
        decay = math.exp(-dt / lag) if lag > 0.0 else 0.0
        before = self._wheels
        left, right = (
            decay * wheel + (1.0 - decay) * target for wheel, target in zip(before, self._targets)
        )
        self._wheels = (left, right)
        # Exact mean of each speed over the interval.
        left, right = (
            target + (old - new) * lag / dt
            for target, old, new in zip(self._targets, before, self._wheels)
        )
        turned = dt * (right - left) / self._calibration.separation
        moved, heading = 0.5 * dt * (left + right), pose.yaw + 0.5 * turned
        return Pose(
            now,
            pose.x + moved * math.cos(heading),
            pose.y + moved * math.sin(heading),
            pose.yaw + turned,
            0.5 * (self._wheels[0] + self._wheels[1]),
            (self._wheels[1] - self._wheels[0]) / self._calibration.separation,
        )


class Tracker:
    """Poses that come from outside; speeds are their smoothed differences."""

    name = "tracker"

    def __init__(
        self,
        receive: Callable[[], list],
        close: Callable[[], None] = lambda: None,
        key: Optional[Key] = None,
    ) -> None:
        """Begins without a pose.

        Args:
          receive: returns the datagrams that have come since it was last called.
          close: is called at the end.
          key: that datagrams are signed with; None: they are not signed.
        """
        self._receive, self._close, self._key = receive, close, key
        self._pose = None  # type: Optional[Pose]
        self._sent = 0.0
        self.rejected = 0
        """Datagrams that were not believed."""
        self.reason = ""
        """Why the last of them was not."""

    def read(self, now: float) -> Optional[Pose]:
        """Return the newest pose; None before the first. No datagram makes it raise."""
        for datagram in self._receive():
            try:
                sighting = parse(datagram) if self._key is None else self._key.check(datagram)
            except Refused as error:
                self.rejected += 1
                self.reason = str(error)
            else:
                self._update(now, sighting)
        return self._pose

    def commanded(self, now: float, left: float, right: float) -> None:
        """Of no use here."""

    def close(self) -> None:
        """Stops listening, and keeps the newest time that was signed.

        Raises:
          DriveError: it cannot be kept.
        """
        self._close()
        if self._key is not None:
            self._key.close()

    def _update(self, now: float, seen: Sighting) -> None:
        last = self._pose
        # A key has seen to it already that time grows.
        if last is None or now - last.time > _FORGET_AFTER:
            self._pose, self._sent = Pose(now, seen.x, seen.y, seen.yaw, 0.0, 0.0), seen.time
            return
        dt = seen.time - self._sent
        if dt <= 0.0:
            return
        turned = _nearest(seen.yaw - last.yaw)
        heading = last.yaw + 0.5 * turned
        moved = (seen.x - last.x) * math.cos(heading) + (seen.y - last.y) * math.sin(heading)
        # The share by its rate: finite however close two pictures were.
        share = -math.expm1(-dt / SMOOTHING)
        rate = share / dt
        self._pose = Pose(
            now,
            seen.x,
            seen.y,
            last.yaw + turned,
            last.speed + rate * moved - share * last.speed,
            last.yaw_rate + rate * turned - share * last.yaw_rate,
        )
        self._sent = seen.time


def _nearest(angle: float) -> float:
    """The same angle in [-π, π)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def udp_tracker(port: int, host: str = "127.0.0.1", key: Optional[Key] = None) -> Tracker:
    """Opens a UDP port for a tracker.

    Args:
      port: of this machine.
      host: the address to listen at; by default only programs of this machine reach it.
      key: that the tracker signs with; None: it does not sign.

    Returns:
      The tracker.

    Raises:
      DriveError: the port cannot be had, or others reach the address and there is no key.
    """
    if not 0 < port < 65536:
        raise DriveError(f"--tracker {port} is no port: give 1 to 65535")
    try:
        address = socket.gethostbyname(host)
    except (OSError, ValueError) as error:
        raise DriveError(f"--tracker-host {host}: {error}")
    if key is None and not ipaddress.ip_address(address).is_loopback:
        raise DriveError(
            f"--tracker-host {host}: whoever reaches this address could steer the robot: share a"
            " key with the tracker by --tracker-key FILE"
        )
    listener = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        listener.bind((address, port))
    except OSError as error:
        listener.close()
        raise DriveError(f"--tracker {port} at {host}: {error.strerror}")
    listener.setblocking(False)

    def receive() -> list:
        found = []
        while len(found) < _MOST_AT_ONCE:
            try:
                found.append(listener.recv(_LONGEST_DATAGRAM))
            except BlockingIOError:
                break
        return found

    return Tracker(receive, listener.close, key)
