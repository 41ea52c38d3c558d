"""Robots that are MuJoCo models of their own: their scene, their wheels, and what is refused."""

import copy
import json
import re

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from helpers.broken_robots import BROKEN
from helpers.further import slow_unless
from helpers.own_robots import EXAMPLES, OWN_ROBOTS, copy_robot, copy_tricycle, load_robot
from jetbot_mjx.config import MjcfRobotConfig, load_config, model_files, parse_config
from jetbot_mjx.envs import make_env
from jetbot_mjx.envs.mjcf_wheels import guess_section
from jetbot_mjx.envs.robot_model import robot_body
from jetbot_mjx.envs.robot_trial import drive_trial
from jetbot_mjx.errors import UserError

HOLD = 16
"""Environment steps for which a command of the drives is held."""


@pytest.fixture(scope="module")
def env_of():
    envs = {name: make_env(load_robot(name)) for name in OWN_ROBOTS}
    return envs.get


@pytest.mark.parametrize("name", OWN_ROBOTS)
def test_the_robot_stands_in_the_scene_and_looks_ahead(env_of, name):
    env = env_of(name)
    model = env.mj_model
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert robot_body(model).startswith("robot/")
    np.testing.assert_allclose(model.qpos0[:2], 0.0)
    assert {model.camera(i).name for i in range(model.ncam)} >= {"chase", "onboard", "top"}
    ahead = -data.cam_xmat[model.camera("chase").id].reshape(3, 3)[:, 2]
    assert ahead[0] > 0.8
    assert data.cam_xpos[model.camera("chase").id][0] < -0.5
    # Only what touches takes part in physics.
    assert env.physics.mj_model.ngeom < model.ngeom
    assert env.physics.mj_model.ncam == 0


def test_the_wheels_are_found_with_their_places(env_of):
    rover = env_of("rover").drive
    assert rover.wheel_radius == pytest.approx(0.05)
    assert rover.wheel_separation == 0.45
    places = [(one.actuator, round(one.x, 4), round(one.y, 4)) for one in rover.wheels]
    assert places == [(0, 0.085, 0.1), (1, 0.085, -0.1), (2, -0.085, 0.1), (3, -0.085, -0.1)]
    car = env_of("car").drive
    assert car.rear == pytest.approx(0.0)
    assert [round(one.x, 4) for one in car.steered] == [0.16, 0.16]
    # At the largest curvature the inner wheel is at its limit.
    controls = np.asarray(car.controls(jnp.array([0.0, car.max_curvature])))
    assert np.abs(controls[2:]).max() == pytest.approx(0.7, rel=1e-5)


@pytest.mark.parametrize(("axis", "y", "gain"), [("0 -1 0", 0.08, -1.0), ("0 1 0", 0.08, 1.0)])
def test_a_wheel_that_turns_the_other_way_gets_the_other_sign(tmp_path, axis, y, gain):
    changes = [('name="left_wheel" axis="0 1 0"', f'name="left_wheel" axis="{axis}"')]
    env = make_env(load_config(copy_robot(tmp_path, "turtlebot", changes)))
    left = env.drive.wheels[0]
    assert (left.y, left.gain) == (pytest.approx(y), gain)


def test_a_gear_is_part_of_the_control(tmp_path):
    changes = [('kv="0.08" forcerange="-0.2 0.2"', 'kv="0.0008" gear="10" forcerange="-0.02 0.02"')]
    env = make_env(load_config(copy_robot(tmp_path, "turtlebot", changes)))
    assert [one.gain for one in env.drive.wheels] == [10.0, 10.0]


@pytest.mark.parametrize("broken", BROKEN.values(), ids=list(BROKEN))
def test_a_broken_robot_gets_one_clear_line(tmp_path, monkeypatch, broken, capfd):
    config = copy_robot(tmp_path, broken.robot, broken.changes, broken.settings)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError) as error:
        make_env(load_config(config))
    assert broken.said in str(error.value)
    assert "\n" not in str(error.value)
    assert capfd.readouterr() == ("", "")
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()


