"""Write a copy of the obstacle example, as a task to start from."""

import importlib.util
import keyword
from pathlib import Path

from jetbot_mjx.config import shipped_folder
from jetbot_mjx.errors import UserError

_EXAMPLE = ("obstacle_task.py", "obstacle.yaml")
"""The files that are copied."""


def write_task_template(path: Path) -> Path:
    """Write a task and its settings, without overwriting anything.

    Args:
      path: The path of the module. The class is named after it, and the settings are written to
        the same folder.

    Returns:
      The path of the settings.

    Raises:
      UserError: the name is not valid or belongs to another module, or a file exists already.
    """
    # Check that the module can be imported by its name, and that nothing is overwritten.
    name = path.stem
    if path.suffix != ".py" or not name.isidentifier() or keyword.iskeyword(name):
        raise UserError(f"{path}: name a Python module, such as my_task.py")
    config = path.with_suffix(".yaml")
    files = path, config
    for file in files:
        if file.exists():
            raise UserError(f"{file} exists already: choose another name")
    if importlib.util.find_spec(name) is not None:
        raise UserError(f"{path}: a module {name} exists already: choose another name")
    # Copy the example under the new names.
    renamed = {
        "jetbot-mjx train obstacle": f"jetbot-mjx train {config.name}",
        "obstacle_task": name,
        "ObstacleTask": "".join(word[:1].upper() + word[1:] for word in name.split("_")),
    }
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for file, example in zip(files, _EXAMPLE, strict=True):
            text = (shipped_folder("examples") / example).read_text("utf-8")
            for old, new in renamed.items():
                text = text.replace(old, new)
            # Mode "x" does not overwrite a file that was created in the meantime.
            with file.open("x", encoding="utf-8") as out:
                out.write(text)
    except OSError as error:
        raise UserError(f"{error.filename}: {error.strerror}") from None
    return config
