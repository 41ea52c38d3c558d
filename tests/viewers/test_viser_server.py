"""The page's server, scene and panel without a browser; `test_viser_page.py` has one."""

import io
import math
import re
import socket
import time
import types
import urllib.error
import urllib.request

import mujoco
import numpy as np
import pytest

from helpers import gliding
from jetbot_mjx.envs.robot_model import QPOS_QUAT, QPOS_XYZ
from jetbot_mjx.errors import UserError
from jetbot_mjx.viewers.player import Player

pytest.importorskip("viser")

import trimesh
import viser
import websockets.exceptions
import websockets.sync.client

from jetbot_mjx.viewers import viser_server as module
from jetbot_mjx.viewers.camera import camera_axes
from jetbot_mjx.viewers.meshes import visible_geoms
from jetbot_mjx.viewers.viser_panel import ControlPanel
from jetbot_mjx.viewers.viser_scene import Scene
from jetbot_mjx.viewers.viser_server import FIRST_PORT, ViserViewer, free_port


@pytest.fixture(scope="module", autouse=True)
def glide(smoke_run):
    """All robots of these tests glide, after the run was trained with those that do not."""
    with gliding.everywhere():
        yield


@pytest.fixture(scope="module")
def player(smoke_run):
    return Player(smoke_run)


@pytest.fixture(scope="module")
def browser(player, unused_port):
    with ViserViewer(player, host="127.0.0.1", port=unused_port(), tell=print) as browser:
        yield browser


@pytest.fixture(autouse=True)
def as_new(player):
    player.paused = True  # so that a test alone decides about steps
    player.reset()


def answer(browser):
    """Lets the loop do what was asked for, and show it."""
    browser.step()
    browser.scene.show()
    browser.panel.update()


# The server.


def test_the_page_and_its_data_come_from_one_port(browser):
    address = f"127.0.0.1:{browser.server.get_port()}"
    with urllib.request.urlopen(f"http://{address}/", timeout=10) as answer:
        assert answer.headers["Content-Type"].startswith("text/html")
        assert b"<html" in answer.read()
    protocol = f"viser-v{viser.__version__}"
    with websockets.sync.client.connect(f"ws://{address}", subprotocols=[protocol]) as page:
        assert len(page.recv(timeout=10)) > 1000


def knock(browser, origin, host=None):
    """Whether a page from somewhere is sent anything, as a real client sees it."""
    here = ("127.0.0.1", browser.server.get_port())
    try:
        with websockets.sync.client.connect(
            f"ws://{host or f'127.0.0.1:{here[1]}'}",
            sock=socket.create_connection(here),
            origin=origin,
            subprotocols=[f"viser-v{viser.__version__}"],
        ) as page:
            return len(page.recv(timeout=10)) > 1000
    except websockets.exceptions.InvalidStatus as error:
        return {403: False}[error.response.status_code]


def test_a_page_from_elsewhere_is_refused_and_our_own_let_in(player, unused_port):
    port = unused_port()
    told = []
    with ViserViewer(
        player,
        host="127.0.0.1",
        port=port,
        allow=["https://hub.example.org"],
        tell=told.append,
    ) as browser:
        for origin in (f"http://127.0.0.1:{port}", None, "https://hub.example.org"):
            assert knock(browser, origin)
        # Through a tunnel, from another port of another machine.
        assert knock(browser, "http://localhost:9999", host="localhost:9999")
        assert told == []
        for origin in ("http://evil.example", "null", f"http://localhost:{port}"):
            assert not knock(browser, origin)
            assert not knock(browser, origin)
        # A name that was pointed at this machine after the page had been served.
        assert not knock(browser, f"http://evil.example:{port}", host=f"evil.example:{port}")
        assert len(told) == 4
        assert "'http://evil.example' asked to connect; --allow-origin lets it in" in told[0]
        for number in range(20):
            assert not knock(browser, f"http://evil.example:{number + 1}")
        assert len(told) == 10


