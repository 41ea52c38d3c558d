"""Videos of the evaluations, which change nothing in a training."""

import json
import re
import time

import imageio.v3 as iio
import numpy as np
import pytest
from PIL import Image

from jetbot_mjx import load_config, viewers
from jetbot_mjx.agents.networks import PolicyParams
from jetbot_mjx.envs import opengl
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation.evaluator import Summary
from jetbot_mjx.evaluation.rollout import Episodes
from jetbot_mjx.runs import Setup
from jetbot_mjx.runs.checkpoint_store import checkpoint_path, checkpoint_steps, read_about
from jetbot_mjx.runs.metrics import CompileClock
from jetbot_mjx.training import composition, run_recorder, session
from jetbot_mjx.training.callbacks import Progress
from jetbot_mjx.training.ppo_trainer import build_ppo
from jetbot_mjx.viewers import video

PARAMS = PolicyParams(normalizer=np.zeros(1), policy=np.ones(2), value=np.zeros(1))


@pytest.fixture
def recorder(root, tmp_path, monkeypatch):
    """Makes recorders whose evaluations have fixed results."""

    class Evaluator:
        def __init__(self, env, networks, programs):
            pass

        def prepare(self, params, episodes):
            pass

        def run(self, params, keys):
            one, place = np.ones(len(keys)), np.zeros((len(keys), 2))
            return Episodes(
                success=one,
                steps=one,
                episode_return=one,
                terminated=one,
                nonfinite=0 * one,
                path_length=one,
                start_w=place,
                start_yaw=0 * one,
                end_w=place,
                goal_w=np.zeros((1, 3)),
                goal=None,
                qpos=None,
            )

    monkeypatch.setattr(session, "Evaluator", Evaluator)
    clocks = []

    def recorder(*settings):
        config = load_config(root / "configs" / "smoke.yaml", settings)
        folders = [tmp_path / f"seed-{index}" for index in range(config.seeds)]
        for folder in folders:
            folder.mkdir(exist_ok=True)
        clocks.append(CompileClock())
        setup = Setup(config)
        ppo = build_ppo(setup)
        parts = composition.Training(setup=setup, run_dir=tmp_path, run_dirs=folders, ppo=ppo)
        return session.open_recorder(parts, clocks[-1], None)

    yield recorder
    for clock in clocks:
        clock.__exit__()


@pytest.fixture
def events(monkeypatch, tmp_path):
    """Saved checkpoints and rendered videos in their order, with the length of the log then."""
    found = []

    def lines(run_dir):
        return len((run_dir / "metrics.jsonl").read_text().splitlines())

    class Film:
        def __init__(self, setup):
            pass

        def write(self, path, params, env_steps):
            time.sleep(0.2)
            Image.new("RGB", (8, 4)).save(path.with_suffix(".gif"))
            run_dir = path.parents[2]
            found.append(("film", str(path.relative_to(run_dir)), run_dir.name, lines(run_dir)))

    class CheckpointStore(run_recorder.CheckpointStore):
        def save(self, env_steps, *arguments):
            run_dir = self._folder.parent
            found.append(("save", env_steps, run_dir.name, lines(run_dir)))
            super().save(env_steps, *arguments)

    monkeypatch.setattr(viewers, "EvaluationVideo", Film)
    monkeypatch.setattr(run_recorder, "CheckpointStore", CheckpointStore)
    monkeypatch.setattr(run_recorder, "find_backend", lambda: "egl")
    return found


def report(recorder, *env_steps, seeds=1):
    for steps in env_steps:
        assert recorder.on_interval([Progress(steps, PARAMS, {}, 1.0)] * seeds)


def times(folder):
    lines = (folder / "metrics.jsonl").read_text().splitlines()
    return [json.loads(line)["time/recording_seconds"] for line in lines]


def test_videos_of_every_seed_follow_after_all_are_logged_and_saved(recorder, events, tmp_path):
    with recorder("evaluation.video=true", "seeds=2") as it:
        report(it, 0, 4096, seeds=2)
    assert events == [
        (what, name, f"seed-{seed}", line)
        for line, steps in enumerate((0, 4096), start=1)
        for what, name in (("save", steps), ("film", f"videos/{steps:012}/evaluation.mp4"))
        for seed in (0, 1)
    ]
    # The time that films take is told, with the next line.
    before, after = times(tmp_path / "seed-0")
    assert before == 0
    assert after > 0.4


def test_video_last_renders_the_end_of_a_training_only(recorder, events, tmp_path):
    with recorder("evaluation.video=last", "ppo.num_timesteps=8192") as it:
        report(it, 0, 4096)
        assert not it.on_interval([Progress(16_384, PARAMS, {}, 1.0)])
    films = [event[1] for event in events if event[0] == "film"]
    assert films == ["videos/000000016384/evaluation.mp4"]


