"""The command that lists the configurations."""

from jetbot_mjx import list_configs as configs
from jetbot_mjx.config import load_config, shipped_configs


def test_every_shipped_configuration_has_its_line(capsys):
    assert configs.main([]) == 0
    _, *lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(shipped_configs())
    for line, path in zip(lines, shipped_configs().values(), strict=True):
        config = load_config(path)
        own = config.environment
        assert f" {own or config.robot.label} " in line
        assert (f" {config.task.observation} " in line) is (own is None)
        assert f" {config.ppo.num_timesteps:,} " in line
        assert (" (randomized) " in line) is bool(config.randomization.drawn)
