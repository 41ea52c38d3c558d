"""The best-known times: how they are found, where they hold, and a policy's gap to them."""

import json

import jax
import numpy as np
import pytest

from benchmarks import ROOT
from benchmarks.learning import best_known as benchmark
from helpers.gliding import Gliding
from helpers.reports import make_episodes, make_report, polar
from jetbot_mjx.config import load_config, parse_config
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation import best_known
from jetbot_mjx.evaluation.evaluator import report_keys
from jetbot_mjx.evaluation.goal_set import GOAL_SET_VERSION
from jetbot_mjx.evaluation.html_report import write_report
from jetbot_mjx.evaluation.report import SECTORS, compare_with
from jetbot_mjx.evaluation.rollout import rollout_fn
from jetbot_mjx.evaluation.tables import best_known_lines, lower_bound_line, policies_table

DT = 1 / 60
CONFIG = parse_config({})
RECORDED = {"qpos": np.zeros((8, 3, 9), np.float32)}
VERSIONS = {
    "packages": {},
    "python": "",
    "platform": "",
    "device": "",
    "device_count": 1,
    "git": None,
}
GOALS = polar(np.full(8, 1.0), np.arange(8) * 45.0)
STEPS = np.arange(60, 68)


@pytest.fixture
def searched(tmp_path, monkeypatch):
    """A function that puts a search into the file, of goals made by hand unless told otherwise."""
    monkeypatch.setattr(best_known, "FILE", tmp_path / "best_known.json")

    def put(settings=None, **changes):
        search = {
            "settings": best_known.settings_of(parse_config(settings or {})),
            "goal_set_version": GOAL_SET_VERSION,
            "goals": np.rint(1000 * GOALS).astype(int).tolist(),
            "steps": STEPS.tolist(),
        }
        benchmark.store(best_known.FILE, search | changes)

    return put


# Where they hold.


def test_times_of_the_same_goals_and_settings_are_found(searched):
    searched()
    searched({"robot": {"preset": "real"}}, steps=(STEPS * 3).tolist())
    known = best_known.find("search", CONFIG, make_episodes(GOALS, np.ones(8)))
    np.testing.assert_array_equal(known, STEPS)
    first = best_known.find("search", CONFIG, make_episodes(GOALS[:3], np.ones(3)))
    np.testing.assert_array_equal(first, STEPS[:3])
    real = parse_config({"robot": {"preset": "real"}})
    slow = best_known.find("search", real, make_episodes(GOALS, np.ones(8)))
    np.testing.assert_array_equal(slow, STEPS * 3)


@pytest.mark.parametrize(
    ("settings", "episodes", "missing"),
    [
        ({"robot": {"preset": "real"}}, 8, "robot.preset = isaac, and this run has real"),
        ({"task": {"max_speed": 0.5}}, 8, "task.max_speed = 1.0, and this run has 0.5"),
        (
            {"task": {"name": "gates:Gates"}},
            8,
            "task.name = jetbot_mjx:GoalTask, and this run has gates",
        ),
        ({}, 9, "the search covers 8 of these 9 goals"),
    ],
)
def test_elsewhere_the_reason_is_told(searched, settings, episodes, missing):
    searched()
    goals = polar(np.full(episodes, 1.0), np.arange(episodes) * 45.0)
    driven = make_episodes(goals, np.ones(episodes))
    found, reason = compare_with("search", parse_config(settings), driven)
    assert found is None
    assert missing in reason


def test_runs_with_other_observations_and_hyperparameters_are_comparable(searched):
    searched()
    settings = {
        "task": {"observation": "egocentric", "episode_length": 300},
        "ppo": {"discounting": 0.9},
        "physics": {"iterations": 7},
    }
    known = best_known.find("search", parse_config(settings), make_episodes(GOALS, np.ones(8)))
    np.testing.assert_array_equal(known, STEPS)


def test_other_goals_have_no_known_times(searched):
    searched(goals=np.rint(1000 * GOALS + [0, 3]).astype(int).tolist())
    driven = make_episodes(GOALS, np.ones(8))
    assert "goals at other positions" in best_known.find("search", CONFIG, driven)
    searched(goal_set_version=GOAL_SET_VERSION + 1)
    assert "no search was made for these goals" in best_known.find("search", CONFIG, driven)


# A policy's gap.


