"""Shared fixtures: the CPU, a compilation cache in the work tree, environments built once."""

import fcntl
import functools
import gc
import os
import signal
import socket
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

ROOT = Path(__file__).parents[1]

# Before JAX is imported. Subprocesses of the tests inherit all of it.
os.environ.setdefault("JAX_PLATFORMS", "cpu")
# One folder for all workers: what one has compiled, the others read. JAX writes an entry in place;
# who reads half of one compiles again, after a warning that pyproject.toml lets pass.
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(ROOT / ".cache" / "jax" / "tests"))
# Ours alone whatever the umask, or the commands would not use it.
Path(os.environ["JAX_COMPILATION_CACHE_DIR"]).mkdir(mode=0o700, parents=True, exist_ok=True)
# What trainings record of the code that they ran is not the user's either.
os.environ.setdefault("XDG_STATE_HOME", str(ROOT / ".cache" / "state"))
# Neither the user's token nor Xet, which speaks to real servers only, instead of LFS.
os.environ.setdefault("HF_HOME", str(ROOT / ".cache" / "huggingface"))
os.environ.setdefault("HF_HUB_DISABLE_XET", "1")
# Small programs too: a process of the tests compiles a hundred of them before it begins.
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
if os.environ["JAX_PLATFORMS"] == "cpu":
    # Most programs run once, for moments, and XLA compiles them in less than half the time so; and
    # all are compiled alike, so that two stay comparable. One that runs for long is `optimized`.
    # Without the emitters, no call of a training step gave other bits than the one before, in 647.
    _flags = ["--xla_backend_optimization_level=0"]
    if version("jaxlib").startswith("0.10."):  # others may not know a flag, and abort
        _flags.append("--xla_cpu_use_fusion_emitters=false")
        # One module of LLVM's for each program: 32 are copied, and take a quarter longer.
        _flags.append("--xla_cpu_parallel_codegen_split_count=1")
    os.environ.setdefault("XLA_FLAGS", " ".join(_flags))
os.environ.setdefault("MPLBACKEND", "agg")
# The cores are the workers': threads of NumPy's products would wait for one, and burn another.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
if sys.dont_write_bytecode:
    # A hundred processes would compile every module from its source: an eighth of what they cost.
    sys.dont_write_bytecode, sys.pycache_prefix = False, str(ROOT / ".cache" / "bytecode")
    os.environ["PYTHONPYCACHEPREFIX"] = sys.pycache_prefix
    del os.environ["PYTHONDONTWRITEBYTECODE"]
# Traces and their caches are millions of objects that stay: look through them less often.
gc.set_threshold(20_000, 20, 10)
# A shell lets its background jobs ignore Ctrl-C: tests that press it would wait for ever.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
# Of this checkout first, in processes of the tests too: the packages, and the tests' `helpers`.
_PATHS = [str(ROOT / "tests"), str(ROOT)]
sys.path[:0] = _PATHS
os.environ["PYTHONPATH"] = os.pathsep.join([*_PATHS, *filter(None, [os.environ.get("PYTHONPATH")])])

import jax
import pytest

from helpers.durations import (  # noqa: F401
    pytest_runtest_logreport,
    pytest_runtest_logstart,
    pytest_runtest_makereport,
    pytest_sessionfinish,
    pytest_terminal_summary,
)
from helpers.further import mark_what_asks_for_slow_fixtures
from helpers.stack import OneChunk
from helpers.unpainted import unpainted
from jetbot_mjx import fallbacks
from jetbot_mjx.config import Config, ConfigError, load_config, parse_config, task_modules
from jetbot_mjx.envs import opengl, program_key
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.jetbot_env import JetBotEnv
from jetbot_mjx.errors import UserError

_OWN_TASKS = program_key.BUILT_IN_TASKS
# Tests replace parts of the package, of which programs that were kept would know nothing.
program_key.BUILT_IN_TASKS = frozenset()

_LONGEST = (
    "test_resumption",
    "test_fused",
    "test_ppo",
    "test_search",
    "test_fused_learner",
    "test_library",
    "test_llvm_codegen",
    "test_mujoco",
    "test_evaluate",
    "test_trust",
)


