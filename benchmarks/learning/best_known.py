"""Search for the shortest time to each goal: `python benchmarks/learning/best_known.py`.

The search finds open-loop commands for each of the report's goals with the true model. The
commands are a polyline of --knots points over the duration of the episode. The cross-entropy
method draws --samples polylines around a mean, selects the best sixteenth, updates mean and
standard deviation to theirs, and repeats this --rounds times. The search restarts --starts times;
each restart spreads its knots over the best duration so far. The report's own rollout simulates
each sample from the reset key of the goal, so that times are counted as for a policy. The cost of
a sample is its number of environment steps, plus the steps that the remaining distance to the
goal would take at full speed.

The result is an upper bound of the shortest time; reports show it as "best known".

Source: R. Y. Rubinstein, The Cross-Entropy Method for Combinatorial and Continuous Optimization,
Methodology and Computing in Applied Probability 1 (1999), 127-190, doi:10.1023/A:1010091220143.
"""

import json
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt32

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from benchmarks import CONFIGS
from benchmarks.harness.results import check_output
from jetbot_mjx import cli
from jetbot_mjx.config import Config, load_config
from jetbot_mjx.devices import require_device, use_compilation_cache
from jetbot_mjx.envs.jetbot_env import JetBotEnv, make_jetbot_env
from jetbot_mjx.envs.state import State
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation.best_known import FILE, FORMAT, settings_of
from jetbot_mjx.evaluation.evaluator import BASELINES, report_keys
from jetbot_mjx.evaluation.goal_set import GOAL_SET_VERSION, REPORT_GOALS
from jetbot_mjx.evaluation.rollout import Controller, Episodes, rollout_fn
from jetbot_mjx.runs.run_dir import versions, write_text, writing_to

_ELITE_SHARE = 16
_FIRST_STD = 1.0
_LEAST_STD = 0.02


class Settings(NamedTuple):
    """`Settings` holds the parameters of the search."""

    knots: int = 16
    samples: int = 512
    rounds: int = 40
    starts: int = 3
    seed: int = 0


class Commands(NamedTuple):
    """`Commands` holds a polyline of actions; the last one is held after its end."""

    knots: Float[Array, "*batch knots 2"]
    """Actions; only the environment clips them to [-1, 1]."""
    steps: Float[Array, "*batch"]
    """Environment steps over which the knots are spread evenly."""


class Found(NamedTuple):
    """`Found` holds the best of all samples of one goal."""

    rank: Float[Array, "*batch"]
    """Environment steps to the goal, plus a thousandth of the cost of the search."""
    steps: Float[Array, "*batch"]
    """Environment steps to the goal; infinite if it was never reached."""
    commands: Commands


def play(params: Commands, state: State, key: UInt32[Array, "2"]) -> Float[Array, "2"]:
    """Return the action of the polyline at the current step; a controller for rollouts."""
    del key
    count = params.knots.shape[-2]
    place = jnp.minimum(state.info["steps"] / params.steps, 1.0) * (count - 1)
    weights = jnp.maximum(1.0 - jnp.abs(place - jnp.arange(count)), 0.0)
    return (weights[:, None] * params.knots).sum(axis=0)


def drive_fn(env: JetBotEnv, longest: int) -> Callable[..., Episodes]:
    """Build a rollout of one command from one reset key for each sample.

    Args:
      env: The environment without wrappers.
      longest: The number of environment steps after which an episode is truncated.

    Returns:
      A function of (commands of n samples, reset keys (n, 2)) to their episodes.
    """
    rollout = rollout_fn(env, [play], longest)

    def drive(commands: Commands, keys: UInt32[Array, "n 2"]) -> Episodes:
        one = jax.vmap(lambda commands, key: rollout(0, commands, key[None]))(commands, keys)
        return jax.tree.map(lambda x: x[:, 0], one)

    return drive


