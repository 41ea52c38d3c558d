"""The learner by kernels: what networks it takes, and on a GPU its gradient and launches."""

import dataclasses
import functools
import itertools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.agents.ppo.networks import PPONetworks

from helpers import simt
from helpers.further import slow_unless
from helpers.kernel_ppo import ACTIONS, OBSERVATIONS, config, make_ppo, minibatch
from jetbot_mjx.agents.fused import launch, launch_gpu, probe
from jetbot_mjx.agents.fused.arrays import ACTIONS as ACTION_ARRAYS
from jetbot_mjx.agents.fused.arrays import ADAM
from jetbot_mjx.agents.fused.gpu_actions import ActionKernel
from jetbot_mjx.agents.fused.gpu_adam import AdamKernel
from jetbot_mjx.agents.fused.gpu_advantages import AdvantageKernel
from jetbot_mjx.agents.fused.gpu_gradient import GradientKernel
from jetbot_mjx.agents.fused.gpu_tiling import Tiling
from jetbot_mjx.agents.fused.learner import FusedLearner, make_fused_learner, shape_of
from jetbot_mjx.agents.fused.shapes import DataSizes
from jetbot_mjx.agents.learner import ONE_DEVICE, DeviceAxis
from jetbot_mjx.agents.networks import Networks
from jetbot_mjx.agents.optimizer import make_optimizer
from jetbot_mjx.agents.train_state import LOSSES
from jetbot_mjx.agents.xla_learner import XlaLearner
from jetbot_mjx.config import ConfigError, load_config, parse_config
from jetbot_mjx.errors import UserError
from jetbot_mjx.training import session
from onekernel import gpu

on_a_gpu = pytest.mark.skipif(gpu.obstacle() is not None, reason="there is no NVIDIA GPU")


@pytest.mark.parametrize(
    ("changes", "sizes", "reason"),
    [
        ({}, ({"pixels/camera": (8, 8, 3)}, 2), "without images"),
        ({"hidden": [64, 32]}, (16, 2), "hidden layers of one width"),
        ({"network": {"value_hidden_layer_sizes": [32]}}, (16, 2), "the same hidden layers"),
    ],
)
def test_it_says_which_networks_it_cannot_compute(changes, sizes, reason):
    found = shape_of(config(**changes).ppo, *sizes)
    assert isinstance(found, str)
    assert reason in found


@pytest.mark.parametrize(
    ("changes", "sizes", "reason"),
    [
        ({}, (65, 2), "at most 64 numbers, not 65"),
        ({}, (16, 5), "at most 8 outputs, not 10"),
        ({"hidden": [40, 40]}, (16, 2), "16, 32, ... 128 units, not 40"),
        ({"hidden": [144]}, (16, 2), "16, 32, ... 128 units, not 144"),
        ({"hidden": [128] * 4}, (16, 2), "does not fit in the registers"),
    ],
)
def test_it_says_which_networks_a_gpu_cannot_compute(changes, sizes, reason):
    shape = shape_of(config(**changes).ppo, *sizes)
    assert reason in launch_gpu.refusal(shape, DataSizes(64, 16, 4))


@pytest.mark.cpu
def test_requested_where_it_cannot_run_it_is_an_error_of_one_line(root, tmp_path):
    sizes = "ppo.network.policy_hidden_layer_sizes=[40]"
    config = load_config(root / "configs" / "smoke.yaml", ["ppo.update=fused", sizes])
    with pytest.raises(UserError) as caught:
        session.run(config, tmp_path / "run")
    assert str(caught.value) == (
        "ppo.update = fused: it takes two networks of the same hidden layers of one width:"
        " choose auto or xla"
    )
    assert not (tmp_path / "run").exists()


def test_brax_trainer_does_not_know_it():
    with pytest.raises(
        ConfigError, match=r"ppo\.update = 'fused' is not supported by trainer = 'brax'"
    ):
        parse_config(
            {
                "trainer": "brax",
                "ppo": {
                    "update": "fused",
                    "learning_rate_schedule": "NONE",
                    "normalizer": "brax",
                },
            }
        )


