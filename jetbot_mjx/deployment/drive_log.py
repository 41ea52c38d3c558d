"""Read a log of `deploy/drive.py`, and replay its motor values on a simulated JetBot."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.typing import HashableList

from jetbot_mjx.deployment.drive_pictures import LoggedPicture, picture_strip, read_picture
from jetbot_mjx.deployment.simulated_camera import camera_config
from jetbot_mjx.deployment.simulated_jetbot import ROLLING_RADIUS, MotorModel, Pose, replayed
from jetbot_mjx.errors import UserError, os_errors, shown
from jetbot_mjx.runs import JsonObject, read_text

FORMAT = "jetbot_mjx-drive/1"
"""The format that a log's first line names."""

_LEAST_POSES = 2

_LONGEST_GAP = 10.0
"""Longest time between two lines [s]: a drive writes one in every control period."""

_LARGEST = 1e6
"""Largest position [m], heading [rad] or latency [s] of a drive."""

_ERRORS = (
    *(ValueError, TypeError, LookupError, AttributeError, ArithmeticError),
    RecursionError,
)
"""Raised for a line that no drive has written."""

_OUTCOMES = ("interrupted", "reached", "timed out")


class DriveLog(NamedTuple):
    """A `DriveLog` holds the log of one drive."""

    path: Path
    header: JsonObject
    """Policy, goal and pose source."""
    calibration: MotorModel
    """The motors that the driver assumed, without a delay."""
    goal_w: tuple[float, float] | None
    """Position of the goal in the frame of the poses [m]; None: a drive by camera knows none."""
    outcome: str
    """`reached`, `timed out`, or `interrupted` where the log has no end."""
    times: Float[np.ndarray, " n"]
    """Start of each control period [s], since the start of the drive."""
    motors: Float[np.ndarray, "n 2"]
    """Motor values (left, right)."""
    pose_times: Float[np.ndarray, " m"]
    """Time of each pose [s]; all are different."""
    poses: Float[np.ndarray, "m 3"]
    """(x, y, yaw) [m, m, rad]; yaw without jumps."""
    latencies: Float[np.ndarray, " k"]
    """Time from the start of a period to the motor command [s]."""
    stale_ticks: int
    """Periods without a fresh pose or picture."""
    pictures: tuple[LoggedPicture, ...]
    """The images of a drive by camera."""


class Replay(NamedTuple):
    """A `Replay` holds a drive and its simulation, at the times of the logged poses."""

    log: DriveLog
    motors: MotorModel
    """The motors of the simulated robot."""
    simulated: Float[np.ndarray, "m 3"]
    """(x, y, yaw) [m, m, rad]."""

    @property
    def distances(self) -> Float[np.ndarray, " m"]:
        """Return the distance from the logged to the simulated position, at each pose [m]."""
        return np.linalg.norm(self.simulated[:, :2] - self.log.poses[:, :2], axis=-1)

    @property
    def turns(self) -> Float[np.ndarray, " m"]:
        """Return simulated minus logged heading [rad], to the nearest turn at the start."""
        return self.simulated[:, 2] - self.log.poses[:, 2]


def read_log(path: Path) -> DriveLog:
    """Read a log.

    Args:
      path: The file that `drive.py --log` wrote.

    Returns:
      The drive.

    Raises:
      UserError: The file is missing, is not a log, or has fewer than two poses.
    """
    lines = _read_lines(path)
    # Parse the header and one line per control period; the number tells where a log is wrong.
    times, motors, latencies = [], [], []
    poses: dict[float, tuple[float, ...]] = {}
    pictures: list[LoggedPicture | None] = []
    outcome, stale_ticks, number = "interrupted", 0, 1
    try:
        header, calibration, goal_w = _parse_header(lines[0])
        for number, text in enumerate(lines[1:], start=2):
            if number == len(lines) and not text.endswith("}"):
                break  # The drive ended while this line was written.
            period = json.loads(text)
            left, right = map(_number, period["motors"])
            times.append(_time(period, times))
            motors.append((left, right))
            stale_ticks += not period["fresh"]
            outcome = _outcome(period) or outcome
            if "x" in period:
                # A period that saw no new pose repeats the last.
                poses.setdefault(*_parse_pose(period))
            pictures.append(read_picture(header, period, times[-1]))
            if "latency" in period:
                latencies.append(_number(period["latency"]))
    except _ERRORS as error:
        raise UserError(
            f"{path} is not a log of deploy/drive.py: line {number}: {_reason(error)}"
        ) from None
    if len(poses) < _LEAST_POSES:
        raise UserError(f"{path} has {len(poses) or 'no'} pose: there is nothing to compare")
    return DriveLog(
        path=path,
        header=header,
        calibration=calibration,
        goal_w=goal_w,
        outcome=outcome,
        times=np.array(times),
        motors=np.array(motors),
        pose_times=np.array(list(poses)),
        poses=np.array(list(poses.values())),
        latencies=np.array(latencies),
        stale_ticks=stale_ticks,
        pictures=tuple(picture for picture in pictures if picture is not None),
    )


