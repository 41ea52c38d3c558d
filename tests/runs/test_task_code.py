"""The source of a task in its run: what is stored, which source runs, and what is reported."""

import importlib
import json
import sys
import textwrap

import pytest

from helpers import gliding
from jetbot_mjx.config import load_config, parse_config
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.mujoco_env import MujocoJetBot
from jetbot_mjx.envs.task import GoalTask
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs import Setup, task_code
from jetbot_mjx.runs.checkpoint import load_checkpoint
from jetbot_mjx.runs.task_code import (
    collect_task_code,
    read_task_code,
    write_task_code,
)
from jetbot_mjx.training import composition, session

NAME = "kicking_task"

TASK = """
import os
import jax
import typing
from jetbot_mjx.envs.task import GoalTask
from kicking_words import WORD
from kicking_tools import FACTOR

class Kick(typing.NamedTuple):
    speed: float

class Task(GoalTask):
    factor = FACTOR

    def word(self):
        return WORD
"""
TOOLS = "import kicking_deep\nFACTOR = {}\n"
FILES = {f"{NAME}.py", "kicking_tools.py", "kicking_words.py", "kicking_deep.py"}


@pytest.fixture(autouse=True)
def forget(monkeypatch):
    """Each test imports its task, and gets its messages, for the first time."""
    monkeypatch.setattr(task_code, "_said", set())
    monkeypatch.setattr(task_code, "_modules", {})


def stored_class(run_dir, name):
    """The class from the source that a run stored, if it stored any."""
    code = read_task_code(run_dir)
    return code and task_code.stored_class(run_dir, name, code)


def own_modules():
    return {name for name in sys.modules if name.startswith("kicking_")}


def write_task(folder, factor=1):
    folder.mkdir(exist_ok=True)
    (folder / f"{NAME}.py").write_text(TASK)
    (folder / "kicking_tools.py").write_text(TOOLS.format(factor))
    (folder / "kicking_words.py").write_text(f"WORD = 'word {factor}'\n")
    (folder / "kicking_deep.py").write_text("import numpy\n")
    (folder / "kicking_other.py").write_text("raise AssertionError\n")
    return folder


def store(run_dir, folder, factor=1):
    """A run folder with the source of a task that nothing imports any more."""
    write_task(folder, factor)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        code = collect_task_code(f"{NAME}:Task")
    run_dir.mkdir(exist_ok=True)
    write_task_code(run_dir, code)
    return run_dir


def test_the_module_and_all_that_it_imports_beside_it_are_stored(tmp_path):
    run_dir = store(tmp_path / "run", tmp_path / "src")
    assert {path.name for path in (run_dir / "task").iterdir()} == FILES | {"sources.json"}
    assert (run_dir / "task" / f"{NAME}.py").read_text() == TASK
    found = read_task_code(run_dir)
    assert found.module == NAME
    assert {path for path, _ in found.files} == FILES


@pytest.mark.parametrize(
    "name",
    [
        "jetbot_mjx:GoalTask",
        "jetbot_mjx.envs.task:GoalTask",
        "numpy:ndarray",
        "json:JSONDecoder",
        "nowhere_at_all:Task",
        "__main__:Task",
    ],
)
def test_packages_and_what_has_no_file_are_not_stored(name):
    assert collect_task_code(name) is None


def test_packages_are_stored_with_their_folders(tmp_path, monkeypatch, capsys):
    for path, text in {
        "kicking_pkg/__init__.py": "from . import base\n",
        "kicking_pkg/base.py": "FACTOR = 5\n",
        "kicking_pkg/unused.py": "",
        "kicking_pkg/tasks/push.py": "from ..base import FACTOR\n"
        "class Push:\n    factor = FACTOR\n",
    }.items():
        (tmp_path / "src" / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "src" / path).write_text(text)
    name = "kicking_pkg.tasks.push:Push"
    with monkeypatch.context() as patch:
        patch.syspath_prepend(tmp_path / "src")
        code = collect_task_code(name)
    assert [path for path, _ in code.files] == [
        "kicking_pkg/__init__.py",
        "kicking_pkg/base.py",
        "kicking_pkg/tasks/push.py",
    ]
    write_task_code(tmp_path, code)
    assert stored_class(tmp_path, name).factor == 5
    assert own_modules() == set()


