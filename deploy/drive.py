"""Drives a JetBot to a goal: `python3 drive.py POLICY --goal X Y`.

Runs on the robot with Python 3.6 or newer and NumPy, and there with NVIDIA's `jetbot`. POLICY is
the folder that `python -m jetbot_mjx.export` wrote. X and Y are metres: ahead and to the left of
the robot as it stands, or in the frame of a tracker (`--tracker PORT`, see poses.py). A tracker on
another machine needs `--tracker-host 0.0.0.0`, and a key that it shares with the robot.

The motors are set to zero before the first command; while the newest pose is older than
`--stale-after`; at the goal, at `--timeout`, after any error, on Ctrl-C, SIGTERM and SIGHUP.
`--dry-run` drives nothing but the dead reckoning. Exit codes: 0 at the goal, 1 not, 2 a mistake
in one line, 128 + n by signal n.
"""

import argparse
import contextlib
import json
import math
import os
import signal
import sys
import time
import types
from typing import Any, Callable, Iterator, NamedTuple, Optional

from datagrams import Key
from motors import (
    Calibration,
    DriveError,
    as_json,
    default_calibration,
    motor_value,
    read_calibration,
    stop,
    wheel_speed,
)
from observations import Observer
from poses import Odometry, Pose, Tracker, udp_tracker

LOG_FORMAT = "jetbot_mjx-drive/1"

STALE_AFTER = 0.08
"""[s] With the 17 ms of a control period the motors are at zero within 100 ms."""

_NEEDED = (
    *("files", "observation", "rest_quaternion", "rest_height", "goal_height", "success_radius"),
    *("control_period", "wheel_speeds", "run", "env_steps", "task", "robot"),
)
"""What a drive takes from `policy.json`."""

_SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)

Log = Callable[[dict], Any]


class Policy(NamedTuple):
    """What `jetbot_mjx.export` wrote."""

    act: Callable
    """Of an observation; returns the action and wheel speeds (left, right) [rad/s]."""
    contract: dict
    """`policy.json`."""


class Settings(NamedTuple):
    """What a drive is to do."""

    goal: tuple
    """Where to, (x, y) in the frame of the poses [m]."""
    timeout: float
    """Until when [s]."""
    stale_after: float
    """Age of a pose beyond which the motors are stopped [s]."""
    arrive_within: float
    """Distance at which the goal is reached [m]."""


class Outcome(NamedTuple):
    """How a drive ended."""

    reached: bool
    """Whether at the goal."""
    seconds: float
    """Since the start."""
    distance: Optional[float]
    """From the goal, by the last pose [m]; None where none ever came."""
    ticks: int
    """Control periods."""
    late_ticks: int
    """Those that ended after the next should have begun."""
    stale_ticks: int
    """Those without a fresh pose."""


class WallClock:
    """The time that passes for us all."""

    def now(self) -> float:
        """Seconds since some moment."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Waits."""
        time.sleep(seconds)


class NoRobot:
    """Takes motor values and does nothing with them."""

    def set_motors(self, left_speed: float, right_speed: float) -> None:
        """Does nothing."""


def load_policy(folder: str) -> Policy:
    """Loads what `jetbot_mjx.export` wrote.

    Args:
      folder: with `policy.py` and `policy.json`.

    Returns:
      The policy.

    Raises:
      DriveError: it is not such a folder.
    """
    try:
        with open(os.path.join(folder, "policy.json"), encoding="utf-8") as file:
            contract = json.load(file)
        path = os.path.join(folder, "policy.py")
        missing = [name for name in _NEEDED if name not in contract]
        if missing:
            raise DriveError(f"{folder} is no exported policy: policy.json lacks {missing[0]}")
        if "numpy" not in contract["files"] or not os.path.isfile(path):
            raise DriveError(f"{folder} holds no policy.py: export it with --format numpy")
        with open(path, encoding="utf-8") as file:
            source = file.read()
        module = types.ModuleType("policy")
        exec(compile(source, path, "exec"), module.__dict__)
        return Policy(module.__dict__["act"], contract)
    except OSError as error:
        raise DriveError(f"{folder} is no exported policy: {error.strerror}")
    except (ValueError, LookupError, TypeError, SyntaxError, RecursionError) as error:
        raise DriveError(f"{folder} is no exported policy: {error}")
    except ImportError as error:
        raise DriveError(f"{path} cannot be run here: {error}")


