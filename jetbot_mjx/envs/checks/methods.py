"""Check the methods of a task; each check yields one line for every error."""

import contextlib
from collections.abc import Callable, Iterator, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jetbot_mjx.envs.checks.probe import (
    DRAWS,
    TERMS,
    Call,
    TaskProbe,
    call_methods,
    first_key,
    method_calls,
)
from jetbot_mjx.envs.task import AdvancesGoal, Field, MovesGoal, Task, layout_size, min_std
from jetbot_mjx.errors import UserError


def layout(probe: TaskProbe) -> Iterator[str]:
    """Check names, sizes, units, frames and smallest deviations of the observation."""
    fields = probe.task.layout
    if not isinstance(fields, tuple) or not all(isinstance(field, Field) for field in fields):
        yield "layout is not a tuple of Field(name, size, unit, frame): make it one"
        return
    if not fields and not probe.config.task.sees:
        yield "layout is empty: name at least one Field"
    names = [field.name for field in fields]
    for name in sorted({name for name in names if names.count(name) > 1}):
        yield f"layout names {name!r} {names.count(name)} times: give each field a name of its own"
    for field in fields:
        if not isinstance(field.size, int) or field.size < 1:
            yield f"layout: {field.name!r} has the size {field.size!r}: it should be 1 or more"
        missing = [
            what
            for what in ("name", "unit", "frame")
            if not isinstance(getattr(field, what), str) or not getattr(field, what).strip()
        ]
        for what in missing:
            yield f"layout: {field.name!r} has no {what}: say it, such as {_LIKE[what]}"
        if not missing and probe.config.ppo.normalizer == "physical":
            try:
                min_std(field)
            except UserError as error:
                yield str(error)


_LIKE = {"name": "goal_distance", "unit": "m, or 1 for none", "frame": "world or body"}


def purity(probe: TaskProbe) -> Iterator[str]:
    """Check that methods trace, twice into the same program, and leave `self` alone."""
    task = probe.task
    before = _attributes(task)
    calls: dict[str, Call] = {"sample": (task.sample, first_key())}
    # If `sample` itself fails, there is no example, and tracing it below reports the error.
    with contextlib.suppress(Exception):
        calls |= method_calls(task, probe.example)
    for name, (function, *arguments) in calls.items():
        try:
            traced = [_traced(function, arguments) for _ in range(2)]
        except Exception as error:
            yield probe.explain(error)
            continue
        if traced[0] != traced[1]:
            yield (
                f"{name} is another program each time it is traced: draw from key with jax.random"
                " alone, and keep no counters"
            )
    after = _attributes(task)
    for attribute in sorted(before.keys() | after.keys()):
        if before.get(attribute) != after.get(attribute):
            yield (
                f"a method changes self.{attribute}: methods must be pure; what an episode has to"
                " remember belongs into the goal, see `advance`"
            )


def _traced(
    function: Callable[..., object], arguments: Sequence[object]
) -> tuple[str, list[bytes]]:
    """Return the jaxpr of a function and its constants, to be compared."""
    # A new function each time, since JAX caches traces.
    closed = jax.make_jaxpr(lambda *given: function(*given))(*arguments)
    return str(closed.jaxpr), [np.asarray(constant).tobytes() for constant in closed.consts]


def _attributes(task: Task) -> dict[str, str]:
    """Return the attributes of a task as strings, to be compared."""
    attributes = getattr(task, "__dict__", {})
    return {name: f"{type(value).__name__} {value!r}" for name, value in attributes.items()}