IMPLICIT = '<option integrator="implicitfast"/>'
ARMATURE = 'armature="1.5e-3"'
FIXED = '<fixed name="t" armature="1e-4"><joint joint="front_left" coef="1"/></fixed>'
MOTOR = '<velocity name="fl"'


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (MOTOR, f'{MOTOR} delay="0.1" nsample="10"', "the delay of an actuator (randomization."),
        (MOTOR, f'{MOTOR} damping="0.05"', "the damping of an actuator (that of a joint it"),
        (MOTOR, f'{MOTOR} armature="0.005"', "the armature of an actuator (that of a joint it"),
        (ARMATURE, f'{ARMATURE} damping="0 1e-4"', "damping of a joint with more numbers than"),
        (ARMATURE, f'{ARMATURE} stiffness="0 1e-4"', "stiffness of a joint with more numbers"),
        (
            "</mujoco>",
            f"<tendon>{FIXED}</tendon></mujoco>",
            "the armature of a tendon as MuJoCo does: leave it out",
        ),
        ('size="0.05"', 'size="1e308"', "size of a geom has a length of 1e+308 m: lengths are"),
        ('solref="0.04 1"', 'solref="-1 1"', "one number is above 0 and one is not: give two"),
        (
            "<worldbody>",
            '<option integrator="implicitfast"/><worldbody>',
            "motors at their limits (forcerange, actuatorfrcrange) as MuJoCo does: leave",
        ),
    ],
)
def test_what_mjx_leaves_out_unsaid_is_refused(tmp_path, old, new, said):
    with pytest.raises(UserError, match=re.escape(said)):
        make_env(load_config(copy_robot(tmp_path, "rover", [(old, new)])))


@pytest.mark.slow
def test_motors_without_limits_may_be_integrated_implicitly(tmp_path):
    changes = [('forcerange="-1.2 1.2"', ""), ("<worldbody>", IMPLICIT + "<worldbody>")]
    env = make_env(load_config(copy_robot(tmp_path, "rover", changes)))
    apart, _, _ = drive_both_ways(env, 4, 0.5)
    assert apart.max() < 1e-5


def test_a_model_that_this_process_has_not_read_is_asked_for():
    values = load_robot("rover").model_dump(mode="json")
    values["robot"]["sha256"] = "0" * 64
    with pytest.raises(UserError, match="load a configuration that names its file"):
        make_env(parse_config(values))


def test_parts_are_guessed_by_their_axes_and_sides():
    for name in OWN_ROBOTS:
        robot = load_robot(name).robot
        assert isinstance(robot, MjcfRobotConfig)
        files = model_files(robot.sha256)
        section = guess_section(robot.file, files)
        given = robot.model_dump(mode="json", exclude_defaults=True, exclude={"sha256"})
        given.pop("wheel_separation", None)
        assert section == given
    assert guess_section("x.xml", {"x.xml": b"<mujoco/>"}) == {}
    assert guess_section("x.xml", {"x.xml": b"\xff"}) == {}


FAR = 2e-3  # [m] that few robots are apart, and by pushes C MuJoCo's own too


