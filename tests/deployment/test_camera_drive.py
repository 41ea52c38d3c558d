"""Driving by camera: images are resized, checked and logged, with a SimulatedCamera."""

import contextlib
import json
import math
import sys
import types
from pathlib import Path

import numpy as np
import pytest

from jetbot_mjx import sim2real
from jetbot_mjx.config import CameraConfig, Config
from jetbot_mjx.deployment.drive_log import read_log
from jetbot_mjx.deployment.drive_pictures import picture_strip
from jetbot_mjx.deployment.policy_spec import _image
from jetbot_mjx.deployment.simulated_camera import CameraModel, camera_config
from jetbot_mjx.deployment.simulated_jetbot import MotorModel, SimulatedJetBot
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.camera import lens
from jetbot_mjx.envs.camera.mujoco_camera import MujocoCamera
from jetbot_mjx.errors import UserError

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "deploy"))

import camera_sense
import drive
import motors
import rehearse
import rehearse_camera
import undistort

PERIOD = 0.05
RED, FLOOR = (224, 36, 31), (200, 205, 202)
YAML = """%YAML:1.0
---
image_width: 640
image_height: 480
{more}camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 2.5e+02, 0., 3.2e+02, 0.,
       2.4e+02, 2.3e+02, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: {count}
   dt: d
   data: [ {numbers} ]
"""

# Not as OpenCV writes it: the only list in brackets is another matrix.
NO_BRACKETS = (
    YAML.split("distortion")[0].format(more="")
    + """distortion_coefficients:
   data:
   - 0.1
rectification_matrix:
   data: [1, 0, 0, 0]
"""
)


def make_policy(act, **camera):
    spec = {
        "image": _image(CameraConfig(width=32, height=32, **camera), PERIOD),
        "observation": [],
        "control_period": PERIOD,
        "wheel_speeds": {"wheel_radius": 0.0325},
        "success_radius": 0.1,
        "goal_height": 0.05,
        "rest_height": 0.0321,
        "run": "test",
        "env_steps": 0,
        "task": "t",
        "robot": "real",
    }
    return drive.Policy(act, spec, lambda image, before: np.concatenate([image, image], axis=2))


def servo(image):
    """Turn until the cube is in sight, then towards it, and drive the faster the less it turns."""
    pixels = image.reshape(-1, image.shape[-1])[:, -3:].astype(float)
    red = pixels[:, 0] > 1.8 * np.maximum(pixels[:, 1], pixels[:, 2]) + 10
    if not red.any():
        speed, yaw_rate = 0.0, 1.2
    else:
        aside = 15.5 - np.mean(np.flatnonzero(red) % 32)
        speed, yaw_rate = 0.2 * max(1.0 - abs(aside) / 10.0, 0.0), 0.12 * aside
    turn = 0.5 * yaw_rate * 0.1125
    return (speed, yaw_rate), ((speed - turn) / 0.0325, (speed + turn) / 0.0325)


def ahead(image):
    return (0.0, 0.0), (6.0, 6.0)


class Clock:
    """A robot and a clock that record the motor values."""

    def __init__(self):
        self.time, self.values = 0.0, []

    def now(self):
        return self.time

    def sleep(self, seconds):
        self.time += seconds

    def set_motors(self, left, right):
        self.values.append((self.time, left, right))


class FakeCamera:
    """Noisy pictures of the floor, 20 a second; `fault` breaks it from 1 to 2 s."""

    def __init__(self, clock, fault=None):
        self.clock, self.fault, self.frozen, self.stopped = clock, fault, None, False

    @property
    def value(self):
        if self.fault and 1.0 <= self.clock.now() < 2.0:
            if self.fault == "frozen":
                return self.frozen
            if self.fault == "black":
                rng = np.random.default_rng(int(1e3 * self.clock.now()))
                return rng.integers(0, 9, (224, 224, 3), np.uint8)
            if self.fault == "too small":
                rng = np.random.default_rng(int(1e3 * self.clock.now()))
                return rng.integers(99, 200, (31, 224, 3), np.uint8)
            return None if self.fault == "missing" else np.zeros((224, 224), np.float32)
        rng = np.random.default_rng(int(self.clock.now() / PERIOD + 1e-6))
        noise = rng.integers(-3, 4, (224, 224, 3))
        self.frozen = (np.array(FLOOR[::-1]) + noise).astype(np.uint8)
        return self.frozen

    def stop(self):
        self.stopped = True


