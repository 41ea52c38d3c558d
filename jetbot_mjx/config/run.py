"""Define the whole configuration of a run: its own settings, all sections, and how they fit."""

import io
from collections.abc import Mapping
from typing import Annotated, Literal, Self, TypeAlias

from pydantic import (
    AfterValidator,
    BeforeValidator,
    Discriminator,
    Field,
    JsonValue,
    Tag,
    model_validator,
)
from ruamel.yaml import YAML

from jetbot_mjx.config.camera import CameraConfig
from jetbot_mjx.config.errors import ConfigError
from jetbot_mjx.config.evaluation import EvaluationConfig
from jetbot_mjx.config.physics import PhysicsConfig
from jetbot_mjx.config.ppo import PPOConfig
from jetbot_mjx.config.randomization import RandomizationConfig
from jetbot_mjx.config.robot import RobotConfig
from jetbot_mjx.config.robot_mjcf import MjcfRobotConfig, is_model
from jetbot_mjx.config.section import Section
from jetbot_mjx.config.task import TaskConfig
from jetbot_mjx.config.task_modules import class_name
from jetbot_mjx.config.value_types import Count, Steps, Text, finite, integral, wandb_project
from jetbot_mjx.errors import clipped, shown

BRAX_DEFAULTS: Mapping[str, object] = {
    "ppo": {"normalizer": "brax", "network": {"shared_cnn": False}},
}
"""Defaults of settings under `trainer: brax` that differ from the others."""

ENVIRONMENT_DEFAULTS: Mapping[str, object] = {"ppo": {"normalizer": "brax"}}
"""Likewise with an `environment` of one's own, whose observation has no known units."""


Setting = bool | int | float | str | list["Setting"] | dict[str, "Setting"] | None
"""Value of a setting, as JSON."""

_Nested: TypeAlias = "Mapping[str, Setting | _Nested]"


ROBOT_KINDS = "measures", "model"
"""What the section `robot` may hold; pydantic adds these words to the places of errors."""


