"""The robot's program: it drives a SimulatedJetBot to its goals and stops the motors on errors."""

import contextlib
import functools
import hmac
import json
import math
import os
import re
import signal
import socket
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from helpers.bare_python import NUMPY, alone, site_with
from jetbot_mjx import export, sim2real
from jetbot_mjx.config import load_config, parse_config
from jetbot_mjx.deployment import compare_drive, export_policy, policy_export
from jetbot_mjx.deployment.drive_log import read_log, replay
from jetbot_mjx.deployment.numpy_policy import record
from jetbot_mjx.deployment.simulated_jetbot import ROLLING_RADIUS, MotorModel, Pose, SimulatedJetBot
from jetbot_mjx.envs.task import GOAL_HEIGHT, LAYOUTS, GoalTask, RobotState
from jetbot_mjx.errors import UserError
from jetbot_mjx.training import session

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "deploy"))

import calibrate
import datagrams
import drive
import motors
import observations
import poses
import rehearse

PERIOD = 1 / 60
IDEAL = MotorModel(dead_band=(0.0, 0.0), lag=0.0, delay=0.0)


@pytest.fixture(scope="module")
def exported(smoke_run, tmp_path_factory):
    """Export a policy with almost no training."""
    folder = tmp_path_factory.mktemp("deploy") / "policy"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(policy_export, "record", functools.partial(record, count=50))
        export_policy(smoke_run, output=folder)
    return folder


@pytest.fixture(scope="module")
def policy(exported):
    """Return the policy `scripted`, with the spec of an exported one."""
    spec = drive.load_policy(str(exported)).spec
    return drive.Policy(scripted, {**spec, "observation": layout("egocentric")})


def layout(name):
    found, start = [], 0
    for field in LAYOUTS[name]:
        index = list(range(start, start + field.size))
        found.append({"name": field.name, "frame": field.frame, "index": index})
        start += field.size
    return found


def scripted(obs):
    """Turn towards the goal, and drive faster the better the robot is aligned."""
    error = math.atan2(obs[3], obs[2])
    speed = 0.35 * max((math.cos(error) - 0.8) / 0.2, 0.0)
    yaw_rate = max(-math.pi, min(math.pi, 2.5 * error))
    turn = 0.5 * yaw_rate * 0.1125
    return (speed, yaw_rate), ((speed - turn) / 0.0325, (speed + turn) / 0.0325)


def settings(goal=(0.6, 0.5), timeout=10.0):
    return drive.Settings(goal, timeout, drive.STALE_AFTER, 0.0983)


def camera(robot, rate=60.0):
    return rehearse.Camera(robot, rate, 0.0, np.random.default_rng(0))


# In the SimulatedJetBot.


def test_the_driver_reaches_goals_through_delay_dead_band_and_lag(policy):
    model = MotorModel()
    assert (model.delay, model.lag > 0, min(model.dead_band) > 0) == (0.05, True, True)
    goals = rehearse.draw_goals(6)
    outcomes = rehearse.rehearse(policy, goals, motors=model)
    assert [one.reached for one in outcomes] == [True] * 6
    assert max(one.distance for one in outcomes) < 0.0983
    assert min(one.ticks for one in outcomes) > 30
    # The dead-band is real: a driver that does not know of it stays behind.
    blind = motors.default_calibration()
    blind = blind._replace(left=motors.Wheel(0.0, 1.4), right=motors.Wheel(0.0, 1.4))
    outcomes = rehearse.rehearse(policy, goals[:2], motors=model, calibration=blind, timeout=6.0)
    assert not any(one.reached for one in outcomes)


@pytest.mark.slow
def test_a_trained_policy_reaches_95_of_100_goals(tmp_path, monkeypatch, capsys):
    config = load_config(ROOT / "configs" / "jetbot_egocentric.yaml", ["robot.preset=real"])
    session.run(config, tmp_path / "run")
    assert export.main([str(tmp_path / "run")]) == 0
    for noise in ("0", "0.003"):
        arguments = [str(tmp_path / "run" / "policy"), "--noise", noise]
        assert rehearse.main(arguments) == 0
    assert "100 goals reached" in capsys.readouterr().out


def test_a_stale_pose_stops_the_motors_within_100_ms(policy):
    robot = SimulatedJetBot()
    eye = camera(robot)
    lines = []

    def log(line):
        lines.append((robot.now(), line))
        eye.blind = 1.0 <= robot.now() < 1.6

    outcome = drive.drive(
        robot,
        robot,
        poses.Tracker(eye.receive),
        policy,
        motors.default_calibration(),
        settings((1.2, 0.0)),
        log,
    )
    seen = [time for time, line in lines if line["pose_age"] == 0.0 and time < 1.1]
    stopped = next(time for time, line in lines if line["motors"] == [0.0, 0.0])
    assert max(lines[40][1]["motors"]) > 0.3
    assert 0.0 < stopped - max(seen) <= 0.1
    while_blind = [line["motors"] for time, line in lines if stopped <= time < 1.6]
    assert len(while_blind) > 20
    assert not np.any(while_blind)
    # The robot sees again, and goes on.
    assert outcome.reached
    assert outcome.stale_ticks >= len(while_blind)


