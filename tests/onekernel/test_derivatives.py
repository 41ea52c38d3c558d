"""What JAX differentiates is two kernels, and its derivatives are JAX's."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.ad_checkpoint import checkpoint_name

from helpers.small_kernels import launches
from onekernel import UnsupportedError, cpu, fuse, fused
from onekernel.build import BACKENDS

pytestmark = pytest.mark.skipif(cpu.obstacle() is not None, reason="there are no kernels here")


@pytest.fixture(autouse=True)
def without_warnings():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield


def states(count=7, size=3):
    return np.float32(np.random.default_rng(0).normal(size=(count, size)))


def lorenz(state):
    x, y, z = state
    return jnp.stack([10 * (y - x), x * (28 - z) - y, x * y - 8 / 3 * z])


def trajectory(state):
    """Steps of an oscillator, which a branch and a random number push."""

    def step(carry, key):
        x, count = carry
        x = x + 0.1 * jnp.sin(x[::-1]) + 0.01 * jax.random.normal(key)
        x = jax.lax.cond(x[0] > 0.2, lambda x: x * 0.9, jnp.tanh, x)
        return (x, count + 1), {"x": x, "is_large": x[0] > 0}

    keys = jax.random.split(jax.random.key(3), 12)
    (x, count), rows = jax.lax.scan(step, (state, 0), keys)
    return x, count, rows


def implicit(state):
    """The solution of equations, and a sum by an index that is computed."""
    matrix = jnp.outer(state, state) + 3 * jnp.eye(3)
    found = jnp.linalg.solve(matrix, jnp.exp(-(state**2)))
    place = (jnp.abs(state[0]) * 7).astype(int) % 3
    return jnp.zeros(3).at[place].add(found[0]) + jnp.sort(found)


FUNCTIONS = {
    "arithmetic": lorenz,
    "a trajectory": trajectory,
    "one that is computed again": jax.checkpoint(trajectory),
    "equations": implicit,
}


def loss(function):
    """A number of all floats that a function returns."""

    def squares(*arguments):
        leaves = jax.tree.leaves(function(*arguments))
        return sum((x**2).sum() for x in leaves if x.dtype == jnp.float32)

    return squares


def rows(function):
    return lambda x: jnp.concatenate([y.ravel() for y in jax.tree.leaves(function(x))][:2])


WAYS = {
    "grad": lambda f: jax.grad(loss(f))(states()[0]),
    "value and grad of vmap": lambda f: jax.jit(
        jax.value_and_grad(lambda x: jax.vmap(loss(f))(x).sum())
    )(states()),
    "vmap of grad": lambda f: jax.jit(jax.vmap(jax.grad(loss(f)), in_axes=1))(states().T),
    "jvp of vmap": lambda f: jax.jit(lambda x: jax.jvp(jax.vmap(rows(f)), (x,), (x,)))(states()),
    "jacfwd": lambda f: jax.jit(jax.jacfwd(rows(f)))(states()[0]),
    "jacrev": lambda f: jax.jit(jax.vmap(jax.jacrev(rows(f))))(states()),
    "hessian": lambda f: jax.jit(jax.vmap(jax.hessian(loss(f))))(states()),
    "grad of grad": lambda f: jax.jit(jax.grad(lambda x: loss(jax.grad(loss(f)))(x)))(states()[0]),
    "through a scan": lambda f: jax.jit(
        jax.grad(
            lambda x: jax.lax.scan(lambda c, _: (rows(f)(0.1 * c)[:3], None), x, length=3)[0].sum()
        )
    )(states()[0]),
    "linearize": lambda f: jax.linearize(rows(f), states()[0])[1](states()[1]),
}
CASES = [("arithmetic", way) for way in WAYS] + [
    *(
        ("a trajectory", way)
        for way in ("vmap of grad", "jvp of vmap", "hessian", "through a scan")
    ),
    *(("one that is computed again", way) for way in ("vmap of grad", "jvp of vmap")),
    *(("equations", way) for way in ("value and grad of vmap", "jacrev", "jacfwd")),
]


def same(one, other, rtol=1e-4):
    assert jax.tree.structure(one) == jax.tree.structure(other)
    for x, y in zip(jax.tree.leaves(one), jax.tree.leaves(other), strict=True):
        assert (x.shape, x.dtype) == (y.shape, y.dtype)
        if x.dtype == np.float32:
            size = float(np.abs(np.asarray(y)).max(initial=1e-6))
            np.testing.assert_allclose(x, y, rtol=rtol, atol=rtol * size)
        elif x.dtype != jax.dtypes.float0:
            np.testing.assert_array_equal(x, y)


@pytest.mark.parametrize(("name", "way"), CASES)
def test_derivatives_of_all_kinds_are_jaxs(name, way):
    function = FUNCTIONS[name]
    ours = WAYS[way](fuse(function, on_unsupported="raise"))
    same(ours, WAYS[way](function))


@pytest.mark.parametrize(("way", "count"), [("vmap of grad", 2), ("hessian", 4)])
def test_a_derivative_is_a_kernel_forward_and_one_backward(way, count):
    one = fuse(trajectory, on_unsupported="raise")
    ways = {
        "vmap of grad": jax.vmap(jax.grad(loss(one))),
        # The gradient is two kernels, each of which has a part for its own derivative.
        "hessian": jax.vmap(jax.hessian(loss(one))),
    }
    assert launches(ways[way], states()) == count


def stored(function, *arguments):
    """The shapes of what the forward kernel returns beside the function's results."""
    one = fuse(function, on_unsupported="raise")
    results = len(jax.tree.leaves(jax.eval_shape(function, *arguments)))
    jaxpr = jax.make_jaxpr(lambda *x: jax.vjp(one, *x)[0])(*arguments).jaxpr
    (forward,) = [x for x in jaxpr.eqns if x.primitive.name == "onekernel"][:1]
    return [x.aval.shape for x in forward.outvars[results:]]


