"""Show a player in the browser with viser; one port serves the page and its data.

With viser the page renders, so this machine needs no OpenGL and little data crosses an ssh tunnel,
and clicks, drags and keys come back to Python. rerun records and shows recordings, without input;
MuJoCo in WebAssembly would run in the page, where the policy is not.

Threads: viser calls back from its own threads. A callback puts its request into a queue, and the
thread that drives the player executes it between two steps.

Security: any page in a browser may open a connection to this machine, and viser accepts them all.
The header `Origin` names the page's server; `_OriginCheck` accepts only this player's own page.
"""

import contextlib
import errno
import http
import ipaddress
import logging
import queue
import socket
import time
import urllib.parse
from collections.abc import Callable, Iterator, Sequence
from typing import Any
from unittest import mock

import rich
import viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from jetbot_mjx.errors import UserError, clipped, printable
from jetbot_mjx.viewers.player import Player
from jetbot_mjx.viewers.realtime import Clock
from jetbot_mjx.viewers.viser_panel import ControlPanel
from jetbot_mjx.viewers.viser_scene import FPS, Scene

_Handler = Callable[[ServerConnection, Request], Response | None]

FIRST_PORT = 8080
_PORTS_TRIED = 100
_PANEL_UPDATES_PER_SECOND = 5
_MAX_REPORTED_ORIGINS = 10


class _Server(viser.ViserServer):
    """viser's server without its public tunnel."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Return no URL: pages cannot open a tunnel."""
        del verbose


class ViserViewer(contextlib.AbstractContextManager["ViserViewer"]):
    """A `ViserViewer` serves one player to any number of clients.

    It is a context manager that stops the server.
    """

    def __init__(
        self,
        player: Player,
        host: str,
        port: int,
        *,
        allow: Sequence[str] = (),
        tell: Callable[[str], None],
    ) -> None:
        """Open the port and build scene and panel.

        Args:
          player: the player.
          host: the address to listen on; everybody who can reach it can watch and interfere.
          port: the port to listen on, from `free_port`.
          allow: origins of other pages that may connect, such as `https://hub.example.org`.
          tell: a function that receives one line for each of the first refused origins.

        Raises:
          UserError: the port was taken meanwhile, or the origin check could not be installed.
        """
        origin_check = _OriginCheck(host, allow, tell)
        with _quiet(), origin_check.install():
            self.server = _Server(host, port, label=player.run_dir.name, verbose=False)
        if not origin_check.installed:
            self.close()
            raise UserError(
                f"viser {viser.__version__} lets in pages from anywhere: pip install viser==1.1.1"
            )
        # If the port is taken, viser uses the next one.
        if self.server.get_port() != port:
            self.close()
            raise UserError(f"--port {port} has just been taken by another program: try again")
        self._player, self._tell = player, tell
        self._requests: queue.SimpleQueue[Callable[[], object]] = queue.SimpleQueue()
        self.scene = Scene(self.server, player, self._ask)
        self.panel = ControlPanel(self.server, player, self.scene, self._ask)
        self._scene_clock = Clock(1 / FPS, time.monotonic())
        self._panel_clock = Clock(1 / _PANEL_UPDATES_PER_SECOND, time.monotonic())

    def run(self) -> None:
        """Drive and show the player until the user interrupts."""
        while True:
            self.step()
            time.sleep(min(self._player.wait(), self._scene_clock.wait(time.monotonic())))

    def step(self) -> None:
        """Execute queued requests, make the steps that are due, and show the result."""
        while not self._requests.empty():
            try:
                self._requests.get()()
            # Any program on this machine may send what no page of this player's would.
            except (ValueError, LookupError, TypeError, ArithmeticError) as error:
                self._tell(f"ignored what a page asked for: {printable(clipped(str(error)))}")
        self._player.advance()
        if self._scene_clock.due(time.monotonic()):
            self.scene.show()
        if self._panel_clock.due(time.monotonic()):
            self.panel.update()
        if self.panel.policy_view is not None:
            self.panel.policy_view.update()

    def close(self) -> None:
        """Stop the server."""
        with _quiet():
            self.server.stop()

    def __exit__(self, *exception: object) -> None:
        """Stop the server."""
        self.close()

    def _ask(self, function: Callable[..., object], *arguments: object) -> None:
        """Queue a call for the player's thread."""
        self._requests.put(lambda: function(*arguments))


