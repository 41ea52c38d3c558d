"""Mistakes of users that were once tracebacks: each is one line now."""

import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import jax
import pytest

from helpers.command_modules import COMMANDS, SMOKE, evaluate, render
from helpers.damage import damage_about
from helpers.tensorboard_files import read_events
from jetbot_mjx import cli, devices
from jetbot_mjx.config import load_config, parse_config
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs import Setup
from jetbot_mjx.runs.metrics import TensorBoardSink
from jetbot_mjx.runs.run_dir import stored_config
from jetbot_mjx.training import ppo_trainer

HEX = "0x" + "f" * 5000
"""An integer that Python parses, but refuses to print for its length."""


def laughs(levels, alias=", &a{n} [{list}]", first="&a0 [x, x]"):
    """Aliases of aliases: each level stands for nine times as many values as the one before."""
    lists = (", ".join([f"*a{n - 1}"] * 9) for n in range(1, levels))
    return first + "".join(alias.format(n=n, list=one) for n, one in enumerate(lists, start=1))


MERGED = laughs(9, ", &a{n} {{<<: [{list}]}}", "&a0 {x: 1}")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("physics: {sim_dt: 5e-324}", "physics"),  # OverflowError
        ("physics: {ctrl_dt: 1e300, sim_dt: 1e-5}", "physics"),  # a scan of 1e305 steps
        ("physics: {sim_dt: 1e-9}", "sim_dt"),  # settling takes hours
        ("ppo: {num_envs: 1000000000000}", "ppo.num_envs = 1000000000000 is wrong"),
        ('ppo: {"a\\nb": 1}', "is unknown"),
        (f"seed: {'9' * 5000}", "a number has too many digits"),  # ValueError
        (f"seed: {HEX}", "seed = (a number of 6,021 digits) is wrong"),  # ValueError
        (f"randomization: {{mass: [1, {HEX}]}}", "mass = [1, (a number of 6,021 digits)] is wrong"),
        (f"task: {{options: {{a: {HEX}}}}}", "task.options.a = (a number of 6,021 digits) is"),
        (f"seed: {'x' * 50_000}", "seed = 'xxx"),
        (f"{'x' * 1000}: 1", "is unknown: known are seed"),
        (f"seed: !!bool {'x' * 50_000}", "is not valid YAML"),
        (f"seed: [{laughs(4)}]", "seed = [['x', 'x'], [['x', 'x'], ['x', 'x'], ['x', 'x']"),
        (
            f"seed: [{laughs(12)}]",
            "is not valid YAML: its aliases stand for more than 100,000",
        ),
        (f"seed: [{MERGED}]", "is not valid YAML: its aliases stand for more than 100,000"),
        ("seed: [&a 1, &a 2]", "seed = [1, 2] is wrong"),
        ("seed: &a [*a]", "is not valid YAML: its aliases stand for more than 100,000"),
        (f"wandb: '{'/' * 50_000}'", "is not a project name"),
        (f"ppo: {{network: {{policy_hidden_layer_sizes: {[8] * 101}}}}}", "at most 100 items"),
        ("seed: !!int x", "is not valid YAML"),  # ValueError
        ("seed: !!bool x", "is not valid YAML"),  # KeyError
        (f"seed: {'[' * 3000}", "is nested too deeply"),  # RecursionError
        ("ppo: {network: {policy_hidden_layer_sizes: 32}}", "it should be a list"),
        ("ppo: {network: {policy_hidden_layer_sizes: []}}", "should have at least 1 item"),
        ("ppo: {1: 2}", "is not a key: keys should be strings"),
        ("camera: {position: [0, 0]}", "camera.position = [0, 0] is wrong: it lacks items"),
        ("task: {options: {a: [1]}}", "task.options.a = [1] is wrong"),
    ],
)
def test_config(refusal, text, said):
    message = refusal(text)
    assert said in message
    assert len(message) < 1000


