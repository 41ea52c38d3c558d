"""A player in the browser, by viser: one port on this machine serves the page and its data.

viser, because the page draws (nothing is rendered here, so no OpenGL is needed, and little crosses
an ssh tunnel) and hands clicks, drags and keys back to Python. rerun is made to record and to look
back, not to interfere; MuJoCo in WebAssembly would run in the page, where the policy is not.

viser calls back from threads of its own. What a callback asks for waits in a queue, and the loop
that drives the player does it between two steps.
"""

import contextlib
import errno
import queue
import socket
import time
from collections.abc import Callable, Iterator
from types import TracebackType
from typing import Any, Self

import rich
import viser

from jetbot_mjx.clock import Clock
from jetbot_mjx.errors import UserError
from jetbot_mjx.panel import Panel
from jetbot_mjx.player import Player
from jetbot_mjx.scene import FPS, Scene

FIRST_PORT = 8080
_PORTS_TRIED = 100
_FIGURES_PER_SECOND = 5


class _Server(viser.ViserServer):
    """viser's server without the tunnel through its makers' machine."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Opens nothing, whatever a page asks for."""
        del verbose


class Browser:
    """Serves one player to any number of pages; a context manager that stops the server."""

    def __init__(self, player: Player, *, host: str, port: int) -> None:
        """Opens the port and builds scene and panel.

        Args:
          player: what drives.
          host: the address to listen on; whoever reaches it can watch and interfere.
          port: to listen on, as `free_port` gave it.

        Raises:
          UserError: the port was taken meanwhile.
        """
        with _quiet():
            self.server = _Server(host, port, label=player.run_dir.name, verbose=False)
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
        """Drives and shows, until it is interrupted."""
        while True:
            self.work()
            time.sleep(min(self._player.wait(), self._pictures.wait(time.monotonic())))

    def work(self) -> None:
        """Does what was asked for, takes the steps that are due, and shows where that led."""
        while not self._asked.empty():
            self._asked.get()()
        self._player.advance()
        if self._pictures.due(time.monotonic()):
            self.scene.show()
        if self._figures.due(time.monotonic()):
            self.panel.tell()

    def close(self) -> None:
        """Stops the server."""
        with _quiet():
            self.server.stop()

    def __enter__(self) -> Self:
        """Enters."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Stops the server."""
        self.close()

    def _ask(self, do: Callable[..., Any], *given: Any) -> None:
        self._asked.put(lambda: do(*given))


def free_port(host: str, port: int | None) -> int:
    """Looks for a port to listen on.

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
    """Keeps what viser tells on starting and stopping out of the terminal."""
    console = rich.get_console()
    before, console.quiet = console.quiet, True
    try:
        yield
    finally:
        console.quiet = before
