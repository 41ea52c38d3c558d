"""Bound the shortest time to each goal from below: `python benchmarks/learning/lower_bound.py`.

The command measures the limits of the robot's motion in --drives drives, and computes from them
for each of the report's goals a number of steps in which no controller reaches it. The numbers are
stored beside the best-known ones, and reports compare policies with both. `docs/lower-bound.md`
states the theorem, its assumptions and its proof.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks import CONFIGS
from benchmarks.harness.results import check_output
from benchmarks.learning.best_known import read, store
from benchmarks.learning.drive_limits import drive, highest, measure, random_actions
from benchmarks.learning.reachable import Grid, farthest, least_steps
from jetbot_mjx import cli
from jetbot_mjx.config import load_config
from jetbot_mjx.devices import require_device, use_compilation_cache
from jetbot_mjx.envs.jetbot_env import make_jetbot_env
from jetbot_mjx.envs.task import reach_on_floor
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation.best_known import BOUND_FILE, FILE, settings_of
from jetbot_mjx.evaluation.evaluator import report_keys
from jetbot_mjx.evaluation.goal_set import GOAL_SET_VERSION, REPORT_GOALS
from jetbot_mjx.runs.run_dir import versions

_FORMAT = "jetbot_mjx-lower-bound/1"


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, compute, print the bound and write the JSON file.

    Args:
      arguments: The command line without the program's name; None: that of the process.

    Returns:
      The exit code.
    """
    parser = cli.Parser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--config", type=Path, default=CONFIGS / "jetbot.yaml")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    for name, value, what in (
        ("goals", REPORT_GOALS, "number of the report's goals"),
        ("drives", 16_384, "drives in which the limits are measured"),
        ("steps", 300, "control steps of a drive, and largest number of steps to a goal"),
        ("divisions", Grid().divisions, "divisions of the largest change of speed in a step"),
        ("headings", Grid().headings, "headings on the circle"),
    ):
        parser.add_argument(f"--{name}", type=cli.positive_int, default=value, help=what)
    what = "default: the package's own, where reports find it"
    parser.add_argument("--output", type=Path, default=BOUND_FILE, help=what)
    options = parser.parse_args(arguments)
    require_device()
    use_compilation_cache()
    config = load_config(options.config, options.overrides)
    check_output(options.output)
    read(options.output, _FORMAT)
    env = make_jetbot_env(config)
    # Measure the limits, and the distance within which goals are reached.
    actions = random_actions(0, options.drives, options.steps, env.action_size)
    driven = drive(env, actions)
    limits, reach = measure(env, driven), reach_on_floor(env.task, highest(driven))
    if isinstance(limits, str) or reach is None:
        reason = limits if isinstance(limits, str) else "the task is not to drive to a goal"
        raise UserError(f"no bound can be given: {reason}")
    for name, value in limits._asdict().items():
        print(f"{name:>16}: {np.array2string(np.array(value), precision=5)}")
    # Compute the bound.
    table = farthest(limits, options.steps, Grid(options.divisions, options.headings))
    goals = np.asarray(jax.vmap(env.reset)(report_keys(options.goals)).goal, float)[:, :2]
    steps = least_steps(table, goals, reach)
    seconds = steps * env.dt
    print(f"bound: median {np.median(seconds):.3f} s, mean {seconds.mean():.4f} s")
    stored = {
        "settings": settings_of(config),
        "goal_set_version": GOAL_SET_VERSION,
        "limits": limits._asdict(),
        "reach": reach,
        "grid": {"divisions": options.divisions, "headings": options.headings},
        "versions": versions(),
        "goals": np.rint(1e3 * goals).astype(int).tolist(),
        "steps": steps.astype(int).tolist(),
    }
    for known in (one for one in read(FILE) if one["settings"] == stored["settings"]):
        gaps = np.array(known["steps"][: len(steps)]) / np.maximum(steps, 1) - 1
        print(f"best known: {np.median(gaps):.2%} longer in the median, {gaps.min():.2%} at least")
    store(options.output, stored, _FORMAT)
    print(f"results: {options.output}")
    return 0


if __name__ == "__main__":
    cli.run_command(main)
