"""Measure the benefit of domain randomization: `python benchmarks/learning/randomization.py`.

Trains several seeds with the configuration's `randomization`, and as many without, and evaluates
the last policy of each on the fixed goals of the report: on the preset's robot, on robots drawn
from the full ranges, and with each parameter of the robustness evaluation changed. The results of
each policy are written as soon as it is evaluated; a plot is drawn beside the file of results.
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks import CONFIGS
from benchmarks.harness.measurements import Sizes
from benchmarks.harness.results import check_output, conditions, default_output, write
from jetbot_mjx import cli
from jetbot_mjx.config import Config, RandomizationConfig, load_config
from jetbot_mjx.devices import require_device, use_compilation_cache
from jetbot_mjx.envs.domain_randomization import DomainRandomizationWrapper
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation.evaluator import Evaluator, report_keys, summarize
from jetbot_mjx.evaluation.robustness import ROBUST_SUCCESS_RATE, Sweeper, SweepResult
from jetbot_mjx.runs import Setup
from jetbot_mjx.runs.checkpoint import load_checkpoint
from jetbot_mjx.runs.run_dir import seed_folders
from jetbot_mjx.training import session

SETTINGS = ("nominal", "randomised")
_EASY = 0.99
"""Success rate above which a parameter is only named."""
_COLOURS = {"nominal": "tab:orange", "randomised": "C0"}


class PolicyEvaluator:
    """Evaluates policies; all policies share its compiled programs."""

    def __init__(self, config: Config, episodes: int, goals: int) -> None:
        """Build the evaluators; they compile at their first use.

        Args:
          config: A configuration with randomization.
          episodes: The number of the report's goals for the preset's robot and the full ranges.
          goals: The number of the report's goals for each robot of the robustness evaluation.
        """
        setup = Setup(config)
        env, networks, programs = setup.robot_env, setup.networks, setup.programs
        self._dt, self._keys = env.dt, report_keys(episodes)
        self._evaluators = {
            "preset": Evaluator(env, networks, programs),
            "ranges": Evaluator(
                DomainRandomizationWrapper(env, ranges=config.randomization), networks, programs
            ),
        }
        self._sweeper = Sweeper(setup, report_keys(goals))

    def evaluate(self, folder: Path) -> dict[str, Any]:
        """Evaluate the last policy of a run.

        Args:
          folder: The run folder of one seed.

        Returns:
          The metrics as JSON: summaries under `preset` and `ranges`, and under `sweep` the success
          rates of policy and scripted controller at each value of each parameter.
        """
        params = load_checkpoint(folder, "last").params
        metrics: dict[str, Any] = {
            name: summarize(one.run(params, self._keys), self._dt)._asdict()
            for name, one in self._evaluators.items()
        }
        return {**metrics, "sweep": [_sweep_row(one) for one in self._sweeper.run(params)]}


def _sweep_row(result: SweepResult) -> dict[str, Any]:
    rates = {
        name: [one.success_rate for one in getattr(result, name)] for name in ("policy", "scripted")
    }
    return {**result.sweep._asdict(), "nominal": result.sweep.nominal, **rates}


def run(config: Config, folder: Path, evaluator: PolicyEvaluator) -> Iterator[dict[str, Any]]:
    """Train without and with randomization, and evaluate seed by seed.

    Args:
      config: A configuration with randomization and with the seeds to train at once.
      folder: The folder of the runs; runs that exist are evaluated without training.
      evaluator: Evaluates the policies.

    Yields:
      A row for each policy.
    """
    for setting in SETTINGS:
        ranges = config.randomization if setting == "randomised" else RandomizationConfig()
        run_dir, start = folder / setting, time.perf_counter()
        if not run_dir.exists():
            trained = config.model_copy(update={"randomization": ranges})
            session.run(trained, run_dir)
        seconds = time.perf_counter() - start
        for one in seed_folders(run_dir) or [run_dir]:
            row = {"setting": setting, "seed": one.name, "training_seconds": seconds}
            yield {**row, **evaluator.evaluate(one)}


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Return a table of the success of both settings: mean over the seeds, and the worst seed.

    Args:
      rows: The rows of all policies.

    Returns:
      A Markdown table: success on the preset, under the full ranges, and at the value of each
      parameter that is hardest for the policies of that setting; then the parameters of which
      no value is hard.
    """
    lines = [
        "| success, mean (worst seed) | nominal | randomised |",
        "| --- | --: | --: |",
    ]
    for title, name in (("the preset's robot", "preset"), ("the full ranges", "ranges")):
        cells = [
            _cell([row[name]["success_rate"] for row in _rows_of(rows, setting)])
            for setting in SETTINGS
        ]
        lines.append(f"| {title} | {' | '.join(cells)} |")
    hard = _hard(rows)
    for index, quantity in enumerate(rows[0]["sweep"]):
        if index not in hard:
            continue
        cells = []
        for setting in SETTINGS:
            rates = _rates(_rows_of(rows, setting), index)
            at = int(rates.mean(axis=0).argmin()) if len(rates) else 0
            where = f" at {quantity['values'][at]:g}" if len(rates) and rates.min() < 1 else ""
            cells.append(f"{_cell(rates[:, at] if len(rates) else [])}{where}")
        lines.append(f"| {quantity['label']}, its hardest value | {' | '.join(cells)} |")
    return "\n".join([*lines, "", _easy(rows)])


