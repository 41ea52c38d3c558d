"""Checkpoints on disk: whole or absent, and the right ones kept."""

import errno
import itertools
import json
import os
import resource
import shutil
import threading
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp
import pytest

from jetbot_mjx.runs import checkpoint_store
from jetbot_mjx.runs.checkpoint_store import (
    FOLDER,
    CheckpointError,
    CheckpointStore,
    checkpoint_path,
    checkpoint_steps,
    digest,
    early_checkpoint,
    flatten,
    read_about,
    read_tree,
    set_aside,
)

TREE = {
    "weights": np.linspace(-1, 1, 6, dtype=np.float32).reshape(2, 3),
    "count": np.uint32(7),
    "done": np.array([True, False]),
    "half": jnp.asarray([1.5, np.nan], jnp.bfloat16),
    "nested": {"reward/progress": np.array([np.nan, -0.0, np.inf], np.float32)},
}


@pytest.fixture
def run_dir(tmp_path):
    folder = tmp_path / "run #1, 100 % ä"
    folder.mkdir()
    return folder


def save(run_dir, *steps, keep=50, tree=TREE, joined=()):
    """Checkpoints at some steps, each a number or a pair of steps and success rate."""
    with CheckpointStore(run_dir, keep) as store:
        for one in steps:
            env_steps, success_rate = one if isinstance(one, tuple) else (one, None)
            store.save(env_steps, {"tree": tree}, {"explained": True}, success_rate, joined)


def read(run_dir, env_steps, template=TREE):
    return read_tree(checkpoint_path(run_dir, env_steps), "tree", template)


def refused(use, *arguments):
    with pytest.raises(CheckpointError) as caught:
        use(*arguments)
    assert "\n" not in str(caught.value)
    return str(caught.value)


joined_or_not = pytest.mark.parametrize("joined", [(), ("tree",)], ids=["arrays", "joined"])


@joined_or_not
def test_a_checkpoint_is_read_back_unchanged(run_dir, joined):
    save(run_dir, 3, joined=joined)
    again = read(run_dir, 3, jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), TREE))
    assert jax.tree.structure(again) == jax.tree.structure(TREE)
    for one, other in zip(jax.tree.leaves(again), jax.tree.leaves(TREE), strict=True):
        assert isinstance(one, np.ndarray)
        assert (one.dtype, one.shape, one.tobytes()) == (other.dtype, other.shape, other.tobytes())
    assert digest(again) == digest(TREE)
    about = read_about(checkpoint_path(run_dir, 3))
    assert about["explained"]
    assert about["env_steps"] == 3


@pytest.mark.parametrize("given", ["../run", ".", "~", "a\nb", "a'b\"c", "%41", "?x=#1", "link"])
def test_a_run_folder_may_have_any_name(tmp_path, monkeypatch, given):
    (tmp_path / "run").mkdir()
    (tmp_path / "link").symlink_to("run")
    monkeypatch.chdir(tmp_path / "run")
    folder = Path(given)
    folder.mkdir(exist_ok=True)
    save(folder, 3)
    monkeypatch.chdir(tmp_path)
    read(tmp_path / "run" / given, 3)


@pytest.mark.parametrize("name", ["a\\b", "\udcff"])
def test_a_name_that_nothing_could_be_read_from_is_refused(tmp_path, name):
    (tmp_path / name).mkdir()
    assert "has a backslash, or bytes that are not UTF-8" in refused(save, tmp_path / name, 3)


def test_arrays_changed_while_they_are_saved_are_saved_unchanged(run_dir):
    tree = {"weights": np.zeros(100_000)}
    with CheckpointStore(run_dir, keep=50) as store:
        for step in (1, 2):
            store.save(step, {"tree": tree}, {}, None)
            tree["weights"] += 1
    assert read(run_dir, 1, tree)["weights"].max() == 0
    assert read(run_dir, 2, tree)["weights"].min() == 1


