"""The command line: a user's mistake costs one line and exit code 2, and leaves nothing behind."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import orbax.checkpoint as ocp
import pytest

from helpers.command_modules import COMMANDS, SMOKE, evaluate, render, train
from helpers.damage import damage_about
from helpers.reports import make_episodes, make_report
from jetbot_mjx import cli, evaluation, training
from jetbot_mjx.config import shipped_configs
from jetbot_mjx.errors import UserError

FILE_OR_NAME = f"give a file, or one of {', '.join(shipped_configs())}"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "name a configuration, as in `train jetbot`, or a run to --resume"),
        (["--config", SMOKE, "--resume", "run"], "--resume: not allowed with argument --config"),
        (
            ["--resume", "run", "--run-dir", "run"],
            "--run-dir: --resume continues that run, in its folder",
        ),
        (["--config", SMOKE, "--seeds", "x"], "argument --seeds: 'x' is not a whole number"),
        (["--config"], "argument --config: expected one argument"),
        (["--config", SMOKE, "more"], "argument CONFIG: not allowed with argument --config"),
        (["--set", "seeds=2", "seed=3", "--config", SMOKE], "seed=3: did you mean --seed 3?"),
        (["--config", SMOKE, "--set", "seeds=2", "ppo.unroll_length=3"], "mean --set ppo.unroll_"),
        (["wandb=true"], "unrecognized arguments: wandb=true: did you mean --set wandb=true?"),
        (["--config", SMOKE, "--lr", "1"], "unrecognized arguments: --lr"),
        (["--config", SMOKE, "--set"], "argument --set: expected one argument"),
        (["--config", SMOKE, "--seed", "x"], "argument --seed: 'x' is not a whole number"),
    ],
)
def test_train_refuses_a_mistaken_command_line(refused, arguments, said):
    line = refused(train, *arguments)
    assert line.startswith("jetbot-mjx train: error: ")
    assert said in line
    assert "(--help lists the arguments)" in line


BAD_FILES = {
    "typo.yaml": ("ppo: {num_env: 3}", "ppo.num_env = 3 is unknown: did you mean ppo.num_envs?"),
    "twice.yaml": ("seed: 1\nseed: 2", "line 2 is not valid YAML: found duplicate key"),
    "open.yaml": ("ppo: [", "line 1 is not valid YAML"),
    "list.yaml": ("- seed", "holds ['seed']: write `key: value` lines"),
    "binary.yaml": ("\udcff\x00", "it is not UTF-8 text"),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_train_refuses_a_bad_file(refused, tmp_path, name):
    text, said = BAD_FILES[name]
    (tmp_path / name).write_text(text, encoding="utf-8", errors="surrogateescape")
    line = refused(train, "--config", tmp_path / name)
    assert line.startswith("error: ")
    assert str(tmp_path / name) in line
    assert said in line


@pytest.mark.parametrize(
    ("path", "said"),
    [
        ("nonsense.yaml", f"config nonsense.yaml does not exist: {FILE_OR_NAME}"),
        (".", "config . is a folder: give a YAML file"),
        ("", "config . is a folder: give a YAML file"),
    ],
)
def test_train_refuses_a_path_without_a_file(refused, path, said):
    assert refused(train, "--config", path) == f"error: {said}\n"


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("seed", "--set seed: write section.key=value, as in ppo.num_envs=256"),
        ("ppo.num_envs.x=3", "--set ppo.num_envs.x=3: num_envs is a value, not a section"),
        ("seed=[", "--set seed=[, line 1 is not valid YAML"),
        ("zzz=1", "zzz = 1 is unknown: known are seed"),
        ("ppo.num_envs=many", "ppo.num_envs = 'many' is wrong: it should be a whole number"),
        ("ppo.num_envs=-1", "ppo.num_envs = -1 is wrong: it should be greater than or equal to 1"),
        ("ppo.num_envs=100", "is not a multiple of num_envs = 100: for example batch_size = 75"),
        ("ppo.discounting=1.5", "ppo.discounting = 1.5 is wrong"),
        ("ppo.learning_rate=.nan", "learning_rate = nan is wrong: it should be a finite number"),
        ("ppo.network=3", "ppo.network = 3 is not a section: set ppo.network.policy_hidden"),
        ("physics.sim_dt=0.01", "for example sim_dt = 0.00833333333"),
        ("checkpoint_interval=100", "make it at least 4096"),
        ("checkpoints_to_keep=0", "checkpoints_to_keep = 0 is wrong"),
        ("preemption_notice=1", "preemption_notice = 1 is wrong: it should be greater than or eq"),
        ("stop_at_success=99", "stop_at_success = 99 is wrong: it should be less than or equal"),
        ("wandb=true", "wandb: True is not a project name: write one, such as jetbot"),
        ("seeds=0", "seeds = 0 is wrong: it should be greater than or equal to 1"),
        ("trainer=stock", "trainer = 'stock' is wrong: it should be 'resumable' or 'brax'"),
        ("ppo.learning_rate_schedule=COSINE", "it should be 'NONE', 'LINEAR' or 'ADAPTIVE_KL'"),
        ("task.name=GoalTask", "task.name: 'GoalTask' is wrong: write file.py:Class"),
        ("task.name=nowhere:Task", "there is no nowhere.py beside the YAML file or in"),
        ("task.name=jetbot_mjx:GaolTask", "jetbot_mjx has no 'GaolTask'"),
        ("task.name=builtins:str", "is not a task: it lacks "),
    ],
)
def test_train_refuses_a_bad_setting(refused, setting, said):
    line = refused(train, "--config", SMOKE, "--set", "ppo.num_minibatches=4", "--set", setting)
    assert line.startswith("error: ")
    assert said in line


def test_train_refuses_a_bad_seed(refused):
    said = "argument --seed: -1 is too small: give at least 0"
    assert said in refused(train, "--config", SMOKE, "--seed", "-1")


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("seeds=2", "seeds = 2 is not supported by trainer = 'brax'"),
        ("deterministic=true", "deterministic = true is not supported by trainer = 'brax'"),
        (
            "ppo.normalizer=physical",
            "ppo.normalizer = 'physical' is not supported by trainer = 'brax'",
        ),
    ],
)
def test_train_refuses_what_the_stock_trainer_cannot_do(refused, setting, said):
    stock = ("--set", "trainer=brax")
    assert said in refused(train, "--config", SMOKE, *stock, "--set", setting)


@pytest.mark.parametrize("run", ["nothing", "empty"])
def test_train_refuses_to_resume_without_a_run(refused, here, run):
    (here / "empty").mkdir()
    remedy = "give a run folder"
    line = refused(train, "--resume", run)
    assert line == f"error: --resume {run}: there is no run in this folder; {remedy}\n"


def test_train_refuses_environments_that_the_devices_cannot_share(refused, monkeypatch):
    monkeypatch.setattr(jax, "device_count", lambda: 3)
    assert "ppo.num_envs = 128 cannot be shared evenly by 3 devices" in refused(
        train, "--config", SMOKE
    )


def test_train_refuses_a_run_folder_in_use(refused, here):
    (here / "run").mkdir()
    (here / "run" / "metrics.jsonl").write_text("precious")
    line = refused(train, "--config", SMOKE, "--run-dir", "run")
    assert "run exists and holds no run (no config.yaml): name a new folder" in line
    assert (here / "run" / "metrics.jsonl").read_text() == "precious"


@pytest.mark.parametrize(
    ("run_dir", "said"),
    [
        ("file", "--run-dir file exists and holds no run (no config.yaml): name a new folder"),
        ("file/run", "--run-dir file/run cannot be written: Not a directory"),
    ],
)
def test_train_refuses_a_run_folder_that_cannot_be_written(refused, here, run_dir, said):
    (here / "file").write_text("precious")
    assert refused(train, "--config", SMOKE, "--run-dir", run_dir) == f"error: {said}\n"
    assert (here / "file").read_text() == "precious"


# evaluate and render find their policy in the same way.


both = pytest.mark.parametrize("command", [evaluate, render], ids=["evaluate", "render"])


@both
@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "arguments are required: RUN: `jetbot-mjx runs` lists the runs, and latest is"),
        (["run", "--more"], "unrecognized arguments: --more"),
        (["run", "--episodes", "0"], "argument --episodes: 0 is too small: give at least 1"),
        (["run", "--episodes", "-3"], "argument --episodes: -3 is too small: give at least 1"),
        (["run", "--episodes", "many"], "argument --episodes: 'many' is not a whole number"),
        (["run", "--episodes", "1.5"], "argument --episodes: '1.5' is not a whole number"),
        (["run", "--checkpoint", "first"], "'first' is neither best, last nor a number of steps"),
        (["run", "--checkpoint", "-1"], "'-1' is neither best, last nor a number of steps"),
        (["run", "--checkpoint"], "argument --checkpoint: expected one argument"),
    ],
)
def test_a_mistaken_command_line_is_refused(refused, command, arguments, said):
    line = refused(command, *arguments)
    assert line.startswith(f"jetbot-mjx {command.__name__.partition('.')[2]}: error: ")
    assert said in line


@pytest.mark.parametrize(
    ("value", "said"),
    [
        ("2", "2 is too large: give at most 1"),
        ("-0.1", "-0.1 is too small: give at least 0"),
        ("nan", "nan is too small: give at least 0"),
        ("95%", "'95%' is not a number"),
    ],
)
def test_evaluate_refuses_an_invalid_success_rate(refused, value, said):
    line = refused(evaluate, "run", "--min-success", value)
    assert f"argument --min-success: {said}" in line


@both
@pytest.mark.parametrize(
    ("make", "said"),
    [
        (
            lambda path: None,
            "no such folder; give a run folder, a checkpoint in it, or a name that",
        ),
        (lambda path: path.write_text("x"), "a file; give a run folder"),
        (lambda path: path.mkdir(), "it holds neither checkpoints/ nor policy/; give a run folder"),
        (lambda path: (path / "src").mkdir(parents=True), "neither checkpoints/ nor policy/"),
        (lambda path: (path / "checkpoints").mkdir(parents=True), "the run saved none"),
        (lambda path: (path / "seed-1").mkdir(parents=True), "it holds several seeds; name one"),
    ],
    ids=["missing", "file", "empty", "not a run", "without checkpoints", "seeds"],
)
def test_a_path_without_a_policy_is_refused(refused, here, command, make, said):
    make(here / "run")
    line = refused(command, "run")
    assert line.startswith("error: no checkpoint ")
    assert str(here / "run") in line
    assert said in line


@both
def test_a_checkpoint_that_is_not_there_is_refused(refused, trained, command):
    line = refused(command, trained, "--checkpoint", "123")
    assert line == f"error: no checkpoint at 123 steps in {trained}: there are 0, 2048\n"


@both
@pytest.mark.parametrize("item", ["policy", "default", None])
def test_a_foreign_checkpoint_is_refused(refused, here, command, item):
    folder = here / "run" / "checkpoints" / "000000000007"
    folder.mkdir(parents=True)
    if item is not None:
        with ocp.StandardCheckpointer() as writer:
            writer.save(folder / item, {"kernel": np.ones(3)})
    line = refused(command, "run")
    assert "is not one of jetbot_mjx: about/metadata is missing or damaged" in line


DAMAGES = {
    "no explanation": (
        lambda checkpoint: shutil.rmtree(checkpoint / "about"),
        "is not one of jetbot_mjx: about/metadata is missing or damaged",
    ),
    "half an explanation": (
        lambda checkpoint: (checkpoint / "about" / "metadata").write_text('{"format"'),
        "is not one of jetbot_mjx: about/metadata is missing or damaged",
    ),
    "another format": (
        damage_about(lambda about: about.update(format="jetbot_mjx/9")),
        "has the format 'jetbot_mjx/9', and only 'jetbot_mjx/3' can be read",
    ),
    "no configuration": (
        damage_about(lambda about: about.pop("config")),
        "has unusable metadata: .*config",
    ),
    "a setting of another version": (
        damage_about(lambda about: about["config"]["ppo"].update(momentum=0.9)),
        "has unusable metadata: .*ppo.momentum = 0.9 is unknown",
    ),
    "no list of parameters": (
        lambda checkpoint: (checkpoint / "policy" / "manifest.ocdbt").unlink(),
        "cannot be read: ",
    ),
    "a task that is gone": (
        damage_about(lambda about: about["config"]["task"].update(name="gone:Task")),
        "task.name = 'gone:Task': there is no gone.py beside",
    ),
}


@both
@pytest.mark.parametrize(("damage", "said"), DAMAGES.values(), ids=DAMAGES)
def test_a_damaged_checkpoint_is_refused(refused, damaged, command, damage, said):
    damage(damaged)
    assert re.search(said, refused(command, damaged))


# What the exit codes mean.


def test_an_exit_code_passes_through(capfd):
    for code in (0, 1):
        with pytest.raises(SystemExit) as caught:
            cli.run_command(lambda _, code=code: code)
        assert caught.value.code == code
    assert capfd.readouterr() == ("", "")


def raising(error):
    def command(_):
        raise error

    return command


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [(UserError("mend it"), 2, "error: mend it\n"), (KeyboardInterrupt(), 130, "interrupted\n")],
)
def test_an_error_of_the_user_has_one_line_and_an_exit_code(capfd, error, code, said):
    with pytest.raises(SystemExit) as caught:
        cli.run_command(raising(error))
    assert caught.value.code == code
    assert capfd.readouterr() == ("", said)


def test_a_mistake_of_ours_keeps_its_traceback():
    with pytest.raises(ZeroDivisionError):
        cli.run_command(raising(ZeroDivisionError()))


@pytest.mark.parametrize("name", COMMANDS)
def test_help_is_no_mistake(capfd, name):
    with pytest.raises(SystemExit) as caught:
        cli.run_command(lambda _: COMMANDS[name].main(["--help"]))
    out, err = capfd.readouterr()
    assert (caught.value.code, err) == (0, "")
    assert out.startswith(f"usage: jetbot-mjx {name} ")


@pytest.mark.parametrize(
    ("arguments", "code"),
    [([], 0), (["--min-success", "0.5"], 0), (["--min-success", "0.51"], 1)],
)
def test_only_a_success_rate_below_the_target_gives_1(
    monkeypatch, tmp_path, capfd, arguments, code
):
    report = make_report(make_episodes([[1, 0], [0, 1]], [1, 0]))
    monkeypatch.setattr(evaluation, "evaluate_run", lambda *args, **kwargs: report)
    assert evaluate.main([str(tmp_path), *arguments]) == code
    assert ("is below the 51.00% asked for" in capfd.readouterr().out) == (code == 1)


@pytest.fixture
def asked(monkeypatch):
    """What `train.main` would train, without training it."""

    def asked(*arguments):
        calls = []

        def run(config, run_dir, *objects, verbose):
            calls.append((config, run_dir))
            raise UserError("no training here")

        monkeypatch.setattr(training, "run", run)
        with pytest.raises(UserError):
            train.main(arguments)
        return calls[0]

    return asked


def test_train_takes_settings_in_order_and_the_seed_last(asked):
    config, run_dir = asked(
        *("--config", SMOKE, "--run-dir", "a/b"),
        *("--set", "seed=1", "--seed", "5", "--set", "seed=2"),
        *("--set", "ppo.learning_rate=1", "--set", "ppo.learning_rate=1e-4"),
    )
    assert config.seed == 5
    assert config.ppo.learning_rate == 1e-4
    assert config.ppo.num_envs == 128  # the file's
    assert run_dir == Path("a/b")


def test_train_takes_seeds(asked):
    assert asked("--config", SMOKE, "--seeds", "4")[0].seeds == 4


def test_train_names_its_run_folder_after_the_configuration(asked):
    _, run_dir = asked("--config", SMOKE)
    assert run_dir.parent == Path("runs")
    assert run_dir.name.startswith("smoke-")


# The same as a user meets it, in processes of their own.


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            ["train", "--config", "nonsense.yaml"],
            f"error: config nonsense.yaml does not exist: {FILE_OR_NAME}\n",
        ),
        (
            ["evaluate", "."],
            "it holds neither checkpoints/ nor policy/; give a run folder, a checkpoint in it, "
            "or a name that `jetbot-mjx runs` lists\n",
        ),
        (["render", ".", "--episodes", "0"], "0 is too small: give at least 1"),
    ],
)
def test_a_mistake_costs_one_line(tmp_path, arguments, said):
    command, *rest = arguments
    process = subprocess.run(
        [sys.executable, "-m", f"jetbot_mjx.{command}", *rest],
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    assert process.returncode == 2
    assert process.stdout == ""
    assert len(process.stderr.splitlines()) == 1
    assert said in process.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("command", "arguments", "meant"),
    [
        ("evaluate", ["run", "--robustnes"], "--robustness"),
        ("train", ["jetbot", "--run-di", "there"], "--run-dir"),
        ("render", ["run", "--checkp=last"], "--checkpoint"),
    ],
)
def test_an_option_that_is_cut_off_is_not_taken_but_answered(refused, command, arguments, meant):
    option = arguments[1].partition("=")[0]
    line = refused(COMMANDS[command], *arguments)
    assert f"unrecognized arguments: {option}: did you mean {meant}?" in line


def test_no_mistake_is_answered_by_trust(capsys):
    with pytest.raises(SystemExit):
        COMMANDS["render"].main(["runs/mine", "--truts"])
    said = capsys.readouterr().err
    assert "unrecognized arguments: --truts" in said
    assert "did you mean --trust" not in said