def by_camera(policy, camera, clock, timeout=3.0, settings=None):
    calibration, lines = motors.default_calibration(), []
    settings = settings or camera_sense.CameraSettings()
    sense = camera_sense.CameraSense(camera, policy, calibration, settings)
    outcome = drive.drive_by(clock, clock, sense, policy, calibration, timeout, lines.append)
    return outcome, lines


# Pictures.


@pytest.mark.parametrize("side", [224, 100])
def test_a_pixel_is_the_mean_of_its_area(side):
    image = make_policy(ahead).spec["image"]
    picture = np.random.default_rng(0).integers(0, 256, (side, side, 3), np.uint8)
    found = undistort.Reducer(image, (side, side))(picture)
    # Every pixel cut into 32 parts, so that 32 of `side` cover whole parts.
    fine = picture.repeat(8, axis=0).repeat(8, axis=1).astype(float)
    wanted = fine.reshape(32, side // 4, 32, side // 4, 3).mean(axis=(1, 3))
    assert np.abs(found - wanted).max() <= 0.51


@pytest.mark.parametrize("fisheye", [False, True])
def test_a_calibration_of_opencv_is_read_and_bends_as_the_package_unbends(tmp_path, fisheye):
    numbers = (-0.02, 0.004, -0.003, 0.0005) if fisheye else (-0.1, 0.02, 0.002, -0.001, 0.001)
    text = YAML.format(
        more="fisheye_model: 1\n" * fisheye,
        count=len(numbers),
        numbers=", ".join(map(str, numbers)),
    )
    (tmp_path / "lens.yaml").write_text(text)
    found = undistort.read_lens(str(tmp_path / "lens.yaml"))
    assert found == ((640, 480), (250.0, 240.0, 320.0, 230.0), numbers, fisheye)
    x, y = np.meshgrid(np.linspace(-0.8, 0.8, 9), np.linspace(-0.6, 0.6, 7))
    undo = lens._undistort_fisheye if fisheye else lens._undistort
    bent = undistort.distort(x, y, calibration=found)
    np.testing.assert_allclose(undo(*bent, numbers), (x, y), atol=1e-4)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "lacks camera_matrix"),
        (YAML.format(more="", count=2, numbers="1, x"), "lacks|could not convert"),
        (YAML.format(more="", count=1, numbers="0").replace("image_width", "w"), "image_width"),
        (YAML.format(more="", count=2, numbers="0, 1e308"), r"has 1e\+308, which no lens has"),
        (YAML.format(more="", count=2, numbers="-Infinity, 0"), "has -inf, which no lens has"),
        (YAML.format(more="", count=9, numbers="0,0,0,0,0,0,0,0,1"), "takes 8 coefficients"),
        (YAML.format(more="", count=1, numbers="0").replace("640", "9" * 5000), "are impossible"),
        (NO_BRACKETS, r"lacks distortion_coefficients with its data in \[\.\.\.\]"),
        ("cameraResolution: [0, 0]\n" + YAML.format(more="", count=1, numbers="0"), "0 x 0 pixels"),
    ],
)
def test_an_invalid_calibration_is_refused_in_one_line(tmp_path, text, said):
    (tmp_path / "lens.yaml").write_text(text)
    with pytest.raises(motors.DriveError, match=said) as caught:
        undistort.read_lens(str(tmp_path / "lens.yaml"))
    assert "\n" not in str(caught.value)


def test_a_lens_of_the_policys_own_is_not_taken_out_twice():
    image = make_policy(ahead, lens="fisheye", fovy=100.0).spec["image"]
    calibration = undistort.LensCalibration((224, 224), (70.0, 70.0, 112.0, 112.0), (), True)
    with pytest.raises(motors.DriveError, match="'fisheye', and takes the picture as it is"):
        undistort.Reducer(image, (224, 224), calibration)
    image = make_policy(ahead).spec["image"]
    with pytest.raises(motors.DriveError, match=r"shows .*% of what"):
        undistort.Reducer(image, (224, 224), calibration._replace(matrix=(300.0, 300.0, 112, 112)))


