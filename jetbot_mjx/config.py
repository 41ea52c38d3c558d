"""Define, read and check the configuration of a run.

A YAML file contains only the settings that differ from the defaults below. Every key, type and
bound is checked before anything else happens, and an error is reported in one line. A configuration
is immutable, and a run stores it with all defaults filled in. This module does not import JAX.

Pydantic checks strict types, bounds and unknown keys, and provides a schema from which the
reference can be generated. ruamel.yaml reads the files, because it supports YAML 1.2, where `1e-3`
is a number, and rejects a key that is given twice.
"""

import difflib
import io
import math
import os
import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic_core import ErrorDetails, PydanticCustomError
from ruamel.yaml import YAML
from ruamel.yaml.constructor import SafeConstructor
from ruamel.yaml.error import YAMLError
from ruamel.yaml.nodes import Node

from jetbot_mjx.errors import InvalidError, NotFoundError, clipped, shown
from jetbot_mjx.imports import find_task_beside

Overrides = Mapping[str, Any] | Sequence[str]
"""Settings that replace those of a configuration: `{"ppo.num_envs": 256}`, or a list of
`section.key=value` as after `--set`."""


class ConfigError(InvalidError):
    """Raised when a configuration is invalid; states the key, the value and the remedy."""


class ConfigNotFoundError(ConfigError, NotFoundError):
    """Raised when there is no such file; callers may also catch a `FileNotFoundError`."""


def _integral(value: object) -> object:
    """Convert a float with an integral value to an int, because YAML reads `3e7` as a float."""
    if isinstance(value, float) and value.is_integer():
        return int(value)
    return value


def _wandb_project(name: str) -> str:
    """Reject a project name that Weights & Biases would reject after the training has started."""
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


def _utf8(text: str) -> str:
    """Reject text that cannot be written as UTF-8, such as half of a surrogate pair."""
    text.encode()
    return text


_LARGEST_FLOAT32 = 3.4e38

Text = Annotated[str, AfterValidator(_utf8)]
_WritableInt = Annotated[int, Field(gt=-(10**300), lt=10**300)]
_Scalar = bool | _WritableInt | Annotated[float, Field(allow_inf_nan=False)] | Text

Count = Annotated[int, BeforeValidator(_integral), Field(ge=1, lt=2**31)]
Steps = Annotated[int, BeforeValidator(_integral), Field(ge=1, lt=2**53)]
Layers = Annotated[tuple[Count, ...], Field(strict=False, min_length=1, max_length=100)]
InnerAction = Annotated[
    tuple[Annotated[float, Field(gt=-1, lt=1)], ...], Field(strict=False, min_length=1)
]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False), AfterValidator(_float32)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False), AfterValidator(_float32)]
Fraction = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]


Range = tuple[float, float] | None


def _range(low: float, high: float, *, whole: bool = False) -> Any:
    """Return a field for a range [low, high] within bounds, or null."""
    return Field(None, json_schema_extra={"low": low, "high": high, "whole": whole})


_MAX_SUBSTEPS = 10_000


class _Section(BaseModel):
    """Base class of all sections: immutable, with strict types and without unknown keys."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    def __repr_args__(self) -> Iterator[tuple[str | None, Any]]:
        """Yield the settings that differ from the defaults, which are few of them."""
        for name, field in type(self).model_fields.items():
            if (value := getattr(self, name)) != field.get_default(call_default_factory=True):
                yield name, value


class RobotConfig(_Section):
    """The robot."""

    preset: Literal["isaac", "real"] = "isaac"
    """`isaac`: the tutorial's heavy robot, reaches 1 m/s; `real`: 0.69 kg, 0.41 m/s."""


class TaskConfig(_Section):
    """The task, and the observations and actions of the policy."""

    name: str = "jetbot_mjx:GoalTask"
    """The task class, as `package.module:Class`, built as `Class(task_config)`; this package's own
    is named by the package alone."""
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
    options: dict[Text, _Scalar] = Field(default_factory=dict)
    """Free settings for a task of your own."""

    @property
    def sees(self) -> bool:
        """Return whether the policy sees through the robot's camera."""
        return self.observation.startswith("camera")

    @property
    def numbers(self) -> str:
        """Return the name of the numbers that the policy observes; empty if it observes none."""
        return self.observation.removeprefix("camera").removeprefix("+")


class CameraConfig(_Section):
    """The robot's camera, for `task.observation: camera`."""

    width: Annotated[int, BeforeValidator(_integral), Field(ge=8, le=512)] = 32
    """[pixels] width of the image."""
    height: Annotated[int, BeforeValidator(_integral), Field(ge=8, le=512)] = 32
    """[pixels] height of the image."""
    colour: Literal["rgb", "grey"] = "rgb"
    """`rgb`: three channels; `grey`: one."""
    frames: Annotated[int, BeforeValidator(_integral), Field(ge=1, le=8)] = 1
    """Images that the policy sees, stacked along the channels, the newest last."""
    samples: Annotated[int, BeforeValidator(_integral), Field(ge=1, le=8)] = 2
    """Rays per side of a pixel."""
    position: tuple[float, float, float] = (0.018, 0.0, 0.059)
    """[m] optical centre ahead of, left of and above the axle midpoint. The JetBot's CAD has the
    lens 15 to 19 mm ahead of the axle and 92 mm above the floor."""
    pitch: Annotated[float, Field(ge=-90, le=90, allow_inf_nan=False)] = 20.0
    """[deg] angle by which the camera looks down; 20 in the JetBot's CAD."""
    lens: Literal["pinhole", "opencv", "fisheye"] = "pinhole"
    """`opencv` and `fisheye`: OpenCV's two models of a lens with distortion."""
    fovy: Annotated[float, Field(ge=1, le=178, allow_inf_nan=False)] = 115.0
    """[deg] vertical field of view, without `matrix`. The JetBot's wide lens has 160 degrees from
    corner to corner, 113 from side to side of a square image; NVIDIA's own simulation uses 115."""
    matrix: tuple[Positive, Positive, float, float] | None = None
    """[pixels] fx, fy, cx, cy of a calibrated camera; null: `fovy`, the axis in the middle."""
    calibration_size: tuple[Count, Count] | None = None
    """[pixels] width and height of the images of the calibration; null: those above."""
    distortion: tuple[float, ...] = ()
    """Coefficients in OpenCV's order: k1, k2, p1, p2, k3 to k6, or of a fisheye k1 to k4."""
    impl: Literal["auto", "llvm", "ptx", "xla"] = "auto"
    """How an image is compiled, as in `physics.impl`."""

    @field_validator("position", "matrix", "calibration_size", "distortion", mode="before")
    @classmethod
    def _as_tuple(cls, value: Any) -> object:
        return tuple(value) if isinstance(value, list) else value

    @model_validator(mode="after")
    def _known_lens(self) -> Self:
        most = {"pinhole": 0, "opencv": 8, "fisheye": 4}[self.lens]
        if len(self.distortion) > most:
            raise ValueError(
                f"distortion has {len(self.distortion)} coefficients: lens = {self.lens} takes at"
                f" most {most}"
            )
        if self.calibration_size is not None and self.matrix is None:
            raise ValueError(
                f"calibration_size = {list(self.calibration_size)} is that of a matrix, and there"
                " is none: give both, or only fovy"
            )
        values = [*self.position, *self.distortion, *(self.matrix or ())]
        if not all(map(math.isfinite, values)):
            raise ValueError("position, matrix and distortion should be finite numbers")
        return self


