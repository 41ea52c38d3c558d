"""Convert docstrings into Markdown: a Griffe extension.

Docstrings in Google's style are written for editors. They contain what Markdown would lose: lists
set in columns, units in brackets, and `<name>` for a placeholder.
"""

import re
from typing import Any

import griffe


class Docstrings(griffe.Extension):
    """A `Docstrings` extension converts docstrings before mkdocstrings renders them."""

    def on_object(self, *, obj: griffe.Object, **kwargs: Any) -> None:
        """Convert the docstring of a module, class, function or attribute."""
        del kwargs
        if obj.docstring is not None:
            lines = "\n".join(map(_escape, obj.docstring.value.split("\n")))
            obj.docstring.value = _columns(lines) if obj.is_module else lines


def _escape(line: str) -> str:
    """Escape outside of code: `[0, π] [rad]` is not a link, and `<env_steps>` is not HTML."""
    if line.startswith("    "):
        return line
    parts = re.split(r"(`[^`]*`)", line)
    parts[::2] = [part.replace("<", "&lt;").replace("] [", r"] \[") for part in parts[::2]]
    return "".join(parts)


def _columns(text: str) -> str:
    """Convert lines that are indented by two spaces, which are columns, into a block of code."""

    def block(found: re.Match[str]) -> str:
        body = re.sub(r"^  ", "    ", found[0], flags=re.MULTILINE)
        return f"\n{body}".replace("&lt;", "<")

    return re.sub(r"(?:^  \S.*(?:\n|\Z))+", block, text, flags=re.MULTILINE)