def test_the_robot_stands_still_without_a_pose(policy):
    robot = SimulatedJetBot()
    outcome = drive.drive(
        robot,
        robot,
        poses.Tracker(list),
        policy,
        motors.default_calibration(),
        settings(timeout=1.0),
    )
    assert (outcome.reached, outcome.distance) == (False, None)
    assert robot.pose() == pytest.approx((0.0, 0.0, 0.0), abs=1e-6)


class RecordingRobot:
    """A robot and a clock that record the motor values."""

    def __init__(self, at=0.5, happens=None):
        self.values, self.time, self._at, self._happens = [], 0.0, at, happens

    def set_motors(self, left, right):
        self.values.append((left, right))

    def now(self):
        return self.time

    def sleep(self, seconds):
        self.time += seconds
        if self._happens and self.time > self._at:
            happens, self._happens = self._happens, None
            happens()


def failing(error):
    def fail(*arguments):
        raise error

    return fail


@pytest.mark.parametrize("where", ["clock", "poses", "policy", "log", "start"])
@pytest.mark.parametrize("error", [ValueError("!"), KeyboardInterrupt(), SystemExit(143)])
def test_every_error_stops_the_motors(where, error, policy):
    robot = RecordingRobot(happens=failing(error) if where == "clock" else None)
    source = poses.Odometry(motors.default_calibration())
    count = iter(range(1000))

    def after_a_while(then):
        def work(*arguments):
            if next(count) > 20:
                raise error
            return then(*arguments)

        return work

    log = None
    if where == "poses":
        source.read = after_a_while(source.read)
    elif where == "policy":
        policy = policy._replace(act=after_a_while(policy.act))
    elif where == "log":
        log = after_a_while(lambda line: None)
    elif where == "start":
        policy = policy._replace(act=failing(error))
    with pytest.raises(type(error)):
        drive.drive(robot, robot, source, policy, motors.default_calibration(), settings(), log)
    assert robot.values[0] == robot.values[-1] == (0.0, 0.0)
    assert (np.abs(robot.values).max() > 0.2) == (where != "start")


def test_a_bus_that_refuses_once_is_asked_again(policy):
    robot = RecordingRobot()
    refusals = [OSError(121, "Remote I/O error")] * 4

    def set_motors(left, right):
        if (left, right) == (0.0, 0.0) and refusals:
            raise refusals.pop()
        robot.values.append((left, right))

    flaky = type("Flaky", (), {"set_motors": staticmethod(set_motors)})
    motors.stop(flaky)
    assert robot.values == [(0.0, 0.0)]
    refusals[:] = [OSError(121, "Remote I/O error")] * 5
    with pytest.raises(OSError, match="Remote"):
        motors.stop(flaky)


def test_a_policy_that_gives_no_numbers_stands_still(policy):
    robot = RecordingRobot()
    lost = policy._replace(act=lambda obs: ((0.0, 0.0), (math.nan, 5.0)))
    source = poses.Odometry(motors.default_calibration())
    drive.drive(robot, robot, source, lost, motors.default_calibration(), settings(timeout=0.5))
    assert not np.any(robot.values)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGHUP])
def test_a_signal_stops_the_motors_and_tells_its_number(number, exported, monkeypatch):
    robot = RecordingRobot(happens=lambda: os.kill(os.getpid(), number))
    monkeypatch.setattr(drive, "NoRobot", lambda: robot)
    before = signal.getsignal(number)
    with pytest.raises(SystemExit) as left:
        drive.main([str(exported), "--goal", "1", "0", "--dry-run"], clock=robot)
    assert left.value.code == 128 + number
    assert robot.values[-1] == (0.0, 0.0)
    assert np.any(robot.values)
    assert signal.getsignal(number) is before


def test_late_periods_are_counted_and_do_not_pile_up(policy):
    robot = RecordingRobot()
    naps = iter([0.03] * 10)
    slow = policy._replace(act=lambda obs: robot.sleep(next(naps, 0.0)) or scripted(obs))
    source = poses.Odometry(motors.default_calibration())
    lines = []
    outcome = drive.drive(
        robot,
        robot,
        source,
        slow,
        motors.default_calibration(),
        settings((2.0, 0.0), timeout=1.0),
        lines.append,
    )
    # One nap was before the start.
    assert outcome.late_ticks == 9
    assert lines[3]["latency"] == pytest.approx(0.03)
    periods = np.diff([line["t"] for line in lines])
    assert periods[:9] == pytest.approx(0.03)
    # What was lost is not made up for in haste.
    assert periods[9:] == pytest.approx(PERIOD)


