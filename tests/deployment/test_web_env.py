"""A page's robots move, see and decide as the package's do; Node stands for the browser."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from helpers.further import slow_fixture, slow_unless
from helpers.web_pages import shipped
from jetbot_mjx.config import RandomizationConfig, RobotParams
from jetbot_mjx.deployment.numpy_policy import as_jax
from jetbot_mjx.envs import (
    PIXELS,
    BatchWrapper,
    DomainRandomizationWrapper,
    EpisodeWrapper,
    KernelWrapper,
    NewEpisodeWrapper,
    robot_state,
    with_camera,
)
from jetbot_mjx.evaluation.evaluator import Evaluator, report_keys
from onekernel import ProgramCache

ROBOTS, SECONDS = 21, 5.0
"""Robots that fill no vector, and the time for which they are compared."""

CAMERAS = ("jetbot_camera", "camera_real")

BEGIN = """
const count = given.keys.length / 2, fleet = engine.fleet(count, 0), { robots } = fleet;
fleet.keys.view.set(given.keys);
fleet.begin();
const rows = (name) => Array.from({ length: count }, (_, i) => [...robots.numbers(name, i)]).flat();
const floats = (name) => Float32Array.from(rows(name));
"""

DRIVE = f"""{BEGIN}
if (given.friction !== undefined) fleet.knobs.friction = given.friction;
const found = {{ qpos: [], obs: [], done: [] }};
for (let at = 0; at < given.commands.length; at += 2 * count) {{
  for (let robot = 0; robot < count; robot++)
    fleet.drive(robot, given.commands.subarray(at + 2 * robot, at + 2 * robot + 2));
  fleet.step();
  found.qpos.push(...rows("qpos"));
  found.obs.push(...rows("obs"));
  found.done.push(...fleet.done);
}}
found.poses = fleet.poses();
found.goals = fleet.goals();
for (const [name, numbers] of Object.entries(found)) found[name] = Float32Array.from(numbers);
return found;
"""


class Drive(NamedTuple):
    """What robots did: arrays of shape (steps, robots, ...)."""

    qpos: np.ndarray
    obs: np.ndarray
    done: np.ndarray
    goals: np.ndarray
    """Positions of the goals in the end, of shape (robots, 3)."""


@pytest.fixture(scope="module")
def page():
    return shipped("jetbot_egocentric")


def switching(steps, robots=ROBOTS):
    """Commands that switch between the ends, as those of trained policies do."""
    rng = np.random.default_rng(0)
    commands = rng.choice(np.float32([-1, 1]), size=(steps, robots, 2))
    kept = rng.random((steps, robots, 1)) < 0.8
    for i in range(1, steps):
        commands[i] = np.where(kept[i], commands[i - 1], commands[i])
    return commands


def driven(batch, keys, commands, shift=0.0):
    """A drive of batched environments by kernels of the CPU, whose start is shifted along x [m]."""

    @jax.jit
    def run(keys, commands):
        begin = batch.reset(keys)
        physics = begin.pipeline_state
        begin = begin.replace(pipeline_state=physics.replace(qpos=physics.qpos.at[:, 0].add(shift)))

        def step(state, action):
            state = batch.step(state, action)
            return state, (state.pipeline_state.qpos, state.obs, state.done)

        end, history = jax.lax.scan(step, begin, commands)
        return *history, jax.vmap(batch.task.goal_position)(end.goal)

    return Drive(*jax.device_get(run(keys, commands)))


def nominal(env):
    """Robots as their preset is, in batches."""
    one = NewEpisodeWrapper(EpisodeWrapper(env.blind(), env.config.task.episode_length))
    return BatchWrapper(with_camera(KernelWrapper(one), env.camera))


@slow_fixture(scope="module")
def drives(page):
    """The drive of the page's robots, and the package's."""
    env, commands = page.env, switching(round(SECONDS / page.env.dt))
    keys = np.asarray(report_keys(ROBOTS))
    found = page.run(DRIVE, keys=keys.ravel(), commands=commands.ravel())
    theirs = driven(nominal(env), keys, commands)
    steps = len(commands), ROBOTS, -1
    ours = Drive(
        found["qpos"].reshape(steps),
        found["obs"].reshape(steps),
        found["done"].reshape(steps[:2]),
        found["goals"].reshape(ROBOTS, 3),
    )
    return ours, theirs, found["poses"].reshape(ROBOTS, -1, 7)


def test_robots_are_where_the_cpus_kernel_puts_them(drives):
    ours, theirs, _ = drives
    # They drove, and met the ends of their episodes.
    assert np.ptp(theirs.qpos[:, :, :2], axis=0).max() > 0.5
    assert theirs.done.sum() >= ROBOTS
    np.testing.assert_array_equal(ours.done, theirs.done)
    np.testing.assert_allclose(ours.qpos[..., :3], theirs.qpos[..., :3], rtol=0, atol=1e-4)
    np.testing.assert_allclose(ours.qpos[..., 3:7], theirs.qpos[..., 3:7], rtol=0, atol=1e-3)
    np.testing.assert_allclose(ours.obs, theirs.obs, rtol=0, atol=1e-3)
    # New episodes have the package's goals.
    np.testing.assert_allclose(ours.goals, theirs.goals, rtol=0, atol=1e-6)


def test_what_is_drawn_is_where_mujoco_has_it(drives, page):
    ours, _, poses = drives
    model, about = page.env.mj_model, page.data["meta"]["scene"]
    data = mujoco.MjData(model)
    for robot in (0, ROBOTS - 1):
        data.qpos[:] = ours.qpos[-1, robot]
        data.mocap_pos[model.body("goal").mocapid[0]] = ours.goals[robot]
        mujoco.mj_kinematics(model, data)
        visible = {model.geom_bodyid[i] for i in range(model.ngeom) if model.geom_rgba[i, 3] > 0}
        moving = sorted(visible - {0})
        places = [np.abs(poses[robot, :, :3] - data.xpos[body]).max(-1) for body in moving]
        assert np.min(places, axis=1).max() < 1e-5
        goal = about["goal"]
        np.testing.assert_allclose(poses[robot, goal, :3], ours.goals[robot], rtol=0, atol=1e-6)
        axes = np.linalg.norm(poses[robot, :, 3:], axis=-1)
        np.testing.assert_allclose(axes, 1.0, rtol=0, atol=1e-5)


def test_a_slippery_floor_is_the_packages(page, drives):
    env, friction = page.env, 0.2
    commands, keys = switching(round(SECONDS / env.dt)), np.asarray(report_keys(ROBOTS))
    found = page.run(DRIVE, keys=keys.ravel(), commands=commands.ravel(), friction=friction)
    ranges, length = RandomizationConfig(), env.config.task.episode_length
    slippery = DomainRandomizationWrapper(env, RobotParams(friction=friction), ranges)
    one = NewEpisodeWrapper(EpisodeWrapper(slippery, length))
    # A robot that nearly tips over is another one by round-off alone: where it starts a micrometre
    # further, too.
    twice = np.tile(keys, (2, 1)), np.tile(commands, (1, 2, 1))
    shift = np.repeat(np.float32([0, 1e-6]), ROBOTS)
    both = driven(BatchWrapper(KernelWrapper(one)), *twice, shift).qpos[..., :3]
    theirs, shifted = both[:, :ROBOTS], both[:, ROBOTS:]
    steady = np.abs(shifted - theirs).max((0, 2)) < 3e-5
    assert steady.mean() > 0.85
    ours = found["qpos"].reshape(*theirs.shape[:2], -1)[..., :3]
    np.testing.assert_allclose(ours[:, steady], theirs[:, steady], rtol=0, atol=1e-4)
    # It is another drive than that on the usual floor.
    assert np.abs(ours - drives[0].qpos[..., :3]).max() > 0.05


def test_knobs_slow_a_robot_down_and_widen_the_goal(page):
    body = f"""{BEGIN}
    const maxSpeed = fleet.knobs.maxSpeed;
    if (given.speed) fleet.knobs.maxSpeed = given.speed * maxSpeed;
    if (given.radius) fleet.knobs.successRadius = given.radius;
    for (let robot = 0; robot < count; robot++) fleet.drive(robot, [1, 0]);
    for (let step = 0; step < 60; step++) fleet.step();
    const [x, y] = robots.numbers("qvel", 0), speed = Math.hypot(x, y);
    return {{ speed, maxSpeed, episodes: fleet.episodes, successes: fleet.successes }};
    """
    keys = np.asarray(report_keys(ROBOTS)).ravel()
    usual, slow, wide = (
        page.run(body, keys=keys, **knobs) for knobs in ({}, {"speed": 0.25}, {"radius": 50.0})
    )
    assert usual["maxSpeed"] == page.env.drive.max_speed
    assert slow["speed"] == pytest.approx(0.25 * usual["speed"], rel=0.02)
    # Every step of every robot reaches so large a goal.
    assert (wide["episodes"], wide["successes"]) == (60 * ROBOTS, 60 * ROBOTS)
    assert usual["successes"] < ROBOTS


def test_a_goal_is_moved_and_a_robot_is_pushed_alone(page):
    body = f"""{BEGIN}
    for (let step = 0; step < 9; step++) fleet.step();
    const goals = fleet.goals().slice(), steps = robots.number("steps", 5);
    const [velocities, others] = [floats("qvel"), floats("obs")];
    fleet.setGoal(5, 0.75, -0.5);
    fleet.push(6, 0.25, -0.125, 2);
    return {{
      goals, velocities, others, moved: fleet.goals(), pushed: floats("qvel"), obs: floats("obs"),
      steps, begun: robots.number("steps", 5), qpos: floats("qpos"),
    }};
    """
    found = page.run(body, keys=np.asarray(report_keys(ROBOTS)).ravel())
    arrays = {
        name: value.reshape(ROBOTS, -1).copy()
        for name, value in found.items()
        if isinstance(value, np.ndarray)
    }
    others = np.delete(np.arange(ROBOTS), 5)
    np.testing.assert_array_equal(arrays["moved"][others], arrays["goals"][others])
    np.testing.assert_allclose(arrays["moved"][5], [0.75, -0.5, arrays["goals"][5, 2]])
    assert (found["steps"], found["begun"]) == (9, 0)
    # The robot sees the goal at its new place, and no other robot sees anything new.
    np.testing.assert_array_equal(arrays["obs"][others], arrays["others"][others])
    task, goal = page.env.task, jnp.float32([0.75, -0.5, arrays["goals"][5, 2]])
    state = page.env.reset(jnp.zeros(2, jnp.uint32))
    data = state.pipeline_state.replace(
        qpos=jnp.asarray(arrays["qpos"][5]), qvel=jnp.asarray(arrays["pushed"][5])
    )
    expected = page.env.observe(robot_state(data), task.move_goal(state.goal, goal))
    np.testing.assert_allclose(arrays["obs"][5], expected, rtol=0, atol=1e-6)
    # The push is that of the sixth robot alone.
    arrays["velocities"][6, [0, 1, 5]] += [0.25, -0.125, 2]
    np.testing.assert_allclose(arrays["pushed"], arrays["velocities"], rtol=0, atol=1e-6)


POLICY = f"""{BEGIN}
fleet.drivenBy(policyOf(given.data.policies[given.data.policies.length - 1]));
const found = {{ obs: [], actions: [], images: [] }}, {{ words, places }} = robots.about;
if (given.begun)
  given.begun.forEach((steps, i) => robots.words.view[i * words + places.steps] = steps);
