"""Replays a drive in the simulator: `python -m jetbot_mjx.sim2real LOG`.

LOG is what `deploy/drive.py --log` wrote on the robot. A simulated robot is given the same motor
values at the same times, from where the log begins; beside the log a picture and a JSON file tell
how the two differ: what the simulation, or the calibration in the log, has wrong.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from jetbot_mjx import cli
from jetbot_mjx.deployment.drive_log import metrics, plot, read_log, replay
from jetbot_mjx.evaluation.plots import theme, to_png
from jetbot_mjx.runs.run_dir import make_folder, write_bytes, write_json, writing_to


class Compared(NamedTuple):
    """A `Compared` holds the files and metrics computed from a log."""

    picture: Path
    json: Path
    figures: dict[str, Any]


def run(
    log: str | Path,
    *,
    delay: float = 0.0,
    lag: float | None = None,
    output: str | Path | None = None,
) -> Compared:
    """Compare one drive with its simulation.

    Args:
      log: a log of `deploy/drive.py`.
      delay: delay of the simulated motors [s].
      lag: time constant of the simulated motors [s]; None: that of the calibration in the log.
      output: the folder for the files; None: that of the log.

    Returns:
      The files, and the content of the JSON file.

    Raises:
      UserError: the file is not a log, or the files cannot be written.
    """
    path = Path(log)
    compared = replay(read_log(path), delay=delay, lag=lag)
    folder = path.parent if output is None else Path(output)
    make_folder(folder)
    files = Compared(
        picture=folder / f"{path.stem}.sim2real.png",
        json=folder / f"{path.stem}.sim2real.json",
        figures=metrics(compared),
    )
    with theme("light"):
        picture = to_png(plot(compared))
    with writing_to(folder):
        write_bytes(files.picture, picture)
        write_json(files.json, files.figures)
    return files


def _seconds(text: str) -> float:
    return 0.0 if text == "0" else cli.positive_float(text)


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and compare.

    Args:
      arguments: arguments without the program's name; None: those of the process.

    Returns:
      0.
    """
    parser = cli.Parser(prog="python -m jetbot_mjx.sim2real", description=__doc__)
    parser.add_argument("log", type=Path, help="a file of deploy/drive.py --log")
    parser.add_argument(
        "--delay", type=_seconds, default=0.0, metavar="S", help="of the motors (default: 0)"
    )
    parser.add_argument(
        "--lag", type=_seconds, metavar="S", help="of the motors (default: the calibration's)"
    )
    parser.add_argument("--output", type=Path, metavar="DIR", help="default: beside the log")
    options = parser.parse_args(arguments)
    compared = run(options.log, delay=options.delay, lag=options.lag, output=options.output)
    found = compared.figures
    print(
        f"{found['outcome']} after {found['seconds']:.2f} s; {found['poses']} poses by"
        f" {found['pose_source']}, {found['stale_periods']} of {found['periods']} periods without a"
        " fresh one\n"
        f"simulated from logged: {1e3 * found['position_error_final']:.0f} mm at the end,"
        f" {1e3 * found['position_error_max']:.0f} mm at most, over"
        f" {found['path_length_logged']:.2f} m\n"
        f"from the goal at the end: {found['goal_distance_logged']:.3f} m logged,"
        f" {found['goal_distance_simulated']:.3f} m simulated\n"
        f"{compared.picture}\n{compared.json}"
    )
    return 0


if __name__ == "__main__":
    cli.run_command(main)