def traced_update(policies, *, at_once):
    """The update of one policy (None) or of several, traced; it takes one minibatch six times."""
    settings = config(update="xla", num_envs=16, num_minibatches=1, num_updates_per_batch=6)
    ppo = make_ppo(settings)
    shape = shape_of(settings.ppo, OBSERVATIONS, ACTIONS)
    fused = FusedLearner(settings.ppo, shape)
    fused.at_once = at_once
    params, *data = minibatch(np.random.default_rng(0), settings, ppo.networks)
    vectors = fused.layout.pack((params, make_optimizer(settings.ppo).init(params)))
    given = *vectors, *data, jax.random.PRNGKey(0)
    if policies is None:
        return jax.jit(fused.update).trace(*given), shape.size
    made = jax.tree.map(lambda x: jnp.stack([x] * policies), given)
    return jax.jit(jax.vmap(fused.update)).trace(*made), shape.size


@pytest.mark.slow
@pytest.mark.parametrize("policies", [None, 3])
def test_a_minibatch_of_several_policies_is_three_launches(monkeypatch, policies):
    pytest.importorskip("llvmlite")
    monkeypatch.setattr(gpu, "compute_capability", lambda: 90)
    monkeypatch.setattr(gpu, "processor_count", lambda: 132)
    text = traced_update(policies, at_once=False)[0].lower(lowering_platforms=("cuda",)).as_text()
    calls = [line for line in text.splitlines() if "custom_call @__gpu$xla.gpu.ptx" in line]
    names = [re.search(r' name = "(\w+)"', call)[1] for call in calls]
    assert names == ["ppo_advantages", "ppo_gradient", "ppo_adam"]
    assert re.findall(r"grid_z = (\d+)", text) == [str(policies or 1)] * 3


def arrays_of(rule, batch):
    """What the kernels take for one policy, by the name of the kernel."""
    shape = rule.shape

    def floats(*sizes):
        return jnp.zeros(sizes)

    vector, statistics = floats(shape.size), floats(shape.observations)
    rows = floats(batch.collected, batch.time, shape.columns["size"])
    last = floats(batch.collected, shape.observations)
    unrolls = jnp.zeros((batch.minibatches, batch.unrolls), jnp.int32)
    noise = floats(batch.minibatches, batch.time, batch.unrolls, shape.actions)
    data, terms, index = (
        (statistics, statistics, rows, last, unrolls, noise),
        floats(6),
        unrolls[0, 0],
    )
    progress, rates = floats(rule.steps + 1, 10), floats(7)
    return {
        "gradient": (vector, *data, index, terms),
        "adam": (vector, vector, vector, vector, progress, index, rates),
        "update": (*data, terms, rates, vector, vector, vector, progress),
    }


@pytest.mark.cpu
@pytest.mark.parametrize("kernel", ["gradient", "adam", "update"])
def test_a_kernel_refuses_what_it_would_misread(kernel):
    fused = make_ppo(config()).learner
    arrays = arrays_of(fused.rule, fused.batch)[kernel]
    spec = fused.shape if kernel == "gradient" else fused.rule
    run = functools.partial(jax.eval_shape, functools.partial(getattr(launch, kernel), spec))
    run(*arrays)
    for i, array in enumerate(arrays):
        other = jnp.float32 if array.dtype == jnp.int32 else jnp.int32
        for wrong in (
            array.astype(other),
            array[None],
            array[..., :-1] if array.ndim else array[None],
        ):
            with pytest.raises((TypeError, ValueError)):
                run(*arrays[:i], wrong, *arrays[i + 1 :])


@pytest.mark.cpu
def test_the_update_at_once_is_of_the_configured_minibatches():
    fused = make_ppo(config()).learner
    arrays = arrays_of(fused.rule, fused.batch)["update"]
    for change in ({"steps": fused.rule.steps - 1}, {"samples": 1}):
        with pytest.raises(TypeError, match="update: "):
            jax.eval_shape(functools.partial(launch.update, fused.rule._replace(**change)), *arrays)


