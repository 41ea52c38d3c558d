"""Drive a simulated JetBot as drive.py drives a real one: `python deploy/rehearse.py POLICY`.

It runs where jetbot_mjx is installed. The robot is a `SimulatedJetBot`, with delay, dead-band and
lag between motor value and wheel. A simulated tracker sends its pose `--rate` times a second, with
noise of `--noise` metres. Goals are drawn as in the tutorial, and each drive starts at the origin.
With `--camera` a policy drives by pictures; `docs/deploy.md` says how. While it computes, the
progress is shown on stderr.
"""

import argparse
import json
import math
import statistics
import sys
import time

import numpy as np
from drive import Outcome, Policy, Settings, arrival_radius, at_least, drive, load_policy
from motors import Calibration, DriveError, check_calibration, default_calibration
from poses import Tracker
from rehearse_camera import CameraRehearsal, counted, passed, summary

from jetbot_mjx.deployment.simulated_camera import CameraModel
from jetbot_mjx.deployment.simulated_jetbot import ROLLING_RADIUS, MotorModel, Pose, SimulatedJetBot
from jetbot_mjx.errors import UserError
from jetbot_mjx.terminal import show_progress

_RATE = 60.0
"""Poses per second."""


class Camera:
    """A simulated camera that sends the datagrams of a tracker."""

    def __init__(
        self, robot: SimulatedJetBot, rate: float, noise: float, rng: np.random.Generator
    ) -> None:
        """Start with a first pose now.

        Args:
          robot: The robot that the camera sees.
          rate: Poses per second.
          noise: Standard deviation of each coordinate [m]; ten times the number for the yaw [rad].
          rng: The generator of the noise.
        """
        self._robot, self._period, self._noise, self._rng = robot, 1.0 / rate, noise, rng
        self._next = robot.now()
        self.blind = False
        """Whether the camera has stopped sending."""

    def receive(self) -> list[bytes]:
        """Return the datagrams since the last call: one with the newest pose, or none."""
        now = self._robot.now()
        if self.blind or now < self._next - 1e-9:
            return []
        self._next += self._period * max(1.0, math.ceil((now - self._next) / self._period - 1e-6))
        x, y, yaw = self._robot.pose()
        dx, dy, turn = self._noise * self._rng.standard_normal(3)
        values = {"time": now, "x": x + dx, "y": y + dy, "yaw": yaw + 10.0 * turn}
        return [json.dumps(values).encode()]


def draw_goals(count: int, seed: int = 0) -> list[tuple[float, float]]:
    """Return goals (x, y) [m] as the tutorial draws them: r = √u₁ + 0.2, in any direction."""
    rng = np.random.default_rng(seed)
    found = []
    for u1, u2 in rng.random((count, 2)):
        distance = math.sqrt(u1) + 0.2
        angle = 2.0 * math.pi * u2
        found.append((distance * math.sin(angle), distance * math.cos(angle)))
    return found


def rehearse(
    policy: Policy,
    goals: list[tuple[float, float]],
    *,
    motors: MotorModel,
    rate: float = 60.0,
    noise: float = 0.0,
    timeout: float = 10.0,
    calibration: Calibration | None = None,
) -> list[Outcome]:
    """Drive to each goal from the origin.

    Args:
      policy: The policy.
      goals: Positions (x, y) of the goals [m].
      motors: The motors of the simulated robot.
      rate: Poses per second.
      noise: Standard deviation of a pose [m]; ten times the number for the yaw [rad].
      timeout: Time limit for each goal [s].
      calibration: The driver's calibration; None: the true one.

    Returns:
      The outcome of each drive. Whether a goal is reached is checked by the true pose.
    """
    robot = SimulatedJetBot(motors)
    calibration = calibration or true_calibration(motors)
    within = arrival_radius(policy.spec)
    rng = np.random.default_rng(0)
    outcomes = []
    for goal in counted("goals", goals):
        robot.place(Pose(0.0, 0.0, 0.0))
        poses = Tracker(Camera(robot, rate, noise, rng).receive)
        settings = Settings(goal, timeout, 0.08, within)
        outcome = drive(robot, robot, poses, policy, calibration, settings)
        x, y, _ = robot.pose()
        distance = math.hypot(goal[0] - x, goal[1] - y)
        reached = outcome.reached and distance < within + 3.0 * noise
        outcomes.append(outcome._replace(reached=reached, distance=distance))
    return outcomes


def true_calibration(motors: MotorModel) -> Calibration:
    """Return the calibration that a perfect measurement of a `SimulatedJetBot` would give."""
    wheel = default_calibration().left
    left, right = (
        wheel._replace(dead_band=dead_band, full_speed=ROLLING_RADIUS * full_speed)
        for dead_band, full_speed in zip(motors.dead_band, motors.full_speed, strict=True)
    )
    return default_calibration()._replace(left=left, right=right, lag=motors.lag)


