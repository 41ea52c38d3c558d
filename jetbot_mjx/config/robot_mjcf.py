"""Define the section `robot` for a robot whose MuJoCo model is a file of your own."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Annotated, Self

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from jetbot_mjx.config.robot import Length, Radius
from jetbot_mjx.config.robot_files import register
from jetbot_mjx.config.robot_quantities import RobotParams
from jetbot_mjx.config.section import Section
from jetbot_mjx.config.value_types import integral
from jetbot_mjx.errors import shown

Name = Annotated[str, Field(min_length=1)]
Names = Annotated[tuple[Name, ...], Field(strict=False, max_length=16)]

MODEL_ENDINGS = (".xml", ".mjcf", ".urdf")
"""Endings of files of a model; what holds URDF is refused with what to do."""

OF_CARS = (
    *("friction", "mass", "com_x", "com_y", "com_z", "action_delay"),
    *("position_noise", "yaw_noise", "speed_noise", "yaw_rate_noise", "observation_delay"),
    *("height_offset", "pitch_offset", "start_x", "start_y", "start_yaw"),
)
"""Quantities of the robot that `randomization` may draw for a car; the others are of the wheels on
two sides."""


def is_model(values: object) -> bool:
    """Return whether a section `robot` names a MuJoCo model."""
    if isinstance(values, MjcfRobotConfig):
        return True
    file = values.get("file") if isinstance(values, Mapping) else None
    return isinstance(file, str) and Path(file).suffix.lower() in MODEL_ENDINGS


def _drive(name: str) -> str:
    """Refuse a drive that is neither known nor a function in a file."""
    file, separator, function = name.partition(":")
    if name in ("differential", "ackermann"):
        return name
    if separator and file.endswith(".py") and "/" not in file and function.isidentifier():
        return name
    raise ValueError(
        f"{shown(name)} is no drive: it should be differential, ackermann, or a function beside the"
        " model, as in my_drive.py:controls"
    )


class Sides(Section):
    """Actuators by the side of the robot on which they are."""

    left: Names = ()
    """Names of the actuators on the left side."""
    right: Names = ()
    """Names of those on the right side."""
    middle: Names = ()
    """Names of those in the middle, as of a car with one steered wheel."""


class MjcfRobotConfig(Section):
    """A robot as a MuJoCo model, `robot.file: NAME.xml`, with the names of its parts."""

    file: str
    """The model, beside the configuration that names it, or in the current folder."""
    base: str | None = None
    """Body with the free joint; null: the only one that has such a joint."""
    drive: Annotated[str, AfterValidator(_drive)] = "differential"
    """How an action moves the wheels: `differential`, for two wheels or more that do not turn to
    the side; `ackermann`, for a car; or `NAME.py:FUNCTION`, a function of your own in a file beside
    the model, from an action in [-1, 1] to the controls of all actuators, in JAX."""
    action_size: Annotated[int, BeforeValidator(integral), Field(ge=1, le=32)] = 2
    """Length of the action of a function of your own."""
    wheels: Sides | None = None
    """Velocity actuators of the driven wheels: `left` and `right`, of a car also `middle`; null
    where the drive is a function of your own."""
    steering: Sides | None = None
    """Position actuators of the steered wheels of a car: `left` and `right`, or one in the
    `middle`."""
    wheel_radius: Radius | None = None
    """[m] radius of the driven wheels; null: that of their geoms."""
    wheel_separation: Length | None = None
    """[m] distance of left and right wheels by which a turn is commanded; null: that in the model.
    A robot that skids turns less than that: give more."""
    sha256: str = ""
    """Hash of all files that the model consists of, which a run stores; empty: that of `file`."""

    @model_validator(mode="before")
    @classmethod
    def _with_hash(cls, values: object) -> object:
        """Add the hash of the model's files, unless it is stored."""
        if not isinstance(values, Mapping) or values.get("sha256"):
            return values
        if not isinstance(file := values.get("file"), str):
            return values
        path, drive = Path(file), values.get("drive")
        code = drive.partition(":")[0] if isinstance(drive, str) and ":" in drive else None
        return {**values, "file": path.name, "sha256": register(path, code)}

    @model_validator(mode="after")
    def _steers(self) -> Self:
        hint = "`jetbot-mjx check-robot` prints those of a model"
        if self.has_own_drive and (self.wheels or self.steering):
            raise ValueError(
                f"drive = {self.drive!r} moves all actuators by itself: leave robot.wheels and"
                " robot.steering out"
            )
        wheels, steering = self.wheels or Sides(), self.steering or Sides()
        if self.drive == "differential" and steering != Sides():
            raise ValueError(
                "steering is that of a car: set robot.drive: ackermann, or leave it out"
            )
        if self.drive == "differential" and (not wheels.left or not wheels.right or wheels.middle):
            raise ValueError(
                "a differential drive has wheels on both sides, and none in the middle: name the"
                f" actuators in robot.wheels.left and robot.wheels.right; {hint}"
            )
        if self.drive == "ackermann" and Sides() in (wheels, steering):
            raise ValueError(
                f"a car has actuators in robot.wheels and in robot.steering: name them; {hint}"
            )
        if self.action_size != 2 and not self.has_own_drive:
            raise ValueError(f"action_size = {self.action_size}: that of {self.drive} is 2")
        return self

    @property
    def has_own_drive(self) -> bool:
        """Return whether the drive is a function of the user's own."""
        return ":" in self.drive

    @property
    def quantities(self) -> tuple[str, ...]:
        """Return the names of the parameters in which this robot may differ."""
        return RobotParams._fields if self.drive == "differential" else OF_CARS

    def check_drawn(self, names: Iterable[str]) -> None:
        """Raise an error if a quantity is to be drawn that only two sides have.

        Args:
          names: the quantities.

        Raises:
          ValueError: there is one.
        """
        for name in names:
            if name in RobotParams._fields and name not in self.quantities:
                raise ValueError(
                    f"randomization.{name} is of motors on two sides, and this robot has none:"
                    f" leave it out; {', '.join(OF_CARS)} may be drawn"
                )

    @property
    def max_wheel_speed(self) -> float | None:
        """Return None: limits are those of the model's actuators."""
        return None

    @property
    def label(self) -> str:
        """Return the robot's name, that of its file."""
        return Path(self.file).stem
