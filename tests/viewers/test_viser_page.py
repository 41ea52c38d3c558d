"""The page in a headless browser: its contents, clicks, drags and keys."""

import io
import math
import threading
import time

import imageio.v3 as iio
import numpy as np
import pytest

pytest.importorskip("viser")

from viser import ClientHandle

from helpers import chromium
from jetbot_mjx.envs.robot_model import QPOS_XYZ
from jetbot_mjx.viewers.player import Player
from jetbot_mjx.viewers.viser_server import ViserViewer

if chromium.find() is None:
    pytest.skip("no Chromium to look at the page with", allow_module_level=True)

PATIENCE = 30  # [s] software draws a picture or two a second where others want the cores too


def wait_for(what, condition):
    deadline = time.monotonic() + PATIENCE
    while not (found := condition()):
        assert time.monotonic() < deadline, f"waited in vain: {what}"
        time.sleep(0.1)
    return found


@pytest.fixture(scope="module")
def served(smoke_run, unused_port):
    """A player whose loop runs beside the test."""
    player = Player(smoke_run, agent="scripted", seed=3)
    player.paused = True
    over = threading.Event()
    with ViserViewer(player, host="127.0.0.1", port=unused_port(), tell=print) as browser:

        def loop():
            while not over.is_set():
                browser.step()
                time.sleep(0.005)

        thread = threading.Thread(target=loop)
        thread.start()
        yield browser, player
        over.set()
        thread.join()


@pytest.fixture(scope="module")
def page(served, tmp_path_factory):
    browser, _ = served
    with chromium.browse(tmp_path_factory.mktemp("chromium")) as page:
        # At the screen's own resolution from the start: what is slow would be drawn coarser.
        page.open(f"http://127.0.0.1:{browser.server.get_port()}/?fixedDpr=1")
        clients = wait_for("the page's camera", browser.server.get_clients)
        # The camera stays: the tests ask where a place is on the page, and then look there.
        browser.panel.camera.value = "free"
        wait_for("the choice", lambda: browser.scene.cameras.mode == "free")
        for client in clients.values():
            client.camera.position, client.camera.look_at = (-0.52, -1.06, 1.2), (0.14, -0.1, 0.0)
        yield page


@pytest.fixture(scope="module")
def see(served, page):
    browser, _ = served
    (client,) = browser.server.get_clients().values()
    return projection(page, client)


def projection(page, client):
    """A function from a place in the world [m] to where it is on the page [pixels]."""

    def see(place):
        camera = client.camera
        w, x, y, z = camera.wxyz
        axes = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        right, down, ahead = axes.T @ (np.asarray(place) - camera.position)
        width, height = page.evaluate("[innerWidth, innerHeight]")
        focal = height / 2 / math.tan(camera.fov / 2)
        return width / 2 + focal * right / ahead, height / 2 + focal * down / ahead

    return see


def red(picture):
    """Middle of what is red [pixels]; None where nothing is."""
    r, g, b = np.moveaxis(picture.astype(int), -1, 0)
    # The page's warnings are orange.
    rows, columns = np.nonzero((r > 140) & (g < 60) & (b < 60))
    return (columns.mean(), rows.mean()) if len(rows) > 50 else None


def shows_the_goal(page, see, player):
    def shown():
        found = red(page.screenshot())
        return found and math.dist(found, see(player.snapshot.goal_w)) < 12

    return shown


def dark_near(page, see, place):
    """How many dark pixels, tyres and boards, there are round a place; the floor is light."""
    x, y = map(round, see(place))
    return int((page.screenshot()[y - 15 : y + 15, x - 15 : x + 15].max(axis=-1) < 100).sum())


def put(player, served, place):
    """Puts the goal somewhere; to the left of the robot, the panel does not hide it."""
    browser, _ = served
    browser._ask(player.move_goal, *place)
    wait_for("the goal", lambda: np.allclose(player.snapshot.goal_w[:2], place))


def test_the_page_shows_the_robot_and_a_red_goal(served, page, see):
    _, player = served
    put(player, served, (-0.3, 0.2))
    wait_for("the goal on the page", shows_the_goal(page, see, player))
    assert dark_near(page, see, player.snapshot.qpos[QPOS_XYZ]) > 50
    assert page.evaluate("document.body.innerText").count("Checkpoint") == 1


def test_the_page_loads_nothing_from_other_hosts(served, page):
    browser, _ = served
    origin = f"127.0.0.1:{browser.server.get_port()}/"
    own = (f"http://{origin}", f"ws://{origin}", f"blob:http://{origin}", "data:")
    assert [url for url in page.requested if url.startswith("http")]
    assert [url[:80] for url in page.requested if not url.startswith(own)] == []


def test_a_click_on_the_floor_moves_the_goal_and_the_robot_drives_there(served, page, see):
    browser, player = served
    target = (-0.35, -0.25)
    start_w = np.array(player.snapshot.qpos[QPOS_XYZ])
    page.click(*see((*target, 0.0)))
    wait_for("the click", lambda: np.allclose(player.snapshot.goal_w[:2], target, atol=0.02))
    wait_for("the goal on the page", shows_the_goal(page, see, player))
    assert dark_near(page, see, start_w) > 50
    before = player.successes
    player.paused = False
    wait_for("the robot at the goal", lambda: player.successes > before)
    player.paused = True
    assert player.distance < 0.1
    # On the page too it stands there, and no longer where it started.
    wait_for("the robot gone", lambda: dark_near(page, see, start_w) < 20)
    assert dark_near(page, see, player.snapshot.qpos[QPOS_XYZ]) > 50
    browser._ask(player.reset)