def pytest_configure(config):
    config.pluginmanager.register(OneChunk())


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Begins with the files that take longest, so that no worker is left alone with one."""
    mark_what_asks_for_slow_fixtures(items)
    rank = {name: index for index, name in enumerate(_LONGEST)}
    items.sort(key=lambda item: rank.get(item.path.stem, len(_LONGEST)))


def pytest_collection_finish():
    """Leaves what was imported out of all garbage collections, as `freeze_what_stays` does."""
    gc.freeze()


@pytest.fixture(autouse=True)
def fallbacks_printed_anew(monkeypatch):
    """Each test is a process of its own in this: what an earlier one printed is printed again."""
    monkeypatch.setattr(fallbacks, "_printed", set())


def pytest_runtest_setup(item):
    if item.get_closest_marker("cpu") and jax.default_backend() != "cpu":
        pytest.skip(f"of programs for CPUs; the default device is a {jax.default_backend()}")


@pytest.fixture(autouse=True)
def forget_modules(tmp_path_factory):
    """Forgets the modules that a test imported from a temporary folder: the next may have another
    of that name."""
    before = set(sys.modules)
    yield
    temporary = str(tmp_path_factory.getbasetemp())
    for name in set(sys.modules) - before:
        if (getattr(sys.modules[name], "__file__", None) or "").startswith(temporary):
            del sys.modules[name]
    sys.path[:] = [folder for folder in sys.path if not folder.startswith(temporary)]
    for name, folder in [*task_modules.TASK_FOLDERS.items()]:
        if str(folder).startswith(temporary):
            del task_modules.TASK_FOLDERS[name]


@pytest.fixture(scope="module", autouse=True)
def freeze_what_stays():
    """Leaves what a file's tests have made to the caches, and out of all later garbage collections.

    Looking through the gigabytes that a worker has in the end takes seconds, again and again.
    """
    yield
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="module", autouse=True)
def brief_clips(request):
    """Lets the clips of reports end in moments, but where they are what is tested."""
    with pytest.MonkeyPatch.context() as patch:
        if request.path.stem != "test_clips":
            patch.setattr("jetbot_mjx.viewers.clips._LONGEST_SECONDS", 0.2)
        yield


@pytest.fixture(scope="session")
def own_tasks() -> frozenset[str]:
    """The tasks of which a user's programs are kept; the tests keep those of none."""
    return _OWN_TASKS


@pytest.fixture(scope="session")
def root() -> Path:
    return ROOT


@pytest.fixture(scope="session")
def world_config() -> Config:
    return parse_config({})


@pytest.fixture(scope="session")
def world_env(world_config: Config) -> JetBotEnv:
    return make_env(world_config)


@functools.cache
def _preset_env(preset: str) -> JetBotEnv:
    return make_env(parse_config({"robot": {"preset": preset}}))


@pytest.fixture(params=["isaac", "real"])
def preset_env(request) -> JetBotEnv:
    # Kept by itself: a test that has parameters of its own for it would end a session's fixture.
    return _preset_env(request.param)


@pytest.fixture(scope="session")
def unused_port() -> Callable[[], int]:
    """Finds a port that nothing listens on, of those that nobody asks for by number."""

    def find() -> int:
        with socket.create_server(("127.0.0.1", 0)) as taken:
            return taken.getsockname()[1]

    return find


@pytest.fixture
def with_opengl():
    """Skips the test where there is no OpenGL."""
    try:
        opengl.find_backend()
    except UserError as error:
        pytest.skip(str(error))


@pytest.fixture
def optimized(monkeypatch):
    """The package compiles its programs at the level of its own: for those that run for long."""
    monkeypatch.delenv("XLA_FLAGS", raising=False)


@pytest.fixture
def blank_figures():
    """No figure of a report is painted."""
    with unpainted():
        yield


@pytest.fixture
def small_videos(monkeypatch):
    """Videos have few frames, and small ones, where nobody looks at them."""
    from jetbot_mjx.viewers import gallery, video

    def small(env, size):
        return video.VideoRenderer(env, (128, 64), fps=2)

    monkeypatch.setattr(gallery, "VideoRenderer", small)


@pytest.fixture
def write(tmp_path):
    """Writes a YAML file and gives its path."""

    def write(text):
        path = tmp_path / "mine.yaml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


@pytest.fixture
def refusal(write):
    """The one line by which a file, with overrides, is refused."""

    def refusal(text, *overrides):
        with pytest.raises(ConfigError) as caught:
            load_config(write(text), overrides)
        message = str(caught.value)
        assert len(message.splitlines()) == 1
        return message

    return refusal


@pytest.fixture(scope="session")
def smoke_run(tmp_path_factory) -> Path:
    """A run folder, trained once with `configs/smoke.yaml` and never written to by a test."""
    from jetbot_mjx.training import session

    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent  # of all workers: the first that comes trains it
    with (folder / "smoke.lock").open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if os.fstat(lock.fileno()).st_size == 0:
            session.run(load_config(ROOT / "configs" / "smoke.yaml"), folder / "smoke")
            lock.write("trained")
    return folder / "smoke"