def test_a_lens_whose_polynomial_turns_back_shows_nothing_twice():
    image = make_policy(ahead).spec["image"]
    matrix = 250.0, 250.0, 320.0, 240.0
    # The calibration of the middle of a wide lens: r (1 - 0.3 r²) turns at r = 1.05.
    calibration = undistort.LensCalibration((640, 480), matrix, (-0.3,), False)
    with pytest.raises(motors.DriveError, match=r"shows .*% of what"):
        undistort.Reducer(image, (224, 224), calibration)
    x, y, once = undistort.distort_once(
        np.array([0.0, 0.5, -1.0, 1.2, 1.7]), np.zeros(5), calibration=calibration
    )
    np.testing.assert_array_equal(once, [True, True, True, False, False])
    np.testing.assert_allclose(x, [0.0, 0.4625, -0.7, 0.703, 0.703], atol=1e-3)
    assert not y.any()


# The watchdog.


@pytest.mark.parametrize("fault", ["frozen", "black", "missing", "of another shape", "too small"])
def test_a_camera_that_fails_stops_the_motors_in_time_and_is_believed_again(fault):
    clock = Clock()
    outcome, lines = by_camera(make_policy(ahead), FakeCamera(clock, fault), clock)
    still = [time for time, *values in clock.values if values == [0.0, 0.0]]
    stopped = [time for time in still if 1.0 <= time < 2.05]
    last = max(line["t"] for line in lines if "picture" in line and line["t"] < 1.5)
    assert min(stopped) - last <= camera_sense.FRAME_STALE_AFTER + PERIOD + 1e-6
    assert max(stopped) < 2.0 + 1e-6
    driving = [time for time, left, _ in clock.values if left > 0.1]
    assert [time for time in driving if time < 1.2]
    assert [time for time in driving if time > 2.0]
    assert not [time for time in driving if min(stopped) <= time < 2.0 - 1e-6]
    assert not outcome.reached
    assert outcome.stale_ticks >= 13


def test_some_lost_pictures_stop_nothing_and_no_picture_starts_nothing():
    class Seldom(FakeCamera):
        @property
        def value(self):
            return super().value if self.clock.now() % 0.2 < 0.05 else None

    clock = Clock()
    outcome, _ = by_camera(make_policy(ahead), Seldom(clock), clock)
    assert outcome.stale_ticks == 0
    clock = Clock()
    outcome, _ = by_camera(make_policy(ahead), types.SimpleNamespace(value=None), clock)
    assert not np.any([values for _, *values in clock.values])


def test_stacked_and_grey_images_are_those_of_training():
    shapes = []
    for settings in ({"colour": "grey"}, {"frames": 2}):
        clock = Clock()
        policy = make_policy(lambda image: shapes.append(image) or ahead(image), **settings)
        by_camera(policy, FakeCamera(clock), clock, timeout=0.2)
    grey = [image for image in shapes if image.shape == (32, 32, 1)]
    assert abs(int(grey[-1].mean()) - 203) <= 2
    assert shapes[-1].shape == (32, 32, 6)
    np.testing.assert_allclose(shapes[-1][..., :3].mean((0, 1)), FLOOR, atol=1.5)


# Arrival.


def test_the_goal_is_reached_where_it_stands_on_the_floor_near_the_axle():
    policy = make_policy(ahead)
    rows, columns = camera_sense.floor_arc(policy.spec, 0.045)
    assert rows.min() > 20
    assert columns.min() < 13 < 18 < columns.max()
    with pytest.raises(motors.DriveError, match="does not see the floor"):
        camera_sense.floor_arc(policy.spec, 0.01)
    for grey in ((90, 90, 90), (0, 0, 0)):
        with pytest.raises(motors.DriveError, match="is grey"):
            camera_sense.colour_share(np.zeros((1, 3), np.uint8), grey)
    for colour, share in ((RED, 1.0), (FLOOR, 0.0), ((60, 5, 5), 1.0), ((20, 0, 0), 0.0)):
        pixels = np.array([colour], np.uint8)
        assert camera_sense.colour_share(pixels, camera_sense.GOAL_COLOUR) == share


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda spec: spec.pop("image"), "observes numbers: give --goal"),
        (lambda spec: spec.update(observation=[{"name": "goal_position"}]), "needs goal_position"),
    ],
)
def test_a_policy_that_needs_more_than_images_is_refused(change, said):
    policy = make_policy(ahead)
    change(policy.spec)
    with pytest.raises(motors.DriveError, match=said):
        by_camera(policy, None, Clock())


