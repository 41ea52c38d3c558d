"""Names of result folders: a short evaluation replaces no fuller one."""

import errno
import json
import types

import pytest

from jetbot_mjx.errors import UnreadableError
from jetbot_mjx.evaluation.goal_set import GOAL_SET_VERSION, REPORT_GOALS
from jetbot_mjx.evaluation.result_names import (
    PARTS,
    comparison_folder,
    find_report,
    fuller_report,
    kept_line,
    name_with_count,
    path_from,
    report_folder,
)
from jetbot_mjx.runs import run_dir

STEPS = "000000065536"
ALL, NONE = frozenset(PARTS), frozenset()


def write(folder, goals, parts, version=GOAL_SET_VERSION):
    folder.mkdir(parents=True, exist_ok=True)
    values = {part: {} if part in parts else None for part in PARTS if part != "rendered"}
    if "rendered" in parts:
        values["mujoco"] = {"rendered": {}}
    values |= {"goal_set_version": version, "policy": {"episodes": goals}}
    (folder / "report.json").write_text(json.dumps(values))


def test_names_say_a_number_that_is_not_the_default():
    assert name_with_count("episodes", 20, 20) == "episodes"
    assert name_with_count("episodes", 3, 20) == "episodes-3"
    assert name_with_count("episodes", 100, 20) == "episodes-100"
    assert name_with_count("comparison", 16, 1024, "-goals") == "comparison-16-goals"


@pytest.mark.parametrize(
    ("goals", "name"),
    [(16, f"{STEPS}-16-goals"), (REPORT_GOALS, STEPS), (4 * REPORT_GOALS, STEPS)],
)
def test_a_report_on_few_goals_has_a_folder_of_its_own(tmp_path, goals, name):
    assert report_folder(tmp_path, STEPS, goals, NONE).name == name
    # The same again takes the place of the earlier one.
    write(tmp_path / name, goals, NONE)
    assert report_folder(tmp_path, STEPS, goals, NONE).name == name
    assert report_folder(tmp_path, STEPS, goals, ALL).name == name


@pytest.mark.parametrize(
    ("goals", "parts", "name"),
    [
        (REPORT_GOALS, ALL, STEPS),
        (2 * REPORT_GOALS, ALL, STEPS),
        (REPORT_GOALS, NONE, f"{STEPS}-nominal"),
        (REPORT_GOALS, frozenset({"mujoco"}), f"{STEPS}-mujoco"),
        (REPORT_GOALS, frozenset({"mujoco", "randomized"}), f"{STEPS}-mujoco-randomized"),
        (2 * REPORT_GOALS, NONE, f"{STEPS}-2048-goals-nominal"),
        (16, ALL, f"{STEPS}-16-goals"),
    ],
)
def test_a_fuller_report_is_kept(tmp_path, goals, parts, name):
    write(tmp_path / STEPS, REPORT_GOALS, ALL)
    for _ in range(2):
        folder = report_folder(tmp_path, STEPS, goals, parts)
        assert folder.name == name
        write(folder, goals, parts)


def test_a_report_on_more_goals_is_kept(tmp_path):
    write(tmp_path / STEPS, 4096, NONE)
    assert report_folder(tmp_path, STEPS, REPORT_GOALS, NONE).name == f"{STEPS}-nominal"
    assert report_folder(tmp_path, STEPS, 4096, NONE).name == STEPS


def test_reports_on_few_goals_keep_their_parts_too(tmp_path):
    write(tmp_path / f"{STEPS}-16-goals", 16, ALL)
    assert report_folder(tmp_path, STEPS, 16, NONE).name == f"{STEPS}-16-goals-nominal"


HUGE = f'{{"goal_set_version": {GOAL_SET_VERSION}, "policy": {{"episodes": 1e999}}}}'


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "3", "{}", '{"goal_set_version": 1}', "\udcff", HUGE]
)
def test_a_damaged_report_is_replaced(tmp_path, text):
    (tmp_path / STEPS).mkdir()
    (tmp_path / STEPS / "report.json").write_text(text, errors="surrogateescape")
    assert report_folder(tmp_path, STEPS, REPORT_GOALS, NONE).name == STEPS
    assert find_report(tmp_path, STEPS, 1, NONE) is None