class Config(Section):
    """All settings of a run."""

    seed: Annotated[int, BeforeValidator(integral), Field(ge=0, lt=2**32)] = 0
    """Seed of networks, environments and exploration."""
    seeds: Annotated[int, BeforeValidator(integral), Field(ge=1, le=1024)] = 1
    """Number of policies to train at once in one program, with consecutive seeds from `seed` on."""
    trainer: Literal["resumable", "brax"] = "resumable"
    """`resumable`: this project's training loop with Brax's PPO; `brax`: Brax's own
    `brax.training.agents.ppo.train.train`, which cannot resume; the defaults of `ppo.normalizer`
    and `ppo.network.shared_cnn` are then `brax` and false."""
    deterministic: bool = False
    """Whether a GPU computes bit-identical results for a seed, more slowly; a CPU always does."""
    cpu_devices: Annotated[int, BeforeValidator(integral), Field(ge=1, le=1024)] | None = None
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
    stop_at_return: Annotated[float, Field(allow_inf_nan=False)] | None = None
    """Training ends at the first evaluation with this mean return of an episode, likewise."""
    environment: Annotated[str, AfterValidator(class_name)] | None = None
    """An environment of your own to train in, in place of the robot and its task: a class, or a
    function that returns one, as `file.py:Class` with a file beside this one, or
    `package.module:Class`."""
    environment_options: Annotated[dict[Text, JsonValue], AfterValidator(finite)] = Field(
        default_factory=dict
    )
    """Keyword arguments with which it is called."""
    tensorboard: bool = True
    """Whether to write TensorBoard's event files beside `metrics.jsonl`."""
    wandb: Annotated[str, BeforeValidator(wandb_project)] | None = None
    """Project of Weights & Biases that the run is also logged to; null: none."""
    robot: Annotated[
        Annotated[RobotConfig, Tag(ROBOT_KINDS[0])]
        | Annotated[MjcfRobotConfig, Tag(ROBOT_KINDS[1])],
        Discriminator(lambda values: ROBOT_KINDS[is_model(values)]),
    ] = RobotConfig()
    task: TaskConfig = TaskConfig()
    camera: CameraConfig = CameraConfig()
    physics: PhysicsConfig = PhysicsConfig()
    randomization: RandomizationConfig = RandomizationConfig()
    ppo: PPOConfig = PPOConfig()
    evaluation: EvaluationConfig = EvaluationConfig()

    @model_validator(mode="before")
    @classmethod
    def _defaults_for_brax(cls, values: object) -> object:
        """Default to what Brax's own trainer knows, where it is to train."""
        if isinstance(values, Mapping) and values.get("trainer") == "brax":
            return with_defaults(values, BRAX_DEFAULTS)
        return values

    @model_validator(mode="before")
    @classmethod
    def _defaults_for_environment(cls, values: object) -> object:
        """Default to what needs no units, where an environment of one's own has none."""
        if isinstance(values, Mapping) and values.get("environment") is not None:
            return with_defaults(values, ENVIRONMENT_DEFAULTS)
        return values

    @model_validator(mode="after")
    def _environment_is_alone(self) -> Self:
        if self.environment is None:
            if self.ppo.network.distribution_type == "categorical":
                raise ValueError(
                    "ppo.network.distribution_type = 'categorical' is for an environment whose"
                    " actions are choices, and those of the robot are numbers: choose tanh_normal"
                )
            if self.environment_options:
                raise ValueError(
                    f"environment_options = {shown(self.environment_options)} are the arguments of"
                    " an environment, and there is none: set environment, or leave them out"
                )
            return self
        given = f"environment = {shown(self.environment)}"
        for name in ("task", "robot", "camera", "physics", "randomization"):
            section: Section = getattr(self, name)
            for key, field in type(section).model_fields.items():
                value = getattr(section, key)
                if value == field.get_default(call_default_factory=True):
                    continue
                if f"{name}.{key}" not in ("task.episode_length", "physics.impl"):
                    raise ValueError(
                        f"{name}.{key} = {shown(value)} is of the JetBot, which {given} takes the"
                        " place of: leave it out"
                    )
        if self.ppo.normalizer == "physical":
            raise ValueError(
                f"ppo.normalizer = 'physical' needs the units of the observation, which {given}"
                " does not state: set ppo.normalizer: brax, or leave it out"
            )
        return self

    @model_validator(mode="after")
    def _settings_fit(self) -> Self:
        step = self.ppo.steps_per_training_step
        if self.seed + self.seeds > 2**32:
            raise ValueError(
                f"seeds = {self.seeds} from seed = {self.seed} on go beyond {2**32 - 1}:"
                f" make seed at most {2**32 - self.seeds}"
            )
        if (looks := self.randomization.looks) and not self.task.sees:
            raise ValueError(
                f"randomization.{looks[0]} = {list(self.randomization.drawn[looks[0]])}"
                f" changes an image, and task.observation = {self.task.observation!r} sees none:"
                " set task.observation: camera, or leave it out"
            )
        if isinstance(self.robot, MjcfRobotConfig):
            self.robot.check_drawn(self.randomization.drawn)
        if self.task.sees and self.init_from is not None:
            raise ValueError(
                f"init_from = {shown(self.init_from)}: a policy with task.observation ="
                f" {self.task.observation!r} cannot begin with another's: leave it out"
            )
        if self.checkpoint_interval < step:
            raise ValueError(
                f"checkpoint_interval = {self.checkpoint_interval} is shorter than one training"
                f" step of {step} environment steps (ppo.batch_size * ppo.num_minibatches *"
                f" ppo.unroll_length): make it at least {step}"
            )
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

    @property
    def code(self) -> str:
        """Return the name of what the policy acts in: environment or task, as `module:Class`."""
        return self.environment or self.task.name

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

    def flat(self) -> dict[str, Setting]:
        """Return every setting by its full key, such as `ppo.num_envs`."""
        return _flat(self.model_dump(mode="json"))

    def check_resume(self, changed: "Config") -> None:
        """Raise an error if a setting changed that must not change on resume.

        Args:
          changed: the configuration to resume the run with.

        Raises:
          ConfigError: it differs in settings other than `CHANGEABLE_ON_RESUME`.
        """
        for key, (then, now) in self.fixed_changes(changed).items():
            raise ConfigError(
                f"{clipped(key)} = {shown(now)} is not what the run began with,"
                f" {shown(then)}: only {', '.join(CHANGEABLE_ON_RESUME)} may change"
            )

    def fixed_changes(self, changed: "Config") -> dict[str, tuple[Setting, Setting]]:
        """Return the settings that must not change on resume and do, each before and after.

        Args:
          changed: the configuration to resume the run with.
        """
        changes = self.changes(changed)
        return {key: both for key, both in changes.items() if key not in CHANGEABLE_ON_RESUME}

    def changes(self, changed: "Config") -> dict[str, tuple[Setting, Setting]]:
        """Return the settings that differ, each before and after.

        Args:
          changed: the other configuration.
        """
        now, then = changed.flat(), self.flat()
        return {
            key: (then.get(key), now.get(key))
            for key in {**then, **now}
            if then.get(key) != now.get(key)
        }

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
    "stop_at_return",
    "checkpoint_interval",
    "checkpoints_to_keep",
    "preemption_notice",
    "tensorboard",
    "wandb",
    "evaluation.video",
)
"""Settings that may change on resume: the length of the training, and what it writes."""


def with_defaults(
    values: Mapping[str, object], defaults: Mapping[str, object]
) -> dict[str, object]:
    """Return nested settings with those that are missing taken from others.

    Args:
      values: the settings.
      defaults: the others, nested alike.
    """
    merged = {**defaults, **values}
    for key, default in defaults.items():
        given = values.get(key)
        if isinstance(default, Mapping) and isinstance(given, Mapping):
            merged[key] = with_defaults(given, default)
    return merged


def _flat(values: _Nested, prefix: str = "") -> dict[str, Setting]:
    flat: dict[str, Setting] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            flat |= _flat(value, f"{prefix}{key}.")
        else:
            flat[prefix + key] = value
    return flat
