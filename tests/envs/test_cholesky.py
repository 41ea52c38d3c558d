"""How XLA factorises MJX's matrices: as `physics.cholesky` says, without a trace elsewhere."""

import jax
import jax.numpy as jnp
import jax.scipy.linalg
import numpy as np
import pytest

from jetbot_mjx.config import parse_config
from jetbot_mjx.envs import mjx
from jetbot_mjx.envs.jetbot_env import make_env

CALLS = "potrf", "trsm", "stablehlo.cholesky", "stablehlo.triangular_solve"


def made(choice):
    return make_env(parse_config({"physics": {"cholesky": choice, "impl": "xla"}}))


@pytest.fixture(scope="module")
def steps():
    """A first state, and its lowered step with each choice."""
    envs = {choice: made(choice) for choice in ("unrolled", "library")}
    state = jax.jit(envs["library"].reset)(jax.random.PRNGKey(0)).pipeline_state
    lowered = {
        choice: jax.jit(env.physics.step).lower(state, jnp.zeros(2)) for choice, env in envs.items()
    }
    return state, lowered


@pytest.mark.parametrize(("choice", "calls"), [("unrolled", False), ("library", True)])
def test_the_choice_decides_whether_physics_calls_a_library(steps, choice, calls):
    text = steps[1][choice].as_text()
    assert any(call in text for call in CALLS) == calls


def test_both_choices_make_the_same_step(steps):
    first, lowered = steps
    states = []
    for choice in ("unrolled", "library"):
        step = lowered[choice].compile()
        states.append(first)
        for _ in range(5):
            states[-1] = step(states[-1], jnp.array([4.0, 9.0]))
    np.testing.assert_allclose(states[0].qvel, states[1].qvel, atol=2e-5)


def test_nothing_of_jax_is_replaced_while_physics_is_traced(monkeypatch):
    library = jax.scipy.linalg.cho_factor, jax.scipy.linalg.cho_solve
    seen, step = [], mjx.step

    def looking_round(*arguments):
        seen.append((jax.scipy.linalg.cho_factor, jax.scipy.linalg.cho_solve))
        return step(*arguments)

    monkeypatch.setattr(mjx, "step", looking_round)
    env = made("unrolled")
    state = jax.eval_shape(env.reset, jax.random.PRNGKey(0)).pipeline_state
    jax.eval_shape(env.physics.step, state, jnp.zeros(2))
    assert set(seen) == {library}
