"""Define the section `task`: the task, its goals, and what the policy observes."""

import math
from typing import Annotated, Literal

from pydantic import AfterValidator, Field

from jetbot_mjx.config.section import Section
from jetbot_mjx.config.task_modules import class_name
from jetbot_mjx.config.value_types import Count, NonNegative, Positive, Scalar, Text


class TaskConfig(Section):
    """The task, and the observations and actions of the policy."""

    name: Annotated[str, AfterValidator(class_name)] = "jetbot_mjx:GoalTask"
    """The task class, as `file.py:Class` or `package.module:Class`, built as `Class(task_config)`;
    this package's own is named by the package alone."""
    observation: Literal["world", "egocentric", "camera", "camera+world", "camera+egocentric"] = (
        "world"
    )
    """`world`: the tutorial's 16-number observation; `egocentric`: the goal in robot frame;
    `camera`: the image of the robot's camera, alone or beside numbers."""
    episode_length: Count = 256
    """Control steps after which an episode is truncated."""
    max_speed: Positive = 1.0
    """[m/s] forward speed commanded by a₀ = 1."""
    max_yaw_rate: Positive = math.pi
    """[rad/s] yaw rate commanded by a₁ = 1."""
    goal_distance_min: Annotated[float, Field(gt=0, le=1000, allow_inf_nan=False)] = 0.2
    """[m] nearest goal."""
    goal_distance_span: Annotated[float, Field(ge=0, le=1000, allow_inf_nan=False)] = 1.0
    """[m] farthest goal minus nearest."""
    success_radius: Annotated[float, Field(ge=0.02, allow_inf_nan=False)] = 0.1
    """[m] 3-D distance of the axle midpoint to the goal below which it is reached. The cube's
    centre lies 18 mm above the axle: no smaller radius can be reached."""
    step_cost: NonNegative = 0.0
    """[m] cost of each step, subtracted from the progress, which is at most `max_speed * ctrl_dt`.
    Without one only the discount makes a policy hurry."""
    options: dict[Text, Scalar] = Field(default_factory=dict)
    """Free settings for a task of your own."""

    @property
    def sees(self) -> bool:
        """Return whether the policy sees through the robot's camera."""
        return self.observation.startswith("camera")

    @property
    def numbers(self) -> str:
        """Return the name of the numbers that the policy observes; empty if it observes none."""
        return self.observation.removeprefix("camera").removeprefix("+")
