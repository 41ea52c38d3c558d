"""The examples of robots that are models of their own, changed and small enough for tests."""

from pathlib import Path

from ruamel.yaml import YAML

from jetbot_mjx.config import load_config

EXAMPLES = Path(__file__).parents[2] / "examples"
OWN_ROBOTS = ("turtlebot", "rover", "car")


def copy_robot(folder, name, changes=(), settings=None):
    """Write an example's model and settings, changed, into a folder; returns the configuration."""
    text = (EXAMPLES / f"{name}.xml").read_text("utf-8")
    for old, new in changes:
        assert old in text, f"{name}.xml has no {old}"
        text = text.replace(old, new)
    (folder / f"{name}.xml").write_text(text, "utf-8")
    values = YAML(typ="safe").load(EXAMPLES / f"{name}.yaml")
    values["robot"] |= settings or {}
    config = folder / f"{name}.yaml"
    YAML().dump(values, config)
    return config


def load_robot(name, *overrides):
    """The configuration of an example."""
    return load_config(EXAMPLES / f"{name}.yaml", overrides)
