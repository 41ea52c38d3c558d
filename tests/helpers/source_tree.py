"""The modules of the two packages, and what each imports."""

import ast
from pathlib import Path

ROOT = Path(__file__).parents[2]
PACKAGE, ENGINE = "jetbot_mjx", "onekernel"

COMMON = ("errors", "fallbacks", "interrupts", "packed", "mjx_import", "devices")
"""Modules of the root that every room but `config` may import, as those after them may."""


def modules_of(package):
    """Full names of its modules; a room's own is that of its `__init__`."""
    return {
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path
        for path in sorted((ROOT / package).rglob("*.py"))
        if "assets" not in path.parts
    }


def imports(source):
    """Full names of all that a module imports, wherever it does; they begin with a dot where the
    module names it by its own place."""
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Import(names):
                yield from (alias.name for alias in names)
            case ast.ImportFrom(module, names, level):
                home = "." * level + (f"{module}." if module else "")
                yield from (f"{home}{alias.name}" for alias in names)
            case ast.Call(func=ast.Attribute(attr="import_module"), args=[ast.Constant(name), *_]):
                yield name


def functions(tree, prefix=""):
    """Yield the qualified name and the node of every function and method of a syntax tree."""
    for node in ast.iter_child_nodes(tree):
        name = prefix
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            name = f"{prefix}{node.name}."
            if not isinstance(node, ast.ClassDef):
                yield prefix + node.name, node
        yield from functions(node, name)


def code_lines(text):
    """Number of lines that are neither blank nor comments nor strings of their own."""
    strings = {
        number
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
        for number in range(node.lineno, node.end_lineno + 1)
    }
    lines = enumerate(map(str.strip, text.splitlines()), start=1)
    return sum(bool(line) and line[0] != "#" and i not in strings for i, line in lines)
