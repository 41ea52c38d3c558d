"""The functions for other programs do what the commands do, and leave the process unchanged."""

import asyncio
import inspect
import os
import pkgutil
import shutil
import signal
import subprocess
import sys
import threading
import time
import warnings
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

import jetbot_mjx
from helpers import gliding
from jetbot_mjx import (
    evaluate,
    load_config,
    load_policy,
    make_env,
    render,
    train,
    training,
    tune,
)
from jetbot_mjx.errors import InvalidError, NotFoundError, UserError
from jetbot_mjx.evaluation.comparison import Comparison
from jetbot_mjx.evaluation.goal_set import REPORT_GOALS
from jetbot_mjx.evaluation.report import Report
from jetbot_mjx.runs.checkpoint import load_checkpoint
from jetbot_mjx.training.preemption import DeferredSignals
from jetbot_mjx.viewers import gallery

STEP = 8_192
SMALL = {
    "ppo.num_timesteps": 2 * STEP,
    "checkpoint_interval": STEP,
    "evaluation.episodes": 8,
    "ppo.network.policy_hidden_layer_sizes": [16],
    "ppo.network.value_hidden_layer_sizes": [16],
    "tensorboard": False,
}
LONG = {**SMALL, "ppo.num_timesteps": 10_000 * STEP}
PATIENCE = 300


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    with gliding.everywhere():
        return train("smoke", SMALL, run_dir=tmp_path_factory.mktemp("library") / "run")


def fresh(code, *arguments):
    """What a process of its own prints."""
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", code, *arguments], capture_output=True, text=True
    )
    assert (done.returncode, done.stderr) == (0, ""), done.stderr[-2000:]
    return done.stdout


# The names.

ORDERS = {
    "function first": "from jetbot_mjx import {0}; import jetbot_mjx.{0}",
    "module first": "import jetbot_mjx.{0}; from jetbot_mjx import {0}",
    "from the module": "from jetbot_mjx.{0} import main; from jetbot_mjx import {0}",
}


FORGET = """
for name in [name for name in sys.modules if name.partition(".")[0] == "jetbot_mjx"]:
    del sys.modules[name]
"""
"""Makes the next import of the package its first; what it imports of others stays loaded."""


def test_a_function_is_one_whatever_was_imported_first():
    code = "import inspect, pickle, sys\n"
    for order, imports in ORDERS.items():
        code += f"{FORGET}import jetbot_mjx\n"
        for name in ("train", "evaluate", "render"):
            told = f"{order}: {name}"
            code += f"{imports.format(name)}\n"
            code += f"assert inspect.isfunction({name}), {told!r}\n"
            code += f"assert {name} is jetbot_mjx.{name} is pickle.loads(pickle.dumps({name}))\n"
            code += f"from jetbot_mjx.{name} import main as main_of_{name}\n"
            code += f"assert inspect.isfunction(main_of_{name}), {told!r}\n"
    assert fresh(code) == ""


def test_the_command_still_runs_as_a_module():
    command = [sys.executable, "-m", "jetbot_mjx.train", "--help"]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.stdout.startswith("usage: jetbot-mjx train "), done.stderr[-2000:]


def test_no_module_takes_the_place_of_a_public_name():
    modules = {module.name for module in pkgutil.iter_modules(jetbot_mjx.__path__)}
    for name in modules & set(dir(jetbot_mjx)):
        setattr(jetbot_mjx, name, sys)
        assert getattr(jetbot_mjx, name) is not sys


def test_an_import_of_the_package_loads_nothing_heavy():
    loaded = fresh("import sys, jetbot_mjx; print(*sorted(sys.modules))").split()
    assert not {"jax", "numpy", "pydantic", "argparse", "jetbot_mjx.library"} & set(loaded)


# What they do.


def test_a_training_returns_its_result_and_prints_nothing(tmp_path, capfd):
    with gliding.everywhere():
        result = train("smoke", SMALL, run_dir=str(tmp_path / "run"))
    assert capfd.readouterr() == ("", "")
    assert result.finished
    assert result.run_dir == tmp_path / "run"
    assert [line.env_steps for line in result.history] == [0, STEP, 2 * STEP]
    assert result.history[-1].metrics["eval/success_rate"] is not None
    best = f"{result.best.success_rate:.1%} success"
    assert repr(result) == f"Result(run_dir='{tmp_path}/run', best={best}, finished=True)"
    assert load_checkpoint(result.run_dir, "last").config == load_config("smoke", SMALL)


