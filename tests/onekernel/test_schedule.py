"""Where operations are placed: before loops that do not change them, in branches that use them."""

import numpy as np
import pytest

from onekernel.lower.scalar_ir import Expr
from onekernel.lower.schedule import (
    PlacedBranch,
    PlacedLoop,
    most_kept,
    recomputable,
    schedule,
)

ONE = np.float32(1)


@pytest.fixture
def flag(graph, x):
    return graph.apply("gt", x, ONE)


def loop_of(graph, first, body):
    """A loop of numbers below 9; `body` computes what the next trip begins with."""
    loop = graph.begin_loop(first)
    loop.updated = list(body(*loop.carries))
    loop.condition = graph.apply("lt", loop.carries[0], np.float32(9))
    loop.results = list(loop.carries)
    return graph.end_loop(loop)


def ops(block):
    """Names of what is done in a block, in order, without what lies deeper."""
    return [x.op if isinstance(x, Expr) else type(x).__name__ for x in block.items]


def inside(block, kind):
    """The only loop, or branch, directly in a block."""
    (item,) = (item for item in block.items if isinstance(item, kind))
    return item


def test_operands_come_before_what_takes_them_and_the_unused_does_not_come(graph, x):
    graph.apply("sqrt", x)
    square = graph.apply("mul", x, x)
    result = graph.apply("add", square, ONE)
    assert schedule([result, ONE]).items == [square, result]


def test_what_is_known_or_given_needs_nothing(graph, x):
    assert schedule([ONE, x]).items == []


def test_what_stays_the_same_in_a_loop_is_done_before_it(graph, x):
    def body(carry):
        return [graph.apply("add", carry, graph.apply("sqrt", graph.apply("neg", x)))]

    root = schedule(loop_of(graph, [x], body))
    assert ops(root) == ["neg", "sqrt", "PlacedLoop"]
    loop = inside(root, PlacedLoop)
    assert (ops(loop.head), ops(loop.body)) == (["lt"], ["add"])


def test_it_leaves_as_many_loops_as_it_does_not_depend_on(graph, x):
    def outer(a):
        def inner(b):
            constant, of_outer = graph.apply("sqrt", x), graph.apply("floor", a)
            return [graph.apply("add", graph.apply("mul", b, constant), of_outer)]

        return loop_of(graph, [a], inner)

    root = schedule(loop_of(graph, [x], outer))
    assert ops(root) == ["sqrt", "PlacedLoop"]
    loop = inside(root, PlacedLoop)
    assert ops(loop.body) == ["floor", "PlacedLoop"]
    assert ops(inside(loop.body, PlacedLoop).body) == ["mul", "add"]


def test_a_loop_that_stays_the_same_leaves_another(graph, x):
    def body(carry):
        (root,) = loop_of(graph, [x], lambda number: [graph.apply("sqrt", number)])
        return [graph.apply("add", carry, root)]

    root = schedule(loop_of(graph, [x], body))
    assert ops(root) == ["PlacedLoop", "PlacedLoop"]


def test_what_follows_a_loop_is_done_once(graph, x):
    (end,) = loop_of(graph, [x], lambda carry: [graph.apply("add", carry, ONE)])
    assert ops(schedule([graph.apply("sqrt", end)])) == ["PlacedLoop", "sqrt"]


def test_what_the_condition_and_the_trip_need_is_done_once_a_trip(graph, x):
    loop = graph.begin_loop([x])
    (carry,) = loop.carries
    root = graph.apply("sqrt", carry)
    loop.updated = [graph.apply("add", root, ONE)]
    loop.condition = graph.apply("gt", root, ONE)
    loop.results = [graph.apply("neg", root)]
    placed = inside(schedule(graph.end_loop(loop)), PlacedLoop)
    assert sorted(ops(placed.head)) == ["gt", "neg", "sqrt"]
    assert ops(placed.body) == ["add"]


def test_of_a_loop_only_what_is_needed_is_carried(graph, x):
    def body(count, total, unused):
        return [
            graph.apply("add", count, ONE),
            graph.apply("mul", total, count),
            graph.apply("sqrt", unused),
        ]

    _, total, _ = loop_of(graph, [x, ONE, x], body)
    root = schedule([total])
    loop = inside(root, PlacedLoop)
    assert loop.places == [0, 1]
    assert loop.results == [total]
    assert "sqrt" not in {value.op for value in root.values()}