@pytest.mark.cpu
def test_several_devices_average_each_gradient():
    settings = config()
    shape = shape_of(settings.ppo, OBSERVATIONS, ACTIONS)
    assert FusedLearner(settings.ppo, shape, DeviceAxis(1, "i")).at_once
    assert not FusedLearner(settings.ppo, shape, DeviceAxis(2, "i")).at_once


@pytest.mark.cpu
def test_other_devices_leave_the_update_to_xla(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "tpu")
    found = make_fused_learner(config().ppo, OBSERVATIONS, ACTIONS)
    assert found == "it needs a CPU or an NVIDIA GPU, and this is tpu"


@pytest.mark.cpu
@pytest.mark.parametrize("policies", [None, 3])
def test_a_minibatch_changes_the_vectors_in_place(policies):
    traced, size = traced_update(policies, at_once=False)
    text = traced.lower().compile().as_text()
    (body,) = (part for part in text.split("\n\n") if part.count("onekernel_") == 2)
    assert (f"f32[{policies},{size}]" if policies else f"f32[{size}]") in body
    copies = [line for line in body.splitlines() if " copy(" in line or "_copy_" in line]
    assert not [line for line in copies if str(size) in line]


@pytest.mark.parametrize(
    ("policies", "environments", "grid"),
    [(1, 4096, (128, 1, 1)), (3, 40, (2, 1, 3)), (64, 4096, (2, 1, 64))],
)
def test_the_actions_of_several_policies_are_one_launch(monkeypatch, policies, environments, grid):
    pytest.importorskip("llvmlite")
    monkeypatch.setattr(gpu, "compute_capability", lambda: 90)
    monkeypatch.setattr(gpu, "processor_count", lambda: 132)
    shape = shape_of(config(update="xla").ppo, OBSERVATIONS, ACTIONS)
    sizes = (shape.size,), (OBSERVATIONS,), (OBSERVATIONS,)
    sizes += (environments, OBSERVATIONS), (environments, ACTIONS)
    arrays = [jax.ShapeDtypeStruct((policies, *size), np.float32) for size in sizes]
    run = jax.jit(jax.vmap(functools.partial(launch.actions, shape)))
    text = run.trace(*arrays).lower(lowering_platforms=("cuda",)).as_text()
    assert text.count("custom_call @__gpu$xla.gpu.ptx") == 1
    found = [re.findall(rf"grid_{axis} = (\d+)", text) for axis in "xyz"]
    assert found == [[str(size)] for size in grid]


@pytest.mark.parametrize("wrong", range(5))
def test_actions_of_other_shapes_are_refused(wrong):
    shape = shape_of(config(update="xla").ppo, OBSERVATIONS, ACTIONS)
    sizes = [(shape.size,), (OBSERVATIONS,), (OBSERVATIONS,), (7, OBSERVATIONS), (7, ACTIONS)]
    arrays = [jnp.zeros(size) for size in sizes]
    arrays[wrong] = arrays[wrong][..., :-1]
    with pytest.raises(TypeError, match="actions: "):
        launch.actions(shape, *arrays)
    arrays[wrong] = jnp.zeros(sizes[wrong], jnp.float16)
    with pytest.raises(TypeError, match=r"actions: .*float32"):
        launch.actions(shape, *arrays)


# Both distributions, and both with and without a normaliser, are in two quick ones of the four.
NORMALIZED = slow_unless(
    lambda distribution, normalizes: normalizes == (distribution == "tanh_normal"),
    itertools.product(["tanh_normal", "normal"], [True, False]),
)


