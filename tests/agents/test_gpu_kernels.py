"""PPO's kernels as `launch_gpu` launches them, with its tiles and grids, on a model of a GPU."""

import functools
import math

import jax
import numpy as np
import pytest

from helpers import simt
from helpers.update_cases import (
    DRAWN,
    NETWORK,
    Case,
    assert_are_actions,
    assert_is_gradient,
    make_actions,
    make_data,
    stacked,
    terms_of,
)
from jetbot_mjx.agents.fused import arrays as signatures
from jetbot_mjx.agents.fused import launch_cpu, launch_gpu
from jetbot_mjx.agents.fused.adam import SIZES, AdamRule
from jetbot_mjx.agents.fused.shapes import DataSizes, UpdateShape

pytest.importorskip("llvmlite")

SHAPES = {
    "swish": UpdateShape(7, 48, 2, 2, "tanh_normal", "swish"),
    "relu": UpdateShape(33, 64, 2, 3, "normal", "relu", normalizes=False),
    "elu": UpdateShape(5, 32, 1, 1, "normal", "elu"),
    "tanh": UpdateShape(16, 128, 2, 2, "tanh_normal", "tanh"),
}
"""Networks by their activation function."""

CASES = [
    # Policies that share the multiprocessors, and blocks with several tiles, of which the last one
    # is not full.
    ("swish", DataSizes(40, 37, 9), 2, 90),
    ("relu", DataSizes(20, 13, 10), 1, 86),
    pytest.param("elu", DataSizes(90, 90, 5), 3, 80, marks=pytest.mark.slow),
    # Several blocks of one policy.
    ("tanh", DataSizes(20, 19, 16), 1, 80),
]
"""Networks, minibatch, policies, and the GPU's compute capability."""


def launched_by(launcher, kernel, spec, arrays):
    """The results of a kernel that a launcher launches."""
    given = dict(zip(kernel.arguments, arrays, strict=True))
    return launcher.launch(kernel, spec, kernel.batch_of(spec, arrays), given)


@pytest.fixture
def model(monkeypatch):
    """Launches run on the model of a GPU, and what they have prepared is not for others."""

    def clear():
        for function in vars(launch_gpu).values():
            if hasattr(function, "cache_clear"):
                function.cache_clear()

    clear()
    yield functools.partial(simt.replace_gpu, monkeypatch)
    clear()


@pytest.mark.parametrize(("name", "batch", "policies", "capability"), CASES)
def test_a_gradient_is_that_of_float64(name, batch, policies, capability, model):
    model(capability)
    case = Case(SHAPES[name], batch, (0, 0), 0, seeds=policies)
    assert launch_gpu.refusal(case.shape, batch) is None
    made = [make_data(case, seed) for seed in range(policies)]
    arrays = [*stacked(made, *NETWORK, *DRAWN), terms_of(case)]
    (vectors,) = launched_by(launch_gpu, signatures.GRADIENT, case.shape, arrays)
    for data, vector in zip(made, vectors, strict=True):
        assert_is_gradient(vector.astype(np.float64), data, 0.01)


@pytest.mark.parametrize("launcher", [launch_gpu, launch_cpu])
@pytest.mark.parametrize("name", ["swish", "relu"])
def test_a_ratio_that_overflows_makes_the_gradient_not_finite(name, launcher, model):
    """So that Adam's step is left out: float16 and simplified programs must not hide it."""
    if launcher is launch_gpu:
        model()
    shape, case = SHAPES[name], Case(SHAPES[name], DataSizes(20, 13, 10), (0, 0), 0)
    made = [make_data(case, 0)]
    arrays = [*stacked(made, *NETWORK, *DRAWN), terms_of(case)]
    place, rows = shape.columns["log_prob"], signatures.GRADIENT.arguments.index("rows")
    arrays[rows] = arrays[rows].copy()
    # The actions were unlikely in the collection: exp overflows.
    arrays[rows][..., place] = -1e4
    run = functools.partial(launched_by, launcher, signatures.GRADIENT, shape)
    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        (vector, *_) = run(arrays) if launcher is launch_gpu else jax.jit(run)(arrays)
    start, stop = shape.ranges[0]
    assert not np.isfinite(np.sum(np.square(vector[0, start:stop])))
    # The value network does not know of it.
    start, stop = shape.ranges[1]
    assert np.isfinite(vector[0, start:stop]).all()


