"""Configurations by name, and the errors for unknown names."""

import pytest

from jetbot_mjx.config import ConfigError, find_config, load_config, shipped_configs


def test_configurations_are_found_by_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert {"gpu", "jetbot", "jetbot_egocentric", "real_jetbot", "smoke"} <= set(shipped_configs())
    for name in ("smoke", "smoke.yaml", "configs/smoke.yaml"):
        assert load_config(name) == load_config(shipped_configs()["smoke"])
    # A file of one's own comes first.
    (tmp_path / "smoke").write_text("seed: 77")
    assert load_config("smoke").seed == 77


def test_a_file_of_ones_own_is_meant_before_those_of_the_package(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "more").mkdir()
    for name in ("jetbo", "more/jetbo"):
        (tmp_path / f"{name}.yaml").touch()
        with pytest.raises(ConfigError, match=rf"{name} does not exist: did you mean {name}\.yaml"):
            load_config(name)


@pytest.mark.parametrize(
    ("name", "told"),
    [
        ("jetbot_egocentrc", "did you mean jetbot_egocentric?"),
        ("configs/smokee.yaml", "did you mean smoke?"),
        ("xyz", "give a file, or one of best, best_camera, best_egocentric,"),
    ],
)
def test_a_mistaken_configuration_is_told_the_likely_one(tmp_path, monkeypatch, name, told):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError) as caught:
        find_config(name)
    assert told in str(caught.value)
    assert isinstance(caught.value, ValueError)
