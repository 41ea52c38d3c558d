"""What the project promises to users and contributors is what was measured, and what is so."""

import collections
import json
import re
import statistics

import pytest

from benchmarks import RESULTS
from benchmarks.reliability import promises
from helpers import durations
from helpers.source_tree import ENGINE, PACKAGE, ROOT, code_lines, modules_of
from jetbot_mjx.config import load_config


def sentence(file):
    """The sentence after `We promise`, in one line."""
    text = (ROOT / file).read_text("utf-8")
    (found,) = re.findall(r"^\*\*We promise[^*]*:\*\* (.*?)\n\n", text, re.M | re.S)
    return " ".join(found.split())


def results(name):
    return json.loads((RESULTS / f"{name}.json").read_text("utf-8"))


# To users


def test_the_time_to_a_trained_policy_is_what_was_measured():
    values = results("cpu-egocentric")
    target, cores = f"{values['target']:.0%}".replace("%", " %"), values["cpu_cores"]
    warm, cold = (
        statistics.median(
            run["target_reached_seconds"] for run in values["runs"] if run["start"] == start
        )
        for start in ("warm", "cold")
    )
    assert cores == 2
    promised = sentence("README.md")
    command = "`jetbot-mjx train jetbot_egocentric`"
    assert f"reaches {target} success {warm:.1f} s after {command} begins" in promised
    assert f"on two CPU cores ({cold:.1f} s with an empty compilation cache)" in promised


def test_policies_reach_the_promised_share_in_both_simulators():
    values = results("promises-cpu")
    (found,) = re.findall(r"(\d+) % or more of ([\d,]+) unseen goals", sentence("README.md"))
    share, goals = found
    assert goals == f"{values['episodes']:,}"
    assert len(values["rows"]) >= 3
    for row in values["rows"]:
        assert min(row["success"], row["success_in_mujoco"]) >= int(share) / 100


def test_a_killed_training_ended_with_the_same_bits():
    values = results("promises-cpu")
    steps = values["config"]["ppo"]["num_timesteps"]
    assert "killed and resumed ends with the same bits" in sentence("README.md")
    for row in values["rows"]:
        assert 0 < row["killed_after"] < steps
        assert row["sha256"] == row["sha256_resumed"]
        assert row["bit_identical"]


def test_what_was_measured_is_the_configuration_of_today():
    today = load_config("jetbot_egocentric").model_dump(mode="json")
    for name, sections in (
        ("promises-cpu", ("task", "ppo", "physics")),
        # Of its physics, the limit of the line search is another since.
        ("cpu-egocentric", ("task", "ppo")),
    ):
        then = results(name)["config"]
        for section in sections:
            shared = today[section].keys() & then[section].keys()
            assert {x: then[section][x] for x in shared} == {x: today[section][x] for x in shared}


def test_the_benchmark_tells_a_seed_that_breaks_the_promise():
    row = promises.Row(**results("promises-cpu")["rows"][0])
    assert row.kept
    for broken in ({"success": 0.98}, {"success_in_mujoco": 0.98}, {"bit_identical": False}):
        assert not row._replace(**broken).kept


# To contributors


def test_the_code_is_as_small_as_is_promised():
    promised = sentence("CONTRIBUTING.md")
    most, rooms, share = re.findall(
        r"than ([\d,]+) lines of code in (\d+) rooms and an engine, none with more than (\d+) %",
        promised,
    )[0]
    most = int(most.replace(",", ""))
    lines = collections.Counter()
    for package in (PACKAGE, ENGINE):
        for name, path in modules_of(package).items():
            lines[name.split(".")[0]] += code_lines(path.read_text("utf-8"))
    assert lines.total() < most
    assert lines.total() > 0.93 * most, "the promise has become too easy: lower it"
    faces = [*(ROOT / PACKAGE).glob("*/__init__.py")]
    assert len(faces) == int(rooms)
    assert int(share) == constant("structure", "LARGEST_ROOM")


def test_functions_are_as_short_as_is_promised():
    (most,) = re.findall(r"functions of at most (\d+) lines", sentence("CONTRIBUTING.md"))
    assert int(most) == constant("function_length", "MOST_LINES")


def constant(file, name):
    """A limit that a test of this folder holds."""
    text = (ROOT / f"tests/repository/test_{file}.py").read_text("utf-8")
    return int(re.findall(rf"^{name} = (\d+)$", text, re.M)[0])


def test_the_tests_take_as_long_as_is_promised(monkeypatch):
    (most,) = re.findall(r"at most (\d+) minutes of processor", sentence("CONTRIBUTING.md"))
    assert int(most) == durations.LIMIT
    for seconds, marks, failed in (
        (60 * durations.LIMIT + 1, "not slow", True),
        (60 * durations.LIMIT, "not slow", False),
        (60 * durations.LIMIT + 1, "slow", False),
    ):
        monkeypatch.setattr(durations, "_costs", collections.Counter(test=seconds))
        assert durations.too_long(marks) is failed


@pytest.mark.parametrize("file", ["README.md", "CONTRIBUTING.md"])
def test_the_file_names_what_keeps_its_promises(file):
    assert "`tests/repository/test_promises.py`" in (ROOT / file).read_text("utf-8")
