"""The kernels of PPO's update: their text is executed by a model of a GPU, and LLVM compiles it."""

import re
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.distribution import NormalDistribution, NormalTanhDistribution
from gpu_model import Gpu

from jetbot_mjx.compiler import ppo_kernel, ptx_backend
from jetbot_mjx.compiler.ppo_kernel import LossTerms, Tiling, UpdateShape

pytest.importorskip("llvmlite")

TERMS = LossTerms(clipping_epsilon=0.2, entropy_cost=0.01, value_coefficient=0.7)
ACTIVATIONS = {
    "tanh": jnp.tanh,
    "relu": jax.nn.relu,
    "elu": jax.nn.elu,
    "swish": jax.nn.swish,
}

# Shape, rows of a tile, row tiles of a warp, samples, blocks, seeds: with tiles that are not full,
# layers that eight warps cannot divide evenly, and observations that do not fill a tile.
CASES = {
    "three layers of 128": (UpdateShape(16, 128, 3, 2, "tanh_normal", "tanh"), 128, 2, 200, 1, 1),
    "a warp for 16 rows": (UpdateShape(16, 128, 3, 2, "tanh_normal", "tanh"), 128, 1, 300, 2, 1),
    "48 units": (UpdateShape(5, 48, 2, 2, "tanh_normal", "elu"), 128, 2, 300, 2, 1),
    "80 units, normal": (UpdateShape(7, 80, 1, 3, "normal", "relu"), 128, 2, 130, 1, 1),
    "four layers, small tiles": (UpdateShape(33, 64, 4, 2, "normal", "tanh"), 64, 1, 130, 1, 1),
    "two seeds, smallest tiles": (
        UpdateShape(64, 16, 1, 4, "tanh_normal", "swish"),
        32,
        1,
        70,
        2,
        2,
    ),
    "112 units, swish": (UpdateShape(16, 112, 2, 2, "normal", "swish"), 32, 1, 70, 1, 1),
}


class Case(NamedTuple):
    """Arguments of the kernel with a first axis for the seeds, and what they should give."""

    arguments: list
    gradient: list
    values: np.ndarray


def network(rng, shape, outputs):
    """Weights and biases; the last ones are small, so that no sample has all the weight."""
    sizes = [shape.width] * shape.layers + [outputs]
    leaves = []
    for inputs, size in zip(shape.inputs, sizes, strict=True):
        leaves += [
            rng.normal(size=(inputs, size)) * 1.2 / np.sqrt(inputs),
            0.1 * rng.normal(size=size),
        ]
    leaves[-2] *= 0.3
    return leaves


def forward(layers, data, shape):
    """The outputs of a network."""
    x = (data["observation"] - data["mean"]) * data["scale"]
    for i in range(0, len(layers), 2):
        x = x @ layers[i] + layers[i + 1]
        x = ACTIVATIONS[shape.activation](x) if i + 2 < len(layers) else x
    return x


def policy(leaves, data, shape):
    """Brax's distribution, and its parameters by the policy network."""
    parameters = forward(leaves[0], data, shape)
    if shape.distribution == "tanh_normal":
        return NormalTanhDistribution(shape.actions), parameters
    scale = jnp.broadcast_to(leaves[1][0], parameters.shape)
    return NormalDistribution(shape.actions), (parameters, scale)


def loss(leaves, data, shape):
    """Brax's loss by given advantages and targets, with the sums of the metrics and the values."""
    brax, parameters = policy(leaves, data, shape)
    current, old = brax.create_dist(parameters), data["old"]
    ratio = jnp.exp(brax.log_prob(parameters, data["action"]) - data["log_prob"])
    clipped = jnp.clip(ratio, 1 - TERMS.clipping_epsilon, 1 + TERMS.clipping_epsilon)
    surrogate = -jnp.minimum(ratio * data["advantage"], clipped * data["advantage"])
    entropy = current.entropy()
    if shape.distribution == "normal":
        old = old[:, : shape.actions], old[:, shape.actions :]
    else:
        sample = data["noise"] * current.scale + current.loc
        entropy += brax._postprocessor.forward_log_det_jacobian(sample)
    entropy = entropy.sum(-1)
    values = forward(leaves[2], data, shape)[:, 0]
    error = (data["target"] - values) ** 2
    divergence = current.kl_divergence(brax.create_dist(old))
    scale = jnp.broadcast_to(current.scale, current.loc.shape)
    sums = [x.sum() for x in (surrogate, entropy, divergence, scale, error)]
    total = surrogate.mean() - TERMS.entropy_cost * entropy.mean()
    return total + 0.5 * TERMS.value_coefficient * error.mean(), (sums, values)