@pytest.mark.parametrize(("distribution", "normalizes"), NORMALIZED)
def test_what_a_collection_keeps_is_as_brax_has_it(distribution, normalizes):
    settings = config(
        network={"distribution_type": distribution}, normalize_observations=normalizes
    )
    ppo, rng = make_ppo(settings), np.random.default_rng(0)
    params, statistics, _ = minibatch(rng, settings, ppo.networks)
    observations = jnp.asarray(rng.normal(size=(64, OBSERVATIONS)), jnp.float32)
    noise = ppo.learner.action_noise(jax.random.PRNGKey(3))
    assert noise.shape == (4, 64, ACTIONS)
    np.testing.assert_allclose(noise.mean((0, 1)), 0, atol=0.2)
    np.testing.assert_allclose(noise.std((0, 1)), 1, atol=0.15)
    assert float(jnp.abs(noise).max()) > 2.5
    assert len(np.unique(noise)) == noise.size
    action, kept = ppo.learner.policy(ppo.learner.layout.pack(params), statistics)(
        observations, noise[0]
    )
    with jax.default_matmul_precision("highest"):
        expected = ppo.networks.policy_network.apply(statistics, params.policy, observations)
    rounding = 2e-2 if jax.default_backend() == "gpu" else 1e-5
    for one, other in zip(
        jax.tree.leaves(kept["distribution_params"]), jax.tree.leaves(expected), strict=True
    ):
        np.testing.assert_allclose(one, other, atol=rounding)
    brax = ppo.networks.parametric_action_distribution
    made = brax.create_dist(kept["distribution_params"])
    np.testing.assert_allclose(kept["raw_action"], made.loc + made.scale * noise[0], atol=1e-5)
    np.testing.assert_allclose(action, brax.postprocess(kept["raw_action"]), atol=1e-5)
    log_prob = brax.log_prob(kept["distribution_params"], kept["raw_action"])
    np.testing.assert_allclose(kept["log_prob"], log_prob, atol=2e-5)


def modelled(shape, *arrays):
    """`launch.gradient` on the model of a GPU, for one policy."""

    def run(*arrays):
        given = [np.array(x) for x in arrays]
        params, mean, scale, rows, last, unrolls, noise, index, terms = given
        batch = DataSizes(len(rows), unrolls.shape[1], rows.shape[1], len(unrolls))
        tiling = Tiling(shape, 64, 1, "advantages")
        blocks = min(2, tiling.tiles(batch))
        kernel = AdvantageKernel(tiling, batch, blocks)
        sizes = batch.samples, batch.samples, (blocks, 2)
        estimates = [np.full(size, np.nan, np.float32) for size in sizes]
        arrays = [params, mean, scale, rows, last, unrolls, index, terms, *estimates]
        memory = kernel.shared_memory
        simt.run(kernel.text(), arrays, (blocks, 1, 1), shared_memory=memory)
        kernel = GradientKernel(Tiling(shape, 32, 1), batch, 1, blocks)
        vector = np.full((1, shape.size), np.nan, np.float32)
        arrays = [params, mean, scale, rows, unrolls, noise, index, *estimates, terms, vector]
        simt.run(kernel.text(), arrays, (1, 2, 1), shared_memory=kernel.shared_memory)
        return vector[0]

    result = jax.ShapeDtypeStruct((shape.size,), np.float32)
    return jax.pure_callback(run, result, *arrays)


def modelled_actions(shape, *arrays):
    """`launch.actions` on the model of a GPU, for one policy."""
    count = arrays[3].shape[0]
    shapes = ACTION_ARRAYS.shapes(shape, DataSizes(environments=count))
    results = [jax.ShapeDtypeStruct(shapes[x], np.float32) for x in launch.Actions._fields]

    def run(*arrays):
        drawn = [np.full(x.shape, np.nan, np.float32) for x in results]
        kernel = ActionKernel(Tiling(shape, 32, 1, "actions"), DataSizes(environments=count), 1)
        given = [*(np.array(x) for x in arrays), *drawn]
        simt.run(kernel.text(), given, shared_memory=kernel.shared_memory)
        return drawn

    return launch.Actions(*jax.pure_callback(run, results, *arrays))


def on_the_device(monkeypatch, **functions):
    """Lets the check launch these functions on its device, and the kernels on the CPU after it."""
    for name, function in functions.items():
        calls = iter([function, getattr(launch, name)])
        monkeypatch.setattr(launch, name, lambda *arrays, calls=calls: next(calls)(*arrays))


@pytest.mark.cpu
@pytest.mark.parametrize("factor", [1.0, 1.1])
def test_the_probe_agrees_with_the_model(monkeypatch, factor):
    on_the_device(
        monkeypatch,
        gradient=lambda *arrays: factor * modelled(*arrays),
        actions=modelled_actions,
        adam=modelled_adam,
    )
    assert probe.runs_correctly.__wrapped__() == (factor == 1.0)


