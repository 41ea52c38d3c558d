"""Load a configuration: read it, apply overrides, and check every key, type and bound."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from jetbot_mjx.config.errors import ConfigError
from jetbot_mjx.config.files import find_config
from jetbot_mjx.config.robot import RobotConfig
from jetbot_mjx.config.robot_files import FOLDER
from jetbot_mjx.config.robot_mjcf import MjcfRobotConfig, is_model
from jetbot_mjx.config.run import Config, with_defaults
from jetbot_mjx.config.task_modules import find_task_beside
from jetbot_mjx.config.yaml_text import YAML_ENDINGS, parse_any, read_yaml
from jetbot_mjx.errors import clipped, shown

Overrides = Mapping[str, object] | Sequence[str]
"""Settings that replace those of a configuration: `{"ppo.num_envs": 256}`, or a list of
`section.key=value` as after `--set`. Numbers and arrays of NumPy and JAX are taken as Python's."""


def load_config(
    config: "str | Path | Config | None", overrides: Overrides = (), *, imports: bool = True
) -> Config:
    """Read a configuration, apply overrides, and check the result.

    Args:
      config: the name of a configuration that comes with the package; a YAML file with the settings
        that differ from the defaults; or a `Config`. None: only defaults.
      overrides: the settings to change, such as `{"ppo.num_envs": 256}`; or a list of
        `section.key=value`, as after `--set`, the value read as YAML, of which the last one wins.
      imports: whether the module of `task.name` or `environment` is to be found beside the file,
        from now on in the whole process.

    Returns:
      The resolved configuration.

    Raises:
      ConfigError: the file or an override cannot be read, or a key is unknown, of the wrong
        type, out of bounds or at odds with another.
      InvalidError: that module is beside the file, and another one of its name was found before.
    """
    file = None
    if isinstance(config, Config):
        if not overrides:
            return config
        values, name = config.model_dump(mode="json"), "config"
    elif config is None:
        values, name = {}, "config"
    elif isinstance(config, str | Path):
        file = find_config(config)
        values, name = read_yaml(file), str(config)
    else:
        raise ConfigError(
            f"config = {shown(config)} is wrong: it should be a name, a file or Config"
        )
    if not _are_settings(overrides):
        raise ConfigError(
            f"overrides = {shown(overrides)} is wrong: give settings and values, as in"
            " {'ppo.num_envs': 256}"
        )
    _forget_robot(values, overrides)
    if isinstance(overrides, Mapping):
        name += f" with {shown(dict(overrides))}" if overrides else ""
        for key, value in zip(overrides, map(plain, overrides.values()), strict=True):
            _set(values, str(key), value, f"{clipped(str(key))} = {shown(value)}")
    else:
        for override in overrides:
            given = f"--set {clipped(override)}"
            name += f" {given}"
            _apply_override(values, override, given)
    stored = _find_robot_beside(file, values) if file is not None else None
    resolved = parse_config(values, source=name)
    if stored and isinstance(resolved.robot, MjcfRobotConfig) and resolved.robot.sha256 != stored:
        raise ConfigError(
            f"{name}: robot.sha256 = {shown(stored)} is not the hash of the model that was found,"
            f" {resolved.robot.sha256!r}: restore its files, or leave the hash out"
        )
    if file is not None and imports:
        find_task_beside(file, resolved.code.partition(":")[0])
    return resolved


def plain(value: object) -> Any:
    """Return a value in which numbers and arrays, of NumPy or JAX, are Python's.

    Of a list only the items are converted, not what is in them.
    """
    if isinstance(value, list | tuple):
        return [_from_array(one) for one in value]
    return _from_array(value)


def _from_array(value: Any) -> object:
    return value.tolist() if hasattr(value, "tolist") and not isinstance(value, type) else value


