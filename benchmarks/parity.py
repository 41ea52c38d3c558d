"""Trains with both trainers and compares how they learn: `python benchmarks/parity.py --seeds 5`.

The first training steps of both are equal to round-off, which `tests/agents/test_ppo.py` holds.
Then trainings are chaotic, and after an interval Brax draws another key: only how they learn can be
compared. On two tasks, with N seeds:
  probe   the egocentric task with a robot that moves exactly as commanded: no physics
  config  the given configuration; LINEAR and the physical normalizer, which Brax does not know,
          give way to ADAPTIVE_KL and Brax's
After every interval the deterministic policy drives to the same fixed goals, those of the final
report. A training's figure is the area under its success curve over its length: its mean success
while it learns. A seed's first networks decide most of that, so both trainers get the same seeds,
and what is tested are the differences, seed by seed.

The test: turning the signs of the N differences in all 2^N ways (a random 100,000 of them where
there are more) gives the two-sided p of their mean, at least 2^(1-N); Student's t gives its 95 %
interval. The verdict is `same` where that interval lies within ± the margin (--margin, in success
rate), `different` where it does not and excludes 0, and else `undecided`. The exit code is 0
only where every verdict is `same`.

What differs between the trainers, on purpose:

| what                    | brax                          | resumable                          |
|-------------------------|-------------------------------|------------------------------------|
| next observation        | kept for every step           | kept where an unroll ends; the     |
|                         |                               | loss reads no other                |
| books of episodes       | shuffled with the data        | left out: the loss reads truncation|
| gradient not finite     | spoils the parameters for good| skipped and counted, Adam and its  |
|                         |                               | step size left as they were        |
| keys after an interval  | a new one for each epoch      | one chain: the interval is not     |
|                         |                               | felt by the bits                   |
| keys of devices         | split                         | the same key, folded in with the   |
|                         |                               | device's index; one device: as is  |
| total steps             | every interval rounded up to  | the whole rounded up to training   |
|                         | training steps                | steps                              |
| smallest deviation of   | 1e-6                          | by the observation's units, unless |
| the normaliser          |                               | normalizer is brax, as it is here  |
| learning rate           | NONE, ADAPTIVE_KL             | LINEAR as well, to zero at the end |
| first reset             | on each device its own share  | all at once, then dealt out        |
| several seeds           | no                            | in one program                     |

Sources: R. A. Fisher, The Design of Experiments (1935), section 21;
Student, Biometrika 6 (1908), 1-25, doi:10.1093/biomet/6.1.1.
"""

# First, before Brax imports MJX and lets it print.
import jetbot_mjx  # noqa: F401  isort: skip

import itertools
import math
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats
from jaxtyping import Array, Float

from jetbot_mjx import cli
from jetbot_mjx.agents.networks import make_networks
from jetbot_mjx.compiler.program_cache import ProgramCache, use_compilation_cache
from jetbot_mjx.compiler.xla_options import compiler_options
from jetbot_mjx.config import Config, load_config, parse_config
from jetbot_mjx.envs import kinematics
from jetbot_mjx.envs.jetbot_env import JetBotEnv, make_env
from jetbot_mjx.envs.robot_model import (
    CONTROLLER_WHEEL_RADIUS,
    CONTROLLER_WHEEL_SEPARATION,
    QPOS_QUAT,
    QVEL_ANGULAR_B,
    QVEL_LINEAR_W,
)
from jetbot_mjx.envs.state import PhysicsState
from jetbot_mjx.evaluation.evaluator import Evaluator, report_keys, summarize
from jetbot_mjx.runs.run_dir import versions, write_json
from jetbot_mjx.training import brax_trainer, ppo_trainer
from jetbot_mjx.training.callbacks import Progress, TrainerCallback
from jetbot_mjx.training.preemption import Preemption

_FOLDER = Path(__file__).resolve().parent
TRAINERS = ("brax", "resumable")
_MOST_SIGNS = 100_000

STEERED = {
    "learning_rate_schedule": "ADAPTIVE_KL",
    "desired_kl": 0.03,
    "learning_rate_schedule_min_lr": 1e-4,
    "learning_rate_schedule_max_lr": 1e-3,
}
"""A schedule that both trainers know."""

PROBE = {
    "checkpoint_interval": 16_384,
    "task": {"observation": "egocentric"},
    "ppo": {
        "num_timesteps": 262_144,
        "num_envs": 256,
        "batch_size": 64,
        "normalizer": "brax",
        **STEERED,
    },
}