class PhysicsConfig(_Section):
    """Time steps and the solver's accuracy. Integrator: Euler, without implicit joint damping."""

    ctrl_dt: Positive = 1 / 60
    """[s] duration of one environment step, during which an action is held."""
    sim_dt: Annotated[float, Field(ge=1e-5, allow_inf_nan=False)] = 1 / 120
    """[s] duration of one physics step; `ctrl_dt` is a whole multiple of it."""
    tolerance: Annotated[float, Field(ge=0, le=1e-3, allow_inf_nan=False)] = 1e-6
    """The contact solver stops when an iteration improves its cost by less than this, or its
    gradient is smaller, both relative to the trace of the inertia matrix. MuJoCo's default of 1e-8
    is below the resolution of float32."""
    iterations: Count = 20
    """Largest number of Newton iterations per physics step; usually one or two are needed."""
    ls_iterations: Count = 8
    """Largest number of line-search steps per Newton iteration; a slippery floor needs most."""
    cholesky: Literal["unrolled", "library"] = "unrolled"
    """How MJX factorises its matrices. `unrolled`: as scalar arithmetic; `library`: by a call of
    LAPACK or cuSOLVER, which prevents a step from running as one kernel or CUDA graph."""
    impl: Literal["auto", "llvm", "ptx", "xla"] = "auto"
    """How a physics step is compiled. `ptx`: as one kernel for NVIDIA GPUs; `llvm`: as one kernel
    for CPUs; `xla`: by XLA, as many kernels; `auto`: as one kernel if that is possible, otherwise
    by XLA."""

    @property
    def n_substeps(self) -> int:
        """Return the number of physics steps per environment step."""
        return round(self.ctrl_dt / self.sim_dt)

    @model_validator(mode="after")
    def _whole_substeps(self) -> Self:
        ratio = self.ctrl_dt / self.sim_dt
        problem = f"sim_dt = {self.sim_dt:g} goes {ratio:g} times into ctrl_dt = {self.ctrl_dt:g}"
        if ratio > _MAX_SUBSTEPS:
            raise ValueError(f"{problem}: make it at most {_MAX_SUBSTEPS} times")
        # A decimal in YAML cannot represent 1/120 exactly: accept a ratio that is nearly whole.
        if round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-3 * ratio:
            nearest = self.ctrl_dt / max(1, round(ratio))
            remedy = f"make the sub-steps whole, for example sim_dt = {nearest:.9g}"
            raise ValueError(f"{problem}: {remedy}")
        return self


