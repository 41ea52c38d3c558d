"""Define the section `randomization`, with a range for each quantity of the table."""

from typing import Any

from pydantic import Field, ValidationInfo, create_model, field_validator
from pydantic_core import PydanticCustomError

from jetbot_mjx.config.look_quantities import LookParams
from jetbot_mjx.config.quantities import quantities_of
from jetbot_mjx.config.robot_quantities import RobotParams
from jetbot_mjx.config.section import Section
from jetbot_mjx.config.value_types import integral

QUANTITIES = quantities_of(RobotParams) | quantities_of(LookParams)
"""All quantities that may differ, by name, those of the robot first."""

_FIELDS: Any = {
    name: (tuple[float, float] | None, Field(None, json_schema_extra=one.bounds._asdict()))
    for name, one in QUANTITIES.items()
}


# Pydantic builds what checks the fields once, for the class with its validator.
_Ranges = create_model("_Ranges", __base__=Section, __cls_kwargs__={"defer_build": True}, **_FIELDS)


class RandomizationConfig(_Ranges, defer_build=False):
    """Domain randomization: parameters drawn uniformly from [low, high] for every episode.

    Each parameter is drawn independently for each robot of a training. null: the preset's value is
    used; if all are null, nothing is drawn. From `cube_brightness` on, parameters change what the
    camera sees, and need `task.observation: camera`.
    """

    @field_validator("*", mode="before")
    @classmethod
    def _within_bounds(cls, value: object, info: ValidationInfo) -> object:
        if value is None:
            return None
        low, high, _, whole = QUANTITIES[str(info.field_name)].bounds
        kinds = int if whole else (int, float)
        if not (
            isinstance(value, list | tuple)
            and len(value) == 2
            and all(isinstance(integral(end), kinds) for end in value)
            and not any(isinstance(end, bool) for end in value)
            and low <= value[0] <= value[1] <= high
        ):
            raise PydanticCustomError(
                "range",
                "[low, high], {kind} from {low} to {high}, the smaller one first",
                {
                    "kind": "whole numbers" if whole else "numbers",
                    "low": f"{low:g}",
                    "high": f"{high:g}",
                },
            )
        return tuple(float(end) for end in value)

    @property
    def drawn(self) -> dict[str, tuple[float, float]]:
        """Return the ranges of the parameters that are drawn, by name."""
        ranges = {name: getattr(self, name) for name in QUANTITIES}
        return {name: span for name, span in ranges.items() if span is not None}

    @property
    def looks(self) -> list[str]:
        """Return the names of the drawn parameters that change what the camera sees."""
        return [name for name in self.drawn if name in LookParams._fields]
