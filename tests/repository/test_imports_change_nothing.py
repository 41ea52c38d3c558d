"""Importing the packages changes nothing in the process, and starts no device."""

import ast
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("jetbot_mjx", "onekernel")

MODULES = [
    ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
    for package in PACKAGES
    for path in sorted((ROOT / package).rglob("*.py"))
    if "assets" not in path.parts
]

IMPORT_AND_COMPARE = """
import gc, importlib, json, logging, os, signal, sys, threading, types, warnings

OURS = ("jetbot_mjx", "onekernel")

def is_ours(name):
    return str(name).partition(".")[0] in OURS

def load(names):
    for name in names:
        try:
            importlib.import_module(name)
        except ImportError as error:
            # An optional package may be missing.
            if is_ours(error.name) or type(error) is ImportError:
                raise

def loggers():
    known = {None: logging.getLogger(), **logging.root.manager.loggerDict}
    return {
        str(name): [one.level, one.disabled, *map(repr, [*one.handlers, *one.filters])]
        for name, one in known.items()
        if isinstance(one, logging.Logger)
    }

def process():
    signals = {str(one): repr(signal.getsignal(one)) for one in signal.valid_signals()}
    streams = [sys.stdin, sys.stdout, sys.stderr]
    hooks = [sys.excepthook, sys.unraisablehook, sys.displayhook, threading.excepthook]
    return {
        "meta path": [repr(one) for one in sys.meta_path],
        "path": [*sys.path, *map(repr, sys.path_hooks)],
        "signals": signals,
        "garbage": [*gc.get_threshold(), gc.isenabled(), *map(repr, gc.callbacks)],
        "warnings": [repr(one) for one in warnings.filters] + [repr(warnings.showwarning)],
        "loggers": loggers(),
        "environment": dict(os.environ),
        "threads": sorted(one.name for one in threading.enumerate()),
        "streams and hooks": [repr(one) for one in [*streams, *hooks]],
    }

def quietly(look):
    # A library may warn when its attributes are looked at.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return look()

def replaced():
    found = []
    for name, module in [*sys.modules.items()]:
        if is_ours(name) or name == "__main__" or not isinstance(module, types.ModuleType):
            continue
        for key, value in [*vars(module).items()]:
            parts = {key: value}
            if isinstance(value, type) and value.__module__ == name:
                parts |= {f"{key}.{part}": one for part, one in vars(value).items()}
            found += [
                f"{name}.{part}"
                for part, one in parts.items()
                if isinstance(one, types.FunctionType | type) and is_ours(one.__module__)
            ]
    return found

def attributes():
    found = {}
    for name, module in [*sys.modules.items()]:
        if isinstance(module, types.ModuleType) and not is_ours(name):
            found[name] = [
                key
                for key, value in [*vars(module).items()]
                if not (isinstance(value, types.ModuleType) and f"{name}.{key}" in sys.modules)
            ]
    return found

others, ours = json.loads(sys.argv[1])
load(others)
before, loaded = process(), quietly(attributes)
load(ours)
after = process()
print(json.dumps({
    "before": before,
    "after": after,
    "loaded": loaded if others else quietly(attributes),
    "replaced": quietly(replaced),
}))
"""


def run(others, ours):
    code = [sys.executable, "-c", IMPORT_AND_COMPARE, json.dumps([others, ours])]
    # A platform that does not exist: the first use of a device would raise.
    environment = {**os.environ, "JAX_PLATFORMS": "nowhere"}
    done = subprocess.run(code, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert (done.returncode, done.stderr[-2000:]) == (0, "")
    *printed, found = done.stdout.splitlines()
    # MJX itself prints where its optional Warp is missing.
    assert all(line.startswith("Failed to import ") for line in printed)
    return json.loads(found)


def statements(node):
    """All statements that run when a module is imported."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
            continue
        if isinstance(child, ast.If) and ast.unparse(child.test) == "TYPE_CHECKING":
            continue
        yield child
        yield from statements(child)


def imported():
    """Names of the modules that the packages import when they are imported."""
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            if "assets" in path.parts:
                continue
            for node in statements(ast.parse(path.read_text("utf-8"))):
                if isinstance(node, ast.Import):
                    yield from (alias.name for alias in node.names)
                elif isinstance(node, ast.ImportFrom) and not node.level:
                    yield str(node.module)


@pytest.fixture(scope="module")
def others():
    own = {*PACKAGES, *sys.stdlib_module_names}
    return sorted({name for name in imported() if name.partition(".")[0] not in own})


@pytest.fixture(scope="module")
def after_others(others):
    assert {"jax", "brax", "tensorboardX"} <= {name.partition(".")[0] for name in others}
    return run(others, MODULES)


@pytest.mark.slow
@pytest.mark.parametrize(
    "what",
    [
        "meta path",
        "path",
        "signals",
        "garbage",
        "warnings",
        "loggers",
        "environment",
        "threads",
        "streams and hooks",
    ],
)
def test_importing_all_modules_leaves_the_process_as_it_is(after_others, what):
    assert after_others["after"][what] == after_others["before"][what]


@pytest.mark.slow
def test_importing_all_modules_replaces_nothing_of_others(after_others):
    assert after_others["replaced"] == []


@pytest.mark.slow
def test_importing_all_modules_loads_others_whole(after_others):
    expected, found = after_others["loaded"], run([], MODULES)["loaded"]
    # A module of which a part was hidden while it was imported lacks names.
    lacking = {
        f"{name}.{key}" for name in expected for key in set(expected[name]) - {*found.get(name, ())}
    }
    assert lacking == set()
