"""A player in the browser, by viser: one port on this machine serves the page and its data.

viser, because the page draws (nothing is rendered here, so no OpenGL is needed, and little crosses
an ssh tunnel) and hands clicks, drags and keys back to Python. rerun is made to record and to look
back, not to interfere; MuJoCo in WebAssembly would run in the page, where the policy is not.

viser calls back from threads of its own. What a callback asks for waits in a queue, and the loop
that drives the player does it between two steps.

Any page that a browser shows may open a connection to this machine, and viser takes them all. The
header `Origin` says where a page is from, and only this player's own page is let in.
"""

import contextlib
import errno
import http
import ipaddress
import queue
import socket
import time
import urllib.parse
from collections.abc import Callable, Iterator, Sequence
from types import TracebackType
from typing import Any, Self

import rich
import viser
import websockets.asyncio.server

from jetbot_mjx.errors import UserError
from jetbot_mjx.viewers.player import Player
from jetbot_mjx.viewers.realtime import Clock
from jetbot_mjx.viewers.viser_panel import Panel
from jetbot_mjx.viewers.viser_scene import FPS, Scene

FIRST_PORT = 8080
_PORTS_TRIED = 100
_FIGURES_PER_SECOND = 5
_ORIGINS_TOLD = 10


class _Server(viser.ViserServer):
    """viser's server without the tunnel through its makers' machine."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Open nothing, whatever a page asks for."""
        del verbose


class Browser:
    """Serves one player to any number of pages; a context manager that stops the server."""

    def __init__(
        self,
        player: Player,
        *,
        host: str,
        port: int,
        allow: Sequence[str] = (),
        tell: Callable[[str], None],
    ) -> None:
        """Open the port and builds scene and panel.

        Args:
          player: what drives.
          host: the address to listen on; whoever reaches it can watch and interfere.
          port: to listen on, as `free_port` gave it.
          allow: origins of other pages that may connect, such as `https://hub.example.org`.
          tell: is given a line for each origin that was refused, the first few.

        Raises:
          UserError: the port was taken meanwhile, or pages cannot be refused.
        """
        door = _Door(host, allow, tell)
        with _quiet(), door.at_viser():
            self.server = _Server(host, port, label=player.run_dir.name, verbose=False)
        if not door.stands:
            self.close()
            raise UserError(
                f"viser {viser.__version__} lets in pages from anywhere: pip install viser==1.1.1"
            )
        # Where a port is taken, viser goes on to the next.
        if self.server.get_port() != port:
            self.close()
            raise UserError(f"--port {port} was taken meanwhile: try again")
        self._player = player
        self._asked: queue.SimpleQueue[Callable[[], Any]] = queue.SimpleQueue()
        self.scene = Scene(self.server, player, self._ask)
        self.panel = Panel(self.server, player, self.scene, self._ask)
        self._pictures = Clock(1 / FPS, time.monotonic())
        self._figures = Clock(1 / _FIGURES_PER_SECOND, time.monotonic())

    def run(self) -> None:
        """Drive and shows, until it is interrupted."""
        while True:
            self.work()
            time.sleep(min(self._player.wait(), self._pictures.wait(time.monotonic())))

    def work(self) -> None:
        """Do what was asked for, take the steps that are due, and show the result."""
        while not self._asked.empty():
            self._asked.get()()
        self._player.advance()
        if self._pictures.due(time.monotonic()):
            self.scene.show()
        if self._figures.due(time.monotonic()):
            self.panel.tell()

    def close(self) -> None:
        """Stop the server."""
        with _quiet():
            self.server.stop()

    def __enter__(self) -> Self:
        """Enter."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Stop the server."""
        self.close()

    def _ask(self, do: Callable[..., Any], *given: Any) -> None:
        self._asked.put(lambda: do(*given))


class _Door:
    """Lets in this player's page and those that the user allows, and no other."""

    def __init__(self, host: str, allow: Sequence[str], tell: Callable[[str], None]) -> None:
        """Create the object without a place yet.

        Args:
          host: the address that is listened on.
          allow: further origins.
          tell: is given a line for each origin that was refused, the first few.
        """
        name = socket.gethostname().lower()
        self._names = {host.lower(), "localhost", name, f"{name}.local"}
        self._allow, self._tell = set(allow), tell
        self._refused: set[str] = set()
        self.stands = False
        """Whether viser's server has it."""

    @contextlib.contextmanager
    def at_viser(self) -> Iterator[None]:
        """Give the door to the server that viser starts inside, for which viser has no option."""
        module = websockets.asyncio.server
        serve = module.serve

        def serve_behind(*arguments: Any, process_request: Any, **options: Any) -> Any:
            def look(connection: Any, request: Any) -> Any:
                refusal = self._refuse(connection, request)
                return process_request(connection, request) if refusal is None else refusal

            self.stands = True
            return serve(*arguments, process_request=look, **options)

        module.serve = serve_behind
        try:
            yield
        finally:
            module.serve = serve

    def _refuse(self, connection: Any, request: Any) -> Any:
        """Return the answer to a request that is refused, or None."""
        headers = request.headers
        # The page itself is no secret, and a program that is no browser could send any header.
        if not headers.get_all("Upgrade"):
            return None
        host = "".join(headers.get_all("Host"))
        for origin in headers.get_all("Origin"):
            if not self.lets_in(origin, host):
                if origin not in self._refused and len(self._refused) < _ORIGINS_TOLD:
                    self._refused.add(origin)
                    self._tell(
                        f"refused: a page from {origin[:200]!r} asked to connect; to let it in,"
                        " --allow-origin names it"
                    )
                return connection.respond(http.HTTPStatus.FORBIDDEN, "another page's origin\n")
        return None

    def lets_in(self, origin: str, host: str) -> bool:
        """Return whether a page may connect.

        Args:
          origin: where the page is from, as its browser says.
          host: what the browser took this server for. It has to be the same, and no name that
            someone else may point at this machine after he served a page of his own under it.

        Returns:
          Whether it may.
        """
        if origin in self._allow:
            return True
        try:
            parts = urllib.parse.urlsplit(origin.lower())
            name = parts.hostname or ""
        except ValueError:
            return False
        if parts.scheme not in ("http", "https") or parts.netloc != host.lower():
            return False
        return name in self._names or _is_address(name)


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def free_port(host: str, port: int | None) -> int:
    """Look for a port to listen on.

    Args:
      host: the address to listen on.
      port: the only one that will do; None: the first from 8080 on that is free.

    Returns:
      The port.

    Raises:
      UserError: the address or the port cannot be had.
    """
    tried = [port] if port is not None else range(FIRST_PORT, FIRST_PORT + _PORTS_TRIED)
    reason = None
    for one in tried:
        try:
            for address in socket.getaddrinfo(host, one, type=socket.SOCK_STREAM):
                with socket.socket(*address[:3]) as probe:
                    # What was served here a minute ago does not count.
                    probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                    probe.bind(address[4])
        except socket.gaierror as error:
            raise UserError(f"--host {host!r} is no address: {error.strerror}") from None
        except UnicodeError as error:
            raise UserError(f"--host {host!r} is no address: {error}") from None
        except OSError as error:
            if error.errno == errno.EADDRNOTAVAIL:
                raise UserError(f"--host {host!r} is no address of this machine") from None
            reason = error.strerror
        else:
            return one
    which = f"--port {port}" if port is not None else f"every port from {FIRST_PORT} on"
    raise UserError(f"{which} cannot be had at --host {host} ({reason}): name another port")


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep what viser tells on starting and stopping out of the terminal."""
    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before
