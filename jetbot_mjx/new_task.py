"""Write a task to start from: `jetbot-mjx new-task my_task.py`.

It is the example `examples/obstacle_task.py` under your name, with its settings as YAML in the same
folder. Both pass `check-env` and can be trained unchanged. No file is overwritten.
"""

from collections.abc import Sequence
from pathlib import Path

from jetbot_mjx import cli
from jetbot_mjx.envs import write_task_template


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and write the files.

    Args:
      arguments: The arguments without the program's name, or None for those of the process.

    Returns:
      0.
    """
    parser = cli.Parser(prog="jetbot-mjx new-task", description=__doc__)
    parser.add_argument("module", type=Path, metavar="MODULE.py", help="file to be written")
    module = parser.parse_args(arguments).module
    config = write_task_template(module)
    cli.tell_written((module, config), "check-env")
    return 0


if __name__ == "__main__":
    cli.run_command(main, writes_files=True)