def test_a_task_that_is_too_large_is_not_stored_and_a_line_says_so(tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(write_task(tmp_path / "src"))
    monkeypatch.setattr(task_code, "MAX_BYTES", 100)
    assert collect_task_code(f"{NAME}:Task") is None
    assert "is larger than 100 bytes and is not stored" in capsys.readouterr().err


@pytest.mark.parametrize("statement", ["import kicking_tools", "from kicking_tools import FACTOR"])
def test_a_task_with_late_imports_is_not_stored_and_a_line_says_so(
    tmp_path, monkeypatch, capsys, statement
):
    source = write_task(tmp_path / "src")
    late = f"class Task:\n    def reward(self):\n        import numpy\n        {statement}\n"
    (source / f"{NAME}.py").write_text(late)
    monkeypatch.syspath_prepend(source)
    monkeypatch.chdir(source)
    assert collect_task_code(f"{NAME}:Task") is None
    assert capsys.readouterr().err == (
        f"{NAME}.py, line 4: imports kicking_tools inside a function, so that the source of"
        f" {NAME}:Task is not stored in the run: move the import to the top of the file\n"
    )


def test_stored_source_runs_where_the_module_cannot_be_found(tmp_path, monkeypatch, capsys):
    run_dir = store(tmp_path / "run", tmp_path / "src", 3)
    before = list(sys.path), list(sys.meta_path), sys.dont_write_bytecode
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module(NAME)
    monkeypatch.chdir(tmp_path)
    found = stored_class(run_dir, f"{NAME}:Task")
    assert issubclass(found, GoalTask)
    assert (found.__module__, found.factor) == (NAME, 3)
    said = capsys.readouterr().err
    assert said == f"running the code stored in run/task/{NAME}.py\n"
    # It leaves no trace.
    assert (sys.path, sys.meta_path, sys.dont_write_bytecode) == before
    assert own_modules() == set()
    assert found.word(None) == "word 3"
    assert not list(run_dir.rglob("*.pyc"))
    # The same class once more, without another line.
    assert stored_class(run_dir, f"{NAME}:Task") is found
    assert capsys.readouterr().err == ""


def test_the_module_itself_runs_where_nothing_changed(tmp_path, monkeypatch, capsys):
    run_dir = store(tmp_path / "run", tmp_path / "src")
    monkeypatch.syspath_prepend(tmp_path / "src")
    assert stored_class(run_dir, f"{NAME}:Task") is None
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ("module", f"{NAME}.py"),
        ("imported", "kicking_tools.py"),
        ("removed", "kicking_words.py"),
    ],
)
def test_stored_source_runs_where_the_module_has_changed(
    tmp_path, monkeypatch, capsys, change, named
):
    run_dir = store(tmp_path / "run", tmp_path / "src", 3)
    if change == "module":
        (tmp_path / "src" / f"{NAME}.py").write_text(TASK.replace("= FACTOR", "= 8"))
    elif change == "imported":
        write_task(tmp_path / "src", 4)
    else:
        (tmp_path / "src" / "kicking_words.py").unlink()
    monkeypatch.syspath_prepend(tmp_path / "src")
    on_disk = None if change == "removed" else importlib.import_module(NAME)
    found = stored_class(run_dir, f"{NAME}:Task")
    assert found.factor == 3
    assert found.word(None) == "word 3"
    said = capsys.readouterr().err
    assert said.startswith(
        f"{named} on disk differs from the code this run was trained with: using"
    )
    assert said.count("\n") == 1
    assert sys.modules.get(NAME) is on_disk
    if on_disk:
        assert on_disk.Task.factor == {"module": 8, "imported": 4}[change]


def test_runs_with_different_sources_of_one_name_each_have_their_own(tmp_path):
    runs = [store(tmp_path / f"run-{n}", tmp_path / f"src-{n}", n) for n in (1, 2)]
    same = store(tmp_path / "run-3", tmp_path / "src-3", 2)
    one, two, three = (stored_class(run_dir, f"{NAME}:Task") for run_dir in [*runs, same])
    assert (one.factor, two.factor) == (1, 2)
    assert (one.word(None), two.word(None)) == ("word 1", "word 2")
    assert two is three


@pytest.mark.parametrize(
    ("file", "text", "said"),
    [
        ("kicking_tools.py", "FACTOR = 7", "is not the file that the training stored"),
        ("kicking_tools.py", None, "is missing"),
        ("sources.json", "{", "is damaged"),
        ("sources.json", "[]", "is damaged"),
        ("sources.json", '{"module": "a"}', "is damaged"),
        ("sources.json", '{"module": "a", "sha256": {"../../a.py": "0"}}', "is damaged"),
        ("sources.json", '{"module": "a", "sha256": {"/a.py": "0"}}', "is damaged"),
    ],
)
def test_damaged_source_is_refused_in_one_line(tmp_path, file, text, said):
    run_dir = store(tmp_path / "run", tmp_path / "src")
    if text is None:
        (run_dir / "task" / file).unlink()
    else:
        (run_dir / "task" / file).write_text(text)
    with pytest.raises(UserError, match="restore it, or delete") as caught:
        stored_class(run_dir, f"{NAME}:Task")
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)
    assert own_modules() == set()


