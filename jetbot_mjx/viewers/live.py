"""Show a policy that drives in real time, in the browser or in MuJoCo's own window."""

import contextlib
import getpass
import os
import socket
import sys
import webbrowser
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

from jetbot_mjx.errors import UserError, requires_extra
from jetbot_mjx.runs import Which, find_checkpoint
from jetbot_mjx.viewers import mujoco_window
from jetbot_mjx.viewers.player import Player


def play_live(
    run_or_checkpoint: str | Path,
    *,
    viewer: Literal["browser", "native"] = "browser",
    agent: str = "policy",
    which: Which = "best",
    seed: int = 0,
    robots: int = 1,
    host: str = "127.0.0.1",
    port: int | None = None,
    allow: Sequence[str] = (),
    opens_page: bool = True,
    tell: Callable[[str], None],
) -> tuple[int, int]:
    """Drive and show a policy in real time until the user interrupts or closes the window.

    Args:
      run_or_checkpoint: A run folder, or one of its checkpoint folders.
      viewer: Whether to show a page in the browser, or MuJoCo's own window.
      agent: The controller at the start, one of `AGENTS`.
      which: The checkpoint of a run folder.
      seed: The seed of the goals and of the random agent.
      robots: The number of robots; MuJoCo's own window shows only one.
      host: The address that the page is served at.
      port: The port that the page is served at, or None for the first free one from 8080 on.
      allow: Origins of other pages that may connect, such as `https://hub.example.org`.
      opens_page: Whether to open the page, where there is a display.
      tell: A function that receives messages for the user, line by line.

    Returns:
      How many goals were reached, and in how many episodes.

    Raises:
      UserError: there is no usable checkpoint, no viewer, no display, or the port is taken.
    """
    # Check first what can fail quickly, before the slow steps.
    if robots > 1 and viewer == "native":
        raise UserError(f"--robots {robots}: --viewer native shows one robot, use the browser")
    find_checkpoint(run_or_checkpoint, which)
    if viewer == "browser":
        with requires_extra("play", "the browser viewer"):
            from jetbot_mjx.viewers import viser_server
        free = viser_server.free_port(host, port)

        def run(player: Player) -> None:
            with viser_server.ViserViewer(player, host, free, allow=allow, tell=tell) as page:
                for line in addresses(host, free):
                    tell(line)
                if opens_page and has_display():
                    webbrowser.open(f"http://{local_name(host)}:{free}")
                page.run()
    else:
        mujoco_window.require_window()
        run = mujoco_window.run
    tell(f"loading {run_or_checkpoint} and compiling: this takes a few seconds")
    player = Player(run_or_checkpoint, which=which, agent=agent, seed=seed, robots=robots)
    # Ctrl-C is the normal way to end the viewer.
    with contextlib.suppress(KeyboardInterrupt):
        run(player)
    return player.successes, player.episodes


def has_display() -> bool:
    """Return whether a browser that this process opens would be seen by its user."""
    names = ("DISPLAY", "WAYLAND_DISPLAY")
    seen = sys.platform != "linux" or any(map(os.environ.get, names))
    return seen and "SSH_CONNECTION" not in os.environ


def local_name(host: str) -> str:
    """Return the name by which this machine reaches an address that it listens on."""
    here = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}
    return here.get(host, f"[{host}]" if ":" in host else host)


def addresses(host: str, port: int) -> list[str]:
    """Return the addresses of the page, on this machine and through ssh.

    Args:
      host: the address that is listened on.
      port: the port of it.

    Returns:
      Lines for the terminal.
    """
    everywhere = host in ("0.0.0.0", "::")
    here = local_name(host)
    name = socket.gethostname()
    # In a container the user may have no name.
    with contextlib.suppress(KeyError, OSError):
        name = f"{getpass.getuser()}@{name}"
    lines = [
        f"the page is at http://{here}:{port} (Ctrl-C ends it)",
        f"from elsewhere: ssh -N -L {port}:{here}:{port} {name}, and open"
        f" http://127.0.0.1:{port} there",
    ]
    if everywhere:
        lines.append(f"--host {host}: everyone who reaches this machine can watch and interfere")
    return lines
