"""Replays a world that stopped being finite: `python -m jetbot_mjx.replay RUN/nan_dumps/FILE`."""

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jetbot_mjx import cli
from jetbot_mjx.compiler.program_cache import use_compilation_cache
from jetbot_mjx.envs.domain_randomization import maybe_randomize
from jetbot_mjx.envs.jetbot_env import JetBotEnv, make_env
from jetbot_mjx.envs.kinematics import yaw
from jetbot_mjx.envs.state import State, robot_state
from jetbot_mjx.envs.wrappers import wrap_for_training
from jetbot_mjx.runs.checkpoint_store import flatten
from jetbot_mjx.runs.nan_dump import StoredNanDump, load_nan_dump

NOT_REPRODUCED = 1


class Moment(NamedTuple):
    """A `Moment` holds one step of the replay."""

    action: np.ndarray
    state: State
    """State after the step and before any reset."""
    odd: list[str]
    """Names of the arrays that are not finite."""


def run(stored: StoredNanDump, env: JetBotEnv) -> Iterator[Moment]:
    """Replay the recorded actions from the state in which the unroll began.

    Args:
      stored: the stored nan_dump.
      env: the environment of the nan_dump.

    Yields:
      Every step up to the one with the non-finite state.
    """
    wrapped = wrap_for_training(env, stored.config.task.episode_length)
    step, raw_step = jax.jit(wrapped.step), jax.jit(jax.vmap(maybe_randomize(env).step))
    state: Any = jax.tree.map(lambda x: jnp.asarray(x)[None], stored.nan_dump.env_state)
    for action in stored.nan_dump.actions[: int(stored.nan_dump.step) + 1]:
        after = jax.device_get(jax.tree.map(lambda x: x[0], raw_step(state, action[None])))
        seen = {"pipeline_state": after.pipeline_state, "obs": after.obs, "reward": after.reward}
        odd = [name for name, leaf in flatten(seen).items() if not np.all(np.isfinite(leaf))]
        yield Moment(action, after, odd)
        state = step(state, action[None])


def line(index: int, moment: Moment) -> str:
    """Format one step as a line of the table."""
    robot = robot_state(jax.tree.map(jnp.asarray, moment.state.pipeline_state))
    x, y, z = np.asarray(robot.position_w)
    fastest = np.abs(moment.state.pipeline_state.qvel).max()
    return (
        f"{index:4d}  {moment.action[0]:+7.3f} {moment.action[1]:+7.3f}  {x:+8.3f} {y:+8.3f}"
        f" {z:+8.4f}  {math.degrees(float(yaw(robot.quat))):+7.1f}°  {fastest:10.3g}"
        f"  {', '.join(moment.odd)}"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and replay.

    Args:
      arguments: arguments without the program's name; None: those of the process.

    Returns:
      0, or 1 if the state stayed finite this time.
    """
    parser = cli.Parser(prog="python -m jetbot_mjx.replay", description=__doc__)
    parser.add_argument("file", type=Path, help="a file in a run's nan_dumps/")
    options = parser.parse_args(arguments)
    cli.require_device()
    use_compilation_cache()
    stored = load_nan_dump(options.file)
    print(
        f"a world that blew up before step {stored.env_steps:,} of its training, from where its"
        " unroll began\n"
        f"{'step':>4}  {'action':>15}  {'x [m]':>8} {'y [m]':>8} {'z [m]':>8}  {'yaw':>8}"
        f"  {'max |qvel|':>10}  not finite"
    )
    odd: list[str] = []
    for index, moment in enumerate(run(stored, make_env(stored.config.for_any_device()))):
        print(line(index, moment))
        odd = moment.odd
    if not odd:
        print("it stayed finite here: other devices and other versions round differently")
        return NOT_REPRODUCED
    return 0


if __name__ == "__main__":
    cli.run_command(main)
