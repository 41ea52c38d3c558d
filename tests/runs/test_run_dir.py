"""The run folder: one training at a time, no foreign files, every file whole."""

import errno
import json
import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from helpers.own_robots import copy_robot, load_robot
from jetbot_mjx.config import load_config, parse_config
from jetbot_mjx.errors import UnreadableError, UserError
from jetbot_mjx.runs import read_history, read_task_code, run_dir, wandb_sink
from jetbot_mjx.runs.run_dir import (
    DamagedRunError,
    atomic_folder,
    changed_versions,
    check_writable,
    claim_run_dir,
    is_occupied,
    make_folder,
    occupied,
    read_config,
    seed_dirs,
    seed_folders,
    stored_config,
    versions,
    write_bytes,
    write_json,
    write_run,
    write_text,
)


def refused(use, *arguments):
    with pytest.raises(UserError) as caught:
        use(*arguments)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def occupy(path):
    with occupied(path):
        pass


def test_a_folder_is_made_held_and_free_again(tmp_path):
    run_dir = tmp_path / "some" / "run"
    for _ in range(2):
        with occupied(run_dir):
            assert (run_dir / ".lock").read_text() == f"{os.getpid()}\n"


def test_a_folder_that_another_training_holds_is_refused_and_the_process_named(tmp_path):
    with occupied(tmp_path):
        said = refused(occupy, tmp_path)
        assert f"--run-dir {tmp_path} is locked by another training (process {os.getpid()})" in said
        assert (tmp_path / ".lock").read_text() == f"{os.getpid()}\n"
    occupy(tmp_path)


_HOLD = """
import fcntl, os, sys
file = open(sys.argv[1], "w")
fcntl.flock(file, fcntl.LOCK_EX)
print(os.getpid(), file=file, flush=True)
print("held", flush=True)
sys.stdin.read()
"""


