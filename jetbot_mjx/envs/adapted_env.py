"""Adapt an environment of one's own to what trainer, evaluation and kernels expect.

Protocol:

1. `reset` and `step` are traced once, for one instance. The trace is the environment from then on:
   Python is not run again, so that what is trained cannot change meanwhile.
2. Of the state, only what a later step reads is kept: of MuJoCo's data that is a tenth. The rest
   would pass through memory in every step.
3. The state is Brax's, in the fields of `State`. `success`, if the environment has such a metric,
   counts once in an episode.
"""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from flax import struct
from jax.core import Tracer
from jax.extend.core import ClosedJaxpr, jaxpr_as_fun
from jax.interpreters import partial_eval
from jaxtyping import Array, Float, PyTree, UInt32

from jetbot_mjx.config import Config
from jetbot_mjx.devices import default_device_cpu
from jetbot_mjx.envs.checks.errors import describe_error
from jetbot_mjx.envs.checks.probe import changed_leaf
from jetbot_mjx.envs.foreign import SUCCESS, Foreign, Outcome, as_foreign
from jetbot_mjx.envs.kernel_impl import KernelImpl
from jetbot_mjx.envs.own_class import import_class
from jetbot_mjx.envs.state import State
from jetbot_mjx.envs.task import Field, Layout
from jetbot_mjx.errors import InvalidError, UserError, shown
from jetbot_mjx.mjx_import import Env


class EnvState(struct.PyTreeNode):
    """An `EnvState` holds what an environment of one's own needs of the past."""

    kept: dict[str, Array]
    """The leaves of its state that its step reads, by their path."""
    succeeded: Float[Array, ""]
    """1 after a success in this episode."""


