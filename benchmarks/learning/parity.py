"""Compare how both trainers learn: `python benchmarks/learning/parity.py --seeds 5`.

The first training steps of both trainers are equal up to round-off, as `tests/agents/test_ppo.py`
checks. Later, trainings are chaotic, and after each interval Brax draws another key, so that only
the learning curves can be compared. There are two tasks, each with N seeds:
  probe   the egocentric task with a robot that moves exactly as commanded, without physics
  config  the given configuration; LINEAR and the physical normalizer, which Brax does not have,
          are replaced by ADAPTIVE_KL and Brax's normalizer
After every interval the deterministic policy is evaluated on the fixed goals of the report. The
score of a training is its mean success while it learns: the area under the success curve divided
by the length of the training. The initial networks of a seed determine most of it, so both
trainers use the same seeds, and the differences are tested seed by seed.

The test: flipping the signs of the N differences in all 2^N ways (a random 100,000 of them if
there are more) gives the two-sided p-value of their mean, at least 2^(1-N); Student's t gives its
95 % confidence interval. The verdict is `same` if this interval lies within ± the margin
(--margin, in success rate), `different` if it does not and excludes 0, and otherwise `undecided`.
The exit code is 0 only if every verdict is `same`.

These differences between the trainers are intended:

| what                    | brax                          | resumable                          |
|-------------------------|-------------------------------|------------------------------------|
| next observation        | stored for every step         | stored at the end of an unroll; the|
|                         |                               | loss reads no other                |
| episode statistics      | shuffled with the data        | not stored: the loss needs only    |
|                         |                               | truncation                         |
| non-finite gradient     | makes the parameters          | skipped and counted; Adam and its  |
|                         | non-finite                    | step size are unchanged            |
| keys after an interval  | a new one for each epoch      | one chain: results do not depend on|
|                         |                               | the interval                       |
| keys of devices         | split                         | the same key, folded in with the   |
|                         |                               | device's index if there are several|
| total steps             | every interval rounded up to  | the sum rounded up to training     |
|                         | training steps                | steps                              |
| smallest deviation of   | 1e-6                          | by the observation's units, unless |
| the normalizer          |                               | normalizer is brax, as it is here  |
| learning rate           | NONE, ADAPTIVE_KL             | also LINEAR, to zero at the end    |
| first reset             | on each device its share      | of all environments at once, then  |
|                         |                               | distributed over the devices       |
| several seeds           | no                            | in one program                     |

Sources: R. A. Fisher, The Design of Experiments (1935), section 21;
Student, Biometrika 6 (1908), 1-25, doi:10.1093/biomet/6.1.1.
"""

import argparse
import itertools
import math
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.stats
from jaxtyping import Array, Float

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks import CONFIGS, RESULTS
from benchmarks.harness.timing import available_cores
from jetbot_mjx import cli
from jetbot_mjx.agents.networks import make_networks
from jetbot_mjx.config import Config, RobotConfig, load_config, parse_config
from jetbot_mjx.devices import compiler_options, require_device, use_compilation_cache
from jetbot_mjx.envs import kinematics
from jetbot_mjx.envs.jetbot_env import JetBotEnv, make_jetbot_env
from jetbot_mjx.envs.physics import Physics
from jetbot_mjx.envs.robot_model import QPOS_QUAT, QVEL_ANGULAR_B, QVEL_LINEAR_W
from jetbot_mjx.envs.state import PhysicsState
from jetbot_mjx.evaluation.evaluator import Evaluator, report_keys, summarize
from jetbot_mjx.runs import Setup
from jetbot_mjx.runs.run_dir import versions, write_json
from jetbot_mjx.training import brax_trainer, ppo_trainer
from jetbot_mjx.training.callbacks import Progress, TrainerCallback
from jetbot_mjx.training.preemption import Preemption
from onekernel.aot.program_cache import ProgramCache

TRAINERS = ("brax", "resumable")
_MOST_SIGNS = 100_000
_ROBOT = RobotConfig()

ADAPTIVE_KL = {
    "learning_rate_schedule": "ADAPTIVE_KL",
    "desired_kl": 0.03,
    "learning_rate_schedule_min_lr": 1e-4,
    "learning_rate_schedule_max_lr": 1e-3,
}
"""A learning-rate schedule that both trainers have."""

PROBE = {
    "checkpoint_interval": 16_384,
    "task": {"observation": "egocentric"},
    "ppo": {
        "num_timesteps": 262_144,
        "num_envs": 256,
        "batch_size": 64,
        "normalizer": "brax",
        **ADAPTIVE_KL,
    },
}


