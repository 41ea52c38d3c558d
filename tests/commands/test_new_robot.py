"""What `new_robot` writes can be checked and trained, and no file is overwritten."""

import pytest

from helpers import gliding
from helpers.tiny import TINY
from jetbot_mjx import check_robot, new_robot
from jetbot_mjx.config import load_config
from jetbot_mjx.envs import write_robot_template
from jetbot_mjx.errors import UserError
from jetbot_mjx.training import session


@pytest.mark.slow
@pytest.mark.parametrize(
    ("file", "names"),
    [
        pytest.param("a b.yaml", ["a b.yaml"], marks=pytest.mark.slow),
        ("r.xml", ["r.xml", "r.yaml"]),
    ],
)
def test_what_is_written_passes_the_check_and_trains(tmp_path, capsys, monkeypatch, file, names):
    assert new_robot.main([str(tmp_path / "in" / file)]) == 0
    assert sorted(path.name for path in (tmp_path / "in").iterdir()) == names
    printed = capsys.readouterr().out
    config = tmp_path / "in" / names[-1]
    assert f"wrote {tmp_path / 'in' / file}" in printed
    monkeypatch.setattr(check_robot, "_tell_cost", lambda env: None)
    assert check_robot.main([str(config)]) == 0
    assert "turn       " in capsys.readouterr().out
    with gliding.everywhere():
        assert session.run(load_config(config, TINY), tmp_path / "run").finished
    # A robot of one's own is told that an episode of 16 steps is short.
    assert "hint: a goal 1.2 m to the rear takes" in (tmp_path / "run" / "train.log").read_text()
    assert "turtlebot" not in config.read_text("utf-8")


@pytest.mark.parametrize("there", ["mine.xml", "mine.yaml"])
def test_nothing_is_overwritten(tmp_path, there):
    (tmp_path / there).write_text("mine")
    with pytest.raises(UserError, match=f"{there} exists already"):
        write_robot_template(tmp_path / "mine.xml")
    assert [file.name for file in tmp_path.iterdir()] == [there]


def test_other_names_are_refused(tmp_path):
    with pytest.raises(UserError, match=r"mine.urdf: name a file for measures, such as"):
        write_robot_template(tmp_path / "mine.urdf")
