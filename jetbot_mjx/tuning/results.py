"""Search, and write what was found: the best configuration, tables of all trials, and plots."""

import csv
import io
import json
import statistics
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt

from jetbot_mjx.config import Config, load_config
from jetbot_mjx.errors import requires_extra
from jetbot_mjx.runs import write_model, write_text, writing_to
from jetbot_mjx.terminal import process_seconds, stage
from jetbot_mjx.tuning.search import (
    CONFIRM_SEEDS,
    SCORES,
    Entrant,
    Search,
    completed_trials,
    format_objective,
    format_score,
    quiet,
    rank,
    ranked_trials,
    study_objective,
    study_score,
)
from jetbot_mjx.tuning.space import Parameter, Values, with_values
from jetbot_mjx.tuning.trials import Objective, ScoredBy

with requires_extra("tune", "tune"):
    import optuna

_PLOTS = ("optimization_history", "param_importances", "slice", "parallel_coordinate")


class TuningResult(NamedTuple):
    """A `TuningResult` holds the result of a search."""

    folder: Path
    """The folder of the study and of all files."""
    config_file: Path
    """The file with the best configuration, `best.yaml`."""
    config: Config
    """The best configuration."""
    values: Values
    """Values of the settings that differ from the given configuration in the best one."""
    entrants: tuple[Entrant, ...]
    """The final trainings: of the given configuration, then of the best trials."""
    study: optuna.Study
    """Optuna's study, which holds all trials."""

    def __repr__(self) -> str:
        """Return the folder and the best values in one line."""
        text = f"TuningResult(folder={str(self.folder)!r}"
        if (best := self.best) is not None:
            score = format_score(statistics.fmean(best.scores), best.scored_by)
            text += f", best={best.name!r}, {best.scored_by}={score}"
        return f"{text}, values={dict(self.values)})"

    @property
    def best(self) -> Entrant | None:
        """Return the entrant with the best configuration; None: nothing was retrained."""
        return best_entrant(self.entrants) if self.entrants else None


def run_search(
    config: Config,
    space: Sequence[Parameter],
    folder: Path,
    *,
    trials: int,
    round_size: int,
    confirm: int,
    objective: Objective = "learning",
    storage: str | None = None,
    say: Callable[[str], None] = lambda text: None,
) -> TuningResult:
    """Search, retrain the best trials, and write the results.

    Args:
      config: the configuration in which settings are changed.
      space: the settings and their values.
      folder: where the study and its results are stored.
      trials: how many completed trials the study shall have.
      round_size: how many to train at once.
      confirm: how many of the best trials to retrain with `CONFIRM_SEEDS` new seeds; 0: retrain
        nothing, and the best trial is the best.
      objective: as for `Search`.
      storage: a database URL; None: SQLite in the folder.
      say: called with one line about the folder and one about each round.

    Returns:
      The result.

    Raises:
      UserError: as for `Search`, its methods `run` and `confirm`, and `write_results`.
    """
    search = Search(config, space, folder, objective=objective, storage=storage, say=say)
    # Only now: a search that cannot begin leaves nothing to continue.
    say(
        f"results: {folder}, where the same command with --output (in Python: output) continues"
        " if stopped"
    )
    search.run(trials, round_size)
    say(f"search finished after {process_seconds():.1f} s")
    path = write_results(folder, config, search, [])
    if confirm:
        say(
            f"{path} is the best trial so far; what follows trains the best trials anew, and begins"
            " anew if stopped (--confirm 0 leaves it out)"
        )
    entrants = search.confirm(confirm, CONFIRM_SEEDS, round_size)
    path = write_results(folder, config, search, entrants)
    values = best_values(search, entrants)
    return TuningResult(folder, path, load_config(path), values, tuple(entrants), search.study)


def best_entrant(entrants: Sequence[Entrant]) -> Entrant:
    """Return the entrant that was best with new seeds, on the goals of training."""

    def key(one: Entrant) -> tuple[float, float]:
        score = statistics.fmean(one.last_scores)
        return rank(statistics.fmean(one.objectives), score, one.objective)

    return min(entrants, key=key)


def best_values(search: Search, entrants: Sequence[Entrant]) -> Values:
    """Return the values of the best entrant, or if there is none, of the best trial.

    Args:
      search: the finished search.
      entrants: the final trainings.
    """
    if entrants:
        return best_entrant(entrants).values
    return search.values_of(ranked_trials(search.study)[0])


