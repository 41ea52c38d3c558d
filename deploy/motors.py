"""From wheel speeds to motor values: dead-band, full speed and the file that holds them.

Python 3.6 and the standard library. Speeds are those of a wheel's rim over the floor [m/s], so
that no wheel radius has to be known. Of two wheels the left comes first.
"""

import json
import math
from typing import Any, NamedTuple

DEFAULT_LAG = 0.1
DEFAULT_SEPARATION = 0.114

# Slower than this [m/s] a wheel is left alone: it would jump back and forth over its dead-band.
_STILL = 0.005

# A remote write error of the motor driver's bus is seldom followed by a second.
_STOP_TRIES = 5


class DriveError(Exception):
    """A mistake that the user can mend; its message is one line."""


class Wheel(NamedTuple):
    """One motor."""

    dead_band: float
    """Motor value up to which it stands."""
    full_speed: float
    """At a motor value of 1 [m/s]."""


class Calibration(NamedTuple):
    """Both motors of a robot."""

    left: Wheel
    right: Wheel
    lag: float
    """Time constant of the motors [s]."""
    separation: float
    """Of the two wheels [m]."""


def default_calibration() -> Calibration:
    """That of the simulated robot `real`, for who has measured nothing yet."""
    wheel = Wheel(dead_band=0.12, full_speed=0.408)
    return Calibration(wheel, wheel, DEFAULT_LAG, DEFAULT_SEPARATION)


def check_calibration(calibration: Calibration) -> Calibration:
    """Refuses numbers that no robot has.

    Args:
      calibration: to be looked at.

    Returns:
      The same.

    Raises:
      DriveError: a number is out of bounds.
    """
    bounds = []
    for side in ("left", "right"):
        wheel = getattr(calibration, side)
        bounds.append((side + ".dead_band", wheel.dead_band, 0.0, 0.6))
        bounds.append((side + ".full_speed", wheel.full_speed, 0.05, 3.0))
    bounds.append(("lag", calibration.lag, 0.0, 1.0))
    bounds.append(("separation", calibration.separation, 0.05, 0.5))
    for name, value, low, high in bounds:
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise DriveError(f"{name} = {value!r} is no number")
        if not low <= value <= high:
            raise DriveError(f"{name} = {value:g} is not between {low:g} and {high:g}")
    return calibration


def as_json(calibration: Calibration) -> dict:
    """A calibration as it stands in its file."""
    return {
        "left": dict(calibration.left._asdict()),
        "right": dict(calibration.right._asdict()),
        "lag": calibration.lag,
        "separation": calibration.separation,
    }


def read_calibration(path: str) -> Calibration:
    """Reads a calibration file.

    Args:
      path: as `calibrate.py` wrote it.

    Returns:
      The calibration.

    Raises:
      DriveError: there is none, or it is not one.
    """
    try:
        with open(path) as file:
            stored = json.load(file)
        return check_calibration(
            Calibration(
                Wheel(**stored["left"]),
                Wheel(**stored["right"]),
                stored["lag"],
                stored["separation"],
            )
        )
    except OSError as error:
        raise DriveError(f"--calibration {path}: {error.strerror}")
    except KeyError as error:
        raise DriveError(f"--calibration {path} lacks {error}")
    except (ValueError, TypeError, RecursionError) as error:
        raise DriveError(f"--calibration {path} is no calibration: {error}")
    except DriveError as error:
        raise DriveError(f"--calibration {path}: {error}")


def motor_value(speed: float, wheel: Wheel) -> float:
    """The motor value that lets a wheel turn at a speed.

        m = sign(v) (dead + (1 - dead) |v| / full)

    Args:
      speed: v [m/s], negative backwards; what the motor cannot reach is cut off.
      wheel: its calibration.

    Returns:
      m in [-1, 1]; zero where the wheel is to stand.
    """
    if abs(speed) < _STILL:
        return 0.0
    share = min(abs(speed) / wheel.full_speed, 1.0)
    return math.copysign(wheel.dead_band + (1.0 - wheel.dead_band) * share, speed)


def wheel_speed(value: float, wheel: Wheel) -> float:
    """The speed [m/s] that a motor value leads to; the inverse of `motor_value`."""
    beyond = max(abs(value) - wheel.dead_band, 0.0) / (1.0 - wheel.dead_band)
    return math.copysign(wheel.full_speed * beyond, value)


def stop(robot: Any) -> None:
    """Sets both motors to zero, and tries again where the bus refuses.

    Raises:
      OSError: it refused every time, and the robot may still drive.
    """
    for attempt in range(_STOP_TRIES):
        try:
            robot.set_motors(0.0, 0.0)
            return
        except OSError:
            if attempt == _STOP_TRIES - 1:
                raise
