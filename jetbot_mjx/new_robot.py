"""Write a robot to start from: `jetbot-mjx new-robot my_robot.yaml`.

`my_robot.yaml` is a configuration with the measures of a JetBot, for a robot with two driven wheels
and casters. `new-robot my_robot.xml` writes a MuJoCo model, the example `examples/turtlebot.xml`
under your name, and `my_robot.yaml`, a configuration for it. All can be trained unchanged. No file
is overwritten.
"""

from collections.abc import Sequence
from pathlib import Path

from jetbot_mjx import cli
from jetbot_mjx.envs import write_robot_template


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and write the files.

    Args:
      arguments: The arguments without the program's name, or None for those of the process.

    Returns:
      0.
    """
    parser = cli.Parser(prog="jetbot-mjx new-robot", description=__doc__)
    parser.add_argument("file", type=Path, metavar="FILE", help="a .yaml or .xml to be written")
    files = write_robot_template(parser.parse_args(arguments).file)
    cli.tell_written(files, "check-robot")
    return 0


if __name__ == "__main__":
    cli.run_command(main, writes_files=True)
