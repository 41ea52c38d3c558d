"""Find the goals at which a policy is worst: `python benchmarks/learning/worst_goal.py RUN ...`.

A million goals are drawn, a hundred times as densely as a report's. The worst is one that the
policy misses, and if it misses none, the one to which it takes the longest, in comparison with what
physics allows. Its place and the drive to it are printed and drawn, above a map of all goals.
"""

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, UInt32
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.harness.results import check_output, write
from benchmarks.learning.reachable import Grid, Limits, farthest, least_steps
from jetbot_mjx import cli, evaluation
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation import theme, to_png
from jetbot_mjx.evaluation.best_known import BOUND_FILE, settings_of
from jetbot_mjx.runs import Checkpoint, Setup, load_checkpoint, write_bytes
from jetbot_mjx.runs.run_dir import versions

_SEED = 1_048_577
_AT_ONCE = 65_536
_GRID = Grid(1, 72)


class Goals(NamedTuple):
    """A `Goals` holds what became of many goals."""

    places_w: Float[np.ndarray, "n 2"]
    """[m]"""
    reached: Bool[np.ndarray, " n"]
    steps: Float[np.ndarray, " n"]
    least: Float[np.ndarray, " n"]
    """The number of steps below which no controller reaches the goal."""

    @property
    def slowness(self) -> Float[np.ndarray, " n"]:
        """Return the time as a multiple of what physics allows; infinite where a goal is missed."""
        return np.where(self.reached, self.steps / self.least, np.inf)

    @property
    def worst(self) -> int:
        """Return the index of the worst goal; of those that are missed, the nearest."""
        distance = np.linalg.norm(self.places_w, axis=1)
        return int(np.lexsort((distance, -self.slowness))[0])


