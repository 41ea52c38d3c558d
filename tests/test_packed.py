"""A pytree of arrays packed into one array and back, bit for bit."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jetbot_mjx.packed import Condensed, Packed, condense, pack

WORDS = 10
"""Numbers of 32 bits that one `Robot` holds."""

NO_NUMBERS = np.uint32([0x7F800001, 0x7FC00000, 0x7FFFFFFF, 0xFF800001, 0xFFC12345, 0xFFFFFFFF])
AT_THE_EDGE = np.uint32([0, 1, 0x7FFFFF, 0x80000000, 0x80000001, 0x7F800000, 0xFF800000])
BITS = np.concatenate([NO_NUMBERS, AT_THE_EDGE])


class Robot(NamedTuple):
    position: Any
    frame: Any
    time: Any
    count: Any
    key: Any
    is_on: Any
    image: Any
    nothing: Any
    absent: Any = None


def drawn(*batch, seed=0):
    """Robots with many NaN among their floats."""
    rng = np.random.default_rng(seed)

    def bits(*shape):
        random = rng.integers(0, 2**32, (*batch, *shape), np.uint32)
        return np.where(rng.random(random.shape) < 0.5, rng.choice(BITS, random.shape), random)

    return Robot(
        position=bits(3).view(np.float32),
        frame={"matrix": bits(1, 2).view(np.float32), "axis": bits(1).view(np.int32)},
        time=np.asarray(bits()).view(np.float32),
        count=np.asarray(bits()).view(np.int32),
        key=bits(2),
        is_on=np.asarray(rng.random(batch) < 0.5),
        image=rng.integers(0, 256, (*batch, 2, 3), np.uint8),
        nothing=(np.zeros((*batch, 0), np.float32), np.zeros((*batch, 2, 0), np.int32)),
    )


def contents(tree):
    """The leaves' dtypes, shapes and bytes, behind the structure of the tree."""
    leaves, structure = jax.tree.flatten(tree)
    return structure, [(x.dtype, x.shape, np.asarray(x).tobytes()) for x in leaves]


BATCHES = [(), (5,), (4, 3)]


@pytest.mark.parametrize("batch", BATCHES)
def test_on_the_host_a_tree_comes_back_and_is_its_own(batch):
    robots = drawn(*batch)
    before = contents(robots)
    packed = pack(robots, batch_axes=len(batch))
    assert packed.words.shape == (*batch, WORDS)
    assert packed.words.dtype == np.float32
    unpacked = packed.unpack()
    assert contents(unpacked) == before
    for leaf in [packed.words, *jax.tree.leaves(unpacked)]:
        assert isinstance(leaf, np.ndarray)
    for leaf in [*jax.tree.leaves(unpacked), *jax.tree.leaves(robots)]:
        assert not np.shares_memory(leaf, packed.words)
    unpacked.position[...] = 7
    robots.key[...] = 7
    assert contents(packed.unpack()) == before


@pytest.mark.parametrize("batch", BATCHES)
@pytest.mark.parametrize("compiled", [True, False])
def test_on_a_device_a_tree_comes_back(batch, compiled):
    robots = drawn(*batch)
    on_device = jax.tree.map(jnp.asarray, robots)

    def packed(tree):
        return pack(tree, batch_axes=len(batch))

    packs, unpacks = (
        (jax.jit(packed), jax.jit(Packed.unpack)) if compiled else (packed, Packed.unpack)
    )
    there = packs(on_device)
    assert isinstance(there.words, jax.Array)
    assert there.words.shape == (*batch, WORDS)
    assert contents(unpacks(there)) == contents(robots)


@pytest.mark.parametrize("axes", [1, 2])
def test_a_robot_packs_itself_as_all_are_packed_together(axes):
    batch = (4, 3)[:axes]
    robots = drawn(*batch)
    one, back = pack, Packed.unpack
    for _ in batch:
        one, back = jax.vmap(one), jax.vmap(back)
    each, together = jax.jit(one)(robots), pack(robots, batch_axes=axes)
    assert contents(each) == contents(together)
    assert contents(jax.jit(back)(each)) == contents(robots)
    assert contents(each.unpack()) == contents(robots)


def test_a_packed_tree_is_a_pytree():
    robots = drawn(5)
    packed = pack(jax.tree.map(jnp.asarray, robots), batch_axes=1)
    second = jax.tree.map(lambda x: x[2], packed).unpack()
    assert contents(second) == contents(jax.tree.map(lambda x: x[2], robots))
    on_host = jax.device_get(packed)
    assert isinstance(on_host.words, np.ndarray)
    assert contents(on_host.unpack()) == contents(robots)