@pytest.mark.parametrize("override", [f"seed={HEX}", f"ppo={{a: {HEX}}}", f"seed={'x' * 9000}"])
def test_overrides(refusal, override):
    assert len(refusal("", override)) < 1000


def test_a_setting_of_a_resumed_run_is_shown_in_a_line():
    then, now = (parse_config({"init_from": name * 50_000}) for name in "ab")
    with pytest.raises(UserError) as caught:
        then.check_resume(now)
    assert len(str(caught.value)) < 1000


def test_a_message_cannot_command_the_terminal():
    said = str(UserError("run \x1b[31m\u202e\udcff\x07\nnext\tü 5 µm"))
    assert said == r"run \x1b[31m\u202e\udcff\x07 next\tü 5 µm"


def test_a_result_cannot_command_the_terminal(capsys):
    cli.tell("one\x1b[31m\ntwo\r")
    assert capsys.readouterr().out == "one\\x1b[31m\ntwo\\r\n"


@pytest.mark.parametrize(
    "name",
    [
        ".task:GoalTask",
        "..:GoalTask",
        "jetbot_mjx.envs.task:WORLD",
        "jetbot_mjx.envs.task:math",
        "jetbot_mjx.envs.task:Field",
        "jetbot_mjx.envs.task:Task",
        "jetbot_mjx.envs.jetbot_env:JetBotEnv",
        "jetbot_mjx.config:TaskConfig",
        "os:getcwd",
    ],
)
def test_tasks(name):
    with pytest.raises(UserError, match=rf"task\.name( =|:) {re.escape(repr(name))}"):
        make_env(parse_config({"task": {"name": name}}))


@pytest.mark.parametrize("preset", ["isaac", "real"])
@pytest.mark.parametrize("dt", [0.018, 0.1, 0.5, 10.0])
def test_unstable_time_steps(preset, dt):
    values = {"robot": {"preset": preset}, "physics": {"ctrl_dt": dt, "sim_dt": dt}}
    with pytest.raises(UserError, match=r"physics\.sim_dt = "):
        make_env(parse_config(values))


@pytest.mark.parametrize(
    ("command", "arguments"),
    [
        ("train", ["--config", "a\nb"]),
        ("train", ["--config", SMOKE, "--set", "a\nb=3"]),
        ("train", ["--config", SMOKE, "--set", "seed=[\n"]),
        ("train", ["--config", SMOKE, "--nonsense\nb"]),
        ("train", ["--config", SMOKE, "--run-dir", "x" * 300]),
        ("evaluate", ["a\nb"]),
        ("evaluate", ["x" * 300]),
        ("evaluate", ["run", "--min-success", "2\n"]),
    ],
)
def test_command_line(refused, command, arguments):
    refused(COMMANDS[command], *arguments)


def test_a_checkpoint_of_more_digits_than_python_reads_is_refused(refused):
    assert "is neither best, last nor a number" in refused(
        evaluate, "run", "--checkpoint", "9" * 5000
    )


def test_a_seed_of_32_bits_trains(root):
    config = load_config(root / "configs" / "smoke.yaml", ["seed=3000000000", "seeds=2"])
    seeds = ppo_trainer.CompiledTrainer.from_setup(Setup(config))._seeds
    keys = [jax.random.PRNGKey(seed) for seed in (3_000_000_000, 3_000_000_001)]
    assert jax.vmap(jax.random.PRNGKey)(seeds).tolist() == [key.tolist() for key in keys]


def test_a_terminal_without_utf8_gets_plain_characters(tmp_path):
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            "from jetbot_mjx import cli\ncli.run_command(lambda _: print('r\\xfcn \\udcff') or 0)",
        ],
        cwd=tmp_path,
        env={**os.environ, "PYTHONIOENCODING": "ascii"},
        capture_output=True,
        text=True,
    )
    assert (done.returncode, done.stdout) == (0, "r\\xfcn \\udcff\n")


