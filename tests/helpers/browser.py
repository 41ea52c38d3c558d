"""Chromium without a window, driven by its DevTools protocol."""

import base64
import contextlib
import itertools
import json
import shutil
import subprocess
import tempfile
import time
import urllib.request
from pathlib import Path

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome")

PROGRAM = next(filter(None, map(shutil.which, NAMES)), None)

OPTIONS = (
    "--headless",
    "--no-sandbox",
    "--hide-scrollbars",
    # Draws without a GPU.
    "--enable-unsafe-swiftshader",
    "--remote-debugging-port=0",
)


class Tab:
    """A tab of the browser. `errors` are what the page's console told as errors."""

    def __init__(self, socket):
        self._socket, self._numbers = socket, itertools.count(1)
        self.errors = []
        for domain in ("Runtime", "Log", "Page"):
            self.send(f"{domain}.enable")

    def send(self, method, **params):
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": params}))
        while True:
            told = json.loads(self._socket.recv(timeout=60))
            if told.get("id") == number:
                assert "error" not in told, told
                return told["result"]
            self._listen(told)

    def _listen(self, told):
        given = told.get("params", {})
        match told["method"]:
            case "Runtime.exceptionThrown":
                self.errors.append(given["exceptionDetails"])
            case "Runtime.consoleAPICalled" if given["type"] in ("error", "assert"):
                self.errors.append(given["args"])
            case "Log.entryAdded" if given["entry"]["level"] == "error":
                self.errors.append(given["entry"])

    def open(self, page, width, height):
        self.send(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=width < 600,
        )
        self.send("Page.navigate", url=page if isinstance(page, str) else page.as_uri())

    def run(self, script):
        """The value of an expression of JavaScript, which may be a promise."""
        given = {"expression": script, "awaitPromise": True, "returnByValue": True}
        result = self.send("Runtime.evaluate", **given)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def wait_for(self, script, seconds=60):
        """Wait until an expression is true."""
        end = time.monotonic() + seconds
        while not self.run(script):
            assert time.monotonic() < end, (script, self.errors)
            time.sleep(0.1)

    def picture(self):
        """The page as PNG."""
        return base64.b64decode(self.send("Page.captureScreenshot", format="png")["data"])


@contextlib.contextmanager
def tab():
    """A tab of a new browser; without one, the test is skipped."""
    if PROGRAM is None:
        pytest.skip("there is no Chromium")
    client = pytest.importorskip("websockets.sync.client")
    with tempfile.TemporaryDirectory() as folder:
        command = [PROGRAM, *OPTIONS, f"--user-data-dir={folder}", "about:blank"]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            port = _port(Path(folder, "DevToolsActivePort"))
            listed = urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=60)
            (address,) = [
                one["webSocketDebuggerUrl"] for one in json.load(listed) if one["type"] == "page"
            ]
            with client.connect(address, max_size=None) as socket:
                yield Tab(socket)
        finally:
            process.kill()
            process.wait()


def _port(file):
    end = time.monotonic() + 60
    while not (file.is_file() and file.read_text().count("\n")):
        assert time.monotonic() < end, "Chromium did not start"
        time.sleep(0.05)
    return int(file.read_text().split()[0])
