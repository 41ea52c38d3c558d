"""A resumed training equals one that was never stopped; damaged checkpoints are skipped.

All trainings here are of the smoke configuration, 16 training steps of 4,096 environment steps,
with a report after every fourth: each is compared to the smoke run, which was never stopped.
"""

import errno
import fcntl
import functools
import itertools
import json
import os
import shlex
import shutil
import sys
import time
import types

import jax
import numpy as np
import orbax.checkpoint as ocp
import pytest

from helpers.command_modules import train
from helpers.fake_wandb import FakeWandb
from helpers.tensorboard_files import read_events
from jetbot_mjx import load_config, make_env, training
from jetbot_mjx.agents.networks import make_networks
from jetbot_mjx.config import CHANGEABLE_ON_RESUME
from jetbot_mjx.devices import compiler_options
from jetbot_mjx.errors import UserError
from jetbot_mjx.evaluation.evaluator import Evaluator
from jetbot_mjx.runs import Setup, checkpoint_store, metrics, run_dir
from jetbot_mjx.runs.checkpoint import POLICY
from jetbot_mjx.runs.checkpoint_store import (
    FOLDER,
    CheckpointError,
    CheckpointStore,
    UnreadableError,
    checkpoint_path,
    checkpoint_steps,
    digest,
    flatten,
    read_about,
)
from jetbot_mjx.runs.resumption import TRAINING, resume, to_trees
from jetbot_mjx.runs.run_dir import write_run
from jetbot_mjx.runs.run_finder import find_run, runs_table, scan_runs
from jetbot_mjx.training import ppo_trainer, session
from jetbot_mjx.training.preemption import StopRequest
from jetbot_mjx.training.result import complete_message
from jetbot_mjx.training.run_recorder import Standing
from onekernel.aot.program_cache import ProgramCache

STEPS = [0, 16_384, 32_768, 49_152, 65_536]
LAST, BEFORE = STEPS[-1], STEPS[-2]
TRAINING_STEP = 4_096


@pytest.fixture(scope="module")
def smoke(root):
    return str(root / "configs" / "smoke.yaml")


@pytest.fixture(scope="module")
def config(smoke):
    return load_config(smoke)


@pytest.fixture(scope="module", autouse=True)
def program(config, smoke_run):
    """Every training of this file runs the same programs: they are traced once."""
    env = make_env(config)
    original = ppo_trainer.CompiledTrainer.from_setup(Setup(config, env=env))
    compiled = functools.cache(original.compile)
    first = functools.cache(lambda: original.get(original.init()))

    class Program(ppo_trainer.CompiledTrainer):
        def compile(self):
            return compiled()

        def init(self):
            return self.put(first())

    networks = make_networks(config.ppo, env.observation_size, env.action_size)
    evaluator = Evaluator(env, networks, ProgramCache(compiler_options(config.deterministic)))
    # The face would keep the one that it finds first.
    assert training.CompiledTrainer is ppo_trainer.CompiledTrainer
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ppo_trainer, "CompiledTrainer", Program)
        patch.setattr(session, "Evaluator", lambda env, networks, programs: evaluator)
        yield original


@pytest.fixture(scope="module")
def template(program):
    return program.template()


@pytest.fixture(scope="module")
def states(smoke_run, config, template, tmp_path_factory):
    """The states of the run that was never stopped, by environment steps."""
    run_dir = shutil.copytree(smoke_run, tmp_path_factory.mktemp("states") / "run")
    found = {}
    for env_steps in reversed(STEPS):
        found[env_steps] = resume([run_dir], [config], template).states[0]
        shutil.rmtree(checkpoint_path(run_dir, env_steps))
    return found


@pytest.fixture
def run_copy(smoke_run, tmp_path):
    return shutil.copytree(smoke_run, tmp_path / "run")


def lines(run_dir):
    """The log, without what the clock says."""
    found = [json.loads(line) for line in (run_dir / "metrics.jsonl").read_text().splitlines()]
    return [
        {
            name: value
            for name, value in line.items()
            if name != "timestamp" and not name.startswith("time/")
        }
        for line in found
    ]


def figures_in(events):
    return [(step, name, value) for step, name, value in events if not name.startswith("time/")]


@pytest.fixture
def same(smoke_run, states, config, template):
    """Checks that a run is, bit for bit, the one that was never stopped."""

    def same(run_dir):
        found = resume([run_dir], [config], template)
        assert (found.env_steps, found.skipped) == (LAST, [])
        assert digest(found.states[0]) == digest(states[LAST])
        for env_steps in STEPS:
            ours, theirs = (
                read_about(checkpoint_path(folder, env_steps)) for folder in (run_dir, smoke_run)
            )
            assert ours["sha256"][POLICY] == theirs["sha256"][POLICY]
            assert ours["sha256"][TRAINING] == theirs["sha256"][TRAINING]
            assert ours["metrics"] == theirs["metrics"]
            for about in (ours, theirs):
                assert about["progress"].pop("wall_seconds") > 0
            assert ours["progress"] == theirs["progress"]
        assert [line["env_steps"] for line in lines(run_dir)] == STEPS
        assert lines(run_dir) == lines(smoke_run)
        events = read_events(run_dir / "tensorboard")
        places = [(step, name) for step, name, _ in events]
        assert len(places) == len(set(places))
        assert figures_in(events) == figures_in(read_events(smoke_run / "tensorboard"))

    return same


