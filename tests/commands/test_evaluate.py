"""The command `evaluate`: its files are the same each time, and its pages agree with the JSON."""

import contextlib
import io
import json
import re
import shutil
from html.parser import HTMLParser

import jax
import numpy as np
import pytest
from PIL import Image

from helpers import gliding
from helpers.command_modules import evaluate
from helpers.further import slow_fixture
from helpers.unpainted import unpainted
from jetbot_mjx import cli, evaluation
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation import (
    compare_runs,
    evaluate_in_mujoco,
    evaluate_run,
    evaluate_runs,
    html_report,
)
from jetbot_mjx.evaluation.evaluator import BASELINES, Summary, json_values
from jetbot_mjx.evaluation.robustness import SWEEPS, SweepResult
from jetbot_mjx.evaluation.tables import policies_table
from jetbot_mjx.runs import checkpoint_store
from jetbot_mjx.runs.checkpoint import load_checkpoint

EPISODES = 48
CURVES = {"learning_curve.png", "losses.png"}
FIGURES = {"by_goal.png", "trajectories.png", "distributions.png"} | CURVES
PAGES = {"report.html", "report.md", "report.json"}


def judge(*arguments):
    """Exit code and output of the command."""
    with contextlib.redirect_stdout(io.StringIO()) as out:
        code = evaluate.main([*map(str, arguments), "--episodes", str(EPISODES)])
    return code, out.getvalue()