def test_progress_is_shown_if_asked_for_and_a_run_may_be_resumed(trained, tmp_path, capfd):
    run_dir = shutil.copytree(trained.run_dir, tmp_path / "run")
    with gliding.everywhere():
        result = train(resume=run_dir, overrides={"ppo.num_timesteps": 3 * STEP}, verbose=True)
    out, err = capfd.readouterr()
    assert f"resuming after {2 * STEP:,} steps" in out
    assert f"{3 * STEP:,} steps  success" in out
    assert result.standings[0].env_steps == 3 * STEP
    assert err == ""


def test_a_configuration_object_gets_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    config = load_config("smoke", {"seed": 3})
    folders = []
    monkeypatch.setattr(
        training, "run", lambda config, run_dir, **more: folders.append((config, run_dir.name))
    )
    train(config)
    train("smoke", ["seed=3"])
    assert [given for given, _ in folders] == [config, config]
    assert [name.partition("-")[0] for _, name in folders] == ["run", "smoke"]


@pytest.mark.slow
def test_a_run_is_evaluated_and_several_are_compared(trained, tmp_path, blank_figures, capfd):
    with gliding.everywhere():
        report = evaluate(trained.run_dir, episodes=4, output=tmp_path / "one")
        comparison = evaluate([trained.run_dir], episodes=4, output=tmp_path / "all")
    assert capfd.readouterr() == ("", "")
    assert isinstance(report, Report)
    assert (report.policy.episodes, report.folder) == (4, tmp_path / "one")
    assert repr(report) == (
        f"Report(run='{trained.run_dir}', env_steps={report.env_steps},"
        f" success={report.policy.successes}/4, folder='{tmp_path}/one')"
    )
    assert isinstance(comparison, Comparison)
    assert repr(comparison).startswith("Comparison(success={'run': '")
    assert len(repr(comparison)) < 200


def test_a_run_is_rendered(trained, with_opengl, monkeypatch, capfd):
    monkeypatch.setattr(gallery.VideoRenderer, "render_episode", lambda self, drive: [])
    monkeypatch.setattr(gallery, "write_mp4", lambda path, frames: list(frames))
    monkeypatch.setattr(gallery, "write_gif", lambda path, frames: None)
    with gliding.everywhere():
        rendered = render(trained.run_dir, goals=[3])
    assert capfd.readouterr() == ("", "")
    assert rendered.files["plot"].is_file()
    assert repr(rendered).startswith("Rendered(reached={")
    assert len(repr(rendered)) < 1000


@pytest.mark.slow
def test_hyperparameters_are_searched(tmp_path, monkeypatch, blank_figures, capfd):
    optuna = pytest.importorskip("optuna")
    from helpers.quick_trials import Quick

    monkeypatch.setattr("jetbot_mjx.tuning.search.Trials", Quick)
    figure, style = plt.figure(), dict(plt.rcParams)
    level = optuna.logging.get_verbosity()
    space = {"ppo.learning_rate": {"low": 1e-4, "high": 1e-2, "log": True}}
    found = tune(
        "smoke", SMALL, space=space, trials=2, round_size=2, confirm=1, output=tmp_path / "t"
    )
    assert capfd.readouterr() == ("", "")
    assert found.config == load_config(tmp_path / "t" / "best.yaml")
    assert set(found.values) <= set(space)
    assert len(found.study.trials) == 2
    assert repr(found).startswith(f"TuningResult(folder='{tmp_path}/t', best='")
    assert optuna.logging.get_verbosity() == level
    assert dict(plt.rcParams) == style
    assert plt.fignum_exists(figure.number)
    plt.close(figure)


def test_a_search_without_final_trainings_returns_the_best_trial(tmp_path, monkeypatch):
    optuna = pytest.importorskip("optuna")
    from helpers.quick_trials import Quick

    monkeypatch.setattr("jetbot_mjx.tuning.search.Trials", Quick)
    level, filters = optuna.logging.get_verbosity(), list(warnings.filters)
    space = {"ppo.learning_rate": {"low": 1e-4, "high": 1e-2}}
    found = tune("smoke", SMALL, space=space, trials=1, confirm=0, output=tmp_path / "t")
    assert (found.entrants, found.best) == ((), None)
    assert found.values == found.study.best_trial.params
    assert found.config.ppo.learning_rate == found.values["ppo.learning_rate"]
    assert repr(found) == f"TuningResult(folder='{tmp_path}/t', values={found.values})"
    assert (optuna.logging.get_verbosity(), list(warnings.filters)) == (level, filters)


