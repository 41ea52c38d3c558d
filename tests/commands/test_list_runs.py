"""The command that lists runs."""

import pytest

from helpers.run_folders import make_run
from jetbot_mjx import list_runs


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
