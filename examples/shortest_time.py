"""Find the commands that drive a JetBot to its goal soonest, by gradients through the physics.

`onekernel.mujoco.fuse_mjx` makes the step of the robot, with wheels that roll and slip on the
floor, and its derivative kernels. So thousands of command sequences are improved at once, by Adam,
from random starts: the time outside of the goal falls along the gradient through all physics steps.
A smooth edge of the goal, which becomes sharper, tells the gradient where the goal is. A second
round starts around the best sequences of each goal.

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

_EDGES = (0.3, 0.01), (0.1, 0.003)
"""Width of the goal's edge in the first and in the last iteration of each round [m]."""

_PARENTS = 8
"""Sequences of a goal around which a round starts."""

_NOISE = 0.2
"""Standard deviation of the noise of each action of such a start."""

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
    edges: Float[Array, " iterations"],
) -> tuple[Float[Array, "n t 2"], Float[Array, " n"]]:
    """Improve command sequences by gradients.

    Args:
      env: the environment.
      starts: the sequences to begin with.
      goals: their goals [m].
      edges: the width of the goal's edge in each step of Adam [m].

    Returns:
      Each sequence as it was in the iteration in which it took the fewest steps to its goal, and
      this number; inf where it never got there. Of equal numbers, that one is less after which the
      robot is farther inside the goal.
    """
    physics, radius = env.config.physics, env.config.task.success_radius
    sharp = jnp.asarray(_EDGES[-1][-1])
    step = fuse_mjx(env.mj_model, physics.n_substeps)
    adam = optax.adam(optax.cosine_decay_schedule(_RATE, len(edges)))

    def loss(actions: Actions, goal: Array, edge: Array) -> tuple[Array, Array]:
        away = distances(env, step, actions, goal)
        there = away < radius
        count = jnp.where(there.any(), jnp.argmax(there) + 1.0, jnp.inf)
        return steps_outside(away, radius, edge), count + 0.01 * steps_outside(away, radius, sharp)

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
    _, _, best, fewest = jax.lax.scan(iteration, first, edges)[0]
    return best, fewest


def around_the_best(
    key: Array, found: Float[Array, "n t 2"], steps: Float[Array, " n"], goals: int
) -> Float[Array, "n t 2"]:
    """Return starts around the best sequences of each goal: these themselves, and with noise.

    Args:
      key: the random key.
      found: the sequences of all goals, as many for each.
      steps: how many steps they took.
      goals: the number of goals.
    """
    starts = len(found) // goals
    parents = min(_PARENTS, starts)
    best = jnp.argsort(steps.reshape(goals, starts), axis=1)[:, :parents]
    # Each parent in turn, until there are as many as before.
    chosen = jnp.take_along_axis(best, jnp.arange(starts)[None] % parents, axis=1)
    chosen = (chosen + starts * jnp.arange(goals)[:, None]).ravel()
    noise = _NOISE * jax.random.normal(key, found.shape)
    is_parent = jnp.tile(jnp.arange(starts) < parents, goals)
    noise = jnp.where(is_parent[:, None, None], 0.0, noise)
    return jnp.clip(found[chosen] + noise, -1.0, 1.0)


def search(
    env: JetBotEnv, goals: Float[Array, "goals 2"], starts: int, steps: int, iterations: int
) -> Float[Array, "n t 2"]:
    """Improve random sequences in two rounds, and print how long that takes.

    Args:
      env: the environment.
      goals: the goals [m].
      starts: the number of sequences for each goal.
      steps: the number of actions of a sequence.
      iterations: the number of steps of Adam in each round.

    Returns:
      The sequences of all goals.
    """
    # All sequences of all goals along one axis.
    count = len(goals) * starts
    key, of_noise = jax.random.split(jax.random.key(0))
    sequences = jax.vmap(lambda key: draw(key, steps, env.dt))(jax.random.split(key, count))
    of_sequences = jnp.repeat(goals, starts, axis=0)
    begin = time.perf_counter()
    run = jax.jit(functools.partial(improve, env))
    edges = [jnp.geomspace(*ends, iterations) for ends in _EDGES]
    compiled = run.lower(sequences, of_sequences, edges[0]).compile()
    print(f"compiled in {time.perf_counter() - begin:.1f} s")
    begin = time.perf_counter()
    best, took = compiled(sequences, of_sequences, edges[0])
    sequences = around_the_best(of_noise, best, took, len(goals))
    best, _ = jax.block_until_ready(compiled(sequences, of_sequences, edges[1]))
    seconds = time.perf_counter() - begin
    gradients = len(edges) * iterations
    print(
        f"{count:,} sequences of {steps} steps, {gradients} gradients of each in {seconds:.2f} s,"
        f" {1e3 * seconds / gradients:.0f} ms for the gradients of all"
    )
    if analysis := compiled.memory_analysis():
        print(f"memory: {analysis.temp_size_in_bytes / 1e9:.2f} GB beside the results")
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
    parser.add_argument(
        "--iterations", type=cli.positive_int, default=100, help="of each round, default: 100"
    )
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
    best = search(env, goals, starts, steps, options.iterations)
    # The environment says which sequence is the best of a goal.
    episodes = driven(env, best, jnp.repeat(keys, starts, axis=0))
    took = np.where(episodes.success > 0, episodes.steps, np.inf).reshape(options.goals, starts)
    place = took.argmin(axis=1) + np.arange(options.goals) * starts
    found = took.min(axis=1)
    chosen = jax.tree.map(lambda x: x[place], episodes)
    known, bound = (find(kind, env.config, chosen) for kind in ("search", "bound"))
    if isinstance(known, str) or isinstance(bound, str):
        raise UserError(str(known if isinstance(known, str) else bound))
    ratio = found / known
    print(
        f"{(ratio <= 1.01).sum()} of {options.goals} goals within 1 % of the best known time,"
        f" {(ratio < 1).sum()} sooner; reached: {np.isfinite(found).sum()}, median"
        f" {np.median(ratio) - 1:+.2%}, worst {ratio.max() - 1:+.2%}"
    )
    print(
        f"{(found == bound).sum()} as soon as physics allows at all, {(found < bound).sum()} sooner"
        " (which would prove the bound wrong)"
    )
    return 0


if __name__ == "__main__":
    cli.run_command(main)
