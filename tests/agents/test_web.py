"""PPO's kernels as WebAssembly do what those of the CPU do; Node stands for the browser."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from helpers import node
from helpers.further import slow_unless
from helpers.kernel_ppo import ACTIONS, OBSERVATIONS, config, minibatch
from jetbot_mjx.agents.fused import arrays, launch
from jetbot_mjx.agents.fused.learner import FusedLearner, shape_of
from jetbot_mjx.agents.fused.web import network_texts, web_learner
from jetbot_mjx.agents.networks import (
    NetworkParams,
    PolicyParams,
    init_normalizer,
    make_networks,
    make_policy,
)
from jetbot_mjx.agents.optimizer import make_optimizer
from onekernel import cpu, wasm

pytest.importorskip("llvmlite")

NETWORKS = {
    "tanh": {"distribution_type": "tanh_normal", "activation": "tanh"},
    "swish": {"distribution_type": "normal", "activation": "swish"},
    "elu": {"distribution_type": "tanh_normal", "activation": "elu"},
    "relu": {"distribution_type": "normal", "activation": "relu"},
}

CALL = """
const memory = new Memory(await WebAssembly.compile(given.module)), { about } = given, room = {};
for (const [name, size] of about.arrays)
  room[name] ??= memory.array(size, name === "unroll_indices" ? Int32Array : Float32Array);
