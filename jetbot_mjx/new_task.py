"""Write a task to start from: `python -m jetbot_mjx.new_task my_task.py`.

It is the example `examples/obstacle_task.py` under your name, with its settings as YAML beside it.
Both pass `check_env` and train as they are. No file is overwritten.
"""

import importlib.util
import keyword
from collections.abc import Sequence
from importlib import resources
from pathlib import Path
from typing import NamedTuple

from jetbot_mjx import cli
from jetbot_mjx.errors import UserError

_EXAMPLE = ("obstacle_task.py", "obstacle.yaml")
"""The files that are copied; in a checkout they are links to the examples."""


class Written(NamedTuple):
    """A `Written` holds the paths of the two files."""

    module: Path
    config: Path


def run(path: Path) -> Written:
    """Write a task and its settings.

    Args:
      path: Path of the module; the class is named after it, and the settings are in its folder.

    Returns:
      The files.

    Raises:
      UserError: The name is not valid or belongs to another module, or a file exists already.
    """
    # Refuse a name that Python could not import, and one that would hide another module.
    name = path.stem
    if path.suffix != ".py" or not name.isidentifier() or keyword.iskeyword(name):
        raise UserError(f"{path}: name a Python module, such as my_task.py")
    files = Written(path, path.with_suffix(".yaml"))
    for file in files:
        if file.exists():
            raise UserError(f"{file} exists already: choose another name")
    if importlib.util.find_spec(name) is not None:
        raise UserError(f"{path}: a module {name} exists already: choose another name")

    # Copy the example under the new names.
    renamed = {
        "examples/obstacle.yaml": files.config.name,
        "PYTHONPATH=examples": "PYTHONPATH=.",
        "obstacle_task": name,
        "ObstacleTask": "".join(word[:1].upper() + word[1:] for word in name.split("_")),
    }
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for file, example in zip(files, _EXAMPLE, strict=True):
            text = resources.files("jetbot_mjx").joinpath(f"assets/{example}").read_text("utf-8")
            for old, new in renamed.items():
                text = text.replace(old, new)
            # Mode "x" does not overwrite a file that was created in the meantime.
            with file.open("x", encoding="utf-8") as out:
                out.write(text)
    except OSError as error:
        raise UserError(f"{error.filename}: {error.strerror}") from None
    return files


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and write the files.

    Args:
      arguments: arguments without the program's name; None: those of the process.

    Returns:
      0.
    """
    parser = cli.Parser(prog="python -m jetbot_mjx.new_task", description=__doc__)
    parser.add_argument("module", type=Path, metavar="MODULE.py", help="file to be written")
    written = run(parser.parse_args(arguments).module)
    folder = written.config.parent
    print(f"wrote {written.module} and {written.config}")
    print(f"next: PYTHONPATH={folder} python -m jetbot_mjx.check_env --config {written.config}")
    print(f"      PYTHONPATH={folder} python -m jetbot_mjx.train --config {written.config}")
    return 0


if __name__ == "__main__":
    cli.run_command(main)
