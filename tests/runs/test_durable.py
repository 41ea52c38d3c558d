"""What is synced, in which order, and what a file system that cannot is forgiven."""

import ctypes
import errno
import os

import pytest

from jetbot_mjx.runs import durable


@pytest.fixture
def synced(monkeypatch):
    """Paths that were synced, in their order."""
    paths = []
    monkeypatch.setattr(durable, "sync", paths.append)
    return paths


@pytest.fixture
def disk_says(monkeypatch):
    def disk_says(number):
        def fsync(descriptor):
            raise OSError(number, os.strerror(number))

        monkeypatch.setattr(os, "fsync", fsync)

    return disk_says


def test_a_tree_is_synced_from_inside(tmp_path, synced):
    (tmp_path / "a" / "b").mkdir(parents=True)
    (tmp_path / "a" / "file").write_text("1")
    (tmp_path / "a" / "b" / "file").write_text("2")
    (tmp_path / "a" / "link").symlink_to(tmp_path / "elsewhere")
    os.mkfifo(tmp_path / "a" / "pipe")
    durable.sync_tree(tmp_path)
    inner = [tmp_path / "a" / "b" / "file", tmp_path / "a" / "b"]
    assert synced == [*inner, tmp_path / "a" / "file", tmp_path / "a", tmp_path]


def test_the_names_of_new_folders_are_synced(tmp_path, synced):
    durable.make_folders(tmp_path / "a" / "b")
    assert (tmp_path / "a" / "b").is_dir()
    assert set(synced) == {tmp_path / "a", tmp_path}
    synced.clear()
    durable.make_folders(tmp_path / "a" / "b")
    assert synced == []


def test_a_move_syncs_both_folders(tmp_path, synced):
    (tmp_path / "a").mkdir()
    (tmp_path / "file").write_text("1")
    durable.move(tmp_path / "file", tmp_path / "a" / "file")
    assert (tmp_path / "a" / "file").read_text() == "1"
    assert set(synced) == {tmp_path / "a", tmp_path}


def test_folders_are_exchanged(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "file").write_text(name)
    if not durable.exchange(tmp_path / "a", tmp_path / "b"):
        pytest.skip("this file system cannot exchange names")
    assert (tmp_path / "a" / "file").read_text() == "b"
    assert (tmp_path / "b" / "file").read_text() == "a"


def test_without_the_system_call_nothing_is_exchanged(tmp_path, monkeypatch):
    monkeypatch.setattr(ctypes, "CDLL", lambda name: object())
    assert not durable.exchange(tmp_path / "a", tmp_path / "b")


def test_a_folder_that_cannot_be_synced_is_written_at_once(tmp_path, disk_says):
    disk_says(errno.EINVAL)
    durable.sync(tmp_path)
    (tmp_path / "file").write_text("1")
    with pytest.raises(OSError, match="Invalid argument"):
        durable.sync(tmp_path / "file")


def test_a_disk_that_fails_is_an_error(tmp_path, disk_says):
    disk_says(errno.EIO)
    with pytest.raises(OSError, match="Input/output error"):
        durable.sync(tmp_path)
