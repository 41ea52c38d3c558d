"""Functions lowered to scalars compute what JAX computes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import Mesh, PartitionSpec

from helpers.run_program import evaluate
from jetbot_mjx.config import parse_config
from jetbot_mjx.envs import mjx
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.state import PhysicsState
from onekernel.aot import xla_options
from onekernel.errors import UnsupportedError
from onekernel.lower import control_flow, jaxpr, scalar_ir
from onekernel.lower.control_flow import MAX_UNROLLED_OPERATIONS, MIN_BRANCH_OPERATIONS
from onekernel.lower.scalar_ir import Expr
from onekernel.lower.schedule import PlacedBranch, PlacedLoop

MATRIX = jax.ShapeDtypeStruct((3, 4), jnp.float32)
VECTOR = jax.ShapeDtypeStruct((4,), jnp.float32)


def in_full_precision(function, x):
    """What JAX makes of it for every robot, without a GPU's TF32."""
    # Without these, XLA writes an operand out again for every use of it: in `large`, without end.
    emitters = ("xla_cpu_use_fusion_emitters", True)
    options = dict([emitters]) if xla_options._is_known(*emitters) else {}
    with jax.default_matmul_precision("highest"):
        return jax.jit(jax.vmap(function), compiler_options=options)(x)


INDICES = jnp.array([[2, 1], [0, 3], [2, 9]])


def newton(x):
    def closer(carry):
        root, i = carry
        return 0.5 * (root + jnp.abs(x) / root), i + 1

    def goes_on(carry):
        root, i = carry
        return (i < 5) & (jnp.abs(root * root - jnp.abs(x)).sum() > 1e-3)

    return jax.lax.while_loop(goes_on, closer, (jnp.ones_like(x), 0))[0]


def branch(x):
    return jax.lax.cond(x[0, 0] > 0, lambda x: x * 2, lambda x: x - 1, x)


def switched(x):
    branches = [lambda x: x * 2, lambda x: jnp.sin(x), lambda x: x - 1, jnp.cos]
    return jax.lax.switch((x[0, 0] * 3).astype(int), branches, x)


def branch_for_each_row(x):
    return jax.vmap(lambda row: jax.lax.cond(row[0] > 0, lambda r: r * 2, lambda r: r - 1, row))(x)


def switch_for_each_row(x):
    branches = [lambda r: r * 2, lambda r: r - 1, lambda r: r[::-1]]
    return jax.vmap(lambda r: jax.lax.switch((r[0] * 2).astype(int), branches, r))(x)


def loop_for_each_row(x):
    def halved(row):
        return jax.lax.while_loop(lambda s: jnp.abs(s[0]).max() > 0.3, halve, (row, 0))

    def halve(state):
        return state[0] / 2, state[1] + 1

    return jax.vmap(halved)(x)


def loop_that_counts(x):
    def body(state):
        i, total, is_even = state
        return i - 1, jnp.where(is_even, total + x[0], total * 0.5), ~is_even

    first = (x[0, 0] * 4).astype(int), jnp.ones(4), x[1, 1] > 0
    return jax.lax.while_loop(lambda s: s[0] > 0, body, first)


def loop_in_loop(x):
    last = (jnp.abs(x).sum() / 2).astype(int)

    def outer(state):
        i, total = state
        inner = jax.lax.while_loop(
            lambda s: (s[0] < i) & (s[1] < 30),
            lambda s: (s[0] + 1, s[1] * 2),
            (0, 1 + x[0, 0] ** 2),
        )
        return i + 1, total + inner[1]

    return jax.lax.while_loop(lambda state: state[0] < last, outer, (0, 0.0))


def running(x):
    def body(carry, row):
        return carry + row, carry * row

    return jax.lax.scan(body, jnp.zeros(4), x), jax.lax.scan(body, jnp.ones(4), x, reverse=True)


def sum_of_softplus(x):
    # With a derivative of its own, and zeros where that has none.
    return jax.nn.softplus(x[0]).sum() + jax.nn.log_sigmoid(x[1]).sum() + jnp.logaddexp(x[2], 1)[0]


def discounted(x):
    return jax.lax.scan(lambda total, row: (0.5 * total + row[0] * row[1], None), x[0, 0], x)[0]