def test_a_state_is_read_back_whole(states, template):
    assert list(states) == STEPS[::-1]
    for env_steps, state in states.items():
        assert jax.tree.structure(state) == jax.tree.structure(template)
        assert ppo_trainer.env_steps(state) == env_steps
        assert state.sums["training_steps"] == 0
    keys = {state.key.tobytes() for state in states.values()}
    assert len(keys) == len(STEPS)
    assert len({digest(state.env_state) for state in states.values()}) == len(STEPS)
    assert len({digest(state.optimizer_state) for state in states.values()}) == len(STEPS)


@pytest.mark.slow
def test_twice_as_long_is_resumed_half_way(smoke, tmp_path, same, capsys):
    run_dir = tmp_path / "run"
    arguments = ["--set", "ppo.num_timesteps=32768", "--run-dir", str(run_dir)]
    assert train.main(["--config", smoke, *arguments]) == 0
    assert checkpoint_steps(run_dir) == STEPS[:3]
    capsys.readouterr()
    assert train.main(["--resume", str(run_dir), "--set", "ppo.num_timesteps=65536"]) == 0
    same(run_dir)
    out, err = capsys.readouterr()
    assert "resuming after 32,768 steps" in out
    assert "skipped: " not in out
    assert "the results may differ" not in out
    assert err == ""
    assert load_config(run_dir / "config.yaml").ppo.num_timesteps == 65_536


class StopAfter(StopRequest):
    """Asks a training to stop after so many training steps."""

    notice = 300.0

    def __init__(self, training_steps):
        super().__init__(self.notice)
        self._left = training_steps

    def wait(self, seconds):
        time.sleep(seconds)
        return False

    @property
    def requested(self):
        self._left -= 1
        return self._left < 0


@pytest.fixture
def stop_after(monkeypatch):
    """Makes the next trainings stop after so many training steps, each a call of its own."""

    def stop_after(training_steps):
        monkeypatch.setattr(session, "DeferredSignals", lambda notice: StopAfter(training_steps))
        monkeypatch.setattr(ppo_trainer, "next_chunk", lambda steps, seconds, wanted: 1)

    return stop_after


def test_stopped_anywhere_and_continued_is_never_stopped(
    config, tmp_path, stop_after, same, monkeypatch
):
    run_dir = tmp_path / "run"
    done = 0
    for count in (0, 1, 5, 0, 2, 6):
        stop_after(count)
        result = session.run(config, run_dir)
        done += count
        assert not result.finished
        assert checkpoint_steps(run_dir)[-1] == done * TRAINING_STEP
        logged = [line["env_steps"] for line in lines(run_dir)]
        assert logged == [steps for steps in STEPS if steps <= done * TRAINING_STEP]
    monkeypatch.undo()
    assert session.run(config, run_dir).finished
    same(run_dir)


@pytest.fixture
def clock_going_back(monkeypatch):
    """The clock of the system is an hour earlier each time that somebody looks at it."""
    now = itertools.count(time.time(), -3_600)
    monkeypatch.setattr(time, "time", lambda: next(now))


def test_a_clock_that_is_set_back_changes_nothing(
    config, tmp_path, stop_after, same, clock_going_back
):
    run_dir = tmp_path / "run"
    for count in (6, 99):
        stop_after(count)
        assert session.run(config, run_dir).finished == (count == 99)
    same(run_dir)
    history = metrics.read_history(run_dir / "metrics.jsonl")
    times = [line.timestamp for line in history]
    assert times == sorted(times, reverse=True)
    for name in {name for line in history for name in line.metrics if name.startswith("time/")}:
        values = [line.metrics[name] for line in history]
        assert all(value is None or value >= 0 for value in values), name
    wall = [line.metrics["time/wall_seconds"] for line in history]
    assert wall == sorted(wall)
    assert wall[-1] < 3_600
    (listed,), damaged = scan_runs(tmp_path)
    assert not damaged
    assert (listed.env_steps, find_run("latest", tmp_path)) == (LAST, run_dir)
    assert " 0 s" in runs_table([listed._replace(changed=times[0] + 86_400)])


def test_a_state_between_two_reports_is_saved_with_what_was_summed_up(
    config, tmp_path, stop_after, template
):
    stop_after(6)
    session.run(config, tmp_path)
    found = resume([tmp_path], [config], template)
    assert found.env_steps == 24_576
    assert found.states[0].sums["training_steps"] == 2
    assert found.progress[0]["env_steps"] == 16_384
    assert read_about(checkpoint_path(tmp_path, 24_576))["metrics"] == {}