# Its parts.


def test_motor_values_undo_dead_band_and_full_speed():
    wheel = motors.Wheel(dead_band=0.2, full_speed=0.4)
    for speed in (-0.4, -0.1, 0.0, 0.006, 0.4):
        assert motors.wheel_speed(motors.motor_value(speed, wheel), wheel) == pytest.approx(speed)
    assert motors.motor_value(0.006, wheel) > 0.2
    assert motors.motor_value(0.004, wheel) == 0.0
    assert motors.motor_value(9.0, wheel) == 1.0
    assert motors.motor_value(-9.0, wheel) == -1.0
    # The motors of SimulatedJetBot do the same.
    robot = SimulatedJetBot(IDEAL._replace(dead_band=(0.2, 0.2)))
    robot.set_motors(*[motors.motor_value(0.3, motors.Wheel(0.2, 12.56 * ROLLING_RADIUS))] * 2)
    robot.sleep(1.0)
    assert robot.speed() == pytest.approx(0.3, rel=2e-3)


@pytest.mark.parametrize("name", ["world", "egocentric"])
def test_observations_are_those_of_training(name, exported):
    spec = drive.load_policy(str(exported)).spec
    observe = observations.Observer({**spec, "observation": layout(name)})
    task = GoalTask(parse_config({"task": {"observation": name}}).task)
    rng = np.random.default_rng(0)
    for x, y, yaw, speed, rate, goal_x, goal_y in rng.uniform(-3, 3, (20, 7)):
        seen = observe(poses.Pose(0.0, x, y, yaw, speed, rate), (goal_x, goal_y))
        pitch = 2 * math.asin(spec["rest_quaternion"][2])
        half = [math.cos(yaw / 2), math.sin(yaw / 2)]
        ahead, tilt = math.cos(pitch / 2), math.sin(pitch / 2)
        robot = RobotState(
            jnp.array([x, y, spec["rest_height"]]),
            jnp.array([half[0] * ahead, -half[1] * tilt, half[0] * tilt, half[1] * ahead]),
            jnp.array([speed * math.cos(yaw), speed * math.sin(yaw), 0.0]),
            jnp.array([0.0, 0.0, rate]),
        )
        wanted = task.observe(robot, jnp.array([goal_x, goal_y, GOAL_HEIGHT]))
        np.testing.assert_allclose(seen, wanted, atol=2e-5)
    assert spec["goal_height"] == GOAL_HEIGHT


def test_an_observation_that_cannot_be_made_is_told(policy):
    part = {"name": "pillar_position", "frame": "body", "index": [7, 8]}
    other = {**policy.spec, "observation": [*policy.spec["observation"], part]}
    with pytest.raises(motors.DriveError, match=r"needs pillar_position \(2 numbers, body frame\)"):
        observations.Observer(other)


def test_dead_reckoning_follows_the_simulated_jetbot(policy):
    model = MotorModel(delay=0.0)
    robot = SimulatedJetBot(model)
    calibration = rehearse.true_calibration(model)
    source = poses.Odometry(calibration)
    outcome = drive.drive(robot, robot, source, policy, calibration, settings((0.8, 0.6)))
    assert outcome.reached
    reckoned, true = source.read(robot.now()), robot.pose()
    assert math.hypot(reckoned.x - true.x, reckoned.y - true.y) < 0.04
    assert 0.5 < math.hypot(true.x, true.y) < 1.0


def datagram(time, x=0.0, y=0.0, yaw=0.0):
    return json.dumps({"time": time, "x": x, "y": y, "yaw": yaw}).encode()


def test_a_tracker_tells_speeds_and_turns_without_jumps():
    inbox = []
    tracker = poses.Tracker(lambda: [inbox.pop(0)] if inbox else [])
    assert tracker.read(0.0) is None
    radius, rate = 0.3, 2.0  # a circle to the left
    for index in range(400):
        time = index * PERIOD
        x, y = radius * math.sin(rate * time), radius * (1 - math.cos(rate * time))
        inbox.append(datagram(5.0 + time, x, y, math.remainder(rate * time, 2 * math.pi)))
        pose = tracker.read(time)
    assert pose.speed == pytest.approx(radius * rate, rel=1e-3)
    assert pose.yaw_rate == pytest.approx(rate, rel=1e-3)
    assert pose.yaw == pytest.approx(rate * time, abs=1e-6)