STORED = {
    "what is linear": (lambda x: 3 * x[::-1].sum(), []),
    "an argument": (lambda x: x**2, []),
    "what is made of an argument": (lambda x: (x[:, None] * x[None] * (x > 0)).sum(), []),
    "a result": (jnp.exp, []),
    "constants": (lambda x: jnp.arange(3.0) * x @ jnp.arange(9.0).reshape(3, 3), []),
    "one number": (lambda x: jnp.sin(x.sum()), [()]),
    "one number that is used twice": (lambda x: jnp.exp(x.sum()) * x[0], [()]),
    "what is computed again": (jax.checkpoint(lambda x: jnp.sin(jnp.sin(x))), []),
    "what has a name": (
        jax.checkpoint(
            lambda x: jnp.sin(jnp.sin(checkpoint_name(jnp.exp(x[:2].sum()), "kept")) * x),
            policy=jax.checkpoint_policies.save_only_these_names("kept"),
        ),
        [()],
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", STORED)
def test_only_what_is_not_there_already_is_stored(name):
    function, shapes = STORED[name]
    assert stored(function, states()[0]) == shapes
    gradient = jax.grad(loss(fuse(function, on_unsupported="raise")))
    same(gradient(states()[0]), jax.grad(loss(function))(states()[0]))


def test_arguments_of_all_kinds_may_be_beside_those_by_which_it_is_differentiated():
    def function(tree, flag, *, key):
        x = tree["x"] + jax.random.normal(key, (2,))
        x = jnp.where(flag, x * tree["count"], -jnp.sin(x))
        return {
            "x": jnp.exp(x),
            "count": tree["count"] + 1,
            "keys": jax.random.split(key),
            "f": flag,
        }

    tree = {"x": jnp.array([0.3, -0.2]), "count": jnp.int32(2)}

    def gradients(one):
        total = lambda *x: one(*x, key=jax.random.key(1))["x"].sum()  # noqa: E731
        whole = jax.grad(total, argnums=(0, 1), allow_int=True)(tree, jnp.array(True))
        (again,) = jax.vjp(
            lambda x: one({**tree, "x": x}, False, key=jax.random.key(2)), tree["x"]
        )[1](
            {
                "x": jnp.ones(2),
                **{
                    k: np.zeros(s, jax.dtypes.float0)
                    for k, s in (("count", ()), ("keys", (2,)), ("f", ()))
                },
            }
        )
        return whole, again

    same(gradients(fuse(function, on_unsupported="raise")), gradients(function))


def test_a_loop_without_reverse_mode_has_forward_mode_and_jaxs_own_error():
    def function(x):
        return jax.lax.while_loop(lambda y: y < 9, lambda y: y * (1.5 + x * x) + 0.25, jnp.abs(x))

    one = fuse(function, on_unsupported="raise")
    with pytest.raises(ValueError, match="Reverse-mode differentiation does not work for"):
        jax.grad(one)(0.5)
    same(jax.vmap(jax.jacfwd(one))(states()[:, 0]), jax.vmap(jax.jacfwd(function))(states()[:, 0]))


@jax.custom_vjp
def clipped(x):
    return x * 2


clipped.defvjp(lambda x: (x * 2, x), lambda x, g: (jnp.clip(g, -1, 1) * jnp.sign(x),))


def test_a_derivative_of_its_own_is_taken_with_jaxs_own_error():
    def function(x):
        return (clipped(jnp.sin(x)) * 3).sum()

    one = fuse(function, on_unsupported="raise")
    same(jax.grad(one)(states()[0]), jax.grad(function)(states()[0]))
    with pytest.raises(TypeError, match=r"forward-mode .*custom_vjp function"):
        jax.jvp(one, (states()[0],), (states()[1],))


def test_what_is_linear_can_be_transposed():
    def function(x, y):
        return x[::-1] * jnp.sin(y), x.sum()

    def transposed(one):
        x, y = states()[:2]
        return jax.linear_transpose(lambda x: one(x, y), x)((y, np.float32(2)))

    same(transposed(fuse(function, on_unsupported="raise")), transposed(function))


def spectrum(x):
    return jnp.abs(jnp.fft.rfft(x)) * x[0]


def long(x):
    def step(y, _):
        return jnp.sin(y), None

    return jax.lax.scan(step, x, length=6000)[0]


def test_what_cannot_be_a_kernel_is_told_in_one_line_and_xla_computes_it():
    one = fuse(long)
    reason = r"one kernel cannot do arguments and results of 72,0\d\d bytes for each instance"
    with pytest.warns(
        UserWarning, match=f"^XLA computes the derivative of long, slower: {reason}"
    ) as told:
        gradients = [jax.jit(jax.vmap(jax.grad(loss(one))))(states()) for _ in range(2)]
    assert len(told) == 1
    same(gradients[1], jax.vmap(jax.grad(loss(long)))(states()))
    with pytest.raises(UnsupportedError, match="72,0"):
        jax.grad(loss(fuse(long, on_unsupported="raise")))(states()[0])
    told = []
    jax.grad(loss(fuse(long, on_unsupported=told.append)))(states()[0])
    assert len(told) == 2
    # The function is no kernel, and so JAX differentiates it.
    x = states(1, 4)[0]
    same(jax.grad(loss(fuse(spectrum, on_unsupported="xla")))(x), jax.grad(loss(spectrum))(x))


def test_without_kernels_xla_computes_both(monkeypatch):
    for backend in BACKENDS:
        monkeypatch.setattr(backend, "obstacle", lambda: "it is broken")
    one = fuse(trajectory, on_unsupported="xla")
    same(jax.vmap(jax.grad(loss(one)))(states()), jax.vmap(jax.grad(loss(trajectory)))(states()))


def test_shard_map_sums_the_gradient_of_what_all_devices_share():
    mesh = jax.make_mesh((1,), ("x",), axis_types=(jax.sharding.AxisType.Auto,))
    shares, all_of_it = jax.P("x"), jax.P()

    def gradients(one):
        def share(x, gain):
            total = lambda gain: jax.vmap(lambda x: one(x, gain))(x).sum()  # noqa: E731
            return jax.vmap(jax.grad(one), in_axes=(0, None))(x, gain), jax.grad(total)(gain)

        specs = {"in_specs": (shares, all_of_it), "out_specs": (shares, all_of_it)}
        return jax.jit(jax.shard_map(share, mesh=mesh, **specs))(states(), jnp.float32(0.5))

    def function(x, gain):
        return jnp.sin(gain * x[0]) * x[1] + trajectory(x)[0].sum()

    same(gradients(fuse(function, on_unsupported="raise")), gradients(function))


def test_each_is_compared_with_xla_if_kernels_are_to_be_checked(monkeypatch):
    compared = []
    monkeypatch.setenv(fused.CHECK, "1")
    monkeypatch.setattr(fused, "check", lambda kernel, *dtypes: compared.append(kernel))
    one = fuse(lorenz, on_unsupported="raise")
    for _ in range(2):
        jax.grad(loss(one))(states()[0])
    # The function, forward and backward.
    assert len({*compared}) == len(compared) == 3