def test_a_finished_run_is_not_trained_again(config, smoke_run, run_copy, same, monkeypatch):
    monkeypatch.delattr(ppo_trainer, "train")
    result = session.run(config, run_copy)
    assert result.finished
    about = read_about(checkpoint_path(smoke_run, LAST))
    assert result.fingerprints == [about["sha256"][POLICY]]
    assert result.standings[0].to_json() == about["progress"]
    assert result.wall_seconds >= about["progress"]["wall_seconds"]
    assert (run_copy / "metrics.jsonl").read_bytes() == (smoke_run / "metrics.jsonl").read_bytes()
    same(run_copy)


def test_a_run_without_a_checkpoint_starts_from_the_beginning(config, smoke_run, tmp_path, same):
    for name in ("config.yaml", "versions.json", "metrics.jsonl"):
        shutil.copy(smoke_run / name, tmp_path)
    left = tmp_path / FOLDER / ".000000000000.unfinished"
    left.mkdir(parents=True)
    assert session.run(config, tmp_path).finished
    assert not left.exists()
    same(tmp_path)


def files_of(path):
    return [file for file in sorted(path.rglob("*")) if file.is_file()]


def data(path):
    """The files that hold the arrays, not those that tell where in them each lies."""
    return files_of(path / "d")


def cut(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def flip(path, every):
    content = bytearray(path.read_bytes())
    content[::every] = (byte ^ 8 for byte in content[::every])
    path.write_bytes(content)


def for_each(harm, files):
    return lambda newest, _: [harm(file) for file in files(newest)]


def edit(change):
    """Changes the text of the explanation, and not its hash."""

    def harm(newest, _):
        path = newest / "about" / "metadata"
        about = json.loads(path.read_text())
        change(about)
        path.write_text(json.dumps(about))

    return harm


def test_other_programs_can_read_the_policy_and_the_rest_is_one_array(smoke_run):
    path = checkpoint_path(smoke_run, LAST)
    with ocp.StandardCheckpointer() as reader:
        policy, rest = (reader.restore(path / name) for name in (POLICY, TRAINING))
    assert policy[KERNEL].ndim == 2
    assert list(rest) == ["bytes"]


def replace(name):
    """Takes a part of the checkpoint before."""

    def harm(newest, _):
        shutil.rmtree(newest / name)
        shutil.copytree(checkpoint_path(newest.parents[1], BEFORE) / name, newest / name)

    return harm


def rewrite(change_about=lambda about: None, change_trees=lambda trees: None):
    """Writes the checkpoint again, with valid hashes and other content."""

    def harm(newest, state):
        about = read_about(newest)
        trees = {name: flatten(tree) for name, tree in to_trees(state).items()}
        change_about(about)
        change_trees(trees)
        shutil.rmtree(newest)
        with CheckpointStore(newest.parents[1], keep=50) as store:
            store.save(LAST, trees, about, None)

    return harm


def rename(newest, _):
    return newest.rename(newest.with_name("000000081920"))


def remove(newest, _):
    shutil.rmtree(newest)


def an_empty_folder(newest, _):
    shutil.rmtree(newest)
    newest.mkdir()


def a_file(newest, _):
    shutil.rmtree(newest)
    newest.write_text("a file where a folder should be")


def a_dangling_link(newest, _):
    shutil.rmtree(newest)
    newest.symlink_to("nowhere")


def a_foreign_checkpoint(newest, state):
    shutil.rmtree(newest)
    with ocp.StandardCheckpointer() as writer:
        for name in (POLICY, TRAINING):
            writer.save(newest / name, {"weights": np.ones(3)})


KERNEL = "policy.params.hidden_0.kernel"

DAMAGES = {
    "data cut": (for_each(cut, data_of := lambda path: data(path / POLICY)), "cannot be read"),
    "data emptied": (for_each(lambda file: file.write_bytes(b""), data_of), "cannot be read"),
    "data missing": (for_each(lambda file: file.unlink(), data_of), "cannot be read"),
    "data flipped": (for_each(lambda file: flip(file, 100), data_of), "policy"),
    "data of the rest flipped": (
        for_each(lambda file: flip(file, 100), lambda path: data(path / TRAINING)),
        "training",
    ),
    "index flipped": (
        for_each(lambda file: flip(file, 50), lambda path: files_of(path / POLICY / "d")),
        "cannot be read",
    ),
    "manifest flipped": (
        lambda newest, _: flip(newest / POLICY / "manifest.ocdbt", 10**6),
        "a file in policy is damaged or missing",
    ),
    "manifest cut": (lambda newest, _: cut(newest / TRAINING / "manifest.ocdbt"), "cannot be read"),
    "manifest missing": (
        lambda newest, _: (newest / TRAINING / "manifest.ocdbt").unlink(),
        "cannot be read",
    ),
    "policy missing": (lambda newest, _: shutil.rmtree(newest / POLICY), "policy is missing"),
    "training missing": (lambda newest, _: shutil.rmtree(newest / TRAINING), "training is missing"),
    "training a file": (
        lambda newest, _: (shutil.rmtree(newest / TRAINING), (newest / TRAINING).write_text("")),
        "training is missing",
    ),
    "about missing": (lambda newest, _: shutil.rmtree(newest / "about"), "missing or damaged"),
    "about cut": (lambda newest, _: cut(newest / "about" / "metadata"), "missing or damaged"),
    "about emptied": (
        lambda newest, _: (newest / "about" / "metadata").write_text(""),
        "missing or damaged",
    ),
    "about with other steps": (
        edit(lambda about: about.update(env_steps=65_537)),
        "about/metadata changed after it was written",
    ),
    "about with another figure": (
        edit(lambda about: about["metrics"].update(success_rate=0.123)),
        "about/metadata changed after it was written",
    ),
    "about without its hash": (
        edit(lambda about: about["sha256"].pop("about")),
        "missing or damaged",
    ),
    "about without hashes": (edit(lambda about: about.pop("sha256")), "missing or damaged"),
    "about of another checkpoint": (replace("about"), "was renamed: it was written after 49152"),
    "training of another checkpoint": (replace(TRAINING), "training changed after it was written"),
    "policy of another checkpoint": (replace(POLICY), "policy changed after it was written"),
    "another shape": (
        rewrite(change_trees=lambda trees: trees[POLICY].update({KERNEL: np.ones((7, 64))})),
        f"{KERNEL} is float64[7, 64], and should be float32[7, 32]",
    ),
    "another dtype": (
        rewrite(change_trees=lambda trees: trees[TRAINING].update(key=np.zeros(2, np.int32))),
        "key is int32[2], and should be uint32[2]",
    ),
    "fewer environments": (
        rewrite(
            change_trees=lambda trees: trees.update(
                {
                    TRAINING: {
                        name: leaf[:64] if name.startswith("env_state") else leaf
                        for name, leaf in trees[TRAINING].items()
                    }
                }
            )
        ),
        "and should be float32[128",
    ),
    "an array more": (
        rewrite(change_trees=lambda trees: trees[TRAINING].update(more=np.ones(2, np.float32))),
        "more is float32[2], and should be missing",
    ),
    "an array fewer": (
        rewrite(change_trees=lambda trees: trees[TRAINING].pop("key")),
        "key is missing, and should be uint32[2]",
    ),
    "a policy only": (
        rewrite(change_trees=lambda trees: trees.pop(TRAINING)),
        "holds no training",
    ),
    "another format": (
        rewrite(lambda about: about.update(format="jetbot_mjx/1")),
        "has the format 'jetbot_mjx/1', and only 'jetbot_mjx/3' can be read",
    ),
    "another seed": (
        rewrite(lambda about: about["config"].update(seed=1)),
        "belongs to another run: seed = 0 is not what the run began with, 1",
    ),
    "another learning rate": (
        rewrite(lambda about: about["config"]["ppo"].update(learning_rate=0.5)),
        "belongs to another run: ppo.learning_rate = 0.001",
    ),
    "other networks": (
        rewrite(
            lambda about: about["config"]["ppo"]["network"].update(value_hidden_layer_sizes=[5])
        ),
        "belongs to another run: ppo.network.value_hidden_layer_sizes",
    ),
    "a configuration that cannot run": (
        rewrite(lambda about: about["config"].update(seed=-1)),
        "belongs to another run: stored config: seed = -1 is wrong",
    ),
    "a foreign checkpoint": (a_foreign_checkpoint, "is not one of jetbot_mjx"),
    "renamed": (rename, "was renamed: it was written after 65536 steps"),
    "an empty folder": (an_empty_folder, "is not one of jetbot_mjx"),
    "a file": (a_file, "about/metadata is missing"),
    "a dangling link": (a_dangling_link, "about/metadata is missing"),
}


@pytest.mark.parametrize("kind", DAMAGES)
def test_a_damaged_checkpoint_is_skipped_and_the_one_before_is_taken(
    run_copy, states, config, template, kind, capfd, caplog
):
    harm, reason = DAMAGES[kind]
    newest = checkpoint_path(run_copy, LAST)
    other = harm(newest, states[LAST])
    newest = other if kind == "renamed" else newest
    found = resume([run_copy], [config], template)
    assert found.env_steps == BEFORE
    assert digest(found.states[0]) == digest(states[BEFORE])
    (said,) = found.skipped
    assert f"checkpoint {newest} " in said
    assert reason in said
    assert "\n" not in said
    assert checkpoint_steps(run_copy) == STEPS[:-1]
    assert os.listdir(run_copy / "set_aside") == [f"{newest.name}.0"]
    assert capfd.readouterr() == ("", "")
    assert not caplog.records
    again = resume([run_copy], [config], template)
    assert (again.env_steps, again.skipped) == (BEFORE, [])


def test_the_damages_are_of_many_kinds():
    assert len(DAMAGES) >= 20


def no_answer(*given, **named):
    raise OSError(errno.EIO, os.strerror(errno.EIO))


def no_answer_to_tensorstore(*given, **named):
    raise ValueError("UNKNOWN: Error opening driver: Input/output error [os_error_code='5']")


@pytest.mark.parametrize(
    ("place", "name", "fail"),
    [
        (os, "listdir", no_answer),
        (run_dir, "open_at_once", no_answer),
        (checkpoint_store, "_count_bytes", no_answer),
        (checkpoint_store.ts, "open", no_answer_to_tensorstore),
    ],
)
def test_a_drive_that_does_not_answer_costs_no_checkpoint(
    run_copy, states, config, template, monkeypatch, place, name, fail
):
    with monkeypatch.context() as patch:
        patch.setattr(place, name, fail)
        with pytest.raises(UnreadableError, match="Input/output error") as caught:
            resume([run_copy], [config], template)
    assert "\n" not in str(caught.value)
    assert not (run_copy / "set_aside").exists()
    assert digest(resume([run_copy], [config], template).states[0]) == digest(states[LAST])


def test_the_best_checkpoint_does_not_lose_its_score_while_the_drive_does_not_answer(
    run_copy, monkeypatch
):
    monkeypatch.setattr(run_dir, "open_at_once", no_answer)
    with pytest.raises(UnreadableError):
        CheckpointStore(run_copy, keep=1)


HARMLESS = {
    "leftover": lambda newest: (newest.parent / ".000000081920.unfinished").mkdir(),
    "stray folder": lambda newest: (newest.parent / "99999").mkdir(),
    "stray file": lambda newest: (newest.parent / "notes.txt").write_text("mine"),
    "no metadata of Orbax": lambda newest: (newest / POLICY / "_METADATA").unlink(),
    "nothing": lambda newest: None,
}


@pytest.mark.parametrize("kind", HARMLESS)
def test_what_does_no_harm_is_not_skipped(run_copy, states, config, template, kind, capfd):
    HARMLESS[kind](checkpoint_path(run_copy, LAST))
    found = resume([run_copy], [config], template)
    assert (found.env_steps, found.skipped) == (LAST, [])
    assert digest(found.states[0]) == digest(states[LAST])
    assert not (run_copy / "set_aside").exists()
    assert capfd.readouterr() == ("", "")


def test_any_flipped_bit_leaves_the_right_state_or_an_older_one(
    run_copy, states, config, template, capfd, caplog
):
    newest = checkpoint_path(run_copy, LAST)
    generator = np.random.default_rng(0)
    found = set()
    for file in files_of(newest):
        whole = file.read_bytes()
        content = bytearray(whole)
        content[generator.integers(len(content))] ^= 1 << generator.integers(8)
        file.write_bytes(content)
        result = resume([run_copy], [config], template)
        assert digest(result.states[0]) == digest(states[result.env_steps])
        found.add(result.env_steps)
        if result.env_steps == BEFORE:
            (run_copy / "set_aside" / f"{newest.name}.0").rename(newest)
        file.write_bytes(whole)
    assert found == {BEFORE, LAST}
    assert capfd.readouterr() == ("", "")
    assert not caplog.records


def test_several_damaged_checkpoints_are_skipped_from_the_newest_on(
    run_copy, states, config, template
):
    newest, second = (checkpoint_path(run_copy, steps) for steps in (LAST, BEFORE))
    DAMAGES["data cut"][0](newest, None)
    DAMAGES["about missing"][0](second, None)
    found = resume([run_copy], [config], template)
    assert found.env_steps == STEPS[2]
    assert digest(found.states[0]) == digest(states[STEPS[2]])
    assert [str(newest) in found.skipped[0], str(second) in found.skipped[1]] == [True] * 2
    assert checkpoint_steps(run_copy) == STEPS[:3]
    assert sorted(os.listdir(run_copy / "set_aside")) == [f"{second.name}.0", f"{newest.name}.0"]


def contents(folder):
    return {path: path.read_bytes() if path.is_file() else None for path in folder.rglob("*")}


@pytest.mark.parametrize(
    ("progress", "key"),
    [
        ([], "progress"),
        ({"env_steps": -1}, "progress.env_steps"),
        ({"wall_seconds": {}}, "progress.wall_seconds"),
        ({"best": {"luck": 1.0}}, "progress.best"),
    ],
)
def test_progress_that_no_training_has_written_costs_one_line(run_copy, states, progress, key):
    harm = rewrite(lambda about: about.update(progress=progress))
    harm(checkpoint_path(run_copy, LAST), states[LAST])
    said = refused(train.main, ["--resume", str(run_copy)])
    assert said.startswith(f"{run_copy}: the last checkpoint has unusable metadata: {key}")


def test_with_all_checkpoints_damaged_nothing_is_moved(run_copy, config, template, capfd):
    for env_steps in STEPS:
        cut(checkpoint_path(run_copy, env_steps) / "about" / "metadata")
    before = contents(run_copy)
    for use in (
        lambda: resume([run_copy], [config], template),
        lambda: session.run(config, run_copy),
    ):
        with pytest.raises(CheckpointError) as caught:
            use()
        said = str(caught.value)
        assert "\n" not in said
        assert f"no checkpoint in {run_copy / FOLDER} can be used. The newest: " in said
        assert str(checkpoint_path(run_copy, LAST)) in said
    after = contents(run_copy)
    after.pop(run_copy / ".lock")
    before.pop(run_copy / ".lock")
    assert after == before
    assert capfd.readouterr() == ("", "")


def test_a_folder_without_checkpoints_resumes_nothing(tmp_path, config, template):
    assert resume([tmp_path], [config], template) is None


@pytest.mark.parametrize("damage", ["missing", "data cut"])
def test_several_seeds_go_on_from_the_newest_that_all_of_them_have(
    smoke_run, tmp_path, states, config, template, damage
):
    folders = [shutil.copytree(smoke_run, tmp_path / name) for name in ("one", "other")]
    harm = remove if damage == "missing" else DAMAGES[damage][0]
    harm(checkpoint_path(folders[1], LAST), None)
    found = resume(folders, [config, config], template)
    assert found.env_steps == BEFORE
    assert [digest(state) for state in found.states] == 2 * [digest(states[BEFORE])]
    assert [checkpoint_steps(folder) for folder in folders] == 2 * [STEPS[:-1]]
    assert os.listdir(folders[0] / "set_aside") == [f"{LAST:012d}.0"]
    assert len(found.skipped) == 1
    assert str(folders[1]) in found.skipped[0]


@pytest.mark.parametrize("kind", ["data flipped", "about missing", "a file"])
def test_training_after_damage_ends_where_it_would_have(
    run_copy, config, states, same, kind, capfd
):
    DAMAGES[kind][0](checkpoint_path(run_copy, LAST), states[LAST])
    with (run_copy / "metrics.jsonl").open("a") as file:
        file.write('{"env_steps": 81920, "timestamp": 1.0}\n{"env_steps": 98304, "timest')
    assert session.run(config, run_copy, verbose=True).finished
    same(run_copy)
    out, err = capfd.readouterr()
    assert f"skipped: checkpoint {checkpoint_path(run_copy, LAST)} " in out
    assert "resuming after 49,152 steps" in out
    assert err == ""


def test_lines_that_no_checkpoint_holds_are_written_again(run_copy, smoke_run, config, same):
    for env_steps in STEPS[2:]:
        remove(checkpoint_path(run_copy, env_steps), None)
    path = run_copy / "metrics.jsonl"
    kept = path.read_text().splitlines()[:2]
    path.write_text(path.read_text()[:-40])
    assert session.run(config, run_copy).finished
    assert path.read_text().splitlines()[:2] == kept
    same(run_copy)


def test_what_is_not_as_it_was_is_said(run_copy, config, capsys):
    path = run_copy / "versions.json"
    found = json.loads(path.read_text())
    found["packages"]["brax"] = "0.0.1"
    path.write_text(json.dumps(found))
    session.run(config, run_copy, verbose=True)
    assert (
        "versions changed, so the results may differ: brax 0.0.1, now " in capsys.readouterr().out
    )
    session.run(config, run_copy, verbose=True)
    assert "the results may differ" not in capsys.readouterr().out


def refused(use, *arguments):
    with pytest.raises(UserError) as caught:
        use(*arguments)
    assert "\n" not in str(caught.value)
    return str(caught.value)


CHANGES = {
    "ppo.num_timesteps": 65_000,
    "stop_at_success": 0.01,
    "stop_at_return": -1.5,
    "checkpoint_interval": 8_192,
    "checkpoints_to_keep": 1,
    "preemption_notice": 60.0,
    "tensorboard": "false",
    "wandb": "jetbots",
    "evaluation.video": "true",
}


@pytest.mark.slow
@pytest.mark.parametrize("key", CHANGEABLE_ON_RESUME)
def test_settings_that_may_change_on_resume_are_applied_and_stored(run_copy, key, monkeypatch):
    monkeypatch.setitem(sys.modules, "wandb", FakeWandb())
    setting = f"{key}={CHANGES[key]}"
    assert train.main(["--resume", str(run_copy), "--set", setting]) == 0
    stored = load_config(run_copy / "config.yaml")
    assert stored == load_config(run_copy / "config.yaml", [setting])
    assert checkpoint_steps(run_copy) == STEPS


@pytest.mark.slow
@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("seed=1", "seed = 1 is not what the run began with, 0"),
        ("seeds=2", "seeds = 2 is not what the run began with, 1"),
        ("deterministic=true", "deterministic = True is not what the run began with, False"),
        ("ppo.learning_rate=0.5", "ppo.learning_rate = 0.5 is not what the run began with, 0.001"),
        ("ppo.num_envs=64", "ppo.num_envs = 64 is not what the run began with, 128"),
        ("task.episode_length=9", "task.episode_length = 9 is not what the run began with, 256"),
        ("evaluation.episodes=8", "evaluation.episodes = 8 is not what the run began with, 64"),
        ("robot.preset=real", "robot.preset = 'real' is not what the run began with, 'isaac'"),
        (
            "ppo.network.policy_hidden_layer_sizes=[32]",
            "policy_hidden_layer_sizes = [32] is not what the run began with, [32, 32]",
        ),
        ("task.options.x=3", "task.options.x = 3 is not what the run began with, None"),
        ("ppo.num_timesteps=4096", f"ppo.num_timesteps = 4096 is fewer than the {LAST:,} steps"),
    ],
)
def test_settings_that_may_not_change_on_resume_are_refused_by_name(run_copy, setting, said):
    before = contents(run_copy)
    answer = refused(train.main, ["--resume", str(run_copy), "--set", setting])
    assert said in answer
    assert contents(run_copy) == before
    if "may change" in answer:
        # The setting comes first, and a complete command last.
        assert answer.startswith(f"{setting.partition('=')[0]} = ")
        words = shlex.split(answer.rpartition("`jetbot-mjx train ")[2].removesuffix("`"))
        options = train._parser().parse_args(words)
        assert (options.config, options.init_from) == (run_copy / "config.yaml", str(run_copy))
        asked_for, proposed = (
            load_config(options.config, settings) for settings in ([setting], options.overrides)
        )
        assert proposed == asked_for


