"""How the two packages hang together: who may know whom, what is public, what no file may name.

`onekernel` compiles functions and knows nothing of robots; `jetbot_mjx` trains robots by it. Each
is divided into rooms, and the code of a room sees of another only the names that the other's face,
its `__init__`, exports. Modules beside the rooms are seen as they are.
"""

import ast
import collections
import functools
import graphlib
import importlib
import re
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

import jetbot_mjx
import onekernel
from helpers.source_tree import COMMON, ENGINE, PACKAGE, ROOT, code_lines, imports, modules_of
from jetbot_mjx import __main__ as command_line

ROOMS = (
    "config",
    "terminal",
    "envs",
    "agents",
    "runs",
    "evaluation",
    "viewers",
    "training",
    "tuning",
    "deployment",
    "adapters",
    "startup",
)
"""A room imports only itself and those before it, and no command. No other room imports `adapters`,
which are for others' programs, or `startup`, which is for commands."""


ENGINE_ORDER = (
    *("errors", "background", "trusted_files", "lower", "codegen", "keys", "kernel", "fingerprint"),
    *("cpu", "gpu", "wasm", "backends", "round_off", "check", "derivatives", "traced"),
    *("fused", "explanation", "aot", "build", "optimum", "mujoco"),
)
"""Modules and rooms of the engine: each imports only itself and those before it."""

NEED_MUJOCO = ("optimum", "mujoco")
"""Modules of the engine that may import MuJoCo."""

ENGINE_ROOMS = ("lower", "codegen", "cpu", "gpu", "wasm", "aot", "build")

FACES = {
    ENGINE: 10,
    f"{ENGINE}.build": 16,
    f"{ENGINE}.mujoco": 3,
}
"""All that others see of the engine, with the most names that each may export."""

ABOUT_ROBOTS = re.compile(r"robot|jetbot|physics\.impl", re.IGNORECASE)
"""What the engine does not speak of."""

LARGEST_ROOM = 20
"""Of all code lines [%]."""

COMMANDS = ("__main__", *(module for module, _ in command_line.COMMANDS.values()))
"""A command imports whatever it likes but adapters and other commands."""

MOST_AT_THE_ROOT = 28

MAY_PRINT_AND_PARSE = ("cli", *COMMANDS, "onekernel.explanation")

MOST_LINES_OF_A_COMMAND = 95
"""A command parses and calls; what it calls is in a room. Its imports are not counted."""

OUTSIDERS = {
    "errors": set(),
    "config": {"lazy_loader", "pydantic", "pydantic_core", "ruamel"},
    "envs.kinematics": {"jax", "jaxtyping"},
}
"""All that these import from outside the standard library and the package."""

OPTIONAL = {
    "gymnasium": (
        "adapters",
        "adapters.base",
        "adapters.gymnasium",
        "adapters.vector",
        "adapters.stable_baselines3",
    ),
    "stable_baselines3": ("adapters.stable_baselines3",),
    "torch": (),
}
"""What only these may import."""


FILES = {**modules_of(ENGINE), **modules_of(PACKAGE)}
ROOM_NAMES = {*(f"{ENGINE}.{x}" for x in ENGINE_ROOMS), *(f"{PACKAGE}.{x}" for x in ROOMS)}


@functools.cache
def exports(face):
    """Names that a face exports, with the modules that they come from."""
    path = FILES[face]
    if path.with_suffix(".pyi").exists():
        tree = ast.parse(path.with_suffix(".pyi").read_text("utf-8"))
        return {
            alias.name: f"{face}.{node.module}"
            for node in tree.body
            if isinstance(node, ast.ImportFrom)
            for alias in node.names
        }
    # A back end is a module itself, and so is a face that is not lazy.
    module = importlib.import_module(face)
    return dict.fromkeys((x for x in vars(module) if not x.startswith("_")), face)


def source_of(name):
    """The source of a module of `jetbot_mjx`, or by its full name of one of `onekernel`."""
    name = name if name.partition(".")[0] == ENGINE else f"{PACKAGE}.{name}"
    return FILES[name].read_text("utf-8")


