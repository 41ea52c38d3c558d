"""Find the commands that drive a JetBot to its goal soonest, by gradients through the physics.

`onekernel.mujoco.fuse_mjx` makes the step of the robot, with wheels that roll and slip on the
floor, and its derivative kernels. So thousands of command sequences are improved at once, by Adam,
from random starts: the mean time outside of the goal falls along the gradient through all physics
steps. A smooth edge of the goal, which becomes sharper, tells the gradient where the goal is.

All sequences are driven once more in the environment, as in the report, and the best time to each
goal is compared with the best known one of `benchmarks/learning/best_known.py`, which searches
without gradients.

    python examples/shortest_time.py
"""

import argparse
import functools
import time
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from jetbot_mjx import cli
from jetbot_mjx.config import load_config
from jetbot_mjx.envs import State, make_jetbot_env
from jetbot_mjx.envs.jetbot_env import JetBotEnv
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation.best_known import find
from jetbot_mjx.evaluation.evaluator import report_keys
from jetbot_mjx.evaluation.rollout import Episodes, rollout_fn
from onekernel.mujoco import FusedMjx, fuse_mjx

_LONGEST_TURN = 1.0  # [s] of a start

_FIRST_EDGE, _LAST_EDGE = 0.3, 0.01
"""Width of the goal's edge in the first and in the last iteration [m]."""

_RATE = 0.03
"""Learning rate of the first iteration."""

Actions = Float[Array, "t 2"]
"""A sequence of actions in [-1, 1], one for each environment step."""


def draw(key: Array, steps: int, dt: float) -> Actions:
    """Draw the actions of a start: a turn of random length and speed, and then straight ahead.

    Args:
      key: the random key.
      steps: the number of actions.
      dt: the duration of an environment step [s].
    """
    of_turn, of_sign, of_speed, of_way = jax.random.split(key, 4)
    turns = jnp.arange(steps) * dt < jax.random.uniform(of_turn, maxval=_LONGEST_TURN)
    turn = jnp.stack(
        [jax.random.uniform(of_speed, minval=-1.0), jax.random.rademacher(of_sign, (), float)]
    )
    way = jnp.stack([jnp.ones(()), jax.random.uniform(of_way, minval=-0.2, maxval=0.2)])
    return jnp.where(turns[:, None], turn, way)


def distances(
    env: JetBotEnv, step: FusedMjx, actions: Actions, goal: Float[Array, "2"]
) -> Float[Array, " t"]:
    """Return how far the robot is from the goal after each environment step [m]."""

    def after(state, action: Float[Array, "2"]):  # noqa: ANN001, ANN202
        state = step(state, env.drive.controls(env.wheel_targets(action)))
        away = state.qpos[:2] - goal
        return state, jnp.sqrt((away**2).sum() + 1e-12)

    return jax.lax.scan(after, step.init(), actions)[1]


def steps_outside(
    away: Float[Array, " t"], radius: float, edge: Float[Array, ""]
) -> Float[Array, ""]:
    """Return the number of steps until the robot is at the goal, for a goal with a smooth edge.

    Args:
      away: the distances [m].
      radius: the goal's [m].
      edge: the width of its edge [m].
    """
    is_outside = jax.nn.sigmoid((away - radius) / edge)
    return jnp.cumprod(is_outside).sum()


def improve(
    env: JetBotEnv,
    starts: Float[Array, "n t 2"],
    goals: Float[Array, "n 2"],
    iterations: int,
) -> Float[Array, "n t 2"]:
    """Improve command sequences by gradients.

    Args:
      env: the environment.
      starts: the sequences to begin with.
      goals: their goals [m].
      iterations: the number of steps of Adam.

    Returns:
      Each sequence as it was in the iteration in which it took the fewest steps to its goal.
    """
    physics, task = env.config.physics, env.config.task
    step = fuse_mjx(env.mj_model, physics.n_substeps)
    edges = jnp.geomspace(_FIRST_EDGE, _LAST_EDGE, iterations)
    adam = optax.adam(optax.cosine_decay_schedule(_RATE, iterations))

    def loss(actions: Actions, goal: Array, edge: Array) -> tuple[Array, Array]:
        away = distances(env, step, actions, goal)
        there = away < task.success_radius
        count = jnp.where(there.any(), jnp.argmax(there) + 1.0, jnp.inf)
        return steps_outside(away, task.success_radius, edge), count

    gradient = jax.vmap(jax.grad(loss, has_aux=True), (0, 0, None))

    def iteration(carry: tuple, edge: Array) -> tuple[tuple, None]:
        actions, state, best, fewest = carry
        slope, counts = gradient(actions, goals, edge)
        is_better = counts < fewest
        best = jnp.where(is_better[:, None, None], actions, best)
        fewest = jnp.minimum(counts, fewest)
        updates, state = adam.update(slope, state)
        return (jnp.clip(actions + updates, -1.0, 1.0), state, best, fewest), None

    first = starts, adam.init(starts), starts, jnp.full(len(starts), jnp.inf)
    _, _, best, _ = jax.lax.scan(iteration, first, edges)[0]
    return best


