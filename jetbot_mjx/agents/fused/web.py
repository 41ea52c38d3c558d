"""Write the kernels of PPO for web pages, where a script calls them.

The kernels are those of CPUs, compiled to WebAssembly. `WebLearner.about` tells the script all that
it needs: sizes, places of numbers, and hyperparameters.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from jetbot_mjx.agents.fused import adam, arrays, sample_loss
from jetbot_mjx.agents.fused.adam import AdamTerms, Progress
from jetbot_mjx.agents.fused.arrays import Signature, Spec
from jetbot_mjx.agents.fused.cpu_product import Matrix, matmul, product_functions
from jetbot_mjx.agents.fused.launch_cpu import call_of, misfit
from jetbot_mjx.agents.fused.learner import FusedLearner, shape_of
from jetbot_mjx.agents.fused.sample_loss import vector_of
from jetbot_mjx.agents.fused.shapes import LossTerms, UpdateShape
from jetbot_mjx.config import PPOConfig
from onekernel.build import LlvmWriter, run_program, scalarize, wasm


class WebLearner(NamedTuple):
    """A `WebLearner` holds what a web page needs to train by PPO."""

    texts: Mapping[str, str]
    """The functions `ppo_act` and `ppo_update`, as LLVM modules for `wasm.link`."""
    about: Mapping[str, Any]
    """What a script must know of them, as JSON values."""


def web_learner(
    config: PPOConfig, observation_size: int | Mapping[str, object], action_size: int
) -> WebLearner | str:
    """Return what a web page needs to train a configuration, or why it cannot.

    Args:
      config: the hyperparameters.
      observation_size: the length of the observation, or the shapes of its parts.
      action_size: the length of the action.
    """
    shape = shape_of(config, observation_size, action_size)
    if isinstance(shape, str):
        return shape
    learner = FusedLearner(config, shape)
    if reason := misfit(shape, learner.batch, wasm.LANES):
        return reason
    texts, functions = {}, {}
    for name, kernel, spec in (
        ("ppo_act", arrays.ACTIONS, shape),
        ("ppo_update", arrays.UPDATE, learner.rule),
    ):
        texts[name], functions[name] = _function(name, kernel, spec, learner)
    about = {
        "functions": functions,
        "environments": config.num_envs,
        "batch": learner.batch._asdict(),
        "passes": config.num_updates_per_batch,
        "columns": shape.columns,
        "shape": shape._asdict(),
        "initial": _initial(shape, config.network.initial_action),
        "layers": _policy_layers(shape),
        "loss_terms": [float(getattr(config, name)) for name in LossTerms._fields],
        "adam_terms": list(AdamTerms._fields),
        "progress": {"names": list(Progress._fields), "metrics": list(adam.METRICS)},
        "betas": [adam.BETA_1, adam.BETA_2],
        "optimizer": {
            "max_grad_norm": config.max_grad_norm,
            "learning_rate": config.learning_rate,
            "fraction_per_step": 1.0 / config.gradient_steps,
            "desired_kl": config.desired_kl,
            "min_rate": config.learning_rate_schedule_min_lr,
            "max_rate": config.learning_rate_schedule_max_lr,
            "adaptive": config.learning_rate_schedule == "ADAPTIVE_KL",
        },
        "normalizes_observations": config.normalize_observations,
        "steps": config.num_timesteps,
    }
    return WebLearner(texts, about)


def network_texts(activation: str) -> dict[str, str]:
    """Write the functions with which a script applies the layers of any policy.

    `net_product` adds the product of two matrices to a third one, `a`, `b` and `c`, whose rows are
    contiguous; it takes address and floats from row to row of each, the rows and columns (a
    multiple of 4) of the result, and the length of the sums. `net_activate` replaces numbers by
    their activations; it takes their address, and their number, a multiple of 4.

    Args:
      activation: the activation between the layers.
    """
    matrices = [text for name in "abc" for text in (f"ptr {name}", f"u32 {name}_row")]
    sizes = "u32 rows", "u32 columns", "u32 length"
    w = LlvmWriter("net_product", *matrices, *sizes, convention="external")
    numbers = [x.to("u64") if x.type == "u32" else x for x in w.parameters]
    a, b, c = (Matrix(*numbers[i : i + 2]) for i in (0, 2, 4))
    matmul(a, b, c, (numbers[6], numbers[7], numbers[8]), adds=True)
    products = product_functions(wasm.LANES, wasm.REGISTERS)
    return {"net_product": wasm.module_text([*products, w]), "net_activate": _activate(activation)}


def _activate(activation: str) -> str:
    program = scalarize(lambda x: sample_loss.activation(activation, x)[0], vector_of())
    parameters = "ptr numbers", "u32 count"
    w = LlvmWriter("net_activate", *parameters, convention="external", lanes=wasm.LANES)
    numbers, count = w.parameters
    with w.loop(count.to("u64") // wasm.LANES) as i:
        place = numbers + i * wasm.LANES
        (activated,) = run_program(w, program, [place.load(w.vector)])
        place.store(activated)
    return wasm.module_text([w])


def _function(
    name: str, kernel: Signature, spec: Spec, learner: FusedLearner
) -> tuple[str, dict[str, Any]]:
    """Write a kernel, and describe its arguments: the arrays, and scratch memory [bytes]."""
    call = call_of(kernel, spec, kernel.relevant(learner.batch), wasm.LANES)
    functions = call.functions(wasm.LANES, wasm.REGISTERS)
    text = wasm.blocks_text(name, functions, len(call.arrays), call.blocks)
    sizes = [[array, call.sizes[array]] for array in call.arrays]
    return text, {"arrays": sizes, "scratch": call.scratch}


def _policy_layers(shape: UpdateShape) -> list[dict[str, int]]:
    """Return where the vector of parameters has the layers of the policy, weights then biases.

    The last layer's first outputs are the means of the actions.
    """
    layers = [
        {"start": start, "inputs": inputs, "outputs": shape.width}
        for _, inputs, start in shape.hidden_layers
    ]
    last = {"start": shape.head_start, "inputs": shape.width, "outputs": shape.outputs[0]}
    return [*layers, last]


def _initial(shape: UpdateShape, action: Sequence[float] | None) -> list[dict[str, float]]:
    """Return which numbers the vector of parameters begins with; all others are 0.

    Each entry says where numbers begin, how many there are, and the limit of their uniform
    distribution around 0, or their value.
    """
    entries: list[dict[str, float]] = []
    # The weights of both networks, by the initialiser of Brax: LeCun's, of variance 1 / inputs.
    for begin, outputs in zip((0, shape.policy_size), shape.outputs, strict=True):
        sizes = [(i, start, shape.width) for _, i, start in shape.hidden_layers]
        for inputs, start, width in (*sizes, (shape.width, shape.head_start, outputs)):
            limit = math.sqrt(3.0 / inputs)
            entries.append({"start": begin + start, "count": inputs * width, "limit": limit})
    # The first action is that of the last layer's biases; the deviations may be parameters.
    biases = shape.head_start + shape.width * shape.outputs[0]
    means = np.zeros(0) if action is None else np.asarray(action)
    means = np.arctanh(means) if shape.distribution == "tanh_normal" else means
    values = [(biases + i, float(mean)) for i, mean in enumerate(means)]
    values += [(biases + shape.outputs[0] + i, 1.0) for i in range(shape.deviations)]
    return entries + [{"start": start, "count": 1, "value": value} for start, value in values]
