"""Run a hyperparameter search whose trials train side by side, with Optuna as the memory.

A worker asks Optuna for a round of trials, trains them together, and tells Optuna what became of
them; the next round is informed by all rounds before it. Several workers, on one host or many, may
share one study through its storage. While a round runs, the worker renews a heartbeat in the
storage. If a worker dies, the next one that looks marks its trials as failed and enqueues the same
values again, so that nothing is lost.

The best trials and the configuration as it was given are then retrained with seeds that the search
has not used, and evaluated on the report's goals, which chose nothing.
"""

import contextlib
import functools
import itertools
import sqlite3
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, get_args

import jax
import numpy as np

from jetbot_mjx.config import Config, ConfigError, Setting
from jetbot_mjx.errors import InvalidError, UserError, ran_out, requires_extra
from jetbot_mjx.evaluation import REPORT_GOALS, report_keys
from jetbot_mjx.runs import load_checkpoint, make_folder
from jetbot_mjx.terminal import stage
from jetbot_mjx.tuning.space import TRACED, Parameter, Value, Values, with_values
from jetbot_mjx.tuning.trials import (
    Objective,
    Outcome,
    ScoredBy,
    Trials,
    mean_scores,
    mean_seconds,
)

with requires_extra("tune", "tune"):
    import optuna
    import sqlalchemy
    import sqlalchemy.exc
    from optuna.trial import FrozenTrial

_EVALUATIONS = 8
"""Number of evaluations of each trial; after the second, a trial may be ended early."""
LEAST_SUCCESS = 0.999
"""Success rate that a policy must have for its time to count."""
_STARTUP_TRIALS = 16
"""Number of trials of each program whose values are random; the first all train to their end."""
_STARTUP_PROGRAMS = 8
"""Most programs that are tried before Optuna proposes one."""
_FAILED_ROUNDS = 8
"""Number of rounds without a trial that could be trained, after which a search ends."""
_BEAT_SECONDS = 5
"""Time between two heartbeats of a worker [s]."""
_STALE_SECONDS = 30
"""Time without a heartbeat after which a worker counts as dead [s]."""
_POLL_SECONDS = 2.0
_PATIENCE_SECONDS = 3600
"""Time of a round after which a worker may hang, and tells no longer that it is alive, unless one
of its earlier rounds took a tenth of that time [s]."""
CONFIRM_SEEDS = 5
"""Number of new seeds with which the best trials are retrained."""
_LOCKED_SECONDS = 60
"""Time that a worker waits for others to write to SQLite [s]."""
_OPENINGS = 3
"""Number of times that a worker tries to open the database, a second apart."""
_CONFIRM_SEED = 1_000_000
"""Distance of the first seed of the final trainings from the first one of the search."""

_STATES = optuna.trial.TrialState
_STORAGE_ERRORS = optuna.exceptions.StorageInternalError, sqlalchemy.exc.SQLAlchemyError
_OPENING_ERRORS = ImportError, ValueError, RuntimeError
"""Raised for a missing driver, an invalid port, or the database of another version of Optuna."""
_DAMAGE = ValueError, LookupError, TypeError, ArithmeticError
"""Raised by Optuna for a database in which it finds other values than it stores."""

SCORES: Mapping[ScoredBy, str] = {"success": "success_rate", "return": "episode_return"}
"""What a stored trial calls its last score."""

_Final = tuple[float, float, float, float | None]
"""Of one final training the value of the objective and the last score, and on the report the score
and the mean duration [s]."""

_Static = tuple[tuple[str, Value], ...]
"""Names and values of the static settings of trials that one program trains."""


class Entrant(NamedTuple):
    """An `Entrant` holds the final trainings of one set of values."""

    name: str
    values: Values
    objectives: tuple[float, ...]
    """What the search improves, for each seed, on the goals of training."""
    last_scores: tuple[float, ...]
    """Success rate or mean return after training, for each seed, on the goals of training."""
    scores: tuple[float, ...]
    """Success rate or mean return after training, for each seed, on the report's goals."""
    mean_seconds: tuple[float | None, ...]
    """Mean duration of the report's episodes [s], for each seed; a failed one counts in full. None
    in an environment of one's own."""
    scored_by: ScoredBy = "success"
    objective: Objective = "learning"


@contextlib.contextmanager
def quiet() -> Iterator[None]:
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