def test_what_only_one_side_of_a_branch_needs_is_done_there(graph, x, flag):
    both = graph.apply("floor", x)
    no = graph.apply("sqrt", both)
    yes = graph.apply("neg", both)
    root = schedule(graph.branch(flag, [no], [yes]))
    assert sorted(ops(root)[:-1]) == ["floor", "gt"]
    branch = inside(root, PlacedBranch)
    assert (ops(branch.if_false), ops(branch.if_true)) == (["sqrt"], ["neg"])


def test_what_is_needed_after_a_branch_as_well_is_done_before_it(graph, x, flag):
    root_of_x = graph.apply("sqrt", x)
    (result,) = graph.branch(flag, [x], [graph.apply("neg", root_of_x)])
    root = schedule([result, root_of_x])
    assert sorted(ops(root)) == ["PlacedBranch", "gt", "sqrt"]
    assert ops(inside(root, PlacedBranch).if_true) == ["neg"]


def test_what_a_branch_decides_for_nobody_is_not_done(graph, x, flag):
    yes = [graph.apply("sqrt", x), graph.apply("neg", x)]
    first, _ = graph.branch(flag, [x, x], yes)
    branch = inside(schedule([first]), PlacedBranch)
    assert branch.results == [first]
    assert ops(branch.if_true) == ["sqrt"]


def test_branches_lie_in_branches(graph, x, flag):
    deeper = graph.branch(graph.apply("lt", x, -ONE), [x], [graph.apply("sqrt", x)])
    branch = inside(schedule(graph.branch(flag, [x], deeper)), PlacedBranch)
    assert ops(branch.if_true) == ["lt", "PlacedBranch"]
    assert ops(inside(branch.if_true, PlacedBranch).if_true) == ["sqrt"]


def test_what_a_branch_in_a_loop_needs_and_no_trip_changes_is_done_before_the_loop(graph, x):
    def body(carry):
        yes = graph.apply("mul", carry, graph.apply("sqrt", x))
        return graph.branch(graph.apply("gt", carry, ONE), [ONE], [yes])

    root = schedule(loop_of(graph, [x], body))
    assert ops(root) == ["sqrt", "PlacedLoop"]
    loop = inside(root, PlacedLoop)
    assert ops(loop.body) == ["gt", "PlacedBranch"]
    assert ops(inside(loop.body, PlacedBranch).if_true) == ["mul"]


def test_a_loop_that_only_one_side_needs_is_in_the_branch(graph, x, flag):
    (end,) = loop_of(graph, [graph.apply("neg", x)], lambda carry: [graph.apply("sqrt", carry)])
    root = schedule(graph.branch(flag, [x], [end]))
    assert ops(root) == ["gt", "PlacedBranch"]
    assert ops(inside(root, PlacedBranch).if_true) == ["neg", "PlacedLoop"]


def test_every_operand_of_a_large_program_is_there_before_it(graph, x):
    def body(a, b):
        (c,) = loop_of(graph, [graph.apply("mul", a, b)], lambda c: [graph.apply("add", c, b)])
        which = graph.apply("gt", c, b)
        (d,) = graph.branch(which, [graph.apply("sqrt", c)], [graph.apply("neg", a)])
        return [graph.apply("add", a, d), graph.apply("sub", d, x)]

    results = loop_of(graph, [x, ONE], body)
    known = {x.index}

    def check(numbers):
        assert all(not isinstance(number, Expr) or number.index in known for number in numbers)

    def visit(block):
        for item in block.items:
            if isinstance(item, Expr):
                check(item.operands)
                known.add(item.index)
            elif isinstance(item, PlacedLoop):
                check(item.loop.initial[place] for place in item.places)
                known.update(item.loop.carries[place].index for place in item.places)
                visit(item.head)
                check([item.loop.condition, *(item.loop.results[r.place] for r in item.results)])
                visit(item.body)
                check(item.loop.updated[place] for place in item.places)
            else:
                check([item.branch.condition])
                for side, numbers in (
                    (item.if_false, item.branch.if_false),
                    (item.if_true, item.branch.if_true),
                ):
                    visit(side)
                    check(numbers[result.place] for result in item.results)
            if not isinstance(item, Expr):
                known.update(result.index for result in item.results)

    visit(schedule(results))
    check(results)