def test_a_tracker_takes_no_repeats_and_no_rubbish():
    inbox = [datagram(1.0, x=0.1)]
    tracker = poses.Tracker(lambda: [inbox.pop(0)] if inbox else [])
    first = tracker.read(0.0)
    rubbish = [b"\xff", b"1", b"{}", b'{"time": 2, "x": "a", "y": 0, "yaw": 0}', datagram(math.nan)]
    for index, content in enumerate([datagram(1.0, x=0.2), datagram(0.9, x=0.3), *rubbish]):
        inbox.append(content)
        assert tracker.read(0.01 * (index + 1)) == first
    assert tracker.rejected == len(rubbish)
    # A restarted tracker counts its time from zero.
    inbox.append(datagram(0.1, x=0.4))
    assert tracker.read(0.7).x == 0.4


NASTY = [
    b"",
    b"[" * 1000,
    b"[" * 4000,
    b'{"time":' * 120,
    b"1" + b"0" * 400,
    b'{"time": 9, "x": 1' + b"0" * 400 + b', "y": 0, "yaw": 0}',
    b'{"time": 9, "x": 1e308, "y": 0, "yaw": 0}',
    b'{"time": 9, "x": 0, "y": 0, "yaw": -1e308}',
    b'{"time": 1e308, "x": 0, "y": 0, "yaw": 0}',
    b'{"time": 9, "x": NaN, "y": 0, "yaw": 0}',
    b'{"time": 9, "x": 0, "y": -Infinity, "yaw": 0}',
    b'{"time": 9, "x": true, "y": 0, "yaw": 0}',
    b'{"time": 9, "x": "0.1", "y": 0, "yaw": 0}',
    b'{"time": 9, "x": [0], "y": 0, "yaw": 0}',
    b'{"time": 9, "x": null, "y": 0, "yaw": 0}',
    b'{"time": 9, "y": 0, "yaw": 0}',
    b'"time"',
    b"null",
    b"\xef\xbb\xbf{}",
    b'"\\ud800"',
    b"\0" * 900,
    json.dumps({"time": 9, "x": 0, "y": 0, "yaw": 0, "note": "x" * 1000}).encode(),
]


@pytest.mark.parametrize("content", NASTY, ids=range(len(NASTY)))
def test_no_datagram_ends_a_drive(content, policy):
    """Check that the robot stops while nothing else comes, and continues afterwards."""
    robot = SimulatedJetBot()
    eye = camera(robot)

    def receive():
        eye.blind = 0.5 <= robot.now() < 0.8
        return [content] if eye.blind else eye.receive()

    tracker = poses.Tracker(receive)
    outcome = drive.drive(
        robot, robot, tracker, policy, motors.default_calibration(), settings((0.6, 0.0))
    )
    assert outcome.reached
    assert outcome.stale_ticks > 10
    assert tracker.rejected > 10
    assert tracker.reason


def mutated(rng, time):
    """Return bytes that are nearly a pose, or random bytes."""
    if rng.random() < 0.2:
        return rng.bytes(rng.integers(0, 1500))
    numbers = [0, -1, 1.5, 1e-320, 1e17, 1e300, 10**30, 10**400, math.nan, -math.inf, True, None]
    values = {"time": time, "x": 0.5, "y": 0.5, "yaw": 0.5}
    for name in values:
        others = [*numbers, "1", [], {}, values, rng.normal(), float(rng.integers(0, 100))]
        if rng.random() < 0.5:
            values = {**values, name: others[rng.integers(len(others))]}
    content = bytearray(json.dumps(values).encode())
    for _ in range(rng.integers(0, 3)):
        place = rng.integers(len(content))
        content[place : place + rng.integers(0, 2)] = rng.bytes(rng.integers(0, 2))
    return bytes(content)


