"""Add what the robot's camera sees to the observation of an environment."""

from typing import Protocol, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt8, UInt32

from jetbot_mjx.envs.camera.looks import Appearance, add_noise
from jetbot_mjx.envs.camera.render import Camera
from jetbot_mjx.envs.camera.timing import SeenPose, noise_seed
from jetbot_mjx.envs.state import Obs, State, robot_state
from jetbot_mjx.envs.task import Task
from jetbot_mjx.mjx_import import Env, Wrapper
from jetbot_mjx.packed import Packed, pack

PIXELS = "pixels/front"
"""Key of the images in the observation; Brax's vision networks read every key that begins so."""

NUMBERS = "state"
"""Key of the task's numbers in the observation, if it has any."""


_Env = TypeVar("_Env", bound=Env)


def numbers_of(obs: Obs) -> Obs:
    """Return an observation without images: the vector of numbers, or an empty dictionary."""
    return obs.get(NUMBERS, {}) if isinstance(obs, dict) else obs


class _Seen(Protocol):
    """The interface that a `CameraWrapper` requires of the environment inside it."""

    task: Task
    observation_size: int
    observation_min_std: np.ndarray

    def reset(self, rng: UInt32[Array, "2"]) -> State: ...

    def step(self, state: State, action: Float[Array, " action"]) -> State: ...


def see(
    camera: Camera,
    task: Task,
    state: State,
    before: UInt8[Array, "h w c"] | None = None,
    begins: Bool[Array, ""] | bool = True,
) -> State:
    """Add the images to a state whose observation has the task's numbers only.

    Args:
      camera: the camera on the robot.
      task: the task, whose `markers` say where its bodies stand.
      state: a state of one robot.
      before: the images of the state before; None: there is none.
      begins: whether the state is the first of an episode, which stacks copies of its image.
    """
    image = _render(camera, task, state)
    if camera.config.frames > 1:
        first = jnp.tile(image, (1, 1, camera.config.frames))
        if before is None:
            image = first
        else:
            later = jnp.concatenate([before[..., camera.shape[2] :], image], axis=-1)
            image = jnp.where(begins, first, later)
    obs = {PIXELS: image}
    if not isinstance(state.obs, dict):
        obs[NUMBERS] = state.obs
    return state.replace(obs=obs)


def seen_pose(task: Task, state: State) -> SeenPose:
    """Return the pose that a camera without delay sees.

    Args:
      task: the task, whose `markers` say where its bodies stand.
      state: a state of one robot.
    """
    robot = robot_state(state.pipeline_state)
    markers = dict(task.markers(state.goal))
    return SeenPose(robot.position_w, robot.quat, markers, state.pipeline_state.time)


def _render(camera: Camera, task: Task, state: State) -> UInt8[Array, "h w c"]:
    """Return the image of a state, with the looks of its episode."""
    now = seen_pose(task, state)
    looks = state.episode_params.camera if state.episode_params is not None else None
    if looks is None:
        return camera.render(camera.pose(now.position_w, now.quat), now.markers)
    seen: SeenPose = now if looks.seen is None else looks.seen
    # Keep the stages apart: XLA would compute drawn numbers again wherever they are used.
    looks, seen = jax.lax.optimization_barrier((looks, seen))
    pose = jax.lax.optimization_barrier(camera.pose(seen.position_w, seen.quat, looks.params))
    image = camera.render(pose, seen.markers, Appearance(looks.params, looks.surroundings))
    if looks.params.differs("pixel_noise"):
        image = add_noise(image, looks.params.pixel_noise, noise_seed(looks.key, seen.time))
    return image


def observation_shapes(camera: Camera, numbers: int) -> dict[str, tuple[int, ...]]:
    """Return the shapes of the parts of an observation with images.

    Args:
      camera: the camera on the robot.
      numbers: the length of the task's vector of numbers; 0: there is none.
    """
    return {PIXELS: camera.obs_shape} | ({NUMBERS: (numbers,)} if numbers else {})


class CameraWrapper(Wrapper):
    """A wrapper that renders the observation; it sees one robot, without a batch axis.

    Protocol: the environment inside observes the numbers of the task's `layout`, or nothing, which
    is an empty dictionary. This wrapper makes a dictionary of it: `pixels/front`, uint8 of shape
    (height, width, channels), and `state` if there are numbers. It is the outermost wrapper of a
    single robot, so that a step renders one image, after `NewEpisodeWrapper` has chosen between the
    old episode and a new one. `info["final_obs"]` therefore holds numbers only.

    With `camera.frames` above 1, the images of the last steps are stacked along the channels, the
    newest last; an episode begins with copies of its first image.
    """

    env: _Seen

    def __init__(self, env: Env, camera: Camera) -> None:
        """Wrap one environment.

        Args:
          env: an environment that observes numbers only, in any wrappers of a single robot.
          camera: the camera on the robot.
        """
        super().__init__(env)
        self.camera = camera

    def reset(self, rng: UInt32[Array, "2"]) -> State:
        """Begin an episode and render its first image.

        Args:
          rng: a random key.
        """
        return see(self.camera, self.env.task, self.env.reset(rng))

    def step(self, state: State, action: Float[Array, " action"]) -> State:
        """Make one step and render the image after it.

        Args:
          state: a state of this environment.
          action: the action, in [-1, 1]².
        """
        nstate = self.env.step(state.replace(obs=numbers_of(state.obs)), action)
        return see(self.camera, self.env.task, nstate, state.obs[PIXELS], nstate.done > 0)

    def step_packed(self, packed: Packed, action: Float[Array, " action"]) -> Packed:
        """Make one step of a packed state.

        Args:
          packed: the state before the step.
          action: the action, in [-1, 1]².
        """
        return pack(self.step(packed.unpack(), action))

    @property
    def observation_size(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the parts of the observation."""
        return observation_shapes(self.camera, self.env.observation_size)

    @property
    def observation_min_std(self) -> dict[str, np.ndarray]:
        """Smallest standard deviations by which training normalises the numbers."""
        return {NUMBERS: self.env.observation_min_std} if self.env.observation_size else {}


def with_camera(env: _Env, camera: Camera | None) -> _Env | CameraWrapper:
    """Wrap the environment of one robot so that it sees, if it has a camera.

    Args:
      env: the environment, in all wrappers of a single robot, which observes numbers only.
      camera: the camera; None: the environment is returned as it is.
    """
    return env if camera is None else CameraWrapper(env, camera)