def room_of(name):
    """Full name of the room that a full name is in, or of the package at whose root it stands."""
    room = ".".join(name.split(".")[:2])
    return room if room in ROOM_NAMES else name.partition(".")[0]


def past_a_face(name, source):
    """What a module, by its full name, imports of another room that its face does not export."""
    for imported in imports(source):
        room, own = room_of(imported), room_of(name)
        if imported.startswith("."):
            yield f"{name} imports {imported}: say it in full"
        elif not imported.startswith((PACKAGE, ENGINE)) or own == room or imported == room:
            # A room itself is its face; of the engine, others see only two.
            if imported.startswith(ENGINE) and not name.startswith(ENGINE) and room not in FACES:
                yield f"{name} imports {imported}, which is no face of {ENGINE}"
        elif room in ROOM_NAMES or name.partition(".")[0] != room:
            if room.startswith(ENGINE) and not name.startswith(ENGINE) and room not in FACES:
                yield f"{name} imports {imported}, which is no face of {ENGINE}"
            elif imported.removeprefix(f"{room}.") not in exports(room):
                yield f"{name} imports {imported} past the face of {room}"


def engine_complaints(name, source):
    """What a module of the engine does that its place forbids."""
    place = name.split(".")[1] if "." in name else None
    for imported in imports(source):
        top, _, rest = imported.partition(".")
        if top == PACKAGE or (top == "mujoco" and place not in NEED_MUJOCO):
            yield f"{name} imports {imported}"
        elif top == ENGINE:
            other = rest.partition(".")[0]
            if other not in ENGINE_ORDER or place not in ENGINE_ORDER:
                yield f"{name} imports {imported}, which it may not know"
            elif ENGINE_ORDER.index(other) > ENGINE_ORDER.index(place):
                yield f"{name} imports {imported}, which comes later"
    yield from prints(name, source)


def prints(name, source):
    """Where a module prints. A stream that was handed in may be written to."""
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Call(func=ast.Name("print"), keywords=keywords):
                streams = [keyword for keyword in keywords if keyword.arg == "file"]
                if not streams and name not in MAY_PRINT_AND_PARSE:
                    yield f"{name} prints in line {node.lineno}"


def complaints(name, source):
    """What a module of `jetbot_mjx` does that its place forbids."""
    first = name.partition(".")[0]
    room = first if first in ROOMS else None
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
            elif own == "startup" and name in COMMANDS:
                continue
            elif name in COMMON or (room and ROOMS.index(own) > ROOMS.index(room)):
                yield f"{name} imports {imported}, a later room"
        elif top == PACKAGE and own in COMMANDS:
            yield f"{name} imports {imported}: commands meet only in the run folder"
        elif imported == f"{PACKAGE}.__version__":
            continue
        elif top == PACKAGE and own not in (*COMMON, *(["cli"] if may_use_cli else [])):
            yield f"{name} imports {imported}, which it may not know"
        elif top == PACKAGE and name in COMMON and COMMON.index(own) > COMMON.index(name):
            yield f"{name} imports {imported}, which comes later"
        elif top == PACKAGE and room == "config" and own == "devices":
            yield f"{name} imports {imported}, which needs it"
        elif top == "argparse" and name not in MAY_PRINT_AND_PARSE:
            yield f"{name} parses arguments"
    yield from prints(name, source)


def test_the_root_is_small_and_every_folder_a_room():
    at_root = [path.stem for path in (ROOT / PACKAGE).glob("*.py")]
    assert set(at_root) == {"__init__", "cli", "library", *COMMON, *COMMANDS}
    assert len(at_root) <= MOST_AT_THE_ROOT
    folders = {path.parent.name for path in (ROOT / PACKAGE).glob("*/__init__.py")}
    assert folders == set(ROOMS)


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_is_short(name):
    source = source_of(name)
    found = (x for x in ast.walk(ast.parse(source)) if isinstance(x, ast.Import | ast.ImportFrom))
    lines = len(source.splitlines()) - sum(x.end_lineno - x.lineno + 1 for x in found)
    assert lines <= MOST_LINES_OF_A_COMMAND


