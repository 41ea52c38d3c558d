"""Drive a JetBot to a goal: `python3 drive.py POLICY --goal X Y`, or `--camera`.

It runs on the robot with Python 3.6 or newer, NumPy and NVIDIA's `jetbot`. POLICY is the folder
that `jetbot-mjx export` wrote. X and Y are metres: ahead and to the left of the robot at
the start, or in the frame of a tracker (`--tracker PORT`, see poses.py). A tracker on another
machine needs `--tracker-host 0.0.0.0`, and a key that it shares with the robot.

A policy that sees drives by the robot's camera alone, `--camera`: see camera_sense.py. The goal is
reached when its nearest edge is `--arrive-within` metres from the axle.

The motors are set to zero before the first command; while the newest pose or picture is older than
`--stale-after`; at the goal, at `--timeout`, after any error, on Ctrl-C, SIGTERM and SIGHUP.
`--dry-run` needs no robot and takes poses from dead reckoning. Exit codes: 0 goal reached, 1 goal
not reached, 2 wrong usage, 128 + n after signal n.
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
from typing import Any, Callable, Iterator, NamedTuple, Optional, Union

from camera_sense import (
    ARRIVE_WITHIN,
    FRAME_STALE_AFTER,
    GOAL_COLOUR,
    CameraSense,
    CameraSettings,
    make_camera,
)
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
from observations import PoseSense
from poses import Odometry, Tracker, udp_tracker
from undistort import read_lens

LOG_FORMAT = "jetbot_mjx-drive/1"

STALE_AFTER = 0.08
"""[s] Together with a control period of 17 ms, the motors are at zero within 100 ms."""

_NEEDED = (
    *("files", "observation", "rest_quaternion", "rest_height", "goal_height", "success_radius"),
    *("control_period", "wheel_speeds", "run", "env_steps", "task", "robot"),
)
"""Keys of `policy.json` that a drive needs."""

_NEEDED_OF_IMAGE = ("height", "width", "grey", "frames", "camera")
_NEEDED_OF_CAMERA = ("position", "pitch_down_degrees", "lens", "matrix", "distortion")
"""Those of its entries `image` and `image.camera`, of a policy that sees."""

_NUMBERS = (
    ("rest_height", 1, -10.0, 10.0),
    ("goal_height", 1, -10.0, 10.0),
    ("success_radius", 1, 0.0, 1000.0),
    ("control_period", 1, 1e-4, 10.0),
    ("rest_quaternion", 4, -1.01, 1.01),
    ("wheel_speeds.wheel_radius", 1, 1e-4, 10.0),
)
"""What of them is numbers: the key, how many numbers, and the least and largest of them."""

_NUMBERS_OF_IMAGE = (
    ("image.height", 1, 1, 4096),
    ("image.width", 1, 1, 4096),
    ("image.frames", 1, 1, 64),
    ("image.camera.position", 3, -10.0, 10.0),
    ("image.camera.pitch_down_degrees", 1, -180.0, 180.0),
    ("image.camera.distortion", range(9), -1e3, 1e3),
    ("image.camera.matrix.fx", 1, 1e-3, 1e6),
    ("image.camera.matrix.fy", 1, 1e-3, 1e6),
    ("image.camera.matrix.cx", 1, -1e6, 1e6),
    ("image.camera.matrix.cy", 1, -1e6, 1e6),
)
"""Those of a policy that sees; bounds without a point are of whole numbers."""

_MOST_CHARACTERS = 1000000
"""Longest `policy.json`."""

_SIGNALS = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP)

Log = Callable[[dict], Any]


class Policy(NamedTuple):
    """An exported policy."""

    act: Callable
    """From an observation to the action and the wheel speeds (left, right) [rad/s]."""
    spec: dict
    """The policy spec, `policy.json`."""
    stack: Optional[Callable] = None
    """Stacks the images of several control periods, of a policy that sees."""


class Settings(NamedTuple):
    """The settings of one drive."""

    goal: tuple
    """Position (x, y) of the goal in the frame of the poses [m]."""
    timeout: float
    """Time limit [s]."""
    stale_after: float
    """Age of a pose above which the motors are stopped [s]."""
    arrive_within: float
    """Distance below which the goal is reached [m]."""


class Outcome(NamedTuple):
    """The result of one drive."""

    reached: bool
    """Whether the goal was reached."""
    seconds: float
    """Duration of the drive [s]."""
    distance: Optional[float]
    """Distance of the last pose from the goal [m]; None without any pose."""
    ticks: int
    """Number of control periods."""
    late_ticks: int
    """Number of periods that ended after the next should have begun."""
    stale_ticks: int
    """Number of periods without a fresh pose."""


class WallClock:
    """The clock of real time."""

    def now(self) -> float:
        """Return the time since a fixed moment [s]."""
        return time.monotonic()

    def sleep(self, seconds: float) -> None:
        """Wait for a time [s]."""
        time.sleep(seconds)


class NoRobot:
    """A robot for dry runs, which ignores motor values."""

    def set_motors(self, left_speed: float, right_speed: float) -> None:
        """Ignore the motor values."""


def load_policy(folder: str) -> Policy:
    """Load an exported policy.

    Args:
      folder: The folder that `jetbot_mjx.export` wrote, with `policy.py` and `policy.json`.

    Raises:
      DriveError: The folder holds no such policy, or it cannot be run on this machine.
    """
    try:
        with open(os.path.join(folder, "policy.json"), encoding="utf-8") as file:
            text = file.read(_MOST_CHARACTERS + 1)
        if len(text) > _MOST_CHARACTERS:
            raise DriveError(f"{folder} is not an exported policy: policy.json is too long")
        spec = json.loads(text)
        path = os.path.join(folder, "policy.py")
        flaw = _flaw(spec)
        if flaw:
            raise DriveError(f"{folder} is not an exported policy: policy.json {flaw}")
        if "numpy" not in dict(spec["files"]) or not os.path.isfile(path):
            raise DriveError(f"{folder} has no policy.py: export it with --format numpy")
        with open(path, encoding="utf-8") as file:
            source = file.read()
        module = types.ModuleType("policy")
        exec(compile(source, path, "exec"), module.__dict__)
        policy = Policy(module.__dict__["act"], spec, module.__dict__.get("stack"))
        if policy.stack is None and "image" in spec and spec["image"]["frames"] > 1:
            raise DriveError(f"{folder} is not an exported policy: policy.py lacks stack")
        return policy
    except OSError as error:
        raise DriveError(f"{folder} is not an exported policy: {error.strerror}")
    except (
        AttributeError,
        LookupError,
        RecursionError,
        SyntaxError,
        TypeError,
        ValueError,
    ) as error:
        raise DriveError(f"{folder} is not an exported policy: {error}")
    except ImportError as error:
        raise DriveError(f"{path} cannot be run here: {error}")


def _flaw(spec: Any) -> Optional[str]:
    """Return what a drive needs and does not find in a policy spec, or None."""
    if not isinstance(spec, dict):
        return "holds no object"
    needed, numbers = list(_NEEDED), _NUMBERS
    if "image" in spec:
        needed += ["image." + name for name in _NEEDED_OF_IMAGE]
        needed += ["image.camera." + name for name in _NEEDED_OF_CAMERA]
        numbers += _NUMBERS_OF_IMAGE
    for name in needed + [row[0] for row in numbers]:
        if _entry(spec, name) is _MISSING:
            return "lacks " + name
    for name, count, least, most in numbers:
        value = _entry(spec, name)  # type: Any
        kinds = (int,) if isinstance(least, int) else (int, float)
        values = [value] if count == 1 else value if isinstance(value, list) else []  # type: list
        counts = (count,) if isinstance(count, int) else count
        if len(values) not in counts or not all(
            type(one) in kinds and least <= one <= most for one in values
        ):
            what = "a number" if count == 1 else f"{max(counts)} numbers"
            bounds = f"from {least:g} to {most:g}"
            return f"has {name} = {_shown(value)}: it should be {what} {bounds}"
    parts = spec["observation"]
    if not isinstance(parts, list) or not all(map(_is_part, parts)):
        return "has no list of observations with name, frame and index"
    if "image" in spec and spec["image"]["camera"]["lens"] not in ("pinhole", "opencv", "fisheye"):
        return f"has image.camera.lens = {_shown(spec['image']['camera']['lens'])}"
    return None


_MISSING = object()


def _entry(spec: Any, name: str) -> Any:
    """Return the value below several keys, or `_MISSING`."""
    for key in name.split("."):
        spec = spec.get(key, _MISSING) if isinstance(spec, dict) else _MISSING
    return spec


def _is_part(part: Any) -> bool:
    return (
        isinstance(part, dict)
        and all(isinstance(part.get(name), str) for name in ("name", "frame"))
        and isinstance(part.get("index"), list)
    )


def _shown(value: Any) -> str:
    """Return a value in a few characters, also a number of more digits than Python writes."""
    try:
        text = repr(value)
    except (ValueError, RecursionError):
        return "what is too long to be shown"
    return text if len(text) <= 80 else text[:80] + "..."


def arrival_radius(spec: dict) -> float:
    """Return the success radius on the floor [m]: that of training is measured in space.

    Args:
      spec: The policy spec.
    """
    above = spec["goal_height"] - spec["rest_height"]
    return math.sqrt(max(spec["success_radius"] ** 2 - above**2, 0.0))


def drive(
    robot: Any,
    clock: Any,
    poses: Any,
    policy: Policy,
    calibration: Calibration,
    settings: Settings,
    log: Optional[Log] = None,
) -> Outcome:
    """Drive to the goal, at the control rate of training, and set the motors to zero at the end.

    Args:
      robot: A robot with `set_motors(left, right)`, which takes values in [-1, 1].
      clock: A clock with `now()` and `sleep(seconds)`.
      poses: A pose source of `poses.py`.
      policy: The policy.
      calibration: The calibration of the motors.
      settings: The goal and the limits of the drive.
      log: A function that is called with a dict for each control period, or None.

    Returns:
      The result: the goal is reached, or the time is over. The motors are set to zero after an
      exception too.

    Raises:
      DriveError: The policy needs an observation that this driver cannot provide.
    """
    sense = PoseSense(poses, policy.spec, settings)
    return drive_by(robot, clock, sense, policy, calibration, settings.timeout, log)


def drive_by(
    robot: Any,
    clock: Any,
    sense: Any,
    policy: Policy,
    calibration: Calibration,
    timeout: float,
    log: Optional[Log] = None,
) -> Outcome:
    """Drive by a sense, at the control rate of training, and set the motors to zero at the end.

    Args:
      robot: As for `drive`, like all arguments that are not named here.
      clock: The clock.
      sense: A `PoseSense`, or a `CameraSense` of camera_sense.py.
      policy: The policy.
      calibration: The calibration of the motors.
      timeout: Time limit [s].
      log: The log.

    Returns:
      The result. The motors are set to zero after an exception too.
    """
    try:
        stop(robot)
        return _drive(robot, clock, sense, policy, calibration, timeout, log or (lambda line: None))
    finally:
        stop(robot)


def _drive(
    robot: Any,
    clock: Any,
    sense: Any,
    policy: Policy,
    calibration: Calibration,
    timeout: float,
    log: Log,
) -> Outcome:
    period = policy.spec["control_period"]
    # The first call of a policy takes far longer than a period, so make it before the start.
    policy.act(*sense.example())
    start = due = clock.now()
    distance, ticks, late, stale = None, 0, 0, 0
    while True:
        # Let the policy set the motor values where what the sense tells is fresh.
        began = clock.now()
        seen = sense.read(began)
        line = dict(seen.line, t=began - start, fresh=seen.fresh)
        distance = distance if seen.distance is None else seen.distance
        values = (0.0, 0.0)
        if seen.fresh and not seen.reached:
            action, wheels = policy.act(*seen.inputs)
            line["action"] = [float(value) for value in action]
            line["wheel_speeds"] = [float(value) for value in wheels]
            values = _motor_values(line["wheel_speeds"], policy, calibration)

        # Finish at the goal or the time limit, before the motors are set again.
        if seen.reached or began - start >= timeout:
            stop(robot)
            outcome = "reached" if seen.reached else "timed out"
            log(dict(line, motors=[0.0, 0.0], outcome=outcome))
            return Outcome(seen.reached, began - start, distance, ticks, late, stale)

        # Set the motors, and tell the sense for its dead reckoning.
        robot.set_motors(*values)
        done = clock.now()
        left = wheel_speed(values[0], calibration.left)
        right = wheel_speed(values[1], calibration.right)
        sense.commanded(done, left, right)

        # Wait for the next period. After a late one the schedule starts anew, so that lost time
        # is not made up by shorter periods.
        due += period
        behind = done > due
        log(dict(line, motors=list(values), latency=done - began, late=behind))
        ticks, late, stale = ticks + 1, late + behind, stale + (not seen.fresh)
        if behind:
            due = clock.now()
        else:
            clock.sleep(max(due - clock.now(), 0.0))


def _motor_values(wheel_speeds: list, policy: Policy, calibration: Calibration) -> tuple:
    # If the policy returns non-finite numbers, the robot stands still.
    if not all(math.isfinite(speed) for speed in wheel_speeds):
        return 0.0, 0.0
    radius = policy.spec["wheel_speeds"]["wheel_radius"]
    left, right = wheel_speeds
    return (
        motor_value(left * radius, calibration.left),
        motor_value(right * radius, calibration.right),
    )


def log_header(
    policy: Policy,
    calibration: Calibration,
    settings: Union[Settings, CameraSettings],
    source: str,
) -> dict:
    """Return the first line of a log, with all that is needed to replay the drive.

    Args:
      policy: The policy.
      calibration: The calibration of the motors.
      settings: The settings of the drive.
      source: The name of the pose source, or `camera`.
    """
    spec, by_camera = policy.spec, isinstance(settings, CameraSettings)
    arrival = ("arrive_within", "goal_colour") if by_camera else ("arrive_within",)
    return dict(
        {name: getattr(settings, name) for name in arrival},
        format=LOG_FORMAT,
        policy={name: spec[name] for name in ("run", "env_steps", "task", "robot")},
        goal=None if settings.goal is None else list(settings.goal),
        control_period=spec["control_period"],
        # Beside the camera, poses are those of dead reckoning.
        pose_source="odometry" if by_camera else source,
        calibration=as_json(calibration),
        **({"image": spec["image"]} if by_camera else {}),
    )


@contextlib.contextmanager
def _log_file(path: Optional[str]) -> Iterator[Optional[Log]]:
    if path is None:
        yield None
        return
    try:
        # Each line is written at once, so that the log survives an empty battery.
        file = open(path, "w", buffering=1, encoding="utf-8")  # noqa: SIM115
    except OSError as error:
        raise DriveError(f"--log {path}: {error.strerror}")
    with file:
        yield lambda line: file.write(json.dumps(line) + "\n")


def _exit_on_signal(number: int, frame: Any) -> None:
    # A second signal must not interrupt the stopping of the motors.
    for one in _SIGNALS:
        signal.signal(one, signal.SIG_IGN)
    sys.exit(128 + number)


@contextlib.contextmanager
def _exiting_on_signals() -> Iterator[None]:
    before = {one: signal.signal(one, _exit_on_signal) for one in _SIGNALS}
    try:
        yield
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)


def at_least(least: float, most: float = 1e9) -> Callable[[str], float]:
    """Return a parser of numbers between two bounds, for an argument of the command line."""

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r} is not a number")
        if not value >= least:
            raise argparse.ArgumentTypeError(f"{text} is not at least {least:g}")
        if value > most:
            raise argparse.ArgumentTypeError(f"{text} is more than {most:g}")
        return value

    return parse


def make_robot() -> Any:
    """Return the robot of NVIDIA's package `jetbot`.

    Raises:
      DriveError: The package is not installed.
    """
    try:
        from jetbot import Robot  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise DriveError(
            f"there is no robot here ({error}): run this on the JetBot, or use --dry-run"
        )
    return Robot()


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("policy", help="folder that jetbot_mjx.export wrote")
    parser.add_argument(
        "--goal",
        nargs=2,
        type=at_least(-1000.0, 1000.0),
        metavar=("X", "Y"),
        help="position of the goal [m]; with --camera for the log alone",
    )
    _add_camera_arguments(parser)
    parser.add_argument("--calibration", metavar="FILE", help="file that calibrate.py wrote")
    parser.add_argument(
        "--tracker",
        type=int,
        metavar="PORT",
        help="UDP port of a tracker (default: dead reckoning)",
    )
    parser.add_argument(
        "--tracker-host", metavar="HOST", help="address to listen on (default: this machine only)"
    )
    parser.add_argument(
        "--tracker-key", metavar="FILE", help="key that the tracker signs with, see datagrams.py"
    )
    parser.add_argument(
        "--timeout",
        type=at_least(0.0),
        default=30.0,
        metavar="S",
        help="time limit [s] (default: 30)",
    )
    parser.add_argument(
        "--stale-after",
        type=at_least(0.0),
        metavar="S",
        help="age of a pose or picture above which the motors stop [s]"
        f" (default: {STALE_AFTER:g}; of a picture {FRAME_STALE_AFTER:g})",
    )
    parser.add_argument("--log", metavar="FILE", help="file for one JSON object per control period")
    parser.add_argument(
        "--dry-run", action="store_true", help="turn no motor; by dead reckoning, or --camera"
    )
    return parser


def _add_camera_arguments(parser: argparse.ArgumentParser) -> None:
    """Add what a drive by the camera needs: its switch, its lens and the goal that it sees."""
    parser.add_argument("--camera", action="store_true", help="drive by the robot's camera alone")
    parser.add_argument(
        "--undistort", metavar="FILE", help="OpenCV's calibration of the lens, to take it out"
    )
    parser.add_argument(
        "--arrive-within",
        type=at_least(0.01, 1.0),
        metavar="M",
        help="with --camera: distance from the axle to the edge of the goal when reached [m]"
        f" (default: {ARRIVE_WITHIN:g})",
    )
    parser.add_argument(
        "--goal-colour",
        nargs=3,
        type=at_least(0.0, 255.0),
        metavar=("R", "G", "B"),
        help=f"colour of the goal (default: {' '.join(map(str, GOAL_COLOUR))})",
    )


def _pose_source(options: argparse.Namespace, calibration: Calibration) -> Any:
    host, key = options.tracker_host, options.tracker_key
    if options.tracker is None:
        for name, value in (("host", host), ("key", key)):
            if value is not None:
                raise DriveError(f"--tracker-{name} needs a tracker: give --tracker PORT too")
        return Odometry(calibration)
    return udp_tracker(options.tracker, host or "127.0.0.1", None if key is None else Key(key))


def _sense(options: argparse.Namespace, policy: Policy, calibration: Calibration) -> tuple:
    """Return the sense of a drive, and what is to be closed at its end."""
    if not options.camera:
        for name in ("undistort", "arrive_within", "goal_colour"):
            if getattr(options, name) is not None:
                flag = name.replace("_", "-")
                raise DriveError(f"--{flag} is about pictures: give --camera too")
        if options.goal is None:
            raise DriveError("give --goal X Y, or --camera for a policy that sees")
        stale_after = STALE_AFTER if options.stale_after is None else options.stale_after
        within = arrival_radius(policy.spec)
        settings = Settings(tuple(options.goal), options.timeout, stale_after, within)
        poses = _pose_source(options, calibration)
        return PoseSense(poses, policy.spec, settings), poses, settings
    for name in ("tracker", "tracker_host", "tracker_key"):
        if getattr(options, name) is not None:
            flag = name.replace("_", "-")
            raise DriveError(f"--{flag} and --camera are two senses: give one")
    given = {
        "stale_after": options.stale_after,
        "arrive_within": options.arrive_within,
        "goal_colour": options.goal_colour and tuple(options.goal_colour),
        "goal": options.goal and tuple(options.goal),
        "lens": options.undistort and read_lens(options.undistort),
    }
    settings = CameraSettings(**{name: one for name, one in given.items() if one is not None})
    # Check policy and colour before the camera starts, which takes seconds.
    CameraSense(None, policy, calibration, settings)
    sense = CameraSense(make_camera(), policy, calibration, settings)
    return sense, sense, settings


def main(arguments: Optional[list] = None, clock: Any = None) -> int:
    """Parse the command line and drive.

    Args:
      arguments: Arguments without the program's name; None: those of the process.
      clock: A clock with `now()` and `sleep(seconds)`; None: real time.

    Returns:
      The exit code.
    """
    options = _parser().parse_args(arguments)
    try:
        policy = load_policy(options.policy)
        calibration = default_calibration()
        if options.calibration:
            calibration = read_calibration(options.calibration)
        robot = NoRobot() if options.dry_run else make_robot()
        sense, source, settings = _sense(options, policy, calibration)
        with contextlib.closing(source), _log_file(options.log) as log, _exiting_on_signals():
            if log is not None:
                log(log_header(policy, calibration, settings, source.name))
            outcome = drive_by(
                robot, clock or WallClock(), sense, policy, calibration, options.timeout, log
            )
    except DriveError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    if isinstance(source, Tracker) and source.rejected:
        print(f"{source.rejected} datagrams were rejected, the last because {source.reason}")
    distance = "by camera" if options.camera else "without any pose"
    if outcome.distance is not None:
        distance = f"{outcome.distance:.3f} m from the goal"
    print(
        f"{'reached' if outcome.reached else 'not reached'} after {outcome.seconds:.2f} s,"
        f" {distance}; {outcome.ticks} periods, {outcome.late_ticks} late,"
        f" {outcome.stale_ticks} without a fresh {'picture' if options.camera else 'pose'}"
    )
    return 0 if outcome.reached else 1


if __name__ == "__main__":
    sys.exit(main())
