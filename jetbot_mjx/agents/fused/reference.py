"""Compute in NumPy what PPO's kernels should compute, to check them before a training.

All formulas are those of `sample_loss` and `adam`, whose programs are evaluated in float64 instead
of compiled, and networks are differentiated by central differences. So a kernel is compared with
the same functions, but with nothing that a compiler or a processor made of them. XLA would take
longer to compile the functions than a training takes to begin.

The networks have a `tanh_normal` distribution, and one hidden layer with tanh.
"""

import numpy as np

from jetbot_mjx.agents.fused import adam, sample_loss
from jetbot_mjx.agents.fused.adam import AdamRule, Factors
from jetbot_mjx.agents.fused.shapes import LossTerms, UpdateShape
from onekernel.build import evaluate

_STEP = 1e-4
"""Distance of the central differences from the parameters."""


def actions(
    shape: UpdateShape, params: np.ndarray, observations: np.ndarray, noise: np.ndarray
) -> list[np.ndarray]:
    """Return the arrays of `launch.Actions`.

    Args:
      shape: the networks.
      params: the vector of parameters.
      observations: the observations, of shape (..., observations).
      noise: standard normal noise, of shape (..., actions).
    """
    program = sample_loss.action_program(shape, for_gpu=True)
    # The program of the kernels, for all samples at once.
    outputs = network(shape, params, observations)
    drawn = np.stack(evaluate(program, _columns(outputs, np.zeros(noise.shape), noise)), -1)
    ends = np.cumsum([shape.actions, shape.actions, 1])
    action, raw, log_prob, parameters = np.split(drawn, ends, axis=-1)
    return [action, raw, log_prob[..., 0], parameters]


def gradient(
    shape: UpdateShape,
    terms: LossTerms,
    params: np.ndarray,
    rows: np.ndarray,
    last: np.ndarray,
    noise: np.ndarray,
) -> np.ndarray:
    """Return the vector of `launch.gradient`, of all unrolls; zero for what is no parameter.

    Args:
      shape: the networks, whose advantages are not normalised.
      terms: the coefficients of the loss.
      params: the vector of parameters.
      rows: the collected rows, of shape (unrolls, time, columns).
      last: the observations after them, of shape (unrolls, observations).
      noise: the noise of the entropy, of shape (time, unrolls, actions).
    """
    # Put the time first.
    rows = rows.swapaxes(0, 1)
    samples = noise[..., 0].size
    start, end = (shape.columns[name] for name in ("raw_action", "reward"))
    observations, collected = rows[..., : shape.observations], rows[..., start:end]
    # Run backwards through the unrolls: advantages, and the derivatives of the loss by the values.
    program = sample_loss.value_step_program(samples)
    final = network(shape, params, last, is_policy=False)[..., 0]
    following = [final, final, np.zeros_like(final)]
    values = network(shape, params, observations, is_policy=False)[..., 0]
    advantages, by_value = np.zeros((2, *values.shape, 1))
    for t in reversed(range(len(rows))):
        given = [values[t], *_columns(rows[t, :, end:]), *following, *terms]
        advantages[t, :, 0], by_value[t, :, 0], _, *following = evaluate(program, given)
    # The derivatives of the loss by the outputs of the policy network.
    program = sample_loss.policy_program(shape, samples, for_gpu=True)
    outputs = network(shape, params, observations)
    sample = outputs, np.zeros(noise.shape), collected, noise, advantages, np.ones(advantages.shape)
    results = evaluate(program, [*_columns(*sample), *terms])
    by_outputs = np.stack(results[: shape.outputs[0]], -1)
    # The derivatives of the outputs and values by each parameter.
    result = np.zeros(shape.size)
    for is_policy, slopes in ((True, by_outputs), (False, by_value)):
        for i, direction in enumerate(_STEP * np.eye(shape.size)):
            ends = (params + x * direction for x in (1, -1))
            forward, backward = (network(shape, x, observations, is_policy=is_policy) for x in ends)
            result[i] += np.sum((forward - backward) * slopes) / (2 * _STEP)
    return result


def adam_step(rule: AdamRule, arrays: dict[str, np.ndarray]) -> list[np.ndarray]:
    """Return the arrays that `arrays.ADAM` returns after a step, the first one of a training step.

    Args:
      rule: what the vectors hold.
      arrays: those of `arrays.ADAM` of one policy, but for the index.
    """
    factors, element = adam.programs(rule)
    gradient, progress = arrays["gradient"], arrays["progress"].copy()
    is_parameter = np.ones(rule.shape.size, bool)
    is_parameter[rule.places] = False
    # What all elements have in common, and then the elements.
    square = np.sum(gradient[is_parameter] ** 2)
    given = [square, *gradient[rule.places], *progress[0], *arrays["adam_terms"]]
    results = evaluate(factors, given)
    common, progress[1] = results[: len(Factors._fields)], results[len(Factors._fields) :]
    before = [arrays[name] for name in ("params", "mu", "nu")]
    after = evaluate(element, [*before, gradient, *common])
    # Metrics stand between the parameters, and stay as they are.
    after = [np.where(is_parameter, *pair) for pair in zip(after, before, strict=True)]
    return [*after, progress]


def network(
    shape: UpdateShape, params: np.ndarray, x: np.ndarray, *, is_policy: bool = True
) -> np.ndarray:
    """Return the outputs of one of the networks.

    Args:
      shape: the networks.
      params: the vector of parameters.
      x: the observations, of shape (..., observations).
      is_policy: whether it is the policy's network, and not that of the values.
    """
    start = 0 if is_policy else shape.policy_size
    for is_last, size in enumerate((shape.width, shape.outputs[not is_policy])):
        # Weights, of shape (inputs, outputs), and biases.
        weights = params[start:][: x.shape[-1] * size].reshape(-1, size)
        start += weights.size + size
        x = x @ weights + params[start - size : start]
        x = x if is_last else np.tanh(x)
    return x


def _columns(*arrays: np.ndarray) -> list[np.ndarray]:
    """Return the numbers of the last axes, one after the other."""
    return [x[..., i] for x in arrays for i in range(x.shape[-1])]