def _parse_header(text: str) -> tuple[JsonObject, MotorModel, tuple[float, float] | None]:
    """Return the header, its calibration and its goal, and check its camera."""
    header = json.loads(text)
    calibration, goal_w = _parse_calibration(header), _parse_goal(header)
    if "image" in header:
        camera_config(header["image"])
    # It becomes a part of the results.
    json.dumps(header, allow_nan=False)
    return header, calibration, goal_w


def _number(value: object, least: float = -_LARGEST, most: float = _LARGEST) -> float:
    """Return a number of a log.

    Raises:
      ValueError: it is none, or out of bounds.
    """
    number = float(value)  # pyright: ignore[reportArgumentType]
    if not least <= number <= most:
        raise ValueError(f"{shown(value)} is not a number from {least:g} to {most:g}")
    return number


def _time(period: JsonObject, before: Sequence[float]) -> float:
    """Return the time of a period [s], which comes after those before."""
    time = _number(period["t"])
    if before and time < before[-1]:
        raise ValueError("its times do not ascend")
    if before and time > before[-1] + _LONGEST_GAP:
        raise ValueError(
            f"it is {time - before[-1]:.3g} s after the line before, and a drive writes one at"
            f" least every {_LONGEST_GAP:g} s"
        )
    return time


def _outcome(period: JsonObject) -> str | None:
    """Return the outcome of a drive, if a period was its last."""
    outcome = period.get("outcome")
    if outcome not in (None, *_OUTCOMES):
        raise ValueError(f"outcome {shown(outcome)} is none of {', '.join(_OUTCOMES)}")
    return outcome


def _reason(error: Exception) -> str:
    """Return why a line of a log cannot be read."""
    if isinstance(error, RecursionError):
        return "it is nested too deeply"
    text = " ".join(str(error).split())  # that of a camera's settings has several lines
    return f"lacks {text}" if isinstance(error, KeyError) else text


def _parse_pose(period: JsonObject) -> tuple[float, tuple[float, ...]]:
    """Return the time of a period's pose [s], and its x [m], y [m] and yaw [rad]."""
    pose = tuple(_number(period[name]) for name in ("x", "y", "yaw"))
    return round(_number(period["t"]) - _number(period["pose_age"]), 6), pose


def _read_lines(path: Path) -> list[str]:
    try:
        with os_errors(f"{path} cannot be read"):
            return read_text(path).splitlines()
    except UnicodeDecodeError:
        raise UserError(f"{path} is not a log of deploy/drive.py: it is not text") from None


def _parse_goal(header: JsonObject) -> tuple[float, float] | None:
    """Return the position of the goal; only a drive by camera may have none."""
    if header["goal"] is None and "image" in header:
        return None
    goal: Any = header["goal"]
    try:
        x, y = map(_number, goal)
    except (ValueError, TypeError, ArithmeticError):
        raise ValueError(f"its goal is {shown(header['goal'])}, not x and y [m]") from None
    return x, y


def _object(value: Any, name: str) -> JsonObject:
    if not isinstance(value, dict):
        raise ValueError(f"its {name} is {shown(value)}, not an object")
    return value


def _parse_calibration(header: JsonObject) -> MotorModel:
    if header["format"] != FORMAT:
        raise ValueError(f"its format is {shown(header['format'])}, not {FORMAT!r}")
    values = _object(header["calibration"], "calibration")
    sides = [_object(values[side], f"calibration's {side}") for side in ("left", "right")]
    left, right = (_number(side["dead_band"]) for side in sides)
    if not max(left, right) < 1:
        raise ValueError(f"a dead-band of {max(left, right):g} leaves no speed")
    # The log has the speed of a wheel's rim [m/s].
    rims = (_number(side["full_speed"], 0.0, 100.0) for side in sides)
    fastest_left, fastest_right = (rim / ROLLING_RADIUS for rim in rims)
    full_speed = fastest_left, fastest_right
    return MotorModel((left, right), full_speed, lag=_number(values["lag"], 0.0), delay=0.0)