class AdaptedEnv(Env):
    """An environment of one's own, of one instance: what `environment` names.

    Action: in [-1, 1]; where actions are discrete, one number for each choice, of which the largest
    is taken. Observation: a vector. State: `metrics` holds those of the environment; `info` holds
    `terminated`. `done` is also 1 where the environment itself cuts an episode off;
    `EpisodeWrapper` adds the time limit.
    """

    camera = None

    def __init__(self, config: Config, env_class: Callable[..., Any] | None = None) -> None:
        """Build the environment, and trace its reset and step.

        Args:
          config: the configuration; `environment` and its options are used.
          env_class: what `environment` names, if it was imported already.

        Raises:
          UserError: it cannot be imported, built or traced, or it breaks a rule of the interface.
        """
        self.config = config
        self.kernel_impl = KernelImpl("physics.impl", config.physics.impl)
        name = config.environment
        assert name is not None
        found = env_class or import_class("environment", name)
        if not callable(found):
            raise InvalidError(f"environment = {name!r} is no class and no function")
        options = config.environment_options
        self.source: Any = self._told(found.__name__, lambda: found(**options))
        """The environment itself."""
        if jax.config.values["jax_enable_x64"]:
            raise InvalidError(
                f"environment = {name!r} sets jax_enable_x64: leave it out, numbers are float32"
            )
        one = self._told("it", lambda: as_foreign(self.source))
        kind = config.ppo.network.distribution_type
        if one.is_discrete != (kind == "categorical"):
            raise InvalidError(
                f"ppo.network.distribution_type = {kind!r} does not fit environment = {name!r}: "
                + (
                    f"its actions are {one.action_size} choices: set categorical"
                    if one.is_discrete
                    else "its actions are numbers: set tanh_normal"
                )
            )
        self._trace(one)

    def __repr__(self) -> str:
        """Return the name and the sizes in one line."""
        return (
            f"{type(self).__name__}({self.config.environment!r},"
            f" observation_size={self.observation_size}, action_size={self.action_size})"
        )

    def _told(self, who: str, call: Callable[[], Any]) -> Any:
        """Call code of the user, and tell its exceptions in one line."""
        try:
            # Each operation outside of what is traced is a program of its own, which a GPU compiles
            # for longer.
            with default_device_cpu():
                return call()
        except UserError as error:
            raise InvalidError(f"environment = {self.config.environment!r}: {error}") from None
        except Exception as error:
            described = describe_error(error, who, ())
            raise InvalidError(f"environment = {self.config.environment!r}: {described}") from error

    def _trace(self, one: Foreign) -> None:
        """Trace reset and step, and find what of the state a step reads."""
        self._action_size, self.is_discrete = one.action_size, one.is_discrete
        key = jax.ShapeDtypeStruct((2,), jnp.uint32)
        action = jax.ShapeDtypeStruct((one.action_size,), jnp.float32)
        # Random keys are kept as their words, which are numbers like others.
        kinds: list[PyTree] = []

        def reset(rng: Array) -> Outcome:
            outcome = one.reset(rng)
            words = _with_words(outcome)
            kinds.append(jax.tree.map(_kind, outcome.kept))
            return words

        def step(words: PyTree, action: Array) -> Outcome:
            kept = jax.tree.map(_from_words, kinds[0], words)
            return _with_words(one.step(kept, action))

        reset_jaxpr, first = self._told("reset", lambda: _make_jaxpr(reset, key))
        step_jaxpr, following = self._told("step", lambda: _make_jaxpr(step, first.kept, action))
        if unlike := changed_leaf(first, following):
            raise InvalidError(
                f"environment = {self.config.environment!r}: a step changes the state's"
                f" {unlike.removeprefix('kept.')}: keep names, tree, shapes and dtypes as reset has"
                " them"
            )
        # Of what is kept, only some is read; of the rest of an outcome, all is.
        leaves = jax.tree_util.tree_leaves_with_path(first.kept)
        read = _read_leaves(step_jaxpr, len(leaves))
        paths = [path for (path, _), one in zip(leaves, read, strict=True) if one]
        self._names = [jax.tree_util.keystr(path).lstrip(".") for path in paths]
        # Where MuJoCo's generalised position is, in an attribute or in a dictionary.
        ends = [jax.tree_util.keystr(path[-1:], simple=True) for path in paths]
        self._qpos = self._names[ends.index("qpos")] if "qpos" in ends else None
        shown = first._replace(kept=None)
        self._shown = jax.tree.structure(shown)
        wanted = [*read, *[True] * self._shown.num_leaves]
        self._reset_traced = _Traced(reset_jaxpr, wanted)
        self._step_traced = _Traced(step_jaxpr, wanted)
        self.metrics = tuple(shown.metrics)
        """The names of the environment's metrics."""
        self.layout: Layout = tuple(Field(name, size, "", "") for name, size in one.parts.items())
        """The parts of the observation, whose units are not known."""

    def reset(self, rng: UInt32[Array, "2"]) -> State:
        """Begin an episode.

        Args:
          rng: a legacy random key of shape (2,), `jax.random.PRNGKey`, as Brax's wrappers need it.
        """
        key, own_key = jax.random.split(rng)
        kept, shown = self._divided(self._reset_traced(own_key))
        zero = jnp.zeros(())
        return State(
            pipeline_state=EnvState(kept, zero),
            obs=shown.obs,
            reward=zero,
            done=zero,
            metrics=dict.fromkeys(self.metrics, zero),
            info={"terminated": zero},
            key=key,
        )

    def step(self, state: State, action: Float[Array, " action"]) -> State:
        """Make one environment step.

        Args:
          state: a state of this environment.
          action: the action; it is clipped to [-1, 1] unless it is discrete.
        """
        return self.follow(state, *self.outcome(state, action))

    def outcome(
        self, state: State, action: Float[Array, " action"]
    ) -> tuple[dict[str, Array], Outcome]:
        """Return what the environment itself makes of a step: what is kept, by name, and the rest.

        Args:
          state: a state of this environment.
          action: as of `step`.
        """
        before: PyTree = state.pipeline_state
        given = action if self.is_discrete else jnp.clip(action, -1.0, 1.0)
        arguments = [before.kept[name] for name in self._names]
        return self._divided(self._step_traced(*arguments, given))

    def follow(self, state: State, kept: dict[str, Array], shown: Outcome) -> State:
        """Return the state after a step.

        Args:
          state: the state before it.
          kept: what is kept, of `outcome`.
          shown: the rest of it.
        """
        before: PyTree = state.pipeline_state
        metrics, succeeded = dict(shown.metrics), before.succeeded
        if self.has_success:
            # An environment may tell it in every step from then on.
            now = (metrics[SUCCESS] > 0).astype(jnp.float32)
            metrics[SUCCESS] = now * (1.0 - succeeded)
            succeeded = jnp.maximum(now, succeeded)
        return state.replace(
            pipeline_state=EnvState(kept, succeeded),
            obs=shown.obs,
            reward=shown.reward,
            done=shown.done,
            metrics={**state.metrics, **metrics},
            info={**state.info, "terminated": shown.terminated},
        )

    @property
    def traced(self) -> tuple[ClosedJaxpr, ClosedJaxpr]:
        """Return reset and step as they were traced."""
        return self._reset_traced.jaxpr, self._step_traced.jaxpr

    def _divided(self, leaves: Sequence[Array]) -> tuple[dict[str, Array], Outcome]:
        """Return what is kept, by name, and the rest of an outcome."""
        count = len(self._names)
        kept = dict(zip(self._names, leaves[:count], strict=True))
        return kept, jax.tree.unflatten(self._shown, leaves[count:])

    # What trainer, evaluation and wrappers ask an environment for.

    @property
    def observation_size(self) -> int:
        """Length of the observation."""
        return sum(field.size for field in self.layout)

    @property
    def action_size(self) -> int:
        """Length of the action."""
        return self._action_size

    @property
    def observation_min_std(self) -> None:
        """None: without units, no smallest deviation is known."""
        return None

    @property
    def has_success(self) -> bool:
        """Return whether the environment tells in which step it is solved."""
        return SUCCESS in self.metrics

    @property
    def may_be_kernel(self) -> bool:
        """Return whether reset and step may be kernels on this machine."""
        if not self.kernel_impl.is_available:
            self.kernel_impl.report_obstacle()
        return self.kernel_impl.is_available

    @property
    def backend(self) -> str:
        """Name of the physics back end, for Brax."""
        return str(getattr(self.source, "backend", "none"))

    @property
    def dt(self) -> float | None:
        """Duration of one environment step [s]; None: the environment does not tell it."""
        dt = getattr(self.source, "dt", None)
        return None if dt is None else float(dt)

    @property
    def mj_model(self) -> mujoco.MjModel | None:
        """MuJoCo's model, for pictures; None: the environment has none, or keeps no `qpos`."""
        # Brax has it in its `sys`.
        owners: list[Any] = [self.source, getattr(self.source, "sys", None)]
        model = next((x.mj_model for x in owners if hasattr(x, "mj_model")), None)
        return model if isinstance(model, mujoco.MjModel) and self._qpos else None

    def qpos(self, state: State) -> Float[Array, " nq"]:
        """Return MuJoCo's generalised position in a state, of an environment with an `mj_model`."""
        assert self._qpos
        kept: PyTree = state.pipeline_state
        return kept.kept[self._qpos]


