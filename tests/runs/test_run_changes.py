"""What two runs differ in, and how one is deleted."""

import pytest

from helpers.run_folders import make_run
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs import changed_settings, compare_two, delete_run, occupied, read_info


def test_two_runs_differ_in_settings_and_results(tmp_path):
    before = make_run(tmp_path / "a", (100, 1.0, 0.5))
    after = make_run(tmp_path / "b", (2000, 2.0, 0.75), seed=7, ppo={"learning_rate": 0.002})
    changed = changed_settings(before, after)
    assert set(changed) == {"seed", "ppo.learning_rate"}
    assert changed["seed"][1] == 7
    table = compare_two(before, after)
    assert "2,000" in table
    assert "50.0%" in table
    assert "75.0%" in table
    assert "ppo.learning_rate" in table
    assert compare_two(before, before).endswith("all settings are equal")


def test_a_run_that_a_training_writes_is_not_deleted(tmp_path):
    folder = make_run(tmp_path / "a", (100, 1.0, 0.5))
    with occupied(folder), pytest.raises(UserError, match="locked by another training"):
        delete_run(read_info(folder))
    assert (folder / "metrics.jsonl").is_file()
    delete_run(read_info(folder))
    assert not folder.exists()
