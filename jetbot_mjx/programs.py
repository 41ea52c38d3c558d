"""Compiled programs, kept from one process to the next without being traced again.

JAX keeps what XLA compiled under the program that it was compiled from; to look there, a process
must first trace and lower that program, which takes far longer than to load it. What is traced
depends on the configuration, on the model, on this package's source and on what is installed:
under these a command finds its programs at once. It does so only for tasks of this package, since
nobody can say what a task of someone else's depends on.
"""

import contextlib
import functools
import hashlib
import importlib.metadata
import json
import os
import pickle
import platform
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Self

import jax
import numpy as np
from jax.experimental import serialize_executable

from jetbot_mjx import cpu
from jetbot_mjx.compiling import Options, compiler_options
from jetbot_mjx.config import Config
from jetbot_mjx.trusted_files import read_trusted, write_private

TRUSTED = frozenset({f"{__package__}:GoalTask"})
"""Tasks whose source is part of the key."""

SOURCES = {".ll", ".py", ".xml"}
"""Of what programs are made from, as files of this package end."""

_LIBRARIES = ["brax", "flax", "jax", "jaxlib", "llvmlite", "mujoco", "mujoco-mjx", "numpy", "optax"]
_UNUSED_DAYS = 30
_CACHE_HIT = "/jax/compilation_cache/cache_hits"
_DIGEST_BYTES = hashlib.sha256().digest_size


class Programs:
    """The compiled programs of one configuration, by name."""

    def __init__(self, options: Options, folder: Path | None = None, key: str = "") -> None:
        """Names the place where they are kept.

        Args:
          options: what they are compiled with.
          folder: is there; None: they are not kept.
          key: all that the programs depend on.
        """
        self._options = options
        self._folder = folder
        self._key = f"{key} {sorted(options.items())}"
        self._coming: dict[str, Future[jax.stages.Compiled | None]] = {}

    def prefetch(self, *names: str) -> None:
        """Begins to load programs, in threads, and returns at once."""
        with_folder = names if self._folder else ()
        for name in with_folder:
            pool = ThreadPoolExecutor(1)
            self._coming[name] = pool.submit(_load, self._path(name))
            pool.shutdown(wait=False)

    def find(self, name: str) -> jax.stages.Compiled | None:
        """A program if it was compiled before.

        Args:
          name: of the program, one of its own within the configuration.

        Returns:
          The program, or None.
        """
        if self._folder is None:
            return None
        coming = self._coming.pop(name, None)
        return coming.result() if coming else _load(self._path(name))

    def compile(self, name: str, trace: Callable[[], jax.stages.Traced]) -> jax.stages.Compiled:
        """A program, compiled unless it was before.

        Args:
          name: of the program.
          trace: traces it.

        Returns:
          The program. It takes arguments of the shapes and shardings that it was traced with.
        """
        program = self.find(name)
        if program is not None:
            return program
        began = time.perf_counter()
        with _CacheHits() as hits:
            lowered = trace().lower()
            program = lowered.compile(compiler_options=self._options)
        # What XLA loaded for a CPU it cannot write again: some functions would be missing.
        if self._folder and not (hits.count and jax.default_backend() == "cpu"):
            seconds = time.perf_counter() - began
            _keep(self._path(name), program, cpu.kernels_in(lowered.as_text()), seconds)
        return program

    def _path(self, name: str) -> Path:
        assert self._folder is not None
        text = f"{self._key} {name}"
        return self._folder / f"program-{hashlib.sha256(text.encode()).hexdigest()}"


def programs_of(config: Config, *, keep: bool) -> Programs:
    """The programs of a configuration on the devices of this process.

    Args:
      config: the run.
      keep: whether to keep them in JAX's folder of compiled programs, if there is one.

    Returns:
      They, not compiled yet.
    """
    options = compiler_options(config)
    folder = jax.config.values["jax_compilation_cache_dir"]
    own_task = config.task.name not in TRUSTED
    if not keep or folder is None or own_task or jax.process_count() > 1:
        return Programs(options)
    devices = jax.devices()
    settings = {
        name: repr(value)
        for name, value in jax.config.values.items()
        if not name.startswith(("jax_compilation_cache", "jax_persistent_cache", "jax_log"))
    }
    depends_on = [
        # Seeds are arguments of programs.
        config.model_copy(update={"seed": 0}).model_dump(mode="json"),
        _own_source(),
        _model(config),
        sys.version,
        [_version(name) for name in _LIBRARIES],
        settings,
        os.environ.get("XLA_FLAGS"),
        processor(),
        devices[0].client.platform_version,
        [device.device_kind for device in devices],
    ]
    return Programs(options, Path(folder), json.dumps(depends_on, sort_keys=True))


