"""The same robot by several means in one run: `python benchmarks/compare.py`.

  physics     this project's `JetBotEnv.step_physics` under random actions
  mujoco      C MuJoCo's threaded `mujoco.rollout`: same model, sub-steps, actions held as long
  warp        MJX-Warp on the same model, on an NVIDIA GPU
  env         this project's training environment under random actions
  playground  MuJoCo Playground's CartpoleBalance, which is smaller, as its trainers see it
  training    this project's PPO, rollouts and updates
  stock       Brax's own `ppo.train` with the same hyperparameters
  sb3         Stable-Baselines3's PPO with the tutorial's, on one robot in C MuJoCo

All rates are environment steps per second. The first three take turns, so that what else the
machine does meets all. What needs a package that is not installed is left out, in one line.
"""

import argparse
import importlib.util
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
from contenders import Contender, MujocoRollout, Sb3, prepare_playground, prepare_warp
from measurements import MEASUREMENTS, Sizes, prepare_env, prepare_physics, training_config
from results import check_output, conditions, counts, default_output, write
from timing import Row, available_cores

from jetbot_mjx import cli
from jetbot_mjx.config import Config, load_config
from jetbot_mjx.errors import UserError

_CONFIG = Path(__file__).resolve().parents[1] / "configs" / "jetbot.yaml"
_OTHERS = ("mujoco", "warp")
"""Physics by other means."""
CONTENDERS = ("physics", *_OTHERS, "env", "playground", "training", "stock", "sb3")
_NEEDS = {
    "playground": (
        ("mujoco_playground", "lxml"),
        # Its own requirements would replace MuJoCo by another release than MJX's.
        "pip install --no-deps playground lxml",
    ),
    "sb3": (
        ("torch", "stable_baselines3", "gymnasium"),
        "pip install -c constraints.txt '.[sb3]', best after torch's build for CPUs",
    ),
    "warp": (("warp",), "pip install 'mujoco-mjx[warp]'"),
}
_BATCHES = {"cpu": (64, 128, 256, 512), "gpu": (4_096, 65_536)}
_ROLLOUT_BATCHES = (16, 64, 256)
"""For each core."""


Result = tuple[Row, list[float]]
"""What was measured, and the busy cores of each repeat: processor time over wall time."""


def run(
    config: Config,
    num_envs: Sequence[int],
    sizes: Sizes,
    *,
    contenders: Sequence[str],
    report: Callable[[Sequence[Result]], None],
) -> None:
    """Measures.

    Args:
      config: robot, task, physics and hyperparameters.
      num_envs: numbers of environments that physics is tried at; the rest takes the best.
      sizes: how much is measured.
      contenders: which, by their names in `CONTENDERS`; their packages are there.
      report: called with results as soon as they are there.

    Raises:
      UserError: worlds blew up, or the environments cannot be dealt out.
    """
    turns: list[Contender] = []
    if "physics" in contenders:
        turns += [prepare_physics(config, count, sizes) for count in num_envs]
    if "mujoco" in contenders:
        batches = [count * available_cores() for count in _ROLLOUT_BATCHES]
        turns += [MujocoRollout(config, count, sizes) for count in batches]
    if "warp" in contenders:
        turns += [prepare_warp(config, count, sizes) for count in num_envs]
    measured = in_turns(turns, sizes.repeats)
    report(measured)
    best = _best([row for row, _ in measured])
    count = best["physics"].num_envs if "physics" in best else num_envs[0]
    prepare: Mapping[str, Callable[[], Contender]] = {
        "env": lambda: prepare_env(config, count, sizes),
        "playground": lambda: prepare_playground(count, sizes),
        "sb3": lambda: Sb3(config),
    }
    for name in contenders:
        if name in prepare:
            report(in_turns([prepare[name]()], sizes.repeats))
        elif name not in ("physics", *_OTHERS):
            # The trainers' own reports are their clock.
            wall, cpu = time.perf_counter(), time.process_time()
            row = MEASUREMENTS[name](config, config.ppo.num_envs, sizes)
            report([(row, [(time.process_time() - cpu) / (time.perf_counter() - wall)])])


def ratios(results: Sequence[Result], other: str, *, per_core: bool = False) -> list[float]:
    """How `physics` compares with another, each at its best number of environments.

    Args:
      results: what was measured.
      other: `mujoco` or `warp`.
      per_core: compares steps per second of processor time, not of the clock on the wall.

    Returns:
      The ratio in each round; nothing where one of them was not measured.
    """
    best = _best([row for row, _ in results])
    if not {"physics", other} <= set(best):
        return []
    ours, theirs = (
        [rate / (busy if per_core else 1.0) for rate, busy in zip(row.repeats, cores, strict=True)]
        for name in ("physics", other)
        for row, cores in results
        if row is best[name]
    )
    return [one / another for one, another in zip(ours, theirs, strict=True)]


def _best(rows: Sequence[Row]) -> dict[str, Row]:
    return {row.rate: row for row in sorted(rows, key=lambda row: row.env_steps_per_second)}


def in_turns(contenders: Sequence[Contender], rounds: int) -> list[Result]:
    """Times all of them once in every round; with each row the cores that it kept busy."""
    rates: list[list[float]] = [[] for _ in contenders]
    cores: list[list[float]] = [[] for _ in contenders]
    for _ in range(rounds):
        for index, contender in enumerate(contenders):
            wall, cpu = time.perf_counter(), time.process_time()
            rates[index].append(contender.repeat())
            used = time.process_time() - cpu
            cores[index].append(used / (time.perf_counter() - wall))
    return [
        (contender.row(one), used)
        for contender, one, used in zip(contenders, rates, cores, strict=True)
    ]