def test_the_package_tells_its_rooms_in_their_order():
    told = re.findall(r"^- `(\w+)`", jetbot_mjx.__doc__, re.MULTILINE)
    assert told == list(ROOMS)


def test_the_design_page_counts_the_rooms():
    design = (ROOT / "docs" / "design.md").read_text("utf-8")
    assert f"is {len(ROOMS)} rooms (folders)" in design
    table = re.findall(r"^\| \[`(\w+)`\]\(api/\w+/index\.md\)", design, re.MULTILINE)
    assert table == [ENGINE, *ROOMS]


def test_the_engine_tells_its_parts_in_their_order():
    told = re.findall(r"^- ([^:]+):", onekernel.__doc__, re.MULTILINE)
    names = [name.strip("` ") for line in told for name in line.split(",")]
    assert names == [name for name in ENGINE_ORDER if name in names]
    assert set(ENGINE_ROOMS) - {"build"} <= set(names)
    folders = {path.parent.name for path in (ROOT / ENGINE).glob("*/__init__.py")}
    assert folders == set(ENGINE_ROOMS)


def needs(name, source):
    """Modules that a module needs; a name of a face needs the module that it comes from."""
    for imported in imports(source):
        room, _, last = imported.rpartition(".")
        if room in FILES and imported not in FILES and FILES[room].stem == "__init__":
            yield exports(room).get(last, room)
        else:
            yield imported if imported in FILES else room


def circle(sources):
    """A circle that modules, by their names, form through their imports; None: there is none."""
    graph = {name: {*needs(name, text)} & sources.keys() - {name} for name, text in sources.items()}
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        return error.args[1]


def test_no_two_modules_need_each_other():
    assert circle({name: path.read_text("utf-8") for name, path in FILES.items()}) is None


def test_a_circle_through_faces_is_reported():
    sources = {
        "jetbot_mjx.envs.task": "from jetbot_mjx.agents import PPO",
        "jetbot_mjx.agents.ppo": "def late():\n    from jetbot_mjx.envs import Task",
    }
    assert set(circle(sources)) == set(sources)
    sources["jetbot_mjx.agents.ppo"] = "from jetbot_mjx.envs import State"
    assert circle(sources) is None


