"""Evaluate the robustness of a policy on changed robots and in another simulator, C MuJoCo.

A sweep changes one parameter at a time from the preset's value. Goals, rules and metrics are those
of the report. One compiled program evaluates all robots, with the policy and with the scripted
controller. A policy that sees is also evaluated with changed looks, which the scripted controller
does not see. The evaluation in C MuJoCo uses the same robot with numerics that no training uses.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple, get_args

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int, UInt32

from jetbot_mjx import envs
from jetbot_mjx.agents import PolicyParams
from jetbot_mjx.config import QUANTITIES, LookParams, RandomizationConfig, RobotParams
from jetbot_mjx.devices import default_device_cpu
from jetbot_mjx.envs import DomainRandomizationWrapper, Numerics
from jetbot_mjx.evaluation import evaluator
from jetbot_mjx.evaluation.evaluator import Evaluator, Summary, summarize
from jetbot_mjx.evaluation.goal_set import GOAL_SET_VERSION
from jetbot_mjx.evaluation.rollout import Episodes, rollout_fn
from jetbot_mjx.runs import JsonObject, Setup
from jetbot_mjx.terminal import stage

SWEEP_GOALS = 128
"""Number of the report's fixed goals that a sweep uses for each robot."""

ROBUST_SUCCESS_RATE = 0.95
"""Lowest success rate at which a policy counts as robust to a changed value."""


Variant = tuple[RobotParams, LookParams]
"""A robot, and what its camera sees."""

RENDERED_GOALS = 256
"""Number of the report's fixed goals that a policy drives to by MuJoCo's pictures."""


class Sweep(NamedTuple):
    """A `Sweep` holds one parameter and the values at which a policy is evaluated."""

    name: str
    """Name of the parameter, a field of `RobotParams` or `LookParams`."""
    label: str
    unit: str
    values: tuple[float, ...]
    """Values in ascending order, which include the preset's value."""
    source: str
    """Source of the range."""

    @property
    def nominal(self) -> float:
        """Return the preset's value."""
        return QUANTITIES[self.name].nominal

    @property
    def is_look(self) -> bool:
        """Return whether the parameter changes what the camera sees."""
        return self.name in LookParams._fields

    @property
    def variants(self) -> list[Variant]:
        """Return robot and looks for each value."""
        changes = [{self.name: value} for value in self.values]
        if self.is_look:
            return [(RobotParams(), LookParams()._replace(**change)) for change in changes]
        return [(RobotParams()._replace(**change), LookParams()) for change in changes]


SWEEPS = tuple(
    Sweep(one.name, *one.evaluated, source=one.bounds.source) for one in QUANTITIES.values()
)
"""All parameters."""


class SweepResult(NamedTuple):
    """A `SweepResult` holds the results of a policy and the scripted controller for one sweep."""

    sweep: Sweep
    policy: tuple[Summary, ...]
    """Metrics of the policy, one summary for each value."""
    scripted: tuple[Summary, ...]


class Sweeper:
    """A `Sweeper` evaluates policies over all parameters with one compiled program."""

    def __init__(
        self,
        setup: Setup,
        keys: UInt32[Array, "n 2"],
        sweeps: Sequence[Sweep] = SWEEPS,
    ) -> None:
        """Prepare the program, which compiles at its first use.

        Args:
          setup: the environment with its preset's robot, and the networks of the policies.
          keys: one reset key for each episode, such as `report_keys(128)`.
          sweeps: the parameters with their values; those that the robot does not have,
            and without a camera those of looks, are left out.
        """
        env, networks = setup.robot_env, setup.networks
        sees = env.camera is not None
        self._env, self._keys = env, keys
        self._sweeps = tuple(
            one for one in sweeps if (sees if one.is_look else one.name in env.robot.quantities)
        )
        # The preset's robot occurs in every sweep, but is evaluated only once.
        self._variants = list(dict.fromkeys(v for one in self._sweeps for v in one.variants))
        # Run robots one after the other on a CPU: the solver iterates until the last robot of a
        # batch has converged, so those that slide would slow down the rest. A GPU needs the whole
        # batch to be busy.
        self._at_once = 1 if jax.default_backend() == "cpu" else len(self._variants)
        controllers = [evaluator.policy_controller(networks), evaluator.BASELINES["scripted"](env)]
        length = env.config.task.episode_length

        def run_episodes(
            index: int | Int[Array, ""],
            params: PolicyParams,
            keys: UInt32[Array, "n 2"],
            variants: Variant,
        ) -> Episodes:
            def one(variant: Variant) -> Episodes:
                robot_params, look_params = variant
                randomized_env = DomainRandomizationWrapper(
                    env, robot_params, look_params=look_params if sees else None
                )
                return rollout_fn(randomized_env, controllers, length)(index, params, keys)

            return jax.vmap(one)(variants)

        self._run_episodes = jax.jit(run_episodes, compiler_options=setup.programs.options)
        self._scripted: dict[Variant, Summary] = {}

    def run(self, params: PolicyParams) -> tuple[SweepResult, ...]:
        """Evaluate a policy at every value of every parameter, on the same goals.

        Args:
          params: parameters of the policy.

        Returns:
          One result for each sweep.
        """
        host = jax.device_get(params)
        policy = self._evaluate(0, host, self._variants)
        if not self._scripted:
            # The scripted controller does not see: the robot counts, and not its looks.
            robots = dict.fromkeys((robot, LookParams()) for robot, _ in self._variants)
            self._scripted = self._evaluate(1, host, list(robots))
        return tuple(
            SweepResult(
                one,
                tuple(policy[variant] for variant in one.variants),
                tuple(self._scripted[robot, LookParams()] for robot, _ in one.variants),
            )
            for one in self._sweeps
        )

    def _evaluate(
        self, controller: int, params: PolicyParams, variants: Sequence[Variant]
    ) -> dict[Variant, Summary]:
        summaries: list[Summary] = []
        name = ("policy", "scripted")[controller]
        with stage(f"robustness values, {name}", len(variants)) as advance:
            for first in range(0, len(variants), self._at_once):
                some = variants[first : first + self._at_once]
                stacked = jax.tree.map(lambda *values: jnp.asarray(values, jnp.float32), *some)
                found = self._run_episodes(controller, params, self._keys, stacked)
                episodes = jax.device_get(found)
                for i in range(len(some)):
                    one = jax.tree.map(lambda x, i=i: x[i], episodes)
                    summaries.append(summarize(one, self._env.dt))
                advance(len(some))
        return dict(zip(variants, summaries, strict=True))