@pytest.mark.cpu
@pytest.mark.parametrize("error", [0.05, np.nan])
@pytest.mark.parametrize("name", launch.Actions._fields)
def test_the_probe_sees_wrong_actions(monkeypatch, name, error):
    right = launch.actions

    def wrong(*arrays):
        drawn = right(*arrays)
        return drawn._replace(**{name: getattr(drawn, name) + error})

    assert probe.runs_correctly.__wrapped__()
    on_the_device(monkeypatch, actions=wrong)
    assert not probe.runs_correctly.__wrapped__()


@pytest.mark.cpu
@pytest.mark.parametrize("error", [0.05, np.nan])
@pytest.mark.parametrize("place", range(4))
def test_the_probe_sees_a_wrong_step(monkeypatch, place, error):
    right = launch.adam

    def wrong(*arrays):
        made = list(right(*arrays))
        made[place] = made[place].at[(0,) * made[place].ndim].add(error)
        return tuple(made)

    on_the_device(monkeypatch, adam=wrong)
    assert not probe.runs_correctly.__wrapped__()


def test_the_probe_agrees():
    assert probe.runs_correctly()


@pytest.mark.cpu
@pytest.mark.parametrize(("distribution", "normalizes"), NORMALIZED)
def test_the_models_gradient_is_xlas(monkeypatch, distribution, normalizes):
    monkeypatch.setattr(launch, "gradient", modelled)
    settings = config(
        network={"distribution_type": distribution},
        normalize_observations=normalizes,
        unroll_length=6,
    )
    assert_gradient_is_xlas(settings)


@on_a_gpu
@pytest.mark.parametrize("activation", ["tanh", "relu", "elu", "swish"])
@pytest.mark.parametrize("distribution", ["tanh_normal", "normal"])
@pytest.mark.parametrize("hidden", [[128, 128, 128], [48, 48], [64]], ids=str)
def test_the_gradient_is_xlas(hidden, distribution, activation):
    network = {"distribution_type": distribution, "activation": activation}
    settings = config(
        hidden=hidden, batch_size=512, num_envs=2048, unroll_length=12, network=network
    )
    assert_gradient_is_xlas(settings)


def rounded(x):
    return x.astype(jnp.float16).astype(jnp.float32)


@jax.custom_vjp
def dense(x, layer, is_last):
    """A layer whose products, forward and backward, have operands of float16."""
    return rounded(x) @ rounded(layer["kernel"]) + layer["bias"]


def dense_backward(kept, slope):
    x, layer, is_last = kept
    errors = rounded(slope)
    flat = errors.reshape(-1, errors.shape[-1])
    kernel = rounded(x).reshape(-1, x.shape[-1]).T @ flat
    bias = (slope if is_last else errors).reshape(flat.shape).sum(0)
    return errors @ rounded(layer["kernel"]).T, {"kernel": kernel, "bias": bias}, None


dense.defvjp(lambda *given: (dense(*given), given), dense_backward)


def rounding(settings, networks):
    """The same networks with such products."""
    activation = getattr(jax.nn, settings.ppo.network.activation)

    def apply(statistics, params, x):
        if settings.ppo.normalize_observations:
            x = (x - statistics.mean) / statistics.std
        tree = params["params"]
        layers = [*tree.get("MLP_0", {}).values()]
        layers += [tree[name] for name in sorted(tree) if name.startswith(("hidden", "Dense"))]
        for layer in layers[:-1]:
            x = activation(dense(x, layer, None))
        x = dense(x, layers[-1], True)
        if "std_param" in tree:
            return x, jnp.broadcast_to(tree["std_param"]["value"], x.shape)
        return x

    policy = dataclasses.replace(networks.policy_network, apply=apply)
    value = dataclasses.replace(networks.value_network, apply=lambda *x: apply(*x)[..., 0])
    made = PPONetworks(policy, value, networks.parametric_action_distribution)
    return Networks(lambda: made)