def _with_robot_of_file(values: Mapping[str, object]) -> Mapping[str, object]:
    """Take the measures that are not given from the robot's file; a stored run has them all.

    Raises:
      ConfigError: the file cannot be read, or a measure in it is unknown, of the wrong type or out
        of bounds.
    """
    robot = values.get("robot")
    if not isinstance(robot, Mapping) or not isinstance(robot.get("file"), str):
        return values
    if is_model(robot):
        return values
    path = Path(robot["file"])
    if path.suffix not in YAML_ENDINGS:
        raise ConfigError(
            f"robot.file {path}: it should be the measures of a robot, NAME.yaml, or a MuJoCo"
            " model, NAME.xml"
        )
    values = {**values, "robot": {**robot, "file": path.name}}
    if RobotConfig.model_fields.keys() <= robot.keys():
        return values
    own = read_yaml(path, "robot.file")
    if "file" in own:
        raise ConfigError(f"robot.file {path}: file = {shown(own['file'])}: it is one itself")
    if "robot" in own:
        raise ConfigError(
            f"robot.file {path}: it has a section robot, as a configuration has: it should be the"
            " measures alone, such as wheel_radius: 0.04"
        )
    camera = own.pop("camera", {})
    measures = parse_config({"robot": own, "camera": camera}, f"robot.file {path}").robot
    defaults = {"robot": measures.model_dump(mode="json"), "camera": camera}
    return with_defaults(values, defaults)


def _forget_robot(values: dict[str, object], overrides: Overrides) -> None:
    """Leave out what a stored configuration knows of its robot, where another one is chosen."""
    robot = values.get("robot")
    chosen = {"robot.preset", "robot.file"} & {_key_of(one) for one in overrides}
    if chosen and isinstance(robot, dict):
        robot.pop("sha256", None)
        if RobotConfig.model_fields.keys() <= robot.keys():
            del values["robot"]


def _key_of(override: object) -> str:
    """Return the key of an override in Python or after `--set`."""
    return str(override).partition("=")[0].strip()


def _find_robot_beside(config: Path, values: dict[str, object]) -> object:
    """Set the robot's file to the one beside a configuration file, or stored in its run.

    Returns:
      The hash that the configuration had of the model; None: it had none, or it is not found.
    """
    robot = values.get("robot")
    if isinstance(robot, dict) and isinstance(name := robot.get("file"), str):
        for folder in (config.parent, config.parent / FOLDER):
            # Unlike that of `Path`, it knows that no file has a name that is too long.
            if os.path.isfile(folder / name):
                robot["file"] = str(folder / name)
                return robot.pop("sha256", None)
    return None


def parse_config(values: Mapping[str, object], source: str = "config") -> Config:
    """Check a nested mapping of settings.

    Args:
      values: the settings, nested as in YAML.
      source: description of their origin for error messages.

    Returns:
      The resolved configuration.

    Raises:
      ConfigError: as for `load_config`.
    """
    try:
        return Config.model_validate(_with_robot_of_file(values))
    except ValidationError as error:
        # Only a mistake needs it.
        from jetbot_mjx.config.explain import explain

        raise ConfigError(f"{source}: {explain(error.errors()[0])}") from None


def _are_settings(overrides: Overrides) -> bool:
    """Return whether overrides are a mapping, or a list of texts, and not a text themselves."""
    if isinstance(overrides, Mapping | str):
        return isinstance(overrides, Mapping)
    return all(isinstance(override, str) for override in overrides)


def _apply_override(values: dict[str, object], override: str, source: str) -> None:
    key, separator, text = override.partition("=")
    if not separator or not all(key.strip().split(".")):
        raise ConfigError(f"{source}: write section.key=value, as in ppo.num_envs=256")
    value = parse_any(text, source)
    _set(values, key.strip(), value, source, "--set {}={}")


def _set(
    values: dict[str, object], key: str, value: object, source: str, form: str = "'{}': {}"
) -> None:
    """Set one key of nested values.

    Args:
      values: the nested values, which are changed.
      key: the key with its sections, such as `ppo.num_envs`.
      value: its new value.
      source: the override as it was written, for error messages.
      form: how an override is written, for error messages.
    """
    *sections, last = key.split(".")
    section = values
    for part in sections:
        section = section.setdefault(part, {})
        if not isinstance(section, dict):
            raise ConfigError(f"{source}: {part} is a value, not a section")
    if isinstance(value, Mapping):
        # A whole section would silently discard the file's values of its other keys.
        inner, one = next(iter(value.items()), ("key", "value"))
        inner, one = (x if isinstance(x, str) else shown(x) for x in (inner, one))
        example = form.format(f"{key}.{clipped(inner)}", clipped(one))
        raise ConfigError(f"{source}: set single keys, as in {example}")
    section[last] = value
