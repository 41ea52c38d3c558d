"""How the package hangs together: who may know whom, what is public, what no file may name."""

import ast
import graphlib
import importlib
import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import jetbot_mjx
from jetbot_mjx import __main__ as command_line

ROOT = Path(__file__).parents[2]
PACKAGE = "jetbot_mjx"

ROOMS = (
    "compiler",
    "envs",
    "agents",
    "runs",
    "evaluation",
    "viewers",
    "training",
    "tuning",
    "deployment",
    "adapters",
)
"""A room imports only itself and those before it, and no command; adapters are imported by none."""

COMMON = ("config", "errors", "fallbacks", "imports", "interrupts")
"""Modules of the root that every room may import."""

COMMANDS = ("__main__", *(module for module, _ in command_line.COMMANDS.values()))
"""A command imports whatever it likes but adapters and other commands; it may be in a room."""

MOST_AT_THE_ROOT = 20

MAY_PRINT_AND_PARSE = ("cli", *COMMANDS)

MOST_LINES_OF_A_COMMAND = 99
"""A command parses and calls; what it calls is in a room."""

OUTSIDERS = {
    "errors": set(),
    "config": {"pydantic", "pydantic_core", "ruamel"},
    "envs.kinematics": {"jax", "jaxtyping"},
}
"""All that these import from outside the standard library and the package."""

OPTIONAL = {
    "gymnasium": ("adapters.base", "adapters.gymnasium", "adapters.vector"),
    "stable_baselines3": ("adapters.stable_baselines3",),
    "torch": (),
}
"""What only these may import."""

MODULES = tuple(
    ".".join(path.relative_to(ROOT / PACKAGE).with_suffix("").parts)
    for path in sorted((ROOT / PACKAGE).rglob("*.py"))
    if "assets" not in path.parts
)


