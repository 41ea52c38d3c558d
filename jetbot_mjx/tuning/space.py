"""Describe what a search may change: a YAML file with one entry for each setting.

    ppo.learning_rate: {low: 1.0e-4, high: 1.0e-2, log: true}
    ppo.discounting: {low: 0.9, high: 0.99}
    ppo.unroll_length: {choices: [8, 16, 32]}
    ppo.network.policy_hidden_layer_sizes: {choices: [[64, 64], [128, 128, 128]]}

A range of a setting that is a whole number draws whole numbers.
"""

import difflib
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeGuard

from jetbot_mjx.config import (
    ALL_KEYS,
    Config,
    ConfigError,
    find_config,
    parse_config,
    plain,
    read_yaml,
)
from jetbot_mjx.errors import clipped, shown

if TYPE_CHECKING:
    import optuna

Value = bool | int | float | str | tuple["Value", ...] | None
"""A value of a setting; a list is a tuple."""

Values = Mapping[str, Value]
"""Values by the name of their setting, such as `ppo.learning_rate`."""

TRACED = (
    "ppo.learning_rate",
    "ppo.desired_kl",
    "ppo.discounting",
    "ppo.gae_lambda",
    "ppo.entropy_cost",
    "ppo.clipping_epsilon",
    "ppo.vf_loss_coefficient",
    "ppo.max_grad_norm",
    "ppo.reward_scaling",
)
"""Settings that only enter the arithmetic: trials with other values share one compiled program."""

SHIPPED = ("configs/spaces",)
"""Folders of the spaces that come with the package."""

_SECTIONS = ("robot", "task", "camera", "physics", "randomization", "ppo")
"""Sections of the configuration that can be searched: the others do not change what is learned."""

_KEYS = ("low", "high", "log", "choices")


class Parameter(NamedTuple):
    """A `Parameter` holds the values that one setting may take: a range or a list."""

    name: str
    """The setting, such as `ppo.learning_rate`."""
    low: float | int | None = None
    high: float | int | None = None
    log: bool = False
    """Whether the logarithm is drawn uniformly."""
    choices: tuple[Value, ...] = ()

    def contains(self, value: Value) -> bool:
        """Return whether the setting may take this value."""
        if self.choices:
            return value in self.choices
        low, high = self.low, self.high
        if low is None or high is None or not isinstance(value, int | float):
            return False
        return low <= value <= high

    def suggest(self, trial: "optuna.Trial") -> Value:
        """Ask an Optuna trial for a value."""
        if self.choices:
            names = [self.to_optuna(choice) for choice in self.choices]
            return self.from_optuna(trial.suggest_categorical(self.name, names))
        if isinstance(self.low, int) and isinstance(self.high, int):
            return trial.suggest_int(self.name, self.low, self.high, log=self.log)
        assert self.low is not None
        assert self.high is not None
        return trial.suggest_float(self.name, self.low, self.high, log=self.log)

    def to_optuna(self, value: Value) -> bool | int | float | str | None:
        """Return a value as Optuna stores it: a list as text."""
        return str(list(value)) if isinstance(value, tuple) else value

    def from_optuna(self, stored: Value) -> Value:
        """Return the value that Optuna has stored."""
        found = [choice for choice in self.choices if self.to_optuna(choice) == stored]
        return found[0] if found else stored


def read_space(space: str | Path | Mapping[str, object], config: Config) -> list[Parameter]:
    """Read what a search may change.

    Args:
      space: the YAML file; the name of a space that comes with the package, such as `ppo`; or the
        content of such a file.
      config: the configuration in which the settings are changed.

    Returns:
      The parameters, in the order of the file.

    Raises:
      ConfigError: the file cannot be read, an entry is malformed, or a setting does not accept an
        end of its range or one of its choices.
    """
    name, values = "space", space
    if not isinstance(space, str | Path | Mapping):
        raise ConfigError(
            f"space = {shown(space)} is wrong: give a YAML file, its content, or the name of a"
            " space that comes with the package, such as 'ppo'"
        )
    if not isinstance(values, Mapping):
        name, values = str(space), read_yaml(find_config(str(space), SHIPPED, "--space"), "--space")
    if not values:
        raise ConfigError(
            f"{name} is empty: write lines such as ppo.discounting: {{low: 0.9, high: 0.99}}"
        )
    return [_parameter(key, entry, name, config) for key, entry in values.items()]