@pytest.mark.parametrize("signs", [False, True])
def test_poses_stay_finite_under_random_datagrams(signs, key):
    """Send 20,000 datagrams, some of which are poses."""
    rng = np.random.default_rng(0)
    inbox = []
    tracker = poses.Tracker(lambda: [inbox.pop()], key=datagrams.Key(str(key)) if signs else None)
    changes, last = 0, None
    for index in range(20_000):
        inbox.append(mutated(rng, index))
        if signs and index % 2:
            inbox[0] = signed(inbox[0])
        # Sometimes so long apart that the clock counts as restarted.
        pose = tracker.read(0.02 * index + index // 50)
        changes += pose is not last
        last = pose
        assert pose is None or all(map(math.isfinite, pose))
    assert tracker.rejected > 5_000
    assert changes > 20


def test_pictures_close_together_make_no_infinite_speed():
    inbox = []
    tracker = poses.Tracker(lambda: [inbox.pop()])
    for time, x in [(0.0, -1000.0), (5e-324, 1000.0), (1e-323, -1000.0), (1.0, 0.0), (1.1, 0.0)]:
        inbox.append(datagram(time, x))
        pose = tracker.read(0.0)
    assert math.isfinite(pose.speed)


def send(port, *contents):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for content in contents:
            sender.sendto(content, ("127.0.0.1", port))


def test_poses_come_by_udp(unused_port):
    port = unused_port()
    tracker = poses.udp_tracker(port)
    send(port, b"[" * 4000, *(datagram(1.0 + index, x=index) for index in range(3)), b"0" * 60_000)
    assert tracker.read(1.0).x == 2
    assert (tracker.rejected, tracker.reason) == (2, "it is longer than 1024 bytes")
    with (
        contextlib.closing(tracker),
        pytest.raises(motors.DriveError, match=f"--tracker {port} at 127.0.0.1: .*in use"),
    ):
        poses.udp_tracker(port)


def test_a_flood_does_not_keep_the_driver_from_its_motors(monkeypatch, unused_port):
    class Flood:
        def __init__(self, *arguments):
            self.bind = self.setblocking = self.close = lambda *value: None

        def recv(self, size):
            return b"x" * size

    port = unused_port()
    monkeypatch.setattr(poses.socket, "socket", Flood)
    tracker = poses.udp_tracker(port)
    assert tracker.read(0.0) is None
    assert tracker.rejected == 256


def test_other_machines_do_not_reach_a_tracker(unused_port):
    port = unused_port()
    with contextlib.closing(poses.udp_tracker(port)) as tracker:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            # Another address of the same loopback: reached only where all addresses are.
            sender.sendto(datagram(1.0), ("127.0.0.2", port))
        assert tracker.read(0.0) is None


@pytest.mark.parametrize("host", ["0.0.0.0", "", "192.0.2.1"])
def test_other_machines_are_let_in_with_a_key_only(host, unused_port):
    with pytest.raises(motors.DriveError, match=r"could steer the robot: .* --tracker-key FILE"):
        poses.udp_tracker(unused_port(), host)


# Datagrams that are signed.

SECRET = b"fb6a1c0e5f4b4ad0a2b1c3d4e5f60718"


@pytest.fixture
def key(tmp_path):
    path = tmp_path / "tracker.key"
    path.write_bytes(SECRET + b"\n")
    path.chmod(0o600)
    return path


def signed(body, secret=SECRET):
    return hmac.new(secret, body, "sha256").digest() + body


def test_only_what_is_signed_and_new_is_believed(key):
    inbox = []
    tracker = poses.Tracker(lambda: [inbox.pop(0)] if inbox else [], key=datagrams.Key(str(key)))
    first = signed(datagram(1000.0, x=0.1))

    def read(content, now):
        inbox.append(content)
        return tracker.read(now)

    assert read(first, 0.0).x == 0.1
    last = tracker.read(0.0)
    forged = [
        datagram(1001.0, x=9.0),
        signed(datagram(1001.0, x=9.0), b"another key of the same length.."),
        signed(datagram(1001.0, x=9.0), b""),
        bytes(32) + datagram(1001.0, x=9.0),
        first[:32] + datagram(1001.0, x=9.0),
        first[:-1],
        b"",
        first[:31],
    ]
    for content in forged:
        assert read(content, 0.01) == last
        assert tracker.reason == f"it is not signed with {key}"
    assert tracker.rejected == len(forged)
    # What was recorded does not count again, also not after a silence, or in another drive.
    assert read(first, 5.0) == last
    assert "not later than 1000.0" in tracker.reason
    tracker.close()
    tracker = poses.Tracker(lambda: [inbox.pop(0)] if inbox else [], key=datagrams.Key(str(key)))
    assert read(first, 0.0) is None
    assert f"a replay, or the tracker's clock was set back (then remove {key}.newest)" in (
        tracker.reason
    )
    assert read(signed(datagram(1000.5, x=0.2)), 0.1).x == 0.2


def test_a_signed_pose_of_the_page_is_believed(key, unused_port, monkeypatch):
    text = (ROOT / "docs" / "deploy.md").read_text("utf-8")
    (block,) = [one for one in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if "hmac" in one]
    port = unused_port()
    monkeypatch.chdir(key.parent)
    assert '("192.168.1.20", 9870)' in block
    here = block.replace('("192.168.1.20", 9870)', f'("127.0.0.1", {port})')
    for secret, seen in ((str(key), True), (None, False)):
        given = None if secret is None else datagrams.Key(secret)
        with contextlib.closing(poses.udp_tracker(port, key=given)) as tracker:
            names = {}
            exec(compile(here, "deploy.md", "exec"), names)
            names["tracker"].close()
            assert (tracker.read(0.0) is not None) == seen


def test_a_key_is_made_that_nobody_else_reads(tmp_path, capsys):
    path = tmp_path / "new.key"
    assert datagrams.main([str(path)]) == 0
    assert path.stat().st_mode & 0o777 == 0o600
    assert len(path.read_text().strip()) == 64
    datagrams.Key(str(path))
    before = path.read_bytes()
    assert datagrams.main([str(path)]) == 2
    assert path.read_bytes() == before
    assert capsys.readouterr().err == f"error: {path}: File exists\n"


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda key: key.chmod(0o644), "can be read by others: chmod 600 "),
        (lambda key: key.write_text("secret"), "has 6 bytes: use at least 16"),
        (lambda key: key.unlink(), "tracker.key: No such file"),
        (lambda key: key.with_suffix(".key.newest").write_text("x"), "could not convert"),
        (lambda key: key.with_suffix(".key.newest").mkdir(), "newest: Is a directory"),
        (lambda key: key.with_suffix(".key.newest.unfinished").mkdir(), "newest: Is a directory"),
    ],
)
def test_a_key_that_cannot_be_used_is_told(damage, message, key):
    damage(key)
    with pytest.raises(motors.DriveError, match=message):
        datagrams.Key(str(key))