def drawn_for(fused, order, key):
    """Unrolls and noise of some minibatches, and the index of the one with the given ones."""
    count, index = fused.batch.minibatches, fused.batch.minibatches - 1
    keys = jnp.zeros((count, 2), jnp.uint32).at[index].set(key)
    unrolls = jnp.full((count, len(order)), -1, jnp.int32).at[index].set(order)
    return unrolls, fused.noise(keys), jnp.int32(index)


def assert_gradient_is_xlas(settings):
    """A minibatch's gradient and metrics, from unrolls in another order among all.

    XLA rounds to float16 where the kernels do. Without that, gradients of policies far from that
    of the collection differ by more, for its rounded parameters are those of another policy.
    """
    ppo = make_ppo(settings)
    params, statistics, batch = minibatch(np.random.default_rng(0), settings, ppo.networks)
    xla = XlaLearner(settings.ppo, rounding(settings, ppo.networks), ONE_DEVICE)
    key = jax.random.PRNGKey(2)
    # XLA would leave out roundings to float16 and back.
    gradient = jax.jit(xla.gradient, compiler_options={"xla_allow_excess_precision": False})
    with jax.default_matmul_precision("highest"):
        metrics, expected = gradient(params, statistics, batch, key)
    shape = shape_of(settings.ppo, OBSERVATIONS, ACTIONS)
    fused = FusedLearner(settings.ppo, shape)
    order = jnp.asarray(np.random.default_rng(1).permutation(settings.ppo.batch_size))

    @jax.jit
    def ours(params):
        shuffled = fused.collected(jax.tree.map(lambda x: x[order], batch), statistics)
        places = jnp.argsort(order).astype(jnp.int32)
        return fused.gradient(fused.layout.pack(params), shuffled, *drawn_for(fused, places, key))

    vector = ours(params)
    places = jnp.asarray(fused.rule.metric_places)
    found, vector = fused.metrics(vector[places]), vector.at[places].set(0.0)
    error = jnp.linalg.norm(vector - fused.layout.pack(expected)) / jnp.linalg.norm(vector)
    assert error < 0.01
    for name, value in found.items():
        np.testing.assert_allclose(value, metrics[name], rtol=0.01, atol=1e-3, err_msg=name)


@on_a_gpu
@pytest.mark.parametrize("activation", ["tanh", "relu", "elu", "swish"])
@pytest.mark.parametrize("environments", [1, 1000, 4096, 40_000])
def test_the_actions_are_xlas(activation, environments):
    settings = config(hidden=[128] * 3, network={"activation": activation}, update="xla")
    shape = shape_of(settings.ppo, OBSERVATIONS, ACTIONS)
    fused = FusedLearner(settings.ppo, shape)
    networks, rng = make_ppo(settings).networks, np.random.default_rng(0)
    made = [minibatch(rng, settings, networks)[:2] for _ in range(3)]
    observations = jnp.asarray(rng.normal(size=(3, environments, OBSERVATIONS)), jnp.float32)
    noise = jnp.asarray(rng.normal(size=(3, environments, ACTIONS)), jnp.float32)
    params, statistics = jax.tree.map(lambda *x: jnp.stack(x), *made)

    @jax.jit
    @jax.vmap
    def ours(params, statistics, observations, noise):
        return fused.policy(fused.layout.pack(params), statistics)(observations, noise)

    together = ours(params, statistics, observations, noise)
    for i, (one, statistic) in enumerate(made):
        with jax.default_matmul_precision("highest"):
            expected = networks.policy_network.apply(statistic, one.policy, observations[i])
        _, kept = jax.tree.map(lambda x, i=i: x[i], together)
        np.testing.assert_allclose(kept["distribution_params"], expected, atol=0.02)
        brax = networks.parametric_action_distribution
        log_prob = brax.log_prob(kept["distribution_params"], kept["raw_action"])
        np.testing.assert_allclose(kept["log_prob"], log_prob, atol=1e-3)


SCHEDULES = {
    "NONE": {"max_grad_norm": None},
    "LINEAR": {"max_grad_norm": 0.5, "num_timesteps": 256 * 3},
    "ADAPTIVE_KL": {"max_grad_norm": 2.0, "desired_kl": 0.02},
}


