"""Explain in one line what is wrong with a setting: the key, the value, and what would be right."""

from collections.abc import Mapping

from pydantic_core import ErrorDetails

from jetbot_mjx.config.errors import ConfigError
from jetbot_mjx.config.keys import ALL_KEYS, likely_key
from jetbot_mjx.config.robot_mjcf import MjcfRobotConfig
from jetbot_mjx.config.run import ROBOT_KINDS
from jetbot_mjx.errors import clipped, shown

_MOST_SECTIONS = 8
"""Largest number of nested sections that a message names."""


_KINDS = {
    "integer": "a whole number",
    "number": "a number",
    "boolean": "true or false",
    "string": "text",
    "dictionary": "a dictionary",
    "tuple": "a list",
}
"""Pydantic's names of types, in words."""


def explain(error: ErrorDetails) -> str:
    """Return one line about pydantic's first error: the key, the value, and what is expected."""
    # Pydantic adds the name of a union's branch or the index in a tuple; keep only the keys.
    location = [clipped(str(part), 100) for part in error["loc"]]
    is_model = location[:2] == ["robot", ROBOT_KINDS[1]]
    if location[:1] == ["robot"] and location[1:2] and location[1] in ROBOT_KINDS:
        del location[1]
    key = ".".join(location)
    value = shown(error["input"])
    if location[:2] == ["task", "options"] and len(location) > 2:
        key = ".".join(location[:3])
        return f"{key} = {value} is wrong: it should be true, false, a finite number or text"
    match error["type"]:
        case "invalid_key":
            return f"{key} = {value} is not a key: keys should be strings"
        case "missing" if isinstance(error["input"], list | tuple):
            value = shown(list(error["input"]))
            return f"{'.'.join(location[:-1])} = {value} is wrong: it lacks items"
        case "missing":
            return f"{key} is missing: {'.'.join(location[:-1])} = {value}"
        case "too_short":
            return f"{key} = {value} is wrong: it should have at least 1 item"
        case "too_long":
            most = error.get("ctx", {}).get("max_length")
            return f"{key} = {value} is wrong: it should have at most {most} items"
        case "extra_forbidden":
            # Of an unknown section, tell the first key.
            value = error["input"]
            while isinstance(value, Mapping) and value and len(location) < _MOST_SECTIONS:
                name, value = next(iter(value.items()))
                location.append(clipped(str(name), 100))
            remedy = likely_key(location)
            if is_model:
                remedy = (
                    f"a robot with a model of its own has {', '.join(MjcfRobotConfig.model_fields)}"
                )
            elif location[0] == "robot" and location[1] in MjcfRobotConfig.model_fields:
                remedy = "only a robot that is a MuJoCo model has it, of robot.file: NAME.xml"
            return f"{'.'.join(location)} = {shown(value)} is unknown: {remedy}"
        case "value_error":
            # A file that the configuration names says itself what is wrong with it.
            inner = error.get("ctx", {}).get("error", error["msg"])
            prefix = f"{key}: " if key and not isinstance(inner, ConfigError) else ""
            return f"{prefix}{inner}"
        case "model_type" | "model_attributes_type":
            inside = next((one for one in ALL_KEYS if one.startswith(f"{key}.")), None)
            empty = error["input"] is None or inside is None
            remedy = "write its keys below it, indented" if empty else f"set {inside}"
            return f"{key} = {value} is not a section: {remedy}"
        case _:
            wanted = error["msg"].removeprefix("Input should be ").removeprefix("a valid ")
            return f"{key} = {value} is wrong: it should be {_KINDS.get(wanted, wanted)}"
