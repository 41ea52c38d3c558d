"""Export one policy: write its files, and check each of them against JAX."""

import importlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jetbot_mjx import runs
from jetbot_mjx.deployment.exporters import FORMATS
from jetbot_mjx.deployment.numpy_policy import (
    TOLERANCE,
    Recording,
    as_jax,
    difference,
    portable_policy,
    record,
    record_environment,
)
from jetbot_mjx.deployment.policy_spec import FILE, environment_spec, policy_spec
from jetbot_mjx.envs import AdaptedEnv
from jetbot_mjx.errors import UserError, requires_extra
from jetbot_mjx.terminal import stage

FOLDER = "policy"
"""Name of the folder of an export in the run folder."""

RECORDING = "recording.npz"


class ExportedPolicy(NamedTuple):
    """An `ExportedPolicy` holds the result of exporting one policy."""

    folder: Path
    env_steps: int
    differences: Mapping[str, float]
    """The largest difference to JAX, by format."""
    observations: int
    """Number of observations on which the formats were compared."""


def export_policy(
    run_or_checkpoint: str | Path,
    *,
    formats: Sequence[str] = ("numpy",),
    which: runs.Which = "best",
    output: str | Path | None = None,
) -> ExportedPolicy:
    """Export one policy.

    Args:
      run_or_checkpoint: A run folder, or one of its checkpoint folders.
      formats: Names of formats from `FORMATS`.
      which: The checkpoint of a run folder.
      output: The folder to write, which replaces an earlier export there, or None for `policy/` in
        the run folder.

    Returns:
      The result. The files are complete, or absent if an error is raised.

    Raises:
      UserError: there is no usable checkpoint, a package is missing, the folder holds something
        else or cannot be written, or the output of a file differs from JAX by too much.
    """
    for name in formats:
        with requires_extra("export", f"--format {name}"):
            for package in FORMATS[name].needs:
                importlib.import_module(package)
    # Load the policy.
    checkpoint = runs.load_checkpoint(run_or_checkpoint, which)
    folder = checkpoint.results_dir / FOLDER if output is None else Path(output)
    setup = checkpoint.make_setup()
    env = setup.env
    policy, reference = portable_policy(checkpoint, env), as_jax(checkpoint, env)
    with runs.writing_to(folder):
        if folder.exists() and not (folder / FILE).is_file():
            raise UserError(
                f"{folder} exists and is not an export: choose a new folder with --output"
            )
    with runs.atomic_folder(folder) as unfinished:
        own = isinstance(env, AdaptedEnv)
        recording = record_environment(checkpoint, setup) if own else record(checkpoint, env)
        # Write each format and check its output against JAX.
        differences = {}
        for name in formats:
            path = unfinished / FORMATS[name].file
            with stage(f"writing and checking {path.name}"):
                FORMATS[name].write(policy, reference, path)
                outputs = FORMATS[name].read(path)(*recording.inputs.values())
                found = difference(recording, outputs, policy.controller)
            if not found < TOLERANCE:
                raise UserError(
                    f"nothing was written to {folder}: {path.name} differs from JAX by {found:.1e}"
                    f" on {len(recording.action):,} observations, and {TOLERANCE:.0e} is allowed"
                )
            differences[name] = found
        # Write the observations and the description of all files.
        describe = environment_spec if own else policy_spec
        _write_spec(unfinished, describe(checkpoint, env, policy), differences, recording)
    return ExportedPolicy(folder, checkpoint.env_steps, differences, len(recording.action))


def _write_spec(
    folder: Path, spec: runs.JsonObject, differences: Mapping[str, float], recording: Recording
) -> None:
    outputs = dict(zip(("action", "wheel_speeds"), recording.outputs, strict=False))
    arrays = {**recording.inputs, **outputs}
    np.savez_compressed(folder / RECORDING, **arrays)
    spec["files"] = {
        name: {"file": FORMATS[name].file, "largest_difference": found}
        for name, found in differences.items()
    }
    spec["recording"] = {"file": RECORDING, "observations": len(recording.action)}
    runs.write_json(folder / FILE, spec)


def summarize_export(exported: ExportedPolicy) -> str:
    """Return the result of an export as lines for the terminal."""
    lines = [
        f"policy after {exported.env_steps:,} steps, the largest difference to JAX on"
        f" {exported.observations:,} observations:"
    ]
    lines += [
        f"  {exported.folder / FORMATS[name].file}  {found:.1e}"
        for name, found in exported.differences.items()
    ]
    lines.append(f"description of inputs and outputs: {exported.folder / FILE}")
    return "\n".join(lines)