def search_fn(env: JetBotEnv, settings: Settings, longest: int) -> Callable[..., Found]:
    """Build the search for one goal.

    Args:
      env: The environment without wrappers.
      settings: The parameters of the search.
      longest: The number of environment steps after which a sample is truncated.

    Returns:
      A function of (index of the goal, its reset key, largest number of environment steps) to the
      best commands; batch it with `jax.vmap`.
    """
    drive = drive_fn(env, longest)
    elites = max(2, settings.samples // _ELITE_SHARE)
    full_speed = env.config.task.max_speed * env.dt  # [m] in a step

    def one_round(
        carry: tuple[Array, Array, Found], key: Array, reset_key: Array, spread: Array
    ) -> tuple[tuple[Array, Array, Found], None]:
        mean, std, best = carry
        noise = jax.random.normal(key, (settings.samples, settings.knots, 2))
        # The first sample is the mean itself.
        knots = mean + std * noise.at[0].set(0.0)
        commands = Commands(knots, jnp.broadcast_to(spread, settings.samples))
        driven = drive(commands, jnp.broadcast_to(reset_key, (settings.samples, 2)))
        rest = jnp.linalg.norm(driven.goal_w[:, :2] - driven.end_w, axis=-1)
        cost = driven.steps + rest / full_speed
        steps = jnp.where(driven.success > 0, driven.steps, jnp.inf)
        rank = jnp.where(driven.success > 0, driven.steps, longest) + 1e-3 * cost
        found = Found(rank, steps, commands)
        found = jax.tree.map(lambda x: x[jnp.argmin(rank)], found)
        best = jax.tree.map(lambda a, b: jnp.where(found.rank < best.rank, a, b), found, best)
        chosen = knots[jax.lax.top_k(-cost, elites)[1]]
        mean, std = chosen.mean(axis=0), jnp.maximum(chosen.std(axis=0), _LEAST_STD)
        return (mean, std, best), None

    def search(goal: Int[Array, ""], reset_key: UInt32[Array, "2"], most: Array) -> Found:
        key = jax.random.fold_in(jax.random.PRNGKey(settings.seed), goal)
        zeros = jnp.zeros((settings.knots, 2))
        nothing = Found(jnp.float32(jnp.inf), jnp.float32(jnp.inf), Commands(zeros, most))

        def one_start(best: Found, key: Array) -> tuple[Found, None]:
            spread = jnp.minimum(best.steps, most)
            carry = (zeros, jnp.full_like(zeros, _FIRST_STD), best)
            carry, _ = jax.lax.scan(
                lambda carry, key: one_round(carry, key, reset_key, spread),
                carry,
                jax.random.split(key, settings.rounds),
            )
            return carry[-1], None

        return jax.lax.scan(one_start, nothing, jax.random.split(key, settings.starts))[0]

    return search


def run(env: JetBotEnv, settings: Settings, goals: int, chunk: int) -> tuple[Found, Episodes]:
    """Search all goals and print the progress.

    Args:
      env: The environment without wrappers.
      settings: The parameters of the search.
      goals: The number of the report's goals, from the first on.
      chunk: The number of goals that are searched at once.

    Returns:
      The best of each goal, and the episodes of the scripted baseline, all on the host.

    Raises:
      UserError: A goal was never reached.
    """
    keys = report_keys(goals)
    scripted: Controller = BASELINES["scripted"](env)
    rollout = jax.jit(rollout_fn(env, [scripted], env.config.task.episode_length))
    baseline = jax.device_get(rollout(0, None, keys))
    longest = int(baseline.steps.max())
    search = jax.jit(jax.vmap(search_fn(env, settings, longest)))
    found, began = [], time.perf_counter()
    for start in range(0, goals, chunk):
        # The last chunk is filled up, so that all have one size and one compiled program.
        which = np.arange(start, start + chunk) % goals
        one = search(which, np.asarray(keys)[which], baseline.steps[which])
        found.append(jax.device_get(one))
        done = min(start + chunk, goals)
        print(f"{done:>5} goals  {time.perf_counter() - began:7.1f} s", flush=True)
    best: Found = jax.tree.map(lambda *parts: np.concatenate(parts)[:goals], *found)
    if missed := np.flatnonzero(~np.isfinite(best.steps)).tolist():
        raise UserError(
            f"{len(missed)} goals were not reached, such as {missed[0]}: try more --samples,"
            " --rounds or --starts"
        )
    return best, baseline


def to_json(config: Config, settings: Settings, best: Found, baseline: Episodes) -> dict[str, Any]:
    """Return a search as JSON."""
    return {
        "settings": settings_of(config),
        "goal_set_version": GOAL_SET_VERSION,
        "physics": config.physics.model_dump(mode="json"),
        "search": settings._asdict(),
        "versions": versions(),
        # Whole millimetres on the floor.
        "goals": np.rint(1e3 * baseline.goal_w[:, :2].astype(float)).astype(int).tolist(),
        "steps": best.steps.astype(int).tolist(),
    }


def read(path: Path, file_format: str = FORMAT) -> list[dict[str, Any]]:
    """Return the searches in a file; an empty list if there is no file.

    Args:
      path: The file.
      file_format: The format that the file states.

    Raises:
      UserError: The file is of another format.
    """
    if not path.exists():
        return []
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
        if values["format"] != file_format:
            raise ValueError(values["format"])
        return list(values["searches"])
    except (OSError, ValueError, LookupError, TypeError):
        what = "best-known times" if file_format == FORMAT else file_format.split("/")[0]
        raise UserError(f"--output {path} is not a file of {what}: name another") from None


def store(path: Path, search: dict[str, Any], file_format: str = FORMAT) -> None:
    """Write a search into the file; it replaces an earlier one for the same settings.

    Raises:
      UserError: The file cannot be written, or is of another format.
    """
    others = [one for one in read(path, file_format) if one["settings"] != search["settings"]]
    searches = sorted([*others, search], key=lambda one: json.dumps(one["settings"]))
    # One line for each key: with the usual indentation the lists would take thousands of lines.
    texts = [
        "{\n"
        + ",\n".join(f'   "{key}": {json.dumps(value)}' for key, value in one.items())
        + "\n  }"
        for one in searches
    ]
    body = ",\n  ".join(texts)
    with writing_to(path):
        write_text(path, f'{{\n "format": "{file_format}",\n "searches": [\n  {body}\n ]\n}}\n')


def main(arguments: Sequence[str] | None = None) -> int:
    """Search, print the best times and write the JSON file.

    Args:
      arguments: The command line without the program's name; None: that of the process.

    Returns:
      The exit code.
    """
    defaults = Settings()
    parser = cli.Parser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--config", type=Path, default=CONFIGS / "jetbot.yaml")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE")
    parser.add_argument(
        "--goals", type=cli.positive_int, default=REPORT_GOALS, help="number of the report's goals"
    )
    parser.add_argument("--chunk", type=cli.positive_int, help="goals that are searched at once")
    for name in ("knots", "samples", "rounds", "starts"):
        default = getattr(defaults, name)
        parser.add_argument(f"--{name}", type=cli.positive_int, default=default)
    parser.add_argument("--seed", type=int, default=defaults.seed)
    parser.add_argument("--output", type=Path, default=FILE)
    options = parser.parse_args(arguments)
    if options.knots < 2 or options.samples < 2:
        parser.error("--knots and --samples: at least 2")
    require_device()
    use_compilation_cache()
    config = load_config(options.config, options.overrides)
    check_output(options.output)
    read(options.output)
    settings = Settings(*(getattr(options, name) for name in Settings._fields))
    chunk = options.chunk or (8 if jax.default_backend() == "cpu" else 1024)
    env = make_jetbot_env(config)
    best, baseline = run(env, settings, options.goals, min(chunk, options.goals))
    for name, steps in (("best known", best.steps), ("scripted", baseline.steps)):
        seconds = steps * env.dt
        print(
            f"{name:>10}: median {np.median(seconds):.3f} s, mean {seconds.mean():.4f} s,"
            f" p95 {np.percentile(seconds, 95):.3f} s"
        )
    store(options.output, to_json(config, settings, best, baseline))
    print(f"results: {options.output}")
    return 0


if __name__ == "__main__":
    cli.run_command(main)
