"""Call environments of Brax, MuJoCo Playground and Gymnax, and one's own, in one way.

Two interfaces are known. Brax's is also Playground's and that of `docs/own-environment.md`:
`reset(rng)` and `step(state, action)` return a state with `obs`, `reward`, `done`, `metrics` and
`info`. Gymnax's has parameters, a random key in every step, and spaces. Both are called for one
instance.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree, UInt32

from jetbot_mjx.errors import InvalidError, shown

SUCCESS = "success"
"""Name of the metric that is 1 in a step that solves the task."""

_PRIVILEGED = "privileged_"
"""Begin of the names of Playground's observations that only a simulator can know."""


class Outcome(NamedTuple):
    """An `Outcome` holds what an environment returns, from `reset` and `step` alike."""

    kept: PyTree
    """Whatever the next step may need."""
    obs: Float[Array, " obs"]
    reward: Float[Array, ""]
    done: Float[Array, ""]
    """1 where the step ended the episode."""
    terminated: Float[Array, ""]
    """1 where it did so in success or failure, and not by a time limit."""
    metrics: Mapping[str, Float[Array, ""]]


class Foreign(NamedTuple):
    """A `Foreign` is an environment as two functions of one instance."""

    reset: Callable[[UInt32[Array, "2"]], Outcome]
    step: Callable[[PyTree, Float[Array, " action"]], Outcome]
    """From what was kept, and an action in [-1, 1], or the numbers of which the largest chooses."""
    action_size: int
    is_discrete: bool
    """Whether an action is the choice of one of `action_size`."""
    parts: Mapping[str, int]
    """Sizes of the parts of an observation by name, in their order, once `reset` was traced."""


def as_foreign(source: Any) -> Foreign:
    """Return an environment as functions.

    Args:
      source: an object with Brax's or Gymnax's methods, or what `gymnax.make` returns.

    Raises:
      InvalidError: it has neither.
    """
    # `gymnax.make` returns an environment and its parameters.
    env: Any = source[0] if isinstance(source, tuple) else source
    params = source[1] if isinstance(source, tuple) else None
    if callable(getattr(env, "step_env", None)) and callable(getattr(env, "reset_env", None)):
        return _gymnax(env, env.default_params if params is None else params)
    modules = {one.__module__.partition(".")[0] for one in type(env).__mro__}
    if modules & {"gymnasium", "gym"}:
        raise InvalidError(
            f"{type(env).__name__} is Gymnasium's and runs in Python: write reset and step in JAX,"
            " as the page on own environments says"
        )
    lacks = [name for name in ("reset", "step") if not callable(getattr(source, name, None))]
    if lacks:
        raise InvalidError(
            f"{type(source).__name__} is no environment: it lacks {' and '.join(lacks)}"
        )
    return _brax(source)


def _brax(env: Any) -> Foreign:
    parts: dict[str, int] = {}

    def outcome(state: Any) -> Outcome:
        if state is None or type(state) in (tuple, list):
            what = "nothing" if state is None else f"a {type(state).__name__}"
            raise InvalidError(f"it returns {what}: return a state with obs, reward and done")
        lacks = [x for x in ("obs", "reward", "done") if not hasattr(state, x)]
        if lacks:
            raise InvalidError(f"its state lacks {', '.join(lacks)}")
        info = getattr(state, "info", None) or {}
        metrics = dict(getattr(state, "metrics", None) or {})
        if SUCCESS in info:
            metrics[SUCCESS] = info[SUCCESS]
        done = _scalar("done", state.done)
        # Brax's wrappers, and some environments, tell which ends are those of a time limit.
        terminated = done
        if "terminated" in info:
            terminated = _scalar('info["terminated"]', info["terminated"])
        elif "truncation" in info:
            terminated = done * (1.0 - _scalar('info["truncation"]', info["truncation"]))
        return Outcome(
            state,
            _vector(state.obs, parts),
            _scalar("reward", state.reward),
            jnp.maximum(done, terminated),
            terminated,
            {str(name): _scalar(f"metrics[{name!r}]", x) for name, x in metrics.items()},
        )

    size = getattr(env, "action_size", None)
    if size is None and (model := getattr(env, "mj_model", None)) is not None:
        size = model.nu
    if not isinstance(size, int | np.integer) or size < 1:
        raise InvalidError(f"action_size = {size!r} is wrong: it should be a whole number above 0")
    return Foreign(
        lambda rng: outcome(env.reset(rng)),
        lambda state, action: outcome(env.step(state, action)),
        int(size),
        is_discrete=bool(getattr(env, "discrete_actions", False)),
        parts=parts,
    )