def _hard(rows: Sequence[dict[str, Any]]) -> list[int]:
    """Return the indices of the parameters of which some value is hard for some policy."""
    count = len(rows[0]["sweep"])
    return [index for index in range(count) if _rates(rows, index).min() < _EASY]


def _easy(rows: Sequence[dict[str, Any]]) -> str:
    labels = [one["label"] for i, one in enumerate(rows[0]["sweep"]) if i not in _hard(rows)]
    return f"Every policy has {_EASY:.0%} or more at every value of: {'; '.join(labels)}."


def _rows_of(rows: Sequence[dict[str, Any]], setting: str) -> list[dict[str, Any]]:
    return [row for row in rows if row["setting"] == setting]


def _rates(rows: Sequence[dict[str, Any]], index: int) -> np.ndarray:
    """Return success by seed and value of one parameter."""
    return np.array([row["sweep"][index]["policy"] for row in rows])


def _cell(rates: Sequence[float] | np.ndarray) -> str:
    return f"{np.mean(rates):.2%} ({np.min(rates):.2%})" if len(rates) else "-"


def plot(rows: Sequence[dict[str, Any]]) -> Figure:
    """Plot success over every parameter that is hard for some policy.

    Args:
      rows: The rows of all policies.

    Returns:
      The figure: means over the seeds, with bands from worst to best.
    """
    hard = _hard(rows)
    columns = 4
    lines = max(1, -(-len(hard) // columns))
    figure = Figure(figsize=(3.2 * columns, 2.5 * lines), layout="constrained")
    for place, index in enumerate(hard):
        quantity = rows[0]["sweep"][index]
        axes = figure.add_subplot(lines, columns, place + 1)
        axes.plot(
            quantity["values"],
            quantity["scripted"],
            color="tab:gray",
            linewidth=1,
            label="scripted",
        )
        for setting in SETTINGS:
            rates = _rates(_rows_of(rows, setting), index)
            if not len(rates):
                continue
            ends = rates.min(axis=0), rates.max(axis=0)
            axes.fill_between(quantity["values"], *ends, color=_COLOURS[setting], alpha=0.25, lw=0)
            axes.plot(
                quantity["values"],
                rates.mean(axis=0),
                marker="o",
                markersize=3,
                color=_COLOURS[setting],
                label=setting,
            )
        axes.axvline(quantity["nominal"], color="black", linestyle="--", linewidth=0.8)
        axes.axhline(ROBUST_SUCCESS_RATE, color="black", linestyle=":", linewidth=0.8)
        axes.set(ylim=(-0.03, 1.03), title=quantity["label"], xlabel=f"[{quantity['unit']}]")
        axes.yaxis.set_major_formatter(PercentFormatter(1.0))
        axes.grid(alpha=0.3)
        if place == 0:
            axes.legend(fontsize="small", loc="lower right")
    return figure


def _parser() -> argparse.ArgumentParser:
    parser = cli.Parser(description=__doc__)
    parser.add_argument("--config", type=Path, default=CONFIGS / "real_jetbot.yaml")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--seeds", type=cli.positive_int, default=5)
    parser.add_argument(
        "--episodes", type=cli.positive_int, default=1024, help="for the preset and the full ranges"
    )
    parser.add_argument(
        "--goals",
        type=cli.positive_int,
        default=128,
        help="for each robot of the robustness evaluation",
    )
    parser.add_argument(
        "--runs", type=Path, help="folder of the runs; runs that exist are not trained again"
    )
    parser.add_argument("--output", type=Path, help="default: results/randomization-<device>.json")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Train, evaluate and print.

    Args:
      arguments: The command line without the program's name; None: that of the process.

    Returns:
      0, or 1 if a randomised policy is below 95 % under the full ranges.
    """
    options = _parser().parse_args(arguments)
    config = load_config(options.config, [*options.overrides, f"seeds={options.seeds}"])
    if not config.randomization.drawn:
        raise UserError(f"--config {options.config}: its randomization draws nothing")
    require_device()
    use_compilation_cache()
    output = options.output or default_output("randomization-")
    check_output(output)
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as temporary:
        evaluator = PolicyEvaluator(config, options.episodes, options.goals)
        for row in run(config, options.runs or Path(temporary), evaluator):
            rows.append(row)
            print(
                f"{row['setting']} {row['seed']}: preset {row['preset']['success_rate']:.2%}, full"
                f" ranges {row['ranges']['success_rate']:.2%}",
                flush=True,
            )
            write(output, {**_about(config, options), "rows": rows})
            plot(rows).savefig(output.with_suffix(".png"), dpi=100)
    print(f"\n{table(rows)}\n\n{output}\n{output.with_suffix('.png')}")
    worst = min(row["ranges"]["success_rate"] for row in _rows_of(rows, "randomised"))
    return 1 if worst < ROBUST_SUCCESS_RATE else 0


def _about(config: Config, options: argparse.Namespace) -> dict[str, Any]:
    return {
        **conditions(config, Sizes()),
        "episodes": options.episodes,
        "goals": options.goals,
        "carries_at": ROBUST_SUCCESS_RATE,
    }


if __name__ == "__main__":
    cli.run_command(main)