class RandomizationConfig(_Section):
    """Domain randomization: parameters drawn uniformly from [low, high] for every episode.

    Each parameter is drawn independently for each robot of a training. null: the preset's value is
    used; if all are null, nothing is drawn. From `cube_brightness` on, parameters change what the
    camera sees, and need `task.observation: camera`.
    """

    friction: Range = _range(0.05, 5)
    """Factor on the Coulomb coefficient of wheel on floor."""
    mass: Range = _range(0.2, 5)
    """Factor on mass and inertia of the chassis."""
    com_x: Range = _range(-0.03, 0.03)
    """[m] shift of the chassis's centre of mass forwards."""
    com_y: Range = _range(-0.03, 0.03)
    """[m] shift of the centre of mass to the left."""
    com_z: Range = _range(-0.03, 0.03)
    """[m] shift of the centre of mass upwards."""
    wheel_radius: Range = _range(0.5, 2)
    """Factor on the radius of both wheels."""
    wheel_radius_mismatch: Range = _range(-0.5, 0.5)
    """Difference of the wheel radii, (left - right) / mean."""
    wheel_separation: Range = _range(0.5, 2)
    """Factor on the distance between the wheels; above 1 the robot turns less."""
    motor_gain: Range = _range(0.1, 2)
    """Factor on the wheel speed that a command produces."""
    motor_gain_mismatch: Range = _range(-0.5, 0.5)
    """Difference of the motor gains, (left - right) / mean."""
    supply_voltage: Range = _range(0.5, 2)
    """Factor on the motors' voltage."""
    dead_band: Range = _range(0, 0.9)
    """Fraction of full voltage below which a wheel stands still."""
    motor_lag: Range = _range(0, 1)
    """[s] time constant of a first-order lag in front of the motors' own dynamics."""
    action_delay: Range = _range(0, 60, whole=True)
    """[control steps] delay from command to motor."""
    position_noise: Range = _range(0, 0.5)
    """[m] standard deviation of the noise on the observed position, drawn at every step."""
    yaw_noise: Range = _range(0, 1)
    """[rad] standard deviation of the noise on the observed heading."""
    speed_noise: Range = _range(0, 1)
    """[m/s] standard deviation of the noise on the observed velocity."""
    yaw_rate_noise: Range = _range(0, 1)
    """[rad/s] standard deviation of the noise on the observed yaw rate."""
    observation_delay: Range = _range(0, 60, whole=True)
    """[control steps] delay of the observation of the robot's own state."""
    height_offset: Range = _range(-0.05, 0.05)
    """[m] offset of the observed height, constant over an episode."""
    pitch_offset: Range = _range(-0.5, 0.5)
    """[rad] offset of the observed pitch, positive nose down, constant over an episode."""
    start_x: Range = _range(-5, 5)
    """[m] start position of the robot, forwards from the origin."""
    start_y: Range = _range(-5, 5)
    """[m] start position of the robot, to the left of the origin."""
    start_yaw: Range = _range(-math.pi - 1e-3, math.pi + 1e-3)
    """[rad] heading at the start, counter-clockwise."""
    cube_brightness: Range = _range(0, 4)
    """Factor on the colour of the goal's cube."""
    cube_red: Range = _range(0, 8)
    """Further factor on the cube's red."""
    cube_blue: Range = _range(0, 8)
    """Further factor on the cube's blue."""
    cube_yaw: Range = _range(-math.pi - 1e-3, math.pi + 1e-3)
    """[rad] turn of the cube about the vertical, counter-clockwise."""
    floor_brightness: Range = _range(0, 4)
    """Factor on the colours of the floor."""
    floor_red: Range = _range(0, 8)
    """Further factor on the floor's red."""
    floor_blue: Range = _range(0, 8)
    """Further factor on the floor's blue."""
    floor_contrast: Range = _range(0, 8)
    """Factor on the difference between the two colours of the floor and their mean."""
    floor_texture: Range = _range(0, 3, whole=True)
    """Pattern of the floor: 0 checker, 1 stripes, 2 tiles with joints, 3 soft spots."""
    floor_scale: Range = _range(0.05, 20)
    """Factor on the size of the pattern; the checker's squares have half a metre."""
    floor_yaw: Range = _range(-math.pi - 1e-3, math.pi + 1e-3)
    """[rad] turn of the pattern, counter-clockwise."""
    sky_brightness: Range = _range(0, 4)
    """Factor on the colours of the sky."""
    sky_red: Range = _range(0, 8)
    """Further factor on the sky's red."""
    sky_blue: Range = _range(0, 8)
    """Further factor on the sky's blue."""
    walls: Range = _range(0, 0.8)
    """[1/m] nearness of four walls around the origin, 1/distance; 0: none. Their turn, height and
    colours are drawn too."""
    clutter: Range = _range(0, 8, whole=True)
    """Number of objects around, in drawn places and in colours unlike the cube's; only to see."""
    ambient: Range = _range(0, 4)
    """Factor on the light from all sides."""
    light: Range = _range(0, 4)
    """Factor on the strength of the lights with a direction."""
    light_x: Range = _range(-5, 5)
    """[m/m] slope by which these lights are tilted, forwards as seen from the start."""
    light_y: Range = _range(-5, 5)
    """[m/m] slope by which these lights are tilted to the left."""
    exposure: Range = _range(0, 8)
    """Factor on all channels, before they are clipped at white."""
    red_gain: Range = _range(0, 4)
    """Factor on the red channel: white balance."""
    blue_gain: Range = _range(0, 4)
    """Factor on the blue channel: white balance."""
    pixel_noise: Range = _range(0, 1)
    """Standard deviation of the noise of every pixel and channel; white is 1."""
    blur: Range = _range(0, 8)
    """[pixels] how much wider than one pixel the area is that a pixel averages."""
    camera_x: Range = _range(-0.05, 0.05)
    """[m] shift of the camera forwards."""
    camera_y: Range = _range(-0.05, 0.05)
    """[m] shift of the camera to the left."""
    camera_z: Range = _range(-0.05, 0.05)
    """[m] shift of the camera upwards."""
    camera_pitch: Range = _range(-1, 1)
    """[rad] angle by which the camera looks further down."""
    camera_roll: Range = _range(-1, 1)
    """[rad] turn of the camera about its axis, clockwise as seen from behind."""
    camera_yaw: Range = _range(-1, 1)
    """[rad] turn of the camera to the left."""
    focal_length: Range = _range(0.5, 2)
    """Factor on the focal length; above 1 the field of view is narrower."""
    distortion: Range = _range(-0.3, 0.3)
    """Share by which the ray of the farthest pixel is bent outwards."""
    camera_delay: Range = _range(0, 60, whole=True)
    """[control steps] delay of the images."""
    camera_interval: Range = _range(1, 60, whole=True)
    """[control steps] from one image to the next; in between the last one stays."""
    frame_drop: Range = _range(0, 1)
    """Probability that an image is lost, and the one before it stays."""

    @field_validator("*", mode="before")
    @classmethod
    def _within_bounds(cls, value: Any, info: ValidationInfo) -> object:
        if value is None:
            return None
        bounds: Any = cls.model_fields[str(info.field_name)].json_schema_extra
        kinds = int if bounds["whole"] else (int, float)
        fits = (
            isinstance(value, list | tuple)
            and len(value) == 2
            and all(isinstance(_integral(end), kinds) for end in value)
            and not any(isinstance(end, bool) for end in value)
            and bounds["low"] <= value[0] <= value[1] <= bounds["high"]
        )
        if not fits:
            raise PydanticCustomError(
                "range",
                "[low, high], {kind} from {low} to {high}, the smaller one first",
                {
                    "kind": "whole numbers" if bounds["whole"] else "numbers",
                    "low": f"{bounds['low']:g}",
                    "high": f"{bounds['high']:g}",
                },
            )
        return tuple(float(end) for end in value)

    @property
    def drawn(self) -> dict[str, tuple[float, float]]:
        """Return the ranges of the parameters that are drawn, by name."""
        ranges = {name: getattr(self, name) for name in type(self).model_fields}
        return {name: span for name, span in ranges.items() if span is not None}

    @property
    def looks(self) -> list[str]:
        """Return the names of the drawn parameters that change what the camera sees."""
        first = list(type(self).model_fields).index("cube_brightness")
        looks = list(type(self).model_fields)[first:]
        return [name for name in looks if getattr(self, name) is not None]