def drive_both_ways(env, robots, seconds):
    """Positions [m] of robots after commands at the limits, in MJX and in converged C MuJoCo."""
    count = round(seconds / env.dt)
    rng = np.random.default_rng(0)
    drawn = rng.choice([-1.0, 1.0], (robots, count // HOLD + 1, 2))
    actions = jnp.asarray(np.repeat(drawn, HOLD, axis=1)[:, :count], jnp.float32)
    ctrl = jax.vmap(jax.vmap(lambda x: env.drive.controls(env.wheel_targets(x))))(actions)
    keys = jax.random.split(jax.random.PRNGKey(0), robots)

    def drive(ctrl):
        first = jax.vmap(env.reset)(keys).pipeline_state
        step = jax.vmap(env.physics.step)
        return jax.lax.scan(lambda x, u: (step(x, u), None), first, ctrl.swapaxes(0, 1))[0]

    ours = np.asarray(jax.jit(drive)(ctrl).qpos)[:, :3]
    model = copy.copy(env.physics.mj_model)
    model.opt.iterations, model.opt.ls_iterations, model.opt.tolerance = 100, 50, 1e-12

    def in_c(controls, push=0.0, seed=0):
        data, rng = mujoco.MjData(model), np.random.default_rng(seed)
        for control in controls:
            data.qvel[:] += push * rng.choice([-1.0, 1.0], model.nv)
            data.ctrl[:] = control
            mujoco.mj_step(model, data, nstep=env.config.physics.n_substeps)
        return data.qpos[:3].copy()

    controls = np.asarray(ctrl, float)
    theirs = np.stack([in_c(one) for one in controls])
    apart = np.linalg.norm(ours - theirs, axis=1)
    # Of those that are further apart, how far C MuJoCo's own robot moves by pushes of 1e-6 a step.
    pushed = np.zeros(robots)
    for i in np.flatnonzero(apart > FAR):
        ends = [in_c(controls[i], 1e-6, seed) for seed in range(8)]
        pushed[i] = np.linalg.norm(ends - theirs[i], axis=1).max()
    return apart, pushed, theirs


@pytest.mark.parametrize("name", slow_unless("rover".__eq__, OWN_ROBOTS))
def test_it_drives_as_in_converged_c_mujoco(env_of, name):
    apart, _, places = drive_both_ways(env_of(name), 8, 1.0)
    assert np.median(apart) < 5e-6
    assert np.median(np.linalg.norm(places[:, :2], axis=1)) > 0.1  # and it did drive


@pytest.mark.slow
@pytest.mark.parametrize("name", OWN_ROBOTS)
def test_a_hundred_of_them_stay_together_for_four_seconds(env_of, name):
    apart, pushed, _ = drive_both_ways(env_of(name), 128, 4.0)
    print(f"\n{name}: median {1e3 * np.median(apart):.4f} mm, largest {1e3 * apart.max():.3f} mm")
    assert np.median(apart) < 5e-5
    assert ((apart <= FAR) | (pushed > 0.5 * apart)).all()
    assert (apart <= FAR).mean() >= 0.99


OWN_DRIVE = """
import jax.numpy as jnp


def controls(action):
    # A number for each wheel: front left, front right, rear left, rear right.
    return 10.0 * action
"""


@pytest.fixture
def own_drive(tmp_path):
    """The configuration of a rover whose action has a number for each wheel."""
    (tmp_path / "wheels.py").write_text(OWN_DRIVE)
    own = {"drive": "wheels.py:controls", "action_size": 4, "wheels": None}
    own["wheel_separation"] = None
    return copy_robot(tmp_path, "rover", settings=own)


@pytest.mark.slow
def test_an_own_function_drives_all_actuators(own_drive):
    env = make_env(load_config(own_drive))
    assert env.action_size == 4
    state = env.reset(jax.random.PRNGKey(0))
    state = jax.jit(env.step)(state, jnp.array([1.0, -1.0, 1.0, -3.0]))
    assert state.pipeline_state.qvel[5] < 0.0  # it turns to the right
    np.testing.assert_array_equal(env.action_of_twist(jnp.zeros(2)), [-1.0, 0.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("def controls(action): return action[:3]", "returns the shape [3]: the model has 4"),
        ("def control(action): return action", "AttributeError: module 'wheels' has no attribute"),
        (
            "import numpy as np\ndef controls(action): return np.asarray(action)",
            "'wheels.py:controls' is not written in JAX (TracerArrayConversionError): take",
        ),
        (
            "def controls(action): return action if action[0] > 0 else -action",
            "is not written in JAX (TracerBoolConversionError)",
        ),
        ("import nothing_like_it", "ModuleNotFoundError: No module named 'nothing_like_it'"),
        ("raise SystemExit(0)", "robot.drive = 'wheels.py:controls': SystemExit: 0"),
        (
            "def controls(action): return action / 0.0",
            "a control that is not finite for the action",
        ),
        ("def controls(action): return 1e6 * action", "unstable with physics.sim_dt"),
    ],
)
def test_an_own_function_that_does_not_fit_gets_one_line(own_drive, code, said):
    (own_drive.parent / "wheels.py").write_text(code)
    changes = [('forcerange="-1.2 1.2"', "")] if "1e6" in code else []
    own = {"drive": "wheels.py:controls", "action_size": 4, "wheels": None}
    own_drive = copy_robot(own_drive.parent, "rover", changes, own)
    with pytest.raises(UserError) as error:
        make_env(load_config(own_drive))
    assert said in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("own", "said"),
    [
        ({"drive": "wheels.py"}, "'wheels.py' is no drive: it should be differential, ackermann"),
        ({"drive": "tank"}, "'tank' is no drive"),
        ({"drive": "none.py:f", "wheels": None}, "none.py does not exist"),
        (
            {"drive": "wheels.py:controls"},
            "drive = 'wheels.py:controls' moves all actuators by itself: leave",
        ),
        ({"wheels": None}, "a differential drive has wheels on both sides"),
        ({"action_size": 3}, "action_size = 3: that of differential is 2"),
    ],
)
def test_drives_that_do_not_fit_their_settings_get_one_line(own_drive, own, said):
    config = copy_robot(own_drive.parent, "rover", settings=own)
    with pytest.raises(UserError) as error:
        load_config(config)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("name", OWN_ROBOTS)
def test_the_exported_policies_of_the_examples_are_of_these_robots(name):
    onnxruntime = pytest.importorskip("onnxruntime")
    folder = EXAMPLES / "policies" / name
    spec = json.loads((folder / "policy.json").read_text("utf-8"))
    robot = load_robot(name).robot
    assert spec["robot"] == robot.model_dump(mode="json")
    session = onnxruntime.InferenceSession(folder / "policy.onnx")
    # It turns to goals half a metre to the left and to the right.
    for side in (1.0, -1.0):
        seen = np.array([0.0, 0.5 * side, 0.0, side, 0.5, 0.1, 0.0], np.float32)
        (action,) = session.run(["action"], {"obs": seen[None]})[0]
        assert side * action[1] > 0.3


SENSORS = (
    ("<freejoint/>", '<freejoint/><site name="imu"/><site name="other" pos="0 0 0.1"/>'),
    ("</mujoco>", '<sensor><gyro site="imu"/><jointvel joint="left_wheel"/></sensor></mujoco>'),
)
STRUT = '<tendon><spatial name="t"><site site="imu"/><site site="other"/></spatial></tendon>'


@pytest.mark.parametrize("more", ["", STRUT])
def test_sites_of_sensors_and_tendons_do_no_harm(tmp_path, more):
    changes = (*SENSORS, ("</mujoco>", f"{more}</mujoco>"))
    env = make_env(load_config(copy_robot(tmp_path, "turtlebot", changes)))
    assert env.physics.mj_model.nsensor == 0
    assert env.physics.mj_model.ntendon == bool(more)


def test_settings_of_a_model_are_taken_or_left_without_a_word(
    tmp_path, monkeypatch, capfd, recwarn
):
    ours = (
        '<option timestep="0.002" gravity="0 0 -3.7" solver="CG" o_solref="0.01 1"/>'
        '<size memory="20M" nuserdata="3"/><statistic extent="3"/>'
        '<visual><map znear="0.1"/><global offwidth="2000"/></visual><worldbody>'
    )
    config = load_config(copy_robot(tmp_path, "turtlebot", [("<worldbody>", ours)]))
    monkeypatch.chdir(tmp_path)
    option = make_env(config).physics.mj_model.opt
    assert option.gravity[2] == -3.7
    assert option.timestep == pytest.approx(config.physics.sim_dt)
    assert capfd.readouterr() == ("", "")
    assert not recwarn.list
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()


def test_angles_of_the_base_are_not_those_of_its_start(tmp_path):
    changes = [('<body name="base"', '<body euler="0 0 0.5" name="base"')]
    env = make_env(load_config(copy_robot(tmp_path, "turtlebot", changes)))
    assert env.mj_model.qpos0[6] == 0.0


def test_a_base_far_above_the_goals_needs_a_larger_radius(tmp_path):
    # The frame of the base is 0.2 m above the axle, and the robot the same.
    higher = (
        ('pos="0 0 0.033"', 'pos="0 0 0.233"'),
        ('pos="0 0.08 0"', 'pos="0 0.08 -0.2"'),
        ('pos="0 -0.08 0"', 'pos="0 -0.08 -0.2"'),
        ('pos="-0.03 0 0.02"', 'pos="-0.03 0 -0.18"'),
        ('pos="-0.081 0 -0.023"', 'pos="-0.081 0 -0.223"'),
    )
    config = copy_robot(tmp_path, "turtlebot", higher)
    said = (
        "goals are 0.05 m above the floor, and the body of turtlebot is 0.232 m above it: set 0.21"
    )
    with pytest.raises(UserError, match=f"task.success_radius = 0.1 cannot be reached: {said}"):
        make_env(config)
    env = make_env(config, {"task.success_radius": 0.21})
    assert env.mj_model.qpos0[2] == pytest.approx(0.233, abs=1e-3)


def test_files_of_one_name_in_two_folders_are_two(tmp_path):
    corners = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"
    for folder in ("shows", "touches"):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "body.obj").write_text(corners)
    meshes = '<asset><mesh name="s" file="shows/body.obj"/><mesh name="t" file="touches/body.obj"/>'
    changes = [("<worldbody>", meshes + "</asset><worldbody>")]
    assert make_env(load_config(copy_robot(tmp_path, "turtlebot", changes))).mj_model.nmesh == 2