class _SyncedConnection(sqlite3.Connection):
    """A connection whose commits the disk holds: SQLite also syncs the end of its journal.

    By default a loss of power just after a commit may bring the journal back, and undo the commit.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        """Open the database."""
        super().__init__(*args, **kwargs)
        self.execute("PRAGMA synchronous = EXTRA")


class Search:
    """A `Search` runs trials of one study."""

    @quiet()
    def __init__(
        self,
        config: Config,
        space: Sequence[Parameter],
        folder: Path,
        *,
        objective: Objective = "learning",
        storage: str | None = None,
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        """Open the study, or create it.

        Args:
          config: the configuration in which settings are changed.
          space: the settings and their values.
          folder: where the study and its results are stored.
          objective: what is improved: `learning`, the mean score while learning, or `time`, the
            time to the goals of policies that reach `LEAST_SUCCESS`.
          storage: a database URL; None: SQLite in the folder.
          say: called with one line about each round.

        Raises:
          ConfigError: trials cannot be trained as the configuration asks for.
          UserError: `init_from` is not a run, the folder or the storage cannot be used, or the
            study has another space.
        """
        _check_config(config, objective)
        self._config = config
        self._objective: Objective = objective
        self._space = list(space)
        flat = config.flat()
        # An option of a task may be searched that the configuration does not have.
        self._given = {one.name: _frozen(flat[one.name]) for one in space if one.name in flat}
        self._programs = self._first_programs()
        self._say = say
        self._batches: dict[_Static, Trials] = {}
        self._longest_round, self._failed = 0.0, 0
        folder = folder.resolve()
        new = not folder.exists()
        make_folder(folder)
        file = sqlalchemy.URL.create("sqlite", database=str(folder / "study.db"))
        self._url = storage or file.render_as_string()
        self._retry = optuna.storages.RetryHeartbeatStaleTrialCallback()
        try:
            with stage("opening the study"), self._reports_storage(*_OPENING_ERRORS, *_DAMAGE):
                self._storage = self._open()
                self.study = self._study(folder.name)
            with self._reports_storage(*_DAMAGE):
                self._check_study()
                # Read all trials once, so that a damaged database is refused before any training.
                for trial in ranked_trials(self.study):
                    self.values_of(trial)
        except UserError:
            if new and not any(folder.iterdir()):
                folder.rmdir()
            raise

    def _study(self, name: str) -> optuna.Study:
        """Return the study of a name in the database, a new one if there is none."""
        return optuna.create_study(
            storage=self._storage,
            sampler=self._sampler(0),
            study_name=name,
            direction="maximize" if self._objective == "learning" else "minimize",
            # Of those at the same step, the worse half of all that were trained ends.
            pruner=optuna.pruners.MedianPruner(_STARTUP_TRIALS, n_warmup_steps=1),
            load_if_exists=True,
        )

    def _open(self) -> optuna.storages.RDBStorage:
        """Return the database, whose tables only one of several workers can create."""
        sqlite = {
            "connect_args": {"timeout": _LOCKED_SECONDS, "factory": _SyncedConnection},
            # Whoever holds the study may use it at any time, and nobody closes it: so that no
            # connection stays open, each is closed when it has been used.
            "poolclass": sqlalchemy.NullPool,
        }
        connect = functools.partial(
            optuna.storages.RDBStorage,
            self._url,
            sqlite if self._url.startswith("sqlite") else None,
            heartbeat_interval=_BEAT_SECONDS,
            grace_period=_STALE_SECONDS,
            heartbeat_stale_trial_callback=self._retry,
        )
        for _ in range(_OPENINGS - 1):
            try:
                return connect()
            except (sqlalchemy.exc.DBAPIError, optuna.exceptions.StorageInternalError):
                time.sleep(1.0)
        return connect()

    @quiet()
    def run(self, trials: int, round_size: int) -> None:
        """Run rounds of trials until the study has enough.

        Args:
          trials: how many trials the study shall have, those of other workers included.
          round_size: how many to train at once.

        Raises:
          UserError: no trial of a round could be trained, the memory is too small, or the
            storage cannot be used.
        """
        with self._reports_storage():
            done = len(finished_trials(self.study))
        with self._reports_storage(), stage("trials", max(0, trials - done)) as advance:
            while (count := min(round_size, self._next_round(trials))) > 0:
                self._run_round(count, trials)
                before, done = done, len(finished_trials(self.study))
                advance(done - before)

    def _run_round(self, count: int, trials: int) -> None:
        """Run `count` trials at once, and tell how many of `trials` the study has."""
        began = time.perf_counter()
        with self._alive() as asked:
            drawn = self._draw(asked, count)
            self._train(asked, drawn)
        failed = [one for one in self._stored(asked) if "error" in one.user_attrs]
        reason = failed[0].user_attrs["error"] if failed else ""
        self._failed = self._failed + count if len(failed) == count else 0
        if self._failed >= _FAILED_ROUNDS * count:
            raise UserError(
                f"none of the last {self._failed} trials could be trained, such as: {reason}"
            )
        done, ranked = len(finished_trials(self.study)), ranked_trials(self.study)
        self._longest_round = max(self._longest_round, time.perf_counter() - began)
        best = describe_trial(self.study, ranked[0]) if ranked else "-"
        self._say(
            f"{done} of {trials} trials, best {best};"
            f" this round of {count} took {time.perf_counter() - began:.1f} s"
            + (f"; {len(failed)} could not be trained, such as: {reason}" if failed else "")
        )

    def _draw(self, asked: list[optuna.Trial], count: int) -> list[Values]:
        """Ask Optuna for trials, append them to a list, and return the values of each.

        All have the static settings of the first, so that one program trains them.
        """
        drawn: list[Values] = []
        # Forget the static settings of the round before.
        self.study.sampler = self._sampler(len(self.study.get_trials(deepcopy=False)))
        with stage("drawing values", count) as advance:
            for _ in range(count):
                asked.append(trial := self.study.ask())
                if not drawn:
                    # Workers that begin at the same time draw different values.
                    self.study.sampler = sampler = self._sampler(trial.number)
                    program = trial.number // max(count, _STARTUP_TRIALS)
                    if program < len(self._programs):
                        self._fix(self._programs[program], sampler)
                drawn.append({one.name: one.suggest(trial) for one in self._space})
                if len(drawn) == 1:
                    self._fix(trial.params, sampler)
                advance(1)
        return drawn

    def _fix(self, values: Mapping[str, Any], sampler: optuna.samplers.BaseSampler) -> None:
        """Let Optuna draw no other static settings than these."""
        static = {name: value for name, value in values.items() if name not in TRACED}
        self.study.sampler = optuna.samplers.PartialFixedSampler(static, sampler)

    def _first_programs(self) -> list[Mapping[str, Any]]:
        """Return static settings to begin with, as Optuna stores them: the given ones, then others.

        Otherwise the first values that happen to be good would decide for their program.
        """
        lists = [one for one in self._space if one.name not in TRACED and one.choices]
        every = list(itertools.product(*(one.choices for one in lists)))
        np.random.default_rng(self._config.seed).shuffle(every)
        given = tuple(self._given.get(one.name) for one in lists)
        every.sort(key=lambda values: values != given)
        return [
            {one.name: one.to_optuna(value) for one, value in zip(lists, values, strict=True)}
            for values in every[:_STARTUP_PROGRAMS]
        ]

    def confirm(self, count: int, seeds: int, round_size: int) -> list[Entrant]:
        """Retrain the best trials and the given configuration with new seeds.

        Args:
          count: how many of the best trials; 0: retrain nothing.
          seeds: how many trainings of each.
          round_size: how many to train at once.

        Returns:
          The given configuration first, then the best trials in the order of their score.

        Raises:
          UserError: as for `run`.
        """
        if count == 0:
            return []
        chosen: dict[str, Values] = {"as given": {}}
        for trial in ranked_trials(self.study):
            values = self.values_of(trial)
            if len(chosen) <= count and values not in (self._given, *chosen.values()):
                chosen[f"trial {trial.number}"] = values
        # Train all seeds of all entrants, grouped by their static settings.
        work = [
            (name, values, (self._config.seed + _CONFIRM_SEED + index) % 2**32)
            for name, values in chosen.items()
            for index in range(seeds)
        ]
        done: dict[str, list[_Final]] = {name: [] for name in chosen}
        with stage("final trainings", len(work)) as advance:
            for key, members in self._groups([values for _, values, _ in work]).items():
                # In parts of one size, which the program of a round can train.
                for part in np.array_split(members, -(-len(members) // round_size)):
                    results = self._final([work[i] for i in part], key)
                    for i, result in zip(part, results, strict=True):
                        done[work[i][0]].append(result)
                    advance(len(part))
        scored_by, entrants = study_score(self.study), []
        for name, found in done.items():
            own, last, scores, seconds = zip(*found, strict=True)
            entrants.append(
                Entrant(name, chosen[name], own, last, scores, seconds, scored_by, self._objective)
            )
        return entrants

    def is_given(self, trial: FrozenTrial) -> bool:
        """Return whether a trial has the values of the given configuration."""
        return self.values_of(trial) == self._given

    def values_of(self, trial: FrozenTrial) -> dict[str, Value]:
        """Return the values of a trial that is stored."""
        return {one.name: one.from_optuna(trial.params[one.name]) for one in self._space}

    def _final(self, work: Sequence[tuple[str, Values, int]], key: _Static) -> list[_Final]:
        """Train values with seeds, and evaluate them on the report."""
        batch = self._batch(key)
        outcomes = self._outcomes(batch, [values for _, values, _ in work], [x[2] for x in work])
        stacked = jax.tree.map(lambda *x: np.stack(x), *(one.params for one in outcomes))
        with stage(f"{len(work) * REPORT_GOALS:,} episodes of the report's goals"):
            episodes = jax.device_get(batch.evaluate(stacked, report_keys(REPORT_GOALS)))
        scores = mean_scores(episodes, outcomes[0].scored_by)
        seconds = mean_seconds(episodes, batch.config)
        own = [(one.value(self._objective), one.scores[-1]) for one in outcomes]
        return [(*x, *y) for x, y in zip(own, zip(scores, seconds, strict=True), strict=True)]

    def _check_study(self) -> None:
        """Refuse a study that was begun with another space or configuration."""
        given = {
            "space": [str(one) for one in self._space],
            "config": self._config.to_yaml(),
            "objective": self._objective,
        }
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
        own = self._given
        if not self.study.get_trials(deepcopy=False) and all(
            one.name in own and one.contains(own[one.name]) for one in self._space
        ):
            first = {one.name: one.to_optuna(own[one.name]) for one in self._space}
            self.study.enqueue_trial(first, skip_if_exists=True)

    def _sampler(self, number: int) -> optuna.samplers.BaseSampler:
        """Return a sampler for the trials from a number on."""
        seed = (self._config.seed + number) % 2**32
        return optuna.samplers.TPESampler(
            seed=seed,
            multivariate=True,
            group=True,
            n_startup_trials=_STARTUP_TRIALS * len(self._programs),
        )

    @contextlib.contextmanager
    def _reports_storage(self, *errors: type[Exception]) -> Iterator[None]:
        """Convert the errors of a database, and others, to a one-line `UserError`."""
        try:
            yield
        except UserError:
            raise
        except (*_STORAGE_ERRORS, *errors) as error:
            # Optuna's own message names only what may have happened.
            reason = next(iter(str(error.__cause__ or error).splitlines()), type(error).__name__)
            raise UserError(f"--storage {self._url} cannot be used: {reason}") from None

    def _stored(self, asked: Sequence[optuna.Trial]) -> list[FrozenTrial]:
        """Return trials as the storage has them."""
        numbers = {trial.number for trial in asked}
        return [one for one in self.study.get_trials(deepcopy=False) if one.number in numbers]

    def _next_round(self, trials: int) -> int:
        """Return how many trials to ask for, after waiting for other workers' last ones."""
        missing = self._missing(trials)
        if missing is None:
            with stage(
                "waiting for trials of other workers; those of a killed one are run again after"
                f" {_STALE_SECONDS} s"
            ):
                while missing is None:
                    time.sleep(_POLL_SECONDS)
                    missing = self._missing(trials)
        return missing

    def _missing(self, trials: int) -> int | None:
        """Return how many trials are missing; None: those that other workers run may be enough."""
        optuna.storages.fail_stale_trials(self.study)
        running = self.study.get_trials(deepcopy=False, states=(_STATES.RUNNING,))
        # Optuna never fails a trial whose worker was killed before its first heartbeat.
        table = sqlalchemy.text("SELECT trial_id FROM trial_heartbeats")
        with self._storage.engine.connect() as connection:
            beating = set(connection.execute(table).scalars())
        for trial in running:
            if trial._trial_id not in beating:
                self._storage.record_heartbeat(trial._trial_id)
        missing = trials - len(finished_trials(self.study)) - len(running)
        return None if missing <= 0 and running else max(missing, 0)

    @contextlib.contextmanager
    def _alive(self) -> Iterator[list[optuna.Trial]]:
        """Tell the storage that the trials of a list are alive, from a thread.

        A worker that hangs does not tell it for ever, and others then run its trials. After an
        error or Ctrl-C, those that are not finished are enqueued again.
        """
        asked: list[optuna.Trial] = []
        finished, began = threading.Event(), time.monotonic()
        patience = max(_PATIENCE_SECONDS, 10 * self._longest_round)

        def beat() -> None:
            while time.monotonic() - began < patience:
                # The worker itself reports a storage that cannot be used.
                with contextlib.suppress(*_STORAGE_ERRORS):
                    for trial in tuple(asked):
                        self._storage.record_heartbeat(trial._trial_id)
                if finished.wait(_BEAT_SECONDS):
                    return

        thread = threading.Thread(target=beat, daemon=True)
        thread.start()
        try:
            yield asked
        except BaseException:
            for one in self._stored(asked):
                if one.state == _STATES.RUNNING:
                    self.study.tell(one.number, state=_STATES.FAIL)
                    self._retry(self.study, one)
            raise
        finally:
            finished.set()
            thread.join()

    def _train(self, asked: Sequence[optuna.Trial], drawn: Sequence[Values]) -> None:
        """Train a round of trials, and tell the study of each group as soon as it is done."""
        valid = []
        for trial, values in zip(asked, drawn, strict=True):
            try:
                with_values(self._config, values, source=f"trial {trial.number}")
                valid.append((trial, values))
            # Values that do not fit together, such as a batch size and a number of environments.
            except UserError as error:
                self._fail(trial, error)
        for key, members in self._groups([values for _, values in valid]).items():
            trials = [valid[i][0] for i in members]
            try:
                batch = self._batch(key)
            # Values that the environment or the networks refuse.
            except UserError as error:
                for trial in trials:
                    self._fail(trial, error)
                continue
            seeds = [(self._config.seed + trial.number) % 2**32 for trial in trials]
            outcomes = self._outcomes(
                batch,
                [valid[i][1] for i in members],
                seeds,
                lambda i, outcome, trials=trials: self._goes_on(trials[i], outcome),
            )
            with stage("storing trials", len(trials)) as advance:
                for trial, outcome in zip(trials, outcomes, strict=True):
                    self._tell(trial, outcome)
                    advance(1)

    def _goes_on(self, trial: optuna.Trial, outcome: Outcome) -> bool:
        """Store how a trial has learned so far, and return whether it may be one of the best."""
        # Another worker may have taken this one for dead, after Ctrl-Z for example.
        if not self._is_running(trial):
            return False
        trial.report(outcome.value(self._objective), len(outcome.scores) - 1)
        return not trial.should_prune()

    def _tell(self, trial: optuna.Trial, outcome: Outcome) -> None:
        if not self._is_running(trial):
            return
        trial.set_user_attr(SCORES[outcome.scored_by], outcome.scores[-1])
        trial.set_user_attr("mean_seconds", outcome.mean_seconds)
        if self._objective == "time":
            # What misses goals is drawn less, however short its times are.
            trial.set_constraint("missed goals", LEAST_SUCCESS - outcome.scores[-1])
        if outcome.params is None:
            self.study.tell(trial, state=_STATES.PRUNED)
            return
        value = outcome.value(self._objective)
        trial.report(value, len(outcome.scores) - 1)
        self.study.tell(trial, value)

    def _fail(self, trial: optuna.Trial, error: UserError) -> None:
        if self._is_running(trial):
            trial.set_user_attr("error", str(error))
            # Optuna learns nothing from a failed trial, and would draw such values again and again.
            self.study.tell(trial, state=_STATES.PRUNED)

    def _is_running(self, trial: optuna.Trial) -> bool:
        return self._storage.get_trial(trial._trial_id).state == _STATES.RUNNING

    def _outcomes(
        self,
        batch: Trials,
        drawn: Sequence[Values],
        seeds: Sequence[int],
        goes_on: Callable[[int, Outcome], bool] = lambda trial, outcome: True,
    ) -> list[Outcome]:
        """Train trials of one group at once; `goes_on` is as for `Trials.run`."""
        values = [{**self._given, **one} for one in drawn]
        try:
            return batch.run(values, seeds, goes_on)
        # JAX raises a subclass.
        except RuntimeError as error:
            if not ran_out(error):
                raise
            raise UserError(
                f"the device's memory is too small to train {len(values)} trials at once:"
                " choose a smaller --round"
            ) from None

    def _groups(self, drawn: Sequence[Values]) -> dict[_Static, list[int]]:
        """Return the indices of the trials that one program trains, by their static settings.

        A setting that is null is static: a program without it differs from one that has it.
        """
        groups: dict[_Static, list[int]] = {}
        for index, one in enumerate(drawn):
            values = {**self._given, **one}
            key = tuple(
                (name, value)
                for name, value in values.items()
                if name not in TRACED or value is None
            )
            groups.setdefault(key, []).append(index)
        return groups

    def _batch(self, key: _Static) -> Trials:
        """Return the programs for static settings."""
        if key not in self._batches:
            static = dict(key)
            config = with_values(self._config, static, source="tune")
            traced = [
                one.name for one in self._space if one.name in TRACED and one.name not in static
            ]
            with stage("preparing the environment and the networks"):
                self._batches[key] = Trials(config, traced, _EVALUATIONS)
        return self._batches[key]


