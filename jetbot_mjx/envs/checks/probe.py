"""A task on trial: what it says of ordinary and extreme robots, and what it raises, in one line."""

import functools
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jetbot_mjx.config import Config
from jetbot_mjx.envs.task import METHODS, AdvancesGoal, RobotState, Task

DRAWS = 256
"""Goals and robots of each kind."""

TERMS = "the terms of reward"
"""Their name among what a task says."""

_PACKAGE = Path(__file__).parents[2]
_AXLE_HEIGHT = 0.0325  # [m]


# What a task raises, in one line.

_REMEDIES = {
    "TracerBool": "Python cannot decide on an array: use jnp.where, & and | and ~",
    "TracerArray": "NumPy cannot take what JAX traces: use jax.numpy",
    "TracerInteger": "Python cannot index by an array: use jnp.take",
    "Concretization": "Python needs a number where there is an array: stay within jax.numpy",
    "UnexpectedTracer": "a value of another call was kept in self: methods must be pure",
}
"""By what the name of JAX's exception begins with."""


def in_one_line(error: Exception, who: str, homes: Sequence[Path]) -> str:
    """Return what was raised, by whom and where.

    Args:
      error: as it was raised.
      who: raised it.
      homes: folders, of which the last place in the traceback is told; empty: of any user's file.

    Returns:
      The line, with what to do where that is known.
    """
    kind = type(error).__name__
    remedy = next((text for name, text in _REMEDIES.items() if kind.startswith(name)), None)
    what = remedy or next(iter(str(error).strip().splitlines()), "")
    places = [
        (Path(frame.filename), frame.lineno) for frame in traceback.extract_tb(error.__traceback__)
    ]
    if isinstance(error, SyntaxError) and error.filename:
        places.append((Path(error.filename), error.lineno))
        what = error.msg
    places = [
        (file, line)
        for file, line in places
        if (file.parent in homes if homes else file.parent != _PACKAGE)
        and "site-packages" not in file.parts
        and not str(file).startswith("<")
    ]
    where = f" ({places[-1][0].name}:{places[-1][1]})" if places else ""
    return " ".join(f"{who} raises {kind}{': ' * bool(what)}{what}{where}".split())


# What the checks try a task on.


class Case(NamedTuple):
    """One step of one robot."""

    before: RobotState
    after: RobotState
    goal: Any
    action: jax.Array


class Subject:
    """A task, and what it says of ordinary and extreme robots."""

    def __init__(self, task: Task, config: Config) -> None:
        """Ask nothing yet.

        Args:
          task: to be tried.
          config: of the run that it is built for.
        """
        self.task, self.config = task, config

    def explain(self, error: Exception) -> str:
        """Return what was raised somewhere inside the task, in one line."""
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
        homes = {Path(file).parent for file in files if file}
        return in_one_line(error, next(inside, "the task"), list(homes - {_PACKAGE} or {_PACKAGE}))

    @functools.cached_property
    def goals(self) -> Any:
        """Return what is drawn for `DRAWS` episodes."""
        return jax.jit(jax.vmap(self.task.sample))(jax.random.split(first_key(), DRAWS))

    @functools.cached_property
    def example(self) -> Case:
        """Make a step in which the robot stands still."""
        quat = jnp.array([1.0, 0.0, 0.0, 0.0])
        robot = RobotState(jnp.array([0.1, 0.2, _AXLE_HEIGHT]), quat, *jnp.zeros((2, 3)))
        return Case(robot, robot, self.task.sample(first_key()), jnp.zeros(2))

    @functools.cached_property
    def cases(self) -> dict[str, Case]:
        """`DRAWS` steps of each kind, by what a robot is like in them."""
        random = np.random.default_rng(0)

        def spread(scale: float, size: int = 3) -> jax.Array:
            return jnp.asarray(scale * random.standard_normal((DRAWS, size)), jnp.float32)

        def robots(place: jax.Array, quat: jax.Array, speed: float = 0.0) -> RobotState:
            quat = quat / jnp.linalg.norm(quat, axis=1, keepdims=True)
            return RobotState(place, quat, spread(speed), spread(4 * speed))

        def on_floor(place: jax.Array) -> jax.Array:
            return place.at[:, 2].set(_AXLE_HEIGHT)

        ahead = jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (DRAWS, 1))
        level = spread(1.0, 4) * jnp.array([1.0, 0.0, 0.0, 1.0])
        goal_w = jax.vmap(self.task.goal_position)(self.goals)
        start = robots(jnp.tile(jnp.array([0.0, 0.0, _AXLE_HEIGHT]), (DRAWS, 1)), ahead)
        place = spread(0.6)
        before = robots(on_floor(place), level)
        after = robots(on_floor(place + spread(0.01)), level, 0.5)
        at_goal = robots(on_floor(goal_w), level)
        action = jnp.asarray(random.choice([-1.0, 0.0, 1.0], (DRAWS, 2)), jnp.float32)
        steps = {
            "at the start": (start, start, action),
            "anywhere on the floor": (before, after, action),
            "standing exactly on the goal": (at_goal, at_goal, action),
            "at the very point of goal_position": (before, robots(goal_w, level), action),
            "far away, tumbling and fast": (before, robots(spread(100), spread(1, 4), 50), action),
            "under actions of ±100": (before, after, 100 * action),
        }
        return {
            where: Case(before, after, self.goals, action)
            for where, (before, after, action) in steps.items()
        }

    @functools.cached_property
    def answers(self) -> dict[str, dict[str, Any]]:
        """Return all that the task says of the cases."""
        ask = jax.jit(jax.vmap(ask_all(self.task)))
        return {where: jax.device_get(ask(case)) for where, case in self.cases.items()}


def first_key() -> jax.Array:
    """Return the key of all that is drawn here, or its root."""
    return jax.random.PRNGKey(0)


def ask_all(task: Task) -> Callable[[Case], dict[str, Any]]:
    """Return all that a task says of a step, as one function.

    Args:
      task: to be asked.

    Returns:
      A function of one step; it gives the answers by the method's name.
    """

    def ask(case: Case) -> dict[str, Any]:
        before, after, goal, action = case
        reward, terms = task.reward(before, after, goal, action)
        answers = {
            "observe": task.observe(after, goal),
            "reward": reward,
            TERMS: dict(terms),
            "terminated": task.terminated(after, goal),
            "success": task.success(after, goal),
            "goal_position": task.goal_position(goal),
            "markers": dict(task.markers(goal)),
        }
        if isinstance(task, AdvancesGoal):
            answers["advance"] = task.advance(before, after, goal)
        return answers

    return ask
