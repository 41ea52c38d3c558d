"""What is loaded and run from the cache: only what nobody else can have written."""

import os
import re
import stat
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from jetbot_mjx.devices import use_compilation_cache
from onekernel.aot import program_cache
from onekernel.aot.program_cache import ProgramCache
from onekernel.trusted_files import cached_bytes, read_trusted, write_private

pytestmark = pytest.mark.skipif(not hasattr(os, "geteuid"), reason="files have no owners here")

SOMEONE = 54_321


@pytest.fixture
def give_away(monkeypatch):
    """Makes a file or folder another user's."""

    def give_away(path):
        if os.geteuid() == 0:
            os.chown(path, SOMEONE, -1)
        else:
            mine = path.stat().st_uid
            monkeypatch.setattr(os, "geteuid", lambda: mine + 1)

    return give_away


@pytest.fixture
def folder(tmp_path):
    """Of this user alone."""
    folder = tmp_path / "cache"
    folder.mkdir(mode=0o700)
    return folder


def change_mode(mode):
    return lambda path, give_away: path.chmod(mode)


SPOILT = [
    (lambda path, give_away: give_away(path), "belongs to another user, number "),
    (change_mode(0o664), "others may write to {path}: chmod go-w {path}"),
    (change_mode(0o646), "others may write to {path}: chmod go-w {path}"),
    (lambda path, give_away: give_away(path.parent), "belongs to another user, number "),
    (lambda path, give_away: path.parent.chmod(0o770), "others may write to {path.parent}: "),
    (lambda path, give_away: path.parent.chmod(0o1777), "others may write to {path.parent}: "),
]


@pytest.mark.parametrize(("spoil", "said"), SPOILT)
def test_what_others_can_have_written_is_not_read(spoil, said, folder, give_away):
    path = folder / "program"
    write_private(path, b"code")
    assert read_trusted(path) == b"code"
    spoil(path, give_away)
    with pytest.warns(UserWarning, match=re.escape(said.format(path=path))) as told:
        assert read_trusted(path) is None
    assert len(told) == 1
    assert "compiled programs are not read, and compiled again" in str(told[0].message)


def test_what_others_may_only_read_is_trusted(folder):
    path = folder / "program"
    write_private(path, b"code")
    folder.chmod(0o755)
    path.chmod(0o644)
    assert read_trusted(path) == b"code"


@pytest.mark.skipif(getattr(os, "geteuid", int)() != 0, reason="only root can give files to root")
def test_what_belongs_to_root_is_trusted(folder, monkeypatch):
    path = folder / "program"
    write_private(path, b"code")
    monkeypatch.setattr(os, "geteuid", lambda: SOMEONE)
    assert read_trusted(path) == b"code"


def test_where_files_have_no_owners_all_are_trusted(folder, monkeypatch):
    path = folder / "program"
    write_private(path, b"code")
    path.chmod(0o666)
    monkeypatch.delattr(os, "geteuid")
    assert read_trusted(path) == b"code"


def test_what_is_not_there_is_nothing_to_tell(folder, capfd):
    assert read_trusted(folder / "program") is None
    assert read_trusted(folder / "nowhere" / "program") is None
    assert capfd.readouterr() == ("", "")


def test_a_file_is_written_for_this_user_alone(folder):
    before = os.umask(0)
    try:
        write_private(folder / "program", b"first")
        write_private(folder / "program", b"second")
    finally:
        os.umask(before)
    (path,) = folder.iterdir()
    assert read_trusted(path) == b"second"
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_a_damaged_file_counts_as_missing(folder):
    path = folder / "program"
    write_private(path, b"code")
    path.write_bytes(path.read_bytes()[:-1] + b"d")
    assert read_trusted(path) is None


def test_nothing_is_written_where_nobody_would_read_it(folder):
    folder.chmod(0o777)
    write_private(folder / "program", b"code")
    assert list(folder.iterdir()) == []
    with pytest.raises(OSError, match="No such file"):
        write_private(folder / "nowhere" / "program", b"code")


# The folder itself.


@pytest.fixture
def settings(monkeypatch, tmp_path):
    """JAX without a folder; what is set is taken back."""
    names = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    before = {name: jax.config.values[name] for name in names}
    jax.config.update("jax_compilation_cache_dir", None)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "caches"))
    yield
    for name, value in before.items():
        jax.config.update(name, value)


def used():
    use_compilation_cache()
    return jax.config.values["jax_compilation_cache_dir"]


@pytest.mark.parametrize("named", [False, True])
def test_the_cache_folder_is_made_for_this_user_alone(named, settings, tmp_path, capfd):
    if named:
        jax.config.update("jax_compilation_cache_dir", str(tmp_path / "mine" / "programs"))
    before = os.umask(0)
    try:
        folder = Path(used())
    finally:
        os.umask(before)
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    assert used() == str(folder)
    assert (tmp_path / ("mine" if named else "caches")) in folder.parents
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(("spoil", "said"), SPOILT[3:])
def test_a_cache_folder_of_others_is_not_used(spoil, said, settings, folder, give_away, capfd):
    jax.config.update("jax_compilation_cache_dir", str(folder))
    spoil(folder / "program", give_away)
    assert used() is None
    line = capfd.readouterr().err
    assert line.count("\n") == 1
    assert said.format(path=folder / "program") in line


def test_a_cache_folder_that_cannot_be_made_costs_one_line(settings, tmp_path, capfd):
    (tmp_path / "caches").write_text("a file where a folder should be")
    assert used() is None
    line = capfd.readouterr().err
    assert line.startswith("slow: compilation cache: every start compiles again")
    assert f": {tmp_path / 'caches'}" in line
    assert line.count("\n") == 1


def test_without_a_home_there_is_no_cache_folder(settings, monkeypatch, capfd):
    def fail():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", fail)
    assert used() is None
    assert capfd.readouterr().err.endswith(": no home folder: set HOME or XDG_CACHE_HOME\n")


def test_a_place_that_only_jax_knows_is_left_to_it(settings, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    jax.config.update("jax_compilation_cache_dir", "gs://bucket/programs")
    assert used() == "gs://bucket/programs"
    assert list(tmp_path.iterdir()) == []


# Those who load code.


def keep_program(folder):
    """Keeps a program; returns a function that says whether it is found."""
    ProgramCache({}, folder, "key").compile(
        "it", lambda: jax.jit(lambda x: 2 * x).trace(jnp.ones(3))
    )
    return lambda: ProgramCache({}, folder, "key").find("it") is not None


def keep_kernel(folder):
    """Likewise machine code."""
    cached_bytes("object", b"key", lambda: b"code")
    return lambda: cached_bytes("object", b"key", lambda: b"anew") == b"code"


@pytest.mark.parametrize("keep", [keep_program, keep_kernel])
@pytest.mark.parametrize(("spoil", "said"), SPOILT)
def test_code_that_others_can_have_written_is_not_run(
    keep, spoil, said, settings, folder, give_away, monkeypatch
):
    jax.config.update("jax_compilation_cache_dir", str(folder))
    # Nothing of JAX's own, if this is the first test of the process to compile.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 3600.0)
    monkeypatch.setattr(program_cache, "_CacheEvents", NoHits)
    is_found = keep(folder)
    assert is_found()
    # XLA for GPUs has folders of its own there.
    (path,) = (path for path in folder.iterdir() if not path.name.startswith("xla_"))
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    spoil(path, give_away)
    with pytest.warns(UserWarning, match=re.escape(said.format(path=path))):
        assert not is_found()


class NoHits:
    """As if JAX had nothing in its own cache: what it has a CPU cannot write again."""

    requests, hits = 1, 0

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        pass