def drive_to_all(checkpoint: Checkpoint, count: int) -> Goals:
    """Drive to so many goals, and compute the bound of each.

    Args:
      checkpoint: the policy.
      count: number of goals.

    Raises:
      UserError: there is no bound for the robot and the task of the policy.
    """
    setup = Setup(checkpoint.config)
    env = setup.robot_env
    bound = _bound(checkpoint)
    table = farthest(Limits(**bound["limits"]), env.config.task.episode_length, _GRID)
    evaluator = evaluation.Evaluator(env, setup.networks, setup.programs)
    parts = []
    for keys in jnp.array_split(_keys(count), -(-count // _AT_ONCE)):
        found = jax.device_get(evaluator.run(checkpoint.params, keys))
        places = np.asarray(found.goal_w, float)[:, :2]
        least = least_steps(table, places, bound["reach"])
        parts.append((places, found.success > 0, found.steps, least))
    return Goals(*map(np.concatenate, zip(*parts, strict=True)))


def drive_to(checkpoint: Checkpoint, index: int, count: int) -> Float[np.ndarray, "t 2"]:
    """Return the positions of a drive to one of so many goals [m]."""
    setup = Setup(checkpoint.config)
    evaluator = evaluation.Evaluator(setup.robot_env, setup.networks, setup.programs, record=True)
    found = jax.device_get(evaluator.run(checkpoint.params, _keys(count)[index : index + 1]))
    return np.asarray(found.qpos)[0, : int(found.steps[0]) + 1, :2]


def _keys(count: int) -> UInt32[jax.Array, "n 2"]:
    return jax.random.split(jax.random.PRNGKey(_SEED), count)


def _bound(checkpoint: Checkpoint) -> dict[str, Any]:
    settings = settings_of(checkpoint.config)
    searches: list[dict[str, Any]] = json.loads(BOUND_FILE.read_text(encoding="utf-8"))["searches"]
    found = [one for one in searches if one["settings"] == settings]
    if not found:
        raise UserError(f"{checkpoint.path}: there is no bound for its task: run lower_bound.py")
    return found[0]


def as_json(goals: Goals, dt: float) -> dict[str, Any]:
    """Return what was found, in metres, degrees and seconds."""
    worst = goals.worst
    (x, y), missed = goals.places_w[worst], goals.places_w[~goals.reached]
    return {
        "goals": len(goals.steps),
        "missed": len(missed),
        "missed_goals": np.round(missed[:20], 3).tolist(),
        "slower_than_twice_the_bound": int((goals.slowness > 2.0).sum()),
        "worst": {
            "goal": [round(float(x), 3), round(float(y), 3)],
            "distance": round(float(np.hypot(x, y)), 3),
            "bearing": round(float(np.degrees(np.arctan2(y, x))), 1),
            "reached": bool(goals.reached[worst]),
            "seconds": round(float(goals.steps[worst]) * dt, 3),
            "bound": round(float(goals.least[worst]) * dt, 3),
        },
    }


def describe(found: dict[str, Any]) -> str:
    """Return what was found in one line."""
    worst = found["worst"]
    outcome = f"takes {worst['seconds']:.2f} s" if worst["reached"] else "is missed"
    return (
        f"{found['missed']:,} of {found['goals']:,} goals missed; the worst lies"
        f" {worst['distance']:.2f} m away at {worst['bearing']:.0f}°, and {outcome}"
        f" (bound {worst['bound']:.2f} s)"
    )


def plot(names: Sequence[str], every: Sequence[Goals], ways: Sequence[np.ndarray]) -> Figure:
    """Plot maps of all goals, and the drives to the worst ones."""
    figure = Figure(figsize=(5.4 * len(every) + 1, 5.2), layout="constrained")
    columns = figure.subplots(1, len(every), squeeze=False)[0]
    colours = None
    for axes, name, goals, way in zip(columns, names, every, ways, strict=True):
        shown = np.random.default_rng(0).permutation(len(goals.steps))[:8_000]
        shown = shown[goals.reached[shown]]
        left, ahead = goals.places_w[shown].T[::-1]
        slower = 100 * (goals.slowness[shown] - 1)
        colours = axes.scatter(-left, ahead, c=slower, s=3, vmin=0, vmax=60, cmap="viridis")
        _draw_worst(axes, goals, way)
        axes.set(title=name, aspect="equal", xlabel="to the right [m]", ylabel="ahead [m]")
        axes.legend(loc="upper right", fontsize="small")
    if colours is not None:
        figure.colorbar(colours, ax=columns, label="longer than physics allows [%]")
    return figure


def _draw_worst(axes: Axes, goals: Goals, way: Float[np.ndarray, "t 2"]) -> None:
    left, ahead = goals.places_w[~goals.reached].T[::-1]
    if left.size:
        axes.plot(-left, ahead, "x", color="C3", label=f"{left.size:,} missed")
    axes.plot(-way[:, 1], way[:, 0], color="black", label="drive to the worst")
    x, y = goals.places_w[goals.worst]
    axes.add_patch(Circle((-y, x), 0.05, fill=False, color="black"))
    axes.plot(0, 0, marker="^", color="black", markersize=8)


def main(arguments: Sequence[str] | None = None) -> int:
    """Find, print and draw the worst goal of each run."""
    parser = cli.Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", metavar="RUN", help="a run, such as pretrained:best")
    cli.add_count(parser, "--goals", "how many goals", default=2**20)
    parser.add_argument("--output", type=Path, help="JSON file; a plot is written beside it")
    options = parser.parse_args(arguments)
    if options.output:
        check_output(options.output)
    every, ways, found = [], [], {}
    for name in options.runs:
        checkpoint = load_checkpoint(cli.find_policy(name))
        every.append(goals := drive_to_all(checkpoint, options.goals))
        ways.append(drive_to(checkpoint, goals.worst, options.goals))
        found[name] = as_json(goals, checkpoint.config.physics.ctrl_dt)
        print(f"{name}: {describe(found[name])}", flush=True)
    if options.output:
        about = {"device": jax.devices()[0].device_kind, "versions": versions()}
        write(options.output, {**about, "policies": found})
        with theme("light"):
            image = to_png(plot(options.runs, every, ways))
        write_bytes(options.output.with_suffix(".png"), image)
    return 0


if __name__ == "__main__":
    cli.run_command(main, writes_files=True)
