"""Compile the functions of a `Player`: reset, step and move a goal, for all robots and agents."""

import functools
from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8, UInt32

from jetbot_mjx import envs
from jetbot_mjx.agents import Networks, PolicyParams, make_policy
from jetbot_mjx.devices import compiler_options
from jetbot_mjx.evaluation import BASELINES, occlusion_map, policy_controller

_REWARD = "reward/"  # prefix of the reward's terms in a state's metrics

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
    standing: Bool[np.ndarray, " robots"]
    """Robots that make no step, because their episodes have ended."""


class Snapshot(NamedTuple):
    """A `Snapshot` holds what a viewer shows of one step of one robot.

    Its arrays are on the host in `Player.snapshot`. In `Player.crowd` they have one more dimension
    in front, over the robots; likewise in `ViewerFns`, on the device.
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
    rewards: Mapping[str, Float[Array | np.ndarray, ""]]
    """Terms of this step's reward, by name."""
    returns: Mapping[str, Float[Array | np.ndarray, ""]]
    """Their sums over the episode, by name."""


Stepped = tuple[envs.State, Snapshot]
"""States and snapshots of all robots."""


class ViewerFns(NamedTuple):
    """A `ViewerFns` holds compiled functions of all robots, which return states and snapshots."""

    reset: Callable[[UInt32[Array, "robots 2"]], Stepped]
    """Begin an episode of each robot from its random key."""
    restart: Callable[[envs.State, Bool[np.ndarray, " robots"]], Stepped]
    """Begin the next episode of some robots, from the keys that their states carry."""
    step: Callable[[envs.State, Inputs], Stepped]
    """Make one environment step, with the episode statistics of `EpisodeWrapper`."""
    move: Callable[[envs.State, np.int32, Float[np.ndarray, "3"]], Stepped]
    """Move one robot's goal to a position [m], world frame, and restart its time limit."""
    see: Callable[[envs.State, np.int32], UInt8[Array, "h w c"]]
    """Return the newest image of one robot's camera."""
    occlusion: Callable[[envs.State, np.int32, PolicyParams], Float[Array, "h w"]]
    """Return the occlusion map of a policy for what one robot's camera sees."""


def make_viewer_fns(env: envs.JetBotEnv, networks: Networks) -> ViewerFns:
    """Build the functions of a player; each one is compiled at its first use.

    Args:
      env: one environment, unwrapped.
      networks: the networks of the policies.

    Returns:
      The functions; `move` may only be called if `move_goal_error` returns an empty string, `see`
      and `occlusion` only if the environment has a camera.
    """
    episodes = envs.EpisodeWrapper(env.blind(), env.config.task.episode_length)
    episode_env = envs.with_camera(episodes, env.camera)
    controllers = [policy_controller(networks), *(make(env) for make in BASELINES.values())]

    def step_one(state: envs.State, robot: Int[Array, ""], inputs: Inputs) -> envs.State:
        key = jax.random.fold_in(jax.random.fold_in(inputs.key, inputs.count), robot)
        branches = [
            *(lambda act=act: act(inputs.params, state, key) for act in controllers),
            lambda: env.action_of_twist(jnp.asarray(inputs.twist_b)),
        ]
        return episode_env.step(state, jax.lax.switch(inputs.agent, branches))

    def reset(keys: UInt32[Array, "robots 2"]) -> Stepped:
        states = jax.vmap(episode_env.reset)(keys)
        return states, _snapshot(env, states)

    def restart(states: envs.State, restarted: Bool[Array, " robots"]) -> Stepped:
        states = _where(restarted, jax.vmap(episode_env.reset)(states.key), states)
        return states, _snapshot(env, states)

    def step(states: envs.State, inputs: Inputs) -> Stepped:
        robots = jnp.arange(len(inputs.standing))
        stepped = jax.vmap(step_one, in_axes=(0, 0, None))(states, robots, inputs)
        states = _where(jnp.asarray(inputs.standing), states, stepped)
        return states, _snapshot(env, states)

    def move(states: envs.State, robot: Int[Array, ""], position_w: Float[Array, "3"]) -> Stepped:
        moved = jax.vmap(lambda state: _move_goal(env, state, position_w))(states)
        states = _where(jnp.arange(len(states.done)) == robot, moved, states)
        return states, _snapshot(env, states)

    def see_one(states: envs.State, robot: Int[Array, ""]) -> UInt8[Array, "h w c"]:
        assert env.camera is not None
        return states.obs[envs.PIXELS][robot, ..., -env.camera.shape[2] :]

    def occlusion(
        states: envs.State, robot: Int[Array, ""], params: PolicyParams
    ) -> Float[Array, "h w"]:
        obs = jax.tree.map(lambda part: part[robot], states.obs)
        return occlusion_map(make_policy(networks, params), obs)

    compiled = functools.partial(
        jax.jit, compiler_options=compiler_options(env.config.deterministic)
    )
    return ViewerFns(*map(compiled, (reset, restart, step, move, see_one, occlusion)))