def arrival_radius(contract: dict) -> float:
    """The success radius of training, which is one in space, as one on the floor [m]."""
    above = contract["goal_height"] - contract["rest_height"]
    return math.sqrt(max(contract["success_radius"] ** 2 - above**2, 0.0))


def drive(
    robot: Any,
    clock: Any,
    poses: Any,
    policy: Policy,
    calibration: Calibration,
    settings: Settings,
    log: Optional[Log] = None,
) -> Outcome:
    """Drives until the goal or the time is reached, at the rate of training.

    Args:
      robot: has `set_motors(left, right)`, values in [-1, 1].
      clock: has `now()` and `sleep(seconds)`.
      poses: a source of `poses.py`.
      policy: of `load_policy`.
      calibration: of the motors.
      settings: where to, and how long.
      log: is given each period as a dict; None: nobody is.

    Returns:
      How it ended. Whatever way it ends, the motors have been set to zero.

    Raises:
      DriveError: the policy wants an observation that cannot be made.
    """
    try:
        stop(robot)
        return _drive(
            robot, clock, poses, policy, calibration, settings, log or (lambda line: None)
        )
    finally:
        stop(robot)


def _drive(
    robot: Any,
    clock: Any,
    poses: Any,
    policy: Policy,
    calibration: Calibration,
    settings: Settings,
    log: Log,
) -> Outcome:
    observe = Observer(policy.contract)
    period = policy.contract["control_period"]
    radius = policy.contract["wheel_speeds"]["wheel_radius"]
    # The first call of a policy takes far longer than a period.
    policy.act(observe(Pose(0.0, 0.0, 0.0, 0.0, 0.0, 0.0), settings.goal))
    start = due = clock.now()
    distance, ticks, late, stale = None, 0, 0, 0
    while True:
        began = clock.now()
        pose = poses.read(began)
        line = {"t": began - start, "fresh": False}
        values, reached = (0.0, 0.0), False
        if pose is not None:
            fresh = began - pose.time <= settings.stale_after
            distance = math.hypot(settings.goal[0] - pose.x, settings.goal[1] - pose.y)
            reached = fresh and distance < settings.arrive_within
            line.update(pose._asdict(), fresh=fresh, pose_age=began - pose.time)
            del line["time"]
            if fresh and not reached:
                action, wheels = policy.act(observe(pose, settings.goal))
                line["action"] = [float(one) for one in action]
                line["wheel_speeds"] = [float(one) for one in wheels]
                # A policy that has lost its mind stands still.
                if all(math.isfinite(wheel) for wheel in wheels):
                    values = (
                        motor_value(float(wheels[0]) * radius, calibration.left),
                        motor_value(float(wheels[1]) * radius, calibration.right),
                    )
        if reached or began - start >= settings.timeout:
            stop(robot)
            log(dict(line, motors=[0.0, 0.0], outcome="reached" if reached else "timed out"))
            return Outcome(reached, began - start, distance, ticks, late, stale)
        robot.set_motors(*values)
        done = clock.now()
        left = wheel_speed(values[0], calibration.left)
        right = wheel_speed(values[1], calibration.right)
        poses.commanded(done, left, right)
        due += period
        behind = done > due
        log(dict(line, motors=list(values), latency=done - began, late=behind))
        ticks, late, stale = ticks + 1, late + behind, stale + (not line["fresh"])
        if behind:
            due = clock.now()
        else:
            clock.sleep(max(due - clock.now(), 0.0))


def log_header(policy: Policy, calibration: Calibration, settings: Settings, source: str) -> dict:
    """The first line of a log: all that is needed to replay what follows."""
    contract = policy.contract
    return {
        "format": LOG_FORMAT,
        "policy": {name: contract[name] for name in ("run", "env_steps", "task", "robot")},
        "goal": list(settings.goal),
        "arrive_within": settings.arrive_within,
        "control_period": contract["control_period"],
        "pose_source": source,
        "calibration": as_json(calibration),
    }


@contextlib.contextmanager
def _log_file(path: Optional[str]) -> Iterator[Optional[Log]]:
    if path is None:
        yield None
        return
    try:
        # A line at a time: what was driven before a battery ran out is there.
        file = open(path, "w", buffering=1, encoding="utf-8")  # noqa: SIM115
    except OSError as error:
        raise DriveError(f"--log {path}: {error.strerror}")
    with file:
        yield lambda line: file.write(json.dumps(line) + "\n")


