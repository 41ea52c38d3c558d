"""Makes files of a policy that run without this package: `python -m jetbot_mjx.export RUN`.

`--format numpy` is one file of Python for a robot that has NumPy alone, `onnx` and `stablehlo` are
for runtimes, `all` is each of them. Beside them lie `policy.json`, which tells what every number
is, and the observations on which each file was held to JAX. What differs by more is not written.
"""

import argparse
import contextlib
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jetbot_mjx import cli
from jetbot_mjx.compiler.program_cache import use_compilation_cache
from jetbot_mjx.deployment.exporters import FORMATS, Source, require
from jetbot_mjx.deployment.numpy_policy import (
    TOLERANCE,
    as_jax,
    difference,
    portable_policy,
    record,
)
from jetbot_mjx.deployment.policy_spec import FILE, policy_spec
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs.checkpoint import Which, load_checkpoint
from jetbot_mjx.runs.run_dir import write_json, writing_to

FOLDER = "policy"
"""Name of the folder of an export in the run folder."""

RECORDING = "recording.npz"


class Exported(NamedTuple):
    """An `Exported` holds the result of exporting one policy."""

    folder: Path
    env_steps: int
    differences: Mapping[str, float]
    """The largest difference to JAX, by format."""
    observations: int
    """Number of observations on which the formats were compared."""


def run(
    run_or_checkpoint: str | Path,
    *,
    formats: Sequence[str] = ("numpy",),
    which: Which = "best",
    output: str | Path | None = None,
) -> Exported:
    """Export one policy.

    Args:
      run_or_checkpoint: a run folder, or one checkpoint folder of it.
      formats: names of formats from `FORMATS`.
      which: the checkpoint of a run folder.
      output: the folder to write, in place of an earlier export there; None: `policy/` of the
        run folder.

    Returns:
      The result; the files are complete, or absent if an error is raised.

    Raises:
      UserError: there is no usable checkpoint, a package is missing, the folder holds something
        else or cannot be written, or the output of a file differs from JAX by too much.
    """
    for name in formats:
        require(name)
    # Load the policy.
    checkpoint = load_checkpoint(run_or_checkpoint, which)
    folder = checkpoint.run_dir / FOLDER if output is None else Path(output)
    env = checkpoint.make_env()
    policy, act = portable_policy(checkpoint), as_jax(checkpoint, env)
    with _written_whole(folder) as unfinished:
        recording = record(checkpoint, env)
        differences = {}
        # Write each format and check its output against JAX.
        for name in formats:
            path = unfinished / FORMATS[name].file
            FORMATS[name].write(Source(policy, act), path)
            found = difference(
                recording, FORMATS[name].read(path)(recording.obs), policy.controller
            )
            if not found < TOLERANCE:
                raise UserError(
                    f"nothing was written to {folder}: {path.name} differs from JAX by {found:.1e}"
                    f" on {len(recording.obs):,} observations, and {TOLERANCE:.0e} is allowed"
                )
            differences[name] = found
        # Write the observations and the description of all files.
        np.savez_compressed(unfinished / RECORDING, **recording._asdict())
        files = {
            name: {"file": FORMATS[name].file, "largest_difference": found}
            for name, found in differences.items()
        }
        about = policy_spec(checkpoint, env, policy)
        about["files"] = files
        about["recording"] = {"file": RECORDING, "observations": len(recording.obs)}
        write_json(unfinished / FILE, about)
    return Exported(folder, checkpoint.env_steps, differences, len(recording.obs))


@contextlib.contextmanager
def _written_whole(folder: Path) -> Iterator[Path]:
    """Yield a temporary folder, and rename it to `folder` when it is complete."""
    unfinished = folder.with_name(f".{folder.name}.unfinished")
    earlier = folder.with_name(f".{folder.name}.earlier")
    with writing_to(folder):
        if folder.exists() and not (folder / FILE).is_file():
            raise UserError(f"{folder} is there and no export: give --out a folder that is not")
        for left in (unfinished, earlier):
            shutil.rmtree(left, ignore_errors=True)
        unfinished.mkdir(parents=True)
        try:
            yield unfinished
            if folder.exists():
                folder.rename(earlier)
            unfinished.rename(folder)
        finally:
            for left in (unfinished, earlier):
                shutil.rmtree(left, ignore_errors=True)


def _formats(text: str) -> tuple[str, ...]:
    if text == "all":
        return tuple(FORMATS)
    if text in FORMATS:
        return (text,)
    raise argparse.ArgumentTypeError(f"{text!r} is none of {', '.join([*FORMATS, 'all'])}")


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and export.

    Args:
      arguments: arguments without the program's name; None: those of the process.

    Returns:
      0.
    """
    parser = cli.Parser(prog="python -m jetbot_mjx.export", description=__doc__)
    cli.add_checkpoint_arguments(parser)
    parser.add_argument(
        "--format",
        type=_formats,
        default=("numpy",),
        metavar="|".join([*FORMATS, "all"]),
        help="what to write (default: numpy)",
    )
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help=f"the folder (default: RUN/{FOLDER})"
    )
    options = parser.parse_args(arguments)
    cli.require_device()
    use_compilation_cache()
    exported = run(
        options.run, formats=options.format, which=options.checkpoint, output=options.out
    )
    print(
        f"policy after {exported.env_steps:,} steps, the largest difference to JAX on"
        f" {exported.observations:,} observations:"
    )
    for name, found in exported.differences.items():
        print(f"  {exported.folder / FORMATS[name].file}  {found:.1e}")
    print(f"what its numbers mean: {exported.folder / FILE}")
    return 0


if __name__ == "__main__":
    cli.run_command(main)
