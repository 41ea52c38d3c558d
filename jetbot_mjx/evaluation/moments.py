"""Find out what a policy saw, and looked at, at three moments of some episodes of a report.

The episodes are run again from their keys, because a report records trajectories but no images.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PyTree, UInt8, UInt32
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jetbot_mjx.agents import Networks, PolicyParams, make_policy
from jetbot_mjx.envs import PIXELS, EpisodeWrapper, JetBotEnv, State, with_camera
from jetbot_mjx.evaluation.occlusion import occlusion_map, overlay_heat
from jetbot_mjx.evaluation.rollout import Episodes
from jetbot_mjx.runs import JsonObject
from jetbot_mjx.terminal import stage
from onekernel import ProgramCache

MOMENTS = ("start", "middle", "end")

MOST_FAILURES = 8
"""Largest number of failures that are shown; one success comes before them."""

_SIDE = 1.15  # [inch] side of an image in the figure
_LEAST_HEAT = 0.05  # change of the action below which no part of a map is bright


_Seen = tuple[UInt8[Array, "n moments h w c"], Float[Array, "n moments h w"]]
_Replay = Callable[[PolicyParams, UInt32[Array, "n 2"], Int[Array, "n moments"]], _Seen]
"""From parameters, reset keys and times of the moments to images and occlusion maps."""


class SeenEpisode(NamedTuple):
    """A `SeenEpisode` holds what a policy saw at each of `MOMENTS`, on the host."""

    goal: int
    """Index of the goal in the report's fixed goals."""
    success: bool
    seconds: tuple[float, ...]
    """Time since the start [s]."""
    images: UInt8[np.ndarray, "moments h w c"]
    """The newest image, without those that are stacked with it."""
    heat: Float[np.ndarray, "moments h w"]
    """Occlusion maps, as of `occlusion_map`."""


def shown_goals(episodes: Episodes, successes: int = 1, failures: int = MOST_FAILURES) -> list[int]:
    """Return the goals to show: the first successes, then the first failures.

    Args:
      episodes: the episodes of a report, on the host.
      successes: the largest number of successes.
      failures: the largest number of failures.
    """
    won = np.asarray(episodes.success) > 0
    first = np.flatnonzero(won)[:successes], np.flatnonzero(~won)[:failures]
    return np.concatenate(first).tolist()


