"""Evaluate the robustness of a policy on changed robots and in another simulator, C MuJoCo.

A sweep changes one parameter at a time from the preset's value. Goals, rules and metrics are those
of the report. One compiled program evaluates all robots, with the policy and with the scripted
controller. The evaluation in C MuJoCo uses the same robot with numerics that no training uses.

Sources of the ranges, by tag; BOM, EST and SIM are those of `envs/robot_model.py`:
  CAD         the space for the battery and the clearance of the casters in the CAD model
  CSE276A     gassajor000/cse276a_jetbot: calibration of a JetBot's motors
  DUCKIETOWN  gym-duckietown: simulator of a robot with the same motors
  ISAACRL     KhaledSharif/isaac-sim-jetbot-rl: domain randomization of Isaac's JetBot
  PICOBOT     uni-obuda picobot: system identification of a robot with the same motors
  TT          measurements of the same motors: newscrewdriver.com, SunFounder's data
  WHEELEDLAB  WheeledLab: domain randomization of a drifting car
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from brax.training.agents.ppo import networks as ppo_networks
from jaxtyping import Array, Float, Int, UInt32

from jetbot_mjx.agents.networks import PolicyParams
from jetbot_mjx.compiler.program_cache import ProgramCache
from jetbot_mjx.compiler.xla_options import compiler_options, default_device_cpu
from jetbot_mjx.config import RandomizationConfig
from jetbot_mjx.envs.domain_randomization import DomainRandomizationWrapper
from jetbot_mjx.envs.jetbot_env import JetBotEnv
from jetbot_mjx.envs.mujoco_simulator import OTHER_NUMERICS, Numerics, in_mujoco
from jetbot_mjx.envs.robot_params import RobotParams
from jetbot_mjx.evaluation.evaluator import (
    BASELINES,
    GOAL_SET_VERSION,
    Evaluator,
    Summary,
    policy_controller,
    summarize,
)
from jetbot_mjx.evaluation.rollout import Episodes, rollout_fn
from jetbot_mjx.runs.progress import stage

SWEEP_GOALS = 128
"""Number of the report's fixed goals that a sweep uses for each robot."""

ROBUST_SUCCESS_RATE = 0.95
"""Lowest success rate at which a policy counts as robust to a changed value."""


class Sweep(NamedTuple):
    """A `Sweep` holds one parameter and the values at which a policy is evaluated."""

    name: str
    """Name of the parameter, a field of `RobotParams`."""
    label: str
    unit: str
    values: tuple[float, ...]
    """Values in ascending order, which include the preset's value."""
    source: str
    """Source of the range."""

    @property
    def nominal(self) -> float:
        """Return the preset's value."""
        return getattr(RobotParams(), self.name)

    @property
    def robots(self) -> list[RobotParams]:
        """Return the robot for each value."""
        return [RobotParams()._replace(**{self.name: value}) for value in self.values]


