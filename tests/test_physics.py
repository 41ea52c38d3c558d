"""Oracles: MJX against C MuJoCo and against closed form, and what must never happen."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from jetbot_mjx import kinematics, mjx, model
from jetbot_mjx.config import parse_config
from jetbot_mjx.env import make_env
from jetbot_mjx.model import make_mj_model

STEPS = 256
POSITION_TOLERANCE = 5e-3  # [m] after 256 control steps
YAW_TOLERANCE = math.radians(2.0)
SOLVER_TOLERANCE = 2e-3  # [m] after 1 s, against the converged solution
CLOSED_FORM_TOLERANCE = 0.015
WORST_TILT = 4.0  # [°]

true_yaw = jax.jit(jax.vmap(kinematics.yaw))


@pytest.fixture(scope="module", params=["isaac", "real"])
def driver(request):
    """An environment and `(model, actions (n, t, 2)) -> physics (t, n, ...)`."""
    env = make_env(parse_config({"robot": {"preset": request.param}}))

    def drive(mjx_model, actions):
        here = env.with_model(mjx_model)

        def step(physics, action):
            ctrl = jax.vmap(env.wheel_targets)(action)
            physics = jax.vmap(here.step_physics)(physics, ctrl)
            return physics, physics

        keys = jnp.zeros((len(actions), 2), jnp.uint32)
        first = jax.vmap(env.reset)(keys).pipeline_state
        return jax.lax.scan(step, first, actions.swapaxes(0, 1))[1]

    return env, drive


def drive_in_c(env, mj_model, actions):
    """The same actions in C MuJoCo: qpos (t, nq)."""
    data = mujoco.MjData(mj_model)
    targets = np.asarray(jax.vmap(env.wheel_targets)(actions))
    trail = []
    for target in targets:
        data.ctrl[:] = target
        mujoco.mj_step(mj_model, data, env.config.physics.n_substeps)
        trail.append(data.qpos.copy())
    return np.stack(trail)


def held(rng, draw, environments, hold):
    """Actions that are held for `hold` steps each."""
    actions = draw(rng, (environments, STEPS // hold, 2))
    return jnp.asarray(np.repeat(actions, hold, axis=1), jnp.float32)


def uniform(rng, shape):
    return rng.uniform(-1, 1, shape)


def bang_bang(rng, shape):
    return rng.choice([-1.0, 1.0], shape)


def converged(mj_model):
    mj_model.opt.iterations, mj_model.opt.ls_iterations, mj_model.opt.tolerance = 100, 50, 1e-12
    return mj_model


def test_mjx_follows_c_mujoco(driver):
    env, drive = driver
    actions = held(np.random.default_rng(0), uniform, 16, hold=16)
    qpos = np.asarray(drive(env.mjx_model, actions).qpos)
    reference = converged(make_mj_model(env.robot, env.config.physics))
    worst = {"after 1 s": 0.0, "position": 0.0, "yaw": 0.0}
    for index in range(actions.shape[0]):
        expected = drive_in_c(env, reference, actions[index])
        distance = np.linalg.norm(expected[:, :3] - qpos[:, index, :3], axis=-1)
        turned = np.asarray(
            true_yaw(jnp.asarray(expected[:, 3:7], jnp.float32)) - true_yaw(qpos[:, index, 3:7])
        )
        turned = np.abs((turned + np.pi) % (2 * np.pi) - np.pi)
        worst["after 1 s"] = max(worst["after 1 s"], distance[59])
        worst["position"] = max(worst["position"], distance.max())
        worst["yaw"] = max(worst["yaw"], turned.max())
    print(
        f"\n{env.config.robot.preset}: MJX is within {worst['position'] * 1e3:.2f} mm and"
        f" {math.degrees(worst['yaw']):.2f}° of converged C MuJoCo over {STEPS} control steps,"
        f" within {worst['after 1 s'] * 1e3:.2f} mm after 1 s"
    )
    assert worst["after 1 s"] < SOLVER_TOLERANCE
    assert worst["position"] < POSITION_TOLERANCE
    assert worst["yaw"] < YAW_TOLERANCE


def test_straight_driving_and_spinning_match_closed_form(driver):
    env, drive = driver
    limits = {"max_speed": 1.0, "max_yaw_rate": math.pi}
    speed = 1.0 if env.robot.max_wheel_speed is None else 0.4
    twists = jnp.array([[speed, 0.0], [0.0, math.pi], [0.0, -1.0]])
    actions = jax.vmap(lambda twist: kinematics.action_from_twist(twist, **limits))(twists)
    physics = drive(env.mjx_model, jnp.repeat(actions[:, None], STEPS, axis=1))
    velocity = np.asarray(physics.qvel[120:]).mean(axis=0)  # after the motors' run-up
    geometry = {
        "wheel_radius": model.WHEEL_RADIUS,
        "wheel_separation": model.WHEEL_SEPARATION,
    }
    wheels = jax.vmap(env.wheel_targets)(actions)
    expected = jax.vmap(lambda w: kinematics.body_twist(w, **geometry))(wheels)
    forward = np.asarray(physics.qpos[-1, 0, 0] - physics.qpos[120, 0, 0]) / (
        (STEPS - 121) * env.dt
    )
    print(
        f"\n{env.config.robot.preset}: straight {forward:.4f} m/s of {speed},"
        f" spin {velocity[1, 5]:.4f} rad/s of {expected[1, 1]:.4f},"
        f" {velocity[2, 5]:.4f} of {expected[2, 1]:.4f}"
    )
    np.testing.assert_allclose(forward, speed, rtol=CLOSED_FORM_TOLERANCE)
    np.testing.assert_allclose(velocity[1, 5], expected[1, 1], rtol=CLOSED_FORM_TOLERANCE)
    np.testing.assert_allclose(velocity[2, 5], expected[2, 1], rtol=CLOSED_FORM_TOLERANCE)


@pytest.mark.parametrize("friction", [1.0, 0.4])
def test_nothing_flips_under_held_bang_bang_actions(driver, friction):
    env, drive = driver
    robot = dataclasses.replace(env.robot, friction=friction)
    mjx_model = mjx.put_model(make_mj_model(robot, env.config.physics, visual=False))
    rng = np.random.default_rng(1)
    actions = jnp.concatenate([held(rng, bang_bang, 64, hold) for hold in (4, 8, 16, 32)])
    physics = drive(mjx_model, actions)
    assert np.all(np.isfinite(physics.qpos))
    assert np.all(np.isfinite(physics.qvel))
    tilt = np.degrees(jax.vmap(jax.vmap(kinematics.tilt))(physics.qpos[:, :, 3:7]).max())
    print(f"\n{env.config.robot.preset}, friction {friction}: worst tilt {tilt:.2f}°")
    assert tilt < WORST_TILT


def test_physics_keeps_full_precision_in_its_matrix_products():
    # TF32, the GPU's default for float32 products, makes the contact solver diverge.
    env = make_env(parse_config({"physics": {"impl": "xla"}}))
    state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
    step = jax.make_jaxpr(env.step_physics)(state.pipeline_state, jnp.zeros(2))
    products = [e for e in _equations(step.jaxpr) if e.primitive.name == "dot_general"]
    assert products
    highest = (jax.lax.Precision.HIGHEST, jax.lax.Precision.HIGHEST)
    assert {product.params["precision"] for product in products} == {highest}


def _equations(jaxpr):
    for equation in jaxpr.eqns:
        yield equation
        for value in equation.params.values():
            for inner in jax.tree.leaves(value, is_leaf=lambda x: hasattr(x, "eqns")):
                inner = getattr(inner, "jaxpr", inner)
                if hasattr(inner, "eqns"):
                    yield from _equations(inner)