def _move_goal(env: envs.JetBotEnv, state: envs.State, position_w: Float[Array, "3"]) -> envs.State:
    """Return the state of a robot whose goal is moved; its episode's time restarts."""
    assert isinstance(env.task, envs.MovesGoal)
    goal = env.task.move_goal(state.goal, position_w)
    obs = env.blind().observe(envs.robot_state(state.pipeline_state), goal)
    info = {**state.info, "steps": jnp.zeros(())}
    seen, state = state.obs, state.replace(goal=goal, obs=obs, info=info, done=jnp.zeros(()))
    if env.camera is None:
        return state
    # The episode goes on, so the images before stay in the stack.
    return envs.see(env.camera, env.task, state, seen[envs.PIXELS], begins=False)


def _snapshot(env: envs.JetBotEnv, states: envs.State) -> Snapshot:
    """Return the snapshot of all robots."""

    def terms(metrics: Mapping[str, Array]) -> dict[str, Array]:
        names = (name for name in metrics if name.startswith(_REWARD))
        return {name.removeprefix(_REWARD): metrics[name] for name in names}

    return Snapshot(
        qpos=states.pipeline_state.qpos,
        markers=jax.vmap(lambda goal: dict(env.task.markers(goal)))(states.goal),
        goal_w=jax.vmap(env.task.goal_position)(states.goal),
        steps=states.info["steps"],
        done=states.done,
        success=states.metrics["success"],
        terminated=states.info["terminated"],
        nonfinite=states.metrics["nonfinite_envs"],
        rewards=terms(states.metrics),
        returns=terms(states.info["episode_metrics"]),
    )


def _where(robots: Bool[Array, " robots"], chosen: envs.State, others: envs.State) -> envs.State:
    """Return the states `chosen` of some robots, and the states `others` of all others."""

    def select(one: Array, other: Array) -> Array:
        return jnp.where(robots.reshape(-1, *[1] * (one.ndim - 1)), one, other)

    return jax.tree.map(select, chosen, others)


def move_goal_error(env: envs.JetBotEnv, state: envs.State) -> str:
    """Check whether the goals of a task can be moved, without moving one.

    Args:
      env: the environment with the task.
      state: any state of one robot.

    Returns:
      The reason why goals cannot be moved, in one line; empty if they can.
    """
    stays = f"the goal stays where it was drawn: {env.config.task.name}"
    if not isinstance(env.task, envs.MovesGoal):
        return f"{stays} has no move_goal"
    try:
        moved = jax.eval_shape(env.task.move_goal, state.goal, jnp.zeros(3))
    # A `move_goal` inherited from a task with another goal may raise anything.
    except Exception:
        moved = None
    if _shapes(moved) != _shapes(state.goal):
        return f"{stays} has a move_goal for another goal than it draws"
    return ""


def _shapes(tree: object) -> object:
    leaves, structure = jax.tree.flatten(tree)
    return structure, [(leaf.shape, leaf.dtype) for leaf in leaves]
