"""A task's module is found beside its YAML file, then in the current folder."""

import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from jetbot_mjx import new_task
from jetbot_mjx.config import load_config, parse_config, shipped_configs, task_modules
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs.task_code import collect_task_code, stored_class, write_task_code

TASK = """
from jetbot_mjx import GoalTask
import found_helper

class Found(GoalTask):
    where = found_helper.WHERE
"""


def write_task(folder, where, config="task: {name: found_task:Found}\n"):
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "found_task.py").write_text(f"{TASK}    # {where}\n")
    (folder / "found_helper.py").write_text(f"WHERE = {where!r}\n")
    (folder / "found.yaml").write_text(config)
    return folder


@pytest.fixture
def places(tmp_path, monkeypatch):
    """The current folder and one beside it, with a task of the same name in each."""
    monkeypatch.chdir(write_task(tmp_path / "here", "in the current folder"))
    return tmp_path, write_task(tmp_path / "my tasks", "beside the file")


def test_it_is_found_beside_the_yaml_file_first(places):
    config = load_config("../my tasks/found.yaml")
    assert make_env(config).task.where == "beside the file"
    # The same as in a process that has only the stored settings.
    assert make_env(parse_config(config.model_dump(mode="json"))).task.where == "beside the file"


def test_it_is_found_in_the_current_folder_next(places):
    name = "task.name=found_task:Found"
    assert make_env(load_config("smoke", [name])).task.where == "in the current folder"


def test_a_package_is_found_as_well(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_task(tmp_path, "-")
    (tmp_path / "found_package").mkdir()
    shutil.move(tmp_path / "found_task.py", tmp_path / "found_package" / "inside.py")
    (tmp_path / "found.yaml").write_text("task: {name: found_package.inside:Found}\n")
    assert type(make_env(load_config("found.yaml")).task).__name__ == "Found"


def test_two_modules_of_one_name_are_not_confused(places):
    tmp_path, beside = places
    load_config(beside / "found.yaml")
    with pytest.raises(UserError) as caught:
        load_config("found.yaml")
    first, second = tmp_path / "here" / "found_task.py", beside / "found_task.py"
    assert str(caught.value) == (
        f"{first} cannot be imported: this process uses another module found_task already,"
        f" {second}: rename one of them"
    )


def test_a_module_named_as_one_of_python_is_refused(tmp_path):
    (tmp_path / "types.py").write_text(TASK)
    (tmp_path / "mine.yaml").write_text("task: {name: types:Found}\n")
    with pytest.raises(UserError, match=r"uses another module types already, .*: rename one"):
        load_config(tmp_path / "mine.yaml")


def test_the_package_itself_is_never_replaced(tmp_path):
    (tmp_path / "jetbot_mjx").mkdir()
    (tmp_path / "jetbot_mjx" / "__init__.py").write_text("raise AssertionError\n")
    (tmp_path / "mine.yaml").write_text("seed: 3\n")
    before = list(sys.path)
    assert load_config(tmp_path / "mine.yaml").seed == 3
    assert sys.path == before


def test_a_folder_without_the_module_stays_out_of_the_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = list(sys.path)
    for name in ("nowhere:Task", "nonsense", "../x:Task", ".x:Task", ":Task", f"{'x' * 300}:Task"):
        (tmp_path / "mine.yaml").write_text(f"task: {{name: '{name}'}}\n")
        with pytest.raises(UserError):
            make_env(load_config("mine.yaml"))
    assert sys.path == before


def test_a_missing_import_of_the_module_is_named(places):
    _, beside = places
    (beside / "found_helper.py").write_text("import not_installed\n")
    with pytest.raises(UserError, match="found_task imports 'not_installed', which is not install"):
        make_env(load_config(beside / "found.yaml"))


def test_the_likely_module_is_suggested(places):
    with pytest.raises(UserError, match=r"no fuond_task\.py beside .* mean found_task:Found\?"):
        make_env(load_config("smoke", ["task.name=fuond_task:Found"]))


BESIDE = ["plan", "../my tasks/found.yaml"]
HERE = ["plan", "smoke", "--set", "task.name=found_task:Found"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("start", "words"),
    [
        pytest.param(["-m"], BESIDE, id="python -m, beside"),
        pytest.param(["-P", "-m"], HERE, id="console script, here", marks=pytest.mark.slow),
        pytest.param(["-m"], HERE, id="python -m, here", marks=pytest.mark.slow),
        pytest.param(["-P", "-m"], BESIDE, id="console script, beside", marks=pytest.mark.slow),
    ],
)
def test_both_ways_to_start_a_command_find_it(places, start, words):
    # As the console script does, `-P` leaves the current folder out of the path.
    command = [sys.executable, *start, "jetbot_mjx", *words]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.slow
def test_the_commands_that_new_task_prints_work_as_they_are(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert new_task.main(["my tasks/park it/parking_spot.py"]) == 0
    lines = [line.removeprefix("next:").split() for line in capsys.readouterr().out.splitlines()]
    commands = [shlex.split(" ".join(line)) for line in lines if "jetbot-mjx" in line]
    assert [words[:2] for words in commands] == [
        ["jetbot-mjx", "check-env"],
        ["jetbot-mjx", "train"],
    ]
    for words in commands:
        assert load_config(words[-1]).task.name == "parking_spot:ParkingSpot"
    # As `check-env` and `train` do, but sooner.
    plan = [sys.executable, "-P", "-m", "jetbot_mjx", "plan", commands[1][-1]]
    done = subprocess.run(plan, capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("name", ["obstacle", "gates", "pillars"])
def test_examples_are_found_by_name_wherever_the_package_is(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = shipped_configs()[name]
    for one in (name, f"examples/{name}.yaml"):
        assert load_config(one) == load_config(path)
    monkeypatch.delitem(task_modules.TASK_FOLDERS, f"{name}_task")  # other tests use copies of it


def test_an_example_in_an_installed_package_is_stored_in_its_run(tmp_path, root, monkeypatch):
    monkeypatch.chdir(tmp_path)
    examples = tmp_path / "lib" / "site-packages" / "jetbot_mjx" / "examples"
    shutil.copytree(root / "examples", examples)
    # No other test has found it anywhere.
    monkeypatch.delitem(sys.modules, "gates_task", raising=False)
    monkeypatch.setattr(task_modules, "TASK_FOLDERS", {})
    monkeypatch.setattr(sys, "path", [one for one in sys.path if Path(one).name != "examples"])
    monkeypatch.setattr(task_modules, "shipped_folder", lambda name: examples)
    config = load_config(examples / "gates.yaml")
    code = collect_task_code(config.task.name)
    assert code is not None
    assert [path for path, _ in code.files] == ["gates_task.py"]
    write_task_code(tmp_path, code)
    shutil.rmtree(examples)
    found = stored_class(tmp_path, config.task.name, code, silent=True)
    assert found is not None
    assert found.__name__ == "GatesTask"
