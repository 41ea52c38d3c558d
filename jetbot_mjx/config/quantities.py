"""Define the types with which a randomised quantity is declared.

`RobotParams` and `LookParams` are the table of all quantities. A field of them declares a quantity,
and everything else follows from it:

- its range in the section `randomization`, with the bounds of that range,
- the parameter of its name of each robot and each look, whose default is here,
- how it is drawn in `envs.DomainRandomizationWrapper`,
- the values at which `evaluate --robustness` evaluates a policy,
- its rows in the tables of the documentation, of which the meaning is the field's docstring.

Sources, by tag; BOM, EST and SIM are those of `assets/robots/isaac.yaml`:
  CAD         the space for the battery and the clearance of the casters in the CAD model
  CSE276A     gassajor000/cse276a_jetbot: calibration of a JetBot's motors
  DUCKIETOWN  gym-duckietown: simulator of a robot with the same motors
  ISAACRL     KhaledSharif/isaac-sim-jetbot-rl: domain randomization of Isaac's JetBot
  IMX219      Sony's sensor with 160° lens modules; drivers tint them until they are calibrated
  PICOBOT     uni-obuda picobot: system identification of a robot with the same motors
  TT          measurements of the same motors: newscrewdriver.com, SunFounder's data
  WHEELEDLAB  WheeledLab: domain randomization of a drifting car
"""

import math
from typing import Any, NamedTuple

Value = Any
"""A number, or a scalar that JAX traces: a configuration does not import JAX."""


ANGLE = math.pi + 1e-3
"""Largest angle of a range [rad]; a decimal of π in YAML may be a little larger than π."""


class Range(NamedTuple):
    """A `Range` holds the smallest and largest value that a range in a configuration may have."""

    low: float
    high: float
    source: str
    """Where the range of the shipped configurations comes from."""
    whole: bool = False
    """Whether only whole numbers are drawn, each with the same probability."""


class Evaluated(NamedTuple):
    """An `Evaluated` holds the values at which a policy's robustness is evaluated."""

    label: str
    """Name of the quantity in tables and plots."""
    unit: str
    values: tuple[float, ...]
    """Values in ascending order, which include the nominal value."""


class Quantity(NamedTuple):
    """A `Quantity` holds the declaration of one quantity."""

    name: str
    nominal: float
    """Value of the preset's robot, or of the plain scene."""
    bounds: Range
    evaluated: Evaluated


def quantities_of(table: type[tuple[Value, ...]]) -> dict[str, Quantity]:
    """Return the quantities that a table declares, by name.

    Args:
      table: `RobotParams` or `LookParams`.
    """
    nominal = table()
    return {
        name: Quantity(name, getattr(nominal, name), *declared.__metadata__)
        for name, declared in table.__annotations__.items()
    }


def differs(self: tuple[Value, ...], *names: str) -> bool:
    """Return whether any of some quantities may differ from its default.

    Args:
      self: the parameters, of which this is a method.
      *names: the quantities; a traced one may always differ.
    """
    nominal = type(self)()
    pairs = [(getattr(self, name), getattr(nominal, name)) for name in names]
    return any(not isinstance(one, int | float) or one != other for one, other in pairs)
