"""Keep the files of robots' models, by their hash.

A configuration names a model without its folder, and holds the hash of all files that it consists
of. So it means the same model wherever it is: beside the user's own configuration, in a run folder,
which has copies of the files, and after the user has changed them.
"""

import hashlib
import math
import stat
from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.etree import ElementTree

from jetbot_mjx.config.errors import ConfigError, ConfigNotFoundError
from jetbot_mjx.errors import check_answer, shown

FOLDER = "robot"
"""Folder of a run that holds the files of its robot's model."""

MAX_BYTES = 20_000_000
"""Largest size of all files of a model together."""

_MOST_ELEMENTS = 10_000
"""Most elements of a model's file, with those that it repeats: MuJoCo takes seconds for as many."""

_MOST_ATTACHED = 16
"""Most models that one file attaches, for each may attach others."""

_MODELS: dict[str, Mapping[str, bytes]] = {}
"""Files of each model that this process has read, by their hash."""

_URDF = (
    "this is URDF, which has no motors: make MJCF of it in Python, by spec ="
    " mujoco.MjSpec.from_file(...), spec.worldbody.first_body().add_freejoint(),"
    " spec.add_actuator(...) for each driven wheel, spec.compile(), and spec.to_xml()"
)

_NAN = {"nan", "+nan", "-nan"}

_NAMES = ("name", "class", "childclass")
"""Attributes that give names, of which one may be called `nan`."""

_FOLDERS = {"mesh": "meshdir", "texture": "texturedir", "hfield": "meshdir", "skin": "meshdir"}
"""Attributes of MJCF's `compiler` that name the folders of elements."""


def register(path: Path, code: str | None = None) -> str:
    """Read a model with all files that it names: those that it includes, meshes and textures.

    Args:
      path: an MJCF.
      code: name of a Python file beside it that belongs to it; None: there is none.

    Returns:
      The hash of its files.

    Raises:
      ConfigError: a file cannot be read, is outside of the model's folder, or is not an MJCF; or
        there are more than `MAX_BYTES`.
    """
    if "\0" in f"{path}{code}":
        raise ConfigError(f"robot.file {path} cannot be read: embedded null byte")
    files: dict[str, bytes] = {}
    trees: list[ElementTree.Element] = []
    _collect(path, path.parent, files, trees)
    _collect_assets(trees, path.parent, files)
    if code is not None:
        _read(path.parent / code, path.parent, files)
    if (size := sum(map(len, files.values()))) > MAX_BYTES:
        raise _too_large(path, size)
    digest = hashlib.sha256(path.name.encode())
    for name, content in sorted(files.items()):
        digest.update(f"{name}\0{len(content)}\0".encode() + content)
    _MODELS[digest.hexdigest()] = files
    return digest.hexdigest()


def model_files(digest: str) -> Mapping[str, bytes] | None:
    """Return the files of a model.

    Args:
      digest: the hash of its files, as of `register`.

    Returns:
      The content of each file by its path from the model's folder; None if this process has not
      read the model.
    """
    return _MODELS.get(digest)


def _collect(
    path: Path,
    root: Path,
    files: dict[str, bytes],
    trees: list[ElementTree.Element],
    within: tuple[Path, ...] = (),
) -> None:
    """Add a model's file and those that it includes, and what they hold."""
    if path.resolve() in within:
        raise ConfigError(f"robot.file {path}: it is a part of itself, by <include> or <model>")
    before = len(files)
    text = _read(path, root, files)
    if len(files) == before:
        return
    try:
        tree = ElementTree.fromstring(text.decode("utf-8-sig"))
    except UnicodeDecodeError:
        raise ConfigError(f"robot.file {path}: this is not UTF-8 text, as MJCF is") from None
    except ElementTree.ParseError as error:
        reason = f"this is not XML: {error}" if text.strip() else "it is empty"
        raise ConfigError(f"robot.file {path}: {reason}") from None
    if tree.tag == "robot":
        raise ConfigError(f"robot.file {path}: {_URDF}")
    if tree.tag not in ("mujoco", "mujocoinclude"):
        raise ConfigError(
            f"robot.file {path}: <{tree.tag}> is not a MuJoCo model: its root should be <mujoco>"
        )
    _check_numbers(path, tree)
    _check_size(path, tree)
    trees.append(tree)
    for element in tree.iter():
        if element.tag in ("include", "model") and (name := element.get("file")):
            _collect(root / name, root, files, trees, (*within, path.resolve()))


