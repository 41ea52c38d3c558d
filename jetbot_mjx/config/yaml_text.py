"""Read YAML 1.2, and explain in one line what is wrong with it.

ruamel.yaml reads it, because it supports YAML 1.2, where `1e-3` is a number, and rejects a key that
is given twice.
"""

import math
import os
import re
import shlex
from pathlib import Path

from ruamel.yaml import YAML
from ruamel.yaml.constructor import SafeConstructor
from ruamel.yaml.error import YAMLError
from ruamel.yaml.nodes import Node

from jetbot_mjx.config.errors import ConfigError, ConfigNotFoundError
from jetbot_mjx.config.files import run_around
from jetbot_mjx.errors import clipped, shown

YAML_ENDINGS = (".yaml", ".yml", ".json")
"""Endings of files of settings: JSON is YAML too."""

_MOST_YAML_CHARACTERS = 100_000
_MOST_YAML_VALUES = 100_000
"""Largest size of a file of settings, as text and with all aliases replaced by what they stand for.
"""

_MOST_COMMAS = 20_000
_DEEPEST = 100
"""Most commas and levels of brackets of a text: ruamel.yaml takes seconds for some longer ones."""


_YAML_PROBLEMS = {
    r"found character '\t' that cannot start any token": "a tab: indent by spaces",
    "expected <block end>, but found '<block mapping start>'": (
        "it is indented neither as the line above it nor as the section it belongs to"
    ),
}
"""Messages of the parser that name its internals, and what to say in their place."""


def read_yaml(path: Path, what: str = "config") -> dict[str, object]:
    """Read a YAML file of settings; an empty file gives an empty dictionary.

    Args:
      path: the file.
      what: the argument that names the file, for error messages.

    Raises:
      ConfigError: the file cannot be read, or does not hold `key: value` lines.
    """
    try:
        with path.open(encoding="utf-8") as file:
            text = file.read(_MOST_YAML_CHARACTERS + 1)
    except FileNotFoundError:
        meant = path.with_name(f"{path.name}.yaml")
        remedy = f"did you mean {meant}?" if meant.is_file() else "give the path of a YAML file"
        message = f"{what} {path} does not exist: {remedy}"
        raise ConfigNotFoundError(message) from None
    except (OSError, ValueError) as error:
        if os.path.isdir(path):
            run = run_around(path) if what == "config" else None
            remedy = "give a YAML file"
            if run is not None:
                remedy = f"to continue that run, give --resume {shlex.quote(str(run))}"
            raise ConfigError(f"{what} {path} is a folder: {remedy}") from None
        reason = error.strerror if isinstance(error, OSError) else str(error)
        if isinstance(error, UnicodeDecodeError):
            reason = "it is not UTF-8 text"
        raise ConfigError(f"{what} {path} cannot be read: {reason}") from None
    if text.lstrip("\ufeff \n").startswith("<"):
        raise ConfigError(
            f"{what} {path} is XML, not YAML: name a robot's model in a configuration, as robot:"
            " {file: NAME.xml, ...}; `jetbot-mjx check-robot NAME.xml` prints that section"
        )
    return parse_yaml(text, f"{what} {path}")


def parse_yaml(text: str, source: str) -> dict[str, object]:
    """Return the settings that a text in YAML holds; an empty text gives an empty dictionary.

    Args:
      text: the text.
      source: description of its origin for error messages.

    Raises:
      ConfigError: the text is not valid YAML, or does not hold `key: value` lines.
    """
    if len(text) > _MOST_YAML_CHARACTERS:
        raise ConfigError(
            f"{source} has more than {_MOST_YAML_CHARACTERS:,} characters: that is not a"
            " configuration"
        )
    values = parse_any(text, source)
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise ConfigError(f"{source} holds {shown(values)}: write `key: value` lines")
    return values


def parse_any(text: str, source: str) -> object:
    """Return the value that a text in YAML stands for.

    Args:
      text: the text.
      source: description of its origin for error messages.

    Raises:
      ConfigError: the text is not valid YAML.
    """
    _check_shape(text, source)
    yaml = YAML(typ="safe", pure=True)
    yaml.Constructor = _BoundedConstructor
    yaml.composer.warn_double_anchors = False
    try:
        return yaml.load(text)
    except YAMLError as error:
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        mark = getattr(error, "problem_mark", None)
        place = f", line {mark.line + 1}" if mark else ""
        reason = _YAML_PROBLEMS.get(problem, clipped(problem))
        raise ConfigError(f"{source}{place} is not valid YAML: {reason}") from None
    except RecursionError:
        raise ConfigError(f"{source} is not valid YAML: it is nested too deeply") from None
    # Errors that ruamel.yaml does not convert: `!!int x`, `!!bool x`, endless integers.
    except (ValueError, LookupError) as error:
        endless = "integer string conversion" in str(error)
        reason = "a number has too many digits" if endless else clipped(str(error))
        raise ConfigError(f"{source} is not valid YAML: {reason}") from None


def _check_shape(text: str, source: str) -> None:
    """Refuse text that would take seconds to read.

    Args:
      text: the text.
      source: description of its origin for error messages.

    Raises:
      ConfigError: it has too many values, or too many brackets in each other.
    """
    if text.count(",") > _MOST_COMMAS:
        raise ConfigError(f"{source} has more than {_MOST_COMMAS:,} values: leave some out")
    depth = 0
    for bracket in re.findall(r"[\[\]{}]", text):
        depth = depth + 1 if bracket in "[{" else max(depth - 1, 0)
        if depth > _DEEPEST:
            raise ConfigError(f"{source} is not valid YAML: it is nested too deeply")


class _BoundedConstructor(SafeConstructor):
    """A `_BoundedConstructor` refuses text whose aliases stand for more values than it should."""

    def construct_document(self, node: Node) -> object:
        """Construct the value of a document, unless it would be too large."""
        if _count_values(node, {}) > _MOST_YAML_VALUES:
            raise YAMLError(f"its aliases stand for more than {_MOST_YAML_VALUES:,} values")
        return super().construct_document(node)


def _count_values(node: Node, known: dict[int, float]) -> float:
    """Return the number of nodes below a node with aliases replaced; infinite if it is recursive.

    Args:
      node: the node.
      known: the numbers found so far, by the identity of the node.
    """
    if id(node) not in known:
        known[id(node)] = math.inf
        children = node.value if isinstance(node.value, list) else []
        pairs = [child if isinstance(child, tuple) else (child,) for child in children]
        known[id(node)] = 1 + sum(_count_values(one, known) for pair in pairs for one in pair)
    return known[id(node)]