def _parameter(name: object, entry: object, path: str, config: Config) -> Parameter:
    where = f"{path}: {clipped(str(name))}"
    if not isinstance(entry, Mapping):
        raise ConfigError(
            f"{where} = {shown(entry)} is wrong: write {{low: A, high: B}} or {{choices: [...]}}"
        )
    entry = {key: plain(value) for key, value in entry.items()}
    for key in entry:
        if key not in _KEYS:
            # A configuration is nested, and a space is not.
            inner = [one for one in ALL_KEYS if one.startswith(f"{name}.{key}")]
            close = difflib.get_close_matches(str(key), _KEYS, n=1)
            hint = f"did you mean {close[0]}?" if close else f"known are {', '.join(_KEYS)}"
            hint = f"write {inner[0]}: {{low: A, high: B}}, not indented" if inner else hint
            raise ConfigError(f"{where}.{clipped(str(key))} is unknown: {hint}")
    if "choices" in entry:
        found = _list(str(name), entry, where)
    else:
        found = _range(str(name), entry, where)
    # If both ends of a range are valid, so is what lies between them.
    for value in entry.get("choices", (found.low, found.high)):
        with_values(config, {found.name: value}, source=path, alone=True)
    if found.name.partition(".")[0] not in _SECTIONS:
        raise ConfigError(
            f"{where} cannot be searched: only settings of {', '.join(_SECTIONS)} can"
        )
    return _typed(found, config)


def _list(name: str, entry: Mapping[str, object], where: str) -> Parameter:
    choices = entry["choices"]
    if not isinstance(choices, list | tuple) or not choices or len(entry) > 1:
        raise ConfigError(f"{where} is wrong: choices should be a list, without other keys")
    for choice in choices:
        if isinstance(choice, Mapping):
            inner = clipped(f"{name}.{next(iter(choice), 'key')}")
            raise ConfigError(
                f"{where}: {shown(choice)} is not a choice: search its keys, such as {inner}"
            )
        if choices.count(choice) > 1:
            raise ConfigError(f"{where}: {shown(choice)} is given twice among the choices")
    return Parameter(
        name, choices=tuple(tuple(one) if isinstance(one, list) else one for one in choices)
    )


def _range(name: str, entry: Mapping[str, object], where: str) -> Parameter:
    low, high, log = entry.get("low"), entry.get("high"), entry.get("log", False)
    if not (_is_number(low) and _is_number(high) and low < high):
        raise ConfigError(f"{where} is wrong: low and high should be numbers, low the smaller")
    if not isinstance(log, bool) or (log and low <= 0):
        raise ConfigError(f"{where}.log = {shown(log)} is wrong: true needs a low above 0")
    return Parameter(name, low, high, log)


def _typed(found: Parameter, config: Config) -> Parameter:
    """Return a range with ends of the setting's type, which decides what is drawn."""
    low, high = found.low, found.high
    if low is None or high is None:
        return found
    if found.name in ALL_KEYS:
        # No setting that may be null is a whole number.
        whole = isinstance(config.flat()[found.name], int)
    else:
        whole = isinstance(low, int) and isinstance(high, int)
    kind = int if whole else float
    return found._replace(low=kind(low), high=kind(high))


def _is_number(value: object) -> TypeGuard[int | float]:
    return isinstance(value, int | float) and not isinstance(value, bool)


def with_values(config: Config, values: Values, *, source: str, alone: bool = False) -> Config:
    """Return a configuration with some settings changed.

    Args:
      config: the configuration.
      values: the new values by setting, such as `ppo.learning_rate`.
      source: the origin of the values, for error messages.
      alone: whether to accept values that only fit together with others, such as a batch size
        that needs another number of environments.

    Raises:
      ConfigError: a setting is unknown, or its value is not accepted.
    """
    changed = config.model_dump(mode="json")
    for name, value in values.items():
        *sections, key = name.split(".")
        section = changed
        for part in sections:
            section = section.get(part) if isinstance(section, dict) else None
        if not isinstance(section, dict):
            raise ConfigError(f"{source}: {name} is unknown: write section.key")
        section[key] = value
    try:
        return parse_config(changed, source)
    except ConfigError as error:
        # The error of an item of a list names its index: `ppo.network...sizes.0 = ...`.
        if alone and not any(
            re.search(rf"{re.escape(one)}(\.\d+)? = ", str(error)) for one in values
        ):
            return config
        raise
