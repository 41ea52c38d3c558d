"""Copy the trained policies that come with the package: `jetbot-mjx pretrained`.

There is one run for each of six configurations. The copies are run folders like any other:
evaluate them, render them, compare them with your own runs, or train them further.
"""

import argparse
import shlex
from collections.abc import Sequence
from pathlib import Path

from jetbot_mjx import cli, startup

FOLDER = Path("runs/pretrained")


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and copy the runs.

    Args:
      arguments: The arguments without the program's name, or None for those of the process.

    Returns:
      0.
    """
    parser = cli.Parser(prog="jetbot-mjx pretrained", description=__doc__)
    cli.add_output(parser, f"folder for the copies (default: {FOLDER})", FOLDER)
    parser.add_argument("names", nargs="*", help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.names:
        name = options.names[0].removeprefix("pretrained:")
        parser.error(
            f"{options.names[0]}: this command takes no names and copies all runs; as"
            f" pretrained:{name} every command finds a run without a copy"
        )
    with startup.exit_on_interrupt():
        from jetbot_mjx.runs import copy_pretrained

    runs = copy_pretrained(options.output)
    for path in runs:
        cli.tell(f"run folder: {path}")
    run = shlex.quote(str(runs[0]))
    cli.tell(
        f"next: jetbot-mjx evaluate {run}\n"
        f"      jetbot-mjx render {run}\n"
        f"      jetbot-mjx play {run}"
    )
    return 0


if __name__ == "__main__":
    cli.run_command(main, writes_files=True)
