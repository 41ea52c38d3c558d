"""Convert a policy to NumPy arrays and to a pure JAX function, and compare implementations.

An exported policy is one function of a batch of observations: `obs`, numbers, or `image`, and
`state`, the numbers beside it, if there are any. It applies the normaliser, the network, the
distribution's mode, the environment's clip to [-1, 1] and the controller that converts an action to
wheel speeds; it returns both the actions and the wheel speeds. In an environment of one's own there
are no wheels: it returns the actions only.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jetbot_mjx import envs
from jetbot_mjx.agents import CNNS, ENCODER, HEAD, make_networks, make_policy
from jetbot_mjx.envs import NUMBERS, PIXELS, AdaptedEnv, JetBotEnv, Observation
from jetbot_mjx.evaluation import report_keys
from jetbot_mjx.runs import Checkpoint, Setup
from jetbot_mjx.terminal import stage

RECORDED, RECORDED_IMAGES = 10_000, 1_000
"""Number of observations on which an export is checked, and that of observations with an image."""

TOLERANCE = 1e-5
"""Largest difference from JAX that an export may have, in the unit of an action."""

_PARTS = {"image": PIXELS, "state": NUMBERS}
"""Inputs of a policy that sees, and their keys in the environment's observation."""

Outputs = tuple[Float[Array | np.ndarray, "n _"], ...]
"""Actions in [-1, 1], and of a robot the wheel speeds (left, right) [rad/s] that they command."""

_CLEAR_CHOICE = 1e-4
"""Smallest difference of the two largest outputs of the network for a recorded choice: where
they are closer, round-off chooses."""

_RECORDED_AT_ONCE = 16
"""Number of environments of one's own that are stepped at once."""


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

    @property
    def mixing(self) -> list[list[float]]:
        """Return the derivative of the wheel speeds (left, right) by drive and turn [rad/s]."""
        drive = 0.5 * self.max_speed / self.wheel_radius
        turn = self.fastest - 2.0 * drive
        return [[drive, drive], [-turn, turn]]


class CarController(NamedTuple):
    """The controller that converts an action to a wheel speed and a curvature of the path."""

    max_speed: float
    """Speed of the middle of the rear axle of a₀ = 1 [m/s]."""
    max_curvature: float
    """Curvature of a₁ = 1 [1/m]."""
    wheel_radius: float
    """Radius of the driven wheels [m]."""

    @property
    def fastest(self) -> float:
        """Return the largest wheel speed that an action can command [rad/s]."""
        return self.max_speed / self.wheel_radius

    @property
    def mixing(self) -> list[list[float]]:
        """Return the derivative of wheel speed [rad/s] and curvature [1/m] by drive and turn."""
        return [[0.5 * self.fastest, 0.0], [0.0, self.max_curvature]]


class OwnController(NamedTuple):
    """A controller that only the robot's own function knows: the action as it is."""

    action_size: int

    @property
    def fastest(self) -> float:
        """Return the largest number of an action."""
        return 1.0

    @property
    def mixing(self) -> list[list[float]]:
        """Return the derivative of the action by itself."""
        return np.eye(self.action_size).tolist()


AnyController = Controller | CarController | OwnController


class Layer(NamedTuple):
    """A dense layer: x ↦ x · kernel + bias."""

    kernel: Float[np.ndarray, "inputs outputs"]
    bias: Float[np.ndarray, " outputs"]


class Convolution(NamedTuple):
    """A convolution without padding, and a ReLU behind it."""

    kernel: Float[np.ndarray, "side side c_in c_out"]
    bias: Float[np.ndarray, " c_out"]
    stride: int


class Encoder(NamedTuple):
    """An `Encoder` maps an image to features, which come before the numbers beside it."""

    image_shape: tuple[int, int, int]
    """Height, width and channels."""
    convolutions: tuple[Convolution, ...]
    """The first kernel takes pixels from 0 to 255."""
    dense: Layer
    """From the last outputs, row by row with the channels last, to the features; a ReLU follows."""


class PortablePolicy(NamedTuple):
    """A `PortablePolicy` holds a deterministic policy as arrays."""

    encoder: Encoder | None
    """None: the policy observes numbers only."""
    mean: Float[np.ndarray, " numbers"]
    """Mean of the normaliser of the numbers; zeros without one."""
    std: Float[np.ndarray, " numbers"]
    """Standard deviation of the normaliser; ones without one."""
    layers: tuple[Layer, ...]
    """The last layer gives only the location of the distribution."""
    activation: Literal["tanh", "relu", "elu", "swish"]
    """Activation between the layers."""
    squash: bool
    """Whether tanh follows the last layer; the clip to [-1, 1] follows in any case."""
    controller: AnyController | None
    """None: what an action means is known to the environment alone."""
    is_choice: bool = False
    """Whether the action is 1 at the largest output of the last layer, and 0 elsewhere."""

    @property
    def outputs(self) -> dict[str, int]:
        """Return the size of each output by its name, in their order."""
        size = self.layers[-1].bias.size
        if self.controller is None:
            return {"action": size}
        return {"action": size, "wheel_speeds": len(self.controller.mixing[0])}

    @property
    def inputs(self) -> dict[str, jax.ShapeDtypeStruct]:
        """Return shape and type of each input by its name, without a batch, in their order."""
        numbers = jax.ShapeDtypeStruct(self.mean.shape, np.float32)
        if self.encoder is None:
            return {"obs": numbers}
        image = jax.ShapeDtypeStruct(self.encoder.image_shape, np.uint8)
        return {"image": image, "state": numbers} if self.mean.size else {"image": image}


