"""What a shared run holds: all that others need, nothing of this machine, and a card."""

import json
import os
import re
import shutil
from pathlib import Path

import pytest

from helpers import fake_hub
from jetbot_mjx import runs
from jetbot_mjx.config import Config, parse_config
from jetbot_mjx.deployment import sharing
from jetbot_mjx.deployment.sharing import model_card, share_run, summarize_sharing
from jetbot_mjx.envs import JetBotEnv
from jetbot_mjx.errors import NotFoundError, UserError
from jetbot_mjx.evaluation import goal_set
from jetbot_mjx.runs.task_code import TaskCode, write_task_code

pytest.importorskip("huggingface_hub")
# Of the library, about itself.
pytestmark = pytest.mark.filterwarnings("ignore:Use 'content=:DeprecationWarning")

POLICY = {
    "episodes": 1024,
    "success_rate": 0.998,
    "success_low": 0.9929,
    "success_high": 0.9995,
    "time_to_goal_median": 1.3,
}
REPORT = {
    "goal_set_version": goal_set.GOAL_SET_VERSION,
    "policy": POLICY,
    "versions": {"packages": {"jetbot_mjx": "0.1.0", "jax": "0.10.2", "mujoco": "3.17.0"}},
}


@pytest.fixture
def run(smoke_run, tmp_path, monkeypatch):
    """A copy of the run with a report and a video, in a folder of its own: the current one."""
    monkeypatch.chdir(tmp_path)
    folder = shutil.copytree(smoke_run, tmp_path / "runs" / "mine")
    name = runs.find_checkpoint(folder).name
    for kind, files in {
        f"evaluations/{name}": {"report.json": json.dumps(REPORT), "report.html": "<p>"},
        f"videos/{name}": {"episodes.mp4": "mp4", "episodes.gif": "gif"},
        "nan_dumps": {"0.npz": ""},
        "task/__pycache__": {"x.pyc": ""},
    }.items():
        (folder / kind).mkdir(parents=True)
        for file, text in files.items():
            (folder / kind / file).write_text(text)
    (folder / f"evaluations/{name}/report.md").write_text("# Report")
    return Path("runs/mine")


@pytest.fixture
def hub(monkeypatch, tmp_path):
    """The server, for one who is logged in as ada."""
    monkeypatch.setenv("HF_TOKEN", "hf_ada")
    with fake_hub.serving() as server:
        monkeypatch.setenv("HF_ENDPOINT", server.url)
        yield server


@pytest.fixture
def quick(monkeypatch):
    """What other tests test is not made."""

    def page(run, output, **_):
        output.write_text("<p>page")
        return type("Page", (), {"path": output})

    def policy(run, output, **_):
        output.mkdir()
        (output / "policy.py").write_text("numbers")
        return type("Exported", (), {"folder": output})

    monkeypatch.setattr(sharing, "write_web_page", page)
    monkeypatch.setattr(sharing, "export_policy", policy)


def files(hub, name="ada/robot"):
    return hub.repositories[name][-1].files