def imports(source):
    """Full names of all that a module imports, wherever it does."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            home = ".".join(
                [PACKAGE] * (node.level > 0) + [node.module] * (node.module is not None)
            )
            yield from (f"{home}.{alias.name}" for alias in node.names)


def source_of(name):
    return (ROOT / PACKAGE / f"{name.replace('.', '/')}.py").read_text("utf-8")


def room_of(name):
    """The room of a module; None: it stands at the root."""
    first = name.partition(".")[0]
    return first if first in ROOMS else None


def complaints(name, source):
    """What a module of the package does that its place forbids."""
    room = room_of(name)
    may_use_cli = name in COMMANDS or not (room or name in COMMON)
    for imported in imports(source):
        top, _, rest = imported.partition(".")
        own = rest.partition(".")[0]
        if top in OPTIONAL and name not in OPTIONAL[top]:
            yield f"{name} imports {imported}, which is optional"
        elif top == PACKAGE and own == "adapters":
            if room != "adapters":
                yield f"{name} imports {imported}: adapters are for others' programs"
        elif top == PACKAGE and own in ROOMS:
            if rest in COMMANDS:
                yield f"{name} imports {imported}: commands meet only in the run folder"
            elif name in COMMON or (room and ROOMS.index(own) > ROOMS.index(room)):
                yield f"{name} imports {imported}, a later room"
        elif top == PACKAGE and own in COMMANDS:
            yield f"{name} imports {imported}: commands meet only in the run folder"
        elif imported == f"{PACKAGE}.__version__":
            continue
        elif top == PACKAGE and own not in (*COMMON, *(["cli"] if may_use_cli else [])):
            yield f"{name} imports {imported}, which it may not know"
        elif top == "argparse" and name not in MAY_PRINT_AND_PARSE:
            yield f"{name} parses arguments"
    for node in ast.walk(ast.parse(source)):
        # A stream that was handed in may be written to.
        match node:
            case ast.Call(func=ast.Name("print"), keywords=keywords):
                streams = [keyword for keyword in keywords if keyword.arg == "file"]
                if not streams and name not in MAY_PRINT_AND_PARSE:
                    yield f"{name} prints in line {node.lineno}"


def test_the_root_is_small_and_every_folder_a_room():
    at_root = [path.stem for path in (ROOT / PACKAGE).glob("*.py")]
    commands = {name for name in COMMANDS if "." not in name}
    assert set(at_root) == {"__init__", "cli", "library", *COMMON, *commands}
    assert len(at_root) <= MOST_AT_THE_ROOT
    folders = {path.parent.name for path in (ROOT / PACKAGE).glob("*/__init__.py")}
    assert folders == set(ROOMS)


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_is_short(name):
    assert len(source_of(name).splitlines()) <= MOST_LINES_OF_A_COMMAND


def test_the_package_tells_its_rooms_in_their_order():
    told = re.findall(r"^- `(\w+)`", jetbot_mjx.__doc__, re.MULTILINE)
    assert told == list(ROOMS)


def test_no_two_modules_need_each_other():
    needs = {}
    for name in MODULES:
        found = set(imports(source_of(name)))
        needs[name] = {
            other
            for other in MODULES
            for full in [f"{PACKAGE}.{other}"]
            if other != name and any(one == full or one.startswith(f"{full}.") for one in found)
        }
    # Raises where they form a circle.
    graphlib.TopologicalSorter(needs).prepare()


def test_all_that_is_needed_is_shipped(tmp_path):
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    shipped = set(zipfile.ZipFile(wheel).namelist())
    tracked = subprocess.run(
        ["git", "ls-files", PACKAGE, "configs", "examples"],
        cwd=ROOT,
        capture_output=True,
        text=True,
    ).stdout.split()
    for path in tracked:
        name = path if path.startswith(PACKAGE) else f"{PACKAGE}/{path}"
        assert name in shipped
    assert not any("__pycache__" in name for name in shipped)


@pytest.mark.parametrize("name", [name for name in MODULES if name != "__init__"])
def test_a_module_keeps_to_its_place(name):
    assert list(complaints(name, source_of(name))) == []


@pytest.mark.parametrize(
    ("name", "source"),
    [
        ("envs.state", "from jetbot_mjx.agents import ppo"),
        ("envs.state", "from jetbot_mjx import config, agents as a"),
        ("envs.state", "import jetbot_mjx.agents.ppo"),
        ("envs.state", "import jetbot_mjx.agents.ppo as ppo"),
        ("envs.state", "from jetbot_mjx.agents.ppo import PPO"),
        ("envs.state", "def late():\n    from jetbot_mjx.agents.ppo import PPO"),
        ("envs.state", "if TYPE_CHECKING:\n    from jetbot_mjx.agents.ppo import PPO"),
        ("envs.state", "from . import env"),
        ("envs.state", "import jetbot_mjx"),
        ("envs.state", "from jetbot_mjx import load_config"),
        ("envs.state", "from jetbot_mjx import cli"),
        ("compiler.kernel", "from jetbot_mjx.envs.task import Task"),
        ("config", "from jetbot_mjx.envs.task import Task"),
        ("config", "from jetbot_mjx import cli"),
        ("cli", "from jetbot_mjx.train import run"),
        ("evaluate", "from jetbot_mjx import train"),
        ("render", "from jetbot_mjx.evaluate import table"),
        ("envs.state", "import argparse"),
        ("envs.state", "from argparse import ArgumentParser"),
        ("envs.state", "def step():\n    print('stepping')"),
        ("runs.metrics", "print('line', flush=True)"),
        ("play", "from jetbot_mjx.adapters import JetBotGymEnv"),
        ("play", "from jetbot_mjx.adapters.gymnasium import JetBotGymEnv"),
        ("cli", "import jetbot_mjx.adapters.gymnasium"),
        ("envs.state", "import gymnasium"),
        ("adapters.vector", "import stable_baselines3"),
        ("adapters.gymnasium", "import torch"),
        ("adapters.gymnasium", "from jetbot_mjx.train import run"),
    ],
)
def test_a_breach_of_the_order_is_seen(name, source):
    assert len(list(complaints(name, source))) == 1


@pytest.mark.parametrize(
    ("name", "source"),
    [
        ("envs.jetbot_env", "import jax\nfrom jetbot_mjx.envs import kinematics"),
        ("envs.jetbot_env", "from jetbot_mjx.compiler.kernel import Kernel"),
        ("evaluate", "from jetbot_mjx import cli\nprint('done')"),
        ("cli", "import argparse"),
        ("runs.metrics", "print('line', file=stream)"),
        ("adapters.vector", "import gymnasium\nfrom jetbot_mjx.adapters.batched_env import Batch"),
        ("adapters.vector", "from jetbot_mjx.envs.jetbot_env import make_env"),
    ],
)
def test_what_is_allowed_is_not_taken_for_a_breach(name, source):
    assert list(complaints(name, source)) == []


@pytest.mark.parametrize("name", OUTSIDERS)
def test_a_module_imports_no_more_than_it_needs(name):
    tops = {imported.partition(".")[0] for imported in imports(source_of(name))}
    assert tops - sys.stdlib_module_names - {PACKAGE} == OUTSIDERS[name]


@pytest.mark.parametrize("package", [PACKAGE, *(f"{PACKAGE}.{room}" for room in ROOMS)])
def test_a_public_name_is_that_of_its_module(package):
    face = importlib.import_module(package)
    for node in ast.walk(ast.parse(Path(face.__file__).read_text("utf-8"))):
        # What type checkers are told is what there is at run time.
        if isinstance(node, ast.ImportFrom) and node.module.startswith(f"{package}."):
            for alias in node.names:
                if not alias.name.startswith("_") and not alias.asname.startswith("_"):
                    module = importlib.import_module(node.module)
                    assert getattr(face, alias.name) is getattr(module, alias.name)
                    assert alias.name in dir(face)
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = face.nothing


IMPORTED = (
    *(name for name in COMMANDS if name != "__main__"),
    "evaluation.evaluate_runs",
    "viewers.gallery",
    "training.session",
    "deployment.policy_export",
)


def test_importing_starts_no_device(tmp_path):
    # A platform that does not exist: the first use of a device would raise.
    process = subprocess.run(
        [
            sys.executable,
            "-c",
            f"import {', '.join(f'{PACKAGE}.{name}' for name in IMPORTED)}",
        ],
        cwd=tmp_path,
        env={**os.environ, "JAX_PLATFORMS": "nowhere"},
        capture_output=True,
        text=True,
    )
    assert (process.returncode, process.stderr) == (0, "")
    # MJX itself prints where its optional Warp is missing.
    assert all(line.startswith("Failed to import ") for line in process.stdout.splitlines())


# What no committed file may name. Put together here, so that this file does not name it either.

MACHINE_PATH = re.compile(
    r"(?<![\w.])/(?:" + "|".join(["work", "tmp", "root", "home", "Users"]) + ")/"
)
REGISTRIES = re.compile(
    "|".join(
        name + r"\." + top
        for name, top in [
            ("pypi", "org"),
            ("pythonhosted", "org"),
            ("anaconda", "org"),
            ("npmjs", "(?:com|org)"),
        ]
    ),
    re.IGNORECASE,
)


def committed_texts():
    """Path and text of every text file in git's index."""
    listed = subprocess.run(
        ["git", "-C", str(ROOT), "ls-files", "-z"], capture_output=True, text=True, check=True
    )
    for name in listed.stdout.split("\0"):
        path = ROOT / name
        if not path.is_file():
            continue
        content = path.read_bytes()
        if b"\0" not in content:
            yield Path(name), content.decode("utf-8")


