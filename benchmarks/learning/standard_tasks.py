"""Learn the standard tasks, on a CPU beside Stable-Baselines3's PPO, or on a GPU with many seeds.

    python benchmarks/learning/standard_tasks.py --limit 300
    python benchmarks/learning/standard_tasks.py --gpu --seeds 5

Each example is trained to its target with one seed and an empty compilation cache. Then
Stable-Baselines3's PPO learns for `--limit` seconds, or to the same target, in Gymnasium's own
environment of the task. Its hyperparameters are those of the RL Zoo (`hyperparams/ppo.yml`). It has
one environment and one thread, as there. Cart-pole swing-up has no equivalent in Gymnasium.

A return is the mean of deterministic episodes: 256 of an example, of which the time is part of the
training's, and 20 with Stable-Baselines3, of which it is not.

With `--gpu`, the configurations `..._gpu` are trained to their targets: seed 0 with an empty
cache, and then every seed with the cache that it filled. Stable-Baselines3 is left out.

    pip install '.[sb3]' 'gymnasium[mujoco]'
"""

import argparse
import importlib
import importlib.util
import math
import os
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks import RESULTS, ROOT
from benchmarks.harness.processes import last_within
from benchmarks.harness.results import check_output, write
from benchmarks.harness.timing import available_cores
from benchmarks.learning.time_to_success import RETURN, SUCCESS, Target, measure, processor
from jetbot_mjx import cli
from jetbot_mjx.errors import UserError

_EVALUATIONS = 10
"""Evaluations of Stable-Baselines3's policy within the limit, of `_EPISODES` each."""

_EPISODES = 20

_NETWORK: Mapping[str, Any] = {
    "log_std_init": -2,
    "ortho_init": False,
    "net_arch": {"pi": [256, 256], "vf": [256, 256]},
}
"""`policy_kwargs` of the walking robots; their activation is ReLU."""


class StandardTask(NamedTuple):
    """A `StandardTask` is an example with its target, and how Stable-Baselines3 learns it."""

    target: Target
    gymnasium: str | None = None
    """Gymnasium's name; None: it has no such task."""
    settings: Mapping[str, Any] = {}
    """Arguments of Stable-Baselines3's PPO, besides 512 steps in an update."""


TASKS: Mapping[str, StandardTask] = {
    "cartpole": StandardTask(Target(SUCCESS, 0.95)),
    "reacher": StandardTask(
        Target(RETURN, -5.0),
        "Reacher-v5",
        {
            "batch_size": 32,
            "gamma": 0.9,
            "learning_rate": 1.04019e-4,
            "ent_coef": 7.52585e-8,
            "clip_range": 0.3,
            "n_epochs": 5,
            "gae_lambda": 1.0,
            "max_grad_norm": 0.9,
            "vf_coef": 0.950368,
        },
    ),
    "hopper": StandardTask(
        Target(RETURN, 3000.0),
        "Hopper-v5",
        {
            "batch_size": 32,
            "gamma": 0.999,
            "learning_rate": 9.80828e-5,
            "ent_coef": 2.29519e-3,
            "clip_range": 0.2,
            "n_epochs": 5,
            "gae_lambda": 0.99,
            "max_grad_norm": 0.7,
            "vf_coef": 0.835671,
            "policy_kwargs": _NETWORK,
        },
    ),
    "half_cheetah": StandardTask(
        Target(RETURN, 3000.0),
        "HalfCheetah-v5",
        {
            "batch_size": 64,
            "gamma": 0.98,
            "learning_rate": 2.0633e-5,
            "ent_coef": 4.01762e-4,
            "clip_range": 0.1,
            "n_epochs": 20,
            "gae_lambda": 0.92,
            "max_grad_norm": 0.8,
            "vf_coef": 0.58096,
            "policy_kwargs": _NETWORK,
        },
    ),
    "walker": StandardTask(
        Target(RETURN, 3000.0),
        "Walker2d-v5",
        {
            "batch_size": 32,
            "gamma": 0.99,
            "learning_rate": 5.05041e-5,
            "ent_coef": 5.85045e-4,
            "clip_range": 0.1,
            "n_epochs": 20,
            "gae_lambda": 0.95,
            "max_grad_norm": 1.0,
            "vf_coef": 0.871923,
        },
    ),
}
"""The task of each example, by the name of its configuration."""

_UPDATE = 512  # steps