def _leave(number: int, frame: Any) -> None:
    # A second signal must not interrupt the stopping.
    for one in _SIGNALS:
        signal.signal(one, signal.SIG_IGN)
    sys.exit(128 + number)


@contextlib.contextmanager
def _leaving_by_signals() -> Iterator[None]:
    before = {one: signal.signal(one, _leave) for one in _SIGNALS}
    try:
        yield
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)


def at_least(least: float, most: float = 1e9) -> Callable[[str], float]:
    """An argument that is a number between two bounds."""

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r} is no number")
        if not value >= least:
            raise argparse.ArgumentTypeError(f"{text} is not at least {least:g}")
        if value > most:
            raise argparse.ArgumentTypeError(f"{text} is more than {most:g}")
        return value

    return parse


def make_robot() -> Any:
    """NVIDIA's robot.

    Raises:
      DriveError: its package is not installed.
    """
    try:
        from jetbot import Robot  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise DriveError(f"no robot here ({error}): run this on the JetBot, or with --dry-run")
    return Robot()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("policy", help="the folder that jetbot_mjx.export wrote")
    parser.add_argument(
        "--goal",
        nargs=2,
        type=at_least(-1000.0, 1000.0),
        metavar=("X", "Y"),
        required=True,
        help="[m]",
    )
    parser.add_argument("--calibration", metavar="FILE", help="of calibrate.py")
    parser.add_argument("--tracker", type=int, metavar="PORT", help="UDP; default: dead reckoning")
    parser.add_argument(
        "--tracker-host", metavar="HOST", help="address to listen at (default: this machine alone)"
    )
    parser.add_argument(
        "--tracker-key", metavar="FILE", help="what the tracker signs with, see datagrams.py"
    )
    parser.add_argument("--timeout", type=at_least(0.0), default=30.0, metavar="S")
    parser.add_argument("--stale-after", type=at_least(0.0), default=STALE_AFTER, metavar="S")
    parser.add_argument("--log", metavar="FILE", help="one JSON object for each control period")
    parser.add_argument("--dry-run", action="store_true", help="no robot: dead reckoning alone")
    return parser


def _pose_source(options: argparse.Namespace, calibration: Calibration) -> Any:
    host, key = options.tracker_host, options.tracker_key
    if options.tracker is None:
        for name, value in (("host", host), ("key", key)):
            if value is not None:
                raise DriveError(f"--tracker-{name} says how to listen: give --tracker PORT too")
        return Odometry(calibration)
    return udp_tracker(options.tracker, host or "127.0.0.1", None if key is None else Key(key))


def main(arguments: Optional[list] = None, clock: Any = None) -> int:
    """Parses the command line and drives.

    Args:
      arguments: without the program's name; None: those of the process.
      clock: has `now()` and `sleep(seconds)`; None: the wall's.

    Returns:
      The exit code.
    """
    options = _parser().parse_args(arguments)
    try:
        policy = load_policy(options.policy)
        calibration = default_calibration()
        if options.calibration:
            calibration = read_calibration(options.calibration)
        settings = Settings(
            tuple(options.goal),
            options.timeout,
            options.stale_after,
            arrival_radius(policy.contract),
        )
        robot = NoRobot() if options.dry_run else make_robot()
        poses = _pose_source(options, calibration)
        with contextlib.closing(poses), _log_file(options.log) as log, _leaving_by_signals():
            if log is not None:
                log(log_header(policy, calibration, settings, poses.name))
            outcome = drive(robot, clock or WallClock(), poses, policy, calibration, settings, log)
    except DriveError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    if isinstance(poses, Tracker) and poses.rejected:
        print(f"{poses.rejected} datagrams were not believed, the last because {poses.reason}")
    nearest = "no pose came" if outcome.distance is None else f"{outcome.distance:.3f} m from it"
    print(
        f"{'reached' if outcome.reached else 'not reached'} after {outcome.seconds:.2f} s,"
        f" {nearest}; {outcome.ticks} periods, {outcome.late_ticks} late,"
        f" {outcome.stale_ticks} without a fresh pose"
    )
    return 0 if outcome.reached else 1


if __name__ == "__main__":
    sys.exit(main())