# Calibration.


def test_calibration_finds_dead_bands_and_full_speeds(tmp_path, monkeypatch, capsys):
    model = MotorModel(dead_band=(0.1, 0.16), full_speed=(12.0, 11.0))
    robot = SimulatedJetBot(model)
    places = [robot.pose()]

    def measure():
        places.append(robot.pose())
        before, after = places[-2:]
        return math.hypot(after.x - before.x, after.y - before.y), after.yaw - before.yaw

    path = tmp_path / "calibration.json"
    assert calibrate.main(["--output", str(path)], robot, robot, measure) == 0
    found, true = motors.read_calibration(str(path)), rehearse.true_calibration(model)
    for side in ("left", "right"):
        assert getattr(found, side).dead_band == pytest.approx(
            getattr(true, side).dead_band, abs=5e-3
        )
        assert getattr(found, side).full_speed == pytest.approx(
            getattr(true, side).full_speed, rel=0.02
        )
    assert robot.motors == (0.0, 0.0)
    measured = iter([(0.3, 0.0), (0.2, 0.0)])
    assert calibrate.main(["--output", "x"], robot, robot, lambda: next(measured)) == 2
    assert "did not drive faster at 0.5" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c.pop("lag"), "lacks 'lag'"),
        (
            lambda c: c["left"].update(dead_band=0.9),
            "left.dead_band = 0.9 is not between 0 and 0.6",
        ),
        (
            lambda c: c["right"].update(full_speed="fast"),
            "right.full_speed = 'fast' is not a number",
        ),
        (lambda c: c["right"].update(full_speed=10**400), "right.full_speed = 10+ is not between"),
        (lambda c: c["right"].update(speed=1), "is not a calibration"),
    ],
)
def test_a_wrong_calibration_is_told(change, message, tmp_path):
    values = motors.as_json(motors.default_calibration())
    change(values)
    path = tmp_path / "calibration.json"
    path.write_text(json.dumps(values))
    with pytest.raises(motors.DriveError, match=message):
        motors.read_calibration(str(path))


# The command.


