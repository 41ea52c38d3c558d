"""Where the robot is: by dead reckoning, or from a tracker that sends datagrams.

Python 3.6 and the standard library. A source has three methods: `read(now)` gives the newest pose,
or None, `commanded(now, left, right)` is told what the motors were set to, and `close()` ends it.

`Odometry` needs nothing and sees nothing: a JetBot has no encoders, so it adds up the speeds that
were commanded. It drifts, by centimetres for every metre on a calibrated robot, and never grows
stale. Its frame is the robot's at the start.

`Tracker` listens to whoever sees the robot from outside, such as a camera above the floor. One
datagram is one JSON object, `{"time": 12.25, "x": 0.31, "y": -0.02, "yaw": 1.57}`: seconds of the
sender's own clock, metres, and radians counter-clockwise from x. `time` must grow; what repeats
is no news, so a tracker that hangs counts as one that is silent.
"""

import json
import math
import socket
from typing import Callable, NamedTuple, Optional

from motors import Calibration, DriveError

# [s] of a low-pass over the speeds: millimetres of noise are 0.1 m/s from picture to picture.
SMOOTHING = 0.03

# [s] without news after which a tracker may begin a new count of time.
_FORGET_AFTER = 0.5

_LONGEST_DATAGRAM = 4096


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
        self, receive: Callable[[], list], close: Callable[[], None] = lambda: None
    ) -> None:
        """Begins without a pose.

        Args:
          receive: returns the datagrams that have come since it was last called.
          close: is called at the end.
        """
        self._receive, self.close = receive, close
        self._pose = None  # type: Optional[Pose]
        self._sent = 0.0
        self.rejected = 0
        """Datagrams that were no pose."""

    def read(self, now: float) -> Optional[Pose]:
        """The newest pose; None before the first."""
        for datagram in self._receive():
            try:
                values = json.loads(datagram.decode("utf-8"))
                sent, x, y, yaw = (float(values[name]) for name in ("time", "x", "y", "yaw"))
            except (ValueError, TypeError, LookupError):
                self.rejected += 1
                continue
            if not all(math.isfinite(value) for value in (sent, x, y, yaw)):
                self.rejected += 1
                continue
            self._update(now, sent, x, y, yaw)
        return self._pose

    def commanded(self, now: float, left: float, right: float) -> None:
        """Of no use here."""

    def _update(self, now: float, sent: float, x: float, y: float, yaw: float) -> None:
        last = self._pose
        if last is None or now - last.time > _FORGET_AFTER:
            self._pose, self._sent = Pose(now, x, y, yaw, 0.0, 0.0), sent
            return
        dt = sent - self._sent
        if dt <= 0.0:
            return
        turned = _nearest(yaw - last.yaw)
        heading = last.yaw + 0.5 * turned
        moved = (x - last.x) * math.cos(heading) + (y - last.y) * math.sin(heading)
        share = 1.0 - math.exp(-dt / SMOOTHING)
        self._pose = Pose(
            now,
            x,
            y,
            last.yaw + turned,
            last.speed + share * (moved / dt - last.speed),
            last.yaw_rate + share * (turned / dt - last.yaw_rate),
        )
        self._sent = sent


def _nearest(angle: float) -> float:
    """The same angle in [-π, π)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def udp_tracker(port: int, host: str = "0.0.0.0") -> Tracker:
    """A tracker that listens on a UDP port.

    Args:
      port: of this machine.
      host: the address to listen at; by default every one.

    Returns:
      The tracker.

    Raises:
      DriveError: the port cannot be had.
    """
    listener = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        listener.bind((host, port))
    except (OSError, OverflowError) as error:
        listener.close()
        raise DriveError(f"--tracker {port}: {error}")
    listener.setblocking(False)

    def receive() -> list:
        found = []
        while True:
            try:
                found.append(listener.recv(_LONGEST_DATAGRAM))
            except BlockingIOError:
                return found

    return Tracker(receive, listener.close)