def test_the_command_that_is_proposed_has_all_settings_that_were_given(run_copy):
    given = ["ppo.learning_rate=3e-3", "ppo.num_timesteps=131072", "stop_at_success=0.9"]
    answer = refused(
        train.main, ["--resume", str(run_copy), *(f"--set={setting}" for setting in given)]
    )
    assert "leave ppo.learning_rate out" in answer
    words = shlex.split(answer.rpartition("`jetbot-mjx train ")[2].removesuffix("`"))
    options = train._parser().parse_args(words)
    config = run_copy / "config.yaml"
    assert load_config(config, options.overrides) == load_config(config, given)


def test_the_same_command_with_another_configuration_is_refused(run_copy, smoke):
    arguments = ["--config", smoke, "--run-dir", str(run_copy), "--seed", "3"]
    said = refused(train.main, arguments)
    assert f"{run_copy} holds another run: choose a new --run-dir, or begin with its policy" in said
    assert "seed = 3 is not what the run began with, 0" in said


def test_resuming_a_complete_run_says_how_to_train_longer(run_copy, config, capsys):
    assert train.main(["--resume", str(run_copy)]) == 0
    out = capsys.readouterr().out
    assert f"complete after {LAST:,} steps; raise ppo.num_timesteps to train further\n" in out
    assert not any(line.startswith("resuming") for line in out.splitlines())
    early = complete_message(config, [Standing(env_steps=16_384)])
    assert early == "complete after 16,384 steps; raise stop_at_success to train further"


