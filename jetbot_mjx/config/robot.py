"""Define the section `robot`: the measures of the robot, each with its unit and its bounds.

The measures of the shipped robots, with the source of each, are the files in `assets/robots`; one
of your own is such a file too. All positions are in the body frame: the origin is the midpoint of
the wheel axle, x is forward, y is left, z is up.
"""

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, field_validator, model_validator

from jetbot_mjx.config.robot_quantities import RobotParams
from jetbot_mjx.config.section import Section
from jetbot_mjx.config.yaml_text import read_yaml
from jetbot_mjx.errors import shown

_FOLDER = Path(__file__).parents[1] / "assets" / "robots"


def _between(low: float, high: float) -> Any:
    return Field(ge=low, le=high, allow_inf_nan=False)


Radius = Annotated[float, _between(2e-3, 0.5)]
Length = Annotated[float, _between(1e-3, 2)]
Place = Annotated[float, _between(-1, 1)]
Mass = Annotated[float, _between(1e-3, 100)]
Moment = Annotated[float, _between(1e-9, 100)]
Moments = Annotated[tuple[Moment, Moment, Moment], Field(strict=False)]
Size = Annotated[tuple[Length, Length, Length], Field(strict=False)]
Position = Annotated[tuple[Place, Place, Place], Field(strict=False)]
Torque = Annotated[float, _between(1e-4, 100)]
Gain = Annotated[float, _between(1e-5, 100)]
Speed = Annotated[float, _between(0.1, 1000)]
Friction = Annotated[float, _between(0.05, 5)]

SHOWN_DIFFERENCES = 3
"""Most measures that the name of a robot tells."""


class Caster(Section):
    """A frictionless ball under the chassis."""

    x: Place
    """[m] centre of the ball ahead of the axle."""
    y: Place
    """[m] centre of the ball to the left of the axle's midpoint."""
    radius: Length
    """[m] radius of the ball."""
    clearance: Annotated[float, _between(0, 0.1)] = 0.0
    """[m] height of the ball's lowest point above the wheels' while the axle is level."""


Casters = Annotated[tuple[Caster, ...], Field(strict=False, min_length=1, max_length=8)]


def _of_isaac(name: str) -> Any:
    """Return a field whose default is a measure of the robot `isaac`."""
    return Field(default_factory=lambda: getattr(RobotConfig(), name))