class Unicycle(JetBotEnv):
    """A robot whose wheels neither slip nor lag."""

    def step_physics(
        self,
        physics: PhysicsState,
        ctrl: Float[Array, "2"],
        mocap_pos: Float[Array, "nmocap 3"] | None = None,
    ) -> PhysicsState:
        """Integrates one environment step of what the wheels command."""
        left, right = CONTROLLER_WHEEL_RADIUS * ctrl
        speed, yaw_rate = 0.5 * (left + right), (right - left) / CONTROLLER_WHEEL_SEPARATION
        heading = kinematics.yaw(physics.qpos[QPOS_QUAT]) + yaw_rate * self.dt
        zero = jnp.zeros(())
        velocity = speed * jnp.stack([jnp.cos(heading), jnp.sin(heading), zero])
        quat = jnp.stack([jnp.cos(heading / 2), zero, zero, jnp.sin(heading / 2)])
        qvel = physics.qvel.at[QVEL_LINEAR_W].set(velocity)
        return physics.replace(
            qpos=physics.qpos.at[:3].add(velocity * self.dt).at[QPOS_QUAT].set(quat),
            qvel=qvel.at[QVEL_ANGULAR_B].set(jnp.stack([zero, zero, yaw_rate])),
            time=physics.time + self.dt,
        )


class Curve(NamedTuple):
    """How one seed learnt."""

    trainer: str
    seed: int
    env_steps: list[int]
    success: list[float]
    """Of the deterministic policy on the fixed goals."""
    seconds: float
    """Of the whole training, evaluations and compilation included."""

    def area(self, until: int) -> float:
        """Mean success over the training up to a number of environment steps."""
        inside = [step for step in self.env_steps if step < until]
        steps = np.array([*inside, until])
        return float(np.trapezoid(np.interp(steps, self.env_steps, self.success), steps) / until)


class Comparison(NamedTuple):
    """Whether two samples of areas, paired by seed, are alike."""

    means: dict[str, float]
    deviations: dict[str, float]
    """Standard deviations over the seeds."""
    difference: float
    """Resumable minus Brax, mean over the seeds."""
    low: float
    """Lower end of its 95 % interval."""
    high: float
    """Upper end of it."""
    p: float
    """Two-sided, of the sign test by permutation."""
    margin: float
    verdict: str


class _Judge(TrainerCallback):
    """Judges every policy that a trainer reports."""

    def __init__(self, judge: Callable[[Any], float]) -> None:
        self._judge = judge
        self.env_steps: list[int] = []
        self.success: list[float] = []

    def on_interval(self, progress: Sequence[Progress]) -> bool:
        self.env_steps.append(progress[0].env_steps)
        self.success.append(self._judge(progress[0].params))
        return True


def train(
    config: Config, env: JetBotEnv, trainer: str, seed: int, judge: Callable[[Any], float]
) -> Curve:
    """Trains one seed with one trainer.

    Args:
      config: the run; its own trainer and seed are not used.
      env: its environment, unwrapped.
      trainer: one of `TRAINERS`.
      seed: of the run.
      judge: from a policy's parameters to its success rate.

    Returns:
      How it learnt.
    """
    config = _with_trainer(config, trainer, seed)
    recorder, began = _Judge(judge), time.perf_counter()
    if trainer == "brax":
        brax_trainer.train(config, env, recorder)
    else:
        program = ppo_trainer.CompiledTrainer.from_config(config, env)
        ppo_trainer.train(
            program, recorder, Preemption(config.preemption_notice), config.checkpoint_interval
        )
    seconds = time.perf_counter() - began
    return Curve(trainer, seed, recorder.env_steps, recorder.success, seconds)


def _with_trainer(config: Config, trainer: str, seed: int) -> Config:
    values = config.model_dump(mode="json")
    return parse_config(values | {"trainer": trainer, "seed": seed, "seeds": 1})


def run(config: Config, env: JetBotEnv, seeds: int, episodes: int) -> list[Curve]:
    """Trains all seeds with both trainers, and prints each.

    Args:
      config: the run.
      env: its environment, unwrapped.
      seeds: how many for each trainer.
      episodes: of every evaluation.

    Returns:
      The curves.
    """
    networks = make_networks(
        config.ppo.network,
        env.observation_size,
        env.action_size,
        normalize=config.ppo.normalize_observations,
    )
    evaluator, keys = (
        Evaluator(env, networks, ProgramCache(compiler_options(config))),
        report_keys(episodes),
    )

    def judge(params: Any) -> float:
        return summarize(evaluator.run(params, keys), env.dt).success_rate

    curves = []
    for trainer in TRAINERS:
        for seed in range(config.seed, config.seed + seeds):
            curves.append(train(config, env, trainer, seed, judge))
            one = curves[-1]
            print(
                f"{trainer:>9}  seed {seed:>3}  {one.seconds:6.1f} s  mean success"
                f" {one.area(one.env_steps[-1]):7.2%}  at the end {one.success[-1]:7.2%}",
                flush=True,
            )
    return curves


