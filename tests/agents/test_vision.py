"""Networks that see: convolutions beside XLA's, PPO's loss beside that of Brax's networks."""

import flax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs import Wrapper
from brax.training.agents.ppo import losses, networks_vision
from brax.training.types import Transition

from jetbot_mjx.agents import cnn_sizes
from jetbot_mjx.agents.networks import init_normalizer, make_networks, update_normalizer
from jetbot_mjx.agents.ppo import PPO
from jetbot_mjx.agents.vision import Encoder, convolve
from jetbot_mjx.config import NetworkConfig, PPOConfig, parse_config
from jetbot_mjx.envs.camera.wrapper import NUMBERS, PIXELS
from jetbot_mjx.errors import InvalidError

LAYERS = sorted({layer for layers in cnn_sizes.CNNS.values() for layer in layers.convolutions})
SMALLEST = {"nature": 36, "small": 18, "tiny": 16}


@pytest.fixture(autouse=True)
def full_precision():
    with jax.default_matmul_precision("highest"):
        yield


@pytest.mark.slow
@pytest.mark.parametrize(("extra_rows", "extra_columns"), [(0, 0), (2, 11)])
@pytest.mark.parametrize("layer", LAYERS)
def test_a_convolution_is_xla_s(layer, extra_rows, extra_columns):
    channels, side, stride = layer
    keys = jax.random.split(jax.random.PRNGKey(side), 3)
    x = jax.random.normal(keys[0], (2, side + extra_rows, side + extra_columns, 3))
    kernel = jax.random.normal(keys[1], (side, side, 3, channels))

    def xla_s(x, kernel):
        return jax.lax.conv_general_dilated(
            x, kernel, (stride, stride), "VALID", dimension_numbers=("NHWC", "HWIO", "NHWC")
        )

    def ours(x, kernel):
        return convolve(x, kernel, stride)

    @jax.jit
    def both(x, kernel, key):
        wanted, pull_back = jax.vjp(xla_s, x, kernel)
        found, our_pull_back = jax.vjp(ours, x, kernel)
        cotangent = jax.random.normal(key, wanted.shape)
        return (found, *our_pull_back(cotangent)), (wanted, *pull_back(cotangent))

    # Sums of up to 192 products of numbers around 1, and of as many as there are outputs.
    for found, wanted in zip(*both(x, kernel, keys[2]), strict=True):
        np.testing.assert_allclose(found, wanted, atol=5e-5, rtol=1e-5)


@pytest.mark.parametrize("cnn", SMALLEST)
def test_the_smallest_image_is_encoded_and_a_smaller_one_refused(cnn):
    config, side = PPOConfig(network=NetworkConfig(cnn=cnn)), SMALLEST[cnn]
    for height, width in ((side, side + 9), (side - 1, side + 9), (side, side - 1)):
        shapes = {PIXELS: (height, width, 3)}
        if min(height, width) == side:
            networks = make_networks(config, shapes, 2)
            policy = jax.eval_shape(networks.policy_network.init, jax.random.PRNGKey(0))
            assert policy["encoder"]["params"]["dense"]["kernel"].shape[0] > 0
            continue
        with pytest.raises(InvalidError) as error:
            make_networks(config, shapes, 2)
        assert str(error.value).startswith(
            f"camera.width = {width} and camera.height = {height} are too small for"
            f" ppo.network.cnn = {cnn!r}: "
        )
        assert f"{cnn}: {side}" in str(error.value)


# PPO's loss.

SHAPE = (20, 23, 3)
UNROLLS, TIME = 3, 4
HIDDEN = (16, 8)


class Sizes(Wrapper):
    """A stand-in for an environment, of which the loss needs the sizes only."""

    observation_min_std, action_size = None, 2

    def __init__(self, shapes):
        super().__init__(None)
        self._shapes = shapes

    @property
    def observation_size(self):
        return self._shapes


def make_ppo(shapes, **network):
    network = {"cnn": "small", "activation": "relu", "cnn_dtype": "float32"} | network
    sizes = {"policy_hidden_layer_sizes": HIDDEN, "value_hidden_layer_sizes": HIDDEN}
    config = parse_config({"ppo": {"network": network | sizes}})
    networks = make_networks(config.ppo, shapes, 2)
    return PPO(config.ppo, Sizes(shapes), networks)


def make_batch(shapes, seed=0):
    rng = np.random.default_rng(seed)

    def observe(time):
        return {
            name: rng.integers(0, 256, (UNROLLS, time, *shape), np.uint8)
            if len(shape) == 3
            else rng.normal(3.0, 2.0, (UNROLLS, time, *shape)).astype(np.float32)
            for name, shape in shapes.items()
        }

    def normal(*shape):
        return rng.normal(size=(UNROLLS, TIME, *shape)).astype(np.float32)

    return Transition(
        observation=observe(TIME),
        action=normal(2),
        reward=normal(),
        discount=(normal() > -1).astype(np.float32),
        next_observation=observe(TIME),
        extras={
            "policy_extras": {
                "raw_action": normal(2),
                "log_prob": normal() - 1.0,
                "distribution_params": normal(4),
            },
            "state_extras": {"truncation": (normal() > 1.5).astype(np.float32)},
        },
    )