def test_nothing_is_prepared_where_nothing_is_asked_for(recorder, tmp_path, monkeypatch):
    def refuse(*arguments):
        raise AssertionError("this was not asked for")

    for module, name in ((video, "EvaluationVideo"), (run_recorder, "find_backend")):
        monkeypatch.setattr(module, name, refuse)
    with recorder() as it:
        report(it, 0)
    assert not (tmp_path / "seed-0" / "videos").exists()


def test_without_opengl_training_goes_on_after_one_line(recorder, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(opengl, "_PROBE", "raise SystemExit(1) # {backend}")
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    opengl.find_backend.cache_clear()
    try:
        with recorder("evaluation.video=true") as it:
            report(it, 0, 4096, 8192)
    finally:
        opengl.find_backend.cache_clear()
    told = [line for line in capsys.readouterr().out.splitlines() if "OpenGL" in line]
    assert len(told) == 1
    assert "evaluation.video: no videos are rendered" in told[0]
    assert "apt-get install" in told[0]
    assert not (tmp_path / "seed-0" / "videos").exists()
    assert checkpoint_steps(tmp_path / "seed-0") == [0, 4096, 8192]


def test_a_full_disk_costs_one_line_and_no_checkpoint(recorder, events, tmp_path):
    (tmp_path / "seed-0").mkdir()
    (tmp_path / "seed-0" / "videos").write_text("a file where a folder should be")
    with recorder("evaluation.video=true") as it, pytest.raises(UserError, match="cannot be writ"):
        report(it, 0)
    assert checkpoint_steps(tmp_path / "seed-0") == [0]


@pytest.mark.slow
def test_videos_change_no_bit_of_a_training(root, smoke_run, tmp_path, monkeypatch):
    try:
        opengl.find_backend()
    except UserError as error:
        pytest.skip(str(error))
    monkeypatch.setattr(video.EvaluationVideo, "_SIZE", (64, 64))
    monkeypatch.setattr(video.EvaluationVideo, "_FPS", 2.0)
    settings = ["evaluation.video=true", "ppo.num_timesteps=16384"]
    config = load_config(root / "configs" / "smoke.yaml", settings)
    session.run(config, tmp_path / "run")
    assert checkpoint_steps(tmp_path / "run") == [0, 16_384]
    for steps in (0, 16_384):
        ours, theirs = (
            read_about(checkpoint_path(folder, steps)) for folder in (tmp_path / "run", smoke_run)
        )
        for tree in ("policy", "training"):
            assert ours["sha256"][tree] == theirs["sha256"][tree]
        assert ours["metrics"] == theirs["metrics"]
        path = tmp_path / "run" / "videos" / f"{steps:012}" / "evaluation.mp4"
        pictures = iio.imread(path, plugin="pyav")
        assert pictures.shape[1:] == (64, video.EvaluationVideo.GOALS * 64, 3)
        assert len(pictures) > 4
        with Image.open(path.with_suffix(".gif")) as gif:
            assert gif.n_frames > 4
    lines = [
        json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()
    ]
    assert lines[1]["time/recording_seconds"] > 0.5


def test_all_logs_get_everything_and_are_all_closed(root, tmp_path):
    class Sink:
        def write(self, env_steps, metrics):
            log.append((self, env_steps, dict(metrics)))

        def close(self):
            log.append((self, "closed"))
            raise OSError("disk full")

    log, sinks = [], [Sink(), Sink()]
    config = load_config(root / "configs" / "smoke.yaml")
    seed = run_recorder.SeedRecorder(config, tmp_path, sinks, {}, run_recorder.Standing(), "")
    summary = Summary(*[0.0] * len(Summary._fields))
    seed.report(Progress(3, PARAMS, {}, 1.0), summary, {"a": 1.0}, 1.0)
    with pytest.raises(UserError, match="disk full"):
        seed.close()
    first, second = sinks
    written = [(first, 3, {"a": 1.0}), (second, 3, {"a": 1.0})]
    assert log == [*written, (second, "closed"), (first, "closed")]


@pytest.mark.parametrize(
    ("seconds", "said"),
    [(-0.1, "1 of 2 programs from the cache)"), (0.0, ")"), (1.0, "saved 1.0 s)")],
)
def test_the_seconds_saved_by_the_cache_are_reported(recorder, capsys, seconds, said):
    with recorder() as recording:
        recording.clock.programs, recording.clock.cached = 2, 1
        recording.clock.saved_seconds = seconds
        recording.on_compiled()
        recording.on_progress(4_096, {}, 1.0)
    line = next(line for line in capsys.readouterr().out.splitlines() if "first training" in line)
    assert line.endswith(said)
    assert ("saved" in line) == (seconds > 0)


def test_messages_are_in_the_run_folder_and_those_of_progress_are_not(recorder, tmp_path):
    with recorder() as recording:
        recording.begin("a headline\nof two lines")
        recording.on_progress(4_096, {}, 1.0)
    lines = (tmp_path / "train.log").read_text().splitlines()
    assert [re.sub(r"^\d{4}-\d\d-\d\d \d\d:\d\d:\d\d  ", "", line) for line in lines] == [
        "a headline",
        "of two lines",
    ]