def _gymnax(env: Any, params: Any) -> Foreign:
    parts: dict[str, int] = {}
    # Gymnax counts the time limit among the ends; the trainer has its own, which it tells apart.
    if hasattr(params, "max_steps_in_episode"):
        params = params.replace(max_steps_in_episode=np.iinfo(np.int32).max)
    space = env.action_space(params)
    is_discrete = hasattr(space, "n")

    def outcome(key: Array, state: Any, obs: Any, reward: Any, done: Any) -> Outcome:
        done = _scalar("done", done)
        return Outcome((key, state), _vector(obs, parts), _scalar("reward", reward), done, done, {})

    def reset(rng: Array) -> Outcome:
        key, own_key = jax.random.split(rng)
        obs, state = env.reset_env(own_key, params)
        return outcome(key, state, obs, 0.0, 0.0)

    def step(kept: PyTree, action: Array) -> Outcome:
        (key, state), given = kept, jnp.argmax(action)
        key, own_key = jax.random.split(key)
        if not is_discrete:
            low, high = jnp.asarray(space.low), jnp.asarray(space.high)
            given = (low + 0.5 * (action + 1.0) * (high - low)).reshape(space.shape)
        obs, state, reward, done, _ = env.step_env(own_key, state, given, params)
        return outcome(key, state, obs, reward, done)

    size = space.n if is_discrete else int(np.prod(space.shape))
    return Foreign(reset, step, int(size), is_discrete, parts)


def _vector(obs: PyTree, sizes: dict[str, int]) -> Float[Array, " obs"]:
    """Return an observation as one vector; the parts of a dictionary are joined in their order.

    Args:
      obs: the observation.
      sizes: receives the size of each part by its name.

    Raises:
      InvalidError: a part is no vector.
    """
    if isinstance(obs, Mapping):
        # What a robot cannot know is for a critic that sees more, which this PPO does not have.
        obs = {name: x for name, x in obs.items() if not str(name).startswith(_PRIVILEGED)}
    parts = {}
    for path, x in jax.tree_util.tree_leaves_with_path(obs):
        if jnp.ndim(x) > 1:
            name = f"observation{jax.tree_util.keystr(path)}"
            raise InvalidError(
                f"{name} has the shape {list(jnp.shape(x))}: it should be a vector, such as"
                " x.ravel()"
            )
        name = jax.tree_util.keystr(path, simple=True, separator=".") or "observation"
        parts[name] = jnp.atleast_1d(jnp.asarray(x, jnp.float32))
    sizes.update({name: x.size for name, x in parts.items() if x.size})
    if not sizes:
        raise InvalidError("observation is empty: it should be a vector")
    return jnp.concatenate([*parts.values()])


def _scalar(name: str, x: Any) -> Float[Array, ""]:
    """Return a number as float32.

    Raises:
      InvalidError: it has axes, or is no number.
    """
    if x is None or isinstance(x, str):
        raise InvalidError(f"{name} = {shown(x)} is wrong: it should be one number")
    if jnp.shape(x) != ():
        raise InvalidError(
            f"{name} has the shape {list(jnp.shape(x))}: it should be one number, of one instance"
        )
    return jnp.asarray(x, jnp.float32)
