"""The order of operations: operands first, few numbers that wait, and the same results."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from onekernel.lower import Block, Expr, PlacedBranch, PlacedLoop, evaluate, ordered, scalarize
from onekernel.lower.order import _inside, _Order
from onekernel.lower.scalar_ir import is_constant

PAIR = jax.ShapeDtypeStruct((2,), jnp.float32)
X = np.random.default_rng(0).normal(size=(2, 50)).astype(np.float32)


def rows(x, count=200):
    """An array that is complete before its first number is used."""
    return jnp.sum(jnp.square(x[0] * jnp.arange(2.0, count + 2) + x[1]))


def controlled(x):
    """A loop with a branch in it, whose results are needed on both sides of them."""

    def closer(carry):
        root, count = carry
        table = jnp.square(jnp.arange(2.0, 42) * root + x[0])
        far = jax.lax.cond(root > x[1], lambda: jnp.sum(table), lambda: jnp.prod(table / root))
        return root - 0.1 * far, count + jnp.sin(root)

    first = x[0] * x[1], x[1]
    root, count = jax.lax.while_loop(lambda carry: jnp.sin(carry[0]) > x[1], closer, first)
    return root * count


def indices(scalars):
    """The indices of what is no constant."""
    return {x.index for x in scalars if not is_constant(x)}


def most_waiting(items):
    """The largest number of values that are computed and still needed."""
    last = {index: i for i, item in enumerate(items) for index in indices(item.operands)}
    return max(
        sum(last.get(done.index, 0) > i for done in items[: i + 1]) for i in range(len(items))
    )


def check_operands(block, there):
    """Assert that each operand is computed before what takes it; return what is computed then."""
    there = set(there)
    for item in block.items:
        if isinstance(item, Expr):
            assert indices(item.operands) <= there, item.op
            there.add(item.index)
        elif isinstance(item, PlacedLoop):
            carries = indices(item.loop.carries)
            in_head = check_operands(item.head, there | carries)
            in_body = check_operands(item.body, in_head)
            updated = [item.loop.updated[place] for place in item.places]
            assert indices(updated) <= in_body
            assert indices([item.loop.condition]) <= in_head
            there |= indices(item.results)
        else:
            for side, scalars in (
                (item.if_true, item.branch.if_true),
                (item.if_false, item.branch.if_false),
            ):
                computed = check_operands(side, there)
                needed = [scalars[x.place] for x in item.results]
                assert indices(needed) <= computed
            there |= indices(item.results)
    return there


def blocks_in(block, kind):
    """The loops, or branches, of a block, at any depth."""
    for item in block.items:
        if isinstance(item, kind):
            yield item
        if not isinstance(item, Expr):
            for inner in item.blocks:
                yield from blocks_in(inner, kind)


def test_an_array_is_computed_number_by_number_where_it_is_used():
    program = scalarize(rows, PAIR)
    recorded = list(program.block.items)
    assert most_waiting(recorded) > 100
    assert most_waiting(ordered(program).block.items) < 8
    # The other back end writes the same program.
    assert program.block.items == recorded


def test_no_bit_of_a_result_depends_on_the_order():
    program = scalarize(rows, PAIR)
    (before,), (after,) = evaluate(program, list(X)), evaluate(ordered(program), list(X))
    np.testing.assert_array_equal(before, after)


def test_loops_and_branches_have_the_same_operations_each_behind_its_operands():
    program = scalarize(controlled, PAIR)
    found = ordered(program)
    recorded, changed = ([x.index for x in p.block.values()] for p in (program, found))
    assert changed != recorded
    assert sorted(changed) == sorted(recorded)
    assert any(blocks_in(found.block, PlacedBranch))
    there = check_operands(found.block, indices(program.inputs[0]))
    assert indices(program.outputs[0].ravel()) <= there


def test_the_steps_of_a_scan_keep_their_order_where_that_is_asked_for():
    def scanned(x):
        def step(c, _):
            c = jnp.stack([rows(c), rows(c[::-1])]) * 0.5
            return c, c

        return rows(jax.lax.scan(step, x, length=100)[1].sum(0))

    def bodies(program):
        return [[x.index for x in y.body.values()] for y in blocks_in(program.block, PlacedLoop)]

    program = scalarize(scanned, PAIR)
    found, kept = ordered(program), ordered(program, scans=False)
    assert len(bodies(program)) == 1
    assert bodies(kept) == bodies(program) != bodies(found)
    outside = [[x.index for x in p.block.items if isinstance(x, Expr)] for p in (program, kept)]
    assert outside[0] != outside[1]


def test_what_takes_the_result_of_a_loop_waits_for_the_loop():
    def after_loop(x):
        total = x[0] + x[1]
        # Its last use sets a register free, so the product would come before the loop.
        return jax.lax.while_loop(lambda y: y > 0, lambda y: y - jnp.sin(y), x[0] * x[1]) * total

    program = scalarize(after_loop, PAIR)
    found = _Order(program.block.items, indices(program.outputs[0].ravel())).find()
    check_operands(Block(items=found), indices(program.inputs[0]))


def test_the_head_of_a_loop_leaves_its_condition_and_what_the_body_takes():
    (loop,) = blocks_in(scalarize(controlled, PAIR).block, PlacedLoop)
    head = indices(loop.head.values())
    body = {index for x in loop.body.values() for index in indices(x.operands)} & head
    (_, after), _ = _inside(loop)
    assert body
    assert indices(after) & head == body | indices([loop.loop.condition])


def test_a_block_keeps_its_order_where_the_other_one_spills_more(monkeypatch):
    program = scalarize(rows, PAIR)
    good = ordered(program)
    monkeypatch.setattr(_Order, "find", lambda self: list(program.block.items))
    assert ordered(good).block.items == good.block.items
    assert ordered(program).block.items == program.block.items


@pytest.mark.parametrize(("count", "spills"), [(31, 1), (40, 19)])
def test_what_does_not_fit_into_the_registers_is_stored_and_loaded(count, spills):
    # One load of the argument. Products beyond the 31st take the places of the first eight, and the
    # sum that of one more: nine are stored and loaded.
    program = scalarize(lambda x: jnp.sum(x[0] * jnp.arange(2.0, count + 2)), PAIR)
    order = _Order(program.block.items, indices(program.outputs[0].ravel()))
    assert order.count_spills(program.block.items) == spills


def test_a_number_that_everything_uses_takes_no_quadratic_time(monkeypatch):
    pushed = 0
    push = _Order._push

    def counting(self, places):
        nonlocal pushed
        places = list(places)
        pushed += len(places)
        push(self, places)

    monkeypatch.setattr(_Order, "_push", counting)
    program = scalarize(lambda x: rows(x, 1000), PAIR)
    ordered(program)
    assert pushed < 10 * program.size
