"""Cache compiled programs on disk under a key, so that later processes need not trace them.

JAX's own cache finds a program by its lowered code. To look there, a process must first trace and
lower the program, which takes far longer than loading it. This cache finds a program by a key that
its user computes from everything that the program depends on.
"""

import contextlib
import hashlib
import io
import pickle
import platform
import threading
import time
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple, Protocol, Self

import jax
from jax.experimental import serialize_executable

from onekernel import cpu
from onekernel.aot.xla_options import Options, unseen_options, untuned_options
from onekernel.background import in_background
from onekernel.trusted_files import distrust, read_trusted, write_private

_UNUSED_DAYS = 30
# Two threads that trace only take turns in Python. With a lock, one program is finished first, and
# XLA compiles it while the next one is traced.
_tracing = threading.Lock()

_CACHE_HIT = "/jax/compilation_cache/cache_hits"
_CACHE_REQUEST = "/jax/compilation_cache/compile_requests_use_cache"

Notice = Any
"""Something that users were told. Only `Notices` knows its type, which must be picklable."""


class _Lowered(NamedTuple):
    """A `_Lowered` holds a program before it is compiled."""

    program: jax.stages.Lowered
    seconds: float
    """Time that it took to trace and lower it [s]."""
    notices: list[Notice]
    """Notices to users from the time of tracing."""


class _Stored(NamedTuple):
    """A `_Stored` holds a compiled program as a file does."""

    program: jax.stages.Compiled
    notices: list[Notice]
    """Notices to users from the time of tracing."""


class Notices(Protocol):
    """A `Notices` collects the notices to users while a program is traced, and repeats them later.

    Tracing may warn users, and a program from the cache is not traced: so its notices are stored.
    """

    def collect(self) -> contextlib.AbstractContextManager[list[Notice]]:
        """Return a context that yields a list of all that is reported inside it."""
        ...

    def report(self, notice: Notice, /) -> None:
        """Report a notice again, when a program is loaded that was traced in another process."""
        ...


class _NoNotices:
    """A `_NoNotices` is for callers that tell their users nothing."""

    def collect(self) -> contextlib.AbstractContextManager[list[Notice]]:
        return contextlib.nullcontext([])

    def report(self, notice: Notice, /) -> None:
        pass


