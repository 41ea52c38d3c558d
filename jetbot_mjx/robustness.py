"""How far a policy carries: judged on robots that differ from the one it was trained on.

One quantity at a time leaves the preset's value; goals, rules and figures are those of the
report. One compiled program serves all robots, and beside the policy the scripted controller.

Sources, by tag; BOM and EST as in `model.py`:
  CSE276A     gassajor000/cse276a_jetbot: a JetBot's motors, calibrated.
  DUCKIETOWN  gym-duckietown: the simulator of a robot with the same motors.
  ISAACRL     KhaledSharif/isaac-sim-jetbot-rl: how that randomises Isaac's JetBot.
  PICOBOT     uni-obuda picobot: a robot with the same motors, identified.
  WHEELEDLAB  WheeledLab: how that randomises a drifting car.
"""

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from brax.training.agents.ppo import networks as ppo_networks
from jaxtyping import Array, Int, UInt32

from jetbot_mjx.compiling import compiler_options
from jetbot_mjx.env import JetBotEnv
from jetbot_mjx.evaluation import (
    BASELINES,
    GOAL_SET_VERSION,
    Summary,
    policy_controller,
    summarize,
)
from jetbot_mjx.policy import PolicyParams
from jetbot_mjx.rollout import Episodes, rollout_fn
from jetbot_mjx.variation import Variation, VariedEnv

SWEEP_GOALS = 128
"""How many of the report's fixed goals a sweep takes for each robot."""

CARRIES_AT = 0.95
"""Success rate down to which a policy is said to carry."""

# On a slippery floor the presets' two or three iterations are wrong by decimetres after 4 s;
# these follow the converged solver to a millimetre (median of 16 robots at μ = 0.3). SIM.
_ITERATIONS, _LS_ITERATIONS = 6, 4


class Sweep(NamedTuple):
    """One quantity, and the values at which a policy is judged."""

    name: str
    """Field of `Variation`."""
    label: str
    unit: str
    values: tuple[float, ...]
    """Rising; the preset's among them."""
    source: str
    """What the range rests on."""

    @property
    def nominal(self) -> float:
        """The preset's value."""
        return getattr(Variation(), self.name)


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
        "motor_gain",
        "motor gain",
        "× preset",
        (0.85, 0.9, 0.95, 1.0, 1.05, 1.1, 1.15),
        "BOM 9.6 to 12.6 V of three cells; ISAACRL ±10 %",
    ),
    Sweep(
        "wheel_radius_mismatch",
        "unequal wheels",
        "(left - right) / mean",
        (-0.1, -0.05, -0.02, 0.0, 0.02, 0.05, 0.1),
        "EST radius ±2 %; CSE276A motors 3 % apart; DUCKIETOWN deviation 2 %, to 5 % EST",
    ),
    Sweep(
        "action_delay",
        "delay of actions",
        "control steps",
        (0.0, 1.0, 2.0, 3.0, 6.0, 9.0),
        "ISAACRL 0 to 3 steps; DUCKIETOWN 0.15 s",
    ),
    Sweep(
        "motor_lag",
        "further lag of the motors",
        "s",
        (0.0, 0.05, 0.1, 0.15, 0.2, 0.25),
        "PICOBOT 0.085 s, DUCKIETOWN 0.20 to 0.25 s, motors and all",
    ),
)


class SweepResult(NamedTuple):
    """A policy, and the scripted controller beside it, over one quantity."""

    sweep: Sweep
    policy: tuple[Summary, ...]
    """One for each value."""
    scripted: tuple[Summary, ...]


def sweep(
    env: JetBotEnv,
    networks: ppo_networks.PPONetworks,
    params: PolicyParams,
    keys: UInt32[Array, "n 2"],
    sweeps: Sequence[Sweep] = SWEEPS,
) -> tuple[SweepResult, ...]:
    """Judges a policy at every value of every quantity, on the same goals.

    Args:
      env: one environment, unwrapped, with its preset's robot.
      networks: of the policy.
      params: the policy's.
      keys: one reset key an episode, such as `report_keys(128)`.
      sweeps: the quantities.

    Returns:
      One result for each quantity.
    """
    env = _with_enough_iterations(env)
    controllers = [policy_controller(networks), BASELINES["scripted"](env)]
    length = env.config.task.episode_length

    def drive(
        index: int | Int[Array, ""],
        params: PolicyParams,
        keys: UInt32[Array, "n 2"],
        variation: Variation,
    ) -> Episodes:
        return rollout_fn(VariedEnv(env, variation), controllers, length)(index, params, keys)

    # Robots one after the other: the solver iterates until the last of a batch is done, and
    # those that slide would hold up the rest.
    drive = jax.jit(drive, compiler_options=compiler_options(env.config))
    host = jax.device_get(params)

    @functools.cache  # the preset's robot occurs in every sweep, and drives once
    def judged(robot: Variation, controller: int) -> Summary:
        variation = jax.tree.map(jnp.float32, robot)
        return summarize(drive(controller, host, keys, variation), env.dt)

    results = []
    for one in sweeps:
        robots = [Variation()._replace(**{one.name: value}) for value in one.values]
        policy, scripted = (tuple(judged(robot, i) for robot in robots) for i in range(2))
        results.append(SweepResult(one, policy, scripted))
    return tuple(results)


def _with_enough_iterations(env: JetBotEnv) -> JetBotEnv:
    option = env.mjx_model.opt
    option = option.replace(
        iterations=max(option.iterations, _ITERATIONS),
        ls_iterations=max(option.ls_iterations, _LS_ITERATIONS),
    )
    return env.with_model(env.mjx_model.replace(opt=option))


def carries(result: SweepResult) -> tuple[float, float] | None:
    """How far from the preset's value the policy's success stays at `CARRIES_AT` or above.

    Args:
      result: over one quantity.

    Returns:
      Lowest and highest judged value, without a gap from the preset's on; None where the
      policy fails at the preset's already.
    """
    values = result.sweep.values
    good = [summary.success_rate >= CARRIES_AT for summary in result.policy]
    low = high = values.index(result.sweep.nominal)
    if not good[low]:
        return None
    while low > 0 and good[low - 1]:
        low -= 1
    while high < len(values) - 1 and good[high + 1]:
        high += 1
    return values[low], values[high]


def as_json(results: Sequence[SweepResult]) -> dict[str, Any]:
    """The results as plain values, for a report's file.

    Args:
      results: of one policy.

    Returns:
      The quantities with their values, figures and the range over which the policy carries.
    """
    return {
        "goal_set_version": GOAL_SET_VERSION,
        "carries_at": CARRIES_AT,
        "goals": results[0].policy[0].episodes,
        "quantities": [
            {
                **result.sweep._asdict(),
                "nominal": result.sweep.nominal,
                "carries": _as_list(carries(result)),
                "lowest": min(summary.success_rate for summary in result.policy),
                "policy": [summary._asdict() for summary in result.policy],
                "scripted": [summary._asdict() for summary in result.scripted],
            }
            for result in results
        ],
    }


def _as_list(span: tuple[float, float] | None) -> list[float] | None:
    return None if span is None else list(span)