class _Traced:
    """A `_Traced` is a traced function of which some results are wanted."""

    def __init__(self, traced: ClosedJaxpr, wanted: Sequence[bool]) -> None:
        """Leave out what the wanted results do not need.

        Args:
          traced: the function.
          wanted: whether each of its results is wanted.
        """
        jaxpr, used = partial_eval.dce_jaxpr(traced.jaxpr, list(wanted))
        self.jaxpr = ClosedJaxpr(jaxpr, traced.consts)
        self._takes_last = used[-1]

    def __call__(self, *arguments: Array) -> list[Array]:
        """Compute the wanted results.

        Args:
          arguments: those that the results need, and the last one in any case: a random key that an
            environment does not draw from, or an action that it does not take.
        """
        given = arguments if self._takes_last else arguments[:-1]
        return jaxpr_as_fun(self.jaxpr)(*given)


def _make_jaxpr(function: Callable[..., Outcome], *like: PyTree) -> tuple[ClosedJaxpr, Outcome]:
    """Trace a function; return also what its results are like.

    Raises:
      InvalidError: it uses what an earlier call has left behind.
    """
    traced, results = jax.make_jaxpr(function, return_shape=True)(*like)
    if any(isinstance(x, Tracer) for x in traced.consts):
        raise InvalidError(
            f"{function.__name__} uses a value that an earlier call kept in self: keep what changes"
            " in the state"
        )
    return traced, results


def _read_leaves(step: ClosedJaxpr, count: int) -> list[bool]:
    """Return which leaves of the state a step reads, now or to compute what a later step reads.

    Args:
      step: a step, from the leaves of a state and an action to those of the next state, followed by
        results of which all are wanted.
      count: the number of leaves.
    """
    others = len(step.out_avals) - count
    read = [False] * count
    while True:
        _, used = partial_eval.dce_jaxpr(step.jaxpr, [*read, *[True] * others])
        if used[:count] == read:
            return read
        read = used[:count]


def _with_words(outcome: Outcome) -> Outcome:
    return outcome._replace(kept=jax.tree_util.tree_map_with_path(_as_words, outcome.kept))


def _as_words(path: jax.tree_util.KeyPath, x: Any) -> Array:
    """Return an array, or the words of random keys.

    Raises:
      InvalidError: it is neither.
    """
    try:
        array = jnp.asarray(x)
    except (TypeError, ValueError):
        name = jax.tree_util.keystr(path).lstrip(".")
        raise InvalidError(
            f"the state's {name} = {shown(x)} is wrong: it should be a number or an array"
        ) from None
    # Without a weak type, which a number of Python has at first, and no step's result.
    return jax.random.key_data(array) if _is_key(array.dtype) else array.astype(array.dtype)


def _kind(x: Any) -> Any:
    """Return the implementation of random keys, or "" for numbers."""
    return jax.random.key_impl(x) if _is_key(jnp.asarray(x).dtype) else ""


def _from_words(kind: Any, words: Array) -> Array:
    """Return an array of a kind; the inverse of `_as_words`."""
    return words if kind == "" else jax.random.wrap_key_data(words, impl=kind)


def _is_key(dtype: Any) -> bool:
    return jnp.issubdtype(dtype, jax.dtypes.prng_key)