def init(ppo):
    @jax.jit
    def both(key):
        policy_key, value_key = jax.random.split(key)
        return losses.PPONetworkParams(
            policy=ppo.networks.policy_network.init(policy_key),
            value=ppo.networks.value_network.init(value_key),
        )

    params = both(jax.random.PRNGKey(3))
    # Biases begin with zero, and would hide where they belong.
    return jax.tree.map(lambda x: x + 0.02 * jnp.cos(jnp.arange(x.size)).reshape(x.shape), params)


def as_brax(params):
    """Rename the parameters of an encoder and a head to those of Brax's one network."""
    encoder, head = params["encoder"]["params"], params["head"]["params"]
    layers = len(cnn_sizes.CNNS["small"].convolutions)
    convolutions = {
        f"Conv_{i}": {"kernel": encoder[f"conv_{i}_kernel"], "bias": encoder[f"conv_{i}_bias"]}
        for i in range(layers)
    }
    dense = {"hidden_0": encoder["dense"]}
    dense |= {f"hidden_{i + 1}": head[f"hidden_{i}"] for i in range(len(HIDDEN) + 1)}
    return {"params": {"CNN_0": convolutions, "MLP_0": dense}}


def gradients_of(ppo, params, batch, normalizer):
    loss = jax.value_and_grad(ppo.learner.loss, has_aux=True)
    return jax.jit(loss)(params, normalizer, batch, jax.random.PRNGKey(9))


def assert_close(one, other, rtol=1e-4):
    """Compare trees leaf by leaf, relative to the largest number of a leaf."""
    one, other = (flax.traverse_util.flatten_dict(tree) for tree in (one, other))
    assert one.keys() == other.keys()
    for name, leaf in one.items():
        scale = np.abs(other[name]).max()
        np.testing.assert_allclose(leaf, other[name], atol=rtol * scale, rtol=0, err_msg=name)


@pytest.fixture(scope="module")
def separate():
    shapes = {PIXELS: SHAPE}
    ppo = make_ppo(shapes, shared_cnn=False)
    params, batch = init(ppo), make_batch(shapes)
    with jax.default_matmul_precision("highest"):
        result = gradients_of(ppo, params, batch, init_normalizer(shapes))
    return params, batch, result


@pytest.mark.slow
def test_the_loss_of_separate_encoders_is_that_of_brax_s_networks(separate):
    params, batch, ((loss, metrics), gradient) = separate
    layers = cnn_sizes.CNNS["small"]
    channels, sides, strides = zip(*layers.convolutions, strict=True)
    theirs = networks_vision.make_ppo_networks_vision(
        {PIXELS: SHAPE},
        2,
        policy_hidden_layer_sizes=(layers.features, *HIDDEN),
        value_hidden_layer_sizes=(layers.features, *HIDDEN),
        activation=jax.nn.relu,
        cnn_output_channels=channels,
        cnn_kernel_size=sides,
        cnn_stride=strides,
        cnn_padding="valid",
        cnn_global_pool="none",
    )
    scaled = batch._replace(
        observation={PIXELS: batch.observation[PIXELS] / np.float32(255)},
        next_observation={PIXELS: batch.next_observation[PIXELS] / np.float32(255)},
    )
    config = make_ppo({PIXELS: SHAPE}).config
    brax_params = losses.PPONetworkParams(as_brax(params.policy), as_brax(params.value))

    def brax_loss(params):
        return losses.compute_ppo_loss(
            params,
            None,
            scaled,
            jax.random.PRNGKey(9),
            ppo_network=theirs,
            entropy_cost=config.entropy_cost,
            discounting=config.discounting,
            reward_scaling=config.reward_scaling,
            gae_lambda=config.gae_lambda,
            clipping_epsilon=config.clipping_epsilon,
            normalize_advantage=config.normalize_advantage,
            vf_coefficient=config.vf_loss_coefficient,
        )

    (wanted, their_metrics), their_gradient = jax.jit(jax.value_and_grad(brax_loss, has_aux=True))(
        brax_params
    )
    # float32: sums of thousands of products in another order.
    assert float(loss) == pytest.approx(float(wanted), rel=1e-5)
    for name, value in metrics.items():
        assert float(value) == pytest.approx(float(their_metrics[name]), rel=1e-4, abs=1e-6), name
    assert_close(as_brax(gradient.policy), their_gradient.policy)
    assert_close(as_brax(gradient.value), their_gradient.value)