def make_case(shape, samples, seed):
    """A case of one seed."""
    rng = np.random.default_rng(seed)
    leaves = (
        network(rng, shape, shape.outputs[0]),
        [np.abs(rng.normal(size=shape.actions)) + 0.5] if shape.deviations else [],
        network(rng, shape, 1),
    )
    data = {
        "mean": rng.normal(size=shape.observations),
        "scale": 1 / (0.5 + np.abs(rng.normal(size=shape.observations))),
        "observation": rng.normal(size=(samples, shape.observations)),
        "action": 0.7 * rng.normal(size=(samples, shape.actions)),
        "log_prob": np.zeros(samples),
        "old": 0.5 * rng.normal(size=(samples, 2 * shape.actions)),
        "noise": rng.normal(size=(samples, shape.actions)),
        "advantage": rng.choice([-0.3, 2.0], size=samples) * (1 + rng.uniform(size=samples)),
        "target": rng.normal(size=samples),
    }
    if shape.deviations:
        data["old"][:, shape.actions :] = np.abs(data["old"][:, shape.actions :]) + 0.3
    with jax.enable_x64(True):
        leaves, arrays = jax.tree.map(jnp.asarray, (leaves, data))
        brax, parameters = policy(leaves, arrays, shape)
        # Ratios far from the ends of the clip range, where rounding would decide.
        ratios = rng.choice([0.4, 1.0, 2.5], size=samples)
        arrays["log_prob"] = brax.log_prob(parameters, arrays["action"]) - np.log(ratios)
        gradient, (sums, values) = jax.grad(loss, has_aux=True)(leaves, arrays, shape)
    parts = [*gradient[0], *gradient[1], *sums[:4], *gradient[2], sums[4]]
    flat = [*leaves[0], *leaves[1], np.zeros(4), *leaves[2], np.zeros(1)]
    params = np.concatenate([np.ravel(x) for x in flat])
    arguments = [np.asarray(x, np.float32) for x in (params, *(arrays[name] for name in data))]
    return Case(arguments, [np.ravel(x) for x in parts], np.asarray(values))


@pytest.mark.parametrize("name", CASES)
def test_the_gradient_is_that_of_float64(name):
    shape, rows, row_tiles, samples, blocks, seeds = CASES[name]
    cases = [make_case(shape, samples, seed) for seed in range(seeds)]
    arguments = [np.stack(x) for x in zip(*(case.arguments for case in cases), strict=True)]
    result = np.full((seeds, blocks, shape.size), np.nan, np.float32)
    text = ppo_kernel.gradient_text(Tiling(shape, rows, row_tiles), samples, TERMS)
    Gpu(text, [*arguments, result]).run(blocks, 2, seeds)
    for case, parts in zip(cases, result, strict=True):
        total, start = parts.astype(np.float64).sum(0), 0
        for expected in case.gradient:
            ours = total[start : start + expected.size]
            start += expected.size
            error = np.linalg.norm(ours - expected) / np.linalg.norm(expected)
            assert error < 0.05, (start, expected.size)
        assert start == shape.size


@pytest.mark.parametrize("name", CASES)
def test_the_values_are_those_of_float64(name):
    shape, rows, row_tiles, samples, blocks, _ = CASES[name]
    case = make_case(shape, samples, 0)
    params, mean, scale, observation = case.arguments[:4]
    result = np.full(samples, np.nan, np.float32)
    # The last ones in an array of their own.
    arrays = [params, mean, scale, observation[:-9].copy(), observation[-9:].copy(), result]
    Gpu(ppo_kernel.values_text(Tiling(shape, rows, row_tiles), samples - 9, 9), arrays).run(blocks)
    np.testing.assert_allclose(result, case.values, atol=0.03)


@pytest.mark.parametrize("architecture", [80, 90])
@pytest.mark.parametrize("name", CASES)
def test_llvm_compiles_it(name, architecture):
    shape, rows, row_tiles, *_ = CASES[name]
    text = ppo_kernel.gradient_text(Tiling(shape, rows, row_tiles), 8192, TERMS)
    ptx = ptx_backend.assembled(text, architecture)
    assert f".target sm_{architecture}" in ptx
    assert f".maxntid {ppo_kernel.THREADS}" in ptx
    assert "mma.sync.aligned.m16n8k16.row.col.f32.bf16.bf16.f32" in ptx
    assert not re.search(r"\b(ld|st)\.local", ptx)


@pytest.mark.parametrize(
    ("width", "layers", "activation", "memory", "rows"),
    [
        (128, 3, "tanh", 232_448, 128),
        (128, 3, "tanh", 166_912, 64),
        (128, 3, "swish", 232_448, 64),
        (128, 3, "tanh", 101_376, None),
        (128, 1, "tanh", 101_376, 128),
        (64, 3, "tanh", 101_376, 128),
    ],
)
def test_the_tile_is_the_largest_that_fits(width, layers, activation, memory, rows):
    shape = UpdateShape(16, width, layers, 2, "tanh_normal", activation)
    tiling = ppo_kernel.choose_tiling(shape, memory)
    assert (tiling.rows if tiling else None) == rows