def test_a_folder_is_free_when_the_process_that_held_it_was_killed(tmp_path):
    process = subprocess.Popen(
        [sys.executable, "-c", _HOLD, tmp_path / ".lock"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    with process:
        assert process.stdout.readline() == b"held\n"
        assert f"(process {process.pid})" in refused(occupy, tmp_path)
        process.kill()
        process.wait()
        with occupied(tmp_path):
            assert (tmp_path / ".lock").read_text() == f"{os.getpid()}\n"


def test_who_asks_about_a_lock_refuses_no_training(tmp_path, monkeypatch):
    assert not is_occupied(tmp_path)
    assert not list(tmp_path.iterdir())
    (tmp_path / ".lock").touch()
    assert not is_occupied(tmp_path)
    with (tmp_path / ".lock").open() as onlooker:
        run_dir.fcntl.flock(onlooker, run_dir.fcntl.LOCK_SH)
        monkeypatch.setattr(run_dir.time, "sleep", lambda seconds: onlooker.close())
        with occupied(tmp_path):
            assert is_occupied(tmp_path)
            assert (tmp_path / ".lock").read_text() == f"{os.getpid()}\n"
    assert not is_occupied(tmp_path)


def test_a_drive_that_refuses_to_close_the_lock_changes_nothing(tmp_path, monkeypatch):
    held = []
    monkeypatch.setattr(run_dir.fcntl, "flock", lambda file, how: held.append(file))
    with occupied(tmp_path):
        # Its close now fails.
        os.close(held[0].fileno())
    assert held[0].closed


def test_a_file_system_without_locks_refuses_nothing(tmp_path, monkeypatch):
    def fail(*arguments):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(run_dir.fcntl, "flock", fail)
    occupy(tmp_path)


@pytest.mark.parametrize(
    "use", [occupy, lambda path: write_run(path, parse_config({}), versions())]
)
def test_a_folder_below_a_file_cannot_be_written(tmp_path, use):
    (tmp_path / "file").write_text("")
    assert "cannot be written: Not a directory" in refused(use, tmp_path / "file" / "run")


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_read_only_folder_cannot_be_written(tmp_path):
    tmp_path.chmod(0o500)
    assert "cannot be written: Permission denied" in refused(occupy, tmp_path)


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="only Linux has this drive")
def test_a_drive_on_which_nothing_can_be_created_is_found_before_long_work(tmp_path):
    assert "cannot be written" in refused(check_writable, Path("/proc/results"))
    check_writable(tmp_path / "new" / "results")
    assert list(tmp_path.iterdir()) == []


def test_a_run_is_known_by_its_resolved_configuration(tmp_path):
    config = parse_config({"seed": 7, "ppo": {"learning_rate": 3e-4}})
    assert stored_config(tmp_path / "nothing") is None
    assert stored_config(tmp_path) is None
    occupy(tmp_path)
    assert stored_config(tmp_path) is None
    write_run(tmp_path, config, versions())
    assert stored_config(tmp_path) == config


@pytest.mark.parametrize(
    "occupant", ["notes.txt", "checkpoints/", "metrics.jsonl", "checkpoints/5/"]
)
def test_a_folder_with_anything_else_in_it_is_refused(tmp_path, occupant):
    if occupant.endswith("/"):
        (tmp_path / occupant).mkdir(parents=True)
    else:
        (tmp_path / occupant).write_text("")
    assert "exists and holds no run (no config.yaml)" in refused(stored_config, tmp_path)


def test_a_file_is_no_run_folder(tmp_path):
    path = tmp_path / "file"
    path.write_text("")
    assert "exists and holds no run" in refused(stored_config, path)


@pytest.mark.parametrize("text", ["ppo: [", "- 1", "sede: 3", "\udcff"])
def test_a_damaged_configuration_is_refused(tmp_path, text):
    (tmp_path / "config.yaml").write_text(text, errors="surrogateescape")
    said = refused(stored_config, tmp_path)
    assert said.startswith(f"the run {tmp_path} is damaged: config.yaml")
    assert said.endswith("restore the file, or train into a new folder")


READERS = {
    "config.yaml": stored_config,
    "versions.json": changed_versions,
    "metrics.jsonl": lambda run: read_history(run / "metrics.jsonl"),
    "task/sources.json": read_task_code,
    "wandb.json": lambda run: wandb_sink._read(run / "wandb.json", "project"),
}


@pytest.mark.parametrize("number", [errno.EIO, errno.ETIMEDOUT])
@pytest.mark.parametrize("name", READERS)
def test_a_file_on_a_drive_that_does_not_answer_is_neither_damaged_nor_missing(
    tmp_path, monkeypatch, name, number
):
    def no_answer(path, flags):
        raise OSError(number, os.strerror(number))

    write_text(tmp_path / "config.yaml", "")
    monkeypatch.setattr(run_dir, "open_at_once", no_answer)
    with pytest.raises(UnreadableError) as caught:
        READERS[name](tmp_path)
    said = f"{tmp_path / name} cannot be read now: {os.strerror(number)}: it may be intact: give"
    assert str(caught.value).startswith(said)


def test_each_seed_has_a_folder_of_its_own(tmp_path):
    one, many = parse_config({"seed": 9}), parse_config({"seed": 9, "seeds": 3})
    assert seed_dirs(tmp_path, one) == [tmp_path]
    folders = [tmp_path / f"seed-{seed}" for seed in (9, 10, 11)]
    assert seed_dirs(tmp_path, many) == folders
    assert seed_folders(tmp_path) == []
    for folder, config in zip(folders, many.of_each_seed(), strict=True):
        folder.mkdir()
        write_run(folder, config, versions())
    (tmp_path / "seed-none").mkdir()
    assert seed_folders(tmp_path) == folders


class Killed(BaseException):
    """Stands for the end of the process."""


@pytest.mark.parametrize(("owner", "method"), [(os, "fsync"), (Path, "replace")])
def test_a_file_is_whole_or_as_it_was_whenever_the_process_ends(
    tmp_path, monkeypatch, owner, method
):
    path = tmp_path / "config.yaml"
    write_text(path, "before\n")

    def die(*arguments):
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(owner, method, die)
        with pytest.raises(Killed):
            write_text(path, "after, and longer than before\n")
    assert path.read_text() == "before\n"
    write_text(path, "after\n")
    assert path.read_text() == "after\n"
    assert list(tmp_path.iterdir()) == [path]


def test_writers_of_one_file_do_not_disturb_each_other(tmp_path):
    path, texts = tmp_path / "page.html", ["a" * 300_000, "b" * 200_000]
    write_text(path, texts[0])

    def write(text):
        for _ in range(100):
            write_text(path, text)

    with ThreadPoolExecutor(2) as pool:
        writers = [pool.submit(write, text) for text in texts]
        while not all(writer.done() for writer in writers):
            assert path.read_text() in texts
        for writer in writers:
            writer.result()
    assert list(tmp_path.iterdir()) == [path]


def test_half_written_files_of_a_killed_process_do_not_occupy_a_folder(tmp_path, monkeypatch):
    def die(self, target):
        raise Killed

    monkeypatch.setattr(Path, "replace", die)
    with pytest.raises(Killed):
        write_run(tmp_path, parse_config({}), versions())
    assert stored_config(tmp_path) is None


def test_json_has_no_non_finite_numbers(tmp_path):
    with pytest.raises(ValueError):
        write_json(tmp_path / "file.json", {"x": float("nan")})
    assert list(tmp_path.iterdir()) == []


def test_a_folder_for_results_is_made_once_and_may_be_there(tmp_path):
    for _ in range(2):
        make_folder(tmp_path / "videos")
    (tmp_path / "file").write_text("")
    assert "cannot be written: File exists" in refused(make_folder, tmp_path / "file")


def store_versions(run_dir, change):
    values = versions()
    change(values)
    write_json(run_dir / "versions.json", values)


def test_nothing_has_changed_where_all_is_as_it_was(tmp_path):
    write_run(tmp_path, parse_config({}), versions())
    assert changed_versions(tmp_path) == []


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda found: found["packages"].update(jax="0.1.2"), "jax 0.1.2, now "),
        (lambda found: found["packages"].update(brax=None), "brax None, now "),
        (lambda found: found["packages"].pop("mujoco"), "mujoco None, now "),
        (lambda found: found.update(device="abacus"), "device abacus, now "),
        (lambda found: found.update(device_count=8), "device_count 8, now 1"),
    ],
    ids=["other", "not there", "not told", "device", "device count"],
)
def test_versions_changed_since_the_training_are_named(tmp_path, change, said):
    store_versions(tmp_path, change)
    (found,) = changed_versions(tmp_path)
    assert found.startswith(said)


