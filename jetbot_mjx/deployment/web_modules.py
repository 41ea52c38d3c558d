"""Find the WebAssembly module of some functions: stored in this package, or linked now.

The modules of the policies that come with the package are stored in it, and those of their
configurations, so that a page of theirs needs no linker. Each is found by a hash of the functions'
text; libraries may write the same functions differently, so there is one for each known version of
JAX. `make wasm` writes them.
"""

import gzip
import hashlib
import json
from collections.abc import Mapping
from importlib import resources
from pathlib import Path

import jax

from jetbot_mjx import runs
from jetbot_mjx.config import load_config
from jetbot_mjx.deployment.web_functions import web_functions
from jetbot_mjx.envs import make_jetbot_env
from onekernel.build import wasm

_POLICIES = (
    "best",
    "best_egocentric",
    "jetbot_egocentric",
    "jetbot_camera",
    "real_jetbot",
    "camera_real",
)
SHIPPED = ("jetbot", *_POLICIES, *(f"pretrained:{name}" for name in _POLICIES))
"""Configurations and policies whose modules are stored. Their settings differ where a configuration
was changed after the training."""

_FOLDER = resources.files("jetbot_mjx").joinpath("assets", "web", "modules")
_INDEX = "index.json"


def find_module(texts: Mapping[str, str]) -> bytes:
    """Return the module of some functions.

    Args:
      texts: the functions as LLVM modules, by name.

    Raises:
      KernelError: it is not stored, and this machine cannot make modules.
    """
    stored = _FOLDER.joinpath(_file(source_hash(texts)))
    return gzip.decompress(stored.read_bytes()) if stored.is_file() else wasm.link(texts)


def source_hash(texts: Mapping[str, str]) -> str:
    """Return the SHA-256 of some functions' text."""
    return hashlib.sha256(json.dumps(sorted(texts.items())).encode()).hexdigest()


def stored_hashes() -> dict[str, dict[str, str]]:
    """Return the hash of each stored module, by JAX's version and the name in `SHIPPED`."""
    index = _FOLDER.joinpath(_INDEX)
    return json.loads(index.read_text("utf-8")) if index.is_file() else {}


def shipped_texts(name: str) -> Mapping[str, str]:
    """Return the functions of the module of a name in `SHIPPED`."""
    comes_with, _, policy = name.rpartition(":")
    path = runs.find_run_config(runs.PRETRAINED / policy) if comes_with else name
    config = load_config(path)
    return web_functions(config, make_jetbot_env(config)).texts


def store_modules() -> None:
    """Write the modules of `SHIPPED` for the present version of JAX into the package."""
    folder, index = Path(str(_FOLDER)), stored_hashes()
    folder.mkdir(exist_ok=True)
    index[jax.__version__] = {}
    for name in SHIPPED:
        texts = shipped_texts(name)
        digest = index[jax.__version__][name] = source_hash(texts)
        # Without the time, so that the same module is the same file.
        compressed = gzip.compress(wasm.link(texts), compresslevel=9, mtime=0)
        (folder / _file(digest)).write_bytes(compressed)
    text = json.dumps(index, indent=2, sort_keys=True)
    (folder / _INDEX).write_text(f"{text}\n", "utf-8")
    # Remove what no entry names any more.
    kept = {_file(digest) for modules in index.values() for digest in modules.values()}
    for path in folder.glob("*.gz"):
        if path.name not in kept:
            path.unlink()


def _file(digest: str) -> str:
    return f"{digest[:16]}.wasm.gz"
