"""Write files of results together with the conditions under which they were measured."""

import datetime
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax

from benchmarks import RESULTS
from benchmarks.harness.measurements import WARM_UP_INTERVALS, Sizes
from benchmarks.harness.timing import WARM_UP_CALLS, available_cores
from jetbot_mjx import cli
from jetbot_mjx.config import Config
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs.run_dir import versions, write_json


def conditions(config: Config, sizes: Sizes) -> dict[str, Any]:
    """Return as JSON under which conditions rates are measured: device, versions, configuration."""
    device = jax.devices()[0]
    return {
        "device": device.device_kind,
        "platform": device.platform,
        "device_count": jax.device_count(),
        "cpu_cores": available_cores(),
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "versions": versions(),
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
        "config": config.model_dump(mode="json"),
        "conditions": {
            **sizes._asdict(),
            "warm_up_calls": WARM_UP_CALLS,
            "warm_up_intervals": WARM_UP_INTERVALS,
            # For the networks; null is the back end's default. Physics sets its own precision.
            "matmul_precision": jax.config.values["jax_default_matmul_precision"],
            # With a cache, a compile time may be the time to read from it.
            "compilation_cache": jax.config.values["jax_compilation_cache_dir"] is not None,
        },
    }


def default_output(prefix: str = "") -> Path:
    """Return `results/<prefix><device>.json`, with the number of devices if there are several."""
    name = re.sub(r"[^a-z0-9]+", "-", jax.devices()[0].device_kind.lower()).strip("-")
    count = jax.device_count()
    return RESULTS / (prefix + (f"{name}-x{count}.json" if count > 1 else f"{name}.json"))


def output_for(given: Path | None, stored: Path, *, is_own: bool) -> Path | None:
    """Return the file of the results; None: there is none.

    Args:
      given: what `--output` says.
      stored: the repository's own file.
      is_own: whether something else is measured than what that file is of, so that it must stay.
    """
    return given or (None if is_own else stored)


def check_output(path: Path | None) -> None:
    """Check before minutes of measuring that the file, if there is one, can be written.

    Raises:
      UserError: It cannot be written.
    """
    if path is None:
        return
    if path.is_dir():
        raise UserError(f"--output {path} is a folder: name a file in it")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"--output {path} cannot be written: {error.strerror}") from None


def write(path: Path | None, values: dict[str, Any]) -> None:
    """Write a file of results, if there is one.

    Raises:
      UserError: The file cannot be written.
    """
    if path is None:
        return
    try:
        write_json(path, values)
    except OSError as error:
        raise UserError(f"--output {path} cannot be written: {error.strerror}") from None


def counts(text: str) -> Sequence[int]:
    """Parse an argument that lists several counts, as in `256,1024`."""
    return [cli.positive_int(part) for part in text.split(",")]
