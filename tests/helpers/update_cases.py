"""Minibatches for the kernels of PPO, with what float64 makes of them."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from brax.training.distribution import NormalDistribution, NormalTanhDistribution

from jetbot_mjx.agents.fused.shapes import DataSizes, LossTerms, UpdateShape
from jetbot_mjx.agents.gae import compute_gae

TERMS = LossTerms(
    clipping_epsilon=0.2,
    entropy_cost=0.01,
    vf_loss_coefficient=0.7,
    discounting=0.9,
    gae_lambda=0.8,
    reward_scaling=2.0,
)

ACTIVATIONS = {
    "tanh": jnp.tanh,
    "relu": jax.nn.relu,
    "elu": jax.nn.elu,
    "swish": jax.nn.swish,
}

COUNT, INDEX = 3, 1
"""Minibatches of a training step, and the one that the kernels compute."""


class Case(NamedTuple):
    """A minibatch, and how it is divided among blocks."""

    shape: UpdateShape
    batch: DataSizes
    gradient: tuple[int, int]
    """Rows of a tile, and row tiles of a warp."""
    rows: int
    """Rows of a tile of the advantages."""
    blocks: int = 1
    seeds: int = 1


# With tiles that are not full, layers that eight warps cannot divide evenly, unrolls that do not
# fill a tile, and observations that do not either.
CASES = {
    "three layers of 128": Case(
        UpdateShape(16, 128, 3, 2, "tanh_normal", "tanh"), DataSizes(30, 25, 8), (128, 2), 128
    ),
    "a warp for 16 rows": Case(
        UpdateShape(16, 128, 3, 2, "tanh_normal", "tanh"), DataSizes(20, 19, 16), (128, 1), 256, 2
    ),
    "48 units": Case(
        UpdateShape(5, 48, 2, 2, "tanh_normal", "elu"), DataSizes(60, 50, 6), (128, 2), 64, 2
    ),
    "80 units, normal": Case(
        UpdateShape(7, 80, 1, 3, "normal", "relu"), DataSizes(5, 2, 65), (128, 2), 128
    ),
    "four layers, small tiles": Case(
        UpdateShape(33, 64, 4, 2, "normal", "tanh"), DataSizes(13, 13, 10), (64, 1), 64, 1
    ),
    "two seeds, one step": Case(
        UpdateShape(64, 16, 1, 4, "tanh_normal", "swish"), DataSizes(99, 70, 1), (32, 1), 64, 2, 2
    ),
    "swish, advantages as they are": Case(
        UpdateShape(16, 112, 2, 2, "normal", "swish", normalizes=False),
        DataSizes(12, 7, 10),
        (32, 1),
        64,
    ),
}


class Data(NamedTuple):
    """What the kernels are given for one seed, and what they should give."""

    arguments: dict[str, np.ndarray]
    advantages: np.ndarray
    targets: np.ndarray
    gradient: list[np.ndarray]


def network(rng, shape, outputs):
    """Weights and biases; the last ones are small, so that no sample has all the weight."""
    sizes = [shape.width] * shape.layers + [outputs]
    leaves = []
    for inputs, size in zip(shape.inputs, sizes, strict=True):
        leaves += [
            rng.normal(size=(inputs, size)) * 1.2 / np.sqrt(inputs),
            0.1 * rng.normal(size=size),
        ]
    leaves[-2] *= 0.1
    return leaves


def forward(layers, data, shape):
    """The outputs of a network."""
    x = (data["observation"] - data["mean"]) * data["inverse_std"]
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


def estimates(leaves, data, case):
    """Advantages and targets, of shape (unrolls, time)."""
    values = forward(leaves[2], data, case.shape)[..., 0]
    last = forward(leaves[2], {**data, "observation": data["last"]}, case.shape)[..., 0]
    targets, advantages = compute_gae(
        data["truncation"].T,
        ((1 - data["discount"]) * (1 - data["truncation"])).T,
        data["reward"].T * TERMS.reward_scaling,
        values.T,
        last,
        TERMS.gae_lambda,
        TERMS.discounting,
    )
    return advantages.T, targets.T


def loss(leaves, data, case):
    """Brax's loss by given estimates, with the sums of the metrics."""
    shape = case.shape
    brax, parameters = policy(leaves, data, shape)
    current, old, advantage = brax.create_dist(parameters), data["distribution"], data["advantage"]
    if case.shape.normalizes:
        advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
    ratio = jnp.exp(brax.log_prob(parameters, data["raw_action"]) - data["log_prob"])
    clipped = jnp.clip(ratio, 1 - TERMS.clipping_epsilon, 1 + TERMS.clipping_epsilon)
    surrogate = -jnp.minimum(ratio * advantage, clipped * advantage)
    entropy = current.entropy()
    if shape.distribution == "normal":
        old = old[..., : shape.actions], old[..., shape.actions :]
    else:
        sample = data["noise"].swapaxes(0, 1) * current.scale + current.loc
        entropy += brax._postprocessor.forward_log_det_jacobian(sample)
    entropy = entropy.sum(-1)
    error = (data["target"] - forward(leaves[2], data, shape)[..., 0]) ** 2
    divergence = current.kl_divergence(brax.create_dist(old))
    scale = jnp.broadcast_to(current.scale, current.loc.shape)
    sums = [x.sum() for x in (surrogate, entropy, divergence, scale, error)]
    total = surrogate.mean() - TERMS.entropy_cost * entropy.mean()
    return total + 0.5 * TERMS.vf_loss_coefficient * error.mean(), sums


