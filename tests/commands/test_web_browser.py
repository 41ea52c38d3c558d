"""A page in a browser: it draws, drives, learns and takes what a visitor does, without an error."""

import io
import urllib.request

import numpy as np
import PIL.Image
import pytest

from benchmarks.harness.browser import find_browser, open_tab
from benchmarks.throughput.web_page import served
from jetbot_mjx.deployment import write_web_page

pytestmark = pytest.mark.skipif(find_browser() is None, reason="there is no Chromium")

PAGE = "pretrained:jetbot_egocentric"


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "page.html"
    write_web_page(PAGE, path)
    return path


@pytest.fixture(scope="module")
def browser():
    with open_tab() as one:
        yield one


@pytest.fixture
def open_page(browser, page):
    def open_at(width, height):
        browser.errors.clear()
        browser.open(page, width, height)
        browser.wait_for("Boolean(window.jetbot && window.jetbot.ready)")
        return browser

    yield open_at
    assert browser.errors == []


def colours(picture):
    return np.unique(
        np.asarray(PIL.Image.open(io.BytesIO(picture)).convert("RGB")).reshape(-1, 3), axis=0
    )


@pytest.mark.parametrize(("width", "height"), [(1400, 900), (800, 380), (400, 800)])
def test_robots_drive_and_are_drawn(width, height, open_page):
    tab = open_page(width, height)
    tab.wait_for("jetbot.fleet.successes > 3")
    # Every goal is reached in time.
    assert tab.run("jetbot.fleet.successes === jetbot.fleet.episodes")
    reds, greens, _ = colours(tab.picture()).T.astype(int)
    # Among the colours are the red of the cubes and the green of those that were reached.
    assert (reds - greens > 100).any()
    assert tab.run("document.documentElement.scrollWidth <= innerWidth")
    places = tab.run(
        "['pause', 'manual', 'panel'].map((id) => document.getElementById(id))"
        ".map((x) => [x.getBoundingClientRect().left, x.getBoundingClientRect().right])"
    )
    (first, _), (_, last), (panel, _) = places
    # The buttons are whole, and beside the controls where there is room.
    assert first >= 0
    assert last <= (width if width < 740 else panel)


def test_a_thousand_robots_drive(open_page):
    tab = open_page(1280, 720)
    tab.run(
        "[...document.querySelectorAll('label')].find((x) => /1,024/.test(x.innerText)).click()"
    )
    tab.wait_for("jetbot.fleet.count === 1024 && jetbot.fleet.time > 0.5")
    positions = tab.run("Array.from(jetbot.fleet.goals())")
    assert len(positions) == 3 * 1024
    assert np.isfinite(positions).all()


def test_a_policy_learns_in_a_worker_and_its_files_are_offered(open_page):
    tab = open_page(1280, 720)
    tab.run(
        "[...document.querySelectorAll('button')].find((x) => x.textContent === 'Start').click()"
    )
    tab.wait_for(
        "jetbot.learner && jetbot.learner.latest && jetbot.learner.latest.steps > 16000", 120
    )
    first, steps = tab.run("[jetbot.learner.latest.success, jetbot.learner.latest.steps]")
    assert 0 <= first <= 1
    assert steps % 16_384 == 0
    files = tab.run("jetbot.learner.download()")
    assert set(files) == {"policy.py", "policy.json"}
    tab.run("jetbot.learner.stop()")


def test_a_training_ends_with_its_last_step(open_page):
    tab = open_page(1280, 720)
    tab.run("jetbot.app.trainPanel.data.meta.learner.steps = 4096")
    tab.run("document.getElementById('start').click()")
    tab.wait_for("document.getElementById('training').textContent === 'finished'", 120)
    assert tab.run("jetbot.app.trainPanel.current.latest.steps") == 4096
    assert tab.run("document.getElementById('start').textContent") == "Start anew"


def test_a_goal_goes_where_it_is_put_and_a_robot_is_driven_by_hand(open_page):
    tab = open_page(1280, 720)
    tab.run("jetbot.fleet.setGoal(0, 1.5, -0.5)")
    goal = tab.run("Array.from(jetbot.fleet.goals().slice(0, 2))")
    np.testing.assert_allclose(goal, [1.5, -0.5], atol=1e-6)
    tab.run("jetbot.fleet.drive(0, Float32Array.of(-1, 1))")
    tab.wait_for("Math.abs(jetbot.fleet.action(0)[1] - 1) < 1e-6")


def test_a_page_works_under_a_strict_policy_of_its_server(browser, page):
    browser.errors.clear()
    with served(page) as address:
        browser.open(address, 1280, 720)
        browser.wait_for("Boolean(window.jetbot && window.jetbot.ready)")
        browser.run("document.getElementById('start').click()")
        browser.wait_for("Boolean(jetbot.learner && jetbot.learner.latest)", 120)
        with urllib.request.urlopen(address) as answer:
            policy = answer.headers["Content-Security-Policy"]
    assert policy.startswith("default-src 'none'; script-src 'sha256-")
    assert "connect-src" not in policy
    assert browser.errors == []


TOUCH = """
(() => {
  const { simulation } = jetbot.app, { fleet } = simulation, robots = [0, 1];
  jetbot.app.setPaused(true);
  simulation.setDriver(simulation.driver);
  const until = (ended) => { while (!ended()) simulation.step(); };
  // One goal is put before its robot, another robot is pushed; both episodes end.
  const [x, y] = fleet.robots.numbers("qpos", 0);
  simulation.setGoal(0, x, y);
  simulation.push(1);
  const seen = robots.map(() => 0);
  until(() => robots.every((robot) => (seen[robot] += fleet.done[robot])));
  return [simulation.score, fleet.episodes, fleet.successes, simulation.touched.size, seen];
})()
"""


def test_episodes_that_a_visitor_changes_do_not_count(open_page):
    tab = open_page(1280, 720)
    score, episodes, successes, touched, seen = tab.run(TOUCH)
    assert min(seen) >= 1
    assert touched == 0
    # One episode of each robot is left out; the one whose goal is at its place has reached it.
    assert score["episodes"] == episodes - 2
    assert successes - 2 <= score["successes"] <= successes - 1
    # A robot that is driven by hand counts for its driver alone.
    tab.run("jetbot.app.setManual(true)")
    counted = tab.run(
        "(() => { const { simulation } = jetbot.app, { chosen, mine } = simulation;"
        " const before = simulation.score.episodes, all = simulation.fleet.episodes;"
        " while (mine.episodes < 1) simulation.step();"
        " return [simulation.score.episodes - before, simulation.fleet.episodes - all]; })()"
    )
    assert counted[0] == counted[1] - 1


def test_a_browser_without_webgl_is_told_in_one_line(browser, page, tmp_path):
    # Without WebGL 2, a canvas has no such context.
    spoilt = page.read_text("utf-8").replace('getContext("webgl2"', 'getContext("webgl9"')
    assert spoilt != page.read_text("utf-8")
    path = tmp_path / "spoilt.html"
    # The changed script has another hash: leave the policy out.
    path.write_text(spoilt.replace("Content-Security-Policy", "X-Nothing"), "utf-8")
    browser.errors.clear()
    browser.open(path, 1280, 720)
    browser.wait_for("Boolean(document.body && document.body.innerText.includes('WebGL'))")
    assert browser.errors == []