DERIVED = {
    "an argument that is used twice": lambda x: (x * x + 3 * x * x[::-1]).sum(),
    "derivatives of their own": sum_of_softplus,
    "activations": lambda x: (jax.nn.relu(x) + jax.nn.elu(x) + jax.nn.swish(x) + jnp.tanh(x)).sum(),
    "extremes": lambda x: jnp.minimum(jnp.clip(x, -0.5, 0.5) * 2, x).sum() + x.max(1).sum(),
    "powers": lambda x: (1 / x + x**-2 + (1 + x * x) ** 0.5 + jnp.square(x)).sum(),
    "logarithms": lambda x: (jnp.log(jnp.abs(x)) + jnp.log1p(x * x) + jnp.expm1(x)).sum(),
    "parts": lambda x: (jnp.concatenate([x[1:], x[:1] * 2]) * jnp.split(x, 2, 1)[0].sum()).sum(),
    "products": lambda x: jnp.linalg.norm(x @ x.T) + jnp.cumsum(x, 1)[:, 2].sum(),
    "places": lambda x: (x[INDICES[:2, 0], INDICES[:2, 1]] ** 2).sum(),
    "what is not derived": lambda x: jnp.where(x > 0, x * jax.lax.stop_gradient(x), 1).sum(),
    "a loop over rows": discounted,
}
"""Functions whose derivatives are lowered."""