def replay(log: DriveLog, *, delay: float = 0.0, lag: float | None = None) -> Replay:
    """Replay the motor values of a log on a simulated robot, at the same times.

    Args:
      log: The drive.
      delay: Delay of the simulated motors [s].
      lag: Time constant of the simulated motors [s]; None: the calibration's.

    Returns:
      The logged and the simulated drive.
    """
    lag = log.calibration.lag if lag is None else lag
    motors = log.calibration._replace(lag=lag, delay=delay)
    path = replayed(motors, Pose(*log.poses[0]), log.times.tolist(), log.motors)
    # The first yaw may lie some turns away from that of the log.
    path[:, 2] += 2.0 * np.pi * np.round((log.poses[0, 2] - path[0, 2]) / (2.0 * np.pi))
    columns = [np.interp(log.pose_times, log.times, column) for column in path.T]
    return Replay(log, motors, np.stack(columns, axis=-1))


def metrics(replay: Replay) -> JsonObject:
    """Return the metrics that compare the logged drive with the simulated one, as JSON."""
    log, distances = replay.log, replay.distances
    periods = np.diff(log.times)

    def length(path: Float[np.ndarray, "m 3"]) -> float:
        return float(np.linalg.norm(np.diff(path[:, :2], axis=0), axis=-1).sum())

    def to_goal(pose: Float[np.ndarray, "3"]) -> float | None:
        if log.goal_w is None:
            return None
        return float(np.linalg.norm(pose[:2] - np.array(log.goal_w)))

    return {
        "log": log.path.name,
        "policy": log.header.get("policy"),
        "pose_source": log.header.get("pose_source"),
        "outcome": log.outcome,
        "seconds": float(log.times[-1]),
        "poses": len(log.poses),
        "periods": len(log.times),
        "stale_periods": log.stale_ticks,
        "pictures": len(log.pictures),
        "rate": float(1.0 / np.median(periods)) if len(periods) and np.median(periods) else None,
        "latency_median": float(np.median(log.latencies)) if len(log.latencies) else None,
        "latency_p95": float(np.percentile(log.latencies, 95)) if len(log.latencies) else None,
        "position_error_mean": float(distances.mean()),
        "position_error_max": float(distances.max()),
        "position_error_final": float(distances[-1]),
        "yaw_error_final": float(replay.turns[-1]),
        "path_length_logged": length(log.poses),
        "path_length_simulated": length(replay.simulated),
        "goal_distance_logged": to_goal(log.poses[-1]),
        "goal_distance_simulated": to_goal(replay.simulated[-1]),
        "motors": replay.motors._asdict(),
    }


def plot(replay: Replay) -> Figure:
    """Plot both drives from above, and their differences over time.

    Args:
      replay: The logged and the simulated drive.

    Returns:
      The figure.
    """
    log = replay.log
    layout: list[HashableList[str]] = [["plan", "place"], ["plan", "turn"]]
    if log.pictures:
        layout.append(["seen", "seen"])
    figure = Figure(figsize=(10, 4.6 + 2.2 * bool(log.pictures)), layout="constrained")
    axes = figure.subplot_mosaic(layout)
    plan = axes["plan"]
    plan.plot(*log.poses[:, :2].T, color="C0", label=f"logged ({log.outcome})")
    plan.plot(*replay.simulated[:, :2].T, color="C1", linestyle="--", label="simulated")
    plan.plot(*log.poses[0, :2], "o", color="C0", markersize=5)
    if log.goal_w is not None:
        plan.plot(*log.goal_w, "s", color="C2", label="goal")
    plan.set(xlabel="x [m]", ylabel="y [m]", title="From above")
    plan.set_aspect("equal", adjustable="datalim")
    plan.margins(0.1)
    plan.grid(visible=True)
    figure.legend(*plan.get_legend_handles_labels(), loc="outside lower left", ncols=3)
    place, turn = axes["place"], axes["turn"]
    place.plot(log.pose_times, 1e3 * replay.distances, color="C0")
    place.set(ylabel="position error [mm]", title="Simulated minus logged")
    turn.plot(log.pose_times, np.degrees(replay.turns), color="C0")
    turn.set(xlabel="time [s]", ylabel="heading error [°]")
    for panel in (place, turn):
        panel.grid(visible=True)
    if log.pictures:
        seen = axes["seen"]
        strip = picture_strip(log.header, log.pictures, log.pose_times, replay.simulated)
        seen.imshow(strip, interpolation="nearest")
        below = "" if log.goal_w is None else "; below, what the simulated robot sees"
        seen.set(title=f"What the camera saw{below}", xticks=[], yticks=[])
    return figure
