"""A training that is asked to stop saves in time in every phase, and resumes."""

import contextlib
import itertools
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from benchmarks.reliability import torture
from helpers import gliding
from helpers.further import slow_fixture
from helpers.preemption_program import LISTENER
from jetbot_mjx.runs.checkpoint_store import checkpoint_path, checkpoint_steps
from jetbot_mjx.training.preemption import STOPPED, Preemption

LONG = 3_600
PATIENCE = 300

INTERVAL = 8_192
"""Environment steps between two checkpoints: two training steps."""
SETTINGS = (
    *torture.SETTINGS,
    f"checkpoint_interval={INTERVAL}",
    f"ppo.num_timesteps={4 * INTERVAL}",
)

TRAINER = gliding.program("train")

# The same trainer, which tells when it comes to a moment, and stays there for a while.
DRIVER = """
import sys, time

sys.path.append({tests})

def now(moment, seconds):
    print("now:", moment, flush=True)
    time.sleep(seconds)

def dwell(owner, name, seconds):
    original = getattr(owner, name)
    def wrapper(*args, **kwargs):
        now(name, seconds)
        return original(*args, **kwargs)
    setattr(owner, name, wrapper)

def dwell_in_calls(seconds):
    def compile(self, original=CompiledTrainer.compile):
        self.call = original(self)
        dwell(self, "call", seconds)
        return self.call
    CompiledTrainer.compile = compile

{before_imports}
{lazily}
from helpers import gliding
from helpers.command_modules import train
from jetbot_mjx import cli
from jetbot_mjx.training import session as training
from jetbot_mjx.runs import setup
from jetbot_mjx.evaluation.evaluator import Evaluator
from jetbot_mjx.training.ppo_trainer import CompiledTrainer
from jetbot_mjx.runs.checkpoint_store import CheckpointStore
{before_training}
with gliding.everywhere():
    cli.run_command(train.main, at_once=True)
"""


def driver(before_training="", before_imports=""):
    program = DRIVER.replace("{tests}", repr(str(Path(__file__).parents[1])))
    program = program.replace("{before_training}", before_training)
    program = program.replace("{lazily}", gliding.LAZILY)
    program = program.replace("{before_imports}", before_imports)
    return ["-c", program]


def training(run_dir, before_training="", before_imports="", notice=300):
    program = driver(before_training, before_imports)
    return torture.Process(run_dir, [*SETTINGS, f"preemption_notice={notice}"], program)


def finish(run_dir):
    return torture.finish(run_dir, SETTINGS, TRAINER)


def stop(process, moment, number=signal.SIGTERM):
    """Sends the signal at that moment, and gives the exit code."""
    process.until(lambda: f"now: {moment}\n" in process.stdout)
    process.send(number)
    return process.wait()


SAVING = "finishing this step and saving (once more to leave without saving)"


def assert_saved_and_gone(process, code, number=signal.SIGTERM, doing=SAVING):
    assert code == STOPPED, process.stderr
    assert process.stderr == (f"\n{number.name}: {doing}\n")
    last = process.stdout.splitlines()[-1]
    assert last == f"stopped; to resume: jetbot-mjx train --resume {process.run_dir}"
    assert (process.run_dir / "train.log").read_text().endswith(f"  {last}\n")
    assert process.unfinished == set()


@slow_fixture(scope="module")
def undisturbed_run(tmp_path_factory):
    return tmp_path_factory.mktemp("preemption") / "undisturbed"


@pytest.fixture(scope="module")
def undisturbed(undisturbed_run):
    return finish(undisturbed_run)


@pytest.fixture
def begun(undisturbed, undisturbed_run, tmp_path):
    """The folder of a training that was stopped after its first interval."""
    run_dir = shutil.copytree(undisturbed_run, tmp_path / "begun")
    for steps in checkpoint_steps(run_dir):
        if steps > INTERVAL:
            shutil.rmtree(checkpoint_path(run_dir, steps))
    return run_dir


def test_while_importing_the_signal_ends_the_process_and_nothing_is_written(tmp_path):
    with training(tmp_path / "run", before_imports=f"now('imports', {LONG})") as process:
        assert stop(process, "imports") == -signal.SIGTERM
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_before_there_is_a_folder_the_signal_ends_the_process(tmp_path):
    with training(tmp_path / "run", f"dwell(setup.envs, 'make_env', {LONG})") as process:
        assert stop(process, "make_env") == -signal.SIGTERM
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_compiling_before_the_first_checkpoint_it_does_not_wait_for_the_compiler(tmp_path):
    with training(tmp_path / "run", f"dwell(Evaluator, 'run', {LONG})") as process:
        process.until(lambda: "now: run\n" in process.stdout)
        began = time.monotonic()
        process.send(signal.SIGINT)
        assert process.wait() == STOPPED
    assert time.monotonic() - began < 2.0
    told = "stopped before the first checkpoint: the same command starts from the beginning"
    assert process.stderr == f"\nSIGINT: ending\n{told}\n"
    assert (tmp_path / "run" / "train.log").read_text().endswith(f"  {told}\n")
    assert checkpoint_steps(tmp_path / "run") == []


