"""Upload a run to the Hugging Face Hub: `jetbot-mjx share RUN --to hf:USER/NAME`.

The repository then holds one checkpoint of the run, its exported policy, its configuration and
metrics, its report, a web page, a clip, and a model card that is written from the report. One
commit makes all of it appear. Everybody who may read it names the run `hf:USER/NAME`.
"""

import argparse
import re
from collections.abc import Sequence

from jetbot_mjx import cli, errors, startup


def _license(text: str) -> str:
    if not re.fullmatch(r"[a-z0-9][a-z0-9.-]{0,49}", text):
        raise argparse.ArgumentTypeError(
            f"{text!r} is no licence: write it as in apache-2.0 or mit"
        )
    return text


def _repository(text: str) -> str:
    from jetbot_mjx.runs import parse_hub_name

    try:
        parse_hub_name(text)
    except errors.InvalidError:
        raise argparse.ArgumentTypeError(
            f"{text!r} is no repository: write it as in hf:ada/jetbot"
        ) from None
    return text


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and share.

    Args:
      arguments: The arguments without the program's name, or None for those of the process.

    Returns:
      0.
    """
    parser = cli.Parser(prog="jetbot-mjx share", description=__doc__)
    cli.add_checkpoint_arguments(parser)
    repository = "repository, which is created if there is none, or replaced if it holds a run"
    parser.add_argument(
        "--to", type=_repository, required=True, metavar="hf:USER/NAME", help=repository
    )
    licence = "licence of the policy, as the Hub names it (default: apache-2.0)"
    parser.add_argument(
        "--license", type=_license, default="apache-2.0", metavar="NAME", help=licence
    )
    cli.add_flag(parser, "--private", "let only you read a repository that is created")
    options = parser.parse_args(arguments)
    run = cli.find_policy(options.run)
    with startup.exit_on_interrupt():
        from jetbot_mjx.deployment import share_run, summarize_sharing
        from jetbot_mjx.runs import check_upload
    check_upload(options.to)
    cli.prepare_device()
    with cli.trusting(options.trust), cli.show_progress():
        shared = share_run(
            run, options.to, which=options.which, licence=options.license, private=options.private
        )
    cli.tell(summarize_sharing(shared))
    return 0


if __name__ == "__main__":
    cli.run_command(main, at_once=True)