@pytest.mark.parametrize(
    ("listening", "origin", "host", "lets_in"),
    [
        ("127.0.0.1", "http://[::1]:8080", "[::1]:8080", True),
        ("0.0.0.0", "http://192.0.2.7:8080", "192.0.2.7:8080", True),
        ("0.0.0.0", "http://this-machine:8080", "this-machine:8080", True),
        ("0.0.0.0", "http://this-machine.local:8080", "This-Machine.local:8080", True),
        ("0.0.0.0", "http://this-machine.evil.example", "this-machine.evil.example", False),
        ("robots.example", "https://robots.example", "robots.example", True),
        ("robots.example", "http://evil.example", "evil.example", False),
        ("127.0.0.1", "http://127.0.0.1:3000", "127.0.0.1:8080", False),
        ("127.0.0.1", "http://127.0.0.1:8080", "", False),
        ("127.0.0.1", "http://", "", False),
        ("127.0.0.1", "", "", False),
        ("127.0.0.1", "http://[", "[", False),
        ("127.0.0.1", "file://localhost", "localhost", False),
        ("127.0.0.1", "http://localhost@evil.example", "evil.example", False),
    ],
)
def test_a_page_is_let_in_from_where_the_player_is(listening, origin, host, lets_in, monkeypatch):
    monkeypatch.setattr(socket, "gethostname", lambda: "This-Machine")
    assert module._OriginCheck(listening, [], print).is_allowed(origin, host) is lets_in


def test_a_viser_that_lets_all_pages_in_is_refused(player, unused_port, monkeypatch):
    elsewhere = types.SimpleNamespace(serve=None)
    monkeypatch.setattr(module.websockets.asyncio, "server", elsewhere)
    monkeypatch.setattr(module, "_Server", lambda host, port, **options: Served(port))
    with pytest.raises(UserError, match="lets in pages from anywhere: pip install viser=="):
        ViserViewer(player, host="127.0.0.1", port=unused_port(), tell=print)
    assert Served.stopped


class Served:
    stopped = False

    def __init__(self, port):
        self.get_port = lambda: port

    def stop(self):
        Served.stopped = True


def test_only_this_machine_is_listened_to(browser):
    # Another address of the same loopback: served only where all addresses are.
    with pytest.raises(urllib.error.URLError, match="refused"):
        urllib.request.urlopen(f"http://127.0.0.2:{browser.server.get_port()}/", timeout=10)


def test_nothing_is_shared_through_other_machines(browser):
    assert browser.server.request_share_url() is None


def test_starting_and_stopping_say_nothing(player, capfd, unused_port):
    with ViserViewer(player, host="127.0.0.1", port=unused_port(), tell=print):
        pass
    assert capfd.readouterr() == ("", "")


def test_a_connection_that_is_not_used_says_nothing(player, caplog, unused_port):
    port = unused_port()
    with ViserViewer(player, host="127.0.0.1", port=port, tell=print):
        for _ in range(2):
            socket.create_connection(("127.0.0.1", port)).close()
        # The page still answers, and what was logged before it was is here.
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/") as page:
            assert page.status == 200
    assert [record.getMessage() for record in caplog.records] == []


def test_a_busy_port_is_refused_where_it_was_asked_for():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(UserError, match=f"--port {port} is already in use") as caught:
            free_port("127.0.0.1", port)
    assert "\n" not in str(caught.value)
    assert free_port("127.0.0.1", port) == port


def test_without_a_wish_the_next_free_port_is_taken(monkeypatch):
    assert free_port("127.0.0.1", None) >= FIRST_PORT
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        monkeypatch.setattr(module, "FIRST_PORT", port)
        assert port < free_port("127.0.0.1", None) < port + 10


def test_a_port_that_is_taken_meanwhile_is_refused(player):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(UserError, match=f"--port {port} has just been taken"):
            ViserViewer(player, host="127.0.0.1", port=port, tell=print)


