"""Trains a policy into a run folder: `python -m jetbot_mjx.train --config configs/jetbot.yaml`.

The same command with the same `--run-dir`, or `--resume RUN`, goes on where a run was stopped.
SIGTERM and Ctrl-C stop it: all is saved, and the exit code is 75. With `--distributed` several
processes, on one host or many, train one policy.
"""

import contextlib
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import jax

from jetbot_mjx import cli, processes, resumable_ppo
from jetbot_mjx.config import Config, load_config
from jetbot_mjx.env import JetBotEnv, make_env
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation import Summary
from jetbot_mjx.memory import advice, device_memory, ran_out
from jetbot_mjx.metrics import CompileClock
from jetbot_mjx.preemption import STOPPED, Preemption, leave_now
from jetbot_mjx.recording import RunRecorder, Standing
from jetbot_mjx.resume import Resumption, resume
from jetbot_mjx.run_folder import (
    CONFIG,
    changed_versions,
    default_run_dir,
    occupied,
    seed_dirs,
    stored_config,
    write_run,
)
from jetbot_mjx.tracking import check_tracking
from jetbot_mjx.trainer import Recorder

_COMPLETE, _BEGINS, _RESUMES = range(3)
"""How a training finds its folder."""


class Result(NamedTuple):
    """What a training leaves; of several processes the first tells, the others what all know."""

    run_dir: Path
    run_dirs: list[Path]
    """The folder of each seed; of a single one, the run folder."""
    standings: list[Standing]
    """How far each seed has come; empty in all processes but the first."""
    fingerprints: list[str]
    """SHA-256 of each seed's last parameters; the same seed gives the same. Empty likewise."""
    finished: bool
    """Whether it came to its end; otherwise the same command goes on."""
    wall_seconds: float
    """In all processes together."""

    @property
    def best(self) -> Summary:
        """Figures of the best checkpoint, of the first seed."""
        assert self.standings[0].best is not None
        return self.standings[0].best

    @property
    def best_steps(self) -> int:
        """Environment steps of the best checkpoint, of the first seed."""
        return self.standings[0].best_steps


def run(config: Config, run_dir: Path) -> Result:
    """Trains a policy, from the beginning or from where the folder's run was stopped.

    Args:
      config: the run.
      run_dir: the run folder: a new one, or that of a run with this configuration.

    Returns:
      Where it lies and how good it became.

    Raises:
      UserError: the folder holds something else, belongs to another training or cannot be
        written; the task cannot be built; the devices cannot share the environments, or their
        memory does not suffice.
    """
    _wake_device()
    if jax.process_count() > 1:
        _check_together(config)
    config.check_devices(jax.device_count())
    check_tracking(config)
    env = make_env(config)
    train = _run_brax if config.trainer == "brax" else _run_resumable
    try:
        return train(config, env, run_dir)
    except jax.errors.JaxRuntimeError as error:
        if not ran_out(error):
            raise
        told = advice(config, env, jax.device_count(), device_memory())
    raise UserError(told)


def _check_together(config: Config) -> None:
    """Refuses what several processes cannot do."""
    if config.trainer == "brax":
        raise UserError("--distributed is not known to trainer = 'brax': take 'resumable'")
    if config.seeds > 1:
        raise UserError(
            f"--distributed trains one policy, not seeds = {config.seeds}: leave one of them out"
        )


def _check_folder(config: Config, run_dir: Path) -> None:
    stored = stored_config(run_dir)
    if stored is not None:
        if "brax" in (stored.trainer, config.trainer):
            raise UserError(
                f"--run-dir {run_dir} is in use by a run of trainer = {stored.trainer!r}, which"
                " cannot be continued: name a new folder"
            )
        stored.check_resume(config)


def _wake_device() -> None:
    """Lets a GPU take its memory, a second and more, while the host builds the environment."""

    def touch() -> None:
        # Whoever needs the device hears of what is wrong with it.
        with contextlib.suppress(jax.errors.JaxRuntimeError):
            jax.block_until_ready(jax.device_put(0.0, jax.local_devices()[0]))

    threading.Thread(target=touch, daemon=True).start()


def _run_brax(config: Config, env: JetBotEnv, run_dir: Path) -> Result:
    # Brax's own trainer takes half a second to import.
    from jetbot_mjx import brax_ppo

    _check_folder(config, run_dir)
    with occupied(run_dir), CompileClock() as clock:
        write_run(run_dir, config)
        with RunRecorder(config, env, [run_dir], clock) as recorder:
            recorder.begin(_headline(config, run_dir))
            brax_ppo.train(config, env, recorder)
    return _result(run_dir, [run_dir], recorder, finished=True)