def test_an_environment_is_built_from_a_name():
    env = make_env("jetbot", {"task.observation": "egocentric"})
    assert env.config == load_config("jetbot", ["task.observation=egocentric"])
    assert repr(env) == (
        "JetBotEnv(task='jetbot_mjx:GoalTask', robot='isaac', observation='egocentric',"
        " observation_size=7, action_size=2)"
    )
    assert make_env(env.config).config == env.config


def test_a_loaded_checkpoint_has_a_short_repr(trained):
    assert len(repr(load_checkpoint(trained.run_dir))) < 600


def test_a_default_is_that_of_the_commands():
    assert inspect.signature(evaluate).parameters["episodes"].default == REPORT_GOALS
    assert (gallery.VIDEO_EPISODES, gallery.GALLERY_EPISODES) == (8, 4)


# What they refuse.


@pytest.mark.parametrize(
    ("mistake", "kind", "said"),
    [
        (lambda run: train(), InvalidError, 'give a configuration, as in train("jetbot"), or a'),
        (lambda run: train("jetbo"), NotFoundError, "config jetbo does not exist: did you mean j"),
        (
            lambda run: train("smoke", {"ppo.num_env": 1}),
            InvalidError,
            "did you mean ppo.num_env",
        ),
        (lambda run: train("smoke", resume=run), InvalidError, "leave out config and run_dir"),
        (lambda run: train(resume="nowhere"), NotFoundError, "there is no run in this folder"),
        (lambda run: train("smoke", run_dir=run), UserError, "holds another run"),
        (lambda run: evaluate("nowhere"), NotFoundError, "no checkpoint at"),
        (lambda run: evaluate(run, episodes=0), InvalidError, "episodes = 0 is wrong: it should"),
        (lambda run: evaluate(run, episodes=2.5), InvalidError, "episodes = 2.5 is wrong: it"),
        (lambda run: evaluate([]), InvalidError, "runs = [] is empty: name at least one run"),
        (lambda run: evaluate(None), InvalidError, "runs = None is wrong: name a run, or several"),
        (lambda run: evaluate(run, simulator="gym"), InvalidError, "simulator = 'gym' is unknown"),
        (lambda run: render("nowhere"), NotFoundError, "no checkpoint at"),
        (lambda run: render(run, size=(640, 361)), InvalidError, "size = 640x361 is wrong: it"),
        (lambda run: render(run, episodes=0), InvalidError, "episodes = 0 is wrong: it should be"),
        (lambda run: render(run, goals=["3"]), InvalidError, "goals: '3' is wrong: give indices"),
        (lambda run: render(run, goals=3), InvalidError, "goals = 3 is wrong: give indices"),
        (lambda run: render(run, goals=[]), InvalidError, "goals = [] is empty: give at least on"),
        (lambda run: render(run, goals=[3, 3]), InvalidError, "goal 3 is given twice"),
        (lambda run: render(run, goals=np.array([5000])), InvalidError, "goal 5000 is not one of"),
        (lambda run: render(run, size=64), InvalidError, "size = 64 is wrong: it should be two"),
        (lambda run: render(run, size=(64.0, 64)), InvalidError, "size = 64.0x64 is wrong: it sho"),
        (lambda run: render(run, many=0), InvalidError, "robots = 0 is wrong: it should be a wh"),
        (lambda run: render(run, gallery=True, goals=[1]), InvalidError, "gallery and goals exc"),
        (lambda run: render(run, gallery=True, strip=True), InvalidError, "strip and gallery exc"),
        (lambda run: render(run, which=8, strip=True), InvalidError, "strip and which exclude"),
        (lambda run: render(run, goals=[1], episodes=2), InvalidError, "goals and episodes excl"),
        (lambda run: render(run, many=4, episodes=2), InvalidError, "many and episodes exclude"),
        (lambda run: tune("smoke", space={}), InvalidError, "space is empty: write lines such as"),
        (
            lambda run: tune("smoke", space="ppo", objective="sucess"),
            InvalidError,
            "objective = 'sucess' is wrong: choose one of 'learning', 'time'",
        ),
        (
            lambda run: load_config("smoke", [("seed", 1)]),
            InvalidError,
            "overrides = [('seed', 1)] is wrong: give",
        ),
        (lambda run: tune("smoke", space="no.yaml"), NotFoundError, "no.yaml does not exist"),
        (lambda run: tune("smoke", space={"seed": {}}, trials=0), InvalidError, "trials = 0 is w"),
        (lambda run: tune(None, space="ppo"), InvalidError, "config = None is wrong: it should be"),
        (lambda run: make_env("jetbo"), NotFoundError, "did you mean jetbot?"),
    ],
)
def test_a_mistake_raises_one_line(trained, tmp_path, monkeypatch, mistake, kind, said):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(kind) as caught:
        mistake(trained.run_dir)
    assert said in str(caught.value)
    assert isinstance(caught.value, UserError)
    assert "--set" not in str(caught.value)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


