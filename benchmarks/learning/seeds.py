"""Train a configuration with many seeds, and evaluate each policy on fixed and on fresh goals.

    python benchmarks/learning/seeds.py --config best --config jetbot --seeds 20 --output FILE
    python benchmarks/learning/seeds.py --config best --variants FILE.yaml --seeds 5 --output FILE

All seeds of a configuration are trained at once, and their best checkpoints are evaluated. A file
of variants holds a name for each set of changed settings. The time beside the best-known time is
the mean over the report's 1,024 fixed goals; there are no best-known times for the fresh goals,
which no evaluation during training and no report has. Likewise the time above the bound, which is
what physics allows. The best seed, by success and then by time, drives to the fixed goals in C
MuJoCo, too.
"""

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import jax
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks.harness.results import check_output
from benchmarks.learning.time_to_success import processor
from jetbot_mjx import cli, evaluation, training
from jetbot_mjx.config import Config, load_config
from jetbot_mjx.config.yaml_text import read_yaml
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation.best_known import Kind
from jetbot_mjx.evaluation.report import compare_with
from jetbot_mjx.evaluation.robustness import MujocoEvaluator
from jetbot_mjx.runs import Setup, load_checkpoint
from jetbot_mjx.runs.run_dir import versions, write_json

_FRESH_SEED = 65_537
_GAPS: dict[str, Kind] = {"above_best_known": "search", "above_bound": "bound"}


def measure(config: Config, fresh: int) -> dict[str, Any]:
    """Train all seeds of a configuration at once, and evaluate them.

    Args:
      config: the configuration with its number of seeds.
      fresh: number of fresh goals.

    Returns:
      The seconds of the training and the metrics of each seed, as JSON.
    """
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        result = training.run(config, Path(folder, "run"), verbose=False)
        seconds = time.perf_counter() - began
        checkpoints = [load_checkpoint(each) for each in result.run_dirs]
        setup = Setup(checkpoints[0].config)
        env = setup.robot_env
        evaluator = evaluation.Evaluator(env, setup.networks, setup.programs)
        fixed_keys = evaluation.report_keys(evaluation.REPORT_GOALS)
        fresh_keys = jax.random.split(jax.random.PRNGKey(_FRESH_SEED), fresh)
        seeds = []
        for checkpoint in checkpoints:
            fixed = jax.device_get(evaluator.run(checkpoint.params, fixed_keys))
            gaps = {}
            for name, kind in _GAPS.items():
                found, missing = compare_with(kind, config, fixed)
                gaps[name] = found.total.gap if found else missing
            unseen = jax.device_get(evaluator.run(checkpoint.params, fresh_keys))
            failed = np.asarray(unseen.goal_w)[np.asarray(unseen.success) == 0][:, :2]
            seeds.append(
                {
                    "seed": checkpoint.config.seed,
                    "env_steps": checkpoint.env_steps,
                    "success_rate": float(np.mean(fixed.success)),
                    "fresh_success_rate": float(np.mean(unseen.success)),
                    "fresh_failed_goals": np.round(failed[:20], 3).tolist(),
                    "seconds": float(np.mean(fixed.steps)) * env.dt,
                    **gaps,
                }
            )
        ranks = [(seed["success_rate"], -seed["seconds"]) for seed in seeds]
        best = max(range(len(seeds)), key=ranks.__getitem__)
        in_mujoco = MujocoEvaluator(setup).run(checkpoints[best].params, fixed_keys).policy
    return {
        "training_seconds": seconds,
        "fresh_goals": fresh,
        "devices": jax.device_count(),
        "seeds": seeds,
        "best_in_mujoco": {
            "seed": seeds[best]["seed"],
            "success_rate": in_mujoco.success_rate,
            "time_to_goal_median": in_mujoco.time_to_goal_median,
        },
    }


def table(results: Mapping[str, dict[str, Any]]) -> str:
    """Return the median and the worst of each configuration as a Markdown table."""
    lines = [
        "| configuration | seeds | training, all seeds | success (worst) | fresh goals (worst) |"
        " above best known (worst) | above the bound (worst) | best seed in C MuJoCo |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name, result in results.items():
        seeds = result["seeds"]

        def spread(metric: str, worst: Any, text: str, seeds: Any = seeds) -> str:
            values = [seed[metric] for seed in seeds]
            if not all(isinstance(value, float) for value in values):
                return "-"
            return f"{statistics.median(values):{text}} ({worst(values):{text}})"

        lines.append(
            f"| {name} | {len(seeds)} | {result['training_seconds']:.0f} s |"
            f" {spread('success_rate', min, '.2%')} | {spread('fresh_success_rate', min, '.3%')} |"
            f" {spread('above_best_known', max, '+.2%')} | {spread('above_bound', max, '+.1%')} |"
            f" {result['best_in_mujoco']['success_rate']:.2%} |"
        )
    return "\n".join(lines)


def variants_of(path: Path | None) -> dict[str, dict[str, Any]]:
    """Read the sets of changed settings, by name; None is the configuration as it is.

    Raises:
      UserError: the file is not a mapping from names to mappings.
    """
    if path is None:
        return {"": {}}
    found = read_yaml(path, "variants")
    if not all(isinstance(one, dict) for one in found.values()):
        raise UserError(f"{path} should hold a mapping of changed settings for each name")
    return cast(dict[str, dict[str, Any]], found)


def _parser() -> cli.Parser:
    parser = cli.Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", action="append", required=True, metavar="NAME|FILE")
    parser.add_argument("--variants", type=Path, help="YAML file of changed settings by name")
    parser.add_argument("--seeds", type=cli.positive_int, default=20)
    parser.add_argument("--fresh", type=cli.positive_int, default=65_536, help="fresh goals")
    parser.add_argument("--output", type=Path, required=True, help="JSON file")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line, measure, print the table and write the file."""
    options = _parser().parse_args(arguments)
    check_output(options.output)
    results: dict[str, dict[str, Any]] = {}
    for base in options.config:
        for name, changed in variants_of(options.variants).items():
            config = load_config(base, {**changed, "seeds": options.seeds})
            label = " ".join(filter(None, (Path(base).stem, name)))
            results[label] = measure(config, options.fresh)
            print(table({label: results[label]}).splitlines()[-1], flush=True)
            about = {
                "device": jax.devices()[0].device_kind,
                "processor": processor(),
                "versions": versions(),
            }
            write_json(options.output, {**about, "configurations": results})
    print(table(results))
    return 0


if __name__ == "__main__":
    cli.run_command(main, writes_files=True)
