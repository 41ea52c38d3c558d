"""What was stored is there after a loss of power; a store that syncs too little is found out."""

import os
import random
import shutil
import sys

import pytest

from benchmarks.harness.disk_replay import Op, Recording, record, states
from benchmarks.reliability import power_loss
from helpers.further import slow_unless

traced = pytest.mark.skipif(
    shutil.which("strace") is None or not sys.platform.startswith("linux"),
    reason="strace records the system calls",
)


@traced
@pytest.mark.parametrize(
    ("name", "share", "least"),
    slow_unless(
        lambda name, *_: name in ("run", "export"),
        [
            ("run", 0.005, 50),
            ("files", 1, 10),
            ("export", 1, 100),
            ("programs", 1, 50),
            ("study", 0.01, 50),
        ],
    ),
)
def test_nothing_confirmed_is_lost(tmp_path, name, share, least):
    row = power_loss.replay(name, tmp_path, share=share)
    assert (row.lost, row.first) == (0, "")
    assert row.states >= least


@traced
@pytest.mark.slow
def test_ten_thousand_states():
    assert power_loss.main([]) == 0


# Each leaves out a sync: if then nothing was lost, the replay would prove nothing.
BROKEN = {
    "the content of a file": ("files", "run_dir.os.fsync = lambda descriptor: None"),
    "the name of a file": ("files", "durable.sync = lambda path: None"),
    "the content of an export": ("export", "run_dir.sync_tree = lambda folder: None"),
}

BROKEN_TOO = {
    "the content of a checkpoint": ("run", "checkpoint_store.sync_tree = lambda folder: None"),
    "the name of a checkpoint": ("run", "checkpoint_store.move = os.replace"),
    "a line of metrics": ("run", "metrics.os.fsync = lambda descriptor: None"),
    "the end of a journal": ("study", "search._SyncedConnection = sqlite3.Connection"),
}
"""Of scenarios that import JAX."""


@pytest.mark.slow
@traced
@pytest.mark.parametrize("name", BROKEN)
def test_a_missing_sync_is_found_out(tmp_path, name):
    assert lost_without_a_sync(tmp_path, *BROKEN[name]) > 0


@traced
@pytest.mark.slow
@pytest.mark.parametrize("name", BROKEN_TOO)
def test_a_missing_sync_of_a_training_is_found_out(tmp_path, name):
    assert lost_without_a_sync(tmp_path, *BROKEN_TOO[name]) > 0


def lost_without_a_sync(folder, scenario, change):
    program = folder / "program.py"
    program.write_text(
        "import os\n"
        "import sqlite3\n"
        "from benchmarks.reliability import power_loss\n"
        "from jetbot_mjx.runs import checkpoint_store, durable, metrics, run_dir\n"
        "from jetbot_mjx.tuning import search\n"
        f"{change}\n"
        "power_loss.main()\n"
    )
    share = 0.02 if scenario == "run" else 1
    return power_loss.replay(scenario, folder, share=share, program=[str(program)]).lost


def texts_of(ops, folders=(0,)):
    found = states(Recording(ops, set(folders)), random.Random(0))
    return {(tuple(sorted(state.items())), tuple(confirmed)) for state, confirmed in found}


def test_the_states_of_a_rename_without_a_sync():
    write = Op("write", 1, data=b"new")
    created = Op("names", names=((0, "t", 1),))
    renamed = Op("names", names=((0, "f", 1), (0, "t", None)))
    states_ = {state for state, _ in texts_of([created, write, renamed])}
    # The name may be there before the content, and the content or a part of it before the name.
    assert states_ == {
        (),
        (("t", b""),),
        (("t", b"new"),),
        (("f", b""),),
        (("f", b"new"),),
    }


def test_a_sync_covers_what_was_complete_when_it_began():
    ops = [
        Op("names", names=((0, "f", 1),)),
        Op("sync", 0, started=1),
        Op("write", 1, data=b"early"),
        Op("write", 1, offset=5, data=b"late"),
        Op("sync", 1, started=3),
        Op("confirm", data=b"one"),
    ]
    confirmed = {state for state, names in texts_of(ops) if names == ("one",)}
    assert confirmed == {(("f", b"early"),), (("f", b"earlylate"),)}


@traced
def test_the_recording_is_what_the_folder_holds(tmp_path):
    program, folder = tmp_path / "program.py", tmp_path / "folder"
    folder.mkdir()
    program.write_text(
        "import os, sys\n"
        "from pathlib import Path\n"
        "folder = Path(sys.argv[1])\n"
        "(folder / 'a' / 'b').mkdir(parents=True)\n"
        "with open(folder / 'a' / 'file', 'wb') as file:\n"
        "    file.write(b'x' * 70_000)\n"
        "    file.seek(100)\n"
        "    file.write(b'middle')\n"
        "with open(folder / 'a' / 'file', 'ab') as file:\n"
        "    file.write(b'end')\n"
        "(folder / 'a' / 'gone').write_text('gone')\n"
        "(folder / 'a' / 'gone').unlink()\n"
        "(folder / 'a').rename(folder / 'moved')\n"
        "(folder / 'moved' / 'b' / 'more').write_text('more')\n"
    )
    found = list(states(record([str(program), str(folder)], folder, os.environ), random.Random(0)))
    there = {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in folder.rglob("*")
    }
    assert there in [state for state, _ in found]
