"""Define the sections `ppo` and `ppo.network`: hyperparameters and networks."""

import math
from typing import Literal, Self

from pydantic import model_validator

from jetbot_mjx.config.section import Section
from jetbot_mjx.config.value_types import (
    Count,
    Fraction,
    InnerAction,
    Layers,
    NonNegative,
    Positive,
    Steps,
)

_MOST_COUNTED = 2**31 - 1
"""Minibatches that a schedule of optax can count."""


class NetworkConfig(Section):
    """Policy and value networks, in the names of `brax.training.agents.ppo.networks`."""

    policy_hidden_layer_sizes: Layers = (128, 128, 128)
    """Units of the policy's hidden layers."""
    value_hidden_layer_sizes: Layers = (128, 128, 128)
    """Units of the value function's hidden layers."""
    activation: Literal["tanh", "relu", "elu", "swish"] = "tanh"
    """Activation between the layers."""
    distribution_type: Literal["normal", "tanh_normal", "categorical"] = "tanh_normal"
    """Action distribution; `normal` leaves clipping to the environment, as SB3 does; `categorical`
    is for an `environment` whose actions are choices."""
    initial_action: InnerAction | None = None
    """Action around which an untrained policy acts, within (-1, 1); null: the zero action. Where
    left and right are as good as each other, as for a camera that sees no cube, a policy that
    begins between the two may stay there."""
    cnn: Literal["nature", "small", "tiny"] = "small"
    """Convolutions in front of the hidden layers, for `task.observation: camera`. `nature`: those
    of SB3's `CnnPolicy`, 603 k parameters at 64×64; `small` and `tiny`: for 32×32."""
    shared_cnn: bool = True
    """Whether policy and value function share the convolutions; Brax's networks do not."""
    cnn_dtype: Literal["auto", "float32", "bfloat16"] = "auto"
    """Numbers that the convolutions compute with; parameters and sums are float32. `auto`:
    bfloat16 on GPUs, float32 on CPUs."""

    @model_validator(mode="after")
    def _choice_has_no_mean(self) -> Self:
        if self.initial_action is not None and self.distribution_type == "categorical":
            raise ValueError(
                f"initial_action = {list(self.initial_action)} is the mean of numbers, and with"
                " distribution_type = 'categorical' actions are choices: leave it out"
            )
        return self


class PPOConfig(Section):
    """Hyperparameters under the names of `brax.training.agents.ppo.train.train`."""

    num_timesteps: Steps = 1_000_000
    """Environment steps to train for. They and each checkpoint interval are rounded up to whole
    training steps of `batch_size * num_minibatches * unroll_length`."""
    num_envs: Count = 512
    """Parallel environments, over all devices."""
    unroll_length: Count = 16
    """Environment steps per environment and unroll."""
    batch_size: Count = 128
    """Unrolls per minibatch."""
    num_minibatches: Count = 4
    """Minibatches per pass over the collected data."""
    num_updates_per_batch: Count = 4
    """Passes over the collected data before new data is collected."""
    learning_rate: Positive = 1e-3
    """Adam's step size at the start of the schedule."""
    learning_rate_schedule: Literal["NONE", "LINEAR", "ADAPTIVE_KL"] = "LINEAR"
    """`LINEAR` decreases to zero at `num_timesteps`; `ADAPTIVE_KL` adapts the step size so that an
    update changes the policy by `desired_kl`."""
    desired_kl: Positive = 0.01
    """Target of `ADAPTIVE_KL`."""
    learning_rate_schedule_min_lr: Positive = 1e-5
    """Lower end of `ADAPTIVE_KL`."""
    learning_rate_schedule_max_lr: Positive = 1e-2
    """Upper end of `ADAPTIVE_KL`."""
    discounting: Fraction = 0.95
    """γ, per environment step."""
    gae_lambda: Fraction = 0.95
    """λ of generalised advantage estimation."""
    entropy_cost: NonNegative = 1e-3
    """Weight of the entropy bonus."""
    clipping_epsilon: Positive = 0.2
    """PPO's clip range of the probability ratio."""
    vf_loss_coefficient: Positive = 1.0
    """Weight of the value loss, in addition to Brax's factor of one half."""
    max_grad_norm: Positive | None = 1.0
    """Global norm that gradients are clipped to; null: no clipping."""
    reward_scaling: Positive = 10.0
    """Factor on the reward inside the loss."""
    normalize_observations: bool = True
    """Normalise observations by running mean and deviation."""
    normalizer: Literal["physical", "brax"] = "physical"
    """Smallest standard deviation to normalise by. `physical`: by the unit of the observation,
    1 cm, 0.05 m/s, 0.05 rad, 0.1 rad/s, 0.05 without a unit, or a field's own `min_std`; `brax`:
    1e-6 for all, with which a policy overfits to the contact of its training simulator."""
    normalize_advantage: bool = True
    """Normalise advantages within a minibatch."""
    update: Literal["auto", "fused", "xla"] = "auto"
    """How the actions of a collection and the gradient of a minibatch are computed. `fused`: by
    kernels of this package, in float32 on CPUs and with products of float16 on NVIDIA GPUs; `xla`:
    by XLA; `auto`: by the kernels where the device and the networks allow it."""
    network: NetworkConfig = NetworkConfig()
    """Network sizes."""

    @property
    def steps_per_training_step(self) -> int:
        """Return the number of environment steps that one training step collects."""
        return self.batch_size * self.num_minibatches * self.unroll_length

    @property
    def training_steps(self) -> int:
        """Return the number of training steps that reach `num_timesteps`."""
        return -(-self.num_timesteps // self.steps_per_training_step)

    @property
    def all_steps(self) -> int:
        """Return `num_timesteps` rounded up to whole training steps."""
        return self.training_steps * self.steps_per_training_step

    @property
    def updates_per_training_step(self) -> int:
        """Return the number of minibatches of one training step."""
        return self.num_updates_per_batch * self.num_minibatches

    @property
    def gradient_steps(self) -> int:
        """Return the number of minibatches of all training steps."""
        return self.training_steps * self.updates_per_training_step

    @model_validator(mode="after")
    def _whole_batches(self) -> Self:
        unrolls = self.batch_size * self.num_minibatches
        if unrolls % self.num_envs:
            # The smallest minibatch size whose total the environments divide.
            step = self.num_envs // math.gcd(self.num_envs, self.num_minibatches)
            fit = step * max(1, round(self.batch_size / step))
            raise ValueError(
                f"batch_size * num_minibatches = {unrolls} is not a multiple of"
                f" num_envs = {self.num_envs}: for example batch_size = {fit}"
            )
        if self.learning_rate_schedule == "LINEAR" and self.gradient_steps > _MOST_COUNTED:
            most = _MOST_COUNTED // self.updates_per_training_step * self.steps_per_training_step
            raise ValueError(
                f"num_timesteps = {self.num_timesteps} has {self.gradient_steps:.1e} minibatches,"
                f" and learning_rate_schedule = 'LINEAR' counts {_MOST_COUNTED:,}: train for at"
                f" most {most} steps, or choose another schedule"
            )
        low, high = self.learning_rate_schedule_min_lr, self.learning_rate_schedule_max_lr
        if self.learning_rate_schedule == "ADAPTIVE_KL" and not low <= self.learning_rate <= high:
            raise ValueError(
                f"learning_rate = {self.learning_rate:g} lies outside the schedule's"
                f" [{low:g}, {high:g}]: choose it inside, or widen the bounds"
            )
        return self