# The command line.


@pytest.fixture
def folder(tmp_path):
    policy = make_policy(ahead)
    spec = {**policy.spec, "files": {"numpy": "policy.py"}, "rest_quaternion": [1, 0, 0, 0]}
    (tmp_path / "policy.json").write_text(json.dumps(spec))
    (tmp_path / "policy.py").write_text("def act(image):\n    return (0.0, 0.0), (6.0, 6.0)\n")
    return tmp_path


def test_the_robots_own_camera_drives_and_is_stopped(folder, monkeypatch, capsys):
    clock = Clock()
    camera, asked = FakeCamera(clock), []
    module = types.ModuleType("jetbot")
    module.Camera = types.SimpleNamespace(instance=lambda **size: asked.append(size) or camera)
    module.Robot = lambda: clock
    monkeypatch.setitem(sys.modules, "jetbot", module)
    log = folder / "drive.jsonl"
    arguments = [str(folder), "--camera", "--timeout", "1", "--log", str(log), "--goal", "1", "0"]
    assert drive.main(arguments, clock=clock) == 1
    assert asked == [{"width": 224, "height": 224}]
    assert camera.stopped
    assert "by camera; 20 periods" in capsys.readouterr().out
    header, *lines = map(json.loads, log.read_text().splitlines())
    assert (header["pose_source"], header["goal"]) == ("odometry", [1.0, 0.0])
    assert header["image"]["width"] == 32
    assert len([line for line in lines if "picture" in line]) >= 19


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--camera"], "no camera here"),
        (["--camera", "--tracker", "9870"], "two senses"),
        (["--camera", "--tracker-key", "nowhere"], "--tracker-key and --camera are two senses"),
        (["--goal", "1", "0"], "this policy sees: drive with --camera"),
        (["--goal", "1", "0", "--undistort", "x"], "--undistort is about pictures"),
        (["--camera", "--undistort", "nowhere.yaml"], "nowhere.yaml: No such file"),
        (["--camera", "--goal-colour", "9", "9", "9"], "is grey"),
        ([], "give --goal X Y, or --camera"),
    ],
)
def test_mistakes_are_told_in_one_line(folder, arguments, said, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "jetbot", None)
    assert drive.main([str(folder), "--dry-run", *arguments]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda spec: spec["image"].pop("height"), "policy.json lacks image.height"),
        (lambda spec: spec["image"].pop("camera"), "policy.json lacks image.camera"),
        (
            lambda spec: spec["image"]["camera"].pop("matrix"),
            "policy.json lacks image.camera.matrix",
        ),
        (lambda spec: spec["image"].update(frames=2), "policy.py lacks stack"),
        (
            lambda spec: spec.update(control_period=0),
            "policy.json has control_period = 0: it should",
        ),
        (lambda spec: spec.update(control_period=math.nan), "policy.json has control_period = nan"),
        (lambda spec: spec.update(rest_height="x"), "policy.json has rest_height = 'x': it should"),
        (lambda spec: spec.update(rest_height=10**400), "policy.json has rest_height = 1000"),
        (lambda spec: spec["image"].update(frames=1.5), "policy.json has image.frames = 1.5: it"),
        (
            lambda spec: spec["image"]["camera"].update(position=[0.0, None, 0.1]),
            "policy.json has image.camera.position = [0.0, None, 0.1]: it should be 3 numbers",
        ),
        (
            lambda spec: spec["image"]["camera"].update(lens=["pinhole"]),
            "policy.json has image.camera.lens = ['pinhole']",
        ),
    ],
)
def test_a_damaged_policy_is_told_in_one_line(folder, change, said, capsys):
    spec = json.loads((folder / "policy.json").read_text())
    change(spec)
    (folder / "policy.json").write_text(json.dumps(spec))
    assert drive.main([str(folder), "--dry-run", "--camera"]) == 2
    error = capsys.readouterr().err
    assert f"is not an exported policy: {said}" in error
    assert error.count("\n") == 1


