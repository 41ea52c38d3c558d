"""Drives a simulated JetBot as drive.py drives a real one: `python deploy/rehearse.py POLICY`.

Runs where jetbot_mjx is installed. The robot is `jetbot_mjx.deployment.simulated_jetbot`: delay,
dead-band and lag between motor value and wheel. A tracker sees it `--rate` times a second,
`--noise` metres beside the truth. Goals are drawn as the tutorial draws them, each from a fresh
start.
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

from jetbot_mjx.deployment.simulated_jetbot import ROLLING_RADIUS, MotorModel, Pose, SimulatedJetBot


class Camera:
    """Sees a stand-in and sends what a tracker receives."""

    def __init__(
        self, robot: SimulatedJetBot, rate: float, noise: float, rng: np.random.Generator
    ) -> None:
        """Looks for the first time now.

        Args:
          robot: to be looked at.
          rate: pictures a second.
          noise: deviation of each coordinate [m], and a tenth of it in radians per centimetre.
          rng: of the noise.
        """
        self._robot, self._period, self._noise, self._rng = robot, 1.0 / rate, noise, rng
        self._next = robot.now()
        self.blind = False
        """Whether it has stopped sending."""

    def receive(self) -> list[bytes]:
        """The datagrams since the last call: the newest picture, where there is one."""
        now = self._robot.now()
        if self.blind or now < self._next - 1e-9:
            return []
        self._next += self._period * max(1.0, math.ceil((now - self._next) / self._period - 1e-6))
        x, y, yaw = self._robot.pose()
        dx, dy, turn = self._noise * self._rng.standard_normal(3)
        values = {"time": now, "x": x + dx, "y": y + dy, "yaw": yaw + 10.0 * turn}
        return [json.dumps(values).encode()]


def draw_goals(count: int, seed: int = 0) -> list[tuple[float, float]]:
    """Goals (x, y) [m] as the tutorial draws them: r = √u₁ + 0.2, in any direction."""
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
    """Drives to each goal from the origin.

    Args:
      policy: as `load_policy` gives it.
      goals: (x, y) [m].
      motors: of the simulated robot.
      rate: poses a second.
      noise: deviation of a pose [m]; ten times the number in radians.
      timeout: for each goal [s].
      calibration: None: the true one.

    Returns:
      How each ended. Whether it arrived is told by the true pose.
    """
    robot = SimulatedJetBot(motors)
    calibration = calibration or true_calibration(motors)
    within = arrival_radius(policy.contract)
    rng = np.random.default_rng(0)
    outcomes = []
    for goal in goals:
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
    """What a perfect measurement of a stand-in would give."""
    wheel = default_calibration().left
    left, right = (
        wheel._replace(dead_band=dead_band, full_speed=ROLLING_RADIUS * full_speed)
        for dead_band, full_speed in zip(motors.dead_band, motors.full_speed, strict=True)
    )
    return default_calibration()._replace(left=left, right=right, lag=motors.lag)


def main(arguments: list[str] | None = None) -> int:
    """Parses the command line and rehearses.

    Args:
      arguments: without the program's name; None: those of the process.

    Returns:
      0 where `--min-success` of the goals were reached, 1 below, 2 after a mistake.
    """
    nominal = MotorModel()
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("policy", help="the folder that jetbot_mjx.export wrote")
    parser.add_argument("--goals", type=int, default=100, help="how many (default: 100)")
    parser.add_argument(
        "--delay", type=at_least(0.0), default=nominal.delay, help="[s] (default: 0.05)"
    )
    parser.add_argument("--lag", type=at_least(0.0), default=nominal.lag, help="[s] (default: 0.1)")
    parser.add_argument(
        "--dead-band", type=float, default=nominal.dead_band[0], help="motor value (default: 0.12)"
    )
    parser.add_argument(
        "--rate", type=at_least(1.0), default=60.0, help="poses a second (default: 60)"
    )
    parser.add_argument(
        "--noise", type=at_least(0.0), default=0.0, help="of a pose [m] (default: 0)"
    )
    parser.add_argument(
        "--timeout", type=at_least(0.0), default=10.0, help="for a goal [s] (default: 10)"
    )
    parser.add_argument("--min-success", type=at_least(0.0), default=0.95, help="(default: 0.95)")
    options = parser.parse_args(arguments)
    try:
        if options.goals < 1:
            raise DriveError(f"--goals {options.goals}: give at least 1")
        policy = load_policy(options.policy)
        began = time.monotonic()
        motors = nominal._replace(
            delay=options.delay, lag=options.lag, dead_band=(options.dead_band,) * 2
        )
        check_calibration(true_calibration(motors))
        outcomes = rehearse(
            policy,
            draw_goals(options.goals),
            motors=motors,
            rate=options.rate,
            noise=options.noise,
            timeout=options.timeout,
        )
    except DriveError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    reached = [one.seconds for one in outcomes if one.reached]
    median = f", after {statistics.median(reached):.2f} s in the median" if reached else ""
    print(
        f"{len(reached)} of {len(outcomes)} goals reached{median}; delay {options.delay:g} s,"
        f" lag {options.lag:g} s, dead-band {options.dead_band:g};"
        f" {time.monotonic() - began:.0f} s of work"
    )
    return int(len(reached) < options.min_success * len(outcomes))


if __name__ == "__main__":
    sys.exit(main())
