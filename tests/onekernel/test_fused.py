"""A function of one robot as one kernel: before its physics and after, it does what JAX does."""

import functools
import re
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers.further import slow_unless
from helpers.small_kernels import launches, launches_in, lowered_text
from jetbot_mjx.config import load_config
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.domain_randomization import maybe_randomize
from jetbot_mjx.envs.wrappers import EpisodeWrapper, NewEpisodeWrapper, wrap_for_training
from jetbot_mjx.packed import pack
from onekernel import KernelError, UnsupportedError, cpu, fuse, gpu, kernel, traced
from onekernel.lower.jaxpr import scalarize

LANES = cpu.host_processor().lanes
STEPS = 3
TWO = np.float32(2)


def agree(ours, theirs, *, atol=2e-6):
    """Floats up to round-off, and all others exactly."""
    assert jax.tree.structure(ours) == jax.tree.structure(theirs)
    for one, other in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        assert (one.shape, one.dtype) == (other.shape, other.dtype)
        if one.dtype == np.float32:
            np.testing.assert_allclose(one, other, rtol=1e-6, atol=atol)
        else:
            np.testing.assert_array_equal(one, other)


MOVES = {
    *("bitcast_convert", "broadcast_in_dim", "reshape", "transpose"),
    *("compare", "constant", "convert", "custom_call"),
}
"""Operations that only move numbers to a kernel and from it, by name."""


def is_one_kernel(function, *arguments, platforms=None):
    """Whether a program calls one kernel, and computes nothing beside it."""
    text = lowered_text(function, *arguments, platforms=platforms)
    others = set(re.findall(r"stablehlo\.(\w+)", text)) - MOVES
    return launches_in(text) == 1 and not others


def robots(count, *shape, seed=0):
    return np.float32(np.random.default_rng(seed).normal(size=(count, *shape)))


def keys(count):
    return np.random.default_rng(1).integers(0, 2**32, (count, 2), np.uint32)


COUNTS = np.int32([-(2**31), -7, -1, 0, 1, 5, 2**31 - 1])

