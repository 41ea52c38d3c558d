"""Where operations are done: outside loops that do not matter, inside branches that need them."""

import jax
import jax.numpy as jnp
import pytest
from kernel_cases import LOOPS, VECTOR

from jetbot_mjx.config import parse_config
from jetbot_mjx.env import make_env
from jetbot_mjx.scalarize import scalarize
from jetbot_mjx.schedule import PlacedBranch, PlacedLoop


def controls(block, kind):
    """All loops or branches in a block, and inside them."""
    for item in block.items:
        if isinstance(item, PlacedLoop | PlacedBranch):
            if isinstance(item, kind):
                yield item
            for inner in item.blocks:
                yield from controls(inner, kind)


def loops(function):
    return list(controls(scalarize(function, VECTOR).block, PlacedLoop))


def ops(block):
    return [value.op for value in block.values()]


def test_what_no_trip_changes_is_done_once():
    def function(x):
        heavy = lambda y: y + jnp.sqrt(jnp.abs(x)).sum() * jnp.sin(x[0])  # noqa: E731
        return jax.lax.while_loop(lambda y: y[0] < 3.0, heavy, x)

    program = scalarize(function, VECTOR)
    (loop,) = controls(program.block, PlacedLoop)
    assert "sqrt" in ops(program.block)
    assert set(ops(loop.head) + ops(loop.body)) == {"lt", "add"}


def test_what_stays_as_it_begins_is_no_carry_and_stays_known():
    def function(x):
        def trip(state):
            y, factor, shift = state
            return y * factor + shift, factor, shift

        return jax.lax.while_loop(lambda s: s[0] < 3.0, trip, (x[0], jnp.float32(0), x[1]))[0]

    (loop,) = loops(function)
    assert len(loop.places) == 1
    # 0 · y is 0, which only a factor that is known can tell.
    assert ops(loop.body) == []


def test_what_follows_from_other_carries_is_computed_when_a_trip_begins():
    (loop,) = loops(LOOPS["what is prepared for the next trip"])
    # The four numbers themselves and the count, none of those prepared.
    assert len(loop.places) == 5
    # The condition needs none of the preparation: it is made after the test, if there is a trip.
    assert "floor" in ops(loop.body)
    assert "floor" not in ops(loop.head)


def test_what_only_one_side_needs_is_done_there():
    program = scalarize(LOOPS["a branch"], VECTOR)
    (branch,) = controls(program.block, PlacedBranch)
    assert ops(branch.no) == []
    assert "floor" in ops(branch.yes)
    outside = [item.op for item in program.block.items if not isinstance(item, PlacedBranch)]
    assert "floor" not in outside


def test_a_small_branch_is_a_choice():
    program = scalarize(lambda x: jax.lax.cond(x[0] > 0, lambda x: x, lambda x: -x, x), VECTOR)
    assert not list(controls(program.block, PlacedBranch))
    assert "select" in ops(program.block)


def test_a_result_that_nobody_takes_is_not_computed():
    def function(x):
        def trip(state):
            y, unused = state
            return y + 1.0, jnp.sqrt(unused) + y

        return jax.lax.while_loop(lambda s: s[0] < 3.0, trip, (x[0], x[1]))[0]

    (loop,) = loops(function)
    assert len(loop.places) == 1
    assert "sqrt" not in ops(loop.body)


@pytest.mark.parametrize("preset", ["isaac", "real"])
def test_the_solver_of_mjx_is_a_loop_whose_last_factor_is_not_computed(preset):
    env = make_env(parse_config({"robot": {"preset": preset}}))
    first = env.reset(jax.random.PRNGKey(0)).pipeline_state
    program = scalarize(lambda s, c: env.physics.substep(s, (c, [])), first, jnp.zeros(2))
    (solver,) = [item for item in program.block.items if isinstance(item, PlacedLoop)]
    (search,) = controls(solver.body, PlacedLoop)
    (evaluation,) = controls(search.body, PlacedBranch)
    # Acceleration, its product with the inertia, its distance from each constraint, two counts.
    assert len(solver.places) < 8 + 8 + 12 + 2
    # A Cholesky factor has a root for each of eight rows, and each trip one.
    assert ops(solver.body).count("sqrt") >= 8
    assert ops(solver.head).count("sqrt") == 1
    assert len(ops(evaluation.yes)) > 300
    assert ops(evaluation.no) == []
