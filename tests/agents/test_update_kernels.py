"""The kernels of PPO's update: their text is executed by a model of a GPU, and LLVM compiles it."""

import functools
import itertools
import re

import jax
import numpy as np
import pytest

from helpers import simt
from helpers.further import slow_unless
from helpers.update_cases import (
    CASES,
    COUNT,
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
from jetbot_mjx.agents.fused import gpu_tiling, launch, launch_cpu
from jetbot_mjx.agents.fused.adam import AdamRule
from jetbot_mjx.agents.fused.gpu_actions import ActionKernel
from jetbot_mjx.agents.fused.gpu_advantages import AdvantageKernel
from jetbot_mjx.agents.fused.gpu_gradient import GradientKernel
from jetbot_mjx.agents.fused.gpu_tiling import Tiling
from jetbot_mjx.agents.fused.launch_gpu import PTX_VERSION
from jetbot_mjx.agents.fused.shapes import DataSizes, UpdateShape
from onekernel import cpu, gpu

pytest.importorskip("llvmlite")


WARPS, SWISH = "a warp for 16 rows", "swish, advantages as they are"


def drawn(shape, environments):
    """The shapes of `launch.Actions`."""
    shapes = signatures.ACTIONS.shapes(shape, DataSizes(environments=environments))
    return [shapes[name] for name in launch.Actions._fields]


# Three layers of tanh are among the quick ones, and so are tiles of every other size.
FURTHER_ADVANTAGES = "three layers of 128", "four layers, small tiles", SWISH


@pytest.mark.slow
@pytest.mark.parametrize("name", slow_unless(lambda name: name not in FURTHER_ADVANTAGES, CASES))
def test_the_advantages_are_those_of_float64(name):
    case = CASES[name]
    made = [make_data(case, seed) for seed in range(case.seeds)]
    tiling = Tiling(case.shape, case.rows, -(-case.rows // 128), "advantages")
    blocks = min(case.blocks, tiling.tiles(case.batch))
    kernel = AdvantageKernel(tiling, case.batch._replace(minibatches=COUNT), blocks)
    results = [
        np.full((case.seeds, *rest), np.nan, np.float32)
        for rest in (case.batch[1:3], case.batch[1:3], (blocks, 2))
    ]
    arrays = [*stacked(made, *NETWORK, "last", "unroll_indices", "index"), terms_of(case), *results]
    sizes = kernel.threads, kernel.shared_memory
    simt.run(kernel.text(), arrays, (blocks, 1, case.seeds), *sizes)
    for data, advantage, target, parts in zip(made, *results, strict=True):
        np.testing.assert_allclose(advantage, data.advantages, atol=0.01)
        np.testing.assert_allclose(target, data.targets, atol=0.01)
        squares = np.sum(advantage.astype(np.float64) ** 2)
        np.testing.assert_allclose(parts.sum(0), [advantage.sum(), squares], rtol=1e-4, atol=1e-3)


def gradients(case, made, parts):
    """The gradients of a GPU's kernel, by the sums of the advantages and of their squares."""
    tiling = Tiling(case.shape, *case.gradient)
    blocks = min(case.blocks, tiling.tiles(case.batch))
    kernel = GradientKernel(tiling, case.batch._replace(minibatches=COUNT), blocks, parts.shape[1])
    estimated = [
        np.stack([x.astype(np.float32) for x in column])
        for column in zip(*((data.advantages, data.targets) for data in made), strict=True)
    ]
    result = np.full((case.seeds, blocks, case.shape.size), np.nan, np.float32)
    arrays = [*stacked(made, *NETWORK, "unroll_indices", "noise", "index"), *estimated, parts]
    arrays += [terms_of(case), result]
    sizes = kernel.threads, kernel.shared_memory
    simt.run(kernel.text(), arrays, (blocks, 2, case.seeds), *sizes)
    return result.astype(np.float64).sum(1)


@pytest.mark.parametrize("name", slow_unless(lambda name: name != WARPS, CASES))
def test_the_gradient_is_that_of_float64(name):
    case = CASES[name]
    made = [make_data(case, seed) for seed in range(case.seeds)]
    # The sums of the advantages in three parts.
    thirds = [np.array_split(data.advantages.ravel(), 3) for data in made]
    parts = np.array([[[x.sum(), (x**2).sum()] for x in third] for third in thirds], np.float32)
    for data, vector in zip(made, gradients(case, made, parts), strict=True):
        assert_is_gradient(vector, data, 0.01)


@pytest.mark.parametrize("rounding", [-1e-6, -1e-7, 0.0, 1e-7])
def test_advantages_that_are_nearly_equal_are_not_blown_up(rounding):
    case = CASES["48 units"]
    data = make_data(case, 0)
    advantages = 300.0 + 1e-3 * data.advantages
    sums = [advantages.sum(), (advantages**2).sum() * (1 + rounding)]
    nearly_equal = [data._replace(advantages=advantages)]
    (vector,) = gradients(case, nearly_equal, np.array([[sums]], np.float32))
    # Normalised, they have a deviation of at most 1, and the largest ratio is 2.5.
    (policy_loss, *_) = AdamRule(case.shape, case.batch.samples, "NONE", 1).metric_places
    assert abs(vector[policy_loss]) <= 2.5 * case.batch.samples


# Sizes that only CPUs take; parts of several unrolls, and the last one with fewer.
CPU_CASES = {
    **CASES,
    "a layer of 256": Case(
        UpdateShape(70, 256, 1, 5, "tanh_normal", "elu"), DataSizes(90, 90, 3), (0, 0), 0
    ),
    "several parts": Case(
        UpdateShape(3, 16, 2, 1, "normal", "tanh"), DataSizes(90, 70, 11), (0, 0), 0, seeds=2
    ),
}


# By the number of lanes: every network on this processor, and every activation on another.
QUICK_LANES = {
    None: [name for name in CPU_CASES if name != WARPS],
    8: ("three layers of 128", "two seeds, one step"),
    4: ("48 units", "80 units, normal"),
}


@pytest.mark.cpu
@pytest.mark.parametrize(
    ("name", "lanes", "registers"),
    slow_unless(
        lambda name, lanes, _: name in QUICK_LANES[lanes],
        [(name, *host) for name in CPU_CASES for host in [(None, None), (8, 16), (4, 32)]],
    ),
)
def test_the_gradient_on_a_cpu_is_that_of_float64(name, lanes, registers, monkeypatch):
    if lanes is not None:
        host = cpu.host_processor()._replace(lanes=lanes, registers=registers)
        monkeypatch.setattr(cpu, "host_processor", lambda: host)
    case = CPU_CASES[name]
    made = [make_data(case, seed) for seed in range(case.seeds)]
    arrays = [*stacked(made, *NETWORK, *DRAWN), terms_of(case)]
    result = jax.jit(jax.vmap(functools.partial(launch.gradient, case.shape)))(*arrays)
    for data, vector in zip(made, np.asarray(result), strict=True):
        assert_is_gradient(vector, data, 2e-4)


@pytest.mark.cpu
def test_the_gradient_on_a_cpu_does_not_depend_on_the_policies_beside_it():
    case = CPU_CASES["several parts"]
    made = [make_data(case, seed) for seed in range(2)]
    arrays = [*stacked(made, *NETWORK, *DRAWN), terms_of(case)]
    run = jax.jit(jax.vmap(functools.partial(launch.gradient, case.shape)))
    both = run(*arrays)
    for i in range(2):
        np.testing.assert_array_equal(run(*(x[i : i + 1] for x in arrays))[0], both[i])


@pytest.mark.cpu
@pytest.mark.parametrize(
    ("shape", "batch", "reason"),
    [
        (
            UpdateShape(16, 128, 3, 9, "tanh_normal", "tanh"),
            DataSizes(9, 9, 9),
            "16 outputs, not 18",
        ),
        (UpdateShape(16, 40, 3, 2, "normal", "tanh"), DataSizes(9, 9, 9), "48, ... units, not 40"),
        (
            UpdateShape(16, 128, 3, 2, "normal", "tanh"),
            DataSizes(9, 9, 2000),
            "2000 steps do not fit",
        ),
    ],
)
def test_it_says_what_a_cpu_cannot_compute(shape, batch, reason):
    assert reason in launch_cpu.refusal(shape, batch)


# Of every network the tiles of one size, and of one network those of two sizes.
QUICK_ROWS = {
    32: ("48 units", "four layers, small tiles", SWISH),
    64: ("three layers of 128", "two seeds, one step"),
    256: ("48 units", "80 units, normal"),
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "rows"),
    slow_unless(lambda name, rows: name in QUICK_ROWS[rows], itertools.product(CASES, QUICK_ROWS)),
)
def test_the_actions_are_those_of_float64(name, rows):
    shape, environments = CASES[name].shape, 2 * rows + 23
    made = [make_actions(shape, environments, seed) for seed in range(2)]
    tiling = Tiling(shape, rows, -(-rows // 128), "actions")
    given = [np.stack(x) for x in zip(*(arrays for arrays, _ in made), strict=True)]
    results = [np.full((2, *size), np.nan, np.float32) for size in drawn(shape, environments)]
    # Of two blocks, the model runs the one with the second tile after that with the third.
    for blocks in (1, 2):
        kernel = ActionKernel(tiling, DataSizes(environments=environments), blocks)
        sizes = (blocks, 1, 2), kernel.threads, kernel.shared_memory
        simt.run(kernel.text(), [*given, *results], *sizes)
    for i, (_, expected) in enumerate(made):
        assert_are_actions([x[i] for x in results], shape, expected, 0.02)


# Of every network one number of environments, and of one network two.
QUICK_ENVIRONMENTS = {
    1: ("48 units", "four layers, small tiles", "two seeds, one step"),
    150: ("48 units", "three layers of 128", "80 units, normal", "a layer of 256"),
    4100: ("several parts", SWISH),
}


@pytest.mark.slow
@pytest.mark.cpu
@pytest.mark.parametrize(
    ("name", "environments"),
    slow_unless(
        lambda name, environments: name in QUICK_ENVIRONMENTS[environments],
        itertools.product(CPU_CASES, QUICK_ENVIRONMENTS),
    ),
)
def test_the_actions_on_a_cpu_are_those_of_float64(name, environments):
    shape = CPU_CASES[name].shape
    made = [make_actions(shape, environments, seed) for seed in range(2)]
    given = [np.stack(x) for x in zip(*(arrays for arrays, _ in made), strict=True)]
    run = jax.jit(jax.vmap(functools.partial(launch.actions, shape)))
    results = run(*given)
    for i, (arrays, expected) in enumerate(made):
        ours = [np.asarray(x[i]) for x in results]
        assert_are_actions(ours, shape, expected, 2e-5)
        alone = run(*(x[None] for x in arrays))
        for one, other in zip(alone, ours, strict=True):
            np.testing.assert_array_equal(one[0], other)


@pytest.mark.cpu
@pytest.mark.parametrize("spread", [50.0, 1e4])
@pytest.mark.parametrize("name", ["two seeds, one step", "80 units, normal"])
def test_the_actions_at_the_ends_of_their_ranges_are_those_of_float64(name, spread):
    shape = CASES[name].shape
    arrays, expected = make_actions(shape, 40, 0, spread)
    on_a_cpu = jax.jit(functools.partial(launch.actions, shape))
    on_a_gpu = [np.full(size, np.nan, np.float32) for size in drawn(shape, 40)]
    kernel = ActionKernel(Tiling(shape, 32, 1, "actions"), DataSizes(environments=40), 2)
    sizes = (2, 1, 1), kernel.threads, kernel.shared_memory
    simt.run(kernel.text(), [*arrays, *on_a_gpu], *sizes)
    for results in ([np.asarray(x) for x in on_a_cpu(*arrays)], on_a_gpu):
        for ours, wanted in zip(results, expected, strict=True):
            # Of the largest numbers, the distance from the mean is what rounding leaves of it.
            np.testing.assert_allclose(ours, wanted, rtol=1e-3, atol=spread * 1e-3)
        assert np.isfinite(np.concatenate([np.ravel(x) for x in results])).all()


@pytest.mark.parametrize(
    ("environments", "memory", "rows"),
    [(4096, 232_448, 32), (65_536, 232_448, 256), (65_536, 166_912, 128), (65_536, 101_376, 32)],
)
def test_a_tile_of_actions_fills_the_gpu(environments, memory, rows):
    shape = UpdateShape(16, 128, 3, 2, "tanh_normal", "tanh")
    batch = DataSizes(environments=environments)
    assert gpu_tiling.best_tiling("actions", shape, batch, 132, memory).rows == rows


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "architecture"),
    slow_unless(
        lambda name, architecture: architecture == 90 or name in ("48 units", SWISH),
        itertools.product(CASES, [80, 90]),
    ),
)
def test_llvm_compiles_them(name, architecture):
    case = CASES[name]
    others = (Tiling(case.shape, 64, 1, purpose) for purpose in ("advantages", "actions"))
    tilings = Tiling(case.shape, *case.gradient), *others
    kernels = (
        GradientKernel(tilings[0], DataSizes(4096, 512, 16), 66, 74),
        AdvantageKernel(tilings[1], DataSizes(4096, 512, 16), 74),
        ActionKernel(tilings[2], DataSizes(environments=4096), 132),
    )
    for tiling, kernel in zip(tilings, kernels, strict=True):
        ptx = gpu.assembled(kernel.text(), architecture, PTX_VERSION)
        assert f".target sm_{architecture}" in ptx
        assert f".maxntid {tiling.threads}" in ptx
        assert "mma.sync.aligned.m16n8k16.row.col.f32.f16.f16.f32" in ptx
        assert not re.search(r"\b(ld|st)\.local", ptx)


@pytest.mark.parametrize(
    ("width", "layers", "activation", "memory", "rows"),
    [
        (128, 3, "tanh", 232_448, 128),
        (128, 3, "tanh", 166_912, 64),
        (128, 3, "swish", 232_448, 64),
        (128, 3, "tanh", 101_376, None),
        (128, 1, "tanh", 101_376, 128),
        (64, 3, "tanh", 101_376, 64),
    ],
)
def test_the_tile_is_the_largest_that_fits(width, layers, activation, memory, rows):
    shape = UpdateShape(16, width, layers, 2, "tanh_normal", activation)
    tiling = gpu_tiling.best_tiling("gradient", shape, DataSizes(9, 9, 9), 1, memory)
    assert (tiling.rows if tiling else None) == rows