def learn_with_sb3(name: str, limit: float, seed: int) -> Iterator[list[dict[str, float]]]:
    """Train Stable-Baselines3's PPO in Gymnasium's environment of a task.

    Args:
      name: the name of the task.
      limit: the time of the training [s], from the imports on.
      seed: the seed.

    Yields:
      The evaluations so far: seconds, steps and mean return. The last one is at the limit, or the
      first one that reaches the target.
    """
    began = time.perf_counter()
    torch = importlib.import_module("torch")
    sb3 = importlib.import_module("stable_baselines3")
    vec_env = importlib.import_module("stable_baselines3.common.vec_env")
    evaluation = importlib.import_module("stable_baselines3.common.evaluation")
    make_vec_env = importlib.import_module("stable_baselines3.common.env_util").make_vec_env
    # More threads do not speed up networks of this size, and slow them down on a busy machine.
    torch.set_num_threads(1)
    task = TASKS[name]
    assert task.gymnasium
    settings = dict(task.settings)
    if "policy_kwargs" in settings:
        activation = {"activation_fn": torch.nn.ReLU}
        settings["policy_kwargs"] = {**settings["policy_kwargs"], **activation}
    env = vec_env.VecNormalize(make_vec_env(task.gymnasium, seed=seed), gamma=settings["gamma"])
    trial = vec_env.VecNormalize(
        make_vec_env(task.gymnasium, seed=seed + 1), training=False, norm_reward=False
    )
    ppo = sb3.PPO("MlpPolicy", env, n_steps=_UPDATE, seed=seed, device="cpu", **settings)
    points: list[dict[str, float]] = []
    spent = time.perf_counter() - began
    while spent < limit and not (points and points[-1][RETURN] >= task.target.value):
        due = limit * (len(points) + 1) / _EVALUATIONS
        began = time.perf_counter() - spent
        while (spent := time.perf_counter() - began) < due:
            ppo.learn(_UPDATE, reset_num_timesteps=False)
        vec_env.sync_envs_normalization(env, trial)
        mean, _ = evaluation.evaluate_policy(ppo, trial, n_eval_episodes=_EPISODES)
        points.append({"seconds": spent, "env_steps": ppo.num_timesteps, RETURN: float(mean)})
        yield points


def _learn_here(config: str, target: Target, seeds: Sequence[int]) -> list[dict[str, Any]]:
    """Train an example to its target with each seed; the first one has an empty cache."""
    stop = "stop_at_success" if target.metric == SUCCESS else "stop_at_return"
    file, stops = ROOT / "examples" / f"{config}.yaml", [f"{stop}={target.value}"]
    with tempfile.TemporaryDirectory() as cache:
        runs = [measure(file, stops, seed, target, Path(cache)) for seed in seeds]
    for run in runs:
        del run["output"]
    return runs


def _learn_beside(name: str, limit: float, seed: int) -> list[dict[str, float]]:
    """Train with Stable-Baselines3 in a process of its own."""
    # Beside the limit there are imports and evaluations.
    points, _ = last_within(3 * limit + 60, learn_with_sb3, name, limit, seed)
    if points is None:
        raise UserError(f"{name}: Stable-Baselines3 was not evaluated within {3 * limit + 60:g} s")
    return points


def _loaded(call: Any, *arguments: Any) -> tuple[Any, dict[str, float]]:
    """Call a function; return also how busy the machine was before, and its processes during it."""
    load, before = os.getloadavg()[0], os.times()
    result = call(*arguments)
    after = os.times()
    used = after.children_user + after.children_system
    used -= before.children_user + before.children_system
    return result, {"load_before": load, "busy_cores": used / (after.elapsed - before.elapsed)}


def _line(name: str, row: Mapping[str, Any], target: Target) -> str:
    run = row["here"]
    reached, steps = run["target_reached_seconds"], run["target_reached_steps"]
    cells = [name, target.format(target.value)]
    if reached is None:
        cells += ["never", "-", "-"]
    else:
        cells += [f"{reached:.1f} s", f"{steps:,}", f"{steps / reached:,.0f}"]
    if row["sb3"] is None:
        cells += ["no equivalent", "-", "-", "-"]
    else:
        last = row["sb3"][-1]
        rate = last["env_steps"] / last["seconds"]
        cells += [f"{last['seconds']:.0f} s", target.format(last[RETURN])]
        cells += [f"{last['env_steps']:,.0f}", f"{rate:,.0f}"]
    return f"| {' | '.join(cells)} |"


