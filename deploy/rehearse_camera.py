"""Rehearse a policy that sees: `python deploy/rehearse.py POLICY --camera`.

It runs where jetbot_mjx is installed, and needs OpenGL. A `SimulatedCamera` on a `SimulatedJetBot`
takes pictures with MuJoCo's renderer; they come late, noisy, and not all. The driver is that of the
robot, with its watchdog.
"""

import math
import statistics
from collections.abc import Iterator, Sequence
from typing import NamedTuple, TypeVar

import numpy as np
from camera_sense import CameraSense, CameraSettings
from drive import Log, Outcome, Policy, arrival_radius, drive_by
from motors import Calibration

from jetbot_mjx.deployment.simulated_camera import (
    CameraModel,
    Fault,
    SimulatedCamera,
    camera_config,
)
from jetbot_mjx.deployment.simulated_jetbot import MotorModel, Pose, SimulatedJetBot
from jetbot_mjx.envs.camera.scenery import SceneryKind
from jetbot_mjx.terminal import stage

T = TypeVar("T")

FAULTS: tuple[Fault, ...] = ("frozen", "black")

ARRIVAL_TOLERANCE = 0.02
"""[m] The driver sees the edge of the cube and not its centre, which is up to 21 mm farther away
behind a corner than behind a face."""

_LASTS = 1.0  # [s] that a fault lasts
_HIDDEN_FOR = 4.0  # [s] without a cube
_MOST_MOVED = 0.3  # [m] while there is no cube
_LEAST_TURNED = math.pi


class FaultCase(NamedTuple):
    """What a fault of the camera did to a drive."""

    kind: Fault
    stopped_after: float
    """Time from the last good picture until both motors stood at zero [s]; infinite: they did
    not."""
    in_time: bool
    """Whether that was within the watchdog's time and a control period."""
    resumed: bool
    """Whether the motors turned again when pictures came again."""


class Search(NamedTuple):
    """What a policy does while there is no cube, and after one has appeared."""

    turned: float
    """Angle turned without a cube [rad]."""
    moved: float
    """Largest distance from the start without a cube [m]."""
    reached: bool
    """Whether the cube was reached after it appeared."""

    @property
    def good(self) -> bool:
        """Return whether the robot turned in place until it saw the cube, and reached it."""
        return self.turned > _LEAST_TURNED and self.moved < _MOST_MOVED and self.reached


