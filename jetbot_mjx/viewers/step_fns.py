"""Compile the functions of a `Player`: reset, step and move the goal, once for all agents."""

import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt32

from jetbot_mjx.agents.networks import Networks, PolicyParams
from jetbot_mjx.compiler.xla_options import compiler_options
from jetbot_mjx.envs import kinematics
from jetbot_mjx.envs.camera.wrapper import see, with_camera
from jetbot_mjx.envs.jetbot_env import JetBotEnv
from jetbot_mjx.envs.state import State, robot_state
from jetbot_mjx.envs.task import MovesGoal
from jetbot_mjx.envs.wrappers import EpisodeWrapper
from jetbot_mjx.evaluation.evaluator import BASELINES, policy_controller

KEYBOARD = "keyboard"
AGENTS = ("policy", *BASELINES, KEYBOARD)
"""Agents that can drive: the run's policy, the baselines of an evaluation, and the user."""


class Inputs(NamedTuple):
    """An `Inputs` holds everything that determines an action, except for the state."""

    agent: Int[np.ndarray, ""] | np.int32
    """Index of the agent in `AGENTS`."""
    params: PolicyParams
    """Parameters of the policy; an argument, so that all checkpoints of a run share one program."""
    twist_b: Float[np.ndarray, "2"]
    """Command of the user: forward speed [m/s] and yaw rate [rad/s]."""
    key: UInt32[Array, "2"]
    """Random key of the random agent."""
    count: np.uint32
    """Number of the step, which is folded into the key."""


class Snapshot(NamedTuple):
    """A `Snapshot` holds what a viewer shows of one step.

    Its arrays are on the device in `ViewerFns` and on the host in `Player.snapshot`.
    """

    qpos: Float[Array | np.ndarray, " nq"]
    """Generalised position of the robot, as in `PhysicsState`."""
    markers: Mapping[str, Float[Array | np.ndarray, "3"]]
    """Positions of the scene's mocap bodies [m], world frame, by name."""
    goal_w: Float[Array | np.ndarray, "3"]
    """Position of the goal [m], world frame."""
    steps: Float[Array | np.ndarray, ""]
    """Environment steps since the episode began, or its goal was moved."""
    done: Float[Array | np.ndarray, ""]
    """1 where this step ended the episode."""
    success: Float[Array | np.ndarray, ""]
    """1 where the robot has solved the task."""
    terminated: Float[Array | np.ndarray, ""]
    """1 where the task ended the episode."""
    nonfinite: Float[Array | np.ndarray, ""]
    """1 where this step was not finite."""


class ViewerFns(NamedTuple):
    """A `ViewerFns` holds three compiled functions, which return a state and its snapshot."""

    reset: Callable[[UInt32[Array, "2"]], tuple[State, Snapshot]]
    """Begin an episode from a random key."""
    step: Callable[[State, Inputs], tuple[State, Snapshot]]
    """Make one environment step, with the episode statistics of `EpisodeWrapper`."""
    move: Callable[[State, Float[np.ndarray, "3"]], tuple[State, Snapshot]]
    """Move the goal to a position [m], world frame, and restart the time limit."""


def make_viewer_fns(env: JetBotEnv, networks: Networks) -> ViewerFns:
    """Build the functions of a player; each one is compiled at its first use.

    Args:
      env: one environment, unwrapped.
      networks: the networks of the policies.

    Returns:
      The functions; `move` may only be called if `move_goal_error` returns an empty string.
    """
    episodes = EpisodeWrapper(env.blind(), env.config.task.episode_length)
    episode_env = with_camera(episodes, env.camera)
    controllers = [policy_controller(networks), *(make(env) for make in BASELINES.values())]
    limits = {"max_speed": env.config.task.max_speed, "max_yaw_rate": env.config.task.max_yaw_rate}

    def snapshot(state: State) -> Snapshot:
        return Snapshot(
            qpos=state.pipeline_state.qpos,
            markers=dict(env.task.markers(state.goal)),
            goal_w=env.task.goal_position(state.goal),
            steps=state.info["steps"],
            done=state.done,
            success=state.metrics["success"],
            terminated=state.info["terminated"],
            nonfinite=state.metrics["nonfinite_envs"],
        )

    def reset(key: UInt32[Array, "2"]) -> tuple[State, Snapshot]:
        state = episode_env.reset(key)
        return state, snapshot(state)

    def step(state: State, inputs: Inputs) -> tuple[State, Snapshot]:
        key = jax.random.fold_in(inputs.key, inputs.count)
        branches = [
            *(lambda act=act: act(inputs.params, state, key) for act in controllers),
            lambda: kinematics.action_from_twist(jnp.asarray(inputs.twist_b), **limits),
        ]
        state = episode_env.step(state, jax.lax.switch(inputs.agent, branches))
        return state, snapshot(state)

    def move(state: State, position_w: Float[Array, "3"]) -> tuple[State, Snapshot]:
        assert isinstance(env.task, MovesGoal)
        goal = env.task.move_goal(state.goal, position_w)
        obs = env.blind().observe(robot_state(state.pipeline_state), goal)
        info = {**state.info, "steps": jnp.zeros(())}
        state = state.replace(goal=goal, obs=obs, info=info, done=jnp.zeros(()))
        if env.camera is not None:
            state = see(env.camera, env.task, state)
        return state, snapshot(state)

    compiled = functools.partial(jax.jit, compiler_options=compiler_options(env.config))
    return ViewerFns(compiled(reset), compiled(step), compiled(move))


def move_goal_error(env: JetBotEnv, state: State) -> str:
    """Check whether the goals of a task can be moved, without moving one.

    Args:
      env: the environment with the task.
      state: any state of the environment.

    Returns:
      The reason why goals cannot be moved, in one line; empty if they can.
    """
    stays = f"the goal stays where it was drawn: {env.config.task.name}"
    if not isinstance(env.task, MovesGoal):
        return f"{stays} has no move_goal"
    try:
        moved = jax.eval_shape(env.task.move_goal, state.goal, jnp.zeros(3))
    # A `move_goal` inherited from a task with another goal may raise anything.
    except Exception:
        moved = None
    if _shapes(moved) != _shapes(state.goal):
        return f"{stays} has a move_goal for another goal than it draws"
    return ""


def _shapes(tree: Any) -> Any:
    leaves, structure = jax.tree.flatten(tree)
    return structure, [(leaf.shape, leaf.dtype) for leaf in leaves]
