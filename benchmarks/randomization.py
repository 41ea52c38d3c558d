"""What training on ever other robots is worth: `python benchmarks/randomization.py`.

Trains several seeds under a configuration with `randomization`, and as many without, and judges
the last policy of each on the report's fixed goals: on the preset's robot, on robots drawn from
the full ranges, and over every quantity of the robustness sweep. Every policy is written down as
soon as it is judged; a figure is drawn beside the file of results.
"""

import argparse
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter
from results import check_output, conditions, default_output, write

from jetbot_mjx import cli
from jetbot_mjx.agents.networks import make_networks
from jetbot_mjx.compiler.program_cache import use_compilation_cache
from jetbot_mjx.config import Config, RandomizationConfig, load_config
from jetbot_mjx.envs.domain_randomization import DomainRandomizationWrapper
from jetbot_mjx.envs.jetbot_env import make_env
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation.evaluator import Evaluator, report_keys, summarize
from jetbot_mjx.evaluation.robustness import ROBUST_SUCCESS_RATE, Sweeper, as_json
from jetbot_mjx.runs.checkpoint import load_checkpoint
from jetbot_mjx.runs.run_dir import seed_folders
from jetbot_mjx.training import session

_CONFIG = Path(__file__).resolve().parents[1] / "configs" / "real_jetbot.yaml"
WAYS = ("nominal", "randomised")
_COLOURS = {"nominal": "tab:orange", "randomised": "C0"}


class Judge:
    """The programs that every policy of both ways is judged by."""

    def __init__(self, config: Config, episodes: int, goals: int) -> None:
        """Prepares them; they compile at their first use.

        Args:
          config: with the ranges to draw from.
          episodes: of the report's fixed goals, for the preset's robot and the full ranges.
          goals: the same for each robot of the sweep.
        """
        env = make_env(config)
        self._dt, self._keys = env.dt, report_keys(episodes)
        networks = make_networks(
            config.ppo.network,
            env.observation_size,
            env.action_size,
            normalize=config.ppo.normalize_observations,
        )
        self._evaluators = {
            "preset": Evaluator(env, networks),
            "ranges": Evaluator(
                DomainRandomizationWrapper(env, ranges=config.randomization), networks
            ),
        }
        self._sweeper = Sweeper(env, networks, report_keys(goals))

    def judge(self, folder: Path) -> dict[str, Any]:
        """All figures of the last policy of a run, as JSON.

        Args:
          folder: of the run, of one seed.

        Returns:
          Summaries under `preset` and `ranges`, and `sweep` as in a report.
        """
        params = load_checkpoint(folder, "last").params
        told: dict[str, Any] = {
            name: summarize(one.run(params, self._keys), self._dt)._asdict()
            for name, one in self._evaluators.items()
        }
        return {**told, "sweep": as_json(self._sweeper.run(params))["quantities"]}


