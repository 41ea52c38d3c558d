"""Define the section `robot`."""

from typing import Literal

from jetbot_mjx.config.section import Section


class RobotConfig(Section):
    """The robot."""

    preset: Literal["isaac", "real"] = "isaac"
    """`isaac`: the tutorial's heavy robot, reaches 1 m/s; `real`: 0.69 kg, 0.41 m/s."""
