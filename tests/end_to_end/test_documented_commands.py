"""Every documented command runs, with configurations, goals and pictures made small.

Words that set a size are replaced, nothing else; `make` is what continuous integration calls.
Every training compiles a program of its own, so most of this is slow: `make test-slow`.
"""

import importlib
import re
import runpy
import shutil
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ruamel.yaml import YAML

from helpers.doc_pages import COMMANDS, PAGES, ROOT, blocks, commands, in_full, own_files
from jetbot_mjx import plan
from jetbot_mjx.agents import NanDump
from jetbot_mjx.config import load_config
from jetbot_mjx.deployment.simulated_jetbot import SimulatedJetBot
from jetbot_mjx.envs.build import make_env
from jetbot_mjx.envs.wrappers import wrap_for_training
from jetbot_mjx.runs.nan_dump import save_nan_dump
from jetbot_mjx.viewers import mujoco_window

TEXTS = {**PAGES, "README.md": (ROOT / "README.md").read_text("utf-8")}

SMALL = {
    "num_timesteps": 512,
    "num_envs": 16,
    "unroll_length": 8,
    "batch_size": 16,
    "num_minibatches": 2,
    "num_updates_per_batch": 1,
    "network": {"policy_hidden_layer_sizes": [8], "value_hidden_layer_sizes": [8]},
}
SIZES = {
    "ppo.num_timesteps=": "1024",
    "ppo.num_envs=": "16",
    "ppo.batch_size=": "16",
    "checkpoint_interval=": "256",
    "cpu_devices=": "1",  # this process has begun with one
}
NUMBERS = {"--seeds": "2", "--episodes": "3", "--checkpoint": "256"}
"""What stands in for the number behind an argument."""

TRAININGS = (
    "jetbot --run-dir runs/mine",
    "jetbot --seeds 5 --run-dir runs/five",
    "hopper --run-dir runs/hopper",
)
"""The trainings whose runs the other commands name."""


DOCUMENTED = {
    " ".join(words): (page, in_full(words))
    for page, text in TEXTS.items()
    for block in blocks(text, "sh")
    for words in commands(block)
}


def of_kind(*start):
    """Documented commands that begin with these words, variables before them set aside."""
    found = []
    for text, (page, words) in DOCUMENTED.items():
        if "--distributed" in words:  # one of several processes: test_distributed.py
            continue
        bare = [word for word in words if not re.fullmatch(r"[A-Z_]+=.*", word)]
        if tuple(bare[: len(start)]) == start:
            found.append(pytest.param(page, words, id=text))
    return found


def make_small(text):
    """A configuration with the sizes of `SMALL`."""
    values = YAML(typ="safe", pure=True).load(text)
    values["ppo"] = {**values.get("ppo", {}), **SMALL}
    return {**values, "checkpoint_interval": 256, "evaluation": {"episodes": 4}}


@pytest.fixture(scope="module")
def checkout(tmp_path_factory):
    """A checkout with small configurations, in which the runs of the pages are trained."""
    folder = tmp_path_factory.mktemp("checkout")
    for path in [*(ROOT / "configs").glob("*.yaml"), *(ROOT / "examples").glob("*")]:
        place = folder / path.relative_to(ROOT)
        place.parent.mkdir(exist_ok=True)
        if path.suffix == ".yaml":
            with place.open("w") as file:
                YAML(typ="safe", pure=True).dump(make_small(path.read_text()), file)
        elif path.is_file():
            shutil.copy(path, place)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        for arguments in TRAININGS:
            assert f"jetbot-mjx train {arguments}" in DOCUMENTED
            assert run("train", arguments.split()) == 0
        shutil.copytree("runs/mine", "runs/other")
        shutil.copytree("runs/hopper", "runs/hopper-2")
        assert run("pretrained", []) == 0
    return folder


