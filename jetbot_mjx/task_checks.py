"""What a task has to keep to, checked without training: each fault in one line, with the remedy.

The environment, the trainer and the reports rely on it. A task that breaks one of these rules
often trains all the same, on something else than was meant.
"""

import collections
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jetbot_mjx import mjx
from jetbot_mjx.config import Config
from jetbot_mjx.env import make_env
from jetbot_mjx.errors import UserError
from jetbot_mjx.model import ROBOTS, make_mj_model
from jetbot_mjx.task import AdvancesGoal, Field, MovesGoal, Task, layout_size, make_task
from jetbot_mjx.task_trials import DRAWS, TERMS, Subject, ask_all, first_key, in_one_line
from jetbot_mjx.wrappers import wrap_for_training

DRIVE_ENVS, DRIVE_STEPS = 16, 64
"""Of the test drive: robots, and environment steps of each."""


class Finding(NamedTuple):
    """A rule that a task breaks."""

    check: str
    """By which check it was found: a key of `CHECKS`."""
    message: str
    """What is wrong and what would be right, in one line."""


def check_task(config: Config) -> Iterator[tuple[str, list[Finding]]]:
    """Checks the task that a configuration names.

    Args:
      config: the run.

    Yields:
      Each check's name and what it found, in the order of `CHECKS`. Nothing is found twice. Where
      the next checks could but fail as well, they are left out.

    Raises:
      UserError: there is no such task, or it refuses the configuration.
    """
    try:
        subject = Subject(make_task(config.task), config)
    except UserError:
        raise
    except Exception as error:
        yield "layout", [Finding("layout", in_one_line(error, config.task.name, ()))]
        return
    seen: set[str] = set()
    for name, check in CHECKS.items():
        messages: list[str] = []
        try:
            messages.extend(check(subject))
        except UserError as error:
            messages.append(str(error))
        except Exception as error:
            messages.append(subject.explain(error))
        found = [Finding(name, one) for one in dict.fromkeys(messages) if one not in seen]
        seen.update(messages)
        yield name, found
        if found and name in _NEEDED:
            return


# The checks: each yields a line for everything that is wrong.


def _layout(subject: Subject) -> Iterator[str]:
    layout = subject.task.layout
    if not isinstance(layout, tuple) or not all(isinstance(field, Field) for field in layout):
        yield "layout is no tuple of Field(name, size, unit, frame): make it one"
        return
    if not layout:
        yield "layout is empty: name at least one Field"
    names = [field.name for field in layout]
    for name in sorted({name for name in names if names.count(name) > 1}):
        yield f"layout names {name!r} {names.count(name)} times: give each field a name of its own"
    for field in layout:
        if not isinstance(field.size, int) or field.size < 1:
            yield f"layout: {field.name!r} has the size {field.size!r}: it should be 1 or more"
        for what in ("name", "unit", "frame"):
            if not isinstance(getattr(field, what), str) or not getattr(field, what).strip():
                yield f"layout: {field.name!r} has no {what}: say it, such as {_LIKE[what]}"


_LIKE = {"name": "goal_distance", "unit": "m, or 1 for none", "frame": "world or body"}


def _tracing(subject: Subject) -> Iterator[str]:
    """Python must not look into arrays, nor keep them."""
    task = subject.task
    before = _attributes(task)
    for name, function, arguments in _calls(subject):
        try:
            traced = [_traced(function, arguments) for _ in range(2)]
        except Exception as error:
            yield subject.explain(error)
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


def _calls(subject: Subject) -> list[tuple[str, Callable[..., Any], tuple[Any, ...]]]:
    """Every method that is traced, with arguments for it."""
    task = subject.task
    try:
        before, after, goal, action = subject.example
    except Exception:
        # `sample` itself fails; being traced it says so.
        return [("sample", task.sample, (first_key(),))]
    calls = [
        ("sample", task.sample, (first_key(),)),
        ("observe", task.observe, (after, goal)),
        ("reward", task.reward, (before, after, goal, action)),
        ("terminated", task.terminated, (after, goal)),
        ("success", task.success, (after, goal)),
        ("goal_position", task.goal_position, (goal,)),
        ("markers", task.markers, (goal,)),
    ]
    if isinstance(task, AdvancesGoal):
        calls.append(("advance", task.advance, (before, after, goal)))
    return calls


