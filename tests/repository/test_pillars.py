"""The example with solid obstacles: the robot collides with them wherever they are drawn."""

import copy

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from jetbot_mjx.config import load_config
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.state import robot_state
from jetbot_mjx.errors import UserError

FAR = [[5.0, 0.0, 0.125], [5.0, 1.0, 0.125]]
"""Pillars out of the way."""

SECONDS = 1.5

# In front of the robot, a hand's breadth aside, so that it slides along, and out of the way.
PLACES = np.array(
    [[[0.5, 0.0, 0.125], *FAR], [[0.5, 0.09, 0.125], *FAR], [[0.5, 0.4, 0.125], *FAR]]
)


@pytest.fixture(scope="module")
def env(root):
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(root / "examples"))
        yield make_env(load_config(root / "examples" / "pillars.yaml"))


@pytest.fixture(scope="module")
def drives(env):
    """Straight ahead at full speed, once for each of `PLACES`: `qpos`, and what contact costs."""
    first = env.reset(jax.random.PRNGKey(0))
    steps = round(SECONDS / env.dt)

    def drive(pillars_w):
        goal = first.goal._replace(goal_w=jnp.array([9.0, 0.0, 0.05]), pillars_w=pillars_w)

        def step(state, _):
            state = env.step(state, jnp.array([1.0, 0.0]))
            return state, (state.pipeline_state.qpos, state.metrics["reward/contact"])

        return jax.lax.scan(step, first.replace(goal=goal), length=steps)[1]

    return jax.device_get(jax.jit(jax.vmap(drive))(jnp.asarray(PLACES, jnp.float32)))


@pytest.mark.slow
def test_a_pillar_stops_the_robot_at_its_surface(drives, env):
    import pillars_task

    x = drives[0][0, -1, 0]
    front = x + pillars_task.BUMPER_POS[0] + pillars_task.BUMPER_RADIUS
    assert front == pytest.approx(0.5 - pillars_task.PILLAR_RADIUS, abs=0.003)


@pytest.mark.slow
def test_a_pillar_beside_the_way_leaves_the_robot_alone(drives):
    assert drives[0][2, -1, 0] > 1.1
    assert abs(drives[0][2, -1, 1]) < 1e-3


def test_a_pillar_that_is_grazed_turns_the_robot_aside(drives):
    x, y = drives[0][1, -1, :2]
    assert y < -0.02
    assert x > drives[0][0, -1, 0] + 0.05


def test_touching_costs_in_every_step_of_it(drives):
    import pillars_task

    contact = drives[1]
    assert contact[0, 0] == 0
    assert contact[0, -1] == pytest.approx(-pillars_task.CONTACT_COST)
    assert np.all(contact[2] == 0)


def test_the_collision_is_that_of_c_mujoco(drives, env):
    model = copy.copy(env.mj_model)
    model.opt.iterations, model.opt.ls_iterations, model.opt.tolerance = 100, 50, 1e-12
    ctrl = np.asarray(env.wheel_targets(jnp.array([1.0, 0.0])))
    for places, qpos in zip(PLACES, drives[0], strict=True):
        data = mujoco.MjData(model)
        for i, place in enumerate(places):
            data.mocap_pos[model.body(f"pillar_{i}").mocapid[0]] = place
        data.ctrl[:] = ctrl
        for _ in range(len(qpos) * env.config.physics.n_substeps):
            mujoco.mj_step(model, data)
        np.testing.assert_allclose(qpos[-1, :2], data.qpos[:2], atol=0.001)


def test_the_robot_stays_on_its_wheels(drives):
    x, y = drives[0][..., 4], drives[0][..., 5]
    assert np.degrees(np.arccos(1 - 2 * (x**2 + y**2))).max() < 5


def test_pillars_keep_clear_of_start_and_goal(env):
    import pillars_task

    keys = jax.random.split(jax.random.PRNGKey(2), 4096)
    goal = jax.device_get(jax.jit(jax.vmap(env.task.sample))(keys))
    pillars, goals = goal.pillars_w[..., :2], goal.goal_w[:, None, :2]
    for gap in (pillars, pillars - goals):
        assert np.linalg.norm(gap, axis=-1).min() >= pillars_task.CLEARANCE - 1e-5


def test_the_nearest_pillar_is_seen_first(env):
    state = env.reset(jax.random.PRNGKey(0))
    places = jnp.array([[0.9, 0.0, 0.125], [0.0, 0.4, 0.125], [0.0, -0.6, 0.125]])
    seen = env.task.observe(
        robot_state(state.pipeline_state), state.goal._replace(pillars_w=places)
    )
    np.testing.assert_allclose(seen[-3:], [0.4, 0.6, 0.9], atol=1e-4)
    np.testing.assert_allclose(seen[7:9], [0.0, 0.4], atol=1e-2)


def test_a_solid_body_without_a_place_is_refused(env, monkeypatch):
    monkeypatch.setattr(env.task, "markers", lambda goal: {"goal": goal.goal_w})
    state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
    with pytest.raises(UserError, match="markers does not say where pillar_0, pillar_1, pillar_2"):
        jax.eval_shape(env.step, state, jnp.zeros(2))


def test_visual_geoms_are_not_in_the_physics_model(world_env, env):
    assert world_env.physics.mocap_names == ()
    assert env.physics.mocap_names == ("pillar_0", "pillar_1", "pillar_2")
