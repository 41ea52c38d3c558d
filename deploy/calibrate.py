"""Measures the motors: `python3 calibrate.py --output calibration.json`.

The robot drives straight twice, slowly and faster, and asks each time how far it came and how far
it turned. That is enough for the dead-band and the full speed of either wheel. Give it 1 m of
floor; measure from axle to axle in a straight line, and turns in degrees, positive to the left.
"""

import argparse
import json
import math
import sys
from typing import Any, Callable, NamedTuple, Optional

from drive import WallClock, at_least, make_robot
from motors import (
    DEFAULT_LAG,
    DEFAULT_SEPARATION,
    Calibration,
    DriveError,
    Wheel,
    as_json,
    check_calibration,
    default_calibration,
    stop,
)


class Trial(NamedTuple):
    """One drive with both motors at the same value."""

    value: float
    seconds: float
    """How long."""
    distance: float
    """How far it came, in a straight line [m]."""
    turn: float
    """How far it turned to the left [rad]."""


def solve(trials: list, separation: float, lag: float) -> Calibration:
    """The calibration that explains two drives.

    A wheel's speed is taken to be linear in the motor value above the dead-band. What the lag
    costs at the start it gives back at the end, when the robot rolls out.

    Args:
      trials: two, at different values.
      separation: of the wheels [m].
      lag: of the motors [s], kept as it is.

    Returns:
      The calibration.

    Raises:
      DriveError: no robot drives so.
    """
    wheels = []
    for side in (-1.0, 1.0):
        points = []
        for trial in trials:
            half = 0.5 * trial.turn
            # The way along the arc, whose chord was measured.
            arc = trial.distance * (half / math.sin(half) if abs(half) > 1e-6 else 1.0)
            points.append((trial.value, (arc + side * half * separation) / trial.seconds))
        (slow, slow_speed), (fast, fast_speed) = sorted(points)
        if not 0.0 < slow_speed < fast_speed:
            raise DriveError(
                "the {} wheel did not drive faster at {:g} ({:.3f} m/s) than at {:g} ({:.3f} m/s):"
                " measure again, with other --values".format(
                    "left" if side < 0 else "right", fast, fast_speed, slow, slow_speed
                )
            )
        slope = (fast_speed - slow_speed) / (fast - slow)
        dead_band = max(slow - slow_speed / slope, 0.0)
        wheels.append(Wheel(round(dead_band, 4), round(slope * (1.0 - dead_band), 4)))
    return check_calibration(Calibration(wheels[0], wheels[1], lag, separation))


def run_trial(robot: Any, clock: Any, value: float, seconds: float, measure: Callable) -> Trial:
    """Drives straight and asks how it went.

    Args:
      robot: has `set_motors`.
      clock: has `sleep`.
      value: of both motors.
      seconds: how long.
      measure: returns distance [m] and turn [rad].

    Returns:
      What was measured. Whatever happens, the motors have been set to zero.
    """
    try:
        robot.set_motors(value, value)
        clock.sleep(seconds)
    finally:
        stop(robot)
    clock.sleep(1.0)
    distance, turn = measure()
    return Trial(value, seconds, distance, turn)


def _ask() -> tuple:
    while True:
        try:
            distance = float(input("  how far did it come [m]? "))
            return distance, math.radians(float(input("  how far did it turn left [degrees]? ")))
        except ValueError:
            print("  a number, please")


def main(
    arguments: Optional[list] = None,
    robot: Any = None,
    clock: Any = None,
    measure: Callable = _ask,
) -> int:
    """Parses the command line, drives and writes the file.

    Args:
      arguments: without the program's name; None: those of the process.
      robot: has `set_motors`; None: NVIDIA's.
      clock: has `sleep`; None: the wall's.
      measure: returns distance [m] and turn [rad] of one drive.

    Returns:
      The exit code: 0, 2 after a mistake, or 130 after Ctrl-C.
    """
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--output", default="calibration.json", metavar="FILE")
    parser.add_argument("--values", nargs=2, type=at_least(0.05), default=(0.3, 0.5), metavar="M")
    parser.add_argument("--seconds", type=at_least(0.5), default=2.0, metavar="S")
    parser.add_argument("--separation", type=float, default=DEFAULT_SEPARATION, metavar="M")
    parser.add_argument("--lag", type=float, default=DEFAULT_LAG, metavar="S")
    options = parser.parse_args(arguments)
    if options.values[0] == options.values[1] or max(options.values) > 1:
        parser.error("--values wants two different ones, at most 1")
    try:
        # What is wrong is told before the robot drives.
        check_calibration(
            default_calibration()._replace(separation=options.separation, lag=options.lag)
        )
        robot, clock, trials = robot or make_robot(), clock or WallClock(), []
        for value in options.values:
            print(f"both motors at {value:g} for {options.seconds:g} s")
            trials.append(run_trial(robot, clock, value, options.seconds, measure))
        calibration = solve(trials, options.separation, options.lag)
        with open(options.output, "w") as file:
            file.write(json.dumps(as_json(calibration), indent=2) + "\n")
    except DriveError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"error: {options.output}: {error.strerror}", file=sys.stderr)
        return 2
    except (KeyboardInterrupt, EOFError):
        print("\ninterrupted", file=sys.stderr)
        return 130
    print(f"{options.output}: {json.dumps(as_json(calibration))}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