def test_an_array_is_made_before_the_loop_that_reads_it(graph, x):
    array = graph.array([x, graph.apply("sqrt", x), ONE])
    loop = graph.begin_loop([x], 3, reverse=True)
    loop.updated = [graph.apply("add", loop.carries[0], graph.load(array, loop.counter))]
    loop.results = list(loop.carries)
    loop.stacked = [graph.apply("neg", loop.updated[0]), graph.apply("floor", loop.carries[0])]
    (end,) = graph.end_loop(loop)
    negative, _ = graph.stacks(loop)
    root = schedule([end, graph.load(negative, np.int32(1))])
    assert ops(root) == ["sqrt", "array", "PlacedLoop", "load"]
    placed = inside(root, PlacedLoop)
    # What nobody reads is not stored.
    assert (ops(placed.head), ops(placed.body)) == ([], ["load", "add", "neg"])
    assert placed.stacks == [negative]
    assert list(root.arrays()) == [[array], [negative]]


def test_what_a_loop_in_a_loop_stores_is_read_there(graph, x):
    outer = graph.begin_loop([x], 3)
    loop = graph.begin_loop([], 2)
    loop.stacked = [graph.apply("mul", outer.carries[0], graph.convert(loop.counter, x.dtype))]
    graph.end_loop(loop)
    (stack,) = graph.stacks(loop)
    outer.updated = [graph.load(stack, np.int32(1))]
    outer.results = list(outer.carries)
    placed = inside(schedule(graph.end_loop(outer)), PlacedLoop)
    assert ops(placed.body) == ["PlacedLoop", "load"]
    assert ops(inside(placed.body, PlacedLoop).body) == ["convert", "mul"]


def loop_with(graph, first, body):
    """The loop of numbers below 9 whose iteration adds what `body` computes."""
    ends = loop_of(graph, [first], lambda carry: [graph.apply("add", carry, body(carry))])
    return inside(schedule(ends), PlacedLoop)


def test_what_follows_from_other_values_of_a_loop_is_recomputable(graph, x):
    y, first = graph.input(np.float32), graph.input(np.float32)
    product = graph.apply("mul", x, y)

    def reads(*values):
        def body(carry):
            total = carry
            for value in values:
                total = graph.apply("mul", total, value)
            return total

        return recomputable(loop_with(graph, first, body))

    assert reads(product, x, y) == {product.index}
    # Instead of the product, another value would have to be kept.
    assert reads(product, x) == frozenset()
    assert reads(product) == frozenset()


def test_the_initial_value_of_a_loop_is_not_there_in_its_iterations(graph, x):
    product = graph.apply("mul", x, np.float32(3))
    loop = loop_with(graph, x, lambda carry: graph.apply("mul", carry, product))
    assert recomputable(loop) == frozenset()


def test_the_initial_value_of_a_loop_inside_is_there(graph, x):
    first = graph.input(np.float32)
    product = graph.apply("mul", x, np.float32(3))

    def body(carry):
        def inner(number):
            return [graph.apply("add", graph.apply("add", number, product), carry)]

        return loop_of(graph, [x], inner)[0]

    loop = loop_with(graph, first, body)
    assert recomputable(loop) == {product.index}
    assert recomputable(inside(loop.body, PlacedLoop)) == frozenset()


def test_what_a_branch_in_a_loop_needs_is_there(graph, x, flag):
    first = graph.input(np.float32)
    double = graph.apply("add", x, x)

    def body(carry):
        sides = [graph.apply("mul", carry, x)], [graph.apply("mul", carry, double)]
        return graph.branch(graph.apply("gt", carry, ONE), *sides)[0]

    assert recomputable(loop_with(graph, first, body)) == {double.index}


@pytest.mark.parametrize("op", ["sqrt", "floor"])
def test_what_costs_more_than_a_register_is_not_recomputable(graph, x, op):
    first, root = graph.input(np.float32), graph.apply(op, x)

    def body(carry):
        return graph.apply("mul", graph.apply("mul", carry, root), x)

    assert recomputable(loop_with(graph, first, body)) == frozenset()


def test_a_loop_keeps_what_it_carries_and_what_it_uses_from_before(graph, x):
    first = graph.input(np.float32)
    root, product = graph.apply("sqrt", x), graph.apply("mul", x, x)

    def body(carry):
        total = graph.apply("mul", graph.apply("mul", carry, root), product)
        return [graph.apply("add", total, x)]

    # It carries a number, and uses x, its root, and its square, which it can compute again.
    assert most_kept(schedule(loop_of(graph, [first], body))) == 3
    assert most_kept(schedule([root, product])) == 0
