"""Compare robots with converged C MuJoCo: `python benchmarks/reliability/robot_fidelity.py`.

Drives many robots of each configuration by commands at the limits, -1 or 1, which each robot holds
for 1 to 24 control steps: in MJX, as training does, and in C MuJoCo in float64 with the same model,
time step and controls, and a converged solver. Compares their positions at the end, on the robot's
own floor and on a slippery one.

Some robots depend on noise alone: a wheel slips or grips. So of each robot that ends beyond 2 mm,
C MuJoCo's own is driven again with every velocity pushed by 1e-6 m/s or rad/s before each control
step. The robot is explained if one of these ends at least half as far away.
"""

import argparse
import copy
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Float

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks import RESULTS
from benchmarks.harness.results import check_output, output_for, write
from benchmarks.harness.timing import env_keys
from jetbot_mjx import cli
from jetbot_mjx.config import load_config
from jetbot_mjx.envs import JetBotEnv, make_jetbot_env, put_model
from jetbot_mjx.runs.run_dir import versions

ROBOTS = {
    "isaac": ("jetbot", ()),
    "real": ("jetbot", ("robot.preset=real",)),
    "turtlebot": ("turtlebot", ()),
    "rover": ("rover", ()),
    "car": ("car", ()),
}
"""Configuration and settings of the robots that come with the package, by name."""

LONGEST_HOLD = 24  # control steps
MEDIAN, FAR = 0.05, 2.0  # [mm] allowed for the median, and for 99 of 100 robots
PUSH = 1e-6  # [m/s, rad/s]
PUSHED = 16
"""Drives with pushes for each robot that ends far away."""


class Row(NamedTuple):
    """A `Row` holds how far the robots of one configuration end from those of C MuJoCo [mm]."""

    robot: str
    friction: float | None
    """Largest sliding friction of all contacts; None: the robot's own."""
    median: float
    p99: float
    worst: float
    driven: float
    """Median distance from the start."""
    far: tuple[tuple[float, float], ...]
    """For each robot beyond `FAR` its distance, and the largest of C MuJoCo's own with pushes."""

    @property
    def explained(self) -> int:
        """Return how many of the robots beyond `FAR` noise sends as far, in C MuJoCo itself."""
        return sum(pushed >= 0.5 * apart for apart, pushed in self.far)

    @property
    def is_right(self) -> bool:
        """Return whether median and 99 of 100 robots are near enough, and all others explained."""
        return self.median <= MEDIAN and self.p99 <= FAR and self.explained == len(self.far)


def draw_actions(seed: int, robots: int, steps: int, size: int) -> Float[np.ndarray, "n t action"]:
    """Draw actions at the limits, which each robot holds for a number of steps of its own."""
    rng = np.random.default_rng(seed)
    holds = rng.integers(1, LONGEST_HOLD + 1, robots)
    limits = rng.choice(np.array([-1.0, 1.0], np.float32), (robots, steps, size))
    turns = np.arange(steps) // holds[:, None]
    return np.take_along_axis(limits, turns[..., None], axis=1)


def make_slippery(env: JetBotEnv, friction: float | None) -> tuple[JetBotEnv, mujoco.MjModel]:
    """Return an environment, and its C model, whose contacts have no more than a friction.

    Args:
      env: one environment, unwrapped.
      friction: the largest sliding friction; None: that of the model.
    """
    model = copy.copy(env.physics.mj_model)
    if friction is None:
        return env, model
    model.geom_friction[:, 0] = np.minimum(model.geom_friction[:, 0], friction)
    model.pair_friction[:, :2] = np.minimum(model.pair_friction[:, :2], friction)
    return env.with_model(put_model(model)), model


def drive(
    env: JetBotEnv, controls: Float[np.ndarray, "n t nu"]
) -> tuple[Float[np.ndarray, "n nq"], Float[np.ndarray, "n 3"]]:
    """Drive robots in MJX.

    Args:
      env: one environment, unwrapped.
      controls: controls of each robot at each control step.

    Returns:
      Their first states, and their last positions [m].
    """

    def run(controls: jax.Array) -> tuple[jax.Array, jax.Array]:
        first = jax.vmap(env.reset)(env_keys(len(controls))).pipeline_state
        step = jax.vmap(env.physics.step)
        last, _ = jax.lax.scan(
            lambda state, ctrl: (step(state, ctrl), None), first, controls.swapaxes(0, 1)
        )
        return first.qpos, last.qpos[:, :3]

    first, last = jax.jit(run)(jnp.asarray(controls))
    return np.asarray(first, float), np.asarray(last, float)


