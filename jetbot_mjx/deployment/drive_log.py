"""Read a log of `deploy/drive.py`, and replay its motor values on a simulated JetBot."""

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.typing import HashableList

from jetbot_mjx.deployment.drive_pictures import LoggedPicture, picture_strip, read_picture
from jetbot_mjx.deployment.simulated_camera import camera_config
from jetbot_mjx.deployment.simulated_jetbot import ROLLING_RADIUS, MotorModel, Pose, replayed
from jetbot_mjx.errors import UserError, os_errors
from jetbot_mjx.runs import JsonObject

FORMAT = "jetbot_mjx-drive/1"
"""The format that a log's first line names."""

_LEAST_POSES = 2


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
            left, right = map(float, period["motors"])
            times.append(float(period["t"]))
            motors.append((left, right))
            stale_ticks += not period["fresh"]
            outcome = period.get("outcome") or outcome
            if "x" in period:
                # A period that saw no new pose repeats the last.
                poses.setdefault(*_parse_pose(period))
            pictures.append(read_picture(header, period, times[-1]))
            if "latency" in period:
                latencies.append(float(period["latency"]))
    except (ValueError, TypeError, LookupError, AttributeError) as error:
        text = " ".join(str(error).split())  # that of a camera's settings has several lines
        reason = f"lacks {text}" if isinstance(error, KeyError) else text
        raise UserError(
            f"{path} is not a log of deploy/drive.py: line {number}: {reason}"
        ) from None
    if len(poses) < _LEAST_POSES:
        raise UserError(f"{path} has {len(poses)} poses: there is nothing to compare")
    if not np.isfinite(motors).all() or not np.isfinite(times).all() or np.any(np.diff(times) < 0):
        raise UserError(f"{path} is not a log of deploy/drive.py: its times do not ascend")
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
    return header, calibration, goal_w


def _parse_pose(period: JsonObject) -> tuple[float, tuple[float, ...]]:
    """Return the time of a period's pose [s], and its x [m], y [m] and yaw [rad]."""
    pose = tuple(float(period[name]) for name in ("x", "y", "yaw"))
    return round(float(period["t"]) - float(period["pose_age"]), 6), pose


def _read_lines(path: Path) -> list[str]:
    try:
        with os_errors(f"{path} cannot be read"):
            return path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError:
        raise UserError(f"{path} is not a log of deploy/drive.py: it is not text") from None


def _parse_goal(header: JsonObject) -> tuple[float, float] | None:
    """Return the position of the goal; only a drive by camera may have none."""
    if header["goal"] is None and "image" in header:
        return None
    x, y = map(float, header["goal"] or ())
    if not np.isfinite([x, y]).all():
        raise ValueError(f"its goal is {header['goal']}")
    return x, y


def _parse_calibration(header: JsonObject) -> MotorModel:
    if header["format"] != FORMAT:
        raise ValueError(f"its format is {header['format']!r}, not {FORMAT!r}")
    values = header["calibration"]
    left, right = (float(values[side]["dead_band"]) for side in ("left", "right"))
    if not max(left, right) < 1:
        raise ValueError(f"a dead-band of {max(left, right):g} leaves no speed")
    # The log has the speed of a wheel's rim [m/s].
    rims = (float(values[side]["full_speed"]) for side in ("left", "right"))
    fastest_left, fastest_right = (rim / ROLLING_RADIUS for rim in rims)
    full_speed = fastest_left, fastest_right
    return MotorModel((left, right), full_speed, lag=float(values["lag"]), delay=0.0)


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
