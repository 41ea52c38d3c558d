"""Boxes touch the floor with the corners that C MuJoCo has."""

import itertools
import threading

import jax
import mujoco
import numpy as np
from mujoco.mjx._src import collision_driver, forward

from helpers.own_robots import copy_robot
from jetbot_mjx.config import load_config
from jetbot_mjx.envs import box_contacts, make_env, mjx

BOX = """<mujoco><worldbody><geom type="plane" size="1 1 1"/>
<body><freejoint/><geom type="box" size="0.1 0.08 0.03"/></body></worldbody></mujoco>"""
CORNERS = np.array([*itertools.product((-1, 1), repeat=3)])
library = dict(collision_driver._COLLISION_FUNC)


def poses(count):
    """Poses of a box whose lowest corner is up to 15 mm below the floor, or above it."""
    rng = np.random.default_rng(0)
    turns = rng.standard_normal((count, 4)) * [1.0, 0.2, 0.2, 1.0]
    turns /= np.linalg.norm(turns, axis=1)[:, None]
    model = mujoco.MjModel.from_xml_string(BOX)
    data = mujoco.MjData(model)
    places = rng.uniform([-1, -1, -0.015], [1, 1, 0.002], (count, 3))
    for place, turn in zip(places, turns, strict=True):
        data.qpos[3:7] = turn
        mujoco.mj_kinematics(model, data)
        rotated = CORNERS * model.geom_size[1] @ data.geom_xmat[1].reshape(3, 3).T
        place[2] -= rotated[:, 2].min()
    return np.concatenate([places, turns], axis=1)


def touching(model, qpos):
    """The contacts of C MuJoCo: positions and distances, in order of the distance."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    rows = [[*contact.pos, contact.dist] for contact in data.contact]
    return np.array(sorted(rows, key=lambda row: row[3])).reshape(-1, 4)


def test_each_corner_below_the_floor_is_a_contact():
    model = mujoco.MjModel.from_xml_string(BOX)
    mjx_model, first = mjx.put_model(model), mjx.make_data(model)

    @jax.jit
    @jax.vmap
    def contacts(qpos):
        with box_contacts.every_corner():
            data = forward.fwd_position(mjx_model, first.replace(qpos=qpos))
        return data._impl.contact.pos, data._impl.contact.dist

    counts = []
    qpos = poses(256)
    for one, position, distance in zip(qpos, *map(np.asarray, contacts(qpos)), strict=True):
        wanted = touching(model, one)
        order = np.argsort(distance)[: np.sum(distance < 0)]
        found = np.concatenate([position[order], distance[order, None]], axis=1)
        counts.append(len(wanted))
        assert len(found) == len(wanted)
        np.testing.assert_allclose(found, wanted, atol=1e-6)
    assert {0, 1, 2, 3, 4} <= set(counts)


def test_a_robot_that_tips_onto_its_chassis_moves_as_in_c_mujoco(tmp_path):
    # The head of the rover is a box; here it reaches below the axles, in front of the wheels.
    solid = '<geom name="head" contype="1" conaffinity="1" friction="1 0.005 0.0001"'
    env = make_env(load_config(copy_robot(tmp_path, "rover", [('<geom name="head"', solid)])))
    model = env.physics.mj_model
    head = model.geom("robot/head")
    assert head.type == mujoco.mjtGeom.mjGEOM_BOX
    model.opt.iterations, model.opt.ls_iterations, model.opt.tolerance = 100, 50, 1e-12
    # Stand it on its head: corners at the floor, some deeper than others by more than 1 mm.
    rng, states = np.random.default_rng(0), []
    state = env.reset(jax.random.PRNGKey(0)).pipeline_state
    step = jax.jit(jax.vmap(env.physics.step, in_axes=(0, None)))
    for _ in range(64):
        turn = rng.uniform(-1, 1, 3) * [0.2, 0.2, 3.0] + [np.pi, 0, 0]
        quat = np.zeros(4)
        mujoco.mju_euler2Quat(quat, turn, "xyz")
        data = mujoco.MjData(model)
        data.qpos[3:7] = quat
        mujoco.mj_kinematics(model, data)
        turned = CORNERS * head.size @ data.geom_xmat[head.id].reshape(3, 3).T
        lowest = data.geom_xpos[head.id, 2] + turned[:, 2].min()
        data.qpos[2] -= lowest + rng.uniform(0.001, 0.01)
        states.append(data.qpos.copy())
    batch = jax.tree.map(lambda x: np.broadcast_to(x, (64, *np.shape(x))), state)
    ours = step(batch.replace(qpos=np.array(states, np.float32)), np.zeros(model.nu, np.float32))
    several = 0
    for qpos, qvel in zip(states, np.asarray(ours.qvel), strict=True):
        data = mujoco.MjData(model)
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        depths = [contact.dist for contact in data.contact]
        several += len(depths) > 1 and max(depths) - min(depths) > 1e-3
        mujoco.mj_step(model, data, nstep=env.config.physics.n_substeps)
        np.testing.assert_allclose(qvel, data.qvel, atol=2e-3)
    assert several > 8


def test_other_threads_and_the_time_after_have_mjx_s_own():
    model = mujoco.MjModel.from_xml_string(BOX)
    mjx_model, first = mjx.put_model(model), mjx.make_data(model)

    def program():
        return str(
            jax.make_jaxpr(lambda qpos: forward.fwd_position(mjx_model, first.replace(qpos=qpos)))(
                first.qpos
            )
        )

    alone, texts = program(), []
    with box_contacts.every_corner():
        thread = threading.Thread(target=lambda: texts.append(program()))
        thread.start()
        thread.join()
        assert program() != alone
    assert texts == [alone]
    assert library == collision_driver._COLLISION_FUNC
    assert program() == alone