DRY = ("{policy}", "--goal", "1", "0", "--dry-run")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{policy}", "--goal", "1", "0"], "there is no robot here"),
        (["nowhere", "--goal", "1", "0"], "nowhere is not an exported policy: No such file"),
        (
            ["{policy}", "--goal", "1", "0", "--calibration", "c.json"],
            "--calibration c.json: No such",
        ),
        (["{policy}", "--goal", "1", "0", "--dry-run", "--tracker", "99999"], "--tracker 99999"),
        (["{policy}", "--goal", "1", "0", "--dry-run", "--tracker", "0"], "give 1 to 65535"),
        (
            [*DRY, "--tracker", "9870", "--tracker-host", "nowhere.invalid"],
            "--tracker-host nowhere.invalid: ",
        ),
        ([*DRY, "--tracker", "9870", "--tracker-host", "x" * 300], "--tracker-host xxx"),
        ([*DRY, "--tracker", "9870", "--tracker-key", "no.key"], "--tracker-key no.key: No such"),
        ([*DRY, "--tracker", "9870", "--tracker-key", ""], "--tracker-key : No such"),
        ([*DRY, "--tracker-host", "0.0.0.0"], "give --tracker PORT too"),
        ([*DRY, "--tracker-key", "no.key"], "give --tracker PORT too"),
        (["{policy}", "--goal", "1", "0", "--dry-run", "--log", "no/log"], "--log no/log: No such"),
    ],
)
def test_a_mistake_is_one_line(arguments, message, exported, capsys):
    assert drive.main([word.format(policy=exported) for word in arguments]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert message in lines[0]


@pytest.mark.parametrize(
    ("goal", "told"),
    [("nan", "nan is not at least"), ("1e9", "1e9 is more than 1000"), ("inf", "inf is more")],
)
def test_an_invalid_goal_is_refused(goal, told, exported, capsys):
    with pytest.raises(SystemExit) as left:
        drive.main([str(exported), "--goal", "1", goal])
    assert left.value.code == 2
    assert told in capsys.readouterr().err


def test_a_dry_run_needs_numpy_alone(exported, tmp_path):
    site = site_with(tmp_path, NUMPY)
    log = tmp_path / "drive.jsonl"
    arguments = [str(exported), "--goal", "1", "0", "--dry-run", "--timeout", "0.2"]
    arguments += ["--log", str(log)]
    done = alone(
        site,
        f"sys.path.insert(0, {str(ROOT / 'deploy')!r})\n"
        f"import drive\nsys.exit(drive.main({arguments!r}))",
    )
    assert (done.returncode, done.stderr) == (1, "")
    assert "not reached after 0.2" in done.stdout
    assert read_log(log).outcome == "timed out"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda spec: spec.pop("rest_height"), "policy.json lacks rest_height"),
        (lambda spec: spec.pop("run"), "policy.json lacks run"),
        (lambda spec: spec["wheel_speeds"].clear(), "policy.json lacks wheel_speeds.wheel_radius"),
        (
            lambda spec: spec.update(rest_quaternion=[1.0, 0.0, 0.0]),
            "policy.json has rest_quaternion = [1.0, 0.0, 0.0]: it should be 4 numbers from",
        ),
        (lambda spec: spec.update(observation=[["x"]]), "no list of observations with name,"),
        (lambda spec: spec.update(files={}), "has no policy.py"),
    ],
)
def test_a_policy_that_lacks_something_is_told(change, message, exported, tmp_path, capsys):
    spec = json.loads((exported / "policy.json").read_text())
    change(spec)
    (tmp_path / "policy.json").write_text(json.dumps(spec))
    (tmp_path / "policy.py").write_text("")
    assert drive.main([str(tmp_path), "--goal", "1", "0", "--dry-run"]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("spec", "source", "message"),
    [
        ("[" * 100_000, "", "is not an exported policy: "),
        ("3", "", "policy.json holds no object"),
        (" " * 1_000_001, "", "policy.json is too long"),
        (None, "import no_such_package", "cannot be run here: No module named 'no_such_package'"),
    ],
)
def test_a_policy_that_cannot_be_read_is_told(spec, source, message, exported, tmp_path):
    spec = spec or (exported / "policy.json").read_text()
    (tmp_path / "policy.json").write_text(spec)
    (tmp_path / "policy.py").write_text(source)
    with pytest.raises(motors.DriveError, match=message):
        drive.load_policy(str(tmp_path))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--rate", "0"], "0 is not at least 1"),
        (["--delay", "nan"], "nan is not at least 0"),
        (["--noise", "-1"], "-1 is not at least 0"),
        (["--goals", "-1"], "--goals -1: give at least 1"),
        (["--dead-band", "1"], "left.dead_band = 1 is not between 0 and 0.6"),
        (["--lag", "9"], "lag = 9 is not between 0 and 1"),
    ],
)
def test_a_rehearsal_of_nonsense_is_refused(arguments, message, exported, capsys):
    try:
        code = rehearse.main([str(exported), *arguments])
    except SystemExit as left:
        code = left.code
    assert code == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "error", "code", "message"),
    [
        (["--lag", "nan"], None, 2, "lag = nan is not between 0 and 1"),
        (["--separation", "5"], None, 2, "separation = 5 is not between"),
        ([], KeyboardInterrupt(), 130, "interrupted"),
        ([], EOFError(), 130, "interrupted"),
    ],
)
def test_a_calibration_that_does_not_end_is_told(arguments, error, code, message, tmp_path, capsys):
    robot, path = RecordingRobot(), tmp_path / "calibration.json"
    arguments = ["--output", str(path), *arguments]
    assert calibrate.main(arguments, robot, robot, failing(error)) == code
    assert message in capsys.readouterr().err
    assert not path.exists()
    # What is wrong with the arguments is told before the robot drives.
    assert robot.values[-1:] == ([(0.0, 0.0)] if error else [])


def test_a_rehearsal_tells_how_many_goals_were_reached(exported, capsys):
    assert rehearse.main([str(exported), "--goals", "2", "--timeout", "0.2"]) == 1
    assert "0 of 2 goals reached; delay 0.05 s, lag 0.1 s" in capsys.readouterr().out
    assert rehearse.main(["nowhere"]) == 2


