"""How the package hangs together: who may know whom, what is public, what no file may name."""

import ast
import importlib
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import jetbot_mjx

ROOT = Path(__file__).parents[1]
PACKAGE = "jetbot_mjx"

NOUNS = (
    "errors",
    "interrupts",
    "config",
    "trusted_files",
    "compiling",
    "imports",
    "mjx",
    "cholesky",
    "scalars",
    "moving",
    "schedule",
    "scalarize",
    "kernel",
    "llvm",
    "gpu",
    "xla_ffi",
    "cpu",
    "kinematics",
    "model",
    "task",
    "programs",
    "state",
    "physics",
    "env",
    "mujoco_jetbot",
    "variation",
    "motors",
    "sensors",
    "randomization",
    "mujoco_simulator",
    "wrappers",
    "task_trials",
    "method_checks",
    "task_checks",
    "policy",
    "advantages",
    "ppo",
    "trainer",
    "rollout",
    "evaluation",
    "robustness",
    "best_known",
    "report",
    "estimates",
    "comparison",
    "tables",
    "plots",
    "curves",
    "offscreen",
    "film",
    "store",
    "checkpoint",
    "resume",
    "faults",
    "run_folder",
    "aliases",
    "metrics",
    "report_files",
    "tracking",
    "terminal",
    "board",
    "dashboard",
    "recording",
    "preemption",
    "processes",
    "memory",
    "resumable_ppo",
    "brax_ppo",
    "training",
    "portable",
    "contract",
    "formats",
    "stand_in",
    "drive_log",
    "clock",
    "live",
    "player",
    "geoms",
    "scene",
    "panel",
    "browser",
    "native",
    "cli",
)
ADAPTERS = tuple(
    f"adapters.{name}"
    for name in (
        "view",
        "settings",
        "batch",
        "gymnasium",
        "vector",
        "stable_baselines3",
    )
)
VERBS = (
    "new_task",
    "check_env",
    "plan",
    "train",
    "evaluate",
    "render",
    "replay",
    "play",
    "export",
    "sim2real",
    "pretrained",
    "__main__",
)
ORDER = (*NOUNS, *ADAPTERS, *VERBS)
"""A module knows only those before it, a verb no other verb, and none but adapters an adapter."""

MAY_PRINT_AND_PARSE = ("cli", *VERBS)

OUTSIDERS = {
    "errors": set(),
    "config": {"pydantic", "pydantic_core", "ruamel"},
    "kinematics": {"jax", "jaxtyping"},
}
"""All that these import from outside the standard library and the package."""

OPTIONAL = {
    "gymnasium": ("adapters.gymnasium", "adapters.vector", "adapters.stable_baselines3"),
    "stable_baselines3": ("adapters.stable_baselines3",),
    "torch": (),
}
"""What only these may import."""

PUBLIC = {
    "load_config": "config",
    "make_env": "env",
    "wrap_for_training": "wrappers",
    "load_policy": "checkpoint",
    "PRETRAINED": "checkpoint",
    "JetBotEnv": "env",
    "GoalTask": "task",
    "Task": "task",
    "State": "state",
}


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


def complaints(name, source):
    """What a module of the package does that its place forbids."""
    known = ORDER[: ORDER.index(name)]
    for imported in imports(source):
        top, _, rest = imported.partition(".")
        own, _, deeper = rest.partition(".")
        if own == "adapters":
            own = f"{own}.{deeper.partition('.')[0]}"
            if name not in ADAPTERS:
                yield f"{name} imports {imported}: adapters are for others' programs"
                continue
        elif top in OPTIONAL and name not in OPTIONAL[top]:
            yield f"{name} imports {imported}, which is optional"
        if top == PACKAGE and own not in known:
            yield f"{name} imports {imported}, which does not stand before it"
        elif top == PACKAGE and name in VERBS and own in VERBS:
            yield f"{name} imports {imported}: verbs meet only in the run folder"
        elif top == "argparse" and name not in MAY_PRINT_AND_PARSE:
            yield f"{name} parses arguments"
    for node in ast.walk(ast.parse(source)):
        # A stream that was handed in may be written to.
        match node:
            case ast.Call(func=ast.Name("print"), keywords=keywords):
                streams = [keyword for keyword in keywords if keyword.arg == "file"]
                if not streams and name not in MAY_PRINT_AND_PARSE:
                    yield f"{name} prints in line {node.lineno}"


def test_every_module_has_a_place():
    modules = {path.stem for path in (ROOT / PACKAGE).glob("*.py")} - {"__init__"}
    adapters = {path.stem for path in (ROOT / PACKAGE / "adapters").glob("*.py")} - {"__init__"}
    assert modules | {f"adapters.{name}" for name in adapters} == set(ORDER)
    folders = [path for path in (ROOT / PACKAGE).rglob("*") if (path / "__init__.py").exists()]
    assert folders == [ROOT / PACKAGE / "adapters"]


def test_every_package_is_shipped():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    folders = [path.parent for path in (ROOT / PACKAGE).rglob("__init__.py")]
    packages = [".".join(folder.relative_to(ROOT).parts) for folder in folders]
    assert sorted(project["tool"]["setuptools"]["packages"]) == sorted(packages)