class Recording(NamedTuple):
    """Observations from a drive, and JAX's outputs for them; on the host."""

    inputs: Mapping[str, np.ndarray]
    """Inputs of the policy by their names, in their order, each with a batch axis."""
    action: Float[np.ndarray, "n action"]
    wheel_speeds: Float[np.ndarray, "n _"] | None
    """(left, right) [rad/s]; of a car (wheel speed [rad/s], curvature [1/m]); the action itself
    where only the robot's own function knows what it means. None in an environment of one's own."""

    @property
    def outputs(self) -> Outputs:
        """Return JAX's outputs, as another implementation's."""
        return (self.action,) if self.wheel_speeds is None else (self.action, self.wheel_speeds)


def portable_policy(checkpoint: Checkpoint, env: JetBotEnv | AdaptedEnv) -> PortablePolicy:
    """Extract a policy from a checkpoint.

    Args:
      checkpoint: A checkpoint of a network that `make_networks` built.
      env: The environment that the policy was trained in.

    Returns:
      The policy as arrays. Compare its outputs with `as_jax`, which uses Brax's own code.
    """
    config = checkpoint.config
    network = config.ppo.network
    params: PyTree = jax.device_get(checkpoint.params)
    size, encoder, policy = checkpoint.about["observation_size"], None, params.policy
    statistics = params.normalizer.mean, params.normalizer.std
    if config.task.sees:
        encoder = _encoder(network.cnn, size[PIXELS], policy[ENCODER]["params"])
        statistics = [one.get(NUMBERS, np.zeros(0, np.float32)) for one in statistics]
        size, policy = sum(size.get(NUMBERS, ())), policy[HEAD]
    mean, std = np.zeros(size, np.float32), np.ones(size, np.float32)
    if config.ppo.normalize_observations:
        mean, std = map(np.asarray, statistics)
    dense: PyTree = policy["params"]
    if network.distribution_type == "normal":
        # Brax stores the last layer of this distribution apart, with a standard deviation.
        dense = {**dense["MLP_0"], f"hidden_{len(dense['MLP_0'])}": dense["Dense_0"]}
    layers = [_layer(dense[f"hidden_{index}"]) for index in range(len(dense))]
    actions = checkpoint.about["action_size"]
    layers[-1] = Layer(layers[-1].kernel[:, :actions], layers[-1].bias[:actions])
    return PortablePolicy(
        encoder=encoder,
        mean=mean,
        std=std,
        layers=tuple(layers),
        activation=network.activation,
        squash=network.distribution_type == "tanh_normal",
        controller=None if isinstance(env, AdaptedEnv) else _controller(env.drive),
        is_choice=network.distribution_type == "categorical",
    )


def _controller(drive: envs.Drive) -> AnyController:
    if isinstance(drive, envs.OwnDrive):
        return OwnController(drive.action_size)
    if isinstance(drive, envs.AckermannDrive):
        return CarController(drive.max_speed, drive.max_curvature, drive.wheel_radius)
    return Controller(
        drive.max_speed, drive.max_yaw_rate, drive.wheel_radius, drive.wheel_separation
    )


def _layer(params: PyTree) -> Layer:
    return Layer(np.asarray(params["kernel"]), np.asarray(params["bias"]))


def _encoder(cnn: str, image_shape: Sequence[int], params: PyTree) -> Encoder:
    """Return the encoder with the division of the pixels by 255 in its first kernel.

    Args:
      cnn: the name of the encoder's layers, `ppo.network.cnn`.
      image_shape: height, width and channels of the image.
      params: the encoder's parameters.
    """
    kernels = [np.asarray(params[f"conv_{i}_kernel"]) for i in range(len(CNNS[cnn].convolutions))]
    kernels[0] = kernels[0] / np.float32(255)
    height, width, channels = image_shape
    return Encoder(
        image_shape=(height, width, channels),
        convolutions=tuple(
            Convolution(kernel, np.asarray(params[f"conv_{i}_bias"]), stride)
            for i, (kernel, (_, _, stride)) in enumerate(
                zip(kernels, CNNS[cnn].convolutions, strict=True)
            )
        ),
        dense=_layer(params["dense"]),
    )