def _traced(function: Callable[..., Any], arguments: tuple[Any, ...]) -> tuple[str, list[bytes]]:
    # A new function each time: JAX remembers what it has traced.
    closed = jax.make_jaxpr(lambda *given: function(*given))(*arguments)
    return str(closed.jaxpr), [np.asarray(constant).tobytes() for constant in closed.consts]


def _attributes(task: Task) -> dict[str, str]:
    """What `self` holds, to be compared."""
    held = getattr(task, "__dict__", {})
    return {name: f"{type(value).__name__} {value!r}" for name, value in held.items()}


def _shapes(subject: Subject) -> Iterator[str]:
    task, (before, after, goal, action) = subject.task, subject.example
    yield from _weak("sample", jax.eval_shape(task.sample, first_key()))
    rewarded = jax.eval_shape(task.reward, before, after, goal, action)
    if not (isinstance(rewarded, tuple) and len(rewarded) == 2 and isinstance(rewarded[1], dict)):
        yield "reward returns something else than (reward, {name: term}): return both"
        return
    if not isinstance(jax.eval_shape(task.markers, goal), dict):
        yield "markers returns something else than {name: place}: return a dict"
        return
    told = jax.eval_shape(ask_all(task), subject.example)
    length = layout_size(task.layout)
    wanted = {
        "observe": ((length,), "float32", f"as long as layout says, {length}"),
        "reward": ((), "float32", "one number"),
        "terminated": ((), "bool", "one truth value"),
        "success": ((), "bool", "one truth value"),
        "goal_position": ((3,), "float32", "x, y, z"),
    }
    for name, (shape, dtype, meaning) in wanted.items():
        yield from _unlike(name, told[name], shape, dtype, meaning)
    for name, term in told[TERMS].items():
        yield from _unlike(f"reward's term {name!r}", term, (), "float32", "one number")
    for name, place in told["markers"].items():
        yield from _unlike(f"markers' {name!r}", place, (3,), "float32", "x, y, z")
    if isinstance(task, AdvancesGoal):
        yield from _other_tree("advance", told["advance"], goal)


def _unlike(name: str, got: Any, shape: Any, dtype: str, meaning: str) -> Iterator[str]:
    if not hasattr(got, "shape"):
        yield f"{name} returns {type(got).__name__}: it should be an array, {meaning}"
    elif got.shape != shape:
        yield f"{name} has the shape {list(got.shape)}: it should be {list(shape)}, {meaning}"
    elif str(got.dtype) != dtype:
        yield f"{name} is {got.dtype}: it should be {dtype}{_CAST.get(dtype, '')}"
    else:
        yield from _weak(name, got)


_CAST = {"bool": ", such as a comparison gives", "float32": ", as .astype(jnp.float32) makes it"}


def _weak(name: str, tree: Any) -> Iterator[str]:
    """Types that Python's numbers bring along: a loop refuses them, or is compiled twice."""
    if any(getattr(leaf, "weak_type", False) for leaf in jax.tree.leaves(tree)):
        yield f"{name} has a weak type, of Python's own number: write jnp.float32(...) instead"


def _other_tree(name: str, got: Any, goal: Any) -> Iterator[str]:
    if jax.tree.structure(got) != jax.tree.structure(goal):
        yield f"{name} returns another tree than sample: change the goal's leaves alone"
        return
    for ours, theirs in zip(jax.tree.leaves(got), jax.tree.leaves(goal), strict=True):
        if (ours.shape, ours.dtype) != (theirs.shape, theirs.dtype):
            yield (
                f"{name} makes {theirs.dtype}{list(theirs.shape)} of sample"
                f" {ours.dtype}{list(ours.shape)}: shapes and dtypes must stay"
            )
            return
    yield from _weak(name, got)


def _draws(subject: Subject) -> Iterator[str]:
    draw = jax.jit(jax.vmap(subject.task.sample))
    keys = jax.random.split(first_key(), DRAWS)
    first, again = (jax.device_get(draw(keys)) for _ in range(2))
    if not all(map(np.array_equal, jax.tree.leaves(first), jax.tree.leaves(again))):
        yield "sample draws something else for the same key: draw from key with jax.random alone"
        return
    rows = np.concatenate([np.reshape(x, (DRAWS, -1)) for x in jax.tree.leaves(first)], axis=1)
    if len(np.unique(rows, axis=0)) == 1:
        yield "sample draws the same for every key: draw from key with jax.random"