def test_a_run_that_ended_before_its_first_checkpoint_begins_as_another(config, tmp_path):
    write_run(tmp_path, config.model_copy(update={"seed": 3}), {})
    (tmp_path / "metrics.jsonl").write_text("")
    (tmp_path / "checkpoints").mkdir()
    assert session.run(config, tmp_path).finished
    assert load_config(tmp_path / "config.yaml") == config


def test_a_run_without_checkpoints_says_that_it_starts_from_zero(config, tmp_path, capsys):
    write_run(tmp_path, config, {})
    assert train.main(["--resume", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert out.startswith("the run has no checkpoint: starting from zero\n")
    assert "resuming" not in out


@pytest.mark.parametrize("length", [0, 1, 700, -4])
def test_a_configuration_that_was_cut_is_not_taken_for_another_runs(run_copy, smoke, length):
    path = run_copy / "config.yaml"
    kept = path.read_text().splitlines(keepends=True)[:length] if length < 0 else ""
    path.write_text("".join(kept) or path.read_text()[:length])
    before = contents(run_copy)
    for arguments in (["--resume"], ["--config", smoke, "--run-dir"]):
        said = refused(train.main, [*arguments, str(run_copy)])
        assert said.startswith(f"the run {run_copy} is damaged: config.yaml ")
        assert said.endswith(": restore the file, or train into a new folder")
    assert contents(run_copy) == before


def test_a_changed_interval_moves_the_reports_and_nothing_else(
    config, tmp_path, stop_after, monkeypatch, states
):
    stop_after(5)
    session.run(config, tmp_path)
    monkeypatch.undo()
    changed = config.model_copy(update={"checkpoint_interval": 2 * TRAINING_STEP})
    assert session.run(changed, tmp_path).finished
    steps = [0, *range(16_384, LAST + 1, 8_192)]
    assert [line["env_steps"] for line in lines(tmp_path)] == steps
    about = read_about(checkpoint_path(tmp_path, LAST))
    assert about["sha256"][TRAINING] == digest(to_trees(states[LAST])[TRAINING])


@pytest.mark.parametrize("kind", ["nothing there", "an empty folder", "a folder", "a file"])
def test_resuming_where_there_is_no_run_is_refused_and_writes_nothing(tmp_path, kind):
    path = tmp_path / "run"
    if kind == "a file":
        path.write_text("")
    elif kind != "nothing there":
        path.mkdir()
    if kind == "a folder":
        (path / "notes.txt").write_text("mine")
    before = contents(tmp_path)
    said = refused(train.main, ["--resume", str(path)])
    assert str(path) in said
    assert "no run" in said
    assert contents(tmp_path) == before


def test_resume_names_the_folder_already(tmp_path, capsys):
    with pytest.raises(SystemExit) as caught:
        train.main(["--resume", str(tmp_path), "--run-dir", str(tmp_path)])
    assert caught.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "--run-dir: --resume continues that run, in its folder" in line


def test_resume_and_config_exclude_each_other(tmp_path, smoke, capsys):
    with pytest.raises(SystemExit) as caught:
        train.main(["--resume", str(tmp_path), "--config", smoke])
    assert caught.value.code == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.parametrize("stored", ["brax", "resumable"])
def test_a_run_of_the_stock_trainer_is_not_continued(config, run_copy, stored):
    ppo = config.ppo.model_copy(update={"normalizer": "brax"})
    brax = config.model_copy(update={"trainer": "brax", "ppo": ppo})
    if stored == "brax":
        (run_copy / "config.yaml").write_text(brax.to_yaml())
    before = contents(run_copy)
    said = refused(session.run, config if stored == "brax" else brax, run_copy)
    assert f"in use by a run of trainer = {stored!r}, which cannot be continued" in said
    assert contents(run_copy) == before


def test_a_run_that_another_training_holds_is_refused_and_left_alone(config, run_copy):
    with (run_copy / ".lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        print(12345, file=file, flush=True)
        before = contents(run_copy)
        assert "locked by another training (process 12345)" in refused(
            session.run, config, run_copy
        )
        assert contents(run_copy) == before
    assert session.run(config, run_copy).finished


def test_a_folder_that_is_no_run_is_refused_and_left_alone(config, tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    before = contents(tmp_path)
    assert "holds no run" in refused(session.run, config, tmp_path)
    assert contents(tmp_path) == before


def test_a_folder_that_cannot_be_made_costs_one_line(config, tmp_path):
    (tmp_path / "file").write_text("")
    assert "Not a directory" in refused(session.run, config, tmp_path / "file" / "run")


def no_space(*arguments, **keywords):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def third(failing, original):
    """Fails at the third call."""
    calls = iter((original, original, failing))

    def call(*arguments, **keywords):
        return next(calls, original)(*arguments, **keywords)

    return call


def full_volume(monkeypatch):
    usage = shutil.disk_usage("/")._replace(free=1_000)
    monkeypatch.setattr(shutil, "disk_usage", third(lambda path: usage, shutil.disk_usage))


def full_log(monkeypatch):
    fake = types.SimpleNamespace(**{**vars(os), "fsync": third(no_space, os.fsync)})
    monkeypatch.setattr(metrics, "os", fake)


def full_tensorboard(monkeypatch):
    original = metrics.EventsWriter.flush
    monkeypatch.setattr(metrics.EventsWriter, "flush", third(no_space, original))


def full_store(monkeypatch):
    original = checkpoint_store.sync_tree
    monkeypatch.setattr(checkpoint_store, "sync_tree", third(no_space, original))


FULL = {
    "volume": (full_volume, "checkpoints: the disk is full"),
    "log": (full_log, "cannot be written: No space left on device"),
    "tensorboard": (full_tensorboard, "cannot be written: No space left on device"),
    "store": (full_store, "could not be written: No space left on device; the earlier"),
}


@pytest.mark.parametrize("kind", FULL)
def test_a_full_disk_costs_one_line_and_the_same_command_goes_on(
    config, tmp_path, same, monkeypatch, kind, capfd, caplog, states, template
):
    fill, said = FULL[kind]
    fill(monkeypatch)
    line = refused(session.run, config, tmp_path)
    assert str(tmp_path) in line
    assert said in line
    monkeypatch.undo()
    found = resume([tmp_path], [config], template)
    assert found.env_steps in STEPS[:2]
    assert digest(found.states[0]) == digest(states[found.env_steps])
    if kind == "store":
        assert session.run(config, tmp_path).finished
        same(tmp_path)
    assert capfd.readouterr().err == ""
    assert not caplog.records


def test_the_best_checkpoint_is_kept_across_a_resume(config, run_copy, states):
    best = read_about(checkpoint_path(run_copy, LAST))["progress"]["best_steps"]
    for env_steps in (one for one in STEPS if one > best):
        remove(checkpoint_path(run_copy, env_steps), None)
    about = read_about(checkpoint_path(run_copy, best))
    with CheckpointStore(run_copy, keep=1) as store:
        for env_steps in (LAST + 1, LAST + 2):
            store.save(env_steps, to_trees(states[LAST]), about, 0.0)
    assert checkpoint_steps(run_copy) == [0, best, LAST + 2]