def test_a_run_without_stored_source_imports_by_name(tmp_path):
    assert stored_class(tmp_path, f"{NAME}:Task") is None
    assert stored_class(tmp_path / "nowhere", f"{NAME}:Task") is None
    # So does one whose folder holds the source of another task.
    store(tmp_path / "run", tmp_path / "src")
    assert stored_class(tmp_path / "run", "other_task:Task") is None


def test_this_package_is_never_replaced(tmp_path):
    code = task_code.TaskCode("jetbot_mjx", (("jetbot_mjx.py", b"raise AssertionError"),))
    write_task_code(tmp_path, code)
    assert stored_class(tmp_path, "jetbot_mjx:GoalTask") is None


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ("import kicking_absent\n", "no module named 'kicking_absent'"),
        ("Other = 1\n", "has no 'Task'"),
    ],
)
def test_source_that_does_not_hold_the_task_is_refused(tmp_path, source, said):
    code = task_code.TaskCode(NAME, ((f"{NAME}.py", source.encode()),))
    write_task_code(tmp_path, code)
    with pytest.raises(UserError, match=said):
        stored_class(tmp_path, f"{NAME}:Task")
    assert own_modules() == set()


def test_the_hashes_are_sha256(tmp_path):
    run_dir = store(tmp_path / "run", tmp_path / "src")
    stored = json.loads((run_dir / "task" / "sources.json").read_text())
    assert stored["module"] == NAME
    assert set(stored["sha256"]) == FILES
    assert {len(one) for one in stored["sha256"].values()} == {64}


def test_dataclasses_with_annotations_as_text_work(tmp_path):
    source = textwrap.dedent(
        """
        from __future__ import annotations
        import dataclasses

        @dataclasses.dataclass
        class Task:
            at: Place
            gone: dataclasses.InitVar[int] = 0

        class Place:
            pass
        """
    )
    write_task_code(tmp_path, task_code.TaskCode(NAME, ((f"{NAME}.py", source.encode()),)))
    assert stored_class(tmp_path, f"{NAME}:Task")(3).at == 3


@pytest.mark.slow
def test_a_run_is_whole_without_the_module_and_resumes_with_its_own_task(
    tmp_path, root, monkeypatch, capsys
):
    source = write_task(tmp_path / "src", 3)
    config = load_config(
        root / "configs" / "smoke.yaml", [f"task.name={NAME}:Task", "ppo.num_timesteps=16384"]
    )
    run_dir = tmp_path / "run"
    with gliding.everywhere(), monkeypatch.context() as patch:
        patch.syspath_prepend(source)
        session.run(config, run_dir)
    assert (run_dir / "task" / "kicking_tools.py").is_file()
    for name in own_modules():
        del sys.modules[name]
    # Without the module.
    checkpoint = load_checkpoint(run_dir)
    env = checkpoint.make_env()
    assert env.task.factor == 3
    assert MujocoJetBot(checkpoint.config, type(env.task)).env.task.factor == 3
    # With one that has changed.
    write_task(source, 4)
    monkeypatch.syspath_prepend(source)
    assert make_env(config).task.factor == 4
    assert load_checkpoint(run_dir).make_env().task.factor == 3
    monkeypatch.setattr(task_code, "_said", set())
    capsys.readouterr()
    task_class, code = composition.find_code(config, [run_dir])
    assert (task_class.factor, code) == (3, None)
    assert "kicking_tools.py on disk differs from the code this run was" in capsys.readouterr().err
    # A new run has the new one, in the folders of all of its seeds.
    two = parse_config({**config.model_dump(), "seeds": 2})
    run_dirs = [tmp_path / "two" / f"seed-{n}" for n in (0, 1)]
    task_class, code = composition.find_code(config, run_dirs)
    assert task_class is None
    assert dict(code.files)["kicking_tools.py"] == TOOLS.format(4).encode()
    for folder in run_dirs:
        folder.mkdir(parents=True)
    folders = {"run_dir": tmp_path / "two", "run_dirs": run_dirs}
    session._store_run(composition.Training(setup=Setup(two), **folders, ppo=None, task_code=code))
    for folder in (tmp_path / "two", *run_dirs):
        assert read_task_code(folder) == code
