"""Define the types of the settings' values: what pydantic converts, and within which bounds."""

import json
from typing import Annotated, TypeVar

from pydantic import AfterValidator, BeforeValidator, Field

from jetbot_mjx.errors import shown

_Json = TypeVar("_Json")


def integral(value: object) -> object:
    """Convert a float with an integral value to an int, because YAML reads `3e7` as a float."""
    if isinstance(value, float) and value.is_integer():
        return int(value)
    return value


def wandb_project(name: object) -> str:
    """Reject a project name that Weights & Biases would reject after the training has started."""
    if not isinstance(name, str):
        raise ValueError(f"{shown(name)} is not a project name: write one, such as jetbot")
    if not 0 < len(name) <= 128 or set(name) & set("/\\#?%:") or not name.isprintable():
        raise ValueError(
            f"{shown(name)} is not a project name: it should have 1 to 128 characters, none of"
            " /\\#?%:"
        )
    return name


def _float32(value: float) -> float:
    """Reject a value that would be infinite in float32."""
    if value > _LARGEST_FLOAT32:
        raise ValueError(f"{value:g} is too large: make it at most {_LARGEST_FLOAT32:.2g}")
    return value


def finite(value: _Json) -> _Json:
    """Reject nested values in which a number is infinite or NaN, which JSON does not have."""
    try:
        json.dumps(value, allow_nan=False)
    except ValueError:
        raise ValueError(f"{shown(value)}: all numbers should be finite") from None
    return value


def _utf8(text: str) -> str:
    """Reject text that cannot be written as UTF-8, such as half of a surrogate pair."""
    text.encode()
    return text


_LARGEST_FLOAT32 = 3.4e38

Text = Annotated[str, AfterValidator(_utf8)]
_WritableInt = Annotated[int, Field(gt=-(10**300), lt=10**300)]
Scalar = bool | _WritableInt | Annotated[float, Field(allow_inf_nan=False)] | Text

Count = Annotated[int, BeforeValidator(integral), Field(ge=1, lt=2**31)]
Steps = Annotated[int, BeforeValidator(integral), Field(ge=1, lt=2**53)]
Layers = Annotated[tuple[Count, ...], Field(strict=False, min_length=1, max_length=100)]
InnerAction = Annotated[
    tuple[Annotated[float, Field(gt=-1, lt=1)], ...], Field(strict=False, min_length=1)
]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False), AfterValidator(_float32)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False), AfterValidator(_float32)]
Fraction = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