def write_log(path, goal, timeout=2.0):
    """Drive straight ahead by camera, and log it."""
    clock, policy = Clock(), make_policy(ahead)
    settings = camera_sense.CameraSettings(goal=goal)
    _, lines = by_camera(policy, FakeCamera(clock), clock, timeout, settings)
    header = drive.log_header(policy, motors.default_calibration(), settings, "camera")
    path.write_text("".join(json.dumps(line) + "\n" for line in [header, *lines]))


@pytest.mark.parametrize("goal", [None, (0.6, 0.0)])
def test_a_log_is_replayed_with_its_pictures(tmp_path, goal, capsys):
    write_log(tmp_path / "drive.jsonl", goal)
    assert sim2real.main([str(tmp_path / "drive.jsonl")]) == 0
    told = capsys.readouterr().out
    assert "41 pictures" in told
    assert ("from the goal" in told) == (goal is not None)
    found = json.loads((tmp_path / "drive.sim2real.json").read_text())
    assert (found["goal_distance_logged"] is None) == (goal is None)
    assert found["position_error_max"] < 0.05
    log = read_log(tmp_path / "drive.jsonl")
    np.testing.assert_allclose(log.pictures[0].image.mean((0, 1)), FLOOR, atol=1.5)
    at = np.array([0.0, 1.0, 2.0])
    strip = picture_strip(log.header, log.pictures, at, np.zeros((3, 3)))
    assert strip.shape == (32 if goal is None else 64, 8 * 32, 3)
    # The simulated robot sees the cube.
    red = strip[32:].astype(int)
    assert (goal is None) or np.any(red[..., 0] > 2 * red[..., 1])


def test_a_picture_of_another_size_is_no_log(tmp_path):
    path = tmp_path / "drive.jsonl"
    write_log(path, None)
    path.write_text(path.read_text().replace('"height": 32', '"height": 31'))
    with pytest.raises(UserError, match=r"is not a log of deploy/drive\.py: line 2"):
        read_log(path)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda header: header["image"].pop("camera"), "lacks 'camera'"),
        (lambda header: header["image"]["camera"]["matrix"].pop("fx"), "lacks 'fx'"),
        (lambda header: header["image"]["camera"].update(lens="none"), "lens Input should be"),
        (lambda header: header.update(goal=[float("nan"), 0.0]), "its goal is [nan, 0.0]"),
    ],
)
def test_a_damaged_header_is_told_in_one_line(tmp_path, change, said):
    path = tmp_path / "drive.jsonl"
    write_log(path, (0.6, 0.0), timeout=0.2)
    first, *others = path.read_text().splitlines()
    header = json.loads(first)
    change(header)
    path.write_text("\n".join([json.dumps(header), *others]))
    with pytest.raises(UserError, match=r"is not a log of deploy/drive\.py: line 1: ") as caught:
        read_log(path)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


# In the SimulatedJetBot.


def rehearsal(appearance="plain", camera=None, **settings):
    model = MotorModel(delay=0.0)
    calibration = rehearse.true_calibration(model)
    camera = camera or CameraModel()
    policy = make_policy(servo, **settings)
    return rehearse_camera.CameraRehearsal(policy, calibration, model, camera, appearance)


@pytest.mark.parametrize("name", ["faults", "searches"])
def test_fewer_than_no_drives_is_a_mistake(folder, name, capsys):
    assert rehearse.main([str(folder), "--camera", f"--{name}", "-3"]) == 2
    assert capsys.readouterr().err == f"error: --{name} -3: give at least 0\n"


@pytest.mark.parametrize("name", ["rate", "noise"])
def test_poses_have_no_place_beside_a_camera(folder, name, capsys):
    assert rehearse.main([str(folder), "--camera", f"--{name}", "30"]) == 2
    said = f"error: --{name} concerns poses, and --camera uses none: leave it out\n"
    assert capsys.readouterr().err == said


def test_what_takes_long_says_how_far_it_is(monkeypatch):
    done = []

    @contextlib.contextmanager
    def stage(name, total):
        done.append((name, total))
        yield done.append

    monkeypatch.setattr(rehearse_camera, "stage", stage)
    assert list(rehearse_camera.counted("goals", ["a", "b"])) == ["a", "b"]
    rehearsal().faults(0)
    rehearse.rehearse(make_policy(servo), [], motors=MotorModel())
    assert done == [("goals", 2), 1, 1, ("drives with a broken camera", 0), ("goals", 0)]


