"""Robots with changed parameters against C MuJoCo, closed-form solutions, and the preset."""

import copy
import functools
import math

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from helpers.own_robots import load_robot
from jetbot_mjx.config import RobotParams, parse_config
from jetbot_mjx.devices import compiler_options
from jetbot_mjx.envs import kinematics, mjx
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.domain_randomization import LARGEST_TRACED, DomainRandomizationWrapper
from jetbot_mjx.envs.robot_model import make_mj_model
from jetbot_mjx.envs.robot_params import vary_model, vary_own_model
from jetbot_mjx.envs.robot_trial import drive_trial

ROBOTS = 16
STEPS = 256
MASSES = (0.8, 1.25)
CENTRES = ((0.01, -0.005, 0.005), (-0.015, 0.005, -0.01))
FRICTIONS = (0.4, 0.7, 1.0, 1.2)
POSITION_TOLERANCE = 1e-3  # [m] after 256 control steps
YAW_TOLERANCE = math.radians(0.5)

true_yaw = jax.jit(jax.vmap(kinematics.yaw))


def many(**fields):
    """One robot_params for each of `ROBOTS` robots: fields are cycled, the rest is the preset's."""
    columns = RobotParams()._replace(**fields)
    return RobotParams(*(jnp.resize(jnp.asarray(c, jnp.float32), (ROBOTS,)) for c in columns))


def straight(steps, drive):
    return jnp.broadcast_to(jnp.array([drive, 0.0]), (ROBOTS, steps, 2))


@functools.cache
def make_driver(preset):
    """An environment and a compiled `(robot_params (n,), actions (n, t, 2)) -> (physics, targets)`.

    Without a robot_params it drives the environment itself.
    """
    env = make_env(parse_config({"robot": {"preset": preset}}))

    def drive(robot_params, actions):
        def one(robot_params, actions):
            robot = env if robot_params is None else DomainRandomizationWrapper(env, robot_params)

            def step(state, action):
                state = robot.step(state, action)
                targets = (
                    jnp.zeros(2) if robot_params is None else state.episode_params.motors.targets
                )
                return state, (state.pipeline_state, targets)

            return jax.lax.scan(step, robot.reset(jax.random.PRNGKey(0)), actions)[1]

        return jax.vmap(one)(robot_params, actions)

    return env, jax.jit(drive, compiler_options=compiler_options(env.config.deterministic))


@pytest.fixture(params=["isaac", "real"])
def driver(request):
    return make_driver(request.param)