class NetworkConfig(_Section):
    """Policy and value networks, in the names of `brax.training.agents.ppo.networks`."""

    policy_hidden_layer_sizes: Layers = (128, 128, 128)
    """Units of the policy's hidden layers."""
    value_hidden_layer_sizes: Layers = (128, 128, 128)
    """Units of the value function's hidden layers."""
    activation: Literal["tanh", "relu", "elu", "swish"] = "tanh"
    """Activation between the layers."""
    distribution_type: Literal["normal", "tanh_normal"] = "tanh_normal"
    """Action distribution; `normal` leaves clipping to the environment, as SB3 does."""
    initial_action: InnerAction | None = None
    """Action around which an untrained policy acts, within (-1, 1); null: the zero action. Where
    left and right are as good as each other, as for a camera that sees no cube, a policy that
    begins between the two may stay there."""
    cnn: Literal["nature", "small", "tiny"] = "small"
    """Convolutions in front of the hidden layers, for `task.observation: camera`. `nature`: those
    of SB3's `CnnPolicy`, 603 k parameters at 64×64; `small` and `tiny`: for 32×32."""
    shared_cnn: bool = True
    """Whether policy and value function share the convolutions; Brax's networks do not."""
    cnn_dtype: Literal["auto", "float32", "bfloat16"] = "auto"
    """Numbers that the convolutions compute with; parameters and sums are float32. `auto`:
    bfloat16 on GPUs, float32 on CPUs."""