class MomentFinder:
    """A `MomentFinder` shows what policies saw, with one compiled program."""

    def __init__(self, env: JetBotEnv, networks: Networks, programs: ProgramCache) -> None:
        """Prepare the program, which compiles at its first use.

        Args:
          env: one unwrapped environment with a camera.
          networks: the networks of the policies.
          programs: the cache of compiled programs for the environment's configuration.
        """
        assert env.camera is not None
        self._channels, self._dt = env.camera.shape[2], env.dt
        self._run = jax.jit(_replay_fn(env, networks))
        self._programs = programs

    def find(
        self, params: PolicyParams, keys: UInt32[Array, "n 2"], episodes: Episodes
    ) -> tuple[SeenEpisode, ...]:
        """Return what a policy saw in the episodes of `shown_goals`.

        Args:
          params: the parameters of the policy.
          keys: the reset keys of all episodes.
          episodes: the policy's episodes, on the host.
        """
        goals = shown_goals(episodes)
        # Fill up with the first goal, so that one program serves every report.
        rows = np.array([*goals, *goals[:1] * (1 + MOST_FAILURES - len(goals))])
        last = np.asarray(episodes.steps)[rows].astype(np.int32)
        times = np.stack([np.zeros_like(last), last // 2, last], axis=1)
        arguments = jax.device_get(params), np.asarray(keys)[rows], times
        with stage("what the policy saw"):
            run = self._programs.compile("what the policy saw", lambda: self._run.trace(*arguments))
            images, heat = jax.device_get(run(*arguments))
        return tuple(
            SeenEpisode(
                goal=goal,
                success=bool(episodes.success[goal] > 0),
                seconds=tuple((times[row] * self._dt).tolist()),
                images=images[row, ..., -self._channels :],
                heat=heat[row],
            )
            for row, goal in enumerate(goals)
        )


def _replay_fn(env: JetBotEnv, networks: Networks) -> _Replay:
    """Return the function that runs episodes again."""
    episode_env = with_camera(
        EpisodeWrapper(env.blind(), env.config.task.episode_length), env.camera
    )

    def run(
        params: PolicyParams, keys: UInt32[Array, "n 2"], times: Int[Array, "n moments"]
    ) -> _Seen:
        policy = make_policy(networks, params)

        def advance(carry: tuple[Array, State, PyTree]) -> tuple[Array, State, PyTree]:
            time, state, seen = carry
            # What an episode does after its end is not kept.
            state = jax.vmap(episode_env.step)(state, policy(state.obs))
            now = times == time + 1

            def keep(old: Array, obs: Array) -> Array:
                return jnp.where(now.reshape(*now.shape, *[1] * (obs.ndim - 1)), obs[:, None], old)

            return time + 1, state, jax.tree.map(keep, seen, state.obs)

        first = jax.vmap(episode_env.reset)(keys)
        seen = jax.tree.map(lambda x: jnp.repeat(x[:, None], times.shape[1], axis=1), first.obs)
        start = jnp.zeros((), jnp.int32), first, seen
        _, _, seen = jax.lax.while_loop(lambda carry: carry[0] < times.max(), advance, start)
        # One map after the other, since each takes hundreds of images.
        every = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), seen)
        heat = jax.lax.map(lambda obs: occlusion_map(policy, obs), every)
        return seen[PIXELS], heat.reshape(*times.shape, *heat.shape[1:])

    return run


def moments_as_json(episodes: Sequence[SeenEpisode]) -> JsonObject:
    """Return what a report says of the images as JSON values."""
    return {
        "goals": [one.goal for one in episodes],
        "successes": sum(one.success for one in episodes),
        "failures": sum(not one.success for one in episodes),
        "largest_change": largest_change(episodes),
    }


def largest_change(episodes: Sequence[SeenEpisode]) -> float:
    """Return the change of the action that is drawn brightest in all maps."""
    return max(_LEAST_HEAT, *(float(one.heat.max()) for one in episodes))


def plot_moments(episodes: Sequence[SeenEpisode]) -> Figure:
    """Plot what a policy saw, one row for each episode, each image beside its occlusion map.

    Args:
      episodes: the episodes, at least one.

    Returns:
      The figure.
    """
    height, width = episodes[0].images.shape[1:3]
    side_x, side_y = _SIDE * width / max(width, height), _SIDE * height / max(width, height)
    size = (2 * len(MOMENTS) * (side_x + 0.08) + 1.0, len(episodes) * (side_y + 0.24) + 0.3)
    figure = Figure(figsize=size)
    figure.set_layout_engine("constrained", w_pad=0.02, h_pad=0.02, wspace=0.01, hspace=0.01)
    grid = figure.subplots(len(episodes), 2 * len(MOMENTS), squeeze=False)
    largest = largest_change(episodes)
    for row, episode in zip(grid, episodes, strict=True):
        outcome = "reached" if episode.success else "missed"
        row[0].set_ylabel(f"goal {episode.goal}\n{outcome}", rotation=0, ha="right", va="center")
        for index, (moment, seconds) in enumerate(zip(MOMENTS, episode.seconds, strict=True)):
            image = episode.images[index]
            _show(row[2 * index], image)
            _show(row[2 * index + 1], overlay_heat(image, episode.heat[index], largest))
            row[2 * index].set_title(f"{moment}, {seconds:.2f} s", fontsize=9)
    return figure


def _show(axes: Axes, image: UInt8[np.ndarray, "h w c"]) -> None:
    """Draw an image without ticks."""
    axes.imshow(np.broadcast_to(image, (*image.shape[:2], 3)), interpolation="nearest")
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