def _parser() -> argparse.ArgumentParser:
    nominal = MotorModel()
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("policy", help="folder that jetbot_mjx.export wrote")
    parser.add_argument("--goals", type=int, default=100, help="number of goals (default: 100)")
    parser.add_argument(
        "--delay",
        type=at_least(0.0),
        help=f"delay of the motors [s] (default: {nominal.delay:g}; with --camera 0)",
    )
    parser.add_argument(
        "--lag",
        type=at_least(0.0),
        default=nominal.lag,
        help="lag of the motors [s] (default: 0.1)",
    )
    parser.add_argument(
        "--dead-band",
        type=float,
        default=nominal.dead_band[0],
        help="motor value below which a wheel stands still (default: 0.12)",
    )
    parser.add_argument("--rate", type=at_least(1.0), help=f"poses per second (default: {_RATE:g})")
    parser.add_argument(
        "--noise", type=at_least(0.0), help="standard deviation of a pose [m] (default: 0)"
    )
    parser.add_argument(
        "--timeout",
        type=at_least(0.0),
        default=10.0,
        help="time limit for a goal [s] (default: 10)",
    )
    parser.add_argument(
        "--min-success",
        type=at_least(0.0),
        default=0.95,
        help="share of the goals to reach for exit code 0 (default: 0.95)",
    )
    parser.add_argument(
        "--lost",
        type=at_least(0.0, 1.0),
        default=0.0,
        help="share of lost motor commands (default: 0)",
    )
    _add_camera_arguments(parser)
    return parser


def _add_camera_arguments(parser: argparse.ArgumentParser) -> None:
    usual = CameraModel()
    parser.add_argument("--camera", action="store_true", help="drive by the camera alone")
    parser.add_argument(
        "--latency",
        type=at_least(0.0),
        default=usual.latency,
        help="latency of the camera [s] (default: 0.08)",
    )
    parser.add_argument(
        "--frame-rate", type=at_least(1.0), default=usual.rate, help="images per second"
    )
    parser.add_argument(
        "--dropped", type=at_least(0.0, 1.0), default=usual.dropped, help="share of lost images"
    )
    parser.add_argument(
        "--appearance",
        choices=("plain", "varied"),
        default="plain",
        help="appearance of the scene (default: plain)",
    )
    parser.add_argument(
        "--faults", type=int, default=20, help="drives with a broken camera (default: 20)"
    )
    parser.add_argument(
        "--searches", type=int, default=5, help="drives that begin without a cube (default: 5)"
    )


def _by_camera(policy: Policy, motors: MotorModel, options: argparse.Namespace) -> int:
    """Rehearse a policy that sees, print the result and return the exit code."""
    camera = CameraModel(options.latency, options.frame_rate, options.dropped)
    calibration = true_calibration(motors)
    rehearsal = CameraRehearsal(policy, calibration, motors, camera, options.appearance)
    outcomes = [
        rehearsal.drive(goal, options.timeout, number)
        for number, goal in enumerate(counted("goals", draw_goals(options.goals)))
    ]
    faults = rehearsal.faults(options.faults)
    seeds = counted("drives that begin without a cube", range(options.searches))
    searches = [rehearsal.search(options.timeout, seed) for seed in seeds]
    print(summary(outcomes, faults, searches))
    return int(not passed(outcomes, faults, searches, options.min_success))


def main(arguments: list[str] | None = None) -> int:
    """Parse the command line, drive to all goals and print the success rate.

    Args:
      arguments: Arguments without the program's name; None: those of the process.

    Returns:
      The exit code: 0 if at least `--min-success` of the goals were reached, 1 if fewer, 2 after
      wrong usage. With `--camera` it is also 1 if a fault did not stop the motors in time, or if
      fewer of the searches succeeded.
    """
    options = _parser().parse_args(arguments)
    with show_progress(sys.stderr):
        return _run(options)


def _run(options: argparse.Namespace) -> int:
    try:
        for name, least in (("goals", 1), ("faults", 0), ("searches", 0)):
            if getattr(options, name) < least:
                raise DriveError(f"--{name} {getattr(options, name)}: give at least {least}")
        for name in ("rate", "noise"):
            if options.camera and getattr(options, name) is not None:
                raise DriveError(f"--{name} concerns poses, and --camera uses none: leave it out")
        policy = load_policy(options.policy)
        began = time.monotonic()
        delay = options.delay
        if delay is None:
            delay = 0.0 if options.camera else MotorModel().delay
        motors = MotorModel()._replace(
            delay=delay, lag=options.lag, dead_band=(options.dead_band,) * 2, lost=options.lost
        )
        check_calibration(true_calibration(motors))
        if options.camera:
            return _by_camera(policy, motors, options)
        outcomes = rehearse(
            policy,
            draw_goals(options.goals),
            motors=motors,
            rate=options.rate or _RATE,
            noise=options.noise or 0.0,
            timeout=options.timeout,
        )
    except (DriveError, UserError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    reached = [outcome.seconds for outcome in outcomes if outcome.reached]
    median = f", median time {statistics.median(reached):.2f} s" if reached else ""
    print(
        f"{len(reached)} of {len(outcomes)} goals reached{median}; delay {delay:g} s,"
        f" lag {options.lag:g} s, dead-band {options.dead_band:g};"
        f" computed in {time.monotonic() - began:.0f} s"
    )
    return int(len(reached) < options.min_success * len(outcomes))


if __name__ == "__main__":
    sys.exit(main())