def test_trees_of_the_same_shapes_are_packed_alike_and_others_are_not():
    one, other = (jax.tree.structure(pack(drawn(5, seed=seed), batch_axes=1)) for seed in (1, 2))
    assert one == other
    longer = drawn(5)._replace(time=np.zeros((5, 1), np.float32))
    whole = drawn(5)._replace(time=np.zeros(5, np.int32))
    for changed in (longer, whole):
        assert jax.tree.structure(pack(changed, batch_axes=1)) != one


def test_a_loop_carries_it_and_what_it_has_stored_is_unpacked_at_once():
    first = drawn()

    def trip(packed, _):
        robot = packed.unpack()
        packed = pack(robot._replace(count=robot.count + 1, is_on=~robot.is_on))
        return packed, packed

    _, stored = jax.lax.scan(trip, pack(jax.tree.map(jnp.asarray, first)), length=3)
    robots = jax.device_get(stored).unpack()
    np.testing.assert_array_equal(robots.count, first.count + np.int32([1, 2, 3]))
    np.testing.assert_array_equal(robots.is_on, [not first.is_on, first.is_on, not first.is_on])
    assert robots.position.tobytes() == np.tile(first.position, (3, 1)).tobytes()


@pytest.mark.parametrize("dtype", [np.float32, np.int32, np.uint32])
@pytest.mark.parametrize("where", ["host", "device", "compiled", "batched"])
def test_the_bits_of_nan_and_of_subnormal_numbers_survive(dtype, where):
    def there_and_back(x):
        return pack([x, np.zeros(3, np.float32)]).unpack()[0]

    leaf = BITS.view(dtype)
    if where != "host":
        leaf = jnp.asarray(leaf)
    if where == "compiled":
        there_and_back = jax.jit(there_and_back)
    elif where == "batched":
        there_and_back = jax.vmap(there_and_back)
    result = there_and_back(leaf)
    assert result.dtype == dtype
    np.testing.assert_array_equal(np.asarray(result).view(np.uint32), BITS)


def test_arrays_of_other_sizes_are_kept_beside():
    others = [np.ones(4, x) for x in (np.float16, np.int64, np.float64, np.uint8, bool)]
    packed = pack([np.float32([1, 2]), *others])
    assert packed.words.shape == (2,)
    assert all(x is y for x, y in zip(packed.others, others, strict=True))
    assert contents(packed.unpack()[1:]) == contents(others)


def test_one_array_on_a_device_takes_the_others_with_it():
    packed = pack([jnp.float32([1, 2]), np.int32([3])])
    assert isinstance(packed.words, jax.Array)
    floats, whole = packed.unpack()
    np.testing.assert_array_equal(floats, [1, 2])
    assert whole.dtype == np.int32
    np.testing.assert_array_equal(whole, [3])


@pytest.mark.parametrize("most", [0, 1, 2, 3, 100])
def test_of_a_tree_the_small_arrays_are_in_one(most):
    robot = drawn()
    condensed = condense(robot, most)
    sizes = [x.size for x in jax.tree.leaves(robot)]
    assert [x.size for x in condensed.large] == [size for size in sizes if size > most]
    assert contents(condensed.restore()) == contents(robot)
    on_device = jax.jit(lambda tree: condense(tree, most))(jax.tree.map(jnp.asarray, robot))
    assert contents(jax.jit(Condensed.restore)(on_device)) == contents(robot)


@pytest.mark.parametrize("empty", [(0,), (2, 0)])
def test_an_empty_array_is_not_among_the_words(empty):
    tree = [np.ones(3, np.float32), np.zeros(empty, np.float32), np.zeros(empty, np.int32)]
    packed = pack(tree)
    assert packed.words.shape == (3,)
    for ours, theirs in zip(jax.jit(lambda x: pack(x).unpack())(tree), tree, strict=True):
        assert (ours.shape, ours.dtype) == (theirs.shape, theirs.dtype)
        np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("tree", [[np.ones((4, 3), bool)], {}, [np.zeros((4, 0), np.float32)]])
def test_without_any_words_there_is_an_empty_array(tree):
    packed = pack(tree, batch_axes=1)
    assert packed.words.shape[-1] == 0
    jax.tree.map(np.testing.assert_array_equal, packed.unpack(), tree)


def test_places_are_where_the_words_of_an_array_lie():
    tree = {
        "a": jnp.zeros((2, 3)),
        "b": jnp.zeros(2, bool),
        "c": jnp.zeros((2, 2), jnp.int32),
        "d": jnp.zeros((2, 0)),
    }
    packed = pack(tree, batch_axes=1)
    places = packed.places()
    np.testing.assert_array_equal(places["a"], [0, 1, 2])
    np.testing.assert_array_equal(places["c"], [3, 4])
    # What is not among the words has no place there.
    assert places["b"] == -1
    assert places["d"].shape == (0,)
    numbered = packed.replace(words=jnp.arange(10.0).reshape(2, 5)).unpack()
    np.testing.assert_array_equal(numbered["a"][1], places["a"] + 5)
