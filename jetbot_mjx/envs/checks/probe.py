"""Call the methods of a task for ordinary and extreme robots, and describe its errors."""

import functools
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from jetbot_mjx.config import Config
from jetbot_mjx.envs.checks.errors import PACKAGE, describe_error
from jetbot_mjx.envs.task import METHODS, AdvancesGoal, Goal, RobotState, Task

DRAWS = 256
"""Number of goals, and of robots of each kind."""

TERMS = "the terms of reward"
"""Key of the reward terms among the results of `call_methods`."""

Call = tuple[Callable[..., PyTree], *tuple[PyTree, ...]]
"""A method and its arguments."""

_AXLE_HEIGHT = 0.0325  # [m]


def changed_leaf(first: object, last: object) -> str:
    """Return the first leaf whose shape or dtype differs between two states, and how.

    The text is empty if none differs.
    """
    sides = [dict(jax.tree_util.tree_leaves_with_path(state)) for state in (first, last)]
    for path in (*sides[0], *sides[1]):
        one, other = (_type(side.get(path)) for side in sides)
        if one != other:
            return f"{jax.tree_util.keystr(path).lstrip('.')} from {one} to {other}"
    return ""


def _type(leaf: jax.ShapeDtypeStruct | None) -> str:
    if leaf is None:
        return "nothing"
    return f"{'weak ' * leaf.weak_type}{leaf.dtype}{list(leaf.shape)}"


# Inputs and results of the methods.


class Transition(NamedTuple):
    """A `Transition` holds one step of one robot, or a batch of steps."""

    before: RobotState
    """Robot state before the step."""
    after: RobotState
    """Robot state after the step."""
    goal: Goal
    """Goal of the episode."""
    action: jax.Array
    """Action of the step."""


class TaskProbe:
    """A `TaskProbe` calls a task for ordinary and extreme robots, and caches the results."""

    def __init__(self, task: Task, config: Config) -> None:
        """Hold a task; its methods are called at the first use of a property.

        Args:
          task: the task.
          config: the configuration that it was built from.
        """
        self.task, self.config = task, config

    def explain(self, error: Exception) -> str:
        """Describe an exception of the task in one line.

        Args:
          error: the exception.
        """
        inside = (
            frame.f_code.co_name
            for frame, _ in traceback.walk_tb(error.__traceback__)
            if isinstance(frame.f_locals.get("self"), type(self.task))
            and frame.f_code.co_name in (*METHODS, "advance", "move_goal")
        )
        files = [
            getattr(sys.modules.get(one.__module__), "__file__", None)
            for one in type(self.task).__mro__
            if one.__module__ not in sys.stdlib_module_names
        ]
        folders = {Path(file).parent for file in files if file}
        return describe_error(
            error, next(inside, "the task"), list(folders - {PACKAGE} or {PACKAGE})
        )

    @functools.cached_property
    def goals(self) -> Goal:
        """Return the goals of `DRAWS` episodes, as a batch."""
        return jax.jit(jax.vmap(self.task.sample))(jax.random.split(first_key(), DRAWS))

    @functools.cached_property
    def example(self) -> Transition:
        """Return one transition in which the robot stands still."""
        quat = jnp.array([1.0, 0.0, 0.0, 0.0])
        robot = RobotState(jnp.array([0.1, 0.2, _AXLE_HEIGHT]), quat, *jnp.zeros((2, 3)))
        return Transition(
            robot, robot, self.task.sample(first_key()), jnp.zeros(self.config.robot.action_size)
        )

    @functools.cached_property
    def transitions(self) -> dict[str, Transition]:
        """Return batches of `DRAWS` transitions, by a description of the robot."""
        random = np.random.default_rng(0)

        def normal(scale: float, size: int = 3) -> jax.Array:
            return jnp.asarray(scale * random.standard_normal((DRAWS, size)), jnp.float32)

        def robots(position: jax.Array, quat: jax.Array, speed: float = 0.0) -> RobotState:
            quat = quat / jnp.linalg.norm(quat, axis=1, keepdims=True)
            return RobotState(position, quat, normal(speed), normal(4 * speed))

        def on_floor(position: jax.Array) -> jax.Array:
            return position.at[:, 2].set(_AXLE_HEIGHT)

        # The order of the draws is part of the fixed test data.
        ahead = jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (DRAWS, 1))
        level = normal(1.0, 4) * jnp.array([1.0, 0.0, 0.0, 1.0])
        goal_w = jax.vmap(self.task.goal_position)(self.goals)
        start = robots(jnp.tile(jnp.array([0.0, 0.0, _AXLE_HEIGHT]), (DRAWS, 1)), ahead)
        position = normal(0.6)
        before = robots(on_floor(position), level)
        after = robots(on_floor(position + normal(0.01)), level, 0.5)
        at_goal = robots(on_floor(goal_w), level)
        shape = DRAWS, self.config.robot.action_size
        action = jnp.asarray(random.choice([-1.0, 0.0, 1.0], shape), jnp.float32)
        steps = {
            "at the start": (start, start, action),
            "anywhere on the floor": (before, after, action),
            "standing exactly on the goal": (at_goal, at_goal, action),
            "at the very point of goal_position": (before, robots(goal_w, level), action),
            "far away, tumbling and fast": (before, robots(normal(100), normal(1, 4), 50), action),
            "under actions of ±100": (before, after, 100 * action),
        }
        return {
            where: Transition(before, after, self.goals, action)
            for where, (before, after, action) in steps.items()
        }

    @functools.cached_property
    def results(self) -> dict[str, dict[str, PyTree]]:
        """Return the results of all methods, on the host, by kind of robot and by method."""
        call = jax.jit(jax.vmap(call_methods(self.task)))
        return {where: jax.device_get(call(batch)) for where, batch in self.transitions.items()}


def first_key() -> jax.Array:
    """Return the random key that all checks start from."""
    return jax.random.PRNGKey(0)


def method_calls(task: Task, transition: Transition) -> dict[str, Call]:
    """Return the calls of all methods of a task for one transition.

    Args:
      task: the task.
      transition: the step of a robot.

    Returns:
      The function and its arguments, by the name of the method.
    """
    before, after, goal, action = transition
    calls: dict[str, Call] = {
        "observe": (task.observe, after, goal),
        "reward": (task.reward, before, after, goal, action),
        "terminated": (task.terminated, after, goal),
        "success": (task.success, after, goal),
        "goal_position": (task.goal_position, goal),
        "markers": (task.markers, goal),
    }
    if isinstance(task, AdvancesGoal):
        calls["advance"] = (task.advance, before, after, goal)
    return calls


def call_methods(task: Task) -> Callable[[Transition], dict[str, PyTree]]:
    """Return a function that calls all methods of a task for one transition.

    Args:
      task: the task.

    Returns:
      A function from a transition to the results, by the name of the method.
    """

    def call(transition: Transition) -> dict[str, PyTree]:
        calls = method_calls(task, transition)
        results = {name: function(*given) for name, (function, *given) in calls.items()}
        reward, terms = results["reward"]
        markers = dict(results["markers"])
        return {**results, "reward": reward, TERMS: dict(terms), "markers": markers}

    return call
