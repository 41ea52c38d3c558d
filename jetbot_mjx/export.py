"""Export a policy to files that run without this package: `jetbot-mjx export RUN`.

`--format numpy` writes one file of Python for a robot that has only NumPy, `onnx` and `stablehlo`
write files for runtimes, and `all` writes all of them. The folder also holds `policy.json`, which
describes every input and output, and the observations on which each file was checked against JAX.
If a file differs from JAX by more than the tolerance, nothing is written.

`--format web` writes one page instead, `--output` is its file: the policy drives up to 1,024 robots
in any browser, and another one can be trained there. Nothing needs to be installed to open it.
"""

import argparse
from collections.abc import Sequence

from jetbot_mjx import cli, startup

_FORMATS = ("numpy", "onnx", "stablehlo")
_WEB = "web"
_FOLDER, _PAGE = "policy", "page.html"


def _formats(text: str) -> list[str]:
    names = text.split(",")
    for name in names:
        if name not in (*_FORMATS, "all", _WEB):
            known = ", ".join([*_FORMATS, "all", _WEB])
            raise argparse.ArgumentTypeError(f"{name!r} is not one of {known}")
    return [*_FORMATS, *({_WEB} & {*names})] if "all" in names else names


def _parser() -> cli.Parser:
    parser = cli.Parser(prog="jetbot-mjx export", description=__doc__)
    cli.add_checkpoint_arguments(parser)
    parser.add_argument(
        "--format",
        type=_formats,
        action="extend",
        metavar="|".join([*_FORMATS, "all", _WEB]),
        help="file format to write, or several with commas between them (default: numpy)",
    )
    places = f"folder to write (default: RUN/{_FOLDER}); of a page its file (RUN/{_PAGE})"
    cli.add_output(parser, places)
    return parser


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and export.

    Args:
      arguments: The arguments without the program's name, or None for those of the process.

    Returns:
      0.
    """
    parser = _parser()
    options = parser.parse_args(arguments)
    formats = tuple(dict.fromkeys(options.format or ("numpy",)))
    if _WEB in formats and len(formats) > 1:
        parser.error("--format web writes a page, not a folder: give it alone")
    run = cli.find_policy(options.run)
    if _WEB in formats:
        cli.write_page(run, options.output, options.which, trust=options.trust)
        return 0
    with startup.exit_on_interrupt():
        from jetbot_mjx.deployment import export_policy, summarize_export
    cli.prepare_device()
    with cli.trusting(options.trust), cli.show_progress():
        exported = export_policy(
            run,
            formats=formats,
            which=options.which,
            output=options.output,
        )
    cli.tell(summarize_export(exported))
    return 0


if __name__ == "__main__":
    cli.run_command(main, at_once=True, writes_files=True)
