"""A clip of what a client of the page sees, with a client that is none."""

import io
import threading
import time
from types import SimpleNamespace

import imageio.v3 as iio
import numpy as np
import pytest

pytest.importorskip("viser")

from jetbot_mjx.viewers import viser_recorder
from jetbot_mjx.viewers.viser_recorder import Recorder


class Client:
    """A page of 300 times 201 pixels that draws a brighter picture each time."""

    def __init__(self, height=201, width=300):
        self.camera = SimpleNamespace(image_height=height, image_width=width)
        self.asked, self.files, self.told = [], [], []

    def get_render(self, height, width, timeout):
        self.asked.append((height, width))
        return np.full((height, width, 3), min(250, 10 * len(self.asked)), np.uint8)

    def send_file_download(self, name, content, save_immediately):
        assert save_immediately
        self.files.append((name, content))

    def add_notification(self, title, text, color):
        self.told.append(text)


@pytest.fixture
def recorder():
    button = SimpleNamespace(label="Record a clip", on_click=lambda act: None)
    return Recorder(SimpleNamespace(add_button=lambda label: button))


def frames_of(client):
    ((name, content),) = client.files
    assert name == "jetbot.mp4"
    return iio.imread(io.BytesIO(content), plugin="pyav", extension=".mp4")


def test_a_second_click_ends_it_and_the_page_gets_the_file(recorder):
    client = Client()
    thread = threading.Thread(target=recorder.toggle, args=[client])
    began = time.monotonic()
    thread.start()
    while len(client.asked) < 5:
        time.sleep(0.01)
    assert recorder.button.label == "Stop and save the clip"
    recorder.toggle(None)  # of another client, which has left since
    thread.join(10)
    elapsed = time.monotonic() - began
    frames = frames_of(client)
    assert recorder.button.label == "Record a clip"
    assert {*client.asked} == {(200, 300)}
    assert frames.shape[1:] == (200, 300, 3)
    # In real time, and what was drawn first is shown first.
    assert 5 <= len(frames) <= 15 * elapsed + 2
    assert frames[0].mean() == pytest.approx(10, abs=4)
    assert frames[-1].mean() > frames[0].mean() + 30
    assert client.told == []


def test_it_ends_by_itself(recorder, monkeypatch):
    monkeypatch.setattr(viser_recorder, "MOST_SECONDS", 0.2)
    client = Client()
    recorder.toggle(client)
    assert len(frames_of(client)) >= 3


def test_a_slow_page_shows_each_picture_for_longer(recorder, monkeypatch):
    monkeypatch.setattr(viser_recorder, "MOST_SECONDS", 0.9)

    class Slow(Client):
        def get_render(self, *size, **options):
            time.sleep(0.4)
            return super().get_render(*size, **options)

    client = Slow()
    recorder.toggle(client)
    assert len(frames_of(client)) >= 5 * len(client.asked)


@pytest.mark.parametrize(
    ("size", "asked"),
    [((1080, 1920), (720, 1280)), ((800, 400), (720, 360)), ((0, 0), (2, 2))],
)
def test_a_clip_is_no_larger_than_a_video(recorder, monkeypatch, size, asked):
    monkeypatch.setattr(viser_recorder, "MOST_SECONDS", -1)
    client = Client(*size)
    recorder.toggle(client)
    assert client.asked == [asked]
    assert frames_of(client).shape[1:3] == asked


@pytest.mark.parametrize(
    ("answer", "told"),
    [
        (RuntimeError("disconnected"), []),
        (TimeoutError("nothing for 10 s"), ["The page sent no picture: nothing for 10 s"]),
        (np.zeros((3, 3, 4)), ["The page sent no picture: its shape is (3, 3, 4)"]),
    ],
)
def test_a_page_that_leaves_or_sends_something_else_ends_it(recorder, answer, told):
    class Other(Client):
        def get_render(self, *_, **__):
            if isinstance(answer, Exception):
                raise answer
            return answer

    client = Other()
    recorder.toggle(client)
    assert (client.files, client.told) == ([], told)
    assert recorder.button.label == "Record a clip"
    # The next one works.
    threading.Timer(0.2, recorder.toggle, [None]).start()
    after = Client()
    recorder.toggle(after)
    assert len(frames_of(after)) > 0
