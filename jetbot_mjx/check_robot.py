"""Check a robot, and tell what a step of it costs: `jetbot-mjx check-robot my_robot.yaml`.

The file is a configuration, the measures of a robot as YAML, or a MuJoCo model. Of a model alone,
the actuators are found by their axes and sides, and the section `robot` that names them is printed.
What is wrong is told in one line that says how to correct it.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from jetbot_mjx import cli, startup
from jetbot_mjx.config import (
    YAML_ENDINGS,
    Config,
    is_model,
    load_config,
    model_files,
    parse_config,
    read_yaml,
    register,
)
from jetbot_mjx.errors import UserError
from jetbot_mjx.fallbacks import collect

if TYPE_CHECKING:
    from jetbot_mjx.envs import JetBotEnv

_ROBOTS = 1024
"""Robots of the rate."""

_ROBOTS_WITHOUT_KERNEL = 16
"""Those of a robot whose step is no kernel: of many, it would take minutes."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line, check the robot, and print what it is.

    Args:
      arguments: The arguments without the program's name, or None for those of the process.

    Returns:
      0. A robot that cannot be used ends the command with its message and exit code 2.
    """
    parser = cli.Parser(prog="jetbot-mjx check-robot", description=__doc__)
    parser.add_argument("file", type=Path, metavar="FILE", help="a YAML file, or a MuJoCo model")
    parser.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="change one setting, as for train",
    )
    options = parser.parse_args(arguments)
    with startup.exit_on_interrupt():
        from jetbot_mjx.envs import describe_robot, make_jetbot_env
    cli.prepare_device()
    env = make_jetbot_env(_config(options.file, options.overrides))
    for label, text in describe_robot(env):
        cli.tell(f"{label:10} {text}")
    _tell_cost(env)
    return 0


def _config(file: Path, overrides: Sequence[str]) -> Config:
    """Return a configuration with the robot of a file."""
    if is_model({"file": str(file)}):
        from jetbot_mjx.envs import guess_section

        files: Mapping[str, bytes] = model_files(register(file)) or {}
        section = guess_section(file.name, files)
        if not section:
            raise UserError(
                f"{file}: no actuators turn wheels on both sides: give a configuration that names"
                " them, as `robot: {file: …, wheels: {left: […], right: […]}}`"
            )
        if '""' in json.dumps(section):
            raise UserError(
                f"{file}: an actuator of a wheel has no name: give each one, as"
                ' <velocity name="…" …>'
            )
        cli.tell(f"robot: {json.dumps(section)}")
        return load_config(parse_config({"robot": {**section, "file": str(file)}}), overrides)
    if not file.suffix or (file.suffix in YAML_ENDINGS and "robot" in read_yaml(file)):
        return load_config(file, overrides)
    return load_config(parse_config({"robot": {"file": str(file)}}), overrides)


def _tell_cost(env: "JetBotEnv") -> None:
    """Print what a step of the environment costs as one kernel, and its rate on this device."""
    import jax
    import jax.numpy as jnp

    import onekernel
    from jetbot_mjx.envs import step_rate

    def step_of_this_robot(state: Any, action: Any) -> Any:
        return env.blind().step(state, action)

    state = jax.eval_shape(env.blind().reset, jax.ShapeDtypeStruct((2,), jnp.uint32))
    with collect() as fallbacks:
        onekernel.explain(
            step_of_this_robot, state, jax.ShapeDtypeStruct((env.action_size,), jnp.float32)
        )
    device = jax.devices()[0].device_kind
    robots = _ROBOTS_WITHOUT_KERNEL if fallbacks else _ROBOTS
    rate = step_rate(env, robots)
    cli.tell(f"{'rate':10} {rate:,.0f} environment steps/s of {robots:,} robots on this {device}")


if __name__ == "__main__":
    cli.run_command(main, at_once=True)