for (const [name, numbers] of Object.entries(given.arrays)) {
  if (room[name].length !== numbers.length) throw Error(`${name} has ${room[name].length} numbers`);
  room[name].view.set(numbers);
}
const addresses = about.arrays.map(([name]) => room[name].address);
memory.functions[given.name](...addresses, memory.array(about.scratch / 4).address);
return Object.fromEntries(Object.entries(room).map(([name, { view }]) => [name, view]));
"""


def settings_of(activation, **ppo):
    return config(network=NETWORKS[activation], **ppo)


def linked(texts):
    if reason := wasm.obstacle():
        pytest.skip(reason)
    return wasm.link(texts)


@functools.cache
def compiled(activation, **ppo):
    """The learner of a configuration for web pages, and its module."""
    learner = web_learner(settings_of(activation, **ppo).ppo, OBSERVATIONS, ACTIONS)
    return learner.about, linked(learner.texts)


def made_up(settings):
    """The learner of this CPU, and the arguments of `launch.update` by name."""
    ppo = settings.ppo
    fused = FusedLearner(ppo, shape_of(ppo, OBSERVATIONS, ACTIONS))
    rng, networks = np.random.default_rng(0), make_networks(ppo, OBSERVATIONS, ACTIONS)
    # As many unrolls as are collected.
    sizes = ppo.model_copy(update={"batch_size": fused.batch.collected})
    whole = settings.model_copy(update={"ppo": sizes})
    params, statistics, data = minibatch(rng, whole, networks)
    batch, shape = fused.batch, fused.shape
    orders = [rng.permutation(batch.collected) for _ in range(ppo.num_updates_per_batch)]
    optimizer_state = make_optimizer(ppo).init(params)
    vectors = fused.layout.pack((params, optimizer_state))
    if shape.distribution == "normal":
        parameters = data.extras["policy_extras"]["distribution_params"]
        widened = tuple(
            jnp.broadcast_to(x, data.extras["policy_extras"]["raw_action"].shape)
            for x in parameters
        )
        data.extras["policy_extras"]["distribution_params"] = widened
    values = (
        *fused.collected(data, statistics),
        np.int32(orders).reshape(batch.minibatches, batch.unrolls),
        rng.normal(size=(batch.minibatches, batch.time, batch.unrolls, shape.actions)),
        fused._loss_terms(),
        fused.adam_terms(vectors[1]),
        *fused.first_vectors(*vectors),
    )
    given = dict(zip(arrays.UPDATE.arguments, values, strict=True))
    return fused, {
        name: np.asarray(x, np.int32 if name == "unroll_indices" else np.float32)
        for name, x in given.items()
    }


def relative(ours, theirs):
    """The largest difference as a share of the largest number."""
    return np.abs(ours - np.ravel(theirs)).max() / np.abs(theirs).max()


@pytest.mark.cpu
@pytest.mark.skipif(cpu.obstacle() is not None, reason="there are no kernels for this CPU")
@pytest.mark.parametrize("activation", slow_unless(lambda name: name == "swish", NETWORKS))
def test_an_update_is_the_cpus(activation):
    settings = settings_of(activation)
    about, module = compiled(activation)
    fused, given = made_up(settings)
    theirs = jax.jit(functools.partial(launch.update, fused.rule))(*given.values())
    flat = {name: x.ravel() for name, x in given.items()}
    ours = node.run(
        CALL, module=module, name="ppo_update", about=about["functions"]["ppo_update"], arrays=flat
    )
    for name, expected in zip(("params", "mu", "nu", "progress"), theirs, strict=True):
        assert relative(ours[name], np.asarray(expected)) <= 1e-4, name
    # All steps were made, and they changed what they should.
    assert ours["progress"][-1] == fused.rule.steps == 16
    assert relative(ours["params"], given["params"]) > 1e-3
    # What is read is not changed.
    for name in ("rows", "last", "mean", "inverse_std", "noise", "terms", "adam_terms"):
        np.testing.assert_array_equal(ours[name], flat[name])


@pytest.mark.cpu
@pytest.mark.skipif(cpu.obstacle() is not None, reason="there are no kernels for this CPU")
@pytest.mark.parametrize("activation", slow_unless(lambda name: name == "elu", NETWORKS))
def test_the_gradient_of_a_minibatch_is_the_cpus(activation):
    # Adam's mean of the gradients after one step tells the gradient.
    one = {"num_minibatches": 1, "num_updates_per_batch": 1, "num_envs": 16, "max_grad_norm": None}
    about, module = compiled(activation, **one)
    fused, given = made_up(settings_of(activation, **one))
    index = np.int32(0)
    names = ("params", "mean", "inverse_std", "rows", "last", "unroll_indices", "noise")
    arguments = [*(given[name] for name in names), index, given["terms"]]
    theirs = np.asarray(jax.jit(functools.partial(launch.gradient, fused.shape))(*arguments))
    ours = node.run(
        CALL,
        module=module,
        name="ppo_update",
        about=about["functions"]["ppo_update"],
        arrays={name: x.ravel() for name, x in given.items()},
    )
    # The vector has the sums of the metrics where there are no parameters.
    for begin, end in fused.shape.ranges:
        assert relative(ours["mu"][begin:end] / 0.1, theirs[begin:end]) <= 1e-4


@pytest.mark.cpu
@pytest.mark.skipif(cpu.obstacle() is not None, reason="there are no kernels for this CPU")
@pytest.mark.parametrize("activation", slow_unless(lambda name: name == "swish", NETWORKS))
def test_actions_are_the_cpus(activation):
    about, module = compiled(activation)
    fused, given = made_up(settings_of(activation))
    rng, count = np.random.default_rng(1), fused.batch.environments
    given = {name: given[name] for name in ("params", "mean", "inverse_std")} | {
        "observations": np.float32(rng.normal(size=(count, OBSERVATIONS))),
        "action_noise": np.float32(rng.normal(size=(count, ACTIONS))),
    }
    theirs = jax.jit(functools.partial(launch.actions, fused.shape))(*given.values())
    ours = node.run(
        CALL,
        module=module,
        name="ppo_act",
        about=about["functions"]["ppo_act"],
        arrays={name: x.ravel() for name, x in given.items()},
    )
    for name, expected in theirs._asdict().items():
        np.testing.assert_allclose(ours[name], np.ravel(expected), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("activation", ["tanh", "swish"])
def test_the_first_parameters_are_distributed_as_braxs(activation):
    settings = config(
        network={**NETWORKS[activation], "initial_action": [0.5, -0.25]}, hidden=[64, 64]
    )
    networks = make_networks(settings.ppo, OBSERVATIONS, ACTIONS)
    shape = shape_of(settings.ppo, OBSERVATIONS, ACTIONS)
    layout = FusedLearner(settings.ppo, shape).layout

    @jax.jit
    @jax.vmap
    def drawn(key):
        keys = jax.random.split(key)
        policy, value = networks.policy_network.init(keys[0]), networks.value_network.init(keys[1])
        return layout.pack(NetworkParams(policy, value))

    theirs = np.asarray(drawn(jax.random.split(jax.random.PRNGKey(0), 400)))
    entries = web_learner(settings.ppo, OBSERVATIONS, ACTIONS).about["initial"]
    left = np.ones(shape.size, bool)
    for entry in entries:
        place = slice(entry["start"], entry["start"] + entry["count"])
        assert left[place].all(), "two entries for the same parameters"
        left[place] = False
        numbers = theirs[:, place]
        if "value" in entry:
            np.testing.assert_allclose(numbers, entry["value"], rtol=1e-6)
            continue
        # A uniform distribution has these limits, and its deviation is this share of them.
        assert np.abs(numbers).max() <= entry["limit"] * (1 + 1e-6)
        assert np.abs(numbers).max() > 0.999 * entry["limit"]
        assert numbers.std() == pytest.approx(entry["limit"] / np.sqrt(3), rel=0.01)
    assert np.all(theirs[:, left] == 0)


SIZES = {"tanh": [24, 16], "swish": [30], "elu": [7, 32, 16], "relu": [16, 16]}

ACT = """
const memory = new Memory(await WebAssembly.compile(given.module));
const { layers, mean, std, squash, obs, actions } = given, size = mean.length;
const count = obs.length / size, found = new Float32Array(count * actions);
const network = new Network(memory, { layers, mean, std, squash }, count);
const observed = (robot) => obs.subarray(robot * size, (robot + 1) * size);
network.act(observed, null, found, actions);
// The same memory serves another policy, and this one again.
const other = layers.map(({ kernel, bias }) => ({ kernel: kernel.map((x) => 1 - x), bias }));
network.load({ layers: other, mean: mean.map((x) => x + 1), std, squash });
const changed = new Float32Array(found.length);
network.act(observed, null, changed, actions);
network.load({ layers, mean, std, squash });
const again = new Float32Array(found.length);
network.act(observed, null, again, actions);
return { found, changed, again };
"""


@pytest.mark.slow
@pytest.mark.parametrize("activation", NETWORKS)
def test_the_layers_of_any_policy_are_applied_as_jax_does(activation):
    actions, sizes = 3, SIZES[activation]
    network = {**NETWORKS[activation], "policy_hidden_layer_sizes": sizes}
    ppo = config(network=network).ppo
    networks = make_networks(ppo, OBSERVATIONS, actions)
    rng = np.random.default_rng(0)
    normalizer = init_normalizer(OBSERVATIONS).replace(
        mean=jnp.float32(rng.normal(size=OBSERVATIONS)),
        std=jnp.float32(0.3 + rng.random(OBSERVATIONS)),
    )
    weights = networks.policy_network.init(jax.random.PRNGKey(3))
    # Biases begin as zeros, and the last weights may be small.
    weights = jax.tree.map(lambda x: np.float32(x + 0.3 * rng.normal(size=x.shape)), weights)
    obs = np.float32(2 * rng.normal(size=(37, OBSERVATIONS)))
    with jax.default_matmul_precision("highest"):
        act = make_policy(networks, PolicyParams(normalizer, weights, None))
        theirs = np.clip(act(obs), -1, 1)
    # Where the deviations are parameters, the last layer has a name of its own.
    parts = weights["params"] | weights["params"].get("MLP_0", {})
    names = [*(f"hidden_{i}" for i in range(len(sizes) + 1)), "Dense_0"]
    kernels, biases = (
        [parts[name][kind] for name in names if name in parts] for kind in ("kernel", "bias")
    )
    assert len(kernels) == len(sizes) + 1
    kernels[-1], biases[-1] = kernels[-1][:, :actions], biases[-1][:actions]
    found = node.run(
        ACT,
        module=linked({**network_texts(activation)}),
        layers=[
            {"kernel": kernel.ravel(), "bias": bias}
            for kernel, bias in zip(kernels, biases, strict=True)
        ],
        mean=np.asarray(normalizer.mean),
        std=np.asarray(normalizer.std),
        squash=NETWORKS[activation]["distribution_type"] == "tanh_normal",
        obs=obs.ravel(),
        actions=actions,
    )
    assert np.std(theirs) > 0.2
    np.testing.assert_allclose(found["found"].reshape(theirs.shape), theirs, rtol=0, atol=1e-5)
    assert np.abs(found["changed"] - found["found"]).max() > 0.1
    np.testing.assert_array_equal(found["again"], found["found"])


@pytest.mark.parametrize(
    ("changes", "sizes", "reason"),
    [
        ({}, ({"pixels/camera": (8, 8, 3)}, 2), "without images"),
        ({"hidden": [64, 32]}, (16, 2), "hidden layers of one width"),
        ({"hidden": [40, 40]}, (16, 2), "16, 32, 48, ... units, not 40"),
        ({}, (16, 9), "at most 16 outputs, not 18"),
    ],
)
def test_it_says_what_a_page_cannot_train(changes, sizes, reason):
    found = web_learner(config(**changes).ppo, *sizes)
    assert isinstance(found, str)
    assert reason in found


SEE = """
const memory = new Memory(await WebAssembly.compile(given.module));
const { images, policy, count, features } = given, found = new Float32Array(count * features);
const network = new Network(memory, policy, count);
network.encoder.look({ bytes: images, size: images.length / count }, found, features);
return found;
"""


def test_an_encoder_of_any_size_is_applied_as_jax_does():
    # Channels that fill no vector, and more images than are encoded at once.
    rng, count, shape = np.random.default_rng(0), 37, (11, 14, 3)
    sizes = [(4, 2, 6), (3, 1, 5)]
    images = rng.integers(0, 256, (count, *shape), np.uint8)
    x, convolutions, channels = np.float32(images), [], shape[-1]
    for side, stride, outputs in sizes:
        kernel = np.float32(rng.normal(size=(side, side, channels, outputs)) / 50)
        bias = np.float32(rng.normal(size=outputs))
        with jax.default_matmul_precision("highest"):
            x = jax.lax.conv_general_dilated(
                x, kernel, (stride, stride), "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC")
            )
        x, channels = np.maximum(np.asarray(x) + bias, 0), outputs
        layer = {"kernel": kernel.ravel(), "bias": bias, "side": side, "stride": stride}
        convolutions.append(layer)
    x = x.reshape(count, -1)
    dense = np.float32(rng.normal(size=(x.shape[1], 7)) / 10)
    bias = np.float32(rng.normal(size=7))
    expected = np.maximum(x @ dense + bias, 0)
    assert (expected > 0).mean() > 0.3
    policy = {
        "mean": np.zeros(0, np.float32),
        "std": np.zeros(0, np.float32),
        "squash": True,
        "layers": [{"kernel": np.zeros(14, np.float32), "bias": np.zeros(2, np.float32)}],
        "encoder": {
            "shape": shape,
            "convolutions": convolutions,
            "dense": {"kernel": dense.ravel(), "bias": bias},
        },
    }
    found = node.run(
        SEE,
        module=linked({**network_texts("tanh")}),
        images=images.ravel(),
        policy=policy,
        count=count,
        features=7,
    )
    np.testing.assert_allclose(found.reshape(expected.shape), expected, rtol=1e-4, atol=1e-4)