@pytest.mark.slow
def test_compiling_after_a_checkpoint_it_does_not_wait_for_the_compiler(begun):
    with training(begun, f"dwell(CompiledTrainer, 'compile', {LONG})") as process:
        code = stop(process, "compile")
    assert_saved_and_gone(process, code, doing="ending")
    assert checkpoint_steps(begun) == [0, INTERVAL]


@pytest.mark.slow
@pytest.mark.parametrize(
    "number", [signal.SIGTERM, pytest.param(signal.SIGINT, marks=pytest.mark.slow)]
)
def test_between_two_reports_it_saves_where_it_is_and_goes_on(number, begun, undisturbed):
    with training(begun, "dwell_in_calls(1)") as process:
        code = stop(process, "call", number)
    assert_saved_and_gone(process, code, number)
    assert checkpoint_steps(begun) == [0, INTERVAL, INTERVAL + INTERVAL // 2]
    if number == signal.SIGTERM:
        assert torture.differences(undisturbed, finish(begun)) == []


@pytest.mark.slow
def test_while_evaluating_it_finishes_that_and_saves(begun):
    with training(begun, "dwell(Evaluator, 'run', 1)") as process:
        code = stop(process, "run")
    assert_saved_and_gone(process, code)
    assert checkpoint_steps(begun) == [0, INTERVAL, 2 * INTERVAL]


def test_while_saving_it_finishes_that(begun):
    with training(begun) as process:
        process.until(lambda: process.unfinished)
        process.send(signal.SIGTERM)
        code = process.wait()
    assert_saved_and_gone(process, code)
    assert 2 * INTERVAL in checkpoint_steps(begun)


@pytest.mark.slow
def test_a_save_longer_than_the_notice_is_aborted(begun):
    notice = 10
    with training(begun, f"dwell(Evaluator, 'run', {LONG})", notice=notice) as process:
        process.until(lambda: "now: run\n" in process.stdout)
        began = time.monotonic()
        process.send(signal.SIGTERM)
        assert process.wait() == STOPPED
    assert time.monotonic() - began < notice
    assert "8 s after SIGTERM: leaving without another save" in process.stderr
    assert "Traceback" not in process.stderr
    # What it goes on from, as all that begin with this folder do.
    assert checkpoint_steps(begun) == [0, INTERVAL]
    assert process.unfinished == set()


UNREAD = "standard output cannot be written: the training goes on"


def unread(run_dir, program):
    """Starts a training whose only reader leaves after the first line."""
    arguments = ["--config", str(torture.CONFIG), "--run-dir", str(run_dir)]
    for setting in SETTINGS:
        arguments += ["--set", setting]
    process = subprocess.Popen(
        [sys.executable, *program, *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    )
    process.stdout.readline()
    process.stdout.close()
    return process


@pytest.mark.slow
def test_a_training_goes_on_without_a_reader(begun, undisturbed):
    with unread(begun, TRAINER) as process:
        assert process.wait(PATIENCE) == 0
    told = (begun / "train.log").read_text()
    assert told.count(UNREAD) == 1
    assert f"sha256 {undisturbed.fingerprint}" in told


def test_ctrl_c_saves_where_the_reader_ends_by_it_too(begun):
    # As in `train 2>&1 | tee log`.
    with unread(begun, driver("dwell_in_calls(1)")) as process:
        deadline = time.monotonic() + PATIENCE
        while 2 * INTERVAL not in checkpoint_steps(begun):
            assert time.monotonic() < deadline
            time.sleep(0.05)
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE) == STOPPED
    assert checkpoint_steps(begun)[-1] > 2 * INTERVAL
    last = f"stopped; to resume: jetbot-mjx train --resume {begun}\n"
    assert (begun / "train.log").read_text().endswith(last)


# What follows needs the module alone, and no training.


def listen(program, notice=300, stderr=subprocess.PIPE):
    """Runs lines of Python under `Preemption`; gives the exit code, the seconds and stderr."""
    lines = [f"with preemption.Preemption({notice}) as asked:", *program.splitlines()]
    process = subprocess.Popen(
        [sys.executable, "-c", LISTENER + "\n    ".join(lines)],
        stdout=subprocess.PIPE,
        stderr=stderr,
        text=True,
    )
    with process:
        try:
            assert process.stdout.readline() == "listening\n"
            began = time.monotonic()
            _, told = process.communicate(timeout=PATIENCE)
        finally:
            process.kill()
    return process.returncode, time.monotonic() - began, told


UNWRITABLE = ("full", "nobody reads", "nobody reads on")
SECOND = {"second signal": "send()", "notice": ""}


@contextlib.contextmanager
def unwritable(kind):
    """Standard error that takes nothing: at the end of a full pipe a write waits for ever."""
    reader, writer = os.pipe()
    if kind == "full":
        os.close(writer)
        writer = os.open("/dev/full", os.O_WRONLY)
    elif kind == "nobody reads on":
        os.set_blocking(writer, False)
        with contextlib.suppress(BlockingIOError):
            while True:
                os.write(writer, bytes(1))
        os.set_blocking(writer, True)
    else:
        os.close(reader)
        reader = os.dup(writer)
    yield writer
    os.close(reader)
    os.close(writer)


@pytest.fixture(scope="module")
def left():
    """How processes left whose standard error takes nothing, all of which wait at the same time."""

    def leave(second, kind):
        send = SECOND[second]
        program = (
            f"print('listening', flush=True)\nsend()\ntime.sleep(1)\n{send}\ntime.sleep({LONG})"
        )
        with unwritable(kind) as stderr:
            return listen(program, notice=300 if send else 5, stderr=stderr)

    cases = [*itertools.product(SECOND, UNWRITABLE)]
    with ThreadPoolExecutor(len(cases)) as pool:
        return dict(zip(cases, pool.map(leave, *zip(*cases, strict=True)), strict=True))


@pytest.mark.parametrize("second", SECOND)
@pytest.mark.parametrize("kind", UNWRITABLE)
def test_it_leaves_in_time_where_stderr_cannot_be_written(left, kind, second):
    code, seconds, _ = left[second, kind]
    assert code == STOPPED
    assert seconds < 5.5


@pytest.mark.parametrize("first", ["SIGTERM", "SIGHUP"])  # the latter of a terminal that is closed
def test_a_second_signal_exits_at_once(first):
    code, _, stderr = listen(
        f"print('listening', flush=True)\nsend(signal.{first})\n"
        f"time.sleep(1)\nsend()\ntime.sleep({LONG})"
    )
    assert code == STOPPED
    assert f"{first}: finishing this step and saving" in stderr
    assert stderr.splitlines()[-1].startswith("second SIGTERM: leaving without another save")


def test_the_same_signal_twice_over_is_one():
    code, _, stderr = listen(
        "print('listening', flush=True)\nsend()\nsend()\nsend(signal.SIGINT)\n"
        "asked.wait(60)\ntime.sleep(1)\nos._exit(3)"
    )
    assert code == 3
    assert len(re.findall("finishing this step", stderr)) == 1


def test_the_clock_runs_while_the_main_thread_is_inside_a_c_function():
    notice = 2.5
    code, seconds, stderr = listen(
        """\
import threading
threading.Timer(0.1, send).start()
print('listening', flush=True)
hashlib.pbkdf2_hmac('sha256', b'', b'salt', 2**31 - 1)""",
        notice,
    )
    assert code == STOPPED
    assert seconds < notice + 0.5
    assert "2 s after SIGTERM: leaving" in stderr


def test_a_very_long_notice_is_accepted():
    code, _, stderr = listen(
        "print('listening', flush=True)\nsend()\nasked.wait(60)\ntime.sleep(0.5)\nos._exit(3)",
        notice=1e308,
    )
    assert code == 3
    assert len(stderr.strip().splitlines()) == 1


def test_another_signal_with_a_handler_is_no_wish_to_stop():
    code, _, stderr = listen(
        """\
signal.signal(signal.SIGUSR1, lambda *_: None)
print('listening', flush=True)
send(signal.SIGUSR1)
os._exit(3 if not asked.wait(1) else 4)"""
    )
    assert (code, stderr) == (3, "")


def test_no_clock_outlives_the_training():
    code, _, _ = listen(
        """\
import threading
class Late(threading.Timer):
    def __init__(self, *args):
        time.sleep(0.5)
        super().__init__(*args)
threading.Timer = Late
print('listening', flush=True)
with preemption.Preemption(2) as inner:
    send()
    inner.wait(60)
time.sleep(4)
os._exit(3)"""
    )
    assert code == 3


def handlers():
    wakeup = signal.set_wakeup_fd(-1)
    signal.set_wakeup_fd(wakeup)
    return [signal.getsignal(signal.SIGTERM), signal.getsignal(signal.SIGINT), wakeup]


@pytest.fixture
def former():
    """A handler and a wakeup file of somebody else's, put in place; gives what `handlers` says."""
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    handler = signal.signal(signal.SIGTERM, lambda number, frame: None)
    wakeup = signal.set_wakeup_fd(writer)
    yield handlers()
    signal.set_wakeup_fd(wakeup)
    signal.signal(signal.SIGTERM, handler)
    os.close(reader)
    os.close(writer)


@pytest.mark.parametrize("error", [None, ValueError])
def test_former_handlers_are_put_back(error, former):
    threads = threading.active_count()
    with pytest.raises(error) if error else contextlib.nullcontext(), Preemption(60) as asked:
        assert all(now != then for now, then in zip(handlers(), former, strict=True))
        signal.raise_signal(signal.SIGTERM)
        assert asked.wait(PATIENCE)
        assert asked.requested
        if error:
            raise error
    assert handlers() == former
    deadline = time.monotonic() + PATIENCE
    while threading.active_count() > threads:
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_outside_the_main_thread_it_does_nothing():
    seen = []

    def work():
        before = handlers_by_name()
        with Preemption(60) as asked:
            seen.append(handlers_by_name() == before)
            seen.append(asked.requested)
        seen.append(handlers_by_name() == before)

    def handlers_by_name():
        return [signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGINT)]

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [True, False, True]
