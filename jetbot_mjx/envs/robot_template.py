"""Write a robot to start from: measures in YAML, or a MuJoCo model."""

from importlib import resources
from pathlib import Path

from jetbot_mjx.config import shipped_folder
from jetbot_mjx.envs.task_template import check_new, write_new
from jetbot_mjx.errors import UserError

_MODEL = "turtlebot"
"""The example that is copied as a model."""

_SETTINGS = """\
# A robot with two driven wheels and casters, on the goal task. The measures are those of a JetBot:
# write yours in their place. The configuration reference, which `make docs` writes, has each with
# its unit and bounds.
robot:
  preset: real
{measures}
  # What the software on the robot takes for the radius and the distance of the wheels.
  controller_wheel_radius: 0.0325
  controller_wheel_separation: 0.114
task:
  observation: egocentric
  max_speed: 0.3
  episode_length: 384
checkpoint_interval: 65_536
ppo:
  num_timesteps: 524_288
  num_envs: 256
  unroll_length: 16
  batch_size: 64
  num_minibatches: 4
  num_updates_per_batch: 4
  discounting: 0.95
  gae_lambda: 0.95
  learning_rate: 1.0e-3
  learning_rate_schedule: LINEAR
"""


def write_robot_template(path: Path) -> list[Path]:
    """Write a robot and its settings, without overwriting anything.

    Args:
      path: `NAME.yaml` for a configuration with measures, or `NAME.xml` for a MuJoCo model, to
        which `NAME.yaml` is added.

    Returns:
      The files that were written, the configuration last.

    Raises:
      UserError: the name is neither, or a file exists already.
    """
    if path.suffix not in (".yaml", ".xml") or not path.stem:
        raise UserError(
            f"{path}: name a file for measures, such as my_robot.yaml, or for a MuJoCo model, such"
            " as my_robot.xml"
        )
    texts = {path: _measures()} if path.suffix == ".yaml" else _model(path)
    check_new(texts)
    write_new(texts)
    return list(texts)


def _measures() -> str:
    """Return a configuration with the measures of the robot `real`."""
    real = resources.files("jetbot_mjx").joinpath("assets/robots/real.yaml").read_text("utf-8")
    lines = [line for line in real.splitlines() if line[:1] not in ("#", "")]
    own = [line for line in lines if not line.startswith("controller_")]
    return _SETTINGS.format(measures="\n".join(f"  {line}" for line in own))


def _model(path: Path) -> dict[Path, str]:
    """Return the files of the example, under another name."""
    examples, name = shipped_folder("examples"), path.stem
    texts = {}
    for file in (path, path.with_suffix(".yaml")):
        text = (examples / f"{_MODEL}{file.suffix}").read_text("utf-8")
        texts[file] = text.replace(f"{_MODEL}.xml", path.name).replace(
            f'model="{_MODEL}"', f'model="{name}"'
        )
    return texts
