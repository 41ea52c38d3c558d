"""Train a policy into a run folder: `jetbot-mjx train jetbot`.

The same command with the same `--run-dir`, or `--resume RUN`, continues a run that was stopped.
SIGTERM and Ctrl-C stop a training: it saves everything and exits with code 75. With
`--distributed`, several processes on one host or many train one policy.
"""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from jetbot_mjx import cli, startup

if TYPE_CHECKING:
    from jetbot_mjx.config import Config


def _parser() -> cli.Parser:
    parser = cli.Parser(prog="jetbot-mjx train", description=__doc__)
    source = parser.add_mutually_exclusive_group()
    cli.add_config_arguments(parser, source)
    source.add_argument("--resume", metavar="RUN", help="continue the run in this folder")
    seed = "random seed, the same as --set seed=N"
    cli.add_count(parser, "--seed", seed, least=0, most=2**32 - 1)
    cli.add_count(parser, "--seeds", "train N policies at once, the same as --set seeds=N")
    text = "start from the policy of another run, of any task; it explores anew: worse at first"
    parser.add_argument("--init-from", metavar="RUN", help=text)
    parser.add_argument(
        "--run-dir", type=Path, help="run folder (default: runs/<config>-<date>-<time>)"
    )
    variables = "JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES and JAX_PROCESS_ID"
    started = f"under srun, mpirun, or with {variables}"
    text = f"this is one of several processes that train one policy, {started}"
    cli.add_flag(parser, "--distributed", text)
    cli.add_trust(parser)
    return parser


def _config_and_folder(options: argparse.Namespace) -> "tuple[Config, Path | None]":
    """Return the configuration, and the run folder if one is named."""
    with startup.exit_on_interrupt():
        from jetbot_mjx.runs import find_run, find_run_config
    run_dir = options.run_dir
    if options.resume:
        run_dir = find_run(options.resume, say=cli.note)
        options.config = find_run_config(run_dir)
    given = {"seed": options.seed, "seeds": options.seeds, "init_from": options.init_from}
    overrides = [f"{key}={json.dumps(x)}" for key, x in given.items() if x is not None]
    return cli.config_of(options, *overrides), run_dir


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and train.

    Args:
      arguments: The arguments without the program's name, or None for those of the process.

    Returns:
      0, or 75 if the training was asked to stop and can be resumed.
    """
    options = (parser := _parser()).parse_args(arguments)
    if options.resume and (options.run_dir or options.init_from):
        name = "--run-dir" if options.run_dir else "--init-from"
        parser.error(f"{name}: --resume continues that run, in its folder")
    if not (options.resume or options.config):
        parser.error("name a configuration, as in `train jetbot`, or a run to --resume")
    startup.wake_driver()
    with cli.trusting(options.trust):
        config, run_dir = _config_and_folder(options)
    # Import the large modules while the GPU initialises, and load the programs during the rest.
    with startup.exit_on_interrupt():
        from jetbot_mjx import runs, training
        from jetbot_mjx.training import is_primary
    if options.resume and run_dir is not None:
        runs.check_resumed(run_dir, options.config, config)
    startup.divide_cpu(config.cpu_devices)
    if options.distributed:
        training.check_processes(config)
        training.join_processes()
    startup.wake_device()
    with startup.exit_on_interrupt():
        from jetbot_mjx.envs import open_program_cache
        from jetbot_mjx.training import CompiledTrainer  # noqa: F401
    cli.prepare_device()
    programs = open_program_cache(config)
    programs.prefetch("advance", "init")
    if not programs.loads:
        startup.load_blas()
    with startup.exit_on_interrupt():
        from jetbot_mjx.training import Preemption, run
    stop = Preemption(config.preemption_notice)
    folder = runs.claim_run_dir(run_dir, options.config, creates=is_primary())
    with cli.trusting(options.trust), folder as run_dir:
        result = run(config, run_dir, programs, stop, verbose=True)
    if is_primary():
        text = training.closing_message(result)
        runs.log_message(run_dir, text)
        cli.tell(text)
    training.leave_processes()
    return 0 if result.finished else training.STOPPED


if __name__ == "__main__":
    cli.run_command(main, at_once=True, writes_files=True)