@pytest.mark.parametrize("environments", [1, 150])
@pytest.mark.parametrize("name", SHAPES)
def test_actions_are_those_of_float64(name, environments, model):
    model(processors=5)
    made = [make_actions(SHAPES[name], environments, seed) for seed in range(2)]
    given = [np.stack(x) for x in zip(*(arrays for arrays, _ in made), strict=True)]
    results = launched_by(launch_gpu, signatures.ACTIONS, SHAPES[name], given)
    for i, (_, expected) in enumerate(made):
        assert_are_actions([x[i] for x in results], SHAPES[name], expected, 0.02)


@pytest.mark.slow
@pytest.mark.parametrize("schedule", ["NONE", "LINEAR", "ADAPTIVE_KL"])
@pytest.mark.parametrize("name", ["swish", "relu", "elu"])
def test_a_step_of_adam_is_that_of_a_cpu(name, schedule, model):
    """Three policies at different steps, one without a finite gradient, in up to three blocks."""
    model(processors=9)
    rule, policies = AdamRule(SHAPES[name], 64, schedule, 4), 3
    rng = np.random.default_rng(0)
    vectors = [np.abs(rng.normal(size=(policies, rule.shape.size))) for _ in range(4)]
    vectors[0][1, 3] = np.nan
    progress = np.full((policies, rule.steps + 1, SIZES["progress"]), np.nan)
    index = np.arange(policies, dtype=np.int32)
    progress[index, index] = [1e-3, 0.9, 0.999, *range(SIZES["progress"] - 3)]
    terms = [[limit, 2e-3, 0.25, 0.01, 0.1, 1e-5, 1e-2] for limit in (1.0, 9.0, np.inf)]
    arrays = [*(x.astype(np.float32) for x in (*vectors, progress)), index, np.float32(terms)]
    ours = launched_by(launch_gpu, signatures.ADAM, rule, arrays)
    with jax.default_device(jax.devices("cpu")[0]):
        run = jax.jit(lambda *given: launched_by(launch_cpu, signatures.ADAM, rule, given)[:4])
        theirs = run(*arrays)
    for i, (one, other) in enumerate(zip(ours, theirs, strict=True)):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-7)
        # The policy in the middle keeps what it has.
        (argument,) = (key for key, value in signatures.ADAM.aliases.items() if value == i)
        if i < 3:
            np.testing.assert_array_equal(one[1], arrays[argument][1])
            assert (one[0] != arrays[argument][0]).mean() > 0.9


def small_gradient():
    """Several tiles of both kernels, and two networks whose layers several warps share."""
    shape = UpdateShape(7, 32, 2, 2, "tanh_normal", "tanh", normalizes=False)
    case = Case(shape, DataSizes(14, 14, 20), (0, 0), 0)
    made = [make_data(case, 0)]
    launched_by(
        launch_gpu, signatures.GRADIENT, shape, [*stacked(made, *NETWORK, *DRAWN), terms_of(case)]
    )


def small_actions():
    shape = UpdateShape(7, 32, 2, 2, "tanh_normal", "tanh")
    launched_by(
        launch_gpu, signatures.ACTIONS, shape, [x[None] for x in make_actions(shape, 600, 0)[0]]
    )


def small_adam():
    rule = AdamRule(SHAPES["elu"], 64, "NONE", 1)
    shapes = signatures.ADAM.shapes(rule, DataSizes()).values()
    arrays = [
        np.arange(math.prod(x), dtype=np.float32).reshape(1, *x) + np.float32(1) for x in shapes
    ]
    arrays[5] = np.zeros(1, np.int32)
    launched_by(launch_gpu, signatures.ADAM, rule, arrays)


@pytest.mark.slow
@pytest.mark.parametrize("launch", [small_gradient, small_actions, small_adam])
def test_without_any_one_of_their_barriers_threads_race(launch, model, monkeypatch):
    model(processors=1)
    run, launched = simt.run, []

    def record(text, arrays, *sizes):
        # An array that is also a result is one array in the copy, too.
        copies = {x.ctypes.data: x.copy() for x in arrays}
        launched.append((text, [copies[x.ctypes.data] for x in arrays], sizes))
        run(text, arrays, *sizes)

    monkeypatch.setattr(simt, "run", record)
    launch()
    assert launched
    for text, arrays, sizes in launched:
        lines = text.splitlines(keepends=True)
        places = [i for i, line in enumerate(lines) if '"bar.' in line]
        assert len(places) > 1
        for i in places:
            with pytest.raises(simt.Fault, match="a race: another thread"):
                run("".join(lines[:i] + lines[i + 1 :]), arrays, *sizes)