class PPOConfig(_Section):
    """Hyperparameters under the names of `brax.training.agents.ppo.train.train`."""

    num_timesteps: Steps = 1_000_000
    """Environment steps to train for, rounded up to whole training steps of
    `batch_size * num_minibatches * unroll_length`; so is each checkpoint interval."""
    num_envs: Count = 512
    """Parallel environments, over all devices."""
    unroll_length: Count = 16
    """Environment steps per environment and unroll."""
    batch_size: Count = 128
    """Unrolls per minibatch."""
    num_minibatches: Count = 4
    """Minibatches per pass over the collected data."""
    num_updates_per_batch: Count = 4
    """Passes over the collected data before new data is collected."""
    learning_rate: Positive = 1e-3
    """Adam's step size at the start of the schedule."""
    learning_rate_schedule: Literal["NONE", "LINEAR", "ADAPTIVE_KL"] = "LINEAR"
    """`LINEAR` decreases to zero at `num_timesteps`; `ADAPTIVE_KL` adapts the step size so that an
    update changes the policy by `desired_kl`."""
    desired_kl: Positive = 0.01
    """Target of `ADAPTIVE_KL`."""
    learning_rate_schedule_min_lr: Positive = 1e-5
    """Lower end of `ADAPTIVE_KL`."""
    learning_rate_schedule_max_lr: Positive = 1e-2
    """Upper end of `ADAPTIVE_KL`."""
    discounting: Fraction = 0.95
    """γ, per environment step."""
    gae_lambda: Fraction = 0.95
    """λ of generalised advantage estimation."""
    entropy_cost: NonNegative = 1e-3
    """Weight of the entropy bonus."""
    clipping_epsilon: Positive = 0.2
    """PPO's clip range of the probability ratio."""
    vf_loss_coefficient: Positive = 1.0
    """Weight of the value loss, in addition to Brax's factor of one half."""
    max_grad_norm: Positive | None = 1.0
    """Global norm that gradients are clipped to; null: no clipping."""
    reward_scaling: Positive = 10.0
    """Factor on the reward inside the loss."""
    normalize_observations: bool = True
    """Normalise observations by running mean and deviation."""
    normalizer: Literal["physical", "brax"] = "physical"
    """Smallest standard deviation to normalise by. `physical`: by the unit of the observation,
    1 cm, 0.05 m/s, 0.05 rad, 0.1 rad/s, 0.05 without a unit, or a field's own `min_std`; `brax`:
    1e-6 for all, with which a policy overfits to the contact of its training simulator."""
    normalize_advantage: bool = True
    """Normalise advantages within a minibatch."""
    update: Literal["auto", "fused", "xla"] = "auto"
    """How the actions of a collection and the gradient of a minibatch are computed. `fused`: by
    kernels of this package, in float32 on CPUs and with products of float16 on NVIDIA GPUs; `xla`:
    by XLA; `auto`: by the kernels where the device and the networks allow it."""
    network: NetworkConfig = NetworkConfig()
    """Network sizes."""

    @property
    def steps_per_training_step(self) -> int:
        """Return the number of environment steps that one training step collects."""
        return self.batch_size * self.num_minibatches * self.unroll_length

    @property
    def training_steps(self) -> int:
        """Return the number of training steps that reach `num_timesteps`."""
        return -(-self.num_timesteps // self.steps_per_training_step)

    @property
    def gradient_steps(self) -> int:
        """Return the number of minibatches of all training steps."""
        return self.training_steps * self.num_minibatches * self.num_updates_per_batch

    @model_validator(mode="after")
    def _whole_batches(self) -> Self:
        unrolls = self.batch_size * self.num_minibatches
        if unrolls % self.num_envs:
            # The smallest minibatch size whose total the environments divide.
            step = self.num_envs // math.gcd(self.num_envs, self.num_minibatches)
            fit = step * max(1, round(self.batch_size / step))
            raise ValueError(
                f"batch_size * num_minibatches = {unrolls} is not a multiple of"
                f" num_envs = {self.num_envs}: for example batch_size = {fit}"
            )
        low, high = self.learning_rate_schedule_min_lr, self.learning_rate_schedule_max_lr
        if self.learning_rate_schedule == "ADAPTIVE_KL" and not low <= self.learning_rate <= high:
            raise ValueError(
                f"learning_rate = {self.learning_rate:g} lies outside the schedule's"
                f" [{low:g}, {high:g}]: choose it inside, or widen the bounds"
            )
        return self


class EvaluationConfig(_Section):
    """The evaluations during training; `jetbot-mjx evaluate` has its own arguments."""

    episodes: Count = 256
    """Deterministic episodes per evaluation, on other goals than those of the report."""
    video: Literal[False, True, "last"] = False
    """Whether every evaluation, or only that at the end of the training (`last`), also renders the
    first four goals of the report, into `videos/<env_steps>/`, TensorBoard and Weights & Biases.
    Without OpenGL a line says so, and the training continues."""


BRAX_DEFAULTS: Mapping[str, Any] = {
    "ppo": {"normalizer": "brax", "network": {"shared_cnn": False}},
}
"""Defaults of settings under `trainer: brax` that differ from the others."""


class Config(_Section):
    """All settings of a run."""

    seed: Annotated[int, BeforeValidator(_integral), Field(ge=0, lt=2**32)] = 0
    """Seed of networks, environments and exploration."""
    seeds: Annotated[int, BeforeValidator(_integral), Field(ge=1, le=1024)] = 1
    """Number of policies to train at once in one program, with consecutive seeds from `seed` on."""
    trainer: Literal["resumable", "brax"] = "resumable"
    """`resumable`: this project's training loop with Brax's PPO; `brax`: Brax's own
    `brax.training.agents.ppo.train.train`, which cannot resume; the defaults of `ppo.normalizer`
    and `ppo.network.shared_cnn` are then `brax` and false."""
    deterministic: bool = False
    """Whether a GPU computes bit-identical results for a seed, more slowly; a CPU always does."""
    cpu_devices: Annotated[int, BeforeValidator(_integral), Field(ge=1, le=1024)] | None = None
    """Devices that the CPU is divided into, at most 1,024, each with its share of the environments,
    which can be faster on several cores; results depend on it. null: as JAX has them, one as a
    rule. A GPU is not divided."""
    init_from: str | None = None
    """A run whose networks and normaliser to begin with, instead of those of the seed: its folder,
    or a name such as `pretrained:jetbot_egocentric`. The observation may differ."""
    checkpoint_interval: Steps = 100_000
    """Environment steps between two checkpoints, each with an evaluation and a log line."""
    checkpoints_to_keep: Count = 50
    """Number of latest checkpoints to keep, besides the first and the best."""
    preemption_notice: Annotated[float, Field(ge=2, allow_inf_nan=False)] = 30.0
    """[s] time after SIGTERM, SIGHUP or SIGINT within which the process must save and exit."""
    stop_at_success: Annotated[float, Field(gt=0, le=1, allow_inf_nan=False)] | None = None
    """Training ends at the first evaluation with this success rate; null: never before the end."""
    tensorboard: bool = True
    """Whether to write TensorBoard's event files beside `metrics.jsonl`."""
    wandb: Annotated[str, AfterValidator(_wandb_project)] | None = None
    """Project of Weights & Biases that the run is also logged to; null: none."""
    robot: RobotConfig = RobotConfig()
    task: TaskConfig = TaskConfig()
    camera: CameraConfig = CameraConfig()
    physics: PhysicsConfig = PhysicsConfig()
    randomization: RandomizationConfig = RandomizationConfig()
    ppo: PPOConfig = PPOConfig()
    evaluation: EvaluationConfig = EvaluationConfig()

    @model_validator(mode="before")
    @classmethod
    def _defaults_for_brax(cls, values: Any) -> Any:
        """Default to what Brax's own trainer knows, where it is to train."""
        if isinstance(values, Mapping) and values.get("trainer") == "brax":
            return _with_defaults(values, BRAX_DEFAULTS)
        return values

    @model_validator(mode="after")
    def _settings_fit(self) -> Self:
        step = self.ppo.steps_per_training_step
        unseen = None if self.task.sees else next(iter(self.randomization.looks), None)
        for is_wrong, message in (
            (
                self.seed + self.seeds > 2**32,
                f"seeds = {self.seeds} from seed = {self.seed} on go beyond {2**32 - 1}:"
                f" make seed at most {2**32 - self.seeds}",
            ),
            (
                unseen is not None,
                f"randomization.{unseen} = {list(self.randomization.drawn.get(str(unseen), ()))}"
                f" changes an image, and task.observation = {self.task.observation!r} sees none:"
                " set task.observation: camera, or leave it out",
            ),
            (
                self.task.sees and self.init_from is not None,
                f"init_from = {shown(self.init_from)}: a policy with task.observation ="
                f" {self.task.observation!r} cannot begin with another's: leave it out",
            ),
            (
                self.checkpoint_interval < step,
                f"checkpoint_interval = {self.checkpoint_interval} is shorter than one training"
                f" step of {step} environment steps (ppo.batch_size * ppo.num_minibatches *"
                f" ppo.unroll_length): make it at least {step}",
            ),
        ):
            if is_wrong:
                raise ValueError(message)
        return self

    @model_validator(mode="after")
    def _trainer_can(self) -> Self:
        shared = self.task.sees and self.ppo.network.shared_cnn
        physical = self.ppo.normalizer == "physical"
        for is_set, setting, other_remedy in (
            (physical, "ppo.normalizer = 'physical'", ", or ppo.normalizer = 'brax'"),
            (self.ppo.update == "fused", "ppo.update = 'fused'", ", or ppo.update = 'auto'"),
            (shared, "ppo.network.shared_cnn = true", ", or ppo.network.shared_cnn = false"),
            (self.deterministic, "deterministic = true", ""),
            (self.init_from is not None, "init_from", ""),
            (self.seeds > 1, f"seeds = {self.seeds}", ""),
        ):
            if is_set and self.trainer == "brax":
                raise ValueError(
                    f"{setting} is not supported by trainer = 'brax': use trainer = 'resumable'"
                    f"{other_remedy}"
                )
        return self

    def for_any_device(self) -> "Config":
        """Return a copy whose `physics.impl` and `camera.impl` are "auto", unless they are `xla`.

        A run that requested a kernel for one kind of device can then be evaluated on others too.
        """
        sections = {"physics": self.physics, "camera": self.camera}
        return self.model_copy(
            update={
                name: section.model_copy(update={"impl": "auto"})
                for name, section in sections.items()
                if section.impl != "xla"
            }
        )

    def of_each_seed(self) -> list["Config"]:
        """Return one configuration for each seed, with `seeds = 1`."""
        return [
            self.model_copy(update={"seed": self.seed + index, "seeds": 1})
            for index in range(self.seeds)
        ]

    def flat(self) -> dict[str, Any]:
        """Return every setting by its full key, such as `ppo.num_envs`."""
        return _flat(self.model_dump(mode="json"))

    def check_resume(self, changed: "Config") -> None:
        """Raise an error if a setting changed that must not change on resume.

        Args:
          changed: the configuration to resume the run with.

        Raises:
          ConfigError: it differs in settings other than `CHANGEABLE_ON_RESUME`.
        """
        now, then = changed.flat(), self.flat()
        for key in {**then, **now}:
            if then.get(key) != now.get(key) and key not in CHANGEABLE_ON_RESUME:
                raise ConfigError(
                    f"{clipped(key)} = {shown(now.get(key))} is not what the run began with,"
                    f" {shown(then.get(key))}: only {', '.join(CHANGEABLE_ON_RESUME)} may change"
                )

    def check_cpu_devices(self, local_device_count: int) -> None:
        """Raise an error if JAX has divided the CPU otherwise.

        Args:
          local_device_count: devices of this process, CPUs.

        Raises:
          ConfigError: `cpu_devices` is another number.
        """
        if self.cpu_devices not in (None, local_device_count):
            raise ConfigError(
                f"cpu_devices = {self.cpu_devices}: JAX has already started with"
                f" {local_device_count}: call jax.config.update('jax_num_cpu_devices',"
                f" {self.cpu_devices}) before its first computation, or remove the setting"
            )

    def check_devices(self, device_count: int) -> None:
        """Raise an error if the environments cannot be divided evenly among the devices.

        Args:
          device_count: devices that training will use, over all hosts.

        Raises:
          ConfigError: `num_envs` or `batch_size` is no multiple of `device_count`.
        """
        for key in ("num_envs", "batch_size"):
            value = getattr(self.ppo, key)
            if value % device_count:
                fit = device_count * max(1, round(value / device_count))
                raise ConfigError(
                    f"ppo.{key} = {value} cannot be shared evenly by {device_count} devices:"
                    f" for example ppo.{key} = {fit}"
                )

    def to_yaml(self) -> str:
        """Return the resolved configuration with every key as YAML."""
        stream = io.StringIO()
        yaml = YAML(typ="safe", pure=True)
        yaml.default_flow_style = False
        yaml.sort_base_mapping_type_on_output = False  # pyright: ignore[reportAttributeAccessIssue]
        yaml.dump(self.model_dump(mode="json"), stream)
        return stream.getvalue()


CHANGEABLE_ON_RESUME = (
    "ppo.num_timesteps",
    "stop_at_success",
    "checkpoint_interval",
    "checkpoints_to_keep",
    "preemption_notice",
    "tensorboard",
    "wandb",
    "evaluation.video",
)
"""Settings that may change on resume: the length of the training, and what it writes."""


def _with_defaults(values: Mapping[str, Any], defaults: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested settings with those that are missing taken from others."""
    merged = {**defaults, **values}
    for key, default in defaults.items():
        if isinstance(default, Mapping) and isinstance(values.get(key), Mapping):
            merged[key] = _with_defaults(values[key], default)
    return merged


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{key}.")
        else:
            flat[prefix + key] = value
    return flat


def shipped_folder(name: str) -> Path:
    """Return a folder of the repository that a wheel holds inside the package.

    Args:
      name: `configs`, `examples`, or a folder in them.
    """
    package = Path(__file__).parent
    return next(
        (folder / name for folder in (package, package.parent) if (folder / name).is_dir()),
        package / name,
    )


_CONFIGS = ("configs", "examples")


def run_around(path: Path) -> Path | None:
    """Return the run folder that a path is, or is inside of at `checkpoints/`; None if neither."""
    inside = [path, path.parent, path.parent.parent, path.parent.parent.parent]
    for place, folder in enumerate(inside):
        if os.path.isfile(folder / "config.yaml"):
            return folder if place == 0 or inside[place - 1].name == "checkpoints" else None
    return None


def shipped_configs(folders: Sequence[str] = _CONFIGS) -> dict[str, Path]:
    """Return the configurations that come with the package, by name; the examples come last.

    Args:
      folders: the folders that hold them, or others in the repository with YAML files.
    """
    files = [file for one in folders for file in sorted(shipped_folder(one).glob("*.yaml"))]
    return {file.stem: file for file in files}


def find_config(name: str | Path, folders: Sequence[str] = _CONFIGS, what: str = "config") -> Path:
    """Return the path of a configuration file.

    Args:
      name: the path of a file, or the name of a configuration that comes with the package, such
        as `jetbot_egocentric`.
      folders: where that comes from, as for `shipped_configs`.
      what: the argument that names the file, for error messages.

    Returns:
      The path, which need not exist if it names a folder.

    Raises:
      ConfigNotFoundError: a plain name is neither a file nor one that comes with the package.
    """
    path = Path(name)
    # A reader of the documentation may name `configs/gpu.yaml` in another folder.
    if os.path.lexists(path) or path.parent.as_posix() not in (".", *folders):
        return path
    shipped = shipped_configs(folders)
    if (found := shipped.get(path.name.removesuffix(".yaml"))) is not None:
        return found
    close = difflib.get_close_matches(path.stem, shipped, n=1)
    hint = f"did you mean {close[0]}?" if close else f"give a file, or one of {', '.join(shipped)}"
    if what == "config" and "=" in path.name:
        hint = f"did you mean --set {path.name}?"
    raise ConfigNotFoundError(f"{what} {name} does not exist: {hint}")


def load_config(config: "str | Path | Config | None", overrides: Overrides = ()) -> Config:
    """Read a configuration, apply overrides, and check the result.

    The module of `task.name` is found beside the file, from now on in the whole process.

    Args:
      config: the name of a configuration that comes with the package; a YAML file with the settings
        that differ from the defaults; or a `Config`. None: only defaults.
      overrides: the settings to change, such as `{"ppo.num_envs": 256}`; or a list of
        `section.key=value`, as after `--set`, the value read as YAML, of which the last one wins.

    Returns:
      The resolved configuration.

    Raises:
      ConfigError: the file or an override cannot be read, or a key is unknown, of the wrong
        type, out of bounds or at odds with another.
      InvalidError: the task's module is beside the file, and another one of its name was found
        before.
    """
    file = None
    if isinstance(config, Config):
        if not overrides:
            return config
        values, name = config.model_dump(mode="json"), "config"
    elif config is None:
        values, name = {}, "config"
    elif isinstance(config, str | Path):
        file = find_config(config)
        values, name = read_yaml(file), str(config)
    else:
        raise ConfigError(
            f"config = {shown(config)} is wrong: it should be a name, a file or Config"
        )
    if isinstance(overrides, str):
        raise ConfigError(
            f"overrides = {shown(overrides)} is wrong: give settings and values, as in"
            " {'ppo.num_envs': 256}"
        )
    if isinstance(overrides, Mapping):
        name += f" with {shown(dict(overrides))}" if overrides else ""
        for key, value in overrides.items():
            _set(values, str(key), value, f"{clipped(str(key))} = {shown(value)}")
    else:
        for override in overrides:
            given = f"--set {clipped(override)}"
            name += f" {given}"
            _apply_override(values, override, given)
    resolved = parse_config(values, source=name)
    if file is not None:
        find_task_beside(file, resolved.task.name.partition(":")[0])
    return resolved


def parse_config(values: Mapping[str, Any], source: str = "config") -> Config:
    """Check a nested mapping of settings.

    Args:
      values: the settings, nested as in YAML.
      source: description of their origin for error messages.

    Returns:
      The resolved configuration.

    Raises:
      ConfigError: as for `load_config`.
    """
    try:
        return Config.model_validate(values)
    except ValidationError as error:
        raise ConfigError(f"{source}: {_explain(error.errors()[0])}") from None


def read_yaml(path: Path, what: str = "config") -> dict[str, Any]:
    """Read a YAML file of settings; an empty file gives an empty dictionary.

    Args:
      path: the file.
      what: the argument that names the file, for error messages.

    Raises:
      ConfigError: the file cannot be read, or does not hold `key: value` lines.
    """
    try:
        with path.open(encoding="utf-8") as file:
            text = file.read(_MOST_YAML_CHARACTERS + 1)
    except FileNotFoundError:
        message = f"{what} {path} does not exist: give the path of a YAML file"
        raise ConfigNotFoundError(message) from None
    except (OSError, UnicodeDecodeError) as error:
        if path.is_dir():
            run = run_around(path) if what == "config" else None
            remedy = "give a YAML file"
            if run is not None:
                remedy = f"to continue that run, give --resume {shlex.quote(str(run))}"
            raise ConfigError(f"{what} {path} is a folder: {remedy}") from None
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise ConfigError(f"{what} {path} cannot be read: {reason}") from None
    return parse_yaml(text, f"{what} {path}")


def parse_yaml(text: str, source: str) -> dict[str, Any]:
    """Return the settings that a text in YAML holds; an empty text gives an empty dictionary.

    Args:
      text: the text.
      source: description of its origin for error messages.

    Raises:
      ConfigError: the text is not valid YAML, or does not hold `key: value` lines.
    """
    if len(text) > _MOST_YAML_CHARACTERS:
        raise ConfigError(
            f"{source} has more than {_MOST_YAML_CHARACTERS:,} characters: that is no configuration"
        )
    values = _parse_yaml(text, source)
    if values is None:
        return {}
    if not isinstance(values, dict):
        raise ConfigError(f"{source} holds {shown(values)}: write `key: value` lines")
    return values


_YAML_PROBLEMS = {
    r"found character '\t' that cannot start any token": "a tab: indent by spaces",
    "expected <block end>, but found '<block mapping start>'": (
        "it is indented neither as the line above it nor as the section it belongs to"
    ),
}
"""What is meant by messages that speak of a parser's inner life."""

_MOST_SECTIONS = 8
"""Largest number of nested sections that a message names."""

_MOST_YAML_CHARACTERS = 100_000
_MOST_YAML_VALUES = 100_000
"""Largest size of a file of settings, as text and with all aliases replaced by what they stand for.
"""


class _BoundedConstructor(SafeConstructor):
    """A `_BoundedConstructor` refuses text whose aliases stand for more values than it should."""

    def construct_document(self, node: Node) -> Any:
        """Construct the value of a document, unless it would be too large."""
        if _count_values(node, {}) > _MOST_YAML_VALUES:
            raise YAMLError(f"its aliases stand for more than {_MOST_YAML_VALUES:,} values")
        return super().construct_document(node)


def _count_values(node: Node, known: dict[int, float]) -> float:
    """Return the number of nodes below a node with aliases replaced; infinite if it is recursive.

    Args:
      node: the node.
      known: the numbers found so far, by the identity of the node.
    """
    if id(node) not in known:
        known[id(node)] = math.inf
        children = node.value if isinstance(node.value, list) else []
        pairs = [child if isinstance(child, tuple) else (child,) for child in children]
        known[id(node)] = 1 + sum(_count_values(one, known) for pair in pairs for one in pair)
    return known[id(node)]


def _parse_yaml(text: str, source: str) -> object:
    yaml = YAML(typ="safe", pure=True)
    yaml.Constructor = _BoundedConstructor
    yaml.composer.warn_double_anchors = False
    try:
        return yaml.load(text)
    except YAMLError as error:
        problem = getattr(error, "problem", None) or str(error).splitlines()[0]
        mark = getattr(error, "problem_mark", None)
        place = f", line {mark.line + 1}" if mark else ""
        reason = _YAML_PROBLEMS.get(problem, clipped(problem))
        raise ConfigError(f"{source}{place} is not valid YAML: {reason}") from None
    except RecursionError:
        raise ConfigError(f"{source} is not valid YAML: it is nested too deeply") from None
    # Errors that ruamel.yaml does not convert: `!!int x`, `!!bool x`, endless integers.
    except (ValueError, LookupError) as error:
        endless = "integer string conversion" in str(error)
        reason = "a number has too many digits" if endless else clipped(str(error))
        raise ConfigError(f"{source} is not valid YAML: {reason}") from None


def _apply_override(values: dict[str, Any], override: str, source: str) -> None:
    key, separator, text = override.partition("=")
    if not separator or not all(key.strip().split(".")):
        raise ConfigError(f"{source}: write section.key=value, as in ppo.num_envs=256")
    value = _parse_yaml(text, source)
    _set(values, key.strip(), value, source, "--set {}={}")


def _set(
    values: dict[str, Any], key: str, value: object, source: str, form: str = "'{}': {}"
) -> None:
    """Set one key of nested values.

    Args:
      values: the nested values, which are changed.
      key: the key with its sections, such as `ppo.num_envs`.
      value: its new value.
      source: the override as it was written, for error messages.
      form: how an override is written, for error messages.
    """
    *sections, last = key.split(".")
    section = values
    for part in sections:
        section = section.setdefault(part, {})
        if not isinstance(section, dict):
            raise ConfigError(f"{source}: {part} is a value, not a section")
    if isinstance(value, Mapping):
        # A whole section would silently discard the file's values of its other keys.
        inner, one = next(iter(value.items()), ("key", "value"))
        inner, one = (x if isinstance(x, str) else shown(x) for x in (inner, one))
        example = form.format(f"{key}.{clipped(inner)}", clipped(one))
        raise ConfigError(f"{source}: set single keys, as in {example}")
    section[last] = value


def _explain(error: ErrorDetails) -> str:
    """Return one line about pydantic's first error: the key, the value, and what is expected."""
    # Pydantic adds the name of a union's branch or the index in a tuple; keep only the keys.
    location = [clipped(str(part), 100) for part in error["loc"]]
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
        case "tuple_type":
            return f"{key} = {value} is wrong: it should be a list"
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
            return f"{'.'.join(location)} = {shown(value)} is unknown: {_likely_key(location)}"
        case "value_error":
            prefix = f"{key}: " if key else ""
            return prefix + str(error["ctx"]["error"]) if "ctx" in error else error["msg"]
        case "model_type" | "model_attributes_type":
            inside = next(one for one in ALL_KEYS if one.startswith(f"{key}."))
            empty = error["input"] is None
            remedy = "write its keys below it, indented" if empty else f"set {inside}"
            return f"{key} = {value} is not a section: {remedy}"
        case _:
            wanted = error["msg"].removeprefix("Input should be ").removeprefix("a valid ")
            return f"{key} = {value} is wrong: it should be {_KINDS.get(wanted, wanted)}"


_KINDS = {
    "integer": "a whole number",
    "number": "a number",
    "boolean": "true or false",
    "string": "text",
    "dictionary": "a dictionary",
}
"""Pydantic's names of types, in words."""


def _likely_key(location: Sequence[str]) -> str:
    """Return a remedy for an unknown key: the one that was probably meant, or all there are."""
    *sections, key = location
    # YAML nests what `--set` writes with dots.
    if not sections and key in ALL_KEYS:
        section, _, last = key.rpartition(".")
        return f"write `{last}` below `{section}:`, indented"
    if likely := keys_meant_by(".".join(location)):
        return f"did you mean {' or '.join(likely)}?"
    section = Config()
    for name in sections:
        section = getattr(section, name, Config())
    return f"known are {', '.join(type(section).model_fields)}"


def keys_meant_by(key: str, *, similar: bool = True) -> list[str]:
    """Return the full keys that were probably meant by an unknown one, the likeliest first.

    Args:
      key: the key, with its section or without, perhaps as another library calls it.
      similar: whether keys that are only spelt like it count too.
    """
    section, _, last = key.rpartition(".")
    if last in _OTHER_NAMES:
        return [_OTHER_NAMES[last]]
    # A key may be that of another section, such as learning_rate without `ppo.`.
    names = {known: known.rpartition(".")[2] for known in ALL_KEYS}
    likely = [known for known, name in names.items() if last == name]
    if likely or not similar:
        return likely
    own = [known for known in ALL_KEYS if known.rpartition(".")[0] == section]
    for keys, cutoff in ((own, 0.6), (ALL_KEYS, 0.8)):
        close = difflib.get_close_matches(last, {names[known] for known in keys}, 1, cutoff)
        likely = [known for known in keys if names[known] in close]
        if likely:
            return likely
    return difflib.get_close_matches(key, ALL_KEYS, 1, 0.8)


_OTHER_NAMES = {
    "lr": "ppo.learning_rate",
    "gamma": "ppo.discounting",
    "discount": "ppo.discounting",
    "lam": "ppo.gae_lambda",
    "n_envs": "ppo.num_envs",
    "n_steps": "ppo.unroll_length",
    "num_steps": "ppo.unroll_length",
    "n_epochs": "ppo.num_updates_per_batch",
    "num_epochs": "ppo.num_updates_per_batch",
    "update_epochs": "ppo.num_updates_per_batch",
    "total_timesteps": "ppo.num_timesteps",
    "timesteps": "ppo.num_timesteps",
    "minibatches": "ppo.num_minibatches",
    "minibatch_size": "ppo.batch_size",
    "clip_range": "ppo.clipping_epsilon",
    "clip_coef": "ppo.clipping_epsilon",
    "ent_coef": "ppo.entropy_cost",
    "entropy_coef": "ppo.entropy_cost",
    "vf_coef": "ppo.vf_loss_coefficient",
    "target_kl": "ppo.desired_kl",
    "net_arch": "ppo.network.policy_hidden_layer_sizes",
    "random_seed": "seed",
    "num_seeds": "seeds",
    "n_seeds": "seeds",
}
"""Settings by the names that Stable-Baselines3, CleanRL, rsl_rl and Brax have for them; they are
suggested, and not accepted."""

ALL_KEYS = tuple(Config().flat())
"""Every setting with its section, such as `ppo.learning_rate`."""
