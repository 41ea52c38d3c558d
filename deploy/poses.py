"""Pose sources: dead reckoning, or a tracker that sends datagrams.

It needs Python 3.6 and the standard library. A source has three methods: `read(now)` returns the
newest pose or None, `commanded(now, left, right)` receives the wheel speeds that were set, and
`close()` ends it.

`Odometry` needs no hardware: a JetBot has no encoders, so it integrates the commanded speeds. It
drifts, by centimetres per metre on a calibrated robot, and is never stale. Its frame is that of
the robot at the start.

`Tracker` receives poses from a program that observes the robot, for example with a camera above
the floor. One datagram is one JSON object, `{"time": 12.25, "x": 0.31, "y": -0.02, "yaw": 1.57}`:
seconds of the sender's clock, metres, and radians counter-clockwise from x. `time` must increase; a
repeated datagram is ignored, so that a tracker that hangs is treated as silent. Datagrams from
another machine are signed, see datagrams.py.
"""

import ipaddress
import math
import socket
from typing import Callable, NamedTuple, Optional

from datagrams import MAX_DATAGRAM_SIZE, Key, RejectedDatagram, TrackedPose, parse
from motors import Calibration, DriveError

# [s] time constant of a low-pass filter of the speeds: a millimetre of noise between two poses is
# 0.1 m/s.
SMOOTHING = 0.03

# [s] without a new pose after which a tracker may restart its clock.
_RESTART_AFTER = 0.5

_RECEIVE_SIZE = 2 * MAX_DATAGRAM_SIZE
"""[bytes] Longer datagrams are truncated here, and are still rejected as too long."""

_MAX_DATAGRAMS = 256
"""Number of datagrams read in one period, so that a flood of them cannot block the driver."""


class Pose(NamedTuple):
    """Position and velocity of the axle midpoint; counter-clockwise is positive."""

    time: float
    """Time of the pose on the driver's clock [s]."""
    x: float
    """[m]"""
    y: float
    """[m]"""
    yaw: float
    """Heading from x, without jumps [rad]."""
    speed: float
    """Speed along the heading [m/s]."""
    yaw_rate: float
    """[rad/s]"""


class Odometry:
    """Dead reckoning from the commanded speeds and the lag of the motors."""

    name = "odometry"

    def __init__(self, calibration: Calibration) -> None:
        """Start at the origin, heading along x.

        Args:
          calibration: The calibration, for its lag and its separation.
        """
        self._calibration = calibration
        self._pose = None  # type: Optional[Pose]
        self._wheels = (0.0, 0.0)
        self._targets = (0.0, 0.0)

    def read(self, now: float) -> Pose:
        """Return the estimated pose at a time [s]."""
        pose = self._pose or Pose(now, 0.0, 0.0, 0.0, 0.0, 0.0)
        self._pose = self._advance(pose, now)
        return self._pose

    def commanded(self, now: float, left: float, right: float) -> None:
        """Store the speeds [m/s] that the wheels are commanded from now on."""
        self.read(now)
        self._targets = (left, right)

    def close(self) -> None:
        """Close nothing; a tracker has a port to close."""

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
        # The exact mean of each speed over the interval.
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
    """Poses from a tracker; the speeds are their filtered differences."""

    name = "tracker"

    def __init__(
        self,
        receive: Callable[[], list],
        close: Callable[[], None] = lambda: None,
        key: Optional[Key] = None,
    ) -> None:
        """Start without a pose.

        Args:
          receive: Returns the datagrams received since its last call.
          close: Called at the end.
          key: The key that signs the datagrams; None: they are not signed.
        """
        self._receive, self._close, self._key = receive, close, key
        self._pose = None  # type: Optional[Pose]
        self._sent = 0.0
        self.rejected = 0
        """Number of rejected datagrams."""
        self.reason = ""
        """Why the last of them was rejected."""

    def read(self, now: float) -> Optional[Pose]:
        """Return the newest pose; None before the first. No datagram raises an exception."""
        for datagram in self._receive():
            try:
                tracked = parse(datagram) if self._key is None else self._key.check(datagram)
            except RejectedDatagram as error:
                self.rejected += 1
                self.reason = str(error)
            else:
                self._update(now, tracked)
        return self._pose

    def commanded(self, now: float, left: float, right: float) -> None:
        """Ignore the commanded speeds: the tracker measures the poses."""

    def close(self) -> None:
        """Stop listening, and save the newest signed time.

        Raises:
          DriveError: It cannot be saved.
        """
        self._close()
        if self._key is not None:
            self._key.close()

    def _update(self, now: float, seen: TrackedPose) -> None:
        last = self._pose
        # With a key, `Key.check` has already verified that time increases.
        if last is None or now - last.time > _RESTART_AFTER:
            self._pose, self._sent = Pose(now, seen.x, seen.y, seen.yaw, 0.0, 0.0), seen.time
            return
        dt = seen.time - self._sent
        if dt <= 0.0:
            return
        turned = _wrap_angle(seen.yaw - last.yaw)
        heading = last.yaw + 0.5 * turned
        moved = (seen.x - last.x) * math.cos(heading) + (seen.y - last.y) * math.sin(heading)
        # Multiplied in this order, the rate stays finite however close the two poses are in time.
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


def _wrap_angle(angle: float) -> float:
    """Return the same angle in [-π, π)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def udp_tracker(port: int, host: str = "127.0.0.1", key: Optional[Key] = None) -> Tracker:
    """Open a UDP port for a tracker.

    Args:
      port: The port on this machine.
      host: The address to listen on; by default only programs of this machine can reach it.
      key: The key that the tracker signs with; None: it does not sign.

    Returns:
      The tracker.

    Raises:
      DriveError: The port cannot be opened, or other machines reach the address and there is no
        key.
    """
    if not 0 < port < 65536:
        raise DriveError(f"--tracker {port} is not a port: give 1 to 65535")
    try:
        address = socket.gethostbyname(host)
    except (OSError, ValueError) as error:
        raise DriveError(f"--tracker-host {host}: {error}")
    if key is None and not ipaddress.ip_address(address).is_loopback:
        raise DriveError(
            f"--tracker-host {host}: anyone who reaches this address could steer the robot:"
            " share a key with the tracker by --tracker-key FILE"
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
        while len(found) < _MAX_DATAGRAMS:
            try:
                found.append(listener.recv(_RECEIVE_SIZE))
            except BlockingIOError:
                break
        return found

    return Tracker(receive, listener.close, key)
