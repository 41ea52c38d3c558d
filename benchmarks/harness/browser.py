"""Drive Chromium without a window, by its DevTools protocol."""

import base64
import contextlib
import itertools
import json
import shutil
import subprocess
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from jetbot_mjx.errors import UserError

_NAMES = ("chromium", "chromium-browser", "google-chrome")

_OPTIONS = (
    "--headless",
    "--no-sandbox",
    "--hide-scrollbars",
    # Draws without a GPU.
    "--enable-unsafe-swiftshader",
    "--remote-debugging-port=0",
)


def find_browser() -> str | None:
    """Return Chromium's program, or None."""
    return next(filter(None, map(shutil.which, _NAMES)), None)


class Tab:
    """A tab of the browser."""

    def __init__(self, socket: Any) -> None:
        """Listen to a tab.

        Args:
          socket: a connection to the tab's debugger.
        """
        self._socket, self._numbers = socket, itertools.count(1)
        self.errors: list[Any] = []
        """What the page's console reported as errors."""
        for domain in ("Runtime", "Log", "Page"):
            self.send(f"{domain}.enable")

    def send(self, method: str, **params: Any) -> dict[str, Any]:
        """Call a method of the protocol and return its result."""
        number = next(self._numbers)
        self._socket.send(json.dumps({"id": number, "method": method, "params": params}))
        while True:
            told = json.loads(self._socket.recv(timeout=120))
            if told.get("id") == number:
                assert "error" not in told, told
                return told["result"]
            self._listen(told)

    def _listen(self, told: dict[str, Any]) -> None:
        given = told.get("params", {})
        match told["method"]:
            case "Runtime.exceptionThrown":
                self.errors.append(given["exceptionDetails"])
            case "Runtime.consoleAPICalled" if given["type"] in ("error", "assert"):
                self.errors.append(given["args"])
            case "Log.entryAdded" if given["entry"]["level"] == "error":
                self.errors.append(given["entry"])

    def open(self, page: Path | str, width: int, height: int) -> None:
        """Open a page, in a window of `width` × `height` pixels.

        Args:
          page: a file or an address.
          width: a width below 600 pixels is a telephone's.
          height: the height.
        """
        self.send(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=width < 600,
        )
        self.send("Page.navigate", url=page if isinstance(page, str) else page.as_uri())

    def run(self, script: str) -> Any:
        """Return the value of an expression of JavaScript, which may be a promise."""
        given = {"expression": script, "awaitPromise": True, "returnByValue": True}
        result = self.send("Runtime.evaluate", **given)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def wait_for(self, script: str, seconds: float = 60) -> None:
        """Wait until an expression is true."""
        end = time.monotonic() + seconds
        while not self.run(script):
            assert time.monotonic() < end, (script, self.errors)
            time.sleep(0.1)

    def picture(self) -> bytes:
        """Return the page as PNG."""
        return base64.b64decode(self.send("Page.captureScreenshot", format="png")["data"])


@contextlib.contextmanager
def open_tab() -> Iterator[Tab]:
    """Yield a tab of a new browser.

    Raises:
      UserError: Chromium or `websockets` is not installed.
    """
    program = find_browser()
    if program is None:
        raise UserError("Chromium is not installed: apt install chromium")
    try:
        from websockets.sync.client import connect
    except ModuleNotFoundError:
        raise UserError("websockets is not installed: pip install websockets") from None

    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        command = [program, *_OPTIONS, f"--user-data-dir={folder}", "about:blank"]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            port = _port(Path(folder, "DevToolsActivePort"))
            listed = urllib.request.urlopen(f"http://127.0.0.1:{port}/json", timeout=60)
            (address,) = [
                one["webSocketDebuggerUrl"] for one in json.load(listed) if one["type"] == "page"
            ]
            with connect(address, max_size=None) as socket:
                yield Tab(socket)
        finally:
            process.kill()
            process.wait()


def _port(file: Path) -> int:
    end = time.monotonic() + 60
    while not (file.is_file() and file.read_text().count("\n")):
        assert time.monotonic() < end, "Chromium did not start"
        time.sleep(0.05)
    return int(file.read_text().split()[0])