def _run_resumable(config: Config, env: JetBotEnv, run_dir: Path) -> Result:
    opened: list[tuple[RunRecorder, Resumption | None]] = []
    with contextlib.ExitStack() as stack:
        clock = stack.enter_context(CompileClock())
        preemption = stack.enter_context(Preemption(config.preemption_notice))
        program = resumable_ppo.Program(config, env)

        def begin() -> int:
            resumption = _open_folders(stack, config, run_dir, program)
            run_dirs = seed_dirs(run_dir, config)
            recorder = RunRecorder(config, env, run_dirs, clock, resumption)
            opened.append((stack.enter_context(recorder), resumption))
            if recorder.complete:
                return _COMPLETE
            recorder.begin(_headline(config, run_dir))
            return _RESUMES if resumption else _BEGINS

        outset = processes.led(begin)
        recorder, resumption = opened[0] if opened else (Recorder(), None)
        states = None
        if outset == _RESUMES:
            stored = resumption.states if resumption else []
            states = processes.from_first(stored, program.template(), config.seeds)
        if outset != _COMPLETE:
            resumable_ppo.train(config, program, recorder, preemption, states)
    first = recorder if isinstance(recorder, RunRecorder) else None
    finished = bool(processes.led(lambda: first is not None and first.complete))
    return _result(run_dir, seed_dirs(run_dir, config), first, finished=finished)


def _open_folders(
    stack: contextlib.ExitStack, config: Config, run_dir: Path, program: resumable_ppo.Program
) -> Resumption | None:
    """Makes the folders, and holds them until the stack ends; tells where the seeds stand."""
    _check_folder(config, run_dir)
    run_dirs, configs = seed_dirs(run_dir, config), config.of_each_seed()
    for folder in dict.fromkeys([run_dir, *run_dirs]):
        stack.enter_context(occupied(folder))
    resumption = resume(run_dirs, configs, program.template())
    if resumption is not None:
        print(_welcome_back(run_dir, resumption), flush=True)
    write_run(run_dir, config)
    if config.seeds > 1:
        for seed_dir, seed_config in zip(run_dirs, configs, strict=True):
            write_run(seed_dir, seed_config)
    return resumption


def _result(
    run_dir: Path, run_dirs: list[Path], recorder: RunRecorder | None, *, finished: bool
) -> Result:
    return Result(
        run_dir=run_dir,
        run_dirs=run_dirs,
        standings=recorder.standings if recorder else [],
        fingerprints=recorder.fingerprints if recorder else [],
        finished=finished,
        wall_seconds=recorder.wall_seconds if recorder else 0.0,
    )


def _welcome_back(run_dir: Path, resumption: Resumption) -> str:
    lines = [f"passed over: {reason}" for reason in resumption.passed_over]
    if changes := changed_versions(run_dir):
        lines.append(f"not as it was, so the bits may differ: {'; '.join(changes)}")
    lines.append(f"going on after {resumption.env_steps:,} steps")
    return "\n".join(lines)


def _headline(config: Config, run_dir: Path) -> str:
    device = jax.devices()[0]
    hosts = f" of {jax.process_count()} processes" if jax.process_count() > 1 else ""
    seeds = f", {config.seeds} seeds at once" if config.seeds > 1 else ""
    return (
        f"training {config.task.name} ({config.robot.preset} robot,"
        f" {config.task.observation} observation) with the {config.trainer} trainer:"
        f" {config.ppo.num_timesteps:,} steps in {config.ppo.num_envs:,} environments{seeds} on"
        f" {jax.device_count()} x {device.device_kind}{hosts}\nrun folder: {run_dir}"
    )


def summary(result: Result) -> str:
    """What the terminal says at the end of a training."""
    lines = []
    for standing, folder, fingerprint in zip(
        result.standings, result.run_dirs, result.fingerprints, strict=True
    ):
        assert standing.best is not None
        seed = f"{folder.name}, " if folder != result.run_dir else ""
        lines.append(
            f"{seed}best policy: {standing.best.success_rate:.1%} success at"
            f" {standing.best_steps:,} steps; last parameters: sha256 {fingerprint}"
        )
    if len(lines) > 1:
        # Its statistics take half a second to import.
        from jetbot_mjx.estimates import bootstrap, mean

        rates = [standing.best.success_rate for standing in result.standings if standing.best]
        over_seeds = bootstrap(mean, rates)
        lines.append(
            f"{len(lines)} seeds: {over_seeds.value:.2%} success in the mean"
            f" (95 % interval {over_seeds.low:.2%} .. {over_seeds.high:.2%})"
        )
    lines += [
        f"{result.wall_seconds:.1f} s in all",
        f"next: python -m jetbot_mjx.evaluate {result.run_dir}",
        f"      python -m jetbot_mjx.render {result.run_dirs[0]}",
        f"      tensorboard --logdir {result.run_dir}",
    ]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Parses the command line and trains.

    Args:
      arguments: without the program's name; None: those of the process.

    Returns:
      0, or 75 where the training was asked to stop and can go on.
    """
    parser = cli.Parser(prog="python -m jetbot_mjx.train", description=__doc__)
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--config", type=Path, help="YAML file, see configs/")
    source.add_argument(
        "--resume", type=Path, metavar="RUN", help="go on with the run in this folder"
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
        _check_together(config)
        processes.join()
    cli.require_device()
    cli.use_compilation_cache()
    result = run(config, run_dir)
    if processes.is_first():
        print(
            summary(result)
            if result.finished
            else f"stopped; to go on: python -m jetbot_mjx.train --resume {run_dir}",
            flush=True,
        )
    processes.leave()
    if result.finished:
        return 0
    if threading.active_count() > 1:
        # The compiler cannot be interrupted, and Python would wait for it.
        leave_now()
    return STOPPED


if __name__ == "__main__":
    cli.run_command(main)