class _OriginCheck:
    """An `_OriginCheck` accepts connections of this player's page and of allowed origins only."""

    def __init__(self, host: str, allow: Sequence[str], tell: Callable[[str], None]) -> None:
        """Prepare the check; `install` adds it to viser's server.

        Args:
          host: the address that the server listens on.
          allow: further origins that may connect.
          tell: a function that receives one line for each of the first refused origins.
        """
        name = socket.gethostname().lower()
        self._names = {host.lower(), "localhost", name, f"{name}.local"}
        self._allow, self._tell = set(allow), tell
        self._refused: set[str] = set()
        self.installed = False
        """Whether viser's server uses the check."""

    @contextlib.contextmanager
    def install(self) -> Iterator[None]:
        """Add the check to a server that viser starts inside.

        viser 1.1 takes neither origins nor a function that checks requests for its websocket
        server, although `websockets.asyncio.server.serve` does. So its call is replaced while it
        starts, and `installed` says whether that has worked.
        """
        serve = websockets.asyncio.server.serve

        def serve_with_check(
            *arguments: Any, process_request: _Handler, **options: Any
        ) -> websockets.asyncio.server.serve:
            def check(connection: ServerConnection, request: Request) -> Response | None:
                refusal = self._refusal(connection, request)
                return process_request(connection, request) if refusal is None else refusal

            self.installed = True
            options["logger"] = _log_without_unused_connections()
            return serve(*arguments, process_request=check, **options)

        with mock.patch.object(websockets.asyncio.server, "serve", serve_with_check):
            yield

    def _refusal(self, connection: ServerConnection, request: Request) -> Response | None:
        """Return the HTTP response that refuses a request; None if the request is accepted."""
        headers = request.headers
        # Only websockets matter: the page is not secret. Programs other than browsers could send
        # any header, so the check protects against foreign pages only.
        if not headers.get_all("Upgrade"):
            return None
        host = "".join(headers.get_all("Host"))
        for origin in headers.get_all("Origin"):
            if not self.is_allowed(origin, host):
                if origin not in self._refused and len(self._refused) < _MAX_REPORTED_ORIGINS:
                    self._refused.add(origin)
                    self._tell(
                        f"refused: a page from {origin[:200]!r} asked to connect; --allow-origin"
                        " lets it in"
                    )
                return connection.respond(http.HTTPStatus.FORBIDDEN, "another page's origin\n")
        return None

    def is_allowed(self, origin: str, host: str) -> bool:
        """Return whether a page may connect.

        Args:
          origin: the header `Origin`: the server of the page.
          host: the header `Host`: the server that the page connects to. It must equal the origin's
            and be an address or a name of this machine: an attacker could point any other name
            at this machine after serving a page under it (DNS rebinding).
        """
        if origin in self._allow:
            return True
        try:
            parts = urllib.parse.urlsplit(origin.lower())
            name = parts.hostname or ""
            if parts.scheme not in ("http", "https") or parts.netloc != host.lower():
                return False
            return name in self._names or bool(ipaddress.ip_address(name))
        except ValueError:
            return False


def _log_without_unused_connections() -> logging.Logger:
    """Return a log for the server that leaves out connections which are closed without a request.

    Browsers open some in advance, and so does whatever looks whether a port is open. The server
    would show each with a traceback.
    """
    log = logging.getLogger(f"{__name__}.websockets")
    if not log.filters:
        log.addFilter(lambda record: "opening handshake failed" not in record.getMessage())
    return log


def free_port(host: str, port: int | None) -> int:
    """Return a free port to listen on.

    Args:
      host: the address to listen on.
      port: the port to check; None: take the first free port from 8080 on.

    Raises:
      UserError: the address is invalid, or no port is free.
    """
    tried = [port] if port is not None else range(FIRST_PORT, FIRST_PORT + _PORTS_TRIED)
    reason = None
    for one in tried:
        try:
            for address in socket.getaddrinfo(host, one, type=socket.SOCK_STREAM):
                with socket.socket(*address[:3]) as probe:
                    # Ignore closed connections of an earlier server on this port.
                    probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                    probe.bind(address[4])
        except (socket.gaierror, UnicodeError) as error:
            reason = getattr(error, "strerror", error)
            raise UserError(f"--host {host!r} is not an address: {reason}") from None
        except OSError as error:
            if error.errno == errno.EADDRNOTAVAIL:
                raise UserError(f"--host {host!r} is not an address of this machine") from None
            in_use = error.errno == errno.EADDRINUSE
            reason = "is already in use" if in_use else f"cannot be opened ({error.strerror})"
        else:
            return one
    which = f"--port {port}" if port is not None else f"every port from {FIRST_PORT} on"
    raise UserError(f"{which} {reason} at --host {host}: choose another port")


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Suppress the messages that viser prints to rich's console when it starts and stops."""
    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before