_IN_MUJOCO = " in C MuJoCo"


class MujocoResult(NamedTuple):
    """A `MujocoResult` holds the metrics of a policy in C MuJoCo, on the goals of the report."""

    numerics: Numerics
    policy: Summary
    """Metrics with the preset's robot."""
    randomized: Summary | None = None
    """Metrics with a robot sampled for each goal; None without ranges to sample from."""
    rendered: Mapping[str, Summary] | None = None
    """Metrics with the preset's robot and the pictures of MuJoCo's renderer, by appearance, on
    the first `RENDERED_GOALS` goals; None where they were not asked for, or the policy does not
    see."""


class MujocoEvaluator:
    """A `MujocoEvaluator` evaluates policies in C MuJoCo."""

    def __init__(
        self,
        setup: Setup,
        ranges: RandomizationConfig | None = None,
        numerics: Numerics = envs.OTHER_NUMERICS,
        *,
        pictures: bool = False,
    ) -> None:
        """Build the simulator, whose programs compile at their first use.

        Args:
          setup: the environment with its preset's robot, and the networks of the policies.
          ranges: ranges from which a robot is sampled for each goal, in addition to the
            evaluation with the preset's robot; None: no sampled robots.
          numerics: numerical settings of C MuJoCo.
          pictures: whether a policy that sees is evaluated also by the pictures of MuJoCo's own
            renderer.

        Raises:
          UserError: JAX is configured without a CPU, or pictures are asked for on a machine
            without OpenGL.
        """
        env, networks, programs = setup.robot_env, setup.networks, setup.programs
        self._numerics, self._dt = numerics, env.dt
        simulator = envs.in_mujoco(env, numerics)
        robots: list[envs.JetBotEnv | DomainRandomizationWrapper] = [simulator]
        if ranges is not None and ranges.drawn:
            robots.append(DomainRandomizationWrapper(simulator, ranges=ranges))
        self._evaluators = [Evaluator(one, networks, programs, where=_IN_MUJOCO) for one in robots]
        self._rendered: dict[envs.SceneryKind, Evaluator] = {}
        if pictures and env.camera is not None:
            config, model = env.camera.config, env.mj_model
            for name in get_args(envs.SceneryKind):
                camera = envs.MujocoCamera(config, model, appearance=name)
                seen = simulator.with_camera(camera)
                own = Evaluator(seen, networks, programs, where=f"{_IN_MUJOCO}, {name} pictures")
                self._rendered[name] = own

    def run(self, params: PolicyParams, keys: UInt32[Array, "n 2"]) -> MujocoResult:
        """Evaluate a policy.

        Args:
          params: parameters of the policy.
          keys: one reset key for each episode, such as `report_keys(1024)`.
        """
        with default_device_cpu():
            found = [summarize(one.run(params, keys), self._dt) for one in self._evaluators]
            rendered = {
                name: summarize(one.run(params, keys[:RENDERED_GOALS]), self._dt)
                for name, one in self._rendered.items()
            }
        randomized = found[1] if len(found) > 1 else None
        return MujocoResult(self._numerics, found[0], randomized, rendered or None)


def robust_range(result: SweepResult) -> tuple[float, float] | None:
    """Return the range of values with a success rate of at least `ROBUST_SUCCESS_RATE`.

    Args:
      result: the result for one parameter.

    Returns:
      The lowest and the highest evaluated value of the contiguous range around the preset's value;
      None if the success rate is lower already at the preset's value.
    """
    values = result.sweep.values
    good = [summary.success_rate >= ROBUST_SUCCESS_RATE for summary in result.policy]
    low = high = values.index(result.sweep.nominal)
    if not good[low]:
        return None
    while low > 0 and good[low - 1]:
        low -= 1
    while high < len(values) - 1 and good[high + 1]:
        high += 1
    return values[low], values[high]


def as_json(results: Sequence[SweepResult]) -> JsonObject:
    """Return the results as JSON values for a report's file.

    Args:
      results: the results of one policy.

    Returns:
      The parameters with their values, metrics and the range over which the policy is robust.
    """
    values = {
        "goal_set_version": GOAL_SET_VERSION,
        "carries_at": ROBUST_SUCCESS_RATE,
        "goals": results[0].policy[0].episodes,
        "quantities": [
            {
                **result.sweep._asdict(),
                "nominal": result.sweep.nominal,
                "carries": robust_range(result),
                "lowest": min(summary.success_rate for summary in result.policy),
                "policy": result.policy,
                "scripted": result.scripted,
            }
            for result in results
        ],
    }
    return evaluator.json_values(values)
