"""The example of trajectory optimisation: its loss is right, and gradients find the way."""

import importlib.util
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jetbot_mjx.errors import UserError
from onekernel import default_backend


@pytest.fixture(scope="module")
def example(root):
    path = root / "examples" / "shortest_time.py"
    spec = importlib.util.spec_from_file_location("shortest_time", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_steps_outside_are_counted_until_the_first_arrival(example):
    away = jnp.array([0.9, 0.5, 0.2, 0.05, 0.3, 0.4])
    # A sharp edge counts the steps before the robot arrives; that it leaves again does not matter.
    assert example.steps_outside(away, 0.1, jnp.float32(1e-3)) == pytest.approx(3.0, abs=1e-3)
    slope = jax.grad(example.steps_outside)(away, 0.1, jnp.float32(0.05))
    assert (slope[:4] > 0).all()
    assert slope[3] > slope[5]


def test_a_start_turns_and_then_goes_straight_ahead(example):
    starts = jax.vmap(lambda key: example.draw(key, 120, 1 / 60))(
        jax.random.split(jax.random.key(0), 200)
    )
    assert np.abs(starts).max() <= 1.0
    assert set(np.unique(starts[:, 0, 1])) >= {-1.0, 1.0}
    assert (starts[:, -1, 0] == 1.0).all()


def test_a_round_starts_with_the_best_of_each_goal_and_around_them(example):
    found = jnp.arange(40.0).reshape(20, 1, 2) / 100
    steps = jnp.array([9.0, 3, 8, 7, 2, 6, 5, jnp.inf, 1, 4] + 10 * [5.0])
    starts = example.around_the_best(jax.random.key(0), found, steps, goals=2)
    # The eight best of ten, whose order is that of their numbers of steps.
    order = [8, 4, 1, 9, 6, 5, 3, 2]
    np.testing.assert_array_equal(starts[:8], found[jnp.array(order)])
    np.testing.assert_array_equal(starts[10:18], found[10:18])
    assert (starts[8:10] != found[jnp.array(order[:2])]).all()
    assert (starts[18:] != found[10:12]).all()
    np.testing.assert_allclose(starts[8:10], found[jnp.array(order[:2])], atol=1.0)
    # Where there are fewer sequences than parents, each is one.
    np.testing.assert_array_equal(
        example.around_the_best(jax.random.key(0), found[:4], steps[:4], 2),
        found[jnp.array([1, 0, 3, 2])],
    )


def test_a_duration_without_steps_is_refused(example):
    with pytest.raises(UserError, match=r"^--seconds 0: name a duration from 0\.03 to 60$"):
        example.main(["--seconds", "0"])


@pytest.mark.slow
@pytest.mark.skipif(default_backend() is None, reason="no back end for kernels")
def test_gradients_find_commands_near_the_best_known(example, capsys):
    arguments = ["--goals", "2", "--starts", "16", "--iterations", "80", "--seconds", "2"]
    assert example.main(arguments) == 0
    said = capsys.readouterr().out
    assert "reached: 2" in said
    worst = float(re.search(r"worst ([+-][\d.]+)%", said)[1])
    assert worst < 8
