"""Makes Markdown of docstrings that are written for the eye: an extension of Griffe.

Google's style lets an editor show what Markdown would lose: lists set in columns, units in
brackets, and `<name>` for a place to fill in.
"""

import re
from typing import Any

import griffe


class Docstrings(griffe.Extension):
    """Changes docstrings before mkdocstrings renders them; the source stays as it is."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """Changes the docstring of a module, class, function or attribute."""
        del kwargs
        if obj.docstring is not None:
            lines = "\n".join(map(_escape, obj.docstring.value.split("\n")))
            obj.docstring.value = _columns(lines) if obj.is_module else lines


def _escape(line: str) -> str:
    """Outside of code: `[0, π] [rad]` is no link named `rad`, and `<env_steps>` no HTML."""
    if line.startswith("    "):
        return line
    parts = re.split(r"(`[^`]*`)", line)
    parts[::2] = [part.replace("<", "&lt;").replace("] [", r"] \[") for part in parts[::2]]
    return "".join(parts)


def _columns(text: str) -> str:
    """Lines indented by two spaces, below others, are columns: a block of code."""

    def block(found: re.Match[str]) -> str:
        body = re.sub(r"^  ", "    ", found[0], flags=re.MULTILINE)
        return f"\n{body}".replace("&lt;", "<")

    return re.sub(r"(?:^  \S.*(?:\n|\Z))+", block, text, flags=re.MULTILINE)
