"""List the runs in a folder, the latest first, and the names by which commands find them."""

from collections.abc import Sequence
from pathlib import Path

from jetbot_mjx import cli, startup


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and list the runs.

    Args:
      arguments: The arguments without the program's name, or None for those of the process.

    Returns:
      0.
    """
    parser = cli.Parser(prog="jetbot-mjx runs", description=__doc__)
    parser.add_argument(
        "folder", type=Path, nargs="?", metavar="DIR", help="folder of the runs (default: runs)"
    )
    options = parser.parse_args(arguments)
    with startup.exit_on_interrupt():
        from jetbot_mjx.runs import PRETRAINED, ROOT, runs_table, scan_runs

    folder = options.folder or ROOT
    if options.folder and not folder.is_dir():
        parser.error(f"{folder} is not a folder")
    cli.tell(runs_table(*scan_runs(folder)))
    if not options.folder:
        cli.tell(
            "\nwith the package, for every command that takes a run:\n"
            f"{runs_table(*scan_runs(PRETRAINED))}"
        )
    return 0


if __name__ == "__main__":
    cli.run_command(main)
