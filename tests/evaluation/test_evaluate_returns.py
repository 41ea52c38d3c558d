"""`evaluate` of runs in an environment of one's own: files, numbers, refusals."""

import contextlib
import io
import json
import re

import pytest

from helpers import point_mass
from helpers.command_modules import evaluate
from helpers.further import slow_fixture
from jetbot_mjx import library, training
from jetbot_mjx.errors import InvalidError, UserError
from jetbot_mjx.evaluation import compare_runs, evaluate_returns, evaluate_run
from jetbot_mjx.runs import TaskCode

EPISODES = 32


@slow_fixture(scope="module")
def folder(tmp_path_factory):
    """A run of one seed and one of two, in an environment that tells successes."""
    folder = tmp_path_factory.mktemp("returns")
    for name, seeds in (("one", 1), ("two", 2)):
        options = {"succeeds": True}
        config = point_mass.config(environment_options=options, seeds=seeds, seed=seeds)
        training.run(config, folder / name)
    return folder


@pytest.fixture(scope="module")
def compared(folder):
    """What the command says about both runs; it writes their reports too."""
    with contextlib.redirect_stdout(io.StringIO()) as out:
        runs = [str(folder / name) for name in ("one", "two")]
        code = evaluate.main([*runs, "--episodes", str(EPISODES), "--min-success", "1"])
    assert code == 1
    return out.getvalue()


def read(path):
    return json.loads(path.read_text("utf-8"))


def look_up(values, place):
    for key in place.split("."):
        values = values[int(key)] if isinstance(values, list) else values[key]
    return values


def places_of(page, values):
    """The places in the JSON file whose numbers a page tells."""
    found = re.findall(r'<data value="([^"]*)" data-json="([^"]*)">', page.read_text("utf-8"))
    for exact, place in found:
        assert json.loads(exact) == look_up(values, place)
    return {place for _, place in found}


@pytest.mark.slow
def test_a_report_holds_the_returns_and_shows_them(folder, compared):
    home = folder / "one" / "evaluations" / f"000000002048-{EPISODES}-episodes"
    assert {path.name for path in home.iterdir()} == {
        *("report.html", "report.md", "report.json", "returns.png", "learning_curve.png")
    }
    values = read(home / "report.json")
    policy = values["policy"]
    assert (policy["episodes"], len(values["returns"])) == (EPISODES, EPISODES)
    assert policy["episode_return"] == pytest.approx(sum(values["returns"]) / EPISODES)
    assert policy["return_min"] == min(values["returns"])
    assert policy["success_low"] <= policy["success_rate"] <= policy["success_high"]
    assert set(values["baselines"]) == {"random", "zero"}
    assert 0 <= policy["metrics"]["near"] <= 16
    lines = (folder / "one" / "metrics.jsonl").read_text("utf-8").splitlines()
    logged = [json.loads(line) for line in lines]
    assert all(0 <= line["eval/metrics/near"] <= 16 for line in logged)
    shown = f"<tr><th>near</th><td>{policy['metrics']['near']:,.4g}</td>"
    assert shown in (home / "report.html").read_text("utf-8")
    # Where no force acts, the point stays where it began, and every reward is the same.
    assert values["baselines"]["zero"]["episode_length"] == 16
    steps = [point["env_steps"] for point in values["learning_curve"]]
    assert steps == [0, 1024, 2048]
    assert values["settings"]["environment_options.succeeds"] is True
    assert [what for what, _ in values["fallbacks"]] == ["ppo.update"]
    places = places_of(home / "report.html", values)
    assert {"policy.episode_return", "policy.return_low", "baselines.zero.return_min"} <= places
    assert "policy.success_high" in places
    assert f"| {policy['episode_return']:.2f} |" in (home / "report.md").read_text("utf-8")


