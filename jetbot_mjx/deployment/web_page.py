"""Write a web page that drives a robot with its policies, and trains new ones: one file.

The page holds a WebAssembly module of the environment's and the learner's kernels, the policies,
scripts, and what they must know. It opens from the disk and asks for nothing from anywhere else:
its content security policy forbids it.
"""

import base64
import hashlib
import html
import json
import re
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import jax

from jetbot_mjx import agents, runs
from jetbot_mjx.agents import PolicyParams
from jetbot_mjx.deployment.numpy_policy import PortablePolicy, portable_policy
from jetbot_mjx.deployment.policy_spec import policy_spec
from jetbot_mjx.deployment.web_functions import web_functions
from jetbot_mjx.deployment.web_modules import find_module
from jetbot_mjx.deployment.web_scene import encoded
from jetbot_mjx.envs import JetBotEnv, layout_data
from jetbot_mjx.errors import UserError
from jetbot_mjx.runs import Checkpoint
from jetbot_mjx.terminal import stage
from onekernel import KernelError

_SCRIPTS = {"engine": ("engine.js", "learner.js"), "app": ("scene.js", "app.js")}
"""The scripts of a page; those of `engine` are also the worker's that trains."""

FILE = "page.html"
"""Name of a page in the run folder."""

_ASSETS = resources.files("jetbot_mjx").joinpath("assets")


class WebPage(NamedTuple):
    """A `WebPage` says what was written."""

    path: Path
    size: int
    """Bytes of the file."""
    drivers: Sequence[str]
    """Who can drive on the page."""
    no_learner: str | None
    """Why the page cannot train; None: it can."""