class CameraRehearsal:
    """A simulated robot with a camera, and a policy that drives it."""

    def __init__(
        self,
        policy: Policy,
        calibration: Calibration,
        motors: MotorModel,
        camera: CameraModel,
        appearance: SceneryKind = "plain",
        settings: CameraSettings | None = None,
    ) -> None:
        """Build robot and camera.

        Args:
          policy: The policy.
          calibration: The driver's calibration.
          motors: The motors of the simulated robot.
          camera: The latency and losses of its camera.
          appearance: `plain`, or `varied`: another scenery for each goal.
          settings: The driver's settings; None: its defaults.

        Raises:
          DriveError: The policy does not drive by images alone.
          UserError: This machine has no OpenGL.
        """
        self._policy, self._calibration = policy, calibration
        self._settings = settings or CameraSettings()
        CameraSense(None, policy, calibration, self._settings)
        self._robot = SimulatedJetBot(motors)
        config = camera_config(policy.spec["image"])
        self._camera = SimulatedCamera(self._robot, config, camera, appearance=appearance)
        self._within = arrival_radius(policy.spec) + ARRIVAL_TOLERANCE

    def drive(
        self, goal: tuple | None, timeout: float, scenery: int = 0, log: Log | None = None
    ) -> Outcome:
        """Drive from the origin to a goal.

        Args:
          goal: Position (x, y) of the cube [m]; None: there is none.
          timeout: Time limit [s].
          scenery: Number of the scenery.
          log: As for `drive_by`.

        Returns:
          The outcome, with the true distance; the goal is reached if that is within the success
          radius of training and `ARRIVAL_TOLERANCE`.
        """
        robot, camera = self._robot, self._camera
        robot.place(Pose(0.0, 0.0, 0.0))
        camera.begin(goal, scenery)
        sense = CameraSense(camera, self._policy, self._calibration, self._settings)
        calibration = self._calibration
        outcome = drive_by(robot, robot, sense, self._policy, calibration, timeout, log)
        if camera.goal is None:
            return outcome
        x, y, _ = robot.pose()
        distance = math.hypot(camera.goal[0] - x, camera.goal[1] - y)
        reached = outcome.reached and distance < self._within
        return outcome._replace(reached=reached, distance=distance)

    def faults(self, count: int, seed: int = 0) -> list[FaultCase]:
        """Break the camera for a second in each of several drives.

        Args:
          count: Number of drives.
          seed: Seed of goals and times.
        """
        rng = np.random.default_rng(seed)
        return [
            self._fault(FAULTS[index % len(FAULTS)], *rng.uniform((-0.7, 0.4), (0.7, 1.2)))
            for index in counted("drives with a broken camera", range(count))
        ]

    def _fault(self, kind: Fault, bearing: float, at: float) -> FaultCase:
        began, seen, stopped, resumed = self._robot.now(), 0.0, math.inf, False

        def log(line: dict) -> None:
            nonlocal seen, stopped, resumed
            time = self._robot.now() - began
            self._camera.fault = kind if at <= time < at + _LASTS else None
            still = line["motors"] == [0.0, 0.0]
            if time < at + _LASTS:
                if "picture" in line:
                    seen = line["t"]
                elif still and time > at and math.isinf(stopped):
                    stopped = line["t"] - seen
            elif not still:
                resumed = True

        goal = 1.5 * math.cos(bearing), 1.5 * math.sin(bearing)
        self.drive(goal, at + _LASTS + 1.0, log=log)
        allowed = self._settings.stale_after + self._policy.spec["control_period"] + 1e-6
        return FaultCase(kind, stopped, stopped <= allowed, resumed)

    def search(self, timeout: float, seed: int = 0) -> Search:
        """Drive without a cube first, and let it appear beside the robot.

        Args:
          timeout: Time limit [s], after the cube has appeared.
          seed: Seed of the cube's place.
        """
        began, path = self._robot.now(), []
        bearing = np.random.default_rng(seed).uniform(-math.pi, math.pi)

        def log(line: dict) -> None:
            x, y, yaw = self._robot.pose()
            if self._robot.now() - began < _HIDDEN_FOR:
                path.append((x, y, yaw))
            elif self._camera.goal is None:
                self._camera.goal = x + 0.8 * math.cos(bearing), y + 0.8 * math.sin(bearing)

        outcome = self.drive(None, _HIDDEN_FOR + timeout, log=log)
        x, y, yaw = np.array(path).T
        turned = abs(float(np.unwrap(yaw)[-1] - yaw[0]))
        return Search(turned, float(np.hypot(x, y).max()), outcome.reached)


def counted(name: str, things: Sequence[T]) -> Iterator[T]:
    """Yield things, and report as a stage how many of them are done."""
    with stage(name, len(things)) as advance:
        for thing in things:
            yield thing
            advance(1)


def passed(
    outcomes: list[Outcome], faults: list[FaultCase], searches: list[Search], share: float
) -> bool:
    """Return whether every fault stopped the motors, and a share of goals and searches succeeded.

    Args:
      outcomes: Drives to goals.
      faults: Drives with a broken camera.
      searches: Drives that began without a cube.
      share: Share of the goals, and of the searches, that must be reached.
    """
    good = ([one.reached for one in outcomes], [one.good for one in searches])
    return all(one.in_time for one in faults) and all(sum(one) >= share * len(one) for one in good)


def summary(outcomes: list[Outcome], faults: list[FaultCase], searches: list[Search]) -> str:
    """Return the result of a rehearsal as lines for the terminal."""
    reached = [outcome.seconds for outcome in outcomes if outcome.reached]
    median = f", median time {statistics.median(reached):.2f} s" if reached else ""
    lines = [f"{len(reached)} of {len(outcomes)} goals reached by camera{median}"]
    for kind in FAULTS:
        times = [case.stopped_after for case in faults if case.kind == kind]
        resumed = sum(case.resumed for case in faults if case.kind == kind)
        if times:
            lines.append(
                f"{kind} pictures: {len(times)} drives, motors at zero within"
                f" {1e3 * max(times):.0f} ms of the last good picture,"
                f" {resumed} drove on afterwards"
            )
    if searches:
        good, turned = sum(one.good for one in searches), min(one.turned for one in searches)
        lines.append(
            f"no cube in sight: {good} of {len(searches)} turned until they saw it and reached it"
            f" (at least {math.degrees(turned):.0f} degrees in {_HIDDEN_FOR:g} s)"
        )
    return "\n".join(lines)