@pytest.mark.usefixtures("quick")
def test_another_user_gets_the_run_and_nothing_of_this_machine(run, hub, monkeypatch, tmp_path):
    best = runs.find_checkpoint(run)
    shared = share_run(run, "hf:ada/robot")
    assert len(hub.repositories["ada/robot"]) == 2
    found = files(hub)
    tops = {path.partition("/")[0] for path in found} - {".gitattributes"}
    assert tops == {
        *("config.yaml", "versions.json", "metrics.jsonl", "checkpoints", "README.md"),
        *("policy", "evaluations", "page.html", "clip.mp4", "clip.gif"),
    }
    assert {path.split("/")[1] for path in found if path.startswith("checkpoints/")} == {best.name}
    assert (found["clip.gif"], found["page.html"]) == (b"gif", b"<p>page")
    for path, content in found.items():
        assert not re.search(rb"/home/|/root/|/tmp/|" + os.fsencode(tmp_path), content), path
    assert summarize_sharing(shared) == (
        f"{hub.url}/ada/robot: {len(found) - 1} files, {shared.size / 1e6:.1f} MB, revision"
        f" {hub.repositories['ada/robot'][-1].sha}\nanyone can use it: jetbot-mjx play hf:ada/robot"
    )
    # The other user.
    monkeypatch.setenv("HF_TOKEN", "hf_eve")
    (tmp_path / "eve").mkdir()
    monkeypatch.chdir(tmp_path / "eve")
    theirs, ours = runs.load_checkpoint("hf:ada/robot"), runs.load_checkpoint(best)
    assert theirs.config == ours.config
    assert theirs.about["sha256"] == ours.about["sha256"]
    assert theirs.results_dir.parent == Path.cwd() / "runs" / "hub"


@pytest.mark.usefixtures("quick")
def test_what_cannot_be_made_is_one_line_and_the_rest_is_shared(run, hub, monkeypatch):
    shutil.rmtree(run / "videos")

    def no_opengl(*_, **__):
        raise UserError("this machine has no OpenGL")

    monkeypatch.setattr(sharing.viewers, "render_run", no_opengl)
    shared = share_run(run, "hf:ada/robot")
    assert "  without a clip: this machine has no OpenGL\n" in summarize_sharing(shared)
    assert "clip.gif" not in files(hub)["README.md"].decode()
    assert "page.html" in files(hub)


@pytest.mark.usefixtures("quick")
def test_a_report_that_is_missing_is_written_first(run, hub, monkeypatch):
    folder = next((run / "evaluations").iterdir())
    shutil.move(folder, "kept")
    asked = []

    def evaluate_run(run, which, **_):
        asked.append((run, which))
        shutil.move("kept", folder)
        return type("Report", (), {"folder": folder})

    monkeypatch.setattr(sharing.evaluation, "evaluate_run", evaluate_run)
    share_run(run, "hf:ada/robot")
    assert asked == [(run, int(folder.name))]
    assert f"evaluations/{folder.name}/report.json" in files(hub)
    # And then it is taken as it is.
    share_run(run, "hf:ada/robot")
    assert len(asked) == 1


LINKS = (
    *("config.yaml", "metrics.jsonl", "task", "task/x.py", "checkpoints/{name}/about/x"),
    *("checkpoints", "evaluations/{name}/report.md", "videos/{name}/episodes.gif"),
)


@pytest.mark.parametrize("place", LINKS)
@pytest.mark.usefixtures("quick")
def test_a_link_shares_nothing_of_the_rest_of_the_disk(place, run, hub, tmp_path):
    path = run / place.format(name=runs.find_checkpoint(run).name)
    path.parent.mkdir(parents=True, exist_ok=True)
    secret = tmp_path / "secret"
    if path.exists():
        # What it leads to is as good as what was there.
        shutil.move(path, secret)
    else:
        secret.write_text("mine")
    path.symlink_to(secret)
    with runs.trusting(True), pytest.raises(UserError, match="is a link or no file: nothing was"):
        share_run(run, "hf:ada/robot")
    assert not hub.repositories


@pytest.mark.usefixtures("quick")
def test_code_that_may_not_run_is_not_run_by_sharing(run, hub):
    text = (run / "config.yaml").read_text()
    (run / "config.yaml").write_text(text.replace("jetbot_mjx:GoalTask", "evil:Task"))
    write_task_code(run, TaskCode("evil", (("evil.py", b"raise AssertionError"),)))
    from helpers.damage import damage_about

    change = damage_about(lambda about: about["config"]["task"].update(name="evil:Task"))
    for checkpoint in (run / "checkpoints").iterdir():
        change(checkpoint)
    with pytest.raises(UserError, match=r"'evil:Task' would run.*add --trust"):
        share_run(run, "hf:ada/robot")
    assert not hub.repositories