@pytest.mark.slow
def test_a_shared_encoder_learns_from_both_heads(separate):
    shapes = {PIXELS: SHAPE}
    params, batch, _ = separate
    both = params.policy["encoder"]
    params = losses.PPONetworkParams(params.policy, params.value | {"encoder": both})
    apart, shared = make_ppo(shapes, shared_cnn=False), make_ppo(shapes)
    (loss, _), gradient = gradients_of(apart, params, batch, init_normalizer(shapes))

    alone = losses.PPONetworkParams(params.policy, {"head": params.value["head"]})
    assert jax.tree.structure(jax.eval_shape(lambda: init(shared))) == jax.tree.structure(alone)
    (found, _), joint = gradients_of(shared, alone, batch, init_normalizer(shapes))
    assert float(found) == pytest.approx(float(loss), rel=1e-6)
    total = jax.tree.map(jnp.add, gradient.policy["encoder"], gradient.value["encoder"])
    assert_close(joint.policy["encoder"], total)
    assert_close(joint.policy["head"], gradient.policy["head"])
    assert_close(joint.value["head"], gradient.value["head"])


# Numbers and pixels.

MIXED = {PIXELS: (18, 18, 6), NUMBERS: (5,)}


def test_numbers_are_normalised_and_pixels_never():
    batch = make_batch(MIXED)
    normalizer = init_normalizer(MIXED)
    assert set(normalizer.mean) == {NUMBERS}
    learned = update_normalizer(normalizer, batch.observation)
    numbers = batch.observation[NUMBERS].reshape(-1, 5)
    np.testing.assert_allclose(learned.mean[NUMBERS], numbers.mean(0), rtol=1e-5)
    assert jax.tree.structure(learned) == jax.tree.structure(normalizer)

    ppo = make_ppo(MIXED)
    params = init(ppo)
    plain, normalised = (
        jax.jit(ppo.networks.encode)(stats, params, batch.observation)
        for stats in (normalizer, learned)
    )
    wanted = (batch.observation[NUMBERS] - learned.mean[NUMBERS]) / learned.std[NUMBERS]
    np.testing.assert_allclose(normalised["policy"][..., -5:], wanted, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(normalised["policy"][..., :-5], plain["policy"][..., :-5])
    # The value function sees the same.
    np.testing.assert_array_equal(normalised["value"], normalised["policy"])


def test_statistics_of_images_alone_stay_empty():
    shapes = {PIXELS: SHAPE}
    normalizer = init_normalizer(shapes)
    assert normalizer.mean == {}
    updated = update_normalizer(normalizer, make_batch(shapes).observation)
    assert jax.tree.structure(updated) == jax.tree.structure(normalizer)


def test_pixels_stay_bytes_until_the_encoder(monkeypatch):
    ppo = make_ppo(MIXED)
    params, batch = init(ppo), make_batch(MIXED)
    given = []
    original = Encoder.__call__

    def call(self, pixels):
        given.append((pixels.shape, pixels.dtype))
        return original(self, pixels)

    monkeypatch.setattr(Encoder, "__call__", call)
    jax.eval_shape(ppo.learner.loss, params, init_normalizer(MIXED), batch, jax.random.PRNGKey(0))
    # Once for policy and value function, with the last next observation.
    assert given == [((UNROLLS, TIME + 1, *MIXED[PIXELS]), jnp.uint8)]


def test_bfloat16_computes_nearly_the_same():
    shapes = {PIXELS: SHAPE}
    batch = make_batch(shapes)
    exact, rough = (make_ppo(shapes, cnn_dtype=name) for name in ("float32", "bfloat16"))
    params = init(exact)
    one, other = (
        jax.jit(ppo.networks.encode)(init_normalizer(shapes), params, batch.observation)["policy"]
        for ppo in (exact, rough)
    )
    assert one.dtype == other.dtype == jnp.float32
    # bfloat16 has 8 bits; 1 % of the largest feature.
    assert 0 < np.abs(one - other).max() < 0.02 * np.abs(one).max()


@pytest.mark.parametrize("shared", [True, False])
@pytest.mark.parametrize("cnn", SMALLEST)
def test_the_memory_of_activations_is_what_a_gradient_keeps(cnn, shared):
    shapes = {PIXELS: (40, 48, 3)}
    ppo = make_ppo(shapes, cnn=cnn, shared_cnn=shared)
    params = jax.eval_shape(lambda: init(ppo))

    def kept(count):
        """Bytes that the backward pass of `count` images reads."""
        obs = {PIXELS: jax.ShapeDtypeStruct((count, *shapes[PIXELS]), jnp.uint8)}
        kept = jax.eval_shape(
            lambda params, obs: jax.vjp(
                lambda p: ppo.networks.encode(init_normalizer(shapes), p, obs), params
            )[1],
            params,
            obs,
        )
        return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(kept))

    network = NetworkConfig(cnn=cnn, shared_cnn=shared, cnn_dtype="float32")
    counted = cnn_sizes.activation_bytes(network, shapes)
    # It keeps the signs of relu and the parts of patches besides.
    assert 0.9 * counted <= kept(9) - kept(8) <= 1.5 * counted