def test_a_report_on_other_goals_is_replaced(tmp_path):
    write(tmp_path / STEPS, 4096, ALL, version=GOAL_SET_VERSION - 1)
    assert report_folder(tmp_path, STEPS, REPORT_GOALS, NONE).name == STEPS


def test_a_report_that_is_as_full_is_found(tmp_path):
    assert find_report(tmp_path, STEPS, 16, NONE) is None
    few, full = tmp_path / f"{STEPS}-16-goals", tmp_path / STEPS
    write(few, 16, NONE)
    assert find_report(tmp_path, STEPS, 16, NONE) == few
    assert find_report(tmp_path, STEPS, 16, ALL) is None
    assert find_report(tmp_path, STEPS, 17, NONE) is None
    write(few, 16, ALL)
    assert find_report(tmp_path, STEPS, 16, NONE) == few
    write(full, REPORT_GOALS, frozenset({"mujoco"}))
    assert find_report(tmp_path, STEPS, 16, NONE) == full
    assert find_report(tmp_path, STEPS, REPORT_GOALS, frozenset({"mujoco"})) == full
    assert find_report(tmp_path, STEPS, REPORT_GOALS, ALL) is None
    assert find_report(tmp_path, STEPS, 4096, NONE) is None


def test_the_report_that_is_kept_is_named(tmp_path):
    full, few = tmp_path / STEPS, tmp_path / f"{STEPS}-16-goals"
    write(few, 16, NONE)
    assert fuller_report(few, STEPS) is None
    write(full, REPORT_GOALS, NONE)
    assert fuller_report(few, STEPS) == full
    assert fuller_report(full, STEPS) is None


def test_a_report_on_a_drive_that_does_not_answer_is_not_replaced(tmp_path, monkeypatch):
    def no_answer(path, flags):
        raise OSError(errno.EIO, "Input/output error")

    write(tmp_path / STEPS, REPORT_GOALS, ALL)
    monkeypatch.setattr(run_dir, "open_at_once", no_answer)
    with pytest.raises(UnreadableError, match="cannot be read now"):
        report_folder(tmp_path, STEPS, REPORT_GOALS, NONE)


def compared(folder, runs):
    """Write a comparison of runs, each with the folders of its seeds, below another folder."""
    folder.mkdir(parents=True, exist_ok=True)
    values = [
        {"name": name, "seeds": [{"run": path_from(folder, seed)} for seed in seeds]}
        for name, seeds in runs.items()
    ]
    (folder / "comparison.json").write_text(json.dumps({"runs": values}))


def test_a_comparison_of_other_runs_has_a_folder_of_its_own(tmp_path):
    def place(runs):
        policies = {
            name: {seed.name: types.SimpleNamespace(run_dir=seed) for seed in seeds}
            for name, seeds in runs.items()
        }
        return comparison_folder(tmp_path / "a" / "evaluations", "comparison", policies)

    a, b, c, other = (tmp_path / name for name in ("a", "b", "c", "x/b"))
    sets = [
        {"a": [a], "b": [b]},
        {"a": [a], "c": [c]},
        # Of the same names, in another folder, and with another checkpoint.
        {"a": [a], "b": [other]},
        {"a": [a], "b @ 100": [b]},
        {"a": [a], "b": [b / "seed-0", b / "seed-1"]},
    ]
    for number, runs in enumerate(sets, start=1):
        name = "comparison" if number == 1 else f"comparison-{number}"
        assert place(runs) == tmp_path / "a" / "evaluations" / name
        compared(place(runs), runs)
    assert [place(runs).name.rpartition("-")[2] for runs in sets] == ["comparison", *"2345"]
    # One that cannot be read is replaced.
    (tmp_path / "a" / "evaluations" / "comparison-2" / "comparison.json").write_text("{")
    assert place({"d": [tmp_path / "d"]}).name == "comparison-2"


def test_the_comparison_that_is_kept_is_named(tmp_path):
    first = tmp_path / "comparison-16-goals"
    assert kept_line(tmp_path / "comparison-16-goals-2") == ""
    compared(first, {"a": [tmp_path], "b": [tmp_path]})
    assert kept_line(first) == ""
    told = f" (the one of a, b in {first} stays as it is)"
    assert kept_line(tmp_path / "comparison-16-goals-2") == told
    assert kept_line(tmp_path / "else-2") == ""
