"""Types of settings: what is converted, and what is refused."""

import pytest
from pydantic import ConfigDict, TypeAdapter, ValidationError

from jetbot_mjx.config import value_types


def read(name, value):
    # As in a section, whose types are strict unless they say otherwise.
    strict = ConfigDict(strict=True)
    return TypeAdapter(getattr(value_types, name), config=strict).validate_python(value)


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("Count", 3e7, 30_000_000),
        ("Steps", 2.0**40, 2**40),
        ("Layers", [64, 32.0], (64, 32)),
        ("Positive", 1, 1.0),
        ("NonNegative", 0.0, 0.0),
        ("Fraction", 1.0, 1.0),
        ("Scalar", True, True),
    ],
)
def test_a_value_is_read(name, value, expected):
    found = read(name, value)
    assert (found, type(found)) == (expected, type(expected))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("Count", 1.5),
        ("Count", 0),
        ("Count", 2**31),
        ("Count", True),
        ("Steps", 2**53),
        ("Layers", []),
        ("Layers", [8] * 101),
        ("InnerAction", [1.0]),
        ("Positive", 0.0),
        ("Positive", 1e39),
        ("Positive", float("inf")),
        ("NonNegative", -1e-9),
        ("Fraction", 1.01),
        ("Scalar", float("nan")),
        ("Text", "\ud800"),
    ],
)
def test_a_value_out_of_bounds_is_refused(name, value):
    with pytest.raises(ValidationError):
        read(name, value)


@pytest.mark.parametrize("name", ["", "x" * 129, "a/b", "a\nb"])
def test_a_name_that_wandb_would_refuse_is_refused(name):
    with pytest.raises(ValueError, match="is not a project name"):
        value_types.wandb_project(name)
    assert value_types.wandb_project("jetbot mjx") == "jetbot mjx"
