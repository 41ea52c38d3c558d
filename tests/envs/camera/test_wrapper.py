"""The camera as an observation: when it renders, what it stacks, and which bodies it sees."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from helpers import gliding
from jetbot_mjx.config import parse_config
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.camera.render import Camera
from jetbot_mjx.envs.camera.wrapper import NUMBERS, PIXELS
from jetbot_mjx.envs.state import robot_state
from jetbot_mjx.envs.task import Field, GoalTask
from jetbot_mjx.envs.wrappers import wrap_for_training
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation.evaluator import report_keys

ENVS, STEPS, LENGTH, FRAMES = 3, 7, 4, 3


@pytest.fixture(scope="module", autouse=True)
def glide():
    with gliding.everywhere():
        yield


def make_config(observation="camera", *, randomization=None, **camera):
    camera = {"width": 12, "height": 10, "samples": 1} | camera
    return parse_config(
        {
            "task": {"observation": observation, "episode_length": LENGTH},
            "camera": camera,
            "randomization": randomization or {},
        }
    )


def counted(monkeypatch):
    calls = []
    render = Camera.render
    monkeypatch.setattr(
        Camera, "render", lambda self, *given: calls.append(1) or render(self, *given)
    )
    return calls


@pytest.mark.parametrize("randomization", [{}, {"wheel_radius": [0.9, 1.1]}])
@pytest.mark.parametrize("action_repeat", [1, 3])
def test_a_step_renders_once(monkeypatch, action_repeat, randomization):
    env = make_env(make_config(randomization=randomization))
    wrapped = wrap_for_training(env, LENGTH, action_repeat)
    calls = counted(monkeypatch)
    state = jax.eval_shape(wrapped.reset, report_keys(ENVS))
    assert len(calls) == 1
    calls.clear()
    jax.eval_shape(wrapped.step, state, jnp.zeros((ENVS, 2)))
    assert len(calls) == 1


@pytest.fixture(scope="module")
def episodes():
    """The environment, and the states of some steps beyond an episode's end, time first."""
    env = make_env(make_config("camera+egocentric", frames=FRAMES))
    wrapped = wrap_for_training(env, LENGTH)

    @jax.jit
    def run(keys):
        first = wrapped.reset(keys)

        def step(state, action):
            nstate = wrapped.step(state, action)
            return nstate, nstate

        actions = jax.random.uniform(keys[0], (STEPS, ENVS, 2), minval=-1.0)
        return first, jax.lax.scan(step, first, actions)[1]

    first, states = jax.device_get(run(report_keys(ENVS)))
    return env, jax.tree.map(lambda x, y: np.concatenate([x[None], y]), first, states)


def rendered(env, states):
    """The image of every state, rendered apart from all wrappers."""

    def render(state):
        robot = robot_state(state.pipeline_state)
        pose = env.camera.pose(robot.position_w, robot.quat)
        return env.camera.render(pose, env.task.markers(state.goal))

    return np.asarray(jax.jit(jax.vmap(jax.vmap(render)))(states))


def test_frames_are_stacked_and_an_episode_begins_with_copies(episodes):
    env, states = episodes
    images = rendered(env, states)
    assert len(np.unique(images[:, 0], axis=0)) > STEPS // 2
    assert images.dtype == np.uint8
    seen = states.obs[PIXELS]
    assert seen.dtype == np.uint8
    assert seen.shape == (STEPS + 1, ENVS, 10, 12, 3 * FRAMES)
    assert states.done[LENGTH].all()
    for time in range(STEPS + 1):
        begin = LENGTH if time >= LENGTH else 0
        stack = [images[max(time - back, begin)] for back in reversed(range(FRAMES))]
        # Within one step of 255: XLA may round otherwise in another program.
        difference = np.abs(seen[time].astype(int) - np.concatenate(stack, axis=-1))
        assert difference.max() <= 1, time


def test_the_observation_after_an_end_is_of_the_new_episode(episodes):
    env, states = episodes
    # Images and numbers are those of the new robot at rest, `final_obs` has the old one's numbers.
    observe = jax.vmap(lambda state: env.observe(robot_state(state.pipeline_state), state.goal))
    for time in range(STEPS + 1):
        state = jax.tree.map(lambda x, time=time: x[time], states)
        np.testing.assert_allclose(state.obs[NUMBERS], observe(state), rtol=1e-5, atol=1e-6)
    final = states.info["final_obs"]
    assert final.shape == (STEPS + 1, ENVS, 7)
    differs = np.abs(final - states.obs[NUMBERS]).max(-1) > 1e-3
    assert differs[LENGTH].all()
    assert not differs[[0, 1, 2, 3, 5, 6, 7]].any()


