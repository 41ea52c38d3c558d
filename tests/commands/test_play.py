"""The command `play`."""

import os
import re
import signal
import socket
import sys
import threading
import time
import urllib.request

import pytest

from jetbot_mjx import cli, play, viewers
from jetbot_mjx.errors import UserError
from jetbot_mjx.viewers import live, mujoco_window
from jetbot_mjx.viewers.step_fns import AGENTS


@pytest.fixture
def nothing_loads(monkeypatch):
    """What is refused has to be refused before anything that takes time."""

    def load(*_, **__):
        raise AssertionError("loaded")

    monkeypatch.setattr(live, "Player", load)


def test_the_page_is_served_until_ctrl_c(smoke_run, capfd, unused_port, monkeypatch):
    free_port = pytest.importorskip("jetbot_mjx.viewers.viser_server").free_port
    port = unused_port()
    pages = []

    def look_and_interrupt():
        # Until the page is there; then as a terminal does on Ctrl-C.
        for _ in range(300):
            try:
                with urllib.request.urlopen(f"http://127.0.0.1:{port}/", timeout=5) as answer:
                    pages.append(answer.status)
                break
            except OSError:
                time.sleep(0.2)
        time.sleep(1.0)
        os.kill(os.getpid(), signal.SIGINT)

    opened = []
    monkeypatch.setattr(live, "has_display", lambda: True)
    monkeypatch.setattr(live.webbrowser, "open", opened.append)
    threading.Thread(target=look_and_interrupt, daemon=True).start()
    assert play.main([str(smoke_run), "--port", str(port), "--agent", "scripted"]) == 0
    assert pages == [200]
    assert opened == [f"http://127.0.0.1:{port}"]
    told, complaints = capfd.readouterr()
    assert complaints == ""
    loading, first, second, last = told.splitlines()
    assert str(smoke_run) in loading
    assert f"http://127.0.0.1:{port} " in first
    assert f"ssh -N -L {port}:127.0.0.1:{port} " in second
    assert re.fullmatch(r"\d+ of \d+ goals reached", last)
    # The port is free again.
    assert free_port("127.0.0.1", port) == port


@pytest.mark.parametrize(
    ("host", "here", "lines"),
    [
        ("127.0.0.1", "127.0.0.1", 2),
        ("0.0.0.0", "127.0.0.1", 3),
        ("::1", "[::1]", 2),
        ("::", "[::1]", 3),
        ("robots.example", "robots.example", 2),
    ],
)
def test_the_address_is_one_to_open_and_a_warning_where_all_may(host, here, lines):
    told = live.addresses(host, 8080)
    assert f"http://{here}:8080 " in told[0]
    assert f"-L 8080:{here}:8080 " in told[1]
    assert len(told) == lines
    assert ("everyone" in told[-1]) == (lines == 3)


@pytest.mark.parametrize(
    ("environment", "seen"),
    [({"DISPLAY": ":0"}, True), ({}, False), ({"DISPLAY": ":0", "SSH_CONNECTION": "a b"}, False)],
)
def test_a_browser_opens_only_where_its_user_sees_it(monkeypatch, environment, seen):
    monkeypatch.setattr(sys, "platform", "linux")
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "SSH_CONNECTION"):
        monkeypatch.delenv(name, raising=False)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    assert live.has_display() == seen


def test_a_user_without_a_name_is_left_out(monkeypatch):
    def fail():
        raise KeyError("getpwuid(): uid not found: 1234")

    monkeypatch.setattr(live.getpass, "getuser", fail)
    assert (
        f"-L 8080:127.0.0.1:8080 {socket.gethostname()}, and open"
        in (live.addresses("127.0.0.1", 8080)[1])
    )