TAKE_PATHS = {
    "run_dir": lambda bad: train("smoke", SMALL, run_dir=bad),
    "output": lambda bad: tune("smoke", space="ppo", output=bad),
    "storage": lambda bad: tune("smoke", space="ppo", storage=bad),
    "run_or_checkpoint": load_policy,
    "run resumed": lambda bad: train(resume=bad),
    "run evaluated": evaluate,
    "run compared": lambda bad: evaluate([bad]),
    "run rendered": render,
    "output of one": lambda bad: evaluate("pretrained:jetbot_egocentric", output=bad),
    "output of two": lambda bad: evaluate(["pretrained:jetbot_egocentric"], output=bad),
    "ranges": lambda bad: evaluate("pretrained:jetbot_egocentric", ranges=bad),
}
"""What takes a path, by the name that its message begins with."""


@pytest.mark.parametrize("name", TAKE_PATHS)
def test_what_is_no_path_is_refused_by_its_name(name, trained, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for bad in (trained, b"run", "", "a\0b", *([] if name == "run evaluated" else [3, ["run"]])):
        with pytest.raises(InvalidError) as caught:
            TAKE_PATHS[name](bad)
        said = str(caught.value)
        assert said.startswith(name.split()[0])
        assert "is wrong: it should be a path or a name" in said
        assert said.endswith(": give its run_dir") == (bad is trained)
    assert list(tmp_path.iterdir()) == []


def test_several_seeds_are_compared_in_a_list(tmp_path):
    for seed in (0, 1):
        (tmp_path / "five" / f"seed-{seed}").mkdir(parents=True)
        (tmp_path / "five" / f"seed-{seed}" / "config.yaml").touch()
    with pytest.raises(InvalidError, match=r"compare all in a list, as in evaluate\(\['/"):
        evaluate(tmp_path / "five")


SHAPES = """
import jax, jax.numpy as jnp
from jetbot_mjx import make_env

env = make_env("smoke")
keys = jax.random.split(jax.random.PRNGKey(0), 3)
state, batch = jax.eval_shape(env.reset, keys[0]), jax.eval_shape(jax.vmap(env.reset), keys)
for step in (
    lambda: env.step(state, jnp.zeros(3)),
    lambda: env.step(state, jnp.zeros((3, 2))),
    lambda: env.step(batch, jnp.zeros((3, 2))),
    lambda: env.step(batch, jnp.zeros(2)),
    lambda: env.step(state, [0.0, 0.0]),
    lambda: jax.eval_shape(jax.vmap(env.step), batch, jnp.zeros((3, 3))),
    lambda: env.reset(keys),
    lambda: env.reset(0),
):
    try:
        step()
    except ValueError as error:
        print(error)
# Keys of both kinds, as ever.
jax.eval_shape(env.reset, jax.random.key(0))
"""


@pytest.mark.slow
def test_an_environment_refuses_another_shape_in_one_line():
    # In a process of its own: in that of the tests, jaxtyping would see it first.
    several = "got 3 of them, and an environment is of one robot: batch it, as in jax.vmap(env."
    assert fresh(SHAPES).splitlines() == [
        "action: expected an array of shape [2]; got shape [3]",
        f"action: {several}step)",
        f"action: {several}step)",
        f"state.done: {several}step)",
        "action: expected an array of shape [2]; got list",
        "action: expected an array of shape [2]; got shape [3]",
        f"rng: {several}reset)",
        "rng: expected an array of shape [2]; got int",
    ]


# The process.

STATE = """
import gc, logging, os, signal, sys, threading, warnings

import jax
import matplotlib.pyplot as plt

def state():
    wakeup = signal.set_wakeup_fd(-1)
    signal.set_wakeup_fd(wakeup)
    loggers = logging.root.manager.loggerDict
    return {
        "signals": [signal.getsignal(signal.SIGINT), signal.getsignal(signal.SIGTERM), wakeup],
        "root": (logging.root.level, list(logging.root.handlers)),
        "absl": (logging.getLogger("absl").level, list(logging.getLogger("absl").filters)),
        "imports": [type(finder).__name__ for finder in sys.meta_path],
        "warnings": list(warnings.filters),
        "environment": dict(os.environ),
        "jax": dict(jax.config.values),
        "collector": gc.get_threshold(),
        "hooks": (sys.excepthook, sys.unraisablehook, threading.excepthook),
        "path": list(sys.path),
        "figures": plt.get_fignums(),
    }

from helpers import gliding, unpainted
from jetbot_mjx import evaluate, train

for handler in list(logging.root.handlers):
    logging.root.removeHandler(handler)
plt.figure()
before = state()
with gliding.everywhere(), unpainted.unpainted():
    result = train("smoke", SETTINGS, run_dir=sys.argv[1])
    evaluate(result.run_dir, episodes=4)
after = state()
print([name for name in before if before[name] != after[name]])
"""


@pytest.mark.slow
def test_the_functions_leave_the_process_unchanged(tmp_path):
    code = STATE.replace("SETTINGS", repr(SMALL))
    told = fresh(code, str(tmp_path / "run")).splitlines()
    assert told[-1] == "[]"


@pytest.mark.slow
def test_a_training_works_in_a_thread_beside_a_running_loop(tmp_path):
    async def main():
        with gliding.everywhere():
            inside = train("smoke", SMALL, run_dir=tmp_path / "inside")
            beside = await asyncio.to_thread(train, "smoke", SMALL, run_dir=tmp_path / "beside")
        return inside, beside

    inside, beside = asyncio.run(main())
    assert inside.fingerprints == beside.fingerprints
    assert load_policy(beside.run_dir)


def interrupt_after_a_checkpoint(run_dir, number):
    """Sends this process a signal, from a thread, as soon as the run has made a step."""

    def send():
        deadline = time.monotonic() + PATIENCE
        while not list(run_dir.glob("checkpoints/*[1-9]*")) and time.monotonic() < deadline:
            time.sleep(0.01)
        os.kill(os.getpid(), number)

    thread = threading.Thread(target=send)
    thread.start()
    return thread


def handlers():
    return [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)]


