"""Convert wheel speeds to motor values, by a calibration of dead-band and full speed.

It needs Python 3.6 and the standard library. Speeds are those of a wheel's rim over the floor
[m/s], so that no wheel radius has to be known. The left wheel comes first.
"""

import json
import math
from typing import Any, NamedTuple

DEFAULT_LAG = 0.1
DEFAULT_SEPARATION = 0.114

# Below this speed [m/s] a wheel stands: it would jump back and forth over its dead-band.
_STANDSTILL = 0.005

# The bus of the motor driver sometimes fails to write, but rarely several times in a row.
_STOP_TRIES = 5


_LONGEST_LINE = 1000


class DriveError(Exception):
    """Raised when the user can correct what is wrong; its message is one line."""

    def __init__(self, message: str) -> None:
        """Leave out the middle of a long message, and write as escapes what a terminal obeys."""
        line = " ".join(message.splitlines())
        if len(line) > _LONGEST_LINE:
            line = line[: _LONGEST_LINE // 2] + " ... " + line[-_LONGEST_LINE // 2 :]
        shown = (x if x.isprintable() else x.encode("unicode_escape").decode() for x in line)
        super().__init__("".join(shown))


class Wheel(NamedTuple):
    """The calibration of one wheel and its motor."""

    dead_band: float
    """Motor value up to which the wheel does not turn."""
    full_speed: float
    """Speed at a motor value of 1 [m/s]."""


class Calibration(NamedTuple):
    """The calibration of a robot."""

    left: Wheel
    right: Wheel
    lag: float
    """Time constant of the motors [s]."""
    separation: float
    """Distance between the two wheels [m]."""


def default_calibration() -> Calibration:
    """Return the calibration of the simulated robot `real`, for a robot without measurements."""
    wheel = Wheel(dead_band=0.12, full_speed=0.408)
    return Calibration(wheel, wheel, DEFAULT_LAG, DEFAULT_SEPARATION)


def check_calibration(calibration: Calibration) -> Calibration:
    """Check that all numbers of a calibration are within bounds, and return it.

    Raises:
      DriveError: A number is out of bounds.
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
            raise DriveError(f"{name} = {value!r} is not a number")
        if not low <= value <= high:
            # A whole number of a file may be too large for a float.
            told = f"{value:g}" if isinstance(value, float) else str(value)[:20]
            raise DriveError(f"{name} = {told} is not between {low:g} and {high:g}")
    return calibration


def as_json(calibration: Calibration) -> dict:
    """Return a calibration as JSON, as its file holds it."""
    return {
        "left": dict(calibration.left._asdict()),
        "right": dict(calibration.right._asdict()),
        "lag": calibration.lag,
        "separation": calibration.separation,
    }


def read_calibration(path: str) -> Calibration:
    """Read a calibration file.

    Args:
      path: The file that `calibrate.py` wrote.

    Raises:
      DriveError: The file is missing, or is not a calibration.
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
        raise DriveError(f"--calibration {path} is not a calibration: {error}")
    except DriveError as error:
        raise DriveError(f"--calibration {path}: {error}")


def motor_value(speed: float, wheel: Wheel) -> float:
    """Return the motor value that turns a wheel at a speed.

        m = sign(v) (dead + (1 - dead) |v| / full)

    Args:
      speed: Speed v [m/s], negative backwards; it is clipped to what the motor reaches.
      wheel: The calibration of the wheel.

    Returns:
      The motor value m in [-1, 1]; zero where the wheel should stand.
    """
    if abs(speed) < _STANDSTILL:
        return 0.0
    share = min(abs(speed) / wheel.full_speed, 1.0)
    return math.copysign(wheel.dead_band + (1.0 - wheel.dead_band) * share, speed)


def wheel_speed(value: float, wheel: Wheel) -> float:
    """Return the speed [m/s] at a motor value; the inverse of `motor_value`."""
    beyond = max(abs(value) - wheel.dead_band, 0.0) / (1.0 - wheel.dead_band)
    return math.copysign(wheel.full_speed * beyond, value)


def stop(robot: Any) -> None:
    """Set both motors to zero, and try again where the bus fails.

    Raises:
      OSError: It failed every time, and the robot may still drive.
    """
    for attempt in range(_STOP_TRIES):
        try:
            robot.set_motors(0.0, 0.0)
            return
        except OSError:
            if attempt == _STOP_TRIES - 1:
                raise
