"""The WebAssembly modules that are stored in the package."""

import gzip
import json
import shutil

import jax
import pytest

from helpers.further import slow_unless
from jetbot_mjx.deployment import web_modules
from jetbot_mjx.deployment.web_modules import (
    SHIPPED,
    find_module,
    shipped_texts,
    source_hash,
    store_modules,
    stored_hashes,
)
from jetbot_mjx.runs import PRETRAINED
from onekernel import KernelError, wasm

MODULES = web_modules._FOLDER
FILES = sorted(path.name for path in MODULES.iterdir() if path.name.endswith(".gz"))

IMPORTS, EXPORTS = 2, 7
"""Numbers of a module's sections."""


def number(data, at):
    """A whole number in LEB128, and where it ends."""
    value = shift = 0
    while True:
        value |= (data[at] & 0x7F) << shift
        shift, at = shift + 7, at + 1
        if data[at - 1] < 0x80:
            return value, at


def sections(module):
    """The sections of a module by their numbers."""
    assert module[:8] == b"\0asm\1\0\0\0"
    found, at = {}, 8
    while at < len(module):
        size, begin = number(module, at + 1)
        found[module[at]] = module[begin : begin + size]
        at = begin + size
    assert at == len(module)
    return found


def exports(module):
    """The names that a module exports."""
    data = sections(module)[EXPORTS]
    count, at = number(data, 0)
    names = []
    for _ in range(count):
        size, at = number(data, at)
        names.append(data[at : at + size].decode())
        # The kind, and the index.
        at = number(data, at + size + 1)[1]
    return names


def test_every_policy_and_every_version_has_its_modules():
    policies = {f"pretrained:{path.name}" for path in PRETRAINED.iterdir()}
    assert policies < {*SHIPPED}
    stored = stored_hashes()
    assert stored
    assert all({*modules} == {*SHIPPED} for modules in stored.values())
    named = {digest[:16] for modules in stored.values() for digest in modules.values()}
    assert {name.removesuffix(".wasm.gz") for name in FILES} == named


@pytest.mark.parametrize("file", FILES)
def test_a_stored_module_is_one_that_imports_nothing(file):
    module = gzip.decompress(MODULES.joinpath(file).read_bytes())
    assert IMPORTS not in sections(module)
    names = exports(module)
    robots = ("reset", "step", "poses", "goals", "script", "draw")
    assert {*names} >= {"memory", "__heap_base", "net_product", *(f"robot_{x}" for x in robots)}
    # Either the page can train, or the policy sees an image.
    assert ("ppo_update" in names) != ("robot_image" in names)


QUICK = ("pretrained:jetbot_egocentric", "camera_real")


@pytest.mark.parametrize("name", slow_unless(lambda name: name in QUICK, SHIPPED))
def test_the_stored_modules_are_those_of_todays_functions(name):
    stored = stored_hashes().get(jax.__version__)
    if stored is None:
        pytest.skip(f"no modules are stored for JAX {jax.__version__}")
    texts = shipped_texts(name)
    assert source_hash(texts) == stored[name], "say: make wasm, with each version of JAX"
    module = find_module(texts)
    assert {*exports(module)} == {*texts, "memory", "__heap_base"}


def texts_of(name):
    """The functions of a tiny module."""
    return {name: f"define void @{name}() {{\n  ret void\n}}"}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder for stored modules, with two of another version of JAX."""
    folder = tmp_path / "modules"
    folder.mkdir()
    monkeypatch.setattr(web_modules, "_FOLDER", folder)
    monkeypatch.setattr(web_modules, "SHIPPED", ("one", "two"))
    monkeypatch.setattr(web_modules, "shipped_texts", texts_of)
    return folder


@pytest.fixture
def linker(monkeypatch):
    """A linker that every machine has; it returns how often it was called, as a module."""
    calls = []

    def link(texts):
        calls.append(texts)
        return f"{[*texts]}".encode()

    monkeypatch.setattr(wasm, "link", link)
    return calls


def test_a_stored_module_needs_no_linker_and_any_other_one_does(folder, linker):
    store_modules()
    assert len(linker) == 2
    assert find_module(texts_of("one")) == b"['one']"
    assert len(linker) == 2
    assert find_module(texts_of("three")) == b"['three']"
    assert len(linker) == 3


def test_storing_replaces_this_versions_modules_and_keeps_the_others(folder, linker):
    store_modules()
    first = {path.name: path.read_bytes() for path in folder.iterdir()}
    store_modules()
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == first
    # The time of compression would make another file of the same module.
    assert all(path.read_bytes()[4:8] == bytes(4) for path in folder.glob("*.gz"))
    # Another version has one of these modules, and one of its own; a third file is nobody's.
    index = json.loads((folder / "index.json").read_text())
    others = {"one": index[jax.__version__]["one"], "two": "f" * 64}
    (folder / "index.json").write_text(json.dumps({"0.0.1": others, jax.__version__: others}))
    for name in ("f" * 16, "0" * 16):
        (folder / f"{name}.wasm.gz").write_bytes(b"")
    store_modules()
    assert {path.name for path in folder.iterdir()} == {*first, f"{'f' * 16}.wasm.gz"}
    assert stored_hashes() == {"0.0.1": others, **index}


def test_without_a_linker_the_remedy_is_told(folder, monkeypatch):
    monkeypatch.setattr(shutil, "which", lambda _: None)
    wasm._linker.cache_clear()
    try:
        with pytest.raises(KernelError, match="wasm-ld is not installed: apt install lld"):
            find_module(texts_of("one"))
    finally:
        wasm._linker.cache_clear()