def test_an_interrupted_training_saves_and_raises(tmp_path):
    before, run_dir = handlers(), tmp_path / "run"
    thread = interrupt_after_a_checkpoint(run_dir, signal.SIGINT)
    with gliding.everywhere():
        with pytest.raises(KeyboardInterrupt):
            train("smoke", LONG, run_dir=run_dir)
        thread.join()
        assert handlers() == before
        saved = load_checkpoint(run_dir, "last").env_steps
        assert saved > 0
        settings = {"ppo.num_timesteps": saved + STEP}
        result = train(resume=run_dir, overrides=settings)
    assert result.standings[0].env_steps == saved + STEP


def test_a_handler_of_the_program_gets_the_signal_once_the_training_is_saved(tmp_path):
    run_dir, saved = tmp_path / "run", []

    def own(number, frame):
        saved.append(load_checkpoint(run_dir, "last").env_steps)

    former = signal.signal(signal.SIGTERM, own)
    try:
        thread = interrupt_after_a_checkpoint(run_dir, signal.SIGTERM)
        with gliding.everywhere():
            result = train("smoke", LONG, run_dir=run_dir)
        thread.join()
        assert signal.getsignal(signal.SIGTERM) is own
    finally:
        signal.signal(signal.SIGTERM, former)
    assert saved == [load_checkpoint(run_dir, "last").env_steps]
    assert not result.finished


def test_a_second_interrupt_is_not_held_back():
    before = handlers()

    def interrupt_twice():
        with DeferredSignals(30) as stop:
            assert not stop.requested
            signal.raise_signal(signal.SIGINT)
            assert stop.wait(0)
            assert handlers() == before
            signal.raise_signal(signal.SIGINT)
            raise AssertionError

    with pytest.raises(KeyboardInterrupt) as caught:
        interrupt_twice()
    assert caught.value.__context__ is None
    assert handlers() == before


def test_a_signal_is_delivered_even_if_the_training_fails():
    def fail():
        with DeferredSignals(30):
            signal.raise_signal(signal.SIGINT)
            raise UserError("the disk is full")

    with pytest.raises(KeyboardInterrupt) as caught:
        fail()
    assert isinstance(caught.value.__context__, UserError)


def test_a_signal_that_is_ignored_stays_ignored():
    former = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with DeferredSignals(30) as stop:
            signal.raise_signal(signal.SIGINT)
            assert not stop.requested
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, former)


def test_the_page_names_every_argument():
    page = (Path(__file__).parents[2] / "docs" / "library.md").read_text("utf-8")
    for function in (train, evaluate, render, tune):
        for name in inspect.signature(function).parameters:
            assert f"`{name}`" in page or f"{name}=" in page, name