def _check_numbers(path: Path, tree: ElementTree.Element) -> None:
    """Refuse NaN, which MuJoCo reads as a number, with a warning in a file of its own."""
    names = {element.get(key) for element in tree.iter() for key in _NAMES}
    for element in tree.iter():
        for key, text in element.items():
            if text not in names and _NAN.intersection(text.lower().split()):
                raise ConfigError(
                    f"robot.file {path}: <{element.tag} {key}={shown(text)}> holds NaN: give a"
                    " number"
                )


def _check_size(path: Path, tree: ElementTree.Element) -> None:
    """Refuse a file of many elements, or a small one that stands for many."""
    attached = sum(1 for _ in tree.iter("attach"))
    try:
        count = _count_elements(tree)
    except (RecursionError, ValueError):
        raise ConfigError(
            f"robot.file {path}: it is nested too deeply, or a count is no whole number"
        ) from None
    if count > _MOST_ELEMENTS or attached > _MOST_ATTACHED:
        raise ConfigError(
            f"robot.file {path}: it stands for {count:,} elements and attaches {attached} models:"
            f" at most {_MOST_ELEMENTS:,} and {_MOST_ATTACHED} can be used"
        )


def _count_elements(element: ElementTree.Element) -> int:
    """Return the number of elements that an element stands for, itself included."""
    own = 1
    if element.tag in ("replicate", "composite", "flexcomp"):
        own = math.prod(max(int(x), 1) for x in element.get("count", "1").split())
    return own * (1 + sum(map(_count_elements, element)))


def _collect_assets(
    trees: Sequence[ElementTree.Element], root: Path, files: dict[str, bytes]
) -> None:
    """Add what a model's files name: meshes, textures and height fields."""
    compiler = {}
    for tree in trees:
        for element in tree.iter("compiler"):
            compiler |= element.attrib
    for element in (one for tree in trees for one in tree.iter()):
        if element.tag not in _FOLDERS:
            if "file" in element.attrib and element.tag not in ("include", "model"):
                raise ConfigError(
                    f"robot.file: <{element.tag} file={shown(element.get('file'))}> names a file"
                    " that a run cannot store: leave it out"
                )
            continue
        folder = compiler.get(_FOLDERS[element.tag], compiler.get("assetdir", ""))
        # A cube's texture has a file for each side.
        for name in (value for key, value in element.items() if key.startswith("file")):
            inner = Path(name).name if compiler.get("strippath") == "true" else name
            _read(root / folder / inner, root, files)


def _too_large(path: Path, size: int) -> ConfigError:
    return ConfigError(
        f"robot.file {path}: {size:,} bytes are more than {MAX_BYTES:,}: leave out what only shows"
    )


def _read(path: Path, root: Path, files: dict[str, bytes]) -> bytes:
    """Read one file, and add it."""
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            kind = "a folder" if stat.S_ISDIR(status.st_mode) else "no regular file"
            raise ConfigError(f"robot.file {path} is {kind}")
        if status.st_size > MAX_BYTES:
            raise _too_large(path, status.st_size)
        content = path.read_bytes()
    except FileNotFoundError:
        raise ConfigNotFoundError(f"robot.file {path} does not exist") from None
    except OSError as error:
        check_answer(error.errno, f"robot.file {path}")
        raise ConfigError(f"robot.file {path} cannot be read: {error.strerror}") from None
    try:
        name = path.resolve().relative_to(root.resolve()).as_posix()
    except ValueError:
        raise ConfigError(
            f"robot.file: {path} is outside of the model's folder, {root}: a run stores that folder"
        ) from None
    files[name] = content
    return content
