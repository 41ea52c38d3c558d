"""Predictions of the memory of a training, against what XLA allocates."""

import json

import jax
import numpy as np
import pytest

from jetbot_mjx.config import load_config, parse_config
from jetbot_mjx.devices import compiler_options
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs import Setup
from jetbot_mjx.training import memory, session
from jetbot_mjx.training.memory import GIB, MemoryModel, sizes
from jetbot_mjx.training.ppo_trainer import CompiledTrainer, build_ppo


@pytest.fixture(scope="module")
def config(root):
    return load_config(root / "configs" / "smoke.yaml")


@pytest.fixture(scope="module")
def env(config):
    return make_env(config)


@pytest.fixture(scope="module")
def each(config, env):
    return sizes(build_ppo(Setup(config, env=env)), env)


MANY = ["ppo.num_envs=2048", "ppo.num_minibatches=32", "ppo.unroll_length=4"]


# For so small a training the XLA of a GPU sets aside from half to nine eighths of what is told.
@pytest.mark.slow
@pytest.mark.cpu
@pytest.mark.parametrize(
    ("settings", "fullest"),
    [
        ([], "learning"),
        pytest.param(MANY, "learning", marks=pytest.mark.slow, id="learning from many"),
        # MJX without the kernel, which compiles so long.
        pytest.param(
            [*MANY, "physics.impl=xla"], "collecting", marks=pytest.mark.slow, id="collecting"
        ),
    ],
)
def test_xla_sets_aside_what_was_told(root, settings, fullest):
    config = load_config(root / "configs" / "smoke.yaml", settings)
    env = make_env(config)
    told = MemoryModel(config, sizes(build_ppo(Setup(config, env=env)), env), 1).footprint()
    program = CompiledTrainer.from_setup(Setup(config, env=env))
    stats = (
        program.trace().lower().compile(compiler_options(config.deterministic)).memory_analysis()
    )
    taken = (
        stats.argument_size_in_bytes
        + stats.output_size_in_bytes
        - stats.alias_size_in_bytes
        + stats.temp_size_in_bytes
    )
    trained = told._replace(evaluation=0)
    assert fullest == max(("collecting", "learning"), key=lambda part: getattr(told, part))
    print(f"{fullest}: told {trained.counted:,} bytes, taken {taken:,}")
    assert 0.9 * taken <= trained.counted <= 1.3 * taken


def test_the_predicted_memory_is_that_of_a_gpu(root):
    measured = json.loads((root / "benchmarks/results/nvidia-h200-sweep.json").read_text("utf-8"))
    # What was measured was XLA's update.
    values = measured["config"]
    config = parse_config({**values, "ppo": {**values["ppo"], "update": "xla"}})
    env = make_env(config)
    each = sizes(build_ppo(Setup(config, env=env)), env)
    for row in measured["results"]:
        if row["rate"] == "training":
            factor, had = row["num_envs"] / config.ppo.num_envs, row["peak_device_bytes"]
            told = MemoryModel(config, each, 1).resized(factor).total
            print(f"{row['num_envs']} environments: {told / had:.2f} of what was in use")
            assert had <= told <= 1.3 * had + 2**24


def test_sizes_are_those_of_the_arrays(config, env, each):
    state = CompiledTrainer.from_setup(Setup(config, env=env)).template()
    size = {
        name: sum(np.prod(x.shape, dtype=int) * x.dtype.itemsize for x in jax.tree.leaves(tree))
        for name, tree in {"all": state, "environments": state.env_state}.items()
    }
    assert each.environment * config.ppo.num_envs == size["environments"]
    assert each.parameters == size["all"] - size["environments"]


def test_devices_share_the_environments_and_not_the_parameters(config, each):
    one, four = MemoryModel(config, each, 1).footprint(), MemoryModel(config, each, 4).footprint()
    assert four.environments == one.environments / 4
    assert four.collecting == one.collecting / 4
    assert four.learning < one.learning / 2
    assert four.parameters == one.parameters
    assert four.evaluation == one.evaluation


def test_seeds_take_their_memory_each(config, each):
    several = config.model_copy(update={"seeds": 3})
    one, three = MemoryModel(config, each, 1).footprint(), MemoryModel(several, each, 1).footprint()
    for part in ("parameters", "environments", "collecting", "learning"):
        assert getattr(three, part) == 3 * getattr(one, part)


def test_the_ladder_ends_with_the_first_that_does_not_fit(config, each):
    limit = MemoryModel(config, each, 1).resized(3.0).total
    found = MemoryModel(config, each, 1).ladder(limit)
    assert [one.num_envs for one in found[:4]] == [32, 64, 128, 256]
    assert [one.total <= limit for one in found] == [True] * (len(found) - 1) + [False]
    assert all(one.batch_size * 2 == one.num_envs for one in found)


def test_the_next_size_is_smaller_and_fits(config, each):
    whole = MemoryModel(config, each, 1).footprint().total
    assert MemoryModel(config, each, 1).next_that_fits(None).num_envs == 64
    assert MemoryModel(config, each, 1).next_that_fits(10 * whole).num_envs == 64
    little = MemoryModel(config, each, 1).resized(0.25).total
    assert MemoryModel(config, each, 1).next_that_fits(little).num_envs == 32
    assert MemoryModel(config, each, 1).next_that_fits(1000) is None
    assert MemoryModel(config, each, 32).next_that_fits(None).num_envs == 64
    assert MemoryModel(config, each, 64).next_that_fits(None) is None  # half a batch of 64 is 32
    assert MemoryModel(config, each, 1).resized(1 / 128) is None


def test_a_cpu_has_the_memory_of_its_machine():
    assert 0.1 * GIB < memory.device_memory() < 2**50


@pytest.mark.slow
def test_out_of_memory_the_next_size_that_fits_is_named(config, tmp_path, monkeypatch):
    def train_too_large(*arguments, **options):
        raise jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory\nallocating")

    monkeypatch.setattr(session.ppo_trainer, "train", train_too_large)
    monkeypatch.setattr(session, "device_memory", lambda: 8 * GIB)
    with pytest.raises(UserError) as caught:
        session.run(config, tmp_path / "run")
    line = str(caught.value)
    assert "\n" not in line
    assert "the device's memory (8.00 GiB) is too small for ppo.num_envs = 128" in line
    assert "--set ppo.num_envs=64 --set ppo.batch_size=32 takes" in line


def test_other_failures_of_jax_pass_through(config, tmp_path, monkeypatch):
    def fail(*arguments, **options):
        raise jax.errors.JaxRuntimeError("INTERNAL: no")

    monkeypatch.setattr(session.ppo_trainer, "train", fail)
    with pytest.raises(jax.errors.JaxRuntimeError, match="INTERNAL"):
        session.run(config, tmp_path / "run")
