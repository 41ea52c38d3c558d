"""Every mistake of an environment of one's own is one line, before anything is compiled for it."""

import sys

import jax
import pytest

from helpers import broken_environments
from helpers.command_modules import train
from jetbot_mjx import cli
from jetbot_mjx.config import parse_config
from jetbot_mjx.envs import make_env
from jetbot_mjx.envs.checks import own_environment
from jetbot_mjx.envs.checks.own_environment import (
    ENVIRONMENT_CHECKS,
    check_environment,
    require_sound,
)
from jetbot_mjx.training import session

BROKEN = {
    "TurnsOnFloat64": "sets jax_enable_x64: leave it out, numbers are float32",
    "DecidesInPython": "step raises TracerBoolConversionError: Python cannot decide on an array",
    "CallsNumpy": "step raises TracerArrayConversionError: NumPy cannot take what JAX traces",
    "DividesByZero": "reward is not finite in 1,024 of 1,024 steps under random actions and ±1",
    "OverflowsInAMetric": "metrics['speed'] is not finite in 1,024 of 1,024 steps",
    "ObservesNothingFinite": "the observation of reset is not finite in 16 of 16 episodes",
    "GrowsItsObservation": "a step changes the state's obs from float32[2] to float32[3]",
    "GrowsItsState": "the state's pipeline_state['x'] from float32[] to float32[2]: keep names",
    "ChangesAType": "the state's pipeline_state['twice'] from float32[] to int32[]",
    "CountsInItself": "reset and step are another program each time: draw random numbers from",
    "RemembersItsState": "step uses a value that an earlier call kept in self: keep what changes",
    "DrawsFromNumpy": "draw random numbers from a key of JAX, not from NumPy or Python, and keep",
    "DrawsAResetFromNumpy": "reset and step are another program each time",
    "NamesAMetricAnewEachTime": "a step changes the state's metrics['speed_",
    "ResetsSlowly": "s, and every episode begins with one: compute in __init__ what all episodes",
    "IsAlwaysDone": "done is 1 in the first step of every episode: it should be 1 only where an",
    "EndsAtOnce": "done is 1 in the first step of every episode: it should be 1 only where an",
    "IsHalfDone": "done is 0.5 in a step: it should be 0 or 1",
    "IsDoneByMinusOne": "done is -1 in a step: it should be 0 or 1",
    "HalfSucceeds": "success is 0.5 in a step: it should be 0 or 1",
    "CountsItsSuccesses": "success is 2 in a step: it should be 0 or 1",
    "SucceedsByNothing": "metrics['success'] is not finite in 1,024 of 1,024 steps",
    "ComparesInstances": "a step of 16 instances gives another reward than each of them alone: no",
    "ResetsTheBatch": "a reset of 16 instances gives another obs than each of them alone: no",
    "CallsOneInPython": "a batch of steps raises NotImplementedError: vmap is only supported",
    "ObservesAMatrix": "observation has the shape [1, 2]: it should be a vector, such as x.ravel()",
    "ObservesImages": "observation['pixels'] has the shape [8, 8, 3]: it should be a vector",
    "ObservesNothing": "observation is empty: it should be a vector",
    "RewardsAVector": "reward has the shape [2]: it should be one number, of one instance",
    "IsABatch": "done has the shape [16]: it should be one number, of one instance",
    "HasNoActionSize": "action_size = None is wrong: it should be a whole number",
    "HasNoReset": "HasNoReset is no environment: it lacks reset",
    "CannotBeBuilt": "CannotBeBuilt raises KeyError: 'table' (broken_environments.py:",
    "Chooses": "its actions are 3 choices: set categorical",
    "MeasuresLater": "the state's metrics['distance'] from nothing to float32[]: keep names",
    "HoldsText": "the state's info['phase'] = 'swing' is wrong: it should be a number or an array",
    "StepsAsGymnasium": "it returns a tuple: return a state with obs, reward and done",
    "ResetsAsGymnasium": "it returns a tuple: return a state with obs, reward and done",
    "TakesNoKey": "reset raises TypeError: TakesNoKey.reset() takes 1 positional argument but 2",
    "TakesNoAction": "step raises TypeError: TakesNoAction.step() takes 2 positional arguments",
    "ForgetsToReturn": "it returns nothing: return a state with obs, reward and done",
    "HasNoReward": "its state lacks reward",
    "returns_nothing": "NoneType is no environment: it lacks reset and step",
    "NOT_CALLABLE": "is no class and no function",
    "OfGymnasium": "OfGymnasium is Gymnasium's and runs in Python: write reset and step in JAX",
    "Nobody": "helpers.broken_environments has no 'Nobody'",
}
"""What is said of each environment."""


