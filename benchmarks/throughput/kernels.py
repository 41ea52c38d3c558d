"""Count kernels: `python benchmarks/throughput/kernels.py --config configs/jetbot.yaml`.

Counts the instructions of compiled programs that become kernels (on a CPU: separate loops and
calls) in one environment step of physics, one environment step with the training wrappers and one
training step. Also counts the scalar operations of one physics step, of which the physics kernel
consists. Nothing is timed, so that a regression is visible on any machine, however busy.
"""

import collections
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jetbot_mjx import cli
from jetbot_mjx.agents.ppo import PPO
from jetbot_mjx.config import Config, load_config, parse_config
from jetbot_mjx.devices import compiler_options
from jetbot_mjx.envs.jetbot_env import make_jetbot_env
from jetbot_mjx.envs.wrappers import wrap_for_training
from jetbot_mjx.runs import Setup
from jetbot_mjx.training.ppo_trainer import build_ppo
from onekernel.lower.jaxpr import scalarize

PROGRAMS = ("physics", "env", "training")

_FREE = {"parameter", "constant", "tuple", "get-tuple-element", "bitcast", "after-all"}
_FREE |= {"partition-id", "replica-id", "opt-barrier", "add-dependency"}
"""Instructions that only name or group existing values."""

_COMPUTATION = re.compile(r"^(ENTRY )?%?([\w.-]+) .*->.* \{$")
_INSTRUCTION = re.compile(r"^\s+(?:ROOT )?%?[\w.-]+ = (?:\(.*?\)|\S+) ([a-z][\w-]*)\(")
_CALLED = re.compile(
    r"(?:to_apply|body|condition|true_computation|false_computation)=%?([\w.-]+)"
    r"|branch_computations=\{([^}]*)\}"
)
_TRIPS = re.compile(r'"known_trip_count":\{"n":"(\d+)"')


class Count(NamedTuple):
    """A `Count` holds the numbers of kernels of a compiled program."""

    kernels: Mapping[str, int]
    """The number of instructions that become kernels, by their operation."""
    launches: int
    """The number of kernel launches; a loop of unknown length counts once."""
    unknown_loops: int
    """The number of loops whose length is known only at run time."""


def count_kernels(text: str) -> Count:
    """Count the kernels of a compiled program.

    Args:
      text: The program after all of XLA's passes, `compiled.as_text()`.

    Returns:
      The counts over the entry computation and all that it calls; a fusion counts as one.
    """
    computations, entry = _computations(text)
    kernels: collections.Counter[str] = collections.Counter()
    unknown = 0

    def walk(name: str) -> int:
        nonlocal unknown
        launches = 0
        for op, line in computations[name]:
            if op in ("while", "call", "conditional"):
                trips = _TRIPS.search(line)
                unknown += op == "while" and trips is None
                turns = int(trips[1]) if trips else 1
                launches += turns * sum(walk(called) for called in _called(line))
            elif op not in _FREE and not op.endswith("-done"):
                kernels[op] += 1
                launches += 1
        return launches

    launches = walk(entry)
    return Count(dict(kernels.most_common()), launches, unknown)


def _computations(text: str) -> tuple[dict[str, list[tuple[str, str]]], str]:
    """Return the (operation, line) pairs of each computation, and the name of the entry."""
    found: dict[str, list[tuple[str, str]]] = {}
    entry, current = "", ""
    for line in text.splitlines():
        if head := _COMPUTATION.match(line):
            current = head[2]
            found[current] = []
            entry = current if head[1] else entry
        elif current and (instruction := _INSTRUCTION.match(line)):
            found[current].append((instruction[1], line))
    return found, entry


def _called(line: str) -> list[str]:
    names = []
    for one, several in _CALLED.findall(line):
        names += [one] if one else [name.strip().lstrip("%") for name in several.split(",")]
    return names


def compiled_text(config: Config, program: str) -> str:
    """Compile a step and return the text of the compiled program.

    Args:
      config: The configuration of the run.
      program: One of `PROGRAMS`.
    """
    env = make_jetbot_env(config)
    batch = wrap_for_training(env, config.task.episode_length)
    keys = jax.random.split(jax.random.PRNGKey(0), config.ppo.num_envs)
    actions = jnp.zeros((config.ppo.num_envs, 2))
    if program == "physics":
        first = jax.eval_shape(jax.vmap(env.reset), keys).pipeline_state
        lowered = jax.jit(jax.vmap(env.physics.step)).lower(first, actions)
    elif program == "env":
        step: Any = batch.step
        lowered = jax.jit(step).lower(jax.eval_shape(batch.reset, keys), actions)
    else:
        ppo = PPO(config.ppo, batch, build_ppo(Setup(config, env=env)).networks)
        state = jax.eval_shape(lambda key: ppo.packed(ppo.init(key)), jax.random.PRNGKey(0))
        lowered = jax.jit(ppo.train_step).lower(state)
    options: dict[str, Any] = {**compiler_options(config.deterministic)}
    return str(lowered.compile(compiler_options=options).as_text())


def count_scalars(config: Config) -> dict[str, int]:
    """Count the scalar operations in one physics step of one robot, by their kind."""
    values = config.model_dump(mode="json")
    values["physics"] |= {"impl": "xla", "ctrl_dt": config.physics.sim_dt}
    env = make_jetbot_env(parse_config(values))
    physics = jax.eval_shape(env.reset, jax.random.PRNGKey(0)).pipeline_state
    program = scalarize(env.physics.step, physics, jnp.zeros(env.action_size))
    return dict(collections.Counter(x.op for x in program.block.values()).most_common())


def main(arguments: Sequence[str] | None = None) -> int:
    """Compile the programs and print their counts.

    Args:
      arguments: The command line without the program's name; None: that of the process.

    Returns:
      The exit code.
    """
    parser = cli.Parser(description=__doc__)
    parser.add_argument("--config", type=Path, required=True)
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument("--skip", action="append", default=[], choices=PROGRAMS)
    options = parser.parse_args(arguments)
    config = load_config(options.config, options.overrides)
    print(
        f"{options.config.name} with {config.ppo.num_envs} environments on"
        f" {jax.devices()[0].device_kind}, physics.impl {make_jetbot_env(config).physics.impl}"
    )
    for program in PROGRAMS:
        if program not in options.skip:
            count = count_kernels(compiled_text(config, program))
            print(_line(program, count), flush=True)
    scalars = count_scalars(config)
    print(f"{'scalars':8} {sum(scalars.values()):6,} operations: {_kinds(scalars)}")
    return 0


def _line(program: str, count: Count) -> str:
    least = "at least " if count.unknown_loops else ""
    return (
        f"{program:8} {sum(count.kernels.values()):6,} kernels, {least}{count.launches:,} launches:"
        f" {_kinds(count.kernels)}"
    )


def _kinds(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{name} {count:,}" for name, count in counts.items())


if __name__ == "__main__":
    cli.run_command(main)