# A log in the simulator.


@pytest.fixture(scope="module")
def driven(policy, tmp_path_factory):
    """Log a drive of a SimulatedJetBot with a known calibration, except for its delay."""
    model = MotorModel(full_speed=(12.0, 11.5), dead_band=(0.1, 0.15))
    robot, calibration = SimulatedJetBot(model), rehearse.true_calibration(model)
    robot.place(Pose(0.2, -0.1, 3.0))
    path = tmp_path_factory.mktemp("log") / "drive.jsonl"
    where = settings((-0.6, 0.5))
    with path.open("w") as file:

        def log(line):
            file.write(json.dumps(line) + "\n")

        log(drive.log_header(policy, calibration, where, "tracker"))
        source = poses.Tracker(camera(robot, 30.0).receive)
        assert drive.drive(robot, robot, source, policy, calibration, where, log).reached
    return path


def test_a_replay_with_the_same_motors_ends_where_the_drive_did(driven):
    same = replay(read_log(driven), delay=0.05)
    assert len(same.log.poses) < 0.6 * len(same.log.times)
    assert same.distances.max() < 2e-3
    assert np.abs(same.turns).max() < 0.01
    late = replay(read_log(driven), delay=0.0)
    assert late.distances.max() > 5 * same.distances.max()


def test_a_log_is_told_in_metrics_and_a_plot(driven, tmp_path, capsys):
    assert sim2real.main([str(driven), "--delay", "0.05", "--output", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "reached after" in out
    assert "mm at the end" in out
    found = json.loads((tmp_path / "drive.sim2real.json").read_text())
    assert found["position_error_final"] < 2e-3
    assert found["goal_distance_logged"] < 0.0983
    assert found["rate"] == pytest.approx(60.0, rel=1e-3)
    assert found["path_length_logged"] == pytest.approx(found["path_length_simulated"], rel=0.01)
    assert (tmp_path / "drive.sim2real.png").read_bytes()[1:4] == b"PNG"


def header(lines, **changes):
    """The first line, changed."""
    return json.dumps({**json.loads(lines[0]), **changes})


def later(lines, **changes):
    """The last line, changed."""
    return json.dumps({**json.loads(lines[-1]), **changes})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda lines: [], "line 1"),
        (lambda lines: ["{}", *lines[1:]], "line 1: lacks 'format'"),
        (lambda lines: [lines[0].replace("drive/1", "drive/9"), *lines[1:]], "its format is"),
        (lambda lines: [*lines[:5], "rubbish", *lines[5:]], "line 6"),
        (lambda lines: [*lines[:5], '{"t": 1}', *lines[5:]], "line 6: lacks 'motors'"),
        (lambda lines: lines[:1], "has no pose:"),
        (lambda lines: lines[:2], "has 1 pose:"),
        (lambda lines: [header(lines, calibration=None)], "its calibration is None, not an obj"),
        (lambda lines: [header(lines, calibration={"left": 1})], "its calibration's left is 1, no"),
        (lambda lines: [lines[0], *lines[:0:-1]], "its times do not ascend"),
        (lambda lines: [*lines, later(lines, t=1e3)], "a drive writes one at least every 10 s"),
        (lambda lines: [*lines, later(lines, x=1e999)], "inf is not a number from -1e"),
        (lambda lines: [*lines, later(lines, yaw=10**400)], "line .*: int too large"),
        (lambda lines: [*lines, later(lines, outcome="won")], "outcome 'won' is none of"),
        (lambda lines: [lines[0], "[" * 99_000 + "]}"], "it is nested too deeply"),
        (lambda lines: [lines[0][:-1] + ', "a": NaN}', *lines[1:]], "line 1: Out of range"),
    ],
)
def test_a_bad_log_is_told(change, message, driven, tmp_path):
    path = tmp_path / "bad.jsonl"
    path.write_text("\n".join(change(driven.read_text().splitlines())))
    with pytest.raises(UserError, match=message):
        compare_drive(path)
    assert os.listdir(tmp_path) == ["bad.jsonl"]


def test_a_log_that_was_cut_off_is_read_to_its_end(driven, tmp_path):
    path = tmp_path / "cut.jsonl"
    path.write_text(driven.read_text()[:20_000])
    cut = read_log(path)
    assert (cut.outcome, len(cut.times) > 20) == ("interrupted", True)
    (tmp_path / "no.jsonl").write_bytes(b"\xff\xfe")
    with pytest.raises(UserError, match="it is not text"):
        read_log(tmp_path / "no.jsonl")
    with pytest.raises(UserError, match="cannot be read: No such file"):
        read_log(tmp_path / "nothing.jsonl")