def test_a_car_with_front_wheel_drive_turns_about_its_rear_axle(tmp_path):
    changes = [(f'joint="rear_{side}"', f'joint="front_{side}"') for side in ("left", "right")]
    env = make_env(load_config(copy_robot(tmp_path, "car", changes)))
    assert env.drive.rear == pytest.approx(0.0)
    trial = drive_trial(env.config, env.physics.mj_model, env.drive)
    assert trial.turn == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize("driven", ["rear", "front"])
def test_a_car_with_one_steered_wheel_is_a_bicycle(tmp_path, driven):
    config = load_config(copy_tricycle(tmp_path, driven=driven))
    env = make_env(config)
    car, base = env.drive, 0.16
    assert car.max_curvature == pytest.approx(np.tan(0.7) / base)
    controls = np.asarray(car.controls(jnp.array([10.0, 2.0])))
    assert controls[-1] == pytest.approx(np.arctan(2.0 * base))
    front, left = np.hypot(1.0, 2.0 * base), 1.0 - 2.0 * 0.065
    assert controls[0] == pytest.approx(10.0 * (front if driven == "front" else left))
    trial = drive_trial(config, env.physics.mj_model, car)
    assert trial[:2] == pytest.approx((1.0, 1.0), abs=0.05)
    assert trial.veer == pytest.approx(0.0, abs=1e-6)
    section = guess_section(config.robot.file, model_files(config.robot.sha256))
    assert parse_config({"robot": section | {"sha256": config.robot.sha256}}).robot == config.robot


def test_stops_of_the_steering_limit_it_too(tmp_path):
    changes = [('range="-0.72 0.72"', 'range="-0.2 0.2"')]
    car = make_env(load_config(copy_robot(tmp_path, "car", changes))).drive
    controls = np.asarray(car.controls(jnp.array([0.0, car.max_curvature])))
    assert np.abs(controls[2:]).max() == pytest.approx(0.2, rel=1e-5)