def modelled_adam(rule, *arrays):
    """`launch.adam` on the model of a GPU, for one policy."""

    def run(*arrays):
        given = {name: np.array(x) for name, x in zip(ADAM.arguments, arrays, strict=True)}
        results = [given[name] for name in ADAM.returns]
        kernel = AdamKernel(rule, 2)
        memory = kernel.shared_memory
        simt.run(kernel.text(), [*given.values(), *results], (2, 1, 1), shared_memory=memory)
        return results

    like = [jax.ShapeDtypeStruct(arrays[i].shape, np.float32) for i in ADAM.aliases]
    return jax.pure_callback(run, like, *arrays)


# Of every schedule, one distribution.
QUICK_SCHEDULES = {"NONE": "normal", "LINEAR": "tanh_normal", "ADAPTIVE_KL": "tanh_normal"}
SCHEDULED = slow_unless(
    lambda schedule, distribution: distribution == QUICK_SCHEDULES[schedule],
    itertools.product(SCHEDULES, ["tanh_normal", "normal"]),
)


@pytest.mark.parametrize("compute", [launch.adam, modelled_adam], ids=["kernel", "model"])
@pytest.mark.parametrize(("schedule", "distribution"), SCHEDULED)
def test_adam_is_that_of_optax(schedule, distribution, compute):
    """Six minibatches after two of another training step, of which one has no finite gradient."""
    settings = config(
        learning_rate_schedule=schedule,
        network={"distribution_type": distribution},
        **SCHEDULES[schedule],
    )
    ppo, rng = make_ppo(settings), np.random.default_rng(0)
    fused, xla = ppo.learner, XlaLearner(settings.ppo, ppo.networks, ONE_DEVICE)
    params, statistics, batch = minibatch(rng, settings, ppo.networks)
    state = params, make_optimizer(settings.ppo).init(params)
    ours, totals = fused.layout.pack(state), jnp.zeros(8)
    adam_step = jax.jit(compute, static_argnums=0)

    @jax.jit
    def optax_step(state, *given):
        xla.gradient = lambda *_: given
        return xla.minibatch_step(*state, statistics, batch, jax.random.PRNGKey(0))

    sizes = np.asarray(fused.rule.metric_places)
    for call, count in enumerate((2, 6)):
        totals, vectors = jnp.zeros_like(totals), fused.first_vectors(*ours)
        vectors = *vectors[:3], vectors[3][: count + 1]
        rule = fused.rule._replace(steps=count)
        terms = fused.adam_terms(ours[1])
        for i in range(count):
            sums = np.float32(rng.normal(size=5) * 64)
            # The divergence lowers the step size, raises it, or leaves it.
            sums[2] = [4.0, 0.1, 1.2, -1.0][i % 4]
            gradient = jax.tree.map(lambda x: np.float32(rng.normal(size=x.shape) * 0.1), params)
            if (call, i) == (1, 2):
                for leaf in jax.tree.leaves(gradient):
                    leaf[(0,) * leaf.ndim] = np.nan
                sums *= np.nan
            *state, row = optax_step(state, fused.metrics(sums), gradient)
            totals += jnp.where(row[-1] > 0, row, 0.0)
            vector = fused.layout.pack(gradient)
            vector[sizes] = sums
            vectors = adam_step(rule, vector, *vectors, jnp.int32(i), terms)
        *ours, found_totals = fused.results(vectors, ours[1])
    found = fused.layout.unpack(tuple(ours))
    assert jax.tree.structure(found) == jax.tree.structure(tuple(state))
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(state), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(found_totals, totals, rtol=1e-5)
    assert float(found_totals[-1]) == 5
    assert int(found[1][-1].count) == 7