@pytest.fixture(scope="module")
def texts():
    if not (ROOT / ".git").exists():
        pytest.skip("not a git checkout: nothing says which files are committed")
    return dict(committed_texts())


def findings(texts, pattern):
    return [
        f"{path}:{number}: {line.strip()}"
        for path, text in texts.items()
        for number, line in enumerate(text.splitlines(), start=1)
        if pattern.search(line)
    ]


def test_no_committed_file_names_a_path_of_one_machine(texts):
    shipped = {path: text for path, text in texts.items() if path.parts[0] != "tests"}
    assert Path("pyproject.toml") in shipped
    assert findings(shipped, MACHINE_PATH) == []


def test_no_committed_file_names_a_package_registry(texts):
    assert Path("constraints.txt") in texts
    assert findings(texts, REGISTRIES) == []


@pytest.mark.parametrize(
    ("pattern", "line", "found"),
    [
        (MACHINE_PATH, "cd {0}work{0}main", True),
        (MACHINE_PATH, '"{0}tmp{0}run"', True),
        (MACHINE_PATH, "={0}root{0}.cache", True),
        (MACHINE_PATH, "see docs{0}work{0}plan.md", False),
        (MACHINE_PATH, "..{0}tmp{0}run", False),
        (MACHINE_PATH, "x{0}workers{0}y", False),
        (REGISTRIES, "--index-url https:{0}{0}pypi{1}org{0}simple", True),
        (REGISTRIES, "files{1}PythonHosted{1}org", True),
        (REGISTRIES, "the PyPI organisation", False),
    ],
)
def test_what_no_file_may_name_is_seen(pattern, line, found):
    texts = {Path("a.txt"): "first\n" + line.format("/", ".")}
    assert bool(findings(texts, pattern)) is found