def study_score(study: optuna.Study) -> ScoredBy:
    """Return what the trials of a study are compared by."""
    returns = any(SCORES["return"] in one.user_attrs for one in completed_trials(study))
    return "return" if returns else "success"


def format_score(score: float, scored_by: ScoredBy) -> str:
    """Return a score as text."""
    return f"{score:.2%}" if scored_by == "success" else f"{score:.2f}"


def study_objective(study: optuna.Study) -> Objective:
    """Return what a study improves."""
    return "time" if study.direction == optuna.study.StudyDirection.MINIMIZE else "learning"


def format_objective(value: float, objective: Objective, scored_by: ScoredBy) -> str:
    """Return what a search improves as text."""
    return f"{value:.3f} s" if objective == "time" else format_score(value, scored_by)


def describe_trial(study: optuna.Study, trial: FrozenTrial) -> str:
    """Return the value of a trial, and what it is, in a few words."""
    objective, scored_by = study_objective(study), study_score(study)
    text = format_objective(trial.value or 0.0, objective, scored_by)
    if objective == "learning":
        return f"mean {scored_by} {text}"
    return f"mean time {text} with {trial.user_attrs[SCORES['success']]:.2%} success"


def completed_trials(study: optuna.Study) -> list[FrozenTrial]:
    """Return the trials that were trained to their end."""
    return study.get_trials(deepcopy=False, states=(_STATES.COMPLETE,))