def test_a_run_that_nobody_could_use_is_not_shared(run, hub):
    (run / "config.yaml").unlink()
    with pytest.raises(NotFoundError, match=r"runs/mine: config\.yaml is missing: nobody could"):
        share_run(run, "hf:ada/robot")
    shutil.rmtree(run / "checkpoints")
    with pytest.raises(NotFoundError, match="no checkpoint at"):
        share_run(run, "hf:ada/robot")
    assert not hub.requests


# The card.


def card(run, report=REPORT, **more):
    what = {"licence": "mit", "files": ["evaluations/1/report.md", "clip.gif", "policy/policy.py"]}
    return model_card("hf:ada/robot", runs.load_checkpoint(run), report, **{**what, **more})


def test_the_card_says_what_how_well_and_how_to_use_it(run):
    text = card(run)
    front, _, body = text.removeprefix("---\n").partition("---\n")
    assert dict(line.split(": ", 1) for line in front.splitlines())["license"] == '"mit"'
    assert "| success | 99.80% | 99.29% to 99.95% |" in body
    assert "| time to goal, median | 1.30 s | - |" in body
    assert "with jetbot_mjx\n0.1.0 (JAX 0.10.2, MuJoCo 3.17.0)" in body
    assert "![The policy drives](clip.gif)" in body
    assert "[The whole report](evaluations/1/report.md)" in body
    assert body.endswith("Licence: mit.\n")
    assert "`policy/`" in body
    assert "page.html" not in body
    assert "--trust" not in body
    # Five lines suffice.
    blocks = "\n".join(re.findall(r"```\w+\n(.*?)```", body, re.DOTALL)).split("\n")
    assert len([line for line in blocks if line]) == 5
    assert "jetbot-mjx play hf:ada/robot" in blocks


def test_the_card_tells_returns_and_the_other_simulator(run):
    returns = {"episodes": 64, "episode_return": 9.5, "return_low": 9.0, "return_high": 10.0}
    values = {**REPORT, "policy": {**returns, "success_rate": None}}
    assert "| return, mean | 9.50 | 9.00 to 10.00 |" in card(run, values)
    assert "| success |" not in card(run, values)
    mujoco = {**REPORT, "mujoco": {"policy": {**POLICY, "success_rate": 0.9}}}
    assert "| success in C MuJoCo | 90.00% | 99.29% to 99.95% |" in card(run, mujoco)


def test_an_environment_is_evaluated_and_not_played_with(run):
    config = parse_config({"environment": "slide:Slide"})
    checkpoint = runs.load_checkpoint(run)._replace(config=config)
    files = ["evaluations/1/report.md"]
    text = model_card("hf:ada/robot", checkpoint, REPORT, licence="mit", files=files)
    assert "pip install 'jetbot_mjx[hub]'\njetbot-mjx evaluate hf:ada/robot\n```" in text
    assert "play" not in text


def test_the_card_warns_of_the_authors_code_and_quotes_it_safely(run, monkeypatch):
    monkeypatch.setattr(Config, "code", property(lambda self: "evil:`</a>|\x1b[2J"))
    text = card(run, files=["task/evil.py", "evaluations/1/report.md"])
    assert "code of its author, `evil:??/a??\\x1b[2J`: read it, then add `--trust`." in text
    assert "\x1b" not in text


@pytest.mark.slow
@pytest.mark.usefixtures("optimized", "with_opengl")
def test_all_of_it_is_made_for_a_policy_of_the_package(hub, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    shared = share_run(runs.PRETRAINED / "jetbot_egocentric", "hf:ada/robot")
    assert shared.missing == {}
    assert {"policy/policy.py", "page.html", "clip.mp4", "clip.gif"} <= files(hub).keys()
    assert isinstance(runs.load_checkpoint("hf:ada/robot").make_env(), JetBotEnv)