class RobotConfig(Section):
    """The robot, unless it is a MuJoCo model. Measures that are not given are those of `preset`."""

    preset: Literal["isaac", "real"] = "isaac"
    """`isaac`: the tutorial's heavy robot, reaches 1 m/s; `real`: 0.69 kg, 0.41 m/s."""
    file: str | None = None
    """A YAML file with the measures of your robot, which may have a section `camera` too; beside
    the configuration that names it, or in the current folder. null: none."""
    wheel_radius: Radius = _of_isaac("wheel_radius")
    """[m] radius of the wheels."""
    wheel_width: Length = _of_isaac("wheel_width")
    """[m] width of a wheel."""
    wheel_separation: Length = _of_isaac("wheel_separation")
    """[m] distance of the wheels, from the middle of one tyre's contact to the other's."""
    wheel_mass: Mass = _of_isaac("wheel_mass")
    """[kg] mass of one wheel."""
    wheel_inertia: Moments | None = _of_isaac("wheel_inertia")
    """[kg m²] moments of inertia of a wheel about x, y (the axle) and z; null: a homogeneous
    cylinder's."""
    chassis_size: Size = _of_isaac("chassis_size")
    """[m] length, width and height of the chassis."""
    chassis_mass: Mass = _of_isaac("chassis_mass")
    """[kg] mass without the wheels."""
    chassis_com: Position = _of_isaac("chassis_com")
    """[m] centre of mass of the chassis."""
    chassis_inertia: Moments | None = _of_isaac("chassis_inertia")
    """[kg m²] principal moments of the chassis about its centre of mass; null: a homogeneous
    box's."""
    casters: Casters = _of_isaac("casters")
    """Balls on which the chassis slides."""
    motor_torque: Torque = _of_isaac("motor_torque")
    """[N m] largest torque of a motor at the wheel."""
    motor_gain: Gain = _of_isaac("motor_gain")
    """[N m s/rad] gain of the speed controller: torque per error of the wheel speed."""
    armature: Annotated[float, _between(0, 10)] = _of_isaac("armature")
    """[kg m²] rotor inertia, seen through the gear at the wheel."""
    max_wheel_speed: Speed | None = _of_isaac("max_wheel_speed")
    """[rad/s] limit of the commanded wheel speed; null: not limited."""
    friction: Friction = _of_isaac("friction")
    """Coulomb friction coefficient between wheel and floor."""
    controller_wheel_radius: Radius = _of_isaac("controller_wheel_radius")
    """[m] wheel radius with which the robot's software turns speeds into wheel speeds."""
    controller_wheel_separation: Length = _of_isaac("controller_wheel_separation")
    """[m] wheel separation with which the robot's software does so."""

    @model_validator(mode="before")
    @classmethod
    def _with_measures_of_preset(cls, values: object) -> object:
        if not isinstance(values, Mapping):
            return values
        preset = values.get("preset", "isaac")
        return {**_shipped(preset), **values} if preset in ("isaac", "real") else values

    @field_validator("wheel_inertia", "chassis_inertia")
    @classmethod
    def _is_of_a_body(cls, moments: Moments | None) -> Moments | None:
        """Refuse moments that no distribution of mass has: none exceeds the sum of the others."""
        if moments and max(moments) > sum(moments) - max(moments):
            raise ValueError(
                f"{list(moments)} is of no body: the largest moment is at most the sum of the"
                " other two"
            )
        return moments

    @model_validator(mode="after")
    def _stands(self) -> Self:
        """Refuse a robot whose centre of mass is not above wheels and casters."""
        ahead, left = (
            self.chassis_mass * place / (self.chassis_mass + 2 * self.wheel_mass)
            for place in self.chassis_com[:2]
        )
        places = [0.0, *(caster.x for caster in self.casters)]
        if not min(places) <= ahead <= max(places):
            side, moved = ("front", "ahead of") if ahead > 0 else ("rear", "behind")
            raise ValueError(
                f"chassis_com = {list(self.chassis_com)}: the robot's centre of mass is"
                f" {abs(ahead):.3g} m {moved} the axle, and it tips over: add a {side} caster there"
            )
        if abs(left) >= self.wheel_separation / 2:
            raise ValueError(
                f"chassis_com = {list(self.chassis_com)}: the robot's centre of mass is outside of"
                f" its wheels, {self.wheel_separation:g} m apart"
            )
        return self

    @property
    def quantities(self) -> tuple[str, ...]:
        """Return the names of the parameters in which this robot may differ: all."""
        return RobotParams._fields

    @property
    def action_size(self) -> int:
        """Return the length of an action: drive and turn."""
        return 2

    @property
    def moments_of_wheel(self) -> tuple[float, float, float]:
        """Return the moments of inertia of a wheel about x, y (the axle) and z [kg m²]."""
        if self.wheel_inertia:
            return self.wheel_inertia
        spin = self.wheel_mass * self.wheel_radius**2 / 2
        across = self.wheel_mass * (3 * self.wheel_radius**2 + self.wheel_width**2) / 12
        return across, spin, across

    @property
    def moments_of_chassis(self) -> tuple[float, float, float]:
        """Return the principal moments of the chassis about its centre of mass [kg m²]."""
        if self.chassis_inertia:
            return self.chassis_inertia
        x, y, z = (side * side for side in self.chassis_size)
        mass = self.chassis_mass
        return mass / 12 * (y + z), mass / 12 * (x + z), mass / 12 * (x + y)

    @property
    def label(self) -> str:
        """Return the robot's name: its file's, or its preset's and how it differs from that."""
        if self.file:
            return Path(self.file).stem
        shipped = type(self)(preset=self.preset)
        changed = [
            f"{name} = {shown(value)}"
            for name, value in self.model_dump(mode="json").items()
            if getattr(self, name) != getattr(shipped, name)
        ]
        if not changed:
            return self.preset
        more = len(changed) - SHOWN_DIFFERENCES
        told = ", ".join(changed[:SHOWN_DIFFERENCES]) + (f" and {more} more" if more > 0 else "")
        return f"{self.preset} with {told}"


@functools.cache
def _shipped(preset: str) -> Mapping[str, object]:
    """Return the measures of a shipped robot."""
    return read_yaml(_FOLDER / f"{preset}.yaml")