@pytest.mark.parametrize("text", [None, "", "{", "{}", "[]", "3", '{"packages": 3}', "\udcff"])
def test_versions_that_cannot_be_read_say_nothing(tmp_path, text):
    if text is not None:
        (tmp_path / "versions.json").write_text(text, errors="surrogateescape")
    assert changed_versions(tmp_path) == []


def test_versions_are_json(tmp_path):
    found = json.loads(json.dumps(versions()))
    assert {"python", "packages", "device", "device_count", "git"} <= found.keys()


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
def test_a_pipe_in_the_place_of_an_unfinished_file_holds_nothing_up(tmp_path):
    writer = f"{os.getpid()}-{threading.get_ident()}"
    os.mkfifo(tmp_path / f".config.yaml.{writer}.unfinished")
    write_bytes(tmp_path / "config.yaml", b"seed: 1\n")
    assert [path.name for path in tmp_path.iterdir()] == ["config.yaml"]
    os.mkfifo(tmp_path / ".policy.unfinished")
    with atomic_folder(tmp_path / "policy") as unfinished:
        (unfinished / "file").touch()
    assert {path.name for path in tmp_path.iterdir()} == {"config.yaml", "policy"}


def test_a_run_without_its_robot_says_which_file_is_missing(tmp_path):
    config = load_config(copy_robot(tmp_path, "turtlebot"))
    # This process has read that model, and another one has not.
    text = config.to_yaml().replace(config.robot.sha256, "f" * 64)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.yaml").write_text(text)
    with pytest.raises(DamagedRunError, match=r"robot/turtlebot.xml does not exist"):
        read_config(tmp_path / "run")


def test_a_runs_model_is_written_before_the_configuration_that_names_it(tmp_path, monkeypatch):
    config = load_robot("rover")
    monkeypatch.setattr(run_dir, "write_text", lambda path, text: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        run_dir.write_run(tmp_path, config, {})
    assert (tmp_path / "robot" / "rover.xml").is_file()


def test_trainings_that_begin_in_one_second_have_a_folder_each(tmp_path, monkeypatch):
    monkeypatch.setattr(run_dir, "default_run_dir", lambda config, root: root / "own-now")
    root = tmp_path / "runs"
    with (
        claim_run_dir(None, Path("own.yaml"), root) as first,
        claim_run_dir(None, Path("own.yaml"), root) as second,
    ):
        assert [first, second] == [root / "own-now", root / "own-now-2"]
        assert stored_config(second) is None
        (first / "config.yaml").write_text("seed: 0\n")
    assert [path.name for path in root.iterdir()] == ["own-now"]


def test_a_training_that_fails_at_once_leaves_no_folder(tmp_path):
    with (
        pytest.raises(UserError, match="wrong"),
        claim_run_dir(None, Path("own.yaml"), tmp_path / "runs"),
    ):
        raise UserError("wrong")
    assert list(tmp_path.iterdir()) == []


def test_a_file_in_the_place_of_all_runs_is_told(tmp_path):
    (tmp_path / "runs").write_text("")
    with (
        pytest.raises(UserError, match=r"runs/own-[0-9-]* cannot be written: "),
        claim_run_dir(None, Path("own.yaml"), tmp_path / "runs"),
    ):
        pass