class Unicycle(Physics):
    """The physics of a robot that moves exactly as commanded, without slip or lag."""

    def step(
        self,
        state: PhysicsState,
        ctrl: Float[Array, "2"],
        mocap_pos: Float[Array, "nmocap 3"] | None = None,
    ) -> PhysicsState:
        """Integrate the commanded wheel speeds over one environment step."""
        dt = self._config.ctrl_dt
        left, right = _ROBOT.controller_wheel_radius * ctrl
        speed = 0.5 * (left + right)
        yaw_rate = (right - left) / _ROBOT.controller_wheel_separation
        heading = kinematics.yaw(state.qpos[QPOS_QUAT]) + yaw_rate * dt
        zero = jnp.zeros(())
        velocity = speed * jnp.stack([jnp.cos(heading), jnp.sin(heading), zero])
        quat = jnp.stack([jnp.cos(heading / 2), zero, zero, jnp.sin(heading / 2)])
        qvel = state.qvel.at[QVEL_LINEAR_W].set(velocity)
        return state.replace(
            qpos=state.qpos.at[:3].add(velocity * dt).at[QPOS_QUAT].set(quat),
            qvel=qvel.at[QVEL_ANGULAR_B].set(jnp.stack([zero, zero, yaw_rate])),
            time=state.time + dt,
        )


class Curve(NamedTuple):
    """A `Curve` holds the learning curve of one seed."""

    trainer: str
    seed: int
    env_steps: list[int]
    success: list[float]
    """Success rates of the deterministic policy on the fixed goals."""
    seconds: float
    """Time of the whole training, including evaluations and compilation."""

    def area(self, until: int) -> float:
        """Return the mean success over the training up to a number of environment steps."""
        inside = [step for step in self.env_steps if step < until]
        steps = np.array([*inside, until])
        return float(np.trapezoid(np.interp(steps, self.env_steps, self.success), steps) / until)


class Comparison(NamedTuple):
    """A `Comparison` holds the test of two samples of areas that are paired by seed."""

    means: dict[str, float]
    deviations: dict[str, float]
    """Standard deviations over the seeds."""
    difference: float
    """Mean over the seeds of resumable minus Brax."""
    low: float
    """Lower end of the 95 % interval of the difference."""
    high: float
    """Upper end of the interval."""
    p: float
    """Two-sided p-value of the sign-flip permutation test."""
    margin: float
    verdict: str


class _SuccessRecorder(TrainerCallback):
    """A callback that evaluates the policy after every interval."""

    def __init__(self, evaluate: Callable[[Any], float]) -> None:
        self._evaluate = evaluate
        self.env_steps: list[int] = []
        self.success: list[float] = []

    def on_interval(self, progress: Sequence[Progress]) -> bool:
        self.env_steps.append(progress[0].env_steps)
        self.success.append(self._evaluate(progress[0].params))
        return True


def train(
    config: Config, env: JetBotEnv, trainer: str, seed: int, evaluate: Callable[[Any], float]
) -> Curve:
    """Train one seed with one trainer.

    Args:
      config: The configuration of the run; its trainer and seed are not used.
      env: its environment, unwrapped.
      trainer: one of `TRAINERS`.
      seed: The seed of the run.
      evaluate: Returns the success rate of a policy, given its parameters.

    Returns:
      The learning curve.
    """
    config = _with_trainer(config, trainer, seed)
    recorder, began = _SuccessRecorder(evaluate), time.perf_counter()
    if trainer == "brax":
        brax_trainer.train(Setup(config, env=env), recorder)
    else:
        program = ppo_trainer.CompiledTrainer.from_setup(Setup(config, env=env))
        ppo_trainer.train(
            program, recorder, Preemption(config.preemption_notice), config.checkpoint_interval
        )
    seconds = time.perf_counter() - began
    return Curve(trainer, seed, recorder.env_steps, recorder.success, seconds)


def _with_trainer(config: Config, trainer: str, seed: int) -> Config:
    values = config.model_dump(mode="json")
    return parse_config(values | {"trainer": trainer, "seed": seed, "seeds": 1})