@pytest.mark.parametrize(
    "host", ["nowhere.invalid", "203.0.113.1", "", "a..b", "x" * 300, "\udcff"]
)
def test_an_address_of_no_machine_or_another_is_refused(host):
    with pytest.raises(UserError, match=f"--host {re.escape(repr(host))} is not an address"):
        free_port(host, None)


# The scene.


def nodes(browser, body):
    scene = browser.server.scene
    return [
        node
        for number in range(20)
        if (node := scene.get_handle_by_name(f"/{body}/{number}")) is not None
    ]


def rotation(quat):
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, np.asarray(quat, float))
    return matrix.reshape(3, 3)


def test_every_visual_geom_stands_where_mujoco_puts_it(browser, player):
    player.agent = "keyboard"
    player.drive(0.6, 1.5)
    for _ in range(40):
        player.tick()
    browser.scene.show()
    model = player.env.mj_model
    data = mujoco.MjData(model)
    data.qpos[:] = player.snapshot.qpos
    data.mocap_pos[0] = player.snapshot.goal_w
    mujoco.mj_kinematics(model, data)
    seen = 0
    for body in range(1, model.nbody):
        shown = np.vstack(
            [
                node.vertices @ rotation(node.batched_wxyzs[0]).T + node.batched_positions[0]
                for node in nodes(browser, model.body(body).name)
            ]
        )
        wanted = []
        for geom in visible_geoms(model):
            if geom.body == body:
                wanted.append(geom.mesh.vertices @ data.xmat[body].reshape(3, 3).T)
                wanted[-1] += data.xpos[body]
                seen += 1
        wanted = np.vstack(wanted)
        assert len(shown) == len(wanted)
        # The same points, in another order.
        distances = np.linalg.norm(shown[:, None] - wanted[None, ::7], axis=-1)
        assert distances.min(axis=0).max() < 1e-5
    assert seen == 27  # the robot's 26 and the goal
    assert np.linalg.norm(player.snapshot.qpos[QPOS_XYZ][:2]) > 0.2


def test_a_frame_is_few_messages_whatever_the_number_of_robots(browser, player, monkeypatch):
    sent = []
    player.tick()
    queue = browser.server._websock_server.queue_message
    monkeypatch.setattr(
        browser.server._websock_server, "queue_message", lambda one: (sent.append(one), queue(one))
    )
    browser.scene.show()
    assert 0 < len(sent) < 40


def test_the_goal_is_red_has_its_size_and_turns_green_when_it_is_reached(browser, player):
    (cube,) = nodes(browser, "goal")
    before = red, green, blue = cube.batched_colors[0].tolist()
    assert red > 3 * max(green, blue)
    np.testing.assert_allclose(np.ptp(cube.vertices, axis=0), 0.1, rtol=1e-6)
    player.agent = "scripted"
    while not player.snapshot.done:
        player.tick()
    browser.scene.show()
    red, green, blue = cube.batched_colors[0]
    assert green > 2 * max(red, blue)
    player.reset()
    browser.scene.show()
    np.testing.assert_array_equal(cube.batched_colors[0], before)


def trail(browser):
    browser.scene._frame = 0
    browser.scene.show()
    return browser.server.scene.get_handle_by_name("/trails").points


def test_the_trail_is_the_path_of_the_episode(browser, player):
    browser.scene.show()
    player.agent = "keyboard"
    player.drive(0.5, 0.0)
    for _ in range(90):
        player.tick()
        browser.scene.show()
    points = trail(browser).reshape(-1, 3)
    x = player.snapshot.qpos[QPOS_XYZ][0]
    assert points[:, 0].min() == pytest.approx(0.0, abs=1e-3)
    assert points[:, 0].max() == pytest.approx(x, abs=1e-5)
    # It is one line.
    np.testing.assert_array_equal(points[1:-1:2], points[2::2])
    player.reset()
    assert np.ptp(trail(browser).reshape(-1, 3), axis=0).max() == 0


