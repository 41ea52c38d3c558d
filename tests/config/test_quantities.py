"""The table of randomized quantities, from which ranges, parameters and sweeps follow."""

from typing import Annotated, NamedTuple

import pytest

from jetbot_mjx.config import QUANTITIES, LookParams, RandomizationConfig, RobotParams
from jetbot_mjx.config.quantities import Evaluated, Quantity, Range, Value, quantities_of
from jetbot_mjx.evaluation.robustness import SWEEPS


class Lemons(NamedTuple):
    sourness: Annotated[
        Value, Range(0, 9, "EST by tongue"), Evaluated("sourness", "pH", (1.0, 2.5))
    ] = 2.5


def test_a_field_of_a_table_declares_a_quantity():
    declared = Quantity(
        "sourness",
        2.5,
        Range(0, 9, "EST by tongue"),
        Evaluated("sourness", "pH", (1.0, 2.5)),
    )
    assert quantities_of(Lemons) == {"sourness": declared}


@pytest.mark.parametrize("one", QUANTITIES.values(), ids=QUANTITIES)
def test_a_value_that_is_evaluated_can_be_drawn(one):
    low, high, _, whole = one.bounds
    assert all(low <= value <= high for value in (one.nominal, *one.evaluated.values))
    assert not whole or all(value.is_integer() for value in one.evaluated.values)


def test_everything_follows_from_the_table():
    names = tuple(QUANTITIES)
    assert tuple(RandomizationConfig.model_fields) == names
    assert tuple(one.name for one in SWEEPS) == names
    nominal = {**RobotParams()._asdict(), **LookParams()._asdict()}
    assert nominal == {name: one.nominal for name, one in QUANTITIES.items()}
    assert tuple(nominal) == names


def test_a_parameter_is_of_its_own_class_and_holds_nothing_else():
    darker = LookParams(exposure=0.5)._replace(blur=1.0)
    assert type(darker) is LookParams
    assert (darker.exposure, darker.blur, darker.light) == (0.5, 1.0, 1.0)
    with pytest.raises(AttributeError):
        darker.brightness = 2.0
