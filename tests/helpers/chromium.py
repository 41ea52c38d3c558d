"""Just enough of Chromium's DevTools protocol to look at a page and to click on it."""

import base64
import contextlib
import io
import itertools
import json
import shutil
import subprocess
import time

import numpy as np
from PIL import Image

WIDTH, HEIGHT = 800, 600


def find():
    """Chromium's program, or None."""
    names = ("chromium", "chromium-browser", "google-chrome", "chrome")
    return next(filter(None, map(shutil.which, names)), None)


class Page:
    """One page in a headless browser that draws by software."""

    def __init__(self, connection):
        self._connection = connection
        self._ids = itertools.count(1)
        self._session = None
        self.requested = []
        """Every address that the page asked for."""
        target = self._call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self._call("Target.attachToTarget", targetId=target, flatten=True)[
            "sessionId"
        ]
        for domain in ("Network", "Page", "Runtime"):
            self._call(f"{domain}.enable")

    def open(self, url):
        self._call("Page.navigate", url=url)

    def open_and_wait(self, url):
        self.open(url)
        deadline = time.monotonic() + 60
        while self.evaluate("document.readyState + location.href") != f"complete{url}":
            assert time.monotonic() < deadline, "the page does not load"
            time.sleep(0.05)

    def resize(self, width, height):
        """Make the page as wide and high as a small screen, which no window can be."""
        self._call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=True,
        )

    def print(self):
        """Return the page as it is printed, a PDF."""
        done = self._call("Page.printToPDF", printBackground=True)
        return base64.b64decode(done["data"])

    def evaluate(self, source):
        done = self._call("Runtime.evaluate", expression=source, returnByValue=True)
        return done["result"].get("value")

    def screenshot(self):
        picture = self._call("Page.captureScreenshot", format="png")["data"]
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(picture))).convert("RGB"))

    def mouse(self, kind, x, y):
        buttons = 0 if kind == "Moved" else 1
        self._call(
            "Input.dispatchMouseEvent",
            type=f"mouse{kind}",
            x=x,
            y=y,
            button="none" if kind == "Moved" else "left",
            buttons=buttons,
            clickCount=1,
        )

    def click(self, x, y):
        for kind in ("Moved", "Pressed", "Released"):
            self.mouse(kind, x, y)
            time.sleep(0.05)

    def drag(self, *points):
        self.mouse("Moved", *points[0])
        self.mouse("Pressed", *points[0])
        for x, y in points[1:]:
            self._call(
                "Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y, button="left", buttons=1
            )
            time.sleep(0.1)
        self.mouse("Released", *points[-1])

    def become_a_telephone(self, width=400, height=800):
        """Has a small screen that is touched from here on."""
        self.resize(width, height)
        self._call("Emulation.setTouchEmulationEnabled", enabled=True)

    def touch(self, *points):
        """Puts a finger on a point, moves it to the others, and lifts it."""
        for index, (x, y) in enumerate(points):
            kind = "touchMove" if index else "touchStart"
            self._call("Input.dispatchTouchEvent", type=kind, touchPoints=[{"x": x, "y": y}])
            time.sleep(0.1)
        self._call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])

    def press(self, key):
        for kind in ("keyDown", "keyUp"):
            self._call(
                "Input.dispatchKeyEvent",
                type=kind,
                key=key,
                code=f"Key{key.upper()}",
                windowsVirtualKeyCode=ord(key.upper()),
            )

    def _call(self, method, **parameters):
        number = next(self._ids)
        message = {"id": number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        self._connection.send(json.dumps(message))
        deadline = time.monotonic() + 120
        while time.monotonic() < deadline:  # its events come all the same
            answer = json.loads(self._connection.recv(timeout=30))
            if answer.get("method") == "Network.requestWillBeSent":
                self.requested.append(answer["params"]["request"]["url"])
            if answer.get("method") == "Network.webSocketCreated":
                self.requested.append(answer["params"]["url"])
            if answer.get("id") == number:
                assert "error" not in answer, answer
                return answer["result"]
        raise AssertionError(f"Chromium does not answer {method}")


@contextlib.contextmanager
def browse(folder, *, dark=False):
    """A page of a browser that keeps its files in a folder, for a user of dark pages or of light.

    Colours that DevTools emulate instead would be chosen again before printing.
    """
    from websockets.sync.client import connect

    port_file = folder / "DevToolsActivePort"
    command = [
        find(),
        "--headless=new",
        "--no-sandbox",
        "--remote-debugging-port=0",
        f"--user-data-dir={folder}",
        f"--window-size={WIDTH},{HEIGHT}",
        "--use-gl=angle",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
        "--disable-background-networking",
        "--disable-component-update",
        "--disable-sync",
        "--no-first-run",
        f"--blink-settings=preferredColorScheme={0 if dark else 1}",
    ]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        deadline = time.monotonic() + 30
        while not (port_file.is_file() and len(port_file.read_text().split()) == 2):
            assert process.poll() is None, "Chromium did not start"
            assert time.monotonic() < deadline, "Chromium does not answer"
            time.sleep(0.1)
        port, path = port_file.read_text().split()
        with connect(f"ws://127.0.0.1:{port}{path}", max_size=None) as connection:
            yield Page(connection)
    finally:
        process.terminate()
        process.wait(10)