def files(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


class Numbers(HTMLParser):
    """The numbers of a page that name their place in the JSON file, and what it loads."""

    def __init__(self, text):
        super().__init__()
        self.found, self.loaded, self.tags = [], [], set()
        self._inside = None
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        attrs = dict(attrs)
        self.tags.add(tag)
        self.loaded += [attrs[name] for name in ("src", "srcset") if name in attrs]
        self.loaded += [attrs["href"]] if tag == "link" else []
        self._inside = attrs if tag == "data" else None

    def handle_data(self, data):
        if self._inside is not None:
            self.found.append((self._inside["data-json"], self._inside["value"], data))
            self._inside = None


def look_up(values, place):
    for key in place.split("."):
        values = values[int(key)] if isinstance(values, list) else values[key]
    return values


def check_numbers(page, values):
    """Every number is the JSON file's, and reads as it; returns the places."""
    numbers = Numbers(page.read_text("utf-8")).found
    for place, exact, shown in numbers:
        value = look_up(values, place)
        assert json.loads(exact) == value, place
        if value is None:
            assert shown == "-"
            continue
        digits = re.match(r"[+-]?[\d,]+(\.\d+)?(e[+-]\d+)?", shown)
        scale = 100 if "%" in shown else 1
        decimals = len(digits[1] or ".") - 1
        if digits[2]:
            assert float(digits[0]) == pytest.approx(value, rel=0.05)
        elif "p" in place.split("."):
            assert float(digits[0]) == pytest.approx(value, rel=0.05, abs=5e-5)
        else:
            told = float(digits[0].replace(",", ""))
            assert told == pytest.approx(value * scale, abs=0.5001 * 10**-decimals), place
    return {place for place, _, _ in numbers}


@pytest.fixture(scope="module", autouse=True)
def glide(smoke_run):
    """All robots of these tests glide, after the run was trained with those that do not."""
    with gliding.everywhere():
        yield


@pytest.fixture(scope="module")
def judged(smoke_run, tmp_path_factory):
    """A run evaluated twice: its folder, the report's, and both evaluations' files and output."""
    run_dir = shutil.copytree(smoke_run, tmp_path_factory.mktemp("judged") / "run")
    texts, left = [], []
    for _ in range(2):
        shutil.rmtree(run_dir / "evaluations", ignore_errors=True)
        code, out = judge(run_dir)
        assert code == 0
        (folder,) = (run_dir / "evaluations").iterdir()
        texts.append(out)
        left.append(files(folder))
    return run_dir, folder, left, texts


@pytest.mark.slow
def test_two_evaluations_leave_the_same_bytes(judged):
    _, _, (first, second), (said, again) = judged
    assert set(first) == FIGURES | PAGES
    assert first == second
    assert said == again


def test_the_terminal_shows_the_headline_and_names_the_page(judged):
    _, folder, (first, _), (said, _) = judged
    policy = json.loads(first["report.json"])["policy"]
    for name in ("policy", *BASELINES):
        assert f"\n{name} " in said
    assert f"{policy['success_rate']:.2%}" in said
    assert said.splitlines()[-1] == f"report: {folder / 'report.html'}"


def test_the_json_file_holds_the_whole_report(judged):
    run_dir, _, (first, _), _ = judged
    values = json.loads(first["report.json"])
    policy = values["policy"]
    assert set(values["baselines"]) == set(BASELINES)
    assert (policy["episodes"], values["goal_set_version"]) == (EPISODES, 1)
    assert policy["success_low"] <= policy["success_rate"] <= policy["success_high"]
    assert sum(cell["successes"] for cell in values["cells"]) == policy["successes"]
    assert len(values["failures"]) == EPISODES - policy["successes"]
    lines = [json.loads(line) for line in (run_dir / "metrics.jsonl").read_text().splitlines()]
    curve = [(point["env_steps"], point["success_rate"]) for point in values["learning_curve"]]
    assert curve == [(line["env_steps"], line["eval/success_rate"]) for line in lines]


def test_the_page_tells_the_numbers_of_the_json_file(judged):
    _, folder, (first, _), _ = judged
    values = json.loads(first["report.json"])
    places = check_numbers(folder / "report.html", values)
    policy = set(values["policy"]) - {"success_low", "success_high", "nonfinite_envs"}
    assert {f"policy.{name}" for name in policy} <= places
    assert {f"baselines.{name}.success_rate" for name in BASELINES} <= places
    assert {f"cells.{i}.success_high" for i in range(len(values["cells"]))} <= places
    assert {f"failures.{i}.final_distance" for i in range(len(values["failures"]))} <= places


def test_a_page_loads_nothing(judged):
    _, folder, _, _ = judged
    page = Numbers((folder / "report.html").read_text("utf-8"))
    images = [one for one in page.loaded if one.startswith("data:image/png;base64,")]
    clips = [one for one in page.loaded if one.startswith("data:video/mp4;base64,")]
    assert len(images) == 2 * len(FIGURES)
    assert len(images) + len(clips) == len(page.loaded)
    assert sum(map(len, clips)) < 3_000_000
    assert "script" not in page.tags
    assert "url(" not in (folder / "report.html").read_text("utf-8")


def test_the_markdown_shows_the_figures_beside_it(judged):
    _, _, (first, _), _ = judged
    text = first["report.md"].decode()
    shown = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", text)
    assert set(shown) == FIGURES
    policy = json.loads(first["report.json"])["policy"]
    assert text.startswith(f"# run: {policy['success_rate']:.2%}\n")
    tables = [block for block in text.split("\n\n") if block.startswith("|")]
    for table in tables:
        assert len({line.count("|") for line in table.strip().splitlines()}) == 1


@pytest.mark.slow
@pytest.mark.usefixtures("blank_figures")
def test_a_sweep_is_reported_with_a_table_and_a_figure(judged, tmp_path, monkeypatch):
    run_dir, _, (first, _), _ = judged

    def run(sweeper, params):
        """Fails with every policy on everything but the preset, and asks for no compiler."""
        assert len(sweeper._keys) == EPISODES
        values = json.loads(first["report.json"])["policy"]
        good, bad = (
            Summary(**values)._replace(success_rate=rate, success_low=0.9 * rate, success_high=rate)
            for rate in (1.0, 0.25)
        )
        return tuple(
            SweepResult(
                one,
                tuple(good if value == one.nominal else bad for value in one.values),
                tuple(bad for _ in one.values),
            )
            for one in SWEEPS
        )

    monkeypatch.setattr(evaluate_runs.Sweeper, "run", run)
    code, said = judge(run_dir, "--robustness", "--output", tmp_path)
    assert code == 0
    assert "wheel-floor friction        1 to 1 × preset" in said
    values = json.loads((tmp_path / "report.json").read_text())
    places = check_numbers(tmp_path / "report.html", values)
    assert {"robustness.quantities.0.carries.1", "robustness.quantities.5.lowest"} <= places
    assert values["robustness"]["quantities"][4]["lowest"] == 0.25
    assert (tmp_path / "robustness.png").is_file()
    page = (tmp_path / "report.md").read_text()
    assert "| delay of actions | control steps | 0 | 0 to 0 | 0 to 9 | 25.00% |" in page
    assert json.loads(first["report.json"])["robustness"] is None
    # The other simulator is part of it.
    assert values["mujoco"]["policy"]["episodes"] == EPISODES
    # A report without it leaves none of an earlier one beside it.
    assert judge(run_dir, "--output", tmp_path)[0] == 0
    assert not (tmp_path / "robustness.png").exists()


@pytest.mark.slow
@pytest.mark.usefixtures("blank_figures")
def test_another_simulator_is_told_beside_the_one_of_the_training(judged, tmp_path):
    run_dir, _, (first, _), _ = judged
    code, said = judge(run_dir, "--simulator", "mujoco", "--output", tmp_path)
    assert code == 0
    assert "\npolicy in C MuJoCo " in said
    values = json.loads((tmp_path / "report.json").read_text())
    own = json.loads(first["report.json"])
    assert own["mujoco"] is None
    assert values["policy"] == own["policy"]
    found = values["mujoco"]["policy"]
    assert (found["episodes"], found["nonfinite_envs"]) == (EPISODES, 0)
    assert values["mujoco"]["randomized"] is None
    numerics = values["mujoco"]["numerics"]
    assert (numerics["substeps"], numerics["cone"]) == (8, "elliptic")
    places = check_numbers(tmp_path / "report.html", values)
    assert {"mujoco.policy.success_rate", "mujoco.numerics.solref.0"} <= places
    page = (tmp_path / "report.md").read_text("utf-8")
    assert f"| in C MuJoCo | {found['success_rate']:.2%} |" in page
    assert "implicitfast with 8 steps per control step, elliptic friction cone" in page
    assert f"--episodes {EPISODES} --simulator mujoco\n" in page
    # And without a report, the same again.
    again = evaluate_in_mujoco(run_dir, episodes=EPISODES)
    assert json.loads(json.dumps(json_values(again._asdict()))) == values["mujoco"]


def test_another_simulator_that_there_is_not_is_refused(judged, capfd):
    run_dir, _, _, _ = judged
    with pytest.raises(SystemExit) as caught:
        judge(run_dir, "--simulator", "isaac")
    assert caught.value.code == 2
    assert "argument --simulator: invalid choice: 'isaac'" in capfd.readouterr().err


@pytest.mark.slow
@pytest.mark.usefixtures("blank_figures")
def test_ranges_of_a_file_are_evaluated_beside_the_preset(judged, tmp_path):
    run_dir, _, (first, _), _ = judged
    ranges = tmp_path / "ranges.yaml"
    ranges.write_text("randomization: {motor_gain: [0.1, 0.11]}")
    elsewhere = "--simulator", "mujoco"
    code, said = judge(run_dir, "--ranges", ranges, *elsewhere, "--output", tmp_path / "report")
    assert code == 0
    assert "policy, randomised robots" in said
    assert "policy in C MuJoCo, randomised robots" in said
    values = json.loads((tmp_path / "report" / "report.json").read_text())
    assert values["ranges"] == {"motor_gain": [0.1, 0.11]}
    assert values["policy"] == json.loads(first["report.json"])["policy"]
    # A robot with a tenth of the speed reaches no goal in time.
    assert values["randomized"]["success_rate"] == 0.0 < values["policy"]["success_rate"]
    there = values["mujoco"]
    assert there["randomized"]["success_rate"] == 0.0 < there["policy"]["success_rate"]
    check_numbers(tmp_path / "report" / "report.html", values)
    page = (tmp_path / "report" / "report.md").read_text()
    assert "| randomised robots | 0.00% |" in page
    assert "| in C MuJoCo, randomised robots | 0.00% |" in page
    assert f"--ranges {ranges}" in page
    assert json.loads(first["report.json"])["randomized"] is None


def test_a_file_without_ranges_is_refused(judged, root):
    run_dir, _, _, _ = judged
    with pytest.raises(
        UserError, match=r"smoke\.yaml: it randomizes nothing; give a configuration"
    ):
        evaluate_run(run_dir, ranges=root / "configs" / "smoke.yaml")


def test_figures_are_drawn_for_light_and_dark_surroundings(judged):
    _, folder, _, _ = judged
    page = (folder / "report.html").read_text("utf-8")
    pair = r'<img class="light" src="([^"]+)" alt="[^"]+">\s*<img class="dark" src="([^"]+)"'
    light, dark = re.search(pair, page).groups()
    assert dark != light
    assert Image.open(folder / "by_goal.png").convert("RGB").getpixel((0, 0)) == (255, 255, 255)


@pytest.mark.usefixtures("blank_figures")
def test_a_target_that_is_missed_costs_exit_code_1(judged):
    run_dir, _, _, _ = judged
    code, said = judge(run_dir, "--checkpoint", "0", "--min-success", "0.5")
    assert code == 1
    assert "is below the 50.00% asked for" in said


@pytest.fixture(scope="module")
def still(smoke_run, tmp_path_factory):
    """A run folder of a policy that never moves, with nothing in it but the checkpoint."""
    checkpoint = load_checkpoint(smoke_run)
    policy = jax.tree.map(np.zeros_like, jax.device_get(checkpoint.params.policy))
    last = max(policy["params"])
    policy["params"][last]["bias"][0] = -20.0
    folder = tmp_path_factory.mktemp("still") / "a still run"
    folder.mkdir()
    about = {key: checkpoint.about[key] for key in checkpoint.about if key != "sha256"}
    with checkpoint_store.CheckpointStore(folder, keep=1) as checkpoints:
        params = checkpoint.params._replace(policy=policy)
        checkpoints.save(checkpoint.env_steps, {"policy": params}, about, 0.0)
    return folder


@pytest.fixture(scope="module")
def hopeless(still, tmp_path_factory):
    """That policy's report, written elsewhere than into the run folder."""
    folder = tmp_path_factory.mktemp("hopeless") / "out"
    with unpainted():
        return evaluate_run(still, episodes=EPISODES, output=folder)


def test_a_policy_that_reaches_nothing_gets_its_report(hopeless, still):
    said = policies_table({"policy": hopeless})
    assert re.search(r"\npolicy +0\.00% +0\.00% \.\. [\d.]+% +- +- +- ", said)
    assert not (still / "evaluations").exists()
    values = json.loads((hopeless.folder / "report.json").read_text())
    policy = values["policy"]
    assert (policy["successes"], policy["success_rate"], policy["success_low"]) == (0, 0.0, 0.0)
    assert policy["time_to_goal_median"] is None
    assert {failure["ended"] for failure in values["failures"]} == {"time limit"}
    assert [failure["goal"] for failure in values["failures"]] == list(range(EPISODES))
    places = check_numbers(hopeless.folder / "report.html", values)
    assert "policy.time_to_goal_median" in places
    page = (hopeless.folder / "report.html").read_text("utf-8")
    assert "--goals 0,1,2,3,4,5,6,7</code>" in page
    assert "holds no evaluations of the training" in page
    assert set(files(hopeless.folder)) == PAGES | FIGURES - CURVES


@pytest.mark.usefixtures("blank_figures")
def test_a_long_list_of_failures_is_cut_on_the_pages_alone(hopeless, tmp_path, monkeypatch):
    monkeypatch.setattr(html_report, "LISTED_FAILURES", 5)
    html_report.write_report(hopeless._replace(folder=tmp_path))
    for name in ("report.html", "report.md"):
        text = (tmp_path / name).read_text("utf-8")
        assert len(re.findall(r"--goals \d+[<`]", text)) == 5
        assert f"{EPISODES - 5} more are in" in text
    assert len(json.loads((tmp_path / "report.json").read_text())["failures"]) == EPISODES


# Several policies.


@slow_fixture(scope="module")
def several(smoke_run, still, tmp_path_factory):
    """A folder of two seeds, the second less trained, and the still run, compared."""
    folder = tmp_path_factory.mktemp("several")
    for seed, steps in enumerate((65_536, 32_768)):
        seed_dir = folder / "five" / f"seed-{seed}"
        shutil.copytree(smoke_run, seed_dir)
        for checkpoint in (seed_dir / "checkpoints").iterdir():
            if int(checkpoint.name) != steps:
                shutil.rmtree(checkpoint)
    shutil.copytree(still, folder / "still")
    runs = folder / "five", folder / "still"
    with unpainted():
        return folder, *judge(*runs, "--min-success", "0.01", "--simulator", "mujoco")


@pytest.mark.slow
def test_runs_are_compared_beside_their_own_reports(several):
    folder, code, said = several
    home = folder / "five" / "evaluations" / f"comparison-{EPISODES}-goals"
    assert set(files(home)) == {
        *("comparison.html", "comparison.md", "comparison.json"),
        *("runs.png", "learning_curves.png"),
    }
    values = json.loads((home / "comparison.json").read_text())
    assert [run["name"] for run in values["runs"]] == ["five", "still"]
    assert [len(run["seeds"]) for run in values["runs"]] == [2, 1]
    rates = [seed["policy"]["success_rate"] for seed in values["runs"][0]["seeds"]]
    success = values["runs"][0]["success_rate"]
    assert (success["over"], success["mean"]["value"]) == ("seeds", np.mean(rates))
    assert success["mean"]["low"] == min(rates)
    assert values["runs"][1]["success_rate"]["over"] == "episodes"
    assert values["pairs"][0]["success_rate"]["losses"] == 0
    elsewhere = [seed["mujoco"]["policy"] for run in values["runs"] for seed in run["seeds"]]
    assert [one["episodes"] for one in elsewhere] == [EPISODES] * 3
    assert elsewhere[2]["success_rate"] == 0.0 < elsewhere[0]["success_rate"]
    for name in ("five seed-0", "five seed-1", "still"):
        assert re.search(rf"^{name} in C MuJoCo +\d", said, re.MULTILINE)
    assert said.splitlines()[-2] == f"report: {home / 'comparison.html'}"
    # The still run is below the target; one is enough.
    assert code == 1
    assert said.splitlines()[-1].startswith("still: success 0.00% is below")


def test_the_comparison_tells_the_numbers_of_its_json_file(several):
    home = several[0] / "five" / "evaluations" / f"comparison-{EPISODES}-goals"
    values = json.loads((home / "comparison.json").read_text())
    places = check_numbers(home / "comparison.html", values)
    assert {
        "runs.0.success_rate.iqm.high",
        "runs.1.success_rate.mean.low",
        "pairs.0.success_rate.p",
        "runs.0.seeds.1.policy.success_rate",
        "runs.0.seeds.1.mujoco.policy.success_rate",
        "baselines.scripted.success_rate",
    } <= places
    page = (home / "comparison.html").read_text("utf-8")
    links = re.findall(r'<a href="([^"]+)"', page)
    links += re.findall(r"\]\(([^)]+\.(?:md|png))\)", (home / "comparison.md").read_text("utf-8"))
    assert len(links) == 8
    assert all((home / link).is_file() for link in links)


@pytest.mark.usefixtures("blank_figures")
def test_seeds_of_one_run_are_a_comparison_without_a_pair(several, tmp_path, monkeypatch):
    run = several[0] / "five"
    written = {path: path.stat().st_mtime_ns for path in run.rglob("evaluations/*/report.json")}
    comparison = compare_runs([run], episodes=EPISODES, output=tmp_path)
    # The reports that are there have the other simulator too, so they stay.
    reports = run.rglob("evaluations/*/report.json")
    assert {path: path.stat().st_mtime_ns for path in reports} == written
    assert len(written) == 2
    values = json.loads((tmp_path / "comparison.json").read_text())
    assert values["pairs"] == []
    check_numbers(tmp_path / "comparison.html", values)
    before = files(tmp_path)
    html_report.write_comparison(comparison)
    assert files(tmp_path) == before
    monkeypatch.setattr(evaluation, "compare_runs", lambda *args, **kwargs: comparison)
    mean = values["runs"][0]["success_rate"]["mean"]["value"]
    code, said = judge(run, "--min-success", mean)
    assert code == 0
    assert re.search(r"^seed-0 +\d", said, re.MULTILINE)
    assert re.search(r"^five .* 2 seeds$", said, re.MULTILINE)
    assert judge(run, "--min-success", mean + 0.01)[0] == 1


def test_checkpoints_of_one_run_are_told_apart_by_their_steps(several, tmp_path, monkeypatch):
    folder, _, _ = several
    run = folder / "five" / "seed-0"
    monkeypatch.setattr(
        evaluate_runs._Reporter, "write", lambda *args, **kwargs: pytest.fail("they are the same")
    )
    with pytest.raises(UserError, match=r"are the same policy, .*000000065536: name each once"):
        judge(run, run / "checkpoints" / "000000065536")
    with pytest.raises(UserError, match="are the same policy"):
        judge(folder / "five", run)


def test_names_take_as_much_of_the_path_as_they_need(several, smoke_run, tmp_path):
    for name in ("x/run", "y/run"):
        shutil.copytree(smoke_run, tmp_path / name)
    paths = [tmp_path / "x" / "run", tmp_path / "y" / "run"]
    assert list(evaluate_runs._load_runs(paths, "best")) == ["x/run", "y/run"]
    paths = [paths[0] / "checkpoints" / f"{steps:012d}" for steps in (0, 65_536)]
    assert list(evaluate_runs._load_runs(paths, "best")) == ["run @ 0", "run @ 65,536"]


def test_runs_with_different_things_to_do_are_refused_before_anything_is_written(
    smoke_run, tmp_path, capfd
):
    for name in ("a", "b"):
        shutil.copytree(smoke_run, tmp_path / name)
    about = tmp_path / "b" / "checkpoints" / "000000065536" / "about" / "metadata"
    values = json.loads(about.read_text())
    values["config"]["robot"]["preset"] = "real"
    del values["sha256"]["about"]
    values["sha256"]["about"] = checkpoint_store._digest_json(values)
    about.write_text(json.dumps(values))
    arguments = [str(tmp_path / name) for name in ("a", "b")]
    with pytest.raises(SystemExit) as caught:
        cli.run_command(lambda _: evaluate.main([*arguments, "--checkpoint", "65536"]))
    out, err = capfd.readouterr()
    assert (caught.value.code, out) == (2, "")
    assert err == (
        "error: b cannot be compared with a: robot.preset = 'real', and not 'isaac'; compare runs"
        " of one task and one robot\n"
    )
    assert not list(tmp_path.rglob("evaluations"))