def random_data(rng, case):
    """A minibatch: `unrolls` of it are taken from the collected ones, which are random as well."""
    shape, (collected, unrolls, time, *_) = case.shape, case.batch
    steps = unrolls, time
    data = {
        "mean": rng.normal(size=shape.observations),
        "inverse_std": 1 / (0.5 + np.abs(rng.normal(size=shape.observations))),
        "observation": rng.normal(size=(*steps, shape.observations)),
        "last": rng.normal(size=(unrolls, shape.observations)),
        "raw_action": 0.7 * rng.normal(size=(*steps, shape.actions)),
        "distribution": 0.5 * rng.normal(size=(*steps, 2 * shape.actions)),
        "reward": rng.normal(size=steps) + 1,
        "discount": rng.choice([0.0, 1.0], size=steps, p=[0.1, 0.9]),
        "truncation": rng.choice([0.0, 1.0], size=steps, p=[0.9, 0.1]),
        "noise": rng.normal(size=(time, unrolls, shape.actions)),
    }
    if shape.deviations:
        old = data["distribution"]
        old[..., shape.actions :] = np.abs(old[..., shape.actions :]) + 0.3
    return data, rng.permutation(collected)[:unrolls].astype(np.int32)


@functools.partial(jax.jit, static_argnums=3)
def reference(leaves, data, log_ratios, case):
    """The data with all that the loss takes, its gradient, and the sums of the metrics.

    Args:
      leaves: the networks.
      data: what `random_data` makes.
      log_ratios: how likely the actions were, beside the current policy's logarithms.
      case: a case.
    """
    brax, parameters = policy(leaves, data, case.shape)
    log_prob = brax.log_prob(parameters, data["raw_action"]) - log_ratios
    advantage, target = estimates(leaves, data, case)
    data = {**data, "log_prob": log_prob, "advantage": advantage, "target": target}
    return data, *jax.grad(loss, has_aux=True)(leaves, data, case)


@functools.cache
def make_data(case, seed):
    """What the kernels are given for one seed, and what float64 makes of it; not to be changed."""
    rng, shape = np.random.default_rng(seed), case.shape
    leaves = (
        network(rng, shape, shape.outputs[0]),
        [np.abs(rng.normal(size=shape.actions)) + 0.5] if shape.deviations else [],
        network(rng, shape, 1),
    )
    data, unrolls = random_data(rng, case)
    # Ratios far from the ends of the clip range, where rounding would decide.
    ratios = rng.choice([0.4, 1.0, 2.5], size=data["reward"].shape)
    with jax.enable_x64(True):
        data, gradient, sums = jax.device_get(reference(leaves, data, np.log(ratios), case))
    parts = [*gradient[0], *gradient[1], *sums[:4], *gradient[2], sums[4]]
    flat = [*leaves[0], *leaves[1], np.zeros(4), *leaves[2], np.zeros(1)]
    # Rows at their places among the collected ones; the others are not numbers.
    columns = [np.atleast_3d(data[name]) for name in shape.columns if name != "size"]
    rows = np.full((case.batch.collected, case.batch.time, shape.columns["size"]), np.nan)
    rows[unrolls] = np.concatenate(columns, axis=-1)
    last = np.full((case.batch.collected, shape.observations), np.nan)
    last[unrolls] = data["last"]
    arguments = {
        "params": np.concatenate([np.ravel(x) for x in flat]),
        "mean": data["mean"],
        "inverse_std": data["inverse_std"],
        "rows": rows,
        "last": last,
        "unroll_indices": unrolls,
        "noise": data["noise"],
    }
    arguments = {
        name: np.asarray(x, np.int32 if name == "unroll_indices" else np.float32)
        for name, x in arguments.items()
    }
    # The other minibatches have no noise, and their unrolls are not there.
    for name, nothing in (("unroll_indices", -1), ("noise", np.nan)):
        whole = np.full((COUNT, *arguments[name].shape), nothing, arguments[name].dtype)
        whole[INDEX] = arguments[name]
        arguments[name] = whole
    arguments["index"] = np.array(INDEX, np.int32)
    estimated = (np.asarray(data[name]) for name in ("advantage", "target"))
    return Data(arguments, *estimated, [np.ravel(x) for x in parts])