def types(probe: TaskProbe) -> Iterator[str]:
    """Check the shapes and dtypes of all results."""
    # Check the containers first.
    task, (before, after, goal, action) = probe.task, probe.example
    yield from _weak("sample", jax.eval_shape(task.sample, first_key()))
    rewarded = jax.eval_shape(task.reward, before, after, goal, action)
    if not (isinstance(rewarded, tuple) and len(rewarded) == 2 and isinstance(rewarded[1], dict)):
        yield "reward returns something other than (reward, {name: term}): return both"
        return
    if not isinstance(jax.eval_shape(task.markers, goal), dict):
        yield "markers returns something other than {name: place}: return a dict"
        return
    # Check each result.
    results = jax.eval_shape(call_methods(task), probe.example)
    length = layout_size(task.layout)
    wanted = {
        "observe": ((length,), "float32", f"as long as layout says, {length}"),
        "reward": ((), "float32", "one number"),
        "terminated": ((), "bool", "one truth value"),
        "success": ((), "bool", "one truth value"),
        "goal_position": ((3,), "float32", "x, y, z"),
    }
    for name, (shape, dtype, meaning) in wanted.items():
        yield from _unlike(name, results[name], shape, dtype, meaning)
    for name, term in results[TERMS].items():
        yield from _unlike(f"reward's term {name!r}", term, (), "float32", "one number")
    for name, place in results["markers"].items():
        yield from _unlike(f"markers' {name!r}", place, (3,), "float32", "x, y, z")
    if isinstance(task, AdvancesGoal):
        yield from _other_tree("advance", results["advance"], goal)


def _unlike(
    name: str, got: object, shape: tuple[int, ...], dtype: str, meaning: str
) -> Iterator[str]:
    """Compare the shape and dtype of a result with those required."""
    if not isinstance(got, jax.ShapeDtypeStruct):
        yield f"{name} returns {type(got).__name__}: it should be an array, {meaning}"
    elif got.shape != shape:
        yield f"{name} has the shape {list(got.shape)}: it should be {list(shape)}, {meaning}"
    elif str(got.dtype) != dtype:
        yield f"{name} is {got.dtype}: it should be {dtype}{_CAST.get(dtype, '')}"
    else:
        yield from _weak(name, got)


_CAST = {"bool": ", such as a comparison gives", "float32": ", as .astype(jnp.float32) makes it"}


def _weak(name: str, tree: object) -> Iterator[str]:
    """Find weakly typed results, with which JAX's loops fail or are compiled twice."""
    if any(getattr(leaf, "weak_type", False) for leaf in jax.tree.leaves(tree)):
        yield f"{name} has a weak type, of Python's own number: write jnp.float32(...) instead"


def _other_tree(name: str, got: object, goal: object) -> Iterator[str]:
    """Compare the tree structure, shapes and dtypes of a new goal with those of `sample`."""
    if jax.tree.structure(got) != jax.tree.structure(goal):
        yield f"{name} returns another tree than sample: change the goal's leaves alone"
        return
    for leaf, sampled in zip(jax.tree.leaves(got), jax.tree.leaves(goal), strict=True):
        if (leaf.shape, leaf.dtype) != (sampled.shape, sampled.dtype):
            yield (
                f"{name} makes {sampled.dtype}{list(sampled.shape)} of sample"
                f" {leaf.dtype}{list(leaf.shape)}: shapes and dtypes must stay"
            )
            return
    yield from _weak(name, got)


def draws(probe: TaskProbe) -> Iterator[str]:
    """Check that equal keys draw equal goals, and different keys draw different goals."""
    draw = jax.jit(jax.vmap(probe.task.sample))
    keys = jax.random.split(first_key(), DRAWS)
    first, again = (jax.device_get(draw(keys)) for _ in range(2))
    if not all(map(np.array_equal, jax.tree.leaves(first), jax.tree.leaves(again))):
        yield "sample draws something else for the same key: draw from key with jax.random alone"
        return
    rows = np.concatenate([np.reshape(x, (DRAWS, -1)) for x in jax.tree.leaves(first)], axis=1)
    if len(np.unique(rows, axis=0)) == 1:
        yield "sample draws the same for every key: draw from key with jax.random"


