"""Calibrate the motors: `python3 calibrate.py --output calibration.json`.

The robot drives straight twice, slowly and faster, and the program asks after each drive how far it
drove and turned. From that it computes the dead-band and the full speed of each wheel. The robot
needs 1 m of free floor. Measure distances from axle to axle in a straight line, and turns in
degrees, positive to the left.
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
    """Duration [s]."""
    distance: float
    """Distance from start to end, in a straight line [m]."""
    turn: float
    """Turn to the left [rad]."""


def solve(trials: list, separation: float, lag: float) -> Calibration:
    """Return the calibration that explains two drives.

    Above the dead-band a wheel's speed is assumed to be linear in the motor value. The distance
    that the lag costs at the start is recovered at the end, when the robot rolls to a stop.

    Args:
      trials: Two trials, at different motor values.
      separation: Distance between the wheels [m].
      lag: Lag of the motors [s]; it is not measured.

    Raises:
      DriveError: The measurements contradict each other.
    """
    wheels = []
    for side in (-1.0, 1.0):
        # Compute the wheel's speed in each trial.
        points = []
        for trial in trials:
            half = 0.5 * trial.turn
            # The length of the arc, whose chord was measured.
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

        # Fit a line through the two points; it crosses zero at the dead-band.
        slope = (fast_speed - slow_speed) / (fast - slow)
        dead_band = max(slow - slow_speed / slope, 0.0)
        wheels.append(Wheel(round(dead_band, 4), round(slope * (1.0 - dead_band), 4)))
    return check_calibration(Calibration(wheels[0], wheels[1], lag, separation))


def run_trial(robot: Any, clock: Any, value: float, seconds: float, measure: Callable) -> Trial:
    """Drive straight, set the motors to zero, and ask for the measurements.

    Args:
      robot: A robot with `set_motors`.
      clock: A clock with `sleep`.
      value: Motor value of both motors.
      seconds: Duration [s].
      measure: Returns distance [m] and turn [rad].

    Returns:
      The trial. The motors are set to zero after an exception too.
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
            distance = float(input("  how far did it drive [m]? "))
            return distance, math.radians(float(input("  how far did it turn left [degrees]? ")))
        except ValueError:
            print("  please enter a number")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--output",
        default="calibration.json",
        metavar="FILE",
        help="file to write (default: calibration.json)",
    )
    parser.add_argument(
        "--values",
        nargs=2,
        type=at_least(0.05),
        default=(0.3, 0.5),
        metavar="M",
        help="motor values of the two drives (default: 0.3 0.5)",
    )
    parser.add_argument(
        "--seconds",
        type=at_least(0.5),
        default=2.0,
        metavar="S",
        help="duration of a drive [s] (default: 2)",
    )
    parser.add_argument(
        "--separation",
        type=float,
        default=DEFAULT_SEPARATION,
        metavar="M",
        help="distance between the wheels [m] (default: 0.114)",
    )
    parser.add_argument(
        "--lag",
        type=float,
        default=DEFAULT_LAG,
        metavar="S",
        help="lag of the motors [s] (default: 0.1)",
    )
    return parser


def main(
    arguments: Optional[list] = None,
    robot: Any = None,
    clock: Any = None,
    measure: Callable = _ask,
) -> int:
    """Parse the command line, drive and write the file.

    Args:
      arguments: Arguments without the program's name; None: those of the process.
      robot: A robot with `set_motors`; None: NVIDIA's.
      clock: A clock with `sleep`; None: real time.
      measure: Returns distance [m] and turn [rad] of one drive.

    Returns:
      The exit code: 0, 2 after a mistake, or 130 after Ctrl-C.
    """
    # Check all arguments before the robot drives.
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.values[0] == options.values[1] or max(options.values) > 1:
        parser.error("--values needs two different motor values, at most 1")
    try:
        check_calibration(
            default_calibration()._replace(separation=options.separation, lag=options.lag)
        )

        # Drive twice, and write what the measurements give.
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
