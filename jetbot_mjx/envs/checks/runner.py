"""Check a task without training, and report each error in one line with a remedy.

Environment, trainer and reports rely on these rules. A task that breaks one often trains without
an error message, but on another problem than intended.
"""

import collections
from collections.abc import Callable, Iterator, Mapping

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from jetbot_mjx.config import Config, MjcfRobotConfig
from jetbot_mjx.envs import mjx
from jetbot_mjx.envs.checks import methods
from jetbot_mjx.envs.checks.errors import describe_error
from jetbot_mjx.envs.checks.probe import (
    DRAWS,
    TaskProbe,
    call_methods,
    changed_leaf,
    first_key,
)
from jetbot_mjx.envs.jetbot_env import make_jetbot_env
from jetbot_mjx.envs.mjcf_robot import PREFIX
from jetbot_mjx.envs.robot_model import make_mj_model, mocap_ids
from jetbot_mjx.envs.state import State
from jetbot_mjx.envs.task import Task, layout_size, make_task
from jetbot_mjx.envs.wrappers import wrap_for_training
from jetbot_mjx.errors import InvalidError, UserError

DRIVE_ENVS, DRIVE_STEPS = 16, 64
"""Number of robots of the test drive, and of environment steps of each."""


def check_task(config: Config) -> Iterator[tuple[str, list[str]]]:
    """Check the task that a configuration names.

    Args:
      config: the configuration of the run.

    Yields:
      The name and the findings of each check, in the order of `CHECKS`. A finding is one line with
      an error and its remedy, and none is repeated. If a check in `_PREREQUISITES` has findings,
      the checks after it are skipped.

    Raises:
      UserError: there is no such task, or it rejects the configuration.
    """
    # Build the task.
    try:
        probe = TaskProbe(make_task(config.task), config)
    except UserError:
        raise
    except Exception as error:
        yield "layout", [describe_error(error, config.task.name, ())]
        return
    # Run the checks.
    seen: set[str] = set()
    for name, (check, _) in CHECKS.items():
        messages: list[str] = []
        try:
            messages.extend(check(probe))
        except UserError as error:
            messages.append(str(error))
        except Exception as error:
            messages.append(probe.explain(error))
        found = [one for one in dict.fromkeys(messages) if one not in seen]
        seen.update(messages)
        yield name, found
        if found and name in _PREREQUISITES:
            return


def require_trainable(task: Task, config: Config) -> None:
    """Raise an error, before anything is compiled, if a task's methods do not fit the training.

    Args:
      task: the task.
      config: the configuration of the run.

    Raises:
      InvalidError: a method raises an error, or returns another shape than a training needs.
    """
    probe = TaskProbe(task, config)
    where = f"task.name = {config.task.name!r}"
    more = f"jetbot-mjx check-env {config.task.name} says more"
    try:
        found = jax.eval_shape(call_methods(task), probe.example)
    except Exception as error:
        raise InvalidError(f"{where}: {probe.explain(error)} ({more})") from error
    wanted = {"observe": (layout_size(task.layout),)}
    wanted |= dict.fromkeys(("reward", "terminated", "success"), ())
    for method, shape in wanted.items():
        if jnp.shape(found[method]) != shape:
            raise InvalidError(
                f"{where}: {method} has the shape {list(jnp.shape(found[method]))}: it should be"
                f" {list(shape)} ({more})"
            )


# Checks of the scene and of the whole environment.


def _scene(probe: TaskProbe) -> Iterator[str]:
    """Check that MuJoCo and MJX accept the scene, and that its mocap bodies match `markers`."""
    task, config = probe.task, probe.config
    # Build the scene for both simulators.
    placed = set(task.markers(probe.example.goal))

    def build(*, visual: bool) -> mujoco.MjModel:
        return make_mj_model(
            config.robot, config.physics, build_scene=task.build_scene, visual=visual
        )

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
    # Compare the mocap bodies with `markers`.
    names, solids = set(mocap_ids(model)), set(mocap_ids(solid))
    for name in sorted(placed - names):
        yield (
            f"markers places {name!r}, which is not a mocap body: add_body(name={name!r},"
            " mocap=True)"
        )
    for name in sorted((names | solids) - placed - {"goal"}):
        yield f"markers does not say where {name!r} stands, a mocap body of build_scene"
    # Look for contacts at the start of episodes, and for geoms without a contact pair.
    if not solids - placed:
        yield from _touching(probe, solid)
    paired = set(solid.pair_geom1) | set(solid.pair_geom2)
    is_model = isinstance(config.robot, MjcfRobotConfig)
    for i in range(solid.ngeom):
        # A robot's model decides itself what of it touches the floor.
        if is_model and (solid.geom(i).name == "floor" or solid.geom(i).name.startswith(PREFIX)):
            continue
        if i not in paired and (solid.geom_contype[i] or solid.geom_conaffinity[i]):
            yield (
                f"geom {solid.geom(i).name or i!r} can collide and is in no contact pair: give it"
                " contype=0, conaffinity=0, and a pair where the robot is to run into it"
            )