def config_of(name, **settings):
    environment = f"{broken_environments.__name__}:{name}"
    return parse_config({"environment": environment, **settings})


@pytest.fixture(autouse=True)
def float32():
    """Whatever an environment sets, the next one begins with float32."""
    yield
    jax.config.update("jax_enable_x64", False)


@pytest.fixture
def type_(tmp_path, monkeypatch, capfd):
    """Trains with a configuration's text as a user would; returns what is on stderr."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])

    def type_(text):
        (tmp_path / "mine.yaml").write_text(text)
        before = {path for path in tmp_path.rglob("*") if "__pycache__" not in path.parts}
        monkeypatch.setattr(sys, "argv", ["jetbot-mjx", "mine.yaml"])
        with pytest.raises(SystemExit) as caught:
            cli.run_command(train.main)
        out, err = capfd.readouterr()
        assert (caught.value.code, out) == (2, "")
        assert {x for x in tmp_path.rglob("*") if "__pycache__" not in x.parts} == before
        (line,) = err.splitlines()
        return line

    return type_


@pytest.fixture
def resets_are_slow_after_10_ms(monkeypatch):
    """However fast the machine is, a reset that counts to a million is slow."""
    monkeypatch.setattr(own_environment, "_LONGEST_RESET", 0.01)


@pytest.mark.parametrize("name", BROKEN)
def test_a_mistake_is_one_line_and_nothing_is_written(type_, name, request):
    if name == "ResetsSlowly":
        request.getfixturevalue("resets_are_slow_after_10_ms")
    # Few steps, so that a training which should not have begun ends.
    few = "ppo: {num_timesteps: 1000}\n"
    line = type_(f"environment: helpers.broken_environments:{name}\n{few}")
    assert line.startswith("error: ")
    assert f"environment = 'helpers.broken_environments:{name}'" in line
    assert BROKEN[name] in line


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("environment: mine.py\n", "write file.py:Class, with a file beside the configuration"),
        ("environment: no_such_file.py:Mine\n", "there is no no_such_file.py beside the YAML"),
        (
            "environment: fails_to_import.py:Mine\n",
            "the import of fails_to_import raises ZeroDivisionError: division by zero"
            " (fails_to_import.py:1)",
        ),
        (
            "environment: helpers.broken_environments:Sound\nenvironment_options: {strat: 1}\n",
            "Sound raises TypeError: Point.__init__() got an unexpected keyword argument 'strat'",
        ),
        (
            "environment: helpers.broken_environments:Sound\n"
            "ppo: {network: {distribution_type: categorical}}\n",
            "its actions are numbers: set tanh_normal",
        ),
    ],
)
def test_what_cannot_be_imported_is_one_line_too(type_, tmp_path, text, told):
    (tmp_path / "fails_to_import.py").write_text("1 / 0\n")
    assert told in type_(text)


def test_a_rare_state_that_is_not_finite_is_left_to_the_training():
    config = config_of("IsRarelyNotFinite")
    require_sound(make_env(config))
    # The command that looks for mistakes tells it.
    (finding,) = dict(check_environment(config))["drive"]
    assert finding.startswith("reward is not finite in ")


def test_an_environment_need_not_end():
    assert dict(check_environment(config_of("NeverEnds"))) == {x: [] for x in ENVIRONMENT_CHECKS}


def test_each_check_is_told_up_to_the_first_with_findings():
    assert dict(check_environment(config_of("Sound"))) == {x: [] for x in ENVIRONMENT_CHECKS}
    found = list(check_environment(config_of("CountsInItself")))
    assert [name for name, _ in found] == ["interface", "purity"]
    assert [len(findings) for _, findings in found] == [0, 1]
    (found,) = check_environment(config_of("HasNoReset"))
    assert found[0] == "interface"


def test_what_was_trained_before_is_not_driven_again(tmp_path, monkeypatch):
    drives = []
    monkeypatch.setattr(session.envs, "require_sound", drives.append)

    class Found(Exception):
        """Raised in place of what follows."""

    def stop(setup):
        raise Found

    monkeypatch.setattr(session.ppo_trainer, "build_ppo", stop)
    for cached in (False, True):
        monkeypatch.setattr(session.ProgramCache, "has", lambda self, name, has=cached: has)
        with pytest.raises(Found):
            session.run(config_of("Sound"), tmp_path / "run")
    assert len(drives) == 1
