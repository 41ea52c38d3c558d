"""Robots that differ from their preset: friction, mass, motors, wheels, delay and lag.

A `Variation` is data, not structure: one compiled program serves every value, traced or not,
and `jax.vmap` gives each robot its own. Most of it enters physics through the model. Delay and
lag stand between command and motor; what they remember travels with the episode, in `info`.
"""

from typing import NamedTuple

import jax.numpy as jnp
import mujoco
import numpy as np
import scipy.linalg
from brax.envs import Wrapper
from jax.typing import ArrayLike
from jaxtyping import Array, Float, UInt32

from jetbot_mjx import mjx
from jetbot_mjx.env import JetBotEnv
from jetbot_mjx.state import State

MAX_ACTION_DELAY = 9
"""Longest `action_delay` [control steps]: 150 ms at the default `ctrl_dt`."""

_CHASSIS = "jetbot"
_BODIES = (_CHASSIS, "left_wheel", "right_wheel")
_SIDES = ("left", "right")


class Variation(NamedTuple):
    """How one robot differs from its preset. `Variation()` does not differ at all."""

    friction: Float[ArrayLike, ""] = 1.0
    """Factor on the Coulomb coefficient of wheel on floor."""
    mass: Float[ArrayLike, ""] = 1.0
    """Factor on mass and inertia of the chassis; the wheels keep theirs."""
    motor_gain: Float[ArrayLike, ""] = 1.0
    """Factor on the wheel speeds that the motors make of a command, and on their limit."""
    wheel_radius_mismatch: Float[ArrayLike, ""] = 0.0
    """(left - right) / mean radius. Entered as wheel speeds, which is the same as long as the
    wheels roll; it stands for motors of unequal speed as well."""
    action_delay: Float[ArrayLike, ""] = 0.0
    """From command to motor [control steps], rounded, 0 to `MAX_ACTION_DELAY`; until the first
    command arrives the motors hold the robot still."""
    motor_lag: Float[ArrayLike, ""] = 0.0
    """Time constant of a first-order lag [s], ahead of the motors' own run-up."""


class Motors(NamedTuple):
    """What stands between command and motor remembers. Wheel speeds (left, right) [rad/s]."""

    commands: Float[Array, "delay 2"]
    """The last commands, the newest first."""
    targets: Float[Array, "2"]
    """What the motors were asked for in the last step."""


def motors_at_rest() -> Motors:
    """Motors that no command has reached yet."""
    return Motors(jnp.zeros((MAX_ACTION_DELAY, 2)), jnp.zeros(2))


def drive_motors(
    motors: Motors, command: Float[Array, "2"], variation: Variation, ctrl_dt: float
) -> Motors:
    """Passes one command through delay and lag.

        u = command of `action_delay` steps ago        d = exp(-ctrl_dt / motor_lag)
        target' = d target + (1 - d) u

    Args:
      motors: before.
      command: wheel speeds (left, right) [rad/s], within the motors' limits.
      variation: its `action_delay` and `motor_lag`.
      ctrl_dt: duration of one control step [s].

    Returns:
      The motors after it; their `targets` are what they aim at during this step.
    """
    commands = jnp.concatenate([command[None], motors.commands])
    delayed = commands[jnp.round(variation.action_delay).astype(jnp.int32)]
    # Without a lag exp(-∞) is exactly zero, and the command passes bit for bit.
    decay = jnp.exp(-ctrl_dt / jnp.asarray(variation.motor_lag))
    return Motors(commands[:-1], decay * motors.targets + (1.0 - decay) * delayed)


def vary_model(model: mjx.Model, mj_model: mujoco.MjModel, variation: Variation) -> mjx.Model:
    """The physics model of a varied robot, as MuJoCo would compile it.

    Args:
      model: the preset's.
      mj_model: the same robot for C, with or without what only shows.
      variation: its friction, mass, motor gain and mismatch of the wheels.

    Returns:
      A model of the same structure. The constants that MuJoCo derives from the masses when it
      compiles, and its contacts read, follow exactly; those that no part of this robot reads
      stay as they were.
    """
    wheels = np.zeros(mj_model.npair, bool)
    wheels[[mj_model.pair(f"{side}_wheel").id for side in _SIDES]] = True
    chassis = np.arange(model.nbody) == mj_model.body(_CHASSIS).id
    mass = jnp.where(chassis, variation.mass, 1.0)
    half = 0.5 * jnp.asarray(variation.wheel_radius_mismatch)
    gain = jnp.ones(mj_model.nu)
    for side, mismatch in zip(_SIDES, (half, -half), strict=True):
        factor = variation.motor_gain * (1.0 + mismatch)
        gain = gain.at[mj_model.actuator(side).id].set(factor)
    # Tangential only: torsion and rolling take no part in a contact of three dimensions.
    friction = jnp.where(wheels[:, None] & (np.arange(5) < 2), variation.friction, 1.0)
    return model.replace(
        pair_friction=model.pair_friction * friction,
        body_mass=model.body_mass * mass,
        body_inertia=model.body_inertia * mass[:, None],
        body_invweight0=model.body_invweight0 + _invweight_change(model, mj_model, variation.mass),
        # Torque = gain (ctrl - wheel speed): with more gain on `ctrl` alone a motor aims
        # higher, its limit included.
        actuator_gainprm=model.actuator_gainprm * gain[:, None],
    )


