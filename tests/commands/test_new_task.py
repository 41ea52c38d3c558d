"""The task that `new_task` writes passes the checks and trains, and no file is overwritten."""

import pytest

from helpers import gliding
from helpers.tiny import TINY
from jetbot_mjx import check_env, new_task
from jetbot_mjx.config import load_config
from jetbot_mjx.envs import write_task_template
from jetbot_mjx.errors import UserError
from jetbot_mjx.training import session


@pytest.mark.slow
def test_what_is_written_passes_the_checks_and_trains(tmp_path, capsys):
    assert new_task.main([str(tmp_path / "park_here.py")]) == 0
    config = tmp_path / "park_here.yaml"
    assert f"jetbot-mjx check-env {config}\n" in capsys.readouterr().out
    with gliding.everywhere():
        assert check_env.main([str(config)]) == 0
        result = session.run(load_config(config, TINY), tmp_path / "run")
    assert result.finished
    written = (tmp_path / "park_here.py").read_text("utf-8") + config.read_text("utf-8")
    assert "class ParkHere(GoalTask)" in written
    assert "    jetbot-mjx train park_here.yaml\n" in written
    for name in ("examples", "obstacle_task", "ObstacleTask", "obstacle.yaml"):
        assert name not in written


@pytest.mark.parametrize("there", ["mine.py", "mine.yaml"])
def test_nothing_is_overwritten(tmp_path, there):
    (tmp_path / there).write_text("mine")
    with pytest.raises(UserError, match=f"{there} exists already"):
        write_task_template(tmp_path / "mine.py")
    assert [file.name for file in tmp_path.iterdir()] == [there]
    assert (tmp_path / there).read_text() == "mine"


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("my-task.py", "name a Python module"),
        ("class.py", "name a Python module"),
        ("my_task.txt", "name a Python module"),
        ("json.py", "a module json exists already"),
    ],
)
def test_names_that_cannot_be_imported_are_refused(tmp_path, name, told):
    with pytest.raises(UserError, match=told):
        write_task_template(tmp_path / name)
    assert list(tmp_path.iterdir()) == []