def stacked(made, *names):
    """Arguments with a first axis for the seeds."""
    return [np.stack([data.arguments[name] for data in made]) for name in names]


NETWORK = ("params", "mean", "inverse_std", "rows")

DRAWN = ("last", "unroll_indices", "noise", "index")


def terms_of(case):
    return np.array([TERMS] * case.seeds, np.float32)


def assert_is_gradient(vector, data, bound):
    start = 0
    for expected in data.gradient:
        ours = vector[start : start + expected.size]
        start += expected.size
        error = np.linalg.norm(ours - expected) / np.linalg.norm(expected)
        assert error < bound, (start, expected.size)
    assert start == vector.size


@functools.partial(jax.jit, static_argnums=2)
def actions(leaves, data, shape):
    """Actions before and after `tanh`, their log-probabilities, and the networks' outputs."""
    brax, parameters = policy(leaves, data, shape)
    distribution = brax.create_dist(parameters)
    raw = distribution.loc + distribution.scale * data["noise"]
    return brax.postprocess(raw), raw, brax.log_prob(parameters, raw), parameters


@functools.partial(jax.jit, static_argnums=(0, 1))
def log_prob(distribution, size, parameters, raw_action):
    """The log-probabilities of actions before `tanh`, by one of Brax's distributions."""
    return distribution(size).log_prob(parameters, raw_action)


def make_actions(shape, environments, seed, spread=None):
    """What the kernel of the actions is given for one policy, and what it should give.

    With a spread, the outputs are far from zero, and from environment to environment the same.
    """
    rng = np.random.default_rng(seed)
    leaves = (
        network(rng, shape, shape.outputs[0]),
        [np.abs(rng.normal(size=shape.actions)) + 0.5] if shape.deviations else [],
    )
    if spread is not None:
        leaves[0][-2][:] = 0
        leaves[0][-1][:] = spread * rng.choice([-1.0, 1.0], size=shape.outputs[0])
    flat = [np.ravel(x) for x in (*leaves[0], *leaves[1])]
    flat.append(np.full(shape.size - sum(map(len, flat)), np.nan))
    data = {
        "mean": rng.normal(size=shape.observations),
        "inverse_std": 1 / (0.5 + np.abs(rng.normal(size=shape.observations))),
        "observation": rng.normal(size=(environments, shape.observations)),
        "noise": rng.normal(size=(environments, shape.actions)),
    }
    with jax.enable_x64(True):
        *expected, parameters = jax.device_get(actions(leaves, data, shape))
    if shape.deviations:
        parameters = np.concatenate(parameters, axis=-1)
    arrays = [np.concatenate(flat), *data.values()]
    return [x.astype(np.float32) for x in arrays], [*expected, parameters]


def assert_are_actions(results, shape, expected, bound):
    for ours, wanted in zip(results, expected, strict=True):
        assert ours.shape == wanted.shape
        np.testing.assert_allclose(ours, wanted, atol=bound, rtol=bound)
    # The probability is that of the action which was drawn, not of the exact one.
    _, raw, found, parameters = (np.asarray(x, np.float64) for x in results)
    distribution = NormalTanhDistribution
    if shape.deviations:
        distribution, parameters = NormalDistribution, np.split(parameters, 2, axis=-1)
    with jax.enable_x64(True):
        expected = log_prob(distribution, shape.actions, parameters, raw)
    np.testing.assert_allclose(found, expected, atol=3e-5)