def play(actions: Actions, state: State, key: Array) -> Float[Array, "2"]:
    """Return the action of a sequence at the current step; a controller for rollouts."""
    del key
    return actions[jnp.minimum(state.info["steps"].astype(int), len(actions) - 1)]


def driven(env: JetBotEnv, actions: Float[Array, "goals t 2"], keys: Array) -> Episodes:
    """Drive the environment itself by one sequence for each reset key."""
    run = rollout_fn(env, [play], actions.shape[1])
    episodes = jax.jit(jax.vmap(lambda actions, key: run(0, actions, key[None])))(actions, keys)
    return jax.device_get(jax.tree.map(lambda x: x[:, 0], episodes))


def main(arguments: Sequence[str] | None = None) -> int:
    """Search all goals, and print times beside the best known ones.

    Args:
      arguments: Arguments without the program's name; None: those of the process.

    Returns:
      The exit code.
    """
    parser = cli.Parser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--goals", type=cli.positive_int, default=64, help="default: 64")
    parser.add_argument("--starts", type=cli.positive_int, help="for a goal (default: 256, CPU: 8)")
    parser.add_argument("--iterations", type=cli.positive_int, default=100, help="default: 100")
    parser.add_argument("--seconds", type=float, default=4.0, help="of a sequence, default: 4")
    options = parser.parse_args(arguments)
    env = make_jetbot_env(load_config("jetbot"))
    if not 2 * env.dt <= options.seconds <= 60:
        raise UserError(
            f"--seconds {options.seconds:g}: name a duration from {2 * env.dt:.2f} to 60"
        )
    starts = options.starts or (8 if jax.default_backend() == "cpu" else 256)
    keys, steps = report_keys(options.goals), round(options.seconds / env.dt)
    goals = jax.vmap(lambda key: env.reset(key).goal[:2])(keys)
    # All sequences of all goals along one axis.
    seeds = jax.random.split(jax.random.key(0), options.goals * starts)
    sequences = jax.vmap(lambda key: draw(key, steps, env.dt))(seeds)
    arrays = sequences, jnp.repeat(goals, starts, axis=0)
    begin = time.perf_counter()
    run = jax.jit(functools.partial(improve, env, iterations=options.iterations))
    compiled = run.lower(*arrays).compile()
    print(f"compiled in {time.perf_counter() - begin:.1f} s")
    begin = time.perf_counter()
    best = jax.block_until_ready(compiled(*arrays))
    seconds = time.perf_counter() - begin
    print(
        f"{len(seeds):,} sequences of {steps} steps, {options.iterations} gradients of each in"
        f" {seconds:.2f} s, {1e3 * seconds / options.iterations:.0f} ms for the gradients of all"
    )
    if analysis := compiled.memory_analysis():
        print(f"memory: {analysis.temp_size_in_bytes / 1e9:.2f} GB beside the results")
    # The environment says which sequence is the best of a goal.
    episodes = driven(env, best, jnp.repeat(keys, starts, axis=0))
    took = np.where(episodes.success > 0, episodes.steps, np.inf).reshape(options.goals, starts)
    place = took.argmin(axis=1) + np.arange(options.goals) * starts
    found = took.min(axis=1)
    known = find("search", env.config, jax.tree.map(lambda x: x[place], episodes))
    if isinstance(known, str):
        raise UserError(known)
    ratio = found / known
    print(
        f"{(ratio <= 1.01).sum()} of {options.goals} goals within 1 % of the best known time,"
        f" {(ratio < 1).sum()} sooner; reached: {np.isfinite(found).sum()}, median"
        f" {np.median(ratio) - 1:+.2%}, worst {ratio.max() - 1:+.2%}"
    )
    return 0


if __name__ == "__main__":
    cli.run_command(main)