for (let step = 0; step < given.steps; step++) {{
  found.obs.push(...rows("obs"));
  if (fleet.eyes) found.images.push(Uint8Array.from(fleet.eyes.bytes));
  fleet.step();
  found.actions.push(...robots.actions.view);
}}
for (const name of ["obs", "actions"]) found[name] = Float32Array.from(found[name]);
return found;
"""


def test_actions_are_those_of_jax(page):
    found = page.run(POLICY, keys=np.asarray(report_keys(ROBOTS)).ravel(), steps=120)
    obs = found["obs"].reshape(120 * ROBOTS, -1)
    act = jax.jit(as_jax(page.checkpoint, page.env))
    theirs, _ = act(obs)
    ours = found["actions"].reshape(theirs.shape)
    assert np.abs(theirs).max() > 0.99
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-5)


EPISODES = f"""{BEGIN}
fleet.drivenBy(policyOf(given.data.policies[given.data.policies.length - 1]));
const ends = new Float32Array(count), reached = new Float32Array(count);
for (let step = 1; ends.includes(0); step++) {{
  fleet.step();
  for (let robot = 0; robot < count; robot++)
    if (fleet.done[robot] && !ends[robot])
      [ends[robot], reached[robot]] = [step, fleet.success[robot]];
}}
return {{ ends, reached }};
"""


def test_the_policy_reaches_the_goals_of_the_report_as_in_an_evaluation(page):
    keys = np.asarray(report_keys(1024))
    found = page.run(EPISODES, keys=keys.ravel())
    checkpoint = page.checkpoint
    theirs = Evaluator(page.env, checkpoint.networks, ProgramCache({})).run(checkpoint.params, keys)
    success = np.asarray(theirs.success)
    assert success.mean() > 0.95
    assert abs(found["reached"].mean() - success.mean()) <= 0.002
    # Not only as often: the same goals, in the same time.
    assert (found["reached"] == success).mean() >= 0.998
    assert (np.abs(found["ends"] - np.asarray(theirs.steps)) <= 1).mean() >= 0.99


def test_the_same_seed_is_the_same_fleet_and_the_scripted_driver_arrives(page):
    body = """
    const fleets = [3, 3, 4].map((seed) => engine.fleet(64, seed));
    for (const fleet of fleets) {
      fleet.scripted = true;
      for (let step = 0; step < 400; step++) fleet.step();
    }
    const [words, again, other] = fleets.map((fleet) => fleet.robots.words.view);
    const { episodes, successes, time } = fleets[0];
    return { words, again, other, episodes, successes, time };
    """
    found = page.run(body)
    np.testing.assert_array_equal(found["words"].view(np.uint32), found["again"].view(np.uint32))
    assert np.any(found["words"] != found["other"])
    assert found["episodes"] >= 64
    assert found["successes"] > 0.9 * found["episodes"]
    assert found["time"] == pytest.approx(400 * page.env.dt)


@pytest.mark.slow
@pytest.mark.parametrize("name", slow_unless(lambda name: name == "camera_real", CAMERAS))
def test_the_camera_sees_what_the_packages_does_and_the_policy_acts_on_it(name):
    page, steps, count = shipped(name), 12, 5
    env, keys = page.env, np.asarray(report_keys(count))
    # Some begin a new episode on the way: its first image takes the place of all before.
    begun = np.float32([env.config.task.episode_length - 5, 0, 0, 0, 0])
    found = page.run(POLICY, keys=keys.ravel(), steps=steps, begun=begun)
    actions = found["actions"].reshape(steps, count, -1)
    batch = nominal(env)

    @jax.jit
    def run(keys, actions):
        def step(state, action):
            after = batch.step(state, action)
            return after, (state.obs, after.done)

        begin = batch.reset(keys)
        begin = begin.replace(info={**begin.info, "steps": jnp.asarray(begun)})
        return jax.lax.scan(step, begin, actions)[1]

    theirs, done = jax.device_get(run(keys, actions))
    assert done.sum() >= 1
    seen = theirs.pop(PIXELS)
    ours = np.stack(found["images"]).reshape(seen.shape)
    # There is something to see, and it moves.
    assert seen.std() > 10
    assert np.abs(seen[-1].astype(int) - seen[0]).max() > 50
    assert np.abs(ours.astype(int) - seen).max() <= 1
    # Some see an image and nothing else.
    numbers = {name: found["obs"].reshape(x.shape) for name, x in theirs.items()}
    for name, x in numbers.items():
        np.testing.assert_allclose(x, theirs[name], rtol=0, atol=1e-4)
    given = (x.reshape(steps * count, *x.shape[2:]) for x in (ours, *numbers.values()))
    expected, _ = jax.jit(as_jax(page.checkpoint, env))(*given)
    np.testing.assert_allclose(actions, expected.reshape(actions.shape), rtol=0, atol=1e-4)


LOOK = f"""{BEGIN}
const policy = policyOf(given.data.policies[given.data.policies.length - 1]);
fleet.drivenBy(policy);
for (let step = 0; step < 3; step++) fleet.step();
const image = (_, robot) => [...fleet.image(robot)];
const all = () => Uint8Array.from(Array.from({{ length: count }}, image).flat());
const seen = {{ images: all(), bytes: fleet.eyes.bytes.slice() }};
// Nobody looks while others drive, but the image of a robot is that of now.
fleet.drivenBy(null);
fleet.scripted = true;
for (let step = 0; step < 9; step++) fleet.step();
const blind = {{ images: all(), bytes: fleet.eyes.bytes.slice() }};
fleet.drivenBy(policy);
return {{ seen, blind, back: fleet.eyes.bytes.slice() }};
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", slow_unless(lambda name: name == "camera_real", CAMERAS))
def test_a_policy_that_takes_over_sees_what_is_there_now(name):
    page, count = shipped(name), 5
    found = page.run(LOOK, keys=np.asarray(report_keys(count)).ravel())
    about = page.data["meta"]["image"]
    pixels = about["height"] * about["width"]
    stack = (count, pixels, about["frames"], about["channels"])
    seen, blind = found["seen"], found["blind"]
    images = seen["images"].reshape(count, pixels, -1)
    np.testing.assert_array_equal(images, seen["bytes"].reshape(stack)[:, :, -1])
    np.testing.assert_array_equal(blind["bytes"], seen["bytes"])
    images = blind["images"].reshape(count, pixels, 1, -1)
    assert np.abs(images[:, :, 0].astype(int) - seen["bytes"].reshape(stack)[:, :, -1]).max() > 50
    np.testing.assert_array_equal(found["back"].reshape(stack), images.repeat(stack[2], axis=2))