def test_only_shadows_need_a_floor_that_fills_the_page(browser):
    plane, lines = map(browser.server.scene.get_handle_by_name, ("/floor", "/lines"))
    assert (plane.visible, lines.visible) == (False, True)
    floor = trimesh.load_scene(io.BytesIO(lines.glb_data), file_type="glb")
    assert floor.area < 0.1 * plane.width * plane.height
    np.testing.assert_allclose(floor.extents, (plane.width, plane.height, 0.0), atol=0.01)
    browser.scene.cast_shadows(True)
    assert (plane.visible, lines.visible) == (True, False)
    browser.scene.cast_shadows(False)
    assert (plane.visible, lines.visible) == (False, True)


def test_a_ray_from_above_moves_the_goal_to_where_it_meets_the_floor(browser, player):
    browser.scene.point((1.0, 0.0, 2.0), (-0.1, 0.3, -1.0))
    answer(browser)
    np.testing.assert_allclose(player.snapshot.goal_w, [0.8, 0.6, 0.05], atol=1e-6)


def test_a_goal_that_is_dragged_keeps_under_the_pointer(browser, player):
    player.move_goal(0.5, 0.5)
    # Grabbed at the top of its edge, 0.1 m above the floor.
    browser.scene.point((0.0, 0.0, 1.1), (0.3, 0.4, -1.0), (0.05, 0.0, 0.1))
    answer(browser)
    np.testing.assert_allclose(player.snapshot.goal_w, [0.25, 0.4, 0.05], atol=1e-6)


@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, -0.01)])
def test_a_ray_that_misses_the_floor_moves_nothing(browser, player, direction):
    before = player.snapshot.goal_w
    browser.scene.point((0.0, 0.0, 1.0), direction)
    answer(browser)
    np.testing.assert_array_equal(player.snapshot.goal_w, before)


class Client:
    """A page of 1100 by 720 pixels, whose camera stands at the place that the server gives it."""

    def __init__(self):
        self.camera = types.SimpleNamespace(
            position=np.ones(3),
            look_at=np.zeros(3),
            fov=math.radians(55),
            image_width=1100,
            image_height=720,
        )
        self.notifications = []

    def add_notification(self, title, body, **_):
        self.notifications.append(body)

    def see(self, place_w):
        """Where a place is on the page [pixels]."""
        right, up, ahead = camera_axes(self.camera.look_at - self.camera.position) @ (
            np.asarray(place_w) - self.camera.position
        )
        assert ahead > 0
        focal = 360 / math.tan(self.camera.fov / 2)
        return 550 + focal * right / ahead, 360 - focal * up / ahead


@pytest.fixture
def client(browser, monkeypatch):
    """A page's camera, as viser would hand it out."""
    client = Client()
    monkeypatch.setattr(browser.server, "get_clients", lambda: {0: client})
    browser.scene.cameras._moves.clear()
    yield client
    browser.panel.camera.value = "free"
    answer(browser)


def settle(browser):
    for _ in range(100):
        browser.scene.show()


def assert_in_view(client, *places_w):
    for place_w in places_w:
        column, row = client.see(place_w)
        # The panel begins at the column 765.
        assert 10 < column < 755, place_w
        assert 10 < row < 710, place_w


@pytest.mark.slow
@pytest.mark.parametrize(
    "goal", [(0.2, 0.1), (1.1, -0.5), (-1.1, 0.2), (0.0, 1.2), (2.0, -2.5), (-0.8, -0.9)]
)
def test_robot_and_goal_stay_in_view_beside_the_panel(browser, player, client, goal):
    browser.panel.camera.value = "robot and goal"
    answer(browser)
    player.agent = "scripted"
    player.move_goal(*goal)
    settle(browser)
    for step in range(200):
        player.tick()
        browser.scene.show()
        if player.snapshot.done:
            break
        assert_in_view(client, player.snapshot.qpos[QPOS_XYZ], player.snapshot.goal_w)
        if step == 0:
            # Not from far away either: the farther of the two is near the border of the view.
            places = [client.see(one) for one in (player.snapshot.goal_w, (0.0, 0.0, 0.0))]
            assert math.dist(*places) > 70