def test_every_asset_is_shipped():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    shipped = {
        path
        for pattern in project["tool"]["setuptools"]["package-data"][PACKAGE]
        for path in (ROOT / PACKAGE).glob(pattern)
    }
    files = {path for path in (ROOT / PACKAGE / "assets").rglob("*") if path.is_file()}
    assert files <= shipped


@pytest.mark.parametrize("name", ORDER)
def test_a_module_keeps_to_its_place(name):
    path = ROOT / PACKAGE / f"{name.replace('.', '/')}.py"
    assert list(complaints(name, path.read_text("utf-8"))) == []


@pytest.mark.parametrize(
    ("name", "source"),
    [
        ("kinematics", "from jetbot_mjx import env"),
        ("kinematics", "from jetbot_mjx import config, env as e"),
        ("kinematics", "import jetbot_mjx.env"),
        ("kinematics", "import jetbot_mjx.env as env"),
        ("kinematics", "from jetbot_mjx.env import JetBotEnv"),
        ("kinematics", "from . import env"),
        ("kinematics", "from .env import JetBotEnv"),
        ("kinematics", "def late():\n    from jetbot_mjx.env import JetBotEnv"),
        ("kinematics", "if TYPE_CHECKING:\n    from jetbot_mjx.env import JetBotEnv"),
        ("kinematics", "from jetbot_mjx.kinematics import yaw"),
        ("env", "import jetbot_mjx"),
        ("env", "from jetbot_mjx import load_config"),
        ("cli", "from jetbot_mjx.train import run"),
        ("evaluate", "from jetbot_mjx import train"),
        ("render", "from jetbot_mjx.evaluate import table"),
        ("env", "import argparse"),
        ("env", "from argparse import ArgumentParser"),
        ("env", "def step():\n    print('stepping')"),
        ("metrics", "print('line', flush=True)"),
        ("play", "from jetbot_mjx.adapters import JetBotGymEnv"),
        ("play", "from jetbot_mjx.adapters.gymnasium import JetBotGymEnv"),
        ("cli", "import jetbot_mjx.adapters.gymnasium"),
        ("env", "import gymnasium"),
        ("adapters.vector", "import stable_baselines3"),
        ("adapters.gymnasium", "import torch"),
        ("adapters.batch", "from jetbot_mjx.adapters.gymnasium import JetBotGymEnv"),
        ("adapters.gymnasium", "from jetbot_mjx.train import run"),
    ],
)
def test_a_breach_of_the_order_is_seen(name, source):
    assert len(list(complaints(name, source))) == 1


@pytest.mark.parametrize(
    ("name", "source"),
    [
        ("env", "import jax\nfrom jetbot_mjx import kinematics\nfrom jetbot_mjx.task import Task"),
        ("evaluate", "from jetbot_mjx import cli\nprint('done')"),
        ("cli", "import argparse"),
        ("metrics", "print('line', file=stream)"),
        ("adapters.vector", "import gymnasium\nfrom jetbot_mjx.adapters.batch import Batch"),
        ("adapters.vector", "from jetbot_mjx import cli\nfrom jetbot_mjx.env import make_env"),
    ],
)
def test_what_is_allowed_is_not_taken_for_a_breach(name, source):
    assert list(complaints(name, source)) == []


def test_the_package_tells_the_order_that_holds():
    told = re.findall(r"`([\w.]+)`", jetbot_mjx.__doc__)
    assert told == [*NOUNS, *VERBS]


@pytest.mark.parametrize("name", OUTSIDERS)
def test_a_module_imports_no_more_than_it_needs(name):
    tops = {
        imported.partition(".")[0]
        for imported in imports((ROOT / PACKAGE / f"{name}.py").read_text("utf-8"))
    }
    assert tops - sys.stdlib_module_names - {PACKAGE} == OUTSIDERS[name]


@pytest.mark.parametrize(("name", "home"), PUBLIC.items())
def test_a_public_name_is_that_of_its_module(name, home):
    module = importlib.import_module(f"{PACKAGE}.{home}")
    assert getattr(jetbot_mjx, name) is getattr(module, name)


def test_nothing_else_is_public():
    assert set(dir(jetbot_mjx)) == set(PUBLIC)
    with pytest.raises(AttributeError, match="'jetbot_mjx' has no attribute 'nothing'"):
        _ = jetbot_mjx.nothing


def test_importing_prints_nothing_and_starts_no_device(tmp_path):
    # A platform that does not exist: the first use of a device would raise.
    process = subprocess.run(
        [
            sys.executable,
            "-c",
            "import jetbot_mjx.plan, jetbot_mjx.train, jetbot_mjx.evaluate, jetbot_mjx.render,"
            " jetbot_mjx.replay, jetbot_mjx.play, jetbot_mjx.export, jetbot_mjx.sim2real",
        ],
        cwd=tmp_path,
        env={**os.environ, "JAX_PLATFORMS": "nowhere"},
        capture_output=True,
        text=True,
    )
    assert (process.returncode, process.stdout, process.stderr) == (0, "", "")


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