class ProgramCache:
    """A `ProgramCache` holds the compiled programs of one configuration, by name."""

    def __init__(
        self,
        options: Options,
        folder: Path | None = None,
        key: str = "",
        notices: Notices | None = None,
        nodes: Sequence[type] = (),
    ) -> None:
        """Set the options, folder and key of the cache.

        Args:
          options: the compiler options of the programs.
          folder: an existing folder; None: programs are not cached.
          key: everything that the programs depend on, but for the options and the processor.
          notices: collects notices to users; those from the tracing of a program are stored with
            it, and reported again where it is loaded.
          nodes: classes in the pytrees that programs take and return, of modules that a later
            process may not find by their names; in an order that the key decides. Files hold their
            numbers, and a program that is loaded has the classes given here.
        """
        self.options = options
        """The compiler options of the programs."""
        self._folder = folder
        self._key = f"{key} {processor()} {sorted(options.items())}" if folder else ""
        self._notices = notices or _NoNotices()
        self._nodes = nodes
        self._prefetched: dict[str, Future[_Stored | None]] = {}
        self.loads = False
        """Whether programs are being loaded, and not one of them must be compiled."""

    def prefetch(self, *names: str) -> None:
        """Start to load programs in threads, and return at once."""
        if self._folder is None:
            return
        for name in names:
            # Each program has a thread of its own, so that all load at the same time.
            pool = ThreadPoolExecutor(1)
            self._prefetched[name] = pool.submit(_load, self._path(name), self._nodes)
            pool.shutdown(wait=False)
        self.loads = all(self._path(name).exists() for name in names)

    def has(self, name: str) -> bool:
        """Return whether there is a file of a program, which need not be usable."""
        return self._folder is not None and self._path(name).exists()

    def find(self, name: str) -> jax.stages.Compiled | None:
        """Return a program if it was compiled before.

        Args:
          name: the name of the program, unique within the configuration.

        Returns:
          The program; None if it is not in the cache.
        """
        if self._folder is None:
            return None
        # A program is loaded once: wait for the thread that loads it, or load it now.
        prefetched = self._prefetched.pop(name, None)
        stored = prefetched.result() if prefetched else _load(self._path(name), self._nodes)
        if stored is None:
            return None
        # A cached program is not traced, so repeat the notices of its tracing.
        for notice in stored.notices:
            self._notices.report(notice)
        return stored.program

    def compile(
        self,
        name: str,
        trace: Callable[[], jax.stages.Traced],
        check: Callable[[], Callable[[], jax.stages.Traced] | None] = lambda: None,
        *,
        tune: bool = False,
    ) -> jax.stages.Compiled:
        """Return a program, and compile it if it is not cached.

        Args:
          name: name of the program.
          trace: a function that traces the program.
          check: a function that returns None if what was traced can be used, and otherwise a
            function that traces another program in its place. It runs while XLA compiles, and not
            at all if the program is cached.
          tune: whether XLA may time kernels on a GPU to choose the fastest, for a program that runs
            for most of the time.

        Returns:
          The program, which takes arguments of the shapes and shardings it was traced with.
        """
        program = self.find(name)
        if program is not None:
            return program
        lowered = self._lower(trace)
        # Check and compile at once. Nothing is written to the cache unless the check has passed.
        checked = in_background(check).result
        try:
            program = self._compile(name, lowered, lambda: checked() is None, tune=tune)
        except jax.errors.JaxRuntimeError:
            # If the check fails, too, compile the other program; otherwise this error counts.
            if checked() is None:
                raise
            program = None
        otherwise = checked()
        if program is not None and otherwise is None:
            return program
        # The check was not passed: compile the other program (or, if compiling failed, the same
        # once more).
        return self._compile(name, self._lower(otherwise or trace), tune=tune)

    def compile_later(
        self,
        name: str,
        trace: Callable[[], jax.stages.Traced],
        inside: contextlib.AbstractContextManager[object] | None = None,
    ) -> Callable[[], jax.stages.Compiled]:
        """Trace a program now if it is not cached, and compile it in a thread.

        Args:
          name: name of the program.
          trace: a function that traces the program.
          inside: a context in which the program is traced and lowered, while no cache lowers
            another one.

        Returns:
          A function that waits for the program, as `compile` returns it.
        """
        program = self.find(name)
        if program is not None:
            return lambda: program
        lowered = self._lower(trace, inside)
        return in_background(lambda: self._compile(name, lowered)).result

    def _lower(
        self,
        trace: Callable[[], jax.stages.Traced],
        inside: contextlib.AbstractContextManager[object] | None = None,
    ) -> "_Lowered":
        around = inside or contextlib.nullcontext()
        with _tracing, around, self._notices.collect() as notices:
            began = time.perf_counter()
            return _Lowered(trace().lower(), time.perf_counter() - began, notices)

    def _compile(
        self,
        name: str,
        lowered: "_Lowered",
        usable: Callable[[], bool] = lambda: True,
        *,
        tune: bool = False,
    ) -> jax.stages.Compiled:
        """Compile a program and write it to the folder.

        Args:
          name: name of the program.
          lowered: the program.
          usable: a function that returns whether to write it.
          tune: whether XLA may time kernels.
        """
        options = self.options if tune else {**self.options, **untuned_options()}
        began = time.perf_counter()
        program, loaded = _compiled(lowered.program, options)
        if self._folder and loaded and (unseen := unseen_options()):
            # A program that JAX has loaded from its own cache cannot be written to this one. So
            # compile it once more, under options that JAX's cache does not have; from now on this
            # cache has the program.
            program, loaded = _compiled(lowered.program, {**options, **unseen})
        if self._folder and not loaded and usable():
            seconds = lowered.seconds + time.perf_counter() - began
            # A program for a CPU calls kernels by name, so they are saved beside it. Writing its
            # text takes a while; a program for a GPU contains its PTX.
            text = lowered.program.as_text() if jax.default_backend() == "cpu" else ""
            kernels = cpu.kernels_in(text)
            stored = _Stored(program, lowered.notices)
            _save(self._path(name), stored, kernels, seconds, self._nodes)
        return program

    def _path(self, name: str) -> Path:
        assert self._folder is not None
        text = f"{self._key} {name}"
        return self._folder / f"program-{hashlib.sha256(text.encode()).hexdigest()}"


def processor() -> str:
    """Return a short name for this processor's instruction set."""
    try:
        # Linux lists the features of each core: programs may use all of them.
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = [platform.machine(), platform.processor()]
    kind = sorted({line for line in lines if line.startswith(("flags", "Features", "model name"))})
    return hashlib.sha256("\n".join(kind or lines).encode()).hexdigest()[:8]


def cache_folder(path: Path, *, by_processor: bool = False) -> Path:
    """Create a folder of compiled programs if it is missing, and return it.

    Args:
      path: the folder.
      by_processor: whether to return a folder inside it, for this kind of processor and version of
        JAX, because a program that was compiled for one may not run on another.

    Raises:
      OSError: the folder cannot be used, or other users may write to it, and JAX would run the
        programs that it finds there.
    """
    folder = path / f"jax-{jax.__version__}-{processor()}" if by_processor else path
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    if reason := distrust(folder, folder.stat()):
        raise PermissionError(reason)
    return folder


class _CacheEvents:
    """A counter of the programs that this thread looks for in JAX's own cache, and finds there."""

    def __enter__(self) -> Self:
        self.requests = self.hits = 0
        # JAX tells all listeners of all threads.
        self._thread = threading.get_ident()
        jax.monitoring.register_event_listener(self._listen)
        return self

    def __exit__(self, *exception: object) -> None:
        jax.monitoring.unregister_event_listener(self._listen)

    def _listen(self, event: str, **kwargs: str | int) -> None:
        if threading.get_ident() == self._thread:
            self.requests += event == _CACHE_REQUEST
            self.hits += event == _CACHE_HIT


