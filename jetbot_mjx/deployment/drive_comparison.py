"""Compare the log of a real drive with the same drive in the simulator, in an image and as JSON."""

from pathlib import Path
from typing import NamedTuple

from jetbot_mjx.deployment.drive_log import metrics, plot, read_log, replay
from jetbot_mjx.evaluation import theme, to_png
from jetbot_mjx.runs import JsonObject, make_folder, write_bytes, write_json, writing_to
from jetbot_mjx.terminal import stage


class DriveComparison(NamedTuple):
    """A `DriveComparison` holds the files and metrics computed from a log."""

    image: Path
    json: Path
    metrics: JsonObject
    """Content of the JSON file."""


def compare_drive(
    log: str | Path,
    *,
    delay: float = 0.0,
    lag: float | None = None,
    output: str | Path | None = None,
) -> DriveComparison:
    """Compare one drive with its simulation, and write the result.

    Args:
      log: A log of `deploy/drive.py`.
      delay: The delay of the simulated motors [s].
      lag: The time constant of the simulated motors [s], or None for that of the calibration in the
        log.
      output: The folder for the files, or None for the folder of the log.

    Returns:
      The files, and the metrics.

    Raises:
      UserError: the file is not a log, or the files cannot be written.
    """
    path = Path(log)
    recorded = read_log(path)
    with stage("simulating the drive"):
        compared = replay(recorded, delay=delay, lag=lag)
    folder = path.parent if output is None else Path(output)
    make_folder(folder)
    files = DriveComparison(
        image=folder / f"{path.stem}.sim2real.png",
        json=folder / f"{path.stem}.sim2real.json",
        metrics=metrics(compared),
    )
    with stage("plotting"), theme("light"):
        image = to_png(plot(compared))
    with writing_to(folder):
        write_bytes(files.image, image)
        write_json(files.json, files.metrics)
    return files


def summarize_drive(comparison: DriveComparison) -> str:
    """Return a comparison as lines for the terminal."""
    found = comparison.metrics
    seen = f", {found['pictures']} pictures" if found["pictures"] else ""
    to_goal = ""
    if found["goal_distance_logged"] is not None:
        to_goal = (
            f"from the goal at the end: {found['goal_distance_logged']:.3f} m logged,"
            f" {found['goal_distance_simulated']:.3f} m simulated\n"
        )
    return (
        f"{found['outcome']} after {found['seconds']:.2f} s; {found['poses']} poses by"
        f" {found['pose_source']}{seen}, {found['stale_periods']} of {found['periods']} periods"
        " without a fresh one\n"
        f"simulated from logged: {1e3 * found['position_error_final']:.0f} mm at the end,"
        f" {1e3 * found['position_error_max']:.0f} mm at most, over"
        f" {found['path_length_logged']:.2f} m\n"
        f"{to_goal}"
        f"{comparison.image}\n{comparison.json}"
    )