@pytest.fixture
def reader(checkout, small_videos, monkeypatch):
    """Sits in the checkout, with the files that a page has its reader write."""

    def sit(page):
        monkeypatch.chdir(checkout)
        for name, text in own_files(page).items() if page in PAGES else ():
            if name.endswith(".yaml"):
                with Path(name).open("w") as file:
                    YAML(typ="safe", pure=True).dump(make_small(text), file)
            else:
                Path(name).write_text(text, encoding="utf-8")

    return sit


def smaller(words):
    """The words with the sizes replaced."""
    words = list(words)
    for index, word in enumerate(words):
        for key, value in SIZES.items():
            if word.startswith(key):
                words[index] = key + value
        if words[index - 1] in NUMBERS and word.isdecimal():
            words[index] = NUMBERS[words[index - 1]]
    return words


def run(command, arguments):
    """Calls a command as the terminal would; returns its exit code."""
    # The latest run is that of whichever page came before, and may hold several seeds.
    words = ["runs/mine" if word == "latest" else word for word in smaller(arguments)]
    small = Path(f"configs/{words[0]}.yaml") if words else Path()
    if command == "train" and small.is_file() and "--init-from" not in words:
        # By its name a configuration has the size that it is shipped with.
        words[0] = str(small)
    return COMMANDS[command].main(words)


def execute(page, words, reader, monkeypatch):
    reader(page)
    while re.fullmatch(r"\w+=.*", words[0]):
        name, _, value = words[0].partition("=")
        if name != "JAX_DEFAULT_MATMUL_PRECISION":  # JAX reads it once, when it is imported
            monkeypatch.setenv(name, value)
        words = words[1:]
    return run(words[2].removeprefix("jetbot_mjx."), words[3:])


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:Brax System", "ignore:Accessing")
@pytest.mark.parametrize(("page", "words"), of_kind("python", "-m", "jetbot_mjx.train"))
def test_a_documented_training_trains(page, words, reader, monkeypatch, capsys):
    if "wandb=jetbots" in words:
        pytest.importorskip("wandb")
        monkeypatch.setenv("WANDB_MODE", "offline")  # nobody is logged in here
    if "ppo.update=fused" in words and jax.default_backend() == "cpu":
        pytest.skip("there is no NVIDIA GPU")
    assert execute(page, words, reader, monkeypatch) == 0
    assert "best policy" in capsys.readouterr().out


@pytest.fixture
def pillar(reader, monkeypatch):
    """The run of the page about tasks, unless it is there."""
    if not Path("runs/pillar").exists():
        page, words = DOCUMENTED["jetbot-mjx train my_task.yaml --run-dir runs/pillar"]
        assert execute(page, words, reader, monkeypatch) == 0


@pytest.mark.slow
@pytest.mark.parametrize(("page", "words"), of_kind("python", "-m", "jetbot_mjx.evaluate"))
def test_a_documented_evaluation_writes_its_report(
    page, words, reader, pillar, monkeypatch, capsys
):
    words = words if "--episodes" in words else [*words, "--episodes", "3"]
    # Policies as small as these are below any target.
    assert execute(page, words, reader, monkeypatch) == int("--min-success" in words)
    # A robot has a scripted baseline; an environment of one's own has none.
    baseline = "zero" if "runs/hopper" in words else "scripted"
    assert re.search(rf"^{baseline} ", capsys.readouterr().out, re.MULTILINE)


@pytest.mark.slow
@pytest.mark.parametrize(("page", "words"), of_kind("python", "-m", "jetbot_mjx.render"))
def test_a_documented_rendering_draws(page, words, reader, pillar, monkeypatch, capsys):
    if "--many" in words:
        words = [word.replace("1024", "9") for word in words]
    elif not {"--episodes", "--goals", "--strip"} & set(words):
        words = [*words, "--episodes", "2"]
    if "runs/short" in words:
        words = [word.replace("runs/short", "runs/mine") for word in words]
    assert execute(page, words, reader, monkeypatch) == 0
    assert (".png" if "--strip" in words else ".mp4") in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize(("page", "words"), of_kind("python", "-m", "jetbot_mjx.replay"))
