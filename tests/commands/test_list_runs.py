"""The command that lists runs."""

import json
import os
import shutil
import time
import webbrowser
from pathlib import Path

import pytest

from helpers.run_folders import make_run
from jetbot_mjx import list_runs
from jetbot_mjx.errors import UserError


@pytest.fixture
def runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    make_run(tmp_path / "runs/older", (0, 10.0, 0.1))
    make_run(tmp_path / "runs/newer", (0, 30.0, 0.2))


def test_the_command_lists_runs_and_what_comes_with_the_package(runs, capsys):
    assert list_runs.main([]) == 0
    out = capsys.readouterr().out
    assert out.index("newer") < out.index("older") < out.index("pretrained:jetbot_egocentric")
    assert list_runs.main(["runs"]) == 0
    assert "pretrained:" not in capsys.readouterr().out


def test_the_command_refuses_what_is_no_folder(capsys):
    with pytest.raises(SystemExit) as left:
        list_runs.main(["nowhere"])
    assert left.value.code == 2
    assert "nowhere is not a folder" in capsys.readouterr().err


def test_the_list_is_filtered_sorted_and_printed_as_json(runs, capsys):
    assert list_runs.main(["runs", "--sort", "name", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [(run["name"], run["success_rate"]) for run in found] == [("newer", 0.2), ("older", 0.1)]
    assert list_runs.main(["--filter", "OLD"]) == 0
    out = capsys.readouterr().out
    assert "older" in out
    assert "newer" not in out
    assert list_runs.main(["runs", "--sort", "success"]) == 0
    out = capsys.readouterr().out
    assert out.index("newer") < out.index("older")


def test_a_filter_that_nothing_matches_says_so_once(runs, capsys):
    assert list_runs.main(["--filter", "nothing"]) == 0
    assert capsys.readouterr().out == "no run has 'nothing' in its name or task\n"
    # Of those that come with the package, none of the user's.
    assert list_runs.main(["--filter", "pretrained:best_ego"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["with", "run", "pretrained:best_egocentric"]


def test_of_several_seeds_the_mean_is_listed(tmp_path, capsys):
    run = make_run(tmp_path / "two", seeds=2)
    for seed, (steps, rate) in enumerate([(200, 0.5), (100, 0.9)]):
        make_run(run / f"seed-{seed}", (50, 1.0, 0.1), (steps, 2.0, rate))
    assert list_runs.main([str(tmp_path)]) == 0
    line = capsys.readouterr().out.splitlines()[1]
    assert " 100 " in line
    assert " 70.0% (2 seeds)" in line
    assert list_runs.main([str(tmp_path), "--json"]) == 0
    (found,) = json.loads(capsys.readouterr().out)
    assert (found["seeds"], found["success_rate"]) == (2, pytest.approx(0.7))


def test_the_newest_report_is_opened(runs, monkeypatch, capsys):
    with pytest.raises(UserError, match="has no report: write one with `jetbot-mjx evaluate"):
        list_runs.main(["--open", "latest"])
    opened = []
    monkeypatch.setattr(webbrowser, "open", lambda url: bool(opened.append(url)))
    for age, name in ((5, "000000000010"), (2, "000000000005")):
        page = Path("runs/newer/evaluations", name, "report.html")
        page.parent.mkdir(parents=True)
        page.write_text("")
        os.utime(page, (time.time() - age,) * 2)
    assert list_runs.main(["--open", "latest"]) == 0
    assert opened == [page.resolve().as_uri()]
    assert "no browser was found" in capsys.readouterr().out


def test_of_several_seeds_their_comparison_is_opened(runs, monkeypatch):
    make_run(Path("runs/both/seed-0"), (0, 10.0, 0.1))
    shutil.copy("runs/both/seed-0/config.yaml", "runs/both/config.yaml")
    opened = []
    monkeypatch.setattr(webbrowser, "open", lambda url: bool(opened.append(url)))
    page = Path("runs/both/evaluations/comparison/comparison.html")
    with pytest.raises(UserError, match="runs/both has no report"):
        list_runs.main(["--open", "both"])
    page.parent.mkdir(parents=True)
    page.write_text("")
    assert list_runs.main(["--open", "both"]) == 0
    assert opened == [page.resolve().as_uri()]


def test_two_runs_are_compared_by_name(runs, capsys):
    assert list_runs.main(["--compare", "older", "newer"]) == 0
    out = capsys.readouterr().out
    assert "10.0%" in out
    assert "20.0%" in out
    assert "all settings are equal" in out
    with pytest.raises(SystemExit):
        list_runs.main(["--compare", "latest", "newer"])
    assert "--compare latest newer: both are the same run, runs/newer" in capsys.readouterr().err


def test_a_run_is_deleted_after_a_question(runs, monkeypatch, capsys):
    with pytest.raises(UserError, match="nobody can be asked here: add --yes"):
        list_runs.main(["--delete", "older"])
    monkeypatch.setattr("sys.stdin.isatty", lambda: True, raising=False)
    questions = []
    for answer in ("", "n"):
        monkeypatch.setattr("builtins.input", lambda text, a=answer: questions.append(text) or a)
        assert list_runs.main(["--delete", "older"]) == 0
        assert capsys.readouterr().out == "nothing was deleted\n"
    assert questions[0].startswith("delete runs/older, 0 steps of ")
    assert Path("runs/older").is_dir()
    assert list_runs.main(["--delete", "older", "--yes"]) == 0
    assert not Path("runs/older").exists()
    assert Path("runs/newer").is_dir()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--delete", "pretrained:jetbot_egocentric"], "it comes with the package and stays"),
        (["--delete", "runs"], "--delete runs: there is no run in this folder"),
    ],
)
def test_only_a_run_of_the_user_is_deleted(runs, arguments, said):
    with pytest.raises(UserError, match=said):
        list_runs.main([*arguments, "--yes"])
    assert Path("runs/older").is_dir()


@pytest.mark.parametrize("action", [["--open"], ["--delete"], ["--compare", "older"]])
def test_a_name_of_no_run_is_refused_as_such(runs, action):
    with pytest.raises(
        UserError, match=r"^no run at .*/old: no such folder; did you mean older\?$"
    ):
        list_runs.main([*action, "old"])


@pytest.mark.parametrize("action", [["--open", "latest"], ["--delete", "latest", "--yes"]])
@pytest.mark.parametrize(
    "given", [["--filter", "older"], ["--sort", "name"], ["--sort", "age"], ["--json"], ["runs"]]
)
def test_what_is_for_the_list_is_refused_beside_a_run(runs, action, given, capsys):
    with pytest.raises(SystemExit) as left:
        list_runs.main([*given, *action])
    assert left.value.code == 2
    said = f"error: {given[0]}: it is for the list, and {action[0]} takes a run itself"
    assert said in capsys.readouterr().err
    assert Path("runs/newer").is_dir()


def test_a_link_to_a_run_is_not_deleted(runs):
    Path("runs/link").symlink_to("older")
    with pytest.raises(UserError, match=r"it is a link: name the folder, .*/runs/older$"):
        list_runs.main(["--delete", "link", "--yes"])
    assert Path("runs/older").is_dir()


def test_yes_alone_is_refused(capsys):
    with pytest.raises(SystemExit) as left:
        list_runs.main(["--yes"])
    assert left.value.code == 2
    assert "--yes: it belongs to --delete" in capsys.readouterr().err
