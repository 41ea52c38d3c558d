"""Show a policy that drives in real time, in the browser or in MuJoCo's own window."""

import contextlib
import getpass
import socket
import types
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

from jetbot_mjx.errors import MissingPackageError, UserError
from jetbot_mjx.runs.checkpoint import Which, find_checkpoint
from jetbot_mjx.viewers import mujoco_window
from jetbot_mjx.viewers.player import Player


class Played(NamedTuple):
    """A `Played` holds the number of successes and episodes while the viewer was open."""

    successes: int
    episodes: int


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
    tell: Callable[[str], None],
) -> Played:
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
      tell: A function that receives messages for the user, line by line.

    Returns:
      How many goals were reached.

    Raises:
      UserError: there is no usable checkpoint, no viewer, no display, or the port is taken.
    """
    # Check first what can fail quickly, before the slow steps.
    if robots > 1 and viewer == "native":
        raise UserError(f"--robots {robots}: --viewer native shows one robot, use the browser")
    find_checkpoint(run_or_checkpoint, which)
    if viewer == "browser":
        server = _server()
        free: int = server.free_port(host, port)
    else:
        mujoco_window.require_window()
    tell(f"loading {run_or_checkpoint} and compiling: some seconds")
    player = Player(run_or_checkpoint, which=which, agent=agent, seed=seed, robots=robots)
    try:
        if viewer == "browser":
            with server.ViserViewer(player, host=host, port=free, allow=allow, tell=tell) as page:
                for line in addresses(host, free):
                    tell(line)
                page.run()
        else:
            mujoco_window.run(player)
    except KeyboardInterrupt:
        # Ctrl-C is the normal way to end the viewer.
        pass
    return Played(player.successes, player.episodes)


def addresses(host: str, port: int) -> list[str]:
    """Return the addresses of the page, on this machine and through ssh.

    Args:
      host: the address that is listened on.
      port: the port of it.

    Returns:
      Lines for the terminal.
    """
    everywhere = host in ("0.0.0.0", "::")
    here = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(host, f"[{host}]" if ":" in host else host)
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


def _server() -> types.ModuleType:
    try:
        from jetbot_mjx.viewers import viser_server
    except ModuleNotFoundError as error:
        raise MissingPackageError(
            f"the browser viewer is an extra ({error.name} is missing): pip install"
            " 'jetbot_mjx[play]'"
        ) from None
    return viser_server