@pytest.mark.parametrize(
    "other",
    [
        {"a": np.array([1, 2], np.int32), "c": np.zeros(1)},
        {"a": np.array([1, 3], np.int32), "b": np.zeros(1)},
        {"a": np.array([1, 2], np.uint32), "b": np.zeros(1)},
        {"a": np.array([[1, 2]], np.int32), "b": np.zeros(1)},
        {"a": np.array([1, 2], np.int32), "b": np.zeros(())},
        {"a": np.array([1, 2], np.int32), "b": -np.zeros(1)},
        {"a": np.array([1, 2], np.int32)},
    ],
    ids=["name", "value", "dtype", "shape", "scalar", "sign of zero", "missing"],
)
def test_a_digest_tells_apart_all_that_differs(other):
    tree = {"a": np.array([1, 2], np.int32), "b": np.zeros(1)}
    assert digest(tree) != digest(other)
    assert digest(tree) == digest(dict(reversed(tree.items())))
    assert digest(tree) == digest(flatten(tree))


OTHER_TEMPLATES = {
    "shape": (lambda tree: tree.update(weights=np.zeros((3, 2), np.float32)), "weights is float32"),
    "dtype": (lambda tree: tree.update(weights=np.zeros((2, 3))), "and should be float64[2, 3]"),
    "more": (lambda tree: tree.update(bias=np.zeros(1)), "bias is missing"),
    "fewer": (lambda tree: tree.pop("done"), "done is bool[2], and should be missing"),
}


def test_two_arrays_of_one_name_are_refused(run_dir):
    tree = {"a.b": np.zeros(1), "a": {"b": np.ones(2)}}
    said = refused(lambda: save(run_dir, 1, tree=tree))
    assert "two arrays of the state are called a.b" in said


def test_a_joined_tree_is_one_array_on_disk_and_refused_if_it_is_shorter(run_dir):
    save(run_dir, 1, joined=("tree",))
    save(run_dir, 2, joined=("tree",), tree={"weights": np.zeros(2)})
    paths = [checkpoint_path(run_dir, step) / "tree" for step in (1, 2)]
    with ocp.StandardCheckpointer() as reader:
        stored = reader.restore(paths[0])
    size = sum(np.asarray(x).nbytes for x in jax.tree.leaves(TREE))
    assert {name: (x.dtype, x.shape) for name, x in stored.items()} == {"bytes": ("uint8", (size,))}
    shutil.rmtree(paths[0])
    shutil.copytree(paths[1], paths[0])
    assert f"bytes is uint8[16], and should be uint8[{size}]" in refused(read, run_dir, 1)


def test_an_invalid_table_is_refused(run_dir):
    with CheckpointStore(run_dir, 50) as store:
        store.save(1, {"tree": TREE}, {}, None)
    file = checkpoint_path(run_dir, 1) / "about" / "metadata"
    about = json.loads(file.read_text())
    about["joined"] = [1]
    del about["sha256"]["about"]
    about["sha256"]["about"] = checkpoint_store._digest_json(about)
    file.write_text(json.dumps(about))
    assert "cannot be read" in refused(read, run_dir, 1)


@joined_or_not
@pytest.mark.parametrize("kind", OTHER_TEMPLATES)
def test_other_arrays_than_those_that_are_wanted_are_refused_by_name(run_dir, kind, joined):
    change, said = OTHER_TEMPLATES[kind]
    save(run_dir, 1, joined=joined)
    template = dict(TREE)
    change(template)
    assert said in refused(read, run_dir, 1, template)


def test_a_tree_that_was_never_written_is_refused(run_dir):
    save(run_dir, 1)
    assert "holds no training" in refused(read_tree, checkpoint_path(run_dir, 1), "training", {})


def test_a_key_that_is_required_and_not_there_is_named(run_dir):
    save(run_dir, 1)
    path = checkpoint_path(run_dir, 1)
    assert read_about(path, ["explained"])["explained"]
    assert "no layout" in refused(read_about, path, ["explained", "layout"])


