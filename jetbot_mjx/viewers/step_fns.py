"""One robot, one step at a time: the programs behind a player, compiled once for all agents."""

import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from brax.training.agents.ppo import networks as ppo_networks
from jaxtyping import Array, Float, Int, UInt32

from jetbot_mjx.agents.networks import PolicyParams
from jetbot_mjx.compiler.xla_options import compiler_options
from jetbot_mjx.envs import kinematics
from jetbot_mjx.envs.jetbot_env import JetBotEnv
from jetbot_mjx.envs.state import State, robot_state
from jetbot_mjx.envs.task import MovesGoal
from jetbot_mjx.envs.wrappers import EpisodeWrapper
from jetbot_mjx.evaluation.evaluator import BASELINES, policy_controller

KEYBOARD = "keyboard"
AGENTS = ("policy", *BASELINES, KEYBOARD)
"""Who can drive: the run's policy, the baselines it is judged against, and the user."""


class Inputs(NamedTuple):
    """All that decides an action beside the state."""

    agent: Int[np.ndarray, ""] | np.int32
    """Index in `AGENTS`."""
    params: PolicyParams
    """Of the checkpoint that drives; an argument, so that all of a run share one program."""
    twist_b: Float[np.ndarray, "2"]
    """What the user asks for: forward speed [m/s] and yaw rate [rad/s]."""
    key: UInt32[Array, "2"]
    """Of the random agent."""
    count: np.uint32
    """Of the step, folded into the key."""


class Shown(NamedTuple):
    """One moment as a viewer needs it; on the host once it has been fetched."""

    qpos: Float[Array | np.ndarray, " nq"]
    """The robot's pose, as `PhysicsState` has it."""
    markers: Mapping[str, Float[Array | np.ndarray, "3"]]
    """Where the scene's mocap bodies stand [m], by name."""
    goal_w: Float[Array | np.ndarray, "3"]
    """Where the robot has to go [m], world frame."""
    steps: Float[Array | np.ndarray, ""]
    """Environment steps since the episode began, or its goal was moved."""
    done: Float[Array | np.ndarray, ""]
    """1 where this step ended the episode; the next three say how."""
    success: Float[Array | np.ndarray, ""]
    terminated: Float[Array | np.ndarray, ""]
    nonfinite: Float[Array | np.ndarray, ""]


class ViewerFns(NamedTuple):
    """Three compiled functions; each returns the state and what to show of it."""

    reset: Callable[[UInt32[Array, "2"]], tuple[State, Shown]]
    """Begins an episode from a key."""
    step: Callable[[State, Inputs], tuple[State, Shown]]
    """One control step, with the episode's books of `EpisodeWrapper`."""
    move: Callable[[State, Float[np.ndarray, "3"]], tuple[State, Shown]]
    """Puts the goal elsewhere [m], world frame, and lets the time limit begin anew."""


def make_programs(env: JetBotEnv, networks: ppo_networks.PPONetworks) -> ViewerFns:
    """Prepare the programs; each compiles at its first use.

    Args:
      env: one environment, unwrapped.
      networks: of the policies that will drive.

    Returns:
      The programs; `move` is of use only where `why_goals_stay` finds no reason.
    """
    episode_env = EpisodeWrapper(env, env.config.task.episode_length)
    controllers = [policy_controller(networks), *(make(env) for make in BASELINES.values())]
    limits = {
        "max_speed": env.config.task.max_speed,
        "max_yaw_rate": env.config.task.max_yaw_rate,
    }

    def show(state: State) -> Shown:
        return Shown(
            qpos=state.pipeline_state.qpos,
            markers=dict(env.task.markers(state.goal)),
            goal_w=env.task.goal_position(state.goal),
            steps=state.info["steps"],
            done=state.done,
            success=state.metrics["success"],
            terminated=state.info["terminated"],
            nonfinite=state.metrics["nonfinite_envs"],
        )

    def reset(key: UInt32[Array, "2"]) -> tuple[State, Shown]:
        state = episode_env.reset(key)
        return state, show(state)

    def step(state: State, inputs: Inputs) -> tuple[State, Shown]:
        key = jax.random.fold_in(inputs.key, inputs.count)
        branches = [
            *(lambda act=act: act(inputs.params, state, key) for act in controllers),
            lambda: kinematics.action_from_twist(jnp.asarray(inputs.twist_b), **limits),
        ]
        state = episode_env.step(state, jax.lax.switch(inputs.agent, branches))
        return state, show(state)

    def move(state: State, position_w: Float[Array, "3"]) -> tuple[State, Shown]:
        assert isinstance(env.task, MovesGoal)
        goal = env.task.move_goal(state.goal, position_w)
        obs = env.task.observe(robot_state(state.pipeline_state), goal)
        info = {**state.info, "steps": jnp.zeros(())}
        state = state.replace(goal=goal, obs=obs, info=info, done=jnp.zeros(()))
        return state, show(state)

    compiled = functools.partial(jax.jit, compiler_options=compiler_options(env.config))
    return ViewerFns(compiled(reset), compiled(step), compiled(move))


def why_goals_stay(env: JetBotEnv, state: State) -> str:
    """Look whether a task's goals can be moved, without moving one.

    Args:
      env: with the task.
      state: any state of it.

    Returns:
      Why not, in one line; empty where they can.
    """
    stays = f"the goal stays where it was drawn: {env.config.task.name}"
    if not isinstance(env.task, MovesGoal):
        return f"{stays} has no move_goal"
    try:
        moved = jax.eval_shape(env.task.move_goal, state.goal, jnp.zeros(3))
    # One that was inherited from a task with another goal may fail in any way.
    except Exception:
        moved = None
    if _shapes(moved) != _shapes(state.goal):
        return f"{stays} has a move_goal for another goal than it draws"
    return ""


def _shapes(tree: Any) -> Any:
    leaves, structure = jax.tree.flatten(tree)
    return structure, [(leaf.shape, leaf.dtype) for leaf in leaves]