def missing(contender: str) -> str | None:
    """Why a contender has to be left out, in one line; None: nothing is missing."""
    if contender == "warp" and jax.default_backend() != "gpu":
        return "warp left out: MJX-Warp needs an NVIDIA GPU"
    packages, remedy = _NEEDS.get(contender, ((), ""))
    absent = [name for name in packages if importlib.util.find_spec(name) is None]
    return f"{contender} left out, no {', '.join(absent)}: {remedy}" if absent else None


TABLE_HEAD = (
    f"| {'':10} | {'num_envs':>8} | {'env_steps_per_second':>20} | {'compile':>8} |"
    f" {'busy cores':>10} | {'min .. max':>18} |\n"
    f"|:{'-' * 10}-|-{'-' * 8}:|-{'-' * 20}:|-{'-' * 8}:|-{'-' * 10}:|-{'-' * 18}:|"
)


def table_row(row: Row, busy: Sequence[float]) -> str:
    """One result, for people."""
    low, high = (end / row.env_steps_per_second - 1 for end in (min(row.repeats), max(row.repeats)))
    spread = f"{low:+.1%} .. {high:+.1%}"
    return (
        f"| {row.rate:10} | {row.num_envs:8,} | {row.env_steps_per_second:20,.0f} |"
        f" {row.compile_seconds:6.1f} s | {statistics.median(busy):10.2f} | {spread:>18} |"
    )


def _as_json(results: Sequence[Result]) -> dict[str, Any]:
    return {
        "comparison": [{**row._asdict(), "busy_cores": busy} for row, busy in results],
        **{
            f"physics_over_{other}{'_per_core' if per_core else ''}": ratios(
                results, other, per_core=per_core
            )
            for other, per_core in _comparisons()
        },
    }


def _comparisons() -> list[tuple[str, bool]]:
    """Others, and whether by processor time, of which physics on a GPU takes next to none."""
    on_cpu = jax.default_backend() == "cpu"
    return [("mujoco", False), *([("mujoco", True)] if on_cpu else []), ("warp", False)]


def ratio_lines(results: Sequence[Result]) -> list[str]:
    """How `physics` compares with others, for people; nothing where one was not measured."""
    lines = []
    for other, per_core in _comparisons():
        if found := ratios(results, other, per_core=per_core):
            unit = "second of processor time" if per_core else "second"
            lines.append(
                f"physics over {other}, steps per {unit}: {statistics.median(found):.2f}"
                f" ({min(found):.2f} .. {max(found):.2f} over {len(found)} rounds)"
            )
    return lines


def _parser() -> argparse.ArgumentParser:
    parser = cli.Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", type=Path, default=_CONFIG, help="default: configs/jetbot.yaml")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument(
        "--num-envs",
        type=counts,
        metavar="N,N,...",
        help="that physics is tried at (default: 64,128,256,512, on a GPU 4096,65536)",
    )
    parser.add_argument("--repeats", type=cli.positive_int, default=5, help="rounds (default: 5)")
    parser.add_argument("--training-steps", type=cli.positive_int, default=4, help="default: 4")
    parser.add_argument("--skip", action="append", default=[], choices=CONTENDERS)
    parser.add_argument("--output", type=Path, help="default: results/compare-<device>.json")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Parses the command line, measures, prints the table and writes the JSON file.

    Args:
      arguments: without the program's name; None: those of the process.

    Returns:
      The exit code.

    Raises:
      UserError: as for `run`, or the file cannot be written.
    """
    options = _parser().parse_args(arguments)
    config = load_config(options.config, options.overrides)
    sizes = Sizes(repeats=options.repeats, training_steps=options.training_steps)
    lines = {name: missing(name) for name in CONTENDERS if name not in options.skip}
    contenders = [name for name, line in lines.items() if line is None]
    if not contenders:
        raise UserError("--skip leaves nothing to compare: leave out fewer")
    for name, trainer in {"training": "resumable", "stock": "brax"}.items():
        if name in contenders:
            # Said before minutes of measuring, not after them.
            training_config(config, config.ppo.num_envs, sizes, trainer)
    output = options.output or default_output("compare-")
    check_output(output)
    measured = conditions(config, sizes)
    for line in filter(None, lines.values()):
        print(line)
    print(
        f"{options.config.name} on {jax.device_count()} x {measured['device']} and"
        f" {measured['cpu_cores']} CPU cores, median of {sizes.repeats}\n{TABLE_HEAD}",
        flush=True,
    )
    platform = "cpu" if jax.default_backend() == "cpu" else "gpu"
    found: list[Result] = []

    def report(more: Sequence[Result]) -> None:
        found.extend(more)
        for row, busy in more:
            print(table_row(row, busy), flush=True)
        write(output, {**measured, **_as_json(found)})

    run(
        config,
        options.num_envs or _BATCHES[platform],
        sizes,
        contenders=contenders,
        report=report,
    )
    for line in ratio_lines(found):
        print(line)
    print(f"results: {output}")
    return 0


if __name__ == "__main__":
    cli.run_command(main)
