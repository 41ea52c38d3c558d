"""Share a run on the Hugging Face Hub: collect its files, write its model card, upload both.

What others need of the run is uploaded as it is: the checkpoint with its configuration, metrics and
code. What people look at is made here, or taken where it was made before: the exported policy, the
report, a web page and a clip. The card takes its numbers from the report's JSON file.
"""

import json
import os
import re
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

from jetbot_mjx import evaluation, runs, viewers
from jetbot_mjx.deployment.policy_export import FOLDER as POLICY
from jetbot_mjx.deployment.policy_export import export_policy
from jetbot_mjx.deployment.web_page import FILE as PAGE
from jetbot_mjx.deployment.web_page import write_web_page
from jetbot_mjx.errors import NotFoundError, UserError, printable
from jetbot_mjx.runs import Checkpoint, JsonObject
from jetbot_mjx.terminal import stage

_Files = dict[str, Path]
"""Files by their path in the repository."""

_CLIP_GOALS, _CLIP_SIZE = 3, (480, 270)
_LEFT_OUT = ("commit_success.txt",)
"""Files of a checkpoint that nobody needs, and that name a folder of this machine."""


class SharedRun(NamedTuple):
    """A `SharedRun` says what was uploaded."""

    name: str
    """`hf:USER/NAME`."""
    url: str
    revision: str
    files: int
    size: int
    """Bytes of all files."""
    command: str
    """Command by which others use it first."""
    missing: Mapping[str, str]
    """What could not be made, with the reason."""


def share_run(
    run: Path,
    name: str,
    *,
    which: runs.Which = "best",
    licence: str = "apache-2.0",
    private: bool = False,
) -> SharedRun:
    """Upload one checkpoint of a run with all that others need, by one commit.

    A report that is missing is written into the run folder first, as `evaluate` does.

    Args:
      run: the run folder, or one of its checkpoint folders.
      name: the repository, `hf:USER/NAME`.
      which: the checkpoint of a run folder.
      licence: the licence of the policy, by the name that the Hub gives it.
      private: whether a repository that is created is private.

    Returns:
      What was uploaded.

    Raises:
      UserError: there is no usable checkpoint, the run names code that may not run, a file of it is
        a link, or as for `runs.upload_run`.
    """
    checkpoint = runs.load_checkpoint(run, which)
    if not (checkpoint.run_dir / "config.yaml").is_file():
        raise NotFoundError(f"{run}: config.yaml is missing: nobody could use what is shared")
    # Whether its code may run is decided before anything is written.
    checkpoint.make_setup()
    files = _of_the_run(checkpoint)
    report = _report(run, checkpoint)
    files |= _of_folder(report, f"evaluations/{report.name}")
    with tempfile.TemporaryDirectory() as folder:
        made, missing = _made(run, checkpoint, Path(folder))
        files |= made
        values = json.loads(runs.read_text(report / "report.json"))
        card = model_card(name, checkpoint, values, licence=licence, files=[*files])
        files["README.md"] = Path(folder) / "README.md"
        files["README.md"].write_text(card, "utf-8")
        size = sum(path.stat().st_size for path in files.values())
        title = f"{checkpoint.run_dir.name} after {checkpoint.env_steps:,} steps"
        with stage(f"uploading {len(files)} files, {size / 1e6:.1f} MB"):
            uploaded = runs.upload_run(name, files, title, private=private)
    command = f"jetbot-mjx {_commands(checkpoint)[0]} {name}"
    return SharedRun(name, *uploaded, len(files), size, command, missing)


def summarize_sharing(shared: SharedRun) -> str:
    """Return what was uploaded as lines for the terminal."""
    lines = [
        f"{shared.url}: {shared.files} files, {shared.size / 1e6:.1f} MB,"
        f" revision {shared.revision}"
    ]
    lines += [f"  without {what}: {reason}" for what, reason in shared.missing.items()]
    return "\n".join([*lines, f"anyone can use it: {shared.command}"])


def _report(run: Path, checkpoint: Checkpoint) -> Path:
    """Return the folder of a report on a checkpoint, which is written if there is none."""
    evaluations = checkpoint.results_dir / "evaluations"
    goals = evaluation.REPORT_GOALS
    found = evaluation.find_report(evaluations, checkpoint.path.name, goals, frozenset())
    if found and (found / "report.html").is_file():
        return found
    which = checkpoint.env_steps
    return evaluation.evaluate_run(run, which=which, clips=viewers.make_clips).folder


def _made(run: Path, checkpoint: Checkpoint, folder: Path) -> tuple[_Files, dict[str, str]]:
    """Make what others look at; return its files, and what could not be made with the reason."""
    which = checkpoint.env_steps

    def policy() -> _Files:
        exported = export_policy(run, which=which, output=folder / POLICY)
        return _of_folder(exported.folder, POLICY)

    def page() -> _Files:
        return {PAGE: write_web_page(run, folder / PAGE, which=which).path}

    def clip() -> _Files:
        name = checkpoint.results_dir / "videos" / checkpoint.path.name / "episodes"
        made = {"video": name.with_suffix(".mp4"), "gif": name.with_suffix(".gif")}
        if not all(path.is_file() for path in made.values()):
            made = viewers.render_run(run, episodes=_CLIP_GOALS, which=which, size=_CLIP_SIZE).files
        return {"clip.mp4": made["video"], "clip.gif": made["gif"]}

    makers: dict[str, Callable[[], _Files]] = {"a clip": clip, "a web page": page}
    files: _Files = {}
    missing = {}
    for what, make in {"the exported policy": policy, **makers}.items():
        try:
            files |= make()
        except UserError as error:
            missing[what] = str(error)
    for path in files.values():
        _check_file(path)
    return files, missing