@pytest.mark.slow
def test_a_policy_that_steers_by_sight_reaches_its_goals_through_latency_and_losses(with_opengl):
    outcomes = [
        rehearsal("varied").drive(goal, 12.0, number)
        for number, goal in enumerate([(0.4, 0.1), (-0.3, 0.2)])
    ]
    assert [one.reached for one in outcomes] == [True, True]
    assert max(one.distance for one in outcomes) < 0.12


@pytest.mark.slow
def test_faults_stop_it_in_time_and_without_a_cube_it_turns(with_opengl):
    found = rehearsal()
    cases = found.faults(2)
    assert [case.kind for case in cases] == ["frozen", "black"]
    assert max(case.stopped_after for case in cases) <= camera_sense.FRAME_STALE_AFTER + PERIOD
    assert all(case.resumed and case.in_time for case in cases)
    search = found.search(12.0)
    assert search.good
    assert rehearse_camera.passed([], cases, [search], 1.0)
    assert not rehearse_camera.passed([], [cases[0]._replace(in_time=False)], [search], 1.0)
    assert not rehearse_camera.passed([], cases, [search._replace(reached=False)], 1.0)
    text = rehearse_camera.summary([], cases, [search])
    assert "1 of 1 turned until they saw it" in text


def test_pictures_come_late_at_their_rate_and_some_are_lost(with_opengl):
    robot = SimulatedJetBot()
    config = camera_config(make_policy(servo).spec["image"])
    for dropped in (0.0, 0.5):
        camera = rehearse_camera.SimulatedCamera(robot, config, CameraModel(0.08, 20.0, dropped))
        began, seen, at = robot.now(), [], []
        while robot.now() < began + 1.0:
            robot.sleep(1 / 60)
            if camera.value is not None and not any(camera.value is one for one in seen):
                seen.append(camera.value)
                at.append(robot.now() - began)
        robot.watchers.clear()
        assert at[0] >= 0.08
        if dropped:
            assert 3 < len(seen) < 16
        else:
            assert len(seen) in (18, 19)
            assert np.diff(at).max() < 0.07
            assert seen[0].shape == (224, 224, 3)


def test_a_lost_motor_value_leaves_the_one_before():
    robot = SimulatedJetBot(MotorModel(lost=0.5))
    for _ in range(40):
        robot.set_motors(0.3, 0.3)
        before = robot.motors
        robot.set_motors(-0.1, 0.2)
        assert robot.motors in (before, (-0.1, 0.2))
    assert len(robot._pending) in range(20, 60)


@pytest.mark.slow
def test_what_a_lens_bends_is_straight_again(with_opengl):
    """Compare a bent picture, taken out, with the picture of a camera without distortion."""
    bent = {"matrix": (80.0, 80.0, 112.0, 110.0), "calibration_size": (224, 224)}
    bent |= {"lens": "opencv", "distortion": (-0.05, 0.005, 0.001, -0.001)}
    scene = make_env(Config()).mj_model
    place = np.array([0.0, 0.0, 0.0325]), np.array([1.0, 0.0, 0.0, 0.0])
    cube = {"goal": np.array([0.3, 0.05, 0.05])}
    side = {"width": 224, "height": 224}
    picture = MujocoCamera(CameraConfig(**side, **bent), scene).picture(*place, cube)
    straight = CameraConfig(width=32, height=32, fovy=90.0)
    wanted = MujocoCamera(straight, scene).picture(*place, cube).astype(int)
    calibration = undistort.LensCalibration(
        (224, 224), bent["matrix"], bent["distortion"], fisheye=False
    )
    reducer = undistort.Reducer(_image(straight, PERIOD), (224, 224), calibration)
    plain = undistort.Reducer(_image(straight, PERIOD), (224, 224))
    apart = np.abs(reducer(picture) - wanted)[2:-2, 2:-2].mean()
    assert apart < 2.0
    assert np.abs(plain(picture) - wanted)[2:-2, 2:-2].mean() > 3 * apart
