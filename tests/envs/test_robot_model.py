"""The compiled robot model against the published numbers of each preset."""

import mujoco
import numpy as np
import pytest

from jetbot_mjx.config import PhysicsConfig, RobotConfig
from jetbot_mjx.envs.robot_model import make_mj_model
from jetbot_mjx.errors import UserError


@pytest.fixture(params=["isaac", "real"])
def robot(request):
    return RobotConfig(preset=request.param)


def test_the_presets_numbers_arrive_in_the_compiled_model(robot):
    compiled = make_mj_model(robot, PhysicsConfig())
    assert (compiled.nq, compiled.nv, compiled.nu) == (9, 8, 2)
    np.testing.assert_allclose(compiled.body("jetbot").mass, robot.chassis_mass)
    np.testing.assert_allclose(compiled.body("jetbot").ipos, robot.chassis_com)
    np.testing.assert_allclose(compiled.body("jetbot").inertia, robot.moments_of_chassis)
    assert compiled.npair == 2 + len(robot.casters)
    for side, y in (("left", 0.057), ("right", -0.057)):
        wheel = compiled.body(f"{side}_wheel")
        np.testing.assert_allclose(wheel.mass, robot.wheel_mass)
        np.testing.assert_allclose(wheel.inertia, robot.moments_of_wheel)
        np.testing.assert_allclose(wheel.pos, (0.0, y, 0.0))
        np.testing.assert_allclose(compiled.geom(f"{side}_wheel").size[0], robot.wheel_radius)
        np.testing.assert_allclose(compiled.joint(f"{side}_wheel_joint").damping, 0.0)
        dof = compiled.joint(f"{side}_wheel_joint").dofadr[0]
        np.testing.assert_allclose(compiled.dof_armature[dof], robot.armature)
        motor = compiled.actuator(side)
        np.testing.assert_allclose(motor.forcerange, (-robot.motor_torque, robot.motor_torque))
        np.testing.assert_allclose(motor.gainprm[0], robot.motor_gain)
        np.testing.assert_allclose(motor.biasprm[2], -robot.motor_gain)
        assert bool(motor.ctrllimited[0]) == (robot.max_wheel_speed is not None)
        if robot.max_wheel_speed is not None:
            np.testing.assert_allclose(motor.ctrlrange[1], robot.max_wheel_speed)
        pair = compiled.pair(f"{side}_wheel")
        assert pair.dim[0] == 3
        np.testing.assert_allclose(pair.friction[:2], robot.friction)
    for i, caster in enumerate(robot.casters):
        geom = compiled.geom(f"caster_{i}")
        height = -0.0325 + caster.clearance + caster.radius
        np.testing.assert_allclose(geom.size[0], caster.radius)
        np.testing.assert_allclose(geom.pos, (caster.x, caster.y, height))
        assert compiled.pair(f"caster_{i}").dim[0] == 1  # frictionless


def test_the_total_masses_are_the_published_ones():
    for name, total in (("isaac", 2.5), ("real", 0.694)):
        compiled = make_mj_model(RobotConfig(preset=name), PhysicsConfig())
        np.testing.assert_allclose(compiled.body_mass.sum(), total)


def test_physics_options_arrive_in_the_compiled_model(robot):
    physics = PhysicsConfig(
        ctrl_dt=0.02, sim_dt=0.005, iterations=7, ls_iterations=3, tolerance=1e-5
    )
    option = make_mj_model(robot, physics).opt
    assert option.timestep == 0.005
    assert (option.iterations, option.ls_iterations, option.tolerance) == (7, 3, 1e-5)
    assert option.integrator == mujoco.mjtIntegrator.mjINT_EULER
    assert option.disableflags & mujoco.mjtDisableBit.mjDSBL_EULERDAMP


def test_explicit_euler_is_stable_for_the_motors(robot):
    # timestep · gain / inertia must stay below 2.
    inertia = robot.moments_of_wheel[1] + robot.armature
    assert PhysicsConfig().sim_dt * robot.motor_gain / inertia < 2.0