def test_the_gap_is_that_of_the_means_over_the_goals_reached(searched):
    searched()
    won = np.array([1, 1, 0, 1, 1, 0, 1, 1])
    driven = make_episodes(GOALS, won, steps=STEPS + np.arange(8))
    found, reason = compare_with("search", CONFIG, driven)
    assert reason is None
    assert found.time_to_goal_median == pytest.approx(63.5 * DT)
    reached = np.flatnonzero(won)
    ours, best = (STEPS + np.arange(8))[reached].mean(), STEPS[reached].mean()
    assert (found.total.reached, found.total.policy_mean) == (6, pytest.approx(ours * DT))
    assert found.total.best_mean == pytest.approx(best * DT)
    assert found.total.gap == pytest.approx(ours / best - 1)
    assert len(found.by_direction) == SECTORS
    gaps = [one.gap for one in found.by_direction]
    assert gaps[2] is gaps[5] is None
    assert gaps[3] == pytest.approx(3 / 63)
    left = found.by_direction[2]
    assert (left.bearing_low, left.bearing_high, left.reached) == (67.5, 112.5, 0)


@pytest.mark.usefixtures("blank_figures")
def test_a_report_tells_it_in_all_its_forms(searched, tmp_path):
    searched()
    driven = make_episodes(GOALS, [1, 1, 0, 1, 1, 1, 1, 1], steps=STEPS + 6, **RECORDED)
    found, _ = compare_with("search", CONFIG, driven)
    report = make_report(driven)._replace(
        folder=tmp_path / "report", best_known=found, versions=VERSIONS
    )
    table = policies_table({"policy": report})
    assert table.splitlines()[-1].split() == [
        "best",
        "known",
        "-",
        "-",
        "1.06",
        "s",
        "1.11",
        "s",
        "-",
        "-",
    ]
    assert "9.42% slower than best known (mean of 7 goals: 1.162 s, best known 1.062 s)" in (
        best_known_lines(report)
    )
    assert "0° +10.0%, 45° +9.8%, 135° +9.5%, 180° +9.4%, -135° +9.2%" in best_known_lines(report)
    write_report(report)
    values = json.loads((tmp_path / "report" / "report.json").read_text())
    assert values["best_known"]["total"]["gap"] == pytest.approx(found.total.gap)
    text = (tmp_path / "report" / "report.md").read_text()
    assert "| best known | - | - | 1.06 s | 1.11 s |" in text
    assert "best-known mean time to the same goals is 1.062 s (gap +9.42%)" in text
    assert "| +68° to +112° | 0 | - | - | - |" in text
    page = (tmp_path / "report" / "report.html").read_text()
    assert 'data-json="best_known.total.gap">+9.42%</data>' in page
    assert 'data-json="best_known.by_direction.7.gap">' in page


@pytest.mark.usefixtures("blank_figures")
def test_a_report_without_it_says_why(searched, tmp_path):
    searched({"robot": {"preset": "real"}})
    driven = make_episodes(GOALS, np.ones(8), **RECORDED)
    found, missing = compare_with("search", CONFIG, driven)
    report = make_report(driven)._replace(
        folder=tmp_path / "report", best_known_missing=missing, versions=VERSIONS
    )
    assert found is None
    assert "best known" not in policies_table({"policy": report})
    assert "robot.preset = real, and this run has isaac" in best_known_lines(report)
    write_report(report)
    values = json.loads((tmp_path / "report" / "report.json").read_text())
    assert (values["best_known"], values["best_known_missing"]) == (None, missing)
    for name in ("report.md", "report.html"):
        assert f"are not available: {missing}." in (tmp_path / "report" / name).read_text()


def test_a_policy_that_reaches_nothing_has_no_gap(searched):
    searched()
    found, _ = compare_with("search", CONFIG, make_episodes(GOALS, np.zeros(8)))
    assert found.total == (-180.0, 180.0, 0, None, None, None)
    report = make_report(make_episodes(GOALS, np.zeros(8)))._replace(best_known=found)
    assert "reached no goal" in best_known_lines(report)


# The bound below them.


def bounds():
    return json.loads(best_known.BOUND_FILE.read_text())["searches"]


@pytest.mark.parametrize("preset", ["isaac", "real"])
def test_a_report_compares_with_it(preset):
    bound = next(one for one in bounds() if one["settings"]["robot.preset"] == preset)
    config = parse_config(
        {"robot": {"preset": preset}, "task": {"max_speed": bound["settings"]["task.max_speed"]}}
    )
    goals = np.array(bound["goals"][:16]) / 1e3
    steps = np.array(bound["steps"][:16])
    episodes = make_episodes(goals, np.ones(16))._replace(steps=1.1 * steps)
    np.testing.assert_array_equal(best_known.find("bound", config, episodes), steps)
    found, _ = compare_with("bound", config, episodes)
    assert found is not None
    assert found.total.gap == pytest.approx(0.1)


def test_another_robot_has_none():
    config = parse_config({"robot": {"friction": 0.5}})
    goals = np.array(bounds()[0]["goals"][:4]) / 1e3
    found, reason = compare_with("bound", config, make_episodes(goals, np.ones(4)))
    assert found is None
    assert reason is not None
    assert "the bound was made for robot.preset = isaac, and this run has isaac with" in reason


