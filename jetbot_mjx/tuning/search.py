"""Run a hyperparameter search whose trials train side by side, with Optuna as the memory.

A worker asks Optuna for a round of trials, trains them together, and tells Optuna what became of
them; the next round is informed by all rounds before it. Several workers, on one host or many, may
share one study through its storage. While a round runs, the worker renews a heartbeat in the
storage. If a worker dies, the next one that looks marks its trials as failed and enqueues the same
values again, so that nothing is lost.

The best trials and the configuration as it was given are then trained anew with seeds that the
search has not used, and evaluated on the report's goals, which chose nothing.
"""

import contextlib
import operator
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from jetbot_mjx.config import Config
from jetbot_mjx.errors import MissingPackageError, UserError
from jetbot_mjx.evaluation.evaluator import REPORT_GOALS, report_keys
from jetbot_mjx.runs.progress import stage
from jetbot_mjx.runs.run_dir import make_folder
from jetbot_mjx.tuning.space import TRACED, Parameter, with_values
from jetbot_mjx.tuning.trials import Outcome, Trials, mean_seconds

try:
    import optuna
except ModuleNotFoundError:
    raise MissingPackageError("tune needs Optuna: pip install 'jetbot_mjx[tune]'") from None

_BEAT_SECONDS = 5
"""How often a worker renews its heartbeat [s]."""
_STALE_SECONDS = 30
"""After how long without a heartbeat a worker counts as dead [s]."""
_POLL_SECONDS = 2.0
CONFIRM_SEEDS = 5
"""How many new seeds the best trials are trained with."""
_CONFIRM_SEED = 1_000_000
"""The first seed of the final trainings, beyond those of the search."""


class Entrant(NamedTuple):
    """An `Entrant` holds the final trainings of one set of values."""

    name: str
    values: Mapping[str, Any]
    areas: tuple[float, ...]
    """Mean success over the training, for each seed, on the goals of training."""
    success_rates: tuple[float, ...]
    """After training, for each seed, on the report's goals."""
    mean_seconds: tuple[float, ...]
    """Mean duration of the report's episodes [s], for each seed; a failed one counts in full."""


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep Optuna from logging, and from warnings that do not matter here, inside the context."""
    verbosity = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            # Heartbeats are recorded here, for a whole round of trials.
            warnings.filterwarnings("ignore", "Heartbeat of storage", UserWarning)
            yield
    finally:
        optuna.logging.set_verbosity(verbosity)


def _open_storage(url: str) -> optuna.storages.RDBStorage:
    """Open a study's database, which enqueues the trials of killed workers again."""
    return optuna.storages.RDBStorage(
        url,
        heartbeat_interval=_BEAT_SECONDS,
        grace_period=_STALE_SECONDS,
        heartbeat_stale_trial_callback=optuna.storages.RetryHeartbeatStaleTrialCallback(),
    )


