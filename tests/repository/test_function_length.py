"""No function is longer than a screen."""

import ast

import pytest

from helpers.source_tree import ROOT, functions

MOST_LINES = 60
"""From `def` to the end, docstring and all, without decorators."""

FILES = [
    path
    for folder in ("jetbot_mjx", "onekernel", "deploy", "benchmarks", "examples")
    for path in sorted((ROOT / folder).rglob("*.py"))
]


def long_functions(source):
    """Names of functions and methods that are too long, with their numbers of lines."""
    lengths = {
        name: node.end_lineno - node.lineno + 1 for name, node in functions(ast.parse(source))
    }
    return {name: lines for name, lines in lengths.items() if lines > MOST_LINES}


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_every_function_fits_on_a_screen(path):
    assert long_functions(path.read_text("utf-8")) == {}, "find the function inside it"


def function_of(lines, indent=""):
    """The text of a function of so many lines, with a decorator."""
    body = "".join(f"{indent}    x{i} = {i}\n" for i in range(lines - 1))
    return f"{indent}@cache\n{indent}def work():\n{body}"


def test_a_line_too_many_is_seen_wherever_the_function_is():
    assert long_functions(function_of(60)) == {}
    assert long_functions(function_of(61)) == {"work": 61}
    assert long_functions(f"class Robot:\n{function_of(61, '    ')}") == {"Robot.work": 61}
    inner = f"def outer():\n{function_of(61, '    ')}"
    assert long_functions(inner) == {"outer": 63, "outer.work": 61}
    assert long_functions(f"if True:\n{function_of(61, '    ')}") == {"work": 61}