def test_a_comparison_is_over_seeds_and_episodes(folder, compared):
    home = folder / "one" / "evaluations" / f"comparison-{EPISODES}-episodes"
    values = read(home / "comparison.json")
    assert [run["episode_return"]["over"] for run in values["runs"]] == ["episodes", "seeds"]
    own = folder / "two" / "seed-2" / "evaluations" / f"000000002048-{EPISODES}-episodes"
    assert values["runs"][1]["seeds"][0]["policy"] == read(own / "report.json")["policy"]
    places = places_of(home / "comparison.html", values)
    assert {"runs.1.episode_return.mean.low", "pairs.0.episode_return.p"} <= places
    assert (home / "comparison.md").read_text("utf-8").startswith("# one, two\n")
    lines = compared.splitlines()
    assert re.match(r"one: success \d+\.\d\d% is below the 100.00% asked for", lines[-2])
    assert lines[-3] == f"report: {home / 'comparison.html'}"


@pytest.mark.usefixtures("blank_figures")
def test_a_comparison_tells_that_the_code_is_not_the_same(folder, tmp_path, monkeypatch, capsys):
    # Each run stores the code that it was trained in; these two stored none.
    stored = {"one": b"mass = 1", "two": b"mass = 2"}

    def read_code(run_dir):
        name = next(x for x in stored if x in run_dir.parts)
        return TaskCode("mass", (("mass.py", stored[name]),))

    monkeypatch.setattr(evaluate_returns, "read_task_code", read_code)
    arguments = [str(folder / name) for name in stored]
    evaluate.main([*arguments, "--episodes", "2", "--output", str(tmp_path)])
    told = (
        "the environments of one and two are not the same code: mass.py differs: their returns may"
        " not be comparable"
    )
    assert told in capsys.readouterr().out.splitlines()
    assert read(tmp_path / "comparison.json")["other_code"] == [told]
    for page in ("comparison.html", "comparison.md"):
        assert told in (tmp_path / page).read_text("utf-8")


@pytest.mark.usefixtures("blank_figures")
def test_a_comparison_of_other_runs_is_kept_and_one_of_the_same_replaced(folder, capsys):
    one, two = folder / "one", folder / "two"
    for others, name in (
        ([two / "seed-2"], "comparison-2-episodes"),
        ([two / "seed-3"], "comparison-2-episodes-2"),
        ([two / "seed-2"], "comparison-2-episodes"),
        ([two], "comparison-2-episodes-3"),
    ):
        found = compare_runs([one, *others], episodes=2)
        assert found.folder == one / "evaluations" / name
    said = evaluate.main([str(one), str(two), "--episodes", "2"])
    assert said == 0
    first = one / "evaluations" / "comparison-2-episodes"
    assert capsys.readouterr().out.splitlines()[-1] == (
        f"report: {first}-3/comparison.html (the one of one, seed-2 in {first} stays as it is)"
    )


@pytest.mark.usefixtures("blank_figures")
def test_from_python_the_same_numbers_come(folder, compared, tmp_path):
    report = library.evaluate(folder / "one", episodes=EPISODES, output=tmp_path)
    values = read(tmp_path / "report.json")
    home = folder / "one" / "evaluations" / f"000000002048-{EPISODES}-episodes"
    assert values == read(home / "report.json")
    assert report.policy.episode_return == values["policy"]["episode_return"]


@pytest.mark.parametrize(
    ("name", "value"), [("robustness", True), ("simulator", "mujoco"), ("ranges", "real_jetbot")]
)
def test_what_is_for_robots_is_refused(folder, name, value):
    told = rf"{name} is for robots, and the run has environment = 'helpers.point_mass:PointMass'"
    with pytest.raises(InvalidError, match=told):
        evaluate_run(folder / "one", **{name: value})
    with pytest.raises(InvalidError, match=told):
        compare_runs([folder / "one", folder / "two"], **{name: value})


def test_a_robot_is_not_compared_with_an_environment(folder):
    with pytest.raises(UserError, match=r"cannot be compared with .*: environment = None, and not"):
        compare_runs([folder / "one", "pretrained:jetbot_egocentric"])


@pytest.mark.slow
def test_a_target_needs_successes(tmp_path):
    training.run(point_mass.config(), tmp_path / "silent")
    with pytest.raises(UserError, match=r"--min-success 0\.5: the environment has no metric"):
        evaluate.main([str(tmp_path / "silent"), "--episodes", "2", "--min-success", "0.5"])
