"""Compare a real drive with the simulator: `jetbot-mjx sim2real LOG`.

LOG is a file that `deploy/drive.py --log` wrote on the robot. A simulated robot gets the same motor
values at the same times, from the first logged pose on. An image and a JSON file in the folder of
the log show where the two differ, and so what is wrong in the simulation or in the calibration.
"""

from collections.abc import Sequence
from pathlib import Path

from jetbot_mjx import cli, startup


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and compare.

    Args:
      arguments: The arguments without the program's name, or None for those of the process.

    Returns:
      0.
    """
    parser = cli.Parser(prog="jetbot-mjx sim2real", description=__doc__)
    parser.add_argument("log", type=Path, metavar="LOG", help="a file of deploy/drive.py --log")
    for name, default, text in (
        ("--delay", 0.0, "delay of the motors [s] (default: 0)"),
        ("--lag", None, "lag of the motors [s] (default: that of the calibration)"),
    ):
        seconds = cli.number(float, 0)
        parser.add_argument(name, type=seconds, default=default, metavar="S", help=text)
    cli.add_output(parser, "folder of the results (default: that of the log)")
    options = parser.parse_args(arguments)
    with startup.exit_on_interrupt():
        from jetbot_mjx.deployment import compare_drive, summarize_drive

    with cli.show_progress():
        comparison = compare_drive(
            options.log, delay=options.delay, lag=options.lag, output=options.output
        )
    cli.tell(summarize_drive(comparison))
    return 0


if __name__ == "__main__":
    cli.run_command(main, at_once=True, writes_files=True)