def test_the_way_a_user_turned_the_camera_is_kept(browser, player, client):
    browser.panel.camera.value = "robot and goal"
    answer(browser)
    player.move_goal(0.5, 0.5)
    settle(browser)
    # The user looks from the other side, and zooms out: the camera stays so.
    client.camera.position, client.camera.look_at = np.array([3.0, 3.0, 3.0]), np.zeros(3)
    settle(browser)
    np.testing.assert_array_equal(client.camera.position, 3.0)
    player.move_goal(-0.9, 0.5)
    settle(browser)
    ahead = client.camera.look_at - client.camera.position
    np.testing.assert_allclose(ahead / np.linalg.norm(ahead), -1 / math.sqrt(3), atol=1e-3)
    assert np.linalg.norm(client.camera.position) < 3
    assert_in_view(client, player.snapshot.goal_w, (0.0, 0.0, 0.0))


def test_the_camera_does_not_move_while_a_goal_is_dragged(browser, player, client):
    browser.panel.camera.value = "robot and goal"
    answer(browser)
    settle(browser)
    before = np.array(client.camera.position)
    browser.scene._dragging = True
    player.move_goal(2.0, 2.0)
    settle(browser)
    np.testing.assert_array_equal(client.camera.position, before)
    browser.scene._dragging = False
    settle(browser)
    assert_in_view(client, player.snapshot.goal_w)


def test_the_camera_drives_behind_the_robot(browser, player, client):
    browser.panel.camera.value = "behind the robot"
    player.agent = "keyboard"
    player.drive(0.3, -1.2)
    for _ in range(60):
        player.tick()
    for _ in range(120):
        answer(browser)
    robot_w = player.snapshot.qpos[QPOS_XYZ]
    w, _, _, z = player.snapshot.qpos[QPOS_QUAT]
    heading = 2 * math.atan2(z, w)
    behind = client.camera.position - robot_w
    assert math.atan2(-behind[1], -behind[0]) == pytest.approx(heading, abs=0.02)
    assert behind[2] > 0.3
    ahead = client.camera.look_at - robot_w
    assert math.atan2(ahead[1], ahead[0]) == pytest.approx(heading, abs=0.02)


def test_a_free_camera_is_left_alone(browser, client):
    browser.panel.camera.value = "free"
    answer(browser)
    before = np.array(client.camera.position)
    settle(browser)
    np.testing.assert_array_equal(client.camera.position, before)


# Many robots.


@pytest.fixture(scope="module")
def crowd(smoke_run, unused_port):
    player = Player(smoke_run, robots=10, agent="scripted")
    player.paused = True
    with ViserViewer(player, host="127.0.0.1", port=unused_port(), tell=print) as browser:
        yield browser, player


def test_many_robots_stand_in_cells_and_the_page_sees_all_of_them(crowd, monkeypatch):
    browser, player = crowd
    client = Client()
    monkeypatch.setattr(browser.server, "get_clients", lambda: {0: client})
    player.reset()
    settle(browser)
    (cube,) = nodes(browser, "goal")
    robot = nodes(browser, "jetbot")[0].batched_positions
    assert robot.shape == (10, 3)
    apart = np.linalg.norm(robot[:, None] - robot, axis=-1) + 9 * np.eye(10)
    assert apart.min() == pytest.approx(1.2, abs=0.01)
    # Goals are where they are relative to their robots.
    places = cube.batched_positions - robot
    np.testing.assert_allclose(places[:, :2], player.crowd.goal_w[:, :2], atol=1e-3)
    assert_in_view(client, *robot, *cube.batched_positions)


