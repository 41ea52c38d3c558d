"""Fallbacks to slower code are reported once, to all who ask."""

import jax
import jax.numpy as jnp
import pytest

from jetbot_mjx import fallbacks
from jetbot_mjx.config import parse_config
from jetbot_mjx.envs import physics
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.task import GoalTask
from jetbot_mjx.envs.wrappers import wrap_for_training
from jetbot_mjx.fallbacks import Fallback, collect, report
from onekernel.aot.program_cache import ProgramCache
from onekernel.background import in_background
from onekernel.errors import UnsupportedError

TRIPLE = jax.jit(lambda x: 3 * x)
SLOW = Fallback("ppo.update", "there is no reason")


class Transforming(GoalTask):
    def reward(self, *arguments):
        reward, terms = super().reward(*arguments)
        spectrum = jnp.abs(jnp.fft.rfft(jnp.stack([reward, -reward])))
        return reward + 0.0 * spectrum[0], terms


def test_a_fallback_is_printed_once_and_collected_by_all_who_ask(capsys):
    with collect() as outer:
        report(SLOW)
        with collect() as inner:
            report(SLOW)
            report(SLOW)
    report(SLOW)
    assert outer == inner == [SLOW]
    line = "slow: ppo.update: training is 2 to 4 times slower: there is no reason\n"
    assert capsys.readouterr().err == line


def test_a_thread_of_the_package_reports_to_those_who_started_it():
    with collect() as found:
        in_background(lambda: report(SLOW)).result()
    assert found == [SLOW]


def test_what_a_task_does_that_no_kernel_can_is_said_with_its_line(capsys):
    env = wrap_for_training(make_env(parse_config({}), own_class=Transforming), 10)
    keys = jax.random.split(jax.random.PRNGKey(0), 2)
    with collect() as found:
        jax.eval_shape(lambda keys: env.step(env.reset(keys), jnp.zeros((2, 2))), keys)
    ((what, reason),) = found
    assert what == "environment step"
    assert "the operation fft" in reason
    assert "test_fallbacks.py:" in reason
    assert capsys.readouterr().err.startswith("slow: environment step: ")


def test_a_task_that_a_kernel_can_do_is_silent(capsys):
    env = wrap_for_training(make_env(parse_config({})), 10)
    keys = jax.random.split(jax.random.PRNGKey(0), 2)
    jax.eval_shape(lambda keys: env.step(env.reset(keys), jnp.zeros((2, 2))), keys)
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("prefetched", [True, False])
def test_a_program_from_the_cache_reports_what_it_was_traced_with(tmp_path, prefetched):
    def trace():
        report(SLOW)
        return jax.jit(lambda x: 2 * x).trace(jnp.ones(3))

    ProgramCache({}, tmp_path, "key", fallbacks).compile("double", trace)
    ProgramCache({}, tmp_path, "key", fallbacks).compile(
        "triple", lambda: TRIPLE.trace(jnp.ones(3))
    )
    later = ProgramCache({}, tmp_path, "key", fallbacks)
    with collect() as found:
        if prefetched:
            later.prefetch("triple")
        later.find("triple")
    assert found == []
    with collect() as found:
        if prefetched:
            later.prefetch("double")
        assert later.find("double") is not None
    assert found == [SLOW]


def test_physics_without_a_kernel_is_reported_alone(monkeypatch, capsys):
    def refuse(*arguments):
        raise UnsupportedError("the operation that_is_new")

    monkeypatch.setattr(physics, "scalarize", refuse)
    env = wrap_for_training(make_env(parse_config({})), 10)
    keys = jax.random.split(jax.random.PRNGKey(0), 2)
    with collect() as found:
        jax.eval_shape(lambda keys: env.step(env.reset(keys), jnp.zeros((2, 2))), keys)
    assert [what for what, _ in found] == ["physics.impl"]
    assert capsys.readouterr().err.count("\n") == 1
