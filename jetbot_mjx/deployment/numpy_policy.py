"""Convert a policy to NumPy arrays and to a pure JAX function, and compare implementations.

An exported policy is one function of a batch of observations. It applies the normaliser, the
network, the distribution's mode, the environment's clip to [-1, 1] and the controller that converts
an action to wheel speeds; it returns both the actions and the wheel speeds.
"""

from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jetbot_mjx.agents.networks import make_policy
from jetbot_mjx.envs.jetbot_env import JetBotEnv
from jetbot_mjx.envs.mujoco_env import MujocoJetBot
from jetbot_mjx.envs.robot_model import CONTROLLER_WHEEL_RADIUS, CONTROLLER_WHEEL_SEPARATION
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation.evaluator import report_keys
from jetbot_mjx.runs.checkpoint import Checkpoint
from jetbot_mjx.runs.progress import stage

RECORDED = 10_000
"""Number of observations on which an export is checked."""

TOLERANCE = 1e-5
"""Largest difference from JAX that an export may have, in the unit of an action."""

Outputs = tuple[Float[Array | np.ndarray, "n 2"], Float[Array | np.ndarray, "n 2"]]
"""Actions in [-1, 1], and the wheel speeds (left, right) [rad/s] that they command."""


class Controller(NamedTuple):
    """The controller that converts an action to wheel speeds; `kinematics` has the formulas."""

    max_speed: float
    """Forward speed of a₀ = 1 [m/s]."""
    max_yaw_rate: float
    """Yaw rate of a₁ = 1 [rad/s]."""
    wheel_radius: float
    """Wheel radius that the controller assumes, not that of a robot [m]."""
    wheel_separation: float
    """Wheel separation that the controller assumes [m]."""

    @property
    def fastest(self) -> float:
        """Return the largest wheel speed that an action can command [rad/s]."""
        turn = 0.5 * self.max_yaw_rate * self.wheel_separation
        return (self.max_speed + turn) / self.wheel_radius


class Layer(NamedTuple):
    """A dense layer: x ↦ x · kernel + bias."""

    kernel: Float[np.ndarray, "inputs outputs"]
    bias: Float[np.ndarray, " outputs"]


class PortablePolicy(NamedTuple):
    """A `PortablePolicy` holds a deterministic policy as arrays."""

    mean: Float[np.ndarray, " obs"]
    """Mean of the observation's normaliser; zeros without one."""
    std: Float[np.ndarray, " obs"]
    """Standard deviation of the normaliser; ones without one."""
    layers: tuple[Layer, ...]
    """The last layer gives only the location of the distribution."""
    activation: Literal["tanh", "relu", "elu", "swish"]
    """Activation between the layers."""
    squash: bool
    """Whether tanh follows the last layer; the clip to [-1, 1] follows in any case."""
    controller: Controller


class Recording(NamedTuple):
    """Observations from a drive, and JAX's outputs for them; on the host, float32."""

    obs: Float[np.ndarray, "n obs"]
    action: Float[np.ndarray, "n 2"]
    wheel_speeds: Float[np.ndarray, "n 2"]
    """(left, right) [rad/s]."""