def as_jax(checkpoint: Checkpoint, env: JetBotEnv | AdaptedEnv) -> Callable[..., Outputs]:
    """Return the policy as used in training and evaluation, the reference for every export.

    Args:
      checkpoint: The checkpoint of the policy.
      env: The environment that the policy was trained in.

    Returns:
      A pure function of batches of the inputs, in their order, in full float32 on every device.
    """
    networks = checkpoint.networks
    if checkpoint.config.task.sees:
        # The convolutions of a training on GPUs compute in bfloat16.
        ppo = checkpoint.config.ppo
        network = ppo.network.model_copy(update={"cnn_dtype": "float32"})
        size = env.observation_size
        networks = make_networks(ppo.model_copy(update={"network": network}), size, env.action_size)
    policy = make_policy(networks, checkpoint.params)

    def act(*inputs: Array) -> Outputs:
        obs: PyTree = inputs[0]
        if checkpoint.config.task.sees:
            obs = dict(zip(_PARTS.values(), inputs, strict=False))
        with jax.default_matmul_precision("highest"):
            action = jnp.clip(policy(obs), -1.0, 1.0)
        if isinstance(env, AdaptedEnv):
            return (action,)
        return action, jax.vmap(env.wheel_targets)(action)

    return act


def record(checkpoint: Checkpoint, env: JetBotEnv, count: int | None = None) -> Recording:
    """Drive to the report's fixed goals, one after the other, and record the observations.

    The drive runs in C MuJoCo, which needs no compilation and simulates the same robot.

    Args:
      checkpoint: The checkpoint of the policy.
      env: The environment that the policy was trained in.
      count: Number of observations; None: `RECORDED`, or `RECORDED_IMAGES`.

    Returns:
      The recording, the same for the same checkpoint on the same machine.
    """
    if count is None:
        count = RECORDED_IMAGES if checkpoint.config.task.sees else RECORDED
    robot = envs.MujocoJetBot(checkpoint.config, type(env.task))
    act = jax.jit(as_jax(checkpoint, env))
    keys = iter(np.asarray(report_keys(count)))
    seen: list[dict[str, np.ndarray]] = []
    with stage("observations of a drive", count) as advance:
        while len(seen) < count:
            before = len(seen)
            obs, _ = robot.reset(next(keys))
            for _ in range(min(checkpoint.config.task.episode_length, count - before)):
                seen.append(_inputs(obs))
                (action,), _ = jax.device_get(act(*(x[None] for x in seen[-1].values())))
                step = robot.step(action)
                obs = step.obs
                if step.terminated or not step.finite:
                    break
            advance(len(seen) - before)
    inputs = {name: np.stack([one[name] for one in seen]) for name in seen[0]}
    action, wheel_speeds = jax.device_get(act(*inputs.values()))
    return Recording(inputs, action, wheel_speeds)


def record_environment(checkpoint: Checkpoint, setup: Setup, count: int = RECORDED) -> Recording:
    """Run a policy in an environment of one's own, and record the observations.

    Args:
      checkpoint: The checkpoint of the policy.
      setup: Its environment and networks.
      count: Number of observations, of which those without a clear choice are left out.

    Returns:
      The recording, the same for the same checkpoint on the same machine.
    """
    batch, act = setup.training_env, as_jax(checkpoint, setup.env)

    @jax.jit
    def run(keys: Array) -> Array:
        def step(state: PyTree, _: None) -> tuple[PyTree, Array]:
            return batch.step(state, jnp.asarray(act(state.obs)[0])), state.obs

        steps = -(-count // _RECORDED_AT_ONCE)
        return jax.lax.scan(step, batch.reset(keys), length=steps)[1]

    with stage(f"{count:,} observations of the environment"):
        found = np.asarray(run(report_keys(_RECORDED_AT_ONCE)))
    obs = found.reshape(-1, found.shape[-1])[:count]
    if portable_policy(checkpoint, setup.env).is_choice:
        obs = obs[_clear_choices(checkpoint, obs)]
    (action,) = jax.device_get(jax.jit(act)(obs))
    return Recording({"obs": obs}, action, None)


def _clear_choices(checkpoint: Checkpoint, obs: Float[np.ndarray, "n obs"]) -> np.ndarray:
    """Return for which observations the choice of a policy does not depend on round-off."""
    params = checkpoint.params
    outputs = checkpoint.networks.policy_network.apply(params.normalizer, params.policy, obs)
    second, first = np.sort(np.asarray(outputs), axis=-1)[:, -2:].T
    return first - second > _CLEAR_CHOICE


def _inputs(obs: Observation) -> dict[str, np.ndarray]:
    """Return an observation of the environment as inputs of an exported policy."""
    if not isinstance(obs, dict):
        return {"obs": obs}
    return {name: obs[key] for name, key in _PARTS.items() if key in obs}


def difference(recording: Recording, outputs: Outputs, controller: AnyController | None) -> float:
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
    units = [1.0, controller.fastest] if controller else [1.0]
    for wanted, unit, found in zip(recording.outputs, units, outputs, strict=True):
        values = np.asarray(found)
        if values.shape != wanted.shape or not np.all(np.isfinite(values)):
            return float("inf")
        worst = max(worst, float(np.abs(values - wanted).max()) / unit)
    return worst
