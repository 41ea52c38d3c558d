"""A training on a drive that is late, or does not answer for a while, loses nothing."""

import json
import os

import numpy as np
import pytest

from benchmarks import RESULTS
from benchmarks.harness.faulty_drive import FaultyDrive, why_not
from benchmarks.reliability import network_drive, torture
from benchmarks.reliability.network_drive import Ground
from helpers import gliding
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs.checkpoint_store import (
    CheckpointStore,
    checkpoint_path,
    checkpoint_steps,
    read_tree,
)

mounted = pytest.mark.skipif(bool(why_not()), reason=why_not())

SETTINGS = (*torture.SETTINGS, "checkpoint_interval=8_192", "ppo.num_timesteps=131_072")
TRAINER = gliding.program("train")


@pytest.fixture(scope="module")
def ground(tmp_path_factory):
    folder = tmp_path_factory.mktemp("network") / "undisturbed"
    undisturbed = torture.finish(folder, SETTINGS, TRAINER)
    return Ground(SETTINGS, TRAINER, torture.make_template(SETTINGS), undisturbed)


@mounted
@pytest.mark.slow
@pytest.mark.parametrize("name", network_drive.SCENARIOS)
def test_a_training_ends_with_the_same_bits_and_errors_are_one_line(ground, tmp_path, name):
    row = network_drive.train_on(name, tmp_path, ground)
    assert row.wrong == ""
    assert row.faults > 0
    assert row.starts > 1
    # Python repeats a call that is interrupted, and TensorStore, which reads, does not.
    assert name == "interrupted" or bool(row.lines) == (name != "late")


@mounted
def test_a_drive_does_what_it_is_told(tmp_path):
    files, mount = tmp_path / "files", tmp_path / "drive"
    files.mkdir()
    mount.mkdir()
    with FaultyDrive(files, mount) as drive:
        (mount / "a").mkdir()
        (mount / "a" / "file").write_text("text")
        with open(mount / "a" / "file", "a") as file:
            file.write(" and more")
        (mount / "a" / "file").rename(mount / "moved")
        assert os.listdir(mount / "a") == []
        assert (files / "moved").read_text() == (mount / "moved").read_text() == "text and more"
        drive.set(1.0, "EIO")
        with pytest.raises(OSError, match="Input/output error"):
            (mount / "moved").read_text()
        drive.set(0.5, "EINTR")
        assert {(mount / "moved").read_text() for _ in range(9)} == {"text and more"}
        counts = drive.set()
        assert 0 < counts["faults"] < counts["calls"]
    assert not mount.is_mount()


@mounted
def test_a_save_on_a_drive_that_fails_comes_to_its_end(tmp_path):
    files, mount = tmp_path / "files", tmp_path / "drive"
    files.mkdir()
    mount.mkdir()
    tree, refused = {"weights": np.linspace(0, 1, 20_000), "count": np.uint32(7)}, 0
    errors = (*network_drive.ERRORS, "ENOSPC", "EROFS", "EINTR")
    with FaultyDrive(files, mount) as drive:
        for step, error in enumerate(10 * errors, 1):
            try:
                with CheckpointStore(mount, keep=5) as store:
                    drive.set(0.1, error)
                    store.save(step, {"arrays": tree, "joined": tree}, {}, None, ["joined"])
            except UserError:
                refused += 1
            drive.set()
        for step in (left := checkpoint_steps(mount)):
            for name in ("arrays", "joined"):
                read_tree(checkpoint_path(mount, step), name, tree)
    assert left
    assert refused > 10


def test_nothing_was_lost_when_it_was_measured():
    rows = json.loads((RESULTS / "network-drive.json").read_text())["rows"]
    assert [row["drive"] for row in rows] == list(network_drive.SCENARIOS)
    assert all(row["faults"] > 10 and not row["wrong"] for row in rows)