def _batches(subject: Subject) -> Iterator[str]:
    ask, count = ask_all(subject.task), 4
    case = subject.cases["anywhere on the floor"]
    few = jax.tree.map(lambda x: x[:count], case)
    together = jax.device_get(jax.jit(jax.vmap(ask))(few))
    one = jax.jit(ask)
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


def _finite(subject: Subject) -> Iterator[str]:
    if not _is_finite(subject.goals):
        yield "sample draws what is not finite: guard divisions and roots"
    told: set[str] = set()
    for where, answers in subject.answers.items():
        for name, value in answers.items():
            if name not in told and not _is_finite(value):
                told.add(name)
                yield (
                    f"{name} is not finite for a robot {where}: guard the division or root, such"
                    " as x / jnp.maximum(length, 1e-3)"
                )


def _is_finite(tree: Any) -> bool:
    return all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(tree))


def _terms(subject: Subject) -> Iterator[str]:
    for where, answers in subject.answers.items():
        reward = answers["reward"]
        total = sum(answers[TERMS].values(), np.zeros(DRAWS))
        wrong = ~np.isclose(reward, total, rtol=1e-3, atol=1e-4) & np.isfinite(reward + total)
        if wrong.any():
            at = int(np.argmax(wrong))
            yield (
                f"reward is {reward[at]:.4g} where its terms add up to {total[at]:.4g} (a robot"
                f" {where}): name every part of the reward among the terms, with its sign"
            )
            return


def _endings(subject: Subject) -> Iterator[str]:
    told = subject.answers
    for where, answers in told.items():
        if (answers["success"] & ~answers["terminated"]).any():
            yield (
                f"success without terminated (a robot {where}): what is done has ended for good,"
                " so terminated must hold wherever success does"
            )
            break
    ended = told["at the start"]["terminated"]
    if all(answers["terminated"].all() for answers in told.values()):
        yield "terminated is always true: no episode lasts longer than a step"
    elif ended.any():
        yield (
            f"{ended.sum()} of {DRAWS} episodes have ended where the robot starts: draw goals that"
            " leave something to do"
        )


def _goals(subject: Subject) -> Iterator[str]:
    task, goal = subject.task, subject.example.goal
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
            subject.goals
        )
    except Exception as error:
        yield f"{subject.explain(error)}; {remedy}"
        return
    if not np.allclose(reached[:, :2], wanted[:2], atol=1e-4):
        yield f"goal_position is not where move_goal has put the goal: {remedy}"


def _scene(subject: Subject) -> Iterator[str]:
    task, config = subject.task, subject.config
    placed = set(task.markers(subject.example.goal))

    def build(*, visual: bool) -> mujoco.MjModel:
        robot = ROBOTS[config.robot.preset]
        return make_mj_model(robot, config.physics, build_scene=task.build_scene, visual=visual)

    try:
        model, solid = build(visual=True), build(visual=False)
    except RuntimeError as error:
        yield f"build_scene: {error}: nothing of the task may touch the robot where it starts"
        return
    except ValueError as error:
        yield f"build_scene: MuJoCo refuses the scene: {error}"
        return
    try:
        mjx.put_model(solid)
    except NotImplementedError as error:
        yield f"build_scene: MJX cannot simulate it: {error}: pair spheres and capsules"
        return
    names, solids = _mocap_bodies(model), _mocap_bodies(solid)
    for name in sorted(placed - names):
        yield f"markers places {name!r}, no mocap body: add_body(name={name!r}, mocap=True)"
    for name in sorted((names | solids) - placed - {"goal"}):
        yield f"markers does not say where {name!r} stands, a mocap body of build_scene"
    if not solids - placed:
        yield from _touching(subject, solid)
    paired = set(solid.pair_geom1) | set(solid.pair_geom2)
    for i in range(solid.ngeom):
        if i not in paired and (solid.geom_contype[i] or solid.geom_conaffinity[i]):
            yield (
                f"geom {solid.geom(i).name or i!r} can collide and meets nothing: give it"
                " contype=0, conaffinity=0, and a pair where the robot is to run into it"
            )


