"""The command: a small search from configuration to `best.yaml`, continued, and refused."""

import sys

import pytest

from helpers.command_modules import tune as command
from jetbot_mjx import tuning
from jetbot_mjx.config import load_config
from jetbot_mjx.errors import UserError

SMALL = [
    *("--set", "ppo.num_timesteps=2048", "--set", "ppo.num_envs=16", "--set", "ppo.batch_size=16"),
    *("--set", "ppo.num_minibatches=4", "--set", "ppo.unroll_length=16"),
    *("--set", "checkpoint_interval=2048", "--set", "evaluation.episodes=4"),
    *("--set", "task.episode_length=32"),
]


@pytest.mark.slow
def test_a_search_ends_in_a_configuration(tmp_path, capsys):
    space = tmp_path / "space.yaml"
    space.write_text("ppo.learning_rate: {low: 1.0e-4, high: 1.0e-2, log: true}\n")
    output = tmp_path / "study"
    arguments = ["jetbot_egocentric", *SMALL, "--space", str(space), "--output", str(output)]
    arguments += ["--trials", "4", "--round", "2", "--confirm", "1"]
    assert command.main(arguments) == 0
    out = capsys.readouterr().out
    assert "4 of 4 trials" in out
    assert "as given" in out
    assert 1e-4 <= load_config(output / "best.yaml").ppo.learning_rate <= 1e-2
    # Once more: nothing is searched again.
    assert command.main(arguments) == 0
    assert "of 4 trials" not in capsys.readouterr().out


def test_without_optuna_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    # The room's face remembers what it has imported.
    for name in ("search", "results", "CONFIRM_SEEDS", "entrants_table", "run_search"):
        monkeypatch.delitem(sys.modules, f"jetbot_mjx.tuning.{name}", raising=False)
        monkeypatch.delitem(vars(tuning), name, raising=False)
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(UserError, match=r"tune needs optuna, .*pip install 'jetbot_mjx\[tune\]'"):
        command.main(["smoke", "--space", "ppo"])


def test_a_mistake_writes_nothing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "space.yaml").write_text("ppo.learning_rate: 3\n")
    with pytest.raises(UserError, match=r"write \{low: A, high: B\}"):
        command.main(["smoke", "--space", "space.yaml"])
    assert [path.name for path in tmp_path.iterdir()] == ["space.yaml"]
