"""Lets a policy drive live: `python -m jetbot_mjx.play RUN` serves it to the browser.

Without a run it is one that comes with the package.
"""

import argparse
import contextlib
import getpass
import socket
import types
import urllib.parse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

from jetbot_mjx import cli
from jetbot_mjx.compiler.program_cache import use_compilation_cache
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs.checkpoint import PRETRAINED, Which
from jetbot_mjx.viewers import mujoco_window
from jetbot_mjx.viewers.player import Player
from jetbot_mjx.viewers.step_fns import AGENTS

_LARGEST_PORT = 65_535
_SHOWN = "jetbot_egocentric"


class Played(NamedTuple):
    """A `Played` holds the number of successes and episodes while the viewer was open."""

    successes: int
    episodes: int


def run(
    run_or_checkpoint: str | Path,
    *,
    viewer: Literal["browser", "native"] = "browser",
    agent: str = "policy",
    which: Which = "best",
    seed: int = 0,
    host: str = "127.0.0.1",
    port: int | None = None,
    allow: Sequence[str] = (),
    tell: Callable[[str], None] = print,
) -> Played:
    """Drive in real time until the user interrupts or closes the window.

    Args:
      run_or_checkpoint: a run folder, or one checkpoint folder of it.
      viewer: a page in the browser, or MuJoCo's own window.
      agent: the controller at the start, one of `AGENTS`.
      which: the checkpoint of a run folder.
      seed: of goals and of the random agent.
      host: the address that the page is served at.
      port: the port of it; None: the first from 8080 on that is free.
      allow: origins of other pages that may connect, such as `https://hub.example.org`.
      tell: a function that receives messages for the user, line by line.

    Returns:
      How many goals were reached.

    Raises:
      UserError: there is no usable checkpoint, no viewer, no display, or the port is taken.
    """
    # Check first what can fail quickly, before the slow steps.
    if viewer == "browser":
        server = _server()
        free: int = server.free_port(host, port)
    else:
        mujoco_window.require_window()
    tell(f"loading {run_or_checkpoint} and compiling: some seconds")
    player = Player(run_or_checkpoint, which=which, agent=agent, seed=seed)
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
        f"it drives at http://{here}:{port} (Ctrl-C ends it)",
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
        raise UserError(
            f"the browser viewer is an extra ({error.name} is missing): pip install"
            " 'jetbot_mjx[play]'"
        ) from None
    return viser_server


def _origin(text: str) -> str:
    """Parse an argument that is a page's origin, as browsers write it."""
    try:
        parts = urllib.parse.urlsplit(text.lower())
        port, name = parts.port, parts.hostname
    except ValueError:
        port = name = None
    else:
        if parts.path not in ("", "/") or parts.query or parts.fragment or parts.username:
            name = None
    if not name or parts.scheme not in ("http", "https"):
        raise argparse.ArgumentTypeError(
            f"{text!r} is no origin: write it as https://hub.example.org or http://localhost:3000"
        )
    default = {"http": 80, "https": 443}[parts.scheme]
    host = f"[{name}]" if ":" in name else name
    return f"{parts.scheme}://{host}" + ("" if port in (None, default) else f":{port}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and drive.

    Args:
      arguments: arguments without the program's name; None: those of the process.

    Returns:
      The exit code.
    """
    parser = cli.Parser(prog="python -m jetbot_mjx.play", description=__doc__)
    cli.add_checkpoint_arguments(parser, default=f"of {_SHOWN}.yaml, comes with the package")
    parser.add_argument("--viewer", choices=("browser", "native"), default="browser")
    parser.add_argument("--agent", choices=AGENTS, default="policy", help="who drives at first")
    parser.add_argument("--seed", type=cli.whole_number(0), default=0, help="of the goals")
    parser.add_argument(
        "--host", default="127.0.0.1", help="address to listen on (default: this machine alone)"
    )
    parser.add_argument(
        "--port",
        type=cli.whole_number(1, _LARGEST_PORT),
        help="port to listen on (default: 8080, or the next free one)",
    )
    parser.add_argument(
        "--allow-origin",
        type=_origin,
        action="append",
        default=[],
        metavar="URL",
        help="let in a page from elsewhere, as https://hub.example.org; may be given again",
    )
    options = parser.parse_args(arguments)
    cli.require_device()
    use_compilation_cache()
    if options.run is None:
        print(f"no run is named: this policy comes with the package, trained by {_SHOWN}.yaml")
    played = run(
        PRETRAINED / _SHOWN if options.run is None else options.run,
        viewer=options.viewer,
        agent=options.agent,
        which=options.checkpoint,
        seed=options.seed,
        host=options.host,
        port=options.port,
        allow=options.allow_origin,
        tell=lambda line: print(line, flush=True),
    )
    print(f"{played.successes} of {played.episodes} goals reached")
    return 0


if __name__ == "__main__":
    cli.run_command(main)