def _invweight_change(
    model: mjx.Model, mj_model: mujoco.MjModel, mass: Float[ArrayLike, ""]
) -> Float[Array, "bodies 2"]:
    """How `body_invweight0`, the softness of contacts, follows the chassis's mass.

    MuJoCo takes it from the diagonal of J M⁻¹ Jᵀ in the initial pose, averaged over the three
    translations and the three rotations of each body. The inertia is M + (f - 1) C, with C the
    chassis's share of it. In modes V with VᵀMV = 1 and VᵀCV = diag(λ) its inverse is
    V diag(1 / (1 + (f - 1) λ)) Vᵀ, at every f.
    """
    data = mujoco.MjData(mj_model)
    mujoco.mj_forward(mj_model, data)
    inertia = np.zeros((mj_model.nv, mj_model.nv))
    mujoco.mj_fullM(mj_model, data, inertia)
    jacobians = {name: np.zeros((6, mj_model.nv)) for name in _BODIES}
    for name, jacobian in jacobians.items():
        body = mj_model.body(name).id
        mujoco.mj_jacBodyCom(mj_model, data, jacobian[:3], jacobian[3:], body)
    chassis = mj_model.body(_CHASSIS).id
    axes = data.ximat[chassis].reshape(3, 3)
    own_inertia = np.zeros((6, 6))
    own_inertia[:3, :3] = mj_model.body_mass[chassis] * np.eye(3)
    own_inertia[3:, 3:] = axes @ np.diag(mj_model.body_inertia[chassis]) @ axes.T
    share = jacobians[_CHASSIS].T @ own_inertia @ jacobians[_CHASSIS]
    rates, modes = scipy.linalg.eigh(share, inertia)
    weights = np.zeros((model.nbody, 2, mj_model.nv))
    for name, jacobian in jacobians.items():
        squares = np.square(jacobian @ modes).reshape(2, 3, -1)
        weights[mj_model.body(name).id] = squares.mean(axis=1)
    # As a difference, so that the preset's mass leaves every bit as it was.
    change = 1.0 / (1.0 + (jnp.asarray(mass) - 1.0) * rates) - 1.0
    return (weights * change).sum(axis=-1)


class VariedEnv(Wrapper):
    """An environment whose robot differs from its preset.

    One robot, like the environment itself; the variation may be traced. `info["motors"]` holds
    the commands on their way. For single episodes, such as those of `rollout`:
    `NewEpisodeWrapper` would let commands of one episode arrive in the next.
    """

    env: JetBotEnv

    def __init__(self, env: JetBotEnv, variation: Variation) -> None:
        """Wraps one environment.

        Args:
          env: unbatched, with its preset's model.
          variation: how its robot differs.
        """
        super().__init__(env.with_model(vary_model(env.mjx_model, env.mj_model, variation)))
        self.variation = variation

    def reset(self, rng: UInt32[Array, "2"]) -> State:
        """Begins an episode with no command on its way."""
        state = self.env.reset(rng)
        return state.replace(info={**state.info, "motors": motors_at_rest()})

    def step(self, state: State, action: Float[Array, "2"]) -> State:
        """Gives a command, and drives by those that have arrived."""
        command = self.env.wheel_targets(action)
        limit = self.env.robot.max_wheel_speed
        if limit is not None:
            # Ahead of the lag: an electronic limit, towards which the motors then run up.
            command = jnp.clip(command, -limit, limit)
        motors = drive_motors(state.info["motors"], command, self.variation, self.env.dt)
        state = state.replace(info={**state.info, "motors": motors})
        return self.env.step_towards(state, action, motors.targets)