def _of_the_run(checkpoint: Checkpoint) -> _Files:
    """Return the files by which others use a checkpoint of a run."""
    run_dir = checkpoint.run_dir
    files: _Files = {x: run_dir / x for x in runs.RUN_FILES if os.path.lexists(run_dir / x)}
    for path in map(run_dir.joinpath, files):
        _check_file(path)
    for name in runs.RUN_FOLDERS:
        if (run_dir / name).is_symlink():
            _check_file(run_dir / name)
        inside = f"{name}/{checkpoint.path.name}" if name == "checkpoints" else name
        files |= _of_folder(run_dir / inside, inside)
    return files


def _of_folder(folder: Path, name: str) -> _Files:
    """Return the files of a folder, if there is one, which has another name in the repository."""
    if folder.is_symlink():
        _check_file(folder)
    found = sorted(path for path in folder.rglob("*") if not path.is_dir() or path.is_symlink())
    files = {f"{name}/{path.relative_to(folder).as_posix()}": path for path in found}
    return {
        place: _check_file(path)
        for place, path in files.items()
        if path.name not in _LEFT_OUT and "__pycache__" not in path.parts
    }


def _check_file(path: Path) -> Path:
    """Raise an error if a file is none, or a link: what it leads to may not be for others."""
    if path.is_symlink() or not path.is_file():
        raise UserError(f"{runs.shortened(path)} is a link or no file: nothing was shared")
    return path


def model_card(
    name: str, checkpoint: Checkpoint, report: JsonObject, *, licence: str, files: list[str]
) -> str:
    """Return the README of a shared run: what it does, how well, and how to use it.

    Args:
      name: the repository, `hf:USER/NAME`.
      checkpoint: the policy.
      report: the content of its `report.json`.
      licence: its licence, by the name that the Hub gives it.
      files: the paths in the repository.
    """
    config, versions = checkpoint.config, report["versions"]["packages"]
    version = versions["jetbot_mjx"]
    robot = f", robot `{_code(config.robot.label)}`, observation `{config.task.observation}`"
    task = f"`{_code(config.code)}`{'' if config.environment else robot}"
    page = next(x for x in files if x.endswith("/report.md"))
    clip = "\n![The policy drives](clip.gif)\n" if "clip.gif" in files else ""
    trust = f" It names code of its author, `{_code(config.code)}`: read it, then add `--trust`."
    names_code = any(x.startswith("task/") for x in files) or config.environment
    extras = "hub" if config.environment else "hub,play"
    commands = "\n".join(f"jetbot-mjx {one} {name}" for one in _commands(checkpoint))
    return f"""---
{_front_matter(licence)}
---

# {name.rpartition("/")[2]}

A policy for {task}, trained for {checkpoint.env_steps:,} environment steps with jetbot_mjx
{version} (JAX {versions["jax"]}, MuJoCo {versions["mujoco"]}).
{clip}
{_results(report)}
[The whole report]({page})

## Use it

```sh
pip install 'jetbot_mjx[{extras}]'
{commands}
```

```python
from jetbot_mjx import load_policy
policy = load_policy("{name}")  # policy(obs) is the action
```

`@` and a revision after the name fix the version.{trust if names_code else ""}

{_list_of(files)}
Licence: {licence}.
"""


def _commands(checkpoint: Checkpoint) -> list[str]:
    """Return the commands that use a policy: only a robot can be played with."""
    return ["evaluate"] if checkpoint.config.environment else ["play", "evaluate"]


def _front_matter(licence: str) -> str:
    """Return by what the Hub finds and shows a repository, as YAML."""
    meta = {
        "license": licence,
        "library_name": "jetbot_mjx",
        "pipeline_tag": "reinforcement-learning",
        "tags": ["reinforcement-learning", "robotics", "mujoco", "jax", "jetbot_mjx"],
    }
    return "\n".join(f"{key}: {json.dumps(value)}" for key, value in meta.items())


def _results(report: JsonObject) -> str:
    """Return the numbers of a report, as a table with their intervals."""
    policy = report["policy"]
    rows = [(f"on {policy['episodes']:,} fixed episodes", "policy", "95 % interval")]
    if policy["success_rate"] is not None:
        ends = f"{policy['success_low']:.2%} to {policy['success_high']:.2%}"
        rows.append(("success", f"{policy['success_rate']:.2%}", ends))
    if policy.get("return_low") is not None:
        ends = f"{policy['return_low']:.2f} to {policy['return_high']:.2f}"
        rows.append(("return, mean", f"{policy['episode_return']:.2f}", ends))
    if policy.get("time_to_goal_median") is not None:
        rows.append(("time to goal, median", f"{policy['time_to_goal_median']:.2f} s", "-"))
    if mujoco := report.get("mujoco"):
        found = mujoco["policy"]
        ends = f"{found['success_low']:.2%} to {found['success_high']:.2%}"
        rows.append(("success in C MuJoCo", f"{found['success_rate']:.2%}", ends))
    rows.insert(1, ("---", "--:", "--:"))
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def _list_of(files: list[str]) -> str:
    """Return a list of what else is in the repository."""
    others = {
        PAGE: "drives in any browser, from the disk",
        f"{POLICY}/": "the policy for a robot that has only NumPy, and its inputs and outputs",
        "config.yaml": "every setting of the training",
    }
    there = {what for what in others for path in files if path.startswith(what)}
    return "".join(f"- `{path}`: {what}\n" for path, what in others.items() if path in there)


def _code(text: str) -> str:
    """Return text that comes from a run as it may stand between backticks."""
    return re.sub(r"[`|<>]", "?", printable(text))
