"""Write the functions of an environment for web pages: its step, and what a page shows of it.

A robot's state is a row of 32-bit words. The functions, of all robots at once:

    reset     random keys -> states
    step      states, actions, knobs -> states, with new episodes where one ended
    move      states, goals -> states, whose episodes begin again with these goals
    poses     states -> positions and quaternions of the bodies
    goals     states -> positions of the goals
    script    states -> actions of the scripted driver
    frame     states -> what the pixels of the camera's image share, if there is a camera
    image     that and a table -> bytes
    draw      random keys -> a standard normal number, and the same between 0 and 1

Knobs are numbers that a visitor may change while the robots drive: the success radius [m], the
share of the largest speed, and a factor on the friction.
"""

import functools
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree, UInt32

from jetbot_mjx import envs
from jetbot_mjx.config import RandomizationConfig, RobotParams
from jetbot_mjx.deployment.web_scene import encoded
from jetbot_mjx.envs import Camera, JetBotEnv, State
from jetbot_mjx.evaluation import BASELINES
from jetbot_mjx.packed import pack
from jetbot_mjx.viewers import move_goal_error
from onekernel import Kernel, UnsupportedError, fuse
from onekernel.build import wasm

KNOBS = ("success_radius", "speed", "friction")
"""What a visitor may change, in the order of the step's argument."""


_KEY = jax.ShapeDtypeStruct((2,), np.uint32)


class WebEnv(NamedTuple):
    """A `WebEnv` holds the functions of an environment for a web page."""

    texts: Mapping[str, str]
    """Functions as LLVM modules for `wasm.link`, by name."""
    about: Mapping[str, Any]
    """What a script must know of them, as JSON values."""


def web_env(env: JetBotEnv, bodies: Sequence[int]) -> WebEnv:
    """Write the functions of an environment whose robots are shown, each as its preset is.

    Args:
      env: one environment, unwrapped.
      bodies: the bodies of its model whose poses are shown.

    Raises:
      UnsupportedError: a function cannot be one kernel.
    """
    robot = _Robot(env.blind(), RandomizationConfig())
    kernels = {
        "poses": _kernel(functools.partial(_poses, env, np.asarray(bodies), robot), robot.words),
        "goals": _kernel(lambda x: env.task.goal_position(robot.state(x).goal), robot.words),
        "script": _kernel(robot.scripted, robot.words),
        "draw": _kernel(_draw, _KEY),
    }
    if not move_goal_error(env, jax.eval_shape(env.reset, _KEY)):
        kernels["move"] = _kernel(robot.moved, robot.words, _floats(3))
    if env.camera is None:
        return _written("robot_", robot, kernels)
    # An image is a kernel with a table.
    image, kernels["frame"] = _image(env.camera, robot)
    shown = _written("robot_", robot, kernels)
    texts = {**shown.texts, "robot_image": wasm.map_text("robot_image", image)}
    return WebEnv(texts, {**shown.about, "image": _about_image(env.camera, image)})


def web_training_env(env: JetBotEnv) -> WebEnv:
    """Write the functions of an environment for a training, with robots that differ as it says.

    Args:
      env: one environment, unwrapped, which observes numbers.

    Raises:
      UnsupportedError: a function cannot be one kernel.
    """
    return _written("training_", _Robot(env, env.config.randomization), {})


def _written(prefix: str, robot: "_Robot", others: Mapping[str, Kernel]) -> WebEnv:
    """Write reset and step of a robot, and other functions of its state.

    Args:
      prefix: what the names of the functions begin with.
      robot: the robot.
      others: the kernels of the other functions, by name.
    """
    knobs = robot.knobs
    try:
        step = _kernel(robot.step, robot.words, robot.action, _floats(len(KNOBS)))
    except (UnsupportedError, jax.errors.JAXTypeError):
        # A task may use its settings as plain numbers of Python: then they stay as they are.
        knobs, step = [], _kernel(robot.plain_step, robot.words, robot.action)
    kernels = {"reset": _kernel(robot.reset, _KEY), "step": step, **others}
    texts = {prefix + name: wasm.step_text(prefix + name, one) for name, one in kernels.items()}
    task = robot.env.config.task
    about = {
        "prefix": prefix,
        "functions": list(kernels),
        "words": robot.words.shape[0],
        "places": robot.places(),
        "actions": robot.env.action_size,
        "knobs": knobs,
        "initial_knobs": [task.success_radius, 1.0, 1.0],
    }
    return WebEnv(texts, about)