def test_adam_serves_several_policies_at_once():
    fused, rng = make_ppo(config()).learner, np.random.default_rng(0)
    size = fused.shape.size
    vectors = [np.abs(rng.normal(size=(3, size))).astype(np.float32) for _ in range(4)]
    progress = np.asarray([1e-3, 0.9, 0.999, *[0.0] * 7], np.float32)
    # Policies may even be at different steps.
    index = np.arange(3, dtype=np.int32)
    rows = np.tile(np.full_like(progress, np.nan), (3, fused.rule.steps + 1, 1))
    rows[index, index] = progress
    terms = np.asarray([[limit, 1e-3, 0, 0, 0, 0, 0] for limit in (1, 9, np.inf)], np.float32)
    vectors[0][1] = np.inf
    run = functools.partial(launch.adam, fused.rule)
    arrays = *vectors, rows, index, terms
    together = jax.jit(jax.vmap(run))(*arrays)
    turned = [np.moveaxis(x, 0, -1) for x in arrays]
    turned = jax.vmap(run, in_axes=-1)(*turned)
    with jax.disable_jit():
        first = run(*(x[0] for x in arrays))
    for one, other, alone in zip(together, turned, first, strict=True):
        np.testing.assert_array_equal(one, other)
        np.testing.assert_array_equal(one[0], alone)
    for i in range(3):
        alone = jax.jit(run)(*(x[i] for x in arrays))
        for one, other in zip(alone, together, strict=True):
            np.testing.assert_array_equal(one, other[i])
        assert float(alone[3][i + 1, -1]) == (i != 1)


@pytest.mark.slow
@pytest.mark.cpu
@pytest.mark.parametrize(
    ("policies", "distribution", "schedule"),
    slow_unless(
        lambda policies, distribution, schedule: (
            distribution == QUICK_SCHEDULES[schedule] and (policies == 3) == (schedule != "LINEAR")
        ),
        itertools.product([1, 3], ["tanh_normal", "normal"], SCHEDULES),
    ),
)
def test_a_cpu_computes_all_minibatches_at_once_as_one_by_one(policies, distribution, schedule):
    settings = config(
        num_minibatches=3,
        num_envs=48,
        batch_size=16,
        unroll_length=40,
        learning_rate_schedule=schedule,
        network={"distribution_type": distribution},
        **SCHEDULES[schedule],
    )
    ppo, rng = make_ppo(settings), np.random.default_rng(0)
    fused, made = ppo.learner, []
    for policy in range(policies):
        params, statistics, _ = minibatch(rng, settings, ppo.networks)
        several = [minibatch(rng, settings, ppo.networks)[2] for _ in range(3)]
        data = jax.tree.map(lambda *x: jnp.concatenate(x), *several)
        if policy == 0:
            # A minibatch of each pass has no finite gradient.
            data = data._replace(reward=data.reward.at[0, 0].set(jnp.inf))
        vectors = fused.layout.pack((params, make_optimizer(settings.ppo).init(params)))
        made.append((*vectors, statistics, data, jax.random.PRNGKey(policy)))
    made = jax.tree.map(lambda *x: jnp.stack(x), *made)
    results = []
    for at_once in (True, False):
        fused.at_once = at_once
        results.append(jax.jit(jax.vmap(lambda *x: fused.update(*x)))(*made))
    jax.tree.map(np.testing.assert_array_equal, *results)
    passes = settings.ppo.num_updates_per_batch
    applied = np.asarray(results[0][2])[:, len(LOSSES)]
    np.testing.assert_array_equal(applied, [2 * passes, *[3 * passes] * (policies - 1)])
    assert np.isfinite(results[0][0]).all()
    assert (np.asarray(results[0][0]) != np.asarray(made[0])).mean() > 0.9


@on_a_gpu
def test_several_policies_take_the_same_launches():
    settings = config(update="fused")
    ppo = make_ppo(settings)
    fused, key = ppo.learner, jax.random.PRNGKey(2)
    made = [minibatch(np.random.default_rng(seed), settings, ppo.networks) for seed in range(3)]
    order = jnp.arange(settings.ppo.batch_size)

    def one_gradient(params, statistics, batch):
        collected = fused.collected(batch, statistics)
        return fused.gradient(fused.layout.pack(params), collected, *drawn_for(fused, order, key))

    together = jax.jit(jax.vmap(one_gradient))(*jax.tree.map(lambda *x: jnp.stack(x), *made))
    for one, ours in zip(made, together, strict=True):
        np.testing.assert_allclose(ours, jax.jit(one_gradient)(*one), rtol=1e-4, atol=1e-6)