FUNCTIONS = {
    **{f"derivative: {name}": jax.value_and_grad(function) for name, function in DERIVED.items()},
    "products": lambda x: (x @ x.T, jnp.einsum("ij,ij->i", x, x), jnp.linalg.norm(x, axis=1)),
    "batched product": lambda x: jnp.einsum("bi,bj->bij", x, x) @ jnp.ones((3, 4, 2)),
    "reductions": lambda x: (x.sum(0), x.max(), x.min(1), (x > 0).all(0), (x > 2).any()),
    "running sums": lambda x: (jnp.cumsum(x, 1), jnp.cumsum(x, 0, dtype=jnp.float32)),
    "running sums backwards": lambda x: jax.lax.cumsum(x, 1, reverse=True),
    "places": lambda x: (jnp.argmin(x, 1), jnp.argmax(x[:, 0])),
    "gather": lambda x: x[INDICES[:, 0], :2],
    "gather beyond the end": lambda x: x.at[INDICES[:, 0], INDICES[:, 1]].get(mode="clip"),
    "gather that fills": lambda x: x.at[:, INDICES[:, 1]].get(mode="fill", fill_value=7),
    "batched gather": lambda x: jax.vmap(lambda row, i: row[i])(x, jnp.array([3, 0, 1])),
    "scatter": lambda x: x.at[INDICES[:2, 0], INDICES[:2, 1]].set(0.5),
    "scatter that drops": lambda x: x.at[INDICES[:, 0], INDICES[:, 1]].add(x[:, 0], mode="drop"),
    "scatter that multiplies": lambda x: x.at[jnp.array([0, 2]), 1:3].multiply(3.0),
    "moves": lambda x: (
        x.T[::-1, 1:],
        jnp.pad(x, ((1, 0), (0, 2))),
        jnp.tile(x, (2, 1)),
        x.ravel(),
    ),
    "joins": lambda x: (jnp.concatenate([x, x], 1), jnp.stack([x, x], 1), jnp.split(x, 2, 1)),
    "sorted constants": lambda x: x[:, jnp.argsort(jnp.array([3, 1, 2, 0]))],
    "places of constants": lambda x: x[:, jnp.nonzero(jnp.array([0, 1, 0, 1]), size=2)[0]],
    "selection": lambda x: (jnp.where(x > 0, x, -x), jnp.clip(x, -0.5, 0.5), jnp.sign(x)),
    "a place that depends": lambda x: jax.lax.dynamic_slice(
        x, (jnp.argmax(x[:, 0]), jnp.int32(1)), (1, 2)
    ),
    "powers": lambda x: (
        x**3,
        x**-2,
        jax.lax.integer_pow(x, 0),
        jnp.square(x),
        jax.lax.rsqrt(x * x),
        x**2.0,
        jnp.abs(x) ** 1.5,
    ),
    "angles": lambda x: (jnp.sin(9 * x), jnp.cos(9 * x), jnp.arctan2(x, x[::-1]), jnp.floor(x)),
    "whole numbers": lambda x: ((x > 0).astype(jnp.int32) * 3 + 1, (x * 3).astype(jnp.int32)),
    "a loop that ends early": newton,
    "a branch": branch,
    "one of four branches": switched,
    "a branch for each row": branch_for_each_row,
    "one of three branches for each row": switch_for_each_row,
    "a loop for each row": loop_for_each_row,
    "a loop that counts down": loop_that_counts,
    "a loop in a loop": loop_in_loop,
    "a choice of three": lambda x: jax.lax.select_n(
        jnp.clip((x * 2).astype(int), 0, 2), x, -x, jnp.ones_like(x)
    ),
    "a gather that is promised": lambda x: x.at[INDICES[:, 0], INDICES[:, 1]].get(
        mode="promise_in_bounds"
    ),
    "loops over rows": running,
    "constants": lambda x: x + jnp.arange(4) * jax.lax.iota(jnp.float32, 3)[:, None],
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_program_does_what_the_function_does(name):
    function = FUNCTIONS[name]
    x = np.float32(np.random.default_rng(3).normal(size=(20, *MATRIX.shape)))
    program = jaxpr.scalarize(function, MATRIX)
    ours = evaluate(program, [x])
    theirs = jax.tree.leaves(in_full_precision(function, x))
    for one, other in zip(ours, theirs, strict=True):
        assert one.shape == other.shape
        np.testing.assert_allclose(one, other, rtol=2e-5, atol=2e-6)


def test_an_operation_that_jax_expands_is_lowered_as_its_expansion():
    hijax = pytest.importorskip("jax.experimental.hijax")
    if not hasattr(hijax, "HiPrim"):
        pytest.skip("JAX 0.12 and later let a user define such operations")

    class TwiceAndCounted(hijax.HiPrim):
        def __init__(self, like):
            self.in_avals, self.out_aval, self.params = (like,), (like, like), {}
            super().__init__()

        def expand(self, x):
            return x + x, jnp.ones_like(x).at[jnp.nonzero(np.ones(4), size=4)].add(1)

    def function(x):
        def body(carry, _):
            twice, two = TwiceAndCounted(jax.typeof(carry))(carry)
            return twice * two, None

        return jax.lax.scan(body, x, length=3)[0]

    x = np.float32(np.random.default_rng(3).normal(size=(20, *VECTOR.shape)))
    (ours,) = evaluate(jaxpr.scalarize(function, VECTOR), [x])
    np.testing.assert_array_equal(ours, x * 4**3)


@pytest.mark.parametrize("check_vma", [True, False])
def test_a_function_is_lowered_in_a_program_for_several_devices_too(check_vma):
    def function(x):
        return jnp.concatenate([jnp.hypot(x, x[::-1]), jnp.zeros(2)])

    programs = []

    def outer(x):
        programs.append(jaxpr.scalarize(function, VECTOR))
        # What is lowered there may also have been traced with the values of the devices.
        closed = jax.make_jaxpr(function)(x[0])
        programs.append(jaxpr.scalarize_part(closed, closed.jaxpr.invars, closed.jaxpr.outvars))
        return x

    mesh = Mesh(np.array(jax.devices()[:1]), ("devices",))
    specs = {"in_specs": PartitionSpec("devices"), "out_specs": PartitionSpec("devices")}
    jax.make_jaxpr(jax.shard_map(outer, mesh=mesh, check_vma=check_vma, **specs))(jnp.ones((2, 4)))
    x = np.float32(np.random.default_rng(3).normal(size=(20, *VECTOR.shape)))
    for program in programs:
        (ours,) = evaluate(program, [x])
        np.testing.assert_allclose(ours, in_full_precision(function, x), rtol=1e-6)


def test_a_product_of_two_dtypes_is_one_of_the_results():
    # As in the frame of a contact that has friction.
    program = jaxpr.scalarize(lambda x: jnp.dot(x, jnp.where(x[0] > 0, 1, 0)), MATRIX)
    x = np.float32(np.random.default_rng(3).normal(size=MATRIX.shape))
    np.testing.assert_allclose(evaluate(program, [x])[0], x @ (x[0] > 0), rtol=1e-6)
    for value in program.block.values():
        if value.op == "mul":
            assert {x.dtype for x in value.operands} == {value.dtype}


@pytest.mark.parametrize(
    ("function", "reason"),
    [
        (lambda x: x.astype(jnp.float16) * 2, "float16"),
        (jax.lax.lgamma, "lgamma"),
        (lambda x: x.view(jnp.float16), "the bits of float32 as float16"),
    ],
)
def test_what_cannot_be_written_so_is_named(function, reason):
    with pytest.raises(UnsupportedError, match=reason):
        jaxpr.scalarize(function, MATRIX)


def test_of_a_function_only_a_part_is_computed():
    closed = jax.make_jaxpr(lambda x, y: (jnp.sqrt(x * y) + y, jnp.sin(y)))(1.0, 2.0)
    x, y = closed.jaxpr.invars
    (root,) = (one.outvars[0] for one in closed.jaxpr.eqns if one.primitive.name == "sqrt")
    before = jaxpr.scalarize_part(closed, [x, y], [root, y])
    assert sorted(value.op for value in before.block.values()) == ["mul", "sqrt"]
    after = jaxpr.scalarize_part(closed, [root, y], closed.jaxpr.outvars[:1])
    assert [value.op for value in after.block.values()] == ["add"]
    half = evaluate(before, [np.float32([8, 2]), np.float32([2, 0.5])])
    np.testing.assert_array_equal(evaluate(after, half)[0], [6, 1.5])


def test_what_is_no_float_is_passed_by_its_bits():
    def function(x, count, word, flag):
        return jnp.where(flag, x, -x), count - 1, word + 1, ~flag, jnp.int32(-3), True

    given = [np.float32([2, np.inf]), np.int32([-7, 2**31 - 1]), np.uint32([2**32 - 1, 2**31])]
    flags = np.array([True, False])
    closed = jax.make_jaxpr(function)(*(x[0] for x in (*given, flags)))
    program = jaxpr.scalarize_part(closed, closed.jaxpr.invars, closed.jaxpr.outvars, words=True)
    assert all(x.dtype == np.float32 for array in program.inputs for x in array.ravel())
    words = [*(x.view(np.float32) for x in given), np.float32(flags)]
    results = evaluate(program, words)
    assert all(x.dtype == np.float32 for x in results)
    np.testing.assert_array_equal(results[0], [2, -np.inf])
    np.testing.assert_array_equal(results[1].view(np.int32), [-8, 2**31 - 2])
    np.testing.assert_array_equal(results[2].view(np.uint32), [0, 2**31 + 1])
    np.testing.assert_array_equal(results[3], [0, 1])
    np.testing.assert_array_equal(results[4].view(np.int32), [-3, -3])
    np.testing.assert_array_equal(results[5], [1, 1])


def items(block, kind):
    """All loops, or branches, of a block and of those inside it."""
    for item in block.items:
        if isinstance(item, kind):
            yield item
        if not isinstance(item, Expr):
            for inner in item.blocks:
                yield from items(inner, kind)


def check(function, robots=50, shape=VECTOR):
    """A program of a function of one vector, which does what the function does for all robots."""
    program = jaxpr.scalarize(function, shape)
    x = np.float32(np.random.default_rng(7).normal(size=(robots, *shape.shape)))
    ours = evaluate(program, [x])
    theirs = jax.tree.leaves(in_full_precision(function, x))
    for one, other in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(one, other, rtol=2e-5, atol=2e-6)
    return program


def steps(x):
    """How many trips a robot's loop makes: 0 to 5."""
    return jnp.clip((4 * jnp.abs(x[0])).astype(int), 0, 6) - 1


def repeated(body, x, *first):
    """A loop of as many trips as `steps` says."""

    def trip(state):
        return (state[0] + 1, *body(*state[1:]))

    return jax.lax.while_loop(lambda state: state[0] < steps(x), trip, (0, *first))[1:]


def test_a_loop_stays_one_and_some_robots_make_no_trip():
    program = check(lambda x: repeated(lambda y: (y * 1.5 - x,), x, x))
    (loop,) = items(program.block, PlacedLoop)
    assert len(loop.places) == 1 + 4


def test_what_a_loop_carries_and_never_changes_stays_known():
    def function(x):
        def body(y, held, matrix, flag):
            return jnp.where(flag, matrix @ y + held, y), held, matrix, flag

        return repeated(body, x, x, x * 2, 2 * jnp.eye(4), True)

    program = check(function)
    (loop,) = items(program.block, PlacedLoop)
    assert len(loop.places) == 1 + 4
    # Of the product only what the diagonal has is left.
    assert [value.op for value in loop.body.values()].count("mul") == 4


def test_what_changes_only_because_something_else_does_is_carried():
    # The second is found to change one round after the first, the third two rounds.
    program = check(lambda x: repeated(lambda a, b, c: (a + 1, a * 2, b), x, 1.0, 2.0, 2.0))
    (loop,) = items(program.block, PlacedLoop)
    assert len(loop.places) == 4


def test_what_a_solver_prepares_for_its_next_trip_is_computed_when_that_begins():
    def prepared(y):
        return jnp.sqrt(y * y + 1), jnp.sin(y)

    def function(x):
        def body(y, root, sine):
            y = 0.7 * y - 0.1 * root * sine
            return y, *prepared(y)

        return repeated(body, x, x, *prepared(x))

    program = check(function)
    (loop,) = items(program.block, PlacedLoop)
    # The counter and y; the other eight numbers follow from y.
    assert len(loop.places) == 1 + 4
    roots = [value for value in program.block.values() if value.op == "sqrt"]
    assert len(roots) == 4


def test_what_follows_through_another_number_that_follows_is_not_carried_either():
    def function(x):
        def body(y, root, both):
            y = y / 2 + both
            return y, jnp.sqrt(jnp.abs(y)), jnp.sqrt(jnp.abs(y)) * 0.25 + x

        return repeated(body, x, x, jnp.sqrt(jnp.abs(x)), jnp.sqrt(jnp.abs(x)) * 0.25 + x)

    (loop,) = items(check(function).block, PlacedLoop)
    assert len(loop.places) == 1 + 4


def test_what_only_looks_as_if_it_followed_is_carried():
    def function(x):
        def body(y, root):
            # At first the root is of y, later of what y was a trip before.
            return y * 0.5 + 1, jnp.sqrt(jnp.abs(y))

        return repeated(body, x, x, jnp.sqrt(jnp.abs(x)))

    (loop,) = items(check(function).block, PlacedLoop)
    assert len(loop.places) == 1 + 4 + 4


def test_numbers_that_change_places_are_all_carried():
    program = check(lambda x: repeated(lambda a, b: (b, a + b * 0.25), x, x, x[::-1]))
    (loop,) = items(program.block, PlacedLoop)
    assert len(loop.places) == 1 + 8


def test_loops_of_whole_numbers_and_truths():
    def function(x):
        def body(number, truth, y):
            return number * 2 - 1, ~truth, jnp.where(truth, y, -y) + number.astype(jnp.float32)

        return repeated(body, x, (x * 3).astype(int), x > 0, x)

    program = check(function)
    (loop,) = items(program.block, PlacedLoop)
    assert {loop.loop.carries[place].dtype.kind for place in loop.places} == set("fib")


def test_a_loop_in_a_loop_begins_again_in_each_trip():
    def function(x):
        def body(y):
            (inner,) = repeated(lambda z: (z * 0.5 + y,), x[1:] + y[0], y)
            return (y * 0.25 + inner,)

        return repeated(body, x, x)

    program = check(function)
    outer, inner = items(program.block, PlacedLoop)
    assert inner in outer.body.items


@pytest.mark.parametrize(("length", "loops"), [(3, 0), (200, 1)])
def test_a_loop_of_known_length_is_written_out_only_if_it_is_small(length, loops):
    def function(x):
        return jax.lax.fori_loop(0, length, lambda i, y: jnp.sqrt(jnp.abs(y + i)), x)

    program = check(function)
    assert len(list(items(program.block, PlacedLoop))) == loops
    assert program.size < MAX_UNROLLED_OPERATIONS


@pytest.mark.parametrize(("rest", "ends_early"), [(0.0, True), (1.0, False)])
def test_a_scan_that_keeps_what_is_finished_ends_early(rest, ends_early):
    def function(x):
        def iterate(y):
            return jnp.cos(y), jnp.abs(jnp.cos(y) - y).max() > 1e-3

        def body(carry, _):
            y, goes_on = carry
            return jax.lax.cond(goes_on, iterate, lambda y: (y + rest, False), y), None

        return jax.lax.scan(body, (x, True), length=100)[0]

    (loop,) = items(check(function).block, PlacedLoop)
    # Only while nothing changes any more is the flag part of the condition.
    assert loop.loop.condition.op == ("and" if ends_early else "lt")


def test_a_loop_with_a_flag_that_is_known_at_first_stays_one():
    def function(x):
        def body(state):
            y, i, _ = state
            return jnp.cos(y), i + 1, jnp.abs(jnp.cos(y) - y).max() < 0.3

        return jax.lax.while_loop(lambda s: (s[1] < 60) & ~s[2], body, (x, 0, False))

    program = check(function)
    assert len(list(items(program.block, PlacedLoop))) == 1
    assert program.size < MAX_UNROLLED_OPERATIONS


def test_a_loop_stays_one_although_an_index_counts_its_trips():
    def function(x):
        return jax.lax.fori_loop(0, 100, lambda i, y: y.at[i % 4].add(jnp.sin(x[0])), x)

    assert len(list(items(check(function).block, PlacedLoop))) == 1


def large(x):
    for _ in range(MIN_BRANCH_OPERATIONS):
        x = jnp.abs(0.9 * x - 0.5)
    return x


def test_a_large_branch_stays_one_and_a_small_one_becomes_a_choice():
    program = check(lambda x: jax.lax.cond(x[0] > 0, large, lambda x: x, x))
    (branch,) = items(program.block, PlacedBranch)
    assert list(branch.if_false.values()) == []
    assert len(list(branch.if_true.values())) > MIN_BRANCH_OPERATIONS
    program = check(lambda x: jax.lax.cond(x[0] > 0, lambda x: x + 1, lambda x: x, x))
    assert list(items(program.block, PlacedBranch)) == []


def test_of_many_cases_each_is_a_side_of_its_own():
    def function(x):
        cases = [large, lambda x: large(x + 1), lambda x: x, lambda x: large(x - 1)]
        return jax.lax.switch((x[0] * 3).astype(int), cases, x)

    program = check(function)
    branches = list(items(program.block, PlacedBranch))
    assert len(branches) == 3
    # One inside the other: none is asked for once an earlier one was.
    assert branches[1] in branches[0].if_true.items
    assert branches[2] in branches[1].if_true.items


def test_a_loop_is_skipped_by_robots_that_do_not_need_it():
    # The loop would never end for a number below zero; a branch around it skips those robots.
    def doubled(x):
        doubling = jax.lax.while_loop(lambda y: (y < 100).all(), lambda y: 2 * y, x)
        return jax.lax.cond(x[1] > 2, large, lambda x: x, doubling)

    program = jaxpr.scalarize(
        lambda x: jax.lax.cond(x[0] > 0, doubled, lambda x: x, x), jax.ShapeDtypeStruct((2,), "f4")
    )
    (loop,) = items(program.block, PlacedLoop)
    (outer, _) = items(program.block, PlacedBranch)
    assert loop in outer.if_true.items
    x = np.float32([[1, 2], [0, 3], [-1, -1], [3, 0.5]])
    np.testing.assert_array_equal(
        evaluate(program, [x])[0], [[64, 128], [0, 3], [-1, -1], [192, 32]]
    )


def test_a_robot_that_is_done_does_not_enter_an_inner_loop():
    # The inner loop would never end for y = 0; a robot that reaches 0 has left the outer loop.
    def body(y):
        return y - (jax.lax.while_loop(lambda z: z < 8, lambda z: z + y, 0.0) >= 8)

    def function(x):
        return jax.lax.while_loop(lambda y: y > 0, body, x[0])

    program = jaxpr.scalarize(function, VECTOR)
    x = np.float32([[3, 0, 0, 0], [1, 0, 0, 0], [0, 0, 0, 0], [2, 0, 0, 0]])
    np.testing.assert_array_equal(evaluate(program, [x])[0], 0)


def sums(length, **options):
    """A scan whose steps are given and return a number each."""

    def function(x):
        given = x[0] * jnp.arange(length) + x[1]
        return jax.lax.scan(lambda c, a: (c * 0.5 + a, c), x[2], given, **options)[1]

    return function


@pytest.mark.parametrize("reverse", [False, True])
@pytest.mark.parametrize(("length", "loops"), [(64, 0), (65, 1), (2000, 1)])
def test_a_scan_with_rows_stays_a_loop_if_it_is_long(length, loops, reverse):
    program = check(sums(length, reverse=reverse), robots=3)
    found = list(items(program.block, PlacedLoop))
    assert len(found) == loops
    for loop in found:
        assert [x.op for x in loop.body.items] == ["load", "mul", "add"]
        assert program.array_bytes == 2 * 4 * length


def test_a_short_scan_stays_a_loop_if_it_is_large(monkeypatch):
    monkeypatch.setattr(control_flow, "MAX_UNROLLED_SCAN_OPERATIONS", 40)
    assert not list(items(check(sums(10), robots=3).block, PlacedLoop))
    assert len(list(items(check(sums(40), robots=3).block, PlacedLoop))) == 1


def test_of_a_loop_that_writes_among_too_many_places_these_are_told():
    def function(x):
        trips = x[0].astype(int)
        return jax.lax.fori_loop(0, trips, lambda i, table: table.at[i].set(x[1]), jnp.zeros(300))

    with pytest.raises(UnsupportedError, match=r"with 300 places \("):
        jaxpr.scalarize(function, VECTOR)


def test_where_an_array_is_put_changes_nothing():
    assert check(lambda x: jax.device_put(x * 2), robots=3).size == 4


def test_what_every_step_is_given_alike_or_knows_takes_no_memory():
    def function(x):
        def step(c, row):
            i, alike, known = row
            return c * 0.5 + alike + known, (x[1], i * 2.0, jnp.float32(3))

        rows = jnp.arange(100), jnp.broadcast_to(x[0], 100), jnp.sin(jnp.arange(100.0))
        return jax.lax.scan(step, x[2], rows)

    program = check(function)
    # The index of a step is its number; of the sines there is one table for all robots. Only what
    # the steps return and what differs from step to step is stored.
    (loop,) = items(program.block, PlacedLoop)
    assert len(loop.stacks) == 1
    assert program.array_bytes == 400
    assert [x.op for x in program.block.items if isinstance(x, Expr)].count("array") == 1


def test_what_one_scan_returns_is_where_the_next_one_reads_it():
    def function(x):
        rows = sums(300)(x)
        return jax.lax.scan(lambda c, a: (c * 0.5 + a, None), x[3], rows, reverse=True)[0]

    program = check(function)
    assert [len(x) for x in program.block.arrays() if x[0].op == "stack"] == [1]
    assert program.array_bytes == 2 * 4 * 300


def test_what_nobody_needs_of_a_scan_is_not_stored():
    def function(x):
        given = x[0] * jnp.arange(100)
        return jax.lax.scan(lambda c, a: (c * 0.5 + a, (c, jnp.sin(a))), x[2], given)[1][0]

    program = check(function)
    (loop,) = items(program.block, PlacedLoop)
    assert len(loop.stacks) == 1
    assert [x.op for x in loop.body.items] == ["load", "mul", "add"]


def writes(x):
    """A scan whose steps write, in a loop, to one of 300 places."""

    def step(table, i):
        return table.at[i * 4].add(x[1]), None

    return jax.lax.scan(step, x[0] * jnp.arange(300.0), jnp.arange(70))[0]


def test_a_scan_that_no_loop_can_do_is_written_out():
    program = check(writes)
    assert not list(items(program.block, PlacedLoop))


def test_arrays_that_take_too_much_memory_are_refused(monkeypatch):
    monkeypatch.setattr(control_flow, "MAX_ARRAY_BYTES", 79_999)
    reason = r"^arrays of 80,000 bytes for each instance, more than 79,999$"
    with pytest.raises(UnsupportedError, match=reason):
        jaxpr.scalarize(sums(10_000), VECTOR)
    monkeypatch.setattr(control_flow, "MAX_ARRAY_BYTES", 80_000)
    jaxpr.scalarize(sums(10_000), VECTOR)


def test_of_a_scan_that_can_be_neither_loop_nor_written_out_the_loops_reason_is_told(monkeypatch):
    monkeypatch.setattr(scalar_ir, "MAX_OPERATIONS", 650)
    with pytest.raises(UnsupportedError, match=r"with 300 places \("):
        jaxpr.scalarize(writes, VECTOR)


def test_a_program_that_is_too_large_is_refused(monkeypatch):
    monkeypatch.setattr(jaxpr, "MAX_PROGRAM_OPERATIONS", 50)
    jaxpr.scalarize(lambda x: x + 1, VECTOR)
    with pytest.raises(UnsupportedError, match=r"^\d+ operations, more than 50$"):
        jaxpr.scalarize(large, VECTOR)


@pytest.fixture(scope="module")
def env():
    # Of the presets the one with more of everything: a motor's limit, a third Newton iteration.
    return make_env(parse_config({"robot": {"preset": "real"}}))


@pytest.fixture(scope="module")
def substep(env):
    """A physics step of MJX, the state before the first one, and the step lowered to scalars."""

    def step(physics, ctrl):
        return env.physics.substep(physics, (ctrl, []))

    first = jax.jit(env.reset)(jax.random.PRNGKey(0)).pipeline_state
    return step, first, jaxpr.scalarize(step, first, jnp.zeros(2))


@pytest.mark.slow
def test_the_arithmetic_of_mjx_is_mjxs_own(substep):
    step, first, program = substep
    rng = np.random.default_rng(0)
    robots = 16
    states = jax.tree.map(lambda x: jnp.repeat(x[None], robots, 0), first)
    step = jax.jit(jax.vmap(step))
    for number in range(8):
        if number % 4 == 0:
            ctrl = jnp.asarray(rng.uniform(-12, 31, (robots, 2)), jnp.float32)
        leaves = [np.asarray(leaf) for leaf in jax.tree.leaves((states, ctrl))]
        states = step(states, ctrl)
        ours = PhysicsState(*evaluate(program, leaves))
        # A wheel of 3e-4 kg m² under 0.05 N m s/rad: an acceleration's last digit is some 1e-4.
        np.testing.assert_allclose(ours.qpos, states.qpos, atol=2e-6)
        np.testing.assert_allclose(ours.qvel, states.qvel, atol=2e-5)
        np.testing.assert_allclose(ours.time, states.time, atol=0)
    # They drive off, each its own way.
    assert np.ptp(np.asarray(states.qvel[:, 0])) > 0.05


def test_of_the_arithmetic_of_mjx_most_is_multiplication_by_zero(env, substep):
    data = mjx.make_data(env.mj_model)
    size = sum(leaf.size for leaf in jax.tree.leaves(data))
    # The traced step has some 15,000 operations on arrays of up to 64 numbers.
    assert size < substep[2].size < 15_000


def test_the_primitives_with_a_rule_are_listed_once():
    names = [name for kind in jaxpr.primitives().values() for name in kind]
    assert len(names) == len(set(names)) > 100
    assert {"scan", "while", "cond", "sin", "dot_general", "gather", "erf", "qr"} <= {*names}
    assert not {"fft", "eigh", "lgamma"} & {*names}


def hessian(rows, x):
    """What Newton's method makes of the rows whose sum is negative."""
    active = rows @ x < 0
    return (rows.T * 2.0 * active) @ rows


def descent(rows, x):
    """Newton's method, which makes what the next iteration needs at the end of one."""

    def prepared(x):
        return x, hessian(rows, x) + jnp.eye(4)

    def closer(carry):
        x, matrix = carry
        return prepared(x - 0.1 * matrix @ x)

    return jax.lax.while_loop(lambda carry: (carry[0] ** 2).sum() > 1e-2, closer, prepared(x))[0]


ROWS = jax.ShapeDtypeStruct((6, 4), jnp.float32), VECTOR


def placed(program, kind):
    """The loops, or branches, of a program, wherever they are."""
    found, pending = [], [program.block]
    while pending:
        for item in pending.pop().items:
            if isinstance(item, kind):
                found.append(item)
            pending += [] if isinstance(item, Expr) else item.blocks
    return found


@pytest.mark.parametrize("function", [hessian, descent])
def test_what_is_multiplied_by_false_is_skipped(function):
    plain, skipping = (jaxpr.scalarize(function, *ROWS, skips=skips) for skips in (False, True))
    rng = np.random.default_rng(0)
    rows = np.float32(rng.normal(size=(50, 6, 4)))
    # In some instances every row counts, in others none.
    rows[:10], rows[10:20] = -np.abs(rows[:10]), np.abs(rows[10:20])
    points = np.abs(np.float32(rng.normal(size=(50, 4))))
    one, other = (evaluate(program, [rows, points])[0] for program in (plain, skipping))
    np.testing.assert_array_equal(one, other)
    assert not placed(plain, PlacedBranch)
    assert len(placed(skipping, PlacedBranch)) >= 6


def forces(rows, x):
    active = jnp.repeat(rows[::3] @ x < 0, 3)
    return (rows.T * active) @ jnp.ones(len(rows))


def velocities(rows, x):
    # The rows of a truth value do not follow each other.
    active = jnp.tile(rows[:2] @ x < 0, 3)
    return (rows * active[:, None]) @ x


@pytest.mark.parametrize("function", [forces, velocities])
def test_rows_with_one_truth_value_share_a_branch(function):
    program = jaxpr.scalarize(function, *ROWS, skips=True)
    assert len(placed(program, PlacedBranch)) == 2
    rows = np.float32(np.random.default_rng(0).normal(size=(20, 6, 4)))
    points = np.ones((20, 4), np.float32)
    plain = evaluate(jaxpr.scalarize(function, *ROWS), [rows, points])[0]
    np.testing.assert_array_equal(evaluate(program, [rows, points])[0], plain)


def test_a_loop_does_not_carry_what_branches_make_of_what_it_carries():
    # The matrix follows from x: it is made where an iteration begins, and not before the loop too.
    for skips in (False, True):
        (loop,) = placed(jaxpr.scalarize(descent, *ROWS, skips=skips), PlacedLoop)
        assert len(loop.places) == 4


def test_few_products_are_not_worth_a_branch():
    def few(rows, x):
        return (rows.T * (rows @ x < 0)) @ rows[:, :1]

    assert not placed(jaxpr.scalarize(few, *ROWS, skips=True), PlacedBranch)


def test_numbers_that_may_be_infinite_are_not_skipped():
    assert not placed(jaxpr.scalarize(hessian, *ROWS, skips=True, finite=False), PlacedBranch)