def test_cameras_cube_and_floor_are_in_the_scene(robot):
    compiled = make_mj_model(robot, PhysicsConfig())
    cameras = {compiled.camera(i).name for i in range(compiled.ncam)}
    assert cameras == {"chase", "top", "onboard"}
    assert compiled.body("goal").mocapid[0] == 0
    np.testing.assert_allclose(compiled.geom("goal").size, 0.05)
    assert not compiled.geom("goal").contype
    assert not compiled.geom("goal").conaffinity


def test_visual_geoms_change_no_physics(robot):
    shown, stripped = (
        make_mj_model(robot, PhysicsConfig(), visual=visual) for visual in (True, False)
    )
    assert stripped.ngeom == 3 + len(robot.casters)
    assert stripped.ncam == 0
    states = []
    for compiled in (shown, stripped):
        data = mujoco.MjData(compiled)
        data.ctrl[:] = (20.0, 8.0)
        for _ in range(120):
            mujoco.mj_step(compiled, data)
        states.append(data.qpos.copy())
    np.testing.assert_array_equal(*states)
    assert np.linalg.norm(states[0][:2]) > 0.1  # and it did drive


def test_the_robot_begins_at_rest(robot):
    compiled = make_mj_model(robot, PhysicsConfig())
    data = mujoco.MjData(compiled)
    for _ in range(60):
        mujoco.mj_step(compiled, data)
    np.testing.assert_allclose(data.qpos[:7], compiled.qpos0[:7], atol=2e-5)
    assert 0.0315 < compiled.qpos0[2] < 0.0325  # the soft contact gives by up to 0.8 mm


def test_a_tasks_own_body_joins_the_scene():
    def build_scene(spec):
        body = spec.worldbody.add_body(name="pillar", mocap=True)
        body.add_geom(size=(0.05, 0.05, 0.05))

    compiled = make_mj_model(RobotConfig(), PhysicsConfig(), build_scene=build_scene)
    assert compiled.body("pillar").mocapid[0] == 1


def test_friction_is_a_number_of_the_robot():
    slippery = RobotConfig(preset="real", friction=0.4)
    compiled = make_mj_model(slippery, PhysicsConfig())
    np.testing.assert_allclose(compiled.pair("left_wheel").friction[:2], 0.4)


def test_what_shows_has_the_size_of_the_measures():
    wide = {"chassis_size": (0.272, 0.18, 0.108), "wheel_radius": 0.065, "wheel_width": 0.039}
    plain, large = (
        make_mj_model(RobotConfig(**measures), PhysicsConfig()) for measures in ({}, wide)
    )
    for name in ("tray", "left_tyre", "left_spoke_1"):
        ratio = large.geom(name).size / np.maximum(plain.geom(name).size, 1e-9)
        np.testing.assert_allclose(ratio[plain.geom(name).size > 0], 2.0)
    np.testing.assert_allclose(large.geom("tray").pos, 2 * plain.geom("tray").pos)


def test_a_robot_that_leans_is_refused():
    casters = [{"x": -0.082, "y": 0.0, "radius": 0.01, "clearance": 0.03}]
    with pytest.raises(UserError, match=r"leans 2.° to the rear: support it there"):
        make_mj_model(RobotConfig(preset="real", casters=casters), PhysicsConfig())


def test_a_robot_that_sways_for_longer_is_waited_for():
    top_heavy = RobotConfig(preset="real", chassis_com=(-0.03, 0.0, 0.5))
    assert make_mj_model(top_heavy, PhysicsConfig()).qpos0[2] == pytest.approx(0.03, abs=1e-3)


def test_motors_that_are_unstable_are_told_with_what_would_help():
    with pytest.raises(UserError, match=r"stable below 6.3e-06 s: make robot.motor_gain smaller"):
        make_mj_model(RobotConfig(preset="real", motor_gain=100.0), PhysicsConfig())