def _touching(subject: Subject, solid: mujoco.MjModel) -> Iterator[str]:
    """What the robot stands in when episodes begin."""
    places = jax.device_get(jax.vmap(subject.task.markers)(subject.goals))
    data, touched = mujoco.MjData(solid), collections.Counter()
    for draw in range(DRAWS if solid.nmocap else 1):
        for name in _mocap_bodies(solid):
            data.mocap_pos[solid.body(name).mocapid[0]] = places[name][draw]
        mujoco.mj_forward(solid, data)
        pairs = data.contact.geom[data.contact.dist < 0]
        touched.update({solid.geom(geom).name for pair in pairs for geom in pair})
    ours = {"floor", "left_wheel", "right_wheel", "caster_front", "caster_rear"}
    for name, often in sorted(touched.items()):
        if name not in ours:
            yield (
                f"{name!r} touches something in {often} of {DRAWS if solid.nmocap else 1} episodes"
                " as they begin: leave room about the robot, 0.2 m from the origin"
            )


def _mocap_bodies(model: mujoco.MjModel) -> set[str]:
    return {model.body(i).name for i in range(model.nbody) if model.body(i).mocapid[0] >= 0}


def _drive(subject: Subject) -> Iterator[str]:
    """Steps of a training's environment, under random and extreme actions."""
    env = make_env(subject.config)
    begun = jax.eval_shape(env.reset, first_key())
    gone = jax.eval_shape(env.step, begun, jax.eval_shape(lambda: jnp.zeros(2)))
    if unlike := _changed(begun, gone):
        yield f"a step changes the state's {unlike}: keep names, tree, shapes and dtypes"
        return
    batch = wrap_for_training(env, episode_length=DRIVE_STEPS // 2)
    traces = 0

    def step(state: Any, action: jax.Array) -> Any:
        nonlocal traces
        traces += 1
        return batch.step(state, action)

    keys = jax.random.split(first_key(), DRIVE_ENVS)
    actions = jax.random.uniform(keys[0], (DRIVE_STEPS, DRIVE_ENVS, 2), minval=-1.0)
    # Half of the robots are driven with all they have.
    actions = jnp.where(jnp.arange(DRIVE_ENVS)[:, None] % 2, actions, jnp.sign(actions))
    state = jax.jit(batch.reset)(keys)
    compiled, nonfinite = jax.jit(step), 0
    for action in actions:
        state = compiled(state, action)
        nonfinite += int(state.metrics["nonfinite_worlds"].sum())
    if traces > 1:
        yield f"a step is traced {traces} times and not once: keep tree, shapes and dtypes"
    if nonfinite:
        yield (
            f"{nonfinite} of {DRIVE_STEPS * DRIVE_ENVS} steps are not finite: look at observe and"
            " reward, and at what the robot runs into"
        )


def _changed(first: Any, last: Any) -> str:
    """Which part of two states differs in more than its numbers; empty where none does."""
    sides = [dict(jax.tree_util.tree_leaves_with_path(state)) for state in (first, last)]
    for path in (*sides[0], *sides[1]):
        one, other = (side.get(path) for side in sides)
        if one is None or other is None or _type(one) != _type(other):
            return jax.tree_util.keystr(path).lstrip(".")
    return ""


def _type(leaf: Any) -> tuple[Any, ...]:
    return leaf.shape, leaf.dtype, leaf.weak_type


CHECKS: Mapping[str, Callable[[Subject], Iterator[str]]] = {
    "layout": _layout,
    "purity": _tracing,
    "types": _shapes,
    "draws": _draws,
    "batches": _batches,
    "finite": _finite,
    "reward": _terms,
    "endings": _endings,
    "goal": _goals,
    "scene": _scene,
    "drive": _drive,
}
"""The checks by name, in their order: each yields a line for everything that is wrong."""

MEANINGS: Mapping[str, str] = {
    "layout": "names, sizes, units and frames of the observation",
    "purity": "methods trace, twice into the same program, and leave self alone",
    "types": "shapes and dtypes as the contract has them, none of them weak",
    "draws": "a key gives one draw, and another key another",
    "batches": "jax.vmap gives what a loop gives",
    "finite": f"{DRAWS} ordinary and extreme robots each, goals and actions too",
    "reward": "the terms add up to the reward",
    "endings": "success ends an episode, and none ends where it begins",
    "goal": "goal_position follows move_goal",
    "scene": "MuJoCo and MJX build it, markers place its bodies",
    "drive": f"{DRIVE_ENVS} robots for {DRIVE_STEPS} steps, traced once and finite",
}
"""What each check looks at, in words."""

_NEEDED = ("layout", "purity", "types")
"""With what these find, the checks after them could but fail as well."""