def write_web_page(
    run_or_checkpoint: str | Path,
    output: str | Path | None = None,
    *,
    which: runs.Which = "best",
) -> WebPage:
    """Write a page of a run's robot, task and policies.

    Args:
      run_or_checkpoint: a run folder, or one of its checkpoint folders.
      output: the file to write, which replaces an earlier one; None: `page.html` in the run folder.
      which: the checkpoint of a run folder.

    Returns:
      What was written: the complete file, or nothing if an error is raised.

    Raises:
      UserError: there is no usable checkpoint, the environment cannot be compiled for pages, the
        linker is missing, or the file cannot be written.
    """
    checkpoint = runs.load_checkpoint(run_or_checkpoint, which)
    path = checkpoint.results_dir / FILE if output is None else Path(output)
    if path.is_dir():
        raise UserError(f"{path} is a folder: name a file with --output, such as {path / FILE}")
    if path.exists() and not path.is_file():
        raise UserError(f"{path} is no file: name a file with --output, such as {FILE}")
    runs.check_writable(path.parent)
    with stage("compiling robot, task and policies for web pages"):
        data = page_data(checkpoint)
    text = page_text(data)
    with runs.writing_to(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        runs.write_text(path, text)
    drivers = [policy["name"] for policy in data["policies"]]
    if data["meta"]["max_speed"] is not None:
        drivers += ["scripted", "you"]
    return WebPage(path, len(text.encode()), drivers, data["meta"]["no_learner"])


def summarize_web_page(page: WebPage) -> str:
    """Return what was written as lines for the terminal."""
    reason = page.no_learner
    none = f"no training there, which needs the fused update: {reason}"
    trains = "can be trained there" if reason is None else none
    return (
        f"{runs.shortened(page.path)}, {page.size / 1e6:.2f} MB, opens in any browser\n"
        f"  drivers: {', '.join(page.drivers)}; {trains}"
    )


def page_data(checkpoint: Checkpoint) -> dict[str, Any]:
    """Return what a page is made of, as JSON values: `meta`, `module` and `policies`.

    Args:
      checkpoint: the checkpoint of the policy that drives at first.

    Raises:
      UserError: the environment cannot be compiled for pages, or the linker is missing.
    """
    env = checkpoint.make_setup().robot_env
    try:
        functions = web_functions(checkpoint.config, env)
        module = find_module(functions.texts)
    except KernelError as error:
        raise UserError(f"no page of {checkpoint.run_dir.name}: {error}") from None
    robots, learner = functions.robots.about, functions.learner
    final = portable_policy(checkpoint, env)
    meta = {
        **_about(checkpoint, env),
        "scene": functions.scene.about,
        "robot_functions": robots,
        "image": robots.get("image"),
        "training_functions": functions.training.about,
        "learner": None if isinstance(learner, str) else learner.about,
        "no_learner": learner if isinstance(learner, str) else None,
        "export": _export(checkpoint, env, final),
    }
    return {
        "meta": meta,
        "module": base64.b64encode(module).decode(),
        "policies": _policies(checkpoint, env, final),
    }


def _about(checkpoint: Checkpoint, env: JetBotEnv) -> dict[str, Any]:
    config, drive = checkpoint.config, env.drive
    task = config.task
    nearest = task.goal_distance_min
    success = runs.stored_score(checkpoint.run_dir, checkpoint.env_steps)
    return {
        "title": checkpoint.run_dir.name,
        "robot": config.robot.label,
        "task": task.name.rpartition(":")[2],
        "dt": env.dt,
        "episode_seconds": task.episode_length * env.dt,
        "success_radius": task.success_radius,
        "goal_range": [nearest, nearest + task.goal_distance_span],
        "observation": _observed(env),
        "max_speed": getattr(drive, "max_speed", None),
        "max_yaw_rate": getattr(drive, "max_yaw_rate", None),
        "trained": {
            "steps": checkpoint.env_steps,
            "success": success if 0 <= success <= 1 else None,
        },
        "versions": runs.versions(),
    }


def _observed(env: JetBotEnv) -> list[dict[str, str]]:
    """Return name and unit of each number of the observation."""
    return [
        {"name": field["name"] + (f" {i}" if field["size"] > 1 else ""), "unit": field["unit"]}
        for field in layout_data(env.task.layout)
        for i in range(field["size"])
    ]


def _policies(
    checkpoint: Checkpoint, env: JetBotEnv, final: PortablePolicy
) -> list[dict[str, Any]]:
    """Return the policies of a page: before the training, early in it if known, and the given."""
    networks, size = checkpoint.networks, checkpoint.about["observation_size"]
    policy_key, value_key = jax.random.split(jax.random.PRNGKey(checkpoint.config.seed))
    untrained = PolicyParams(
        agents.init_normalizer(size),
        networks.policy_network.init(policy_key),
        networks.value_network.init(value_key),
    )
    found = [("untrained", 0, portable_policy(checkpoint._replace(params=untrained), env))]
    run = checkpoint.run_dir
    steps = [one for one in runs.checkpoint_steps(run) if 0 < one < checkpoint.env_steps]
    if steps:
        chosen = runs.early_checkpoint({one: runs.stored_score(run, one) for one in steps})
        early = runs.load_checkpoint(runs.checkpoint_path(run, chosen))
        found.append(("early", early.env_steps, portable_policy(early, env)))
    found.append(("final", checkpoint.env_steps, final))
    return [{"name": name, "env_steps": at, **_stored(policy)} for name, at, policy in found]


def _stored(policy: PortablePolicy) -> dict[str, Any]:
    """Return a policy as JSON values, arrays as float32 in base64."""

    def pair(layer: Any) -> dict[str, str]:
        return {"kernel": encoded(layer.kernel), "bias": encoded(layer.bias)}

    encoder = policy.encoder
    return {
        "mean": encoded(policy.mean),
        "std": encoded(policy.std),
        "layers": [pair(layer) for layer in policy.layers],
        "squash": policy.squash,
        "encoder": encoder
        and {
            "shape": list(encoder.image_shape),
            "convolutions": [
                {**pair(one), "side": len(one.kernel), "stride": one.stride}
                for one in encoder.convolutions
            ],
            "dense": pair(encoder.dense),
        },
    }


def _export(checkpoint: Checkpoint, env: JetBotEnv, policy: PortablePolicy) -> dict[str, Any]:
    """Return what a page needs to write `policy.py` and `policy.json` of what it trained."""
    spec = policy_spec(checkpoint, env, policy)
    return {
        "python": _ASSETS.joinpath("policy.py").read_text("utf-8"),
        "about": {
            "inputs": list(policy.inputs),
            "image": None,
            "strides": [],
            "activation": policy.activation,
            "squash": policy.squash,
            "controller": policy.controller and policy.controller._asdict(),
        },
        "spec": {**spec, "evaluation": None, "files": {"numpy": {"file": "policy.py"}}},
    }


def page_text(data: Mapping[str, Any]) -> str:
    """Return the page as HTML.

    Args:
      data: the result of `page_data`.
    """
    web = _ASSETS.joinpath("web")
    text = web.joinpath("page.html").read_text("utf-8")
    scripts = {
        name: "".join(web.joinpath(file).read_text("utf-8") for file in files)
        for name, files in _SCRIPTS.items()
    }
    style = text.partition("<style>")[2].partition("</style>")[0]
    # A `<` in a text of JSON could end its element.
    json_text = json.dumps(data, separators=(",", ":")).replace("<", "\\u003c")
    parts = {
        "csp": _security_policy(scripts.values(), style),
        "title": html.escape(data["meta"]["title"]),
        "data": json_text,
        **scripts,
    }
    # All at once: a part may hold what looks like the place of another one.
    return re.sub(r"{{(\w+)}}", lambda place: parts[place[1]], text)


def _security_policy(scripts: Sequence[str] | Any, style: str) -> str:
    """Return what a page may run: its own scripts and style, by their hashes, and the module."""
    run = " ".join([*map(_source, scripts), "'wasm-unsafe-eval'"])
    return (
        f"default-src 'none'; script-src {run}; style-src {_source(style)}; worker-src blob:;"
        " img-src data: blob:; base-uri 'none'; form-action 'none'"
    )


def _source(text: str) -> str:
    digest = hashlib.sha256(text.encode()).digest()
    return f"'sha256-{base64.b64encode(digest).decode()}'"
