"""`JETBOT_MJX_PLAIN_START=1` turns off everything that `startup` lists."""

import json
import os
import platform
import re
import subprocess
import sys
from pathlib import Path

import pytest

from jetbot_mjx import startup
from jetbot_mjx.startup.switch import PLAIN_START

ALWAYS = {"divide_cpu", "keep_own_files", "protect_output", "share_memory"}
"""What `startup` exports and the switch does not turn off."""

SET_BY_TESTS = {
    "JAX_COMPILATION_CACHE_DIR",
    # Commands set these, also the ones that earlier tests ran in this process.
    "OPENBLAS_NUM_THREADS",
    "PYDANTIC_DISABLE_PLUGINS",
    "XLA_PYTHON_CLIENT_PREALLOCATE",
}
"""Environment variables that a process of these tests does not inherit."""

PROCESS = """
import gc, os, signal, sys, threading
import jax
from jetbot_mjx import cli, startup

started = []
start = threading.Thread.start

def count_and_start(thread):
    # A thread may have ended before its process is looked at.
    started.append(thread.name)
    start(thread)

threading.Thread.start = count_and_start

def process():
    return (
        [*sys.meta_path], gc.get_threshold(), dict(os.environ), signal.getsignal(signal.SIGINT),
        sys.unraisablehook, [*started], jax.config.jax_compilation_cache_dir,
    )

before = process()

def command(_):
    startup.wake_driver()
    startup.wake_device()
    startup.load_blas()
    cli.prepare_device()
    with startup.exit_on_interrupt():
        changed = [one for one, other in zip(process(), before, strict=True) if one != other]
    print(len(changed))
    return 0

cli.run_command(command, at_once=True)
"""


TRAIN_AND_EVALUATE = """
import json, sys
from helpers import gliding
from helpers.command_modules import evaluate, train
from helpers.unpainted import unpainted
from jetbot_mjx import cli

training, evaluation = map(json.loads, sys.argv[1:])
with gliding.everywhere(), unpainted():
    cli.run_command(lambda _: train.main(training) or evaluate.main(evaluation), at_once=True)
"""


def python(*arguments, plain="1", **environment):
    inherited = {name: value for name, value in os.environ.items() if name not in SET_BY_TESTS}
    return subprocess.run(
        [sys.executable, "-W", "ignore", *arguments],
        env={**inherited, **environment, PLAIN_START: plain},
        capture_output=True,
        text=True,
    )


@pytest.mark.slow
@pytest.mark.parametrize(("plain", "changed"), [("1", 0), ("0", 7), ("", 7)])
def test_a_plain_start_leaves_the_process_as_it_is(tmp_path, plain, changed):
    (tmp_path / "program.py").write_text(PROCESS, "utf-8")
    # A program that is loaded from a file, and JAX's device, start no threads that have a name.
    done = python(str(tmp_path / "program.py"), plain=plain, XDG_CACHE_HOME=str(tmp_path))
    assert (done.returncode, done.stderr) == (0, "")
    assert int(done.stdout) == changed


def test_another_value_is_refused():
    done = python("-m", "jetbot_mjx", "runs", plain="yes")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "error: JETBOT_MJX_PLAIN_START = 'yes' is neither 0 nor 1\n"


@pytest.mark.slow
def test_a_plain_training_and_evaluation_do_the_same(tmp_path):
    run = str(tmp_path / "run")
    steps = ["--set", "ppo.num_timesteps=8_192", "--set", "checkpoint_interval=8_192"]
    arguments = ["smoke", "--run-dir", run, *steps], [run, "--episodes", "8"]
    program = ["-c", TRAIN_AND_EVALUATE, *map(json.dumps, arguments)]
    # JAX's own variable for compiled programs, of which a plain start knows nothing.
    kept = {"JAX_COMPILATION_CACHE_DIR": os.environ["JAX_COMPILATION_CACHE_DIR"]}
    done = python(*program, XDG_CACHE_HOME=str(tmp_path), **kept)
    assert done.returncode == 0, done.stderr[-2000:]
    assert "last parameters: sha256" in done.stdout
    assert (Path(run) / "evaluations").is_dir()
    done = python("-m", "jetbot_mjx", "runs", str(tmp_path))
    assert done.returncode == 0, done.stderr[-2000:]
    assert re.search(rf"^{re.escape(run)} .* 8,192 ", done.stdout, re.MULTILINE), done.stdout


def test_the_table_has_every_trick():
    told = re.findall(r"^    ([a-z_]+) {2,}\S", startup.__doc__, re.MULTILINE)
    assert set(told) - {"trick"} == set(startup.__all__) - ALWAYS


@pytest.mark.parametrize(("umask", "mode"), [(0o777, 0o600), (0o022, 0o644), (0o400, 0o666)])
def test_files_of_a_command_are_its_users(tmp_path, umask, mode):
    before = os.umask(umask)
    try:
        startup.keep_own_files()
        (tmp_path / "file").write_text("x")
    finally:
        os.umask(before)
    assert (tmp_path / "file").stat().st_mode & 0o777 == mode


ARENAS = """
import ctypes, sys, threading
from jetbot_mjx import startup
if sys.argv[2:]:
    startup.share_memory()
c = ctypes.CDLL(None)
c.malloc.restype = ctypes.c_void_p
together = threading.Barrier(16)
def allocate():
    together.wait()
    c.malloc(1000)
    together.wait()
threads = [threading.Thread(target=allocate) for _ in range(16)]
[one.start() for one in threads]
[one.join() for one in threads]
c.fopen.restype = ctypes.c_void_p
file = ctypes.c_void_p(c.fopen(sys.argv[1].encode(), b"w"))
c.malloc_info(0, file)
c.fclose(file)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="arenas are GNU's")
def test_threads_share_few_arenas(tmp_path, monkeypatch):
    monkeypatch.delenv("MALLOC_ARENA_MAX", raising=False)
    file = tmp_path / "arenas.xml"

    def arenas(*arguments):
        command = [sys.executable, "-c", ARENAS, str(file), *arguments]
        subprocess.run(command, check=True)
        return file.read_text("utf-8").count("<heap nr=")

    assert arenas() > 2
    assert arenas("shared") <= 2
    monkeypatch.setenv("MALLOC_ARENA_MAX", "5")
    assert 2 < arenas("shared") <= 5