def portable_policy(checkpoint: Checkpoint) -> PortablePolicy:
    """Extract a policy from a checkpoint.

    Args:
      checkpoint: A checkpoint of a network that `make_networks` built.

    Returns:
      The policy as arrays. Compare its outputs with `as_jax`, which uses Brax's own code.

    Raises:
      UserError: the policy sees images.
    """
    config = checkpoint.config
    if config.task.sees:
        raise UserError(
            f"{checkpoint.run_dir} has task.observation = {config.task.observation!r}: only"
            " policies that observe numbers can be exported"
        )
    network = config.ppo.network
    params: Any = jax.device_get(checkpoint.params)
    size = checkpoint.about["observation_size"]
    mean, std = np.zeros(size, np.float32), np.ones(size, np.float32)
    if config.ppo.normalize_observations:
        mean, std = np.asarray(params.normalizer.mean), np.asarray(params.normalizer.std)
    dense: Mapping[str, Any] = params.policy["params"]
    if network.distribution_type == "normal":
        # Brax stores the last layer of this distribution apart, with a standard deviation.
        dense = {**dense["MLP_0"], f"hidden_{len(dense['MLP_0'])}": dense["Dense_0"]}
    layers = [
        Layer(np.asarray(one["kernel"]), np.asarray(one["bias"]))
        for one in (dense[f"hidden_{index}"] for index in range(len(dense)))
    ]
    actions = checkpoint.about["action_size"]
    layers[-1] = Layer(layers[-1].kernel[:, :actions], layers[-1].bias[:actions])
    return PortablePolicy(
        mean=mean,
        std=std,
        layers=tuple(layers),
        activation=network.activation,
        squash=network.distribution_type == "tanh_normal",
        controller=Controller(
            max_speed=config.task.max_speed,
            max_yaw_rate=config.task.max_yaw_rate,
            wheel_radius=CONTROLLER_WHEEL_RADIUS,
            wheel_separation=CONTROLLER_WHEEL_SEPARATION,
        ),
    )


def as_jax(
    checkpoint: Checkpoint, env: JetBotEnv
) -> Callable[[Float[Array, "n obs"]], tuple[Float[Array, "n 2"], Float[Array, "n 2"]]]:
    """Return the policy as used in training and evaluation, the reference for every export.

    Args:
      checkpoint: The checkpoint of the policy.
      env: The environment that the policy was trained in.

    Returns:
      A pure function of a batch of observations, in full float32 on every device.
    """
    policy = make_policy(checkpoint.networks, checkpoint.params)

    def act(obs: Float[Array, "n obs"]) -> tuple[Float[Array, "n 2"], Float[Array, "n 2"]]:
        with jax.default_matmul_precision("highest"):
            action = jnp.clip(policy(obs), -1.0, 1.0)
        return action, jax.vmap(env.wheel_targets)(action)

    return act


def record(checkpoint: Checkpoint, env: JetBotEnv, count: int = RECORDED) -> Recording:
    """Drive to the report's fixed goals, one after the other, and record the observations.

    The drive runs in C MuJoCo, which needs no compilation and simulates the same robot.

    Args:
      checkpoint: The checkpoint of the policy.
      env: The environment that the policy was trained in.
      count: Number of observations.

    Returns:
      The recording, the same for the same checkpoint on the same machine.
    """
    robot = MujocoJetBot(checkpoint.config, type(env.task))
    act = jax.jit(as_jax(checkpoint, env))
    keys = iter(np.asarray(report_keys(count)))
    seen: list[np.ndarray] = []
    with stage("observations of a drive", count) as advance:
        while len(seen) < count:
            before = len(seen)
            obs, _ = robot.reset(next(keys))
            for _ in range(min(checkpoint.config.task.episode_length, count - before)):
                seen.append(obs)
                (action,), _ = jax.device_get(act(obs[None]))
                step = robot.step(action)
                obs = step.obs
                if step.terminated or not step.finite:
                    break
            advance(len(seen) - before)
    obs = np.stack(seen)
    action, wheel_speeds = jax.device_get(act(obs))
    return Recording(obs, action, wheel_speeds)


def difference(recording: Recording, outputs: Outputs, controller: Controller) -> float:
    """Return the largest difference of another implementation's results from JAX's.

    Args:
      recording: Observations, and JAX's outputs for them.
      outputs: The other implementation's outputs.
      controller: The controller, which limits the wheel speeds.

    Returns:
      The largest difference of any number, wheel speeds as a share of the fastest; infinite
      where an output has another shape or is not finite.
    """
    worst = 0.0
    pairs = ((recording.action, 1.0), (recording.wheel_speeds, controller.fastest))
    for (wanted, unit), found in zip(pairs, outputs, strict=True):
        values = np.asarray(found)
        if values.shape != wanted.shape or not np.all(np.isfinite(values)):
            return float("inf")
        worst = max(worst, float(np.abs(values - wanted).max()) / unit)
    return worst
