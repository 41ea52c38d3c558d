"""Brings trained policies: `python -m jetbot_mjx.pretrained`.

They come with the package, one run for each of two configurations, and become run folders like any
other: to be judged, filmed, exported, compared with one's own, or trained further.
"""

import shutil
from collections.abc import Sequence
from pathlib import Path

from jetbot_mjx import cli
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs.checkpoint import PRETRAINED
from jetbot_mjx.runs.run_dir import writing_to

FOLDER = Path("runs/pretrained")


def run(folder: Path = FOLDER) -> tuple[Path, ...]:
    """Copy the runs that come with the package, without overwriting anything.

    Args:
      folder: the folder in which each run gets its own folder.

    Returns:
      The run folders, named after their configurations; each is complete or absent.

    Raises:
      UserError: one of them is there already, or cannot be written.
    """
    runs = {path: folder / path.name for path in sorted(PRETRAINED.iterdir())}
    for target in runs.values():
        if target.exists():
            raise UserError(f"{target} is there already: give --out another folder")
    for source, target in runs.items():
        unfinished = target.with_name(f".{target.name}.unfinished")
        with writing_to(target):
            shutil.rmtree(unfinished, ignore_errors=True)
            try:
                shutil.copytree(source, unfinished)
                unfinished.rename(target)
            finally:
                shutil.rmtree(unfinished, ignore_errors=True)
    return tuple(runs.values())


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and copy the runs.

    Args:
      arguments: arguments without the program's name; None: those of the process.

    Returns:
      0.
    """
    parser = cli.Parser(prog="python -m jetbot_mjx.pretrained", description=__doc__)
    parser.add_argument(
        "--out", type=Path, default=FOLDER, metavar="DIR", help=f"the folder (default: {FOLDER})"
    )
    runs = run(parser.parse_args(arguments).out)
    for path in runs:
        print(f"run folder: {path}")
    print(
        f"next: python -m jetbot_mjx.evaluate {runs[0]}\n"
        f"      python -m jetbot_mjx.render {runs[0]}\n"
        f"      python -m jetbot_mjx.play {runs[0]}"
    )
    return 0


if __name__ == "__main__":
    cli.run_command(main)
