"""The choice of a learner, and XLA in the place of one that cannot be used."""

import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import gliding
from helpers.kernel_ppo import config, make_ppo, minibatch
from jetbot_mjx.agents.fused import probe
from jetbot_mjx.agents.fused.layout import VectorLayout
from jetbot_mjx.agents.fused.learner import FusedLearner
from jetbot_mjx.agents.learner import TREES, Learner
from jetbot_mjx.agents.optimizer import make_optimizer
from jetbot_mjx.agents.xla_learner import XlaLearner
from jetbot_mjx.config import load_config, parse_config
from jetbot_mjx.errors import UserError
from jetbot_mjx.fallbacks import collect
from jetbot_mjx.runs import Setup
from jetbot_mjx.training.ppo_trainer import CompiledTrainer, build_ppo
from onekernel import ProgramCache, cpu, gpu

pytestmark = pytest.mark.cpu


def test_a_cpu_takes_the_kernels_where_it_can_and_says_where_it_cannot(capsys):
    with collect() as found:
        learner = make_ppo(config()).learner
    assert isinstance(learner, FusedLearner)
    assert (found, capsys.readouterr().err) == ([], "")
    with collect() as found:
        learner = make_ppo(config(hidden=[40])).learner
    assert isinstance(learner, XlaLearner)
    assert learner.layout is TREES
    reason = "it takes layers of 16, 32, 48, ... units, not 40"
    assert found == [("ppo.update", reason)]
    line = f"slow: ppo.update: training is 2 to 4 times slower: {reason}\n"
    assert capsys.readouterr().err == line


def test_without_llvmlite_a_cpu_takes_xla_and_says_so(monkeypatch, capsys):
    cpu.obstacle.cache_clear()
    monkeypatch.setitem(sys.modules, "llvmlite.binding", None)
    monkeypatch.setattr(cpu, "_binding", cpu._binding.__wrapped__)
    monkeypatch.setattr(cpu, "host_processor", cpu.host_processor.__wrapped__)
    try:
        assert isinstance(make_ppo(config()).learner, XlaLearner)
        assert "ppo.update: training is 2 to 4 times slower: llvmlite" in capsys.readouterr().err
        with pytest.raises(UserError, match=r"ppo\.update = fused: llvmlite cannot be used"):
            make_ppo(config(update="fused"))
    finally:
        cpu.obstacle.cache_clear()


@pytest.mark.parametrize("update", ["auto", "fused", "xla"])
def test_a_learner_is_named_as_the_setting_that_asks_for_it(update):
    learner = make_ppo(config(update=update)).learner
    assert isinstance(learner, Learner)
    assert learner.name == ("fused" if update == "auto" else update)
    assert learner.keeps_activations == (learner.name == "xla")
    assert learner.draws_ahead == (learner.name == "fused")


def test_kernels_that_fail_their_check_say_so_and_change_nothing(monkeypatch):
    ppo = make_ppo(config())
    before = vars(ppo.learner).copy()
    # A CPU's kernels are checked by the probe of their back end.
    monkeypatch.setattr(probe, "runs_correctly", lambda: False)
    assert ppo.learner.failure() is None
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert ppo.learner.failure() == "its kernels failed their check on this machine"
    assert vars(ppo.learner) == before
    assert make_ppo(config(update="xla")).learner.failure() is None
    monkeypatch.setattr(probe, "runs_correctly", lambda: True)
    assert ppo.learner.failure() is None


def test_without_a_back_end_xla_computes_the_update(monkeypatch, capsys):
    ppo, requested = make_ppo(config()), make_ppo(config(update="fused"))
    assert ppo.launchable() is ppo
    monkeypatch.setattr(gpu, "obstacle", lambda: "there is none")
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    other = ppo.launchable()
    assert isinstance(other.learner, XlaLearner)
    assert isinstance(ppo.learner, FusedLearner)
    assert capsys.readouterr().err.endswith(": there is none\n")
    with pytest.raises(UserError, match=r"ppo\.update = fused: there is none: choose auto or xla"):
        requested.launchable()
    alone = make_ppo(config(update="xla"))
    assert alone.launchable() is alone


def assert_close(one, other):
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6), one, other)


@pytest.mark.slow
def test_in_the_place_of_kernels_xla_takes_and_returns_their_vectors():
    settings = config()
    kernels, xla = make_ppo(settings), make_ppo(config(update="xla"))
    with collect() as found:
        instead = kernels.with_xla("of a test").learner
    assert found == [("ppo.update", "of a test")]
    assert isinstance(instead.layout, VectorLayout)
    params, statistics, data = minibatch(np.random.default_rng(0), settings, xla.networks)
    several = settings.ppo.num_minibatches
    data = jax.tree.map(lambda x: jnp.concatenate([x] * several), data)
    tree = params, make_optimizer(settings.ppo).init(params)
    vectors = kernels.learner.layout.pack(tree)
    key = jax.random.PRNGKey(1)

    @jax.jit
    def update(vectors):
        params, optimizer_state = instead.to_working(vectors)
        *tree, totals = instead.update(params, optimizer_state, statistics, data, key)
        return instead.from_working(tuple(tree)), totals

    with collect() as found:
        ours, totals = update(vectors)
    # Tracing a program reports the fallback, so that the cache can store it with the program.
    assert found == [("ppo.update", "of a test")]
    assert jax.tree.structure(ours) == jax.tree.structure(vectors)
    *theirs, expected = jax.jit(xla.learner.update)(*tree, statistics, data, key)
    # Two programs, in which XLA may round differently.
    assert_close(kernels.learner.layout.unpack(ours), tuple(theirs))
    assert_close(totals, expected)
    assert float(totals[-1]) == several * settings.ppo.num_updates_per_batch


TINY = {
    "task": {"observation": "egocentric", "episode_length": 16},
    "ppo": {"num_envs": 4, "unroll_length": 4, "batch_size": 4, "num_minibatches": 1},
}


@pytest.mark.slow
def test_a_training_whose_kernels_fail_their_check_is_that_of_xla(root, monkeypatch):
    smoke = load_config(root / "configs" / "smoke.yaml").model_dump(mode="json")

    def trained(update):
        config = parse_config({**smoke, **TINY, "ppo": {**TINY["ppo"], "update": update}})
        with gliding.everywhere():
            ppo = build_ppo(Setup(config, env=gliding.Gliding(config)))
            trainer = CompiledTrainer(ppo, [0], ProgramCache({}))
            state, _ = trainer.compile()(trainer.init(), 2, False)
            return ppo, trainer.get(state)[0]

    _, expected = trained("xla")
    monkeypatch.setattr(FusedLearner, "failure", lambda self: "of a test")
    with collect() as found:
        ppo, state = trained("auto")
    assert found == [("ppo.update", "of a test")]
    assert isinstance(ppo.learner, FusedLearner)
    assert_close(jax.device_get(state), jax.device_get(expected))
    with pytest.raises(UserError, match=r"ppo\.update = fused: of a test: choose auto or xla"):
        trained("fused")