def test_more_episodes_than_can_be_counted_are_refused(refused):
    assert "argument --episodes" in refused(evaluate, "run", "--episodes", "9" * 24)


@pytest.mark.parametrize("command", [evaluate, render], ids=["evaluate", "render"])
@pytest.mark.parametrize(
    "change",
    [
        lambda about: about.update(layout=about["layout"][::-1]),
        lambda about: about.pop("layout"),
        lambda about: about.pop("env_steps"),
    ],
)
def test_checkpoint_of_another_task(refused, damaged, command, change):
    damage_about(change)(damaged)
    refused(command, damaged, "--episodes", "1")


@pytest.mark.parametrize(
    ("command", "folder"), [(evaluate, "evaluations"), (render, "videos")], ids=str
)
def test_results_that_cannot_be_written(refused, damaged, command, folder):
    (damaged.parents[1] / folder).write_text("a file where a folder should be")
    refused(command, damaged, "--episodes", "1")


@pytest.mark.parametrize("sizes", [[5], [4, 4]])
@pytest.mark.parametrize("command", [evaluate, render], ids=["evaluate", "render"])
def test_other_layers(refused, damaged, command, sizes):
    network = {"policy_hidden_layer_sizes": sizes}
    damage_about(lambda about: about["config"]["ppo"]["network"].update(network))(damaged)
    assert "cannot be read: policy.params.hidden_" in refused(command, damaged)


def test_a_stray_folder_among_the_checkpoints_does_not_matter(refused, damaged):
    (damaged.parent / "²" / "policy").mkdir(parents=True)
    refused(evaluate, damaged.parents[1], "--checkpoint", "123")


@pytest.mark.slow
def test_missing_parameters_cost_one_line(damaged):
    shutil.rmtree(damaged / "policy" / "d")
    process = subprocess.run(
        [sys.executable, "-m", "jetbot_mjx.evaluate", str(damaged)],
        capture_output=True,
        text=True,
    )
    assert (process.returncode, len(process.stderr.splitlines())) == (2, 1)


def test_a_platform_that_is_not_there_costs_one_line(tmp_path):
    process = subprocess.run(
        [sys.executable, "-m", "jetbot_mjx.train", "--config", SMOKE],
        cwd=tmp_path,
        env={**os.environ, "JAX_PLATFORMS": "nowhere"},
        capture_output=True,
        text=True,
    )
    assert (process.returncode, len(process.stderr.splitlines())) == (2, 1)
    assert "JAX_PLATFORMS = 'nowhere'" in process.stderr


def test_too_little_memory_costs_one_line(capfd):
    def command(_):
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory\nallocating")

    with pytest.raises(SystemExit) as caught:
        cli.run_command(command)
    assert caught.value.code == 2
    assert len(capfd.readouterr().err.splitlines()) == 1


@pytest.mark.parametrize(
    ("owner", "method", "use"),
    [
        (Path, "exists", lambda: stored_config(Path("run"))),
        (os, "listdir", lambda: stored_config(Path(__file__).parent)),
        (Path, "is_dir", lambda: evaluate.main(["run"])),
    ],
)
def test_a_forbidden_path_costs_one_line(monkeypatch, owner, method, use):
    def deny(path, **kwargs):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(owner, method, deny)
    # Denied its folder, JAX would do without one in all later tests.
    monkeypatch.setattr(devices, "use_compilation_cache", lambda: None)
    with pytest.raises(UserError, match="Permission denied"):
        use()


def test_tensorboard_can_be_read_while_training_runs(tmp_path):
    sink = TensorBoardSink(tmp_path / "tensorboard")
    for env_steps in range(20):
        sink.write(env_steps, {"loss/total": 1.5})
    deadline = time.monotonic() + 10
    while len(read_events(tmp_path / "tensorboard")) < 20 and time.monotonic() < deadline:
        time.sleep(0.1)
    seen = len(read_events(tmp_path / "tensorboard"))
    sink.close()
    assert seen == 20