SWEEPS = (
    Sweep(
        "friction",
        "wheel-floor friction",
        "× preset",
        (0.3, 0.4, 0.6, 0.8, 1.0, 1.2),
        "ISAACRL 0.4 to 1.2; WHEELEDLAB from 0.3",
    ),
    Sweep(
        "mass",
        "chassis mass and inertia",
        "× preset",
        (0.85, 0.92, 1.0, 1.12, 1.25),
        "EST 0.60 to 0.85 kg in all, from the BOM's parts; ISAACRL ±15 %",
    ),
    Sweep(
        "com_x",
        "centre of mass, forward",
        "m",
        (-0.03, -0.015, 0.0, 0.015),
        "CAD ±15 mm; further forward the robot tips over its wheels",
    ),
    Sweep("com_y", "centre of mass, left", "m", (-0.01, -0.005, 0.0, 0.005, 0.01), "CAD ±5 mm"),
    Sweep("com_z", "centre of mass, up", "m", (-0.01, 0.0, 0.01, 0.02), "EST ±10 mm"),
    Sweep(
        "wheel_radius",
        "radius of the wheels",
        "× preset",
        (0.92, 0.96, 1.0, 1.04, 1.08),
        "BOM wheels of 60 and 65 mm, worn or new; measured to 68 mm",
    ),
    Sweep(
        "wheel_radius_mismatch",
        "unequal wheels",
        "(left - right) / mean",
        (-0.1, -0.05, -0.02, 0.0, 0.02, 0.05, 0.1),
        "EST radius ±2 %",
    ),
    Sweep(
        "wheel_separation",
        "wheel separation",
        "× preset",
        (0.9, 0.95, 1.0, 1.05, 1.25, 1.6),
        "CAD ±5 %; CSE276A turns as if 1.4 to 1.8 times as wide",
    ),
    Sweep(
        "motor_gain",
        "motor gain",
        "× preset",
        (0.85, 0.9, 0.95, 1.0, 1.05, 1.1, 1.15),
        "ISAACRL ±10 %",
    ),
    Sweep(
        "motor_gain_mismatch",
        "unequal motors",
        "(left - right) / mean",
        (-0.2, -0.1, 0.0, 0.1, 0.2),
        "CSE276A 3 % apart; DUCKIETOWN deviation 2 %, to 5 % EST",
    ),
    Sweep(
        "supply_voltage",
        "supply voltage",
        "× nominal",
        (0.8, 0.9, 1.0, 1.05, 1.15),
        "BOM 5 V bank 0.9 to 1.05; three cells 9.6 to 12.6 V",
    ),
    Sweep(
        "dead_band",
        "dead-band of the motors",
        "of full voltage",
        (0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3),
        "CSE276A 1 %, PICOBOT 11 %, TT 11 to 25 %",
    ),
    Sweep(
        "motor_lag",
        "further lag of the motors",
        "s",
        (0.0, 0.05, 0.1, 0.15, 0.2, 0.25),
        "PICOBOT 0.085 s, DUCKIETOWN 0.20 to 0.25 s, motors and all",
    ),
    Sweep(
        "action_delay",
        "delay of actions",
        "control steps",
        (0.0, 1.0, 2.0, 3.0, 6.0, 9.0),
        "ISAACRL 0 to 3 steps; DUCKIETOWN 0.15 s",
    ),
    Sweep(
        "position_noise",
        "noise of the position",
        "m",
        (0.0, 0.01, 0.02, 0.03, 0.06),
        "ISAACRL 0.01 to 0.03 m",
    ),
    Sweep(
        "yaw_noise",
        "noise of the heading",
        "rad",
        (0.0, 0.01, 0.03, 0.1),
        "ISAACRL 0.01 to 0.03 rad",
    ),
    Sweep("speed_noise", "noise of the velocity", "m/s", (0.0, 0.01, 0.03), "ISAACRL 0.01 m/s"),
    Sweep(
        "yaw_rate_noise",
        "noise of the yaw rate",
        "rad/s",
        (0.0, 0.03, 0.1),
        "ISAACRL 0.03 rad/s",
    ),
    Sweep(
        "observation_delay",
        "delay of observations",
        "control steps",
        (0.0, 1.0, 2.0, 3.0, 6.0),
        "EST 30 to 60 ms of a camera with 30 frames per second",
    ),
    Sweep(
        "height_offset",
        "observed height, offset",
        "m",
        (-0.003, -0.001, 0.0, 0.001, 0.003),
        "SIM MuJoCo's default contact carries the robot 0.4 mm higher; EST 3 mm, a carpet",
    ),
    Sweep(
        "pitch_offset",
        "observed pitch, offset",
        "rad",
        (-0.0175, 0.0, 0.0175),
        "EST 1°, how straight a sensor is mounted",
    ),
    Sweep("start_x", "start, forward", "m", (-0.05, 0.0, 0.05), "EST set down by hand"),
    Sweep("start_y", "start, left", "m", (-0.05, 0.0, 0.05), "EST set down by hand"),
    Sweep(
        "start_yaw",
        "heading at the start",
        "rad",
        (-3.14, -1.57, 0.0, 1.57, 3.14),
        "EST any heading",
    ),
)


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
        env: JetBotEnv,
        networks: ppo_networks.PPONetworks,
        keys: UInt32[Array, "n 2"],
        sweeps: Sequence[Sweep] = SWEEPS,
    ) -> None:
        """Prepare the program, which compiles at its first use.

        Args:
          env: one unwrapped environment with its preset's robot.
          networks: the networks of the policies.
          keys: one reset key for each episode, such as `report_keys(128)`.
          sweeps: the parameters with their values.
        """
        self._env, self._keys, self._sweeps = env, keys, tuple(sweeps)
        # The preset's robot occurs in every sweep, but is evaluated only once.
        self._robots = list(dict.fromkeys(robot for one in sweeps for robot in one.robots))
        # Run robots one after the other on a CPU: the solver iterates until the last robot of a
        # batch has converged, so those that slide would slow down the rest. A GPU needs the whole
        # batch to be busy.
        self._at_once = 1 if jax.default_backend() == "cpu" else len(self._robots)
        controllers = [policy_controller(networks), BASELINES["scripted"](env)]
        length = env.config.task.episode_length

        def run_episodes(
            index: int | Int[Array, ""],
            params: PolicyParams,
            keys: UInt32[Array, "n 2"],
            robot_params: Float[Array, "robots quantities"],
        ) -> Episodes:
            def one(robot_params: Float[Array, " quantities"]) -> Episodes:
                randomized_env = DomainRandomizationWrapper(env, RobotParams(*robot_params))
                return rollout_fn(randomized_env, controllers, length)(index, params, keys)

            return jax.vmap(one)(robot_params)

        self._run_episodes = jax.jit(run_episodes, compiler_options=compiler_options(env.config))
        self._scripted: dict[RobotParams, Summary] = {}

    def run(self, params: PolicyParams) -> tuple[SweepResult, ...]:
        """Evaluate a policy at every value of every parameter, on the same goals.

        Args:
          params: parameters of the policy.

        Returns:
          One result for each sweep.
        """
        host = jax.device_get(params)
        policy = self._evaluate(0, host)
        self._scripted = self._scripted or self._evaluate(1, host)
        return tuple(
            SweepResult(
                one,
                tuple(policy[robot] for robot in one.robots),
                tuple(self._scripted[robot] for robot in one.robots),
            )
            for one in self._sweeps
        )

    def _evaluate(self, controller: int, params: PolicyParams) -> dict[RobotParams, Summary]:
        robot_params = jnp.asarray(self._robots, jnp.float32)
        summaries: list[Summary] = []
        name = ("policy", "scripted")[controller]
        with stage(f"robustness values, {name}", len(self._robots)) as advance:
            for first in range(0, len(robot_params), self._at_once):
                some = robot_params[first : first + self._at_once]
                episodes = jax.device_get(self._run_episodes(controller, params, self._keys, some))
                for i in range(len(some)):
                    one = jax.tree.map(lambda x, i=i: x[i], episodes)
                    summaries.append(summarize(one, self._env.dt))
                advance(len(some))
        return dict(zip(self._robots, summaries, strict=True))


