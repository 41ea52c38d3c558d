"""Train a policy into a run folder: `python -m jetbot_mjx.train --config configs/jetbot.yaml`.

The same command with the same `--run-dir`, or `--resume RUN`, continues a run that was stopped.
SIGTERM and Ctrl-C save and stop a training with exit code 75. With `--distributed` several
processes, on one host or many, train one policy.
"""

from collections.abc import Sequence
from pathlib import Path

from jetbot_mjx import cli
from jetbot_mjx.compiler.program_cache import use_compilation_cache
from jetbot_mjx.config import load_config
from jetbot_mjx.envs.program_key import open_program_cache
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs.run_dir import CONFIG, default_run_dir, stored_config
from jetbot_mjx.training import distributed
from jetbot_mjx.training.preemption import STOPPED


def main(arguments: Sequence[str] | None = None) -> int:
    """Parse the command line and train.

    Args:
      arguments: arguments without the program's name; None: those of the process.

    Returns:
      0, or 75 if the training was asked to stop and can be resumed.
    """
    parser = cli.Parser(prog="python -m jetbot_mjx.train", description=__doc__)
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--config", type=Path, help="YAML file, see configs/")
    source.add_argument(
        "--resume", type=Path, metavar="RUN", help="continue the run in this folder"
    )
    parser.add_argument(
        "--set",
        dest="overrides",
        action="append",
        default=[],
        metavar="SECTION.KEY=VALUE",
        help="override one setting; may be given again",
    )
    parser.add_argument("--seed", type=int, help="the same as --set seed=N")
    parser.add_argument("--seeds", type=int, help="the same as --set seeds=N: N policies at once")
    parser.add_argument("--run-dir", type=Path, help="default: runs/<config>-<date>-<time>")
    parser.add_argument(
        "--distributed",
        action="store_true",
        help="one of several processes that train one policy, under srun, mpirun, or with"
        " JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES and JAX_PROCESS_ID",
    )
    options = parser.parse_args(arguments)
    if options.resume and options.run_dir:
        parser.error("--run-dir: --resume names the folder already")
    overrides = list(options.overrides)
    overrides += [f"seed={options.seed}"] if options.seed is not None else []
    overrides += [f"seeds={options.seeds}"] if options.seeds is not None else []
    if options.resume:
        if stored_config(options.resume) is None:
            raise UserError(f"--resume {options.resume}: there is no run in this folder")
        config, run_dir = load_config(options.resume / CONFIG, overrides), options.resume
    else:
        config = load_config(options.config, overrides)
        run_dir = options.run_dir or default_run_dir(options.config)
    if options.distributed:
        distributed.check(config)
        distributed.join()
    cli.wake_device()
    # Import the large modules while the GPU initialises, and load the programs during the rest.
    from jetbot_mjx.training import ppo_trainer  # noqa: F401

    cli.require_device()
    use_compilation_cache()
    programs = open_program_cache(config)
    programs.prefetch("advance", "init")
    from jetbot_mjx.training import session

    result = session.train(config, run_dir, programs)
    if distributed.is_primary():
        print(
            session.summary(result)
            if result.finished
            else f"stopped; to resume: python -m jetbot_mjx.train --resume {run_dir}",
            flush=True,
        )
    distributed.leave()
    return 0 if result.finished else STOPPED


if __name__ == "__main__":
    cli.run_command(main, at_once=True)