def finished_trials(study: optuna.Study) -> list[FrozenTrial]:
    """Return the trials that were trained to their end or ended early."""
    ended = study.get_trials(deepcopy=False, states=(_STATES.COMPLETE, _STATES.PRUNED))
    return [trial for trial in ended if "error" not in trial.user_attrs]


def ranked_trials(study: optuna.Study) -> list[FrozenTrial]:
    """Return the trials that were trained to their end, the best first."""
    objective = study_objective(study)

    def key(trial: FrozenTrial) -> tuple[float, float]:
        score = trial.user_attrs.get(SCORES["success"], 0.0)
        return rank(trial.value or 0.0, score, objective)

    return sorted(completed_trials(study), key=key)


def rank(value: float, score: float, objective: Objective) -> tuple[float, float]:
    """Return a key that sorts the best first.

    Args:
      value: the value of the objective.
      score: the success rate after training, which for `time` must reach `LEAST_SUCCESS`.
      objective: what is improved.
    """
    return (0.0, -value) if objective == "learning" else (max(0.0, LEAST_SUCCESS - score), value)


def _check_config(config: Config, objective: Objective) -> None:
    """Raise an error if trials cannot be trained as a configuration asks for.

    Raises:
      ConfigError: a setting is not one of trials.
      InvalidError: there is no such objective.
      UserError: `init_from` is not a run.
    """
    if objective not in get_args(Objective):
        choices = ", ".join(map(repr, get_args(Objective)))
        raise InvalidError(f"objective = {objective!r} is wrong: choose one of {choices}")
    if config.trainer != "resumable":
        raise ConfigError(
            f"trainer = {config.trainer!r} cannot be tuned: take trainer = 'resumable'"
        )
    if config.seeds > 1:
        raise ConfigError(
            f"seeds = {config.seeds} cannot be tuned: leave it out. Every trial has a seed of its"
            " own, and the best trials are retrained with new seeds"
        )
    if objective == "time" and config.environment is not None:
        raise ConfigError(
            f"--objective time is for goals of robots, and environment = {config.environment!r}:"
            " leave it out, and the mean return counts"
        )
    if config.init_from is not None:
        load_checkpoint(config.init_from)


def _frozen(value: Setting) -> Value:
    if isinstance(value, dict):
        return tuple(_frozen([key, one]) for key, one in value.items())
    return tuple(map(_frozen, value)) if isinstance(value, list) else value