def sweep(
    env: JetBotEnv,
    networks: ppo_networks.PPONetworks,
    params: PolicyParams,
    keys: UInt32[Array, "n 2"],
    sweeps: Sequence[Sweep] = SWEEPS,
) -> tuple[SweepResult, ...]:
    """Evaluate one policy over all parameters; use `Sweeper` for several policies.

    Args:
      env: one unwrapped environment with its preset's robot.
      networks: the networks of the policy.
      params: parameters of the policy.
      keys: one reset key for each episode, such as `report_keys(128)`.
      sweeps: the parameters with their values.

    Returns:
      One result for each sweep.
    """
    return Sweeper(env, networks, keys, sweeps).run(params)


class MujocoResult(NamedTuple):
    """A `MujocoResult` holds the metrics of a policy in C MuJoCo, on the goals of the report."""

    numerics: Numerics
    policy: Summary
    """Metrics with the preset's robot."""
    randomized: Summary | None
    """Metrics with a robot sampled for each goal; None without ranges to sample from."""

    def to_json(self) -> dict[str, Any]:
        """Return the numerics and metrics as JSON values."""
        numerics = self.numerics._asdict().items()
        return {
            "numerics": {k: list(v) if isinstance(v, tuple) else v for k, v in numerics},
            "policy": self.policy._asdict(),
            "randomized": self.randomized._asdict() if self.randomized else None,
        }


class MujocoEvaluator:
    """A `MujocoEvaluator` evaluates policies in C MuJoCo."""

    def __init__(
        self,
        env: JetBotEnv,
        networks: ppo_networks.PPONetworks,
        ranges: RandomizationConfig | None = None,
        numerics: Numerics = OTHER_NUMERICS,
    ) -> None:
        """Build the simulator, whose programs compile at their first use.

        Args:
          env: one unwrapped environment with its preset's robot.
          networks: the networks of the policies.
          ranges: ranges from which a robot is sampled for each goal, in addition to the
            evaluation with the preset's robot; None: no sampled robots.
          numerics: numerical settings of C MuJoCo.

        Raises:
          UserError: JAX is configured without a CPU.
        """
        self._numerics, self._dt = numerics, env.dt
        simulator = in_mujoco(env, numerics)
        programs = ProgramCache(compiler_options(env.config))
        self._preset = Evaluator(simulator, networks, programs)
        self._randomized = (
            Evaluator(DomainRandomizationWrapper(simulator, ranges=ranges), networks, programs)
            if ranges is not None and ranges.drawn
            else None
        )

    def run(self, params: PolicyParams, keys: UInt32[Array, "n 2"]) -> MujocoResult:
        """Evaluate a policy.

        Args:
          params: parameters of the policy.
          keys: one reset key for each episode, such as `report_keys(1024)`.
        """
        with default_device_cpu(), stage("in C MuJoCo"):
            return MujocoResult(
                self._numerics,
                summarize(self._preset.run(params, keys), self._dt),
                summarize(self._randomized.run(params, keys), self._dt)
                if self._randomized
                else None,
            )


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


def as_json(results: Sequence[SweepResult]) -> dict[str, Any]:
    """Return the results as JSON values for a report's file.

    Args:
      results: the results of one policy.

    Returns:
      The parameters with their values, metrics and the range over which the policy is robust.
    """
    return {
        "goal_set_version": GOAL_SET_VERSION,
        "carries_at": ROBUST_SUCCESS_RATE,
        "goals": results[0].policy[0].episodes,
        "quantities": [
            {
                **result.sweep._asdict(),
                "nominal": result.sweep.nominal,
                "carries": _as_list(robust_range(result)),
                "lowest": min(summary.success_rate for summary in result.policy),
                "policy": [summary._asdict() for summary in result.policy],
                "scripted": [summary._asdict() for summary in result.scripted],
            }
            for result in results
        ],
    }


def _as_list(span: tuple[float, float] | None) -> list[float] | None:
    return None if span is None else list(span)