def run(config: Config, env: JetBotEnv, seeds: int, episodes: int) -> list[Curve]:
    """Train all seeds with both trainers and print a line for each.

    Args:
      config: The configuration of the run.
      env: Its environment without wrappers.
      seeds: The number of seeds for each trainer.
      episodes: The number of episodes of each evaluation.

    Returns:
      The learning curves.
    """
    networks = make_networks(config.ppo, env.observation_size, env.action_size)
    evaluator, keys = (
        Evaluator(env, networks, ProgramCache(compiler_options(config.deterministic))),
        report_keys(episodes),
    )

    def evaluate(params: Any) -> float:
        return summarize(evaluator.run(params, keys), env.dt).success_rate

    curves = []
    for trainer in TRAINERS:
        for seed in range(config.seed, config.seed + seeds):
            curves.append(train(config, env, trainer, seed, evaluate))
            one = curves[-1]
            print(
                f"{trainer:>9}  seed {seed:>3}  {one.seconds:6.1f} s  mean success"
                f" {one.area(one.env_steps[-1]):7.2%}  at the end {one.success[-1]:7.2%}",
                flush=True,
            )
    return curves


def compare(brax: Sequence[float], resumable: Sequence[float], margin: float) -> Comparison:
    """Test whether two samples that are paired by seed have the same mean.

    Args:
      brax: The scores of Brax's trainer, one for each seed and at least two.
      resumable: The scores of the resumable trainer in the same order.
      margin: The largest difference of means that counts as equal.

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
    """Return the share of all choices of signs whose mean is at least as far from 0."""
    count = differences.size
    if 2**count <= _MOST_SIGNS:
        signs = np.array(list(itertools.product((1.0, -1.0), repeat=count)))
    else:
        drawn = np.random.default_rng(0).choice((1.0, -1.0), size=(_MOST_SIGNS - 1, count))
        signs = np.vstack([np.ones(count), drawn])
    means = np.abs((signs * differences).mean(axis=1))
    return float(np.mean(means >= abs(differences.mean()) - 1e-12))


def _table(curves: Sequence[Curve], comparison: Comparison) -> str:
    """Return a table of success over steps: mean and standard deviation over the seeds."""
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


def _measure_task(config: Config, env: JetBotEnv, options: argparse.Namespace) -> dict[str, Any]:
    """Train and compare both trainers on one task, print the tables, and return the results."""
    curves = run(config, env, options.seeds, options.episodes)
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
    return {
        "config": config.model_dump(mode="json"),
        "areas": areas,
        "comparison": found._asdict(),
        "curves": [curve._asdict() for curve in curves],
    }


def _parser() -> argparse.ArgumentParser:
    parser = cli.Parser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--config", type=Path, default=CONFIGS / "jetbot_egocentric.yaml")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--seeds", type=cli.positive_int, default=5, help="for each trainer")
    parser.add_argument("--episodes", type=cli.positive_int, default=256, help="of each evaluation")
    parser.add_argument(
        "--margin", type=cli.fraction, default=0.05, help="of the mean success (default: 0.05)"
    )
    parser.add_argument("--output", type=Path, default=RESULTS / "parity-cpu.json")
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Train and compare both trainers, print the tables and write the JSON file.

    Args:
      arguments: The command line without the program's name; None: that of the process.

    Returns:
      0, or 1 unless both trainers were found to learn equally well on every task.
    """
    # Parse the command line and check it before minutes of training.
    parser = _parser()
    options = parser.parse_args(arguments)
    if options.seeds < 2:
        parser.error("--seeds: a comparison needs at least 2")
    require_device()
    use_compilation_cache()
    # Build both tasks with settings that both trainers have.
    config, probe = load_config(options.config, options.overrides), parse_config(PROBE)
    values = config.model_dump(mode="json")
    values["ppo"] |= ADAPTIVE_KL if config.ppo.learning_rate_schedule == "LINEAR" else {}
    values["ppo"]["normalizer"] = "brax"
    config = parse_config(values)
    probe_env = make_jetbot_env(probe)
    probe_env = probe_env.with_physics(Unicycle(probe_env.physics.mj_model, probe.physics))
    tasks = {"probe": (probe, probe_env), options.config.name: (config, make_jetbot_env(config))}
    for trainer in TRAINERS:
        _with_trainer(config, trainer, config.seed).check_devices(jax.device_count())
    # Train and compare on each task.
    results: dict[str, Any] = {}
    for name, (task_config, env) in tasks.items():
        print(f"{name}: {task_config.ppo.num_timesteps:,} steps", flush=True)
        results[name] = _measure_task(task_config, env, options)
    # Write all results.
    options.output.parent.mkdir(parents=True, exist_ok=True)
    write_json(
        options.output,
        {
            "overrides": options.overrides,
            "episodes": options.episodes,
            "cpu_cores": available_cores(),
            "versions": versions(),
            "results": results,
        },
    )
    print(f"results: {options.output}")
    verdicts = {result["comparison"]["verdict"] for result in results.values()}
    return 0 if verdicts == {"same"} else 1


if __name__ == "__main__":
    cli.run_command(main)