def write_results(
    folder: Path, config: Config, search: Search, entrants: Sequence[Entrant]
) -> Path:
    """Write `best.yaml`, `trials.csv`, `trials.md` and the plots, and a model of the robot.

    Args:
      folder: an existing folder.
      config: the configuration that the search began from.
      search: the finished search.
      entrants: the final trainings; if there are none, the best trial is the best.

    Returns:
      The path of `best.yaml`.

    Raises:
      UserError: a file cannot be written.
    """
    study = search.study
    path = folder / "best.yaml"
    tables = [*([entrants_table(entrants)] if entrants else []), _trials_table(search)]
    with writing_to(folder):
        write_model(folder, config)
        write_text(
            path, with_values(config, best_values(search, entrants), source="tune").to_yaml()
        )
        write_text(folder / "trials.csv", _csv(study))
        write_text(folder / "trials.md", "\n\n".join(tables) + "\n")
        _plot(folder, study)
    return path


def entrants_table(entrants: Sequence[Entrant]) -> str:
    """Return a Markdown table of the final trainings."""
    best = best_entrant(entrants)
    kind = best.scored_by
    unit = " [%]" if kind == "success" else ""
    learning = " while learning" if best.objective == "learning" else ""
    lines = [
        f"| | {_heading(best.objective, kind)}{learning} | {kind}{unit} | worst seed{unit}"
        " | mean time [s] | values |",
        "|---|---|---|---|---|---|",
    ]
    for one in entrants:
        values = ", ".join(f"{name.split('.')[-1]} {_short(x)}" for name, x in one.values.items())
        lines.append(
            f"| {one.name}{' (best)' if one is best else ''}"
            f" | {format_objective(statistics.fmean(one.objectives), one.objective, kind)}"
            f" | {_number(statistics.fmean(one.scores), kind)} | {_number(min(one.scores), kind)}"
            f" | {_mean_seconds(one.mean_seconds)} | {values} |"
        )
    return "\n".join(lines)


def _heading(objective: Objective, scored_by: ScoredBy) -> str:
    """Return what the values of an objective are, on the goals of training."""
    return f"mean {scored_by}" if objective == "learning" else "time when learnt"


def _number(score: float, scored_by: ScoredBy) -> str:
    """Return a score below a heading that has its unit."""
    return format_score(score, scored_by).rstrip("%")


def _mean_seconds(seconds: Sequence[float | None]) -> str:
    known = [one for one in seconds if one is not None]
    return f"{statistics.fmean(known):.3f}" if known else "-"


def _trials_table(search: Search) -> str:
    study = search.study
    kind, objective = study_score(study), study_objective(study)
    unit = " [%]" if kind == "success" else ""
    names = sorted({name for trial in study.trials for name in trial.params})
    lines = [
        f"| trial | {_heading(objective, kind)} | last {kind}{unit} | mean time [s]"
        f" | {' | '.join(names)} |",
        "|" + "---|" * (4 + len(names)),
    ]
    for trial in ranked_trials(study):
        values = " | ".join(_short(trial.params.get(name, "-")) for name in names)
        lines.append(
            f"| {trial.number}{' (as given)' if search.is_given(trial) else ''}"
            f" | {format_objective(trial.value or 0.0, objective, kind)}"
            f" | {_number(trial.user_attrs[SCORES[kind]], kind)}"
            f" | {_mean_seconds([trial.user_attrs['mean_seconds']])} | {values} |"
        )
    return "\n".join(lines)


def _csv(study: optuna.Study) -> str:
    names = sorted({name for trial in study.trials for name in trial.params})
    text = io.StringIO()
    score = SCORES[study_score(study)]
    columns = ["trial", "state", "score", score, "mean_seconds", *names, "error"]
    writer = csv.DictWriter(text, columns, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for trial in study.trials:
        own = {"trial": trial.number, "state": trial.state.name, "score": trial.value}
        writer.writerow({**trial.user_attrs, **trial.params, **own})
    return text.getvalue()


def _plot(folder: Path, study: optuna.Study) -> None:
    """Draw Optuna's plots, which need two trials."""
    if len(completed_trials(study)) < 2:
        return
    with stage("plots", len(_PLOTS)) as advance, quiet():
        for name in _PLOTS:
            # Optuna sets a style for all figures, and a notebook shows those that are left open.
            with warnings.catch_warnings(), plt.ioff(), plt.rc_context():
                warnings.simplefilter("ignore")
                draw = getattr(optuna.visualization.matplotlib, f"plot_{name}")
                more: dict[str, optuna.importance.BaseImportanceEvaluator] = {}
                if name == "param_importances":
                    # Optuna's default evaluator needs scikit-learn.
                    more["evaluator"] = optuna.importance.PedAnovaImportanceEvaluator()
                axes = draw(study, **more)
                figure = (axes if hasattr(axes, "figure") else axes.flat[0]).figure
                figure.set_size_inches(11, 6)
                figure.savefig(folder / f"{name}.png", dpi=110, bbox_inches="tight")
                plt.close(figure)
            advance(1)


def _short(value: object) -> str:
    """Return a value of a setting as YAML writes it, in few digits."""
    if isinstance(value, float):
        return f"{value:.4g}"
    return json.dumps(value) if value is None or isinstance(value, bool | tuple) else str(value)
