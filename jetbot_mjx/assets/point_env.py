"""Push a point to a goal: an environment of your own to start from, in plain JAX.

    jetbot-mjx check-env point_env.yaml
    jetbot-mjx train point_env.yaml

Both methods see one instance and are pure: no batch axis, no `if` on an array, nothing kept in
`self`. All that an episode has to remember is in the state.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, UInt32

from jetbot_mjx import State


class PointEnv:
    """A point of 1 kg on a plane, with a goal up to 1 m away."""

    action_size = 2
    dt = 0.05  # [s] duration of a step

    def __init__(self, force: float = 4.0, radius: float = 0.1) -> None:
        """Set what `environment_options` may change.

        Args:
          force: force of an action of 1 [N].
          radius: distance from the goal that is a success [m].
        """
        self.force, self.radius = force, radius

    def reset(self, rng: UInt32[Array, "2"]) -> State:
        """Begin an episode at rest, with a goal that is drawn from the key."""
        goal = jax.random.uniform(rng, (2,), minval=-1.0)
        zero = jnp.zeros(())
        return self.state(jnp.zeros(2), jnp.zeros(2), goal, zero)

    def step(self, state: State, action: Float[Array, "2"]) -> State:
        """Push the point by an action in [-1, 1] for one step, with some friction."""
        before = state.pipeline_state
        velocity = 0.95 * before["velocity"] + self.dt * self.force * action
        position = before["position"] + self.dt * velocity
        nearer = distance(before["position"], before["goal"]) - distance(position, before["goal"])
        return self.state(position, velocity, before["goal"], nearer)

    def state(self, position: Array, velocity: Array, goal: Array, reward: Array) -> State:
        """Return a state; the reward is the way that the point came nearer [m]."""
        physics = {"position": position, "velocity": velocity, "goal": goal}
        reached = jnp.float32(distance(position, goal) < self.radius)
        # The metric "success" makes a success rate of the evaluations.
        metrics = {"success": reached, "speed": jnp.linalg.norm(velocity)}
        obs = jnp.concatenate([goal - position, velocity])
        return State(physics, obs, reward, reached, metrics)


def distance(position: Float[Array, "2"], goal: Float[Array, "2"]) -> Float[Array, ""]:
    """Return the distance of two places [m]."""
    return jnp.linalg.norm(goal - position)