def test_a_click_moves_the_goal_of_the_nearest_robot_and_chooses_it(crowd):
    browser, player = crowd
    player.reset()
    browser.scene.show()
    target = nodes(browser, "jetbot")[0].batched_positions[7] + [0.3, -0.2, 0.0]
    before = np.array(player.crowd.goal_w)
    browser.scene.point((target[0], target[1], 2.0), (0.0, 0.0, -1.0))
    answer(browser)
    assert player.robot == 7
    assert browser.panel.robot.value == 7
    np.testing.assert_allclose(player.snapshot.goal_w[:2], [0.3, -0.2], atol=1e-2)
    np.testing.assert_array_equal(player.crowd.goal_w[:7], before[:7])
    browser.panel.robot.value = 2
    answer(browser)
    assert player.robot == 2
    assert browser.panel.texts["Distance"].value == f"{np.linalg.norm(before[2, :2]):.2f} m"


# The panel.


def test_the_panel_reads_what_the_player_does(browser, player):
    panel = browser.panel
    player.successes, player.episodes, player.outcome = 2, 3, "reached"
    player.move_goal(0.3, 0.4)
    player.tick()
    answer(browser)
    assert panel.texts["Goals"].value == "2 of 3 reached"
    assert panel.texts["Episode"].value == "0.0 of 4.3 s"
    assert panel.texts["Distance"].value == "0.50 m"
    assert "steps/s" in panel.texts["Pace"].value
    assert "progress +0." in panel.rewards.content
    player.crowd = player.crowd._replace(done=np.ones(1, np.float32))
    panel.update()
    assert panel.texts["Episode"].value == "0.0 of 4.3 s, reached"


def test_the_terms_of_the_reward_are_bars_relative_to_their_largest(browser, player, monkeypatch):
    rewards = {"progress": 0.02, "<b>": -0.5}
    monkeypatch.setattr(browser.panel, "_largest", dict.fromkeys(rewards, 1e-9))
    for scale, width in ((1.0, 50.0), (0.5, 25.0)):
        player.crowd = player.crowd._replace(
            rewards={name: np.array([scale * value]) for name, value in rewards.items()},
            returns=dict.fromkeys(rewards, np.array([0.25])),
        )
        bars = browser.panel._reward_bars()
        assert bars.count(f"width:{width:.1f}%") == 2
    assert "progress +0.0100</span><span>+0.250" in bars
    assert "&lt;b&gt; -0.2500" in bars
    # In the order of the names, as JAX returns them.
    assert bars.index("right:50%") < bars.index("left:50%")


def test_the_panel_changes_who_drives(browser, player):
    panel = browser.panel
    panel.agent.value = "keyboard"
    answer(browser)
    assert player.agent == "keyboard"
    assert panel.drive_controls.visible
    panel.agent.value = "scripted"
    answer(browser)
    assert player.agent == "scripted"
    assert not panel.drive_controls.visible


def test_the_panel_switches_the_checkpoint(browser, player):
    first, last = player.checkpoints[0], player.checkpoints[-1]
    for steps in (first, last):
        browser.panel.checkpoint.value = f"{steps:,} steps"
        answer(browser)
        assert player.checkpoint == steps


def test_a_checkpoint_that_cannot_be_used_is_told_on_the_page(browser, player, client, tmp_path):
    panel, before, run_dir = browser.panel, player.checkpoint, player.run_dir
    other = next(steps for steps in player.checkpoints if steps != before)
    player.run_dir = tmp_path
    try:
        panel.checkpoint.value = f"{other:,} steps"
        browser.step()
    finally:
        player.run_dir = run_dir
    assert len(client.notifications) == 1
    assert "no checkpoint at" in client.notifications[0]
    assert panel.checkpoint.value == f"{before:,} steps"
    assert player.checkpoint == before
    answer(browser)


def press(browser, button):
    browser.panel.buttons.value = button
    answer(browser)