def _touching(probe: TaskProbe, solid: mujoco.MjModel) -> Iterator[str]:
    """Find bodies that touch the robot when episodes begin."""
    places = jax.device_get(jax.vmap(probe.task.markers)(probe.goals))
    data, touched = mujoco.MjData(solid), collections.Counter()
    for draw in range(DRAWS if solid.nmocap else 1):
        for name, index in mocap_ids(solid).items():
            data.mocap_pos[index] = places[name][draw]
        mujoco.mj_forward(solid, data)
        pairs = data.contact.geom[data.contact.dist < 0]
        touched.update({solid.geom(geom).name for pair in pairs for geom in pair})
    of_robot = solid.body_rootid[solid.geom_bodyid] == solid.jnt_bodyid[0]
    robot_geoms = {"floor", *(solid.geom(geom).name for geom in np.flatnonzero(of_robot))}
    for name, often in sorted(touched.items()):
        if name not in robot_geoms:
            yield (
                f"{name!r} touches something in {often} of {DRAWS if solid.nmocap else 1} episodes"
                " as they begin: leave room around the robot, 0.2 m from the origin"
            )


def _drive(probe: TaskProbe) -> Iterator[str]:
    """Step the environment of a training with random and extreme actions."""
    # Compare the trees of the states before and after a step.
    env = make_jetbot_env(probe.config)
    first = jax.eval_shape(env.reset, first_key())
    second = jax.eval_shape(env.step, first, jax.eval_shape(lambda: jnp.zeros(env.action_size)))
    if unlike := changed_leaf(first, second):
        yield f"a step changes the state's {unlike}: keep names, tree, shapes and dtypes"
        return
    # Count how often a step is traced.
    batch = wrap_for_training(env, episode_length=DRIVE_STEPS // 2)
    traces = 0

    def step(state: State, action: jax.Array) -> State:
        nonlocal traces
        traces += 1
        return batch.step(state, action)

    keys = jax.random.split(first_key(), DRIVE_ENVS)
    actions = jax.random.uniform(keys[0], (DRIVE_STEPS, DRIVE_ENVS, env.action_size), minval=-1.0)
    # Half of the robots get the largest actions.
    actions = jnp.where(jnp.arange(DRIVE_ENVS)[:, None] % 2, actions, jnp.sign(actions))
    state = jax.jit(batch.reset)(keys)
    compiled, nonfinite = jax.jit(step), 0
    for action in actions:
        state = compiled(state, action)
        nonfinite += int(state.metrics["nonfinite_envs"].sum())
    if traces > 1:
        yield f"a step is traced {traces} times and not once: keep tree, shapes and dtypes"
    if nonfinite:
        yield (
            f"{nonfinite} of {DRIVE_STEPS * DRIVE_ENVS} steps are not finite: look at observe and"
            " reward, and at what the robot runs into"
        )


CHECKS: Mapping[str, tuple[Callable[[TaskProbe], Iterator[str]], str]] = {
    "layout": (
        methods.layout,
        "names, sizes, units, frames and smallest deviations of the observation",
    ),
    "purity": (methods.purity, "methods trace, twice into the same program, and leave self alone"),
    "types": (methods.types, "shapes and dtypes as the contract has them, none of them weak"),
    "draws": (methods.draws, "a key gives one draw, and another key another"),
    "batches": (methods.batches, "jax.vmap gives what a loop gives"),
    "finite": (methods.finite, f"{DRAWS} ordinary and extreme robots each, goals and actions too"),
    "reward": (methods.reward, "the terms add up to the reward"),
    "endings": (methods.endings, "success ends an episode, and none ends where it begins"),
    "goal": (methods.goal, "goal_position follows move_goal"),
    "scene": (_scene, "MuJoCo and MJX build it, markers place its bodies"),
    "drive": (_drive, f"{DRIVE_ENVS} robots for {DRIVE_STEPS} steps, traced once and finite"),
}
"""The checks by name, in their order, with what they look at; each yields a line for every error.
"""

_PREREQUISITES = ("layout", "purity", "types")
"""Checks without which all checks after them would fail as well."""