def test_an_unwrapped_environment_sees_too():
    env = make_env(make_config("camera+world", colour="grey", frames=2))
    assert env.observation_size == {PIXELS: (10, 12, 2), NUMBERS: (16,)}
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    nstate = jax.jit(env.step)(state, jnp.ones(2))
    assert jax.tree.map(lambda x: (x.shape, x.dtype), nstate) == jax.tree.map(
        lambda x: (x.shape, x.dtype), state
    )
    shapes = {name: part.shape for name, part in nstate.obs.items()}
    assert shapes == env.observation_size
    np.testing.assert_array_equal(nstate.obs[PIXELS][..., 0], state.obs[PIXELS][..., 1])
    assert make_env(make_config()).observation_size == {PIXELS: (10, 12, 3)}


# Tasks of one's own.


class Crates(GoalTask):
    """Has a number of its own, a wall, a crate that every episode puts elsewhere, and a mark."""

    layout = (Field("crate_side", 1, "m", "body"),)

    def __init__(self, config):
        super().__init__(config)
        self.layout = Crates.layout

    def observe(self, robot, goal):
        return goal[1:2] - robot.position_w[1:2]

    def markers(self, goal):
        side = goal[1]
        return {
            "goal": jnp.array([0.0, 5.0, 0.05]),
            "crate": jnp.stack([jnp.float32(0.6), side, jnp.float32(0.05)]),
            "mark": jnp.array([0.5, -0.1, 0.02]),
        }

    def build_scene(self, spec):
        world, box = spec.worldbody, mujoco.mjtGeom.mjGEOM_BOX
        world.add_geom(name="wall", type=box, size=(0.01, 1, 0.1), pos=(1.5, 0, 0.1), group=1)
        crate = world.add_body(name="crate", mocap=True)
        crate.add_geom(name="crate", type=box, size=(0.05, 0.05, 0.05), contype=1, conaffinity=1)
        mark = world.add_body(name="mark", mocap=True)
        sphere = mujoco.mjtGeom.mjGEOM_SPHERE
        mark.add_geom(name="mark", type=sphere, size=(0.03, 0, 0), contype=0, conaffinity=0)


def test_a_task_s_bodies_stand_in_the_picture():
    env = make_env(make_config("camera+world", width=64, height=48, fovy=60.0), own_class=Crates)
    assert env.observation_size == {PIXELS: (48, 64, 3), NUMBERS: (1,)}
    state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
    assert state.obs[NUMBERS].shape == (1,)

    @jax.jit
    def ids(goal):
        pose = env.camera.pose(jnp.array([0.0, 0.0, 0.0325]), jnp.array([1.0, 0.0, 0.0, 0.0]))
        return env.camera.trace(pose, env.task.markers(goal))[1]

    columns = []
    for side in (0.15, 0.3):
        found = np.asarray(ids(jnp.array([0.0, side, 0.0])))
        names = {env.mj_model.geom(i).name for i in np.unique(found[found >= 0])}
        assert names == {"floor", "wall", "crate", "mark"}
        columns.append(np.nonzero(found == env.mj_model.geom("crate").id)[1].mean())
    # What moves to the left moves to the left in the picture.
    assert columns[1] < columns[0] - 5


def with_mesh(spec):
    vertices = [0, 0, 0, 0.1, 0, 0, 0, 0.1, 0, 0, 0, 0.1]
    spec.add_mesh(name="rock", uservert=vertices)
    geom = {"type": mujoco.mjtGeom.mjGEOM_MESH, "meshname": "rock", "pos": (1, 0, 0.5)}
    spec.worldbody.add_geom(name="rock", contype=0, conaffinity=0, **geom)


def with_joint(spec):
    body = spec.worldbody.add_body(name="door", pos=(2, 0, 0.5))
    body.add_joint(name="hinge", type=mujoco.mjtJoint.mjJNT_HINGE, axis=(0, 0, 1))
    box = mujoco.mjtGeom.mjGEOM_BOX
    body.add_geom(name="door", type=box, size=(0.1, 0.1, 0.1), mass=1, contype=1)


def with_lamp(spec):
    lamp = spec.worldbody.add_light(name="lamp", pos=(0, 0, 2))
    lamp.type = mujoco.mjtLightType.mjLIGHT_SPOT


@pytest.mark.parametrize(
    ("build_scene", "message"),
    [
        (with_mesh, "cannot draw 'rock', a mesh: build it of plane, sphere"),
        (with_joint, "cannot draw 'door', which moves by joints"),
        (with_lamp, "light 'lamp' has a position: set its type to directional"),
    ],
)
def test_an_invalid_range_is_refused_in_one_line(build_scene, message):
    class Own(GoalTask):
        def build_scene(self, spec):
            build_scene(spec)

    with pytest.raises(UserError) as error:
        make_env(make_config(), own_class=Own)
    assert message in str(error.value)
    assert str(error.value).startswith("task.observation: the camera ")
    # Whoever sees nothing may have it.
    if build_scene is not with_joint:
        make_env(make_config("world"), own_class=Own)