def batches(probe: TaskProbe) -> Iterator[str]:
    """Check that `jax.vmap` gives the same results as a loop."""
    call, count = call_methods(probe.task), 4
    batch = probe.transitions["anywhere on the floor"]
    few = jax.tree.map(lambda x: x[:count], batch)
    together = jax.device_get(jax.jit(jax.vmap(call))(few))
    one = jax.jit(call)
    alone = [jax.device_get(one(jax.tree.map(lambda x, i=i: x[i], few))) for i in range(count)]
    for name, value in together.items():
        apart = jax.tree.map(lambda *x: np.stack(x), *[each[name] for each in alone])
        for a, b in zip(jax.tree.leaves(value), jax.tree.leaves(apart), strict=True):
            if not np.allclose(a, b, rtol=1e-4, atol=1e-5, equal_nan=True):
                yield (
                    f"{name} under jax.vmap differs from one robot at a time: no robot may depend"
                    " on another; look for callbacks"
                )
                break


def finite(probe: TaskProbe) -> Iterator[str]:
    """Check that all results are finite, for ordinary and extreme robots."""
    if not _is_finite(probe.goals):
        yield "sample draws what is not finite: guard divisions and roots"
    reported: set[str] = set()
    for where, results in probe.results.items():
        for name, value in results.items():
            if name not in reported and not _is_finite(value):
                reported.add(name)
                yield (
                    f"{name} is not finite for a robot {where}: guard the division or root, such"
                    " as x / jnp.maximum(length, 1e-3)"
                )


def _is_finite(tree: object) -> bool:
    return all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(tree))


def reward(probe: TaskProbe) -> Iterator[str]:
    """Check that the terms add up to the reward."""
    for where, results in probe.results.items():
        reward = results["reward"]
        total = sum(results[TERMS].values(), np.zeros(DRAWS))
        wrong = ~np.isclose(reward, total, rtol=1e-3, atol=1e-4) & np.isfinite(reward + total)
        if wrong.any():
            at = int(np.argmax(wrong))
            yield (
                f"reward is {reward[at]:.4g} where its terms add up to {total[at]:.4g} (a robot"
                f" {where}): name every part of the reward among the terms, with its sign"
            )
            return


def endings(probe: TaskProbe) -> Iterator[str]:
    """Check that success terminates an episode, and that no episode ends at its start."""
    by_robot = probe.results
    for where, results in by_robot.items():
        if (results["success"] & ~results["terminated"]).any():
            yield (
                f"success without terminated (a robot {where}): a task that is done has ended,"
                " so terminated must hold wherever success does"
            )
            break
    ended = by_robot["at the start"]["terminated"]
    if all(results["terminated"].all() for results in by_robot.values()):
        yield "terminated is always true: no episode lasts longer than a step"
    elif ended.any():
        yield (
            f"{ended.sum()} of {DRAWS} episodes have ended where the robot starts: draw goals that"
            " leave something to do"
        )


def goal(probe: TaskProbe) -> Iterator[str]:
    """Check that `goal_position` follows `move_goal`."""
    task, goal = probe.task, probe.example.goal
    if not isinstance(task, MovesGoal):
        return
    wanted = jnp.array([0.31, -0.47, 0.0]).at[2].set(task.goal_position(goal)[2])
    remedy = "write a move_goal for what sample draws"
    try:
        moved = jax.eval_shape(task.move_goal, goal, wanted)
        if unlike := list(_other_tree("move_goal", moved, goal)):
            yield f"{unlike[0]}; {remedy}"
            return
        reached = jax.vmap(lambda goal: task.goal_position(task.move_goal(goal, wanted)))(
            probe.goals
        )
    except Exception as error:
        yield f"{probe.explain(error)}; {remedy}"
        return
    if not np.allclose(reached[:, :2], wanted[:2], atol=1e-4):
        yield f"goal_position is not where move_goal has put the goal: {remedy}"
