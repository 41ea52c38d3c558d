"""Runs every command on the machine's NVIDIA GPU, and the tests: `make test-gpu`, a line each.

`python tests/on_gpu.py [--skip-tests] [--output FOLDER]`. Trainings are cut short: this shows that
commands work where the default device is a GPU, not how well policies drive. A command for which an
optional package or OpenGL is missing is left out and said.
"""

import argparse
import os
import shlex
import subprocess
import sys
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]

_SHORT = "--set ppo.num_timesteps=262144 --set checkpoint_interval=131072"
_GPU = f"--config configs/gpu.yaml {_SHORT} --set ppo.num_envs=1024 --set ppo.batch_size=128"
_LIVE = (
    "from jetbot_mjx.viewers.player import Player; player = Player('{runs}/mine'); "
    "[player.tick() for _ in range(300)]; print(player.episodes, 'episodes')"
)


class Command(NamedTuple):
    """One line of a shell, with `{runs}` for a folder of its own."""

    line: str
    needs: tuple[str, ...] = ()
    """Packages without which it is left out."""
    expected: int = 0
    """Its exit code."""


_RUN = "python -m jetbot_mjx"
COMMANDS = [
    Command(_RUN),
    Command(f"{_RUN}.plan --config configs/gpu.yaml"),
    Command(f"{_RUN}.train --config configs/jetbot.yaml --run-dir {{runs}}/mine {_SHORT}"),
    Command(f"{_RUN}.train --resume {{runs}}/mine --set ppo.num_timesteps=393216"),
    Command(f"{_RUN}.train {_GPU} --run-dir {{runs}}/gpu"),
    Command(f"{_RUN}.train {_GPU} --run-dir {{runs}}/exact --set deterministic=true"),
    Command(f"{_RUN}.train {_GPU} --run-dir {{runs}}/drawn --set robot.preset=real"),
    Command(f"{_RUN}.train {_GPU} --run-dir {{runs}}/xla --set physics.impl=xla"),
    Command(f"{_RUN}.train {_GPU} --run-dir {{runs}}/ptx --set physics.impl=ptx"),
    Command(f"{_RUN}.train {_GPU} --run-dir {{runs}}/cpus --set physics.impl=llvm", expected=2),
    Command(f"{_RUN}.train {_GPU} --run-dir {{runs}}/fused --set ppo.update=fused"),
    Command(f"{_RUN}.train {_GPU} --run-dir {{runs}}/several --set ppo.update=fused --seeds 4"),
    Command(f"{_RUN}.train {_GPU} --run-dir {{runs}}/unfused --set ppo.update=xla"),
    Command(f"{_RUN}.train --config configs/smoke.yaml --seeds 2 --run-dir {{runs}}/two"),
    Command(
        f"{_RUN}.train --config configs/real_jetbot.yaml --run-dir {{runs}}/real {_SHORT}"
        " --set ppo.num_envs=256 --set ppo.batch_size=64"
    ),
    *(
        Command(f"{_RUN}.train --config examples/{name}.yaml --run-dir {{runs}}/{name} {_SHORT}")
        for name in ("obstacle", "pillars", "gates")
    ),
    Command(f"{_RUN}.evaluate {{runs}}/mine"),
    Command(f"{_RUN}.evaluate {{runs}}/real --episodes 64 --ranges configs/real_jetbot.yaml"),
    Command(f"{_RUN}.evaluate {{runs}}/mine {{runs}}/gpu --episodes 64"),
    Command(f"{_RUN}.evaluate {{runs}}/ptx --robustness --episodes 64"),
    Command(f"{_RUN}.render {{runs}}/mine --goals 3,17", needs=("av", "OpenGL")),
    Command(f"{_RUN}.export {{runs}}/mine --format numpy"),
    Command(f"{_RUN}.export {{runs}}/mine --format stablehlo"),
    Command(f"{_RUN}.export {{runs}}/mine --format onnx", needs=("onnx", "onnxruntime")),
    Command(f"{_RUN}.pretrained --output {{runs}}/pretrained"),
    Command(f"{_RUN}.evaluate {{runs}}/pretrained/jetbot_egocentric --min-success 0.95"),
    Command(f"{_RUN}.new_task {{runs}}/my_task.py"),
    Command(f"{_RUN}.check_env GoalTask --set robot.preset=real"),
    Command(f"{_RUN}.check_env --config examples/pillars.yaml"),
    Command(f"python -c {shlex.quote(_LIVE)}"),
    Command(f"python -c {shlex.quote(_LIVE.replace('mine', 'ptx'))}"),
    Command(
        "python benchmarks/steps_per_second.py --num-envs 256 --repeats 1 --skip brax"
        " --output {runs}/rates.json"
    ),
]


def main() -> int:
    """Run all; return 0 if nothing failed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--skip-tests", action="store_true", help="commands alone")
    parser.add_argument("--output", type=Path, help="what the commands print goes there")
    options = parser.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="jetbot_mjx-gpu-"))
    output = options.output or folder
    output.mkdir(parents=True, exist_ok=True)
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]),
        "JAX_COMPILATION_CACHE_DIR": str(folder / "cache"),
        "XLA_PYTHON_CLIENT_PREALLOCATE": "false",
    }
    commands = list(COMMANDS)
    if not options.skip_tests:
        # Tests take some CPU devices for several; the GPU is the default one.
        environment |= {"JAX_PLATFORMS": "cuda,cpu"}
        workers = min(8, os.cpu_count() or 1)
        commands.append(
            Command(
                f"python -m pytest -m 'not slow' -q -p no:benchmark -n {workers} --dist loadfile"
                " --durations=0"
            )
        )
    failed = 0
    for index, command in enumerate(commands):
        failed += not _run(command, folder, output / f"{index:02}.txt", environment)
    print(f"{len(commands) - failed} of {len(commands)} lines in order; output in {output}")
    return int(failed > 0)


def _run(command: Command, folder: Path, log: Path, environment: dict[str, str]) -> bool:
    """Run one command, print its line, and return whether it did as expected."""
    missing = [name for name in command.needs if not _is_there(name, environment)]
    if missing:
        print(f"left out  {command.line}: no {', '.join(missing)}", flush=True)
        return True
    line = command.line.replace("{runs}", str(folder)).replace("python", sys.executable, 1)
    began = time.perf_counter()
    with log.open("w", encoding="utf-8") as file:
        code = subprocess.run(
            shlex.split(line),
            cwd=ROOT,
            env=environment,
            stdout=file,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            check=False,
        ).returncode
    fine = code == command.expected
    seconds = time.perf_counter() - began
    print(f"{'ok' if fine else 'FAILED':8} {seconds:6.1f} s  {command.line}", flush=True)
    if not fine:
        print(f"  exit code {code}, not {command.expected}:")
        for text in log.read_text("utf-8").splitlines()[-15:]:
            print(f"  | {text}")
    return fine


def _is_there(name: str, environment: dict[str, str]) -> bool:
    if name != "OpenGL":
        return find_spec(name) is not None
    code = "import mujoco; mujoco.GLContext(8, 8)"
    environment = {"MUJOCO_GL": "egl", **environment}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, check=False
    )
    return done.returncode == 0


if __name__ == "__main__":
    sys.exit(main())
