"""Watch a policy live and interact with it: `jetbot-mjx play RUN` serves a page.

Without RUN, a policy that comes with the package drives.
"""

from collections.abc import Sequence

from jetbot_mjx import cli, startup

_LARGEST_PORT = 65_535
_DEFAULT_POLICY = "jetbot_egocentric"
_AGENTS = ("policy", "scripted", "random", "constant", "keyboard")


def _parser() -> cli.Parser:
    parser = cli.Parser(prog="jetbot-mjx play", description=__doc__)
    default = f"pretrained:{_DEFAULT_POLICY}"
    cli.add_checkpoint_arguments(parser, default=default)
    viewers = "a page in the browser, or MuJoCo's own window"
    cli.add_choice(parser, "--viewer", ("browser", "native"), viewers)
    cli.add_choice(parser, "--agent", _AGENTS, "initial driver; the page can switch it")
    cli.add_count(parser, "--seed", "random seed of the goals", least=0, default=0)
    web = "open a page that needs no server, in which another policy can be trained"
    parser.add_argument("--web", action="store_true", help=web)
    text = "do not open the page"
    parser.add_argument("--no-browser", dest="opens_page", action="store_false", help=text)
    # At most as many as two CPU cores still drive in real time.
    cli.add_count(parser, "--robots", "number of robots that drive at once", most=256, default=1)
    parser.add_argument(
        "--host", default="127.0.0.1", help="address to listen on (default: this machine alone)"
    )
    port = "port to listen on (default: 8080, or the next free one)"
    cli.add_count(parser, "--port", port, most=_LARGEST_PORT)
    parser.add_argument(
        "--allow-origin",
        dest="allow",
        type=cli.origin,
        action="append",
        default=[],
        metavar="URL",
        help="allow pages of this origin to connect too, such as https://hub.example.org; may be"
        " repeated",
    )
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and drive.

    Args:
      arguments: The arguments without the program's name, or None for those of the process.

    Returns:
      0.
    """
    # The other options are named as the arguments of `play_live`.
    options = vars(_parser().parse_args(arguments))
    given = options.pop("run")
    run = cli.find_policy(given or f"pretrained:{_DEFAULT_POLICY}")
    trust = options.pop("trust")
    if options.pop("web"):
        page = cli.write_page(run, None, options["which"], trust=trust)
        if options["opens_page"]:
            cli.open_page(page)
        return 0
    with startup.exit_on_interrupt():
        from jetbot_mjx.viewers import play_live
    cli.prepare_device()
    if given is None:
        cli.tell(f"no RUN given: playing pretrained:{_DEFAULT_POLICY}")
    with cli.trusting(trust):
        successes, episodes = play_live(run, **options, tell=cli.tell)
    cli.tell(f"{successes} of {episodes} goals reached")
    return 0


if __name__ == "__main__":
    cli.run_command(main, at_once=True)
