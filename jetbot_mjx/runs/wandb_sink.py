"""Weights & Biases, for those who ask for it by `wandb: <project>`; nobody else imports it.

What is logged is what TensorBoard gets. Whatever goes wrong there is said in one line, and the
training goes on without it. Its own settings hold, such as `WANDB_MODE=offline`.
"""

import contextlib
import importlib.util
import json
import uuid
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from jetbot_mjx.config import Config
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs.metrics import Figures, History
from jetbot_mjx.runs.run_dir import write_json
from jetbot_mjx.runs.sb3_tags import aliases, with_aliases

_FILE = "wandb.json"
_INIT_SECONDS = 30.0
_SHARE_OF_NOTICE = 0.3
_LONGEST_TAG = 64


def check_tracking(config: Config) -> None:
    """Refuses a run that wants Weights & Biases where that is not installed.

    Raises:
      UserError: the package is missing.
    """
    if config.wandb is None:
        return
    spec = importlib.util.find_spec("wandb")
    # Its own folder of earlier runs, `wandb/`, passes for a package without a file.
    if spec is None or spec.origin is None:
        raise UserError(
            f"wandb = {config.wandb!r} needs a package that is not installed:"
            " pip install 'jetbot_mjx[wandb]'"
        )


class WandbSink:
    """One run of Weights & Biases, which goes on where the training goes on.

    Its id lies in the run folder, with the last step that it was told: no step is told twice.
    """

    def __init__(
        self,
        config: Config,
        run_dir: Path,
        history: Sequence[History],
        say: Callable[[str], None],
        seeds: int = 1,
    ) -> None:
        """Begins the run, or goes on with it.

        Args:
          config: of this seed; `config.wandb` is the project.
          run_dir: of this seed.
          history: what was logged before; what the run lacks of it is told first.
          say: takes a line for people.
          seeds: how many runs there are of the same training: several share a group.
        """
        self._names = aliases(config.ppo)
        self._say = say
        self._path = run_dir / _FILE
        self._told = _read(self._path, config.wandb)
        self._run: Any = None
        with self._or_without():
            self._run = self._begin(config, run_dir, seeds)
            write_json(self._path, self._told)
        for entry in history:
            self.write(entry.env_steps, entry.figures)

    def _begin(self, config: Config, run_dir: Path, seeds: int) -> Any:
        wandb: Any = importlib.import_module("wandb")
        group = run_dir.parent.name if seeds > 1 else None
        task = config.task.name.rpartition(":")[2]
        tags = (task, config.task.observation, config.robot.preset, config.trainer)
        run = wandb.init(
            project=config.wandb,
            id=self._told["id"],
            resume="allow",
            reinit="create_new",
            name=f"{group}-{run_dir.name}" if group else run_dir.name,
            group=group,
            tags=[tag[:_LONGEST_TAG] for tag in tags],
            config=config.model_dump(mode="json"),
            allow_val_change=True,
            dir=run_dir,
            settings=wandb.Settings(
                console="off",
                silent=True,
                init_timeout=_INIT_SECONDS,
                finish_timeout=_SHARE_OF_NOTICE * config.preemption_notice / seeds,
                finish_timeout_raises=True,
            ),
        )
        where = f"offline; later: wandb sync {Path(run.dir).parent}" if run.offline else run.url
        self._say(f"Weights & Biases: {where or 'disabled'}")
        return run

    def write(self, env_steps: int, figures: Figures) -> None:
        """Tells what TensorBoard is told."""
        if self._run is None or env_steps <= self._told["env_steps"]:
            return
        with self._or_without():
            self._run.log(with_aliases(env_steps, figures, self._names), step=env_steps)
            self._told["env_steps"] = env_steps
            write_json(self._path, self._told)

    def close(self) -> None:
        """Waits for what is on its way, for a share of `preemption_notice` at most."""
        if self._run is not None:
            with self._or_without():
                self._run.finish()
        self._run = None

    @contextlib.contextmanager
    def _or_without(self) -> Iterator[None]:
        try:
            yield
        # It has errors of its own, of the network's, of the disk's and of pydantic's.
        except Exception as error:
            self._run = None
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            self._say(f"Weights & Biases: {reason}; the training goes on without it")


def _read(path: Path, project: str | None) -> dict[str, Any]:
    """What an earlier process told this project; otherwise the beginning of a new run."""
    with contextlib.suppress(OSError, ValueError, LookupError, TypeError):
        told = json.loads(path.read_text(encoding="utf-8"))
        if told["project"] == project and isinstance(told["id"], str):
            return {"project": project, "id": told["id"], "env_steps": int(told["env_steps"])}
    return {"project": project, "id": uuid.uuid4().hex[:8], "env_steps": -1}
