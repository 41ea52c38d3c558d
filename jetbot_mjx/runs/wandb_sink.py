"""Log a run to Weights & Biases if the configuration sets `wandb: <project>`.

The module is imported only in that case. It logs the same metrics as TensorBoard. An error of
Weights & Biases is reported in one line, and the training continues without it. Its own settings,
such as `WANDB_MODE=offline`, apply.
"""

import contextlib
import importlib.util
import json
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Protocol

from jetbot_mjx.config import Config
from jetbot_mjx.errors import MissingPackageError
from jetbot_mjx.runs.metrics import VIDEO_TAG, History, MetricValues
from jetbot_mjx.runs.run_dir import JsonObject, read_text, write_json
from jetbot_mjx.runs.sb3_tags import aliases, with_aliases

_FILE = "wandb.json"
_INIT_SECONDS = 30.0
_FINISH_SHARE_OF_NOTICE = 0.3
_MAX_TAG_LENGTH = 64


def check_tracking(config: Config) -> None:
    """Raise an error if a run needs Weights & Biases and the package is not installed.

    Raises:
      MissingPackageError: the package is missing.
    """
    if config.wandb is None:
        return
    spec = importlib.util.find_spec("wandb")
    # The folder `wandb/` of earlier runs looks like a package without a file.
    if spec is None or spec.origin is None:
        raise MissingPackageError(
            f"wandb = {config.wandb!r} needs a package that is not installed:"
            " pip install 'jetbot_mjx[wandb]'"
        )


class _Run(Protocol):
    """A run of Weights & Biases."""

    def log(self, data: Mapping[str, object], *, step: int) -> None: ...

    def finish(self) -> None: ...


class WandbSink:
    """A sink that logs to one run of Weights & Biases, which continues when a training resumes.

    The run folder stores the id of this run and the last step that was logged, so that no step is
    logged twice.
    """

    def __init__(
        self,
        config: Config,
        run_dir: Path,
        history: Sequence[History],
        say: Callable[[str], None],
        seeds: int = 1,
    ) -> None:
        """Start the run, or continue it.

        Args:
          config: the configuration of this seed; `config.wandb` is the project.
          run_dir: the run folder of this seed.
          history: metrics that were logged before; those that the run lacks are logged first.
          say: a function that prints one line for the user.
          seeds: number of runs of the same training; several runs share a group.
        """
        self._names = aliases(config.ppo)
        self._say = say
        self._path = run_dir / _FILE
        self._progress = _read(self._path, config.wandb)
        self._run: _Run | None = None
        self._last_written: int | None = None
        with self._disable_on_error():
            self._run = self._begin(config, run_dir, seeds)
            write_json(self._path, self._progress)
        for entry in history:
            self.write(entry.env_steps, entry.metrics)

    def _begin(self, config: Config, run_dir: Path, seeds: int) -> _Run:
        wandb = importlib.import_module("wandb")
        group = run_dir.parent.name if seeds > 1 else None
        tags = [config.code.rpartition(":")[2], config.trainer]
        if config.environment is None:
            tags[1:1] = config.task.observation, config.robot.label
        run = wandb.init(
            project=config.wandb,
            id=self._progress["id"],
            resume="allow",
            reinit="create_new",
            name=f"{group}-{run_dir.name}" if group else run_dir.name,
            group=group,
            tags=[tag[:_MAX_TAG_LENGTH] for tag in tags],
            config=config.model_dump(mode="json"),
            allow_val_change=True,
            dir=run_dir,
            settings=wandb.Settings(
                console="off",
                silent=True,
                init_timeout=_INIT_SECONDS,
                finish_timeout=_FINISH_SHARE_OF_NOTICE * config.preemption_notice / seeds,
                finish_timeout_raises=True,
            ),
        )
        # The table of runs shows the best and the last one beside the configuration.
        run.define_metric("eval/success_rate", summary="max,last")
        if config.environment is not None:
            run.define_metric("eval/episode_return", summary="max,last")
        where = f"offline; later: wandb sync {Path(run.dir).parent}" if run.offline else run.url
        self._say(f"Weights & Biases: {where or 'disabled'}")
        return run

    def write(self, env_steps: int, metrics: MetricValues) -> None:
        """Log the same metrics as TensorBoard, unless this step was logged already."""
        if self._run is None or env_steps <= self._progress["env_steps"]:
            return
        with self._disable_on_error():
            self._run.log(with_aliases(env_steps, metrics, self._names), step=env_steps)
            self._progress["env_steps"] = self._last_written = env_steps
            write_json(self._path, self._progress)

    def write_video(self, env_steps: int, mp4: Path) -> None:
        """Log the video beside the metrics of its step, unless those were logged before."""
        if self._run is None or env_steps != self._last_written:
            return
        with self._disable_on_error():
            video = importlib.import_module("wandb").Video(str(mp4), format="mp4")
            self._run.log({VIDEO_TAG: video}, step=env_steps)

    def close(self) -> None:
        """Wait for pending uploads, for at most a share of `preemption_notice`."""
        if self._run is not None:
            with self._disable_on_error():
                self._run.finish()
        self._run = None

    @contextlib.contextmanager
    def _disable_on_error(self) -> Iterator[None]:
        try:
            yield
        # Weights & Biases raises errors of its own, of the network, of the disk and of pydantic.
        except Exception as error:
            self._run = None
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            self._say(f"Weights & Biases: {reason}; the training continues without it")


def _read(path: Path, project: str | None) -> JsonObject:
    """Return the id and last step of this project's run, or those of a new run if there is none."""
    errors = OSError, ValueError, LookupError, TypeError, RecursionError, ArithmeticError
    with contextlib.suppress(*errors):
        progress = json.loads(read_text(path))
        if progress["project"] == project and isinstance(progress["id"], str):
            return {**progress, "env_steps": int(progress["env_steps"])}
    return {"project": project, "id": uuid.uuid4().hex[:8], "env_steps": -1}
