"""Ctrl-C while a command loads or compiles."""

import os
import signal
import subprocess
import sys
import time

import pytest

RUN = "pretrained:jetbot_egocentric"

STAND_IN = """
import os, signal, time
try:
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(20)
except BaseException as error:
    if {lost}:
        raise ImportError("an extension could not be loaded")
    raise
"""
"""For a library that is still loading when the signal comes."""


def python(folder, *arguments):
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{os.environ['PYTHONPATH']}"},
        capture_output=True,
        text=True,
        timeout=60,
    )


@pytest.mark.slow
@pytest.mark.parametrize("lost", [False, True])
@pytest.mark.parametrize("command", ["train", "evaluate"])
def test_a_command_that_still_loads_leaves_quietly(command, lost, tmp_path):
    (tmp_path / "jax").mkdir()
    (tmp_path / "jax" / "__init__.py").write_text(STAND_IN.format(lost=lost))
    arguments = {"train": ["smoke", "--run-dir", "run"], "evaluate": [RUN]}[command]
    done = python(tmp_path, "-m", f"jetbot_mjx.{command}", *arguments)
    # 130, to a shell.
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, "", "")


def test_a_background_job_ignores_it_while_it_loads(tmp_path):
    (tmp_path / "jax.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGINT)\n1/0")
    # What a process ignores, the program that takes its place ignores.
    background = (
        "import os, signal, sys\n"
        "signal.signal(signal.SIGINT, signal.SIG_IGN)\n"
        f"os.execv(sys.executable, [sys.executable, '-m', 'jetbot_mjx.evaluate', '{RUN}'])"
    )
    done = python(tmp_path, "-c", background)
    assert done.returncode == 1
    assert "ZeroDivisionError" in done.stderr


@pytest.mark.parametrize("arguments", [("-c", "import program"), ("-m", "program")])
def test_programs_that_import_the_package_keep_their_own_way(arguments, tmp_path):
    (tmp_path / "program").mkdir()
    (tmp_path / "program" / "__main__.py").touch()
    (tmp_path / "program" / "__init__.py").write_text(
        "import signal, jetbot_mjx\n"
        "print(signal.getsignal(signal.SIGINT) is signal.default_int_handler)\n"
    )
    done = python(tmp_path, *arguments)
    assert (done.stdout, done.stderr) == ("True\n", "")


COMMAND = """
import signal, sys, time
from jetbot_mjx import cli

class Loses:
    def __del__(self):
        signal.raise_signal(signal.SIGINT)

def command(_):
    {what}
    time.sleep(20)
    return 0

cli.run_command(command)
"""


@pytest.mark.parametrize(
    ("what", "code", "said"),
    [
        ("signal.raise_signal(signal.SIGINT)", 130, "interrupted\n"),
        # As in a callback of garbage collection: Python prints what is raised there, and goes on.
        ("Loses()", 130, "interrupted\n"),
        ("signal.signal(signal.SIGINT, signal.SIG_IGN); Loses(); sys.exit(3)", 3, ""),
    ],
)
def test_a_command_at_work_is_interrupted_wherever_it_is(what, code, said, tmp_path):
    done = python(tmp_path, "-c", COMMAND.format(what=what))
    assert (done.returncode, done.stderr) == (code, said)


def test_a_command_does_not_wait_for_a_compiler_in_the_main_thread(tmp_path):
    source = COMMAND.replace("cli.run_command(command)", "cli.run_command(command, at_once=True)")
    # As XLA does, it computes without Python's lock and answers no signal.
    source = source.format(
        what="import hashlib, os, threading\n"
        "    threading.Timer(0.5, os.kill, [os.getpid(), signal.SIGINT]).start()\n"
        "    print(time.monotonic(), flush=True)\n"
        "    hashlib.pbkdf2_hmac('sha256', b'', b'salt', 2**31 - 1)"
    )
    done = python(tmp_path, "-c", source)
    assert (done.returncode, done.stderr) == (130, "interrupted\n")
    assert time.monotonic() - float(done.stdout) < 2.5


COMPILING = """
import sys, time
import jax
import jax.numpy as jnp
from jetbot_mjx import cli
from onekernel.background import in_background

jax.config.update("jax_enable_compilation_cache", False)

def long(x):
    for _ in range(2_000):
        x = jnp.sin(x) @ x
    return x

def command(_):
    lowered = jax.jit(long).lower(jnp.ones((3, 3)))
    in_background(lowered.compile)
    time.sleep(0.2)
    raise {error}

cli.run_command(command, at_once=True)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "error",
    ["ValueError: wrong", "SystemExit: wrong"],
)
def test_an_error_while_a_thread_compiles_has_its_traceback_and_exit_code(error, tmp_path):
    raised = "{}('{}')".format(*error.split(": "))
    done = python(tmp_path, "-c", COMPILING.format(error=raised))
    assert done.returncode == 1, done.stderr
    assert done.stderr.startswith("Traceback")
    assert done.stderr.endswith(f"\n{error}\n")


def test_other_unraisable_exceptions_are_printed(tmp_path):
    source = COMMAND.format(what="Loses(); return 0")
    source = source.replace("signal.raise_signal(signal.SIGINT)", "1 / 0")
    done = python(tmp_path, "-c", source)
    assert done.returncode == 0
    assert "ZeroDivisionError" in done.stderr