def test_without_viser_one_line_says_what_to_install(smoke_run, monkeypatch, nothing_loads):
    monkeypatch.delitem(sys.modules, "jetbot_mjx.viewers.viser_server", raising=False)
    monkeypatch.delattr(viewers, "viser_server", raising=False)
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(UserError, match=r"pip install 'jetbot_mjx\[play\]'") as caught:
        play.main([str(smoke_run)])
    assert "\n" not in str(caught.value)


def test_a_busy_port_is_refused_at_once(smoke_run, nothing_loads):
    pytest.importorskip("viser")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        with pytest.raises(UserError, match=f"--port {port} is already in use"):
            play.main([str(smoke_run), "--port", str(port)])


def test_without_a_display_a_window_is_refused_at_once(smoke_run, monkeypatch, nothing_loads):
    def refuse():
        raise UserError("no display")

    monkeypatch.setattr(mujoco_window, "require_window", refuse)
    with pytest.raises(UserError, match="no display"):
        play.main([str(smoke_run), "--viewer", "native"])


def test_the_window_shows_one_robot(smoke_run, nothing_loads):
    with pytest.raises(UserError, match="--robots 4: --viewer native shows one robot"):
        play.main([str(smoke_run), "--viewer", "native", "--robots", "4"])


def test_the_window_is_driven_until_it_is_closed(smoke_run, monkeypatch, capsys):
    seen = []
    monkeypatch.setattr(mujoco_window, "require_window", lambda: None)
    monkeypatch.setattr(mujoco_window, "run", seen.append)
    monkeypatch.setattr(live, "Player", FakePlayer)
    assert play.main([str(smoke_run), "--viewer", "native", "--seed", "3"]) == 0
    (player,) = seen
    assert player.given == {"which": "best", "agent": "policy", "seed": 3, "robots": 1}
    assert capsys.readouterr().out.splitlines()[-1] == "1 of 2 goals reached"


class FakePlayer:
    successes, episodes = 1, 2

    def __init__(self, run_or_checkpoint, **given):
        self.given = given


@pytest.mark.parametrize(
    ("text", "origin"),
    [
        ("https://Hub.Example.org/", "https://hub.example.org"),
        ("http://localhost:3000", "http://localhost:3000"),
        ("https://hub.example.org:443", "https://hub.example.org"),
        ("http://[::1]:3000", "http://[::1]:3000"),
    ],
)
def test_origins_are_read_as_browsers_write_them(text, origin):
    assert cli.origin(text) == origin


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--allow-origin", "hub.example.org"], "'hub.example.org' is not an origin: write it as"),
        (["--allow-origin", "https://hub/user"], "is not an origin"),
        (["--allow-origin", "http://hub:port"], "is not an origin"),
        (["--allow-origin", "http://["], "is not an origin"),
        (["--allow-origin", "*"], "is not an origin"),
        (["--agent", "nobody"], "invalid choice: 'nobody'"),
        (["--viewer", "vnc"], "invalid choice: 'vnc'"),
        (["--port", "0"], "0 is too small: give at least 1"),
        (["--port", "70000"], "70000 is too large: give at most 65535"),
        (["--port", "http"], "'http' is not a whole number"),
        (["--robots", "0"], "0 is too small: give at least 1"),
        (["--robots", "9999"], "9999 is too large: give at most 256"),
        (["--seed", "-1"], "-1 is too small"),
        (["--checkpoint", "worst"], "neither best, last nor a number"),
    ],
)
def test_a_wrong_argument_is_one_line(arguments, message, capsys):
    with pytest.raises(SystemExit) as caught:
        play.main(["runs/none", *arguments])
    assert caught.value.code == 2
    complaint = capsys.readouterr().err
    assert message in complaint
    assert complaint.count("\n") == 1


def test_a_run_that_is_not_there_is_one_line(tmp_path):
    pytest.importorskip("viser")
    with pytest.raises(UserError, match="no such folder"):
        play.main([str(tmp_path / "none")])


def test_the_agents_are_those_of_the_viewer():
    assert play._AGENTS == AGENTS
