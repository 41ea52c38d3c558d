"""Two processes on one host train one policy, as two hosts would: by gloo, over localhost."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import pytest

from helpers import gliding
from helpers.command_modules import train
from helpers.further import slow_fixture
from jetbot_mjx.config import load_config
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs.checkpoint_store import checkpoint_steps
from jetbot_mjx.training import distributed
from jetbot_mjx.training.preemption import STOPPED

ROOT = Path(__file__).parents[2]
SMOKE = str(ROOT / "configs" / "smoke.yaml")
SIZE = load_config(SMOKE).ppo.steps_per_training_step
STEPS = 4
SETTINGS = [
    "--set",
    f"ppo.num_timesteps={STEPS * SIZE}",
    "--set",
    f"checkpoint_interval={2 * SIZE}",
    "--set",
    "evaluation.episodes=8",
]
STOCK = ["--set", "trainer=brax"]
VARIABLES = ("JAX_COORDINATOR_ADDRESS", "JAX_NUM_PROCESSES", "JAX_PROCESS_ID")


TASK = """
from jetbot_mjx import GoalTask
from sent_tools import NAME

class Sent(GoalTask):
    name = NAME
"""


# The other processes: the training command, one training step a call, telling what it holds.

TELLER = f"{gliding.LAZILY}; from helpers import distributed_process; distributed_process.main()"


def start(arguments, *, sent="-", **variables):
    environment = {name: value for name, value in os.environ.items() if name not in VARIABLES}
    return subprocess.Popen(
        [sys.executable, "-c", TELLER, sent, *map(str, arguments)],
        env={**environment, "JAX_PLATFORMS": "cpu", **variables},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def lines(run_dir):
    return [json.loads(line) for line in (run_dir / "metrics.jsonl").read_text().splitlines()]


class Ended:
    def __init__(self, process):
        try:
            self.out, self.err = process.communicate(timeout=240)
        finally:
            process.kill()
        self.code = process.returncode
        self.told = [json.loads(line) for line in re.findall(r"^told: (.*)$", self.out, re.M)]
        # Gloo, which a CPU's collectives use, prints lines of its own.
        self.said = re.sub(r"^(told: |\[Gloo\]|Failed to import ).*\n", "", self.out, flags=re.M)
        self.complained = re.sub(r"^\[Gloo\].*\n", "", self.err, flags=re.M)


@slow_fixture(scope="module")
def alone(tmp_path_factory):
    """The same training by one process with two devices, and the folder it left."""
    run_dir = tmp_path_factory.mktemp("distributed") / "alone"
    divided = ["--set", "cpu_devices=2"]
    ended = Ended(start(["--config", SMOKE, "--run-dir", run_dir, *SETTINGS, *divided]))
    assert ended.code == 0, ended.err
    return ended, run_dir


@pytest.fixture(scope="module")
def stopped(alone, unused_port):
    """Two processes, of which the second is asked to stop after the first training step."""
    _, run_dir = alone
    together = run_dir.with_name("together")
    port = unused_port()
    begun = [
        start(
            ["--config", SMOKE, "--distributed", *SETTINGS, "--run-dir", folder],
            sent="SIGTERM" if index == 1 else "-",
            JAX_COORDINATOR_ADDRESS=f"127.0.0.1:{port}",
            JAX_NUM_PROCESSES="2",
            JAX_PROCESS_ID=str(index),
        )
        # The second needs no folder, and makes none.
        for index, folder in enumerate([together, run_dir.with_name("nothing")])
    ]
    ended = [Ended(process) for process in begun]
    return ended, together, checkpoint_steps(together)


@pytest.fixture(scope="module")
def finished(stopped, unused_port):
    """Two processes, as Slurm would start them, that go on from there to the end."""
    _, run_dir, _ = stopped
    port = unused_port()
    begun = [
        start(
            ["--resume", run_dir, "--distributed"],
            SLURM_JOB_ID="1",
            SLURM_STEP_NODELIST="localhost",
            SLURM_NTASKS="2",
            SLURM_PROCID=str(index),
            SLURM_LOCALID=str(index),
            JAX_COORDINATOR_PORT=str(port),
        )
        for index in range(2)
    ]
    return [Ended(process) for process in begun], run_dir


@pytest.mark.slow
def test_a_signal_to_one_stops_all_at_the_same_step(stopped):
    (first, second), _, saved = stopped
    assert [first.code, second.code] == [STOPPED, STOPPED], first.err + second.err
    assert saved == [0, SIZE]
    assert "stopped; to resume: jetbot-mjx train --resume" in first.said
    assert "SIGTERM: finishing this step" in second.complained


@pytest.mark.slow
def test_only_the_first_prints_and_writes(stopped, finished):
    (first, second), run_dir, _ = stopped
    assert "on 2 x cpu of 2 processes" in first.said
    assert (second.said, first.complained) == ("", "")
    (first, second), _ = finished
    assert "last parameters: sha256" in first.said
    assert (second.said, second.complained, first.complained) == ("", "", "")
    assert not run_dir.with_name("nothing").exists()
    assert len(list((run_dir / "tensorboard").iterdir())) == 1
    assert {path.name for path in run_dir.iterdir()} == {
        *(".lock", "config.yaml", "versions.json"),
        *("train.log", "metrics.jsonl", "tensorboard", "checkpoints"),
    }


@pytest.mark.slow
def test_they_go_on_where_they_were_stopped(finished):
    (first, second), run_dir = finished
    assert (first.code, second.code) == (0, 0), first.err + second.err
    assert f"resuming after {SIZE:,} steps" in first.said
    assert checkpoint_steps(run_dir) == [0, SIZE, 2 * SIZE, 4 * SIZE]
    assert [line["env_steps"] for line in lines(run_dir)] == [0, 2 * SIZE, 4 * SIZE]


def test_all_hold_the_same_parameters_and_environments_of_their_own(stopped, finished):
    for first, second in (stopped[0], finished[0]):
        assert len(first.told) == len(second.told) > 0
        for one, other in zip(first.told, second.told, strict=True):
            assert one["devices"] == other["devices"] == [1, 2]
            assert one["parameters"] == other["parameters"]
            for name in ("keys", "goals"):
                assert len({tuple(x) for x in one[name] + other[name]}) == 128


def test_they_end_with_the_bits_of_one_process_on_two_devices(alone, finished):
    (first, _), run_dir = finished
    ended, run_dir_alone = alone
    assert first.told[-1] != ended.told[0]
    assert first.told[-1]["parameters"] == ended.told[-1]["parameters"]
    sums = [re.search(r"sha256 (\w+)", one.said)[1] for one in (first, ended)]
    assert sums[0] == sums[1]
    for ours, theirs in zip(lines(run_dir), lines(run_dir_alone), strict=True):
        assert {k: v for k, v in ours.items() if not k.startswith("time")} == {
            k: v for k, v in theirs.items() if not k.startswith("time")
        }


@pytest.mark.slow
def test_one_that_is_killed_ends_the_other_with_one_line_and_costs_no_bit(
    alone, unused_port, tmp_path
):
    run_dir = tmp_path / "run"

    def together(signals):
        port = unused_port()
        begun = [
            start(
                ["--config", SMOKE, "--distributed", *SETTINGS, "--run-dir", run_dir],
                sent=sent,
                JAX_COORDINATOR_ADDRESS=f"127.0.0.1:{port}",
                JAX_NUM_PROCESSES="2",
                JAX_PROCESS_ID=str(index),
            )
            for index, sent in enumerate(signals)
        ]
        second, began = Ended(begun[1]), time.monotonic()
        return Ended(begun[0]), second, time.monotonic() - began

    first, second, seconds = together(["-", "SIGKILL"])
    assert (first.code, second.code) == (2, -signal.SIGKILL), first.err
    assert seconds < 30
    (line,) = first.complained.splitlines()
    assert line.startswith("error: the device failed: ")
    assert f"`jetbot-mjx train --resume {run_dir}` continues it from there" in line
    first, _, _ = together(["-", "-"])
    assert first.code == 0, first.err
    sums = [re.search(r"sha256 (\w+)", one.said)[1] for one in (first, alone[0])]
    assert sums[0] == sums[1]


# One process by itself: nothing to wait for, and mistakes that cost one line.


@pytest.mark.slow
def test_a_process_without_the_task_and_the_run_trains_the_source_of_the_first(
    tmp_path, unused_port
):
    (tmp_path / "tasks").mkdir()
    (tmp_path / "tasks" / "sent_task.py").write_text(TASK)
    (tmp_path / "tasks" / "sent_tools.py").write_text("NAME = 'sent'\n")
    run_dirs = [tmp_path / "run", tmp_path / "elsewhere"]

    def train_together(num_steps, path):
        port = unused_port()
        settings = ["--set", "task.name=sent_task:Sent", "--set", "evaluation.episodes=4"]
        settings += ["--set", f"ppo.num_timesteps={num_steps * SIZE}"]
        begun = [
            start(
                ["--config", SMOKE, "--distributed", *settings, "--run-dir", folder],
                JAX_COORDINATOR_ADDRESS=f"127.0.0.1:{port}",
                JAX_NUM_PROCESSES="2",
                JAX_PROCESS_ID=str(index),
                **({"PYTHONPATH": path} if index == 0 else {}),
            )
            for index, folder in enumerate(run_dirs)
        ]
        return [Ended(process) for process in begun]

    # A new run, and its continuation where nobody has the module any more.
    with_task = os.pathsep.join([str(tmp_path / "tasks"), os.environ["PYTHONPATH"]])
    for num_steps, path in ((4, with_task), (8, os.environ["PYTHONPATH"])):
        first, second = train_together(num_steps, path)
        assert (first.code, second.code) == (0, 0), first.err + second.err
        assert second.said == ""
        assert second.complained == ""
    assert (run_dirs[0] / "task" / "sent_tools.py").is_file()
    assert not run_dirs[1].exists()


def test_alone_nothing_is_exchanged():
    assert distributed.is_primary()
    assert distributed.all_gather_ints(3, 4).tolist() == [[3, 4]]
    assert distributed.run_on_primary(lambda: 5) == 5


def heard(monkeypatch, index, said=0):
    """Plays one of two processes, the other of which says a number; returns what this one says."""
    told = []

    def gathered(values):
        told.append(values.tolist())
        other = np.full_like(values, said)
        return np.stack([values, other] if index == 0 else [other, values])

    monkeypatch.setattr(jax, "process_count", lambda: 2)
    monkeypatch.setattr(jax, "process_index", lambda: index)
    monkeypatch.setattr(distributed.multihost_utils, "process_allgather", gathered)
    return told


def test_the_others_do_what_the_first_came_to(monkeypatch):
    heard(monkeypatch, 1, said=1)
    assert distributed.run_on_primary(lambda: pytest.fail("only the first does it")) == 1


def test_all_processes_exit_when_the_first_fails(monkeypatch):
    told = heard(monkeypatch, 0)
    with pytest.raises(ZeroDivisionError):
        distributed.run_on_primary(lambda: 1 // 0)
    assert told == [[distributed._FAILED]]
    heard(monkeypatch, 1, said=distributed._FAILED)
    with pytest.raises(UserError, match="process 0 has failed"):
        distributed.run_on_primary(lambda: 0)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (
            ("localhost", "2", "0"),
            "JAX_COORDINATOR_ADDRESS = 'localhost' is wrong: write host:port",
        ),
        (("host:port", "2", "0"), "JAX_COORDINATOR_ADDRESS = 'host:port' is wrong"),
        (("host:70000", "2", "0"), "JAX_COORDINATOR_ADDRESS = 'host:70000' is wrong"),
        (("host:1234", "two", "0"), "JAX_NUM_PROCESSES = 'two' is wrong: it should be a whole"),
        (("host:1234", "0", "0"), "JAX_NUM_PROCESSES = 0 is wrong: there is at least one"),
        (("host:1234", "2", "-1"), "JAX_PROCESS_ID = '-1' is wrong: it should be a whole number"),
        (("host:1234", "2", "2"), "JAX_PROCESS_ID = 2 is wrong: 2 processes count from 0 to 1"),
        (("host:1234", "2", None), "JAX_PROCESS_ID is missing"),
        (("host:1234", None, "1"), "JAX_NUM_PROCESSES is missing"),
        ((None, "2", "1"), "JAX_COORDINATOR_ADDRESS is missing: give host:port of process 0"),
    ],
)
def test_a_mistaken_variable_costs_one_line(monkeypatch, values, said):
    for name, value in zip(VARIABLES, values, strict=True):
        monkeypatch.delenv(name, raising=False)
        if value is not None:
            monkeypatch.setenv(name, value)
    with pytest.raises(UserError) as caught:
        train.main(["--config", SMOKE, "--distributed"])
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--seeds", "2"], "--distributed trains one policy, not seeds = 2"),
        (STOCK, "--distributed is not supported by trainer = 'brax'"),
    ],
)
def test_unsupported_settings_of_several_processes_are_refused_before_they_connect(arguments, said):
    with pytest.raises(UserError, match=said):
        train.main(["--config", SMOKE, "--distributed", *arguments])


def test_without_a_launcher_the_variables_are_named(monkeypatch):
    def initialize(*args, **kwargs):
        raise ValueError("coordinator_address should be defined.")

    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(jax.distributed, "initialize", initialize)
    with pytest.raises(UserError, match=", ".join(VARIABLES[:1])) as caught:
        train.main(["--config", SMOKE, "--distributed"])
    assert all(name in str(caught.value) for name in VARIABLES)


def test_processes_that_do_not_come_are_not_waited_for_without_end(tmp_path, unused_port):
    program = (
        "from jetbot_mjx.training import distributed as d; d.JOIN_SECONDS = 1; d.join_processes()"
    )
    process = subprocess.run(
        [sys.executable, "-c", program],
        cwd=tmp_path,
        env={
            **os.environ,
            **dict(zip(VARIABLES, (f"127.0.0.1:{unused_port()}", "2", "1"), strict=True)),
        },
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert process.returncode == 2
    assert len(process.stderr.splitlines()) == 1
    assert "not all processes have connected at 127.0.0.1" in process.stderr
    assert "within 1 s" in process.stderr