class Search:
    """A `Search` runs trials of one study."""

    @_quiet()
    def __init__(
        self,
        config: Config,
        space: Sequence[Parameter],
        folder: Path,
        *,
        storage: str | None = None,
        evaluations: int = 8,
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        """Open the study, or create it.

        Args:
          config: the configuration in which settings are changed.
          space: the settings and their values.
          folder: where the study and its results are stored.
          storage: a database URL; None: SQLite in the folder.
          evaluations: how often each trial is evaluated; their mean success is maximised.
          say: called with one line about each round.

        Raises:
          UserError: the folder or the storage cannot be used, or the study has another space.
        """
        self._config = config
        self._space = list(space)
        self._traced_names = [one.name for one in space if one.name in TRACED]
        self._static_names = [one.name for one in space if one.name not in TRACED]
        self._evaluations = evaluations
        self._say = say
        self._batches: dict[tuple[Any, ...], Trials] = {}
        new = not folder.exists()
        make_folder(folder)
        url = storage or f"sqlite:///{folder.absolute() / 'study.db'}"
        try:
            self._storage = _open_storage(url)
            self.study = optuna.create_study(
                storage=self._storage,
                study_name=folder.name,
                direction="maximize",
                load_if_exists=True,
            )
            # Workers that join later draw other values than the first.
            seed = config.seed + len(self.study.get_trials(deepcopy=False))
            self.study.sampler = optuna.samplers.TPESampler(
                seed=seed % 2**32, multivariate=True, group=True, n_startup_trials=16
            )
        # SQLAlchemy has many kinds of errors for a URL, a driver or a host that is wrong.
        except Exception as error:
            reason = next(iter(str(error).splitlines()), type(error).__name__)
            if new and not any(folder.iterdir()):
                folder.rmdir()
            raise UserError(f"--storage {url} cannot be used: {reason}") from None
        self._check_space()

    @_quiet()
    def run(self, trials: int, round_size: int) -> None:
        """Run rounds of trials until the study has enough.

        Args:
          trials: how many completed trials the study shall have, those of other workers included.
          round_size: how many to train at once.

        Raises:
          UserError: the values of no trial of a round fit together.
        """
        with stage("trials", max(0, trials - len(completed_trials(self.study)))) as advance:
            while (count := self._next_round(trials, round_size)) > 0:
                self._run_round(count, trials)
                advance(count)

    def _run_round(self, count: int, trials: int) -> None:
        """Run `count` trials at once, and tell how many of `trials` the study has."""
        began = time.perf_counter()
        asked = [self.study.ask() for _ in range(count)]
        with self._heartbeat(asked):
            self._train(asked)
        errors = [one.user_attrs.get("error") for one in self._stored(asked)]
        if all(errors):
            raise UserError(
                f"none of the last {count} trials could be trained, such as: {errors[0]}"
            )
        best = max((one.value for one in completed_trials(self.study)), default=float("nan"))
        self._say(
            f"{len(completed_trials(self.study))} of {trials} trials, best mean success {best:.2%};"
            f" this round of {count} took {time.perf_counter() - began:.1f} s"
        )

    def confirm(self, count: int, seeds: int) -> list[Entrant]:
        """Train the best trials and the given configuration anew, with new seeds.

        Args:
          count: how many of the best trials.
          seeds: how many trainings of each.

        Returns:
          The given configuration first, then the best trials in the order of their score.
        """
        ranked = sorted(completed_trials(self.study), key=lambda trial: -(trial.value or 0.0))
        chosen: dict[str, Mapping[str, Any]] = {"as given": {}}
        for trial in ranked:
            if len(chosen) <= count and trial.params not in chosen.values():
                chosen[f"trial {trial.number}"] = trial.params
        # Train all seeds of all entrants, grouped by their static settings.
        work = [
            (name, values, _CONFIRM_SEED + index)
            for name, values in chosen.items()
            for index in range(seeds)
        ]
        done: dict[str, list[tuple[Outcome, float, float]]] = {name: [] for name in chosen}
        for batch, members in self._groups([values for _, values, _ in work]):
            outcomes = batch.run(
                [self._values(work[i][1], self._traced_names) for i in members],
                [work[i][2] for i in members],
            )
            stacked = jax.tree.map(lambda *x: np.stack(x), *(one.params for one in outcomes))
            with stage("episodes of the report's goals", len(members) * REPORT_GOALS):
                episodes = jax.device_get(batch.evaluate(stacked, report_keys(REPORT_GOALS)))
            rates = np.asarray(episodes.success).mean(axis=1).tolist()
            seconds = mean_seconds(episodes, self._config)
            results = zip(outcomes, rates, seconds, strict=True)
            for i, result in zip(members, results, strict=True):
                done[work[i][0]].append(result)
        return [
            Entrant(
                name,
                dict(chosen[name]),
                tuple(one.area for one, _, _ in found),
                tuple(rate for _, rate, _ in found),
                tuple(seconds for _, _, seconds in found),
            )
            for name, found in done.items()
        ]

    def _check_space(self) -> None:
        """Refuse a study that was begun with another space or configuration."""
        given = {"space": [str(one) for one in self._space], "config": self._config.to_yaml()}
        stored = self.study.user_attrs
        for key, value in given.items():
            if key not in stored:
                self.study.set_user_attr(key, value)
            elif stored[key] != value:
                raise UserError(
                    f"the study {self.study.study_name} was begun with another {key}: choose a"
                    " new --output"
                )
        # Begin with the given configuration, if the space contains it.
        own = self._values({}, [one.name for one in self._space])
        if not self.study.get_trials(deepcopy=False) and all(
            one.contains(own[one.name]) for one in self._space
        ):
            self.study.enqueue_trial(own, skip_if_exists=True)

    def _stored(self, asked: Sequence[Any]) -> list[Any]:
        """Return trials as the storage has them."""
        numbers = {trial.number for trial in asked}
        return [one for one in self.study.get_trials(deepcopy=False) if one.number in numbers]

    def _next_round(self, trials: int, round_size: int) -> int:
        """Return how many trials to ask for, after waiting for other workers' last ones."""
        while True:
            optuna.storages.fail_stale_trials(self.study)
            running = self.study.get_trials(
                deepcopy=False, states=(optuna.trial.TrialState.RUNNING,)
            )
            missing = trials - len(completed_trials(self.study)) - len(running)
            if missing > 0 or not running:
                return min(round_size, max(missing, 0))
            time.sleep(_POLL_SECONDS)

    @contextlib.contextmanager
    def _heartbeat(self, trials: Sequence[Any]) -> Iterator[None]:
        """Tell the storage that these trials are alive, from a thread."""
        finished = threading.Event()

        def beat() -> None:
            while True:
                for trial in trials:
                    self._storage.record_heartbeat(trial._trial_id)
                if finished.wait(_BEAT_SECONDS):
                    return

        thread = threading.Thread(target=beat, daemon=True)
        thread.start()
        try:
            yield
        finally:
            finished.set()
            thread.join()

    def _train(self, asked: Sequence[Any]) -> None:
        """Train a round of trials, and tell the study of each group as soon as it is done."""
        drawn = [{one.name: one.suggest(trial) for one in self._space} for trial in asked]
        valid = []
        for trial, values in zip(asked, drawn, strict=True):
            try:
                with_values(self._config, values, source=f"trial {trial.number}")
                valid.append((trial, values))
            # Values that do not fit together, such as a batch size and a number of environments.
            except UserError as error:
                trial.set_user_attr("error", str(error))
                self.study.tell(trial, state=optuna.trial.TrialState.FAIL)
        for batch, members in self._groups([values for _, values in valid]):
            outcomes = batch.run(
                [self._values(valid[i][1], self._traced_names) for i in members],
                [self._config.seed + valid[i][0].number for i in members],
            )
            for i, outcome in zip(members, outcomes, strict=True):
                trial, _ = valid[i]
                trial.set_user_attr("success_rate", outcome.success_rates[-1])
                trial.set_user_attr("mean_seconds", outcome.mean_seconds)
                for step, rate in enumerate(outcome.success_rates):
                    trial.report(rate, step)
                self.study.tell(trial, outcome.area)

    def _groups(self, drawn: Sequence[Mapping[str, Any]]) -> Iterator[tuple[Trials, list[int]]]:
        """Yield the programs and the indices of the trials that each of them trains."""
        groups: dict[tuple[Any, ...], list[int]] = {}
        for index, values in enumerate(drawn):
            key = tuple(self._values(values, self._static_names).values())
            groups.setdefault(key, []).append(index)
        for key, members in groups.items():
            if key not in self._batches:
                static = dict(zip(self._static_names, key, strict=True))
                config = with_values(self._config, static, source="tune")
                self._batches[key] = Trials(config, self._traced_names, self._evaluations)
            yield self._batches[key], members

    def _values(self, drawn: Mapping[str, Any], names: Sequence[str]) -> dict[str, Any]:
        """Return the values of settings: those that were drawn, or those of the configuration."""
        given = {name: operator.attrgetter(name)(self._config) for name in names}
        return {name: drawn.get(name, value) for name, value in given.items()}


def completed_trials(study: optuna.Study) -> list[Any]:
    """Return the trials that were trained to their end."""
    return study.get_trials(deepcopy=False, states=(optuna.trial.TrialState.COMPLETE,))