def test_a_documented_replay_ends_at_the_non_finite_state(page, words, reader, monkeypatch, capsys):
    reader(page)
    config = load_config("runs/mine/config.yaml")
    env = wrap_for_training(make_env(config), config.task.episode_length)
    state = jax.tree.map(lambda x: x[0], env.reset(jax.random.PRNGKey(0)[None]))
    physics = state.pipeline_state
    physics = physics.replace(qvel=jnp.full_like(physics.qvel, jnp.inf))
    nan_dump = NanDump(
        found=np.array(True),
        env_state=state.replace(pipeline_state=physics),
        actions=np.zeros((8, 2), np.float32),
        step=np.array(0),
    )
    assert str(save_nan_dump(Path("runs/mine"), config, 131_072, nan_dump)) == words[-1]
    assert execute(page, words, reader, monkeypatch) == 0
    assert "qvel" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize(("page", "words"), of_kind("python", "-m", "jetbot_mjx.play"))
def test_a_documented_play_drives(page, words, reader, monkeypatch, capsys):
    browser = pytest.importorskip("jetbot_mjx.viewers.viser_server")

    def look_once(page):
        page.step()
        raise KeyboardInterrupt

    monkeypatch.setattr(browser.ViserViewer, "run", look_once)
    monkeypatch.setattr(mujoco_window, "require_window", lambda: None)
    monkeypatch.setattr(mujoco_window, "run", lambda player: player.tick())
    assert execute(page, words, reader, monkeypatch) == 0
    assert "0 of 0 goals reached" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize(("page", "words"), of_kind("python", "-m", "jetbot_mjx.plan"))
def test_a_documented_plan_tells_what_fits(page, words, monkeypatch, capsys):
    monkeypatch.chdir(ROOT)
    assert plan.main(words[3:]) == 0
    assert "4,096" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize(("page", "words"), of_kind("tensorboard"))
def test_tensorboard_finds_events_where_it_is_told_to_look(page, words, reader):
    reader(page)
    assert list(Path(words[-1]).rglob("events.out.tfevents.*"))


@pytest.mark.parametrize(("page", "words"), of_kind("make"))
def test_every_documented_target_is_made_by_continuous_integration(page, words):
    assert f"\nmake {words[1]}" in (ROOT / ".ci" / "run").read_text()