def run(config: Config, folder: Path, judge: Judge) -> Iterator[dict[str, Any]]:
    """Trains both ways, and judges seed by seed.

    Args:
      config: with ranges to draw from, and the seeds to train at once.
      folder: where the runs go; what lies there already trained is judged as it is.
      judge: of the policies.

    Yields:
      A row for each policy.
    """
    for way in WAYS:
        ranges = config.randomization if way == "randomised" else RandomizationConfig()
        run_dir, begun = folder / way, time.perf_counter()
        if not run_dir.exists():
            trained = config.model_copy(update={"randomization": ranges})
            session.run(trained, run_dir)
        seconds = time.perf_counter() - begun
        for one in seed_folders(run_dir) or [run_dir]:
            row = {"way": way, "seed": one.name, "training_seconds": seconds}
            yield {**row, **judge.judge(one)}


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Both ways side by side: mean over the seeds, and the worst seed.

    Args:
      rows: of all policies.

    Returns:
      A Markdown table: success on the preset, under the full ranges, and where each quantity is
      hardest on the way's own policies.
    """
    lines = [
        "| success, mean (worst seed) | nominal | randomised |",
        "| --- | --: | --: |",
    ]
    for title, name in (("the preset's robot", "preset"), ("the full ranges", "ranges")):
        cells = [_cell([row[name]["success_rate"] for row in _of(rows, way)]) for way in WAYS]
        lines.append(f"| {title} | {' | '.join(cells)} |")
    for index, quantity in enumerate(rows[0]["sweep"]):
        cells = []
        for way in WAYS:
            rates = _rates(_of(rows, way), index)
            at = int(rates.mean(axis=0).argmin()) if len(rates) else 0
            where = f" at {quantity['values'][at]:g}" if len(rates) and rates.min() < 1 else ""
            cells.append(f"{_cell(rates[:, at] if len(rates) else [])}{where}")
        lines.append(f"| {quantity['label']}, its hardest value | {' | '.join(cells)} |")
    return "\n".join(lines)


def _of(rows: Sequence[dict[str, Any]], way: str) -> list[dict[str, Any]]:
    return [row for row in rows if row["way"] == way]


def _rates(rows: Sequence[dict[str, Any]], index: int) -> np.ndarray:
    """Success by seed and value of one quantity."""
    return np.array(
        [[one["success_rate"] for one in row["sweep"][index]["policy"]] for row in rows]
    )


def _cell(rates: Sequence[float] | np.ndarray) -> str:
    return f"{np.mean(rates):.2%} ({np.min(rates):.2%})" if len(rates) else "-"


def plot(rows: Sequence[dict[str, Any]]) -> Figure:
    """Success over every quantity: lines are means over the seeds, bands reach to worst and best.

    Args:
      rows: of all policies.

    Returns:
      The figure.
    """
    quantities = rows[0]["sweep"]
    columns = 4
    lines = -(-len(quantities) // columns)
    figure = Figure(figsize=(3.2 * columns, 2.5 * lines), layout="constrained")
    for index, quantity in enumerate(quantities):
        axes = figure.add_subplot(lines, columns, index + 1)
        scripted = [one["success_rate"] for one in quantity["scripted"]]
        axes.plot(quantity["values"], scripted, color="tab:gray", linewidth=1, label="scripted")
        for way in WAYS:
            rates = _rates(_of(rows, way), index)
            if not len(rates):
                continue
            ends = rates.min(axis=0), rates.max(axis=0)
            axes.fill_between(quantity["values"], *ends, color=_COLOURS[way], alpha=0.25, lw=0)
            axes.plot(
                quantity["values"],
                rates.mean(axis=0),
                marker="o",
                markersize=3,
                color=_COLOURS[way],
                label=way,
            )
        axes.axvline(quantity["nominal"], color="black", linestyle="--", linewidth=0.8)
        axes.axhline(ROBUST_SUCCESS_RATE, color="black", linestyle=":", linewidth=0.8)
        axes.set(ylim=(-0.03, 1.03), title=quantity["label"], xlabel=f"[{quantity['unit']}]")
        axes.yaxis.set_major_formatter(PercentFormatter(1.0))
        axes.grid(alpha=0.3)
        if index == 0:
            axes.legend(fontsize="small", loc="lower right")
    return figure


def _parser() -> argparse.ArgumentParser:
    parser = cli.Parser(description=__doc__)
    parser.add_argument("--config", type=Path, default=_CONFIG)
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--seeds", type=cli.positive_int, default=5)
    parser.add_argument(
        "--episodes", type=cli.positive_int, default=1024, help="on preset and full ranges"
    )
    parser.add_argument("--goals", type=cli.positive_int, default=128, help="for each swept robot")
    parser.add_argument(
        "--runs", type=Path, help="folder of the trainings, taken as they are where they exist"
    )
    parser.add_argument("--output", type=Path, help="JSON file")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Parses the command line, trains, judges and prints.

    Args:
      arguments: without the program's name; None: those of the process.

    Returns:
      0, or 1 where a randomised policy is below 95 % under the full ranges.
    """
    options = _parser().parse_args(arguments)
    config = load_config(options.config, [*options.overrides, f"seeds={options.seeds}"])
    if not config.randomization.drawn:
        raise UserError(f"--config {options.config}: its randomization draws nothing")
    cli.require_device()
    use_compilation_cache()
    output = options.output or default_output("randomization-")
    check_output(output)
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as temporary:
        judge = Judge(config, options.episodes, options.goals)
        for row in run(config, options.runs or Path(temporary), judge):
            rows.append(row)
            print(
                f"{row['way']} {row['seed']}: preset {row['preset']['success_rate']:.2%}, full"
                f" ranges {row['ranges']['success_rate']:.2%}",
                flush=True,
            )
            write(output, {**_about(config, options), "rows": rows})
            plot(rows).savefig(output.with_suffix(".png"), dpi=100)
    print(f"\n{table(rows)}\n\n{output}\n{output.with_suffix('.png')}")
    worst = min(row["ranges"]["success_rate"] for row in _of(rows, "randomised"))
    return 1 if worst < ROBUST_SUCCESS_RATE else 0


def _about(config: Config, options: argparse.Namespace) -> dict[str, Any]:
    from measurements import Sizes

    return {
        **conditions(config, Sizes()),
        "episodes": options.episodes,
        "goals": options.goals,
        "carries_at": ROBUST_SUCCESS_RATE,
    }


if __name__ == "__main__":
    cli.run_command(main)
