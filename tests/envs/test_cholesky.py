"""How XLA factorises MJX's matrices: as `physics.cholesky` says, without a trace elsewhere."""

import jax
import jax.numpy as jnp
import jax.scipy.linalg
import numpy as np
import pytest

from helpers.small_physics import small_physics
from jetbot_mjx.config import parse_config
from jetbot_mjx.envs import mjx
from jetbot_mjx.envs.build import make_env

CALLS = "potrf", "trsm", "stablehlo.cholesky", "stablehlo.triangular_solve"
ROBOTS, STEPS = 24, 16


@pytest.mark.parametrize(("choice", "calls"), [("unrolled", False), ("library", True)])
def test_the_choice_decides_whether_physics_calls_a_library(choice, calls):
    physics, state = small_physics(cholesky=choice, impl="xla")
    text = jax.jit(physics.step).lower(state, jnp.zeros(1)).as_text()
    assert any(call in text for call in CALLS) == calls


# The quick tests compare both on a chain of hinges, in `onekernel/test_linear_algebra.py`.
@pytest.mark.slow
def test_both_choices_and_a_kernel_make_the_same_steps(world_env):
    settings = [{"cholesky": choice, "impl": "xla"} for choice in ("unrolled", "library")]
    envs = [*(make_env(parse_config({"physics": one})) for one in settings), world_env]
    keys = jax.random.split(jax.random.PRNGKey(0), ROBOTS)
    first = jax.jit(jax.vmap(world_env.reset))(keys).pipeline_state
    targets = np.random.default_rng(0).uniform(-12, 31, (STEPS, ROBOTS, 2)).astype(np.float32)
    ends = []
    for env in envs:
        step, states = jax.jit(jax.vmap(env.physics.step)), first
        for target in targets:
            states = step(states, target)
        ends.append(states)
    for other in ends[1:]:
        np.testing.assert_allclose(other.qvel, ends[0].qvel, atol=2e-5)
    assert np.ptp(np.asarray(ends[0].qvel[:, 0])) > 0.05


def test_nothing_of_jax_is_replaced_while_physics_is_traced(monkeypatch):
    library = jax.scipy.linalg.cho_factor, jax.scipy.linalg.cho_solve
    seen, step = [], mjx.step

    def looking_round(*arguments):
        seen.append((jax.scipy.linalg.cho_factor, jax.scipy.linalg.cho_solve))
        return step(*arguments)

    monkeypatch.setattr(mjx, "step", looking_round)
    physics, state = small_physics(cholesky="unrolled", impl="xla")
    jax.eval_shape(physics.step, state, jnp.zeros(1))
    assert set(seen) == {library}
