"""Write a task or an environment to start from: a copy of an example under another name."""

import importlib.util
import keyword
from collections.abc import Iterable, Mapping
from pathlib import Path

from jetbot_mjx.config import shipped_folder
from jetbot_mjx.errors import UserError


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
    return _write(path, shipped_folder("examples") / "obstacle_task.py", "obstacle")


def write_environment_template(path: Path) -> Path:
    """Write an environment and its settings, as `write_task_template` does a task.

    Args:
      path: as for `write_task_template`.

    Returns:
      The path of the settings.

    Raises:
      UserError: as for `write_task_template`.
    """
    return _write(path, Path(__file__).parents[1] / "assets" / "point_env.py", "point_env")


def _write(path: Path, example: Path, settings: str) -> Path:
    """Write a copy of an example.

    Args:
      path: the path of the module.
      example: the module to copy, which has a class of its name.
      settings: the name of its settings, which are beside it.
    """
    # Check that the module can be imported by its name, and that nothing is overwritten.
    name = path.stem
    if path.suffix != ".py" or not name.isidentifier() or keyword.iskeyword(name):
        kind = example.stem.rpartition("_")[2]
        raise UserError(f"{path}: name a Python module, such as my_{kind}.py")
    config = path.with_suffix(".yaml")
    copies = {path: example, config: example.with_name(f"{settings}.yaml")}
    check_new(copies)
    if importlib.util.find_spec(name) is not None:
        raise UserError(f"{path}: a module {name} exists already: choose another name")
    # Copy the example under the new names.
    renamed = {
        f"jetbot-mjx train {settings}\n": f"jetbot-mjx train {config.name}\n",
        f"{settings}.yaml": config.name,
        example.stem: name,
        _class_name(example.stem): _class_name(name),
    }
    texts = {file: source.read_text("utf-8") for file, source in copies.items()}
    for old, new in renamed.items():
        texts = {file: text.replace(old, new) for file, text in texts.items()}
    write_new(texts)
    return config


def check_new(files: Iterable[Path]) -> None:
    """Raise an error if one of the files exists.

    Raises:
      UserError: it does.
    """
    for file in files:
        if file.exists():
            raise UserError(f"{file} exists already: choose another name")


def write_new(texts: Mapping[Path, str]) -> None:
    """Write files, none of which exists, and the folder of the first.

    Raises:
      UserError: one cannot be written.
    """
    try:
        next(iter(texts)).parent.mkdir(parents=True, exist_ok=True)
        for file, text in texts.items():
            # Mode "x" does not overwrite a file that was created in the meantime.
            with file.open("x", encoding="utf-8") as out:
                out.write(text)
    except OSError as error:
        raise UserError(f"{error.filename}: {error.strerror}") from None


def _class_name(module: str) -> str:
    return "".join(word[:1].upper() + word[1:] for word in module.split("_"))