def drive_in_c(
    model: mujoco.MjModel,
    substeps: int,
    first: Float[np.ndarray, " nq"],
    controls: Float[np.ndarray, "t nu"],
    seed: int | None = None,
) -> Float[np.ndarray, "3"]:
    """Drive one robot in C MuJoCo.

    Args:
      model: the model; its solver's limits are replaced by those of a converged one.
      substeps: physics steps in one control step.
      first: the first position.
      controls: controls at each control step.
      seed: seed of the pushes; None: there are none.

    Returns:
      Its last position [m].
    """
    model.opt.iterations, model.opt.ls_iterations, model.opt.tolerance = 100, 50, 1e-12
    data, rng = mujoco.MjData(model), np.random.default_rng(seed)
    data.qpos[:] = first
    for control in controls:
        if seed is not None:
            data.qvel[:] += PUSH * rng.choice([-1.0, 1.0], model.nv)
        data.ctrl[:] = control
        mujoco.mj_step(model, data, nstep=substeps)
    return data.qpos[:3].copy()


def measure(name: str, env: JetBotEnv, friction: float | None, options: argparse.Namespace) -> Row:
    """Compare the robots of one configuration with C MuJoCo.

    Args:
      name: name of the robot.
      env: its environment, unwrapped.
      friction: the largest sliding friction; None: the robot's own.
      options: `robots`, `seconds` and `seed`.
    """
    here, model = make_slippery(env, friction)
    steps = round(options.seconds / env.dt)
    actions = draw_actions(options.seed, options.robots, steps, env.action_size)
    of_action = jax.vmap(jax.vmap(lambda x: env.drive.controls(env.wheel_targets(x))))
    controls = np.asarray(jax.jit(of_action)(actions))
    first, ours = drive(here, controls)
    substeps = env.config.physics.n_substeps

    def in_c(robot: int, seed: int | None = None) -> Float[np.ndarray, "3"]:
        return drive_in_c(model, substeps, first[robot], controls[robot], seed)

    theirs = np.stack([in_c(robot) for robot in range(options.robots)])
    apart = 1e3 * np.linalg.norm(ours - theirs, axis=1)
    far = []
    for robot in np.flatnonzero(~(apart <= FAR)).tolist():
        pushed = np.stack([in_c(robot, seed) for seed in range(PUSHED)]) - theirs[robot]
        far.append((float(apart[robot]), float(1e3 * np.linalg.norm(pushed, axis=1).max())))
    median, p99, worst = np.percentile(apart, [50, 99, 100]).tolist()
    driven = 1e3 * float(np.median(np.linalg.norm(theirs - first[:, :3], axis=1)))
    return Row(name, friction, median, p99, worst, driven, tuple(far))


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare the robots, print a table, and write the results.

    Args:
      arguments: The arguments without the program's name, or None for those of the process.

    Returns:
      0, or 1 if the robots of a configuration are not where C MuJoCo's are.
    """
    parser = cli.Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "names",
        nargs="*",
        metavar="CONFIG",
        help=f"{', '.join(ROBOTS)}, or any configuration (default: those five)",
    )
    parser.add_argument("--robots", type=cli.positive_int, default=512)
    parser.add_argument("--seconds", type=cli.number(float, 0.1), default=4.0)
    parser.add_argument(
        "--friction", type=cli.number(float, 0.0), default=0.2, help="of the slippery floor"
    )
    parser.add_argument("--seed", type=cli.whole_number(0), default=0, help="of the commands")
    stored = RESULTS / "robot-fidelity-cpu.json"
    parser.add_argument(
        "--output",
        type=Path,
        help=f"JSON file (default: results/{stored.name} of those five, none of others)",
    )
    options = parser.parse_args(arguments)
    names = options.names or [*ROBOTS]
    output = output_for(options.output, stored, is_own={*names} != {*ROBOTS})
    check_output(output)
    print("| robot | friction | median, mm | 99 % | worst | beyond 2 mm | explained | driven, m |")
    print("|---|--:|--:|--:|--:|--:|--:|--:|")
    rows = []
    for name in names:
        source, settings = ROBOTS.get(name, (name, ()))
        env = make_jetbot_env(load_config(source, settings)).blind()
        for friction in (None, options.friction):
            rows.append(measure(Path(name).stem, env, friction, options))
            print(_line(rows[-1]), flush=True)
    measured = {key: getattr(options, key) for key in ("robots", "seconds", "seed")}
    table = [{**row._asdict(), "explained": row.explained} for row in rows]
    write(output, {"versions": versions(), **measured, "fidelity": table})
    return 0 if all(row.is_right for row in rows) else 1


def _line(row: Row) -> str:
    floor = "its own" if row.friction is None else f"{row.friction:g}"
    return (
        f"| {row.robot} | {floor} | {row.median:.4f} | {row.p99:.3f} | {row.worst:.3g} |"
        f" {len(row.far)} | {row.explained} | {row.driven / 1e3:.2f} |"
    )


if __name__ == "__main__":
    cli.run_command(main)