def _gpu_line(name: str, runs: Sequence[Mapping[str, Any]], target: Target) -> str:
    """Return the row of a task that was learned by seed 0 from a cold start, then by every seed."""
    cells = [name, target.format(target.value)]
    for some in (runs[:1], runs[1:]):
        times = [run["target_reached_seconds"] or math.inf for run in some]
        cells.append(f"{statistics.median(times):.1f} s ({max(times):.1f})")
    steps = [run["target_reached_steps"] or math.inf for run in runs[1:]]
    scores = [run["policy"][target.metric] for run in runs[1:]]
    cells += [f"{statistics.median(steps):,.0f}", target.format(statistics.median(scores))]
    return f"| {' | '.join(cells)} |"


def _parser() -> argparse.ArgumentParser:
    parser = cli.Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tasks", nargs="*", metavar="TASK", help=f"default: {' '.join(TASKS)}")
    parser.add_argument(
        "--limit",
        type=cli.positive_int,
        default=300,
        metavar="SECONDS",
        help="of Stable-Baselines3, for each task (default: 300)",
    )
    parser.add_argument("--seed", type=int, default=0, help="default: 0")
    parser.add_argument("--gpu", action="store_true", help="on a GPU, without Stable-Baselines3")
    parser.add_argument(
        "--seeds", type=cli.positive_int, default=5, help="with --gpu: seeds 0 to N-1 (default: 5)"
    )
    parser.add_argument(
        "--output",
        type=Path,
        help="JSON file (default: results/standard-tasks-cpu.json, or -gpu.json)",
    )
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, print the table and write the JSON file.

    Args:
      arguments: The command line without the program's name; None: that of the process.

    Returns:
      0, or 1 if an example did not reach its target.

    Raises:
      UserError: A package is missing, there is no such task, or the file cannot be written.
    """
    options = _parser().parse_args(arguments)
    names = options.tasks or list(TASKS)
    if unknown := [name for name in names if name not in TASKS]:
        raise UserError(f"there is no task {unknown[0]!r}: give some of {', '.join(TASKS)}")
    device = "gpu" if options.gpu else "cpu"
    output = options.output or RESULTS / f"standard-tasks-{device}.json"
    check_output(output)
    measure_tasks = _with_many_seeds if options.gpu else _beside_sb3
    return 0 if measure_tasks(names, options, output) else 1


def _with_many_seeds(names: Sequence[str], options: argparse.Namespace, output: Path) -> bool:
    """Measure the configurations for a GPU; return whether every training reached its target."""
    tasks: dict[str, Any] = {}
    results = {"cpu_cores": available_cores(), "processor": processor(), "tasks": tasks}
    print(
        "| task | target | cold | warm, median (worst) | steps | in the report |\n"
        "|---|--:|--:|--:|--:|--:|",
        flush=True,
    )
    for name in names:
        target = TASKS[name].target
        tasks[name] = _learn_here(f"{name}_gpu", target, [0, *range(options.seeds)])
        write(output, results)
        print(_gpu_line(name, tasks[name], target), flush=True)
    return all(run["target_reached_seconds"] for runs in tasks.values() for run in runs)


def _beside_sb3(names: Sequence[str], options: argparse.Namespace, output: Path) -> bool:
    """Measure the configurations for a CPU; return whether every training reached its target.

    Raises:
      UserError: A package is missing.
    """
    packages = ("stable_baselines3", "torch", "gymnasium", "mujoco")
    if absent := [name for name in packages if importlib.util.find_spec(name) is None]:
        raise UserError(f"{absent[0]} is not installed: pip install '.[sb3]' 'gymnasium[mujoco]'")
    results: dict[str, Any] = {
        "seed": options.seed,
        "limit": options.limit,
        "episodes": _EPISODES,
        "cpu_cores": available_cores(),
        "processor": processor(),
        "packages": {name: importlib.import_module(name).__version__ for name in packages},
        "settings": {name: TASKS[name]._asdict() for name in names},
        "tasks": {},
    }
    print(
        "| task | target | reached | steps | steps/s | Stable-Baselines3 | return | steps |"
        " steps/s |\n|---|--:|--:|--:|--:|--:|--:|--:|--:|",
        flush=True,
    )
    for name in names:
        task = TASKS[name]
        row: dict[str, Any] = {"sb3": None}
        (row["here"],), row["here_load"] = _loaded(_learn_here, name, task.target, [options.seed])
        if task.gymnasium:
            row["sb3"], row["sb3_load"] = _loaded(_learn_beside, name, options.limit, options.seed)
        results["tasks"][name] = row
        # After every task, so that an interrupted command keeps what it has measured.
        write(output, results)
        print(_line(name, row, task.target), flush=True)
    return all(one["here"]["target_reached_seconds"] for one in results["tasks"].values())


if __name__ == "__main__":
    cli.run_command(main)