def test_only_what_carries_the_name_of_a_checkpoint_is_one(run_dir):
    assert checkpoint_steps(run_dir) == []
    save(run_dir, 5, 1_000_000_000_000_000)
    folder = run_dir / FOLDER
    for name in ("99", "5", "²", ".000000000006.unfinished", "more"):
        (folder / name).mkdir()
    (folder / "notes.txt").write_text("not a checkpoint")
    assert checkpoint_steps(run_dir) == [5, 1_000_000_000_000_000]
    save(run_dir, 2_000_000_000_000_000)
    assert checkpoint_steps(run_dir) == [5, 1_000_000_000_000_000, 2_000_000_000_000_000]


def test_unfinished_checkpoints_of_an_earlier_process_are_deleted(run_dir):
    save(run_dir, 1)
    left = run_dir / FOLDER / ".000000000002.unfinished"
    (left / "tree").mkdir(parents=True)
    save(run_dir, 3)
    assert not left.exists()
    assert checkpoint_steps(run_dir) == [1, 3]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="this system has no named pipes")
def test_a_pipe_in_the_place_of_an_unfinished_checkpoint_holds_nothing_up(run_dir):
    (run_dir / FOLDER).mkdir()
    os.mkfifo(run_dir / FOLDER / ".000000000010.unfinished")
    save(run_dir, *RATES, keep=1)
    assert checkpoint_steps(run_dir) == [0, 20, 60]


RATES = [(0, 0.1), (10, 0.9), (20, 0.9), (30, 0.2), (40, None), (50, 0.3), (60, 0.3)]


@pytest.mark.parametrize(
    ("keep", "kept"),
    [(1, [0, 20, 60]), (2, [0, 20, 50, 60]), (50, [0, 10, 20, 30, 40, 50, 60])],
)
def test_the_latest_the_first_and_the_best_stay_and_of_equals_the_later(run_dir, keep, kept):
    save(run_dir, *RATES, keep=keep)
    assert checkpoint_steps(run_dir) == kept


def test_a_clock_that_is_set_back_keeps_the_latest_by_their_steps(run_dir, monkeypatch):
    now = itertools.count(time.time(), -3_600)
    monkeypatch.setattr(time, "time", lambda: next(now))
    save(run_dir, 1, (2, 0.9), 3, keep=2)
    save(run_dir, 4, 5, 6, keep=2)
    assert checkpoint_steps(run_dir) == [1, 2, 5, 6]


def test_the_best_of_an_earlier_process_stays(run_dir):
    save(run_dir, *RATES[:4], keep=1)
    save(run_dir, *RATES[4:], keep=1)
    assert checkpoint_steps(run_dir) == [0, 20, 60]


def test_a_damaged_checkpoint_does_not_count_as_the_best(run_dir):
    save(run_dir, *RATES[:4], keep=1)
    (checkpoint_path(run_dir, 20) / "about" / "metadata").write_text("{}")
    save(run_dir, *RATES[4:], keep=1)
    assert checkpoint_steps(run_dir) == [0, 60]


def test_the_message_about_a_damaged_checkpoint_names_another_one(run_dir):
    save(run_dir, 1, 2, 3)
    for steps in (1, 3):
        for path in checkpoint_path(run_dir, steps).glob("tree/**/d/*"):
            path.write_bytes(b"")
    said = refused(read, run_dir, 3)
    assert said.endswith(f"; another one is {checkpoint_path(run_dir, 2)}")
    assert refused(read, run_dir, 1).endswith(str(checkpoint_path(run_dir, 3)))
    for steps in (2, 3):
        shutil.rmtree(checkpoint_path(run_dir, steps))
    assert refused(read, run_dir, 1).endswith("is damaged or missing")


