"""What two runs differ in, and how one is deleted."""

import pytest

from helpers.run_folders import make_run
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs.run_changes import (
    changes_since_the_run_before,
    changes_table,
    compare_two,
    delete_run,
    find_deletable,
)
from jetbot_mjx.runs.run_dir import occupied


def test_two_runs_differ_in_settings_and_results(tmp_path):
    before = make_run(tmp_path / "a", (100, 1.0, 0.5))
    after = make_run(tmp_path / "b", (2000, 2.0, 0.75), seed=7, ppo={"learning_rate": 0.002})
    table = changes_table(compare_two(before, after))
    _, steps, scores, *settings = [line.split() for line in table.splitlines()]
    assert steps == ["steps", "100", "2,000"]
    assert scores[-2:] == ["50.0%", "75.0%"]
    assert {(line[0], line[2]) for line in settings} == {
        ("seed", "7"),
        ("ppo.learning_rate", "0.002"),
    }
    assert changes_table(compare_two(before, before)).endswith("all settings are equal")


def test_a_run_that_a_training_writes_is_not_deleted(tmp_path):
    folder = make_run(tmp_path / "a", (100, 1.0, 0.5))
    with occupied(folder), pytest.raises(UserError, match="locked by another training"):
        delete_run(find_deletable(folder))
    assert (folder / "metrics.jsonl").is_file()
    delete_run(find_deletable(folder))
    assert not folder.exists()


def test_the_run_before_is_the_latest_that_ended_earlier(tmp_path):
    first = make_run(tmp_path / "first", (10, 1.0, 0.1))
    make_run(tmp_path / "second", (10, 2.0, 0.2), seed=5)
    third = make_run(tmp_path / "third", (10, 3.0, 0.3))
    make_run(tmp_path / "fourth", (10, 4.0, 0.4))
    changes = changes_since_the_run_before(third)
    assert changes.before.endswith("second")
    assert changes.results["best evaluation"] == ("20.0%", "30.0%")
    assert changes.settings["seed"][0] == "5"
    assert changes_since_the_run_before(first) is None
    assert changes_since_the_run_before(tmp_path) is None