def test_the_buttons_pause_step_and_reset(browser, player):
    player.agent = "scripted"
    player.paused = False
    press(browser, "Pause")
    assert player.paused
    assert browser.panel.buttons.options[0] == "Resume"
    before = player.time
    press(browser, "Step")
    assert player.time == pytest.approx(before + 1 / 60)
    goal_w = player.snapshot.goal_w
    press(browser, "New episode")
    assert player.time == 0
    assert not np.allclose(player.snapshot.goal_w, goal_w)
    press(browser, "Resume")
    assert not player.paused
    assert browser.panel.buttons.options[0] == "Pause"


def test_the_pace_is_the_users(browser, player):
    browser.panel.speed.value = 2.5
    answer(browser)
    assert player.speed == 2.5
    browser.panel.speed.value = 1.0
    answer(browser)


def test_sliders_and_keys_ask_for_the_same(browser, player):
    panel = browser.panel
    panel.agent.value = "keyboard"
    panel.ahead.value, panel.left.value = 0.5, -90
    answer(browser)
    assert player.command == pytest.approx((0.5, -math.pi / 2))
    keys = {command.hotkey: command for command in panel._keys}
    assert not any(command.disabled for command in keys.values())
    for key in "IL":
        for call in keys[key]._impl.trigger_cb:
            call(None)
    answer(browser)
    answer(browser)  # what the sliders called back
    assert player.command == pytest.approx((0.625, -math.radians(112)), abs=0.01)
    assert panel.ahead.value == pytest.approx(0.625)
    for call in keys["H"]._impl.trigger_cb:
        call(None)
    answer(browser)
    answer(browser)
    assert player.command == (0.0, 0.0)
    panel.agent.value = "policy"
    answer(browser)
    assert all(command.disabled for command in keys.values())


def test_a_checkpoint_written_meanwhile_can_be_chosen(browser, player, monkeypatch):
    steps = [*player.checkpoints, 999_424]
    monkeypatch.setattr(Player, "checkpoints", steps)
    browser.panel.update()
    assert browser.panel.checkpoint.options[-1] == "999,424 steps"


def test_a_task_whose_goals_stay_says_so_and_plays_on(player, monkeypatch):
    monkeypatch.setattr(player, "cannot_move_goal", "the goal stays: because")
    said = []
    monkeypatch.setattr(viser.GuiApi, "add_markdown", lambda _, content: said.append(content))
    asked = []

    def ask(do, *given):
        asked.append((do, given))

    server = viser.ViserServer("127.0.0.1", 0, verbose=False)
    try:
        scene = Scene(server, player, ask)
        ControlPanel(server, player, scene, ask)
        assert "the goal stays: because" in said
        before = player.snapshot.goal_w
        scene.point((0.0, 0.0, 1.0), (0.1, 0.1, -1.0))
        for do, given in asked:
            do(*given)
        np.testing.assert_array_equal(player.snapshot.goal_w, before)
        player.tick()
    finally:
        server.stop()


@pytest.mark.parametrize(
    ("control", "value"),
    [
        ("speed", math.nan),
        ("speed", 1e300),
        ("ahead", -math.inf),
        ("left", 1e9),
        ("agent", "nobody"),
        ("checkpoint", "x steps"),
    ],
)
def test_what_no_page_of_ours_would_send_is_ignored(browser, player, monkeypatch, control, value):
    told = []
    monkeypatch.setattr(browser, "_tell", told.append)
    handle = getattr(browser.panel, control)
    before, own = (player.speed, player.agent, player.checkpoint, player.command), handle.value
    handle.value = value
    for _ in range(100):
        browser.step()
        if told:
            break
        time.sleep(0.02)
    assert len(told) == 1
    assert told[0].startswith("ignored what a page asked for: ")
    assert (player.speed, player.agent, player.checkpoint, player.command) == before
    handle.value = own
    time.sleep(0.1)
    answer(browser)