def _version(library: str) -> str | None:
    try:
        return importlib.metadata.version(library)
    except importlib.metadata.PackageNotFoundError:
        return None


def processor() -> str:
    """A short name for this processor's instruction set."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = [platform.machine(), platform.processor()]
    kind = sorted({line for line in lines if line.startswith(("flags", "Features", "model name"))})
    return hashlib.sha256("\n".join(kind or lines).encode()).hexdigest()[:8]


class _CacheHits:
    """How many programs this thread finds in JAX's own cache."""

    def __enter__(self) -> Self:
        self.count = 0
        self._thread = threading.get_ident()
        jax.monitoring.register_event_listener(self._listen)
        return self

    def __exit__(self, *exception: object) -> None:
        jax.monitoring.unregister_event_listener(self._listen)

    def _listen(self, event: str, **kwargs: str | int) -> None:
        del kwargs
        self.count += event == _CACHE_HIT and threading.get_ident() == self._thread


def _model(config: Config) -> str:
    """A name for the model of a configuration, with all options of its solver."""
    # A mistyped command says so before MuJoCo is loaded.
    import mujoco

    from jetbot_mjx import model, task

    scene = task.make_task(config.task).build_scene
    robot = model.ROBOTS[config.robot.preset]
    made = model.make_mj_model(robot, config.physics, build_scene=scene, visual=False)
    content = np.zeros(mujoco.mj_sizeModel(made), np.uint8)
    mujoco.mj_saveModel(made, None, content)
    return hashlib.sha256(content.tobytes()).hexdigest()


@functools.cache
def _own_source() -> str:
    """A name for all that this package consists of."""
    digest = hashlib.sha256()
    root = Path(__file__).parent
    for path in sorted(root.rglob("*")):
        if path.suffix in SOURCES:
            digest.update(str(path.relative_to(root)).encode() + path.read_bytes())
    return digest.hexdigest()


def _load(path: Path) -> jax.stages.Compiled | None:
    """The program in a file; None where there is none, none that is trusted or can be loaded."""
    began = time.perf_counter()
    content = read_trusted(path)
    if content is None:
        return None
    digest, body = content[:_DIGEST_BYTES], content[_DIGEST_BYTES:]
    if hashlib.sha256(body).digest() != digest:
        return None
    seconds, kernels, ids, kept = pickle.loads(body)
    cpu.register(kernels)
    devices = {device.id: device for device in jax.devices()}
    try:
        program = serialize_executable.deserialize_and_load(
            # Else it would be one program for all devices, whatever it was.
            *kept,
            execution_devices=[devices[number] for number in ids],
        )
    except jax.errors.JaxRuntimeError:
        # A driver that knows it no longer, say: compiling says what is wrong, if anything is.
        return None
    with contextlib.suppress(OSError):
        path.touch()
    # As JAX does when it finds a program in its own cache, for those who listen.
    loaded = time.perf_counter() - began
    monitoring = jax.monitoring
    monitoring.record_event(_CACHE_HIT)
    monitoring.record_event_duration_secs(
        "/jax/compilation_cache/compile_time_saved_sec", max(0.0, seconds - loaded)
    )
    monitoring.record_event_duration_secs("/jax/core/compile/backend_compile_duration", loaded)
    return program


def _keep(
    path: Path, program: jax.stages.Compiled, kernels: dict[str, bytes], seconds: float
) -> None:
    """Writes a program, the kernels that it calls and the time that it took.

    A folder without room costs time, no more.
    """
    try:
        kept = serialize_executable.serialize(program)
        loaded: Any = program.runtime_executable()
        ids = [device.id for device in loaded.local_devices()]
    except (NotImplementedError, ValueError):
        # This kind of device cannot.
        return
    body = pickle.dumps((seconds, kernels, ids, kept))
    with contextlib.suppress(OSError):
        for other in path.parent.glob("program-*"):
            if time.time() - other.stat().st_mtime > _UNUSED_DAYS * 86_400:
                other.unlink(missing_ok=True)
        write_private(path, hashlib.sha256(body).digest() + body)