class _Robot:
    """One robot in the wrappers of a training, as functions of the words of its state."""

    def __init__(self, env: JetBotEnv, ranges: RandomizationConfig) -> None:
        self.env, self._ranges = env, ranges
        self._wrapped = self._wrap(env)
        self._like = jax.eval_shape(lambda key: pack(self._wrapped.reset(key)), _KEY)
        # Words hold numbers of 32 bits; other arrays must be empty.
        if lost := [x.dtype for x in self._like.others if x.size]:
            raise UnsupportedError(f"a state with numbers of {lost[0]}: make them int32 or float32")
        self.words: jax.ShapeDtypeStruct = self._like.words
        self.action = _floats(env.action_size)
        # What is drawn is not changed, nor the actions of a drive that is a function of its own.
        changeable = {
            "success_radius": True,
            "speed": hasattr(env.drive, "max_speed"),
            "friction": "friction" not in ranges.drawn,
        }
        self.knobs = [name for name in KNOBS if changeable[name]]

    def _wrap(self, env: JetBotEnv, friction: Array | float = 1.0) -> envs.NewEpisodeWrapper:
        """Wrap an environment, whose friction is changed by a factor."""
        params = RobotParams(friction=friction)
        robot = envs.DomainRandomizationWrapper(env, params, self._ranges)
        length = env.config.task.episode_length
        return envs.NewEpisodeWrapper(envs.EpisodeWrapper(robot, length))

    def state(self, words: Float[Array, " words"]) -> State:
        """Return the state that some words hold; what is not among them is empty."""
        others = [jnp.zeros(x.shape, x.dtype) for x in self._like.others]
        return self._like.replace(words=words, others=others).unpack()

    def places(self) -> dict[str, Any]:
        """Return where the words have what a script reads and writes."""
        state = self._like.places()
        info, physics = state.info, state.pipeline_state
        single = {
            "reward": state.reward,
            "done": state.done,
            "success": state.metrics["success"],
            "truncation": info["truncation"],
            "steps": info["steps"],
        }
        several = {"obs": state.obs, "qpos": physics.qpos, "qvel": physics.qvel}
        found: dict[str, Any] = {name: int(place) for name, place in single.items()}
        # Those of an array are next to each other; there may be no numbers at all.
        for name, place in several.items():
            numbers = np.asarray(place if isinstance(place, np.ndarray) else [], int)
            found[name] = [int(numbers[0]) if numbers.size else 0, numbers.size]
        return found

    def reset(self, key: UInt32[Array, "2"]) -> Float[Array, " words"]:
        return pack(self._wrapped.reset(key)).words

    def plain_step(
        self, words: Float[Array, " words"], action: Float[Array, " action"]
    ) -> Float[Array, " words"]:
        return pack(self._wrapped.step(self.state(words), action)).words

    def step(
        self,
        words: Float[Array, " words"],
        action: Float[Array, " action"],
        knobs: Float[Array, " knobs"],
    ) -> Float[Array, " words"]:
        radius, speed, friction = knobs
        config = self.env.config.task.model_copy(update={"success_radius": radius})
        env = self.env.with_task(type(self.env.task)(config))
        wrapped = self._wrap(env, friction if "friction" in self.knobs else 1.0)
        # A share of the speed range is a part of the first action's range.
        slower = action
        if "speed" in self.knobs:
            slower = action.at[0].set((jnp.clip(action[0], -1.0, 1.0) + 1.0) * speed - 1.0)
        return pack(wrapped.step(self.state(words), slower)).words

    def moved(
        self, words: Float[Array, " words"], position_w: Float[Array, "3"]
    ) -> Float[Array, " words"]:
        state, task = self.state(words), self.env.task
        assert isinstance(task, envs.MovesGoal)
        goal = task.move_goal(state.goal, position_w)
        obs = self.env.observe(envs.robot_state(state.pipeline_state), goal)
        info = {**state.info, "steps": jnp.zeros(())}
        return pack(state.replace(goal=goal, obs=obs, info=info, done=jnp.zeros(()))).words

    def scripted(self, words: Float[Array, " words"]) -> Float[Array, " action"]:
        return BASELINES["scripted"](self.env)(None, self.state(words), jnp.zeros(2, np.uint32))


def _poses(
    env: JetBotEnv, bodies: np.ndarray, robot: _Robot, words: Float[Array, " words"]
) -> Float[Array, "bodies 7"]:
    """Return position and quaternion of some bodies of the model with visual elements."""
    state, model = robot.state(words), envs.put_model(env.mj_model)
    data = envs.make_data(env.mj_model).replace(qpos=state.pipeline_state.qpos)
    # The task places the mocap bodies.
    markers, positions = env.task.markers(state.goal), data.mocap_pos
    for name, index in envs.mocap_ids(env.mj_model).items():
        if name in markers:
            positions = positions.at[index].set(markers[name])
    data = envs.body_poses(model, data.replace(mocap_pos=positions))
    return jnp.concatenate([data.xpos, data.xquat], axis=1)[bodies]


def _image(camera: Camera, robot: _Robot) -> tuple[Kernel, Kernel]:
    """Return the kernel of an image, and that of what its pixels share."""
    structures: list[Hashable] = []

    def frame(words: Float[Array, " words"]) -> Float[Array, " shared"]:
        state = robot.state(words)
        body = envs.robot_state(state.pipeline_state)
        pose = camera.pose(body.position_w, body.quat)
        shared, structure = camera.shared(pose, dict(robot.env.task.markers(state.goal)))
        structures.append(structure)
        return shared

    kernel = _kernel(frame, robot.words)
    (size,) = kernel.results()[0].shape
    return camera.make_kernel(structures[0], size), kernel


def _about_image(camera: Camera, kernel: Kernel) -> dict[str, Any]:
    height, width, channels = camera.shape
    assert kernel.table is not None
    return {
        "height": height,
        "width": width,
        "channels": channels,
        "frames": camera.config.frames,
        "shared": sum(kernel.argument_shapes[0]),
        "table": encoded(kernel.table),
    }


def _draw(key: UInt32[Array, "2"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Return a standard normal number, and from the same bits one that is uniform in [0, 1)."""
    return jax.random.normal(key), jax.random.uniform(key)


def _floats(size: int) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct((size,), jnp.float32)


def _kernel(function: Callable[..., PyTree], *like: jax.ShapeDtypeStruct) -> Kernel:
    """Lower a function of one robot.

    Raises:
      UnsupportedError: it cannot be one kernel.
    """
    kernel = fuse(function, on_unsupported="raise").lowered(*like).one
    if isinstance(kernel, UnsupportedError):
        raise kernel
    return kernel
