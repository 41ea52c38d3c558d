"""What comes of a training, by what it trains."""

import pytest

from helpers import point_mass
from jetbot_mjx.config import load_config
from jetbot_mjx.training import session
from jetbot_mjx.training.result import summary


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "commands"),
    [("PointMass", ["evaluate", "export"]), ("Shown", ["evaluate", "export", "render"])],
)
def test_an_environment_gets_the_commands_that_work_for_it(name, commands, tmp_path):
    result = session.run(point_mass.config(name), tmp_path / "mine")
    lines = summary(result).partition("next:")[2].splitlines()
    assert [line.split()[1] for line in lines if "jetbot-mjx" in line] == commands


@pytest.mark.slow
def test_the_headline_tells_the_steps_that_will_be_made(capsys, tmp_path):
    config = load_config(point_mass.config(), {"ppo.num_timesteps": 1500})
    session.run(config, tmp_path / "run", verbose=True)
    assert ": 1,536 steps (1,500 rounded up to whole training steps) in" in capsys.readouterr().out