def test_a_checkpoint_that_the_disk_cannot_hold_is_not_begun(run_dir, monkeypatch):
    save(run_dir, 1)
    usage = shutil.disk_usage(run_dir)
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=10_000))
        said = refused(save, run_dir, 2)
    assert str(run_dir / FOLDER) in said
    assert "the disk is full: a checkpoint needs 1.0 MB, and 0.0 MB are free" in said
    assert os.listdir(run_dir / FOLDER) == [checkpoint_path(run_dir, 1).name]
    save(run_dir, 2)
    assert checkpoint_steps(run_dir) == [1, 2]


@pytest.mark.parametrize("env_steps", [5, 10])
def test_a_checkpoint_that_is_not_the_latest_is_refused(run_dir, env_steps):
    save(run_dir, 10)
    assert "could not be written" in refused(save, run_dir, env_steps)
    assert checkpoint_steps(run_dir) == [10]


@pytest.fixture
def short_files():
    """No file may become longer than 20 kB, as if the disk were full: C++ fails, not Python."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
    yield lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_write_that_fails_on_the_way_costs_one_line_and_no_other_checkpoint(
    run_dir, short_files, capfd, caplog
):
    save(run_dir, 1)
    long = {"weights": np.random.default_rng(0).random(50_000)}
    said = refused(lambda: save(run_dir, 2, tree=long))
    assert "a checkpoint could not be written: File too large; the earlier ones are" in said
    assert checkpoint_steps(run_dir) == [1]
    assert digest(read(run_dir, 1)) == digest(TREE)
    short_files()
    save(run_dir, 2, tree=long)
    assert checkpoint_steps(run_dir) == [1, 2]
    assert digest(read(run_dir, 2, long)) == digest(long)
    assert capfd.readouterr() == ("", "")
    assert not caplog.records


@pytest.mark.parametrize("name", ["write_arrays", "sync_tree", "move"])
@pytest.mark.parametrize("steps", [(2,), (2, 3)], ids=["the last", "another follows"])
def test_an_error_while_writing_is_one_line(run_dir, monkeypatch, name, steps):
    def fail(*arguments):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    save(run_dir, 1)
    with monkeypatch.context() as patch:
        patch.setattr(checkpoint_store, name, fail)
        assert "No space left on device; the earlier ones" in refused(save, run_dir, *steps)
    assert os.listdir(run_dir / FOLDER) == [checkpoint_path(run_dir, 1).name]
    assert digest(read(run_dir, 1)) == digest(TREE)
    save(run_dir, *steps)
    assert checkpoint_steps(run_dir) == [1, *steps]


def test_a_training_goes_on_while_a_checkpoint_is_written(run_dir, monkeypatch):
    may_go_on = threading.Event()
    sync_tree = checkpoint_store.sync_tree
    monkeypatch.setattr(
        checkpoint_store, "sync_tree", lambda path: may_go_on.wait(60) and sync_tree(path)
    )
    with CheckpointStore(run_dir, keep=50) as store:
        store.save(1, {"tree": TREE}, {}, None)
        assert checkpoint_steps(run_dir) == []
        may_go_on.set()
    assert checkpoint_steps(run_dir) == [1]


def test_nothing_is_said_of_checkpoints_that_are_gone(run_dir):
    with CheckpointStore(run_dir, keep=2) as store:
        store.save(1, {"tree": TREE}, {}, None)
        store._wait()
        shutil.rmtree(run_dir)
        said = refused(store.save, 2, {"tree": TREE}, {}, None)
        assert said.endswith("a checkpoint could not be written: No such file or directory")


def test_a_long_reason_keeps_its_beginning_and_its_end(run_dir, monkeypatch):
    def fail(*arguments, **keywords):
        # Some releases of TensorStore add where in their source they noticed.
        places = "\\n".join(f"tensorstore/kvstore/transaction.cc:{line}" for line in range(99))
        told = f" the end [source locations='{places}']"
        raise ValueError("RESOURCE_EXHAUSTED: " + 1_000 * "x" + told + "\nand more")

    monkeypatch.setattr(checkpoint_store, "write_arrays", fail)
    said = refused(save, run_dir, 1)
    assert "RESOURCE_EXHAUSTED: xxx" in said
    assert "xxx the end; the earlier" in said
    assert len(said) < 600


def test_a_run_folder_that_is_moved_away_is_not_made_again(run_dir, monkeypatch):
    save(run_dir, 1)
    away = run_dir.with_name("away")
    monkeypatch.setattr(CheckpointStore, "_check_space", lambda *size: run_dir.rename(away))
    assert "No such file or directory" in refused(save, run_dir, 2)
    assert not run_dir.exists()
    assert checkpoint_steps(away) == [1]


def test_a_folder_that_cannot_be_made_costs_one_line(tmp_path):
    (tmp_path / "run").write_text("a file where the run folder should be")
    assert "could not be written" in refused(save, tmp_path / "run", 1)


def test_a_checkpoint_that_is_moved_aside_replaces_no_other(run_dir):
    save(run_dir, 1)
    places = []
    for _ in range(3):
        places.append(set_aside(checkpoint_path(run_dir, 1)))
        assert checkpoint_steps(run_dir) == []
        save(run_dir, 1)
    assert [place.name for place in places] == [f"000000000001.{number}" for number in range(3)]
    shutil.rmtree(places[0])
    assert set_aside(checkpoint_path(run_dir, 1)) == places[0]
    assert all((place / "tree").is_dir() for place in places)
    assert {place.parent for place in places} == {run_dir / "set_aside"}


def test_a_checkpoint_that_cannot_be_moved_is_kept_and_reported(run_dir):
    save(run_dir, 1)
    (run_dir / "set_aside").write_text("a file where a folder should be")
    assert "cannot be moved into" in refused(set_aside, checkpoint_path(run_dir, 1))
    assert checkpoint_steps(run_dir) == [1]


def metadata(path: Path) -> Path:
    return path / "about" / "metadata"


def change_about(path, change):
    about = json.loads(metadata(path).read_text())
    change(about)
    metadata(path).write_text(json.dumps(about))


@pytest.mark.parametrize(
    "change",
    [
        lambda about: about.update(env_steps=2),
        lambda about: about.update(explained=False),
        lambda about: about.update(more=1),
        lambda about: about.pop("explained"),
        lambda about: about["sha256"].update(tree="0" * 64),
        lambda about: about["sha256"].update(more="0" * 64),
        lambda about: about["sha256"].update(about="0" * 64),
    ],
    ids=["steps", "value", "more", "fewer", "hash of a tree", "hash of no tree", "own hash"],
)
def test_changed_metadata_is_refused(run_dir, change):
    save(run_dir, 1)
    change_about(checkpoint_path(run_dir, 1), change)
    assert "changed after it was written" in refused(read_about, checkpoint_path(run_dir, 1))
    assert "changed after it was written" in refused(read, run_dir, 1)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "{}",
        "[]",
        "3",
        "null",
        '{"sha256": 3}',
        '{"sha256": {}}',
        '{"sha256": {"about": NaN}, "x": NaN}',
        "[" * 100_000,
        "\udcff",
    ],
)
def test_invalid_metadata_is_refused(run_dir, text):
    save(run_dir, 1)
    path = checkpoint_path(run_dir, 1)
    metadata(path).write_text(text, errors="surrogateescape")
    assert "about/metadata is missing or damaged" in refused(read_about, path)


def test_a_renamed_checkpoint_is_refused(run_dir):
    save(run_dir, 1)
    checkpoint_path(run_dir, 1).rename(checkpoint_path(run_dir, 2))
    assert "was renamed: it was written after 1 steps" in refused(read, run_dir, 2)


def test_the_early_checkpoint_is_the_first_of_those_closest_to_40_percent():
    assert early_checkpoint({1: 0.03, 2: 0.3, 3: 0.9}) == 2
    assert early_checkpoint({1: 0.35, 2: 0.9, 3: 0.35}) == 1
    assert early_checkpoint({1: -np.inf, 2: 1.0}) == 2