FUNCTIONS = {
    "floats": (lambda x: x * 2 - jnp.tanh(x[::-1]), robots(17, 3)),
    "a scalar": (lambda x: x.sum(), robots(17, 3)),
    "scalars": (lambda x, y: (x + y, x * y), robots(17), robots(17, seed=1)),
    "whole numbers": (lambda n: (n * 3 - 1, n // 4, n % 7, -n, n.astype(jnp.float32)), COUNTS),
    "keys": (lambda key: (key, jax.random.split(key), jax.random.bits(key, (3,))), keys(17)),
    "truths": (
        lambda x, flag: (jnp.where(flag, x, -x), ~flag, flag & (x > 0)),
        robots(17, 2),
        robots(17) > 0,
    ),
    "empty arrays": (
        lambda x, none: (none, none * 2, x[:0].astype(int), jnp.zeros((0, 3), bool), x + 1),
        robots(17, 2),
        np.zeros((17, 2, 0), np.uint32),
    ),
    "nothing but an empty array": (lambda none: none * 2, np.zeros((17, 0), np.float32)),
    "a tree": (
        lambda tree: {"a": tree["b"][0], "none": None, "b": (tree["a"], [tree["b"][1] + 1])},
        {"a": robots(17), "b": (keys(17), robots(17, 1, 2))},
    ),
    "what is given": (lambda x, key: (key, x, key), robots(17, 3), keys(17)),
    "what is known": (
        lambda x: (jnp.arange(3), jnp.uint32(2**32 - 1), jnp.array([True, False]), x),
        robots(17, 3),
    ),
    "bits": (lambda x: (x.view(jnp.uint32) + 1, x.view(jnp.int32)), robots(17, 3)),
    "a loop": (
        lambda x: jax.lax.while_loop(lambda y: y < 9, lambda y: y * 1.5 + 0.25, jnp.abs(x)),
        robots(17),
    ),
    "a place that depends": (lambda x: x[x[0].astype(int) % 3], robots(17, 3) ** 2),
    "another such function": (lambda x: fuse(jnp.tanh)(x + 1) * x, robots(17, 3)),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_function_is_one_kernel_that_does_what_it_did(name):
    function, *arguments = FUNCTIONS[name]
    one = fuse(function)
    for batched in (jax.vmap(one), jax.jit(jax.vmap(one))):
        agree(batched(*arguments), jax.vmap(function)(*arguments))
    assert is_one_kernel(jax.vmap(one), *arguments)
    alone = jax.tree.map(lambda x: x[1], arguments)
    agree(one(*alone), jax.tree.map(jnp.asarray, function(*jax.tree.map(jnp.asarray, alone))))


def test_whole_numbers_reach_their_kernel_as_they_are():
    # XLA would compile each conversion for a CPU to a kernel of its own.
    one = fuse(lambda key, count: (key ^ key[::-1], count + 1))
    text = jax.jit(jax.vmap(one)).lower(keys(17), np.arange(17, dtype=np.int32)).as_text()
    assert text.count("custom_call") == 1
    assert "bitcast_convert" not in text


def test_a_key_from_outside_of_a_function_is_part_of_its_kernel():
    def draw(key, x):
        return jax.vmap(fuse(lambda x: x + jax.random.normal(key), on_unsupported="raise"))(x)

    key, x = jax.random.key(7), robots(17)
    expected = x + jax.random.normal(key)
    agree(draw(key, x), expected)
    agree(jax.jit(draw)(key, x), expected)


LONG = 2_000


def trajectory(state):
    """Euler's method for the Lorenz system, whose states are returned by step."""

    def step(y, _):
        slope = (10 * (y[1] - y[0]), y[0] * (28 - y[2]) - y[1], y[0] * y[1] - 8 / 3 * y[2])
        y = y + 1e-4 * jnp.stack(slope)
        return y, y

    return jax.lax.scan(step, state, length=LONG)[1]


def sums_until_small(x, rows):
    """As many rounds as an instance needs, of sums whose steps the next round begins with."""

    def trip(state):
        rows, y, count = state
        y, rows = jax.lax.scan(lambda c, a: (c * 0.5 + a, a * 0.4 + c * 0.1), y, rows)
        return rows, y, count + 1

    def goes_on(state):
        return (jnp.abs(state[1]) > 0.01) & (state[2] < 20)

    return jax.lax.while_loop(goes_on, trip, (rows, x * 9, 0))


def of_several_dtypes(numbers, counts, flags, key):
    def step(carry, row):
        total, key = carry
        number, count, flag = row
        key, drawn = jax.random.split(key)
        word = jax.random.bits(drawn)
        total = total + jnp.where(flag, count, -1)
        return (total, key), (number * 2, total, word, flag ^ (word % 2 == 0), drawn)

    return jax.lax.scan(step, (0, key), (numbers, counts, flags), reverse=True)


def decayed_error(decay, rows):
    def step(state, a):
        state = state * jnp.tanh(decay) * 0.9 + a
        return state, state

    return (jax.lax.scan(step, jnp.float32(0.5), rows)[1] ** 2).mean()


LONG_SCANS = {
    "cumulative sums": (
        lambda x: jax.lax.scan(lambda c, a: (c + a, c + a), jnp.float32(0), x),
        robots(17, LONG),
    ),
    "rows that are results, too": (
        lambda x: (x[::-1], jax.lax.scan(lambda c, a: (c + a, c + a), jnp.float32(0), x), x),
        robots(17, 300),
    ),
    "a trajectory": (trajectory, robots(17, 3)),
    "rounds": (sums_until_small, robots(17), robots(17, 100, seed=1)),
    "several dtypes": (
        of_several_dtypes,
        robots(17, 300),
        (robots(17, 300) * 9).astype(np.int32),
        robots(17, 300, seed=1) > 0,
        keys(17),
    ),
    "a derivative": (
        jax.value_and_grad(decayed_error, argnums=(0, 1)),
        robots(17),
        robots(17, 300, seed=1),
    ),
}


# Cumulative sums are in "rows that are results, too".
@pytest.mark.slow
@pytest.mark.parametrize("name", slow_unless(lambda name: name != "cumulative sums", LONG_SCANS))
def test_a_long_scan_is_one_kernel(name):
    function, *arguments = LONG_SCANS[name]
    batched = jax.vmap(fuse(function))
    assert is_one_kernel(batched, *arguments)
    agree(jax.jit(batched)(*arguments), jax.jit(jax.vmap(function))(*arguments), atol=2e-5)


def test_numbers_that_are_no_arrays_will_do():
    one = fuse(lambda x, n, flag: (x * n, n + 1, ~flag))
    agree(one(1.5, 2, np.bool_(True)), (jnp.float32(3), jnp.int32(3), jnp.bool_(False)))


class Robot(NamedTuple):
    state: Any
    key: Any
    count: Any
    is_on: Any
    nothing: Any


def substep(state, consts):
    torque, mass = consts
    speed = state["speed"] + 0.05 * (torque / mass - 9.81 * jnp.sin(state["angle"]))
    return {"angle": state["angle"] + 0.05 * speed, "speed": speed}


def stepped(state, consts):
    for _ in range(STEPS):
        state = substep(state, consts)
    return state


def made(impl="auto"):
    shapes = {"angle": jnp.zeros(2), "speed": jnp.zeros(2)}, (jnp.zeros(2), jnp.zeros(()))
    structure = jax.tree.structure(shapes)

    def fallback(*leaves):
        return jax.tree.leaves(stepped(*jax.tree.unflatten(structure, leaves)))

    program = scalarize(substep, *shapes)
    one = kernel.Kernel(program, carried=2, steps=STEPS, fallback=fallback, impl=impl)
    return one.as_step()


def driving(step):
    """A function of one robot, which computes before its physics and after."""

    def drive(robot, action, mass):
        key, drawn = jax.random.split(robot.key)
        torque = jnp.clip(action, -1, 1) + 0.1 * jax.random.uniform(drawn, (2,))
        state = step(robot.state, (jnp.where(robot.is_on, torque, 0.0), mass))
        low = jnp.abs(state["angle"]) < 0.3
        angle = jnp.arctan2(jnp.sin(state["angle"]), jnp.cos(state["angle"]))
        robot = Robot(
            {"angle": angle, "speed": state["speed"]},
            key,
            robot.count + low.sum(),
            low.any() | ~robot.is_on,
            robot.nothing * 2,
        )
        # What is needed before and after.
        return robot, {"torque": torque * mass, "reward": -state["speed"] @ action, "low": low}

    return drive


def situations(*batch):
    rng = np.random.default_rng(3)

    def normal(*shape):
        return np.float32(rng.normal(size=(*batch, *shape)))

    robot = Robot(
        {"angle": normal(2), "speed": normal(2)},
        rng.integers(0, 2**32, (*batch, 2), np.uint32),
        np.asarray(rng.integers(-5, 5, batch, np.int32)),
        np.asarray(rng.random(batch) < 0.5),
        np.zeros((*batch, 0), np.float32),
    )
    return robot, 2 * normal(2), 1 + np.square(normal())


@pytest.fixture(scope="module")
def drive():
    return fuse(driving(made()))


@pytest.mark.parametrize("count", [0, 1, LANES + 1, 1000])
def test_before_and_after_its_physics_it_does_what_it_did(drive, count):
    given = situations(count)
    theirs = jax.jit(jax.vmap(driving(stepped)))(*given)
    agree(jax.jit(jax.vmap(drive))(*given), theirs)
    assert is_one_kernel(jax.vmap(drive), *given)
    assert not is_one_kernel(jax.vmap(driving(made())), *given)
    if count == 1000:
        assert 0.1 < np.mean(theirs[0].is_on) < 0.9
        assert np.ptp(theirs[0].count) > 5


def test_one_robot_needs_no_batch(drive):
    given = situations()
    agree(drive(*given), driving(stepped)(*given))


def test_where_nothing_is_to_be_compiled_the_function_itself_is_called(drive):
    def halved(x):
        return x / 2 if x > 0 else x

    with jax.disable_jit():
        assert fuse(halved)(jnp.float32(3)) == 1.5
        given = situations()
        agree(drive(*given), driving(stepped)(*given))


def test_a_batch_of_batches_along_any_axes_is_one_kernel(drive):
    robot, action, mass = situations(5, 4)
    axes = Robot({"angle": 2, "speed": 0}, 0, 0, 0, 0), 1, 0
    robot.state["angle"] = np.moveaxis(robot.state["angle"], 0, 2)
    given = robot, np.moveaxis(action, 0, 1), mass

    def twice(function):
        return jax.vmap(jax.vmap(function), in_axes=axes)

    agree(jax.jit(twice(drive))(*given), twice(driving(stepped))(*given))
    assert is_one_kernel(twice(drive), *given)


def test_what_is_common_to_all_robots_is_given_to_each(drive):
    robot, action, mass = situations(LANES + 1)
    given = robot._replace(is_on=np.bool_(True), count=np.int32(3)), action, mass[0]
    axes = Robot({"angle": 0, "speed": 0}, 0, None, None, 0), 0, None

    def batch(function):
        return jax.vmap(function, in_axes=axes)

    agree(jax.jit(batch(drive))(*given), batch(driving(stepped))(*given))
    assert is_one_kernel(batch(drive), *given)
    # The inner batch is of robots, the outer one of masses alone.
    masses = np.float32([1, 2, 3])
    ours, theirs = (
        jax.vmap(batch(function), in_axes=(None, None, 0))(*given[:2], masses)
        for function in (drive, driving(stepped))
    )
    agree(ours, theirs)


def test_it_can_be_looped_over(drive):
    robot, action, mass = situations(LANES + 1)

    def run(function):
        def trip(robot, _):
            return jax.vmap(function)(robot, action, mass)

        return jax.jit(lambda robot: jax.lax.scan(trip, robot, length=10))(robot)

    agree(run(drive), run(driving(stepped)), atol=1e-5)


def closed_over(physics, compiled):
    """A function that makes one of its first arguments, and calls it with the others."""

    def outer(gain, is_on, key, robot, action):
        def inner(robot, action):
            robot, seen = driving(physics)(robot._replace(is_on=is_on), gain * action, gain[0])
            return robot, seen, key, is_on, jax.random.bits(key, (2,))

        return compiled(inner)(robot, action)

    return outer


@pytest.mark.parametrize("how", ["jit", "vmap", "vmap of the others", "jit of vmap", "vmap of jit"])
def test_what_another_function_traces_is_an_argument_too(how):
    robot, action, mass = situations(LANES + 1)
    given = np.stack([mass, mass + 1], axis=1), robot.is_on, robot.key, robot, action
    first = jax.tree.map(lambda x: x[0], given)
    if how == "jit":
        given = first
    elif how == "vmap of the others":
        given = (*first[:3], *given[3:])
    transform = {
        "jit": jax.jit,
        "vmap": jax.vmap,
        "vmap of the others": functools.partial(jax.vmap, in_axes=(None, None, None, 0, 0)),
        "jit of vmap": lambda f: jax.jit(jax.vmap(f)),
        "vmap of jit": lambda f: jax.vmap(jax.jit(f)),
    }[how]
    ours = transform(closed_over(made(), fuse))
    agree(ours(*given), transform(closed_over(stepped, lambda f: f))(*given))
    assert is_one_kernel(ours, *given)


def test_what_another_function_traces_may_be_used_twice():
    def outer(gain, x):
        one = fuse(lambda x: gain * x)
        return one(x), one(x + 1)

    for gain in (2.0, 3.0):
        ours = jax.vmap(outer, in_axes=(0, None))(np.full(2, gain, np.float32), 1.0)
        np.testing.assert_array_equal(ours, [[gain, gain], [2 * gain, 2 * gain]])
    assert launches(outer, 2.0, 1.0) == 2


def with_two_kernels(step):
    def function(x):
        state = step({"angle": x, "speed": x * 2}, (x, x[0] ** 2 + 1))
        return step(state, (x[::-1], x[1] ** 2 + 1))

    return function


def with_a_kernel_in_a_loop(step):
    def function(x):
        def trip(state, _):
            return step(state, (x, x[0] ** 2 + 1)), state["speed"]

        return jax.lax.scan(trip, {"angle": x, "speed": x * 2}, length=3)

    return function


def with_a_kernel_in_a_function(step):
    return lambda x: jax.jit(step)({"angle": x, "speed": x * 2}, (x, x[0] ** 2 + 1))["speed"] + 1


def with_a_kernel_and_a_transform(step):
    return lambda x: (
        jnp.fft.rfft(step({"angle": x, "speed": x * 2}, (x, x[0] ** 2 + 1))["speed"]).real
    )


def with_one_inside_that_has_a_kernel(step):
    def inner(x):
        return step({"angle": x + 1, "speed": x * 2}, (x, x[0] ** 2 + 1))["speed"] - 1

    return lambda x: (fuse(inner) if step is not stepped else inner)(2 * x) * x


PHYSICS = {
    "two kernels": (with_two_kernels, 2),
    "a kernel in a loop": (with_a_kernel_in_a_loop, 1),
    "a kernel in a function": (with_a_kernel_in_a_function, 1),
    "a kernel and a sort": (with_a_kernel_and_a_transform, 1),
    "one inside that has a kernel": (with_one_inside_that_has_a_kernel, 1),
}


@pytest.mark.parametrize("name", PHYSICS)
def test_around_physics_what_no_kernel_can_do_stays_as_it_is(name):
    function, kernels = PHYSICS[name]
    one, x = fuse(function(made()), on_unsupported="xla"), robots(LANES + 1, 2)
    agree(jax.jit(jax.vmap(one))(x), jax.vmap(function(stepped))(x), atol=5e-6)
    assert launches(jax.vmap(one), x) == kernels
    agree(one(x[0]), function(stepped)(x[0]), atol=5e-6)


@pytest.mark.parametrize("function", [with_a_kernel_in_a_loop, with_a_kernel_in_a_function])
def test_a_kernel_that_is_not_called_directly_is_told(function):
    with pytest.raises(UnsupportedError, match=r"^a step of fuse_mjx within a loop, a branch or a"):
        fuse(function(made()), on_unsupported="raise")(robots(1, 2)[0])


IMAGES = np.random.default_rng(0).integers(0, 256, (17, 2, 3), np.uint8)
OTHERS = {
    "half floats": (lambda x: x * 2 + 1, robots(17, 3).astype(np.float16)),
    "half floats inside": (lambda x: (x.astype(jnp.bfloat16) * 3).astype(jnp.float32), robots(17)),
    "an image": (lambda image, x: (image, image.mean() * x, x.any()), IMAGES, robots(17)),
    "bytes": (lambda x: x.astype(jnp.int8), robots(17) * 100),
    "a call": (lambda x: jnp.linalg.eigh(x @ x.T)[0], robots(17, 2, 2)),
}


@pytest.mark.parametrize("name", OTHERS)
def test_what_no_kernel_can_do_stays_as_it_is(name):
    function, *arguments = OTHERS[name]
    one = fuse(function, on_unsupported="xla")
    agree(jax.jit(jax.vmap(one))(*arguments), jax.jit(jax.vmap(function))(*arguments))
    assert launches(jax.vmap(one), *arguments) == 0
    alone = jax.tree.map(lambda x: jnp.asarray(x[0]), arguments)
    agree(one(*alone), function(*alone))


@pytest.mark.parametrize("kernels", [0, 1])
def test_a_function_that_does_more_than_return_results_stays_as_it_is(kernels):
    told = []
    step = made()

    def function(x):
        if kernels:
            x = step({"angle": x, "speed": x}, (x, jnp.float32(1)))["angle"]
        jax.debug.callback(lambda x: told.append(x.shape), x)
        return x + 1

    one, x = jax.vmap(fuse(function, on_unsupported="xla")), robots(17, 2)
    agree(jax.jit(one)(x), jax.vmap(function)(x))
    jax.effects_barrier()
    assert told == [(2,)] * 17 * 2
    assert launches(one, x) == kernels


def test_what_is_no_kernel_can_be_differentiated():
    def function(x):
        return jnp.abs(jnp.fft.rfft(x)).sum()

    x = robots(1, 3)[0]
    agree(jax.grad(fuse(function, on_unsupported="xla"))(x), jax.grad(function)(x))


NO_NUMBERS = np.float32([[1, np.nan], [np.inf, 2], [-np.inf, np.nan], [0.5, -2], [30.0, 1e-3]])


def test_nan_reaches_the_results():
    def function(x):
        guarded = jnp.where(jnp.isfinite(x), x, 7.0)
        extremes = jnp.maximum(x[0], x[1]), jnp.minimum(x, 0.25), jnp.clip(x, -1, 1), x.max()
        tests = jnp.isnan(x), jnp.isinf(x), jnp.isfinite(x).all(), x == x, x > 0, x != x[0]
        rest = -x, x + 1, x * 2.5, jnp.abs(x), x.sum(), jnp.nan_to_num(x), jnp.exp(x), x @ x
        return guarded, extremes, tests, rest, x.astype(jnp.int32), x

    one = jax.vmap(fuse(function))
    assert is_one_kernel(one, NO_NUMBERS)
    agree(one(NO_NUMBERS), jax.vmap(function)(NO_NUMBERS))


@pytest.mark.parametrize("where", ["angle", "action", "mass"])
def test_nan_reaches_what_comes_after_physics(drive, where):
    robot, action, mass = situations(len(NO_NUMBERS))
    robot = robot._replace(is_on=np.ones(len(NO_NUMBERS), bool))
    if where == "angle":
        robot.state["angle"] = NO_NUMBERS
    elif where == "action":
        action = NO_NUMBERS
    else:
        mass = NO_NUMBERS[:, 1]
    given = robot, action, mass

    def guarded(function):
        def run(*given):
            robot, seen = function(*given)
            finite = jnp.isfinite(jnp.concatenate(jax.tree.leaves(robot.state))).all()
            state = jax.tree.map(lambda a, b: jnp.where(finite, a, b), robot.state, given[0].state)
            return finite, state, seen

        return run

    ours = jax.vmap(fuse(guarded(driving(made()))))
    theirs = jax.vmap(guarded(driving(stepped)))(*given)
    assert is_one_kernel(ours, *given)
    agree(ours(*given), theirs)
    assert 0 < np.mean(theirs[0]) < 1


def counted(monkeypatch):
    """What is lowered to scalars, one after the other."""
    lowered = []
    part = traced.scalarize_part

    def count(*arguments, **options):
        lowered.append(arguments)
        return part(*arguments, **options)

    monkeypatch.setattr(traced, "scalarize_part", count)
    return lowered


def test_each_set_of_shapes_is_lowered_once(monkeypatch):
    lowered = counted(monkeypatch)
    run = fuse(lambda tree, n: (tree["x"] * n, tree["flag"]))

    def tree(*shape, dtype=np.float32):
        return {"x": np.ones(shape, dtype), "flag": np.bool_(True)}

    def number_after(*arguments):
        run(*arguments)
        return len(lowered)

    assert number_after(tree(3), TWO) == 1
    assert number_after(tree(3), np.float32(5)) == 1
    jax.jit(lambda *x: run(*x))(tree(3), TWO)
    jax.vmap(run, in_axes=(None, 0))(tree(3), np.ones(7, np.float32))
    assert number_after(tree(3), TWO) == 1
    assert number_after(tree(4), TWO) == 2
    assert number_after(tree(3, dtype=np.int32), TWO) == 3
    assert number_after({**tree(3), "flag": np.float32(1)}, TWO) == 4
    assert number_after({**tree(3), "more": 1.0}, TWO) == 5
    other = fuse(lambda tree: tree["a"] if "a" in tree else -tree["b"])
    assert [float(other({name: 1.0})) for name in "abab"] == [1, -1, 1, -1]
    assert len(lowered) == 7
    for shape, dtype in ((3, np.int32), (4, np.float32), (3, np.float32)):
        result, flag = run(tree(shape, dtype=dtype), np.float32(3))
        np.testing.assert_array_equal(result, np.full(shape, 3))
        assert flag.dtype == bool
    assert len(lowered) == 7


def test_physics_is_lowered_with_what_comes_before_and_after_once(monkeypatch):
    run, given = fuse(driving(made())), situations(3)
    lowered = counted(monkeypatch)
    for _ in range(3):
        jax.vmap(run)(*given)
    assert len(lowered) == 2


def test_what_cannot_be_lowered_is_not_tried_again(monkeypatch):
    lowered = counted(monkeypatch)
    run = fuse(jnp.sort)
    for _ in range(3):
        run(np.ones(3, np.float32))
    assert len(lowered) == 1


def drawing(robot, action, mass):
    return robot.is_on & (mass > 1), jax.random.uniform(robot.key, (2,)) * action, robot.count


def prepared(case):
    """A function as one kernel and as it is, and what is given to it."""
    robot, action, mass = given = situations(5)
    if case == "with physics":
        return fuse(driving(made())), driving(stepped), given
    if case == "without physics":
        return fuse(drawing), drawing, given
    given = np.stack([mass, mass], axis=1), robot.is_on, robot.key, robot, action
    return closed_over(made(), fuse), closed_over(stepped, lambda f: f), given


@pytest.mark.filterwarnings("ignore:.*XLA.*slower:UserWarning")
@pytest.mark.parametrize("case", ["with physics", "without physics", "traced by another"])
def test_a_platform_without_a_back_end_runs_the_function_itself(case, monkeypatch):
    one, function, given = prepared(case)
    assert launches(jax.vmap(one), *given, platforms=("tpu",)) == 0
    for backend in (cpu, gpu):
        monkeypatch.setattr(backend, "obstacle", lambda: "there is none")
    theirs = jax.vmap(function)(*given)
    for known in (one, prepared(case)[0]):
        agree(jax.jit(jax.vmap(known))(*given), theirs)
        assert launches(jax.vmap(known), *given) == 0


@pytest.mark.filterwarnings("ignore:.*XLA.*slower:UserWarning")
def test_a_programs_platform_decides(drive, monkeypatch):
    arguments = jax.vmap(drive), *situations(5)
    if not cpu.obstacle():
        assert is_one_kernel(*arguments, platforms=("cpu",))
    monkeypatch.setattr(gpu, "obstacle", lambda: None)
    monkeypatch.setattr(gpu, "target_architecture", lambda: 90)
    assert is_one_kernel(*arguments, platforms=("cuda",))
    monkeypatch.setattr(gpu, "obstacle", lambda: "there is none")
    assert launches(*arguments, platforms=("cuda",)) == 0


def test_a_kernel_that_was_asked_for_is_not_replaced():
    one = fuse(driving(made(impl="llvm")))
    with pytest.raises(KernelError, match=r"^this program is for cuda"):
        launches(one, *situations(), platforms=("cuda",))


ENVS, EPISODE_LENGTH, DRIVEN = 19, 7, 60
NEAR_GOALS = ["goal_distance_min=0.1", "goal_distance_span=0.1", "success_radius=0.12"]


@functools.cache
def environment(name, root):
    """Robots whose steps are one kernel, and a robot of which only physics is one."""
    overrides = [f"task.{override}" for override in NEAR_GOALS]
    env = make_env(load_config(root / "configs" / f"{name}.yaml", overrides))
    one = NewEpisodeWrapper(EpisodeWrapper(maybe_randomize(env), EPISODE_LENGTH))
    return wrap_for_training(env, EPISODE_LENGTH), one


def spoilt(state):
    """A batch of states in which one robot's state is NaN, and the goal of another one."""
    physics, goal = state.pipeline_state, state.goal
    return state.replace(
        pipeline_state=physics.replace(qpos=physics.qpos.at[3, 1].set(jnp.inf)),
        goal=goal.at[5, 0].set(jnp.nan),
    )


def drive_all(state, step, spoil):
    """The states of robots that are driven to and fro as fast as they can."""
    rng = np.random.default_rng(0)
    signs = np.where(rng.random((DRIVEN, ENVS, 2)) < 0.3, -1, 1).cumprod(axis=0)
    actions = np.float32(signs * rng.choice([1.0, 1.5], signs.shape))
    actions[40, 7, 0], actions[40, 8, 1] = np.nan, -np.inf
    states = [state]
    for number, action in enumerate(actions):
        state = step(spoil(state) if number == 20 else state, action)
        states.append(state)
    return jax.device_get(states)


@pytest.fixture(
    scope="module",
    params=slow_unless(lambda name: name == "real_jetbot", ["smoke", "jetbot", "real_jetbot"]),
)
def driven(request, root):
    """What became of robots whose steps are one kernel, and many."""
    batch, one = environment(request.param, root)
    keys = jax.random.split(jax.random.PRNGKey(3), ENVS)
    ours = drive_all(
        jax.jit(lambda keys: pack(batch.reset(keys), batch_axes=1))(keys),
        jax.jit(batch.step_packed),
        jax.jit(lambda packed: pack(spoilt(packed.unpack()), batch_axes=1)),
    )
    reset, step = (jax.jit(jax.vmap(function)) for function in (one.reset, one.step))
    theirs = drive_all(reset(keys), step, jax.jit(spoilt))
    return request.param, *(
        jax.tree.map(lambda *x: np.stack(x), *states)
        for states in ([packed.unpack() for packed in ours], theirs)
    )


@pytest.mark.slow
@pytest.mark.cpu
def test_environments_draw_and_end_as_those_of_many_kernels(driven):
    _, ours, theirs = driven
    assert jax.tree.structure(ours) == jax.tree.structure(theirs)
    np.testing.assert_array_equal(ours.done, theirs.done)
    pairs = list(zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True))
    assert all((x.shape, x.dtype) == (y.shape, y.dtype) for x, y in pairs)
    keys = [(x, y) for x, y in pairs if x.dtype != np.float32]
    assert all(x.dtype == np.uint32 for x, _ in keys)
    for one, other in keys:
        np.testing.assert_array_equal(one, other)
    # A new episode begins with a new key.
    changed = np.any(ours.key[1:] != ours.key[:-1], axis=-1)
    np.testing.assert_array_equal(changed, ours.done[1:] > 0)


def test_episodes_end_in_every_way(driven):
    _, ours, _ = driven
    assert ours.done.sum() > 100
    assert ours.info["terminated"].sum() > 4
    assert ours.info["truncation"].sum() > 50
    broken = ours.metrics["nonfinite_envs"].sum(axis=0)
    np.testing.assert_array_equal(np.flatnonzero(broken), [3, 5, 7])
    np.testing.assert_array_equal(broken[[3, 5, 7]], 1)
    for state in (ours.obs, ours.reward, ours.goal, ours.pipeline_state.qpos):
        assert np.isfinite(state).all()


TOLERANCES = {"smoke": 2e-6, "jetbot": 3e-7, "real_jetbot": 8e-6}
"""Ten times the largest difference of a number, or less: 2.4e-7, 3.0e-8 and 3.1e-6; accelerations
of up to 200 differ by 2.5e-4."""


@pytest.mark.cpu
def test_all_numbers_of_environments_are_those_of_many_kernels(driven):
    name, ours, theirs = driven
    leaves = jax.tree_util.tree_leaves_with_path(ours)
    for (path, one), other in zip(leaves, jax.tree.leaves(theirs), strict=True):
        field = jax.tree_util.keystr(path)
        atol = TOLERANCES[name]
        if name == "real_jetbot" and "qacc" in field:
            atol = 2e-3
        np.testing.assert_allclose(one, other, rtol=0, atol=atol, err_msg=field)


@pytest.mark.parametrize("name", [pytest.param("smoke", marks=pytest.mark.slow), "real_jetbot"])
def test_a_step_of_an_environment_is_one_kernel_and_a_reset_another(name, root):
    batch, one = environment(name, root)
    keys = jax.random.split(jax.random.PRNGKey(0), ENVS)
    state, actions = batch.reset(keys), np.zeros((ENVS, 2), np.float32)
    assert is_one_kernel(batch.reset, keys)
    assert is_one_kernel(batch.step, state, actions)
    assert is_one_kernel(batch.step_packed, pack(state, batch_axes=1), actions)
    assert launches(jax.vmap(one.reset), keys) == 0