def test_the_line_says_how_far_the_policy_is_from_it():
    bound = next(one for one in bounds() if one["settings"]["robot.preset"] == "isaac")
    goals, steps = np.array(bound["goals"][:16]) / 1e3, np.array(bound["steps"][:16])
    report = make_report(make_episodes(goals, np.ones(16))._replace(steps=1.1 * steps))
    found, _ = compare_with("bound", report.config, report.episodes)
    mean = steps.mean() / 60
    assert lower_bound_line(report._replace(lower_bound=found)) == (
        f"within 10.00% of what physics allows: {1.1 * mean:.3f} s on average, and no controller"
        f" reaches the same goals in less than {mean:.3f} s\n"
    )
    line = lower_bound_line(report._replace(lower_bound_missing="no bound"))
    assert line == "what physics allows: not known, no bound\n"


# The file of the package, and the search.


def test_the_file_of_the_package_holds_for_a_shipped_configuration():
    values = json.loads(best_known.FILE.read_text())
    assert values["format"] == best_known.FORMAT
    settings = [search["settings"] for search in values["searches"]]
    assert best_known.settings_of(load_config(ROOT / "configs" / "jetbot.yaml")) in settings
    for search in values["searches"]:
        assert set(search["settings"]) == {"robot.preset", *best_known.SETTINGS}
        assert len(search["goals"]) == len(search["steps"])


def test_its_goals_are_the_reports():
    for search in json.loads(best_known.FILE.read_text())["searches"]:
        overrides = [f"{key}={value}" for key, value in search["settings"].items()]
        config = load_config(None, overrides)
        count = len(search["steps"])
        goals = jax.vmap(Gliding(config).reset)(report_keys(count)).goal[:, :2]
        known = best_known.find("search", config, make_episodes(goals, np.ones(count)))
        np.testing.assert_array_equal(known, search["steps"])


@pytest.fixture(scope="module")
def found():
    """A small search by a robot that glides, and the same goals by the scripted baseline."""
    env = Gliding(CONFIG)
    settings = benchmark.Settings(knots=8, samples=64, rounds=8, starts=2)
    return env, *benchmark.run(env, settings, goals=3, chunk=2)


def test_a_search_finds_shorter_ways_than_the_baseline(found):
    _, best, beside = found
    assert best.steps.shape == beside.steps.shape == (3,)
    assert np.all(best.steps < beside.steps)


def test_its_times_are_those_of_the_reports_own_count(found):
    """The commands again, looked up step by step, under the rollout that counts for policies."""
    env, best, _ = found
    for goal, key in enumerate(report_keys(3)):
        commands = jax.tree.map(lambda x, goal=goal: x[goal], best.commands)

        def play(params, state, key):
            del key
            at = state.info["steps"] / params.steps * (len(params.knots) - 1)
            places = np.arange(len(params.knots))
            return jax.numpy.stack(
                [jax.numpy.interp(at, places, params.knots[:, axis]) for axis in range(2)]
            )

        rollout = rollout_fn(env, [play], CONFIG.task.episode_length)
        again = jax.device_get(jax.jit(rollout)(0, commands, key[None]))
        assert (again.success[0], again.steps[0]) == (1, best.steps[goal])


def test_a_search_that_finds_nothing_is_one_line():
    settings = benchmark.Settings(knots=2, samples=2, rounds=1, starts=1)
    with pytest.raises(UserError, match="2 goals were not reached, such as 0: try more --samples"):
        benchmark.run(Gliding(CONFIG), settings, goals=2, chunk=2)


def test_a_search_replaces_one_of_the_same_settings_alone(searched):
    searched()
    searched({"robot": {"preset": "real"}})
    searched(steps=[1] * 8)
    values = json.loads(best_known.FILE.read_text())
    presets = [one["settings"]["robot.preset"] for one in values["searches"]]
    assert sorted(presets) == ["isaac", "real"]
    assert values["searches"][presets.index("isaac")]["steps"] == [1] * 8
    assert values["searches"][presets.index("real")]["steps"] == STEPS.tolist()


@pytest.mark.parametrize("text", ["{}", "[1]", "mine", '{"format": "another/1", "searches": []}'])
def test_a_file_of_something_else_is_refused_before_the_search(tmp_path, monkeypatch, text):
    monkeypatch.setattr(benchmark, "run", lambda *args, **kwargs: pytest.fail("it searches"))
    file = tmp_path / "mine.json"
    file.write_text(text)
    with pytest.raises(
        UserError, match=r"mine\.json is not a file of best-known times: name another"
    ):
        benchmark.main(["--goals", "1", "--output", str(file)])
    assert file.read_text() == text