def _compiled(lowered: jax.stages.Lowered, options: Options) -> tuple[jax.stages.Compiled, bool]:
    """Compile a program; return also whether it must not be serialized.

    That is so on a CPU if JAX took it from its own cache: XLA would leave out some functions. If
    JAX did not look there, this process has the program already, perhaps from there.
    """
    # Tracing may have found small programs in JAX's cache, which do not count.
    with _CacheEvents() as events:
        # JAX passes numbers on, too, although its annotation does not say so.
        program = lowered.compile(compiler_options=options)  # pyright: ignore[reportArgumentType]
    reused = events.requests == 0 and jax.config.values["jax_enable_compilation_cache"]
    return program, (events.hits > 0 or reused) and jax.default_backend() == "cpu"


class _Pickler(pickle.Pickler):
    """A `_Pickler` writes classes of the cache's user as numbers."""

    def __init__(self, file: io.BytesIO, nodes: Sequence[type]) -> None:
        super().__init__(file)
        self._nodes = nodes

    def persistent_id(self, obj: object) -> int | None:
        found = (number for number, node in enumerate(self._nodes) if node is obj)
        return next(found, None)


class _Unpickler(pickle.Unpickler):
    """An `_Unpickler` reads what a `_Pickler` wrote."""

    def __init__(self, file: io.BytesIO, nodes: Sequence[type]) -> None:
        super().__init__(file)
        self._nodes = nodes

    def persistent_load(self, pid: int) -> type:
        return self._nodes[pid]


def _load(path: Path, nodes: Sequence[type]) -> _Stored | None:
    """Load the program in a file; return None if it is missing, damaged, untrusted or unusable.

    What cannot be unpickled costs a warning.
    """
    began = time.perf_counter()
    content = read_trusted(path)
    if content is None:
        return None
    # `read_trusted` has checked that nobody else can have written this pickle. Register the kernels
    # first: XLA looks for them when it loads the program.
    try:
        seconds, kernels, notices, ids, serialized = _Unpickler(io.BytesIO(content), nodes).load()
    except Exception as error:
        # What a pickle names may be anyone's code, and raise anything.
        _warn("read, and is compiled again", error)
        return None
    cpu.register(kernels)
    # Programs name their devices by number.
    devices = {device.id: device for device in jax.devices()}
    try:
        program = serialize_executable.deserialize_and_load(
            *serialized,
            # Without these devices, JAX would load it as one program for all devices.
            execution_devices=[devices[number] for number in ids],
        )
    except jax.errors.JaxRuntimeError:
        # For example, a newer driver rejects the program: compile it again.
        return None
    with contextlib.suppress(OSError):
        path.touch()
    # Report the same events as JAX does when it finds a program in its own cache.
    loaded = time.perf_counter() - began
    monitoring = jax.monitoring
    monitoring.record_event(_CACHE_HIT)
    monitoring.record_event_duration_secs(
        "/jax/compilation_cache/compile_time_saved_sec", max(0.0, seconds - loaded)
    )
    monitoring.record_event_duration_secs("/jax/core/compile/backend_compile_duration", loaded)
    return _Stored(program, notices)


def _warn(what: str, error: Exception) -> None:
    """Say in one line what cannot be done with a compiled program, once for each reason."""
    reason = f"{type(error).__name__}: {error}".splitlines()[0]
    warnings.warn(f"a compiled program cannot be {what}: {reason}", stacklevel=1)


def _save(
    path: Path,
    stored: _Stored,
    kernels: dict[str, bytes],
    seconds: float,
    nodes: Sequence[type],
) -> None:
    """Write a program, the kernels that it calls and its compile time to a file.

    An error while writing is ignored, because a missing file only costs time. What cannot be
    pickled costs a warning, because every process compiles it again.
    """
    try:
        serialized = serialize_executable.serialize(stored.program)
        loaded = stored.program.runtime_executable()
        assert loaded is not None
        ids = [device.id for device in loaded.local_devices()]
    except (NotImplementedError, ValueError):
        # Devices of this kind cannot serialize programs.
        return
    file = io.BytesIO()
    try:
        _Pickler(file, nodes).dump((seconds, kernels, stored.notices, ids, serialized))
    except Exception as error:
        # For example, a class in its results belongs to a module that cannot be imported.
        _warn("kept, and is compiled again by every start", error)
        return
    with contextlib.suppress(OSError):
        # Remove programs that nobody has loaded for a month (`_load` touches what it loads).
        for other in path.parent.glob("program-*"):
            if time.time() - other.stat().st_mtime > _UNUSED_DAYS * 86_400:
                other.unlink(missing_ok=True)
        write_private(path, file.getvalue())