def compare(brax: Sequence[float], resumable: Sequence[float], margin: float) -> Comparison:
    """Tests whether two samples that are paired by seed have the same mean.

    Args:
      brax: one figure for each seed, at least two.
      resumable: likewise, in the same order.
      margin: difference of means that would not matter.

    Returns:
      The comparison.
    """
    samples = dict(zip(TRAINERS, (np.asarray(brax), np.asarray(resumable)), strict=True))
    differences = samples["resumable"] - samples["brax"]
    mean, count = float(differences.mean()), differences.size
    error = float(differences.std(ddof=1)) / math.sqrt(count)
    spread = float(scipy.stats.t.ppf(0.975, count - 1)) * error
    low, high = mean - spread, mean + spread
    if max(-low, high) < margin:
        verdict = "same"
    else:
        verdict = "different" if low > 0 or high < 0 else "undecided"
    return Comparison(
        means={name: float(values.mean()) for name, values in samples.items()},
        deviations={name: float(values.std(ddof=1)) for name, values in samples.items()},
        difference=mean,
        low=low,
        high=high,
        p=_sign_flip_p(differences),
        margin=margin,
        verdict=verdict,
    )


def _sign_flip_p(differences: np.ndarray) -> float:
    """Share of all choices of signs under which the mean is at least as far from 0."""
    count = differences.size
    if 2**count <= _MOST_SIGNS:
        signs = np.array(list(itertools.product((1.0, -1.0), repeat=count)))
    else:
        drawn = np.random.default_rng(0).choice((1.0, -1.0), size=(_MOST_SIGNS - 1, count))
        signs = np.vstack([np.ones(count), drawn])
    means = np.abs((signs * differences).mean(axis=1))
    return float(np.mean(means >= abs(differences.mean()) - 1e-12))


def _table(curves: Sequence[Curve], comparison: Comparison) -> str:
    """Success over steps, the mean over the seeds with their standard deviation."""
    lines = ["| steps | brax | resumable |", "|------:|-----:|----------:|"]
    of = {name: [curve for curve in curves if curve.trainer == name] for name in TRAINERS}
    for step in of["resumable"][0].env_steps:
        cells = []
        for name in TRAINERS:
            rates = [np.interp(step, curve.env_steps, curve.success) for curve in of[name]]
            cells.append(f"{np.mean(rates):.1%} ± {np.std(rates, ddof=1):.1%}")
        lines.append(f"| {step:,} | {' | '.join(cells)} |")
    means = [f"{comparison.means[name]:.2%}" for name in TRAINERS]
    lines.append(f"| mean  | {' | '.join(means)} |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Parses the command line, trains, prints the tables and writes the JSON file.

    Args:
      arguments: without the program's name; None: those of the process.

    Returns:
      0, or 1 where the trainers were not found to learn the same.
    """
    parser = cli.Parser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "--config", type=Path, default=_FOLDER.parent / "configs" / "jetbot_egocentric.yaml"
    )
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--seeds", type=cli.positive_int, default=5, help="for each trainer")
    parser.add_argument("--episodes", type=cli.positive_int, default=256, help="an evaluation")
    parser.add_argument(
        "--margin", type=cli.fraction, default=0.05, help="of the mean success (default: 0.05)"
    )
    parser.add_argument("--output", type=Path, default=_FOLDER / "results" / "parity-cpu.json")
    options = parser.parse_args(arguments)
    if options.seeds < 2:
        parser.error("--seeds: a comparison needs at least 2")
    cli.require_device()
    use_compilation_cache()
    config, probe = load_config(options.config, options.overrides), parse_config(PROBE)
    values = config.model_dump(mode="json")
    values["ppo"] |= STEERED if config.ppo.learning_rate_schedule == "LINEAR" else {}
    values["ppo"]["normalizer"] = "brax"
    config = parse_config(values)
    tasks = {"probe": (probe, Unicycle(probe)), options.config.name: (config, make_env(config))}
    for trainer in TRAINERS:
        _with_trainer(config, trainer, config.seed).check_devices(jax.device_count())
    results: dict[str, Any] = {}
    for name, (task_config, env) in tasks.items():
        print(f"{name}: {task_config.ppo.num_timesteps:,} steps", flush=True)
        curves = run(task_config, env, options.seeds, options.episodes)
        until = min(curve.env_steps[-1] for curve in curves)
        areas = {
            trainer: [curve.area(until) for curve in curves if curve.trainer == trainer]
            for trainer in TRAINERS
        }
        found = compare(areas["brax"], areas["resumable"], options.margin)
        print(
            f"{_table(curves, found)}\n"
            f"difference of mean success {found.difference:+.2%} (95 % interval"
            f" {found.low:+.2%} .. {found.high:+.2%}), p = {found.p:.3f};"
            f" margin ± {found.margin:.0%}: {found.verdict}",
            flush=True,
        )
        results[name] = {
            "config": task_config.model_dump(mode="json"),
            "areas": areas,
            "comparison": found._asdict(),
            "curves": [curve._asdict() for curve in curves],
        }
    options.output.parent.mkdir(parents=True, exist_ok=True)
    write_json(
        options.output,
        {
            "overrides": options.overrides,
            "episodes": options.episodes,
            "cpu_cores": os.cpu_count(),
            "versions": versions(),
            "results": results,
        },
    )
    print(f"results: {options.output}")
    verdicts = {result["comparison"]["verdict"] for result in results.values()}
    return 0 if verdicts == {"same"} else 1


if __name__ == "__main__":
    cli.run_command(main)