def test_all_that_is_needed_is_shipped(tmp_path):
    build = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(build, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    assert wheel.stat().st_size <= 8_000_000
    shipped = set(zipfile.ZipFile(wheel).namelist())
    tracked = subprocess.run(
        ["git", "ls-files", PACKAGE, ENGINE, "configs", "examples", "docs/*.md", "docs/llms.txt"],
        cwd=ROOT,
        capture_output=True,
        text=True,
    ).stdout.split()
    for path in tracked:
        name = path if path.startswith((PACKAGE, ENGINE)) else f"{PACKAGE}/{path}"
        assert name in shipped
    # What its own packages are: faces and templates too.
    for package in (PACKAGE, ENGINE):
        assert f"{package}/__init__.pyi" in shipped
    assert f"{ENGINE}/cpu/xla_call.ll" in shipped
    assert not any("__pycache__" in name or "docs/jetbot.gif" in name for name in shipped)


@pytest.mark.parametrize("name", [x for x in FILES if x.startswith(f"{PACKAGE}.")])
def test_a_module_keeps_to_its_place(name):
    own = name.removeprefix(f"{PACKAGE}.")
    assert list(complaints(own, source_of(own))) == []


@pytest.mark.parametrize("name", [x for x in FILES if x.partition(".")[0] == ENGINE])
def test_a_module_of_the_engine_keeps_to_its_place(name):
    assert list(engine_complaints(name, source_of(name))) == []


@pytest.mark.parametrize("name", FILES)
def test_a_module_sees_of_another_room_only_its_face(name):
    assert list(past_a_face(name, FILES[name].read_text("utf-8"))) == []


def lines_about_robots(text):
    return [line for line in text.splitlines() if ABOUT_ROBOTS.search(line)]


def test_the_engine_knows_nothing_of_robots():
    texts = [x for x in (ROOT / ENGINE).rglob("*") if x.suffix in (".py", ".pyi", ".ll")]
    assert {x.suffix for x in texts} == {".py", ".pyi", ".ll"}
    found = {path: lines_about_robots(path.read_text("utf-8")) for path in texts}
    assert {path: lines for path, lines in found.items() if lines} == {}


@pytest.mark.parametrize(
    "line",
    [
        "from jetbot_mjx.errors import UserError",
        '"""Run a kernel for all robots."""',
        "; one thread for each Robot",
        'raise KernelError("choose physics.impl = xla")',
        "_XLA_NAME = 'jetbot_mjx_kernel'",
    ],
)
def test_a_robot_in_the_engine_is_reported(line):
    assert lines_about_robots(f"x = 1\n{line}\n") == [line]


@pytest.mark.parametrize("line", ["from onekernel import cpu", "physics of an instance", "implies"])
def test_a_line_without_a_robot_is_not_reported(line):
    assert lines_about_robots(line) == []


@pytest.mark.parametrize(("face", "most"), FACES.items())
def test_a_face_of_the_engine_is_small(face, most):
    module = importlib.import_module(face)
    assert 0 < len(module.__all__) <= most
    assert set(module.__all__) <= {*exports(face)}
    for name in module.__all__:
        assert getattr(module, name) is not None


def shares(sources):
    """Share of each room, and of each root, in all code lines [%]."""
    counts = collections.Counter()
    for name, text in sources.items():
        counts[room_of(name)] += code_lines(text)
    return {room: round(100 * lines / counts.total()) for room, lines in counts.items()}


def test_no_room_is_too_large():
    found = shares({name: path.read_text("utf-8") for name, path in FILES.items()})
    assert {room: share for room, share in found.items() if share > LARGEST_ROOM} == {}


def test_code_lines_are_counted_without_words():
    text = '"""Words.\n\nMore."""\n\nx = 1  # note\n# note\ny = (\n    "text"\n)\n"""Y."""\n'
    assert code_lines(text) == 4
    assert shares({"onekernel.cpu": text, "onekernel.errors": text, "jetbot_mjx.cli": "x = 1"}) == {
        "onekernel.cpu": 44,
        "onekernel": 44,
        "jetbot_mjx": 11,
    }


@functools.cache
def uses():
    """Names that code of other rooms takes from a face, by the face."""
    found = collections.defaultdict(set)
    for name, path in FILES.items():
        source = path.read_text("utf-8")
        for imported in imports(source):
            face, _, last = imported.rpartition(".")
            if room_of(name) != face:
                found[face].add(last)
        # As text, because an annotation may be a string.
        for room, attr in re.findall(r"\b(\w+)\.(\w+)", source):
            found[f"{PACKAGE}.{room}"].add(attr)
            found[room].add(attr)
    for face in exports(PACKAGE), exports(ENGINE):
        for last, module in face.items():
            found[module].add(last)
    for text in [
        *(ROOT / "docs").glob("*.md"),
        *(ROOT / "docs").glob("*.py"),
        *(ROOT / "examples").glob("*.py"),
    ]:
        found["docs"] |= set(re.findall(r"\w+", text.read_text("utf-8")))
    return found


def idle(face, found):
    """Names that a face exports and nobody takes."""
    return {*exports(face)} - found[face] - found["docs"]


@pytest.mark.parametrize(
    "face", sorted(x for x in ROOM_NAMES if FILES[x].with_suffix(".pyi").exists())
)
def test_every_exported_name_is_used(face):
    assert idle(face, uses()) == set()


def test_an_unused_exported_name_is_reported():
    found = collections.defaultdict(set, {x: names - {"make_data"} for x, names in uses().items()})
    assert idle(f"{PACKAGE}.envs", found) == {"make_data"}


@pytest.mark.parametrize(
    ("name", "source"),
    [
        ("jetbot_mjx.agents.ppo", "from jetbot_mjx.envs.task import Task"),
        ("jetbot_mjx.agents.ppo", "from jetbot_mjx.envs import physics"),
        ("jetbot_mjx.agents.ppo", "from jetbot_mjx.envs import Task, physics"),
        ("jetbot_mjx.agents.ppo", "from jetbot_mjx.envs import *"),
        ("jetbot_mjx.agents.ppo", "import jetbot_mjx.envs.task"),
        ("jetbot_mjx.agents.ppo", "import jetbot_mjx.envs.task as task"),
        ("jetbot_mjx.agents.ppo", "from jetbot_mjx.envs.camera import render"),
        ("jetbot_mjx.agents.ppo", "def late():\n    from jetbot_mjx.envs.task import Task"),
        ("jetbot_mjx.agents.ppo", "if TYPE_CHECKING:\n    from jetbot_mjx.envs.task import Task"),
        ("jetbot_mjx.agents.ppo", "importlib.import_module('jetbot_mjx.envs.task')"),
        ("jetbot_mjx.agents.ppo", "from ..envs.task import Task"),
        ("jetbot_mjx.agents.ppo", "from . import networks"),
        ("jetbot_mjx.train", "from jetbot_mjx.training.session import run"),
        ("jetbot_mjx.train", "from jetbot_mjx.training import session"),
        ("jetbot_mjx.envs.physics", "from onekernel.kernel import Kernel"),
        ("jetbot_mjx.envs.physics", "from onekernel import kernel"),
        ("jetbot_mjx.envs.physics", "from onekernel import cpu"),
        ("jetbot_mjx.envs.physics", "import onekernel.cpu"),
        ("jetbot_mjx.envs.physics", "from onekernel.cpu import obstacle"),
        ("jetbot_mjx.envs.physics", "from onekernel.lower import scalarize"),
        ("jetbot_mjx.envs.physics", "from onekernel.build import nothing"),
        ("onekernel.kernel", "from onekernel.codegen.llvm import require"),
        ("onekernel.kernel", "from onekernel.codegen import llvm"),
        ("onekernel.cpu.xla_call", "from onekernel.lower.jaxpr import scalarize"),
        ("onekernel.aot.program_cache", "from onekernel.cpu import xla_call_of_another"),
    ],
)
def test_an_import_past_a_face_is_seen(name, source):
    assert len(list(past_a_face(name, source))) == 1


@pytest.mark.parametrize(
    ("name", "source"),
    [
        ("jetbot_mjx.agents.ppo", "import jax\nfrom jetbot_mjx.agents import networks"),
        ("jetbot_mjx.agents.ppo", "from jetbot_mjx.agents.networks import Networks"),
        ("jetbot_mjx.agents.ppo", "from jetbot_mjx.envs import Task, make_env"),
        ("jetbot_mjx.agents.ppo", "from jetbot_mjx import errors\nimport jetbot_mjx.errors"),
        ("jetbot_mjx.library", "from jetbot_mjx import evaluation\nimport jetbot_mjx.envs"),
        ("jetbot_mjx.envs.physics", "import onekernel\nfrom onekernel import Kernel"),
        ("jetbot_mjx.envs.physics", "from onekernel.build import LlvmWriter, cpu"),
        ("jetbot_mjx.envs.physics", "from onekernel import build\nimport onekernel.build"),
        ("onekernel.kernel", "from onekernel.errors import KernelError"),
        (
            "onekernel.aot.program_cache",
            "from onekernel import cpu\nfrom onekernel.cpu import NAME",
        ),
        ("onekernel.cpu.xla_call", "from onekernel.lower import scalarize"),
    ],
)
def test_an_import_from_a_face_is_not_taken_for_a_breach(name, source):
    assert list(past_a_face(name, source)) == []


@pytest.mark.parametrize(
    ("name", "source"),
    [
        ("onekernel.kernel", "from jetbot_mjx.errors import UserError"),
        ("onekernel.kernel", "def late():\n    import jetbot_mjx"),
        ("onekernel.kernel", "if TYPE_CHECKING:\n    from jetbot_mjx.config import Config"),
        ("onekernel.lower.jaxpr", "from onekernel.codegen import require"),
        ("onekernel.codegen.llvm", "from onekernel.kernel import Kernel"),
        ("onekernel.kernel", "from onekernel import cpu"),
        ("onekernel.errors", "from onekernel.lower import scalarize"),
        ("onekernel.kernel", "from onekernel import KernelError"),
        ("onekernel.cpu", "import onekernel"),
        ("onekernel.cpu", "from mujoco import mjx"),
        ("onekernel.cpu", "print('compiled')"),
    ],
)
def test_a_forbidden_import_in_the_engine_is_reported(name, source):
    assert len(list(engine_complaints(name, source))) == 1


@pytest.mark.parametrize(
    ("name", "source"),
    [
        ("onekernel", "import lazy_loader"),
        ("onekernel.kernel", "import jax\nfrom onekernel.codegen import require"),
        ("onekernel.cpu.xla_call", "from onekernel.kernel import Kernel"),
        ("onekernel.aot.program_cache", "from onekernel import cpu\nwarnings.warn('slow')"),
    ],
)
def test_an_allowed_import_in_the_engine_is_not_reported(name, source):
    assert list(engine_complaints(name, source)) == []


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
        ("envs.state", "import jetbot_mjx"),
        ("envs.state", "from jetbot_mjx import load_config"),
        ("envs.state", "from jetbot_mjx import cli"),
        ("config.load", "from jetbot_mjx.envs import Task"),
        ("config.load", "from jetbot_mjx import cli"),
        ("config.load", "from jetbot_mjx.devices import host_cpu"),
        ("devices", "from jetbot_mjx.envs import Task"),
        ("errors", "from jetbot_mjx.config import Config"),
        ("fallbacks", "from jetbot_mjx.imports import LIBRARIES"),
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
def test_a_forbidden_import_is_reported(name, source):
    assert len(list(complaints(name, source))) == 1


@pytest.mark.parametrize(
    ("name", "source"),
    [
        ("envs.jetbot_env", "import jax\nfrom jetbot_mjx.envs import kinematics"),
        ("envs.jetbot_env", "from onekernel import Kernel"),
        ("devices", "from jetbot_mjx import fallbacks"),
        ("evaluate", "from jetbot_mjx import cli\nprint('done')"),
        ("cli", "import argparse"),
        ("runs.metrics", "print('line', file=stream)"),
        ("adapters.vector", "import gymnasium\nfrom jetbot_mjx.adapters.batched_env import Batch"),
        ("adapters.vector", "from jetbot_mjx.envs.build import make_env"),
    ],
)
def test_an_allowed_import_is_not_reported(name, source):
    assert list(complaints(name, source)) == []


@pytest.mark.parametrize("name", OUTSIDERS)
def test_a_module_imports_no_more_than_it_needs(name):
    place = f"{PACKAGE}.{name}"
    sources = [p.read_text("utf-8") for x, p in FILES.items() if f"{x}.".startswith(f"{place}.")]
    tops = {imported.partition(".")[0] for source in sources for imported in imports(source)}
    assert tops - sys.stdlib_module_names - {PACKAGE} == OUTSIDERS[name]


@pytest.mark.parametrize("face", [PACKAGE, ENGINE, *sorted(ROOM_NAMES)])
def test_a_public_name_is_that_of_its_module(face):
    module = importlib.import_module(face)
    # What type checkers are told is what there is at run time.
    for name, home in exports(face).items():
        assert getattr(module, name) is getattr(importlib.import_module(home), name)
        assert name in dir(module)
    lazy = FILES[face].with_suffix(".pyi").exists()
    assert not lazy or set(module.__all__) == {*exports(face)}
    with pytest.raises(AttributeError, match="nothing"):
        _ = module.nothing


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
def test_a_forbidden_name_in_a_file_is_reported(pattern, line, found):
    texts = {Path("a.txt"): "first\n" + line.format("/", ".")}
    assert bool(findings(texts, pattern)) is found