@pytest.mark.slow
@pytest.mark.parametrize(("page", "words"), of_kind("python", "benchmarks/steps_per_second.py"))
def test_a_documented_benchmark_measures(page, words, monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(ROOT)
    from benchmarks import steps_per_second

    counts = ["16,32" if re.fullmatch(r"[\d,]+", word) else word for word in words[2:]]
    assert steps_per_second.main([*counts, "--output", str(tmp_path / "out.json")]) == 0
    assert "training" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize(("page", "words"), of_kind("python", "-m", "jetbot_mjx.export"))
def test_a_documented_export_is_held_to_jax(page, words, reader, real_run, monkeypatch, capsys):
    assert execute(page, words, reader, monkeypatch) == 0
    count = "1,000" if "pretrained:jetbot_camera" in words else "10,000"
    assert f"on {count} observations" in capsys.readouterr().out


@pytest.fixture
def real_run(reader, monkeypatch):
    """The run of the page about real robots, unless it is there."""
    page, words = next(
        (page, words)
        for page, words in DOCUMENTED.values()
        if page == "deploy.md" and words[2] == "jetbot_mjx.train"
    )
    reader(page)
    if not Path("runs/real").exists():
        assert execute(page, words, reader, monkeypatch) == 0


@pytest.mark.slow
def test_the_page_about_real_robots_leads_to_a_comparison(reader, real_run, monkeypatch, capsys):
    # In order, as a reader would: the stand-in is the robot and its clock, and copies are links.
    monkeypatch.syspath_prepend(ROOT / "deploy")
    monkeypatch.syspath_prepend(ROOT / "benchmarks" / "throughput")
    import calibrate
    import drive
    from poses import Tracker
    from rehearse import Camera

    robot = SimulatedJetBot()
    eye = Camera(robot, 60.0, 0.0, np.random.default_rng(0))
    distances = iter([0.14, 0.33])
    monkeypatch.setattr(drive, "make_robot", lambda: robot)
    monkeypatch.setattr(drive, "udp_tracker", lambda *where: Tracker(eye.receive))
    mains = {
        "calibrate": lambda words: calibrate.main(
            words, robot, robot, lambda: (next(distances), 0.0)
        ),
        "drive": lambda words: drive.main(words, clock=robot),
    }
    done = []
    for page, words in DOCUMENTED.values():
        if page != "deploy.md" or words[:3] == ["python", "-m", "jetbot_mjx.train"]:
            continue
        if words[0] == "scp":
            if words[1] == "-r":  # to the robot
                Path("policy").symlink_to("runs/real/policy")
            continue
        if words[1] == "-m":
            assert execute(page, words, reader, monkeypatch) == 0
        elif words[1].endswith("policy/policy.py"):
            with pytest.raises(SystemExit) as left:
                runpy.run_path(words[1], run_name="__main__")
            assert left.value.code == 0
        else:
            name = Path(words[1]).stem
            main = mains.get(name) or importlib.import_module(name).main
            # What has learnt nothing reaches nothing.
            assert main(words[2:]) == int(name in {"drive", "rehearse"})
        done.append(Path(words[1]).stem)
    assert {"rehearse", "action_latency", "policy", "calibrate", "drive"} <= set(done)
    assert Path("seen.sim2real.png").is_file()
    assert "mm at the end" in capsys.readouterr().out


@pytest.mark.slow
def test_documented_tasks_are_written_and_checked(tmp_path):
    found = [
        one.values
        for name in ("new_task", "new_env", "check_env", "new_robot", "check_robot")
        for one in of_kind("python", "-m", f"jetbot_mjx.{name}")
    ]
    assert len(found) == 6
    for page, words in found:
        folder = tmp_path / page
        folder.mkdir(exist_ok=True)
        for name, text in own_files(page).items() if page in PAGES else ():
            (folder / name).write_text(text, encoding="utf-8")
        start = words.index("-m") + 1
        name = words[start].removeprefix("jetbot_mjx.")
        with pytest.MonkeyPatch.context() as patch:
            patch.chdir(folder)
            if name in ("new_robot", "new_env"):
                # The page shows a file of this name, too.
                for file in own_files(page).keys() & {words[start + 1], "my_env.yaml"}:
                    Path(file).unlink()
            assert run(name, words[start + 1 :]) == 0, words


def test_no_kind_of_command_is_left_out():
    # Installing needs a network, Slurm a cluster, copying a robot; the tests that are named run
    # among these; Python is run as it is.
    elsewhere = {("pip", "install"), ("apt-get", "install"), ("[", "$?"), ("break",), ("srun",)}
    elsewhere |= {("scp",), ("git", "clone"), ("cd",)}
    covered = {"train", "evaluate", "render", "replay", "play", "plan", "export", "sim2real"}
    covered |= {"new_task", "new_env", "check_env", "new_robot", "check_robot", "pretrained"}
    covered.add("jetbot_mjx")
    # Tested by test_list_configs.py, test_list_runs.py, test_share.py and test_tune.py.
    covered |= {"configs", "runs", "tune", "share"}
    for text, (_, words) in DOCUMENTED.items():
        bare = [word for word in words if not re.fullmatch(r"[A-Z_]+=.*", word)]
        if bare[:2] == ["python", "-m"] and bare[2] != "pytest":
            assert bare[2].removeprefix("jetbot_mjx.") in covered, text
        elif bare[0] not in {"python", "python3"}:
            known = bare[0] in {"make", "tensorboard"} or tuple(bare[:2]) in elsewhere
            assert known or tuple(bare[:1]) in elsewhere, text


@pytest.mark.parametrize(("page", "words"), of_kind("python", "-c"))
def test_a_documented_line_of_python_runs(page, words, capsys):
    exec(compile(words[2], page, "exec"), {})
    assert capsys.readouterr().out