def test_the_goal_can_be_dragged_over_the_floor(served, page, see):
    _, player = served
    put(player, served, (-0.25, 0.2))
    wait_for("the goal on the page", shows_the_goal(page, see, player))
    x, y, z = map(float, player.snapshot.goal_w)
    places = [(x - step / 2, y - step, z) for step in np.linspace(0.0, 0.3, 6)]
    page.drag(*[see(place) for place in places])
    wait_for("the drag", lambda: np.allclose(player.snapshot.goal_w[:2], places[-1][:2], atol=0.03))
    assert player.snapshot.goal_w[2] == pytest.approx(0.05)


def middle(page, element):
    """Where an element is [pixels], once it has come to rest; the page's own words say which."""
    where = f"""(() => {{
        const box = ({element})?.getBoundingClientRect();
        return box?.height ? [box.x + box.width / 2, box.y + box.height / 2] : null;
    }})()"""
    seen = []

    def rests():
        seen.append(page.evaluate(where))
        return seen[-1] and seen[-3:] == [seen[-1]] * 3

    wait_for("an element at rest", rests)
    return seen[-1]


def choose(page, label, option):
    """Chooses from a drop-down by mouse, as a user does."""
    field = f"[...document.querySelectorAll('input')].find((one) => one.value === {label!r})"
    page.click(*middle(page, field))
    entry = (
        "[...document.querySelectorAll('[role=option]')].find((one) =>"
        f" one.innerText === {option!r} && one.getBoundingClientRect().height > 0)"
    )
    page.click(*middle(page, entry))


def test_another_checkpoint_is_chosen_on_the_page(served, page):
    _, player = served
    before, other = player.checkpoint, player.checkpoints[1]
    assert other != before
    choose(page, f"{before:,} steps", f"{other:,} steps")
    wait_for("the checkpoint", lambda: player.checkpoint == other)


def test_keys_drive_once_the_user_is_the_agent(served, page):
    _, player = served
    page.press("i")
    choose(page, "scripted", "keyboard")
    wait_for("the agent", lambda: player.agent == "keyboard")
    assert player.command == (0.0, 0.0)
    # The keys are heard once the page knows of it, some time after the player does.
    wait_for("the wheel", lambda: "Ahead" in page.evaluate("document.body.innerText"))
    # A key that is pressed while a field has the focus belongs to the field.
    page.evaluate("document.activeElement.blur()")
    for key in "iij":
        page.press(key)
    wait_for("the keys", lambda: player.command == pytest.approx((0.25, math.pi / 8), abs=0.02))


def button(page, label):
    return middle(
        page, f"[...document.querySelectorAll('button')].find((one) => one.innerText === {label!r})"
    )


def test_a_clip_shows_what_the_page_shows(served, page, see, monkeypatch):
    _, player = served
    put(player, served, (-0.3, 0.2))
    wait_for("the goal on the page", shows_the_goal(page, see, player))
    files = []
    monkeypatch.setattr(
        ClientHandle,
        "send_file_download",
        lambda _, name, content, save_immediately: files.append((name, content)),
    )
    page.click(*button(page, "Record a clip"))
    place = button(page, "Stop and save the clip")
    time.sleep(1.0)
    page.click(*place)
    wait_for("the file", lambda: files)
    wait_for("the button", lambda: button(page, "Record a clip"))
    ((name, content),) = files
    assert name == "jetbot.mp4"
    frames = iio.imread(io.BytesIO(content), plugin="pyav", extension=".mp4")
    assert len(frames) >= 2
    width, height = page.evaluate("[innerWidth, innerHeight]")
    scale = frames.shape[1] / height
    assert frames.shape[2] == pytest.approx(width * scale, abs=4)
    found = red(frames[-1])
    assert math.dist(found, np.multiply(scale, see(player.snapshot.goal_w))) < 12


def test_a_telephone_is_touched(served, page):
    """The last: the page stays small."""
    browser, player = served
    before = set(browser.server.get_clients())
    page.become_a_telephone()
    page.open(f"http://127.0.0.1:{browser.server.get_port()}/?fixedDpr=1")
    clients = browser.server.get_clients
    (number,) = wait_for("the small page's camera", lambda: set(clients()) - before)
    client = clients()[number]
    client.camera.position, client.camera.look_at = (-0.52, -1.06, 1.2), (0.14, -0.1, 0.0)
    see = projection(page, client)
    browser._ask(player.reset)
    put(player, served, (0.1, 0.2))
    wait_for("the small page", shows_the_goal(page, see, player))
    # A tap moves the goal, and so does a finger that drags it.
    target = (-0.1, 0.3)
    page.touch(see((*target, 0.0)))
    wait_for("the tap", lambda: np.allclose(player.snapshot.goal_w[:2], target, atol=0.03))
    wait_for("the goal on the page", shows_the_goal(page, see, player))
    x, y, z = map(float, player.snapshot.goal_w)
    places = [(x + step, y + step, z) for step in np.linspace(0.0, 0.2, 6)]
    page.touch(*[see(place) for place in places])
    wait_for("the drag", lambda: np.allclose(player.snapshot.goal_w[:2], places[-1][:2], atol=0.04))