@pytest.fixture(scope="module")
def actions():
    """Held for 16 steps each."""
    drawn = np.random.default_rng(0).uniform(-1, 1, (ROBOTS, STEPS // 16, 2))
    return jnp.asarray(np.repeat(drawn, 16, axis=1), jnp.float32)


def varied_robot(robot, mass, friction, shift=(0.0, 0.0, 0.0)):
    changed = {
        "chassis_com": tuple(np.add(robot.chassis_com, shift)),
        "chassis_mass": mass * robot.chassis_mass,
        "chassis_inertia": tuple(mass * moment for moment in robot.moments_of_chassis),
        "friction": friction,
    }
    return robot.model_copy(update=changed)


def drive_in_c(env, mj_model, actions, height=None):
    """From the preset's initial pose, with a converged solver: qpos (t, nq)."""
    mj_model.opt.iterations, mj_model.opt.ls_iterations, mj_model.opt.tolerance = 100, 50, 1e-12
    data = mujoco.MjData(mj_model)
    data.qpos[:] = env.mj_model.qpos0
    data.qpos[2] = data.qpos[2] if height is None else height
    trail = []
    for target in np.asarray(jax.vmap(env.wheel_targets)(actions)):
        data.ctrl[:] = target
        mujoco.mj_step(mj_model, data, env.config.physics.n_substeps)
        trail.append(data.qpos.copy())
    return np.stack(trail)


def test_without_a_difference_the_robot_is_its_preset_to_the_bit(driver):
    env, _ = driver
    varied = jax.jit(lambda robot_params: vary_model(env.mjx_model, env.mj_model, robot_params))
    jax.tree.map(np.testing.assert_array_equal, varied(RobotParams()), env.mjx_model)


@pytest.mark.slow
@pytest.mark.parametrize(
    "driver", [pytest.param("isaac", marks=pytest.mark.slow), "real"], indirect=True
)
def test_without_a_difference_the_robot_drives_as_its_preset(driver, actions):
    """Not to the bit: where a number is known, a kernel has done its arithmetic beforehand."""
    _, drive = driver
    varied, preset = drive(many(), actions)[0], drive(None, actions)[0]
    np.testing.assert_allclose(varied.qpos[..., :7], preset.qpos[..., :7], atol=2e-5)


@pytest.mark.slow
def test_a_varied_robot_drives_as_one_compiled_with_its_numbers(driver, actions):
    env, drive = driver
    triples = [(m, f, *shift) for m in MASSES for f in FRICTIONS for shift in CENTRES]
    mass, friction, *shift = (np.resize(column, ROBOTS) for column in np.transpose(triples))
    centre = dict(zip(("com_x", "com_y", "com_z"), shift, strict=True))
    qpos = np.asarray(drive(many(mass=mass, friction=friction, **centre), actions)[0].qpos)
    preset = np.asarray(drive(many(), actions)[0].qpos)
    worst = {"position": 0.0, "yaw": 0.0, "difference": 0.0}
    for i in range(ROBOTS):
        robot = varied_robot(env.robot, mass[i], friction[i], np.transpose(shift)[i])
        expected = drive_in_c(env, make_mj_model(robot, env.config.physics), actions[i])
        distance = np.linalg.norm(expected[:, :3] - qpos[i, :, :3], axis=-1).max()
        turned = np.asarray(
            true_yaw(jnp.asarray(expected[:, 3:7], jnp.float32)) - true_yaw(qpos[i, :, 3:7])
        )
        turned = np.abs((turned + np.pi) % (2 * np.pi) - np.pi).max()
        difference = np.linalg.norm(expected[:, :3] - preset[i, :, :3], axis=-1).max()
        for name, value in (("position", distance), ("yaw", turned), ("difference", difference)):
            worst[name] = max(worst[name], value)
    print(
        f"\n{env.robot.label}: varied robots are within {worst['position'] * 1e3:.2f} mm"
        f" and {math.degrees(worst['yaw']):.2f}° of C MuJoCo over {STEPS} control steps; from"
        f" their preset they are up to {worst['difference'] * 1e3:.0f} mm away"
    )
    assert worst["position"] < POSITION_TOLERANCE
    assert worst["yaw"] < YAW_TOLERANCE
    assert worst["difference"] > 3 * POSITION_TOLERANCE


@pytest.mark.parametrize(("mass", "shift"), [*zip(MASSES, CENTRES, strict=True)])
def test_a_varied_model_is_the_one_that_mujoco_compiles(preset_env, mass, shift):
    robot = varied_robot(preset_env.robot, mass, 0.4, shift)
    compiled = mjx.put_model(make_mj_model(robot, preset_env.config.physics, visual=False))
    robot_params = RobotParams(0.4, mass, *shift)
    varied = vary_model(preset_env.mjx_model, preset_env.mj_model, robot_params)
    for name in ("body_mass", "body_ipos", "body_inertia", "body_invweight0", "pair_friction"):
        changed, preset = getattr(varied, name), getattr(preset_env.mjx_model, name)
        np.testing.assert_allclose(changed, getattr(compiled, name), rtol=1e-5, atol=1e-7)
        assert np.abs(changed - preset).max() > 1e-6


def test_the_motors_gain_scales_the_speed_and_its_limit(driver):
    _, drive = driver
    gains = np.linspace(0.85, 1.15, ROBOTS)
    # Full speed, which is the limit of a motor that has one.
    commands = straight(STEPS, 1.0)
    x = np.asarray(drive(many(motor_gain=gains), commands)[0].qpos[:, :, 0])
    preset = np.asarray(drive(many(), commands)[0].qpos[0, :, 0])
    ratio = (x[:, -1] - x[:, 120]) / (preset[-1] - preset[120])
    np.testing.assert_allclose(ratio, gains, rtol=2e-3)


def test_unequal_wheels_drive_in_the_circle_that_kinematics_predicts(driver):
    env, drive = driver
    mismatch = np.concatenate([np.linspace(-0.1, -0.02, 8), np.linspace(0.02, 0.1, 8)])
    # Slow: the faster a curve, the more its centrifugal force turns the robot further in.
    physics, _ = drive(many(wheel_radius_mismatch=mismatch), straight(STEPS, -0.9))
    qvel = np.asarray(physics.qvel)
    speed, yaw_rate = qvel[:, 120:, :2], qvel[:, 120:, 5].mean(axis=1)
    radius = np.linalg.norm(speed, axis=-1).mean(axis=1) / yaw_rate
    # v / ω = b (ω_R + ω_L) / 2 (ω_R - ω_L): a larger left wheel drives to the right.
    np.testing.assert_allclose(radius, -env.robot.wheel_separation / mismatch, rtol=0.02)


def test_wheels_of_another_size_and_distance_drive_as_a_robot_built_so(driver):
    env, drive = driver
    radius, separation = 1.04, 0.95
    # Slow, as above.
    actions = jnp.broadcast_to(jnp.array([-0.8, 0.2]), (ROBOTS, STEPS, 2))
    entered, preset = (
        np.asarray(drive(one, actions)[0].qpos)[0]
        for one in (many(wheel_radius=radius, wheel_separation=separation), many())
    )
    changed = {
        "wheel_radius": radius * env.robot.wheel_radius,
        "wheel_separation": separation * env.robot.wheel_separation,
        "wheel_inertia": env.robot.moments_of_wheel,
    }
    built = make_mj_model(env.robot.model_copy(update=changed), env.config.physics)
    expected = drive_in_c(env, built, actions[0], height=built.qpos0[2])
    away = np.linalg.norm(expected[:, :2] - entered[:, :2], axis=-1).max()
    difference = np.linalg.norm(expected[:, :2] - preset[:, :2], axis=-1).max()
    print(
        f"\n{env.robot.label}: entered as wheel speeds, {away * 1e3:.1f} mm from a robot"
        f" built so; the preset is {difference * 1e3:.0f} mm away"
    )
    assert away < 5e-3
    assert difference > 10 * away


def test_a_delay_shifts_the_response_by_its_steps(driver, actions):
    _, drive = driver
    delays = np.resize(np.arange(LARGEST_TRACED["action_delay"] + 1), ROBOTS)
    # Wheel speeds, which hardly feel that the robot settles meanwhile.
    same = jnp.broadcast_to(actions[:1], actions.shape)
    late = np.asarray(drive(many(action_delay=delays), same)[0].qvel[:, :, 6:])
    prompt = np.asarray(drive(many(), same)[0].qvel[0, :, 6:])
    assert np.abs(np.diff(prompt, axis=0)).max() > 1.0
    for i, delay in enumerate(delays):
        assert np.abs(late[i, :delay]).max(initial=0.0) < 0.05
        np.testing.assert_allclose(late[i, delay:], prompt[: STEPS - delay], atol=0.2)


def test_a_limit_of_the_motors_lies_ahead_of_their_lag(driver):
    env, drive = driver
    _, targets = drive(many(motor_lag=0.1), straight(STEPS, 1.0))
    speed = env.robot.max_wheel_speed or 1.0 / env.robot.controller_wheel_radius
    expected = speed * (1.0 - np.exp(-np.arange(1, STEPS + 1) * env.dt / 0.1))
    np.testing.assert_allclose(targets[0, :, 0], expected, rtol=1e-4)


def test_one_program_serves_all_values(driver):
    _, drive = driver
    drive(many(), straight(STEPS, 0.0))
    before = drive._cache_size()
    drive(many(friction=0.5, mass=1.1, action_delay=3), straight(STEPS, 0.5))
    assert drive._cache_size() == before


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "tolerance"), [("turtlebot", 3e-3), ("car", 3e-3), ("rover", 0.1)]
)
def test_the_softness_of_contacts_of_an_own_robot_may_stay_where_its_mass_differs(name, tolerance):
    env = make_env(load_robot(name))
    varied = RobotParams()._replace(mass=1.25, com_x=-0.015)
    ours = vary_own_model(env.physics.model, varied)
    kept = copy.copy(env.physics.mj_model)
    for array in ("body_mass", "body_inertia", "body_ipos", "body_invweight0"):
        getattr(kept, array)[:] = getattr(ours, array)
    right = copy.copy(kept)
    mujoco.mj_setConst(right, mujoco.MjData(right))
    base = env.physics.mj_model.jnt_bodyid[0]
    assert kept.body_mass[base] == pytest.approx(1.25 * env.physics.mj_model.body_mass[base])
    assert right.body_invweight0[base, 0] < 0.9 * kept.body_invweight0[base, 0]
    one, other = (drive_trial(env.config, model, env.drive) for model in (kept, right))
    assert one.speed == pytest.approx(other.speed, rel=3e-3)
    assert one.turn == pytest.approx(other.turn, rel=tolerance)
